//! The kernels on a GPU, in CubeCL: one source for Vulkan, Metal and DX12. Most are the
//! twin of a kernel of [`super::cpu`]; the twins of drawing and of points are in `tiface`.
//!
//! Values of samples lie plane by plane, `[channels, capacity]`: neighboring threads read
//! neighboring words, and a plane is read four samples at a time. `capacity` is a multiple of
//! [`mlp::TILE`](super::cpu::mlp::TILE). The actual number of samples is a count that an earlier
//! kernel wrote into a buffer, so the host need not read it back. Weights and tables have the same
//! layout as on the CPU.
//!
//! Many threads that add to one word use atomics, whose kind [`Atomics`] selects. All other sums
//! have a fixed order.

mod adam;
mod adapter;
mod batch;
mod color;
mod composite;
mod density;
mod device;
mod draw;
mod evaluate;
mod hash;
mod lens;
mod losses;
mod march;
mod neus;
mod occupancy;
mod points;
mod rng;
mod running_counts;
mod schedule;
mod sdf;
mod sum;
mod tile;
mod vec3;
mod vm;
mod weight_norm;

pub use adam::{Gate, adam};
pub use adapter::Adapter;
pub use batch::DeviceBatch;
pub use density::Density;
pub use device::{Atomics, Buffer, Device, DeviceLimits, Words};
pub use draw::{BUFFERS, DrawnView, Photographs, PixelOrder, SamplingOptions};
pub use evaluate::{Evaluator, planes};
pub use hash::Grid;
pub use losses::Losses;
pub use march::Samples;
pub use neus::Neus;
pub use occupancy::{BandUpdate, Nerfacc, Occupancy};
pub use points::SurfacePoints;
pub use schedule::Schedule;
pub use sdf::Sdf;
pub use vm::{DeviceDecoder, DeviceGrid, Vm, VmLosses, VmRenderer, VmValues};
pub use weight_norm::WeightNorm;

#[cfg(test)]
mod case_tests;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
