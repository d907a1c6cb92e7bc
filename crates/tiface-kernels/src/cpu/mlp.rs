//! The two small networks of the signed-distance field: the layout of their weights, and
//! the weights as the tiles read them.
//!
//! ```text
//! geometry  [x 3, hash 2L] ─ 64 ─ softplus₁₀₀ ─ 13     out[0] is the sdf, all 13 go to the color
//! color     [13, SH 16, normal 3 (, hash 2L)] ─ 64 ─ relu ─ 64 ─ relu ─ 3 ─ sigmoid      no biases
//! ```
//!
//! With the color skip (not published) the color network also reads the hash features: twelve
//! outputs of a layer that is trained to represent the surface are a bottleneck for the appearance
//! of a head.

use super::matrix::{Matrix, split};

/// Width of every hidden layer.
pub const HIDDEN: usize = 64;
/// Outputs of the geometry network.
pub const OUTPUTS: usize = 13;
/// Inputs of the color network without the skip: 13 features, 16 harmonics, 3 of the normal.
pub const COLOR_INPUTS: usize = 32;
/// Index of the output that controls the softness of the surface, if the field's sharpness is
/// local.
pub const SOFTNESS: usize = OUTPUTS - 1;
/// [`OUTPUTS`] as stored in tiles, zero-padded.
pub const OUTPUTS_PADDED: usize = 16;
/// Color channels as stored in tiles, zero-padded.
pub const RGB_PADDED: usize = 8;
/// Number of samples per tile. Activations of one tile stay in the first-level cache.
pub const TILE: usize = 64;

/// Layout of the flat vector of network weights; all matrices are row-major `[out, in]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layout {
    /// Inputs of the geometry network: 3 + 2 · levels.
    pub inputs: usize,
    /// Whether the color network also reads the hash features.
    pub color_skip: bool,
}

impl Layout {
    /// Returns the layout for a hash grid with the given number of levels.
    pub fn new(levels: usize, color_skip: bool) -> Layout {
        Layout { inputs: 3 + 2 * levels, color_skip }
    }

    /// Returns the number of inputs of the color network.
    pub fn color_inputs(&self) -> usize {
        COLOR_INPUTS + if self.color_skip { self.inputs - 3 } else { 0 }
    }

    /// Returns the number of columns of a tile of color inputs, zero-padded to a multiple of 8.
    pub fn color_padded(&self) -> usize {
        self.color_inputs().next_multiple_of(8)
    }

    /// Returns the shapes `[out, in]` in storage order: W1, b1, W2, b2, C1, C2, C3 (biases as
    /// `[n, 1]`).
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

    /// Returns the number of floats of all matrices together.
    pub fn len(&self) -> usize {
        self.shapes().iter().map(|(o, i)| o * i).sum()
    }

    /// Returns the shapes in which tiles accumulate gradients: padded, with three color channels
    /// stored as four and geometry columns ordered as in [`Weights`].
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

    /// Returns the number of columns of a tile of geometry inputs: `[hash 2L, x 3, zeros]`, padded
    /// to a multiple of 8.
    pub fn padded(&self) -> usize {
        self.inputs.next_multiple_of(8)
    }
}

/// Network weights, padded for the matrix blocks and stored with their transpose. They are about
/// ten thousand floats and are rebuilt once per step. Geometry columns are reordered to
/// `[hash, x]`, so that hash features start aligned.
#[derive(Debug)]
pub struct Weights {
    pub(super) layout: Layout,
    pub(super) w1: Matrix, // [64, kp]
    pub(super) b1: [f32; HIDDEN],
    pub(super) w2: Matrix, // [16, 64]
    pub(super) b2: [f32; OUTPUTS_PADDED],
    pub(super) c1: Matrix, // [64, cp]
    pub(super) c2: Matrix, // [64, 64]
    pub(super) c3: Matrix, // [8, 64]
}

impl Weights {
    /// Creates the weights from the flat vector that [`Layout`] describes.
    pub fn new(layout: Layout, flat: &[f32]) -> Weights {
        assert_eq!(flat.len(), layout.len(), "network weights do not fit the layout");
        let [w1, b1, w2, b2, c1, c2, c3] = split(flat, layout.shapes());
        let [k, ci] = [layout.inputs, layout.color_inputs()];
        let reordered: Vec<f32> =
            w1.chunks_exact(k).flat_map(|row| [&row[3..], &row[..3]].concat()).collect();
        Weights {
            layout,
            w1: Matrix::new(&reordered, (HIDDEN, k), (HIDDEN, layout.padded())),
            b1: std::array::from_fn(|j| b1[j]),
            w2: Matrix::new(w2, (OUTPUTS, HIDDEN), (OUTPUTS_PADDED, HIDDEN)),
            b2: std::array::from_fn(|j| b2.get(j).copied().unwrap_or(0.0)),
            c1: Matrix::new(c1, (HIDDEN, ci), (HIDDEN, layout.color_padded())),
            c2: Matrix::new(c2, (HIDDEN, HIDDEN), (HIDDEN, HIDDEN)),
            c3: Matrix::new(c3, (3, HIDDEN), (RGB_PADDED, HIDDEN)),
        }
    }

    /// Returns the row of `W2` that gives output `output`.
    #[inline(always)]
    pub(super) fn output_row(&self, output: usize) -> &[f32; HIDDEN] {
        &self.w2.m.as_chunks().0[output]
    }
}
