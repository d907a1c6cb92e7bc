//! Code that all learned fields share: the trainer, its device operations, parameters, photographs
//! and checkpoints.
//!
//! A model ([`training::Model`]) defines what differs between fields. Its training step is written
//! once, over operations ([`ops::Ops`]) that each device implements with its own kernels.

#[cfg(any(test, feature = "wgpu"))]
pub(crate) mod ball;
pub mod checkpoint;
mod compute_device;
mod device_report;
#[cfg(feature = "wgpu")]
pub mod devices;
#[cfg(feature = "wgpu")]
pub mod drawing;
mod gpu_field;
#[cfg(all(test, feature = "wgpu"))]
pub(crate) mod gpu_tests;
#[cfg(feature = "wgpu")]
pub mod memory;
pub mod ops;
pub mod parameters;
pub mod pixels;
#[cfg(feature = "wgpu")]
pub(crate) mod self_test;
pub mod soft_pixels;
#[cfg(test)]
pub(crate) mod testing;
pub mod training;

pub use compute_device::{ComputeDevice, compute_device, examine_devices, require_device};
pub use device_report::{Check, DeviceReport, SelfTest};
pub use gpu_field::GpuField;
