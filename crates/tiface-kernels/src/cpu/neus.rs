//! NeuS compositing of ragged rays, forward and backward.
//!
//! Wang et al. 2021, "NeuS", eq. 10-13, with the cosine annealing of its code: along a ray of unit
//! direction `d`, a sample of length `δ` with distance `f` and unit normal `n̂` has
//!
//! ```text
//! cos = d·n̂     ic = −[relu(½ − ½cos)(1 − a) + relu(−cos) a]     (a: anneal, 0 → 1)
//! P = σ(s (f − ½ ic δ))     N = σ(s (f + ½ ic δ))
//! α = clip((P − N + ε)/(P + ε), 0, 1)     ε = 1e-5
//! T_i = Π_{j<i} (1 − α_j)     w = T α     out = Σ w · (rgb, 1, t, n̂, ‖rgb‖²)
//! ```
//!
//! The last column of the field's output is `ln(s / inv_s)` of the sample; in NeuS it is 0
//! everywhere.
//!
//! A sample whose weight is at most [`ColorRule::min_weight`] counts as black, so its color is not
//! evaluated; its opacity counts. Neighbors may share a color: see [`ColorRule::group_weight`].

use super::hash::{LANES, Lanes};
use super::march::COLORLESS;
use super::pool::Buffer;
use super::sdf::WIDTH;
use super::simd::{exp, sigmoid_and_complement};
use rayon::prelude::*;
use std::ops::Range;
use tiface_base::dispatch;

/// Number of values per ray: rgb (3), opacity, depth (Σ w t), normal (3, Σ w n̂), squared color (Σ
/// w ‖rgb‖²).
pub const RAY_WIDTH: usize = 9;

/// The segments of rays that samples stand for, sorted by ray and then by `t`.
#[derive(Clone, Copy)]
pub struct Segments<'a> {
    /// `[rays + 1]`: ray `r` owns samples `offsets[r]..offsets[r + 1]`.
    pub offsets: &'a [i32],
    /// `[rays, 3]` unit directions.
    pub direction: &'a [[f32; 3]],
    /// `[samples]` midpoints.
    pub t: &'a [f32],
    /// `[samples]` lengths.
    pub dt: &'a [f32],
    /// Which samples have colors.
    pub colors: ColorRule,
}

/// Which samples of a ray have a color, and which of them share one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColorRule {
    /// Weight along the ray above which the color of a sample counts.
    pub min_weight: f32,
    /// Neighboring samples of a ray share a color, that of the heaviest of them, until their
    /// weights sum to this; what is left at the end of a ray takes the color before it. At 0 each
    /// sample has its own.
    pub group_weight: f32,
}

const EPSILON: f32 = 1e-5;

/// Opacity of one sample, with the intermediate values that its derivative needs.
struct Alpha {
    /// Opacity before it is clipped.
    raw: f32,
    /// P and 1 − P.
    previous: [f32; 2],
    /// N and 1 − N.
    next: [f32; 2],
    ic: f32,
    ic_by_cos: f32,
}

impl Alpha {
    #[inline(always)]
    fn clipped(&self) -> f32 {
        self.raw.clamp(0.0, 1.0)
    }
}

#[inline(always)]
fn alpha_of<const F: bool>(sdf: f32, cos: f32, dt: f32, inv_s: f32, anneal: f32) -> Alpha {
    let (soft, hard) = (0.5 - 0.5 * cos, -cos);
    let ic = -(soft.max(0.0) * (1.0 - anneal) + hard.max(0.0) * anneal);
    let by_soft = if soft > 0.0 { 0.5 * (1.0 - anneal) } else { 0.0 };
    let ic_by_cos = by_soft + if hard > 0.0 { anneal } else { 0.0 };
    let half = 0.5 * ic * dt;
    let [previous, next] = [sdf - half, sdf + half].map(|f| sigmoid_and_complement::<F>(f * inv_s));
    // outside the surface the complements are the smaller ones: their difference loses fewer digits
    let between = if sdf > 0.0 { next[1] - previous[1] } else { previous[0] - next[0] };
    Alpha { raw: (between + EPSILON) / (previous[0] + EPSILON), previous, next, ic, ic_by_cos }
}

/// Returns the opacity of a cell of half size `half` for the occupancy grid: that of a ray that
/// meets the surface head-on.
pub fn occupancy(sdf: f32, half: f32, inv_s: f32) -> f32 {
    alpha_of::<false>(sdf, -1.0, 2.0 * half, inv_s.clamp(1e-6, 1e6), 1.0).clipped()
}

/// A field gradient that is not longer than this has no meaningful direction, so nothing is
/// propagated back through its unit normal: that gradient would be scaled by the inverse length, up
/// to 1e12.
pub const MIN_GRADIENT_NORM: f32 = 1e-6;

#[inline(always)]
fn normal_of(field: &[f32]) -> [f32; 3] {
    let n = [field[1], field[2], field[3]];
    let length = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt().max(1e-12);
    n.map(|c| c / length)
}

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Returns the values of a sample that are composited, before they are multiplied by its weight.
#[inline]
fn values_of([r, g, b]: [f32; 3], n: [f32; 3], t: f32) -> [f32; RAY_WIDTH] {
    [r, g, b, 1.0, t, n[0], n[1], n[2], r * r + g * g + b * b]
}

/// Returns the color in the row `source` of the field's output, or black for [`COLORLESS`].
#[inline]
fn color_of(field: &[f32], source: u32) -> [f32; 3] {
    match source {
        COLORLESS => [0.0; 3],
        _ => std::array::from_fn(|c| field[source as usize * WIDTH + 4 + c]),
    }
}

/// What compositing derives from the field's output at [`LANES`] samples of a ray.
#[derive(Default)]
struct Block {
    raw: Lanes,
    /// P and 1 − P.
    previous: [Lanes; 2],
    /// N and 1 − N.
    next: [Lanes; 2],
    ic: Lanes,
    ic_by_cos: Lanes,
    /// Sharpness, clamped to [1e-6, 1e6].
    sharp: Lanes,
    normal: [Lanes; 3],
    /// Length of the gradient.
    length: Lanes,
}

/// Evaluates up to [`LANES`] samples of a ray; those that are missing get arbitrary values.
#[inline(always)]
fn block<const F: bool>(field: &[f32], dt: &[f32], direction: [f32; 3], inv_s: f32, anneal: f32) -> Block {
    let mut columns = [[0f32; LANES]; WIDTH];
    let mut lengths = [0f32; LANES];
    for (i, (row, dt)) in field.as_chunks::<WIDTH>().0.iter().zip(dt).take(LANES).enumerate() {
        for k in 0..WIDTH {
            columns[k][i] = row[k];
        }
        lengths[i] = *dt;
    }
    let [sdf, x, y, z, .., ln_sharp] = &columns;
    let mut b = Block::default();
    for i in 0..LANES {
        b.length[i] = (x[i] * x[i] + y[i] * y[i] + z[i] * z[i]).sqrt().max(1e-12);
        let n = [x[i] / b.length[i], y[i] / b.length[i], z[i] / b.length[i]];
        let cos = direction[0] * n[0] + direction[1] * n[1] + direction[2] * n[2];
        b.sharp[i] = (inv_s * exp::<F>(ln_sharp[i])).clamp(1e-6, 1e6);
        let a = alpha_of::<F>(sdf[i], cos, lengths[i], b.sharp[i], anneal);
        [b.normal[0][i], b.normal[1][i], b.normal[2][i]] = n;
        [b.previous[0][i], b.previous[1][i]] = a.previous;
        [b.next[0][i], b.next[1][i]] = a.next;
        b.raw[i] = a.raw;
        (b.ic[i], b.ic_by_cos[i]) = (a.ic, a.ic_by_cos);
    }
    b
}

/// Number of rays per task.
const RAYS: usize = 64;

/// Splits the rows of samples, `width` long, into those of each task, with its first ray.
fn by_task<'a, T>(offsets: &[i32], mut rows: &'a mut [T], width: usize) -> Vec<(usize, &'a mut [T])> {
    let rays = offsets.len() - 1;
    let mut cut = |first: usize| {
        let samples = (offsets[(first + RAYS).min(rays)] - offsets[first]) as usize;
        (first, rows.split_off_mut(..samples * width).expect("a row for each sample"))
    };
    (0..rays).step_by(RAYS).map(&mut cut).collect()
}

/// Rays of a task whose first is `first`, with the ranges of their samples.
#[inline(always)]
fn rays_of(segments: Segments<'_>, first: usize) -> impl Iterator<Item = (usize, Range<usize>)> {
    let end = (first + RAYS).min(segments.offsets.len() - 1);
    (first..end).map(move |r| (r, segments.offsets[r] as usize..segments.offsets[r + 1] as usize))
}

#[inline(always)]
fn weights_body<const F: bool>(
    first: usize,
    weights: &mut [f32],
    segments: Segments,
    field: &[f32],
    inv_s: f32,
    anneal: f32,
) {
    let begin = segments.offsets[first] as usize;
    for (r, span) in rays_of(segments, first) {
        let mut transmittance = 1f32;
        for start in span.clone().step_by(LANES) {
            let end = (start + LANES).min(span.end);
            let (rows, dt) = (&field[start * WIDTH..end * WIDTH], &segments.dt[start..end]);
            let block = block::<F>(rows, dt, segments.direction[r], inv_s, anneal);
            for (weight, raw) in weights[start - begin..end - begin].iter_mut().zip(block.raw) {
                let alpha = raw.clamp(0.0, 1.0);
                *weight = transmittance * alpha;
                transmittance *= 1.0 - alpha;
            }
        }
    }
}

dispatch! {
    fn weights_task / weights_body(
        first: usize, weights: &mut [f32], segments: Segments, field: &[f32], inv_s: f32, anneal: f32,
    )
}

/// Returns the weight of each sample, `[samples]`, for which colors are not needed.
///
/// # Shapes
///
/// - field: `[samples, 8]`, the output of the field
pub fn weights(segments: Segments, field: &[f32], inv_s: f32, anneal: f32) -> Vec<f32> {
    let inv_s = inv_s.clamp(1e-6, 1e6);
    let mut weights = vec![0f32; segments.t.len()];
    by_task(segments.offsets, &mut weights, 1)
        .into_par_iter()
        .for_each(|(first, weights)| weights_task(first, weights, segments, field, inv_s, anneal));
    weights
}

/// Returns, for each sample, the sample whose color it takes: see [`ColorRule`]. Samples whose
/// color does not count have [`COLORLESS`].
///
/// # Shapes
///
/// - weights: `[samples]`, as [`weights`] returns them
pub fn color_sources(segments: Segments, weights: &[f32]) -> Vec<u32> {
    let mut sources = vec![COLORLESS; weights.len()];
    by_task(segments.offsets, &mut sources, 1).into_par_iter().for_each(|(first, sources)| {
        let begin = segments.offsets[first] as usize;
        for (_, span) in rays_of(segments, first) {
            let own = span.start - begin..span.end - begin;
            share_colors(segments.colors, &weights[span.clone()], span.start as u32, &mut sources[own]);
        }
    });
    sources
}

/// As [`color_sources`], of a ray whose first sample has the index `begin`.
fn share_colors(rule: ColorRule, weights: &[f32], begin: u32, sources: &mut [u32]) {
    let counts = |s: &usize| weights[*s] > rule.min_weight;
    // of the samples since `start`: their weight, and the heaviest
    let (mut start, mut group, mut heaviest) = (0, 0f32, None);
    let mut before = None;
    let mut give = |samples: Range<usize>, from: usize| {
        samples.filter(counts).for_each(|s| sources[s] = begin + from as u32);
    };
    for s in (0..weights.len()).filter(counts) {
        group += weights[s];
        let from = heaviest.filter(|&h: &usize| weights[h] >= weights[s]).unwrap_or(s);
        heaviest = Some(from);
        if group >= rule.group_weight {
            give(start..s + 1, from);
            (start, group, heaviest, before) = (s + 1, 0.0, None, Some(from));
        }
    }
    if let Some(from) = before.or(heaviest) {
        give(start..weights.len(), from);
    }
}

/// Returns the samples whose color is taken by some sample, ascending.
///
/// # Shapes
///
/// - sources: `[samples]`, as [`color_sources`] returns them
pub fn shown(sources: &[u32]) -> Vec<u32> {
    (0..sources.len() as u32).filter(|&s| sources[s as usize] == s).collect()
}

/// Composites the samples of each ray by their weights. The values of a ray without samples are
/// zero.
///
/// # Shapes
///
/// - field: `[samples, 8]`, the output of the field; weights: `[samples]`
/// - sources: `[samples]`, as [`color_sources`] returns them
/// - output: `[rays, 9]` = rgb, opacity, Σ w t, Σ w n̂, Σ w ‖rgb‖²
pub fn composite(segments: Segments, field: &[f32], weights: &[f32], sources: &[u32]) -> Vec<f32> {
    let count = segments.offsets.len() - 1;
    let mut out = vec![0f32; count * RAY_WIDTH];
    out.par_chunks_mut(RAY_WIDTH).with_min_len(64).enumerate().for_each(|(r, out)| {
        for s in segments.offsets[r] as usize..segments.offsets[r + 1] as usize {
            let normal = normal_of(&field[s * WIDTH..][..WIDTH]);
            let values = values_of(color_of(field, sources[s]), normal, segments.t[s]);
            out.iter_mut().zip(values).for_each(|(out, value)| *out += weights[s] * value);
        }
    });
    out
}

/// Composites the samples of each ray: [`composite`] by [`weights`].
pub fn forward(segments: Segments, field: &[f32], inv_s: f32, anneal: f32) -> Vec<f32> {
    let weights = weights(segments, field, inv_s, anneal);
    composite(segments, field, &weights, &color_sources(segments, &weights))
}

/// The backward pass of some rays.
struct NeusBackwardTask<'a> {
    first: usize,
    g_field: &'a mut [f32],
    /// Of each ray, the gradient with respect to `ln inv_s`.
    g_ln_inv_s: Vec<f64>,
}

#[inline(always)]
fn backward_body<const F: bool>(
    t: &mut NeusBackwardTask,
    segments: Segments,
    (field, sources): (&[f32], &[u32]),
    inv_s: f32,
    anneal: f32,
    g_out: &[f32],
) {
    let begin = segments.offsets[t.first] as usize;
    let mut blocks: Vec<(Block, [f32; LANES])> = Vec::new();
    for (r, span) in rays_of(segments, t.first) {
        let direction = segments.direction[r];
        let g = &g_out[r * RAY_WIDTH..][..RAY_WIDTH];
        // recompute the forward pass: opacities and transmittances
        blocks.clear();
        let mut light = 1f32;
        for start in span.clone().step_by(LANES) {
            let end = (start + LANES).min(span.end);
            let (rows, dt) = (&field[start * WIDTH..end * WIDTH], &segments.dt[start..end]);
            let block = block::<F>(rows, dt, direction, inv_s, anneal);
            let mut transmittance = [0f32; LANES];
            for i in 0..end - start {
                transmittance[i] = light;
                light *= 1.0 - block.raw[i].clamp(0.0, 1.0);
            }
            blocks.push((block, transmittance));
        }
        let mut farther = 0f32; // Σ_{j>k} w_j g_w_j
        let mut g_s = 0f64;
        for s in span.clone().rev() {
            let ((b, transmittance), i) = (&blocks[(s - span.start) / LANES], (s - span.start) % LANES);
            let (alpha, transmittance) = (b.raw[i].clamp(0.0, 1.0), transmittance[i]);
            let normal = [b.normal[0][i], b.normal[1][i], b.normal[2][i]];
            let w = transmittance * alpha;
            let row = &field[s * WIDTH..][..WIDTH];
            let color = color_of(field, sources[s]);
            // the loss gradient by the weight
            let mut g_w = 0f32;
            for (g, value) in g.iter().zip(values_of(color, normal, segments.t[s])) {
                g_w += g * value;
            }
            if sources[s] != COLORLESS {
                let out = &mut t.g_field[(sources[s] as usize - begin) * WIDTH + 4..][..3];
                for c in 0..3 {
                    out[c] += w * (g[c] + 2.0 * g[8] * color[c]);
                }
            }
            let out = &mut t.g_field[(s - begin) * WIDTH..][..WIDTH];
            let g_alpha = transmittance * g_w - farther / (1.0 - alpha).max(1e-10);
            farther += w * g_w;
            // the gradient by the unit normal has two parts: as composited, and through the cosine
            let mut g_normal = [w * g[5], w * g[6], w * g[7]];
            if alpha == b.raw[i] {
                let [p, not_p] = b.previous.map(|lanes| lanes[i]);
                let [q, not_q] = b.next.map(|lanes| lanes[i]);
                let sharp = b.sharp[i];
                let d = p + EPSILON;
                // α = (P − N + ε)/(P + ε): ∂P = N/(P+ε)², ∂N = −1/(P+ε)
                let g_p = g_alpha * q / (d * d) * p * not_p;
                let g_q = -g_alpha / d * q * not_q;
                out[0] = (g_p + g_q) * sharp;
                let (sdf, half) = (row[0], 0.5 * b.ic[i] * segments.dt[s]);
                // the gradient by ln s is that by the sample's offset and, divided by inv_s, that
                // by inv_s
                let g_ln = (g_p * (sdf - half) + g_q * (sdf + half)) * sharp;
                out[7] = g_ln;
                g_s += g_ln as f64;
                let g_cos = (g_q - g_p) * sharp * 0.5 * segments.dt[s] * b.ic_by_cos[i];
                for c in 0..3 {
                    g_normal[c] += g_cos * direction[c];
                }
            }
            let (radial, length) = (dot(normal, g_normal), b.length[i]);
            if length > MIN_GRADIENT_NORM {
                for c in 0..3 {
                    out[1 + c] = (g_normal[c] - normal[c] * radial) / length;
                }
            }
        }
        t.g_ln_inv_s.push(g_s);
    }
}

dispatch! {
    fn backward_task / backward_body(
        t: &mut NeusBackwardTask, segments: Segments, field_and_sources: (&[f32], &[u32]), inv_s: f32,
        anneal: f32, g_out: &[f32],
    )
}

/// Returns the gradients of [`composite`] by [`weights`] with respect to the field's output, `[n,
/// 8]`, and with respect to `inv_s`.
///
/// # Shapes
///
/// - field: `[n, 8]`, the output of the field; the gradient of rows beyond the samples is zero
/// - sources: `[samples]`, as [`color_sources`] returns them
/// - g_out: `[rays, 9]`, the gradient of the loss with respect to the output of [`composite`]
pub fn composite_backward(
    segments: Segments,
    field: &[f32],
    sources: &[u32],
    inv_s: f32,
    anneal: f32,
    g_out: &[f32],
) -> (Buffer, f32) {
    let clamped = inv_s.clamp(1e-6, 1e6);
    let mut g_field = Buffer::zeroed(field.len());
    let mut tasks: Vec<NeusBackwardTask> = by_task(segments.offsets, &mut g_field, WIDTH)
        .into_iter()
        .map(|(first, g_field)| NeusBackwardTask { first, g_field, g_ln_inv_s: Vec::with_capacity(RAYS) })
        .collect();
    tasks.par_iter_mut().for_each(|t| backward_task(t, segments, (field, sources), clamped, anneal, g_out));
    let total: f64 = tasks.iter().flat_map(|t| &t.g_ln_inv_s).sum();
    let inside = (1e-6..=1e6).contains(&inv_s);
    (g_field, if inside { (total / inv_s as f64) as f32 } else { 0.0 })
}

/// Returns the gradients of [`forward`]: see [`composite_backward`].
pub fn backward(segments: Segments, field: &[f32], inv_s: f32, anneal: f32, g_out: &[f32]) -> (Buffer, f32) {
    let sources = color_sources(segments, &weights(segments, field, inv_s, anneal));
    composite_backward(segments, field, &sources, inv_s, anneal, g_out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::reference;

    #[test]
    fn alphas_match_the_published_values() {
        let dt = 0.00101484375;
        let e3 = 3f32.exp();
        for (sdf, cos, s, a, want) in [
            (0.01, -0.8, 64.0, 0.25, 0.0194449),
            (0.0, -1.0, e3, 0.0, 0.0101598),
            (-0.05, -1.0, 1000.0, 1.0, 1.0),
            (0.02, 0.5, 200.0, 0.5, 4.66413e-4),
        ] {
            let got = alpha_of::<true>(sdf, cos, dt, s, a).clipped();
            assert!((got - want).abs() < 2e-6 * want.max(0.05), "{got} {want}");
        }
        for (sdf, s, want) in
            [(0.05, e3, 0.00546357), (0.2, e3, 3.70632e-4), (-0.1, e3, 0.0178938), (0.01, 1000.0, 5.80727e-5)]
        {
            let got = occupancy(sdf, 0.5 * dt, s);
            assert!((got - want).abs() < 5e-7, "{got} {want}");
        }
    }

    #[test]
    fn extreme_fields_have_finite_opacities_and_bounded_gradients() {
        let offsets = [0, 4];
        let (direction, t, dt) = ([[0.6, 0.0, -0.8]], [1.0, 1.1, 1.2, 1.3], [1e-9, 0.05, 3.0, 1e3]);
        let colors = ColorRule { min_weight: 1e-4, group_weight: 0.05 };
        let segments = Segments { offsets: &offsets, direction: &direction, t: &t, dt: &dt, colors };
        let g = [1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0];
        for inv_s in [0.0, 1e-9, 1e-6, 1.0, 1e6, 1e9, f32::INFINITY] {
            for sdf in [0.0, 1e-30, -1e-6, 1.0, -1e3, 1e20] {
                for slope in [0.0, 1e-30, 1e-12, 2e-6, 1.0, 1e6] {
                    let sample = |k: usize| [sdf, slope, -0.5 * slope, 0.0, 0.5, 0.5, 0.5, -(k as f32)];
                    let field: Vec<f32> = (0..4).flat_map(sample).collect();
                    let composited = forward(segments, &field, inv_s, 1.0);
                    assert!(
                        composited.iter().all(|v| v.is_finite() && v.abs() < 2.0),
                        "{inv_s} {sdf} {slope} {composited:?}"
                    );
                    let (g_field, g_s) = backward(segments, &field, inv_s, 1.0, &g);
                    let gradients = || g_field.iter().chain([&g_s]);
                    assert!(gradients().all(|v| v.is_finite()), "{inv_s} {sdf} {slope} {g_field:?} {g_s}");
                    // 3 · 1e6, the unit normal's 1 / MIN_GRADIENT_NORM, and 1e3 · 1e6 by the length
                    // of an interval
                    assert!(gradients().all(|v| v.abs() < 1e10), "{inv_s} {sdf} {slope} {g_field:?} {g_s}");
                    if slope < MIN_GRADIENT_NORM {
                        assert!(g_field.as_chunks::<8>().0.iter().all(|g| g[1..4] == [0.0; 3]));
                    }
                }
            }
        }
    }

    #[test]
    fn samples_share_the_color_of_the_heaviest_until_their_weights_sum_to_that_of_a_group() {
        const NONE: u32 = COLORLESS;
        let rule = |group_weight| ColorRule { min_weight: 1e-4, group_weight };
        // (weight of a group, weights, sources of a ray whose first sample is 10)
        let cases: [(f32, &[f32], &[u32]); 6] = [
            (0.0, &[0.3, 0.0, 0.2], &[10, NONE, 12]),
            (0.05, &[0.02, 1e-5, 0.04, 0.3, 0.04, 0.02], &[12, NONE, 12, 13, 14, 14]),
            // what is left takes the color before it, even where it is heavier
            (0.05, &[0.06, 0.01, 0.02], &[10, 10, 10]),
            (0.5, &[0.1, 0.3, 0.2, 0.4], &[11, 11, 11, 11]),
            // a ray of less than a group
            (0.5, &[0.1, 0.2, 1e-4, 0.1], &[11, 11, NONE, 11]),
            (0.5, &[1e-4, 1e-5], &[NONE, NONE]),
        ];
        for (group_weight, weights, want) in cases {
            let mut sources = vec![COLORLESS; weights.len()];
            share_colors(rule(group_weight), weights, 10, &mut sources);
            assert_eq!(sources, want, "{group_weight} {weights:?}");
        }
        assert_eq!(shown(&[2, NONE, 2, 3, 3]), [2, 3]);
    }

    /// Returns Σ g · out, by the formulas in f64.
    fn loss(segments: Segments, field: &[f64], inv_s: f64, anneal: f64, g: &[f32]) -> f64 {
        let out = reference::neus::composite(segments, field, inv_s, anneal);
        out.iter().zip(g).map(|(o, g)| o * *g as f64).sum()
    }

    #[test]
    fn the_backward_agrees_with_f64_finite_differences() {
        let offsets = [0, 5, 5, 12];
        let direction = [[0.6, 0.0, -0.8], [0.0, 0.0, 1.0], [0.36, -0.48, 0.8]];
        let t: Vec<f32> = (0..12).map(|i| 1.0 + 0.05 * i as f32).collect();
        let dt = vec![0.05f32; 12];
        let field: Vec<f32> = (0..96)
            .map(|i| match i % 8 {
                // so far outside that its color does not count
                0 if i / 8 == 4 => 0.5,
                0 => 0.12 - 0.03 * (i / 8 % 6) as f32,
                7 => -0.1 * (i % 5) as f32,
                1..=3 => (i as f32 * 0.7).sin() * 0.8 + if i % 8 == 3 { 0.5 } else { 0.0 },
                _ => 0.5 + 0.4 * (i as f32 * 1.3).cos(),
            })
            .collect();
        let g: Vec<f32> = (0..27).map(|i| (i as f32 * 0.9).sin()).collect();
        let (inv_s, anneal) = (30f32, 0.4f32);
        for group_weight in [0.0, 0.1] {
            let colors = ColorRule { min_weight: 1e-4, group_weight };
            let segments = Segments { offsets: &offsets, direction: &direction, t: &t, dt: &dt, colors };
            let (g_field, g_s) = backward(segments, &field, inv_s, anneal, &g);
            let faint = |w: &f32| *w <= colors.min_weight;
            assert!(faint(&weights(segments, &field, inv_s, anneal)[4]) && g_field[36..39] == [0.0; 3]);
            assert!(g_field[32] != 0.0, "its opacity counts");
            let wide = reference::wide(&field);
            let at = |f: &[f64], s: f64| loss(segments, f, s, anneal as f64, &g);
            let scale = g_field.iter().fold(0f32, |a, &b| a.max(b.abs())) as f64;
            for i in 0..96 {
                let mut f = wide.clone();
                f[i] += 1e-6;
                let up = at(&f, inv_s as f64);
                f[i] -= 2e-6;
                let slope = (up - at(&f, inv_s as f64)) / 2e-6;
                let error = (slope - g_field[i] as f64).abs() / slope.abs().max(1e-3 * scale);
                assert!(error < 1e-3, "{group_weight}, field {i}: {slope} {}", g_field[i]);
            }
            let slope = (at(&wide, inv_s as f64 + 1e-4) - at(&wide, inv_s as f64 - 1e-4)) / 2e-4;
            assert!((slope - g_s as f64).abs() < 1e-3 * slope.abs(), "inv_s {slope} {g_s}");
            assert_eq!(&forward(segments, &field, inv_s, anneal)[9..18], &[0.0; 9]);
        }
    }
}
