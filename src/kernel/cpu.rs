//! The arithmetic: slices in, slices out; rayon and autovectorised SIMD; knows no tensors.
//!
//! Every kernel gives the same bytes for any number of threads: work is cut into pieces of fixed
//! size, each piece owns what it writes, and sums over pieces are taken in a fixed order.

pub mod adam;
pub mod cg;
pub mod density;
pub mod distance;
pub mod hash;
pub mod losses;
pub mod march;
pub mod matrix;
pub mod mlp;
pub mod neus;
pub mod occupancy;
pub mod pool;
#[cfg(test)]
#[path = "../../tests/support/reference/mod.rs"]
pub(crate) mod reference;
pub mod rng;
pub mod schedule;
pub mod sdf;
pub mod simd;
pub mod stereo;
pub mod vm;
pub mod weight_norm;
