//! `[mesh]`: the extracted surface.

use super::{Key, Preset};
use serde::{Deserialize, Serialize};

/// A mesh file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MeshFormat {
    /// glTF 2.0 binary.
    Glb,
    /// Wavefront.
    Obj,
    /// Stanford, binary.
    Ply,
}

/// The coordinates a mesh is exported in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MeshFrame {
    /// The dataset's own world, turned to +Y up where the format demands it.
    Dataset,
    /// +Y up through the crown, face towards +Z, origin at the centre of the box.
    Head,
}

/// How the surface is extracted and exported.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeshConfig {
    /// Samples along the longest side of the box.
    pub resolution: u32,
    /// Components with less than this share of the largest one's area are dropped.
    pub keep_share: f64,
    /// Every how many cells the field is asked first.
    pub coarse_step: u32,
    /// Newton steps that pull vertices onto the zero level.
    pub newton_steps: u32,
    /// How far vertices slide towards the middle of their neighbours with the first step.
    pub relax: f32,
    /// Also evaluate the whole grid and report what the sparse extraction lost.
    pub verify: bool,
    /// Files to write.
    pub format: Vec<MeshFormat>,
    /// Coordinates to write them in.
    pub frame: MeshFrame,
}

pub(super) const KEYS: &[Key] = &[
    Key::number("resolution", "Samples along the longest side of the box.", 16.0, 4096.0),
    Key::number(
        "keep_share",
        "Components with less than this share of the largest are dropped; 1 keeps only the largest.",
        0.0,
        1.0,
    ),
    Key::number(
        "newton_steps",
        "Newton steps that pull vertices onto the zero level of the field.",
        0.0,
        8.0,
    ),
    Key::number(
        "coarse_step",
        "Every how many cells the field is asked first: 2, 4 or 8; smaller finds smaller loose pieces.",
        2.0,
        8.0,
    ),
    Key::number(
        "relax",
        "How far vertices slide towards the middle of their neighbours with the first step.",
        0.0,
        1.0,
    ),
    Key::word("verify", "Also evaluate the whole grid and report what the sparse extraction lost: slow."),
    Key::word("format", "Files to write, a list of glb, obj, ply."),
    Key::word("frame", "Coordinates of the files: dataset, or head (+Y up, face towards +Z, centred)."),
];

impl MeshConfig {
    /// The values a preset starts with.
    pub fn preset(preset: Preset) -> MeshConfig {
        MeshConfig {
            resolution: if preset == Preset::Draft { 256 } else { 512 },
            keep_share: 1.0,
            coarse_step: 8,
            newton_steps: 2,
            relax: 0.5,
            verify: false,
            format: vec![MeshFormat::Glb],
            frame: MeshFrame::Dataset,
        }
    }
}
