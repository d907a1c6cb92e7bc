//! State that a training step takes from the previous one, without a readback: the number of rays
//! and the length of a march step.

use super::device::{Buffer, Device, Words, launch};
use crate::cpu::losses::TERMS;
use crate::cpu::schedule::{Figures, RayBudget, StepLength};
use burn::cubecl::{self, prelude::*};
use tiface_base::Result;

/// Computes the number of rays and the length of a march step for the next training step.
#[cube(launch)]
fn advance(
    inv_s: &[f32],
    count: &[u32],
    rays: &mut [u32],
    step_length: &mut [f32],
    empty_steps: &mut [u32],
    units: f32,
    shortest: f32,
    longest: f32,
    budget: f32,
    min_rays: u32,
    max_rays: u32,
    first: u32,
) {
    if ABSOLUTE_POS == 0 {
        let s = clamp(inv_s[0], 1e-6f32, 1e6f32);
        step_length[0] = max(min(units / s, longest), shortest);
        let wanted = count[1];
        if first == 0 {
            if wanted == 0 {
                empty_steps[0] += 1;
            } else {
                empty_steps[0] = 0;
                let fitting =
                    u32::cast_from((f32::cast_from(rays[0]) * (budget / f32::cast_from(wanted))).floor());
                rays[0] = clamp((9 * rays[0] + min(fitting, max_rays * 10)) / 10, min_rays, max_rays);
            }
        }
    }
}

/// Collects all results of a step in one buffer, so that one readback is enough.
#[cube(launch)]
fn collect(
    losses: &[f32],
    variance: &[f32],
    count: &[u32],
    rays: &[u32],
    empty_steps: &[u32],
    non_finite: &[u32],
    out: &mut [u32],
) {
    let i = ABSOLUTE_POS;
    if i < losses.len() {
        out[i] = u32::reinterpret(losses[i]);
    }
    if i == 0 {
        out[losses.len()] = u32::reinterpret(variance[0]);
        out[losses.len() + 1] = count[1];
        out[losses.len() + 2] = rays[0];
        out[losses.len() + 3] = empty_steps[0];
        out[losses.len() + 4] = non_finite[0];
    }
}

/// Number of sums of [`Losses`](super::Losses).
const SUMS: usize = TERMS + 2;

/// The number of rays and the length of a march step, updated on the device.
pub struct Schedule {
    rule: StepLength,
    budget: RayBudget,
    /// `[1]`: number of rays of the current step.
    pub rays: Buffer,
    /// `[1]`: length of a march step in the current step, in field units.
    pub step_length: Buffer,
    /// `[1]`: number of consecutive steps without a sample, before the current one.
    empty_steps: Buffer,
    figures: Buffer,
}

impl Schedule {
    /// Creates a schedule whose first step has `rays` rays.
    pub fn new(device: &Device, rule: StepLength, budget: RayBudget, rays: usize) -> Schedule {
        Schedule {
            rule,
            budget,
            rays: device.upload(&[rays as u32]),
            step_length: device.zeros::<f32>(1),
            empty_steps: device.zeros::<u32>(1),
            figures: device.zeros::<u32>(SUMS + 5),
        }
    }

    /// Prepares the next step, from the sharpness and, unless it is the first step, from `count`,
    /// `[2]`: the number of samples of the last step, and the number with unlimited capacity.
    pub fn advance(&self, device: &Device, inv_s: &Buffer, count: &Buffer, first: bool) {
        let RayBudget { samples, min, max } = self.budget;
        let [units, shortest, longest] = match self.rule {
            StepLength::Constant(step) => [0.0, step, step],
            StepLength::OfSharpness { units, min, max } => [units, min, max],
        };
        launch!(device, advance::launch, CubeCount::new_single(), 1;
            inv_s, count, self.rays, self.step_length, self.empty_steps;
            units, shortest, longest, samples as f32, min.min(max) as u32, max as u32, u32::from(first)
        );
    }

    /// Waits for the device and returns the number of rays of the next step. `count` is the number
    /// of samples of the last step, `[2]`, or `None` before the first one.
    pub fn next_rays(&self, device: &Device, count: Option<&Buffer>) -> Result<usize> {
        let rays = device.fetch::<u32>(&self.rays)?[0] as usize;
        let wanted = count.map(|count| device.fetch::<u32>(count)).transpose()?;
        Ok(wanted.map_or(rays, |wanted| self.budget.next(rays, wanted[1] as usize)))
    }

    /// Waits for the device and returns the results of the last step, in one readback.
    pub fn figures(
        &self,
        device: &Device,
        losses: &Buffer,
        variance: &Buffer,
        count: &Buffer,
        non_finite: &Buffer,
    ) -> Result<Figures> {
        assert_eq!(losses.word_count(), SUMS);
        launch!(device, collect::launch, CubeCount::new_single(), 16;
            losses, variance, count, self.rays, self.empty_steps, non_finite, self.figures
        );
        let words = device.fetch::<u32>(&self.figures)?;
        let (samples, rays) = (words[SUMS + 1] as usize, words[SUMS + 2] as usize);
        let [squares, steps] = [0, 1].map(|i| f32::from_bits(words[TERMS + i]));
        Ok(Figures {
            losses: std::array::from_fn(|i| f32::from_bits(words[i])),
            mean_square: (steps > 0.0).then_some(squares / steps),
            variance: f32::from_bits(words[SUMS]),
            samples,
            rays: self.budget.next(rays, samples),
            // the device counts the last step only when the next one begins
            empty_steps: if samples == 0 { u64::from(words[SUMS + 3]) + 1 } else { 0 },
            non_finite: words[SUMS + 4] != 0,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::device;
    use super::*;

    #[test]
    fn rays_follow_the_budget_and_steps_the_sharpness() {
        let Some(device) = device() else { return };
        let budget = RayBudget { samples: 262_144, min: 64, max: 8192 };
        let rule = StepLength::OfSharpness { units: 1.0, min: 0.004, max: 0.05 };
        let schedule = Schedule::new(&device, rule, budget, 256);
        let inv_s = device.upload(&[100f32]);
        // 100 samples per ray; the sequence is worked out by hand in `crate::cpu::schedule`
        let mut rays = 256;
        for (k, want) in [256, 492, 704, 895, 1067, 1222, 1361].into_iter().enumerate() {
            let count = device.upload(&[0, 100 * rays]);
            schedule.advance(&device, &inv_s, &count, k == 0);
            rays = device.read::<u32>(&schedule.rays)[0];
            assert!(rays.abs_diff(want) <= 1, "{rays} {want}");
        }
        assert_eq!(device.read::<f32>(&schedule.step_length), [0.01]);
        // steps without samples keep the number of rays, and are counted
        let none = device.upload(&[0u32, 0]);
        (0..3).for_each(|_| schedule.advance(&device, &device.upload(&[1e-3f32]), &none, false));
        let losses: [f32; TERMS] = std::array::from_fn(|i| i as f32);
        let device_losses = device.upload(&[&losses[..], &[0.5, 2.0]].concat());
        let figures = |count: &Buffer, non_finite: u32| {
            schedule.figures(&device, &device_losses, &inv_s, count, &device.upload(&[non_finite])).unwrap()
        };
        let (samples, rays, empty_steps) = (0, rays as usize, 4);
        let want = Figures {
            losses,
            mean_square: Some(0.25),
            variance: 100.0,
            samples,
            rays,
            empty_steps,
            non_finite: true,
        };
        assert_eq!(figures(&none, 1), want);
        assert_eq!(device.read::<f32>(&schedule.step_length), [0.05]);
        // few and many samples stay within the bounds
        for (wanted, want) in [(1u32, 8192), (u32::MAX, 7372)] {
            schedule.advance(&device, &inv_s, &device.upload(&[0, wanted]), false);
            assert_eq!(device.read::<u32>(&schedule.rays), [want]);
        }
        assert_eq!(figures(&none, 0).empty_steps, 1);
    }
}
