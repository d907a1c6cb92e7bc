//! A stub of LPIPS for builds without the feature `matting`: it cannot be opened.

use crate::image::{Image, Photo};
use crate::{Error, Result};
use std::convert::Infallible;
use std::path::Path;

/// The type of LPIPS in a build without networks, which has no value.
pub enum Lpips {}

impl Lpips {
    /// Returns `None` for an empty path.
    ///
    /// # Errors
    /// Fails if a network is named.
    pub fn open(path: &Path, _memory_gib: f64) -> Result<Option<Lpips>> {
        match path.as_os_str().is_empty() {
            true => Ok(None),
            false => Err(Error::cannot(
                "this build cannot run networks, but `metrics.lpips` names one",
                "build with `--features matting`, or leave the file out",
            )),
        }
    }

    /// Returns the record of the network.
    pub fn file(&self) -> Infallible {
        match *self {}
    }

    /// Returns the distance of a render from a photograph.
    ///
    /// # Errors
    /// None: the type has no value.
    pub fn distance(&self, _: &Image, _: &Photo) -> Result<f64> {
        match *self {}
    }
}
