//! Stage `iface`: a signed-distance field learned from masked photographs.
//!
//! Instant-NGP's hash grid (Müller et al. 2022) under a small network gives a signed distance; NeuS
//! (Wang et al. 2021) renders it; colour, mask, eikonal and sparsity losses train it (I-Face of
//! TI-Face, ICCV 2023 View Synthesis Challenge for Human Heads). The `paper` preset follows the
//! published system; the others start from the masks' visual hull, sample only a band around the
//! surface, let the surface be softer in hair than on skin (Wang et al. 2023, "Adaptive Shells"), and
//! show the colour network the hash features themselves.

mod checkpoint;
mod hull_start;
mod infer;
mod losses;
mod model;
mod occupancy;
mod schedule;
mod train;

pub use infer::{IFace, VolumeRay};
pub use schedule::{learning_rate, next_rays};
pub use train::{TrainReport, train};

use crate::Error;
use crate::field;
use crate::io::ReadError;
use crate::io::WriteError;
use std::path::PathBuf;

/// Why training ended without a field.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IfaceError {
    /// The device cannot train.
    #[error(transparent)]
    Device(#[from] Error),
    /// Nothing to learn from.
    #[error("no training view has a pixel to learn from (masks empty, or everything marked invalid)")]
    NoPixels,
    /// A loss became NaN or infinite again after the last checkpoint was restored.
    #[error(
        "the {term} loss is {value} at step {step} (learning rate {lr:.2e}), and was again after \
         restoring the last checkpoint"
    )]
    Diverged {
        /// Which term.
        term: &'static str,
        /// Its value.
        value: f32,
        /// At which step.
        step: u64,
        /// Learning rate of the networks there.
        lr: f64,
    },
    /// No ray meets a cell that may hold surface any more: nothing could be learned from here on.
    #[error("the surface is lost at step {step}: no ray of {steps_without} steps met a sample")]
    SurfaceLost {
        /// At which step.
        step: u64,
        /// How many steps in a row saw nothing.
        steps_without: u64,
    },
    /// A stop was asked for. A checkpoint was saved, unless there was no step to save.
    #[error("saved at step {step} of {steps}")]
    Stopped {
        /// Steps done.
        step: u64,
        /// Steps wanted.
        steps: u64,
    },
    /// A checkpoint does not belong to this model.
    #[error("`{}`: {reason}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What does not fit.
        reason: String,
    },
    /// A checkpoint cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A checkpoint cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

impl IfaceError {
    /// The way out, if there is one to name.
    pub fn hint(&self) -> Option<String> {
        Some(match self {
            IfaceError::NoPixels => "look at the masks with `tiface inspect`".into(),
            IfaceError::Diverged { .. } => {
                "lower iface.lr_network and iface.lr_table, or start again with another --seed".into()
            }
            IfaceError::Checkpoint { .. } => "start the stage afresh with `--fresh iface`".into(),
            IfaceError::Read(e) => field::checkpoint::way_out(e, "iface"),
            IfaceError::Write(e) => e.hint(),
            IfaceError::SurfaceLost { .. } => {
                "look at the masks and poses with `tiface inspect`; lower iface.lr_network".into()
            }
            _ => return None,
        })
    }
}
