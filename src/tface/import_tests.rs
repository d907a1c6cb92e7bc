//! A converted checkpoint rendered by our kernels, compared with the published arithmetic.

use super::*;
use crate::field::testing::session;
use glam::{DVec3, Vec3};
use serde_json::Value;
use std::path::PathBuf;
use tiface_base::Quiet;
use tiface_base::geom::Ray;
use tiface_kernels::cpu::vm::{DecoderWeights, RAY_WIDTH, render};

fn reference(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference").join(name)
}

fn three(v: &Value) -> [f32; 3] {
    std::array::from_fn(|i| v[i].as_f64().unwrap() as f32)
}

fn imported(scene: &Similarity) -> TFace {
    let dir = tempfile::tempdir().unwrap();
    import(&reference("vm_g5.safetensors"), 1.0 / 0.3, scene, &session("tface", dir.path(), "x", &Quiet))
        .unwrap();
    TFace::load("tface", dir.path()).unwrap()
}

/// `vm_g5.json` holds what plain numpy computed from the published formulas.
#[test]
fn an_imported_checkpoint_renders_as_the_published_arithmetic_does() {
    let face = imported(&Similarity::IDENTITY);
    let want: Value = serde_json::from_slice(&std::fs::read(reference("vm_g5.json")).unwrap()).unwrap();
    let weights = DecoderWeights::new(face.field.decoder, &face.values[2]);
    assert_eq!(face.field.lattice.samples, 17);
    let mut open = face.field.clone();
    open.mask = None;
    let mut compared = 0;
    for ray in want["rays"].as_array().unwrap() {
        let vm = Ray::new(three(&ray["origin"]), three(&ray["direction"]));
        for (field, key) in [(&open, "without_mask"), (&face.field, "with_mask")] {
            let out = render(field, &face.values[0], &face.values[1], &weights, &[vm], &[]).out;
            let black = three(&ray[key]["black"]);
            let opacity = ray[key]["opacity"].as_f64().unwrap() as f32;
            for c in 0..3 {
                assert!((out[c] - black[c]).abs() < 5e-7, "{key} {out:?} {ray}");
            }
            assert!((out[3] - opacity).abs() < 5e-7, "{key} {out:?} {ray}");
            // the published depth adds (1 − opacity) d_z, which is −1 here
            let depth = ray[key]["depth"].as_f64().unwrap() as f32;
            let z = vm.direction[2];
            assert!((out[4] + (1.0 - out[3]) * z - depth).abs() < 3e-6, "{key} {out:?} {ray}");
            compared += RAY_WIDTH;
        }
    }
    assert!(compared >= 20);
}

#[test]
fn an_imported_field_renders_in_the_scene_as_in_its_own_world() {
    let scene = Similarity::scale_translate(2.5, DVec3::new(0.3, -0.2, 0.1));
    let face = imported(&scene);
    // a ray of the published loader, written in the scene: world = field · 0.3, directions of depth
    // 1
    let (origin, direction) = (Vec3::new(0.1, -0.2, 4.5), Vec3::new(0.02, 0.05, -1.0));
    let in_scene = |p: Vec3| scene.point(p * 0.3);
    let ray = Ray::new(in_scene(origin), direction.normalize());
    let seen = face.render(&[ray], Vec3::NEG_Z)[0];
    let weights = DecoderWeights::new(face.field.decoder, &face.values[2]);
    let vm = Ray::new(origin, direction);
    let want = render(&face.field, &face.values[0], &face.values[1], &weights, &[vm], &[]).out;
    for c in 0..3 {
        assert!((seen.color[c] - want[c]).abs() < 1e-5, "{seen:?} {want:?}");
    }
    // depth along the unit ray in scene units: t · ‖d‖ · 0.3 · 2.5
    let depth = want[4] / want[3] * direction.length() * 0.75;
    assert!((seen.depth - depth).abs() < 1e-4, "{seen:?} {depth}");
}

#[test]
fn what_was_not_converted_is_refused_with_the_way_to_convert_it() {
    let dir = tempfile::tempdir().unwrap();
    let session = session("tface", dir.path(), "x", &Quiet);
    import(&reference("vm_g5.safetensors"), 1.0 / 0.3, &Similarity::IDENTITY, &session).unwrap();
    let own = checkpoint::newest(dir.path());
    let before = std::fs::read(&own).unwrap();
    let th = dir.path().join("official.th");
    std::fs::write(&th, b"PK\x03\x04and what torch packs").unwrap();
    // nor is the result of an import, which lies in its scene
    for path in [&th, &own, Path::new("/nowhere/x.safetensors")] {
        let e = import(path, 1.0, &Similarity::IDENTITY, &session).err().unwrap();
        assert!(e.to_string().contains(path.file_name().unwrap().to_str().unwrap()), "{e}");
        assert!(e.hint().contains("th_to_safetensors.py"), "{}", e.hint());
    }
    assert!(std::fs::read(&own).unwrap() == before, "a refused import has changed the folder");
}
