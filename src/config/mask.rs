//! `[mask]`: which pixels are the head.

use super::{Key, Preset};
use serde::{Deserialize, Serialize};

/// Where masks come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskSource {
    /// Whatever the capture has: named in its frames, beside the photographs, or their alpha.
    Auto,
    /// The photographs' own alpha.
    Alpha,
    /// The folder `capture.mask_dir`.
    Folder,
    /// None: everything in the picture is reconstructed.
    None,
}

/// What the pixels outside a mask are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskMeaning {
    /// Empty space: nothing of the head is there.
    Empty,
    /// Not looked at, as nerfstudio's `mask_path` means it.
    Ignore,
}

/// Where masks come from and what they mean.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaskConfig {
    /// Where they come from.
    pub source: MaskSource,
    /// What the rest of the picture is.
    pub meaning: MaskMeaning,
}

pub(super) const KEYS: &[Key] = &[
    Key::word("source", "Where masks come from: auto, alpha, folder (capture.mask_dir) or none."),
    Key::word("meaning", "What lies outside a mask: empty (nothing of the head) or ignore (not looked at)."),
];

impl MaskConfig {
    /// The values a preset starts with.
    pub fn preset(_: Preset) -> MaskConfig {
        MaskConfig { source: MaskSource::Auto, meaning: MaskMeaning::Empty }
    }
}
