//! The two small networks of the signed-distance field: layout of their weights, prepared for tiles.
//!
//! ```text
//! geometry  [x 3, hash 2L] ─ 64 ─ softplus₁₀₀ ─ 13     out[0] is the sdf, all 13 go to the color
//! color     [13, SH 16, normal 3 (, hash 2L)] ─ 64 ─ relu ─ 64 ─ relu ─ 3 ─ sigmoid      no biases
//! ```
//!
//! With the color skip (not published) the color network reads the hash features themselves too: twelve numbers
//! behind a layer that is shaped by the surface are a narrow way for all that is seen on a head.

use super::matrix::{Matrix, padded, split};

/// Width of every hidden layer.
pub const HIDDEN: usize = 64;
/// Outputs of the geometry network.
pub const OUTPUTS: usize = 13;
/// Inputs of the color network without the skip: 13 features, 16 harmonics, 3 of the normal.
pub const COLOR_INPUTS: usize = 32;
/// The output that says how soft the surface is, where a field's sharpness is local.
pub const SOFTNESS: usize = OUTPUTS - 1;
/// [`OUTPUTS`] as stored in tiles.
pub const OUTPUTS_PADDED: usize = 16;
/// Color channels as stored in tiles.
pub const RGB_PADDED: usize = 8;
/// Samples a tile: activations of one tile stay in the first-level cache.
pub const TILE: usize = 64;

/// Where each matrix starts in the flat vector of network weights, all row-major `[out, in]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layout {
    /// Inputs of the geometry network: 3 + 2 · levels.
    pub inputs: usize,
    /// Does the color network read the hash features too?
    pub color_skip: bool,
}

impl Layout {
    /// For a hash grid of so many levels.
    pub fn new(levels: usize, color_skip: bool) -> Layout {
        Layout { inputs: 3 + 2 * levels, color_skip }
    }

    /// Inputs of the color network.
    pub fn color_inputs(&self) -> usize {
        COLOR_INPUTS + if self.color_skip { self.inputs - 3 } else { 0 }
    }

    /// Columns of a tile of color inputs: zeros up to a multiple of 8.
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

    /// Shapes in which tiles sum gradients: padded, three color channels as four, geometry columns as in [`Weights`].
    pub(super) fn gradient_shapes(&self) -> [(usize, usize); 7] {
        let (inputs, color_inputs) = (self.padded(), self.color_padded());
        let padded = OUTPUTS_PADDED;
        [
            (HIDDEN, inputs),
            (HIDDEN, 1),
            (padded, HIDDEN),
            (padded, 1),
            (HIDDEN, color_inputs),
            (HIDDEN, HIDDEN),
            (4, HIDDEN),
        ]
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
    pub(super) w1: Matrix,   // [64, kp]
    pub(super) b1: Vec<f32>, // [64]
    pub(super) w2: Matrix,   // [16, 64]
    pub(super) b2: Vec<f32>, // [16]
    pub(super) c1: Matrix,   // [64, cp]
    pub(super) c2: Matrix,   // [64, 64]
    pub(super) c3: Matrix,   // [8, 64]
}

impl Weights {
    /// From the flat vector that [`Layout`] describes.
    pub fn new(layout: Layout, flat: &[f32]) -> Weights {
        assert_eq!(flat.len(), layout.len(), "network weights do not fit the layout");
        let [w1, b1, w2, b2, c1, c2, c3] = split(flat, layout.shapes());
        let [k, ci] = [layout.inputs, layout.color_inputs()];
        let turned: Vec<f32> = w1.chunks_exact(k).flat_map(|row| [&row[3..], &row[..3]].concat()).collect();
        Weights {
            layout,
            w1: Matrix::new(&turned, (HIDDEN, k), (HIDDEN, layout.padded())),
            b1: b1.to_vec(),
            w2: Matrix::new(w2, (OUTPUTS, HIDDEN), (OUTPUTS_PADDED, HIDDEN)),
            b2: padded(b2, OUTPUTS_PADDED),
            c1: Matrix::new(c1, (HIDDEN, ci), (HIDDEN, layout.color_padded())),
            c2: Matrix::new(c2, (HIDDEN, HIDDEN), (HIDDEN, HIDDEN)),
            c3: Matrix::new(c3, (3, HIDDEN), (RGB_PADDED, HIDDEN)),
        }
    }
}
