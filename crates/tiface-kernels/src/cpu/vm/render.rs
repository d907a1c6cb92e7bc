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
use super::gather::{self, Cell, FactorGradients, Lookup};
use super::mask::{BoxMask, Lattice, Walk};
use super::{DecoderShape, Grid};
use crate::cpu::march::shift;
use crate::cpu::pool::Buffer;
use crate::cpu::simd::{exp, ln_1p};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
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

/// Index of a color for samples whose weight is below the threshold, which have none.
pub(crate) const COLORLESS: u32 = u32::MAX;

/// A rendered batch of rays, with the intermediate values that its backward pass needs.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// `[rays, 5]`: see [`RAY_WIDTH`].
    pub out: Vec<f32>,
    /// Number of samples whose density was evaluated.
    pub density_samples: u64,
    /// Number of samples whose color was decoded.
    pub color_samples: u64,
    kept: Vec<KeptSample>,
    cells: Vec<Cell>,
    /// `[rays + 1]` into `kept`.
    offsets: Vec<u32>,
    /// `[kept]`: index into the decoded colors, or [`COLORLESS`].
    color_of: Vec<u32>,
    decoded: Decoded,
}

/// Number of rays per task.
const RAYS: usize = 32;

struct MarchTask<'a> {
    rays: &'a [Ray],
    jitter: &'a [f32],
    kept: Vec<KeptSample>,
    cells: Vec<Cell>,
    counts: Vec<u32>,
    looked_up: u64,
}

#[inline(always)]
fn march_body<const F: bool>(task: &mut MarchTask, field: &VmField, lookup: &Lookup) {
    let s = &field.shading;
    let length = field.lattice.step * s.distance_scale;
    for (r, ray) in task.rays.iter().enumerate() {
        let (origin, direction) = (ray.origin.to_array(), ray.direction.to_array());
        let before = task.kept.len();
        let mut transmittance = 1f32;
        let mut walk = Walk::new(&field.lattice, field.mask.as_ref(), ray, shift(task.jitter, r));
        while let Some(t) = walk.advance() {
            let cell = field.cell(std::array::from_fn(|a| origin[a] + t * direction[a]));
            let feature = lookup.sum::<F>(&cell);
            task.looked_up += 1;
            if !s.softplus && feature <= 0.0 {
                transmittance *= 1.0 + 1e-10;
                continue; // the sample has neither weight nor gradient
            }
            let alpha = 1.0 - exp::<F>(-s.density::<F>(feature) * length);
            task.kept.push(KeptSample { t, feature, alpha, transmittance });
            task.cells.push(cell);
            transmittance *= 1.0 - alpha + 1e-10;
            if transmittance <= s.stop {
                break;
            }
        }
        task.counts.push((task.kept.len() - before) as u32);
    }
}

dispatch! { fn march_rays / march_body(task: &mut MarchTask, field: &VmField, lookup: &Lookup) }

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
    assert!(jitter.is_empty() || jitter.len() == rays.len());
    let lookup = Lookup::new(&field.density, density);
    assert_eq!(lookup.size(), field.color.size);
    let mut tasks: Vec<MarchTask> = rays
        .chunks(RAYS)
        .enumerate()
        .map(|(task, rays)| MarchTask {
            rays,
            jitter: jitter.get(task * RAYS..task * RAYS + rays.len()).unwrap_or(&[]),
            kept: Vec::with_capacity(rays.len() * 32),
            cells: Vec::with_capacity(rays.len() * 32),
            counts: Vec::with_capacity(rays.len()),
            looked_up: 0,
        })
        .collect();
    tasks.par_iter_mut().for_each(|task| march_rays(task, field, &lookup));

    let total = tasks.iter().map(|t| t.kept.len()).sum();
    let mut kept = Vec::with_capacity(total);
    let mut cells = Vec::with_capacity(total);
    let mut offsets = vec![0u32];
    let (mut end, mut density_samples) = (0, 0);
    for task in tasks {
        for count in task.counts {
            end += count;
            offsets.push(end);
        }
        kept.extend_from_slice(&task.kept);
        cells.extend_from_slice(&task.cells);
        density_samples += task.looked_up;
    }
    let mut color_of = vec![COLORLESS; total];
    let mut colored = Vec::with_capacity(total);
    let mut directions = Vec::with_capacity(total);
    for (ray, range) in rays.iter().zip(offsets.windows(2)) {
        let of_ray = range[0] as usize..range[1] as usize;
        let weights = kept[of_ray.clone()].iter().map(KeptSample::weight);
        assign_colors(&field.shading, weights, range[0], &mut color_of[of_ray], &mut colored);
        directions.resize(colored.len(), ray.direction.to_array());
    }
    let color_cells: Vec<Cell> = colored.iter().map(|&i| cells[i as usize]).collect();
    let decoded = decoder::decode(&field.color, color, decoder, color_cells, &directions);

    let mut out = vec![0f32; rays.len() * RAY_WIDTH];
    for (r, out) in out.chunks_exact_mut(RAY_WIDTH).enumerate() {
        for i in offsets[r] as usize..offsets[r + 1] as usize {
            let k = &kept[i];
            let w = k.weight();
            if let Some(color) = decoded.rgb.get(color_of[i] as usize) {
                (0..3).for_each(|c| out[c] += w * color[c]);
            }
            out[3] += w;
            out[4] += w * k.t;
        }
    }
    let color_samples = colored.len() as u64;
    Rendered { out, density_samples, color_samples, kept, cells, offsets, color_of, decoded }
}

#[inline(always)]
fn factors_body<const F: bool>(
    cells: &[Cell],
    gradient: &[f32],
    planes: &mut [f32],
    lines: &mut [f32],
    n: usize,
    lookup: &Lookup,
) {
    for (i, (cell, &g)) in cells.iter().zip(gradient).enumerate() {
        let (p, l) = (&mut planes[i * n..][..n], &mut lines[i * n..][..n]);
        lookup.factors::<F>(cell, p, l);
        for (p, l) in p.iter_mut().zip(l) {
            (*p, *l) = (g * *l, g * *p);
        }
    }
}

dispatch! {
    fn factor_gradients / factors_body(
        cells: &[Cell], gradient: &[f32], planes: &mut [f32], lines: &mut [f32], n: usize, lookup: &Lookup,
    )
}

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
    let Rendered { kept, cells, offsets, color_of, decoded, .. } = rendered;
    let length = field.lattice.step * field.shading.distance_scale;
    let mut g_feature = vec![0f32; kept.len()];
    let mut g_rgb = vec![[0f32; 3]; decoded.rgb.len()];
    for r in (0..offsets.len() - 1).rev() {
        let g = &g[r * RAY_WIDTH..][..RAY_WIDTH];
        let mut farther = 0f32; // Σ w_j dL/dw_j over the farther samples
        for i in (offsets[r]..offsets[r + 1]).rev() {
            let i = i as usize;
            let k = &kept[i];
            let w = k.weight();
            let mut g_w = g[3] + g[4] * k.t;
            let color = color_of[i] as usize;
            if let (Some(c), Some(g_rgb)) = (decoded.rgb.get(color), g_rgb.get_mut(color)) {
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
    // samples with a gradient of exactly zero need no scatter
    let (cells, g_feature): (Vec<Cell>, Vec<f32>) =
        cells.into_iter().zip(g_feature).filter(|(_, g)| *g != 0.0).unzip();
    let lookup = Lookup::new(&field.density, density);
    let n = field.density.channels();
    let mut planes = Buffer::scratch(cells.len() * n);
    let mut lines = Buffer::scratch(cells.len() * n);
    const CHUNK: usize = 1024;
    planes
        .par_chunks_mut(CHUNK * n)
        .zip(lines.par_chunks_mut(CHUNK * n))
        .zip(cells.par_chunks(CHUNK).zip(g_feature.par_chunks(CHUNK)))
        .for_each(|((p, l), (cells, g))| factor_gradients(cells, g, p, l, n, &lookup));
    let gradients = FactorGradients { cells: &cells, planes: &planes, lines: &lines, stride: n };
    gather::scatter(&field.density, &gradients, g_density);
    decoder::decode_backward(&field.color, decoder, decoded, &g_rgb, g_color)
}

#[inline(always)]
fn density_body<const F: bool>(points: &[[f32; 3]], out: &mut [f32], field: &VmField, lookup: &Lookup) {
    for (p, out) in points.iter().zip(out) {
        *out = field.shading.density::<F>(lookup.sum::<F>(&field.cell(*p)));
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
