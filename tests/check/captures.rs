//! The three shared captures, read as a user would: formats, splits, poses, masks, and the head's
//! box.
//!
//! They lie beside the repository, or where `TIFACE_SHARED` says; without them these tests skip,
//! aloud.

use crate::clicked::folder;
use glam::{Vec2, Vec3};
use std::collections::HashSet;
use std::path::PathBuf;
use tiface::capture::inspect::inspect;
use tiface::capture::scene::{self, Scene, SceneOptions};
use tiface::capture::{self, Capture, CaptureOptions, MaskMeaning, MaskSource, Split, ViewMask};
use tiface::geom::Camera;
use tiface::image::Gray;
use tiface::io::Limits;

fn count(c: &Capture, split: Split) -> usize {
    c.split(split).count()
}

/// Box and hull from the training views.
fn place(c: &Capture) -> (Scene, Vec<String>, Vec<Camera>) {
    let limits = Limits::default();
    let train: Vec<_> = c.split(Split::Train).collect();
    let cameras: Vec<Camera> = train.iter().map(|v| v.camera.clone()).collect();
    let masks: Vec<Option<Gray>> = train.iter().map(|v| v.load(&limits).unwrap().mask).collect();
    let options =
        SceneOptions { names: train.iter().map(|v| v.name.clone()).collect(), ..SceneOptions::default() };
    let (scene, warnings) = scene::fit(&cameras, &masks, &options).unwrap();
    (scene, warnings, cameras)
}

/// Vertices of a binary PLY whose vertices are six floats, as both `gt.ply` are.
fn vertices(path: &PathBuf) -> Vec<Vec3> {
    let bytes = std::fs::read(path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8_lossy(&bytes[..end]).into_owned();
    assert_eq!(header.matches("property float").count(), 6);
    let n: usize =
        header.split("element vertex ").nth(1).unwrap().split('\n').next().unwrap().parse().unwrap();
    let float = |i: usize| f32::from_le_bytes(bytes[end + 4 * i..end + 4 * i + 4].try_into().unwrap());
    (0..n).map(|i| Vec3::new(float(6 * i), float(6 * i + 1), float(6 * i + 2))).collect()
}

fn in_frame(c: &Camera, p: Vec3) -> bool {
    c.project(p)
        .is_some_and(|(Vec2 { x, y }, _)| x >= 0.0 && y >= 0.0 && x < c.width as f32 && y < c.height as f32)
}

fn light_stage(name: &str) {
    let Some(root) = folder(name) else { return };
    let c = capture::open(&root, &CaptureOptions::default()).unwrap();
    assert_eq!((count(&c, Split::Train), count(&c, Split::Val), count(&c, Split::Test)), (24, 0, 8));
    assert_eq!((c.name.as_str(), c.up, c.warnings.len()), (name, Vec3::Z, 0));
    assert_eq!(c.reasons.iter().filter(|r| r.contains("agrees with the JSON")).count(), 2, "{:?}", c.reasons);
    let names: HashSet<_> = c.views.iter().map(|v| v.name.clone()).collect();
    assert!(names.len() == 32 && names.contains("024"));
    for v in &c.views {
        assert!(matches!(&v.mask, ViewMask::File(p) if p.ends_with(format!("masks/{}.png", v.name))));
        assert!(v.region.is_some() && v.valid.is_none());
    }

    let (scene, warnings, cameras) = place(&c);
    let gt = vertices(&root.join("gt.ply"));
    let seen: Vec<Vec3> =
        gt.iter().copied().filter(|&p| cameras.iter().filter(|c| in_frame(c, p)).count() >= 3).collect();
    let hull = scene.hull.as_ref().unwrap();
    let lost = seen.iter().filter(|&&p| !hull.contains(scene.scene_from_world.point(p))).count();
    let outside = seen.iter().filter(|&&p| !scene::world_box(&scene).contains(p)).count();
    let truth = tiface::geom::Aabb::around(seen.iter().copied());
    eprintln!("{name}: {} of {} vertices seen, {lost} outside the hull", seen.len(), gt.len());
    eprintln!("  box   {}", scene::describe(&scene));
    eprintln!("  truth {:?} .. {:?}\n  {warnings:?}", truth.min, truth.max);
    assert!(outside == 0 && lost == 0);
}

#[test]
fn lps_opens_its_poses_agree_and_its_hull_holds_the_true_surface() {
    light_stage("lps");
}

#[test]
fn nefertiti_opens_its_poses_agree_and_its_hull_holds_the_true_surface() {
    light_stage("nefertiti");
}

#[test]
fn fox_opens_with_distortion_and_a_box_without_masks() {
    let Some(root) = folder("fox") else { return };
    let c = capture::open(&root, &CaptureOptions::default()).unwrap();
    assert_eq!((count(&c, Split::Train), count(&c, Split::Test)), (43, 7));
    assert!(c.views.iter().all(|v| v.mask == ViewMask::None && v.camera.distortion.k1 == 0.0578421));
    assert_eq!(c.up, Vec3::Z); // the mean of the cameras' ups is within 20° of it
    let (scene, warnings, cameras) = place(&c);
    eprintln!("fox: {} {warnings:?}", scene::describe(&scene));
    assert!(scene.hull.is_none());
    let b = scene::world_box(&scene);
    let middle = b.center();
    let near = cameras.iter().filter(|c| in_frame(c, middle)).count();
    assert!(near >= 40, "only {near} cameras see the middle of the box");
    let inside = cameras.iter().filter(|c| b.contains(c.position.as_vec3())).count();
    assert_eq!(inside, 0, "cameras inside the box");
}

#[test]
fn a_downscaled_view_has_the_camera_of_its_pixels() {
    let Some(root) = folder("fox") else { return };
    // 270 × 480 by 4: 67 columns of 4, two left over
    let c = capture::open(&root, &CaptureOptions { downscale: 4, ..Default::default() }).unwrap();
    let v = &c.views[0];
    assert_eq!((v.camera.width, v.camera.height), (67, 120));
    assert!((v.camera.fx - 343.88 / 4.0).abs() < 1e-9 && (v.camera.cx - 138.6395 / 4.0).abs() < 1e-9);
    let loaded = v.load(&Limits::default()).unwrap();
    assert_eq!((loaded.photo.width, loaded.photo.rgb.len()), (67, 67 * 120));
}

#[test]
fn masks_can_be_left_out_named_or_mean_not_looked_at() {
    let Some(root) = folder("nefertiti") else { return };
    let with = |o: CaptureOptions| capture::open(&root, &o).unwrap();
    let none = with(CaptureOptions { masks: MaskSource::None, ..Default::default() });
    assert!(none.views.iter().all(|v| v.mask == ViewMask::None));
    let named = with(CaptureOptions {
        masks: MaskSource::Folder,
        mask_dir: "face_masks".into(),
        ..Default::default()
    });
    assert!(matches!(&named.views[3].mask, ViewMask::File(p) if p.ends_with("face_masks/003.png")));
    let ignore = with(CaptureOptions { mask_meaning: MaskMeaning::Ignore, ..Default::default() });
    let loaded = ignore.views[0].load(&Limits::default()).unwrap();
    let valid = loaded.valid.unwrap();
    assert!(loaded.mask.is_none() && valid.values.contains(&0) && valid.values.contains(&255));
}

#[test]
fn inspecting_a_sound_capture_finds_it_sound() {
    for (name, masks) in [("lps", 32), ("nefertiti", 32), ("fox", 0)] {
        let Some(root) = folder(name) else { continue };
        let mut options = CaptureOptions::default();
        if masks == 0 {
            let found = inspect(&root, &options);
            assert!(!found.is_usable() && found.problems.len() == 1, "{:?}", found.problems);
            assert!(found.problems[0].hint.contains("--page"), "{:?}", found.problems);
            options.masks = MaskSource::None; // as asked
        }
        let found = inspect(&root, &options);
        eprintln!("{found}");
        assert!(found.is_usable() && found.masks == masks, "{:?}", found.problems);
        assert!(found.scene.unwrap().size().cmpgt(Vec3::ZERO).all());
        assert!(serde_json::to_string(&found).unwrap().contains("\"problems\":[]"));
        let distance = found.distance.unwrap();
        assert!(distance.min > 0.0 && distance.max >= distance.median);
    }
}
