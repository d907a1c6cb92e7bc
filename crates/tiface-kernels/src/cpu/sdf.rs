//! The fused signed-distance field: hash features → sdf, its spatial gradient, color; and backward.
//!
//! With `F` the hash features, `J = dF/dx`, `u = [F, x]`, `w` row 0 of `W2`:
//!
//! ```text
//! z = W1 u + b1     h = softplus₁₀₀(z)     o = W2 h + b2      sdf = o₀
//! s = sigmoid(100 z)     a = w ⊙ s     q = W1ᵀ a              n = ∇sdf = q_x + Jᵀ q_F
//! ```
//!
//! `n` is an *output*, since NeuS alpha, color and eikonal loss use it; the backward pass is second
//! order. Given the gradients `g_o` and `g_n`:
//!
//! ```text
//! g_q = [J g_n, g_n]     g_a = W1 g_q     g_W1 += a g_qᵀ + g_z uᵀ     g_w += g_a ⊙ s
//! g_z = (W2ᵀ g_o) ⊙ s + 100 g_a ⊙ w ⊙ s ⊙ (1 − s)     g_F = (W1ᵀ g_z)_F
//! table[corner] += g_F w + q_F (g_n · ∇w)
//! ```
//!
//! If the sharpness is local, the last of the thirteen outputs also gives the ratio of the local to
//! the maximum sharpness: `ln(s / s_max) = −L σ(o₁₂ − 2)`, after Wang et al. 2023, "Adaptive
//! Shells", who learn a kernel size per position. Hair can then be soft while skin is sharp.
//!
//! Of `z`, `h` and `s` only `h` is kept for the backward pass, because `s = 1 − e^{−100 h}`.
//!
//! Geometry comes first, at all samples; color, two thirds of the arithmetic, is evaluated where a
//! sample shows, which its weight along the ray says.

use super::hash::{self, JacobianBlock, LANES, Level};
use super::mlp::{HIDDEN, Layout, OUTPUTS_PADDED, SOFTNESS, TILE, Weights};
use super::pool::{Buffer, by_chunk, pieces};
use super::simd::{exp, fma, gemm, ln_1p, sigmoid};
use color::Shaded;
use rayon::prelude::*;
use std::ops::Range;
use tiface_base::dispatch;

mod backward;
mod color;
mod infer;

pub use backward::backward;
pub use infer::{colors, gradients, softness, values, values_and_softness};

/// Number of values per sample of the field's output: sdf, gradient (3), color (3), logarithm of
/// the ratio of the local to the maximum sharpness (0 if the sharpness is global).
pub const WIDTH: usize = 8;

/// Shape of the field: its hash grid, its box and the variants of its networks.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldShape {
    /// Levels of the hash grid.
    pub levels: Vec<Level>,
    /// The field lives in `[-radius, radius]³`; the networks see positions divided by it.
    pub radius: f32,
    /// Number of active hash levels, for coarse-to-fine training; features of the other levels are
    /// zero.
    pub active: usize,
    /// Whether the color network also reads the hash features.
    pub color_skip: bool,
    /// L: ln of the largest ratio of the maximum to the local sharpness; 0 if the sharpness is
    /// global.
    pub soften: f32,
}

/// Returns ln of the ratio of the local to the maximum sharpness, from the network's output. The
/// offset of −2 lets training start close to the maximum.
#[inline(always)]
fn softened<const F: bool>(soften: f32, output: f32) -> f32 {
    -soften * sigmoid::<F>(output - 2.0)
}

impl FieldShape {
    /// Returns the layout of the network weights.
    pub fn layout(&self) -> Layout {
        Layout::new(self.levels.len(), self.color_skip)
    }

    /// Returns d x01 / d position.
    fn world(&self) -> f32 {
        0.5 / self.radius
    }

    fn x01(&self, x: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let k = self.world();
        x.iter().map(|p| p.map(|c| c * k + 0.5)).collect()
    }
}

/// Output of a forward pass, with the activations that the backward pass needs.
#[derive(Clone, Debug)]
pub struct Activations {
    shape: FieldShape,
    samples: usize,
    x01: Vec<[f32; 3]>,
    jacobian: Buffer, // [levels, blocks, 6, 8]
    q: Buffer,        // [levels, n, 2]
    u: Buffer,        // [np, kp]; np = n rounded up to whole tiles
    h: Buffer,        // [np, 64]
    o: Buffer,        // [np, 16] outputs of the geometry network
    shaded: Shaded,
    out: Buffer, // [n, 8]
}

/// Number of samples per task. It is fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 16 * TILE;

/// Inputs of the first layer for a range of samples: the hash features of each level, then the
/// position.
struct Inputs<'a> {
    /// Index of the first sample of the range.
    start: usize,
    /// Number of samples of all ranges, which is the stride of `value` from level to level.
    total: usize,
    levels: usize,
    active: usize,
    inv_radius: f32,
    x: &'a [[f32; 3]], // [n, 3], samples of the range only
    value: &'a [f32],  // [active, total, 2]
}

impl<'a> Inputs<'a> {
    /// Creates the inputs of the samples `range` of `x`, whose gathered features are `value`.
    fn new(shape: &FieldShape, x: &'a [[f32; 3]], value: &'a [f32], range: Range<usize>) -> Inputs<'a> {
        Inputs {
            start: range.start,
            total: x.len(),
            levels: shape.levels.len(),
            active: shape.active,
            inv_radius: 1.0 / shape.radius,
            x: &x[range],
            value,
        }
    }

    /// Returns the index of a level's first Jacobian block of the tile that starts at sample
    /// `base`.
    #[inline(always)]
    fn first_block(&self, level: usize, base: usize) -> usize {
        level * self.total.div_ceil(LANES) + (self.start + base) / LANES
    }

    /// Writes the rows of a tile that starts at sample `base`. Columns of inactive levels and of
    /// padding are not written.
    #[inline(always)]
    fn fill(&self, u: &mut [f32], kp: usize, base: usize, rows: usize) {
        for l in 0..self.active {
            let v = &self.value[(l * self.total + self.start + base) * 2..][..rows * 2];
            for r in 0..rows {
                u[r * kp + 2 * l] = v[2 * r];
                u[r * kp + 2 * l + 1] = v[2 * r + 1];
            }
        }
        let first = 2 * self.levels;
        for r in 0..rows {
            for a in 0..3 {
                u[r * kp + first + a] = self.x[base + r][a] * self.inv_radius;
            }
        }
    }
}

/// The forward pass of a range of samples; all slices are cut to that range.
struct SdfForwardTask<'a> {
    inputs: Inputs<'a>,
    jacobian: &'a [JacobianBlock], // of all samples
    soften: f32,
    u: &'a mut [f32],
    h: &'a mut [f32],
    q: Vec<&'a mut [[f32; 2]]>, // of each level
    o: &'a mut [f32],
    out: &'a mut [f32],
}

/// Replaces `z` by h = softplus₁₀₀(z + b) and writes a = w ⊙ sigmoid(100 (z + b)), sharing one
/// exponential.
#[inline(always)]
fn activate<const F: bool>(z: &mut [f32], a: &mut [f32], b: &[f32; HIDDEN], w: &[f32; HIDDEN]) {
    for (z, a) in z.as_chunks_mut::<HIDDEN>().0.iter_mut().zip(a.as_chunks_mut::<HIDDEN>().0) {
        for j in 0..HIDDEN {
            let v = z[j] + b[j];
            let e = exp::<F>(-(100.0 * v).abs());
            let inverse = 1.0 / (1.0 + e);
            a[j] = w[j] * if v >= 0.0 { inverse } else { e * inverse };
            z[j] = v.max(0.0) + 0.01 * ln_1p::<F>(e);
        }
    }
}

#[inline(always)]
fn forward_body<const F: bool>(t: &mut SdfForwardTask, w: &Weights) {
    let kp = w.layout.padded();
    let inputs = &t.inputs;
    let first = 2 * inputs.levels;
    let samples = inputs.x.len();
    let mut a = [0f32; TILE * HIDDEN];
    let mut q = vec![0f32; TILE * kp];
    for tile in 0..samples.div_ceil(TILE) {
        let base = tile * TILE;
        let rows = TILE.min(samples - base);
        let u = &mut t.u[base * kp..][..TILE * kp];
        u.fill(0.0);
        inputs.fill(u, kp, base, rows);
        let u = &*u;
        let h = &mut t.h[base * HIDDEN..][..TILE * HIDDEN];
        gemm((TILE, HIDDEN, kp), u, (kp, 1), &w.w1.t, HIDDEN, h, HIDDEN, false);
        activate::<F>(h, &mut a, &w.b1, w.output_row(0));
        let out16 = OUTPUTS_PADDED;
        let o = &mut t.o[base * out16..][..TILE * out16];
        gemm((TILE, out16, HIDDEN), h, (HIDDEN, 1), &w.w2.t, out16, o, out16, false);
        for row in o.as_chunks_mut::<OUTPUTS_PADDED>().0 {
            for j in 0..OUTPUTS_PADDED {
                row[j] += w.b2[j];
            }
        }
        gemm((TILE, kp, HIDDEN), &a, (HIDDEN, 1), &w.w1.m, kp, &mut q, kp, false);
        let mut n: [[f32; TILE]; 3] =
            std::array::from_fn(|k| std::array::from_fn(|r| q[r * kp + first + k] * inputs.inv_radius));
        for (l, level_q) in t.q.iter_mut().enumerate() {
            let jacobian = &t.jacobian[inputs.first_block(l, base)..][..rows.div_ceil(LANES)];
            for (b, j) in jacobian.iter().enumerate() {
                let pair: [[f32; LANES]; 2] =
                    std::array::from_fn(|c| std::array::from_fn(|i| q[(b * LANES + i) * kp + 2 * l + c]));
                for (k, n) in n.iter_mut().enumerate() {
                    for i in 0..LANES {
                        let n = &mut n[b * LANES + i];
                        *n = fma::<F>(j[k][i], pair[0][i], fma::<F>(j[3 + k][i], pair[1][i], *n));
                    }
                }
            }
            for (r, pair) in level_q[base..][..rows].iter_mut().enumerate() {
                *pair = [q[r * kp + 2 * l], q[r * kp + 2 * l + 1]];
            }
        }
        let mut soft = [0f32; TILE];
        for r in 0..TILE {
            soft[r] = softened::<F>(t.soften, o[r * out16 + SOFTNESS]);
        }
        for r in 0..rows {
            let out = &mut t.out[(base + r) * WIDTH..][..WIDTH];
            out.copy_from_slice(&[o[r * out16], n[0][r], n[1][r], n[2][r], 0.0, 0.0, 0.0, soft[r]]);
        }
    }
}

dispatch! { fn forward_task / forward_body(t: &mut SdfForwardTask, w: &Weights) }

/// Evaluates sdf, gradient and local sharpness at points, and keeps the activations that the
/// backward pass needs. Colors are zero until [`Activations::shade`].
///
/// # Shapes
///
/// - table: `[entries, 2]`; weights: prepared from the flat `[P]`
/// - x: `[n, 3]` in the field's box
/// - output: `[n, 8]` = sdf, ∇sdf (3, field units), zeros (3), ln of the local sharpness
pub fn geometry(shape: &FieldShape, table: &[[f32; 2]], weights: &Weights, x: &[[f32; 3]]) -> Activations {
    let n = x.len();
    let np = n.next_multiple_of(TILE);
    let levels = shape.levels.len();
    let kp = weights.layout.padded();
    let x01 = shape.x01(x);
    let mut value = Buffer::scratch(levels * n * 2);
    let block_floats = n.div_ceil(LANES) * 6 * LANES;
    let mut jacobian = Buffer::scratch(levels * block_floats);
    let active = &shape.levels[..shape.active];
    hash::gather(
        active,
        table,
        &x01,
        shape.world(),
        bytemuck::cast_slice_mut(&mut value[..active.len() * n * 2]),
        Some(bytemuck::cast_slice_mut(&mut jacobian[..active.len() * block_floats])),
    );
    let mut u = Buffer::scratch(np * kp);
    let mut q = Buffer::scratch(active.len() * n * 2);
    let mut h = Buffer::scratch(np * HIDDEN);
    let mut o = Buffer::scratch(np * OUTPUTS_PADDED);
    let mut out = Buffer::scratch(n * WIDTH);
    let widths = [kp, HIDDEN, OUTPUTS_PADDED, WIDTH];
    let mut cut = pieces([&mut u, &mut h, &mut o, &mut out], widths, CHUNK);
    let q_of_chunks = by_chunk(bytemuck::cast_slice_mut(&mut q), n, CHUNK);
    let jacobian_blocks = bytemuck::cast_slice(&jacobian);
    let mut tasks: Vec<SdfForwardTask> = (0..n)
        .step_by(CHUNK)
        .zip(q_of_chunks)
        .map(|(start, q)| {
            let range = start..(start + CHUNK).min(n);
            let inputs = Inputs::new(shape, x, &value, range);
            let [u, h, o, out] = cut();
            let (jacobian, soften) = (jacobian_blocks, shape.soften);
            SdfForwardTask { inputs, jacobian, soften, u, h, q, o, out }
        })
        .collect();
    tasks.par_iter_mut().for_each(|t| forward_task(t, weights));
    drop((tasks, cut));
    drop(value);
    let shaded = Shaded::default();
    Activations { shape: shape.clone(), samples: n, x01, jacobian, q, u, h, o, shaded, out }
}

/// Evaluates sdf, gradient, local sharpness and color at points: [`geometry`], then
/// [`Activations::shade`] of all of them.
///
/// # Shapes
///
/// - x: `[n, 3]` in the field's box; direction: `[n, 3]` unit, away from the camera
/// - output: `[n, 8]` = sdf, ∇sdf (3, field units), rgb (3, sRGB-coded, 0..1), ln of the local
///   sharpness
pub fn forward(
    shape: &FieldShape,
    table: &[[f32; 2]],
    weights: &Weights,
    x: &[[f32; 3]],
    direction: &[[f32; 3]],
) -> Activations {
    assert_eq!(x.len(), direction.len());
    let mut activations = geometry(shape, table, weights, x);
    activations.shade(weights, (0..x.len() as u32).collect(), direction);
    activations
}

impl Activations {
    /// Returns the output of the field, `[n, 8]`: see [`geometry`] and [`forward`].
    pub fn output(&self) -> &[f32] {
        &self.out
    }
}

#[cfg(test)]
pub mod tests;
