//! What every part of `tiface` knows: errors, progress, fingerprints of results, pictures,
//! geometry, files and arithmetic.
//!
//! [`io`] is the only module of all crates that opens files, each within limits. Whatever fails
//! returns [`Error`]: a kind that a caller can act on, a message that names file and place, and a
//! suggested fix.

pub mod error;
mod fingerprint;
pub mod geom;
pub mod image;
pub mod io;
pub mod math;
pub mod monitor;

pub use error::{Error, ErrorKind, Result};
pub use fingerprint::Fingerprint;
pub use monitor::{Monitor, Quiet};
