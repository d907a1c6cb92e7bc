//! The color decoder of [`crate::cpu::vm`] without encodings, like the published one.
//!
//! Only two matrices lie between the products and the first activation; here they are merged into
//! one:
//!
//! ```text
//! M = W1_features B     h1 = relu(M products + W1_direction d + b1)
//! h2 = relu(W2 h1 + b2)     rgb = sigmoid(W3 h2 + b3)
//! g_B = W1_featuresᵀ g_M     g_W1_features = g_M Bᵀ
//! ```
//!
//! A group of 256 threads evaluates all layers for 64 samples, or for 32 if hidden layers are wider
//! than 64. The backward pass recomputes the activations, which costs less than storing and loading
//! them. Gradients of weights are summed by group, in registers over its tiles, then over the
//! groups in a fixed order.

mod kernels;

use super::super::batch::DeviceBatch;
use super::super::device::{Buffer, Device, Words, groups, launch};
use super::super::sdf::kernels::sum_groups;
use super::super::tile::{self, UNITS};
use super::grid::{DeviceGrid, NONE};
use super::march::VmSamples;
use super::rays::CompositedRays;
use crate::cpu::vm::DecoderShape;
use kernels::{backward, chain, forward, prepare};

/// Maximum number of groups that sum gradients of weights, each over its own tiles. A thread keeps
/// 50 to 200 sums in registers, which then suffice for one or two groups on a multiprocessor, and
/// the largest cards have some 150.
const GROUPS: usize = 256;

/// Maximum number of groups that decode colors.
const DECODING: usize = 4096;

/// Sizes and offsets of the matrices of a decoder, in rows with as many floats as a tile has
/// channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct DecoderPlan {
    /// Number of vectors of four channels of each term.
    quads: [usize; 3],
    /// Number of channels on the CPU, without padding.
    channels: usize,
    features: usize,
    hidden: usize,
    lanes: usize,
}

impl DecoderPlan {
    fn new(shape: &DecoderShape, quads: [usize; 3]) -> DecoderPlan {
        let lanes = if shape.hidden > tile::channels(16) { 8 } else { 16 };
        let (channels, features, hidden) = (shape.channels, shape.features, shape.hidden);
        DecoderPlan { quads, channels, features, hidden, lanes }
    }

    /// Returns the number of vectors of products.
    fn products(&self) -> usize {
        self.quads.iter().sum()
    }

    /// Returns the number of inputs of the first layer: products, direction, 0.
    fn inputs(&self) -> usize {
        4 * self.products() + 4
    }

    /// Returns the number of floats of a row.
    fn width(&self) -> usize {
        tile::channels(self.lanes)
    }

    /// Returns the number of pieces of the inputs, each of which fills a tile.
    fn pieces(&self) -> usize {
        self.inputs().div_ceil(self.width())
    }

    /// Returns the first rows of `[M, W1_direction]ᵀ`, b1, W2ᵀ, b2, W3, b3, `[M, W1_direction]`
    /// (one piece after the other), W2, and the end.
    fn rows(&self) -> [usize; 9] {
        let w = self.width();
        let counts = [self.inputs(), 1, w, 1, 3, 1, self.pieces() * w, w];
        std::array::from_fn(|i| counts[..i].iter().sum())
    }

    /// Returns the first rows of the gradients of `[M, W1_direction]` (one piece after the other),
    /// b1, W2, b2, W3, b3, and the end.
    fn gradients(&self) -> [usize; 7] {
        let w = self.width();
        let counts = [self.pieces() * w, 1, w, 1, 3, 1];
        std::array::from_fn(|i| counts[..i].iter().sum())
    }

    /// Returns the number of groups that sum gradients of up to so many samples.
    fn groups(&self, samples: usize) -> usize {
        GROUPS.min(samples.div_ceil(4 * self.lanes))
    }

    /// Returns the offsets of B, W1, b1, W2, b2, W3, b3 in the flat weights, and the end.
    fn parts(&self) -> [usize; 8] {
        let shape = DecoderShape {
            channels: self.channels,
            features: self.features,
            hidden: self.hidden,
            view_frequencies: 0,
            feature_frequencies: 0,
        };
        let counts = shape.shapes().map(|(o, i)| o * i);
        std::array::from_fn(|i| counts[..i].iter().sum())
    }
}

/// A decoder on a device.
pub struct DeviceDecoder {
    plan: DecoderPlan,
    /// Channel on the CPU of each channel on the device.
    real: Buffer,
    /// Channel on the device of each channel on the CPU.
    padded: Buffer,
    weights: Buffer,
    /// Gradients with respect to products, `[chunk, channels]`.
    g_products: Buffer,
    pub(super) chunk: usize,
    capacity: usize,
    /// Maximum number of groups that sum gradients of weights.
    pub(super) groups: usize,
    partial: Buffer,
    summed: Buffer,
}

impl DeviceDecoder {
    /// Maximum number of samples whose gradients with respect to products are stored at once.
    pub const CHUNK: usize = 1 << 20;

    /// Checks whether a device can decode this shape. The error names the unsupported property.
    pub fn supports(shape: &DecoderShape) -> Result<(), &'static str> {
        if shape.view_frequencies > 0 || shape.feature_frequencies > 0 {
            return Err("encodings of directions or features");
        }
        if shape.hidden > 128 { Err("hidden layers wider than 128") } else { Ok(()) }
    }

    /// Returns the memory of the gradients of products and weights in words, for up to `capacity`
    /// samples.
    pub fn words_of_gradients(shape: &DecoderShape, quads: [usize; 3], capacity: usize) -> usize {
        let plan = DecoderPlan::new(shape, quads);
        let chunk = capacity.min(Self::CHUNK);
        chunk * 4 * plan.products() + (plan.groups(chunk) + 1) * plan.gradients()[6] * plan.width()
    }

    /// Creates a decoder of the products of a grid, for up to `capacity` samples; buffers for
    /// gradients are allocated only if `learns` is set.
    pub fn new(
        device: &Device,
        shape: &DecoderShape,
        grid: &DeviceGrid,
        capacity: usize,
        learns: bool,
    ) -> DeviceDecoder {
        assert_eq!(DeviceDecoder::supports(shape), Ok(()));
        let plan = DecoderPlan::new(shape, grid.quads());
        let real = grid.channels();
        let mut padded = vec![0u32; shape.channels];
        for (c, &cpu_channel) in real.iter().enumerate().filter(|(_, real)| **real != NONE) {
            padded[cpu_channel as usize] = c as u32;
        }
        // a power of two, so that chunks consist of whole tiles
        let fits = (device.limits().largest_buffer as usize / (16 * plan.products()).max(1)).max(super::TILE);
        let chunk = capacity.min(Self::CHUNK).min(1 << fits.ilog2());
        let learned = |words: usize| device.scratch::<f32>(if learns { words } else { 1 });
        let gradients = plan.gradients()[6] * plan.width();
        DeviceDecoder {
            plan,
            real: device.upload(&real),
            padded: device.upload(&padded),
            weights: device.scratch::<f32>(plan.rows()[8] * plan.width()),
            g_products: learned(chunk * 4 * plan.products()),
            chunk,
            capacity,
            partial: learned(plan.groups(chunk) * gradients),
            groups: plan.groups(chunk),
            summed: learned(gradients),
        }
    }

    /// Converts the flat weights, as on the CPU, to the layout of the kernels.
    pub fn prepare(&self, device: &Device, flat: &Buffer) {
        assert_eq!(flat.word_count(), self.plan.parts()[7]);
        launch!(device, prepare::launch, groups(self.weights.word_count().div_ceil(UNITS as usize)), UNITS;
            flat, self.real, self.weights; self.plan
        );
    }

    /// Computes the colors of all samples whose weight is above the threshold.
    pub fn forward(
        &self,
        device: &Device,
        grid: &DeviceGrid,
        values: &Buffer,
        rays: &DeviceBatch,
        samples: &VmSamples,
        composited: &CompositedRays,
    ) {
        assert!(composited.index.word_count() == self.capacity && values.word_count() == grid.len());
        let tiles = self.capacity.div_ceil(4 * self.plan.lanes);
        // SAFETY: all planes have `capacity` samples, a multiple of a tile's, and no tile reaches
        // beyond it.
        unsafe {
            launch!(device, forward::launch_unchecked, groups(tiles.min(DECODING)), UNITS;
                self.weights, values, grid.sizes(), samples.place, samples.ray, rays.direction,
                composited.index, composited.count, composited.rgb;
                self.plan
            );
        }
    }

    /// Adds the gradient with respect to planes and lines, and writes that with respect to the flat
    /// weights. Sets `non_finite`, `[1]`, to 1 if a value of the latter is not finite.
    pub fn backward(
        &self,
        device: &Device,
        grid: &DeviceGrid,
        values: &Buffer,
        rays: &DeviceBatch,
        samples: &VmSamples,
        composited: &CompositedRays,
        flat: &Buffer,
        g_values: &Buffer,
        g_flat: &Buffer,
        non_finite: &Buffer,
    ) {
        assert!(composited.index.word_count() == self.capacity && values.word_count() == grid.len());
        for from in (0..self.capacity).step_by(self.chunk) {
            // SAFETY: all planes have `capacity` samples, a multiple of a tile's, and no tile
            // reaches beyond it.
            unsafe {
                launch!(device, backward::launch_unchecked, groups(self.summing()), UNITS;
                    self.weights, values, grid.sizes(), samples.place, samples.ray, rays.direction,
                    composited.index, composited.count, composited.g_pre, self.g_products, self.partial;
                    from as u32, self.chunk as u32, self.plan
                );
            }
            let part = Some((&composited.index, from, self.chunk));
            let (place, count) = (&samples.place, &composited.count);
            grid.scatter(device, g_values, values, place, part, count, &self.g_products);
        }
        let sizes = (self.summed.word_count(), 4 * self.plan.lanes, self.summing());
        sum_groups(device, &self.partial, None, &composited.count, &self.summed, sizes);
        launch!(device, chain::launch, groups(flat.word_count().div_ceil(UNITS as usize)), UNITS;
            flat, self.real, self.padded, self.summed, g_flat, non_finite; self.plan
        );
    }

    fn summing(&self) -> usize {
        self.groups.min(self.plan.groups(self.chunk))
    }
}
