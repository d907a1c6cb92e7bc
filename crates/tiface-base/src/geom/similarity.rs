//! Uniform scale, rotation and translation: how the scene sits in the world.

use glam::{DMat3, DVec3, Mat3, Vec3};
use serde::{Deserialize, Serialize};

/// `b = scale · rotation · a + translation`, kept in f64 so that mapping back loses nothing visible
/// even when the dataset lies far from its origin. `rotation` is a proper rotation: no mirror.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Similarity {
    /// Uniform scale, > 0.
    pub scale: f64,
    /// Orthonormal, determinant +1.
    pub rotation: DMat3,
    /// Image of the origin.
    pub translation: DVec3,
}

impl Similarity {
    /// The identity.
    pub const IDENTITY: Similarity =
        Similarity { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Returns the first invalid part, if any: its name, its value and the expected one.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        // beyond that the way back is lost in f64
        if !(1e-12..=1e12).contains(&self.scale) {
            return Some(("scale", self.scale.to_string(), "a number from 1e-12 to 1e12"));
        }
        let off = self.rotation * self.rotation.transpose() - DMat3::IDENTITY;
        let turns = off.to_cols_array().iter().all(|v| v.abs() < 1e-6) && self.rotation.determinant() > 0.0;
        if !turns {
            return Some(("rotation", format!("{:?}", self.rotation.to_cols_array()), "a rotation"));
        }
        if !self.translation.is_finite() {
            return Some(("translation", self.translation.to_string(), "finite numbers"));
        }
        None
    }

    /// Scale about the origin, then move: no rotation.
    pub fn scale_translate(scale: f64, translation: DVec3) -> Similarity {
        Similarity { scale, rotation: DMat3::IDENTITY, translation }
    }

    /// Transforms a point.
    #[inline]
    pub fn point(&self, p: Vec3) -> Vec3 {
        (self.scale * (self.rotation * p.as_dvec3()) + self.translation).as_vec3()
    }

    /// Transforms a point in f64.
    #[inline]
    pub fn point_f64(&self, p: DVec3) -> DVec3 {
        self.scale * (self.rotation * p) + self.translation
    }

    /// Rotates a direction; its length is kept, so unit vectors and normals stay unit.
    #[inline]
    pub fn direction(&self, d: Vec3) -> Vec3 {
        self.rotation.as_mat3() * d
    }

    /// Returns the rotation in f32.
    pub fn rotation_f32(&self) -> Mat3 {
        self.rotation.as_mat3()
    }

    /// First `first`, then this one.
    pub fn after(&self, first: &Similarity) -> Similarity {
        Similarity {
            scale: self.scale * first.scale,
            rotation: self.rotation * first.rotation,
            translation: self.point_f64(first.translation),
        }
    }

    /// Returns the way back.
    pub fn inverse(&self) -> Similarity {
        let rotation = self.rotation.transpose();
        let scale = 1.0 / self.scale;
        Similarity { scale, rotation, translation: -scale * (rotation * self.translation) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_and_back_is_where_we_started() {
        let s = Similarity {
            scale: 3.5,
            rotation: DMat3::from_rotation_y(0.7) * DMat3::from_rotation_x(-0.2),
            translation: DVec3::new(10.0, -4.0, 2.5),
        };
        let p = Vec3::new(0.3, -0.8, 0.1);
        assert!(s.inverse().point(s.point(p)).distance(p) < 1e-6);
        let d = Vec3::new(0.6, 0.0, 0.8);
        assert!((s.direction(d).length() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn one_after_the_other_is_both() {
        let turn = Similarity { rotation: DMat3::from_rotation_z(0.3), ..Similarity::IDENTITY };
        let far = Similarity::scale_translate(2.0, DVec3::new(5e6, -3e6, 2e5));
        let p = DVec3::new(0.3, -0.8, 0.1);
        assert!(turn.after(&far).point_f64(p).distance(turn.point_f64(far.point_f64(p))) < 1e-8);
        assert_eq!(Similarity::IDENTITY.after(&far), far);
    }
}
