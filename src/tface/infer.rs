//! A trained field, asked from outside.

use super::TfaceError;
use crate::config::VmConfig;
use crate::geom::Ray;
use std::path::Path;

/// What a ray saw; colour is premultiplied by opacity (over black).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VmPixel {
    /// sRGB-coded colour, premultiplied, 0..=1.
    pub color: [f32; 3],
    /// Sum of weights, 0..=1.
    pub opacity: f32,
    /// Expected distance along the ray, scene units; 0 where nothing was met.
    pub depth: f32,
}

/// The trained field on the host. Positions and distances are in scene units.
pub struct TFace {}

impl TFace {
    /// From the checkpoint in a stage folder.
    pub fn load(_dir: &Path, _config: &VmConfig) -> Result<TFace, TfaceError> {
        unimplemented!()
    }

    /// Volume render of rays in scene coordinates.
    pub fn render(&self, _rays: &[Ray]) -> Vec<VmPixel> {
        unimplemented!()
    }
}
