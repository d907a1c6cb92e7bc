//! The hand-written backward pass of the fused signed-distance field; [`super`] has its formulas.

use super::color::backward_rows;
use super::{Activations, CHUNK, WIDTH};
use crate::cpu::hash::{self, JacobianBlock, LANES, Lanes};
use crate::cpu::matrix::add_to;
use crate::cpu::mlp::{COLOR_INPUTS, HIDDEN, OUTPUTS, OUTPUTS_PADDED, SOFTNESS, TILE, Weights};
use crate::cpu::neus::MIN_GRADIENT_NORM;
use crate::cpu::pool::{Buffer, by_chunk};
use crate::cpu::simd::{ROWS, exp, fma, gemm};
use rayon::prelude::*;
use tiface_base::dispatch;

/// The backward pass of a range of samples.
struct SdfBackwardTask<'a> {
    chunk: usize,
    g_out: &'a [f32],
    g_value: Vec<&'a mut [[f32; 2]]>, // of each active level
    g_normal: &'a mut [[f32; 3]],     // [n, 3]
    /// Gradients with respect to the matrices, in the shapes of
    /// [`Layout::gradient_shapes`](crate::cpu::mlp::Layout::gradient_shapes).
    gradients: [Vec<f32>; 7],
}

#[inline(always)]
fn backward_body<const F: bool>(t: &mut SdfBackwardTask, a: &Activations, w: &Weights) {
    let (kp, ci) = (w.layout.padded(), w.layout.color_padded());
    let features = 2 * a.shape.levels.len();
    let features_padded = features.next_multiple_of(8);
    let inv_radius = 1.0 / a.shape.radius;
    let blocks = a.samples.div_ceil(LANES);
    let jacobian: &[JacobianBlock] = bytemuck::cast_slice(&a.jacobian);
    let [g_w1, g_b1, g_w2, g_b2, of_color @ ..] = &mut t.gradients;
    let start = t.chunk * CHUNK;
    let mut shaded = a.shaded.samples(t.chunk).iter().map(|&s| s as usize).peekable();
    let mut g_inputs = Buffer::scratch(shaded.len().next_multiple_of(ROWS) * ci);
    backward_rows::<F>(a, w, t.chunk, t.g_out, of_color.each_mut().map(|g| &mut g[..]), &mut g_inputs);
    let mut of_rows = g_inputs.chunks_exact(ci);
    let mut g_c0 = vec![0f32; TILE * ci];
    let mut g_o = [0f32; TILE * OUTPUTS_PADDED];
    let mut g_q = vec![0f32; TILE * kp];
    let mut g_u = vec![0f32; TILE * kp];
    let mut s = [0f32; TILE * HIDDEN];
    let mut weighted = [0f32; TILE * HIDDEN]; // a = w ⊙ s
    let mut g_a = [0f32; TILE * HIDDEN];
    let mut g_z = [0f32; TILE * HIDDEN];
    for tile in 0..t.g_normal.len().div_ceil(TILE) {
        let base = start + tile * TILE;
        let rows = TILE.min(t.g_normal.len() - tile * TILE);
        let h = &a.h[base * HIDDEN..][..TILE * HIDDEN];
        let u = &a.u[base * kp..][..TILE * kp];
        let g_out = &t.g_out[tile * TILE * WIDTH..][..rows * WIDTH];
        let out = &a.out[base * WIDTH..][..rows * WIDTH];

        // from the color network; samples without color give it zeros
        g_c0.fill(0.0);
        while let Some(s) = shaded.next_if(|&s| s < base + rows) {
            let row = of_rows.next().expect("a row for each sample with a color");
            g_c0[(s - base) * ci..][..ci].copy_from_slice(row);
        }

        // outputs of the geometry network and the spatial gradient
        g_o.fill(0.0);
        g_q.fill(0.0);
        let mut normal = [[0f32; TILE]; 3];
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
                normal[k][r] = n[k];
                g_q[r * kp + features + k] = n[k] * inv_radius;
            }
        }
        for l in 0..a.shape.active {
            let jacobian = &jacobian[l * blocks + base / LANES..][..rows.div_ceil(LANES)];
            let rows = g_q.chunks_exact_mut(LANES * kp);
            for ((b, j), rows) in jacobian.iter().enumerate().zip(rows) {
                let n: [&Lanes; 3] = std::array::from_fn(|k| &normal[k].as_chunks().0[b]);
                let mut pair = [[0f32; LANES]; 2];
                for c in 0..2 {
                    let j = [&j[3 * c], &j[3 * c + 1], &j[3 * c + 2]];
                    for i in 0..LANES {
                        pair[c][i] =
                            fma::<F>(j[0][i], n[0][i], fma::<F>(j[1][i], n[1][i], j[2][i] * n[2][i]));
                    }
                }
                for (i, row) in rows.chunks_exact_mut(kp).enumerate() {
                    (row[2 * l], row[2 * l + 1]) = (pair[0][i], pair[1][i]);
                }
            }
        }
        let first_row = w.output_row(0);
        let hidden_rows = h.as_chunks::<HIDDEN>().0.iter().zip(s.as_chunks_mut::<HIDDEN>().0);
        for ((h, s), a) in hidden_rows.zip(weighted.as_chunks_mut::<HIDDEN>().0) {
            for j in 0..HIDDEN {
                s[j] = 1.0 - exp::<F>(-100.0 * h[j]);
                a[j] = s[j] * first_row[j];
            }
        }
        gemm((TILE, HIDDEN, kp), &g_q, (kp, 1), &w.w1.t, HIDDEN, &mut g_a, HIDDEN, false);
        let (go, op) = (&g_o, OUTPUTS_PADDED);
        gemm((TILE, HIDDEN, OUTPUTS), go, (op, 1), &w.w2.m, HIDDEN, &mut g_z, HIDDEN, false);
        gemm((op, HIDDEN, TILE), go, (1, op), h, HIDDEN, g_w2, HIDDEN, true);
        for row in g_o.as_chunks::<OUTPUTS_PADDED>().0 {
            g_b2.iter_mut().zip(row).for_each(|(sum, g)| *sum += g);
        }
        let sums: (&mut [[f32; HIDDEN]], &mut [[f32; HIDDEN]]) =
            (g_w2.as_chunks_mut().0, g_b1.as_chunks_mut().0);
        // copies, since compilers do not vectorize a loop whose two sums may overlap
        let (mut g_row, mut g_bias) = (sums.0[0], sums.1[0]);
        let given = s.as_chunks::<HIDDEN>().0.iter().zip(g_a.as_chunks::<HIDDEN>().0);
        for ((s, g_a), g_z) in given.zip(g_z.as_chunks_mut::<HIDDEN>().0).take(rows) {
            for j in 0..HIDDEN {
                g_row[j] += g_a[j] * s[j];
                g_z[j] = s[j] * (g_z[j] + 100.0 * g_a[j] * first_row[j] * (1.0 - s[j]));
                g_bias[j] += g_z[j];
            }
        }
        (sums.0[0], sums.1[0]) = (g_row, g_bias);
        g_z[rows * HIDDEN..].fill(0.0);
        gemm((HIDDEN, kp, TILE), &weighted, (1, HIDDEN), &g_q, kp, g_w1, kp, true);
        gemm((HIDDEN, kp, TILE), &g_z, (1, HIDDEN), u, kp, g_w1, kp, true);
        let wide = (TILE, features_padded, HIDDEN);
        gemm(wide, &g_z, (HIDDEN, 1), &w.w1.m, kp, &mut g_u, kp, false);
        for (l, g_value) in t.g_value.iter_mut().enumerate() {
            let g_value = &mut g_value[tile * TILE..][..rows];
            for (g, of_layer) in g_value.iter_mut().zip(g_u.chunks_exact(kp)) {
                *g = [of_layer[2 * l], of_layer[2 * l + 1]];
            }
            if w.layout.color_skip {
                for (g, skipped) in g_value.iter_mut().zip(g_c0.chunks_exact(ci)) {
                    let skipped = &skipped[COLOR_INPUTS..];
                    *g = [g[0] + skipped[2 * l], g[1] + skipped[2 * l + 1]];
                }
            }
        }
    }
}

dispatch! { fn backward_task / backward_body(t: &mut SdfBackwardTask, a: &Activations, w: &Weights) }

/// Adds the gradient of a loss with respect to the table to `g_table`, and returns that with
/// respect to the network weights.
///
/// # Shapes
///
/// - g_out: `[n, 8]`, the loss's gradient by the output (the last column is used only if the
///   sharpness is local)
/// - g_table: `[entries, 2]`, added to
/// - output: `[P]`, flat as [`Layout`](crate::cpu::mlp::Layout) describes
pub fn backward(a: &Activations, w: &Weights, g_out: &[f32], g_table: &mut [[f32; 2]]) -> Vec<f32> {
    let n = a.samples;
    assert_eq!(g_out.len(), n * WIDTH);
    let layout = w.layout;
    let padded = layout.gradient_shapes();
    let mut flat = vec![0.0; layout.len()];
    if n == 0 {
        return flat;
    }
    let active = &a.shape.levels[..a.shape.active];
    let mut g_value = Buffer::scratch(active.len() * n * 2);
    let mut g_normal = Buffer::scratch(3 * n);
    let g_normal: &mut [[f32; 3]] = bytemuck::cast_slice_mut(&mut g_normal);
    let mut tasks: Vec<SdfBackwardTask> = by_chunk(bytemuck::cast_slice_mut(&mut g_value), n, CHUNK)
        .into_iter()
        .zip(g_normal.chunks_mut(CHUNK))
        .zip(g_out.chunks(CHUNK * WIDTH))
        .enumerate()
        .map(|(i, ((g_value, g_normal), g_out))| SdfBackwardTask {
            chunk: i,
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
    hash::scatter(
        active,
        g_table,
        &a.x01,
        a.shape.world(),
        bytemuck::cast_slice(&g_value),
        bytemuck::cast_slice(&a.q),
        g_normal,
    );
    flat
}
