//! Networks in a build without the feature `matting`: none can be opened, so no type has a value.

use crate::config::MaskConfig;
use std::convert::Infallible;
use std::path::Path;
use tiface_base::image::{Gray, Image, Photo};
use tiface_base::{Error, Result};

/// The networks that make masks.
#[derive(Clone, Copy, Debug)]
pub enum Networks {}

impl Networks {
    /// Returns `None` if the configuration names no network.
    ///
    /// # Errors
    ///
    /// Fails if it names one.
    pub fn open(config: &MaskConfig) -> Result<Option<Networks>> {
        if !config.with_networks() {
            return Ok(None);
        }
        Err(Error::usage(
            "this build cannot run networks, but one is named",
            "build with `--features matting`, or leave the files out: clicks work without them",
        ))
    }

    /// Returns the loaded files.
    pub fn files(&self) -> &[String] {
        match *self {}
    }

    /// Runs the networks once.
    pub fn prepare(&self, _width: u32, _height: u32) -> Result<()> {
        match *self {}
    }

    /// Returns how many photographs may be run side by side.
    pub fn photos_at_once(&self, _width: u32, _height: u32, _threads: usize) -> usize {
        match *self {}
    }

    /// Returns SAM's mask from clicks.
    pub fn segment<C>(&self, _photo: &Photo, _clicks: &[C]) -> Result<Option<(Gray, f32)>> {
        match *self {}
    }

    /// Returns the alpha network's alpha.
    pub fn propose(&self, _photo: &Photo, _size: (u32, u32)) -> Result<Option<Gray>> {
        match *self {}
    }

    /// Returns ViTMatte's alpha.
    pub fn alpha(&self, _photo: &Photo, _trimap: &Gray) -> Result<Option<Vec<f32>>> {
        match *self {}
    }
}

/// The network of LPIPS.
pub enum Lpips {}

impl Lpips {
    /// Returns `None` for an empty path.
    ///
    /// # Errors
    ///
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
    pub fn distance(&self, _: &Image, _: &Photo) -> Result<f64> {
        match *self {}
    }
}
