//! Why a radiance field cannot be had.

use crate::Error;
use crate::field;
use crate::io::{ReadError, WriteError};
use crate::tface::th::ThError;
use std::path::PathBuf;

/// Why training ended without a field.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TfaceError {
    /// The device cannot train.
    #[error(transparent)]
    Device(#[from] Error),
    /// Nothing to learn from.
    #[error("no training view has a pixel to learn from (masks empty, or everything marked invalid)")]
    NoPixels,
    /// The settings contradict each other.
    #[error("`{stage}.{key}` {problem}")]
    Settings {
        /// Table of the configuration.
        stage: &'static str,
        /// Key in it.
        key: &'static str,
        /// What is wrong.
        problem: String,
    },
    /// A loss became NaN or infinite again after the last checkpoint was restored.
    #[error("the {term} loss is {value} at step {step}, and was again after restoring the last checkpoint")]
    Diverged {
        /// Which term.
        term: &'static str,
        /// Its value.
        value: f32,
        /// At which step.
        step: u64,
    },
    /// The alpha mask kept no vertex: the field is empty.
    #[error("the field is empty at step {step}: no vertex of the alpha mask is above {threshold:e}")]
    Empty {
        /// At which step.
        step: u64,
        /// The mask's threshold.
        threshold: f64,
    },
    /// The training of one field of several broke.
    #[error("field {field} of {fields}: {source}")]
    Field {
        /// Which, from 1.
        field: usize,
        /// Of how many.
        fields: usize,
        /// How.
        source: Box<TfaceError>,
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
    /// A published checkpoint cannot be taken.
    #[error(transparent)]
    Th(#[from] ThError),
    /// The field cannot become, or come from, a published checkpoint.
    #[error("the field cannot be exchanged: {0}")]
    Exchange(&'static str),
    /// A checkpoint cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A checkpoint cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

impl TfaceError {
    /// The same, where `field` (from 1) of several fields broke and the error speaks of its steps.
    pub(super) fn of_field(self, field: usize, fields: usize) -> TfaceError {
        match self {
            TfaceError::Diverged { .. } | TfaceError::Empty { .. } if fields > 1 => {
                TfaceError::Field { field, fields, source: Box::new(self) }
            }
            other => other,
        }
    }

    /// The way out, if there is one to name; `stage` is `tface` or `baseline`.
    pub fn hint(&self, stage: &str) -> Option<String> {
        Some(match self {
            TfaceError::NoPixels => "look at the masks with `tiface inspect`".into(),
            TfaceError::Settings { stage, key, .. } => {
                format!("`tiface config --explain {stage}.{key}` says what it means")
            }
            TfaceError::Diverged { .. } => {
                format!("lower {stage}.lr_grid and {stage}.lr_network, or start again with another --seed")
            }
            TfaceError::Empty { .. } => format!(
                "look at the masks and poses with `tiface inspect`; lower {stage}.mask_threshold and {stage}.mask_weight"
            ),
            TfaceError::Checkpoint { .. } => format!("start the stage afresh with `--fresh {stage}`"),
            TfaceError::Field { source, .. } => return source.hint(stage),
            TfaceError::Th(e) => e.hint(),
            TfaceError::Read(e) => field::checkpoint::way_out(e, stage),
            TfaceError::Write(e) => e.hint(),
            _ => return None,
        })
    }
}
