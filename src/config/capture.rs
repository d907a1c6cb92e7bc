//! `[capture]`: how a capture is read.

use super::table::table;
use std::path::PathBuf;
use tiface_capture::{CameraPoses, Exposures, Glares};

table! {
    /// How a capture is read.
    pub struct CaptureConfig;
    keys {
        /// Folder of the capture; stored in the run.
        path: PathBuf [nothing] => PathBuf::new();
        /// Integer factor by which photographs are reduced, by averaging.
        downscale: u32, 1.0..=64.0 [Masks] => 1;
        /// Poses of the training views: auto (measured on the photographs, and refined where they
        /// do not fit), refine (always) or given.
        cameras: CameraPoses [Masks] => CameraPoses::Auto, CameraPoses::Auto, CameraPoses::Given;
        /// Exposure and white balance of the photographs: auto (measured, and divided out of the
        /// training photographs where they differ) or given (photographs are used as they are).
        exposure: Exposures [Masks] => Exposures::Auto, Exposures::Auto, Exposures::Given;
        /// Glare of lamps that stand behind the head before a dark background: auto (measured on
        /// that background, and taken out of the training photographs) or given (photographs are
        /// used as they are).
        glare: Glares [Masks] => Glares::Auto, Glares::Auto, Glares::Given;
        /// Bounding box of the fields: head (found from cameras and masks), ilsh (published: ±0.45,
        /// ±0.501, ±0.3 dataset units for radiance, ±0.3 for I-Face; falls back to head if the head
        /// is elsewhere) or six numbers in dataset units, lowest corner first.
        r#box: String [Masks] => "head".into(), "head".into(), "ilsh".into();
        /// Length of one dataset unit, meters.
        unit_m: f64, 1e-6..=1e6 [Masks, Files] => 1.0;
        /// Folder of masks inside the capture, named like the photographs; empty: search for one.
        mask_dir: String [Masks] => String::new();
        /// Share of the training pixels that is held out, in small squares, to fit the weights of
        /// the blend; 0: none.
        tiles: f64, 0.0..=0.25 [
            Baseline if |c| c.baseline.import.is_empty(),
            Tface if |c| c.tface.import.is_empty(),
            Iface,
            Blend if |c| c.ensemble.weights.is_empty()
        ] => 0.04, 0.04, 0.0;
    }
}
