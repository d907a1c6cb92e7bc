//! Hard cases, each with the largest error met and what it must stay below: what floating point,
//! odd volumes, grazing rays and hard captures do to every part of the pipeline.
//!
//! `tests/check/stability.rs` holds them to their bounds, `cargo bench --bench stability` prints
//! them.

mod captures;
pub mod case;
mod kernels;
mod rays;
#[path = "../reference/mod.rs"]
mod reference;
mod sharpness;
mod surfaces;

use case::StabilityCase;
use std::path::Path;
use tiface::Result;

/// Which hard captures are learned from.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Breadth {
    /// One of each kind: a far world, a narrow lens, few views, and what is refused.
    #[allow(dead_code, reason = "the bench runs all")]
    Few,
    /// All of them.
    All,
}

/// Runs the hard cases; those that learn fields write into the folder `scratch`.
///
/// # Errors
///
/// A scratch folder that cannot be written. What a case finds is no error: it does not hold.
pub fn stability(scratch: &Path, breadth: Breadth) -> Result<Vec<StabilityCase>> {
    let mut done = [surfaces::cases(), rays::cases(), sharpness::cases(), kernels::cases()].concat();
    done.extend(captures::cases(scratch, breadth)?);
    Ok(done)
}
