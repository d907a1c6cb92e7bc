//! NeuS compositing of ragged rays, one thread per ray: see [`crate::cpu::neus`].

use super::batch::DeviceBatch;
use super::composite::Composited;
use super::device::{Buffer, Device, Words, groups, launch};
use super::march::Samples;
use super::sum::group_sum;
use super::vec3::Vec3;
use crate::cpu::march::COLORLESS;
use crate::cpu::neus::{ColorRule, MIN_GRADIENT_NORM};
use crate::cpu::sdf::WIDTH;
use burn::cubecl::{self, prelude::*};

const UNITS: u32 = 64;

pub use crate::cpu::neus::RAY_WIDTH;

/// ε in the formula of the opacity.
const EPSILON: f32 = 1e-5;

/// Opacity of one sample, with the intermediate values that its derivative needs.
#[derive(CubeType)]
struct Sample {
    alpha: f32,
    clipped: bool,
    previous: Sigmoid,
    next: Sigmoid,
    half: f32,
    ic_by_cos: f32,
    sharp: f32,
    normal: Vec3,
    length: f32,
}

/// A sigmoid and its complement, each without cancellation.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Sigmoid {
    value: f32,
    complement: f32,
}

#[cube]
impl Sigmoid {
    /// Returns the sigmoid of a value.
    fn new(v: f32) -> Sigmoid {
        let e = (-v.abs()).exp();
        let large = 1.0f32 / (1.0f32 + e);
        let small = e * large;
        Sigmoid { value: select(v < 0.0f32, small, large), complement: select(v < 0.0f32, large, small) }
    }

    /// Returns the derivative, σ (1 − σ).
    fn slope(self) -> f32 {
        self.value * self.complement
    }
}

/// Returns the opacity between two sigmoids around `sdf` before it is clipped.
#[cube]
fn between(sdf: f32, previous: Sigmoid, next: Sigmoid) -> f32 {
    // outside the surface the complements are the smaller ones: their difference loses fewer digits
    let difference = select(sdf > 0.0f32, next.complement - previous.complement, previous.value - next.value);
    (difference + EPSILON) / (previous.value + EPSILON)
}

/// Writes the opacity at points of a march step that meets the surface head-on, `[capacity]`: see
/// [`neus::occupancy`](crate::cpu::neus::occupancy).
#[cube(launch)]
fn opacities(field: &[f32], inv_s: &[f32], count: &[u32], out: &mut [f32], step: f32) {
    let s = ABSOLUTE_POS;
    if s < count[0] as usize {
        let sharp = clamp(inv_s[0] * field[7 * out.len() + s].exp(), 1e-6f32, 1e6f32);
        // head-on the signed distance decreases along the ray
        let previous = Sigmoid::new((field[s] + 0.5f32 * step) * sharp);
        let next = Sigmoid::new((field[s] - 0.5f32 * step) * sharp);
        out[s] = clamp(between(field[s], previous, next), 0.0f32, 1.0f32);
    }
}

/// Evaluates sample `s` of a ray in a direction.
#[cube]
fn sample(
    field: &[f32],
    plane: usize,
    s: usize,
    dt: f32,
    direction: Vec3,
    inv_s: f32,
    anneal: f32,
) -> Sample {
    let gradient = Vec3::read(field, plane, plane + s);
    let length = max(gradient.length(), 1e-12f32);
    let normal = gradient / length;
    let cos = direction.dot(normal);
    let (soft, hard) = (0.5f32 - 0.5f32 * cos, -cos);
    let ic = -(max(soft, 0.0f32) * (1.0f32 - anneal) + max(hard, 0.0f32) * anneal);
    let by_soft = select(soft > 0.0f32, 0.5f32 * (1.0f32 - anneal), 0.0f32);
    let by_hard = select(hard > 0.0f32, anneal, 0.0f32);
    let sharp = clamp(inv_s * field[7 * plane + s].exp(), 1e-6f32, 1e6f32);
    let half = 0.5f32 * ic * dt;
    let previous = Sigmoid::new((field[s] - half) * sharp);
    let next = Sigmoid::new((field[s] + half) * sharp);
    let raw = between(field[s], previous, next);
    let alpha = clamp(raw, 0.0f32, 1.0f32);
    Sample {
        alpha,
        clipped: raw != alpha,
        previous,
        next,
        half,
        ic_by_cos: by_soft + by_hard,
        sharp,
        normal,
        length,
    }
}

/// Gives the samples of a range that have a color the color of sample `from`.
#[cube]
fn give(sources: &mut [u32], start: usize, end: usize, from: usize) {
    for s in start..end {
        if sources[s] != COLORLESS {
            sources[s] = from as u32;
        }
    }
}

/// Composites rays, and writes the transmittance at each sample to `light` and the sample whose
/// color it takes to `sources`.
#[cube(launch)]
fn forward(
    offsets: &[u32],
    direction: &[f32],
    t: &[f32],
    dt: &[f32],
    field: &[f32],
    inv_s: &[f32],
    out: &mut [f32],
    light: &mut [f32],
    sources: &mut [u32],
    anneal: f32,
    min_weight: f32,
    group_weight: f32,
) {
    let rays = direction.len() / 3;
    let plane = t.len();
    let r = ABSOLUTE_POS;
    if r < rays {
        let inv_s = clamp(inv_s[0], 1e-6f32, 1e6f32);
        let d = Vec3::read(direction, rays, r);
        let mut transmittance = 1.0f32;
        let mut sums = Composited::empty();
        let mut normal = Vec3::zero();
        let mut squares = 0.0f32;
        let (begin, end) = (offsets[r] as usize, offsets[r + 1] as usize);
        // of the samples since `start`: their weight, and the heaviest with its own
        let mut start = begin;
        let mut group = 0.0f32;
        let mut heaviest = begin;
        let mut most = 0.0f32;
        // the color of the last group that was full
        let mut before = end;
        for s in begin..end {
            let a = sample(field, plane, s, dt[s], d, inv_s, anneal);
            let w = transmittance * a.alpha;
            sources[s] = COLORLESS;
            if w > min_weight {
                sources[s] = s as u32;
                group += w;
                if w > most {
                    most = w;
                    heaviest = s;
                }
                if group >= group_weight {
                    give(sources, start, s + 1, heaviest);
                    let color = Vec3::read(field, plane, 4 * plane + heaviest);
                    sums.rgb.add_weighted(group, color);
                    squares += group * color.dot(color);
                    start = s + 1;
                    group = 0.0f32;
                    most = 0.0f32;
                    before = heaviest;
                }
            }
            sums.add(w, t[s]);
            normal.add_weighted(w, a.normal);
            light[s] = transmittance;
            transmittance *= 1.0f32 - a.alpha;
        }
        if group > 0.0f32 {
            // what is left takes the color before it
            heaviest = select(before < end, before, heaviest);
            give(sources, start, end, heaviest);
            let color = Vec3::read(field, plane, 4 * plane + heaviest);
            sums.rgb.add_weighted(group, color);
            squares += group * color.dot(color);
        }
        sums.write(out, rays, r);
        normal.write(out, rays, 5 * rays + r);
        out[8 * rays + r] = squares;
    }
}

/// Writes the gradients with respect to the field's output, and the contribution of each ray to
/// that with respect to `ln inv_s`.
#[cube(launch)]
fn backward(
    offsets: &[u32],
    direction: &[f32],
    t: &[f32],
    dt: &[f32],
    field: &[f32],
    inv_s: &[f32],
    light: &[f32],
    sources: &[u32],
    g_out: &[f32],
    g_field: &mut [f32],
    g_ln: &mut [f32],
    anneal: f32,
) {
    let rays = direction.len() / 3;
    let plane = t.len();
    let r = ABSOLUTE_POS;
    if r < rays {
        let inv_s = clamp(inv_s[0], 1e-6f32, 1e6f32);
        let d = Vec3::read(direction, rays, r);
        let g_rgb = Vec3::read(g_out, rays, r);
        let (g_opacity, g_depth) = (g_out[3 * rays + r], g_out[4 * rays + r]);
        let g_normal = Vec3::read(g_out, rays, 5 * rays + r);
        let g_squares = g_out[8 * rays + r];
        let (begin, end) = (offsets[r] as usize, offsets[r + 1] as usize);
        for s in begin..end {
            Vec3::zero().write(g_field, plane, 4 * plane + s);
        }
        let mut farther = 0.0f32; // Σ_{j>k} w_j g_w_j
        let mut sum = 0.0f32;
        for k in 0..end - begin {
            let s = end - 1 - k;
            let a = sample(field, plane, s, dt[s], d, inv_s, anneal);
            let transmittance = light[s];
            let w = transmittance * a.alpha;
            let mut color = Vec3::zero();
            if sources[s] != COLORLESS {
                let from = 4 * plane + sources[s] as usize;
                color = Vec3::read(field, plane, from);
                let by_color = (g_rgb + color * (2.0f32 * g_squares)) * w;
                g_field[from] += by_color.x;
                g_field[plane + from] += by_color.y;
                g_field[2 * plane + from] += by_color.z;
            }
            // from left to right, without brackets around the dot product of the normals
            let g_w = g_rgb.dot(color)
                + g_squares * color.dot(color)
                + g_opacity
                + g_depth * t[s]
                + g_normal.x * a.normal.x
                + g_normal.y * a.normal.y
                + g_normal.z * a.normal.z;
            let g_alpha = transmittance * g_w - farther / max(1.0f32 - a.alpha, 1e-10f32);
            farther += w * g_w;
            // the gradient by the unit normal has two parts: as composited, and through the cosine
            let mut g_cos = 0.0f32;
            let mut g_sdf = 0.0f32;
            let mut ln = 0.0f32;
            if !a.clipped {
                let d = a.previous.value + EPSILON;
                // α = (P − N + ε)/(P + ε): ∂P = N/(P+ε)², ∂N = −1/(P+ε)
                let g_p = g_alpha * a.next.value / (d * d) * a.previous.slope();
                let g_q = -g_alpha / d * a.next.slope();
                g_sdf = (g_p + g_q) * a.sharp;
                ln = (g_p * (field[s] - a.half) + g_q * (field[s] + a.half)) * a.sharp;
                g_cos = (g_q - g_p) * a.sharp * 0.5f32 * dt[s] * a.ic_by_cos;
            }
            g_field[s] = g_sdf;
            g_field[7 * plane + s] = ln;
            sum += ln;
            let by_normal = g_normal * w + d * g_cos;
            let radial = a.normal.dot(by_normal);
            let share = select(a.length > MIN_GRADIENT_NORM, 1.0f32 / a.length, 0.0f32);
            ((by_normal - a.normal * radial) * share).write(g_field, plane, plane + s);
        }
        g_ln[r] = sum;
    }
}

/// Sums the rays' gradients with respect to `ln inv_s` in a fixed order, and writes the gradient
/// with respect to `inv_s`; it is zero if `inv_s` was clamped.
#[cube(launch)]
fn sharpness(g_ln: &[f32], inv_s: &[f32], g_inv_s: &mut [f32]) {
    let unit = UNIT_POS as usize;
    let mut sum = 0.0f32;
    for r in range_stepped(unit, g_ln.len(), UNITS as usize) {
        sum += g_ln[r];
    }
    let total = group_sum::<f32>(sum, UNITS as usize);
    if unit == 0 {
        let s = inv_s[0];
        g_inv_s[0] = select(clamp(s, 1e-6f32, 1e6f32) == s, total / s, 0.0f32);
    }
}

/// Buffers of compositing and its gradients.
pub struct Neus {
    /// Which samples have colors.
    colors: ColorRule,
    out: Buffer,
    light: Buffer,
    /// `[capacity]`: the samples that colors are taken from.
    sources: Buffer,
    g_field: Buffer,
    g_ln: Buffer,
}

impl Neus {
    /// Allocates buffers for `rays` rays and up to `capacity` samples, some of which have colors.
    pub fn new(device: &Device, rays: usize, capacity: usize, colors: ColorRule) -> Neus {
        Neus {
            colors,
            out: device.scratch::<f32>(RAY_WIDTH * rays),
            light: device.scratch::<f32>(capacity),
            sources: device.scratch::<u32>(capacity),
            g_field: device.scratch::<f32>(WIDTH * capacity),
            g_ln: device.scratch::<f32>(rays),
        }
    }

    /// Returns the output of the last forward pass, planes `[9, rays]`.
    pub fn output(&self) -> &Buffer {
        &self.out
    }

    /// Returns the opacities, `[capacity]`, of march steps of length `step` that meet the surface
    /// head-on at the first `count` points of a field's output. The next forward pass overwrites
    /// them.
    pub fn opacities(
        &self,
        device: &Device,
        field: &Buffer,
        inv_s: &Buffer,
        count: &Buffer,
        step: f32,
    ) -> &Buffer {
        let out = &self.light;
        launch!(device, opacities::launch, groups(out.word_count().div_ceil(UNITS as usize)), UNITS;
            field, inv_s, count, out; step
        );
        out
    }

    /// Returns the gradients with respect to the field's output of the last backward pass, planes
    /// `[8, capacity]`.
    pub fn gradient(&self) -> &Buffer {
        &self.g_field
    }

    /// Composites the field's output at the samples of rays, planes `[8, capacity]`, and returns
    /// planes `[9, rays]`; inv_s: `[1]`.
    pub fn forward(
        &self,
        device: &Device,
        rays: &DeviceBatch,
        samples: &Samples,
        field: &Buffer,
        inv_s: &Buffer,
        anneal: f32,
    ) -> &Buffer {
        launch!(device, forward::launch, groups(self.g_ln.word_count().div_ceil(UNITS as usize)), UNITS;
            samples.offsets, rays.direction, samples.t, samples.dt, field, inv_s, self.out, self.light,
            self.sources;
            anneal, self.colors.min_weight, self.colors.group_weight
        );
        &self.out
    }

    /// Computes the gradients of the last forward pass. Returns those with respect to the field's
    /// output, planes `[8, capacity]`, which are valid for existing samples only, and writes that
    /// with respect to `inv_s` to `g_inv_s`.
    pub fn backward(
        &self,
        device: &Device,
        rays: &DeviceBatch,
        samples: &Samples,
        field: &Buffer,
        inv_s: &Buffer,
        anneal: f32,
        g_out: &Buffer,
        g_inv_s: &Buffer,
    ) -> &Buffer {
        launch!(device, backward::launch, groups(self.g_ln.word_count().div_ceil(UNITS as usize)), UNITS;
            samples.offsets, rays.direction, samples.t, samples.dt, field, inv_s, self.light,
            self.sources, g_out, self.g_field, self.g_ln;
            anneal
        );
        let one = CubeCount::new_single();
        launch!(device, sharpness::launch, one, UNITS; self.g_ln, inv_s, g_inv_s);
        &self.g_field
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{agree, device, planes};
    use super::*;
    use crate::cpu::neus;
    use tiface_base::math::rng;

    /// Composited values, gradient by the field's output, gradient by `inv_s`.
    type Results = (Vec<f32>, Vec<f32>, f32);

    /// Runs forward and backward pass, and returns the results of the device and of the CPU.
    fn device_and_cpu(
        device: &Device,
        segments: neus::Segments,
        field: &[[f32; WIDTH]],
        inv_s: f32,
        anneal: f32,
        g: &[[f32; RAY_WIDTH]],
    ) -> [Results; 2] {
        let (n, count) = (field.len(), segments.direction.len());
        let device_neus = Neus::new(device, count, n, segments.colors);
        let direction = device.upload(&planes(segments.direction, count));
        let rays = DeviceBatch { direction, ..DeviceBatch::new(device, count) };
        let samples = Samples {
            offsets: device.upload(segments.offsets),
            t: device.upload(segments.t),
            dt: device.upload(segments.dt),
            ..Samples::new(device, count, n)
        };
        let (device_field, device_inv_s) = (device.upload(&planes(field, n)), device.upload(&[inv_s]));
        let composited = device_neus.forward(device, &rays, &samples, &device_field, &device_inv_s, anneal);
        let out = device.read(composited);
        let (g_out, g_s) = (device.upload(&planes(g, count)), device.zeros::<f32>(1));
        let g_field = device.read(device_neus.backward(
            device,
            &rays,
            &samples,
            &device_field,
            &device_inv_s,
            anneal,
            &g_out,
            &g_s,
        ));
        let flat = field.as_flattened();
        let want = neus::forward(segments, flat, inv_s, anneal);
        let (want_field, want_s) = neus::backward(segments, flat, inv_s, anneal, g.as_flattened());
        let [want, want_field] =
            [planes::<RAY_WIDTH>(want.as_chunks().0, count), planes::<WIDTH>(want_field.as_chunks().0, n)];
        [(out, g_field, device.read::<f32>(&g_s)[0]), (want, want_field, want_s)]
    }

    #[test]
    fn rays_and_gradients_are_those_of_the_cpu() {
        let Some(device) = device() else { return };
        // ragged rays, some empty, some through a surface
        let counts: Vec<usize> = (0..200).map(|r| [0, 1, 7, 40, 90][r % 5]).collect();
        let mut offsets = vec![0i32];
        counts.iter().for_each(|&c| offsets.push(offsets.last().unwrap() + c as i32));
        let n = *offsets.last().unwrap() as usize;
        let normal = |stream: u64, i: usize| rng::normal(3, stream, i as u64);
        let direction: Vec<[f32; 3]> = (0..200)
            .map(|r| {
                let v = [0, 1, 2].map(|k| normal(1, 3 * r + k));
                let length = v.iter().map(|c| c * c).sum::<f32>().sqrt();
                v.map(|c| c / length)
            })
            .collect();
        let mut field = Vec::new();
        let mut t = Vec::new();
        for (r, &c) in counts.iter().enumerate() {
            for k in 0..c {
                let i = field.len() * 8;
                let sdf = 0.3 - 0.6 * (k as f32 + 0.5) / c as f32 + 0.01 * normal(2, i);
                // mostly towards the camera
                let along = |a: usize| -direction[r][a] + 0.5 * normal(2, i + 1 + a);
                let color = |a: usize| rng::uniform(3, 4, (i + a) as u64);
                let n = [along(0), along(1), along(2)];
                field.push([sdf, n[0], n[1], n[2], color(0), color(1), color(2), -0.3 * color(3)]);
                t.push(1.0 + 0.01 * k as f32);
            }
        }
        let dt = vec![0.01f32; n];
        let g: Vec<[f32; RAY_WIDTH]> =
            (0..200).map(|r| std::array::from_fn(|k| normal(5, RAY_WIDTH * r + k))).collect();
        for (inv_s, anneal, group_weight) in [(20.0, 0.0, 0.0), (60.0, 0.4, 0.05), (200.0, 1.0, 0.3)] {
            let colors = ColorRule { min_weight: 1e-4, group_weight };
            let segments =
                neus::Segments { offsets: &offsets, direction: &direction, t: &t, dt: &dt, colors };
            let [got, want] = device_and_cpu(&device, segments, &field, inv_s, anneal, &g);
            agree("rays", &got.0, &want.0, 1e-4);
            for k in 0..8 {
                // the gradient by the sdf is a difference of nearly equal numbers, which is no more
                // accurate on the CPU
                let tolerance = if k == 0 { 2e-4 } else { 1e-4 };
                let (got, want) = (&got.1[k * n..][..n], &want.1[k * n..][..n]);
                agree(&format!("gradient by output {k}"), got, want, tolerance);
            }
            agree("gradient by inv_s", &[got.2], &[want.2], 1e-4);
        }
    }

    #[test]
    fn extreme_fields_have_finite_opacities_and_bounded_gradients() {
        let Some(device) = device() else { return };
        // a ray of four samples for each distance and slope
        let mut field = Vec::new();
        for sdf in [0.0, -1e-6, 1.0, -1e3, 1e20] {
            for slope in [0.0, 1e-12, 2e-6, 1.0, 1e6] {
                let sample = |k: usize| [sdf, slope, -0.5 * slope, 0.0, 0.5, 0.5, 0.5, -(k as f32)];
                field.extend((0..4).map(sample));
            }
        }
        let count = field.len() / 4;
        let offsets: Vec<i32> = (0..=count as i32).map(|r| 4 * r).collect();
        let direction = vec![[0.6, 0.0, -0.8]; count];
        let (t, dt) = ([1.0, 1.1, 1.2, 1.3].repeat(count), [1e-9, 0.05, 3.0, 1e3].repeat(count));
        let colors = ColorRule { min_weight: 1e-4, group_weight: 0.05 };
        let segments = neus::Segments { offsets: &offsets, direction: &direction, t: &t, dt: &dt, colors };
        let g = vec![[1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0]; count];
        for inv_s in [0.0, 1e-6, 1.0, 1e6, 1e9] {
            let [(out, g_field, g_s), _] = device_and_cpu(&device, segments, &field, inv_s, 1.0, &g);
            // sample i of all planes
            let of = |values: &[f32], n: usize, i: usize| -> Vec<f32> {
                values.iter().skip(i).step_by(n).copied().collect()
            };
            for r in 0..count {
                let seen = of(&out, count, r);
                let finite = seen.iter().all(|v| v.is_finite() && v.abs() < 2.0);
                assert!(finite, "{inv_s} {:?} {seen:?}", field[4 * r]);
            }
            let bounded = |v: &f32| v.is_finite() && v.abs() < 1e10;
            for (i, sample) in field.iter().enumerate() {
                let slopes = of(&g_field, field.len(), i);
                assert!(slopes.iter().all(bounded), "{inv_s} {sample:?} {slopes:?}");
            }
            assert!(bounded(&g_s), "{inv_s} {g_s}");
        }
    }
}
