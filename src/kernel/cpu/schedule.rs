//! What a training step takes from the one before it: how many rays, and how long a march step is.

use super::losses::TERMS;

/// How long a march step is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum StepLength {
    /// Always this.
    Constant(f32),
    /// So many units of the surface's width, `1 / inv_s`, but within these.
    OfSharpness {
        /// Units.
        units: f32,
        /// Shortest step.
        min: f32,
        /// Longest step.
        max: f32,
    },
}

impl StepLength {
    /// Returns the step at a sharpness.
    pub fn at(self, inv_s: f32) -> f32 {
        match self {
            StepLength::Constant(step) => step,
            StepLength::OfSharpness { units, min, max } => (units / inv_s).min(max).max(min),
        }
    }
}

/// How many rays a step draws: nine tenths of the last one's and a tenth of what would have met the budget.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RayBudget {
    /// Samples of a step.
    pub samples: usize,
    /// Fewest rays.
    pub min: usize,
    /// Most rays.
    pub max: usize,
}

impl RayBudget {
    /// Returns the rays of the step after one of `rays` rays that met `samples` samples. The published code has no floor
    /// and divides by zero when no ray met a sample; here a step without samples keeps its count.
    pub fn next(&self, rays: usize, samples: usize) -> usize {
        if samples == 0 {
            return rays;
        }
        let fitting = (rays as f64 * (self.samples as f64 / samples as f64)) as usize;
        ((rays as f64 * 0.9 + fitting as f64 * 0.1) as usize).clamp(self.min.min(self.max), self.max)
    }
}

/// What the last step came to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figures {
    /// Its losses, unweighted, in the order of [`super::losses`].
    pub losses: [f32; TERMS],
    /// Mean squared error of the colors of all steps since the last ones that were reported, none where none met a sample.
    pub mean_square: Option<f32>,
    /// NeuS' variance v behind it: the sharpness is exp(10 v).
    pub variance: f32,
    /// Samples, as many as there would have been with room for all.
    pub samples: usize,
    /// Rays of the next step.
    pub rays: usize,
    /// Steps in a row, with it, that met no sample.
    pub blind: u64,
    /// Was a gradient not finite, in this step or before?
    pub broken: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ray_count_follows_the_published_sequence_and_stalls_where_it_does() {
        // 100 samples per ray from 256 rays, budget 262,144
        let budget = RayBudget { samples: 262_144, min: 1, max: 8192 };
        let mut rays = 256;
        let mut seen = Vec::new();
        for _ in 0..200 {
            rays = budget.next(rays, rays * 100);
            seen.push(rays);
        }
        assert_eq!(&seen[..6], [492, 704, 895, 1067, 1222, 1361]);
        assert_eq!(seen[199], 2612);
    }

    #[test]
    fn a_step_without_samples_changes_nothing() {
        let budget = RayBudget { samples: 1000, min: 64, max: 8192 };
        assert_eq!((budget.next(300, 0), budget.next(64, 1_000_000)), (300, 64));
    }
}
