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
    /// Comparison of views with photographs, and of the surface with a known one.
    pub struct MetricsConfig;
    keys {
        /// Reference of the views: photo (as taken; whole-frame figures include the background) or
        /// masked (cut out by its mask, over render.background).
        truth: TruthPhoto [Metrics] => TruthPhoto::Masked, TruthPhoto::Masked, TruthPhoto::Photo;
        /// LPIPS network, an ONNX file that takes two pictures (needs a build with the feature
        /// `matting`); empty: no LPIPS.
        lpips: String [nothing] => String::new();
        /// Number of points sampled on a surface to compare it with a known one.
        surface_points: u32, 100.0..=10_000_000.0 [Metrics] => 20_000, 100_000, 100_000;
    }
}
