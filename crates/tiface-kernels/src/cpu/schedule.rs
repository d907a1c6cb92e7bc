//! State that a training step takes from the previous one: the number of rays and the length of a
//! march step.

use super::losses::TERMS;

/// Rule for the length of a march step, in field units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum StepLength {
    /// A constant length.
    Constant(f32),
    /// A multiple of the surface's width `1 / inv_s`, clamped to a range.
    OfSharpness {
        /// Multiple of the surface's width.
        units: f32,
        /// Shortest step.
        min: f32,
        /// Longest step.
        max: f32,
    },
}

impl StepLength {
    /// Returns the length of a march step at a sharpness.
    pub fn at(self, inv_s: f32) -> f32 {
        match self {
            StepLength::Constant(step) => step,
            StepLength::OfSharpness { units, min, max } => (units / inv_s).min(max).max(min),
        }
    }
}

/// Rule for the number of rays of a step: 0.9 times that of the previous step plus 0.1 times the
/// number that would have met the budget of samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RayBudget {
    /// Target number of samples per step.
    pub samples: usize,
    /// Minimum number of rays.
    pub min: usize,
    /// Maximum number of rays.
    pub max: usize,
}

impl RayBudget {
    /// Returns the number of rays of the next step, after a step of `rays` rays with `samples`
    /// samples in total. The published code has no minimum and divides by zero if no ray has a
    /// sample; here the number is then kept.
    pub fn next(&self, rays: usize, samples: usize) -> usize {
        if samples == 0 {
            return rays;
        }
        let fitting = (rays as f64 * (self.samples as f64 / samples as f64)) as usize;
        ((rays as f64 * 0.9 + fitting as f64 * 0.1) as usize).clamp(self.min.min(self.max), self.max)
    }
}

/// Results of the last training step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figures {
    /// Unweighted losses of the step, in the order of [`super::losses`].
    pub losses: [f32; TERMS],
    /// Mean squared color error over all steps since the last report; `None` if none of them had a
    /// sample.
    pub mean_square: Option<f32>,
    /// NeuS's variance parameter v after the step; the sharpness is exp(10 v).
    pub variance: f32,
    /// Number of samples that the step would have had with unlimited capacity.
    pub samples: usize,
    /// Number of rays of the next step.
    pub rays: usize,
    /// Number of consecutive steps without a sample, up to and including this one.
    pub empty_steps: u64,
    /// Whether a gradient was not finite, in this step or an earlier one.
    pub non_finite: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ray_count_follows_the_published_sequence_to_its_fixed_point() {
        // 100 samples per ray from 256 rays, budget 262,144
        let budget = RayBudget { samples: 262_144, min: 1, max: 8192 };
        let mut rays = 256;
        let mut counts = Vec::new();
        for _ in 0..200 {
            rays = budget.next(rays, rays * 100);
            counts.push(rays);
        }
        assert_eq!(&counts[..6], [492, 704, 895, 1067, 1222, 1361]);
        assert_eq!(counts[199], 2612);
    }

    #[test]
    fn a_step_without_samples_changes_nothing() {
        let budget = RayBudget { samples: 1000, min: 64, max: 8192 };
        assert_eq!((budget.next(300, 0), budget.next(64, 1_000_000)), (300, 64));
    }
}
