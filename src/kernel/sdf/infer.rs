//! The signed-distance field asked, not trained: nothing is kept for a backward.

use super::{CHUNK, FieldShape, Inputs, WIDTH, run};
use crate::dispatch;
use crate::kernel::hash;
use crate::kernel::mlp::{COLOR_INPUTS, HIDDEN, OUTPUTS, OUTPUTS_PADDED, RGB_PADDED, TILE, Weights};
use crate::kernel::pool::Buffer;
use crate::kernel::simd::{exp, gemm, ln_1p, sigmoid};
use crate::kernel::sphharm::sh16;
use rayon::prelude::*;

/// softplus₁₀₀.
#[inline(always)]
fn softplus<const F: bool>(v: f32) -> f32 {
    v.max(0.0) + 0.01 * ln_1p::<F>(exp::<F>(-(100.0 * v).abs()))
}

struct ValueTask<'a> {
    inputs: Inputs<'a>,
    sdf: &'a mut [f32],
}

#[inline(always)]
fn value_body<const F: bool>(t: &mut ValueTask, w: &Weights) {
    let kp = w.layout.padded();
    let samples = t.inputs.x.len();
    let mut u = vec![0f32; TILE * kp];
    let mut h = [0f32; TILE * HIDDEN];
    for tile in 0..samples.div_ceil(TILE) {
        let base = tile * TILE;
        let rows = TILE.min(samples - base);
        t.inputs.fill(&mut u, kp, base, rows);
        gemm::<F>((TILE, HIDDEN, kp), &u, (kp, 1), &w.w1t, HIDDEN, &mut h, HIDDEN, false);
        for r in 0..rows {
            let row = &h[r * HIDDEN..][..HIDDEN];
            let mut sum = [0f32; 8];
            for j in 0..HIDDEN {
                sum[j % 8] += softplus::<F>(row[j] + w.b1[j]) * w.w2[j];
            }
            t.sdf[base + r] = sum.iter().sum::<f32>() + w.b2[0];
        }
    }
}

dispatch! { fn value_task / value_body(t: &mut ValueTask, w: &Weights) }

/// Signed distance alone: a quarter of the work of [`super::forward`]. `[n, 3]` → `[n]`.
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
        sdf.par_chunks_mut(CHUNK).enumerate().for_each(|(i, sdf)| {
            let own = i * CHUNK..i * CHUNK + sdf.len();
            value_task(&mut ValueTask { inputs: Inputs::new(shape, x, value, own), sdf }, weights);
        });
    }
    sdf
}

struct ColorTask<'a> {
    inputs: Inputs<'a>,
    normal: &'a [[f32; 3]],
    direction: &'a [[f32; 3]],
    rgb: &'a mut [[f32; 3]],
}

#[inline(always)]
fn color_body<const F: bool>(task: &mut ColorTask, w: &Weights) {
    let kp = w.layout.padded();
    let samples = task.inputs.x.len();
    let mut u = vec![0f32; TILE * kp];
    let mut h = [0f32; TILE * HIDDEN];
    let mut o = [0f32; TILE * OUTPUTS_PADDED];
    let mut c0 = [0f32; TILE * COLOR_INPUTS];
    let mut c1 = [0f32; TILE * HIDDEN];
    let mut rgb = [0f32; TILE * RGB_PADDED];
    for tile in 0..samples.div_ceil(TILE) {
        let base = tile * TILE;
        let rows = TILE.min(samples - base);
        task.inputs.fill(&mut u, kp, base, rows);
        gemm::<F>((TILE, HIDDEN, kp), &u, (kp, 1), &w.w1t, HIDDEN, &mut h, HIDDEN, false);
        for row in h.chunks_exact_mut(HIDDEN) {
            for j in 0..HIDDEN {
                row[j] = softplus::<F>(row[j] + w.b1[j]);
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
/// of the work of [`super::forward`]. All `[n, 3]`.
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
            let own = i * CHUNK..i * CHUNK + rgb.len();
            let mut task = ColorTask {
                inputs: Inputs::new(shape, x, value, own.clone()),
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
