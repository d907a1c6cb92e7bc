//! The color decoder of [`crate::kernel::cpu::vm`] without encodings, which is what is published.
//!
//! Between products and first layer lies nothing but two matrices; here they are one:
//!
//! ```text
//! M = W1_features B     h1 = relu(M products + W1_direction d + b1)     h2 = relu(W2 h1 + b2)     rgb = sigmoid(W3 h2 + b3)
//! g_B = W1_featuresᵀ g_M     g_W1_features = g_M Bᵀ
//! ```
//!
//! A group of 256 threads takes 64 samples through all layers, or 32 where hidden layers are wider than 64. The backward
//! takes them through once more: that costs less than to write down and read what lies between.

mod kernels;

use super::super::device::{Buffer, Device, Words, groups, launch};
use super::super::draw::Batch;
use super::super::tile::{self, UNITS};
use super::grid::{DeviceGrid, NONE};
use super::march::VmSamples;
use super::rays::Along;
use crate::kernel::cpu::vm::DecoderShape;
use kernels::{backward, chain, forward, prepare, reduce};

/// Groups that take tiles, one after the other, and sum gradients of weights, each over its own.
const GROUPS: usize = 256;

/// Where the matrices of a decoder stand, in rows of as many floats as a tile has channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Plan {
    /// Vectors of each term's channels.
    quads: [usize; 3],
    /// Channels of the CPU.
    channels: usize,
    features: usize,
    hidden: usize,
    lanes: usize,
}

impl Plan {
    /// Vectors of products.
    fn products(&self) -> usize {
        self.quads.iter().sum()
    }

    /// Inputs of the first layer: products, direction, 0.
    fn inputs(&self) -> usize {
        4 * self.products() + 4
    }

    /// Floats of a row.
    fn width(&self) -> usize {
        tile::channels(self.lanes)
    }

    /// Tiles that hold the inputs.
    fn pieces(&self) -> usize {
        self.inputs().div_ceil(self.width())
    }

    /// Inputs in a piece.
    fn piece(&self, p: usize) -> usize {
        (self.inputs() - p * self.width()).min(self.width())
    }

    /// First rows of `[M, W1_direction]ᵀ`, b1, W2ᵀ, b2, W3, b3, `[M, W1_direction]` (one piece after the other), W2, and
    /// the end.
    fn rows(&self) -> [usize; 9] {
        let w = self.width();
        let counts = [self.inputs(), 1, w, 1, 3, 1, self.pieces() * w, w];
        std::array::from_fn(|i| counts[..i].iter().sum())
    }

    /// First rows of the gradients of `[M, W1_direction]` (one piece after the other), b1, W2, b2, W3, b3, and the end.
    fn gradients(&self) -> [usize; 7] {
        let w = self.width();
        let counts = [self.pieces() * w, 1, w, 1, 3, 1];
        std::array::from_fn(|i| counts[..i].iter().sum())
    }

    /// Where B, W1, b1, W2, b2, W3, b3 begin among the flat weights, and the end.
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
    plan: Plan,
    /// The CPU's channel of each on the device, and the other way round.
    real: Buffer,
    padded: Buffer,
    weights: Buffer,
    /// Gradients by products, `[chunk, channels]`.
    g_products: Buffer,
    pub(super) chunk: usize,
    capacity: usize,
    partial: Buffer,
    summed: Buffer,
}

impl DeviceDecoder {
    /// Samples whose gradients by products are there at once.
    pub const CHUNK: usize = 1 << 20;

    /// Can a device decode this? Else what it cannot.
    pub fn supports(shape: &DecoderShape) -> Result<(), &'static str> {
        if shape.view_frequencies > 0 || shape.feature_frequencies > 0 {
            return Err("encodings of directions or features");
        }
        if shape.hidden > 128 { Err("hidden layers wider than 128") } else { Ok(()) }
    }

    /// Of the products of a grid, for up to `capacity` samples; with room for gradients where it learns.
    pub fn new(
        device: &Device,
        shape: &DecoderShape,
        grid: &DeviceGrid,
        capacity: usize,
        learns: bool,
    ) -> DeviceDecoder {
        assert_eq!(DeviceDecoder::supports(shape), Ok(()));
        let lanes = if shape.hidden > tile::channels(16) { 8 } else { 16 };
        let (features, hidden, quads) = (shape.features, shape.hidden, grid.quads());
        let plan = Plan { quads, channels: shape.channels, features, hidden, lanes };
        let real = grid.channels();
        let mut padded = vec![0u32; shape.channels];
        for (c, &own) in real.iter().enumerate().filter(|(_, own)| **own != NONE) {
            padded[own as usize] = c as u32;
        }
        // a power of two, so that pieces are whole tiles
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
            partial: learned(GROUPS * gradients),
            summed: learned(gradients),
        }
    }

    /// Makes the weights ready, as the CPU has them.
    pub fn prepare(&self, device: &Device, flat: &Buffer) {
        assert_eq!(flat.words(), self.plan.parts()[7]);
        launch!(device, prepare::launch, groups(self.weights.words().div_ceil(UNITS as usize)), UNITS;
            flat, self.real, self.weights; self.plan
        );
    }

    /// Colors of the samples worth one.
    pub fn forward(
        &self,
        device: &Device,
        grid: &DeviceGrid,
        values: &Buffer,
        rays: &Batch,
        samples: &VmSamples,
        along: &Along,
    ) {
        assert!(along.index.words() == self.capacity && values.words() == grid.len());
        let tiles = self.capacity.div_ceil(4 * self.plan.lanes);
        // SAFETY: all planes have `capacity` samples, a multiple of a tile's, and no tile reaches beyond it.
        unsafe {
            launch!(device, forward::launch_unchecked, groups(tiles.min(8 * GROUPS)), UNITS;
                self.weights, values, grid.words(), samples.place, samples.ray, rays.direction, along.index,
                along.count, along.rgb;
                self.plan
            );
        }
    }

    /// Adds the gradient of planes and lines and writes that of the flat weights; `broken`, `[1]`, becomes 1 where one of
    /// these is not finite.
    pub fn backward(
        &self,
        device: &Device,
        grid: &DeviceGrid,
        values: &Buffer,
        rays: &Batch,
        samples: &VmSamples,
        along: &Along,
        flat: &Buffer,
        g_values: &Buffer,
        g_flat: &Buffer,
        broken: &Buffer,
    ) {
        assert!(along.index.words() == self.capacity && values.words() == grid.len());
        for from in (0..self.capacity).step_by(self.chunk) {
            // SAFETY: all planes have `capacity` samples, a multiple of a tile's, and no tile reaches beyond it.
            unsafe {
                launch!(device, backward::launch_unchecked, groups(self.summing()), UNITS;
                    self.weights, values, grid.words(), samples.place, samples.ray, rays.direction,
                    along.index, along.count, along.g_pre, self.g_products, self.partial;
                    from as u32, self.chunk as u32, self.plan
                );
            }
            let part = Some((&along.index, from, self.chunk));
            let (place, count) = (&samples.place, &along.count);
            grid.scatter(device, g_values, values, place, part, count, &self.g_products);
        }
        launch!(device, reduce::launch, groups(self.summed.words().div_ceil(UNITS as usize)), UNITS;
            self.partial, along.count, self.summed; 4 * self.plan.lanes as u32, self.summing() as u32
        );
        launch!(device, chain::launch, groups(flat.words().div_ceil(UNITS as usize)), UNITS;
            flat, self.real, self.padded, self.summed, g_flat, broken; self.plan
        );
    }

    fn summing(&self) -> usize {
        GROUPS.min(self.chunk.div_ceil(4 * self.plan.lanes))
    }
}
