//! `[capture]`: what was photographed.

use super::table::table;

table! {
    /// How a capture is read.
    pub struct CaptureConfig;
    keys {
        /// Folder of photographs; the run remembers it.
        path: String => String::new();
        /// Photographs are made this many times smaller, by averaging; an integer.
        downscale: u32, 1.0..=64.0 => 1;
        /// Where fields are learned: head (found from cameras and masks), ilsh (published: ±0.45, ±0.501, ±0.3 dataset
        /// units for radiance, ±0.3 for I-Face; head where the head is not there) or six numbers in dataset units,
        /// lowest corner first.
        r#box: String => "head".into(), "head".into(), "ilsh".into();
        /// Metres in one unit of the dataset.
        unit_m: f64, 1e-6..=1e6 => 1.0;
        /// Folder of masks inside the capture, named like the photographs; empty to look for one.
        mask_dir: String => String::new();
        /// Share of the training photographs' pixels that nothing learns from, in small squares, so that the weights
        /// of the blend can be fitted there; 0: none.
        tiles: f64, 0.0..=0.25 => 0.04, 0.04, 0.0;
    }
}
