//! Hard cases, each with the largest error met and what it must stay below: what floating point, odd volumes, grazing
//! rays and hard captures do to every part of the pipeline.
//!
//! `tests/stability.rs` holds them to their bounds, `cargo bench --bench stability` prints them.

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

/// Runs all hard cases; those that learn fields write into the folder `scratch`.
///
/// # Errors
///
/// A scratch folder that cannot be written. What a case finds is no error: it does not hold.
pub fn stability(scratch: &Path) -> Result<Vec<StabilityCase>> {
    let mut done = [surfaces::cases(), rays::cases(), sharpness::cases(), kernels::cases()].concat();
    done.extend(captures::cases(scratch)?);
    Ok(done)
}
