//! The optimizer of [`crate::cpu::adam`].

use super::device::{Buffer, Device, Words, groups, launch};
use crate::cpu::adam::AdamStep;
use burn::cubecl::{self, prelude::*};

const UNITS: u32 = 256;

#[cube(launch)]
fn adam_kernel(
    p: &mut [f32],
    m: &mut [f32],
    v: &mut [f32],
    g: &mut [f32],
    count: &[u32],
    non_finite: &[u32],
    lr: f32,
    beta1: f32,
    beta2: f32,
    epsilon: f32,
    keep: f32,
    c1: f32,
    c2: f32,
    #[comptime] skip_zero: bool,
) {
    let i = ABSOLUTE_POS;
    if i < p.len() && count[0] > 0 && non_finite[0] == 0 {
        let gradient = g[i];
        if !skip_zero || gradient != 0.0f32 {
            let m1 = fma(beta1, m[i], (1.0f32 - beta1) * gradient);
            let v1 = fma(beta2, v[i], (1.0f32 - beta2) * gradient * gradient);
            p[i] = fma(p[i], keep, -lr * (m1 * c1) / ((v1 * c2).sqrt() + epsilon));
            m[i] = m1;
            v[i] = v1;
            g[i] = 0.0f32;
        }
    }
}

/// Condition under which parameters are updated.
#[derive(Clone, Copy)]
pub struct Gate<'a> {
    /// `[1]` or more: number of samples of the step in the first word. Nothing is updated if it
    /// is 0.
    pub count: &'a Buffer,
    /// `[1]`: not 0 once a gradient was not finite. Nothing is updated from then on.
    pub non_finite: &'a Buffer,
}

/// Takes one AdamW step in place; the gradient is left zero. All four buffers are `[n]`.
pub fn adam(device: &Device, [p, m, v]: [&Buffer; 3], g: &Buffer, step: &AdamStep, gate: Gate) {
    assert!([m, v, g].iter().all(|b| b.word_count() == p.word_count()));
    let correction = |beta: f32| (1.0 / (1.0 - (beta as f64).powf(step.step as f64))) as f32;
    launch!(device, adam_kernel::launch, groups(p.word_count().div_ceil(UNITS as usize)), UNITS;
        p, m, v, g, gate.count, gate.non_finite;
        step.lr, step.beta1, step.beta2, step.epsilon, 1.0 - step.lr * step.weight_decay,
        correction(step.beta1), correction(step.beta2), step.skip_zero
    );
}

#[cfg(test)]
mod tests {
    use super::super::testing::{agree, device};
    use super::*;
    use crate::cpu::adam;
    use tiface_base::math::rng;

    #[test]
    fn steps_are_those_of_the_cpu_with_and_without_idle_weights() {
        let Some(device) = device() else { return };
        let n = 1000;
        for skip_zero in [true, false] {
            let mut step = AdamStep {
                lr: 0.01,
                beta1: 0.9,
                beta2: 0.99,
                epsilon: 1e-15,
                weight_decay: 0.02,
                step: 0,
                skip_zero,
            };
            let mut p: Vec<f32> = (0..n).map(|i| rng::normal(1, 1, i)).collect();
            let (mut m, mut v) = (vec![0f32; p.len()], vec![0f32; p.len()]);
            let device_state = [&p, &m, &v].map(|b| device.upload(b));
            for k in 0..5 {
                step.step += 1;
                // in each step a third of the gradients are zero, and the others have very
                // different magnitudes
                let size = |i: u64| 10f32.powi(i as i32 % 12 - 8) * rng::normal(2, k, i);
                let mut g: Vec<f32> = (0..n).map(|i| if (i + k) % 3 == 0 { 0.0 } else { size(i) }).collect();
                let device_g = device.upload(&g);
                let [device_p, device_m, device_v] = &device_state;
                for (count, non_finite) in [(0, 0), (7, 1), (7, 0)] {
                    // nothing is updated without samples, or after a gradient that was not finite
                    let (count, non_finite) =
                        (device.upload::<u32>(&[count]), device.upload::<u32>(&[non_finite]));
                    let gate = Gate { count: &count, non_finite: &non_finite };
                    super::adam(&device, [device_p, device_m, device_v], &device_g, &step, gate);
                }
                adam::adam(&mut p, &mut m, &mut v, &mut g, &step);
                assert_eq!(device.read::<f32>(&device_g), g);
            }
            for (what, (got, want)) in ["p", "m", "v"].iter().zip(device_state.iter().zip([&p, &m, &v])) {
                agree(&format!("adam {what}"), &device.read::<f32>(got), want, 1e-5);
            }
        }
    }
}
