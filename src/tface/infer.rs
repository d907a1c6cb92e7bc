//! A trained field, evaluated.

use super::record::{FORMAT, FieldRecord, NAMES, Placement, geometry};
use crate::Result;
use crate::field::checkpoint::{self, Checkpoint};
use crate::geom::{Ray, RayResult};
use crate::kernel::march::MarchRay;
use crate::kernel::vm::{self, DecoderWeights, RAY_WIDTH, VmField};
use glam::Vec3;
use std::path::Path;

/// The trained field on the host. Positions and distances are in scene units.
pub struct TFace {
    pub(super) field: VmField,
    /// Flat planes and lines of density and appearance, flat decoder weights.
    pub(super) values: [Vec<f32>; 3],
    weights: DecoderWeights,
    pub(super) placement: Option<Placement>,
}

/// Rays rendered together: what they keep stays in the low hundreds of megabytes.
const PASS: usize = 1 << 13;

impl TFace {
    pub(super) fn from_parts(field: VmField, values: [Vec<f32>; 3], placement: Option<Placement>) -> TFace {
        let weights = DecoderWeights::new(field.decoder, &values[2]);
        TFace { field, values, weights, placement }
    }

    /// Loads the field from the checkpoint in a folder of `stage`.
    pub fn load(stage: &'static str, dir: &Path) -> Result<TFace> {
        let mut file = Checkpoint::read(&checkpoint::newest(dir), stage, FORMAT)?;
        let record = FieldRecord::restore(&file)?;
        let (bounds, size, mask) = geometry(&mut file)?;
        let field = record.field(bounds, size, mask);
        let lengths = [field.density.len(), field.color.len(), field.decoder.len()];
        let mut values = [const { Vec::new() }; 3];
        for ((name, len), values) in NAMES.iter().zip(lengths).zip(&mut values) {
            *values = file.floats(&format!("model.{name}"), &[len])?;
        }
        Ok(TFace::from_parts(field, values, record.placement))
    }

    /// Volume render of rays in scene coordinates, with unit directions, of a camera that looks along the unit
    /// vector `forward`.
    pub fn render(&self, rays: &[Ray], forward: Vec3) -> Vec<RayResult> {
        rays.chunks(PASS).flat_map(|rays| self.pass(rays, forward)).collect()
    }

    fn pass(&self, rays: &[Ray], forward: Vec3) -> Vec<RayResult> {
        let p = self.placement.unwrap_or(Placement { scale: 1.0, offset: [0.0; 3], depth_directions: false });
        // length of each direction in the field's units of t
        let stretch = |r: &Ray| {
            if p.depth_directions { 1.0 / r.direction.dot(forward).max(1e-3) } else { 1.0 }
        };
        let placed: Vec<MarchRay> = rays
            .iter()
            .map(|r| MarchRay {
                origin: std::array::from_fn(|a| p.scale * r.origin[a] + p.offset[a]),
                direction: (r.direction * stretch(r)).to_array(),
                jitter: 0.0,
            })
            .collect();
        let [density, color, _] = &self.values;
        vm::render(&self.field, density, color, &self.weights, &placed)
            .out
            .chunks_exact(RAY_WIDTH)
            .zip(rays)
            .map(|(o, r)| RayResult {
                color: [o[0], o[1], o[2]].map(|c| c.clamp(0.0, 1.0)),
                opacity: o[3].clamp(0.0, 1.0),
                depth: if o[3] > 0.0 { o[4] / o[3] * stretch(r) / p.scale } else { 0.0 },
                normal: Vec3::ZERO,
            })
            .collect()
    }
}
