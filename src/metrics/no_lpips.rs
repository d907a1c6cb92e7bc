//! A stub of LPIPS for builds without the feature `matting`: no network can be opened.

use crate::image::{Image, Photo};
use crate::{Error, Result};
use std::convert::Infallible;

/// A network for LPIPS, which cannot exist in this build.
pub enum Lpips {}

impl Lpips {
    /// Refuses the network.
    ///
    /// # Errors
    ///
    /// Always fails.
    pub fn open(_: &std::path::Path, _: &str, _: f64) -> Result<Lpips> {
        Err(Error::cannot(
            "this build cannot run networks, but `metrics.lpips` names one",
            "build with `--features matting`, or leave the file out",
        ))
    }

    /// Returns the record of the loaded network.
    pub fn file(&self) -> Infallible {
        match *self {}
    }

    /// Returns the distance of two pictures.
    ///
    /// # Errors
    ///
    /// Never fails, because no network exists.
    pub fn distance(&self, _: &Image, _: &Photo) -> Result<f64> {
        match *self {}
    }
}
