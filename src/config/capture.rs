//! `[capture]`: what was photographed.

use super::{Key, Preset};
use serde::{Deserialize, Serialize};

/// How a capture is read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CaptureConfig {
    /// The folder of photographs; empty when it is given on the command line.
    pub path: String,
    /// Photographs are made this many times smaller, by averaging.
    pub downscale: u32,
    /// Metres in one unit of the dataset.
    pub unit_m: f64,
    /// Folder of masks inside the capture; empty to look for one.
    pub mask_dir: String,
    /// Every so-many-th training view is not learned from: the blend is fitted on it. 0 for none.
    pub fit_views: usize,
}

pub(super) const KEYS: &[Key] = &[
    Key::word("path", "Folder of photographs; the run remembers it."),
    Key::number(
        "downscale",
        "Photographs are made this many times smaller, by averaging; an integer.",
        1.0,
        64.0,
    ),
    Key::number("unit_m", "Metres in one unit of the dataset.", 1e-6, 1e6),
    Key::word(
        "mask_dir",
        "Folder of masks inside the capture, named like the photographs; empty to look for one.",
    ),
    Key::number(
        "fit_views",
        "Every so-many-th training view is learned from by no field, for ensemble.fit and ensemble.correct; 0: none.",
        0.0,
        10_000.0,
    ),
];

impl CaptureConfig {
    /// The values a preset starts with.
    pub fn preset(_: Preset) -> CaptureConfig {
        CaptureConfig {
            path: String::new(),
            downscale: 1,
            unit_m: 1.0,
            mask_dir: String::new(),
            fit_views: 0,
        }
    }
}
