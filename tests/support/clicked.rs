//! The shared captures with the clicks that come with them and the masks they should give.

// benches take what they need
#![allow(dead_code)]

use std::collections::HashMap;
use std::path::PathBuf;
use tiface::capture::{self, Capture, CaptureOptions, Split, View};
use tiface::image::{Gray, Photo};
use tiface::io::Limits;
use tiface::mask::Click;

/// The training views of a capture, in memory.
pub struct Clicked {
    pub views: Vec<View>,
    pub photos: Vec<Photo>,
    pub truth: Vec<Gray>,
    /// Per view; empty where nobody clicked.
    pub clicks: Vec<Vec<Click>>,
}

/// The folder of a shared capture, or says aloud that it is not there.
pub fn folder(name: &str) -> Option<PathBuf> {
    let shared = std::env::var("TIFACE_SHARED")
        .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into());
    let root = PathBuf::from(shared).join("data/captures").join(name);
    if !root.is_dir() {
        eprintln!("skipped: the capture `{name}` is not at {}", root.display());
    }
    root.is_dir().then_some(root)
}

/// Reads a capture, if it is there.
pub fn read(name: &str) -> Option<Clicked> {
    let root = folder(name)?;
    let capture: Capture = capture::open(&root, &CaptureOptions::default()).unwrap();
    let text = std::fs::read_to_string(root.join("prompts.json")).unwrap();
    let prompts: serde_json::Value = serde_json::from_str(&text).unwrap();
    let mut given: HashMap<String, Vec<Click>> = HashMap::new();
    for frame in prompts["frames"].as_array().unwrap() {
        let file = frame["file_path"].as_str().unwrap();
        let number = |v: &serde_json::Value| v.as_f64().unwrap() as f32;
        let points = frame["points"].as_array().unwrap().iter();
        let clicks =
            points.map(|p| Click { x: number(&p["x"]), y: number(&p["y"]), head: p["label"] == 1 }).collect();
        given.insert(file.trim_start_matches("images/").trim_end_matches(".png").into(), clicks);
    }
    let views: Vec<View> = capture.split(Split::Train).cloned().collect();
    let clicks = views.iter().map(|v| given.remove(&v.name).unwrap_or_default()).collect();
    let (photos, truth) = (views.iter().map(|v| v.load(&Limits::default()).unwrap()))
        .map(|loaded| (loaded.photo, loaded.mask.unwrap()))
        .unzip();
    Some(Clicked { views, photos, truth, clicks })
}

/// Pixels both call head over pixels either does.
pub fn overlap(mask: &Gray, truth: &Gray) -> f64 {
    let (mut both, mut either) = (0, 0);
    for (m, t) in mask.values.iter().zip(&truth.values) {
        both += (*m > 127 && *t > 127) as u32;
        either += (*m > 127 || *t > 127) as u32;
    }
    both as f64 / either as f64
}

/// Mean and worst.
pub fn mean_worst(values: &[f64]) -> (f64, f64) {
    (values.iter().sum::<f64>() / values.len() as f64, values.iter().copied().fold(f64::INFINITY, f64::min))
}
