//! The fused signed-distance field: hash features → sdf, its spatial gradient, colour; and backward.
//!
//! With `F` the hash features, `J = dF/dx`, `u = [F, x]`, `w` row 0 of `W2`:
//!
//! ```text
//! z = W1 u + b1     h = softplus₁₀₀(z)     o = W2 h + b2      sdf = o₀
//! s = sigmoid(100 z)     a = w ⊙ s     q = W1ᵀ a              n = ∇sdf = q_x + Jᵀ q_F
//! ```
//!
//! Autodiff is first order only, so `n` is an *output* and the backward includes everything that used
//! it (NeuS alpha, colour, eikonal). Given `g_o` and `g_n`:
//!
//! ```text
//! g_q = [J g_n, g_n]     g_a = W1 g_q     g_W1 += a g_qᵀ + g_z uᵀ     g_w += g_a ⊙ s
//! g_z = (W2ᵀ g_o) ⊙ s + 100 g_a ⊙ w ⊙ s ⊙ (1 − s)     g_F = (W1ᵀ g_z)_F
//! table[corner] += g_F w + q_F (g_n · ∇w)
//! ```
//!
//! Only `h` is kept of `z`, `h`, `s`: `s = 1 − e^{−100 h}`.

use super::hash::{self, Level};
use super::mlp::{
    COLOR_INPUTS, HIDDEN, Layout, OUTPUTS, OUTPUTS_PADDED, RGB_PADDED, TILE, WeightGradients, Weights,
};
use super::pool::Buffer;
use super::simd::{exp, gemm, ln_1p, sigmoid};
use super::sphharm::sh16;
use crate::dispatch;
use rayon::prelude::*;

/// Values per sample of the field's output: sdf, gradient (3), colour (3), one zero.
pub const WIDTH: usize = 8;

/// Shape of the field: its grid and the half edge of its box.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldShape {
    /// Levels of the hash grid.
    pub levels: Vec<Level>,
    /// The field lives in `[-radius, radius]³`; the networks see positions divided by it.
    pub radius: f32,
    /// Hash levels that take part (the rest read as zero): coarse-to-fine training.
    pub active: usize,
}

impl FieldShape {
    /// Layout of the network weights.
    pub fn layout(&self) -> Layout {
        Layout::new(self.levels.len())
    }

    /// d x01 / d position.
    fn world(&self) -> f32 {
        0.5 / self.radius
    }

    fn x01(&self, x: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let k = self.world();
        x.iter().map(|p| p.map(|c| c * k + 0.5)).collect()
    }
}

/// What the backward needs of a forward.
#[derive(Clone, Debug)]
pub struct Activations {
    shape: FieldShape,
    samples: usize,
    x01: Vec<[f32; 3]>,
    jacobian: Buffer, // [levels, n, 6]
    q: Buffer,        // [levels, n, 2]
    u: Buffer,        // [np, kp]; np = n rounded up to whole tiles
    h: Buffer,        // [np, 64]
    c0: Buffer,       // [np, 32] colour inputs
    c1: Buffer,       // [np, 64]
    c2: Buffer,       // [np, 64]
    out: Buffer,      // [n, 8]
}

/// Samples a task handles: fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 16 * TILE;

/// A piece of the forward: `n` samples starting at `start` of all, storage already cut to it.
struct ForwardTask<'a> {
    start: usize,
    n: usize,
    total: usize,
    levels: usize,
    active: usize,
    inv_radius: f32,
    x: &'a [[f32; 3]],
    direction: Option<&'a [[f32; 3]]>,
    value: &'a [f32],
    jacobian: &'a [f32],
    u: &'a mut [f32],
    h: &'a mut [f32],
    q: &'a mut [f32], // [n, kp]
    c0: &'a mut [f32],
    c1: &'a mut [f32],
    c2: &'a mut [f32],
    out: &'a mut [f32],
}

#[inline(always)]
fn fill_inputs(t: &ForwardTask, u: &mut [f32], kp: usize, base: usize, rows: usize) {
    u[..TILE * kp].fill(0.0);
    for l in 0..t.active {
        let v = &t.value[(l * t.total + t.start + base) * 2..][..rows * 2];
        for r in 0..rows {
            u[r * kp + 2 * l] = v[2 * r];
            u[r * kp + 2 * l + 1] = v[2 * r + 1];
        }
    }
    let first = 2 * t.levels;
    for r in 0..rows {
        for a in 0..3 {
            u[r * kp + first + a] = t.x[base + r][a] * t.inv_radius;
        }
    }
}

/// h = softplus(z + b), s = sigmoid(100 (z + b)), sharing one exponential. Rows of 64.
#[inline(always)]
fn activate<const F: bool>(z: &mut [f32], s: &mut [f32], b: &[f32]) {
    for (z, s) in z.chunks_exact_mut(HIDDEN).zip(s.chunks_exact_mut(HIDDEN)) {
        for j in 0..HIDDEN {
            let v = z[j] + b[j];
            let e = exp::<F>(-(100.0 * v).abs());
            let inverse = 1.0 / (1.0 + e);
            s[j] = if v >= 0.0 { inverse } else { e * inverse };
            z[j] = v.max(0.0) + 0.01 * ln_1p::<F>(e);
        }
    }
}

#[inline(always)]
fn forward_body<const F: bool>(t: &mut ForwardTask, w: &Weights) {
    let kp = w.layout.padded();
    let first = 2 * t.levels;
    let mut s = [0f32; TILE * HIDDEN];
    let mut o = [0f32; TILE * OUTPUTS_PADDED];
    let mut rgb = [0f32; TILE * RGB_PADDED];
    for tile in 0..t.n.div_ceil(TILE) {
        let base = tile * TILE;
        let rows = TILE.min(t.n - base);
        let u = std::mem::take(&mut t.u);
        fill_inputs(t, &mut u[base * kp..], kp, base, rows);
        t.u = u;
        let u = &t.u[base * kp..][..TILE * kp];
        let h = &mut t.h[base * HIDDEN..][..TILE * HIDDEN];
        gemm::<F>((TILE, HIDDEN, kp), u, (kp, 1), &w.w1t, HIDDEN, h, HIDDEN, false);
        activate::<F>(h, &mut s, &w.b1);
        let out16 = OUTPUTS_PADDED;
        gemm::<F>((TILE, out16, HIDDEN), h, (HIDDEN, 1), &w.w2t, out16, &mut o, out16, false);
        for row in o.chunks_exact_mut(out16) {
            for j in 0..out16 {
                row[j] += w.b2[j];
            }
        }
        // a = w ⊙ s in place, then q = a W1
        for row in s.chunks_exact_mut(HIDDEN) {
            for j in 0..HIDDEN {
                row[j] *= w.w2[j];
            }
        }
        let q = &mut t.q[base * kp..][..TILE * kp];
        gemm::<F>((TILE, kp, HIDDEN), &s, (HIDDEN, 1), &w.w1, kp, q, kp, false);
        let mut n = [[0f32; 3]; TILE];
        for r in 0..rows {
            n[r] = std::array::from_fn(|a| q[r * kp + first + a] * t.inv_radius);
        }
        for l in 0..t.active {
            let j = &t.jacobian[(l * t.total + t.start + base) * 6..][..rows * 6];
            for r in 0..rows {
                let (q0, q1) = (q[r * kp + 2 * l], q[r * kp + 2 * l + 1]);
                for a in 0..3 {
                    n[r][a] += j[6 * r + a] * q0 + j[6 * r + 3 + a] * q1;
                }
            }
        }
        let c0 = &mut t.c0[base * COLOR_INPUTS..][..TILE * COLOR_INPUTS];
        if let Some(direction) = t.direction {
            for r in 0..rows {
                let row = &mut c0[r * COLOR_INPUTS..][..COLOR_INPUTS];
                row[..OUTPUTS].copy_from_slice(&o[r * out16..][..OUTPUTS]);
                row[OUTPUTS..OUTPUTS + 16].copy_from_slice(&sh16(direction[base + r]));
                row[OUTPUTS + 16..].copy_from_slice(&unit(n[r]));
            }
            c0[rows * COLOR_INPUTS..].fill(0.0);
            let c1 = &mut t.c1[base * HIDDEN..][..TILE * HIDDEN];
            let inner = (TILE, HIDDEN, COLOR_INPUTS);
            gemm::<F>(inner, c0, (COLOR_INPUTS, 1), &w.c1t, HIDDEN, c1, HIDDEN, false);
            c1.iter_mut().for_each(|v| *v = v.max(0.0));
            let c2 = &mut t.c2[base * HIDDEN..][..TILE * HIDDEN];
            gemm::<F>((TILE, HIDDEN, HIDDEN), c1, (HIDDEN, 1), &w.c2t, HIDDEN, c2, HIDDEN, false);
            c2.iter_mut().for_each(|v| *v = v.max(0.0));
            let last = (TILE, RGB_PADDED, HIDDEN);
            gemm::<F>(last, c2, (HIDDEN, 1), &w.c3t, RGB_PADDED, &mut rgb, RGB_PADDED, false);
            rgb.iter_mut().for_each(|v| *v = sigmoid::<F>(*v));
        }
        for r in 0..rows {
            let (c, out) = (&rgb[r * RGB_PADDED..], &mut t.out[(base + r) * WIDTH..][..WIDTH]);
            out.copy_from_slice(&[o[r * out16], n[r][0], n[r][1], n[r][2], c[0], c[1], c[2], 0.0]);
        }
    }
}

dispatch! { fn forward_task / forward_body(t: &mut ForwardTask, w: &Weights) }

/// v / ‖v‖, zero for a (nearly) zero vector: torch's `normalize` with ε = 1e-12.
#[inline(always)]
fn unit(v: [f32; 3]) -> [f32; 3] {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt().max(1e-12);
    v.map(|c| c / length)
}

/// Sdf, gradient and colour at points, and what the backward needs.
///
/// # Shapes
///
/// - table: `[entries, 2]`; weights: prepared from the flat `[P]`
/// - x: `[n, 3]` in the field's box; direction: `[n, 3]` unit, away from the camera
/// - output: `[n, 8]` = sdf, ∇sdf (3, field units), rgb (3, sRGB-coded, 0..1), 0
pub fn forward(
    shape: &FieldShape,
    table: &[[f32; 2]],
    weights: &Weights,
    x: &[[f32; 3]],
    direction: &[[f32; 3]],
) -> Activations {
    assert_eq!(x.len(), direction.len());
    run(shape, table, weights, x, Some(direction))
}

fn run(
    shape: &FieldShape,
    table: &[[f32; 2]],
    weights: &Weights,
    x: &[[f32; 3]],
    direction: Option<&[[f32; 3]]>,
) -> Activations {
    let n = x.len();
    let np = n.next_multiple_of(TILE);
    let levels = shape.levels.len();
    let kp = weights.layout.padded();
    let x01 = shape.x01(x);
    let mut value = Buffer::scratch(levels * n * 2);
    let mut jacobian = Buffer::scratch(levels * n * 6);
    let active = &shape.levels[..shape.active];
    hash::gather(
        active,
        table,
        &x01,
        shape.world(),
        bytemuck::cast_slice_mut(&mut value[..active.len() * n * 2]),
        Some(bytemuck::cast_slice_mut(&mut jacobian[..active.len() * n * 6])),
    );
    let color = direction.is_some();
    let mut u = Buffer::scratch(np * kp);
    let mut qr = Buffer::scratch(np * kp);
    let mut h = Buffer::scratch(np * HIDDEN);
    let mut c0 = Buffer::scratch(np * COLOR_INPUTS);
    let mut c1 = Buffer::scratch(if color { np * HIDDEN } else { 0 });
    let mut c2 = Buffer::scratch(if color { np * HIDDEN } else { 0 });
    let mut out = Buffer::scratch(n * WIDTH);
    // chunks_mut on an empty buffer gives no items, which would end the zip: give it width instead
    let piece = |width: usize| CHUNK * width;
    let mut tasks: Vec<ForwardTask> = Vec::with_capacity(n.div_ceil(CHUNK));
    {
        let mut us = u.chunks_mut(piece(kp));
        let mut qs = qr.chunks_mut(piece(kp));
        let mut hs = h.chunks_mut(piece(HIDDEN));
        let mut c0s = c0.chunks_mut(piece(COLOR_INPUTS));
        let mut c1s = c1.chunks_mut(piece(HIDDEN));
        let mut c2s = c2.chunks_mut(piece(HIDDEN));
        let mut outs = out.chunks_mut(piece(WIDTH));
        for start in (0..n).step_by(CHUNK) {
            let count = CHUNK.min(n - start);
            tasks.push(ForwardTask {
                start,
                n: count,
                total: n,
                levels,
                active: shape.active,
                inv_radius: 1.0 / shape.radius,
                x: &x[start..start + count],
                direction: direction.map(|d| &d[start..start + count]),
                value: &value,
                jacobian: &jacobian,
                u: us.next().unwrap_or_default(),
                h: hs.next().unwrap_or_default(),
                q: qs.next().unwrap_or_default(),
                c0: c0s.next().unwrap_or_default(),
                c1: c1s.next().unwrap_or_default(),
                c2: c2s.next().unwrap_or_default(),
                out: outs.next().unwrap_or_default(),
            });
        }
    }
    tasks.par_iter_mut().for_each(|t| forward_task(t, weights));
    drop(tasks);
    drop(value);
    // the scatter reads q level by level
    let mut q = Buffer::scratch(levels * n * 2);
    q.par_chunks_mut(n.max(1) * 2).enumerate().for_each(|(l, q)| {
        for s in 0..n {
            q[2 * s] = qr[s * kp + 2 * l];
            q[2 * s + 1] = qr[s * kp + 2 * l + 1];
        }
    });
    Activations { shape: shape.clone(), samples: n, x01, jacobian, q, u, h, c0, c1, c2, out }
}

impl Activations {
    /// `[n, 8]`: see [`forward`].
    pub fn output(&self) -> &[f32] {
        &self.out
    }
}

/// A piece of the backward.
struct BackwardTask<'a> {
    start: usize,
    n: usize,
    g_out: &'a [f32],
    g_value: &'a mut [f32],       // [n, 2L], row-major, turned afterwards
    g_normal: &'a mut [[f32; 3]], // [n, 3]
    gradients: WeightGradients,
}

#[inline(always)]
fn backward_body<const F: bool>(t: &mut BackwardTask, a: &Activations, w: &Weights) {
    let kp = w.layout.padded();
    let levels = a.shape.levels.len();
    let features = 2 * levels;
    let features_padded = features.next_multiple_of(8);
    let inv_radius = 1.0 / a.shape.radius;
    let total = a.samples;
    let g = &mut t.gradients;
    let mut g_pre = [0f32; TILE * RGB_PADDED];
    let mut g_c2 = [0f32; TILE * HIDDEN];
    let mut g_c1 = [0f32; TILE * HIDDEN];
    let mut g_c0 = [0f32; TILE * COLOR_INPUTS];
    let mut g_o = [0f32; TILE * OUTPUTS_PADDED];
    let mut g_q = vec![0f32; TILE * kp];
    let mut g_u = vec![0f32; TILE * kp];
    let mut s = [0f32; TILE * HIDDEN];
    let mut weighted = [0f32; TILE * HIDDEN]; // a = w ⊙ s
    let mut g_a = [0f32; TILE * HIDDEN];
    let mut g_z = [0f32; TILE * HIDDEN];
    for tile in 0..t.n.div_ceil(TILE) {
        let base = t.start + tile * TILE;
        let rows = TILE.min(t.n - tile * TILE);
        let h = &a.h[base * HIDDEN..][..TILE * HIDDEN];
        let u = &a.u[base * kp..][..TILE * kp];
        let c0 = &a.c0[base * COLOR_INPUTS..][..TILE * COLOR_INPUTS];
        let c1 = &a.c1[base * HIDDEN..][..TILE * HIDDEN];
        let c2 = &a.c2[base * HIDDEN..][..TILE * HIDDEN];
        let g_out = &t.g_out[tile * TILE * WIDTH..][..rows * WIDTH];
        let out = &a.out[base * WIDTH..][..rows * WIDTH];

        // colour network; rows beyond the last sample carry zero gradients and vanish
        g_pre.fill(0.0);
        for r in 0..rows {
            for c in 0..3 {
                let y = out[r * WIDTH + 4 + c];
                g_pre[r * RGB_PADDED + c] = g_out[r * WIDTH + 4 + c] * y * (1.0 - y);
            }
        }
        gemm::<F>((4, HIDDEN, TILE), &g_pre, (1, RGB_PADDED), c2, HIDDEN, &mut g.c3, HIDDEN, true);
        gemm::<F>((TILE, HIDDEN, 3), &g_pre, (RGB_PADDED, 1), &w.c3, HIDDEN, &mut g_c2, HIDDEN, false);
        for i in 0..TILE * HIDDEN {
            g_c2[i] = if c2[i] > 0.0 { g_c2[i] } else { 0.0 };
        }
        gemm::<F>((HIDDEN, HIDDEN, TILE), &g_c2, (1, HIDDEN), c1, HIDDEN, &mut g.c2, HIDDEN, true);
        gemm::<F>((TILE, HIDDEN, HIDDEN), &g_c2, (HIDDEN, 1), &w.c2, HIDDEN, &mut g_c1, HIDDEN, false);
        for i in 0..TILE * HIDDEN {
            g_c1[i] = if c1[i] > 0.0 { g_c1[i] } else { 0.0 };
        }
        let ci = COLOR_INPUTS;
        gemm::<F>((HIDDEN, ci, TILE), &g_c1, (1, HIDDEN), c0, ci, &mut g.c1, ci, true);
        gemm::<F>((TILE, ci, HIDDEN), &g_c1, (HIDDEN, 1), &w.c1, ci, &mut g_c0, ci, false);

        // outputs of the geometry network and the spatial gradient
        g_o.fill(0.0);
        g_q.fill(0.0);
        for r in 0..rows {
            let from_color = &g_c0[r * ci..][..ci];
            g_o[r * OUTPUTS_PADDED..][..OUTPUTS].copy_from_slice(&from_color[..OUTPUTS]);
            g_o[r * OUTPUTS_PADDED] += g_out[r * WIDTH];
            // through n̂ = n / ‖n‖: (g − n̂ (n̂ · g)) / ‖n‖
            let raw = &out[r * WIDTH + 1..][..3];
            let length = (raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2]).sqrt().max(1e-12);
            let unit: [f32; 3] = std::array::from_fn(|k| raw[k] / length);
            let gn = &from_color[OUTPUTS + 16..];
            let along = unit[0] * gn[0] + unit[1] * gn[1] + unit[2] * gn[2];
            let n: [f32; 3] =
                std::array::from_fn(|k| g_out[r * WIDTH + 1 + k] + (gn[k] - unit[k] * along) / length);
            t.g_normal[tile * TILE + r] = n;
            for k in 0..3 {
                g_q[r * kp + features + k] = n[k] * inv_radius;
            }
        }
        for l in 0..a.shape.active {
            let j = &a.jacobian[(l * total + base) * 6..][..rows * 6];
            for r in 0..rows {
                let n = t.g_normal[tile * TILE + r];
                let j = &j[6 * r..][..6];
                g_q[r * kp + 2 * l] = j[0] * n[0] + j[1] * n[1] + j[2] * n[2];
                g_q[r * kp + 2 * l + 1] = j[3] * n[0] + j[4] * n[1] + j[5] * n[2];
            }
        }
        for (row, (s, a)) in
            h.chunks_exact(HIDDEN).zip(s.chunks_exact_mut(HIDDEN).zip(weighted.chunks_exact_mut(HIDDEN)))
        {
            for j in 0..HIDDEN {
                s[j] = 1.0 - exp::<F>(-100.0 * row[j]);
                a[j] = s[j] * w.w2[j];
            }
        }
        gemm::<F>((TILE, HIDDEN, kp), &g_q, (kp, 1), &w.w1t, HIDDEN, &mut g_a, HIDDEN, false);
        let (go, op) = (&g_o, OUTPUTS_PADDED);
        gemm::<F>((TILE, HIDDEN, OUTPUTS), go, (op, 1), &w.w2, HIDDEN, &mut g_z, HIDDEN, false);
        gemm::<F>((op, HIDDEN, TILE), go, (1, op), h, HIDDEN, &mut g.w2, HIDDEN, true);
        for r in 0..rows {
            for j in 0..op {
                g.b2[j] += g_o[r * op + j];
            }
            let row = r * HIDDEN..(r + 1) * HIDDEN;
            let (s, g_a, g_z) = (&s[row.clone()], &g_a[row.clone()], &mut g_z[row]);
            for j in 0..HIDDEN {
                g.w2[j] += g_a[j] * s[j];
                g_z[j] = s[j] * (g_z[j] + 100.0 * g_a[j] * w.w2[j] * (1.0 - s[j]));
                g.b1[j] += g_z[j];
            }
        }
        g_z[rows * HIDDEN..].fill(0.0);
        gemm::<F>((HIDDEN, kp, TILE), &weighted, (1, HIDDEN), &g_q, kp, &mut g.w1, kp, true);
        gemm::<F>((HIDDEN, kp, TILE), &g_z, (1, HIDDEN), u, kp, &mut g.w1, kp, true);
        let wide = (TILE, features_padded, HIDDEN);
        gemm::<F>(wide, &g_z, (HIDDEN, 1), &w.w1, kp, &mut g_u, kp, false);
        for r in 0..rows {
            t.g_value[(tile * TILE + r) * features..][..features].copy_from_slice(&g_u[r * kp..][..features]);
        }
    }
}

dispatch! { fn backward_task / backward_body(t: &mut BackwardTask, a: &Activations, w: &Weights) }

/// Gradients of a loss with respect to table and network weights.
///
/// # Shapes
///
/// - g_out: `[n, 8]`, the loss's gradient by the output (the last column is ignored)
/// - g_table: `[entries, 2]`, added to
/// - output: `[P]`, flat as [`Layout`] describes
pub fn backward(a: &Activations, w: &Weights, g_out: &[f32], g_table: &mut [[f32; 2]]) -> Vec<f32> {
    let n = a.samples;
    assert_eq!(g_out.len(), n * WIDTH);
    let layout = w.layout;
    let mut flat = vec![0.0; layout.len()];
    if n == 0 {
        return flat;
    }
    let levels = a.shape.levels.len();
    let features = 2 * levels;
    let mut g_value = Buffer::scratch(n * features);
    let mut g_normal = vec![[0f32; 3]; n];
    let mut tasks: Vec<BackwardTask> = g_value
        .chunks_mut(CHUNK * features)
        .zip(g_normal.chunks_mut(CHUNK))
        .zip(g_out.chunks(CHUNK * WIDTH))
        .enumerate()
        .map(|(i, ((g_value, g_normal), g_out))| BackwardTask {
            start: i * CHUNK,
            n: g_normal.len(),
            g_out,
            g_value,
            g_normal,
            gradients: WeightGradients::zeros(layout),
        })
        .collect();
    tasks.par_iter_mut().for_each(|t| backward_task(t, a, w));
    for t in &tasks {
        t.gradients.add_to(layout, &mut flat);
    }
    drop(tasks);
    let active = &a.shape.levels[..a.shape.active];
    let mut turned = Buffer::scratch(active.len() * n * 2);
    turned.par_chunks_mut(n * 2).enumerate().for_each(|(l, out)| {
        for s in 0..n {
            out[2 * s] = g_value[s * features + 2 * l];
            out[2 * s + 1] = g_value[s * features + 2 * l + 1];
        }
    });
    hash::scatter(
        active,
        g_table,
        &a.x01,
        a.shape.world(),
        bytemuck::cast_slice(&turned),
        bytemuck::cast_slice(&a.q[..active.len() * n * 2]),
        &g_normal,
    );
    flat
}

struct ValueTask<'a> {
    start: usize,
    total: usize,
    active: usize,
    levels: usize,
    inv_radius: f32,
    x: &'a [[f32; 3]],
    value: &'a [f32],
    sdf: &'a mut [f32],
}

#[inline(always)]
fn value_body<const F: bool>(t: &mut ValueTask, w: &Weights) {
    let kp = w.layout.padded();
    let first = 2 * t.levels;
    let mut u = vec![0f32; TILE * kp];
    let mut h = [0f32; TILE * HIDDEN];
    for tile in 0..t.x.len().div_ceil(TILE) {
        let base = tile * TILE;
        let rows = TILE.min(t.x.len() - base);
        for l in 0..t.active {
            let v = &t.value[(l * t.total + t.start + base) * 2..][..rows * 2];
            for r in 0..rows {
                u[r * kp + 2 * l] = v[2 * r];
                u[r * kp + 2 * l + 1] = v[2 * r + 1];
            }
        }
        for r in 0..rows {
            for a in 0..3 {
                u[r * kp + first + a] = t.x[base + r][a] * t.inv_radius;
            }
        }
        gemm::<F>((TILE, HIDDEN, kp), &u, (kp, 1), &w.w1t, HIDDEN, &mut h, HIDDEN, false);
        for r in 0..rows {
            let row = &h[r * HIDDEN..][..HIDDEN];
            let mut sum = [0f32; 8];
            for j in 0..HIDDEN {
                let v = row[j] + w.b1[j];
                let soft = v.max(0.0) + 0.01 * ln_1p::<F>(exp::<F>(-(100.0 * v).abs()));
                sum[j % 8] += soft * w.w2[j];
            }
            t.sdf[base + r] = sum.iter().sum::<f32>() + w.b2[0];
        }
    }
}

dispatch! { fn value_task / value_body(t: &mut ValueTask, w: &Weights) }

/// Signed distance alone: a quarter of the work of [`forward`]. `[n, 3]` → `[n]`.
pub fn values(shape: &FieldShape, table: &[[f32; 2]], weights: &Weights, x: &[[f32; 3]]) -> Vec<f32> {
    /// Points per pass: bounds the scratch memory whatever the caller asks for.
    const PASS: usize = 1 << 16;
    let mut sdf = vec![0.0; x.len()];
    let active = &shape.levels[..shape.active];
    for (x, sdf) in x.chunks(PASS).zip(sdf.chunks_mut(PASS)) {
        let n = x.len();
        let mut value = Buffer::scratch(active.len() * n * 2);
        hash::gather(active, table, &shape.x01(x), 1.0, bytemuck::cast_slice_mut(&mut value), None);
        let value = &value[..];
        x.par_chunks(CHUNK).zip(sdf.par_chunks_mut(CHUNK)).enumerate().for_each(|(i, (x, sdf))| {
            let (levels, active) = (shape.levels.len(), shape.active);
            let inv_radius = 1.0 / shape.radius;
            let start = i * CHUNK;
            let mut task = ValueTask { start, total: n, active, levels, inv_radius, x, value, sdf };
            value_task(&mut task, weights);
        });
    }
    sdf
}

struct ColorTask<'a> {
    value: ValueTask<'a>,
    normal: &'a [[f32; 3]],
    direction: &'a [[f32; 3]],
    rgb: &'a mut [[f32; 3]],
}

#[inline(always)]
fn color_body<const F: bool>(task: &mut ColorTask, w: &Weights) {
    let kp = w.layout.padded();
    let t = &task.value;
    let first = 2 * t.levels;
    let mut u = vec![0f32; TILE * kp];
    let mut h = [0f32; TILE * HIDDEN];
    let mut o = [0f32; TILE * OUTPUTS_PADDED];
    let mut c0 = [0f32; TILE * COLOR_INPUTS];
    let mut c1 = [0f32; TILE * HIDDEN];
    let mut rgb = [0f32; TILE * RGB_PADDED];
    for tile in 0..t.x.len().div_ceil(TILE) {
        let base = tile * TILE;
        let rows = TILE.min(t.x.len() - base);
        for l in 0..t.active {
            let v = &t.value[(l * t.total + t.start + base) * 2..][..rows * 2];
            for r in 0..rows {
                u[r * kp + 2 * l] = v[2 * r];
                u[r * kp + 2 * l + 1] = v[2 * r + 1];
            }
        }
        for r in 0..rows {
            for a in 0..3 {
                u[r * kp + first + a] = t.x[base + r][a] * t.inv_radius;
            }
        }
        gemm::<F>((TILE, HIDDEN, kp), &u, (kp, 1), &w.w1t, HIDDEN, &mut h, HIDDEN, false);
        for row in h.chunks_exact_mut(HIDDEN) {
            for j in 0..HIDDEN {
                let v = row[j] + w.b1[j];
                row[j] = v.max(0.0) + 0.01 * ln_1p::<F>(exp::<F>(-(100.0 * v).abs()));
            }
        }
        let op = OUTPUTS_PADDED;
        gemm::<F>((TILE, op, HIDDEN), &h, (HIDDEN, 1), &w.w2t, op, &mut o, op, false);
        for r in 0..rows {
            let row = &mut c0[r * COLOR_INPUTS..][..COLOR_INPUTS];
            (0..OUTPUTS).for_each(|j| row[j] = o[r * op + j] + w.b2[j]);
            row[OUTPUTS..OUTPUTS + 16].copy_from_slice(&sh16(task.direction[base + r]));
            row[OUTPUTS + 16..].copy_from_slice(&task.normal[base + r]);
        }
        let ci = COLOR_INPUTS;
        gemm::<F>((TILE, HIDDEN, ci), &c0, (ci, 1), &w.c1t, HIDDEN, &mut c1, HIDDEN, false);
        c1.iter_mut().for_each(|v| *v = v.max(0.0));
        gemm::<F>((TILE, HIDDEN, HIDDEN), &c1, (HIDDEN, 1), &w.c2t, HIDDEN, &mut h, HIDDEN, false);
        h.iter_mut().for_each(|v| *v = v.max(0.0));
        let last = (TILE, RGB_PADDED, HIDDEN);
        gemm::<F>(last, &h, (HIDDEN, 1), &w.c3t, RGB_PADDED, &mut rgb, RGB_PADDED, false);
        for r in 0..rows {
            task.rgb[base + r] = std::array::from_fn(|c| sigmoid::<F>(rgb[r * RGB_PADDED + c]));
        }
    }
}

dispatch! { fn color_task / color_body(task: &mut ColorTask, w: &Weights) }

/// Colour of points whose unit normals are known (of a mesh's surface): no gradient is computed, a third
/// of the work of [`forward`]. All `[n, 3]`.
pub fn colors(
    shape: &FieldShape,
    table: &[[f32; 2]],
    weights: &Weights,
    x: &[[f32; 3]],
    normal: &[[f32; 3]],
    direction: &[[f32; 3]],
) -> Vec<[f32; 3]> {
    const PASS: usize = 1 << 15;
    assert!(normal.len() == x.len() && direction.len() == x.len());
    let mut rgb = vec![[0f32; 3]; x.len()];
    let active = &shape.levels[..shape.active];
    for (pass, rgb) in rgb.chunks_mut(PASS).enumerate() {
        let n = rgb.len();
        let span = pass * PASS..pass * PASS + n;
        let (x, normal, direction) = (&x[span.clone()], &normal[span.clone()], &direction[span]);
        let mut value = Buffer::scratch(active.len() * n * 2);
        hash::gather(active, table, &shape.x01(x), 1.0, bytemuck::cast_slice_mut(&mut value), None);
        let value = &value[..];
        rgb.par_chunks_mut(CHUNK).enumerate().for_each(|(i, rgb)| {
            let start = i * CHUNK;
            let own = start..start + rgb.len();
            let mut task = ColorTask {
                value: ValueTask {
                    start,
                    total: n,
                    active: shape.active,
                    levels: shape.levels.len(),
                    inv_radius: 1.0 / shape.radius,
                    x: &x[own.clone()],
                    value,
                    sdf: &mut [],
                },
                normal: &normal[own.clone()],
                direction: &direction[own],
                rgb,
            };
            color_task(&mut task, weights);
        });
    }
    rgb
}

/// Signed distance and gradient, no colour: `[n, 3]` → `[n]` pairs.
pub fn gradients(
    shape: &FieldShape,
    table: &[[f32; 2]],
    weights: &Weights,
    x: &[[f32; 3]],
) -> Vec<(f32, [f32; 3])> {
    const PASS: usize = 1 << 15;
    x.chunks(PASS)
        .flat_map(|x| {
            let a = run(shape, table, weights, x, None);
            a.out.chunks_exact(WIDTH).map(|o| (o[0], [o[1], o[2], o[3]])).collect::<Vec<_>>()
        })
        .collect()
}

#[cfg(test)]
#[path = "sdf_tests.rs"]
mod tests;
