//! Stages `baseline` and `tface`: TensoRF's vector-matrix radiance field learned from photographs.
//!
//! Chen et al. 2022 (TensoRF) with the mask loss of T-Face (TI-Face, ICCV 2023 View Synthesis
//! Challenge for Human Heads): the opacity that background rays collect is pushed to zero. The
//! baseline is the same code on photographs as they are; only its box still comes from the masks.

mod cpu;
#[cfg(feature = "wgpu")]
mod gpu;
mod import;
mod infer;
mod mean;
mod ops;
mod record;
mod refine;
#[cfg(feature = "wgpu")]
mod self_test;
mod state;
mod train;

pub use import::import;
pub use infer::TFace;
pub use mean::{FieldMean, train};
pub use train::TfaceReport;

use crate::config::VmConfig;
use crate::field::ComputeDevice;
use tiface_base::Result;
use tiface_base::geom::Aabb;

/// Refuses a GPU that cannot hold the training of a field, before its photographs are known: they
/// need no memory there. Without `bounds`, the box that the masks give, refuses what fits in no
/// box. An imported field is not trained.
pub fn require_fit(
    stage: &str,
    config: &VmConfig,
    bounds: Option<Aabb>,
    device: &ComputeDevice,
) -> Result<()> {
    #[cfg(not(feature = "wgpu"))]
    let _ = (stage, config, bounds);
    match device {
        ComputeDevice::Cpu(_) => Ok(()),
        #[cfg(feature = "wgpu")]
        ComputeDevice::Gpu(_) if !config.import.is_empty() => Ok(()),
        #[cfg(feature = "wgpu")]
        ComputeDevice::Gpu(found) => {
            use crate::field::pixels::RaySampler;
            use gpu::GpuVm;
            train::check(stage, config)?;
            let (none, device) =
                (RaySampler::new(&[], f32::INFINITY, 1.0, config.foreground, false), &found.device);
            let fits = match bounds.map(|bounds| [bounds.min.to_array(), bounds.max.to_array()]) {
                Some(bounds) => GpuVm::fits(stage, config, &none, bounds, device),
                None => GpuVm::fits_some_box(stage, config, &none, device),
            };
            fits.map(drop)
        }
    }
}

/// Whether a GPU learns a vector-matrix field as the CPU does.
pub const VM_TEST: crate::field::SelfTest = crate::field::SelfTest {
    field: "vector-matrix",
    #[cfg(feature = "wgpu")]
    run: self_test::vm,
};
