//! Published checkpoints rendered by our kernels, and fields that go out and come back.

use super::*;
use crate::geom::Ray;
use crate::kernel::vm::mask::VmRay;
use crate::kernel::vm::{DecoderWeights, RAY_WIDTH, render};
use glam::{DVec3, Vec3};
use serde_json::Value;
use std::path::PathBuf;

fn reference(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference").join(name)
}

fn three(v: &Value) -> [f32; 3] {
    std::array::from_fn(|i| v[i].as_f64().unwrap() as f32)
}

/// `vm_g5.json` holds what plain torch computed from the published formulas.
#[test]
fn an_imported_checkpoint_renders_as_the_published_arithmetic_does() {
    let checkpoint = th::read_th(&reference("vm_g5.th"), &Limits::default()).unwrap();
    let (face, _) = field_of(&checkpoint, None);
    let want: Value = serde_json::from_slice(&std::fs::read(reference("vm_g5.json")).unwrap()).unwrap();
    let weights = DecoderWeights::new(face.field.decoder, &face.network);
    assert_eq!(face.field.lattice.samples, 17);
    let mut open = (*face.field).clone();
    open.mask = None;
    let mut compared = 0;
    for ray in want["rays"].as_array().unwrap() {
        let vm = VmRay { origin: three(&ray["origin"]), direction: three(&ray["direction"]), jitter: 0.0 };
        for (field, key) in [(&open, "without_mask"), (&*face.field, "with_mask")] {
            let out = render(field, &face.density, &face.color, &weights, &[vm]).out;
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
fn a_field_goes_out_and_comes_back_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let path = reference("vm_g5.th");
    let scene = Similarity::scale_translate(2.5, DVec3::new(0.3, -0.2, 0.1));
    let face = import_th(&path, 1.0 / 0.3, &scene, dir.path(), "x").unwrap();
    // out again: what the file held; the mask may differ in vertices that make no cell
    let bytes = export_th(dir.path(), 1.0 / 0.3, &scene).unwrap();
    let (there, back) = (
        th::read_th(&path, &Limits::default()).unwrap(),
        th::from_bytes(&bytes, Path::new("out.th"), &Limits::default()).unwrap(),
    );
    let bare = |c: &VmCheckpoint| VmCheckpoint { mask: None, ..c.clone() };
    assert_eq!(bare(&there), bare(&back));
    let mask = |c: &VmCheckpoint| field_of(c, None).0.field.mask.clone().unwrap();
    let (a, b) = (mask(&there), mask(&back));
    assert_eq!((a.size(), a.bits()), (b.size(), b.bits()));
    let corners = |m: &BoxMask| [m.bounds().0, m.bounds().1].concat();
    assert!(corners(&a).iter().zip(corners(&b)).all(|(a, b)| (a - b).abs() < 1e-5));

    // a ray of the published loader, written in the scene: world = field · 0.3, directions of depth 1
    let (origin, direction) = (Vec3::new(0.1, -0.2, 4.5), Vec3::new(0.02, 0.05, -1.0));
    let in_scene = |p: Vec3| scene.point(p * 0.3);
    let ray =
        Ray { origin: in_scene(origin), direction: direction.normalize(), t_min: 0.0, t_max: f32::INFINITY };
    let seen = face.render(&[ray], Vec3::NEG_Z)[0];
    let weights = DecoderWeights::new(face.field.decoder, &face.network);
    let vm = VmRay { origin: origin.to_array(), direction: direction.to_array(), jitter: 0.0 };
    let want = render(&face.field, &face.density, &face.color, &weights, &[vm]).out;
    for c in 0..3 {
        assert!((seen.color[c] - want[c]).abs() < 1e-5, "{seen:?} {want:?}");
    }
    // depth along the unit ray in scene units: t · ‖d‖ · 0.3 · 2.5
    let depth = want[4] / want[3] * direction.length() * 0.75;
    assert!((seen.depth - depth).abs() < 1e-4, "{seen:?} {depth}");
}

#[test]
fn a_field_of_ours_lies_in_the_datasets_world_when_exported() {
    let checkpoint = th::read_th(&reference("vm_g5.th"), &Limits::default()).unwrap();
    let (face, record) = field_of(&checkpoint, None);
    let dir = tempfile::tempdir().unwrap();
    checkpoint::save_field(dir.path(), &face, record, "x").unwrap();
    // scene = 2 · world + (1, 0, 0), and the file's world is twice the dataset's: file = scene − (1, 0, 0)
    let scene = Similarity::scale_translate(2.0, DVec3::X);
    let bytes = export_th(dir.path(), 2.0, &scene).unwrap();
    let out = th::from_bytes(&bytes, Path::new("out.th"), &Limits::default()).unwrap();
    assert_eq!(out.aabb, [[-2.5, -1.67, -1.0], [0.5, 1.67, 1.0]]);
    assert_eq!(out.distance_scale, 25.0);
    // four times the dataset's: lengths double, so densities count half
    let bytes = export_th(dir.path(), 4.0, &scene).unwrap();
    let out = th::from_bytes(&bytes, Path::new("out.th"), &Limits::default()).unwrap();
    assert_eq!((out.aabb[1][1], out.distance_scale), (3.34, 12.5));
    let turned = Similarity { rotation: DMat3::from_rotation_x(0.1), ..scene };
    assert!(export_th(dir.path(), 2.0, &turned).is_err());
}
