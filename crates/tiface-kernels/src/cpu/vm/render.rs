//! Volume rendering of the field, front to back, and its gradients.
//!
//! ```text
//! σ_k = activation(feature(p_k))          α_k = 1 − exp(−σ_k δ s)      δ: step, s: distance scale
//! T_k = Π_{j<k} (1 − α_j + 1e-10)         w_k = T_k α_k
//! C = Σ w_k c_k  over w_k > threshold     opacity = Σ w_k              depth = Σ w_k t_k
//! ```
//!
//! Neighboring samples of a ray may share a color c_k: see [`Shading::group_weight`].
//!
//! A ray is marched, evaluated and composited in one pass, so it can end where its transmittance is
//! used up.

use super::decoder::{self, Decoded, DecoderWeights};
use super::gather::{self, Cell, FactorGradients, Lookup, PlaneGradients};
use super::mask::{BoxMask, Lattice, Walk};
use super::{DecoderShape, Grid};
use crate::cpu::march::{COLORLESS, shift};
use crate::cpu::pool::Buffer;
use crate::cpu::simd::{exp, ln_1p};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use tiface_base::dispatch;
use tiface_base::geom::Ray;

/// Number of values of a rendered ray: rgb over black (3), opacity, Σ w t.
pub const RAY_WIDTH: usize = 5;

/// Conversion of features to densities and weights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shading {
    /// Whether the density is the softplus of `feature + shift`, else the relu of the feature.
    pub softplus: bool,
    /// Offset of the feature, used with softplus only.
    pub shift: f32,
    /// Factor from the length of a step to its optical length.
    pub distance_scale: f32,
    /// Color is evaluated only where the weight is above this.
    pub weight_threshold: f32,
    /// A ray ends where its transmittance is at most this; at 0 it does not end early.
    pub stop: f32,
    /// Neighboring samples of a ray share one color, decoded at the last of them, until their
    /// weights sum to this; what is left at the end of a ray takes the color before it. At 0 each
    /// sample has its own.
    #[serde(default)]
    pub group_weight: f32,
}

impl Shading {
    /// Returns the density of a feature.
    #[inline(always)]
    pub fn density<const F: bool>(&self, feature: f32) -> f32 {
        if self.softplus {
            let x = feature + self.shift;
            x.max(0.0) + ln_1p::<F>(exp::<F>(-x.abs()))
        } else {
            feature.max(0.0)
        }
    }

    #[inline(always)]
    fn slope<const F: bool>(&self, feature: f32) -> f32 {
        if self.softplus {
            crate::cpu::simd::sigmoid::<F>(feature + self.shift)
        } else {
            f32::from(feature > 0.0)
        }
    }
}

/// All properties of a field except its weights.
#[derive(Clone, Debug, PartialEq)]
pub struct VmField {
    /// Planes and lines of the density.
    pub density: Grid,
    /// Planes and lines of the appearance; same size.
    pub color: Grid,
    /// The color decoder.
    pub decoder: DecoderShape,
    /// Box, step and number of samples.
    pub lattice: Lattice,
    /// Conversion of features to weights.
    pub shading: Shading,
    /// Occupied cells; `None` if all of the box is occupied.
    pub mask: Option<BoxMask>,
}

impl VmField {
    #[inline(always)]
    fn cell(&self, p: [f32; 3]) -> Cell {
        let l = &self.lattice;
        let mut unit = [0f32; 3];
        for a in 0..3 {
            unit[a] = (p[a] - l.min[a]) / (l.max[a] - l.min[a]);
        }
        Cell::new(self.density.size, unit)
    }
}

/// A sample that contributes to its ray or its gradient.
#[derive(Clone, Copy, Debug)]
struct KeptSample {
    t: f32,
    feature: f32,
    alpha: f32,
    transmittance: f32,
}

impl KeptSample {
    fn weight(&self) -> f32 {
        self.alpha * self.transmittance
    }
}

/// A rendered batch of rays, with the intermediate values that its backward pass needs.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// `[rays, 5]`: see [`RAY_WIDTH`].
    pub out: Vec<f32>,
    /// Number of samples whose density was evaluated.
    pub density_samples: u64,
    /// Number of samples whose color was decoded.
    pub color_samples: u64,
    /// The samples of each task's rays.
    marched: Vec<Marched>,
    /// The colors of all tasks, one after the other.
    decoded: Decoded,
}

/// The samples of a task's rays that contribute to a ray or its gradient.
#[derive(Clone, Debug)]
struct Marched {
    kept: Vec<KeptSample>,
    cells: Vec<Cell>,
    /// Whether a backward pass follows.
    keeps_planes: bool,
    /// `[kept, channels]`: interpolated values of the density's planes, if a backward pass follows.
    planes: Vec<f32>,
    /// `[rays + 1]` into `kept`.
    offsets: Vec<u32>,
    /// `[kept]`: index into the colors of the task, or [`COLORLESS`].
    color_of: Vec<u32>,
    /// Samples at which colors are decoded, `[colors of the task]`.
    colored: Vec<u32>,
    /// Number of densities that were looked up.
    looked_up: u64,
}

impl Marched {
    /// Returns, for each ray, the range of its samples.
    fn rays(&self) -> impl DoubleEndedIterator<Item = Range<usize>> {
        self.offsets.windows(2).map(|ends| ends[0] as usize..ends[1] as usize)
    }

    /// Returns the gradients by the features of samples, and adds those by the task's colors `rgb`
    /// to `g_rgb`; `g` is `[rays, 5]`.
    fn gradients(&self, field: &VmField, g: &[f32], rgb: &[[f32; 3]], g_rgb: &mut [[f32; 3]]) -> Vec<f32> {
        let length = field.lattice.step * field.shading.distance_scale;
        let mut g_feature = vec![0f32; self.kept.len()];
        for (g, samples) in g.chunks_exact(RAY_WIDTH).zip(self.rays()) {
            let mut farther = 0f32; // Σ w_j dL/dw_j over the farther samples
            for i in samples.rev() {
                let k = &self.kept[i];
                let w = k.weight();
                let mut g_w = g[3] + g[4] * k.t;
                let color = self.color_of[i] as usize;
                if let (Some(c), Some(g_rgb)) = (rgb.get(color), g_rgb.get_mut(color)) {
                    g_w += g[0] * c[0] + g[1] * c[1] + g[2] * c[2];
                    (0..3).for_each(|channel| g_rgb[channel] += w * g[channel]);
                }
                let open = 1.0 - k.alpha;
                let g_alpha = k.transmittance * g_w - farther / (open + 1e-10);
                // dα/dσ = (1 − α) δ s
                let slope = field.shading.slope::<true>(k.feature);
                g_feature[i] = g_alpha * open * length * slope;
                farther += w * g_w;
            }
        }
        g_feature
    }
}

/// Splits a list that has an element for each color into the parts of the tasks.
fn by_task<'a, T>(marched: &[Marched], mut of_colors: &'a [T]) -> Vec<&'a [T]> {
    let part = |m: &Marched| of_colors.split_off(..m.colored.len()).expect("an element for each color");
    marched.iter().map(part).collect()
}

/// As [`by_task`], for a list to be written.
fn by_task_mut<'a, T>(marched: &[Marched], mut of_colors: &'a mut [T]) -> Vec<&'a mut [T]> {
    let part = |m: &Marched| of_colors.split_off_mut(..m.colored.len()).expect("an element for each color");
    marched.iter().map(part).collect()
}

/// Number of rays per task.
const RAYS: usize = 32;

/// Floats that a cell takes in a [`Buffer`].
const CELL_FLOATS: usize = size_of::<Cell>() / size_of::<f32>();

#[inline(always)]
fn march_body<const F: bool>(
    task: &mut Marched,
    rays: &[Ray],
    jitter: &[f32],
    field: &VmField,
    lookup: &Lookup,
) {
    let s = &field.shading;
    let length = field.lattice.step * s.distance_scale;
    let mut planes = vec![0f32; field.density.channels()];
    for (r, ray) in rays.iter().enumerate() {
        let (origin, direction) = (ray.origin.to_array(), ray.direction.to_array());
        let mut transmittance = 1f32;
        let mut walk = Walk::new(&field.lattice, field.mask.as_ref(), ray, shift(jitter, r));
        while let Some(t) = walk.advance() {
            let cell = field.cell(std::array::from_fn(|a| origin[a] + t * direction[a]));
            let feature = match task.keeps_planes {
                true => lookup.sum::<F, true>(&cell, &mut planes),
                false => lookup.sum::<F, false>(&cell, &mut planes),
            };
            task.looked_up += 1;
            if !s.softplus && feature <= 0.0 {
                transmittance *= 1.0 + 1e-10;
                continue; // the sample has neither weight nor gradient
            }
            let alpha = 1.0 - exp::<F>(-s.density::<F>(feature) * length);
            task.kept.push(KeptSample { t, feature, alpha, transmittance });
            task.cells.push(cell);
            if task.keeps_planes {
                task.planes.extend_from_slice(&planes);
            }
            transmittance *= 1.0 - alpha + 1e-10;
            if transmittance <= s.stop {
                break;
            }
        }
        task.offsets.push(task.kept.len() as u32);
    }
}

dispatch! {
    fn march_rays / march_body(
        task: &mut Marched, rays: &[Ray], jitter: &[f32], field: &VmField, lookup: &Lookup,
    )
}

/// Assigns colors to the samples of a ray, the first of which has the index `start`; appends the
/// indices of the samples at which colors are decoded to `colored`.
pub(super) fn assign_colors(
    shading: &Shading,
    weights: impl Iterator<Item = f32>,
    start: u32,
    color_of: &mut [u32],
    colored: &mut Vec<u32>,
) {
    let first = colored.len();
    let mut group = 0f32; // weight of the samples whose color is not decoded yet
    let mut last = None;
    for ((i, w), color) in (start..).zip(weights).zip(color_of.iter_mut()) {
        *color = COLORLESS;
        if w > shading.weight_threshold {
            *color = colored.len() as u32;
            group += w;
            last = Some(i);
            if group >= shading.group_weight {
                colored.extend(last.take());
                group = 0.0;
            }
        }
    }
    if colored.len() == first {
        colored.extend(last);
        return;
    }
    let end = colored.len() as u32;
    for color in color_of.iter_mut().rev().filter(|color| **color != COLORLESS) {
        if *color < end {
            break;
        }
        *color = end - 1;
    }
}

/// Renders a batch of whole rays; directions may have any length, which is then the unit of `t`.
///
/// # Shapes
///
/// - density, color: flat planes and lines of the field's two grids
/// - jitter: `[rays]`, the part of a step by which each ray's samples are shifted; `[0]` for none
/// - output: `[rays, 5]` = rgb over black, opacity, Σ w t
pub fn render(
    field: &VmField,
    density: &[f32],
    color: &[f32],
    decoder: &DecoderWeights,
    rays: &[Ray],
    jitter: &[f32],
) -> Rendered {
    rendered(field, [density, color], decoder, rays, jitter, true)
}

/// As [`Rendered::out`] of [`render`], without what a backward pass needs.
pub fn composited(
    field: &VmField,
    density: &[f32],
    color: &[f32],
    decoder: &DecoderWeights,
    rays: &[Ray],
) -> Vec<f32> {
    rendered(field, [density, color], decoder, rays, &[], false).out
}

fn rendered(
    field: &VmField,
    [density, color]: [&[f32]; 2],
    decoder: &DecoderWeights,
    rays: &[Ray],
    jitter: &[f32],
    keeps_planes: bool,
) -> Rendered {
    assert!(jitter.is_empty() || jitter.len() == rays.len());
    let lookup = Lookup::new(&field.density, density);
    assert_eq!(lookup.size(), field.color.size);
    let channels = field.density.channels();
    let march = |(task, rays): (usize, &[Ray])| {
        let jitter = jitter.get(task * RAYS..task * RAYS + rays.len()).unwrap_or(&[]);
        let mut marched = Marched {
            kept: Vec::with_capacity(rays.len() * 32),
            cells: Vec::with_capacity(rays.len() * 32),
            keeps_planes,
            planes: Vec::with_capacity(if keeps_planes { rays.len() * 16 * channels } else { 0 }),
            offsets: vec![0],
            color_of: Vec::new(),
            colored: Vec::new(),
            looked_up: 0,
        };
        march_rays(&mut marched, rays, jitter, field, &lookup);
        marched.color_of.resize(marched.kept.len(), COLORLESS);
        let Marched { kept, cells, offsets, color_of, colored, .. } = &mut marched;
        let mut directions = Vec::with_capacity(kept.len() / 2);
        for (ray, ends) in rays.iter().zip(offsets.windows(2)) {
            let of_ray = ends[0] as usize..ends[1] as usize;
            let weights = kept[of_ray.clone()].iter().map(KeptSample::weight);
            assign_colors(&field.shading, weights, ends[0], &mut color_of[of_ray], colored);
            directions.resize(colored.len(), ray.direction.to_array());
        }
        let color_cells: Vec<Cell> = colored.iter().map(|&i| cells[i as usize]).collect();
        (marched, (color_cells, directions))
    };
    let (marched, colored): (Vec<Marched>, Vec<_>) = rays.par_chunks(RAYS).enumerate().map(march).unzip();
    let (color_cells, directions): (Vec<_>, Vec<_>) = colored.into_iter().unzip();
    let (color_cells, directions) = (color_cells.concat(), directions.concat());
    let colors = color_cells.len();
    let decoded = decoder::decode(&field.color, color, decoder, color_cells, &directions);

    let mut out = vec![0f32; rays.len() * RAY_WIDTH];
    let rgb = by_task(&marched, &decoded.rgb);
    out.par_chunks_mut(RAYS * RAY_WIDTH).zip(marched.par_iter().zip(rgb)).for_each(|(out, (m, rgb))| {
        for (out, samples) in out.chunks_exact_mut(RAY_WIDTH).zip(m.rays()) {
            for (k, &color) in m.kept[samples.clone()].iter().zip(&m.color_of[samples]) {
                let w = k.weight();
                if let Some(color) = rgb.get(color as usize) {
                    (0..3).for_each(|c| out[c] += w * color[c]);
                }
                out[3] += w;
                out[4] += w * k.t;
            }
        }
    });
    let density_samples = marched.iter().map(|m| m.looked_up).sum();
    Rendered { out, density_samples, color_samples: colors as u64, marched, decoded }
}

/// Gradients of a task's samples, without those that are exactly zero: cells, gradients with
/// respect to the sum of plane times line, and those with respect to line values.
struct Gradients<'a> {
    cells: &'a mut [Cell],
    by_sum: &'a mut [f32],
    lines: &'a mut [f32],
}

#[inline(always)]
fn gradients_body<const F: bool>(m: &Marched, g: &[f32], out: &mut Gradients) {
    let n = out.lines.len() / out.by_sum.len().max(1);
    let kept = g.iter().enumerate().filter(|(_, g)| **g != 0.0);
    for (k, (i, &g)) in kept.enumerate() {
        (out.cells[k], out.by_sum[k]) = (m.cells[i], g);
        for (line, plane) in out.lines[k * n..][..n].iter_mut().zip(&m.planes[i * n..][..n]) {
            *line = g * plane;
        }
    }
}

dispatch! { fn line_gradients / gradients_body(m: &Marched, g: &[f32], out: &mut Gradients) }

/// Computes the gradients of a rendered batch: adds those with respect to the grids to `g_density`
/// and `g_color`, and returns those with respect to the decoder's flat weights. `g` is the gradient
/// with respect to [`Rendered::out`], `[rays, 5]`.
pub fn backward(
    field: &VmField,
    density: &[f32],
    decoder: &DecoderWeights,
    rendered: Rendered,
    g: &[f32],
    g_density: &mut [f32],
    g_color: &mut [f32],
) -> Vec<f32> {
    assert_eq!(g.len(), rendered.out.len(), "a gradient for each ray");
    let Rendered { marched, decoded, .. } = rendered;
    let mut g_rgb = vec![[0f32; 3]; decoded.rgb.len()];
    let (rgb_of, g_rgb_of) = (by_task(&marched, &decoded.rgb), by_task_mut(&marched, &mut g_rgb));
    let of_rays = g.par_chunks(RAYS * RAY_WIDTH);
    let g_feature: Vec<Vec<f32>> = (&marched, of_rays, rgb_of, g_rgb_of)
        .into_par_iter()
        .map(|(m, g, rgb, g_rgb)| m.gradients(field, g, rgb, g_rgb))
        .collect();

    let lookup = Lookup::new(&field.density, density);
    let n = field.density.channels();
    let counts: Vec<usize> = g_feature.iter().map(|g| g.iter().filter(|g| **g != 0.0).count()).collect();
    let count = counts.iter().sum::<usize>();
    let mut cells = Buffer::scratch(count * CELL_FLOATS);
    let (mut by_sum, mut lines) = (Buffer::scratch(count), Buffer::scratch(count * n));
    let mut rest = [&mut cells[..], &mut by_sum[..], &mut lines[..]];
    let tasks: Vec<_> = (g_feature.iter().zip(&marched).zip(counts))
        .map(|((g, m), count)| {
            let mut cut = |k: usize, width: usize| {
                rest[k].split_off_mut(..count * width).expect("a row for each sample")
            };
            let cells = bytemuck::cast_slice_mut(cut(0, CELL_FLOATS));
            (m, g, Gradients { cells, by_sum: cut(1, 1), lines: cut(2, n) })
        })
        .collect();
    tasks.into_par_iter().for_each(|(m, g, mut out)| line_gradients(m, g, &mut out));
    drop(marched);
    let planes = PlaneGradients::OfSum(&by_sum, &lookup);
    let gradients = FactorGradients { cells: bytemuck::cast_slice(&cells), planes, lines: &lines, stride: n };
    gather::scatter(&field.density, &gradients, g_density);
    decoder::decode_backward(&field.color, decoder, decoded, &g_rgb, g_color)
}

#[inline(always)]
fn density_body<const F: bool>(points: &[[f32; 3]], out: &mut [f32], field: &VmField, lookup: &Lookup) {
    for (p, out) in points.iter().zip(out) {
        *out = field.shading.density::<F>(lookup.sum::<F, false>(&field.cell(*p), &mut []));
    }
}

dispatch! {
    fn density_points / density_body(points: &[[f32; 3]], out: &mut [f32], field: &VmField, lookup: &Lookup)
}

/// Returns densities at points of the field's box, ignoring the mask. `[n, 3]` → `[n]`.
pub fn density_at(field: &VmField, density: &[f32], points: &[[f32; 3]]) -> Vec<f32> {
    let lookup = Lookup::new(&field.density, density);
    let mut out = vec![0f32; points.len()];
    out.par_chunks_mut(1024)
        .zip(points.par_chunks(1024))
        .for_each(|(out, points)| density_points(points, out, field, &lookup));
    out
}
