//! The arithmetic of the learned fields: slices or buffers in, slices or buffers out.
//!
//! A kernel of a GPU has the name of its twin on the CPU.

pub mod cpu;
#[cfg(feature = "wgpu")]
pub mod gpu;
