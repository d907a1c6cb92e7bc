//! The two small networks of the signed-distance field: layout of their weights, prepared for tiles.
//!
//! ```text
//! geometry  [x 3, hash 2L] ─ 64 ─ softplus₁₀₀ ─ 13     out[0] is the sdf, all 13 go to the colour
//! colour    [13, SH 16, normal 3 (, hash 2L)] ─ 64 ─ relu ─ 64 ─ relu ─ 3 ─ sigmoid      no biases
//! ```
//!
//! With the colour skip (not published) the colour network reads the hash features themselves too: twelve numbers
//! behind a layer that is shaped by the surface are a narrow way for all that is seen on a head.

/// Width of every hidden layer.
pub const HIDDEN: usize = 64;
/// Outputs of the geometry network.
pub const OUTPUTS: usize = 13;
/// Inputs of the colour network without the skip: 13 features, 16 harmonics, 3 of the normal.
pub const COLOR_INPUTS: usize = 32;
/// The output that says how soft the surface is, where a field's sharpness is local.
pub const SOFTNESS: usize = OUTPUTS - 1;
/// [`OUTPUTS`] as stored in tiles.
pub const OUTPUTS_PADDED: usize = 16;
/// Colour channels as stored in tiles.
pub const RGB_PADDED: usize = 8;
/// Samples a tile: activations of one tile stay in the first-level cache.
pub const TILE: usize = 64;

/// Where each matrix starts in the flat vector of network weights, all row-major `[out, in]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layout {
    /// Inputs of the geometry network: 3 + 2 · levels.
    pub inputs: usize,
    /// Does the colour network read the hash features too?
    pub color_skip: bool,
}

impl Layout {
    /// For a hash grid of so many levels.
    pub fn new(levels: usize, color_skip: bool) -> Layout {
        Layout { inputs: 3 + 2 * levels, color_skip }
    }

    /// Inputs of the colour network.
    pub fn color_inputs(&self) -> usize {
        COLOR_INPUTS + if self.color_skip { self.inputs - 3 } else { 0 }
    }

    /// Columns of a tile of colour inputs: zeros up to a multiple of 8.
    pub fn color_padded(&self) -> usize {
        self.color_inputs().next_multiple_of(8)
    }

    /// Shapes `[out, in]` in storage order: W1, b1, W2, b2, C1, C2, C3 (biases as `[n, 1]`).
    pub fn shapes(&self) -> [(usize, usize); 7] {
        [
            (HIDDEN, self.inputs),
            (HIDDEN, 1),
            (OUTPUTS, HIDDEN),
            (OUTPUTS, 1),
            (HIDDEN, self.color_inputs()),
            (HIDDEN, HIDDEN),
            (3, HIDDEN),
        ]
    }

    /// Floats of all matrices together.
    pub fn len(&self) -> usize {
        self.shapes().iter().map(|(o, i)| o * i).sum()
    }

    /// Never: a network has weights. (Beside `len` by convention.)
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Columns of a tile of geometry inputs: `[hash 2L, x 3, zeros]` up to a multiple of 8.
    pub fn padded(&self) -> usize {
        self.inputs.next_multiple_of(8)
    }
}

/// Network weights in both orders, padded for the matrix blocks. About ten thousand floats, rebuilt
/// once a step. Geometry columns are turned to `[hash, x]` so that hash features start aligned.
#[derive(Debug)]
pub struct Weights {
    pub(super) layout: Layout,
    pub(super) w1: Vec<f32>,  // [64, kp]
    pub(super) w1t: Vec<f32>, // [kp, 64]
    pub(super) b1: Vec<f32>,  // [64]
    pub(super) w2: Vec<f32>,  // [16, 64]
    pub(super) w2t: Vec<f32>, // [64, 16]
    pub(super) b2: Vec<f32>,  // [16]
    pub(super) c1: Vec<f32>,  // [64, cp]
    pub(super) c1t: Vec<f32>, // [cp, 64]
    pub(super) c2: Vec<f32>,  // [64, 64]
    pub(super) c2t: Vec<f32>, // [64, 64]
    pub(super) c3: Vec<f32>,  // [8, 64]
    pub(super) c3t: Vec<f32>, // [64, 8]
}

/// `[rows, columns]` → `[columns, padded_rows]`, zeros in the padding.
fn transposed(m: &[f32], rows: usize, columns: usize, padded_rows: usize) -> Vec<f32> {
    let mut t = vec![0.0; columns * padded_rows];
    for r in 0..rows {
        for c in 0..columns {
            t[c * padded_rows + r] = m[r * columns + c];
        }
    }
    t
}

fn padded(m: &[f32], len: usize) -> Vec<f32> {
    let mut p = m.to_vec();
    p.resize(len, 0.0);
    p
}

impl Weights {
    /// From the flat vector that [`Layout`] describes.
    pub fn new(layout: Layout, flat: &[f32]) -> Weights {
        assert_eq!(flat.len(), layout.len(), "network weights do not fit the layout");
        let mut rest = flat;
        let [w1x, b1, w2, b2, c1, c2, c3] = layout.shapes().map(|(o, i)| {
            let (own, tail) = rest.split_at(o * i);
            rest = tail;
            own
        });
        let kp = layout.padded();
        let mut w1 = vec![0.0; HIDDEN * kp];
        for (row, out) in w1x.chunks_exact(layout.inputs).zip(w1.chunks_exact_mut(kp)) {
            out[..layout.inputs - 3].copy_from_slice(&row[3..]);
            out[layout.inputs - 3..layout.inputs].copy_from_slice(&row[..3]);
        }
        let (ci, cp) = (layout.color_inputs(), layout.color_padded());
        let mut c1p = vec![0.0; HIDDEN * cp];
        for (row, out) in c1.chunks_exact(ci).zip(c1p.chunks_exact_mut(cp)) {
            out[..ci].copy_from_slice(row);
        }
        Weights {
            layout,
            w1t: transposed(&w1, HIDDEN, kp, HIDDEN),
            w1,
            b1: b1.to_vec(),
            w2t: transposed(w2, OUTPUTS, HIDDEN, OUTPUTS_PADDED),
            w2: padded(w2, OUTPUTS_PADDED * HIDDEN),
            b2: padded(b2, OUTPUTS_PADDED),
            c1t: transposed(&c1p, HIDDEN, cp, HIDDEN),
            c1: c1p,
            c2t: transposed(c2, HIDDEN, HIDDEN, HIDDEN),
            c2: c2.to_vec(),
            c3t: transposed(c3, 3, HIDDEN, RGB_PADDED),
            c3: padded(c3, RGB_PADDED * HIDDEN),
        }
    }
}

/// Gradients of the matrices as tiles accumulate them (padded, geometry columns `[hash, x]`).
#[derive(Clone)]
pub struct WeightGradients {
    pub(super) w1: Vec<f32>, // [64, kp]
    pub(super) b1: Vec<f32>, // [64]
    pub(super) w2: Vec<f32>, // [16, 64]
    pub(super) b2: Vec<f32>, // [16]
    pub(super) c1: Vec<f32>, // [64, cp]
    pub(super) c2: Vec<f32>, // [64, 64]
    pub(super) c3: Vec<f32>, // [4, 64]
}

impl WeightGradients {
    /// All zero.
    pub fn zeros(layout: Layout) -> WeightGradients {
        WeightGradients {
            w1: vec![0.0; HIDDEN * layout.padded()],
            b1: vec![0.0; HIDDEN],
            w2: vec![0.0; OUTPUTS_PADDED * HIDDEN],
            b2: vec![0.0; OUTPUTS_PADDED],
            c1: vec![0.0; HIDDEN * layout.color_padded()],
            c2: vec![0.0; HIDDEN * HIDDEN],
            c3: vec![0.0; 4 * HIDDEN],
        }
    }

    /// Adds this to the flat gradient that [`Layout`] describes.
    pub fn add_to(&self, layout: Layout, flat: &mut [f32]) {
        let kp = layout.padded();
        let mut rest = flat;
        let mut next = |len: usize| {
            let (own, tail) = std::mem::take(&mut rest).split_at_mut(len);
            rest = tail;
            own
        };
        let w1 = next(HIDDEN * layout.inputs);
        for (row, g) in w1.chunks_exact_mut(layout.inputs).zip(self.w1.chunks_exact(kp)) {
            for i in 0..3 {
                row[i] += g[layout.inputs - 3 + i];
            }
            for i in 3..layout.inputs {
                row[i] += g[i - 3];
            }
        }
        let mut add = |part: &[f32], rows: usize, columns: usize, stride: usize| {
            let own = next(rows * columns);
            for (row, g) in own.chunks_exact_mut(columns).zip(part.chunks_exact(stride)) {
                for (a, b) in row.iter_mut().zip(g) {
                    *a += b;
                }
            }
        };
        add(&self.b1, 1, HIDDEN, HIDDEN);
        add(&self.w2, OUTPUTS, HIDDEN, HIDDEN);
        add(&self.b2, 1, OUTPUTS, OUTPUTS);
        add(&self.c1, HIDDEN, layout.color_inputs(), layout.color_padded());
        add(&self.c2, HIDDEN, HIDDEN, HIDDEN);
        add(&self.c3, 3, HIDDEN, HIDDEN);
    }
}
