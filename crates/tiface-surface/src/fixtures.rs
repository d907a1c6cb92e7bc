//! What unit tests of meshing share: a painted shape, a ball and its photographs, and a monitor
//! that asks to stop.

use super::{Volume, marching};
use glam::{DMat3, DVec3, Vec2, Vec3};
use tiface_base::Monitor;
use tiface_base::geom::{Camera, Mesh, SdfField};
use tiface_base::image::Gray;

/// Side of the pictures of [`cameras`].
pub const SIZE: u32 = 48;

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

/// Returns a ball of triangles around the origin.
pub fn ball(radius: f32) -> Mesh {
    const N: usize = 33;
    let at = |i: usize| i as f32 / (N - 1) as f32 * 2.0 - 1.0;
    let value = |i: usize| Vec3::new(at(i % N), at(i / N % N), at(i / (N * N))).length() - radius;
    let values: Vec<f32> = (0..N * N * N).map(value).collect();
    let spacing = Vec3::splat(2.0 / (N - 1) as f32);
    let volume = Volume { dims: [N; 3], values: &values, origin: Vec3::NEG_ONE, spacing };
    let surface = marching(&volume, true).unwrap().mesh;
    let normals = surface.positions.iter().map(|p| p.normalize()).collect();
    Mesh { normals, ..surface }
}

/// Returns cameras around it, three units away; a pixel is 0.03 units at the origin.
pub fn cameras() -> Vec<Camera> {
    let camera = |k: usize| {
        let rotation = DMat3::from_rotation_y(k as f64 * std::f64::consts::TAU / 12.0);
        Camera {
            position: rotation * DVec3::new(0.0, 0.0, 3.0),
            rotation,
            ..Camera::above(SIZE, SIZE, 100.0, 3.0)
        }
    };
    (0..12).map(camera).collect()
}

/// Returns the mask of a ball whose opacity falls from 1 to 0 as that of a field of this sharpness
/// does, seen by a camera: a ray that comes as near as `f` to the surface has σ(−f · sharpness).
pub fn ball_mask(camera: &Camera, radius: f32, sharpness: f32) -> Gray {
    let value = |i: u32| {
        let ray = camera.ray(Vec2::new((i % SIZE) as f32 + 0.5, (i / SIZE) as f32 + 0.5)).unwrap();
        let nearest = ray.origin.cross(ray.direction).length() - radius;
        (255.0 / (1.0 + (nearest * sharpness).exp()) + 0.5) as u8
    };
    Gray { width: SIZE, height: SIZE, values: (0..SIZE * SIZE).map(value).collect() }
}
