//! Does a GPU compute what the processor does? One training step of a field on both, before anything is trusted to an
//! adapter and its driver.

use super::checkpoint::TrainingProgress;
use super::devices::Check;
use super::parameters::HostGroup;
use super::training::{self, Model, StepError, TrainingSession};
use crate::kernel::gpu::{Adapter, Atomics, Device};
use crate::{Quiet, Result};
use std::path::Path;

/// Seed of all that is random in a test.
pub const SEED: u64 = 3;

/// The step that is compared: cells are updated before it, [`CELLS_AT`], and rates have warmed up.
pub const STEP: u64 = 321;

/// The step at which cells are updated; some of them are drawn, by the rule that draws.
pub const CELLS_AT: u64 = STEP - 1;

/// Relative error of losses and gradients. What is computed wrong is wrong by more than a percent; what is summed in
/// another order, or a sample more or less at the border of a cell, is not.
const ALLOWED: f32 = 2e-3;

/// A training that saves nothing.
pub fn session(stage: &'static str) -> TrainingSession<'static> {
    TrainingSession { stage, seed: SEED, device: "", dir: Path::new(""), identity: "", monitor: &Quiet }
}

/// An adapter as a device, once for each way of adding that trainings use there.
pub fn ways(adapter: &Adapter) -> [Device; 2] {
    [Device::open(adapter), Device::open(adapter).with_atomics(Atomics::Fixed)]
}

/// A field in training, whose parameters can be read.
pub trait TestedModel: Model {
    /// Waits for the device and copies parameters and moments to the host.
    fn host_groups(&self) -> Result<Vec<HostGroup>>;
}

/// What a step came to.
pub struct Outcome {
    /// Losses, and counts of rays and samples; none where the step failed.
    figures: Vec<(&'static str, f64)>,
    before: Vec<HostGroup>,
    /// The first moments were zero before, and are a share of the gradients now.
    after: Vec<HostGroup>,
}

/// Makes a step, the first one as the moments have it.
pub fn outcome(model: &mut impl TestedModel) -> Result<Outcome> {
    let before = model.host_groups()?;
    let progress = TrainingProgress { step: STEP, ..TrainingProgress::default() };
    let figures = match training::step(model, SEED, &progress, true) {
        Ok(report) => report.map_or_else(Vec::new, |report| report.figures),
        Err(StepError::NotFinite { .. }) => Vec::new(),
        Err(StepError::Failed(e)) => return Err(e),
    };
    Ok(Outcome { figures, before, after: model.host_groups()? })
}

/// The sum of errors as a share of the sum of values.
fn error(pairs: impl Iterator<Item = (f64, f64)>) -> f32 {
    let (errors, all) =
        pairs.fold((0.0, 0.0), |(e, a), (got, want)| (e + (got - want).abs(), a + want.abs()));
    if errors == 0.0 { 0.0 } else { (errors / all) as f32 }
}

/// Compares what a step on a GPU came to with what it came to on the processor: each loss, the gradient of each parameter,
/// and what the optimizer made of all gradients.
pub fn compare(field: &str, got: &Outcome, want: &Outcome) -> Vec<Check> {
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
            let own = first..first + part.count();
            first = own.end;
            let pairs = own.map(|i| (slopes[i].into(), wanted[i].into()));
            checks.push(Check::new(format!("{field}: gradient of {}", part.name), error(pairs), ALLOWED));
        }
        // a first step goes by signs: of next to no gradient it says next to nothing
        let moved = |of: &Outcome, i: usize| {
            let [before, after] = [&of.before, &of.after].map(|groups| f64::from(groups[g].state[0][i]));
            (after - before) * f64::from(wanted[i])
        };
        let worst = error((0..wanted.len()).map(|i| (moved(got, i), moved(want, i))));
        optimizer = if worst > optimizer || worst.is_nan() { worst } else { optimizer };
    }
    checks.push(Check::new(format!("{field}: optimizer"), optimizer, ALLOWED));
    checks
}

/// Compares cells to march through: the share of all that differ.
pub fn compare_cells(field: &str, got: &[u64], want: &[u64]) -> Check {
    let differ: u32 = got.iter().zip(want).map(|(a, b)| (a ^ b).count_ones()).sum();
    let all: u32 = want.iter().map(|bits| bits.count_ones()).sum();
    Check::new(format!("{field}: cells"), differ as f32 / all as f32, ALLOWED)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(slope: f32, moved: f32, loss: f64) -> Outcome {
        let group = |value: f32| {
            let mut group = HostGroup::flat("table", vec![value; 100]);
            group.state[1] = vec![slope; 100];
            vec![group]
        };
        Outcome { figures: vec![("rgb", loss)], before: group(1.0), after: group(1.0 + moved) }
    }

    #[test]
    fn what_is_wrong_is_named_and_a_failed_step_is_wrong() {
        let wrong = |got: &Outcome| -> Vec<String> {
            let checks = compare("density", got, &of(0.5, -0.01, 2.0));
            checks.into_iter().filter(|check| !check.passed).map(|check| check.name).collect()
        };
        assert!(wrong(&of(0.5, -0.01, 2.0)).is_empty());
        assert_eq!(wrong(&of(0.5, -0.01, 2.1)), ["density: rgb"]);
        assert_eq!(wrong(&of(0.51, -0.01, 2.0)), ["density: gradient of table"]);
        assert_eq!(wrong(&of(f32::NAN, -0.01, 2.0)), ["density: gradient of table"]);
        assert_eq!(wrong(&of(0.5, 0.01, 2.0)), ["density: optimizer"]);
        let failed = Outcome { figures: Vec::new(), ..of(0.0, 0.0, 0.0) };
        assert_eq!(wrong(&failed).len(), 3);
        assert!(!compare_cells("", &[0b1011], &[0b1111]).passed && compare_cells("", &[7], &[7]).passed);
    }
}
