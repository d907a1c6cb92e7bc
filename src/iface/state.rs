//! The state of an I-Face training between steps, and its checkpoint format.

use super::occupancy::Occupancy;
use super::stereo::SurfacePoint;
use crate::config::iface::IfaceConfig;
use crate::field::checkpoint::Checkpoint;
use crate::field::parameters::{HostGroup, ParameterPart};
use tiface_base::Result;
use tiface_base::geom::BitGrid;
use tiface_kernels::cpu::mlp::Weights;
use tiface_kernels::cpu::sdf::FieldShape;
use tiface_kernels::cpu::weight_norm;

/// Version of the checkpoints' layout.
pub const FORMAT: &str = "tiface-iface-1";

/// State of a training between two steps, for a field with `GROUPS` parameter groups.
pub struct FieldState<const GROUPS: usize> {
    /// Hash table, networks and, of a signed distance, variance.
    pub groups: [HostGroup; GROUPS],
    /// Cells to march through.
    pub occupancy: Occupancy,
    /// Number of rays of the next step.
    pub rays: usize,
    /// Stereo points that several photographs agree on, once they are found.
    pub stereo: Vec<SurfacePoint>,
}

/// State of a signed distance's training.
pub type SdfState = FieldState<3>;

impl<const GROUPS: usize> FieldState<GROUPS> {
    /// Returns the state before the first step, with the given groups.
    pub fn start(groups: [HostGroup; GROUPS], config: &IfaceConfig, hull: Option<&BitGrid>) -> Self {
        let occupancy = Occupancy::new(config, hull);
        FieldState { groups, occupancy, rays: config.rays, stereo: Vec::new() }
    }

    /// Writes the state into a checkpoint.
    pub fn save(&self, into: &mut Checkpoint) {
        self.groups.iter().for_each(|group| group.save(into, true));
        self.occupancy.save(into);
        if !self.stereo.is_empty() {
            into.put_floats("stereo", &[self.stereo.len(), 5], bytemuck::cast_slice(&self.stereo).to_vec());
            into.set("stereo", self.stereo.len());
        }
        into.set("rays", self.rays);
    }

    /// Reads the state from a checkpoint; names, shapes and types must be exactly those of the
    /// parts. The moments that a finished checkpoint may lack are then zero.
    pub fn restore(
        parts: [Vec<ParameterPart>; GROUPS],
        config: &IfaceConfig,
        hull: Option<&BitGrid>,
        from: &mut Checkpoint,
    ) -> Result<Self> {
        let mut state =
            FieldState::start(parts.map(|parts| HostGroup { parts, ..HostGroup::default() }), config, hull);
        let with_moments = from.has_moments() || from.number_or("finished", 0, 0..=1)? == 0;
        for group in &mut state.groups {
            *group = HostGroup::restore(std::mem::take(&mut group.parts), from, with_moments)?;
        }
        state.occupancy.restore(from)?;
        if from.has("stereo") {
            let count = from.number("stereo", 1..=1 << 32)? as usize;
            state.stereo = bytemuck::cast_slice(&from.floats("stereo", &[count, 5])?).to_vec();
        }
        state.rays = from.number("rays", 1..=config.rays.max(config.max_rays) as u64)? as usize;
        Ok(state)
    }
}

impl SdfState {
    /// Returns the hash table, `[entries, 2]`.
    pub fn table(&self) -> &[[f32; 2]] {
        bytemuck::cast_slice(self.groups[0].values())
    }

    /// Returns the flat network weights of the field with weight norm applied, and the same weights
    /// prepared for the CPU kernels.
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
