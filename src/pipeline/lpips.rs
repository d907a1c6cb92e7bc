//! The network that computes LPIPS, in builds with and without networks.

#[cfg(not(feature = "matting"))]
use crate::Error;
use crate::Result;
use crate::config::Config;
#[cfg(feature = "matting")]
pub(super) use crate::metrics::Lpips;

/// Loads the network for LPIPS, if one is named.
#[cfg(feature = "matting")]
pub(super) fn measure(config: &Config) -> Result<Option<Lpips>> {
    let file = &config.metrics.lpips;
    if file.is_empty() {
        return Ok(None);
    }
    Lpips::open(file.as_ref(), config.mask.memory_gib).map(Some)
}

/// A stub of LPIPS for a build without networks.
#[cfg(not(feature = "matting"))]
pub(super) enum Lpips {}

#[cfg(not(feature = "matting"))]
impl Lpips {
    pub fn file(&self) -> std::convert::Infallible {
        match *self {}
    }

    pub fn distance(&self, _: &crate::image::Image, _: &crate::image::Photo) -> Result<f64> {
        match *self {}
    }
}

#[cfg(not(feature = "matting"))]
pub(super) fn measure(config: &Config) -> Result<Option<Lpips>> {
    match config.metrics.lpips.is_empty() {
        true => Ok(None),
        false => Err(Error::cannot(
            "this build cannot run networks, but `metrics.lpips` names one",
            "build with `--features matting`, or leave the file out",
        )),
    }
}
