//! The training loss of the signed-distance field and its gradients: see [`crate::cpu::losses`].

use super::batch::DeviceBatch;
use super::device::{Buffer, Device, Words, groups, launch};
use super::sum::group_sum;
use super::vec3::Vec3;
use crate::cpu::losses::{LossWeights, RAY_TERMS, SAMPLE_TERMS, TERMS};
use crate::cpu::neus::RAY_WIDTH;
use burn::cubecl::{self, prelude::*};

const UNITS: u32 = 256;

/// Number of words of [`tally`].
pub(super) const TALLY: usize = 5;

/// Offsets in the words of a tally: rays; rays with samples; rays whose pixel is entirely head;
/// rays whose pixel is background; the last ray with samples, counted from 1.
pub(super) const HIT: usize = 1;
const HEAD: usize = 2;
pub(super) const BACKGROUND: usize = 3;
pub(super) const LAST: usize = 4;

/// Counts rays. Runs as one group of threads. Without `sampled`, `offsets` is not read and no ray
/// counts as one with samples.
#[cube(launch)]
pub(super) fn tally(
    offsets: &[u32],
    alpha: &[f32],
    alive: &[u32],
    out: &mut [u32],
    #[comptime] sampled: bool,
) {
    let unit = UNIT_POS as usize;
    let mut rays = 0u32;
    let mut hit_rays = 0u32;
    let mut head_rays = 0u32;
    let mut background_rays = 0u32;
    let mut last = 0u32;
    for r in range_stepped(unit, alpha.len(), UNITS as usize) {
        rays += alive[r];
        head_rays += select(alpha[r] > 0.999f32, alive[r], 0u32);
        background_rays += select(alpha[r] == 0.0f32, alive[r], 0u32);
        if sampled && offsets[r + 1] > offsets[r] {
            hit_rays += 1;
            last = u32::cast_from(r) + 1;
        }
    }
    let mut lasts = Shared::<[u32]>::new_slice(UNITS as usize);
    lasts[unit] = last;
    let rays = group_sum::<u32>(rays, UNITS as usize);
    let hit_rays = group_sum::<u32>(hit_rays, UNITS as usize);
    let head_rays = group_sum::<u32>(head_rays, UNITS as usize);
    let background_rays = group_sum::<u32>(background_rays, UNITS as usize);
    if unit == 0 {
        for i in 1..UNITS as usize {
            last = max(last, lasts[i]);
        }
        out[0] = rays;
        out[HIT] = hit_rays;
        out[HEAD] = head_rays;
        out[BACKGROUND] = background_rays;
        out[LAST] = last;
    }
}

/// A loss term of a ray, and the derivative of the weighted term with respect to the opacity.
#[derive(CubeType, Clone, Copy)]
pub(super) struct OpacityTerm {
    pub value: f32,
    pub slope: f32,
}

/// Returns the binary cross entropy of an opacity with its target, times the ray's share in the
/// mean.
#[cube]
pub(super) fn cross_entropy(opacity: f32, target: f32, share: f32, weight: f32) -> OpacityTerm {
    let p = clamp(opacity, 1e-3f32, 1.0f32 - 1e-3f32);
    let value = -(target * p.ln() + (1.0f32 - target) * (1.0f32 - p).ln()) * share;
    let by_p = ((1.0f32 - target) / (1.0f32 - p) - target / p) * share * weight;
    OpacityTerm { value, slope: select(p == opacity, by_p, 0.0f32) }
}

/// Writes the loss terms of rays, planes `[3, rays]`, and the gradients with respect to the
/// composited values, planes `[9, rays]`.
#[cube(launch)]
fn of_rays(
    composed: &[f32],
    color: &[f32],
    alpha: &[f32],
    background: &[f32],
    alive: &[u32],
    offsets: &[u32],
    tally: &[u32],
    g_out: &mut [f32],
    terms: &mut [f32],
    rgb_mse: f32,
    rgb_sample: f32,
    mask: f32,
) {
    let rays = alpha.len();
    let r = ABSOLUTE_POS;
    if r < rays {
        let (opacity, a) = (composed[3 * rays + r], alpha[r]);
        let is_alive = f32::cast_from(alive[r]);
        let is_hit = select(offsets[r + 1] > offsets[r], 1.0f32, 0.0f32);
        let share = is_hit / (3.0f32 * max(f32::cast_from(tally[HIT]), 1.0f32));
        let head =
            select(a > 0.999f32, is_alive, 0.0f32) / (3.0f32 * max(f32::cast_from(tally[HEAD]), 1.0f32));
        let mut square = 0.0f32;
        let mut sample_error = composed[8 * rays + r];
        let mut g_opacity = 0.0f32;
        for c in 0..3usize {
            let (h, b, composited) = (color[c * rays + r], background[c * rays + r], composed[c * rays + r]);
            let e = composited + (1.0f32 - opacity) * b - (h + (1.0f32 - a) * b);
            square += e * e;
            sample_error += h * h * opacity - 2.0f32 * h * composited;
            let g = 2.0f32 * e * rgb_mse * share;
            g_out[c * rays + r] = g - 2.0f32 * h * rgb_sample * head;
            g_opacity += h * h * rgb_sample * head - b * g;
        }
        let ray_share = is_alive / max(f32::cast_from(tally[0]), 1.0f32);
        let entropy = cross_entropy(opacity, a, ray_share, mask);
        g_out[3 * rays + r] = g_opacity + entropy.slope;
        for k in 4..8usize {
            g_out[k * rays + r] = 0.0f32;
        }
        g_out[8 * rays + r] = rgb_sample * head;
        terms[r] = square * share;
        terms[rays + r] = sample_error * head;
        terms[2 * rays + r] = entropy.value;
    }
}

/// Writes the loss terms of samples, planes `[2, capacity]`, and adds their gradients with respect
/// to the field's output.
#[cube(launch)]
fn of_samples(
    field: &[f32],
    count: &[u32],
    g_field: &mut [f32],
    terms: &mut [f32],
    eikonal: f32,
    sparsity: f32,
    scale: f32,
) {
    let plane = terms.len() / SAMPLE_TERMS;
    let s = ABSOLUTE_POS;
    if s < count[0] as usize {
        let share = 1.0f32 / f32::cast_from(count[0]);
        let f = field[s];
        let gradient = Vec3::read(field, plane, plane + s);
        let length = (gradient.dot(gradient) + 1e-12f32).sqrt();
        let excess = length - 1.0f32;
        let g = 2.0f32 * excess / length * share * eikonal;
        g_field[plane + s] += g * gradient.x;
        g_field[2 * plane + s] += g * gradient.y;
        g_field[3 * plane + s] += g * gradient.z;
        let closeness = (-scale * f.abs()).exp() * share;
        let sign = select(f > 0.0f32, 1.0f32, select(f < 0.0f32, -1.0f32, 0.0f32));
        g_field[s] -= scale * sign * closeness * sparsity;
        terms[s] = excess * excess * share;
        terms[plane + s] = closeness;
    }
}

/// Sums the loss terms in a fixed order, one group of threads per term. Also adds the squared error
/// of a step with samples to a sum over steps, and counts such steps. `count` is the number of rows
/// of `of_samples`, `met` that of samples of the step.
#[cube(launch)]
pub(super) fn sum(
    of_rays: &[f32],
    of_samples: &[f32],
    of_points: &[f32],
    count: &[u32],
    met: &[u32],
    out: &mut [f32],
) {
    let unit = UNIT_POS as usize;
    let term = CUBE_POS_X as usize;
    let mut sum = 0.0f32;
    if term < RAY_TERMS {
        let rays = of_rays.len() / RAY_TERMS;
        for r in range_stepped(unit, rays, UNITS as usize) {
            sum += of_rays[term * rays + r];
        }
    } else if term == RAY_TERMS + SAMPLE_TERMS {
        for p in range_stepped(unit, of_points.len(), UNITS as usize) {
            sum += of_points[p];
        }
    } else {
        let plane = of_samples.len() / SAMPLE_TERMS;
        for s in range_stepped(unit, count[0] as usize, UNITS as usize) {
            sum += of_samples[(term - RAY_TERMS) * plane + s];
        }
    }
    let total = group_sum::<f32>(sum, UNITS as usize);
    if unit == 0 {
        out[term] = total;
        if term == 0 && met[0] > 0 {
            out[TERMS] += total;
            out[TERMS + 1] += 1.0f32;
        }
    }
}

/// The losses of a batch of rays and their samples, with the buffers for them.
pub struct Losses {
    weights: LossWeights,
    tally: Buffer,
    g_out: Buffer,
    ray_terms: Buffer,
    sample_terms: Buffer,
    sums: Buffer,
}

impl Losses {
    /// Allocates buffers for `rays` rays and up to `capacity` samples.
    pub fn new(device: &Device, weights: LossWeights, rays: usize, capacity: usize) -> Losses {
        Losses {
            weights,
            tally: device.scratch::<u32>(TALLY),
            g_out: device.scratch::<f32>(RAY_WIDTH * rays),
            ray_terms: device.scratch::<f32>(RAY_TERMS * rays),
            sample_terms: device.scratch::<f32>(SAMPLE_TERMS * capacity),
            sums: device.zeros::<f32>(TERMS + 2),
        }
    }

    /// Computes the losses of rays, and returns the gradients with respect to the output of
    /// [`Neus::forward`](super::Neus::forward), planes `[9, rays]`. offsets: `[rays + 1]`.
    pub fn of_rays(
        &self,
        device: &Device,
        composed: &Buffer,
        batch: &DeviceBatch,
        offsets: &Buffer,
    ) -> &Buffer {
        let w = &self.weights;
        let DeviceBatch { color, alpha, background, alive, .. } = batch;
        let tally = &self.tally;
        let one = CubeCount::new_single();
        launch!(device, tally::launch, one, UNITS; offsets, alpha, alive, tally; true);
        launch!(device, of_rays::launch, groups(alpha.word_count().div_ceil(UNITS as usize)), UNITS;
            composed, color, alpha, background, alive, offsets, tally, self.g_out, self.ray_terms;
            w.rgb_mse, w.rgb_sample, w.mask
        );
        &self.g_out
    }

    /// Computes the losses of samples, and adds their gradients with respect to the field's output
    /// to `g_field`, planes `[8, capacity]`.
    pub fn of_samples(&self, device: &Device, field: &Buffer, count: &Buffer, g_field: &Buffer) {
        let w = &self.weights;
        let capacity = self.sample_terms.word_count() / SAMPLE_TERMS;
        launch!(device, of_samples::launch, groups(capacity.div_ceil(UNITS as usize)), UNITS;
            field, count, g_field, self.sample_terms; w.eikonal, w.sparsity, w.sparsity_scale
        );
    }

    /// Sums the loss terms of a step: see [`sums`](Losses::sums).
    pub fn add(&self, device: &Device, count: &Buffer, of_points: &Buffer) {
        launch!(device, sum::launch, CubeCount::new_1d(TERMS as u32), UNITS;
            self.ray_terms, self.sample_terms, of_points, count, count, self.sums
        );
    }

    /// Returns the sums, `[8]`: the unweighted loss terms of the last step in the order of
    /// [`LossWeights`], with that of stereo points last; then the sum of the squared errors of all
    /// steps with samples since [`reset_sums`](Losses::reset_sums), and the number of these steps.
    pub fn sums(&self) -> &Buffer {
        &self.sums
    }

    /// Resets the squared errors that are summed over steps.
    pub fn reset_sums(&mut self, device: &Device) {
        self.sums = device.zeros::<f32>(TERMS + 2);
    }
}

#[cfg(test)]
mod tests {
    use super::super::march::Samples;
    use super::super::neus::Neus;
    use super::super::testing::{agree, device, planes};
    use super::*;
    use crate::cpu::neus::ColorRule;
    use tiface_base::math::rng;

    const WEIGHTS: LossWeights = LossWeights {
        rgb_mse: 10.0,
        rgb_sample: 3.0,
        mask: 0.5,
        eikonal: 0.2,
        sparsity: 0.3,
        sparsity_scale: 4.0,
        stereo: 0.0,
        knee: 0.0,
    };
    const ANNEAL: f64 = 0.4;
    const STEP: f64 = 0.05;

    struct Case {
        offsets: Vec<u32>,
        direction: Vec<[f32; 3]>,
        color: Vec<[f32; 3]>,
        alpha: Vec<f32>,
        background: Vec<[f32; 3]>,
        field: Vec<[f32; 8]>,
    }

    /// Returns five rays, one of them without samples, whose pixels are head, background and partly
    /// head.
    fn case() -> Case {
        let uniform = |stream: u64, i: usize| rng::uniform(9, stream, i as u64);
        let rows =
            |stream: u64| (0..5).map(|r| std::array::from_fn(|c| uniform(stream, 3 * r + c))).collect();
        let alpha = vec![1.0, 0.0, 0.3, 1.0, 1.0];
        let over_black = |r: usize| std::array::from_fn(|c| alpha[r] * uniform(2, 3 * r + c));
        let sample = |i: usize| -> [f32; 8] {
            let slope = [0, 1, 2].map(|c| 0.7 * rng::normal(9, 3, (3 * i + c) as u64));
            let color = [0, 1, 2].map(|c| uniform(4, 3 * i + c));
            let f = 0.15 - 0.06 * (i % 7) as f32 + 0.013;
            [f, slope[0], slope[1], slope[2] + 0.5, color[0], color[1], color[2], -0.2 * uniform(5, i)]
        };
        Case {
            offsets: vec![0, 6, 12, 12, 17, 24, 24],
            direction: vec![
                [0.6, 0.0, -0.8],
                [0.0, 0.0, 1.0],
                [1.0, 0.0, 0.0],
                [0.36, -0.48, 0.8],
                [0.0, 0.6, -0.8],
            ],
            color: (0..5).map(over_black).collect(),
            background: rows(6),
            field: (0..24).map(sample).collect(),
            alpha,
        }
    }

    /// Returns the loss terms in f64, and their weighted sum.
    fn terms(case: &Case, field: &[f64], inv_s: f64) -> ([f64; 5], f64) {
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        let mut t = [0f64; 5];
        let (met, heads, n) = (4.0, 3.0, 24.0);
        for r in 0..5 {
            let mut transmittance = 1.0;
            let (mut composited, mut opacity, mut sample_error) = ([0f64; 3], 0.0, 0.0);
            let h = case.color[r].map(f64::from);
            for s in case.offsets[r] as usize..case.offsets[r + 1] as usize {
                let f = &field[s * 8..][..8];
                let length = (f[1] * f[1] + f[2] * f[2] + f[3] * f[3]).sqrt();
                let cos = (0..3).map(|c| case.direction[r][c] as f64 * f[1 + c] / length).sum::<f64>();
                let ic = -((0.5 - 0.5 * cos).max(0.0) * (1.0 - ANNEAL) + (-cos).max(0.0) * ANNEAL);
                let (half, sharp) = (0.5 * ic * STEP, inv_s * f[7].exp());
                let (p, q) = (sigmoid((f[0] - half) * sharp), sigmoid((f[0] + half) * sharp));
                let alpha = ((p - q + 1e-5) / (p + 1e-5)).clamp(0.0, 1.0);
                let w = transmittance * alpha;
                (0..3).for_each(|c| composited[c] += w * f[4 + c]);
                sample_error += w * (0..3).map(|c| (f[4 + c] - h[c]).powi(2)).sum::<f64>();
                opacity += w;
                transmittance *= 1.0 - alpha;
                t[3] += (length - 1.0).powi(2) / n;
                t[4] += (-WEIGHTS.sparsity_scale as f64 * f[0].abs()).exp() / n;
            }
            let a = case.alpha[r] as f64;
            if case.offsets[r + 1] > case.offsets[r] {
                for c in 0..3 {
                    let b = case.background[r][c] as f64;
                    let e = composited[c] + (1.0 - opacity) * b - h[c] - (1.0 - a) * b;
                    t[0] += e * e / (3.0 * met);
                }
            }
            if a == 1.0 {
                t[1] += sample_error / (3.0 * heads);
            }
            let p = opacity.clamp(1e-3, 1.0 - 1e-3);
            t[2] -= (a * p.ln() + (1.0 - a) * (1.0 - p).ln()) / 5.0;
        }
        let w = WEIGHTS;
        let weights = [w.rgb_mse, w.rgb_sample, w.mask, w.eikonal, w.sparsity];
        (t, t.iter().zip(weights).map(|(t, w)| t * w as f64).sum())
    }

    #[test]
    fn losses_and_gradients_agree_with_f64_finite_differences() {
        let Some(device) = device() else { return };
        let mut case = case();
        // the buffers have capacity for one more ray, which is not alive
        case.direction.push([0.0; 3]);
        case.color.push([9.0; 3]);
        case.background.push([9.0; 3]);
        case.alpha.push(1.0);
        let inv_s = 30f32;
        let up = |v: &[f32]| device.upload(v);
        let samples = Samples {
            offsets: device.upload(&case.offsets),
            t: up(&[1.0; 24]),
            dt: up(&[STEP as f32; 24]),
            ..Samples::new(&device, 6, 24)
        };
        let (field, sharp) = (up(&planes(&case.field, 24)), up(&[inv_s]));
        let batch = DeviceBatch {
            direction: up(&planes(&case.direction, 6)),
            color: up(&planes(&case.color, 6)),
            background: up(&planes(&case.background, 6)),
            alpha: up(&case.alpha),
            alive: device.upload(&[1u32, 1, 1, 1, 1, 0]),
            ..DeviceBatch::new(&device, 6)
        };
        let colors = ColorRule { min_weight: 1e-4, group_weight: 0.0 };
        let (neus, losses) = (Neus::new(&device, 6, 24, colors), Losses::new(&device, WEIGHTS, 6, 24));
        let (count, g_s) = (device.upload(&[24u32]), device.zeros::<f32>(1));
        let composed = neus.forward(&device, &batch, &samples, &field, &sharp, ANNEAL as f32);
        let g_out = losses.of_rays(&device, composed, &batch, &samples.offsets);
        let g_field = neus.backward(&device, &batch, &samples, &field, &sharp, ANNEAL as f32, g_out, &g_s);
        losses.of_samples(&device, &field, &count, g_field);
        (0..2).for_each(|_| losses.add(&device, &count, &up(&[0.25, 0.5])));
        let sums = losses.sums();
        let (launches, readbacks) = device.counts();
        println!(
            "{launches} launches and {readbacks} readbacks of compositing and losses, forward and backward"
        );

        let wide: Vec<f64> = case.field.as_flattened().iter().map(|&v| v as f64).collect();
        let mut want = terms(&case, &wide, inv_s as f64).0.map(|t| t as f32).to_vec();
        want.push(0.75);
        // two steps with samples
        want.extend([2.0 * want[0], 2.0]);
        agree("losses", &device.read::<f32>(sums), &want, 1e-5);
        let at = |i: usize, h: f64| {
            let mut f = wide.clone();
            f[i] += h;
            terms(&case, &f, inv_s as f64).1
        };
        let slopes: Vec<f32> = (0..192).map(|i| ((at(i, 1e-6) - at(i, -1e-6)) / 2e-6) as f32).collect();
        agree("gradients", &device.read::<f32>(g_field), &planes::<8>(slopes.as_chunks().0, 24), 1e-4);
        let s = |h: f64| terms(&case, &wide, inv_s as f64 + h).1;
        let slope = ((s(1e-4) - s(-1e-4)) / 2e-4) as f32;
        agree("gradient by inv_s", &device.read::<f32>(&g_s), &[slope], 1e-4);
    }
}
