//! A colored signed distance: the interface of a learned field to the extraction and finishing of
//! meshes.

use glam::Vec3;
use rayon::prelude::*;

/// A colored signed distance. A field is called from one thread, with thousands of points at a time
/// where possible.
///
/// A closure that returns the signed distance of a point is a gray field, with central differences
/// as its gradient:
///
/// ```
/// use glam::Vec3;
/// use tiface_base::geom::SdfField;
///
/// let ball = |p: Vec3| p.length() - 0.5;
/// assert_eq!(ball.sdf(&[Vec3::X, Vec3::ZERO]), [0.5, -0.5]);
/// assert!(ball.sdf_gradient(&[Vec3::X]).1[0].distance(Vec3::X) < 1e-3);
/// ```
pub trait SdfField: Sync {
    /// Returns the signed distances of points, negative inside. `[n]` → `[n]`.
    fn sdf(&self, points: &[Vec3]) -> Vec<f32>;

    /// Returns the signed distances and their gradients, which need not be of unit length. `[n]` →
    /// `[n]`, `[n]`.
    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>);

    /// Returns the sRGB-coded colors of surface points `[n]` with unit normals `[n]`. Point `i` is
    /// seen along `counts[i]` unit directions, away from the camera, all in one list; one color is
    /// returned per direction.
    fn colors(&self, points: &[Vec3], normals: &[Vec3], counts: &[u32], directions: &[Vec3])
    -> Vec<[f32; 3]>;

    /// Returns the same with one direction per point.
    fn color(&self, points: &[Vec3], normals: &[Vec3], directions: &[Vec3]) -> Vec<[f32; 3]> {
        self.colors(points, normals, &vec![1; points.len()], directions)
    }

    /// Returns the local sharpness, per unit of length: the opacity at a distance `f` outside the
    /// surface is σ(−f · sharpness). `[n]` → `[n]`. Infinite where it is not known.
    fn sharpness(&self, points: &[Vec3]) -> Vec<f32> {
        vec![f32::INFINITY; points.len()]
    }

    /// Returns whether a point is known to be outside, so that the field need not be evaluated.
    fn excludes(&self, _point: Vec3) -> bool {
        false
    }
}

/// Step of the central differences of a closure.
const STEP: f32 = 1e-3;

impl<F: Fn(Vec3) -> f32 + Sync> SdfField for F {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        points.par_iter().with_min_len(256).map(|&p| self(p)).collect()
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        let slope = |p: Vec3| {
            Vec3::from(Vec3::AXES.map(|e| (self(p + STEP * e) - self(p - STEP * e)) / (2.0 * STEP)))
        };
        points.par_iter().with_min_len(64).map(|&p| (self(p), slope(p))).unzip()
    }

    fn colors(&self, _: &[Vec3], _: &[Vec3], _: &[u32], directions: &[Vec3]) -> Vec<[f32; 3]> {
        vec![[0.5; 3]; directions.len()]
    }
}
