//! The stage `ensemble` on pictures made by hand.

use super::{Line, pictures};
use crate::capture::Split;
use crate::capture::synthetic::{SyntheticOptions, write_capture};
use crate::config::{Background, Config, Correct, Fit, Method, Preset};
use crate::image::{Image, quantise};
use crate::io;
use crate::render::RenderedView;
use crate::run::{Exit, Quiet, Run, Stop};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const SIZE: (u32, u32) = (32, 40);

fn config(root: &Path) -> Config {
    let options = SyntheticOptions { width: SIZE.0, height: SIZE.1, train: 8, test: 2, seed: 1 };
    write_capture(root, &options).unwrap();
    let mut config = Config::preset(Preset::Draft);
    config.capture.path = root.to_str().unwrap().into();
    config
}

fn run(dir: &Path) -> Run {
    Run::open(&dir.join("run"), Stop::new(), Arc::new(Quiet))
}

fn flat(color: [f32; 4]) -> Image {
    let mut image = Image::new(SIZE.0, SIZE.1, 4);
    image.data.as_chunks_mut::<4>().0.fill(color);
    image
}

/// As `render` would have left it, one metre before the camera.
fn put(run: &Run, member: &str, name: &str, color: Image) -> PathBuf {
    let mut depth = Image::new(SIZE.0, SIZE.1, 1);
    depth.data.fill(1.0);
    let view = RenderedView { color, depth, normal: Image::new(0, 0, 3) };
    let folder = run.path(format!("render/{member}/float"));
    pictures::write_float(&folder, name, &view).unwrap();
    pictures::float_path(&folder, name)
}

fn pixel(run: &Run, file: &str, at: usize) -> [u8; 3] {
    let read = io::read_photo(&run.path(file), None, &io::Limits::default()).unwrap();
    read.photo.rgb[at]
}

#[test]
fn float_members_are_blended_and_rounded_once_and_a_missing_one_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let config = config(&dir.path().join("head"));
    let run = run(dir.path());
    let line = Line::open(&config, &run, false).unwrap();
    line.mask().unwrap();
    let names: Vec<String> = line.capture().split(Split::Test).map(|v| v.name.clone()).collect();
    for name in &names {
        put(&run, "baseline", name, flat([0.2, 0.2, 0.2, 1.0]));
        put(&run, "tface", name, flat([0.402, 0.402, 0.402, 1.0]));
    }
    let e = line.ensemble().unwrap_err();
    let missing = format!("render/volume/float/{}.exr", names[0]);
    assert_eq!(
        e.to_string(),
        format!("stage `ensemble`: member `volume` is missing: there is no `{missing}`")
    );
    assert!(
        e.hint().contains("--with baseline,tface,volume") && e.hint().contains("`iface`"),
        "{}",
        e.hint()
    );
    for name in &names {
        put(&run, "volume", name, flat([0.601, 0.601, 0.601, 1.0]));
    }
    let done = line.ensemble().unwrap();
    assert_eq!(done.summary["views"], 2);
    // 0.1 · 0.2 + 0.6 · 0.402 + 0.3 · 0.601 = 0.4415 → 112.58 → 113; bytes blended would give
    // 0.1 · 51 + 0.6 · 103 + 0.3 · 153 = 112.8, and truncated 112
    assert_eq!(quantise(0.4415), 113);
    assert_eq!(pixel(&run, &format!("ensemble/{}.png", names[1]), 77), [113; 3]);
    let weights = io::read_json(&run.path("ensemble/weights.json"), &io::Limits::default()).unwrap();
    assert_eq!(weights["weights"], json!([0.1, 0.6, 0.3]));
    assert!(weights["fitted"].is_null() && !run.path("ensemble/fitted").exists());
    assert!(line.ensemble().unwrap().skipped);
}

#[test]
fn a_fit_uses_the_views_set_aside_and_stands_beside_the_given_weights() {
    for fit in [Fit::Global, Fit::Regions, Fit::None] {
        let dir = tempfile::tempdir().unwrap();
        let mut config = config(&dir.path().join("head"));
        config.capture.fit_views = 4;
        config.render.method = vec![Method::Tface, Method::Volume];
        config.ensemble.members = vec![Method::Tface, Method::Volume];
        config.ensemble.weights = vec![0.5, 0.5];
        config.ensemble.fit = fit;
        config.ensemble.correct = if fit == Fit::Regions { Correct::None } else { Correct::Gain };
        config.metrics.surface_points = 100;
        let run = run(dir.path());
        let line = Line::open(&config, &run, false).unwrap();
        line.mask().unwrap();
        // T-Face is the photograph itself, too bright by a quarter where colours are corrected; I-Face
        // is black inside the head. Test views are white: had they a say, T-Face would lose.
        let gain = if fit == Fit::Regions { 1.0 } else { 1.25 };
        let mut black = 0;
        for view in &line.capture().views.clone() {
            let (tface, volume) = match view.split {
                Split::Train => continue,
                Split::Test => (flat([1.0; 4]), flat([0.0, 0.0, 0.0, 1.0])),
                Split::Val => {
                    let loaded = view.load(&io::Limits::default()).unwrap();
                    let photo = pictures::expected(&loaded.photo, loaded.mask.as_ref(), Background::None);
                    let mut exact = flat([0.0, 0.0, 0.0, 1.0]);
                    for (p, rgb) in exact.data.as_chunks_mut::<4>().0.iter_mut().zip(&photo.rgb) {
                        (0..3).for_each(|k| p[k] = (rgb[k] as f32 / 255.0 * gain).min(1.0));
                    }
                    black += 1;
                    (exact, flat([0.0, 0.0, 0.0, 1.0]))
                }
            };
            let name =
                if view.split == Split::Val { format!("fit/{}", view.name) } else { view.name.clone() };
            put(&run, "tface", &name, tface);
            put(&run, "volume", &name, volume);
        }
        assert_eq!(black, 2);
        let done = line.ensemble().unwrap();
        let fitted = &done.summary["fitted"];
        let name = line.capture().split(Split::Test).next().unwrap().name.clone();
        // white and black in equal shares
        assert_eq!(pixel(&run, &format!("ensemble/{name}.png"), 700), [128; 3]);
        let better = pixel(&run, &format!("ensemble/fitted/{name}.png"), 700);
        if fit == Fit::None {
            // corrected by 1 / 1.25 = 0.8: 0.5 · 0.8 · 255 = 102
            assert!((better[0] as i32 - 102).abs() <= 3, "{better:?}");
            assert!(fitted.get("weights").is_none(), "{fitted}");
        } else {
            assert!(fitted["weights"][0].as_f64().unwrap() > 0.95, "{fitted}");
            assert!(fitted["psnr_global"].as_f64() > fitted["psnr_given"].as_f64(), "{fitted}");
        }
        if fit == Fit::Regions {
            assert!(better[0] > 240 && fitted["psnr_regions"].is_f64(), "{better:?} {fitted}");
            assert!(!run.path("ensemble/corrected").exists());
        } else {
            let corrected = pixel(&run, &format!("ensemble/corrected/tface/{name}.png"), 700);
            assert!((corrected[0] as i32 - 204).abs() <= 5, "{corrected:?}"); // 0.8 · 255
        }
        // judged beside each other; a training view that was set aside is not judged
        let sets: Vec<String> = line.sets().into_iter().map(|s| s.name).collect();
        let corrected = ["tface_corrected", "volume_corrected"].iter().filter(|_| fit != Fit::Regions);
        let all = ["tface", "volume", "ensemble", "ensemble_fitted"].iter().chain(corrected);
        assert_eq!(sets, all.copied().collect::<Vec<_>>());
        let judged = line.comparable(&line.sets()[3]);
        assert_eq!(judged.len(), 2);
        assert!(judged.iter().all(|s| s.view.split == Split::Test));
        let metrics = line.metrics().unwrap().summary;
        assert!(metrics["ensemble"]["head"]["mean"]["psnr_masked"].is_f64(), "{metrics}");
        // the blend is opaque all over, so is what is outside
        let outside = metrics["ensemble"]["mean_square_opacity_outside"].as_f64().unwrap();
        assert!((outside - 1.0).abs() < 1e-6, "{outside}");
    }
}

#[test]
fn what_cannot_be_blended_is_said_before_anything_is_learned() {
    let dir = tempfile::tempdir().unwrap();
    let base = config(&dir.path().join("head"));
    let run = run(dir.path());
    let error = |change: &dyn Fn(&mut Config)| {
        let mut config = base.clone();
        change(&mut config);
        let line = Line::open(&config, &run, false).unwrap();
        let e = line.remember("metrics").unwrap_err();
        assert_eq!(e.exit(), Exit::Usage);
        assert!(!run.path("config.toml").exists());
        (e.to_string(), e.hint())
    };
    let (text, hint) = error(&|c| c.render.method = vec![Method::Volume]);
    assert_eq!(text, "`ensemble.members` names baseline, which render.method does not make");
    assert!(hint.contains("tiface render --fresh render --with baseline,tface,volume"), "{hint}");
    let (text, hint) = error(&|c| c.ensemble.fit = Fit::Global);
    assert_eq!(text, "`ensemble.fit` asks for a fit of weights, but no view is set aside to fit it on");
    assert!(hint.contains("capture.fit_views=8"), "{hint}");
    let (text, _) = error(&|c| c.ensemble.correct = Correct::Affine);
    assert!(text.starts_with("`ensemble.correct` asks for a correction of colours"), "{text}");
    let (text, _) = error(&|c| c.ensemble.members.truncate(2));
    assert_eq!(text, "`ensemble.weights` has 3 weights for 2 members");
    let (text, hint) = error(&|c| c.ensemble.weights = vec![1.0, 1.0, 2.0]);
    assert_eq!(text, "`ensemble.weights` sum to 4, expected 1");
    assert!(hint.contains("0.2500, 0.2500, 0.5000"), "{hint}");
    let (text, _) = error(&|c| c.render.float = false);
    assert!(text.starts_with("`render.float` is false"), "{text}");
    // no members: no blend, and nothing to complain about
    let mut config = base.clone();
    config.render.method = vec![Method::Volume];
    config.ensemble.members.clear();
    let line = Line::open(&config, &run, false).unwrap();
    assert_eq!(line.order("metrics").join(" "), "mask iface render metrics");
    line.remember("metrics").unwrap();
}
