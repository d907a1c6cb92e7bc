//! Stages `baseline` and `tface`: TensoRF's vector-matrix radiance field learned from photographs.
//!
//! Chen et al. 2022 (TensoRF) with the mask loss of T-Face (TI-Face, ICCV 2023 View Synthesis Challenge for
//! Human Heads): the opacity that background rays collect is pushed to zero. The baseline is the same code
//! on photographs as they are; only its box still comes from the masks.

mod cpu;
#[cfg(feature = "wgpu")]
mod gpu;
mod import;
mod infer;
mod mean;
mod ops;
mod record;
mod refine;
mod state;
mod train;

pub use import::import;
pub use infer::TFace;
pub use mean::{FieldMean, train};
pub use train::TfaceReport;
