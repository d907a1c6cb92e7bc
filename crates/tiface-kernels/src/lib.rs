//! The arithmetic of the learned fields of `tiface`: slices or buffers in, slices or buffers out.
//!
//! [`cpu`] has the kernels that define the results; with the feature `wgpu`, `gpu` has those on
//! Vulkan, Metal and DX12. A kernel of a GPU has the name of its twin on the CPU. Losses, schedules
//! and the choice of steps belong to the package `tiface`.

// The reference arithmetic of tests names the crate as its other users do.
#[cfg(test)]
extern crate self as tiface_kernels;

pub mod cpu;
#[cfg(feature = "wgpu")]
pub mod gpu;
