//! The color network, forward and backward, of the samples that show.
//!
//! Samples of a chunk are packed into rows, so that matrices have no rows of samples without
//! color.

use super::{Activations, CHUNK, WIDTH};
use crate::cpu::mlp::{COLOR_INPUTS, HIDDEN, Layout, OUTPUTS, OUTPUTS_PADDED, RGB_PADDED, TILE, Weights};
use crate::cpu::pool::Buffer;
use crate::cpu::simd::{ROWS, gemm, relu_gradient, sigmoid};
use rayon::prelude::*;
use std::ops::Range;
use tiface_base::dispatch;
use tiface_base::geom::sphharm::sh16;

/// Activations of the color network. Rows are those of each chunk's samples, one chunk after the
/// other, each padded to whole blocks of matrices.
#[derive(Clone, Debug, Default)]
pub(super) struct Shaded {
    /// The samples that have a color, ascending.
    samples: Vec<u32>,
    /// Of each chunk of samples: its part of `samples`, and its first row.
    chunks: Vec<(Range<usize>, usize)>,
    c0: Buffer, // [rows, cp] inputs
    c1: Buffer, // [rows, 64]
    c2: Buffer, // [rows, 64]
}

impl Shaded {
    /// Returns the chunks of `samples`, which are ascending and less than `count`.
    fn chunks(samples: &[u32], count: usize) -> Vec<(Range<usize>, usize)> {
        let (mut first, mut row) = (0, 0);
        let mut chunks = Vec::with_capacity(count.div_ceil(CHUNK));
        for end in (0..count).step_by(CHUNK).map(|start| start + CHUNK) {
            let last = first + samples[first..].partition_point(|&s| (s as usize) < end);
            chunks.push((first..last, row));
            row += (last - first).next_multiple_of(ROWS);
            first = last;
        }
        assert!(first == samples.len(), "a color was asked for a sample that is not there");
        chunks
    }

    /// Returns the samples of a chunk that have a color.
    pub(super) fn samples(&self, chunk: usize) -> &[u32] {
        self.chunks.get(chunk).map_or(&[], |(span, _)| &self.samples[span.clone()])
    }
}

/// Evaluates the color network on `rows` rows of inputs, whole blocks of them.
#[inline(always)]
pub(super) fn color_layers<const F: bool>(
    w: &Weights,
    rows: usize,
    c0: &[f32],
    c1: &mut [f32],
    c2: &mut [f32],
    rgb: &mut [f32; TILE * RGB_PADDED],
) {
    let ci = w.layout.color_padded();
    gemm((rows, HIDDEN, ci), c0, (ci, 1), &w.c1.t, HIDDEN, c1, HIDDEN, false);
    relu(c1);
    gemm((rows, HIDDEN, HIDDEN), c1, (HIDDEN, 1), &w.c2.t, HIDDEN, c2, HIDDEN, false);
    relu(c2);
    gemm((rows, RGB_PADDED, HIDDEN), c2, (HIDDEN, 1), &w.c3.t, RGB_PADDED, rgb, RGB_PADDED, false);
    for v in rgb {
        *v = sigmoid::<F>(*v);
    }
}

// Loops here are no closures: closures are compiled without the vector instructions of the kernel
// that calls them.
#[inline(always)]
fn relu(values: &mut [f32]) {
    for v in values {
        *v = v.max(0.0);
    }
}

/// Writes the columns of a row after the first [`COLOR_INPUTS`]: the hash features, if the color
/// network reads them, and zero padding.
#[inline(always)]
pub(super) fn write_skip(layout: Layout, u: &[f32], row: &mut [f32]) {
    let count = layout.color_inputs() - COLOR_INPUTS;
    row[COLOR_INPUTS..COLOR_INPUTS + count].copy_from_slice(&u[..count]);
    row[COLOR_INPUTS + count..].fill(0.0);
}

/// Returns v / ‖v‖, with the norm clamped to at least 1e-12, like torch's `normalize`.
#[inline(always)]
fn unit(v: [f32; 3]) -> [f32; 3] {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt().max(1e-12);
    [v[0] / length, v[1] / length, v[2] / length]
}

/// The samples of a chunk that get a color.
struct ShadeTask<'a> {
    samples: &'a [u32],
    /// Index of the chunk's first sample.
    start: usize,
    direction: &'a [[f32; 3]], // of all samples
    u: &'a [f32],              // of all samples
    o: &'a [f32],              // of all samples
    c0: &'a mut [f32],
    c1: &'a mut [f32],
    c2: &'a mut [f32],
    out: &'a mut [f32], // of the chunk
}

#[inline(always)]
fn shade_body<const F: bool>(t: &mut ShadeTask, w: &Weights) {
    let (kp, ci) = (w.layout.padded(), w.layout.color_padded());
    let mut rgb = [0f32; TILE * RGB_PADDED];
    for (tile, samples) in t.samples.chunks(TILE).enumerate() {
        let rows = samples.len().next_multiple_of(ROWS);
        let c0 = &mut t.c0[tile * TILE * ci..][..rows * ci];
        for (&s, row) in samples.iter().zip(c0.chunks_exact_mut(ci)) {
            let s = s as usize;
            let out = &t.out[(s - t.start) * WIDTH..][..WIDTH];
            row[..OUTPUTS].copy_from_slice(&t.o[s * OUTPUTS_PADDED..][..OUTPUTS]);
            row[OUTPUTS..OUTPUTS + 16].copy_from_slice(&sh16(t.direction[s]));
            row[OUTPUTS + 16..COLOR_INPUTS].copy_from_slice(&unit([out[1], out[2], out[3]]));
            write_skip(w.layout, &t.u[s * kp..], row);
        }
        c0[samples.len() * ci..].fill(0.0);
        let hidden = tile * TILE * HIDDEN..(tile * TILE + rows) * HIDDEN;
        color_layers::<F>(w, rows, c0, &mut t.c1[hidden.clone()], &mut t.c2[hidden], &mut rgb);
        for (&s, rgb) in samples.iter().zip(rgb.as_chunks::<RGB_PADDED>().0) {
            t.out[(s as usize - t.start) * WIDTH + 4..][..3].copy_from_slice(&rgb[..3]);
        }
    }
}

dispatch! { fn shade_task / shade_body(t: &mut ShadeTask, w: &Weights) }

impl Activations {
    /// Evaluates the colors of `samples`, which are ascending, along directions.
    ///
    /// # Shapes
    ///
    /// - direction: `[n, 3]` unit vectors away from the camera, of all samples up to the last of
    ///   `samples`
    pub fn shade(&mut self, weights: &Weights, samples: Vec<u32>, direction: &[[f32; 3]]) {
        let ci = weights.layout.color_padded();
        let chunks = Shaded::chunks(&samples, self.samples);
        let rows = chunks.last().map_or(0, |(last, row)| row + last.len().next_multiple_of(ROWS));
        let mut c0 = Buffer::scratch(rows * ci);
        let [mut c1, mut c2] = [(); 2].map(|()| Buffer::scratch(rows * HIDDEN));
        let mut rest = [&mut c0[..], &mut c1[..], &mut c2[..]];
        let tasks: Vec<ShadeTask> = chunks
            .iter()
            .zip(self.out.chunks_mut(CHUNK * WIDTH))
            .enumerate()
            .map(|(i, ((span, _), out))| {
                let rows = span.len().next_multiple_of(ROWS);
                let mut cut = |k: usize, width: usize| {
                    rest[k].split_off_mut(..rows * width).expect("a row for each sample")
                };
                let [c0, c1, c2] = [cut(0, ci), cut(1, HIDDEN), cut(2, HIDDEN)];
                let (samples, start) = (&samples[span.clone()], i * CHUNK);
                ShadeTask { samples, start, direction, u: &self.u, o: &self.o, c0, c1, c2, out }
            })
            .collect();
        tasks.into_par_iter().for_each(|mut t| shade_task(&mut t, weights));
        self.shaded = Shaded { samples, chunks, c0, c1, c2 };
    }
}

/// Adds the gradients of a chunk's colors with respect to the matrices of the color network to
/// `g_weights`, and writes those with respect to its inputs to `g_inputs`, row by row.
///
/// # Shapes
///
/// - g_out: `[samples of the chunk, 8]`
/// - g_inputs: `[samples with a color in the chunk, padded to blocks; cp]`
#[inline(always)]
pub(super) fn backward_rows<const F: bool>(
    a: &Activations,
    w: &Weights,
    chunk: usize,
    g_out: &[f32],
    [g_c1_weights, g_c2_weights, g_c3_weights]: [&mut [f32]; 3],
    g_inputs: &mut [f32],
) {
    let ci = w.layout.color_padded();
    let first = a.shaded.chunks.get(chunk).map_or(0, |(_, row)| *row);
    let mut g_pre = [0f32; TILE * RGB_PADDED];
    let mut g_c2 = [0f32; TILE * HIDDEN];
    let mut g_c1 = [0f32; TILE * HIDDEN];
    for (tile, samples) in a.shaded.samples(chunk).chunks(TILE).enumerate() {
        let rows = samples.len().next_multiple_of(ROWS);
        let row = first + tile * TILE;
        let c0 = &a.shaded.c0[row * ci..][..rows * ci];
        let c1 = &a.shaded.c1[row * HIDDEN..][..rows * HIDDEN];
        let c2 = &a.shaded.c2[row * HIDDEN..][..rows * HIDDEN];
        // rows beyond the last sample carry zero gradients and vanish
        g_pre.fill(0.0);
        for (&s, g) in samples.iter().zip(g_pre.as_chunks_mut::<RGB_PADDED>().0) {
            let out = &a.out[s as usize * WIDTH + 4..][..3];
            let g_out = &g_out[(s as usize - chunk * CHUNK) * WIDTH + 4..][..3];
            for c in 0..3 {
                g[c] = g_out[c] * out[c] * (1.0 - out[c]);
            }
        }
        gemm((4, HIDDEN, rows), &g_pre, (1, RGB_PADDED), c2, HIDDEN, g_c3_weights, HIDDEN, true);
        gemm((rows, HIDDEN, 3), &g_pre, (RGB_PADDED, 1), &w.c3.m, HIDDEN, &mut g_c2, HIDDEN, false);
        for i in 0..rows * HIDDEN {
            g_c2[i] = relu_gradient(g_c2[i], c2[i]);
        }
        gemm((HIDDEN, HIDDEN, rows), &g_c2, (1, HIDDEN), c1, HIDDEN, g_c2_weights, HIDDEN, true);
        gemm((rows, HIDDEN, HIDDEN), &g_c2, (HIDDEN, 1), &w.c2.m, HIDDEN, &mut g_c1, HIDDEN, false);
        for i in 0..rows * HIDDEN {
            g_c1[i] = relu_gradient(g_c1[i], c1[i]);
        }
        gemm((HIDDEN, ci, rows), &g_c1, (1, HIDDEN), c0, ci, g_c1_weights, ci, true);
        let g_c0 = &mut g_inputs[tile * TILE * ci..][..rows * ci];
        gemm((rows, ci, HIDDEN), &g_c1, (HIDDEN, 1), &w.c1.m, ci, g_c0, ci, false);
    }
}
