//! Evaluation of a trained field.

use super::record::{FORMAT, FieldRecord, NAMES, Placement, geometry};
use crate::field::GpuField;
use crate::field::checkpoint::{self, Checkpoint};
use glam::Vec3;
use std::path::Path;
use tiface_base::Result;
use tiface_base::geom::{Ray, RayResult};
use tiface_kernels::cpu::vm::{self, DecoderWeights, RAY_WIDTH, VmField};

/// Renders rays in the field's coordinates on a device. `[n]` rays → `[n]`.
type Renderer = dyn FnMut(&[Ray]) -> Result<Vec<[f32; RAY_WIDTH]>> + Send;

/// The trained field on the host. Positions and distances are in scene units.
pub struct TFace {
    pub(super) field: VmField,
    /// Flat planes and lines of density and appearance, flat decoder weights.
    pub(super) values: [Vec<f32>; 3],
    weights: DecoderWeights,
    pub(super) placement: Option<Placement>,
    on_gpu: GpuField<Box<Renderer>>,
}

/// Number of rays rendered together. A sample whose color is decoded takes two kilobytes, and a ray
/// has dozens: this keeps them in the low hundreds of megabytes.
const PASS: usize = 1 << 11;

impl TFace {
    pub(super) fn from_parts(field: VmField, values: [Vec<f32>; 3], placement: Option<Placement>) -> TFace {
        let weights = DecoderWeights::new(field.decoder, &values[2]);
        TFace { field, values, weights, placement, on_gpu: GpuField::new(None) }
    }

    /// Loads the field from the checkpoint in a folder of `stage`.
    pub fn load(stage: &'static str, dir: &Path) -> Result<TFace> {
        TFace::restore(Checkpoint::read(&checkpoint::newest(dir), stage, FORMAT)?)
    }

    /// Reads the field from a checkpoint.
    pub(super) fn restore(mut file: Checkpoint) -> Result<TFace> {
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

    /// Renders on `device` from now on, if it supports the field's decoder.
    #[cfg(feature = "wgpu")]
    pub(super) fn on(&mut self, device: std::sync::Arc<tiface_kernels::gpu::Device>) {
        use tiface_kernels::gpu::{DeviceDecoder, VmRenderer};
        if DeviceDecoder::supports(&self.field.decoder).is_ok() {
            let values = self.values.each_ref().map(|v| v.as_slice());
            let mut renderer = VmRenderer::new(device, &self.field, values);
            let render: Box<Renderer> = Box::new(move |rays: &[Ray]| renderer.render(rays));
            self.on_gpu = GpuField::new(Some(render));
        }
    }

    /// Returns why the GPU is no longer used, if it failed.
    pub(super) fn gpu_failure(&self) -> Option<&str> {
        self.on_gpu.failure()
    }

    /// Renders rays in scene coordinates, with unit directions, of a camera that looks along the
    /// unit vector `forward`.
    pub fn render(&self, rays: &[Ray], forward: Vec3) -> Vec<RayResult> {
        let p = self.placement.unwrap_or(Placement { scale: 1.0, offset: [0.0; 3], depth_directions: false });
        // length of each direction in the field's units of t
        let stretch = |r: &Ray| {
            if p.depth_directions { 1.0 / r.direction.dot(forward).max(1e-3) } else { 1.0 }
        };
        let in_field = |rays: &[Ray]| -> Vec<Ray> {
            let to_field =
                |r: &Ray| Ray::new(p.scale * r.origin + Vec3::from(p.offset), r.direction * stretch(r));
            rays.iter().map(to_field).collect()
        };
        let result = |(o, r): (&[f32; RAY_WIDTH], &Ray)| RayResult {
            color: [o[0], o[1], o[2]].map(|c| c.clamp(0.0, 1.0)),
            opacity: o[3].clamp(0.0, 1.0),
            depth: if o[3] > 0.0 { o[4] / o[3] * stretch(r) / p.scale } else { 0.0 },
            normal: Vec3::ZERO,
        };
        if let Some(composited) = self.on_gpu.ask(|render| render(&in_field(rays))) {
            return composited.iter().zip(rays).map(result).collect();
        }
        let [density, color, _] = &self.values;
        let pass = |rays: &[Ray]| -> Vec<RayResult> {
            let composited = vm::composited(&self.field, density, color, &self.weights, &in_field(rays));
            composited.as_chunks().0.iter().zip(rays).map(result).collect()
        };
        rays.chunks(PASS).flat_map(pass).collect()
    }
}
