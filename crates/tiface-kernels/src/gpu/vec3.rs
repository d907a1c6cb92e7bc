//! Vectors of three floats in kernels.
//!
//! In a kernel CubeCL translates the operators to the inherent methods below; the operators' traits
//! let the compiler check the types.

use burn::cubecl::{self, prelude::*};
use std::ops::{Add, Div, Mul, Sub};

/// A point, a direction or a color.
#[derive(CubeType, cubecl::CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Vec3 {
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

#[cube]
impl Vec3 {
    /// Returns a vector from its components.
    pub fn new(x: f32, y: f32, z: f32) -> Vec3 {
        Vec3 { x, y, z }
    }

    /// Returns the vector (0, 0, 0).
    pub fn zero() -> Vec3 {
        Vec3::new(0.0f32, 0.0f32, 0.0f32)
    }

    /// Returns the vector whose components are words `first`, `first + stride` and
    /// `first + 2 stride`: with a stride of one plane, those of an item of planes `[3, stride]`.
    pub fn read(words: &[f32], stride: usize, first: usize) -> Vec3 {
        Vec3::new(words[first], words[first + stride], words[first + 2 * stride])
    }

    /// Writes the components where [`read`](Vec3::read) finds them.
    pub fn write(self, words: &mut [f32], stride: usize, first: usize) {
        words[first] = self.x;
        words[first + stride] = self.y;
        words[first + 2 * stride] = self.z;
    }

    pub fn add(self, other: Vec3) -> Vec3 {
        Vec3::new(self.x + other.x, self.y + other.y, self.z + other.z)
    }

    pub fn sub(self, other: Vec3) -> Vec3 {
        Vec3::new(self.x - other.x, self.y - other.y, self.z - other.z)
    }

    pub fn mul(self, factor: f32) -> Vec3 {
        Vec3::new(self.x * factor, self.y * factor, self.z * factor)
    }

    pub fn div(self, divisor: f32) -> Vec3 {
        Vec3::new(self.x / divisor, self.y / divisor, self.z / divisor)
    }

    /// Adds `weight · v` to the vector, which is a mutable variable.
    pub fn add_weighted(&mut self, weight: f32, v: Vec3) {
        self.x += weight * v.x;
        self.y += weight * v.y;
        self.z += weight * v.z;
    }

    pub fn dot(self, other: Vec3) -> f32 {
        self.x * other.x + self.y * other.y + self.z * other.z
    }

    pub fn length(self) -> f32 {
        self.dot(self).sqrt()
    }
}

impl Add for Vec3 {
    type Output = Vec3;
    fn add(self, other: Vec3) -> Vec3 {
        Vec3::add(self, other)
    }
}

impl Sub for Vec3 {
    type Output = Vec3;
    fn sub(self, other: Vec3) -> Vec3 {
        Vec3::sub(self, other)
    }
}

impl Mul<f32> for Vec3 {
    type Output = Vec3;
    fn mul(self, factor: f32) -> Vec3 {
        Vec3::mul(self, factor)
    }
}

impl Div<f32> for Vec3 {
    type Output = Vec3;
    fn div(self, divisor: f32) -> Vec3 {
        Vec3::div(self, divisor)
    }
}
