//! The arithmetic of the learned fields of `tiface`: slices or buffers in, slices or buffers out.
//!
//! [`cpu`] has the kernels that define the results; with the feature `wgpu`, `gpu` has those on
//! Vulkan, Metal and DX12. Most kernels of a GPU have a twin of their name on the CPU. Which losses
//! a step has, and when, is decided in the package `tiface`; their formulas and the rules of step
//! length and ray budget are here.

// The reference arithmetic of tests names the crate as its other users do.
#[cfg(test)]
extern crate self as tiface_kernels;

pub mod cpu;
#[cfg(feature = "wgpu")]
pub mod gpu;
