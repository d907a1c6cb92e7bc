//! Cameras with a lens: pixel → ray and back.
//!
//! Camera axes are OpenGL's (+X right, +Y up, looking along −Z). A pixel's center is at +0.5 and
//! (0, 0) is the top-left corner of the picture.

use super::ray::Ray;
use super::similarity::Similarity;
use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};
use serde::{Deserialize, Serialize};

/// Projection of a lens: the radius of the angle θ from its axis, before the distortion
/// coefficients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Projection {
    /// `r = tan θ`.
    #[default]
    Perspective,
    /// Equidistant, `r = θ` (OpenCV's fisheye).
    Fisheye,
    /// `r = atan(2 tan θ tan(ω/2)) / ω` (Devernay and Faugeras, "Straight lines have to be
    /// straight").
    Fov,
}

/// One model of a lens for all formats: OpenCV's coefficients on normalized coordinates.
///
/// With the projected point (u, v), r² = u² + v²:
///
/// - perspective: radial `(1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)` (OpenCV's
///   rational model);
/// - fisheye: radial `1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸`, where r is the angle θ;
/// - both: tangential p1, p2 as in OpenCV and a thin prism (sx1, sy1) · r² (Weng, Cohen and
///   Herniou).
///
/// At most half of a sphere is visible: no rays beyond 90° from the axis.
#[derive(Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
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
    /// r² coefficient of the denominator; of a fisheye, the r⁸ coefficient.
    #[serde(default, skip_serializing_if = "is_default")]
    pub k4: f64,
    /// r⁴ coefficient of the denominator; perspective only.
    #[serde(default, skip_serializing_if = "is_default")]
    pub k5: f64,
    /// r⁶ coefficient of the denominator; perspective only.
    #[serde(default, skip_serializing_if = "is_default")]
    pub k6: f64,
    /// Thin prism along x.
    #[serde(default, skip_serializing_if = "is_default")]
    pub sx1: f64,
    /// Thin prism along y.
    #[serde(default, skip_serializing_if = "is_default")]
    pub sy1: f64,
    /// ω of [`Projection::Fov`], radians, in 0..π.
    #[serde(default, skip_serializing_if = "is_default")]
    pub omega: f64,
    /// The projection that the coefficients distort.
    #[serde(default, skip_serializing_if = "is_default")]
    pub projection: Projection,
}

/// Serialized form; digests of cameras depend on it.
impl std::fmt::Debug for Distortion {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let mut out = f.debug_struct("Distortion");
        let plain = [("k1", self.k1), ("k2", self.k2), ("k3", self.k3), ("p1", self.p1), ("p2", self.p2)];
        for (name, value) in &plain {
            out.field(name, value);
        }
        let more = [("k4", self.k4), ("k5", self.k5), ("k6", self.k6), ("sx1", self.sx1), ("sy1", self.sy1)];
        let more = more.into_iter().chain([("omega", self.omega)]).filter(|(_, value)| *value != 0.0);
        for (name, value) in more {
            out.field(name, &value);
        }
        if self.projection != Projection::default() {
            out.field("projection", &self.projection);
        }
        out.finish()
    }
}

/// Returns whether a value is the default, which is not written, so that files of most lenses stay
/// short.
fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Angles from here on count as 90°: the tangent would be too large to be of use.
const MAX_ANGLE: f64 = std::f64::consts::FRAC_PI_2 - 1e-3;

impl Distortion {
    /// Returns whether all coefficients are zero.
    #[inline]
    pub fn is_none(&self) -> bool {
        *self == Distortion::default()
    }

    /// Ideal normalized coordinates (OpenCV: y down) to distorted ones.
    #[inline]
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        match self.projection {
            Projection::Perspective => self.bend(x, y),
            other => {
                let scale = self.radius_over_tangent(other, x.hypot(y));
                self.bend(scale * x, scale * y)
            }
        }
    }

    /// r / tan θ of a projection.
    #[inline]
    fn radius_over_tangent(&self, projection: Projection, tangent: f64) -> f64 {
        let small = tangent < 1e-9;
        match projection {
            Projection::Perspective => 1.0,
            Projection::Fisheye if small => 1.0,
            Projection::Fisheye => tangent.atan() / tangent,
            Projection::Fov if self.omega.abs() < 1e-6 => 1.0,
            Projection::Fov => {
                let spread = 2.0 * (0.5 * self.omega).tan();
                if small { spread / self.omega } else { (spread * tangent).atan() / (self.omega * tangent) }
            }
        }
    }

    /// tan θ / r, the way back; `None` at 90° and beyond.
    fn tangent_over_radius(&self, radius: f64) -> Option<f64> {
        let small = radius < 1e-9;
        match self.projection {
            Projection::Perspective => Some(1.0),
            Projection::Fisheye if small => Some(1.0),
            Projection::Fisheye => (radius < MAX_ANGLE).then(|| radius.tan() / radius),
            Projection::Fov if self.omega.abs() < 1e-6 => Some(1.0),
            Projection::Fov => {
                let spread = 2.0 * (0.5 * self.omega).tan();
                let angle = (radius * self.omega).abs();
                if small {
                    return Some(self.omega / spread);
                }
                (angle < MAX_ANGLE).then(|| angle.tan() / (spread.abs() * radius))
            }
        }
    }

    /// Returns the radial factor at r², and its derivative by r².
    #[inline]
    fn radial(&self, r2: f64) -> (f64, f64) {
        if self.projection == Projection::Fisheye {
            let factor = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)));
            let slope = self.k1 + r2 * (2.0 * self.k2 + r2 * (3.0 * self.k3 + 4.0 * r2 * self.k4));
            return (factor, slope);
        }
        let over = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        let over_slope = self.k1 + r2 * (2.0 * self.k2 + 3.0 * r2 * self.k3);
        let under = 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6));
        let under_slope = self.k4 + r2 * (2.0 * self.k5 + 3.0 * r2 * self.k6);
        let factor = over / under;
        (factor, (over_slope - factor * under_slope) / under)
    }

    /// Returns the distorted position of a projected point.
    #[inline]
    fn bend(&self, x: f64, y: f64) -> (f64, f64) {
        let r2 = x * x + y * y;
        let (radial, _) = self.radial(r2);
        (
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x) + self.sx1 * r2,
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y + self.sy1 * r2,
        )
    }

    /// Derivatives of [`Self::bend`]: rows are its two outputs, columns x and y.
    fn bend_slopes(&self, x: f64, y: f64) -> [[f64; 2]; 2] {
        let r2 = x * x + y * y;
        let (radial, slope) = self.radial(r2);
        let slope = 2.0 * slope;
        let xx = radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x + 2.0 * self.sx1 * x;
        let xy = x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y;
        let yy = radial + y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x + 2.0 * self.sy1 * y;
        // the thin prism alone makes the Jacobian unsymmetric
        [[xx, xy + 2.0 * self.sx1 * y], [xy + 2.0 * self.sy1 * x, yy]]
    }

    /// Returns the derivatives of [`Self::apply`]: rows are its two outputs, columns x and y.
    pub fn slopes(&self, x: f64, y: f64) -> [[f64; 2]; 2] {
        let tangent = x.hypot(y);
        let along = match self.projection {
            _ if tangent < 1e-9 => None,
            Projection::Perspective => None,
            Projection::Fisheye => Some(1.0 / (1.0 + tangent * tangent)),
            Projection::Fov if self.omega.abs() < 1e-6 => None,
            Projection::Fov => {
                let spread = 2.0 * (0.5 * self.omega).tan();
                Some(spread / (self.omega * (1.0 + (spread * tangent).powi(2))))
            }
        };
        // the radius as a function of the tangent has the slope `along`; across it, the scale is
        // radius / tangent
        let scale = self.radius_over_tangent(self.projection, tangent);
        let bent = self.bend_slopes(scale * x, scale * y);
        let Some(along) = along else { return bent.map(|row| row.map(|v| v * scale)) };
        let (u, v) = (x / tangent, y / tangent);
        let more = along - scale;
        bent.map(|[bx, by]| {
            let toward = more * (bx * u + by * v);
            [scale * bx + toward * u, scale * by + toward * v]
        })
    }

    /// Distorted normalized coordinates back to ideal ones: Newton on the coefficients with their
    /// exact Jacobian, whose result is checked, then the projection's inverse. `None` where the
    /// model folds over (no ideal point has this image) and from 90° on.
    pub fn undistort(&self, xd: f64, yd: f64) -> Option<(f64, f64)> {
        if self.is_none() {
            return Some((xd, yd));
        }
        let (mut x, mut y) = (xd, yd);
        for _ in 0..50 {
            let (fx, fy) = self.bend(x, y);
            let (ex, ey) = (fx - xd, fy - yd);
            let [[xx, right], [down, yy]] = self.bend_slopes(x, y);
            let det = xx * yy - right * down;
            if det.is_nan() || det <= 1e-6 {
                return None; // past the fold: the mapping is no longer one to one
            }
            let (dx, dy) = ((yy * ex - right * ey) / det, (xx * ey - down * ex) / det);
            (x, y) = (x - dx, y - dy);
            if dx.abs() + dy.abs() < 1e-12 {
                break;
            }
        }
        let (fx, fy) = self.bend(x, y);
        if (fx - xd).abs() + (fy - yd).abs() >= MAX_RESIDUAL {
            return None;
        }
        let scale = self.tangent_over_radius(x.hypot(y))?;
        Some((scale * x, scale * y))
    }
}

/// Tolerance of [`Distortion::undistort`]; at a focal length of 10 000 pixels, 1e-6 of a pixel.
const MAX_RESIDUAL: f64 = 1e-10;

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
    /// Position, in dataset units.
    pub position: DVec3,
}

impl Camera {
    /// Returns the ray through a picture position (pixel centers at +0.5), in the camera's world;
    /// `t` is distance from the camera center. `None` where the lens model folds over.
    pub fn ray(&self, pixel: Vec2) -> Option<Ray> {
        let xd = (pixel.x as f64 - self.cx) / self.fx;
        let yd = (pixel.y as f64 - self.cy) / self.fy;
        let (x, y) = self.distortion.undistort(xd, yd)?;
        let direction = (self.rotation * DVec3::new(x, -y, -1.0)).normalize();
        Some(Ray::new(self.position.as_vec3(), direction.as_vec3()))
    }

    /// Picture position and distance along the viewing axis of a world point; `None` behind the
    /// camera.
    ///
    /// ```
    /// use glam::{Vec2, Vec3};
    /// use tiface_base::geom::Camera;
    ///
    /// // two units before the origin, looking along -Z
    /// let camera = Camera::above(80, 60, 100.0, 2.0);
    ///
    /// let (pixel, depth) = camera.project(Vec3::new(0.5, 0.25, 0.0)).unwrap();
    /// assert_eq!((pixel, depth), (Vec2::new(65.0, 17.5), 2.0)); // y points down in pictures
    /// assert_eq!(camera.project(Vec3::new(0.0, 0.0, 3.0)), None);
    /// // the ray through that pixel meets the point again
    /// let ray = camera.ray(pixel).unwrap();
    /// let t = 2.0 / -ray.direction.z;
    /// assert!((ray.origin + t * ray.direction).distance(Vec3::new(0.5, 0.25, 0.0)) < 1e-6);
    /// ```
    #[inline]
    pub fn project(&self, point: Vec3) -> Option<(Vec2, f32)> {
        let (pixel, depth) = self.project_f64(point.as_dvec3())?;
        Some((pixel.as_vec2(), depth as f32))
    }

    /// Returns where in the picture a point is seen; `None` behind the camera and beside the
    /// picture.
    #[inline]
    pub fn project_inside(&self, point: Vec3) -> Option<Vec2> {
        let (at, _) = self.project(point)?;
        let (width, height) = (self.width as f32, self.height as f32);
        ((0.0..width).contains(&at.x) && (0.0..height).contains(&at.y)).then_some(at)
    }

    /// Returns what [`Self::project`] returns, in f64.
    #[inline]
    pub fn project_f64(&self, point: DVec3) -> Option<(DVec2, f64)> {
        let (ideal, depth) = Camera::ideal(self.local(point))?;
        Some((self.pixel(ideal), depth))
    }

    /// Returns a point of the world in the axes of the camera: right, up, backwards.
    #[inline]
    pub fn local(&self, point: DVec3) -> DVec3 {
        self.rotation.transpose() * (point - self.position)
    }

    /// Returns the ideal normalized coordinates (y down) of a point in the axes of a camera, and
    /// its distance along the viewing axis; `None` behind the camera.
    #[inline]
    pub fn ideal(local: DVec3) -> Option<(DVec2, f64)> {
        let depth = -local.z;
        if depth <= 1e-9 {
            return None;
        }
        Some((DVec2::new(local.x / depth, -local.y / depth), depth))
    }

    /// Returns the picture position of ideal normalized coordinates.
    #[inline]
    pub fn pixel(&self, ideal: DVec2) -> DVec2 {
        self.pixel_behind_lens(self.distortion.apply(ideal.x, ideal.y))
    }

    /// Returns the picture position of normalized coordinates that the lens has distorted.
    #[inline]
    pub fn pixel_behind_lens(&self, (x, y): (f64, f64)) -> DVec2 {
        DVec2::new(self.fx * x + self.cx, self.fy * y + self.cy)
    }

    /// Returns the direction the camera looks in.
    #[inline]
    pub fn forward(&self) -> Vec3 {
        (-self.rotation.z_axis).as_vec3()
    }

    /// Returns the same camera seen from another coordinate system.
    pub fn transformed(&self, b_from_a: &Similarity) -> Camera {
        Camera {
            rotation: b_from_a.rotation * self.rotation,
            position: b_from_a.point_f64(self.position),
            ..self.clone()
        }
    }

    /// Returns the camera of a part of the picture, which begins in column `x` of row `y`.
    pub fn part(&self, x: u32, y: u32, width: u32, height: u32) -> Camera {
        let (cx, cy) = (self.cx - x as f64, self.cy - y as f64);
        Camera { width, height, cx, cy, ..self.clone() }
    }

    /// Returns the camera of the same picture at another size.
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

    /// Returns a camera at (0, 0, z) that looks along −Z, with +Y up, without distortion and with
    /// the middle of the picture as principal point.
    pub fn above(width: u32, height: u32, focal: f64, z: f64) -> Camera {
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
            distortion: Distortion { k1: -0.1, k2: 0.02, p1: 0.001, p2: -0.002, ..Distortion::default() },
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
    fn a_point_is_inside_up_to_the_borders_of_the_picture_and_not_behind_the_camera() {
        let c = camera();
        let (near, far) = (Vec2::new(0.5, 0.5), Vec2::new(199.5, 99.5));
        for (pixel, inside) in [
            (near, true),
            (far, true),
            (Vec2::new(-0.5, 0.5), false),
            (Vec2::new(0.5, -0.5), false),
            (Vec2::new(200.5, 99.5), false),
            (Vec2::new(199.5, 100.5), false),
        ] {
            let seen = c.project_inside(c.ray(pixel).unwrap().at(2.0));
            assert!(seen.map(|at| at.distance(pixel) < 1e-3) == inside.then_some(true), "{pixel} {seen:?}");
        }
        assert_eq!(c.project_inside(c.ray(near).unwrap().at(-2.0)), None);
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

    /// Returns a lens of each kind, bent about as far as real ones are.
    fn lenses() -> Vec<Distortion> {
        let none = Distortion::default();
        let fisheye = Distortion { projection: Projection::Fisheye, ..none };
        vec![
            Distortion { k1: -0.2, ..none },
            Distortion { k1: -0.25, k2: 0.08, p1: 0.004, p2: -0.003, ..none },
            Distortion {
                k1: 0.3,
                k2: -0.1,
                k3: 0.02,
                k4: 0.25,
                k5: 0.05,
                k6: 0.01,
                p1: 1e-3,
                p2: -2e-3,
                ..none
            },
            Distortion { sx1: 3e-3, sy1: -2e-3, k1: 0.05, ..none },
            fisheye,
            Distortion { k1: -0.03, k2: 0.01, k3: -4e-3, k4: 6e-4, ..fisheye },
            Distortion {
                k1: 0.02,
                k2: -5e-3,
                k3: 1e-3,
                k4: -2e-4,
                p1: 1e-3,
                p2: 2e-3,
                sx1: 4e-3,
                sy1: -1e-3,
                ..fisheye
            },
            Distortion { projection: Projection::Fov, omega: 0.9, ..none },
            Distortion { projection: Projection::Fov, omega: 0.0, ..none },
        ]
    }

    #[test]
    fn every_lens_is_undone_to_the_last_digits() {
        for lens in lenses() {
            for i in 0..400 {
                let (x, y) = ((i % 20) as f64 / 19.0 * 1.6 - 0.8, (i / 20) as f64 / 19.0 * 1.6 - 0.8);
                let (xd, yd) = lens.apply(x, y);
                let (u, v) = lens.undistort(xd, yd).unwrap();
                assert!((u - x).abs() + (v - y).abs() < 1e-11, "{lens:?} at {x}, {y}: {u}, {v}");
            }
        }
    }

    #[test]
    fn slopes_of_every_lens_are_its_finite_differences() {
        const STEP: f64 = 1e-5;
        for lens in lenses() {
            for (x, y) in [(0.0, 0.0), (0.31, -0.2), (-0.5, 0.44), (0.02, 0.6)] {
                let slopes = lens.slopes(x, y);
                for (column, (dx, dy)) in [(STEP, 0.0), (0.0, STEP)].into_iter().enumerate() {
                    let (after, before) = (lens.apply(x + dx, y + dy), lens.apply(x - dx, y - dy));
                    let measured = [(after.0 - before.0) / (2.0 * STEP), (after.1 - before.1) / (2.0 * STEP)];
                    for row in 0..2 {
                        let off = (slopes[row][column] - measured[row]).abs();
                        assert!(off < 1e-8, "{lens:?} at {x}, {y}: {slopes:?}, {measured:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn lenses_bend_as_worked_by_hand() {
        let none = Distortion::default();
        let near = |(a, b): (f64, f64), (c, d): (f64, f64)| (a - c).abs() + (b - d).abs() < 1e-12;
        // at x = 1, y = 0: (1 + 0.1 + 0.02 + 0.003) / (1 + 0.2 + 0.03 + 0.004) + p2 · 3
        let full = Distortion {
            k1: 0.1,
            k2: 0.02,
            k3: 0.003,
            k4: 0.2,
            k5: 0.03,
            k6: 0.004,
            p1: 0.5,
            p2: 0.25,
            ..none
        };
        assert!(near(full.apply(1.0, 0.0), (1.123 / 1.234 + 0.75, 0.5)));
        // 45° off the axis, θ = π/4
        let angle = std::f64::consts::FRAC_PI_4;
        let fisheye = Distortion { projection: Projection::Fisheye, k1: 0.1, sx1: 0.01, ..none };
        let bent = angle * (1.0 + 0.1 * angle * angle);
        assert!(near(fisheye.apply(0.0, 1.0), (0.01 * angle * angle, bent)));
        // ω = 90°: tan(ω/2) = 1, so r = atan(2) / (π/2) at tan θ = 1
        let fov = Distortion { projection: Projection::Fov, omega: 2.0 * angle, ..none };
        assert!(near(fov.apply(1.0, 0.0), (2f64.atan() / (2.0 * angle), 0.0)));
    }

    #[test]
    fn where_a_lens_folds_over_or_sees_backwards_there_is_no_ray() {
        let none = Distortion::default();
        // r (1 − 0.3 r²) is at most 2/3 · √(1/0.9) = 0.7027
        let barrel = Distortion { k1: -0.3, ..none };
        assert!(barrel.undistort(0.70, 0.0).is_some() && barrel.undistort(0.71, 0.0).is_none());
        let fisheye = Distortion { projection: Projection::Fisheye, ..none };
        assert!(fisheye.undistort(1.56, 0.0).is_some() && fisheye.undistort(1.58, 0.0).is_none());
        assert!(barrel.undistort(f64::NAN, 0.0).is_none() && fisheye.undistort(f64::INFINITY, 0.0).is_none());
    }

    #[test]
    fn a_plain_lens_is_written_as_it_always_was() {
        let lens = Distortion { k1: 0.5, ..Distortion::default() };
        let text = serde_json::to_string(&lens).unwrap();
        assert_eq!(text, r#"{"k1":0.5,"k2":0.0,"k3":0.0,"p1":0.0,"p2":0.0}"#);
        assert_eq!(format!("{lens:?}"), "Distortion { k1: 0.5, k2: 0.0, k3: 0.0, p1: 0.0, p2: 0.0 }");
        let fov = Distortion { projection: Projection::Fov, omega: 0.9, ..lens };
        assert!(format!("{fov:?}").ends_with("p2: 0.0, omega: 0.9, projection: Fov }"));
        for lens in lenses() {
            let text = serde_json::to_string(&lens).unwrap();
            assert_eq!(serde_json::from_str::<Distortion>(&text).unwrap(), lens);
        }
    }
}
