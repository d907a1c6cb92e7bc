//! Conversion of features to weights, and compositing, with one thread per ray: see `render` of
//! [`crate::cpu::vm`], whose module has the formulas.

use super::super::composite::Composited;
use super::super::device::{Buffer, Device, Words, groups, launch};
use super::super::march::prefix_sum;
use super::super::vec3::Vec3;
use super::march::VmSamples;
use crate::cpu::march::COLORLESS;
use crate::cpu::vm::{RAY_WIDTH, VmField};
use burn::cubecl::{self, prelude::*};

const UNITS: u32 = 64;

#[cube]
fn sigmoid(v: f32) -> f32 {
    1.0f32 / (1.0f32 + (-v).exp())
}

/// Computes the weights of samples up to where a ray's transmittance is used up, and numbers the
/// colors that they share, from 0 on each ray.
#[cube(launch)]
fn compute_weights(
    offsets: &[u32],
    feature: &[f32],
    alpha: &mut [f32],
    light: &mut [f32],
    color_of: &mut [u32],
    ends: &mut [u32],
    counts: &mut [u32],
    shift: f32,
    length: f32,
    threshold: f32,
    group_weight: f32,
    stop: f32,
    #[comptime] softplus: bool,
) {
    let r = ABSOLUTE_POS;
    if r < ends.len() {
        let mut transmittance = 1.0f32;
        let mut colors = 0u32;
        let mut group = 0.0f32; // weight of the samples whose color is not counted yet
        let mut waiting = 0u32; // whether there are any
        let mut s = offsets[r] as usize;
        let end = offsets[r + 1] as usize;
        let mut marching = s < end;
        while marching {
            let x = feature[s] + shift;
            let density = if softplus {
                max(x, 0.0f32) + (1.0f32 + (-x.abs()).exp()).ln()
            } else {
                max(feature[s], 0.0f32)
            };
            let a = 1.0f32 - (-density * length).exp();
            let w = a * transmittance;
            alpha[s] = a;
            light[s] = transmittance;
            let has_color = w > threshold;
            color_of[s] = select(has_color, colors, COLORLESS);
            group += select(has_color, w, 0.0f32);
            let full = has_color && group >= group_weight;
            colors += select(full, 1u32, 0u32);
            group = select(full, 0.0f32, group);
            waiting = select(full, 0u32, select(has_color, 1u32, waiting));
            transmittance *= 1.0f32 - a + 1e-10f32;
            s += 1;
            let dark = a > 0.0f32 && transmittance <= stop;
            marching = s < end && !dark;
        }
        ends[r] = s as u32;
        counts[r] = max(colors, waiting);
    }
}

/// Lists the samples at which colors are decoded: the last of each group. Numbers the colors in the
/// order of that list; what is left at the end of a ray takes the color before it.
#[cube(launch)]
fn list(offsets: &[u32], ends: &[u32], color_of: &mut [u32], firsts: &[u32], index: &mut [u32]) {
    let r = ABSOLUTE_POS;
    if r < ends.len() {
        let (first, end) = (firsts[r], firsts[r + 1]);
        for s in (offsets[r] as usize)..(ends[r] as usize) {
            let color = color_of[s];
            if color != COLORLESS {
                if first + color < end {
                    index[(first + color) as usize] = s as u32;
                }
                color_of[s] = min(first + color, end - 1);
            }
        }
    }
}

/// Composites the colors of samples along rays.
#[cube(launch)]
fn composite(
    offsets: &[u32],
    ends: &[u32],
    t: &[f32],
    alpha: &[f32],
    light: &[f32],
    color_of: &[u32],
    rgb: &[f32],
    out: &mut [f32],
) {
    let r = ABSOLUTE_POS;
    let rays = ends.len();
    if r < rays {
        let plane = rgb.len() / 3;
        let mut sums = Composited::empty();
        for s in (offsets[r] as usize)..(ends[r] as usize) {
            let w = alpha[s] * light[s];
            let color = color_of[s];
            if color != COLORLESS {
                sums.rgb.add_weighted(w, Vec3::read(rgb, plane, color as usize));
            }
            sums.add(w, t[s]);
        }
        sums.write(out, rays, r);
    }
}

/// Writes the gradients with respect to features, and with respect to the inputs of the colors'
/// sigmoids.
#[cube(launch)]
fn backward(
    offsets: &[u32],
    ends: &[u32],
    t: &[f32],
    feature: &[f32],
    alpha: &[f32],
    light: &[f32],
    color_of: &[u32],
    rgb: &[f32],
    g_out: &[f32],
    g_feature: &mut [f32],
    g_pre: &mut [f32],
    shift: f32,
    length: f32,
    #[comptime] softplus: bool,
) {
    let r = ABSOLUTE_POS;
    let rays = ends.len();
    if r < rays {
        let plane = rgb.len() / 3;
        let g_color = Vec3::read(g_out, rays, r);
        let (g_opacity, g_depth) = (g_out[3 * rays + r], g_out[4 * rays + r]);
        let (begin, end) = (offsets[r] as usize, ends[r] as usize);
        for s in end..(offsets[r + 1] as usize) {
            g_feature[s] = 0.0f32;
        }
        let mut of_group = Vec3::zero(); // gradient with respect to the color of the group
        let mut group = color_of.len() as u32; // the index of no color
        let mut farther = 0.0f32; // Σ_{j>k} w_j dL/dw_j
        for k in 0..end - begin {
            let s = end - 1 - k;
            let w = alpha[s] * light[s];
            let mut g_w = g_opacity + g_depth * t[s];
            let color = color_of[s];
            if color != COLORLESS {
                let c = Vec3::read(rgb, plane, color as usize);
                g_w += g_color.dot(c);
                let same = color == group;
                group = color;
                of_group.x = select(same, of_group.x, 0.0f32) + w * g_color.x;
                of_group.y = select(same, of_group.y, 0.0f32) + w * g_color.y;
                of_group.z = select(same, of_group.z, 0.0f32) + w * g_color.z;
                // the derivative of a sigmoid with value c is c (1 − c)
                let x = of_group.x * c.x * (1.0f32 - c.x);
                let y = of_group.y * c.y * (1.0f32 - c.y);
                let z = of_group.z * c.z * (1.0f32 - c.z);
                Vec3::new(x, y, z).write(g_pre, plane, color as usize);
            }
            let open = 1.0f32 - alpha[s];
            let g_alpha = light[s] * g_w - farther / (open + 1e-10f32);
            // dα/dσ = (1 − α) δ s
            let mut slope = select(feature[s] > 0.0f32, 1.0f32, 0.0f32);
            if softplus {
                slope = sigmoid(feature[s] + shift);
            }
            g_feature[s] = g_alpha * open * length * slope;
            farther += w * g_w;
        }
    }
}

/// Values of samples along the rays of a batch, and the composited rays.
pub struct CompositedRays {
    /// `[capacity]`: features of samples.
    pub feature: Buffer,
    /// `[capacity]`: gradients with respect to features.
    pub g_feature: Buffer,
    /// `[2]`: number of decoded colors, in both words.
    pub count: Buffer,
    /// `[capacity]`: samples at which colors are decoded.
    pub index: Buffer,
    /// Planes `[3, capacity]`: colors of the listed samples.
    pub rgb: Buffer,
    /// Planes `[3, capacity]`: gradients with respect to the inputs of the colors' sigmoids.
    pub g_pre: Buffer,
    /// Planes `[5, rays]`: see [`RAY_WIDTH`].
    pub out: Buffer,
    alpha: Buffer,
    light: Buffer,
    /// `[capacity]`: index of the color of a sample, or [`COLORLESS`].
    color_of: Buffer,
    ends: Buffer,
    counts: Buffer,
    firsts: Buffer,
    shift: f32,
    length: f32,
    threshold: f32,
    group_weight: f32,
    stop: f32,
    softplus: bool,
}

impl CompositedRays {
    /// Memory per sample of a field that is trained, in words.
    pub const WORDS: usize = 12;
    /// Memory per ray, in words: composited values, their gradients and loss terms, offsets,
    /// counts, and the ray itself.
    pub const OF_RAY: usize = 2 * RAY_WIDTH + 24;

    /// Allocates buffers for `rays` rays and up to `capacity` samples of a field; buffers for
    /// gradients only if `learns` is set.
    pub fn new(
        device: &Device,
        field: &VmField,
        rays: usize,
        capacity: usize,
        learns: bool,
    ) -> CompositedRays {
        let s = &field.shading;
        let samples = |planes: usize| device.scratch::<f32>(planes * capacity);
        let gradients = |planes: usize| device.scratch::<f32>(if learns { planes * capacity } else { 1 });
        CompositedRays {
            feature: samples(1),
            g_feature: gradients(1),
            count: device.zeros::<u32>(2),
            index: device.scratch::<u32>(capacity),
            rgb: samples(3),
            g_pre: gradients(3),
            out: device.scratch::<f32>(RAY_WIDTH * rays),
            alpha: samples(1),
            light: samples(1),
            color_of: device.scratch::<u32>(capacity),
            ends: device.scratch::<u32>(rays),
            counts: device.scratch::<u32>(rays),
            firsts: device.scratch::<u32>(rays + 1),
            shift: s.shift,
            length: field.lattice.step * s.distance_scale,
            threshold: s.weight_threshold,
            group_weight: s.group_weight,
            stop: s.stop,
            softplus: s.softplus,
        }
    }

    fn groups(&self) -> CubeCount {
        groups(self.ends.word_count().div_ceil(UNITS as usize))
    }

    /// Computes the weights of samples from their features, and lists the samples at which colors
    /// are decoded.
    pub fn compute_weights(&self, device: &Device, samples: &VmSamples) {
        launch!(device, compute_weights::launch, self.groups(), UNITS;
            samples.offsets, self.feature, self.alpha, self.light, self.color_of, self.ends, self.counts;
            self.shift, self.length, self.threshold, self.group_weight, self.stop, self.softplus
        );
        prefix_sum(device, &self.counts, &self.firsts, &self.count, self.index.word_count());
        launch!(device, list::launch, self.groups(), UNITS;
            samples.offsets, self.ends, self.color_of, self.firsts, self.index
        );
    }

    /// Composites the colors of samples.
    pub fn composite(&self, device: &Device, samples: &VmSamples) {
        launch!(device, composite::launch, self.groups(), UNITS;
            samples.offsets, self.ends, samples.t, self.alpha, self.light, self.color_of, self.rgb,
            self.out
        );
    }

    /// Computes the gradients of samples from those with respect to the composited rays, planes
    /// `[5, rays]`.
    pub fn backward(&self, device: &Device, samples: &VmSamples, g_out: &Buffer) {
        assert!(
            g_out.word_count() == self.out.word_count()
                && self.g_feature.word_count() == self.feature.word_count()
        );
        launch!(device, backward::launch, self.groups(), UNITS;
            samples.offsets, self.ends, samples.t, self.feature, self.alpha, self.light, self.color_of,
            self.rgb, g_out, self.g_feature, self.g_pre;
            self.shift, self.length, self.softplus
        );
    }
}
