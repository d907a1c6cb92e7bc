//! Cameras half way between those of a capture.

use glam::{DQuat, DVec3};
use tiface_base::geom::{Camera, Distortion};

/// Number of its nearest that each camera has others half way to.
const NEIGHBORS: usize = 4;

/// Cosine of the largest angle between two cameras that have another between them: 70°. What lies
/// farther from both is a guess of any field.
const WIDEST: f64 = 0.342;

/// Returns at most `count` cameras, each half way between two of `cameras` that are neighbors as
/// seen from `center`: first those with the widest angle between.
///
/// Each stands in the mean direction of the two at their mean distance, and is turned half way from
/// one to the other. Lens and picture size are those of the first of them, without distortion.
///
/// # Examples
///
/// ```
/// use glam::{DMat3, DVec3};
/// use tiface_base::geom::Camera;
/// use tiface_capture::path::between;
///
/// let front = Camera::above(400, 300, 500.0, 4.0);
/// let rotation = DMat3::from_rotation_y(1.0);
/// let beside = Camera { rotation, position: rotation * front.position, ..front.clone() };
/// let found = between(&[front, beside], DVec3::ZERO, 10);
/// assert_eq!(found.len(), 1);
/// let half = DMat3::from_rotation_y(0.5) * DVec3::new(0.0, 0.0, 4.0);
/// assert!(found[0].position.distance(half) < 1e-9);
/// ```
pub fn between(cameras: &[Camera], center: DVec3, count: usize) -> Vec<Camera> {
    let toward: Vec<DVec3> = cameras.iter().map(|c| (c.position - center).normalize_or_zero()).collect();
    let mut pairs: Vec<(usize, usize)> = Vec::new();
    for (i, own) in toward.iter().enumerate() {
        let mut others: Vec<usize> = (0..cameras.len()).filter(|&j| toward[j] != *own).collect();
        others.sort_by(|a, b| toward[*b].dot(*own).total_cmp(&toward[*a].dot(*own)));
        pairs.extend(others.into_iter().take(NEIGHBORS).map(|j| (i.min(j), i.max(j))));
    }
    pairs.sort_unstable();
    pairs.dedup();
    let cosine = |&(i, j): &(usize, usize)| toward[i].dot(toward[j]);
    pairs.retain(|pair| cosine(pair) >= WIDEST);
    pairs.sort_by(|a, b| cosine(a).total_cmp(&cosine(b)));
    pairs.truncate(count);
    let camera = |(i, j): (usize, usize)| {
        let (one, other) = (&cameras[i], &cameras[j]);
        let distance = 0.5 * (one.position.distance(center) + other.position.distance(center));
        let [from, to] = [one, other].map(|c| DQuat::from_mat3(&c.rotation));
        Camera {
            distortion: Distortion::default(),
            rotation: glam::DMat3::from_quat(from.slerp(to, 0.5)),
            position: center + distance * (toward[i] + toward[j]).normalize(),
            ..one.clone()
        }
    };
    pairs.into_iter().map(camera).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;

    /// Returns a camera that looks at the origin from an angle around Y, in degrees.
    fn at(degrees: f64) -> Camera {
        let front = Camera::above(40, 30, 50.0, 4.0);
        let rotation = DMat3::from_rotation_y(degrees.to_radians());
        Camera { rotation, position: rotation * front.position, ..front }
    }

    fn angles(cameras: &[Camera]) -> Vec<f64> {
        let angle = |c: &Camera| c.position.x.atan2(c.position.z).to_degrees().round();
        cameras.iter().map(angle).collect()
    }

    #[test]
    fn cameras_stand_between_neighbors_the_widest_gap_first() {
        let cameras = [0.0, 10.0, 40.0].map(at);
        let found = between(&cameras, DVec3::ZERO, 10);
        assert_eq!(angles(&found), [20.0, 25.0, 5.0]);
        assert_eq!(angles(&between(&cameras, DVec3::ZERO, 1)), [20.0]);
        for camera in &found {
            // they look at the middle
            let (seen, _) = camera.project(glam::Vec3::ZERO).unwrap();
            assert!((seen - glam::Vec2::new(20.0, 15.0)).length() < 1e-3, "{seen}");
        }
    }

    #[test]
    fn a_camera_has_no_others_beyond_its_neighbors_across_the_head_or_where_it_stands() {
        // on a ring of twelve, two neighbors on each side
        let ring: Vec<Camera> = (0..12).map(|i| at(30.0 * f64::from(i))).collect();
        assert_eq!(between(&ring, DVec3::ZERO, 100).len(), 24);
        assert!(between(&[at(0.0), at(80.0)], DVec3::ZERO, 10).is_empty());
        assert!(between(&[at(0.0), at(0.0)], DVec3::ZERO, 10).is_empty());
        assert!(between(&[], DVec3::ZERO, 10).is_empty());
        // from where a camera stands there is no direction to it
        assert!(between(&[at(0.0), at(20.0)], at(0.0).position, 10).is_empty());
    }
}
