//! Stages `baseline` and `tface`: TensoRF's vector-matrix radiance field learned from photographs.
//!
//! Chen et al. 2022 (TensoRF) with the mask loss of T-Face (TI-Face, ICCV 2023 View Synthesis Challenge for
//! Human Heads): the opacity that background rays collect is pushed to zero. The baseline is the same code
//! on photographs as they are; only its box still comes from the masks.

#[cfg(feature = "cpu")]
mod cpu;
#[cfg(feature = "cpu")]
mod exchange;
#[cfg(feature = "wgpu")]
mod gpu;
#[cfg(feature = "cpu")]
mod infer;
#[cfg(feature = "cpu")]
mod mean;
#[cfg(feature = "cpu")]
mod ops;
#[cfg(feature = "cpu")]
mod record;
#[cfg(feature = "cpu")]
mod refine;
#[cfg(feature = "wgpu")]
mod self_test;
#[cfg(feature = "cpu")]
mod state;
pub mod th;
#[cfg(feature = "cpu")]
mod train;

#[cfg(feature = "cpu")]
pub use exchange::import_th;
#[cfg(feature = "cpu")]
pub use infer::TFace;
#[cfg(feature = "cpu")]
pub use mean::{FieldMean, train};
#[cfg(feature = "cpu")]
pub use train::TfaceReport;

/// Whether a GPU learns a vector-matrix field as the processor does.
#[cfg(feature = "cpu")]
pub const VM_TEST: crate::field::SelfTest = crate::field::SelfTest {
    field: "vector-matrix",
    #[cfg(feature = "wgpu")]
    run: self_test::vm,
};
