//! What stands for LPIPS in a build without the feature `matting`: no network can be opened.

use crate::image::{Image, Photo};
use crate::{Error, Result};
use std::convert::Infallible;

/// A network for LPIPS, of which there are none in this build.
pub enum Lpips {}

impl Lpips {
    /// Refuses the network.
    ///
    /// # Errors
    ///
    /// Always.
    pub fn open(_: &std::path::Path, _: &str, _: f64) -> Result<Lpips> {
        Err(Error::cannot(
            "this build cannot run networks, but `metrics.lpips` names one",
            "build with `--features matting`, or leave the file out",
        ))
    }

    /// What was loaded.
    pub fn file(&self) -> Infallible {
        match *self {}
    }

    /// The distance of two pictures.
    ///
    /// # Errors
    ///
    /// Never: there is no network.
    pub fn distance(&self, _: &Image, _: &Photo) -> Result<f64> {
        match *self {}
    }
}
