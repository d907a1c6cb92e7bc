//! `[render]`: the views made of the result.

use super::{Key, Preset};
use serde::{Deserialize, Serialize};

/// A picture file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PictureFormat {
    /// 8-bit sRGB, straight alpha.
    Png,
    /// Float, scene-linear, premultiplied, with depth and normals.
    Exr,
}

/// What stands behind the head.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// Black.
    Black,
    /// White.
    White,
    /// Nothing: real alpha.
    None,
}

/// Which views are made, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RenderConfig {
    /// `test`, `train`, `orbit`, or a file of cameras.
    pub cameras: String,
    /// Samples along each side of a pixel.
    pub samples: u32,
    /// Files to write.
    pub format: PictureFormat,
    /// What stands behind the head.
    pub background: Background,
}

pub(super) const KEYS: &[Key] = &[
    Key::word(
        "cameras",
        "Which cameras: test, train, orbit, or a file (transforms.json or a nerfstudio camera path).",
    ),
    Key::number("samples", "Rays along each side of a pixel.", 1.0, 8.0),
    Key::word("format", "png (8-bit sRGB) or exr (float, with depth and normals)."),
    Key::word("background", "Behind the head: black, white or none (real alpha)."),
];

impl RenderConfig {
    /// The values a preset starts with.
    pub fn preset(preset: Preset) -> RenderConfig {
        RenderConfig {
            cameras: "test".into(),
            samples: if preset == Preset::Draft { 1 } else { 2 },
            format: PictureFormat::Png,
            background: Background::None,
        }
    }
}
