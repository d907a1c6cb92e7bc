//! Cameras of the demo head: exact ones, disturbed ones, one that was moved, and photographs that
//! are swapped.

use super::cameras::{CameraCheck, POSES, check_by};
use super::rig_photos::RigPhotos;
use super::tests::{NoFields, draft, measured_head, quiet, scene_of};
use super::{Session, Stage, capture_options, complete, inspect_capture};
use crate::config::{CameraPoses, Config, MaskSource, Preset};
use crate::run::read_record;
use glam::{DMat3, DQuat, DVec3};
use serde_json::{Value, json};
use std::sync::OnceLock;
use tiface_base::geom::Camera;
use tiface_base::io::{self, Limits};
use tiface_capture::path::NamedCamera;
use tiface_capture::rig;
use tiface_capture::scene::{self, SceneOptions};
use tiface_capture::synthetic::SyntheticHead;
use tiface_capture::{self as capture, Capture, Split, View};

/// A quarter of the points is enough for small photographs, and takes a quarter of the time.
const POINTS: usize = rig::POINTS / 4;

fn train(capture: &Capture) -> Vec<&View> {
    capture.split(Split::Train).collect()
}

fn check(capture: &Capture, poses: CameraPoses) -> CameraCheck {
    let photos = RigPhotos::load(capture, &scene_of(capture), &Limits::default()).unwrap().unwrap();
    check_by(POINTS, &photos, poses)
}

/// What is found of exact cameras, measured once a test program.
fn of_exact(poses: CameraPoses) -> &'static CameraCheck {
    static FOUND: [OnceLock<CameraCheck>; 2] = [const { OnceLock::new() }; 2];
    FOUND[usize::from(poses == CameraPoses::Refine)].get_or_init(|| check(&measured_head().1, poses))
}

/// Turns and moves a camera about this many pixels; neighbors in number move oppositely, so that
/// the world stays.
fn disturb(capture: &mut Capture, view: usize, pixels: f64) {
    let camera = &mut capture.views[view].camera;
    let sign = if view.is_multiple_of(2) { 1.0 } else { -1.0 };
    let axis = DVec3::new(1.0, (view / 2 % 3) as f64 - 1.0, 0.5).normalize();
    let turn = DQuat::from_scaled_axis(sign * pixels / camera.fx * axis);
    // about the head: what it does to the picture is the turn alone
    camera.rotation *= DMat3::from_quat(turn);
}

/// Returns the root mean square of how far the head lies from its true place in the pictures.
fn error_px(capture: &Capture, exact: &Capture) -> f64 {
    let cameras = train(capture).into_iter().zip(train(exact)).map(|(a, b)| [&a.camera, &b.camera]);
    distance_px(&cameras.collect::<Vec<_>>())
}

/// Returns the root mean square of how far the head in the pictures of each pair of cameras lies
/// apart.
fn distance_px(pairs: &[[&Camera; 2]]) -> f64 {
    let points = SyntheticHead.surface_points(200, 1);
    let mut squares = Vec::new();
    for pair in pairs {
        for p in &points {
            let [a, b] = pair.map(|camera| camera.project(*p).unwrap().0);
            squares.push(f64::from(a.distance_squared(b)));
        }
    }
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

fn state(check: &CameraCheck, key: &str) -> Vec<(String, Value)> {
    let value = json!(check);
    let cameras = value["cameras"].as_array().unwrap().iter();
    cameras.map(|c| (c["view"].as_str().unwrap().to_string(), c[key].clone())).collect()
}

#[test]
fn exact_poses_stay() {
    let clean = of_exact(CameraPoses::Auto);
    assert!(!clean.refines() && clean.problems().is_empty(), "{clean:?}");
    assert!(clean.sentence().starts_with("poses fit within 0."), "{}", clean.sentence());
}

#[test]
fn one_camera_that_was_moved_is_named_and_refined_alone() {
    let (_dir, exact) = measured_head();
    let mut wrong = exact.clone();
    disturb(&mut wrong, 5, 3.0);
    let found = check(&wrong, CameraPoses::Auto);
    assert!(found.sentence().contains("except camera `005` by"), "{}", found.sentence());
    let mut refined = wrong.clone();
    found.apply(&mut refined);
    let kept = |v: usize| refined.views[v].camera == exact.views[v].camera;
    assert!((0..15).all(|v| v == 5 || kept(v)));
    let (before, after) = (error_px(&wrong, &exact), error_px(&refined, &exact));
    assert!(after < before / 3.0, "{before} {after}");
}

#[test]
fn a_held_out_view_is_fitted_alone_where_poses_are_refined_and_changes_nothing_else() {
    let (_dir, exact) = measured_head();
    let clean = of_exact(CameraPoses::Refine);
    // two more held-out views of the same photograph: one whose pose is wrong, and one that shows
    // the back of the head, on which few of the points lie that others see
    let mut more = exact.clone();
    for name in ["wrong", "lost"] {
        more.views.push(View { name: name.into(), ..exact.views[14].clone() });
    }
    let [wrong, lost] = [15, 16];
    disturb(&mut more, wrong, 1.5);
    let turned = DMat3::from_rotation_y(std::f64::consts::PI);
    let camera = &mut more.views[lost].camera;
    *camera =
        Camera { rotation: turned * camera.rotation, position: turned * camera.position, ..camera.clone() };
    // nor does the number of threads
    let threads = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
    let found = threads.install(|| check(&more, CameraPoses::Refine));
    let values = [clean, &found].map(|check| json!(check));
    assert_eq!(values[0]["cameras"], values[1]["cameras"]);
    assert_eq!(values[0]["held_out"][0], values[1]["held_out"][0]);
    let named = |v: usize| {
        let View { name, camera, .. } = &more.views[v];
        [NamedCamera { name: name.clone(), camera: camera.clone() }]
    };
    let off = |cameras: &[NamedCamera]| distance_px(&[[&cameras[0].camera, &exact.views[14].camera]]);
    let (before, stayed, mended) =
        (off(&named(wrong)), off(&clean.fitted(&named(14))), off(&found.fitted(&named(wrong))));
    assert!(before > 1.0 && mended < before / 3.0 && stayed < 0.3, "{before} {mended} {stayed}");
    assert!(clean.not_fitted().is_none() && found.fitted(&named(lost)).is_empty());
    let said = found.not_fitted().unwrap();
    assert!(said.contains("`lost`") && !said.contains("`wrong`"), "{said}");
    // poses that stay leave held-out views alone, too
    let stays = of_exact(CameraPoses::Auto);
    assert!(!stays.refines() && stays.fitted(&named(14)).is_empty());
}

#[test]
fn swapped_photographs_are_refused_by_name() {
    let (_dir, exact) = measured_head();
    let mut swapped = exact.clone();
    for (a, b) in [(3, 9), (9, 3)] {
        swapped.views[a].photo.clone_from(&exact.views[b].photo);
        swapped.views[a].mask.clone_from(&exact.views[b].mask);
    }
    let problems = check(&swapped, CameraPoses::Auto).problems();
    let named = |view: &str| problems.iter().any(|p| p.to_string().contains(view));
    assert!(problems.len() == 2 && named("`003`") && named("`009`"), "{problems:?}");
    assert!(problems[0].hint().contains("capture.cameras=given"));
}

#[test]
fn poses_are_read_back_and_what_is_no_pose_is_refused_with_its_key() {
    let found = of_exact(CameraPoses::Refine);
    assert!(state(found, "refined").iter().all(|(_, pose)| pose.is_object()));
    let dir = tempfile::tempdir().unwrap();
    assert!(CameraCheck::read(dir.path()).unwrap().is_none());
    found.write(dir.path()).unwrap();
    assert_eq!(json!(CameraCheck::read(dir.path()).unwrap()), json!(found));
    let path = dir.path().join(POSES);
    let written: Value = io::read_json(&path, &Limits::default()).unwrap();
    for (place, key, value) in [
        ("/cameras/4/refined", "rotation", json!([0, 0, 0, 0, 0, 0, 0, 0, 0])),
        ("/cameras/4/refined", "rotation", json!([-1, 0, 0, 0, 1, 0, 0, 0, 1])),
        ("/cameras/4/refined", "position", json!([null, 0, 0])),
        ("/held_out/0/fitted", "rotation", json!([0, 0, 0, 0, 0, 0, 0, 0, 0])),
        ("/held_out/0/fitted", "position", json!("here")),
    ] {
        let mut bad = written.clone();
        bad.pointer_mut(place).unwrap()[key] = value;
        std::fs::write(&path, bad.to_string()).unwrap();
        let error = CameraCheck::read(dir.path()).unwrap_err().to_string();
        assert!(error.contains(key) && error.contains(POSES), "{error}");
    }
}

#[test]
fn without_masks_nothing_is_said() {
    let (_dir, mut bare) = measured_head();
    let scene = scene::fit(
        &train(&bare).iter().map(|v| v.camera.clone()).collect::<Vec<_>>(),
        &[const { None }; 14],
        &SceneOptions::default(),
    );
    bare.views.iter_mut().for_each(|v| v.mask = capture::ViewMask::None);
    let why = RigPhotos::load(&bare, &scene.unwrap().0, &Limits::default()).unwrap().err();
    assert_eq!(why.unwrap(), "there is no hull of head masks");
}

#[test]
fn refinement_that_cannot_be_done_is_told_with_its_reason() {
    let (dir, whole) = measured_head();
    let scene = scene_of(&whole);
    let why = |views: usize| {
        let mut capture = whole.clone();
        capture.views = (0..views).map(|v| whole.views[v % 14].clone()).collect();
        RigPhotos::load(&capture, &scene, &Limits::default()).unwrap().err().unwrap()
    };
    assert_eq!(why(2), "there are 2 training views, and at least 3 are needed");
    assert_eq!(why(1), "there is 1 training view, and at least 3 are needed");
    assert_eq!(why(257), "there are 257 training views, and at most 256 can be compared");

    // the stage says so in its record, and the inspection in its place
    for (poses, words) in [
        (CameraPoses::Refine, "`capture.cameras=refine` refines nothing: there is no hull of head masks"),
        (CameraPoses::Auto, "poses are not checked: there is no hull of head masks"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let run = quiet(folder.path());
        let mut config = Config::preset(Preset::Draft);
        config.capture.path = dir.path().into();
        config.capture.cameras = poses;
        config.mask.source = MaskSource::None;
        complete(&Session::open(&config, &run).unwrap(), Stage::Mask, &NoFields).unwrap();
        let warnings = read_record(&run.path(Stage::Mask)).unwrap().unwrap().warnings;
        assert!(warnings.iter().any(|w| w.starts_with(words)), "{warnings:?}");
        let found = inspect_capture(dir.path(), &capture_options(&config));
        assert!(found.fit.as_ref().is_some_and(|fit| fit.starts_with(words)), "{found}");
        let words = "exposures are not compared: there is no hull of head masks";
        assert!(warnings.iter().any(|w| w.starts_with(words)), "{warnings:?}");
        assert!(found.exposure.as_ref().is_some_and(|text| text.starts_with(words)), "{found}");
    }
}

#[test]
fn the_stage_mask_brings_wrong_poses_to_a_third_for_later_stages_unless_given_ones_are_asked_for() {
    let (dir, exact) = measured_head();
    let mut wrong = exact.clone();
    (0..14).for_each(|v| disturb(&mut wrong, v, 1.5));
    let file = dir.path().join("transforms_train.json");
    let mut frames: Value = io::read_json(&file, &Limits::default()).unwrap();
    for (frame, view) in frames["frames"].as_array_mut().unwrap().iter_mut().zip(&wrong.views) {
        for (row, column) in (0..9).map(|i| (i / 3, i % 3)) {
            frame["transform_matrix"][row][column] = json!(view.camera.rotation.col(column)[row]);
        }
    }
    std::fs::write(&file, frames.to_string()).unwrap();
    for (poses, refined) in [(CameraPoses::Given, false), (CameraPoses::Auto, true)] {
        let folder = tempfile::tempdir().unwrap();
        let run = quiet(folder.path());
        let mut config = draft(dir.path());
        config.capture.cameras = poses;
        let session = Session::open(&config, &run).unwrap();
        complete(&session, Stage::Mask, &NoFields).unwrap();
        let found = CameraCheck::read(&run.path("mask")).unwrap();
        assert_eq!(found.map(|f| f.sentence().contains("off against each other")), refined.then_some(true));
        let used = session.refined_capture().unwrap();
        let (before, after) = (error_px(&wrong, &exact), error_px(used, &exact));
        assert!(before > 1.0 && (after < before / 3.0) == refined, "{before} {after}");
        // held-out views keep their poses
        assert_eq!(used.views[14].camera, exact.views[14].camera);
        let cameras: Value = io::read_json(&run.path("cameras.json"), &Limits::default()).unwrap();
        assert_eq!(cameras["fit"]["cameras"][3]["refined"].is_object(), refined);
        // a finished stage is not made again for what it found itself
        assert!(complete(&Session::open(&config, &run).unwrap(), Stage::Mask, &NoFields).unwrap().skipped);
    }
}
