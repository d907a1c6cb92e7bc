//! What unit tests of meshing share: a painted shape, and a monitor that asks to stop.

use glam::Vec3;
use tiface_base::Monitor;
use tiface_base::geom::SdfField;

/// A shape with colors of its own.
pub struct Painted<S, C> {
    /// The signed distance.
    pub shape: S,
    /// As [`SdfField::colors`].
    pub paint: C,
}

impl<S, C> SdfField for Painted<S, C>
where
    S: SdfField,
    C: Fn(&[Vec3], &[Vec3], &[u32], &[Vec3]) -> Vec<[f32; 3]> + Sync,
{
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        self.shape.sdf(points)
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        self.shape.sdf_gradient(points)
    }

    fn colors(&self, points: &[Vec3], normals: &[Vec3], counts: &[u32], d: &[Vec3]) -> Vec<[f32; 3]> {
        (self.paint)(points, normals, counts, d)
    }
}

/// Reports nothing, asks to stop from the start.
pub struct Stopping;

impl Monitor for Stopping {
    fn step(&self, _: u64, _: u64, _: &[(&str, f64)]) {}
    fn stop(&self) -> bool {
        true
    }
}
