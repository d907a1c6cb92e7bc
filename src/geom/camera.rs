//! Pinhole cameras with OpenCV distortion: pixel → ray and back.
//!
//! Camera axes are OpenGL's (+X right, +Y up, looking along −Z). A pixel's centre is at +0.5 and
//! (0, 0) is the top-left corner of the picture.

use super::ray::Ray;
use super::similarity::Similarity;
use glam::{DMat3, DVec3, Vec2, Vec3};
use serde::{Deserialize, Serialize};

/// OpenCV radial (k) and tangential (p) coefficients on normalized coordinates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Distortion {
    /// r² coefficient.
    pub k1: f64,
    /// r⁴ coefficient.
    pub k2: f64,
    /// r⁶ coefficient.
    pub k3: f64,
    /// First tangential coefficient.
    pub p1: f64,
    /// Second tangential coefficient.
    pub p2: f64,
}

impl Distortion {
    /// Returns whether it does nothing.
    pub fn is_none(&self) -> bool {
        *self == Distortion::default()
    }

    /// Ideal normalized coordinates (OpenCV: y down) to distorted ones.
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        (
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )
    }

    /// Distorted normalized coordinates back to ideal ones: Newton on [`Distortion::apply`] with its
    /// exact Jacobian. `None` where the model folds over (no ideal point maps there).
    pub fn undo(&self, xd: f64, yd: f64) -> Option<(f64, f64)> {
        if self.is_none() {
            return Some((xd, yd));
        }
        let (mut x, mut y) = (xd, yd);
        for _ in 0..50 {
            let (fx, fy) = self.apply(x, y);
            let (ex, ey) = (fx - xd, fy - yd);
            let r2 = x * x + y * y;
            let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
            let slope = 2.0 * (self.k1 + r2 * (2.0 * self.k2 + 3.0 * r2 * self.k3));
            let xx = radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x;
            let xy = x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y;
            let yy = radial + y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x;
            let det = xx * yy - xy * xy;
            if det.is_nan() || det <= 1e-6 {
                return None; // past the fold: the mapping is no longer one to one
            }
            let (dx, dy) = ((yy * ex - xy * ey) / det, (xx * ey - xy * ex) / det);
            (x, y) = (x - dx, y - dy);
            if dx.abs() + dy.abs() < 1e-12 {
                break;
            }
        }
        let (fx, fy) = self.apply(x, y);
        ((fx - xd).abs() + (fy - yd).abs() < 1e-8).then_some((x, y))
    }
}

/// One camera: intrinsics in pixels of its own picture, pose in the dataset's world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Picture width in pixels.
    pub width: u32,
    /// Picture height in pixels.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point from the left edge, pixels.
    pub cx: f64,
    /// Principal point from the top edge, pixels.
    pub cy: f64,
    /// Lens distortion; all zero for an ideal pinhole.
    pub distortion: Distortion,
    /// Columns right, up, backwards (the camera looks along minus the third), orthonormal.
    pub rotation: DMat3,
    /// Where the camera is, dataset units.
    pub position: DVec3,
}

impl Camera {
    /// The ray through a picture position (pixel centres at +0.5), in the camera's world;
    /// `t` is distance from the camera centre. `None` where the lens model folds over.
    pub fn ray(&self, pixel: Vec2) -> Option<Ray> {
        let xd = (pixel.x as f64 - self.cx) / self.fx;
        let yd = (pixel.y as f64 - self.cy) / self.fy;
        let (x, y) = self.distortion.undo(xd, yd)?;
        let direction = (self.rotation * DVec3::new(x, -y, -1.0)).normalize();
        Some(Ray {
            origin: self.position.as_vec3(),
            direction: direction.as_vec3(),
            t_min: 0.0,
            t_max: f32::INFINITY,
        })
    }

    /// Picture position and distance along the viewing axis of a world point; `None` behind the
    /// camera.
    ///
    /// ```
    /// use glam::{DMat3, DVec3, Vec2, Vec3};
    /// use tiface::geom::{Camera, Distortion};
    ///
    /// // two units before the origin, looking along -Z
    /// let (rotation, position) = (DMat3::IDENTITY, DVec3::new(0.0, 0.0, 2.0));
    /// let (fx, fy, cx, cy) = (100.0, 100.0, 40.0, 30.0);
    /// let distortion = Distortion::default();
    /// let camera = Camera { width: 80, height: 60, fx, fy, cx, cy, distortion, rotation, position };
    ///
    /// let (pixel, depth) = camera.project(Vec3::new(0.5, 0.25, 0.0)).unwrap();
    /// assert_eq!((pixel, depth), (Vec2::new(65.0, 17.5), 2.0)); // y points down in pictures
    /// assert_eq!(camera.project(Vec3::new(0.0, 0.0, 3.0)), None);
    /// // the ray through that pixel meets the point again
    /// let ray = camera.ray(pixel).unwrap();
    /// let t = 2.0 / -ray.direction.z;
    /// assert!((ray.origin + t * ray.direction).distance(Vec3::new(0.5, 0.25, 0.0)) < 1e-6);
    /// ```
    pub fn project(&self, point: Vec3) -> Option<(Vec2, f32)> {
        let p = self.rotation.transpose() * (point.as_dvec3() - self.position);
        if p.z >= -1e-9 {
            return None;
        }
        let (x, y) = self.distortion.apply(p.x / -p.z, -p.y / -p.z);
        let pixel = Vec2::new((self.fx * x + self.cx) as f32, (self.fy * y + self.cy) as f32);
        Some((pixel, -p.z as f32))
    }

    /// The direction the camera looks in.
    pub fn forward(&self) -> Vec3 {
        (-self.rotation.z_axis).as_vec3()
    }

    /// The same camera seen from another coordinate system.
    pub fn transformed(&self, b_from_a: &Similarity) -> Camera {
        Camera {
            rotation: b_from_a.rotation * self.rotation,
            position: b_from_a.point_f64(self.position),
            ..self.clone()
        }
    }

    /// The camera of a part of the picture, which begins in column `x` of row `y`.
    pub fn part(&self, x: u32, y: u32, width: u32, height: u32) -> Camera {
        let (cx, cy) = (self.cx - x as f64, self.cy - y as f64);
        Camera { width, height, cx, cy, ..self.clone() }
    }

    /// The camera of the same picture at another size.
    pub fn resized(&self, width: u32, height: u32) -> Camera {
        let (sx, sy) = (width as f64 / self.width as f64, height as f64 / self.height as f64);
        Camera {
            width,
            height,
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            ..self.clone()
        }
    }
}

#[cfg(test)]
impl Camera {
    /// For tests: at (0, 0, z), looking along −Z, up +Y, without distortion.
    pub(crate) fn above(width: u32, height: u32, focal: f64, z: f64) -> Camera {
        Camera {
            width,
            height,
            fx: focal,
            fy: focal,
            cx: width as f64 / 2.0,
            cy: height as f64 / 2.0,
            distortion: Distortion::default(),
            rotation: DMat3::IDENTITY,
            position: DVec3::new(0.0, 0.0, z),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera {
            width: 200,
            height: 100,
            fx: 150.0,
            fy: 160.0,
            cx: 101.0,
            cy: 48.0,
            distortion: Distortion { k1: -0.1, k2: 0.02, k3: 0.0, p1: 0.001, p2: -0.002 },
            rotation: DMat3::from_rotation_y(0.4),
            position: DVec3::new(1.0, 2.0, 3.0),
        }
    }

    #[test]
    fn a_ray_through_a_pixel_projects_back_onto_it() {
        let c = camera();
        for pixel in [Vec2::new(0.5, 0.5), Vec2::new(199.5, 99.5), Vec2::new(70.0, 12.0)] {
            let ray = c.ray(pixel).unwrap();
            let (back, _) = c.project(ray.at(2.0)).unwrap();
            assert!(back.distance(pixel) < 1e-3, "{pixel} {back}");
        }
    }

    #[test]
    fn the_principal_point_looks_along_minus_z() {
        let c = Camera { distortion: Distortion::default(), rotation: DMat3::IDENTITY, ..camera() };
        let ray = c.ray(Vec2::new(101.0, 48.0)).unwrap();
        assert_eq!(ray.direction, -Vec3::Z);
        // a point to the right and above lands right of and above the principal point
        let (p, depth) = c.project(Vec3::new(1.5, 2.5, 1.0)).unwrap();
        assert!(p.x > 101.0 && p.y < 48.0);
        assert_eq!(depth, 2.0);
        assert!(c.project(Vec3::new(1.0, 2.0, 4.0)).is_none());
    }
}
