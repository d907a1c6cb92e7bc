//! A trained field, asked from outside.

use super::{TfaceError, checkpoint};
use crate::geom::Ray;
use crate::kernel::vm::mask::VmRay;
use crate::kernel::vm::{self, DecoderWeights, RAY_WIDTH, VmField};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;

/// What a ray saw; colour is premultiplied by opacity (over black).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VmPixel {
    /// sRGB-coded colour, premultiplied, 0..=1.
    pub color: [f32; 3],
    /// Sum of weights, 0..=1.
    pub opacity: f32,
    /// Expected distance along the ray, scene units; 0 where nothing was met.
    pub depth: f32,
}

/// Where a field's coordinates are not the scene's: `field = scale · scene + offset`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Placement {
    /// Field units in a scene unit.
    pub scale: f32,
    /// Where the scene's origin is in the field.
    pub offset: [f32; 3],
    /// Ray directions are scaled to depth 1 along the optical axis before the decoder sees them, and steps are
    /// so much longer off the axis: what the published ILSH loader does.
    pub depth_directions: bool,
}

/// The trained field on the host. Positions and distances are in scene units.
pub struct TFace {
    pub(super) field: Arc<VmField>,
    pub(super) density: Vec<f32>,
    pub(super) color: Vec<f32>,
    pub(super) network: Vec<f32>,
    weights: DecoderWeights,
    pub(super) placement: Option<Placement>,
}

/// Rays rendered together: what they keep stays in the low hundreds of megabytes.
const PASS: usize = 1 << 13;

impl TFace {
    pub(super) fn from_parts(
        field: Arc<VmField>,
        density: Vec<f32>,
        color: Vec<f32>,
        network: Vec<f32>,
        placement: Option<Placement>,
    ) -> TFace {
        let weights = DecoderWeights::new(field.decoder, &network);
        TFace { field, density, color, network, weights, placement }
    }

    /// From the checkpoint in a stage folder.
    pub fn load(dir: &Path) -> Result<TFace, TfaceError> {
        Ok(checkpoint::load(&checkpoint::newest(dir))?.0)
    }

    /// Volume render of rays in scene coordinates, with unit directions, of a camera that looks along the unit
    /// vector `forward`.
    pub fn render(&self, rays: &[Ray], forward: Vec3) -> Vec<VmPixel> {
        rays.chunks(PASS).flat_map(|rays| self.pass(rays, forward)).collect()
    }

    fn pass(&self, rays: &[Ray], forward: Vec3) -> Vec<VmPixel> {
        let p = self.placement.unwrap_or(Placement { scale: 1.0, offset: [0.0; 3], depth_directions: false });
        // length of each direction in the field's units of t
        let stretch = |r: &Ray| {
            if p.depth_directions { 1.0 / r.direction.dot(forward).max(1e-3) } else { 1.0 }
        };
        let placed: Vec<VmRay> = rays
            .iter()
            .map(|r| VmRay {
                origin: std::array::from_fn(|a| p.scale * r.origin[a] + p.offset[a]),
                direction: (r.direction * stretch(r)).to_array(),
                jitter: 0.0,
            })
            .collect();
        vm::render(&self.field, &self.density, &self.color, &self.weights, &placed)
            .out
            .chunks_exact(RAY_WIDTH)
            .zip(rays)
            .map(|(o, r)| VmPixel {
                color: [o[0], o[1], o[2]].map(|c| c.clamp(0.0, 1.0)),
                opacity: o[3].clamp(0.0, 1.0),
                depth: if o[3] > 0.0 { o[4] / o[3] * stretch(r) / p.scale } else { 0.0 },
            })
            .collect()
    }
}
