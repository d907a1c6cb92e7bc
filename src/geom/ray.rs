//! Rays and what they meet.

use glam::Vec3;

/// A half line with the part of it that matters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where it starts: the camera centre.
    pub origin: Vec3,
    /// Unit direction, away from the camera.
    pub direction: Vec3,
    /// Nearest parameter of interest, ≥ 0.
    pub t_min: f32,
    /// Farthest parameter of interest.
    pub t_max: f32,
}

impl Ray {
    /// The point at parameter `t`.
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + t * self.direction
    }
}

/// What a ray through a radiance field or a scene came to; color is premultiplied by opacity (over black).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RayResult {
    /// sRGB-coded color, premultiplied.
    pub color: [f32; 3],
    /// Sum of weights, 0..=1.
    pub opacity: f32,
    /// Expected distance along the ray, scene units; 0 where nothing was met.
    pub depth: f32,
    /// Expected normal in the scene, unit length or zero; zero where nobody asks for one.
    pub normal: Vec3,
}

/// What a ray met on a triangle mesh: `p = (1 − u − v)·a + u·b + v·c`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Ray parameter.
    pub t: f32,
    /// Index into `Mesh::triangles`.
    pub triangle: u32,
    /// Weight of the triangle's second vertex.
    pub u: f32,
    /// Weight of the triangle's third vertex.
    pub v: f32,
}
