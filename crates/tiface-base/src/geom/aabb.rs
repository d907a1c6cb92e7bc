//! Axis-aligned boxes.

use glam::Vec3;
use serde::{Deserialize, Serialize};

/// An axis-aligned box, `min <= max` on every axis unless it is [`Aabb::EMPTY`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Aabb {
    /// Lowest corner.
    pub min: Vec3,
    /// Highest corner.
    pub max: Vec3,
}

impl Aabb {
    /// The empty box; growing it by a point gives that point.
    pub const EMPTY: Aabb = Aabb { min: Vec3::INFINITY, max: Vec3::NEG_INFINITY };

    /// The cube [-1, 1]³ that every scene is fitted into.
    pub const SCENE: Aabb = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };

    /// Returns the smallest box around `points`; [`Aabb::EMPTY`] without points.
    pub fn around(points: impl IntoIterator<Item = Vec3>) -> Aabb {
        points.into_iter().fold(Aabb::EMPTY, Aabb::with)
    }

    /// This box, grown to hold `point`.
    #[inline]
    pub fn with(self, point: Vec3) -> Aabb {
        Aabb { min: self.min.min(point), max: self.max.max(point) }
    }

    /// Grown by `margin` on every side.
    #[inline]
    pub fn grown(self, margin: f32) -> Aabb {
        Aabb { min: self.min - margin, max: self.max + margin }
    }

    /// Edge lengths.
    #[inline]
    pub fn size(self) -> Vec3 {
        self.max - self.min
    }

    /// Returns the middle.
    #[inline]
    pub fn center(self) -> Vec3 {
        0.5 * (self.min + self.max)
    }

    /// Returns whether it holds no point.
    #[inline]
    pub fn is_empty(self) -> bool {
        self.min.cmpgt(self.max).any()
    }

    /// Returns whether `point` is inside or on the border.
    #[inline]
    pub fn contains(self, point: Vec3) -> bool {
        point.cmpge(self.min).all() && point.cmple(self.max).all()
    }

    /// Returns the parameters at which the line `origin + t · direction` enters and leaves, if it
    /// meets the box at any `t` (negative ones included). Zero direction components are handled.
    #[inline]
    pub fn intersect(self, origin: Vec3, direction: Vec3) -> Option<(f32, f32)> {
        let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
        for axis in 0..3 {
            let (o, d) = (origin[axis], direction[axis]);
            if d == 0.0 {
                if o < self.min[axis] || o > self.max[axis] {
                    return None;
                }
                continue;
            }
            let (a, b) = ((self.min[axis] - o) / d, (self.max[axis] - o) / d);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter <= leave).then_some((enter, leave))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ray_along_an_axis_crosses_the_unit_cube_from_one_to_three() {
        // origin z = 2, direction −z: enters at z = 1 (t = 1), leaves at z = −1 (t = 3)
        let hit = Aabb::SCENE.intersect(Vec3::new(0.5, 0.5, 2.0), -Vec3::Z).unwrap();
        assert_eq!(hit, (1.0, 3.0));
        assert!(Aabb::SCENE.intersect(Vec3::new(1.5, 0.5, 2.0), -Vec3::Z).is_none());
    }

    #[test]
    fn growing_the_empty_box_by_a_point_gives_that_point() {
        let b = Aabb::EMPTY.with(Vec3::ONE);
        assert_eq!((b.min, b.max), (Vec3::ONE, Vec3::ONE));
        assert!(Aabb::EMPTY.is_empty());
    }
}
