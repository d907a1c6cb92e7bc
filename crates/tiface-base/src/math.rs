//! Arithmetic that knows no pictures, no geometry and no devices: slices of numbers in, numbers
//! out.
//!
//! Everything gives the same bits on any number of threads.

pub mod cg;
pub mod cholesky;
mod components;
mod dispatch;
pub mod distance;
pub mod rank;
pub mod rng;

pub use components::{Components, components};
