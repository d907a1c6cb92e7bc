//! The trainer of every field.
//!
//! ```text
//! restore, or start and save → prepare → rays, losses, gradients → Adam → read losses → after the step
//!                                → not finite? back to the last checkpoint, once
//!                                → stop asked for, or time? save
//!                                → finish
//! ```
//!
//! A model says what differs between fields and leaves what it needs between steps (rays, samples, parameters, moments)
//! where it is: the trainer sees named figures after a step, and the whole state when a checkpoint is due.

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
    /// Name of the device: see [`super::compute_device`].
    pub device: &'a str,
    /// The folder of the checkpoints; training continues from those that lie there.
    pub dir: &'a Path,
    /// Names settings and inputs: a checkpoint of another identity is refused.
    pub identity: &'a str,
    /// Hears of every step and asks to stop.
    pub monitor: &'a dyn Monitor,
}

/// A step of a training.
#[derive(Clone, Copy, Debug)]
pub struct StepAt {
    /// Seed of its random numbers: another one after a step that diverged.
    pub seed: u64,
    /// Optimizer steps before it.
    pub step: u64,
}

/// What a step came to, on the host.
pub struct StepReport {
    /// Mean squared error of the colors of all steps since the last report; none where they met nothing.
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
    },
    /// Going back would not help.
    Failed(Error),
}

impl StepError {
    /// The error that a gradient is not finite: a finite loss does not promise one.
    pub fn gradient() -> StepError {
        StepError::NotFinite { term: "gradient of the", value: f32::NAN }
    }

    /// The first of these named terms that is not finite.
    pub fn check(terms: impl IntoIterator<Item = (&'static str, f32)>) -> Result<(), StepError> {
        match terms.into_iter().find(|(_, value)| !value.is_finite()) {
            Some((term, value)) => Err(StepError::NotFinite { term, value }),
            None => Ok(()),
        }
    }
}

impl From<Error> for StepError {
    fn from(e: Error) -> StepError {
        StepError::Failed(e)
    }
}

/// A field in training.
pub trait Model {
    /// Name of its checkpoints' format.
    const FORMAT: &'static str;
    /// The settings that hold its learning rates.
    const RATES: [&'static str; 2];
    /// Steps between two reports.
    const READ_EVERY: u64;

    /// Learning rate of the networks at a step.
    fn learning_rate(&self, step: u64) -> f64;

    /// Does what is due before a step: occupancy, stereo points.
    fn prepare(&mut self, _: StepAt) -> Result<(), StepError> {
        Ok(())
    }

    /// Draws rays and leaves the gradients of their losses in the parameter groups.
    fn backward(&mut self, at: StepAt);

    /// Makes the optimizer's step of every parameter group.
    fn optimize(&mut self, step: u64);

    /// Waits for the device and returns what `step`, the last one, or the mean of those since the last report came to.
    fn report(&mut self, step: u64) -> Result<StepReport, StepError>;

    /// Does what is due after a step: finer grids.
    fn finish_step(&mut self, _: u64) -> Result<(), StepError> {
        Ok(())
    }

    /// Puts everything needed to go on into a checkpoint; of a finished one only the result is read.
    fn save(&self, into: &mut Checkpoint, finished: bool) -> Result<(), StepError>;

    /// Takes up a checkpoint's state, with its progress and whether it is finished, or the one before the first step.
    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError>;
}

/// Makes a step, and returns what it came to where that is read.
pub fn step<M: Model>(
    model: &mut M,
    seed: u64,
    progress: &TrainingProgress,
    read: bool,
) -> Result<Option<StepReport>, StepError> {
    let at = StepAt { seed: seed ^ progress.salt << 32, step: progress.step };
    model.prepare(at)?;
    model.backward(at);
    model.optimize(at.step);
    let report = read.then(|| model.report(at.step)).transpose()?;
    model.finish_step(at.step)?;
    Ok(report)
}

/// Trains until `steps`, saving a checkpoint every `checkpoint_s` seconds. A finished training is left as it is.
/// Returns how far it came and oddities on the way.
pub fn train<M: Model>(
    model: &mut M,
    session: &TrainingSession,
    steps: u64,
    checkpoint_s: f64,
) -> Result<(TrainingProgress, Vec<String>)> {
    let every = Duration::from_secs_f64(checkpoint_s);
    let &TrainingSession { stage, identity, dir, monitor, .. } = session;
    let save = |model: &M, progress: &TrainingProgress, finished: bool| -> Result<(), StepError> {
        let mut into = Checkpoint::new(stage, M::FORMAT, identity);
        progress.save(&mut into, finished);
        // a poisoned field must not take the place of a good checkpoint
        model.save(&mut into, finished)?;
        Ok(into.save(dir)?)
    };
    let restore = |model: &mut M| {
        checkpoint::restore(dir, stage, M::FORMAT, identity, |file| {
            let (progress, finished) = TrainingProgress::restore(file, steps)?;
            let taken = model.restore(Some((file, &progress, finished)));
            taken.map_err(|e| failure(model, e, stage, progress.step, false))?;
            Ok(progress)
        })
    };
    let (mut progress, mut warnings) = match restore(model)? {
        Some(restored) => restored,
        None => {
            let progress = TrainingProgress::default();
            // a training that breaks early goes back to here
            let started = model.restore(None).and_then(|()| save(model, &progress, false));
            started.map_err(|e| failure(model, e, stage, 0, false))?;
            (progress, Vec::new())
        }
    };
    if progress.step == steps {
        monitor.step(steps, steps, &[]);
    }
    let mut went_back = progress.salt > 0;
    let mut saved = Instant::now();
    while progress.step < steps {
        let done = progress.step + 1;
        let read = done.is_multiple_of(M::READ_EVERY) || done == steps;
        let result = step(model, session.seed, &progress, read).and_then(|report| {
            progress.step = done;
            let report = report.unwrap_or(StepReport { square_error: None, figures: Vec::new() });
            if let Some(error) = report.square_error {
                let new = (done - 1) % M::READ_EVERY + 1;
                progress.mean_square = running_mean(progress.mean_square, done - new, error.into(), new);
            }
            // none before the first error is known, which a device tells once in many steps
            let psnr = (progress.mean_square > 0.0).then(|| ("psnr", progress.psnr()));
            let figures: Vec<_> = psnr.into_iter().chain(report.figures).collect();
            monitor.step(done, steps, &figures);
            let (last, stop) = (done == steps, monitor.stop());
            if last || stop || saved.elapsed() > every {
                save(model, &progress, last)?;
                saved = Instant::now();
            }
            Ok(stop && !last)
        });
        match result {
            Ok(false) => {}
            Ok(true) => return Err(stopped(progress.step, steps)),
            Err(StepError::NotFinite { term, value }) if !went_back => {
                went_back = true;
                warnings.push(format!(
                    "the {term} loss became {value} at step {}; went back to the last checkpoint once",
                    done - 1
                ));
                let Some((restored, notes)) = restore(model)? else {
                    return Err(Error::cannot("the checkpoint of the start is gone", "start again"));
                };
                warnings.extend(notes);
                // other rays, or the same step would break in the same way
                progress = TrainingProgress { salt: 1, ..restored };
            }
            Err(e) => return Err(failure(model, e, stage, done - 1, went_back)),
        }
    }
    checkpoint::finish(dir)?;
    Ok((progress, warnings))
}

/// Returns the mean of all steps, of which each counts 2 % less than the one after it: from that of the first `old` ones
/// and the mean of the `new` ones behind them.
fn running_mean(mean: f64, old: u64, of_new: f64, new: u64) -> f64 {
    let weight = |steps: u64| 1.0 - 0.98f64.powf(steps as f64);
    let keep = (1.0 - weight(new)) * weight(old) / weight(old + new);
    if mean == 0.0 { of_new } else { keep * mean + (1.0 - keep) * of_new }
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

fn failure<M: Model>(model: &M, e: StepError, stage: &str, step: u64, went_back: bool) -> Error {
    match e {
        StepError::Failed(e) => e,
        StepError::NotFinite { term, value } => {
            let [a, b] = M::RATES;
            let lr = model.learning_rate(step);
            let again = if went_back { ", and was again after restoring the last checkpoint" } else { "" };
            Error::cannot(
                format!("the {term} loss is {value} at step {step} (learning rate {lr:.2e}){again}"),
                format!("lower {stage}.{a} and {stage}.{b}, or start again with another --seed"),
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_running_error_is_the_same_read_each_step_or_every_fiftieth() {
        let error = |step: u64| 0.2 / (1.0 + 0.1 * step as f64);
        let (mut each, mut some) = (0.0, 0.0);
        for step in 0..600 {
            each = running_mean(each, step, error(step), 1);
            if (step + 1) % 50 == 0 {
                let mean = (step - 49..=step).map(error).sum::<f64>() / 50.0;
                some = running_mean(some, step - 49, mean, 50);
                let apart: f64 = 10.0 * (some / each).log10();
                assert!(apart.abs() < if step < 200 { 0.7 } else { 0.25 }, "step {step}: {apart:.2} dB");
            }
        }
        // the weights by hand: 0.98 and 1 of two steps
        assert!(
            (running_mean(running_mean(0.0, 0, 3.0, 1), 1, 1.0, 1) - (0.98 * 3.0 + 1.0) / 1.98).abs() < 1e-12
        );
    }
}
