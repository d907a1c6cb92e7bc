//! What a hard case came to.

use std::fmt::{self, Display};

/// One hard case: the largest error met, and what it must stay below.
#[derive(Clone, Debug)]
pub struct StabilityCase {
    /// What it is about: `surfaces`, `rays`, `sharpness`, `kernels` or `captures`.
    pub group: &'static str,
    /// What is hard, and which error of it.
    pub case: String,
    /// The largest error met; NaN where something was not a number.
    pub error: f64,
    /// What the error is counted in.
    pub unit: &'static str,
    /// The largest error that holds.
    pub bound: f64,
}

impl StabilityCase {
    /// Returns whether the error is within its bound; one that is not a number never is.
    pub fn holds(&self) -> bool {
        self.error <= self.bound
    }
}

impl Display for StabilityCase {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let StabilityCase { group, case, error, unit, bound } = self;
        write!(f, "{group:10} {case:64} {error:10.2e} {bound:8.0e} {unit}")
    }
}

/// The cases of a group, in the making.
pub(super) struct Cases {
    group: &'static str,
    pub done: Vec<StabilityCase>,
}

impl Cases {
    pub fn new(group: &'static str) -> Cases {
        Cases { group, done: Vec::new() }
    }

    pub fn add(&mut self, case: impl Into<String>, error: f64, bound: f64, unit: &'static str) {
        self.done.push(StabilityCase { group: self.group, case: case.into(), error, unit, bound });
    }
}

/// The largest of some errors; NaN if one is.
pub fn worst(errors: impl IntoIterator<Item = f64>) -> f64 {
    errors.into_iter().fold(0.0, |a: f64, b: f64| if a.is_nan() || b.is_nan() { f64::NAN } else { a.max(b) })
}

/// The largest error relative to the sizes of what is right, of which those below `least` count as
/// that.
pub(super) fn relative(got: impl IntoIterator<Item = f32>, want: &[f64], least: f64) -> f64 {
    worst(got.into_iter().zip(want).map(|(g, w)| (g as f64 - w).abs() / w.abs().max(least)))
}
