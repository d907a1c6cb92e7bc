//! The training loop.

use super::{TFace, TfaceError};
use crate::config::VmConfig;
use crate::field::pixels::TrainView;
use crate::geom::Aabb;
use crate::kernel::march::Bitmask;
use crate::run::Monitor;
use serde::Serialize;
use std::path::Path;

/// What training did.
#[derive(Clone, Debug, Serialize)]
pub struct TrainReport {
    /// Optimiser steps.
    pub steps: u64,
    /// Seconds in this process (less than the whole when resumed).
    pub seconds: f64,
    /// PSNR of the last training batches, dB.
    pub train_psnr: f64,
    /// Share of the box's cells that are marched at the end.
    pub occupied: f64,
    /// Oddities on the way.
    pub warnings: Vec<String>,
}

/// Trains until `config.steps`, saving checkpoints into `dir` and continuing from the one that lies there.
///
/// `stage` is `tface` or `baseline`, for messages. `views` have their cameras in scene coordinates; `bounds`
/// is the scene's tight box; `hull` the masks' visual hull over [-1, 1]³. `identity` names settings and
/// inputs: a checkpoint of another identity is refused.
pub fn train(
    _stage: &'static str,
    _views: &[TrainView],
    _bounds: Aabb,
    _hull: Option<&Bitmask>,
    _config: &VmConfig,
    _seed: u64,
    _device: &str,
    _dir: &Path,
    _identity: &str,
    _monitor: &dyn Monitor,
) -> Result<(TFace, TrainReport), TfaceError> {
    unimplemented!()
}
