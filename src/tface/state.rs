//! The state of a T-Face training between steps: parameters, and the geometry of the grid.

use super::record::{FieldRecord, NAMES, decoder, geometry, grids};
use crate::config::VmConfig;
use crate::field::checkpoint::Checkpoint;
use crate::field::parameters::{HostGroup, ParameterPart};
use std::sync::Arc;
use tiface_base::Result;
use tiface_base::geom::BitGrid;
use tiface_base::math::rng;
use tiface_kernels::cpu::vm::mask::BoxMask;
use tiface_kernels::cpu::vm::{VmField, size_for};

/// State of a training between two steps.
#[derive(Clone)]
pub struct VmState {
    /// Lower and upper corner of the grid, scene units.
    pub bounds: [[f32; 3]; 2],
    /// Vertices along each axis.
    pub size: [usize; 3],
    /// Flat planes and lines of the density, those of the appearance, flat decoder weights.
    pub groups: [HostGroup; 3],
    /// Cells that may be non-empty; all cells if `None`.
    pub mask: Option<BoxMask>,
    /// Step at which the learning rates last started.
    pub reset: u64,
    /// Step at which the moments last started: whenever the grids change their size.
    pub moments_from: u64,
    /// Whether the alpha mask has been rebuilt at least once.
    pub masked: bool,
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

/// Returns the field that is trained in a box with grids of `size`.
fn trained_field(
    config: &VmConfig,
    bounds: [[f32; 3]; 2],
    size: [usize; 3],
    mask: Option<BoxMask>,
) -> VmField {
    let mut field = FieldRecord::new(config).field(bounds, size, mask);
    let vertices = size.iter().map(|&n| (n * n) as f32).sum::<f32>().sqrt();
    field.lattice.samples = ((vertices / config.step_ratio as f32) as usize).min(1_000_000);
    field
}

/// Returns the edge lengths of a box.
fn extent(bounds: [[f32; 3]; 2]) -> [f32; 3] {
    std::array::from_fn(|a| bounds[1][a] - bounds[0][a])
}

/// Returns the fields with the first and with the last grids of a training in a box that stays as
/// it is.
#[cfg(feature = "wgpu")]
pub fn first_and_last(config: &VmConfig, bounds: [[f32; 3]; 2]) -> [VmField; 2] {
    let last = if config.upsample_at.is_empty() { config.voxels_start } else { config.voxels_final };
    [config.voxels_start, last]
        .map(|voxels| trained_field(config, bounds, size_for(extent(bounds), voxels), None))
}

/// The hull as cells, one cell wider all around.
fn hull_mask(hull: &BitGrid) -> Option<BoxMask> {
    BoxMask::from_bits([-1.0; 3], [1.0; 3], [hull.resolution; 3], hull.grown().bits)
}

impl VmState {
    /// Returns the state before the first step.
    pub fn new(config: &VmConfig, seed: u64, bounds: [[f32; 3]; 2], hull: Option<&BitGrid>) -> VmState {
        let size = size_for(extent(bounds), config.voxels_start);
        let mut names = NAMES.into_iter();
        let groups = start_values(config, size, seed)
            .map(|values| HostGroup::flat(names.next().unwrap_or_default(), values));
        let mask = hull.and_then(hull_mask);
        VmState { bounds, size, groups, mask, reset: 0, moments_from: 0, masked: false }
    }

    /// Returns whether every weight is finite. A NaN in a relu density has neither weight nor
    /// gradient, so no loss would show it, and total variation would spread it.
    pub fn is_finite(&self) -> bool {
        self.groups.iter().all(|group| group.is_finite())
    }

    /// Returns the field as the kernels see it. In training a ray has `‖size‖ / ratio` samples,
    /// else as many as the box's diagonal needs; both as published.
    pub fn field(&self, config: &VmConfig, training: bool) -> Arc<VmField> {
        let mask = self.mask.clone();
        Arc::new(match training {
            true => trained_field(config, self.bounds, self.size, mask),
            false => FieldRecord::new(config).field(self.bounds, self.size, mask),
        })
    }

    /// Writes the state into a checkpoint. A finished checkpoint omits the optimizer's moments,
    /// because no training resumes from it.
    pub fn save(&self, config: &VmConfig, into: &mut Checkpoint, finished: bool) {
        FieldRecord::new(config).save(self.bounds, self.size, self.mask.as_ref(), into);
        self.groups.iter().for_each(|group| group.save(into, !finished));
        into.set("reset", self.reset);
        into.set("moments_from", self.moments_from);
        into.set("masked", u64::from(self.masked));
    }

    /// Reads the state after `step` from a checkpoint; sizes and types must be exactly the
    /// configured model's.
    pub fn restore(
        &mut self,
        config: &VmConfig,
        from: &mut Checkpoint,
        step: u64,
        finished: bool,
    ) -> Result<()> {
        (self.reset, self.moments_from) =
            (from.number("reset", 0..=step)?, from.number("moments_from", 0..=step)?);
        self.masked = from.number("masked", 0..=1)? == 1;
        (self.bounds, self.size, self.mask) = geometry(from)?;
        let (density, color) = grids(config, self.size);
        let lengths = [density.len(), color.len(), decoder(config).len()];
        for ((group, name), len) in self.groups.iter_mut().zip(NAMES).zip(lengths) {
            *group = HostGroup::restore(vec![ParameterPart { name, shape: vec![len] }], from, !finished)?;
        }
        Ok(())
    }
}
