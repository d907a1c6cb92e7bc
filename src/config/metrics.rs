//! `[metrics]`: how the result is judged.

use super::{Key, Preset};
use serde::{Deserialize, Serialize};

/// How views and surface are compared with what is known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MetricsConfig {
    /// Points on a surface when two surfaces are compared.
    pub surface_points: u32,
}

pub(super) const KEYS: &[Key] = &[Key::number(
    "surface_points",
    "Points drawn on a surface when it is compared with a known one.",
    100.0,
    10_000_000.0,
)];

impl MetricsConfig {
    /// The values a preset starts with.
    pub fn preset(preset: Preset) -> MetricsConfig {
        MetricsConfig { surface_points: if preset == Preset::Draft { 20_000 } else { 100_000 } }
    }
}
