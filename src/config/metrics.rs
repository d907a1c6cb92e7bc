//! `[metrics]`: how the result is judged.

use super::table::table;

table! {
    /// How views and surface are compared with what is known.
    pub struct MetricsConfig;
    keys {
        /// Points drawn on a surface when it is compared with a known one.
        surface_points: u32, 100.0..=10_000_000.0 => 20_000, 100_000, 100_000;
    }
}
