//! The training loop of every field.
//!
//! ```text
//! restore, or start and save → step → not finite? back to the last checkpoint, once
//!                                   → stop asked for, or time? save
//!                                   → finish
//! ```
//!
//! A field says what a step is and where it keeps what it needs between steps (rays, samples, parameters, moments):
//! the loop sees named figures after a step, and the whole state when a checkpoint is due, and nothing else.

use super::checkpoint::{self, Checkpoint, TrainingProgress};
use crate::{Error, Monitor, Result};
use std::path::Path;
use std::time::{Duration, Instant};

/// What a training is given besides its photographs and settings.
#[derive(Clone, Copy)]
pub struct TrainingSession<'a> {
    /// The stage, which is the table of its settings: `iface`, `tface` or `baseline`.
    pub stage: &'static str,
    /// Seed of every random number.
    pub seed: u64,
    /// Name of the device: see [`super::place`].
    pub device: &'a str,
    /// The folder of the checkpoints; training continues from those that lie there.
    pub dir: &'a Path,
    /// Names settings and inputs: a checkpoint of another identity is refused.
    pub identity: &'a str,
    /// Hears of every step and asks to stop.
    pub monitor: &'a dyn Monitor,
}

/// What a step came to, on the host.
pub struct StepReport {
    /// Mean squared error of the colors; none where the step met nothing.
    pub square_error: Option<f32>,
    /// Named figures, for people.
    pub figures: Vec<(&'static str, f64)>,
}

/// Why there is no next step.
pub enum StepError {
    /// A loss or gradient is NaN or infinite; nothing was updated.
    NotFinite {
        /// Which term.
        term: &'static str,
        /// Its value.
        value: f32,
        /// Learning rate of the networks there.
        lr: f64,
    },
    /// Going back would not help.
    Failed(Error),
}

impl From<Error> for StepError {
    fn from(e: Error) -> StepError {
        StepError::Failed(e)
    }
}

/// A field in training.
pub trait Learner {
    /// Name of its checkpoints' format.
    const FORMAT: &'static str;
    /// The settings that hold its learning rates.
    const RATES: [&'static str; 2];
    /// Steps that a squared error is the mean of.
    const EVERY: u64 = 1;

    /// Makes the optimizer step after `progress.step`.
    fn step(&mut self, progress: &TrainingProgress) -> Result<StepReport, StepError>;

    /// Puts everything needed to go on into a checkpoint; of a finished one only the result is read.
    fn save(
        &self,
        progress: &TrainingProgress,
        into: &mut Checkpoint,
        finished: bool,
    ) -> Result<(), StepError>;

    /// Takes up a checkpoint's state, or the one before the first step.
    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError>;
}

/// Trains until `steps`, saving a checkpoint every `checkpoint_s` seconds. A finished training is left as it is.
/// Returns how far it came and oddities on the way.
pub fn train<L: Learner>(
    learner: &mut L,
    session: &TrainingSession,
    steps: u64,
    checkpoint_s: f64,
) -> Result<(TrainingProgress, Vec<String>)> {
    let every = Duration::from_secs_f64(checkpoint_s);
    let &TrainingSession { stage, identity, dir, monitor, .. } = session;
    let save = |learner: &L, progress: &TrainingProgress, finished: bool| -> Result<(), StepError> {
        let mut into = Checkpoint::new(stage, L::FORMAT, identity);
        progress.save(&mut into, finished);
        // a poisoned field must not take the place of a good checkpoint
        learner.save(progress, &mut into, finished)?;
        Ok(into.save(dir)?)
    };
    let restore = |learner: &mut L| {
        checkpoint::restore(dir, stage, L::FORMAT, identity, |file| {
            let (progress, finished) = TrainingProgress::restore(file, steps)?;
            let taken = learner.restore(Some((file, &progress, finished)));
            taken.map_err(|e| failure::<L>(e, stage, progress.step, false))?;
            Ok(progress)
        })
    };
    let (mut progress, mut warnings) = match restore(learner)? {
        Some(restored) => restored,
        None => {
            let progress = TrainingProgress::default();
            // a training that breaks early goes back to here
            let started = learner.restore(None).and_then(|()| save(learner, &progress, false));
            started.map_err(|e| failure::<L>(e, stage, 0, false))?;
            (progress, Vec::new())
        }
    };
    if progress.step == steps {
        monitor.step(steps, steps, &[]);
    }
    let mut went_back = progress.salt > 0;
    let mut saved = Instant::now();
    while progress.step < steps {
        let step = progress.step;
        let result = learner.step(&progress).and_then(|report| {
            progress.step += 1;
            if let Some(error) = report.square_error {
                let kept = 0.98f64.powi(L::EVERY as i32);
                let keep = if progress.mean_square == 0.0 { 0.0 } else { kept };
                progress.mean_square = keep * progress.mean_square + (1.0 - keep) * error as f64;
            }
            // none before the first error is known, which a device tells once in many steps
            let psnr = (progress.mean_square > 0.0).then(|| ("psnr", progress.psnr()));
            let figures: Vec<_> = psnr.into_iter().chain(report.figures).collect();
            monitor.step(progress.step, steps, &figures);
            let (last, stop) = (progress.step == steps, monitor.stop());
            if last || stop || saved.elapsed() > every {
                save(learner, &progress, last)?;
                saved = Instant::now();
            }
            Ok(stop && !last)
        });
        match result {
            Ok(false) => {}
            Ok(true) => return Err(stopped(progress.step, steps)),
            Err(StepError::NotFinite { term, value, .. }) if !went_back => {
                went_back = true;
                warnings.push(format!(
                    "the {term} loss became {value} at step {step}; went back to the last checkpoint once"
                ));
                let Some((restored, notes)) = restore(learner)? else {
                    return Err(Error::cannot("the checkpoint of the start is gone", "start again"));
                };
                warnings.extend(notes);
                // other rays, or the same step would break in the same way
                progress = TrainingProgress { salt: 1, ..restored };
            }
            Err(e) => return Err(failure::<L>(e, stage, step, went_back)),
        }
    }
    checkpoint::finish(dir)?;
    Ok((progress, warnings))
}

/// Returns the error of a training that was asked to stop; what was done is saved.
pub fn stopped(step: u64, steps: u64) -> Error {
    Error::stopped(format!("saved at step {step} of {steps}"))
}

/// Returns the error that no view has a pixel to learn from.
pub fn no_pixels() -> Error {
    Error::cannot(
        "no training view has a pixel to learn from (masks empty, or everything marked invalid)",
        "look at the masks with `tiface inspect`",
    )
}

fn failure<L: Learner>(e: StepError, stage: &str, step: u64, went_back: bool) -> Error {
    match e {
        StepError::Failed(e) => e,
        StepError::NotFinite { term, value, lr } => {
            let [a, b] = L::RATES;
            let again = if went_back { ", and was again after restoring the last checkpoint" } else { "" };
            Error::cannot(
                format!("the {term} loss is {value} at step {step} (learning rate {lr:.2e}){again}"),
                format!("lower {stage}.{a} and {stage}.{b}, or start again with another --seed"),
            )
        }
    }
}
