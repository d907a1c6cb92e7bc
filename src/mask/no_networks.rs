//! A stub of the networks for builds without the feature `matting`: none can be opened.

use super::clicks::Click;
use crate::config::MaskConfig;
use crate::image::{Gray, Photo};
use crate::{Error, Result};

/// The type of networks in a build without them, which has no value.
#[derive(Clone, Copy, Debug)]
pub enum NoNetworks {}

pub use self::NoNetworks as Networks;

impl NoNetworks {
    /// Returns `None` where the configuration uses no network.
    ///
    /// # Errors
    /// When it uses one.
    pub fn open(config: &MaskConfig) -> Result<Option<NoNetworks>> {
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

    /// SAM's mask.
    pub fn segment(&self, _photo: &Photo, _clicks: &[Click]) -> Result<Option<(Gray, f32)>> {
        match *self {}
    }

    /// Returns the alpha network's alpha.
    pub fn propose(&self, _photo: &Photo, _size: (u32, u32)) -> Result<Option<Gray>> {
        match *self {}
    }

    /// ViTMatte's alpha.
    pub fn alpha(&self, _photo: &Photo, _trimap: &Gray) -> Result<Option<Vec<f32>>> {
        match *self {}
    }
}
