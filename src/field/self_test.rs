//! Self-tests of GPUs: one training step of a field on the GPU and on the CPU, compared before
//! `auto` trusts an adapter and its driver.

use super::Check;
use super::checkpoint::TrainingProgress;
use super::parameters::HostGroup;
use super::training::{self, Model, StepError, TrainingSession};
use std::path::Path;
use tiface_base::{Quiet, Result};
use tiface_kernels::gpu::{Adapter, Atomics, Device};

/// Seed of a test's random numbers.
pub const SEED: u64 = 3;

/// The compared step. Cells are updated before it, at [`CELLS_AT`], and the learning rates have
/// warmed up.
pub const STEP: u64 = 321;

/// The step at which cells are updated. It is late enough that nerfacc's rule draws random cells
/// instead of visiting all.
pub const CELLS_AT: u64 = STEP - 1;

/// Largest relative error of losses and gradients. A wrong computation is off by more than a
/// percent; another order of summation, or a sample more or less at the border of a cell, is not.
const ALLOWED: f32 = 2e-3;

/// Returns a session for a training without checkpoints.
pub fn session(stage: &'static str) -> TrainingSession<'static> {
    TrainingSession { stage, seed: SEED, device: "", dir: Path::new(""), identity: "", monitor: &Quiet }
}

/// Opens an adapter once for each kind of atomics that trainings use on it. The second step is
/// smaller by the returned divisor: the kernels that add differ, which are a small part of a step,
/// and variants that the first step does not launch.
pub fn devices(adapter: &Adapter) -> Result<[(Device, usize); 2]> {
    Ok([(Device::open(adapter)?, 1), (Device::open(adapter)?.with_atomics(Atomics::Fixed), 8)])
}

/// A field in training whose parameters can be read.
pub trait TestedModel: Model {
    /// Waits for the device and copies parameters and moments to the host.
    fn host_groups(&self) -> Result<Vec<HostGroup>>;
}

/// Result of a step.
pub struct StepResult {
    /// Losses, and counts of rays and samples; empty if the step failed.
    figures: Vec<(&'static str, f64)>,
    before: Vec<HostGroup>,
    /// Groups after the step. The first moments started at zero, so they are proportional to the
    /// gradients.
    after: Vec<HostGroup>,
}

/// Runs a step whose moments start at zero.
pub fn run_step(model: &mut impl TestedModel) -> Result<StepResult> {
    let before = model.host_groups()?;
    let progress = TrainingProgress { step: STEP, ..TrainingProgress::default() };
    let figures = match training::step(model, SEED, &progress, true) {
        Ok(report) => report.map_or_else(Vec::new, |report| report.figures),
        Err(StepError::NotFinite { .. }) => Vec::new(),
        Err(StepError::Failed(e)) => return Err(e),
    };
    Ok(StepResult { figures, before, after: model.host_groups()? })
}

/// Returns the sum of absolute errors, relative to the sum of absolute values.
fn error(pairs: impl Iterator<Item = (f64, f64)>) -> f32 {
    let (errors, all) =
        pairs.fold((0.0, 0.0), |(e, a), (got, want)| (e + (got - want).abs(), a + want.abs()));
    if errors == 0.0 { 0.0 } else { (errors / all) as f32 }
}

/// Compares the result of a step on a GPU with the CPU's: each loss, the gradient of each
/// parameter, and the optimizer's updates.
pub fn compare(field: &str, got: &StepResult, want: &StepResult) -> Vec<Check> {
    let mut checks = Vec::new();
    for &(name, want) in &want.figures {
        let found = got.figures.iter().find(|(other, _)| *other == name).map_or(f64::NAN, |(_, v)| *v);
        let error = error(std::iter::once((found, want)));
        checks.push(Check::new(format!("{field}: {name}"), error, ALLOWED));
    }
    let mut optimizer = 0f32;
    for (g, group) in want.after.iter().enumerate() {
        let (slopes, wanted) = (&got.after[g].state[1], &group.state[1]);
        let mut first = 0;
        for part in &group.parts {
            let span = first..first + part.count();
            first = span.end;
            let pairs = span.map(|i| (slopes[i].into(), wanted[i].into()));
            checks.push(Check::new(format!("{field}: gradient of {}", part.name), error(pairs), ALLOWED));
        }
        // Adam's first step has the gradient's sign alone, so the updates are weighted by the
        // gradient: the sign of a gradient near zero means nothing.
        let moved = |of: &StepResult, i: usize| {
            let [before, after] = [&of.before, &of.after].map(|groups| f64::from(groups[g].state[0][i]));
            (after - before) * f64::from(wanted[i])
        };
        let worst = error((0..wanted.len()).map(|i| (moved(got, i), moved(want, i))));
        optimizer = if worst > optimizer || worst.is_nan() { worst } else { optimizer };
    }
    checks.push(Check::new(format!("{field}: optimizer"), optimizer, ALLOWED));
    checks
}

/// Compares values of any kind.
pub fn compare_values(name: String, got: &[f32], want: &[f32]) -> Check {
    assert_eq!(got.len(), want.len(), "{name}");
    let pairs = got.iter().zip(want).map(|(&got, &want)| (got.into(), want.into()));
    Check::new(name, error(pairs), ALLOWED)
}

/// Compares the cells to march through, by the share of cells that differ.
pub fn compare_cells(field: &str, got: &[u64], want: &[u64]) -> Check {
    let differ: u32 = got.iter().zip(want).map(|(a, b)| (a ^ b).count_ones()).sum();
    let all: u32 = want.iter().map(|bits| bits.count_ones()).sum();
    Check::new(format!("{field}: cells"), differ as f32 / all as f32, ALLOWED)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step_result(slope: f32, moved: f32, loss: f64) -> StepResult {
        let group = |value: f32| {
            let mut group = HostGroup::flat("table", vec![value; 100]);
            group.state[1] = vec![slope; 100];
            vec![group]
        };
        StepResult { figures: vec![("rgb", loss)], before: group(1.0), after: group(1.0 + moved) }
    }

    #[test]
    fn what_is_wrong_is_named_and_a_failed_step_is_wrong() {
        let wrong = |got: &StepResult| -> Vec<String> {
            let checks = compare("density", got, &step_result(0.5, -0.01, 2.0));
            checks.into_iter().filter(|check| !check.passed).map(|check| check.name).collect()
        };
        assert!(wrong(&step_result(0.5, -0.01, 2.0)).is_empty());
        assert_eq!(wrong(&step_result(0.5, -0.01, 2.1)), ["density: rgb"]);
        assert_eq!(wrong(&step_result(0.51, -0.01, 2.0)), ["density: gradient of table"]);
        assert_eq!(wrong(&step_result(f32::NAN, -0.01, 2.0)), ["density: gradient of table"]);
        assert_eq!(wrong(&step_result(0.5, 0.01, 2.0)), ["density: optimizer"]);
        let failed = StepResult { figures: Vec::new(), ..step_result(0.0, 0.0, 0.0) };
        assert_eq!(wrong(&failed).len(), 3);
        assert!(!compare_cells("", &[0b1011], &[0b1111]).passed && compare_cells("", &[7], &[7]).passed);
        let same = |got: f32| compare_values("colors".into(), &[got, 0.5], &[0.5, 0.5]).passed;
        assert!(same(0.5) && !same(0.51) && !same(f32::NAN));
    }
}
