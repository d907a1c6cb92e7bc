//! What is learned, and the grid it lives on.

use crate::config::{DensityActivation, VmConfig};
use crate::field;
use crate::field::optimizer::Moments;
use crate::kernel::march::Bitmask;
use crate::kernel::rng;
use crate::kernel::vm::mask::{BoxMask, Lattice};
use crate::kernel::vm::{
    DecoderShape, Grid, Shading, VmField, samples_across, size_for, step_size, voxel_schedule,
};
use burn::module::Param;
use burn::tensor::{Device, Tensor};
use std::sync::Arc;

/// Training between two steps.
pub struct State {
    /// Lower and upper corner of the grid, scene units.
    pub bounds: [[f32; 3]; 2],
    /// Vertices along each axis.
    pub size: [usize; 3],
    /// Flat planes and lines of the density.
    pub density: Param<Tensor<1>>,
    /// Flat planes and lines of the appearance.
    pub color: Param<Tensor<1>>,
    /// Flat decoder weights.
    pub network: Param<Tensor<1>>,
    /// Optimiser, in the order of the three.
    pub moments: [Moments<1>; 3],
    /// Cells that may hold anything; all without.
    pub mask: Option<BoxMask>,
    /// Optimiser steps done.
    pub step: u64,
    /// Step at which the learning rates last started.
    pub reset: u64,
    /// Step at which the moments last started: whenever the grids change their size.
    pub moments_from: u64,
    /// Has the alpha mask been rebuilt at least once?
    pub masked: bool,
    /// Running mean of the squared colour error, for the PSNR that is shown.
    pub mean_square: f64,
    /// Mixed into the seed: 1 after a restore from a diverged step, so that other rays are drawn.
    pub salt: u64,
}

fn triple(list: &[usize]) -> [usize; 3] {
    [list[0], list[1], list[2]]
}

/// Grids of a size: density, appearance.
pub fn grids(config: &VmConfig, size: [usize; 3]) -> (Grid, Grid) {
    (Grid { size, rank: triple(&config.density_rank) }, Grid { size, rank: triple(&config.color_rank) })
}

/// The decoder that a configuration describes.
pub fn decoder(config: &VmConfig) -> DecoderShape {
    DecoderShape {
        channels: config.color_rank.iter().sum(),
        features: config.features,
        hidden: config.hidden,
        view_frequencies: config.view_frequencies,
        feature_frequencies: config.feature_frequencies,
    }
}

/// A trainable parameter of these values.
pub fn param(values: Vec<f32>, device: &Device) -> Param<Tensor<1>> {
    let n = values.len();
    Param::from_tensor(field::tensor(values, [n], device).autodiff().require_grad())
}

/// The parameter's values on the host.
pub fn read(param: &Param<Tensor<1>>) -> Vec<f32> {
    field::values(param.val().inner())
}

/// Fresh moments for parameters of these lengths.
pub fn no_moments(lengths: [usize; 3], device: &Device) -> [Moments<1>; 3] {
    lengths.map(|n| Moments::zeros([n], device))
}

/// Planes and lines 0.1 N(0, 1); matrices and biases U(±1/√fan_in), the last bias 0: as published.
fn start_values(config: &VmConfig, size: [usize; 3], seed: u64) -> [Vec<f32>; 3] {
    let (density, color) = grids(config, size);
    let noise = |stream: u64, n: usize| -> Vec<f32> {
        (0..n as u64).map(|i| 0.1 * rng::normal(seed, stream, i)).collect()
    };
    let shapes = decoder(config).shapes();
    let mut network = Vec::new();
    for (k, &(rows, columns)) in shapes.iter().enumerate() {
        // a bias has the fan-in of the matrix before it
        let bias = columns == 1 && k > 0;
        let fan_in = if bias { shapes[k - 1].1 } else { columns };
        let bound = if k == shapes.len() - 1 { 0.0 } else { 1.0 / (fan_in as f32).sqrt() };
        let stream = 311 + k as u64;
        network.extend(
            (0..(rows * columns) as u64).map(|i| bound * (2.0 * rng::uniform(seed, stream, i) - 1.0)),
        );
    }
    [noise(301, density.len()), noise(302, color.len()), network]
}

/// The hull as cells, one cell wider all around.
fn hull_mask(hull: &Bitmask) -> BoxMask {
    let r = hull.resolution;
    let near = |c: usize| c.saturating_sub(1)..(c + 2).min(r);
    BoxMask::new([-1.0; 3], [1.0; 3], [r; 3], |[x, y, z]| {
        near(x).any(|x| near(y).any(|y| near(z).any(|z| hull.get((x * r + y) * r + z))))
    })
}

impl State {
    /// The start, before any step.
    pub fn new(
        config: &VmConfig,
        seed: u64,
        bounds: [[f32; 3]; 2],
        hull: Option<&Bitmask>,
        device: &Device,
    ) -> State {
        let extent = std::array::from_fn(|a| bounds[1][a] - bounds[0][a]);
        let size = size_for(extent, config.voxels_start);
        let [density, color, network] = start_values(config, size, seed);
        State {
            bounds,
            size,
            moments: no_moments([density.len(), color.len(), network.len()], device),
            density: param(density, device),
            color: param(color, device),
            network: param(network, device),
            mask: hull.map(hull_mask),
            step: 0,
            reset: 0,
            moments_from: 0,
            masked: false,
            mean_square: 0.0,
            salt: 0,
        }
    }

    /// Is every weight a finite number? A NaN in a relu density has neither weight nor gradient: no loss
    /// would tell, and total variation would spread it.
    pub fn is_finite(&self) -> bool {
        [&self.density, &self.color, &self.network].iter().all(|p| read(p).iter().all(|v| v.is_finite()))
    }

    /// The field as the kernels see it. In training a ray has `‖size‖ / ratio` samples, else as many as the
    /// box's diagonal needs; both as published.
    pub fn field(&self, config: &VmConfig, training: bool) -> Arc<VmField> {
        let (density, color) = grids(config, self.size);
        let extent: [f32; 3] = std::array::from_fn(|a| self.bounds[1][a] - self.bounds[0][a]);
        let ratio = config.step_ratio as f32;
        let step = step_size(extent, self.size, ratio);
        let vertices = self.size.iter().map(|&n| (n * n) as f32).sum::<f32>().sqrt();
        let samples = if training { (vertices / ratio) as usize } else { samples_across(extent, step) };
        Arc::new(VmField {
            density,
            color,
            decoder: decoder(config),
            lattice: Lattice {
                min: self.bounds[0],
                max: self.bounds[1],
                step,
                samples: samples.min(1_000_000),
                near: 0.0,
                far: 1e6,
            },
            shading: shading(config),
            mask: self.mask.clone(),
        })
    }
}

/// From features to weights, as configured.
pub fn shading(config: &VmConfig) -> Shading {
    Shading {
        softplus: config.activation == DensityActivation::Softplus,
        shift: config.density_shift as f32,
        distance_scale: config.distance_scale as f32,
        weight_threshold: config.weight_threshold as f32,
        stop: config.stop as f32,
    }
}

/// Voxels after each upsampling.
pub fn upsampled_voxels(config: &VmConfig) -> Vec<u64> {
    voxel_schedule(config.voxels_start, config.voxels_final, config.upsample_steps.len().max(1))
}
