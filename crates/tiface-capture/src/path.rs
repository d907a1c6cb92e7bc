//! Cameras of novel views: an orbit around the head, a file, or between others.

mod between;
mod file;

pub use between::between;
pub use file::from_json;

use glam::{BVec3, DMat3, DVec3, Vec3};
use tiface_base::geom::{Aabb, Camera, Distortion};
use tiface_base::{Error, Result};

/// Maximum number of cameras in one file.
const MAX_CAMERAS: usize = 100_000;

/// A camera with the name of its picture.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedCamera {
    /// File name without folder and extension.
    pub name: String,
    /// Pose and intrinsics.
    pub camera: Camera,
}

/// Returns the error for a file that is no camera path.
fn not_a_path(message: String) -> Error {
    Error::cannot(message, "export a camera path from nerfstudio's viewer, or give a transforms.json")
}

fn no_orbit(what: &str) -> Error {
    let hint = "give a capture with at least one camera and an `up` direction";
    Error::cannot(format!("no orbit: {what}"), hint)
}

/// Checks the number of cameras.
fn check_count(found: usize) -> Result<()> {
    match found {
        1..=MAX_CAMERAS => Ok(()),
        _ => Err(not_a_path(format!("{found} cameras, expected 1 to {MAX_CAMERAS}"))),
    }
}

/// Maximum part of a picture that the head fills in `orbit`, so that it does not touch the border.
const FILLED: f64 = 0.95;

/// Returns `count` cameras on a circle around the middle of `bounds`, evenly spaced, all looking at
/// it.
///
/// The circle lies across `up` at the mean height and mean distance of the capture's cameras, or so
/// much farther away, in the same direction, that every picture shows all of `bounds`. It begins
/// where the mean direction of the cameras is. Lens and picture size are those of the first camera,
/// without distortion and with the middle of the picture as principal point.
///
/// # Errors
/// Fails if `cameras` is empty, `up` has no direction, `count` is 0 or beyond 100,000, or the
/// cameras lie on the axis of the circle.
///
/// # Examples
///
/// ```
/// use glam::Vec3;
/// use tiface_capture::path::orbit;
/// use tiface_base::geom::{Aabb, Camera};
///
/// let front = Camera::above(400, 300, 500.0, 4.0);
/// let head = Aabb { min: Vec3::splat(-0.5), max: Vec3::splat(0.5) };
/// let path = orbit(&[front], head, Vec3::Y, 8)?;
/// assert_eq!((path.len(), path[0].name.as_str()), (8, "0001"));
/// // a quarter of the circle on, at the same height and distance
/// let (first, third) = (path[0].camera.position, path[2].camera.position);
/// assert!(first.dot(third).abs() < 1e-9 && (first.length() - third.length()).abs() < 1e-9);
/// # Ok::<(), tiface_base::Error>(())
/// ```
pub fn orbit(cameras: &[Camera], bounds: Aabb, up: Vec3, count: usize) -> Result<Vec<NamedCamera>> {
    let like = cameras.first().ok_or_else(|| no_orbit("there are no cameras"))?;
    let up = up.as_dvec3().try_normalize().ok_or_else(|| no_orbit("`up` has no direction"))?;
    check_count(count)?;
    let center = bounds.center().as_dvec3();
    let (mut height, mut radius, mut toward) = (0.0, 0.0, DVec3::ZERO);
    for camera in cameras {
        let arm = camera.position - center;
        let flat = arm - arm.dot(up) * up;
        height += arm.dot(up) / cameras.len() as f64;
        radius += flat.length() / cameras.len() as f64;
        toward += flat.normalize_or_zero();
    }
    if !(radius.is_finite() && height.is_finite() && radius > 0.0) {
        return Err(no_orbit("the cameras stand on the axis of the circle"));
    }
    // cameras all around have no mean direction, so any direction will do
    let start = if toward.length() > 1e-6 { toward.normalize() } else { up.any_orthonormal_vector() };
    let side = up.cross(start);
    let digits = count.to_string().len().max(4);
    let turned = |i: usize| {
        let angle = std::f64::consts::TAU * i as f64 / count as f64;
        let back = (height * up + radius * (angle.cos() * start + angle.sin() * side)).normalize();
        let right = up.cross(back).normalize();
        DMat3::from_cols(right, back.cross(right), back)
    };
    let rotations: Vec<DMat3> = (0..count).map(turned).collect();
    // a corner at (x, y, z) from the middle, as the camera sees it, is f·x / (distance − z) from
    // the picture's middle
    let reach = |focal: f64, side: u32| focal / (FILLED * side as f64 / 2.0);
    let (reach_x, reach_y) = (reach(like.fx, like.width), reach(like.fy, like.height));
    let mut distance = height.hypot(radius);
    for rotation in &rotations {
        for corner in (0..8).map(|k| BVec3::new(k & 1 > 0, k & 2 > 0, k & 4 > 0)) {
            let corner = Vec3::select(corner, bounds.max, bounds.min).as_dvec3() - center;
            let p = rotation.transpose() * corner;
            distance = distance.max(p.z + (p.x.abs() * reach_x).max(p.y.abs() * reach_y));
        }
    }
    let path = rotations.iter().enumerate().map(|(i, &rotation)| {
        let camera = Camera {
            cx: like.width as f64 / 2.0,
            cy: like.height as f64 / 2.0,
            distortion: Distortion::default(),
            rotation,
            position: center + distance * rotation.z_axis,
            ..like.clone()
        };
        NamedCamera { name: format!("{:0digits$}", i + 1), camera }
    });
    Ok(path.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn like() -> Camera {
        Camera {
            width: 400,
            height: 200,
            fx: 500.0,
            fy: 500.0,
            cx: 190.0,
            cy: 110.0,
            distortion: Distortion { k1: 0.1, ..Default::default() },
            rotation: DMat3::IDENTITY,
            position: DVec3::new(0.0, 3.0, 4.0),
        }
    }

    #[test]
    fn an_orbit_keeps_mean_height_and_distance_and_looks_at_the_middle() {
        let mut other = like();
        other.position = DVec3::new(0.0, 1.0, 6.0);
        // around (0, 1, 0): heights 2 and 0, distances 4 and 6: mean 1 and 5
        let center = Vec3::new(0.0, 1.0, 0.0);
        let point = Aabb { min: center, max: center };
        let path = orbit(&[like(), other], point, Vec3::Y, 4).unwrap();
        assert_eq!(path.len(), 4);
        assert!(path[0].camera.position.distance(DVec3::new(0.0, 2.0, 5.0)) < 1e-12);
        assert!(path[1].camera.position.distance(DVec3::new(5.0, 2.0, 0.0)) < 1e-12);
        for c in &path {
            let (pixel, depth) = c.camera.project(center).unwrap();
            assert!(pixel.distance(glam::Vec2::new(200.0, 100.0)) < 1e-3);
            assert!((depth - 26f32.sqrt()).abs() < 1e-5);
            // up is up in the picture, and the pose is a rotation
            assert!(c.camera.project(center + Vec3::Y).unwrap().0.y < 100.0);
            assert!((c.camera.rotation.determinant() - 1.0).abs() < 1e-12);
        }
        assert_eq!(path[3].name, "0004");
        assert!(orbit(&[], point, Vec3::Y, 4).is_err());
        assert!(orbit(&[like()], point, Vec3::ZERO, 4).is_err());
        assert!(orbit(&[like()], point, Vec3::Y, 0).is_err());
    }

    #[test]
    fn an_orbit_never_cuts_the_bottom_of_a_bust() {
        // 5 away, cameras for a face: the bust is 4 high, and wide across where it is seen from the
        // side
        let bounds = Aabb { min: Vec3::new(-1.5, -2.0, -1.0), max: Vec3::new(1.5, 2.0, 1.0) };
        for (width, height) in [(400, 200), (200, 400), (300, 300)] {
            let camera = Camera { width, height, ..like() };
            let path = orbit(&[camera], bounds, Vec3::Y, 7).unwrap();
            let mut nearest = f32::INFINITY;
            for c in &path {
                for k in 0..8 {
                    let corner =
                        Vec3::select(BVec3::new(k & 1 > 0, k & 2 > 0, k & 4 > 0), bounds.max, bounds.min);
                    let (at, _) = c.camera.project(corner).unwrap();
                    let (x, y) = (at.x / width as f32, at.y / height as f32);
                    nearest = nearest.min(x).min(y).min(1.0 - x).min(1.0 - y);
                }
            }
            // a fortieth of the picture stays free, and no more
            assert!((nearest - 0.025).abs() < 1e-3, "{width} × {height}: {nearest}");
        }
        // a box that is visible already does not change the distance
        let small = Aabb { min: Vec3::splat(-0.1), max: Vec3::splat(0.1) };
        let path = orbit(&[like()], small, Vec3::Y, 3).unwrap();
        assert!((path[0].camera.position.length() - 5.0).abs() < 1e-12);
    }
}
