//! Inference of the signed-distance field: no activations are kept for a backward pass.

use super::color::{color_layers, write_skip};
use super::{CHUNK, FieldShape, Inputs, WIDTH, geometry, softened};
use crate::cpu::hash;
use crate::cpu::mlp::{COLOR_INPUTS, HIDDEN, OUTPUTS, OUTPUTS_PADDED, RGB_PADDED, SOFTNESS, TILE, Weights};
use crate::cpu::pool::Buffer;
use crate::cpu::simd::{exp, fma, gemm, ln_1p};
use rayon::prelude::*;
use tiface_base::dispatch;
use tiface_base::geom::sphharm::sh16;

/// Replaces `z` by softplus₁₀₀(z + b).
#[inline(always)]
fn softplus<const F: bool>(z: &mut [f32], b: &[f32; HIDDEN]) {
    for row in z.as_chunks_mut::<HIDDEN>().0 {
        for j in 0..HIDDEN {
            let v = row[j] + b[j];
            row[j] = v.max(0.0) + 0.01 * ln_1p::<F>(exp::<F>(-(100.0 * v).abs()));
        }
    }
}

/// Evaluates signed distance and softness of the samples of a task.
#[inline(always)]
fn values_body<const F: bool>(inputs: &Inputs, soften: f32, values: &mut [[f32; 2]], w: &Weights) {
    let kp = w.layout.padded();
    let mut u = vec![0f32; TILE * kp];
    let mut h = [0f32; TILE * HIDDEN];
    for (tile, values) in values.chunks_mut(TILE).enumerate() {
        inputs.fill(&mut u, kp, tile * TILE, values.len());
        gemm((TILE, HIDDEN, kp), &u, (kp, 1), &w.w1.t, HIDDEN, &mut h, HIDDEN, false);
        softplus::<F>(&mut h, &w.b1);
        for (value, h) in values.iter_mut().zip(h.as_chunks::<HIDDEN>().0) {
            for (value, output) in value.iter_mut().zip([0, SOFTNESS]) {
                let mut sum = [0f32; 8];
                for (h, w) in h.as_chunks::<8>().0.iter().zip(w.output_row(output).as_chunks::<8>().0) {
                    for k in 0..8 {
                        sum[k] = fma::<F>(h[k], w[k], sum[k]);
                    }
                }
                *value = sum.iter().sum::<f32>() + w.b2[output];
            }
            value[1] = softened::<F>(soften, value[1]);
        }
    }
}

dispatch! {
    fn values_task / values_body(inputs: &Inputs, soften: f32, values: &mut [[f32; 2]], w: &Weights)
}

/// Returns the signed distances at points, `[n, 3]` → `[n]`, in a third of the time of
/// [`super::geometry`].
pub fn values(shape: &FieldShape, table: &[[f32; 2]], weights: &Weights, x: &[[f32; 3]]) -> Vec<f32> {
    values_and_softness(shape, table, weights, x).into_iter().map(|[value, _]| value).collect()
}

/// Returns ln of the ratio of the local to the maximum sharpness at points, `[n, 3]` → `[n]`, in
/// `-soften..=0`.
pub fn softness(shape: &FieldShape, table: &[[f32; 2]], weights: &Weights, x: &[[f32; 3]]) -> Vec<f32> {
    values_and_softness(shape, table, weights, x).into_iter().map(|[_, soft]| soft).collect()
}

/// Returns the signed distances at points, and their [`softness`], `[n, 3]` → `[n, 2]`.
pub fn values_and_softness(
    shape: &FieldShape,
    table: &[[f32; 2]],
    weights: &Weights,
    x: &[[f32; 3]],
) -> Vec<[f32; 2]> {
    /// Points per pass, which bounds the scratch memory for any number of points.
    const PASS: usize = 1 << 16;
    let mut values = vec![[0.0; 2]; x.len()];
    let active = &shape.levels[..shape.active];
    for (x, values) in x.chunks(PASS).zip(values.chunks_mut(PASS)) {
        let n = x.len();
        let mut value = Buffer::scratch(active.len() * n * 2);
        hash::gather(active, table, &shape.x01(x), 1.0, bytemuck::cast_slice_mut(&mut value), None);
        let value = &value[..];
        values.par_chunks_mut(CHUNK).enumerate().for_each(|(i, values)| {
            let range = i * CHUNK..i * CHUNK + values.len();
            values_task(&Inputs::new(shape, x, value, range), shape.soften, values, weights);
        });
    }
    values
}

struct ColorTask<'a> {
    inputs: Inputs<'a>,
    normal: &'a [[f32; 3]],
    /// Number of directions of each point; `None` if each point has one.
    counts: Option<&'a [u32]>,
    direction: &'a [[f32; 3]],
    rgb: &'a mut [[f32; 3]],
}

/// Scratch memory to evaluate the color network on one tile.
struct Shader {
    c0: Vec<f32>, // [TILE, cp]
    c1: [f32; TILE * HIDDEN],
    c2: [f32; TILE * HIDDEN],
    rgb: [f32; TILE * RGB_PADDED],
}

impl Shader {
    /// Evaluates the first `out.len()` rows of the tile, whose inputs `c0` are filled.
    #[inline(always)]
    fn run<const F: bool>(&mut self, w: &Weights, out: &mut [[f32; 3]]) {
        let Shader { c0, c1, c2, rgb } = self;
        color_layers::<F>(w, TILE, c0, c1, c2, rgb);
        for (rgb, out) in rgb.as_chunks::<RGB_PADDED>().0.iter().zip(out) {
            *out = [rgb[0], rgb[1], rgb[2]];
        }
    }
}

#[inline(always)]
fn color_body<const F: bool>(task: &mut ColorTask, w: &Weights) {
    let (kp, ci) = (w.layout.padded(), w.layout.color_padded());
    let samples = task.inputs.x.len();
    let mut u = vec![0f32; TILE * kp];
    let mut h = [0f32; TILE * HIDDEN];
    let mut o = [0f32; TILE * OUTPUTS_PADDED];
    let mut shader = Shader {
        c0: vec![0.0; TILE * ci],
        c1: [0.0; TILE * HIDDEN],
        c2: [0.0; TILE * HIDDEN],
        rgb: [0.0; TILE * RGB_PADDED],
    };
    // number of directions that fill the shader's tile so far, and of those already evaluated
    let (mut filled, mut done) = (0, 0);
    for tile in 0..samples.div_ceil(TILE) {
        let base = tile * TILE;
        let rows = TILE.min(samples - base);
        task.inputs.fill(&mut u, kp, base, rows);
        gemm((TILE, HIDDEN, kp), &u, (kp, 1), &w.w1.t, HIDDEN, &mut h, HIDDEN, false);
        softplus::<F>(&mut h, &w.b1);
        let op = OUTPUTS_PADDED;
        gemm((TILE, op, HIDDEN), &h, (HIDDEN, 1), &w.w2.t, op, &mut o, op, false);
        for r in 0..rows {
            for _ in 0..task.counts.map_or(1, |c| c[base + r]) {
                let row = &mut shader.c0[filled * ci..][..ci];
                (0..OUTPUTS).for_each(|j| row[j] = o[r * op + j] + w.b2[j]);
                row[OUTPUTS..OUTPUTS + 16].copy_from_slice(&sh16(task.direction[done + filled]));
                row[OUTPUTS + 16..COLOR_INPUTS].copy_from_slice(&task.normal[base + r]);
                write_skip(w.layout, &u[r * kp..], row);
                filled += 1;
                if filled == TILE {
                    shader.run::<F>(w, &mut task.rgb[done..done + TILE]);
                    (filled, done) = (0, done + TILE);
                }
            }
        }
    }
    if filled > 0 {
        shader.run::<F>(w, &mut task.rgb[done..done + filled]);
    }
}

dispatch! { fn color_task / color_body(task: &mut ColorTask, w: &Weights) }

/// Returns colors of points whose unit normals are known, such as points of a mesh. Point `i` is
/// viewed along `counts[i]` directions, or along one if `counts` is `None`.
///
/// No gradient is computed, which takes a third of the time of [`super::forward`], and the geometry
/// network is evaluated once per point.
///
/// # Shapes
///
/// - x, normal: `[n, 3]`; counts: `[n]`
/// - direction: `[sum of counts, 3]` unit vectors away from the camera, ordered by point
/// - output: `[sum of counts, 3]`
pub fn colors(
    shape: &FieldShape,
    table: &[[f32; 2]],
    weights: &Weights,
    x: &[[f32; 3]],
    normal: &[[f32; 3]],
    counts: Option<&[u32]>,
    direction: &[[f32; 3]],
) -> Vec<[f32; 3]> {
    const PASS: usize = 1 << 15;
    let total = |counts: Option<&[u32]>, n: usize| counts.map_or(n, |c| c.iter().map(|&c| c as usize).sum());
    assert!(normal.len() == x.len() && counts.is_none_or(|c| c.len() == x.len()));
    assert_eq!(direction.len(), total(counts, x.len()));
    let mut rgb = vec![[0f32; 3]; direction.len()];
    let active = &shape.levels[..shape.active];
    let (mut rgb_left, mut directions_left) = (&mut rgb[..], direction);
    for first in (0..x.len()).step_by(PASS) {
        let span = first..(first + PASS).min(x.len());
        let (x, normal, counts) = (&x[span.clone()], &normal[span.clone()], counts.map(|c| &c[span]));
        let n = x.len();
        let mut value = Buffer::scratch(active.len() * n * 2);
        hash::gather(active, table, &shape.x01(x), 1.0, bytemuck::cast_slice_mut(&mut value), None);
        let value = &value[..];
        let mut tasks = Vec::with_capacity(n.div_ceil(CHUNK));
        for start in (0..n).step_by(CHUNK) {
            let range = start..(start + CHUNK).min(n);
            let counts = counts.map(|c| &c[range.clone()]);
            let colors = total(counts, range.len());
            let rgb = rgb_left.split_off_mut(..colors).expect("a color for each direction");
            let direction = directions_left.split_off(..colors).expect("a direction for each count");
            let (normal, inputs) = (&normal[range.clone()], Inputs::new(shape, x, value, range));
            tasks.push(ColorTask { inputs, normal, counts, direction, rgb });
        }
        tasks.par_iter_mut().for_each(|task| color_task(task, weights));
    }
    rgb
}

/// Returns signed distances and gradients at points, `[n, 3]` → `[n]` pairs, without colors.
pub fn gradients(
    shape: &FieldShape,
    table: &[[f32; 2]],
    weights: &Weights,
    x: &[[f32; 3]],
) -> Vec<(f32, [f32; 3])> {
    const PASS: usize = 1 << 15;
    x.chunks(PASS)
        .flat_map(|x| {
            let a = geometry(shape, table, weights, x);
            a.out.chunks_exact(WIDTH).map(|o| (o[0], [o[1], o[2], o[3]])).collect::<Vec<_>>()
        })
        .collect()
}
