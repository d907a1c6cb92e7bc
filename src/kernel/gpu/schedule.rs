//! What a step takes from the one before it, without asking the host: how many rays, and how long a march step is.

use super::device::{Buffer, Device};
use super::losses::TERMS;
use crate::Result;
use cubecl::prelude::*;

/// How long a march step is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pitch {
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

#[cube(launch)]
fn advance(
    inv_s: &[f32],
    count: &[u32],
    rays: &mut [u32],
    pitch: &mut [f32],
    blind: &mut [u32],
    units: f32,
    shortest: f32,
    longest: f32,
    budget: f32,
    least: u32,
    most: u32,
    first: u32,
) {
    if ABSOLUTE_POS == 0 {
        let s = clamp(inv_s[0], 1e-6f32, 1e6f32);
        pitch[0] = max(min(units / s, longest), shortest);
        let wanted = count[1];
        if first == 0 {
            if wanted == 0 {
                blind[0] += 1;
            } else {
                blind[0] = 0;
                let fitting =
                    u32::cast_from((f32::cast_from(rays[0]) * (budget / f32::cast_from(wanted))).floor());
                rays[0] = clamp((9 * rays[0] + min(fitting, most * 10)) / 10, least, most);
            }
        }
    }
}

/// Everything that the host asks for at once.
#[cube(launch)]
fn collect(
    losses: &[f32],
    variance: &[f32],
    count: &[u32],
    rays: &[u32],
    blind: &[u32],
    broken: &[u32],
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
        out[losses.len() + 3] = blind[0];
        out[losses.len() + 4] = broken[0];
    }
}

/// What a step came to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figures {
    /// Its losses, in the order of [`Losses::sums`](super::Losses::sums).
    pub losses: [f32; TERMS],
    /// NeuS' variance v behind it: the sharpness is exp(10 v).
    pub variance: f32,
    /// Samples, as many as there would have been with room for all.
    pub samples: u32,
    /// Rays.
    pub rays: u32,
    /// Steps in a row before it that met no sample.
    pub blind: u32,
    /// Was a gradient not finite, in this step or before?
    pub broken: bool,
}

/// What a step takes from the one before it.
pub struct Schedule {
    pitch_rule: Pitch,
    budget: RayBudget,
    /// `[1]`: rays of this step.
    pub rays: Buffer,
    /// `[1]`: length of its march step.
    pub pitch: Buffer,
    /// `[1]`: steps in a row before it that met no sample.
    blind: Buffer,
    figures: Buffer,
}

impl Schedule {
    /// Starts with so many rays.
    pub fn new(device: &Device, pitch: Pitch, budget: RayBudget, rays: usize) -> Schedule {
        Schedule {
            pitch_rule: pitch,
            budget,
            rays: device.upload(&[rays as u32]),
            pitch: device.zeros(1),
            blind: device.zeros(1),
            figures: device.zeros(TERMS + 5),
        }
    }

    /// Looks at the sharpness and, unless it is the first one, at the samples of the last step: how many there were and
    /// how many there would have been with more room, `[2]`.
    pub fn advance(&self, device: &Device, inv_s: &Buffer, count: &Buffer, first: bool) {
        let RayBudget { samples, min, max } = self.budget;
        let [units, shortest, longest] = match self.pitch_rule {
            Pitch::Constant(step) => [0.0, step, step],
            Pitch::OfSharpness { units, min, max } => [units, min, max],
        };
        advance::launch(
            device.launch(),
            CubeCount::new_single(),
            CubeDim::new_1d(1),
            inv_s.arg(),
            count.arg(),
            self.rays.arg(),
            self.pitch.arg(),
            self.blind.arg(),
            units,
            shortest,
            longest,
            samples as f32,
            min.min(max) as u32,
            max as u32,
            u32::from(first),
        );
    }

    /// Waits for the device; what the last step came to, in one readback.
    pub fn figures(
        &self,
        device: &Device,
        losses: &Buffer,
        variance: &Buffer,
        count: &Buffer,
        broken: &Buffer,
    ) -> Result<Figures> {
        assert_eq!(losses.words(), TERMS);
        collect::launch(
            device.launch(),
            CubeCount::new_single(),
            CubeDim::new_1d(16),
            losses.arg(),
            variance.arg(),
            count.arg(),
            self.rays.arg(),
            self.blind.arg(),
            broken.arg(),
            self.figures.arg(),
        );
        let words = device.fetch::<u32>(&self.figures)?;
        Ok(Figures {
            losses: std::array::from_fn(|i| f32::from_bits(words[i])),
            variance: f32::from_bits(words[TERMS]),
            samples: words[TERMS + 1],
            rays: words[TERMS + 2],
            blind: words[TERMS + 3],
            broken: words[TERMS + 4] != 0,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::device::tests::device;
    use super::*;

    #[test]
    fn rays_follow_the_budget_and_steps_the_sharpness() {
        let Some(device) = device() else { return };
        let budget = RayBudget { samples: 262_144, min: 64, max: 8192 };
        let rule = Pitch::OfSharpness { units: 1.0, min: 0.004, max: 0.05 };
        let schedule = Schedule::new(&device, rule, budget, 256);
        let inv_s = device.upload(&[100f32]);
        // 100 samples a ray, worked out by hand in `iface::schedule`
        let mut rays = 256;
        for (k, want) in [256, 492, 704, 895, 1067, 1222, 1361].into_iter().enumerate() {
            let count = device.upload(&[0, 100 * rays]);
            schedule.advance(&device, &inv_s, &count, k == 0);
            rays = device.read::<u32>(&schedule.rays)[0];
            assert!(rays.abs_diff(want) <= 1, "{rays} {want}");
        }
        assert_eq!(device.read::<f32>(&schedule.pitch), [0.01]);
        // without samples nothing changes, but is counted
        let none = device.upload(&[0u32, 0]);
        (0..3).for_each(|_| schedule.advance(&device, &device.upload(&[1e-3f32]), &none, false));
        let losses: [f32; TERMS] = std::array::from_fn(|i| i as f32);
        let there = device.upload(&losses);
        let figures = |count: &Buffer, broken: u32| {
            schedule.figures(&device, &there, &inv_s, count, &device.upload(&[broken])).unwrap()
        };
        let (samples, blind) = (0, 3);
        let want = Figures { losses, variance: 100.0, samples, rays, blind, broken: true };
        assert_eq!(figures(&none, 1), want);
        assert_eq!(device.read::<f32>(&schedule.pitch), [0.05]);
        // few and many samples stay within the bounds
        for (wanted, want) in [(1u32, 8192), (u32::MAX, 7372)] {
            schedule.advance(&device, &inv_s, &device.upload(&[0, wanted]), false);
            assert_eq!(device.read::<u32>(&schedule.rays), [want]);
        }
        assert_eq!(figures(&none, 0).blind, 0);
    }
}
