//! Exposures of the demo head: one for all, known gains, one photograph that is brighter.

use super::exposure::{EXPOSURE, ExposureCheck};
use super::rig_photos::RigPhotos;
use super::tests::{NoFields, measured_head, quiet, scene_of};
use super::{Session, Stage, complete};
use crate::config::{CameraPoses, Config, Exposures, Preset};
use serde_json::{Value, json};
use std::sync::OnceLock;
use tiface_base::image::{Exposure, Photo};
use tiface_base::io::{self, Limits};
use tiface_capture::{self as capture, Capture, CaptureOptions, View};

fn measure(capture: &Capture) -> ExposureCheck {
    tried(capture).unwrap()
}

fn tried(capture: &Capture) -> Result<ExposureCheck, String> {
    let photos = RigPhotos::load(capture, &scene_of(capture), &Limits::default()).unwrap().unwrap();
    ExposureCheck::measure(&photos)
}

/// Multiplies the light of photographs. A photograph that is read with the inverse exposure is
/// brighter by it.
pub(super) fn expose(capture: &mut Capture, gains: &[[f32; 3]]) {
    for (view, gain) in capture.views.iter_mut().zip(gains) {
        view.exposure = Some(Exposure { gain: gain.map(|g| 1.0 / g) });
    }
}

/// Returns gains of a geometric mean of 1 over the training views, which do not follow the viewing
/// direction: neighbors differ.
pub(super) fn gains() -> Vec<[f32; 3]> {
    let log = |v: usize, k: usize| {
        let sign = if v.is_multiple_of(2) { 1.0 } else { -1.0 };
        sign * (0.1 + 0.01 * (v / 2) as f32 - 0.05 * k as f32)
    };
    (0..15).map(|v| [0, 1, 2].map(|k| log(v, k).exp())).collect()
}

/// What is found where photographs have [`gains`], measured once a test program.
pub(super) fn found_gains() -> &'static ExposureCheck {
    static FOUND: OnceLock<ExposureCheck> = OnceLock::new();
    FOUND.get_or_init(|| {
        let (_dir, mut exposed) = measured_head();
        expose(&mut exposed, &gains());
        measure(&exposed)
    })
}

#[test]
fn known_gains_are_found() {
    let (_dir, clean) = measured_head();
    let found = measure(&clean);
    assert!(!found.evens_out() && found.used("003").is_none(), "{found:?}");
    assert!(found.sentence().contains("alike within 0."), "{}", found.sentence());

    let found = found_gains();
    assert!(found.evens_out() && found.sentence().contains("white balance differs"), "{}", found.sentence());
    // the held-out view, the last one, is compared with the training views but does not shape what
    // they share
    let error = |(view, gain): (&View, [f32; 3])| {
        let used = found.used(&view.name).unwrap().gain;
        used.iter().zip(gain).map(|(used, gain)| (used / gain - 1.0).abs()).fold(0.0, f32::max)
    };
    let errors: Vec<f32> = clean.views.iter().zip(gains()).map(error).collect();
    // what is linear in the viewing direction cannot be told from shading: gains of 10 to 20 % have
    // a little of it
    assert!(errors.iter().all(|&e| e < 0.03), "{errors:?}");
}

#[test]
fn one_dark_photograph_is_left_out_and_named_and_the_others_are_compared() {
    let (_dir, mut exposed) = measured_head();
    assert!(measure(&exposed).not_measured().is_none());
    // 1/64 of the light leaves even white darker than what is compared
    let mut gains = gains();
    gains[9] = [1.0 / 64.0; 3];
    expose(&mut exposed, &gains);
    let found = measure(&exposed);
    assert!(found.evens_out() && found.used("009").is_none(), "{found:?}");
    let said = found.not_measured().unwrap();
    assert!(said.contains("dark nor saturated: `009`; such photographs"), "{said}");
    assert!(!found.sentence().contains("`009`"), "{}", found.sentence());
    let error = |v: usize| {
        let used = found.used(&exposed.views[v].name).unwrap().gain;
        used.iter().zip(gains[v]).map(|(used, gain)| (used / gain - 1.0).abs()).fold(0.0, f32::max)
    };
    // the mean of the others is 1 % off that of all
    let errors: Vec<(usize, f32)> = (0..15).filter(|&v| v != 9).map(|v| (v, error(v))).collect();
    assert!(errors.iter().all(|&(_, e)| e < 0.04), "{errors:?}");
    let dir = tempfile::tempdir().unwrap();
    found.write(dir.path()).unwrap();
    let read = ExposureCheck::read(dir.path()).unwrap().unwrap();
    assert_eq!(json!(read), json!(found));
    assert!(json!(read)["views"][9].get("measured").is_none());
    // later stages read its photograph as it is
    found.apply(&mut exposed);
    assert!(exposed.views[9].exposure.is_none() && exposed.views[8].exposure.is_some());
}

#[test]
fn exposures_of_few_views_are_not_compared_and_the_reason_is_told() {
    let (_dir, mut exposed) = measured_head();
    let mut gains = gains();
    (0..8).for_each(|v| gains[v] = [1.0 / 64.0; 3]);
    expose(&mut exposed, &gains);
    let why = tried(&exposed).unwrap_err();
    assert!(why.contains("of 14 training views can be measured, and at least 7 are needed"), "{why}");
    assert!(why.contains("`000`, `001`") && why.contains("`007`"), "{why}");
    exposed.views.truncate(6);
    exposed.views.iter_mut().for_each(|view| view.exposure = None);
    let why = tried(&exposed).unwrap_err();
    assert!(why.contains("6 training views") && why.contains("at least 7 are needed"), "{why}");
}

#[test]
fn where_only_colors_differ_nothing_is_said_of_brightness() {
    let (_dir, mut exposed) = measured_head();
    let warm =
        |v: usize| [0.08, 0.0, -0.08].map(|l: f32| if v.is_multiple_of(2) { l.exp() } else { (-l).exp() });
    expose(&mut exposed, &(0..15).map(warm).collect::<Vec<_>>());
    let found = measure(&exposed);
    assert!(found.sentence().starts_with("white balance differs by "), "{}", found.sentence());
    assert!((0..14).all(|v| (found.used(&exposed.views[v].name).unwrap().brightness() - 1.0).abs() < 1e-5));
}

#[test]
fn one_photograph_that_is_brighter_is_named() {
    let (_dir, mut exposed) = measured_head();
    let mut gains = [[1.0; 3]; 15];
    gains[5] = [1.12; 3];
    expose(&mut exposed, &gains);
    let found = measure(&exposed).announcement();
    let percent = (10..=12)
        .find(|p| found.contains(&format!("view `005` is {p} % brighter than the others; a run evens")));
    assert!(percent.is_some(), "{found}");
}

#[test]
fn later_stages_read_photographs_with_the_mean_exposure_unless_given_ones_are_asked_for() {
    let (dir, mut exposed) = measured_head();
    expose(&mut exposed, &gains());
    let photos = |capture: &Capture| -> Vec<_> {
        capture.views.iter().map(|v| v.load_photo(&Limits::default()).unwrap()).collect()
    };
    let clean = photos(&capture::open(dir.path(), &CaptureOptions::default()).unwrap());
    let run = |exposure: Exposures| {
        let folder = tempfile::tempdir().unwrap();
        let run = quiet(folder.path());
        let mut config = Config::preset(Preset::Draft);
        config.capture.path = dir.path().into();
        (config.capture.cameras, config.capture.exposure) = (CameraPoses::Given, exposure);
        let session = Session::open(&config, &run).unwrap();
        complete(&session, Stage::Mask, &NoFields).unwrap();
        let measured = io::is_file(&run.path("mask").join(EXPOSURE));
        let cameras: Value = io::read_json(&run.path("cameras.json"), &Limits::default()).unwrap();
        assert_eq!(cameras["exposure"]["views"][3]["measured"].is_object(), measured);
        (measured, photos(session.refined_capture().unwrap()))
    };
    // photographs of one exposure stay as they are, to the byte
    assert!(run(Exposures::Auto) == (true, clean.clone()));
    for (view, photo) in exposed.views.iter().zip(photos(&exposed)) {
        io::write_png_rgb(&view.photo, photo.width, photo.height, &photo.rgb).unwrap();
    }
    let (measured, given) = run(Exposures::Given);
    assert!(!measured && given == photos(&capture::open(dir.path(), &CaptureOptions::default()).unwrap()));
    let (_, even) = run(Exposures::Auto);
    let off = |a: &[Photo], v: usize| {
        let pairs = a[v].rgb.as_flattened().iter().zip(clean[v].rgb.as_flattened());
        pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>()
    };
    let left: Vec<f64> = (0..14).map(|v| off(&even, v) / off(&given, v)).collect();
    // photographs are rounded to 8 bits twice, and the brightest pixels of the brighter ones are
    // clipped
    assert!(left.iter().all(|&share| share < 0.4), "{left:?}");
    // held-out photographs are never changed
    assert!(even[14] == given[14]);
}

#[test]
fn exposures_are_read_back_and_what_is_no_gain_is_refused_with_its_key() {
    let found = found_gains();
    assert!(found.evens_out());
    let dir = tempfile::tempdir().unwrap();
    assert!(ExposureCheck::read(dir.path()).unwrap().is_none());
    found.write(dir.path()).unwrap();
    assert_eq!(json!(ExposureCheck::read(dir.path()).unwrap()), json!(found));
    let path = dir.path().join(EXPOSURE);
    let written: Value = io::read_json(&path, &Limits::default()).unwrap();
    for value in [json!([1, 0, 1]), json!([1, -1, 1]), json!([1, 1, 101]), json!([1, 1]), json!([1, 1, null])]
    {
        let mut bad = written.clone();
        bad["views"][4]["used"]["gain"] = value;
        std::fs::write(&path, bad.to_string()).unwrap();
        let error = ExposureCheck::read(dir.path()).unwrap_err().to_string();
        assert!(error.contains(EXPOSURE), "{error}");
    }
}
