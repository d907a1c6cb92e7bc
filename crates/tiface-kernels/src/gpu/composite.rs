//! Compositing of samples along a ray, which both fields share.

use super::vec3::Vec3;
use burn::cubecl::{self, prelude::*};

/// Weighted sums over the samples of a ray: the first five values of a composited ray.
#[derive(CubeType, cubecl::CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Composited {
    pub rgb: Vec3,
    pub opacity: f32,
    pub depth: f32,
}

#[cube]
impl Composited {
    /// Returns the sums of a ray without samples.
    pub fn empty() -> Composited {
        Composited { rgb: Vec3::zero(), opacity: 0.0f32, depth: 0.0f32 }
    }

    /// Adds a sample of weight `w` at `t`, but not its color.
    pub fn add(&mut self, w: f32, t: f32) {
        self.opacity += w;
        self.depth += w * t;
    }

    /// Writes color, opacity and depth of ray `r` to planes `[5.., rays]`.
    pub fn write(self, out: &mut [f32], rays: usize, r: usize) {
        self.rgb.write(out, rays, r);
        out[3 * rays + r] = self.opacity;
        out[4 * rays + r] = self.depth;
    }
}
