//! What a training of I-Face keeps between steps, and how it lies in a checkpoint.

use super::model::{initial, parts};
use super::occupancy::Occupancy;
use super::stereo::SurfacePoint;
use crate::Result;
use crate::config::iface::IfaceConfig;
use crate::field::checkpoint::Checkpoint;
use crate::field::parameters::HostGroup;
use crate::kernel::cpu::march::Bitmask;
use crate::kernel::cpu::mlp::Weights;
use crate::kernel::cpu::sdf::FieldShape;
use crate::kernel::cpu::weight_norm;

/// Version of the checkpoints' layout.
pub const FORMAT: &str = "tiface-iface-1";

/// Training between two steps.
pub struct SdfState {
    /// Hash table, networks and variance.
    pub groups: [HostGroup; 3],
    /// Cells to march through.
    pub occupancy: Occupancy,
    /// Rays of the next step.
    pub rays: usize,
    /// Points on which photographs agree, once they are found.
    pub stereo: Vec<SurfacePoint>,
}

impl SdfState {
    /// Returns the state before the first step.
    pub fn new(config: &IfaceConfig, seed: u64, hull: Option<&Bitmask>) -> SdfState {
        SdfState {
            groups: initial(config, seed),
            occupancy: Occupancy::new(config, hull),
            rays: config.rays,
            stereo: Vec::new(),
        }
    }

    /// Puts the state into a checkpoint.
    pub fn save(&self, into: &mut Checkpoint) {
        self.groups.iter().for_each(|group| group.save(into, true));
        self.occupancy.save(into);
        if !self.stereo.is_empty() {
            into.put_floats("stereo", &[self.stereo.len(), 5], bytemuck::cast_slice(&self.stereo).to_vec());
            into.set("stereo", self.stereo.len());
        }
        into.set("rays", self.rays);
    }

    /// Takes the state out of a checkpoint; names, shapes and types must be exactly the configured model's.
    pub fn restore(config: &IfaceConfig, hull: Option<&Bitmask>, from: &mut Checkpoint) -> Result<SdfState> {
        let [table, network, variance] = parts(config).map(|parts| HostGroup::restore(parts, from, true));
        let groups = [table?, network?, variance?];
        let mut occupancy = Occupancy::new(config, hull);
        occupancy.restore(from)?;
        let most = config.rays.max(config.max_rays) as u64;
        let mut stereo = Vec::new();
        if from.has("stereo") {
            let count = from.number("stereo", 1..=1 << 32)? as usize;
            stereo = bytemuck::cast_slice(&from.floats("stereo", &[count, 5])?).to_vec();
        }
        Ok(SdfState { groups, occupancy, rays: from.number("rays", 1..=most)? as usize, stereo })
    }

    /// Returns the hash table, `[entries, 2]`.
    pub fn table(&self) -> &[[f32; 2]] {
        bytemuck::cast_slice(self.groups[0].values())
    }

    /// Returns the flat network weights of the field, weight norm applied, and the same prepared for its kernels.
    pub fn weights(&self, shape: &FieldShape) -> (Vec<f32>, Weights) {
        let flat = weight_norm::forward(shape.layout(), self.groups[1].values());
        let weights = Weights::new(shape.layout(), &flat);
        (flat, weights)
    }

    /// Returns the NeuS sharpness.
    pub fn inv_s(&self) -> f32 {
        (10.0 * self.groups[2].values()[0]).exp().clamp(1e-6, 1e6)
    }
}
