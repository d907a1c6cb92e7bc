//! Rays and what they meet.

use glam::Vec3;
use std::ops::{Add, Mul};

/// A half line with the part of it that matters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Origin: the camera center.
    pub origin: Vec3,
    /// Direction, away from the camera. It has unit length in the scene; a field may count `t` in
    /// another unit, and its rays' directions have the length of that.
    pub direction: Vec3,
    /// Nearest parameter of interest, ≥ 0.
    pub t_min: f32,
    /// Farthest parameter of interest.
    pub t_max: f32,
}

impl Ray {
    /// Returns the whole half line from `origin` along `direction`.
    #[inline]
    pub fn new(origin: impl Into<Vec3>, direction: impl Into<Vec3>) -> Ray {
        Ray { origin: origin.into(), direction: direction.into(), t_min: 0.0, t_max: f32::INFINITY }
    }

    /// Returns the ray in coordinates that are `scale` times those of this one.
    #[inline]
    pub fn scaled(self, scale: f32) -> Ray {
        let [t_min, t_max] = [self.t_min, self.t_max].map(|t| t * scale);
        Ray { origin: self.origin * scale, t_min, t_max, ..self }
    }

    /// Returns the point at parameter `t`.
    #[inline]
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + t * self.direction
    }
}

/// Result of a ray through a radiance field or a scene; color is premultiplied by opacity (over
/// black).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RayResult {
    /// sRGB-coded color, premultiplied.
    pub color: [f32; 3],
    /// Sum of weights, 0..=1.
    pub opacity: f32,
    /// Expected distance along the ray, scene units; 0 without a surface.
    pub depth: f32,
    /// Expected normal in the scene, unit length or zero; zero if it was not requested.
    pub normal: Vec3,
}

/// Intersection of a ray with a triangle mesh: `p = (1 − u − v)·a + u·b + v·c`.
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

impl Hit {
    /// Returns the weights of the triangle's vertices.
    #[inline]
    pub fn weights(&self) -> [f32; 3] {
        [1.0 - self.u - self.v, self.u, self.v]
    }

    /// Interpolates values at the triangle's vertices.
    #[inline]
    pub fn mix<T: Add<Output = T>>(&self, [a, b, c]: [T; 3]) -> T
    where
        f32: Mul<T, Output = T>,
    {
        let [wa, wb, wc] = self.weights();
        wa * a + wb * b + wc * c
    }
}
