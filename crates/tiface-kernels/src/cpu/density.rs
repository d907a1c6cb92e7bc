//! Instant-NeRF: a density on a hash grid, and volume rendering with the distortion loss.
//!
//! Müller et al. 2022 ("Instant Neural Graphics Primitives"), as in instant-nsr-pl's `nerf` model:
//!
//! ```text
//! u = hash features          h = relu(W1 u)       o = W2 h  [16]      σ = exp(o₀ − 1)
//! c = [o, SH16(d)]           rgb = sigmoid(C3 relu(C2 relu(C1 c)))    no biases
//! T_k = exp(−Σ_{j<k} σ_j δ)  w_k = T_k (1 − exp(−σ_k δ))              rgb and opacity: Σ w (c, 1)
//! distortion = Σ_k ⅓ δ w_k² + 2 w_k (m_k Σ_{j<k} w_j − Σ_{j<k} w_j m_j)     m: midpoints
//! ```
//!
//! Distortion: Barron et al. 2022 ("Mip-NeRF 360", eq. 15). As in instant-nsr-pl, the gradient of
//! the exponential is clamped to exp(15).

use super::hash::{self, Level};
use super::march::Samples;
use super::matrix::{Matrix, add_to, split};
use super::simd::{exp, gemm, sigmoid};
use rayon::prelude::*;
use tiface_base::dispatch;
use tiface_base::geom::sphharm::sh16;

/// Width of all hidden layers.
pub const HIDDEN: usize = 64;
/// Outputs of the geometry network: the logarithm of the density comes first, and all of them are
/// inputs of the color network.
pub const FEATURES: usize = 16;
/// Inputs of the color network: the geometry network's outputs and 16 spherical harmonics of the
/// direction.
pub const COLOR_INPUTS: usize = FEATURES + 16;
/// A ray is truncated where its transmittance falls below this.
pub const MIN_TRANSMITTANCE: f32 = 1e-4;
/// Weight of the distortion loss.
pub const DISTORTION: f32 = 0.001;
/// The gradient of the density's exponential is clamped to e¹⁵.
pub const MAX_EXP_GRADIENT: f32 = 3_269_017.25;
/// Color channels as stored in tiles, padded for the matrix blocks.
const RGB: usize = 8;
/// Number of samples per task. It is fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 64;

/// Hash grid and bounding box of the field.
#[derive(Clone, Debug, PartialEq)]
pub struct DensityShape {
    /// Levels of the hash grid; a multiple of 4.
    pub levels: Vec<Level>,
    /// The field lives in `[-radius, radius]³`.
    pub radius: f32,
}

impl DensityShape {
    /// Shapes `[out, in]` of W1, W2, C1, C2, C3 in storage order, row-major.
    pub fn shapes(&self) -> [(usize, usize); 5] {
        let u = 2 * self.levels.len();
        [(HIDDEN, u), (FEATURES, HIDDEN), (HIDDEN, COLOR_INPUTS), (HIDDEN, HIDDEN), (3, HIDDEN)]
    }

    /// Returns the number of floats of all matrices.
    pub fn len(&self) -> usize {
        self.shapes().iter().map(|(o, i)| o * i).sum()
    }

    fn x01(&self, x: &[[f32; 3]]) -> Vec<[f32; 3]> {
        x.iter().map(|p| p.map(|c| c * (0.5 / self.radius) + 0.5)).collect()
    }
}

/// The networks' matrices, each stored with its transpose.
#[derive(Debug)]
pub struct DensityWeights {
    m: [Matrix; 5],
}

impl DensityWeights {
    /// Creates the weights from the flat vector that [`DensityShape::shapes`] describes.
    pub fn new(shape: &DensityShape, flat: &[f32]) -> DensityWeights {
        let shapes = shape.shapes();
        let mut parts = split(flat, shapes).into_iter().zip(shapes);
        let m = std::array::from_fn(|_| {
            let (values, (rows, columns)) = parts.next().expect("five matrices");
            Matrix::new(values, (rows, columns), (rows.next_multiple_of(8), columns))
        });
        DensityWeights { m }
    }
}

/// Activations of a tile of samples, kept for the backward pass; all arrays are row-major, one row
/// per sample.
#[derive(Clone, Debug, Default)]
struct Tile {
    u: Vec<f32>,
    h: Vec<f32>,
    o: Vec<f32>,
    c0: Vec<f32>,
    c1: Vec<f32>,
    c2: Vec<f32>,
    rgb: Vec<f32>,
}

/// Evaluated samples, with the activations that the backward pass needs.
#[derive(Clone, Debug)]
pub struct DensitySamples {
    /// `[n]` densities.
    pub density: Vec<f32>,
    /// `[n, 3]` colors, sigmoid outputs in 0..=1; empty if [`evaluate`] got no directions.
    pub color: Vec<[f32; 3]>,
    tiles: Vec<Tile>,
    x01: Vec<[f32; 3]>,
}

fn relu(v: &mut [f32]) {
    v.iter_mut().for_each(|v| *v = v.max(0.0));
}

struct ForwardTask<'a> {
    /// Index of the first sample of this task.
    first: usize,
    /// Number of samples of all tasks.
    total: usize,
    /// `[levels, total]`
    features: &'a [[f32; 2]],
    levels: usize,
    direction: Option<&'a [[f32; 3]]>,
    density: &'a mut [f32],
    color: &'a mut [[f32; 3]],
    tile: &'a mut Tile,
}

#[inline(always)]
fn forward_body<const F: bool>(task: &mut ForwardTask, w: &DensityWeights) {
    let (n, inputs) = (task.density.len(), 2 * task.levels);
    let t = &mut *task.tile;
    t.u = vec![0.0; CHUNK * inputs];
    for l in 0..task.levels {
        for s in 0..n {
            let f = task.features[l * task.total + task.first + s];
            t.u[s * inputs + 2 * l..][..2].copy_from_slice(&f);
        }
    }
    t.h = vec![0.0; CHUNK * HIDDEN];
    gemm((CHUNK, HIDDEN, inputs), &t.u, (inputs, 1), &w.m[0].t, HIDDEN, &mut t.h, HIDDEN, false);
    relu(&mut t.h);
    t.o = vec![0.0; CHUNK * FEATURES];
    gemm((CHUNK, FEATURES, HIDDEN), &t.h, (HIDDEN, 1), &w.m[1].t, FEATURES, &mut t.o, FEATURES, false);
    for (s, density) in task.density.iter_mut().enumerate() {
        *density = exp::<F>(t.o[s * FEATURES] - 1.0);
    }
    let Some(direction) = task.direction else { return };
    t.c0 = vec![0.0; CHUNK * COLOR_INPUTS];
    for (s, d) in direction.iter().enumerate() {
        let row = &mut t.c0[s * COLOR_INPUTS..][..COLOR_INPUTS];
        row[..FEATURES].copy_from_slice(&t.o[s * FEATURES..][..FEATURES]);
        row[FEATURES..].copy_from_slice(&sh16(*d));
    }
    t.c1 = vec![0.0; CHUNK * HIDDEN];
    let size = (CHUNK, HIDDEN, COLOR_INPUTS);
    gemm(size, &t.c0, (COLOR_INPUTS, 1), &w.m[2].t, HIDDEN, &mut t.c1, HIDDEN, false);
    relu(&mut t.c1);
    t.c2 = vec![0.0; CHUNK * HIDDEN];
    gemm((CHUNK, HIDDEN, HIDDEN), &t.c1, (HIDDEN, 1), &w.m[3].t, HIDDEN, &mut t.c2, HIDDEN, false);
    relu(&mut t.c2);
    t.rgb = vec![0.0; CHUNK * RGB];
    gemm((CHUNK, RGB, HIDDEN), &t.c2, (HIDDEN, 1), &w.m[4].t, RGB, &mut t.rgb, RGB, false);
    for (s, color) in task.color.iter_mut().enumerate() {
        *color = std::array::from_fn(|c| sigmoid::<F>(t.rgb[s * RGB + c]));
    }
}

dispatch! { fn forward_task / forward_body(task: &mut ForwardTask, w: &DensityWeights) }

/// Evaluates densities at samples, and colors if directions are given.
///
/// # Shapes
///
/// - table: `[entries, 2]`; x: `[n, 3]` in the field's box; direction: `[n, 3]` unit
pub fn evaluate(
    shape: &DensityShape,
    table: &[[f32; 2]],
    weights: &DensityWeights,
    x: &[[f32; 3]],
    direction: Option<&[[f32; 3]]>,
) -> DensitySamples {
    let (n, levels) = (x.len(), shape.levels.len());
    let x01 = shape.x01(x);
    let mut features = vec![[0f32; 2]; levels * n];
    hash::gather(&shape.levels, table, &x01, 1.0, &mut features, None);
    let mut density = vec![0f32; n];
    let mut color = vec![[0f32; 3]; if direction.is_some() { n } else { 0 }];
    let mut tiles = vec![Tile::default(); n.div_ceil(CHUNK)];
    let mut colors = color.chunks_mut(CHUNK);
    let tasks: Vec<ForwardTask> = density
        .chunks_mut(CHUNK)
        .zip(&mut tiles)
        .enumerate()
        .map(|(i, (density, tile))| ForwardTask {
            first: i * CHUNK,
            total: n,
            features: &features,
            levels,
            direction: direction.map(|d| &d[i * CHUNK..][..density.len()]),
            density,
            color: colors.next().unwrap_or_default(),
            tile,
        })
        .collect();
    tasks.into_par_iter().for_each(|mut task| {
        forward_task(&mut task, weights);
        if task.direction.is_none() {
            *task.tile = Tile::default(); // a density-only evaluation has no backward pass
        }
    });
    DensitySamples { density, color, tiles, x01 }
}

struct BackwardTask<'a> {
    tile: &'a Tile,
    g_density: &'a [f32],
    g_color: &'a [[f32; 3]],
    density: &'a [f32],
    color: &'a [[f32; 3]],
    /// Gradients with respect to the five matrices.
    g: [Vec<f32>; 5],
    /// Gradient with respect to the hash features.
    g_u: Vec<f32>,
}

/// Returns `G[out, in] = gᵀ v`, summed over the samples of a tile.
#[inline(always)]
fn outer<const F: bool>(g: &[f32], out: usize, v: &[f32], inputs: usize) -> Vec<f32> {
    let mut sum = vec![0f32; out * inputs];
    gemm((out, inputs, CHUNK), g, (1, out), v, inputs, &mut sum, inputs, false);
    sum
}

/// Returns `g W`, set to zero where the activation of the previous layer is not positive (the
/// relu's gradient).
#[inline(always)]
fn back<const F: bool>(g: &[f32], out: usize, w: &Matrix, inputs: usize, layer: Option<&[f32]>) -> Vec<f32> {
    let mut g_input = vec![0f32; CHUNK * inputs];
    gemm((CHUNK, inputs, out), g, (out, 1), &w.m, inputs, &mut g_input, inputs, false);
    if let Some(layer) = layer {
        g_input.iter_mut().zip(layer).for_each(|(g, v)| *g = if *v > 0.0 { *g } else { 0.0 });
    }
    g_input
}

#[inline(always)]
fn backward_body<const F: bool>(task: &mut BackwardTask, w: &DensityWeights) {
    let t = task.tile;
    let inputs = t.u.len() / CHUNK;
    let mut g_rgb = vec![0f32; CHUNK * RGB];
    for (s, (g, c)) in task.g_color.iter().zip(task.color).enumerate() {
        (0..3).for_each(|k| g_rgb[s * RGB + k] = g[k] * c[k] * (1.0 - c[k]));
    }
    task.g[4] = outer::<F>(&g_rgb, RGB, &t.c2, HIDDEN);
    let g_c2 = back::<F>(&g_rgb, RGB, &w.m[4], HIDDEN, Some(&t.c2));
    task.g[3] = outer::<F>(&g_c2, HIDDEN, &t.c1, HIDDEN);
    let g_c1 = back::<F>(&g_c2, HIDDEN, &w.m[3], HIDDEN, Some(&t.c1));
    task.g[2] = outer::<F>(&g_c1, HIDDEN, &t.c0, COLOR_INPUTS);
    let g_c0 = back::<F>(&g_c1, HIDDEN, &w.m[2], COLOR_INPUTS, None);
    let mut g_o = vec![0f32; CHUNK * FEATURES];
    for (s, (g, density)) in task.g_density.iter().zip(task.density).enumerate() {
        let row = &mut g_o[s * FEATURES..][..FEATURES];
        row.copy_from_slice(&g_c0[s * COLOR_INPUTS..][..FEATURES]);
        row[0] += g * density.min(MAX_EXP_GRADIENT);
    }
    task.g[1] = outer::<F>(&g_o, FEATURES, &t.h, HIDDEN);
    let g_h = back::<F>(&g_o, FEATURES, &w.m[1], HIDDEN, Some(&t.h));
    task.g[0] = outer::<F>(&g_h, HIDDEN, &t.u, inputs);
    task.g_u = back::<F>(&g_h, HIDDEN, &w.m[0], inputs, None);
}

dispatch! { fn backward_task / backward_body(task: &mut BackwardTask, w: &DensityWeights) }

/// Returns the gradient with respect to the flat weights, and adds the gradient with respect to the
/// table to `g_table`.
///
/// # Shapes
///
/// - g_density: `[n]` and g_color: `[n, 3]`, gradients of the loss with respect to what
///   [`evaluate`] returned with directions
/// - g_table: `[entries, 2]`
pub fn backward(
    shape: &DensityShape,
    weights: &DensityWeights,
    samples: &DensitySamples,
    (g_density, g_color): (&[f32], &[[f32; 3]]),
    g_table: &mut [[f32; 2]],
) -> Vec<f32> {
    let (n, levels) = (g_density.len(), shape.levels.len());
    let mut flat = vec![0f32; shape.len()];
    let mut g_value = vec![[0f32; 2]; levels * n];
    let shapes = shape.shapes();
    // tiles are processed in passes to bound the memory: each task holds a gradient of all matrices
    const PASS: usize = 64;
    for (pass, tiles) in samples.tiles.chunks(PASS).enumerate() {
        let finished: Vec<BackwardTask> = tiles
            .par_iter()
            .enumerate()
            .map(|(i, tile)| {
                let first = (pass * PASS + i) * CHUNK;
                let range = first..(first + CHUNK).min(n);
                let mut task = BackwardTask {
                    tile,
                    g_density: &g_density[range.clone()],
                    g_color: &g_color[range.clone()],
                    density: &samples.density[range.clone()],
                    color: &samples.color[range],
                    g: Default::default(),
                    g_u: Vec::new(),
                };
                backward_task(&mut task, weights);
                task
            })
            .collect();
        for (i, task) in finished.iter().enumerate() {
            let strides = shapes.map(|(_, inputs)| inputs);
            let parts: Vec<(&[f32], usize)> = task.g.iter().zip(strides).map(|(g, s)| (&g[..], s)).collect();
            add_to(&mut flat, &shapes, &parts);
            let first = (pass * PASS + i) * CHUNK;
            for s in 0..task.density.len() {
                for l in 0..levels {
                    let g = &task.g_u[s * 2 * levels + 2 * l..][..2];
                    g_value[l * n + first + s] = [g[0], g[1]];
                }
            }
        }
    }
    let no_q = vec![[0f32; 2]; levels * n];
    let no_normals = vec![[0f32; 3]; n];
    hash::scatter(&shape.levels, g_table, &samples.x01, 1.0, &g_value, &no_q, &no_normals);
    flat
}

/// Returns the compositing weights `[samples]` of a ray with densities `[samples]`, for intervals
/// of length `dt`.
pub fn weights(density: &[f32], dt: f32) -> Vec<f32> {
    let mut thickness = 0f32;
    let weight = |sigma: &f32| {
        let transmittance = (-thickness).exp();
        thickness += sigma * dt;
        transmittance * -(-sigma * dt).exp_m1()
    };
    density.iter().map(weight).collect()
}

/// Returns the distortion loss of a ray's weights at midpoints `t`, and its gradient with respect
/// to each weight.
pub fn distortion(weight: &[f32], t: &[f32], dt: f32) -> (f32, Vec<f32>) {
    let (mut sum, mut moment) = (0f32, 0f32);
    let mut value = 0f32;
    let mut g = Vec::with_capacity(weight.len());
    for (&w, &m) in weight.iter().zip(t) {
        let before = m * sum - moment;
        value += dt * w * w / 3.0 + 2.0 * w * before;
        g.push(2.0 / 3.0 * dt * w + 2.0 * before);
        sum += w;
        moment += w * m;
    }
    let (mut farther, mut farther_moment) = (0f32, 0f32);
    for ((g, &w), &m) in g.iter_mut().zip(weight).zip(t).rev() {
        *g += 2.0 * (farther_moment - m * farther);
        farther += w;
        farther_moment += w * m;
    }
    (value, g)
}

/// Returns the gradient with respect to a ray's densities of a loss whose gradient with respect to
/// the ray's weights is `g`. All arrays are `[samples]`.
pub fn weights_backward(density: &[f32], weight: &[f32], g: &[f32], dt: f32) -> Vec<f32> {
    let mut thickness: f32 = density.iter().map(|s| s * dt).sum();
    let mut farther = 0f32; // Σ w_j g_j over the farther samples, j > k
    let mut out = vec![0f32; density.len()];
    for k in (0..density.len()).rev() {
        // ∂w_k/∂σ_k = δ T_k exp(−σ_k δ), and ∂w_j/∂σ_k = −δ w_j for all j > k
        out[k] = dt * ((-thickness).exp() * g[k] - farther);
        thickness -= density[k] * dt;
        farther += weight[k] * g[k];
    }
    out
}

/// Truncates each ray where its transmittance falls below [`MIN_TRANSMITTANCE`], and returns the
/// remaining samples. `density` is `[samples]`, in the order of `samples`.
pub fn cut(samples: &Samples, density: &[f32], dt: f32) -> Samples {
    let mut kept = Samples { offsets: vec![0], t: Vec::new() };
    for range in samples.offsets.windows(2) {
        let mut thickness = 0f32;
        for s in range[0] as usize..range[1] as usize {
            if (-thickness).exp() < MIN_TRANSMITTANCE {
                break;
            }
            kept.t.push(samples.t[s]);
            thickness += density[s] * dt;
        }
        kept.offsets.push(kept.t.len() as i32);
    }
    kept
}

/// Returns the mean squared error, the smooth-L1 loss and the distortion of a batch of rays, and
/// the gradients of `smooth + DISTORTION · distortion` with respect to the densities `[n]` and
/// colors `[n, 3]` of the samples.
///
/// # Shapes
///
/// - color: `[rays, 3]`, the photographed colors
/// - evaluated: densities and colors of `samples`
/// - dt: length of the intervals
pub fn losses(
    samples: &Samples,
    color: &[[f32; 3]],
    evaluated: &DensitySamples,
    dt: f32,
) -> ([f32; 3], Vec<f32>, Vec<[f32; 3]>) {
    let rays = || samples.offsets.windows(2).map(|o| o[0] as usize..o[1] as usize).enumerate();
    let hit_rays = rays().filter(|(_, span)| !span.is_empty()).count().max(1) as f32;
    // nerfacc's mean is over the rays up to the last one with samples
    let last = samples.offsets.windows(2).rposition(|o| o[1] > o[0]).map_or(1, |r| r + 1) as f32;
    let (mut g_density, mut g_color) = (vec![0f32; samples.t.len()], vec![[0f32; 3]; samples.t.len()]);
    let (mut smooth, mut square, mut spread) = (0f64, 0f64, 0f64);
    for (r, span) in rays().filter(|(_, span)| !span.is_empty()) {
        let weight = weights(&evaluated.density[span.clone()], dt);
        let colors = &evaluated.color[span.clone()];
        let mut composited = [0f32; 3];
        for (w, c) in weight.iter().zip(colors) {
            (0..3).for_each(|k| composited[k] += w * c[k]);
        }
        let error: [f32; 3] = std::array::from_fn(|k| composited[k] - color[r][k]);
        for e in error.map(f64::from) {
            square += e * e;
            smooth += if e.abs() < 1.0 { 0.5 * e * e } else { e.abs() - 0.5 };
        }
        let g = error.map(|e| e.clamp(-1.0, 1.0) / (3.0 * hit_rays));
        let (value, g_spread) = distortion(&weight, &samples.t[span.clone()], dt);
        spread += f64::from(value / last);
        let g_weight: Vec<f32> = g_spread
            .iter()
            .zip(colors)
            .map(|(s, c)| DISTORTION / last * s + g[0] * c[0] + g[1] * c[1] + g[2] * c[2])
            .collect();
        for (g_color, w) in g_color[span.clone()].iter_mut().zip(&weight) {
            *g_color = g.map(|g| w * g);
        }
        let by_density = weights_backward(&evaluated.density[span.clone()], &weight, &g_weight, dt);
        g_density[span].copy_from_slice(&by_density);
    }
    let n = f64::from(3.0 * hit_rays);
    ([(square / n) as f32, (smooth / n) as f32, spread as f32], g_density, g_color)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::reference::tape::{Var, gradient};
    use crate::cpu::reference::{Real, wide};

    #[test]
    fn weights_and_distortion_have_the_published_values() {
        // σ = (0, 2) over δ = 0.25
        let w = weights(&[0.0, 2.0], 0.25);
        assert!(w[0] == 0.0 && (w[1] - 0.393_469_34).abs() < 1e-7, "{w:?}");
        let (value, _) = distortion(&[0.1, 0.3, 0.4], &[1.0, 1.2, 1.5], 0.1);
        assert!((value - 0.132_666_67).abs() < 1e-7, "{value}");
    }

    #[test]
    fn gradients_of_weights_and_distortion_are_those_of_their_formulas() {
        let density = [0.3f32, 4.0, 0.0, 9.0, 2.0];
        let t = [1.0f32, 1.1, 1.3, 1.4, 1.5];
        let (dt, of) = (0.1f32, Var::of);
        let w = weights(&density, dt);
        let (value, mut g) = distortion(&w, &t, dt);
        g.iter_mut().enumerate().for_each(|(k, g)| *g += k as f32 - 1.5); // and Σ (k − 1.5) w
        let g = weights_backward(&density, &w, &g, dt);
        let mut distortion_alone = 0.0;
        let (_, want) = gradient(&wide(&density), |x| {
            let mut thickness = of(0.0);
            let w: Vec<Var> = x
                .iter()
                .map(|s| {
                    let before = (-thickness).exp();
                    thickness += *s * of(dt.into());
                    before * (of(1.0) - (-*s * of(dt.into())).exp())
                })
                .collect();
            let mut sum = of(0.0);
            for (i, a) in w.iter().enumerate() {
                sum += *a * *a * of(f64::from(dt) / 3.0);
                for (j, b) in w.iter().enumerate() {
                    sum += *a * *b * of(f64::from((t[i] - t[j]).abs()));
                }
            }
            distortion_alone = sum.value();
            sum + w.iter().enumerate().map(|(k, w)| *w * of(k as f64 - 1.5)).sum()
        });
        assert!((f64::from(value) - distortion_alone).abs() < 1e-6);
        for (g, want) in g.iter().zip(want) {
            assert!((f64::from(*g) - want).abs() < 1e-5 * want.abs().max(0.1), "{g} {want}");
        }
    }
}
