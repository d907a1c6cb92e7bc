//! Stage `iface`: a signed-distance field learned from masked photographs.
//!
//! Instant-NGP's hash grid (Müller et al. 2022) under a small network gives a signed distance; NeuS
//! (Wang et al. 2021) renders it; color, mask, eikonal and sparsity losses train it (I-Face of
//! TI-Face, ICCV 2023 View Synthesis Challenge for Human Heads). The `paper` preset follows the
//! published system; the others start from the masks' visual hull, sample only a band around the
//! surface, let the surface be softer in hair than on skin (Wang et al. 2023, "Adaptive Shells"),
//! show the color network the hash features themselves, and hold the surface to points that stereo
//! finds on it half-way (Fu et al. 2022, "Geo-NeuS", use points of a reconstruction as zero set).

mod cpu;
mod density;
#[cfg(feature = "wgpu")]
mod gpu;
mod hull_start;
mod infer;
mod model;
mod occupancy;
mod ops;
mod schedule;
#[cfg(feature = "wgpu")]
mod self_test;
mod state;
mod stereo;
mod train;

pub use density::{DensityField, train_density};
pub use infer::IFace;
pub use train::{IfaceReport, train};

use crate::config::iface::IfaceConfig;
use crate::field::{ComputeDevice, SelfTest, checkpoint};
use std::path::Path;
use tiface_base::Result;

/// Whether a GPU learns a signed distance as the CPU does.
pub const SDF_TEST: SelfTest = SelfTest {
    field: "signed distance",
    #[cfg(feature = "wgpu")]
    run: self_test::sdf,
};

/// Whether a GPU learns a density as the CPU does.
pub const DENSITY_TEST: SelfTest = SelfTest {
    field: "density",
    #[cfg(feature = "wgpu")]
    run: self_test::density,
};

/// Returns the bytes of a finished checkpoint without what only training reads; `None` if it holds
/// nothing else, or is not finished.
pub fn without_moments(checkpoint: &Path) -> Result<Option<Vec<u8>>> {
    checkpoint::without_moments(checkpoint, "iface", &[state::FORMAT, density::FORMAT])
}

/// Refuses a GPU that cannot hold a training, before its photographs are known: they need no memory
/// there.
pub fn require_fit(config: &IfaceConfig, device: &ComputeDevice) -> Result<()> {
    #[cfg(not(feature = "wgpu"))]
    let _ = config;
    match device {
        ComputeDevice::Cpu(_) => Ok(()),
        #[cfg(feature = "wgpu")]
        ComputeDevice::Gpu(found) => {
            use crate::config::iface::{FieldKind, Foreground};
            let none =
                crate::field::pixels::RaySampler::new(&[], f32::INFINITY, 1.0, Foreground::Photo, false);
            match config.field {
                FieldKind::Sdf => gpu::GpuSdf::fits(config, &none, &found.device),
                FieldKind::Density => density::GpuDensity::fits(config, &none, &found.device),
            }
        }
    }
}
