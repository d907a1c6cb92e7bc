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
    /// The share of the training photographs that no field learns from, in squares: the weights of the blend are
    /// fitted there. 0 for none.
    pub tiles: f64,
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
        "tiles",
        "Share of the training photographs' pixels that no field learns from, in small squares, so that the weights \
         of the blend can be fitted there; 0: none.",
        0.0,
        0.25,
    ),
];

impl CaptureConfig {
    /// The values a preset starts with.
    pub fn preset(preset: Preset) -> CaptureConfig {
        CaptureConfig {
            path: String::new(),
            downscale: 1,
            unit_m: 1.0,
            mask_dir: String::new(),
            tiles: if preset == Preset::Paper { 0.0 } else { 0.04 },
        }
    }
}
