//! The hand-written backward pass of the fused signed-distance field; [`super`] has its formulas.

use super::{Activations, CHUNK, WIDTH};
use crate::dispatch;
use crate::kernel::cpu::hash;
use crate::kernel::cpu::matrix::add_to;
use crate::kernel::cpu::mlp::{
    COLOR_INPUTS, HIDDEN, OUTPUTS, OUTPUTS_PADDED, RGB_PADDED, SOFTNESS, TILE, Weights,
};
use crate::kernel::cpu::neus::MIN_GRADIENT_NORM;
use crate::kernel::cpu::pool::Buffer;
use crate::kernel::cpu::simd::{exp, gemm};
use rayon::prelude::*;

/// The backward pass of a range of samples.
struct SdfBackwardTask<'a> {
    start: usize,
    g_out: &'a [f32],
    g_value: &'a mut [f32],       // [n, 2L], row-major, transposed afterwards
    g_normal: &'a mut [[f32; 3]], // [n, 3]
    /// Gradients with respect to the matrices, in the shapes of [`Layout::gradient_shapes`](crate::kernel::cpu::mlp::Layout::gradient_shapes).
    gradients: [Vec<f32>; 7],
}

#[inline(always)]
fn backward_body<const F: bool>(t: &mut SdfBackwardTask, a: &Activations, w: &Weights) {
    let (kp, ci) = (w.layout.padded(), w.layout.color_padded());
    let levels = a.shape.levels.len();
    let features = 2 * levels;
    let features_padded = features.next_multiple_of(8);
    let inv_radius = 1.0 / a.shape.radius;
    let total = a.samples;
    let [g_w1, g_b1, g_w2, g_b2, g_c1_weights, g_c2_weights, g_c3_weights] = &mut t.gradients;
    let mut g_pre = [0f32; TILE * RGB_PADDED];
    let mut g_c2 = [0f32; TILE * HIDDEN];
    let mut g_c1 = [0f32; TILE * HIDDEN];
    let mut g_c0 = vec![0f32; TILE * ci];
    let mut g_o = [0f32; TILE * OUTPUTS_PADDED];
    let mut g_q = vec![0f32; TILE * kp];
    let mut g_u = vec![0f32; TILE * kp];
    let mut s = [0f32; TILE * HIDDEN];
    let mut weighted = [0f32; TILE * HIDDEN]; // a = w ⊙ s
    let mut g_a = [0f32; TILE * HIDDEN];
    let mut g_z = [0f32; TILE * HIDDEN];
    for tile in 0..t.g_normal.len().div_ceil(TILE) {
        let base = t.start + tile * TILE;
        let rows = TILE.min(t.g_normal.len() - tile * TILE);
        let h = &a.h[base * HIDDEN..][..TILE * HIDDEN];
        let u = &a.u[base * kp..][..TILE * kp];
        let c0 = &a.c0[base * ci..][..TILE * ci];
        let c1 = &a.c1[base * HIDDEN..][..TILE * HIDDEN];
        let c2 = &a.c2[base * HIDDEN..][..TILE * HIDDEN];
        let g_out = &t.g_out[tile * TILE * WIDTH..][..rows * WIDTH];
        let out = &a.out[base * WIDTH..][..rows * WIDTH];

        // color network; rows beyond the last sample carry zero gradients and vanish
        g_pre.fill(0.0);
        for r in 0..rows {
            for c in 0..3 {
                let y = out[r * WIDTH + 4 + c];
                g_pre[r * RGB_PADDED + c] = g_out[r * WIDTH + 4 + c] * y * (1.0 - y);
            }
        }
        gemm::<F>((4, HIDDEN, TILE), &g_pre, (1, RGB_PADDED), c2, HIDDEN, g_c3_weights, HIDDEN, true);
        gemm::<F>((TILE, HIDDEN, 3), &g_pre, (RGB_PADDED, 1), &w.c3.m, HIDDEN, &mut g_c2, HIDDEN, false);
        for i in 0..TILE * HIDDEN {
            g_c2[i] = if c2[i] > 0.0 { g_c2[i] } else { 0.0 };
        }
        gemm::<F>((HIDDEN, HIDDEN, TILE), &g_c2, (1, HIDDEN), c1, HIDDEN, g_c2_weights, HIDDEN, true);
        gemm::<F>((TILE, HIDDEN, HIDDEN), &g_c2, (HIDDEN, 1), &w.c2.m, HIDDEN, &mut g_c1, HIDDEN, false);
        for i in 0..TILE * HIDDEN {
            g_c1[i] = if c1[i] > 0.0 { g_c1[i] } else { 0.0 };
        }
        gemm::<F>((HIDDEN, ci, TILE), &g_c1, (1, HIDDEN), c0, ci, g_c1_weights, ci, true);
        gemm::<F>((TILE, ci, HIDDEN), &g_c1, (HIDDEN, 1), &w.c1.m, ci, &mut g_c0, ci, false);

        // outputs of the geometry network and the spatial gradient
        g_o.fill(0.0);
        g_q.fill(0.0);
        for r in 0..rows {
            let from_color = &g_c0[r * ci..][..ci];
            g_o[r * OUTPUTS_PADDED..][..OUTPUTS].copy_from_slice(&from_color[..OUTPUTS]);
            g_o[r * OUTPUTS_PADDED] += g_out[r * WIDTH];
            // through y = −L σ, whose slope is y (1 + y / L)
            if a.shape.soften > 0.0 {
                let y = out[r * WIDTH + 7];
                g_o[r * OUTPUTS_PADDED + SOFTNESS] += g_out[r * WIDTH + 7] * y * (1.0 + y / a.shape.soften);
            }
            // through n̂ = n / ‖n‖: (g − n̂ (n̂ · g)) / ‖n‖
            let raw = &out[r * WIDTH + 1..][..3];
            let length = (raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2]).sqrt().max(1e-12);
            let unit: [f32; 3] = std::array::from_fn(|k| raw[k] / length);
            let gn = &from_color[OUTPUTS + 16..COLOR_INPUTS];
            let radial = unit[0] * gn[0] + unit[1] * gn[1] + unit[2] * gn[2];
            let n: [f32; 3] = std::array::from_fn(|k| {
                let through_normal =
                    if length > MIN_GRADIENT_NORM { (gn[k] - unit[k] * radial) / length } else { 0.0 };
                g_out[r * WIDTH + 1 + k] + through_normal
            });
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
                a[j] = s[j] * w.w2.m[j];
            }
        }
        gemm::<F>((TILE, HIDDEN, kp), &g_q, (kp, 1), &w.w1.t, HIDDEN, &mut g_a, HIDDEN, false);
        let (go, op) = (&g_o, OUTPUTS_PADDED);
        gemm::<F>((TILE, HIDDEN, OUTPUTS), go, (op, 1), &w.w2.m, HIDDEN, &mut g_z, HIDDEN, false);
        gemm::<F>((op, HIDDEN, TILE), go, (1, op), h, HIDDEN, g_w2, HIDDEN, true);
        for r in 0..rows {
            for j in 0..op {
                g_b2[j] += g_o[r * op + j];
            }
            let row = r * HIDDEN..(r + 1) * HIDDEN;
            let (s, g_a, g_z) = (&s[row.clone()], &g_a[row.clone()], &mut g_z[row]);
            for j in 0..HIDDEN {
                g_w2[j] += g_a[j] * s[j];
                g_z[j] = s[j] * (g_z[j] + 100.0 * g_a[j] * w.w2.m[j] * (1.0 - s[j]));
                g_b1[j] += g_z[j];
            }
        }
        g_z[rows * HIDDEN..].fill(0.0);
        gemm::<F>((HIDDEN, kp, TILE), &weighted, (1, HIDDEN), &g_q, kp, g_w1, kp, true);
        gemm::<F>((HIDDEN, kp, TILE), &g_z, (1, HIDDEN), u, kp, g_w1, kp, true);
        let wide = (TILE, features_padded, HIDDEN);
        gemm::<F>(wide, &g_z, (HIDDEN, 1), &w.w1.m, kp, &mut g_u, kp, false);
        for r in 0..rows {
            let g_features_row = &mut t.g_value[(tile * TILE + r) * features..][..features];
            g_features_row.copy_from_slice(&g_u[r * kp..][..features]);
            if w.layout.color_skip {
                let skipped = &g_c0[r * ci + COLOR_INPUTS..][..features];
                g_features_row.iter_mut().zip(skipped).for_each(|(g, s)| *g += s);
            }
        }
    }
}

dispatch! { fn backward_task / backward_body(t: &mut SdfBackwardTask, a: &Activations, w: &Weights) }

/// Adds the gradient of a loss with respect to the table to `g_table`, and returns that with respect to the network
/// weights.
///
/// # Shapes
///
/// - g_out: `[n, 8]`, the loss's gradient by the output (the last column is used only if the sharpness is local)
/// - g_table: `[entries, 2]`, added to
/// - output: `[P]`, flat as [`Layout`](crate::kernel::cpu::mlp::Layout) describes
pub fn backward(a: &Activations, w: &Weights, g_out: &[f32], g_table: &mut [[f32; 2]]) -> Vec<f32> {
    let n = a.samples;
    assert_eq!(g_out.len(), n * WIDTH);
    let layout = w.layout;
    let padded = layout.gradient_shapes();
    let mut flat = vec![0.0; layout.len()];
    if n == 0 {
        return flat;
    }
    let levels = a.shape.levels.len();
    let features = 2 * levels;
    let mut g_value = Buffer::scratch(n * features);
    let mut g_normal = vec![[0f32; 3]; n];
    let mut tasks: Vec<SdfBackwardTask> = g_value
        .chunks_mut(CHUNK * features)
        .zip(g_normal.chunks_mut(CHUNK))
        .zip(g_out.chunks(CHUNK * WIDTH))
        .enumerate()
        .map(|(i, ((g_value, g_normal), g_out))| SdfBackwardTask {
            start: i * CHUNK,
            g_out,
            g_value,
            g_normal,
            gradients: padded.map(|(rows, columns)| vec![0.0; rows * columns]),
        })
        .collect();
    tasks.par_iter_mut().for_each(|t| backward_task(t, a, w));
    for t in &mut tasks {
        // columns of the first layer are `[hash, x]` in tiles
        for row in t.gradients[0].chunks_exact_mut(layout.padded()) {
            row[..layout.inputs].rotate_right(3);
        }
        let parts: [_; 7] = std::array::from_fn(|k| (&t.gradients[k][..], padded[k].1));
        add_to(&mut flat, &layout.shapes(), &parts);
    }
    drop(tasks);
    let active = &a.shape.levels[..a.shape.active];
    let mut transposed = Buffer::scratch(active.len() * n * 2);
    transposed.par_chunks_mut(n * 2).enumerate().for_each(|(l, out)| {
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
        bytemuck::cast_slice(&transposed),
        bytemuck::cast_slice(&a.q[..active.len() * n * 2]),
        &g_normal,
    );
    flat
}
