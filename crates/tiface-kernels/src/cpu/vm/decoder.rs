//! The color decoder of TensoRF ("MLP_Fea"): basis matrix, encodings, two hidden layers.
//!
//! ```text
//! a = B · products                                         [features]
//! in = [a, d, PE(a), PE(d)]     PE(v) = [sin(2^k v), cos(2^k v)], all k of a component together
//! rgb = sigmoid(W3 relu(W2 relu(W1 in + b1) + b2) + b3)
//! ```

use super::gather::{FactorGradients, PlaneGradients};
use super::{Cell, Grid};
use crate::cpu::matrix::{Matrix, add_to, split};
use crate::cpu::pool::{Buffer, pieces};
use crate::cpu::simd::{gemm, relu_gradient, sigmoid};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tiface_base::dispatch;

/// Number of samples per tile. Activations of one tile stay in the second-level cache.
const TILE: usize = 64;
/// Number of samples per task. It is fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 16 * TILE;
/// Color channels as stored in tiles, zero-padded.
const RGB: usize = 8;

/// Sizes of the decoder.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DecoderShape {
    /// Channels of the appearance grid; not stored, because the grid determines them.
    #[serde(skip)]
    pub channels: usize,
    /// Outputs of the basis matrix (published: 27).
    pub features: usize,
    /// Width of both hidden layers, a multiple of 8.
    pub hidden: usize,
    /// Frequencies of the view direction's encoding.
    pub view_frequencies: usize,
    /// Frequencies of the features' encoding.
    pub feature_frequencies: usize,
}

impl DecoderShape {
    /// Returns the number of inputs of the first layer.
    pub fn inputs(&self) -> usize {
        self.features * (1 + 2 * self.feature_frequencies) + 3 * (1 + 2 * self.view_frequencies)
    }

    /// Returns the shapes `[out, in]` in storage order: B, W1, b1, W2, b2, W3, b3 (biases as
    /// `[n, 1]`), all row-major.
    pub fn shapes(&self) -> [(usize, usize); 7] {
        let h = self.hidden;
        [(self.features, self.channels), (h, self.inputs()), (h, 1), (h, h), (h, 1), (3, h), (3, 1)]
    }

    /// Returns the number of floats of all matrices together.
    pub fn len(&self) -> usize {
        self.shapes().iter().map(|(o, i)| o * i).sum()
    }

    /// Returns the widths of hidden layers, products, features and inputs as stored in tiles.
    fn padded(&self) -> [usize; 4] {
        [self.hidden, self.channels, self.features, self.inputs()].map(|n| n.next_multiple_of(8))
    }

    /// Returns the shapes in which tiles accumulate gradients: padded, with three color channels
    /// stored as four.
    fn gradient_shapes(&self) -> [(usize, usize); 7] {
        let [h, products, features, inputs] = self.padded();
        [(features, products), (h, inputs), (h, 1), (h, h), (h, 1), (4, h), (3, 1)]
    }
}

/// The decoder's matrices, padded for the matrix blocks and stored with their transpose.
#[derive(Debug)]
pub struct DecoderWeights {
    shape: DecoderShape,
    basis: Matrix, // [fp, cp]
    w1: Matrix,    // [h, ip]
    b1: Vec<f32>,
    w2: Matrix, // [h, h]
    b2: Vec<f32>,
    w3: Matrix, // [8, h]
    b3: [f32; RGB],
}

impl DecoderWeights {
    /// Creates the weights from the flat vector that [`DecoderShape::shapes`] describes.
    pub fn new(shape: DecoderShape, flat: &[f32]) -> DecoderWeights {
        assert_eq!(flat.len(), shape.len(), "network weights do not fit the decoder");
        assert!(shape.hidden.is_multiple_of(8), "hidden layers are a multiple of 8 wide");
        let shapes = shape.shapes();
        let [basis, w1, b1, w2, b2, w3, b3] = split(flat, shapes);
        let [h, cp, fp, ip] = shape.padded();
        DecoderWeights {
            shape,
            basis: Matrix::new(basis, shapes[0], (fp, cp)),
            w1: Matrix::new(w1, shapes[1], (h, ip)),
            b1: b1.to_vec(),
            w2: Matrix::new(w2, shapes[3], (h, h)),
            b2: b2.to_vec(),
            w3: Matrix::new(w3, shapes[5], (RGB, h)),
            b3: std::array::from_fn(|c| b3.get(c).copied().unwrap_or(0.0)),
        }
    }
}

/// Decoded samples, with the activations that the backward pass needs.
#[derive(Clone, Debug)]
pub(super) struct Decoded {
    pub cells: Vec<Cell>,
    planes: Buffer, // [n, cp] plane values, later their gradients
    lines: Buffer,  // [n, cp]
    inputs: Buffer, // [np, ip]; np = n rounded up to whole tiles
    h1: Buffer,     // [np, h]
    h2: Buffer,     // [np, h]
    /// `[n, 3]`
    pub rgb: Vec<[f32; 3]>,
}

struct DecodeTask<'a> {
    cells: &'a [Cell],
    direction: &'a [[f32; 3]],
    planes: &'a mut [f32],
    lines: &'a mut [f32],
    inputs: &'a mut [f32],
    h1: &'a mut [f32],
    h2: &'a mut [f32],
    rgb: &'a mut [[f32; 3]],
}

/// Writes features and direction with their encodings to a row of inputs.
#[inline(always)]
fn encode(shape: &DecoderShape, features: &[f32], d: [f32; 3], row: &mut [f32]) {
    let f = shape.features;
    row[..f].copy_from_slice(&features[..f]);
    row[f..f + 3].copy_from_slice(&d);
    let mut at = f + 3;
    for (v, frequencies) in [(&features[..f], shape.feature_frequencies), (&d[..], shape.view_frequencies)] {
        let n = v.len() * frequencies;
        for (i, &v) in v.iter().enumerate() {
            for k in 0..frequencies {
                let (sin, cos) = (v * (1u32 << k) as f32).sin_cos();
                row[at + i * frequencies + k] = sin;
                row[at + n + i * frequencies + k] = cos;
            }
        }
        at += 2 * n;
    }
    row[at..].fill(0.0);
}

#[inline(always)]
fn relu(rows: &mut [f32], bias: &[f32]) {
    for row in rows.chunks_exact_mut(bias.len()) {
        for (v, b) in row.iter_mut().zip(bias) {
            *v = (*v + b).max(0.0);
        }
    }
}

#[inline(always)]
fn forward_body<const F: bool>(t: &mut DecodeTask, w: &DecoderWeights, lookup: &super::gather::Lookup) {
    let s = &w.shape;
    let [h, cp, fp, ip] = s.padded();
    let n = t.cells.len();
    let mut products = vec![0f32; TILE * cp];
    let mut features = vec![0f32; TILE * fp];
    let mut out = [0f32; TILE * RGB];
    for base in (0..n).step_by(TILE) {
        let rows = TILE.min(n - base);
        for r in 0..rows {
            let (p, l) = (&mut t.planes[(base + r) * cp..][..cp], &mut t.lines[(base + r) * cp..][..cp]);
            p[s.channels..].fill(0.0);
            l[s.channels..].fill(0.0);
            lookup.factors::<F>(&t.cells[base + r], p, l);
            for ((product, p), l) in products[r * cp..][..cp].iter_mut().zip(p.iter()).zip(l.iter()) {
                *product = p * l;
            }
        }
        products[rows * cp..].fill(0.0);
        gemm((TILE, fp, cp), &products, (cp, 1), &w.basis.t, fp, &mut features, fp, false);
        let inputs = &mut t.inputs[base * ip..][..TILE * ip];
        for r in 0..rows {
            encode(s, &features[r * fp..], t.direction[base + r], &mut inputs[r * ip..][..ip]);
        }
        inputs[rows * ip..].fill(0.0);
        let h1 = &mut t.h1[base * h..][..TILE * h];
        gemm((TILE, h, ip), inputs, (ip, 1), &w.w1.t, h, h1, h, false);
        relu(h1, &w.b1);
        let h2 = &mut t.h2[base * h..][..TILE * h];
        gemm((TILE, h, h), h1, (h, 1), &w.w2.t, h, h2, h, false);
        relu(h2, &w.b2);
        gemm((TILE, RGB, h), h2, (h, 1), &w.w3.t, RGB, &mut out, RGB, false);
        for r in 0..rows {
            for c in 0..3 {
                t.rgb[base + r][c] = sigmoid::<F>(out[r * RGB + c] + w.b3[c]);
            }
        }
    }
}

dispatch! {
    fn forward_task / forward_body(t: &mut DecodeTask, w: &DecoderWeights, lookup: &super::gather::Lookup)
}

/// Decodes the colors of samples in the appearance grid `values`, viewed along `direction`.
pub(super) fn decode(
    grid: &Grid,
    values: &[f32],
    w: &DecoderWeights,
    cells: Vec<Cell>,
    direction: &[[f32; 3]],
) -> Decoded {
    let s = &w.shape;
    assert_eq!(s.channels, grid.channels());
    let n = cells.len();
    let np = n.next_multiple_of(TILE);
    let [h, cp, _, ip] = s.padded();
    let lookup = super::gather::Lookup::new(grid, values);
    let mut planes = Buffer::scratch(n * cp);
    let mut lines = Buffer::scratch(n * cp);
    let mut inputs = Buffer::scratch(np * ip);
    let mut h1 = Buffer::scratch(np * h);
    let mut h2 = Buffer::scratch(np * h);
    let mut rgb = vec![[0f32; 3]; n];
    let mut cut = pieces([&mut planes, &mut lines, &mut inputs, &mut h1, &mut h2], [cp, cp, ip, h, h], CHUNK);
    let mut tasks: Vec<DecodeTask> = cells
        .chunks(CHUNK)
        .zip(direction.chunks(CHUNK))
        .zip(rgb.chunks_mut(CHUNK))
        .map(|((cells, direction), rgb)| {
            let [planes, lines, inputs, h1, h2] = cut();
            DecodeTask { cells, direction, planes, lines, inputs, h1, h2, rgb }
        })
        .collect();
    tasks.par_iter_mut().for_each(|t| forward_task(t, w, &lookup));
    drop((tasks, cut));
    Decoded { cells, planes, lines, inputs, h1, h2, rgb }
}

struct DecodeBackwardTask<'a> {
    g_rgb: &'a [[f32; 3]],
    planes: &'a mut [f32],
    lines: &'a mut [f32],
    inputs: &'a [f32],
    h1: &'a [f32],
    h2: &'a [f32],
    rgb: &'a [[f32; 3]],
    /// Gradients with respect to the matrices, in the shapes of [`DecoderShape::gradient_shapes`].
    gradients: [Vec<f32>; 7],
}

/// Sets `g` to zero where the activation `h` is not positive (the relu's gradient), and adds the
/// column sums to `bias`.
#[inline(always)]
fn relu_backward(g: &mut [f32], h: &[f32], bias: &mut [f32]) {
    for (g, h) in g.chunks_exact_mut(bias.len()).zip(h.chunks_exact(bias.len())) {
        for ((g, h), b) in g.iter_mut().zip(h).zip(bias.iter_mut()) {
            *g = relu_gradient(*g, *h);
            *b += *g;
        }
    }
}

#[inline(always)]
fn backward_body<const F: bool>(t: &mut DecodeBackwardTask, w: &DecoderWeights) {
    let s = &w.shape;
    let [h, cp, fp, ip] = s.padded();
    let [g_basis, g_w1, g_b1, g_w2, g_b2, g_w3, g_b3] = &mut t.gradients;
    let mut g_pre = [0f32; TILE * RGB];
    let mut g_h2 = vec![0f32; TILE * h];
    let mut g_h1 = vec![0f32; TILE * h];
    let mut g_in = vec![0f32; TILE * ip];
    let mut g_features = vec![0f32; TILE * fp];
    let mut products = vec![0f32; TILE * cp];
    let mut g_products = vec![0f32; TILE * cp];
    for base in (0..t.rgb.len()).step_by(TILE) {
        let rows = TILE.min(t.rgb.len() - base);
        let (h1, h2) = (&t.h1[base * h..][..TILE * h], &t.h2[base * h..][..TILE * h]);
        let inputs = &t.inputs[base * ip..][..TILE * ip];
        // rows beyond the last sample carry zero gradients and vanish
        g_pre.fill(0.0);
        for r in 0..rows {
            for c in 0..3 {
                let y = t.rgb[base + r][c];
                let v = t.g_rgb[base + r][c] * y * (1.0 - y);
                g_pre[r * RGB + c] = v;
                g_b3[c] += v;
            }
        }
        gemm((4, h, TILE), &g_pre, (1, RGB), h2, h, g_w3, h, true);
        gemm((TILE, h, 3), &g_pre, (RGB, 1), &w.w3.m, h, &mut g_h2, h, false);
        relu_backward(&mut g_h2, h2, g_b2);
        gemm((h, h, TILE), &g_h2, (1, h), h1, h, g_w2, h, true);
        gemm((TILE, h, h), &g_h2, (h, 1), &w.w2.m, h, &mut g_h1, h, false);
        relu_backward(&mut g_h1, h1, g_b1);
        gemm((h, ip, TILE), &g_h1, (1, h), inputs, ip, g_w1, ip, true);
        gemm((TILE, ip, h), &g_h1, (h, 1), &w.w1.m, ip, &mut g_in, ip, false);
        // back through the features' encoding; the direction's gradient is not needed
        g_features.fill(0.0);
        let (f, k) = (s.features, s.feature_frequencies);
        for r in 0..rows {
            let (row, x) = (&g_in[r * ip..][..ip], &inputs[r * ip..][..ip]);
            let out = &mut g_features[r * fp..][..f];
            out.copy_from_slice(&row[..f]);
            let (sin, cos) = (f + 3, f + 3 + f * k);
            for i in 0..f {
                for q in 0..k {
                    let at = i * k + q;
                    out[i] +=
                        (1u32 << q) as f32 * (x[cos + at] * row[sin + at] - x[sin + at] * row[cos + at]);
                }
            }
        }
        for r in 0..rows {
            let (p, l) = (&t.planes[(base + r) * cp..][..cp], &t.lines[(base + r) * cp..][..cp]);
            for c in 0..cp {
                products[r * cp + c] = p[c] * l[c];
            }
        }
        products[rows * cp..].fill(0.0);
        gemm((fp, cp, TILE), &g_features, (1, fp), &products, cp, g_basis, cp, true);
        gemm((TILE, cp, fp), &g_features, (fp, 1), &w.basis.m, cp, &mut g_products, cp, false);
        for r in 0..rows {
            let (p, l) = (&mut t.planes[(base + r) * cp..][..cp], &mut t.lines[(base + r) * cp..][..cp]);
            for c in 0..cp {
                let (v, q) = (p[c], g_products[r * cp + c]);
                p[c] = q * l[c];
                l[c] = q * v;
            }
        }
    }
}

dispatch! { fn backward_task / backward_body(t: &mut DecodeBackwardTask, w: &DecoderWeights) }

/// Adds the gradient with respect to the appearance grid to `g_values`, and returns that with
/// respect to the flat weights.
pub(super) fn decode_backward(
    grid: &Grid,
    w: &DecoderWeights,
    mut decoded: Decoded,
    g_rgb: &[[f32; 3]],
    g_values: &mut [f32],
) -> Vec<f32> {
    let s = &w.shape;
    let n = decoded.cells.len();
    let [h, cp, _, ip] = s.padded();
    let padded_shapes = s.gradient_shapes();
    let d = &mut decoded;
    let mut tasks: Vec<DecodeBackwardTask> = d
        .planes
        .chunks_mut(CHUNK * cp)
        .zip(d.lines.chunks_mut(CHUNK * cp))
        .enumerate()
        .map(|(i, (planes, lines))| {
            let start = i * CHUNK;
            let range = start..(start + CHUNK).min(n);
            DecodeBackwardTask {
                g_rgb: &g_rgb[range.clone()],
                planes,
                lines,
                inputs: &d.inputs[start * ip..],
                h1: &d.h1[start * h..],
                h2: &d.h2[start * h..],
                rgb: &d.rgb[range],
                gradients: padded_shapes.map(|(rows, columns)| vec![0.0; rows * columns]),
            }
        })
        .collect();
    tasks.par_iter_mut().for_each(|t| backward_task(t, w));
    let mut flat = vec![0f32; s.len()];
    for task in &tasks {
        let parts: [_; 7] = std::array::from_fn(|k| (&task.gradients[k][..], padded_shapes[k].1));
        add_to(&mut flat, &s.shapes(), &parts);
    }
    drop(tasks);
    let planes = PlaneGradients::Given(&decoded.planes);
    let gradients = FactorGradients { cells: &decoded.cells, planes, lines: &decoded.lines, stride: cp };
    super::gather::scatter(grid, &gradients, g_values);
    flat
}
