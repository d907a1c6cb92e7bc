//! The size and gutter of an atlas, and its layout before it is checked.

use crate::Result;
use crate::geom::Atlas;
use crate::mesh::input::setting;
use glam::Vec3;

/// Steps that the monitor hears of.
pub(super) const STEPS: u64 = 4;

/// How a mesh is laid into its texture.
#[derive(Clone, Debug, PartialEq)]
pub struct AtlasConfig {
    /// Texels across and down; 16..=16384.
    pub size_px: u32,
    /// Charts are at least twice this far from each other and from the border; 0..=256 and at most an eighth of
    /// the texture.
    pub gutter_px: u32,
    /// Where the face looks, in the mesh's coordinates: what lies there becomes one chart, with seams around it
    /// and none across. That costs stretch: the nose is laid flat with the cheeks.
    pub front: Option<Vec3>,
    /// Where up is there: what lies in front stands upright in the texture. With `front` alone.
    pub up: Option<Vec3>,
}

impl Default for AtlasConfig {
    fn default() -> AtlasConfig {
        AtlasConfig { size_px: 2048, gutter_px: 8, front: None, up: None }
    }
}

impl AtlasConfig {
    pub(super) fn check(&self) -> Result<()> {
        setting((16..=16384).contains(&self.size_px), "AtlasConfig::size_px", "16..=16384", self.size_px)?;
        let narrow = self.gutter_px <= 256.min(self.size_px / 8);
        setting(
            narrow,
            "AtlasConfig::gutter_px",
            "0..=256 and at most an eighth of the texture's side",
            self.gutter_px,
        )?;
        let front = self.front.unwrap_or(Vec3::Z);
        setting(front.is_finite() && front != Vec3::ZERO, "AtlasConfig::front", "a direction", front)?;
        let up = self.up.unwrap_or(Vec3::Z);
        setting(up.is_finite() && up != Vec3::ZERO, "AtlasConfig::up", "a direction", up)
    }
}

/// An atlas in which every triangle has a place, none is flipped, flat or covers another.
pub(super) struct AtlasLayout {
    pub atlas: Atlas,
    /// Triangles that got a chart of their own.
    pub repaired: usize,
    /// Half the distance that charts keep.
    pub gutter_px: f64,
}
