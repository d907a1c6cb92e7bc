//! Progress reports and stop requests of long computations.

use crate::error::COMPLETE_IS_KEPT;
use crate::{Error, Result};

/// Progress out, stop request in.
///
/// Called from the computing thread between steps, never in the middle of one, so that whatever it
/// stops is in a state that can be saved.
pub trait Monitor: Send + Sync {
    /// `step` of `steps` is done; `values` are named figures of this step (losses, rays, rate,
    /// ...).
    fn step(&self, step: u64, steps: u64, values: &[(&str, f64)]);

    /// Returns whether a stop was requested.
    fn stop(&self) -> bool;

    /// Returns an error once someone has asked to stop.
    fn check_stop(&self) -> Result<()> {
        if self.stop() { Err(Error::stopped(COMPLETE_IS_KEPT)) } else { Ok(()) }
    }
}

/// Reports nothing, never stops.
pub struct Quiet;

impl Monitor for Quiet {
    fn step(&self, _: u64, _: u64, _: &[(&str, f64)]) {}
    fn stop(&self) -> bool {
        false
    }
}
