//! Stages `baseline` and `tface`: TensoRF's vector-matrix radiance field learned from photographs.
//!
//! Chen et al. 2022 (TensoRF) with the mask loss of T-Face (TI-Face, ICCV 2023 View Synthesis Challenge for
//! Human Heads): the opacity that background rays collect is pushed to zero. The baseline is the same code
//! on photographs as they are; only its box still comes from the masks.

mod cpu;
#[cfg(feature = "wgpu")]
mod gpu;
mod infer;
mod mean;
mod ops;
mod record;
mod refine;
#[cfg(feature = "wgpu")]
mod self_test;
mod state;
mod train;

pub use infer::{TFace, import};
pub use mean::{FieldMean, train};
pub use train::TfaceReport;

/// Whether a GPU learns a vector-matrix field as the processor does.
pub const VM_TEST: crate::field::SelfTest = crate::field::SelfTest {
    field: "vector-matrix",
    #[cfg(feature = "wgpu")]
    run: self_test::vm,
};
