//! The trainer that all fields share.
//!
//! ```text
//! restore, or start and save
//!   → prepare → rays, losses, gradients → Adam → read losses → after the step
//!     → not finite? back to the last checkpoint, once
//!     → stop asked for, or time? save
//!     → finish
//! ```
//!
//! A model defines what differs between fields, and keeps its rays, samples, parameters and moments
//! on its device between steps. The trainer sees named figures after a step, and the whole state
//! only when a checkpoint is due.

use super::checkpoint::{self, Checkpoint, TrainingProgress};
use std::path::Path;
use std::time::{Duration, Instant};
use tiface_base::{Error, Monitor, Result};

/// Context of a training, besides its photographs and settings.
#[derive(Clone, Copy)]
pub struct TrainingSession<'a> {
    /// Stage, which is also its settings table: `iface`, `tface` or `baseline`.
    pub stage: &'static str,
    /// Seed of every random number.
    pub seed: u64,
    /// Name of the device; see [`super::compute_device`].
    pub device: &'a str,
    /// Folder of the checkpoints; training resumes from those it contains.
    pub dir: &'a Path,
    /// Identity of settings and inputs; a checkpoint of another identity is refused.
    pub identity: &'a str,
    /// Receives every step's progress, and can request a stop.
    pub monitor: &'a dyn Monitor,
}

/// A step of a training.
#[derive(Clone, Copy, Debug)]
pub struct StepAt {
    /// Seed of the step's random numbers, which changes after a step diverged.
    pub seed: u64,
    /// Number of optimizer steps before this one.
    pub step: u64,
}

/// Figures of a step, on the host.
pub struct StepReport {
    /// Mean squared error of the colors of all steps since the last report; `None` if no ray met a
    /// sample.
    pub square_error: Option<f32>,
    /// Named figures, for display.
    pub figures: Vec<(&'static str, f64)>,
}

impl StepReport {
    /// Returns the report of a step with these loss terms, which are shown before `others`.
    ///
    /// # Errors
    ///
    /// Fails if a term is not finite, or if a gradient is not, which `non_finite` says.
    pub fn checked<const N: usize>(
        terms: [(&'static str, f32); N],
        non_finite: bool,
        square_error: Option<f32>,
        others: impl IntoIterator<Item = (&'static str, f64)>,
    ) -> Result<StepReport, StepError> {
        StepError::check(terms)?;
        if non_finite {
            return Err(StepError::gradient());
        }
        let terms = terms.map(|(name, value)| (name, f64::from(value)));
        Ok(StepReport { square_error, figures: terms.into_iter().chain(others).collect() })
    }
}

/// Reason for which training cannot go on to the next step.
pub enum StepError {
    /// A loss or gradient is NaN or infinite; nothing was updated.
    NotFinite {
        /// Name of the term.
        term: &'static str,
        /// Its value.
        value: f32,
    },
    /// Any other error, for which going back to a checkpoint would not help.
    Failed(Error),
}

impl StepError {
    /// Returns the error for a gradient that is not finite, which can happen even if the loss is
    /// finite.
    pub fn gradient() -> StepError {
        StepError::NotFinite { term: "gradient of the", value: f32::NAN }
    }

    /// Returns an error for the first of these named terms that is not finite.
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
    /// Format name of the model's checkpoints.
    const FORMAT: &'static str;
    /// Names of the settings that hold the learning rates, for messages.
    const RATES: [&'static str; 2];
    /// Steps between two reports.
    const READ_EVERY: u64;

    /// Returns the learning rate of the networks at a step.
    fn learning_rate(&self, step: u64) -> f64;

    /// Does the work due before a step, such as updating the occupancy or searching stereo points.
    fn prepare(&mut self, _: StepAt) -> Result<(), StepError> {
        Ok(())
    }

    /// Draws rays and writes the gradients of their losses into the parameter groups.
    fn backward(&mut self, at: StepAt);

    /// Makes the optimizer's step of every parameter group.
    fn optimize(&mut self, step: u64);

    /// Waits for the device and returns the figures of `step`, the last one, or their means since
    /// the last report.
    fn report(&mut self, step: u64) -> Result<StepReport, StepError>;

    /// Does the work due after a step, such as refining grids.
    fn finish_step(&mut self, _: u64) -> Result<(), StepError> {
        Ok(())
    }

    /// Writes everything needed to resume into a checkpoint. A finished checkpoint needs only the
    /// result.
    fn save(&self, into: &mut Checkpoint, finished: bool) -> Result<(), StepError>;

    /// Restores the state from a checkpoint, given its progress and whether it is finished, or sets
    /// the initial state.
    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError>;
}

/// Runs a step, and returns its report if `read`.
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

/// Trains until `steps`, saving a checkpoint every `checkpoint_s` seconds. A finished training is
/// left unchanged. Returns the progress and warnings.
pub fn train<M: Model>(
    model: &mut M,
    session: &TrainingSession,
    steps: u64,
    checkpoint_s: f64,
) -> Result<(TrainingProgress, Vec<String>)> {
    let mut training = Training::start(model, session, steps)?;
    if training.progress.step == steps {
        session.monitor.step(steps, steps, &[]);
    }
    let every = Duration::from_secs_f64(checkpoint_s);
    let mut saved = Instant::now();
    while training.progress.step < steps {
        let step = training.progress.step;
        match training.advance(every, &mut saved) {
            Ok(false) => {}
            Ok(true) => return Err(stopped(training.progress.step, steps)),
            Err(StepError::NotFinite { term, value }) if !training.went_back => {
                training.warnings.push(format!(
                    "the {term} loss became {value} at step {step}; went back to the last checkpoint once. If the result is \
                     poor, train again with another `--seed`"
                ));
                training.go_back()?;
            }
            Err(e) => return Err(failure(training.model, e, session.stage, step, training.went_back)),
        }
    }
    checkpoint::finish(session.dir)?;
    Ok((training.progress, training.warnings))
}

/// A model that is being trained.
struct Training<'a, M> {
    model: &'a mut M,
    session: &'a TrainingSession<'a>,
    /// Total number of steps.
    steps: u64,
    progress: TrainingProgress,
    /// Whether training returned to a checkpoint, which it does once.
    went_back: bool,
    warnings: Vec<String>,
}

impl<'a, M: Model> Training<'a, M> {
    /// Restores a training, or starts and saves it.
    fn start(model: &'a mut M, session: &'a TrainingSession, steps: u64) -> Result<Training<'a, M>> {
        let (progress, warnings) = (TrainingProgress::default(), Vec::new());
        let mut training = Training { model, session, steps, progress, went_back: false, warnings };
        match training.restore()? {
            Some((progress, warnings)) => {
                training.went_back = progress.salt > 0;
                (training.progress, training.warnings) = (progress, warnings);
            }
            None => {
                // A training that diverges early goes back to this checkpoint.
                let started = training.model.restore(None).and_then(|()| training.save(false));
                started.map_err(|e| failure(training.model, e, session.stage, 0, false))?;
            }
        }
        Ok(training)
    }

    fn save(&self, finished: bool) -> Result<(), StepError> {
        let mut into = Checkpoint::new(self.session.stage, M::FORMAT, self.session.identity);
        self.progress.save(&mut into, finished);
        // A model with non-finite values returns an error here, so that it does not replace a good
        // checkpoint.
        self.model.save(&mut into, finished)?;
        Ok(into.save(self.session.dir)?)
    }

    /// Restores the model from the newest checkpoint, and returns its progress with warnings;
    /// `None` without a checkpoint.
    fn restore(&mut self) -> Result<Option<(TrainingProgress, Vec<String>)>> {
        let &TrainingSession { stage, identity, dir, .. } = self.session;
        checkpoint::restore(dir, stage, M::FORMAT, identity, |file| {
            let (progress, finished) = TrainingProgress::restore(file, self.steps)?;
            let taken = self.model.restore(Some((file, &progress, finished)));
            taken.map_err(|e| failure(self.model, e, stage, progress.step, false))?;
            Ok(progress)
        })
    }

    /// Returns to the last checkpoint.
    fn go_back(&mut self) -> Result<()> {
        self.went_back = true;
        let Some((restored, notes)) = self.restore()? else {
            return Err(Error::cannot("the checkpoint of the start is gone", "start again"));
        };
        self.warnings.extend(notes);
        // The salt draws other rays; the same ones would make the step diverge again.
        self.progress = TrainingProgress { salt: 1, ..restored };
        Ok(())
    }

    /// Makes a step, reports it, and saves a checkpoint when one is due. Returns whether a stop is
    /// asked for before the last step.
    fn advance(&mut self, every: Duration, saved: &mut Instant) -> Result<bool, StepError> {
        let (steps, done) = (self.steps, self.progress.step + 1);
        let read = done.is_multiple_of(M::READ_EVERY) || done == steps;
        let report = step(self.model, self.session.seed, &self.progress, read)?;
        let progress = &mut self.progress;
        progress.step = done;
        let report = report.unwrap_or(StepReport { square_error: None, figures: Vec::new() });
        if let Some(error) = report.square_error {
            let new = (done - 1) % M::READ_EVERY + 1;
            progress.mean_square = running_mean(progress.mean_square, done - new, error.into(), new);
        }
        // The error is unknown until the first readback, which a GPU makes once in many steps.
        let psnr = (progress.mean_square > 0.0).then(|| ("psnr", progress.psnr()));
        let figures: Vec<_> = psnr.into_iter().chain(report.figures).collect();
        self.session.monitor.step(done, steps, &figures);
        let (last, stop) = (done == steps, self.session.monitor.stop());
        if last || stop || saved.elapsed() > every {
            self.save(last)?;
            *saved = Instant::now();
        }
        Ok(stop && !last)
    }
}

/// Returns the running mean over all steps, each weighted 2 % less than the next, from the mean of
/// the first `old` steps and the mean of the `new` steps after them.
fn running_mean(mean: f64, old: u64, of_new: f64, new: u64) -> f64 {
    let weight = |steps: u64| 1.0 - 0.98f64.powf(steps as f64);
    let keep = (1.0 - weight(new)) * weight(old) / weight(old + new);
    if mean == 0.0 { of_new } else { keep * mean + (1.0 - keep) * of_new }
}

/// Returns the error of a training that stopped on request after saving its progress.
pub fn stopped(step: u64, steps: u64) -> Error {
    Error::stopped(format!("saved at step {step} of {steps}"))
}

/// Returns the error for views without a drawable pixel.
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
        // By hand: the weights of two steps are 0.98 and 1.
        assert!(
            (running_mean(running_mean(0.0, 0, 3.0, 1), 1, 1.0, 1) - (0.98 * 3.0 + 1.0) / 1.98).abs() < 1e-12
        );
    }
}
