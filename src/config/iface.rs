//! `[iface]`: the learned signed-distance field.

use super::{Key, Preset};
use serde::{Deserialize, Serialize};

/// How the signed-distance field is learned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IfaceConfig {
    /// Optimisation steps.
    pub steps: u64,
    /// Most rays in one step.
    pub rays: usize,
}

pub(super) const KEYS: &[Key] = &[
    Key::number("steps", "Optimisation steps.", 1.0, 10_000_000.0),
    Key::number("rays", "Most rays in one step; fewer are used while samples are many.", 16.0, 1_048_576.0),
];

impl IfaceConfig {
    /// The values a preset starts with.
    pub fn preset(preset: Preset) -> IfaceConfig {
        match preset {
            Preset::Draft => IfaceConfig { steps: 2_000, rays: 2048 },
            Preset::Standard | Preset::Paper => IfaceConfig { steps: 20_000, rays: 8192 },
        }
    }
}
