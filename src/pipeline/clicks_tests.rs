//! Masks from clicks, as a stage of the pipeline.

use super::clicks::propagated_clicks;
use super::tests::{NoFields, demo_head, draft, masked};
use super::*;
use crate::config::{Config, MaskSource, Preset};
use crate::mask::prompts::{PhotoPrompts, Prompts, file_path};
use crate::run::{Event, Observer, Run, Stop};
use std::path::{Path, PathBuf};
use tiface_base::ErrorKind;
use tiface_base::image::Gray;
use tiface_base::io::{self, Limits};
use tiface_capture::{self as capture, CaptureOptions, Split};

/// Photographs that masks are held against the truth on.
const SHARP: (u32, u32) = (120, 160);

/// Photographs that are only to be masked, fewer of them.
const SMALL: (u32, u32) = (72, 96);

/// A synthetic capture, clicks on three of its views at the deepest places of the true masks, and
/// those masks.
fn clicked(dir: &Path, size: (u32, u32)) -> (Config, Vec<Gray>) {
    let root = dir.join("head");
    demo_head(&root, size, if size == SMALL { (6, 1) } else { (8, 2) });
    let capture = capture::open(&root, &CaptureOptions::default()).unwrap();
    let truth: Vec<Gray> =
        capture.views.iter().map(|v| v.load_mask(&Limits::default()).unwrap().unwrap()).collect();
    let frame = |i: usize| PhotoPrompts {
        file_path: file_path(&capture, &capture.views[i]),
        points: propagated_clicks(&truth[i], size),
    };
    Prompts { frames: [0, 3, 5].map(frame).to_vec() }.write(&dir.join("prompts.json")).unwrap();
    let mut config = draft(&root);
    config.mask.prompts = dir.join("prompts.json").to_str().unwrap().into();
    (config, truth)
}

fn run(dir: &Path, name: &str) -> Run {
    Run::quiet(&dir.join(name))
}

fn iou(a: &Gray, b: &Gray) -> f64 {
    assert_eq!((a.width, a.height), (b.width, b.height));
    let both = |f: fn(bool, bool) -> bool| {
        a.values.iter().zip(&b.values).filter(|(a, b)| f(**a >= 128, **b >= 128)).count() as f64
    };
    both(|a, b| a && b) / both(|a, b| a || b)
}

#[test]
fn clicks_on_three_views_mask_all_and_later_stages_read_those_masks() {
    let dir = tempfile::tempdir().unwrap();
    let (config, truth) = clicked(dir.path(), SHARP);
    let run = run(dir.path(), "run");
    let session = Session::open(&config, &run).unwrap();
    session.remember(Stage::Mask).unwrap();
    let done = masked(&session);
    assert_eq!(done.summary["masks"], 10);
    assert_eq!(done.summary["made"]["clicked_views"], 3);
    assert_eq!(done.summary["suspicious"], serde_json::json!([]));
    for (view, truth) in session.capture().views.iter().zip(&truth) {
        // what a training reads
        let loaded = view.load(&Limits::default()).unwrap().mask.unwrap();
        assert!(iou(&loaded, truth) > 0.95, "{}: {}", view.name, iou(&loaded, truth));
        // soft, and hardened at the ends
        assert!(loaded.values.iter().any(|&v| v > 5 && v < 250) && !loaded.values.contains(&1));
    }
    let sheet = String::from_utf8(io::read_bytes(&run.path("mask/sheet.html"), &Limits::default()).unwrap());
    assert_eq!(sheet.unwrap().matches("<figure").count(), 10);
    assert!(complete(&session, Stage::Mask, &NoFields).unwrap().skipped);

    // the same clicks from another file are the same; other clicks are not
    let moved = dir.path().join("elsewhere.json");
    std::fs::rename(&config.mask.prompts, &moved).unwrap();
    let mut config = config;
    config.mask.prompts = moved.to_str().unwrap().into();
    assert!(complete(&Session::open(&config, &run).unwrap(), Stage::Mask, &NoFields).unwrap().skipped);
    // and the run outlives the file
    let text = std::fs::read_to_string(&moved).unwrap();
    std::fs::remove_file(&moved).unwrap();
    assert!(complete(&Session::open(&config, &run).unwrap(), Stage::Mask, &NoFields).unwrap().skipped);
    let mut prompts: serde_json::Value = serde_json::from_str(&text).unwrap();
    prompts["frames"][0]["points"].as_array_mut().unwrap().pop();
    std::fs::write(&moved, prompts.to_string()).unwrap();
    let error = complete(&Session::open(&config, &run).unwrap(), Stage::Mask, &NoFields).unwrap_err();
    assert!(error.to_string().contains("clicks"), "{error}");
}

#[test]
fn views_are_judged_by_the_masks_of_the_capture_and_not_by_those_that_the_run_made() {
    let dir = tempfile::tempdir().unwrap();
    let (config, truth) = clicked(dir.path(), SHARP);
    let run = run(dir.path(), "run");
    let session = Session::open(&config, &run).unwrap();
    masked(&session);
    let evaluated = session.evaluation_capture().unwrap();
    assert_eq!(session.mask_source(&evaluated), "capture");
    for ((view, own), truth) in session.capture().views.iter().zip(&evaluated.views).zip(&truth) {
        let judged = own.load_mask(&Limits::default()).unwrap();
        assert!(judged.as_ref() == Some(truth) && view.load_mask(&Limits::default()).unwrap() != judged);
    }
    let plan = session.plan(Stage::Metrics).fingerprint;
    // other masks judge otherwise; without any the run's own have to, and say so
    let masks = dir.path().join("head/masks");
    std::fs::copy(masks.join("001.png"), masks.join("000.png")).unwrap();
    let other = Session::open(&config, &run).unwrap();
    assert!(
        other.plan(Stage::Metrics).fingerprint.differences(&plan).iter().any(|d| d.contains("own masks"))
    );
    assert!(complete(&other, Stage::Mask, &NoFields).unwrap().skipped, "they shape nothing else");
    std::fs::remove_dir_all(masks).unwrap();
    for name in ["transforms.json", "transforms_train.json", "transforms_test.json"] {
        let file = dir.path().join("head").join(name);
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::write(&file, text.replace("\"mask_path\"", "\"other\"")).unwrap();
    }
    let bare = Session::open(&config, &run).unwrap();
    let view = &bare.capture().views[0];
    let evaluated = bare.evaluation_capture().unwrap();
    assert_eq!((bare.mask_source(&evaluated), &evaluated.views[0].mask), ("run", &view.mask));
}

#[test]
fn clicks_that_make_no_sense_end_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let (good, _) = clicked(dir.path(), SMALL);
    let refused = |change: &dyn Fn(&mut Config)| {
        let mut config = good.clone();
        change(&mut config);
        let run = run(dir.path(), "refused");
        let error = Session::open(&config, &run).err().expect("an error");
        assert!(!error.hint().is_empty() && !run.dir().exists());
        error.to_string()
    };
    let file = |text: &str| {
        let path: PathBuf = dir.path().join("bad.json");
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let text = refused(&|c| c.mask.prompts = "nowhere.json".into());
    assert!(text.contains("nowhere.json"), "{text}");
    let bad =
        file(r#"{"frames": [{"file_path": "../../etc/passwd", "points": [{"x": 1, "y": 1, "label": 1}]}]}"#);
    let text = refused(&|c| c.mask.prompts.clone_from(&bad));
    assert!(text.contains("bad.json") && text.contains("frames[0]"), "{text}");
    let bad = file(r#"{"frames": []}"#);
    assert!(refused(&|c| c.mask.prompts.clone_from(&bad)).contains("bad.json"));
    let point = |view: &'static str, point: &'static str| {
        move |c: &mut Config| {
            c.mask.prompts.clear();
            c.mask.point = vec![point.into()];
            c.mask.view = view.into();
        }
    };
    assert!(refused(&point("", "9999,1,1")).contains("9999"));
    assert!(refused(&point("nobody", "1,1,1")).contains("nobody"));
    assert!(refused(&point("", "1;1;1")).contains("1;1;1"));
    let text = refused(&|c| c.mask.source = MaskSource::Folder);
    assert!(text.contains("mask.source"), "{text}");
}

#[test]
fn a_network_that_is_no_network_is_refused_in_one_sentence() {
    let dir = tempfile::tempdir().unwrap();
    let (mut config, _) = clicked(dir.path(), SMALL);
    config.mask.vitmatte = config.mask.prompts.clone();
    let run = run(dir.path(), "run");
    let error = complete(&Session::open(&config, &run).unwrap(), Stage::Mask, &NoFields).unwrap_err();
    let expected = if cfg!(feature = "matting") { "prompts.json" } else { "this build cannot run networks" };
    assert!(error.to_string().contains(expected), "{error}");
    assert!(!run.path("mask/done.json").exists());
}

/// Random weights mean nothing; that they are run, and named in the record, is what is looked at.
#[cfg(feature = "matting")]
#[test]
fn networks_cut_and_soften_and_are_recorded() {
    let shared =
        std::env::var("TIFACE_SHARED").unwrap_or(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into());
    let models = Path::new(&shared).join("data/mask-models");
    if !models.is_dir() {
        eprintln!("skipped: networks on the demo head, there are no mask models at {}", models.display());
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (mut config, _) = clicked(dir.path(), SMALL);
    let file = |name: &str| models.join(name).to_str().unwrap().to_owned();
    config.mask.vitmatte = file("vitmatte_tiny/model.onnx");
    config.mask.sam = file("sam_tiny/vision_encoder.onnx");
    config.mask.sam_decoder = file("sam_tiny/prompt_encoder_mask_decoder.onnx");
    let run = run(dir.path(), "run");
    let session = Session::open(&config, &run).unwrap();
    let done = complete(&session, Stage::Mask, &NoFields).unwrap();
    let networks = &done.summary["made"]["networks"];
    assert_eq!(networks.as_array().unwrap().len(), 3, "{networks}");
    assert!(networks.to_string().contains("sha256"));
    let first = run.path("mask").join(format!("{}.png", session.capture().views[0].name));
    assert!(first.is_file());
    let inputs: Vec<&str> =
        session.inputs.clicks.as_ref().map(|c| c.inputs.iter().map(|i| i.0).collect()).unwrap();
    assert_eq!(inputs, ["clicks", "sam", "sam_decoder", "vitmatte"]);
}

/// Every photograph painted bright where the head is, and a network that takes what is bright for
/// it.
#[cfg(feature = "matting")]
#[test]
fn a_network_masks_all_views_without_a_click() {
    let dir = tempfile::tempdir().unwrap();
    let (mut config, truth) = clicked(dir.path(), SHARP);
    let capture = capture::open(&config.capture.path, &CaptureOptions::default()).unwrap();
    for (view, mask) in capture.views.iter().zip(&truth) {
        let color = |(i, &m): (usize, &u8)| [if m >= 128 { 180 } else { 20 } + (i * 7919 % 13) as u8; 3];
        let rgb: Vec<[u8; 3]> = mask.values.iter().enumerate().map(color).collect();
        io::write_png_rgb(&view.photo, mask.width, mask.height, &rgb).unwrap();
    }
    // 0.73 and 0.1 of white: logits of 6.6 and -6
    let file = dir.path().join("net.onnx");
    std::fs::write(&file, crate::onnx::tests::made::brightness(96, 20.0, -8.0)).unwrap();
    config.mask.prompts.clear();
    (config.mask.alpha_net, config.mask.alpha_input) = (file.to_str().unwrap().into(), "96,0,1".into());
    let run = run(dir.path(), "run");
    let session = Session::open(&config, &run).unwrap();
    let done = complete(&session, Stage::Mask, &NoFields).unwrap();
    assert_eq!((&done.summary["masks"], &done.summary["made"]["clicked_views"]), (&10.into(), &0.into()));
    assert_eq!(done.summary["made"]["networks"][0]["role"], "alpha_net");
    assert_eq!(
        session.inputs.clicks.as_ref().unwrap().inputs.iter().map(|i| i.0).collect::<Vec<_>>(),
        ["alpha_net"]
    );
    for (view, truth) in session.capture().views.iter().zip(&truth) {
        let made = view.load_mask(&Limits::default()).unwrap().unwrap();
        assert!(iou(&made, truth) > 0.95, "{}: {}", view.name, iou(&made, truth));
    }
    assert!(complete(&session, Stage::Mask, &NoFields).unwrap().skipped);
    // a head's masks follow from the network's content, not from its path
    config.mask.alpha_input = "96,0.1,1".into();
    let other = complete(&Session::open(&config, &run).unwrap(), Stage::Mask, &NoFields).unwrap_err();
    assert!(other.to_string().contains("mask.alpha_input"), "{other}");
}

/// The clicked views of the light stage.
const CLICKED: [&str; 3] = ["010", "013", "015"];

/// Masks a capture of a light stage from the clicks that come with it, once for each band around
/// the cut, and holds the masks against its true ones: so much are their mean and least overlap.
/// Returns the squared errors of the alphas of clicked views.
fn masked_light_stage(bands: &[f32], [mean_least, worst_least]: [f64; 2]) -> Vec<f64> {
    let shared =
        std::env::var("TIFACE_SHARED").unwrap_or(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into());
    let root = Path::new(&shared).join("data/captures/lps");
    if !root.is_dir() {
        eprintln!("skipped: masks of `lps` from clicks, it is not at {}", root.display());
        return Vec::new();
    }
    let dir = tempfile::tempdir().unwrap();
    let truth = capture::open(&root, &CaptureOptions::default()).unwrap();
    let mut errors = Vec::new();
    for &band in bands {
        let mut config = draft(&root);
        config.mask.prompts = root.join("prompts.json").to_str().unwrap().into();
        config.mask.band = band;
        let run = run(dir.path(), &band.to_string());
        let session = Session::open(&config, &run).unwrap();
        assert_eq!(
            complete(&session, Stage::Mask, &NoFields).unwrap().summary["suspicious"],
            serde_json::json!([])
        );
        let (mut overlap, mut error) = (Vec::new(), 0.0);
        for (view, truth) in session.capture().views.iter().zip(&truth.views) {
            let limits = Limits::default();
            let (made, truth) = (view.load_mask(&limits).unwrap(), truth.load_mask(&limits).unwrap());
            let (made, truth) = (made.unwrap(), truth.unwrap());
            if view.split == Split::Train {
                overlap.push(iou(&made, &truth));
            }
            if CLICKED.contains(&view.name.as_str()) {
                let off = made.values.iter().zip(&truth.values).map(|(a, b)| (*a as f64 - *b as f64).powi(2));
                error += off.sum::<f64>();
            }
        }
        let mean = overlap.iter().sum::<f64>() / overlap.len() as f64;
        let worst = overlap.iter().copied().fold(1.0, f64::min);
        eprintln!("lps, band {band}: IoU {mean:.4}, worst {worst:.4}, squared error {error:.0}");
        assert!(overlap.len() == 24 && mean > mean_least && worst > worst_least, "{mean} {worst}");
        errors.push(error);
    }
    errors
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; masks 32 photographs twice at their full size"]
fn three_clicked_photographs_mask_all_at_full_size_and_matting_takes_four_tenths_of_the_error() {
    if let [soft, hard] = masked_light_stage(&[0.023, 0.0], [0.979, 0.965])[..] {
        assert!(soft < 0.6 * hard, "{soft} {hard}");
    }
}

#[test]
fn held_out_photographs_shape_only_their_own_masks() {
    let dir = tempfile::tempdir().unwrap();
    let (config, _) = clicked(dir.path(), SMALL);
    let capture = capture::open(&config.capture.path, &CaptureOptions::default()).unwrap();
    let held_out = capture.views.iter().find(|v| v.split == Split::Test).unwrap();
    // clicks on a test view as well: deep in its own true mask
    let mask = held_out.load_mask(&Limits::default()).unwrap().unwrap();
    let mut prompts =
        crate::mask::prompts::read_prompts(Path::new(&config.mask.prompts), &Limits::default()).unwrap();
    prompts.frames.push(PhotoPrompts {
        file_path: file_path(&capture, held_out),
        points: propagated_clicks(&mask, SMALL),
    });
    prompts.write(Path::new(&config.mask.prompts)).unwrap();
    let masks = |name: &str| -> Vec<Vec<u8>> {
        let run = run(dir.path(), name);
        let session = Session::open(&config, &run).unwrap();
        complete(&session, Stage::Mask, &NoFields).unwrap();
        let train = session.capture().views.iter().filter(|v| v.split == Split::Train);
        train.map(|v| v.load_mask(&Limits::default()).unwrap().unwrap().values).collect()
    };
    let before = masks("before");
    // the same photograph, much darker
    let mut photo = held_out.load_photo(&Limits::default()).unwrap();
    photo.rgb.iter_mut().for_each(|c| *c = c.map(|v| v / 3));
    io::write_png_rgb(&held_out.photo, photo.width, photo.height, &photo.rgb).unwrap();
    assert!(before == masks("after"));
    // and alone they are refused
    prompts.frames.drain(..3);
    prompts.write(Path::new(&config.mask.prompts)).unwrap();
    let run = run(dir.path(), "alone");
    let error = complete(&Session::open(&config, &run).unwrap(), Stage::Mask, &NoFields).unwrap_err();
    assert!(error.to_string().contains("held-out"), "{error}");
}

#[test]
fn paper_masks_without_networks_are_a_warning() {
    /// Keeps warnings, and stops a stage that has begun before it reads a photograph.
    struct Warnings(Stop, std::sync::Mutex<Vec<String>>);
    impl Observer for Warnings {
        fn event(&self, event: &Event) {
            match event {
                Event::Started { .. } => self.0.request(ErrorKind::Interrupted),
                Event::Warning { text, .. } => self.1.lock().unwrap().push(text.to_string()),
                _ => {}
            }
        }
    }
    let dir = tempfile::tempdir().unwrap();
    let (draft, _) = clicked(dir.path(), SMALL);
    let mut paper = Config::preset(Preset::Paper);
    (paper.capture.path, paper.mask.prompts) = (draft.capture.path.clone(), draft.mask.prompts.clone());
    let warned = |config: &Config, name: &str| {
        let seen = std::sync::Arc::new(Warnings(Stop::new(), Default::default()));
        let run = Run::open(&dir.path().join(name), seen.0.clone(), seen.clone());
        let stopped = complete(&Session::open(config, &run).unwrap(), Stage::Mask, &NoFields).unwrap_err();
        assert_eq!(stopped.kind(), ErrorKind::Interrupted, "{stopped}");
        seen.1.lock().unwrap().iter().filter(|t| t.contains("the published masks are SAM's")).count()
    };
    assert_eq!((warned(&draft, "draft"), warned(&paper, "paper")), (0, 1));
}
