//! The kernels on the CPU. They work on slices, with rayon and autovectorized SIMD, and do not
//! depend on tensors.
//!
//! Every kernel is bitwise reproducible for any number of threads: work is split into pieces of
//! fixed size, each piece owns the memory it writes, and sums over pieces are taken in a fixed
//! order.

pub mod adam;
mod bricks;
pub mod density;
pub mod hash;
pub mod losses;
pub mod march;
mod matrix;
pub mod mlp;
pub mod neus;
pub mod occupancy;
pub mod pool;
#[cfg(test)]
#[path = "../../../tests/support/reference/mod.rs"]
pub(crate) mod reference;
pub mod schedule;
pub mod sdf;
pub mod simd;
pub mod stereo;
pub mod vm;
pub mod weight_norm;
