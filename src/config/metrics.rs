//! `[metrics]`: how the result is judged.

use super::table::table;
use serde::{Deserialize, Serialize};

/// What a photograph looks like that views are compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TruthPhoto {
    /// As it was taken, background and all.
    Photo,
    /// Cut out by its mask and laid over the views' background.
    Masked,
}

table! {
    /// How views and surface are compared with what is known.
    pub struct MetricsConfig;
    keys {
        /// What views are compared with: photo (as it was taken; figures of the whole frame count the background) or
        /// masked (cut out by its mask, over render.background).
        truth: TruthPhoto => TruthPhoto::Masked, TruthPhoto::Masked, TruthPhoto::Photo;
        /// LPIPS as an ONNX file that takes two pictures (needs a build with the feature `matting`); without one there are no
        /// such figures. `mask.onnxruntime` runs it, if it is named.
        lpips: String => String::new();
        /// Points drawn on a surface when it is compared with a known one.
        surface_points: u32, 100.0..=10_000_000.0 => 20_000, 100_000, 100_000;
    }
}
