//! A camera prepared for many projections.

use glam::DVec3;
use tiface_base::geom::Camera;

/// A camera prepared for many projections.
pub struct Projector {
    pub(super) camera: Camera,
    /// Squared ideal radius beyond which the lens model is not trusted: a polynomial folds back.
    reach: f64,
    plain: bool,
}

impl Projector {
    /// Returns a camera with the reach of its lens model, which its borders show.
    pub fn new(camera: &Camera) -> Projector {
        let (w, h) = (camera.width as f64, camera.height as f64);
        let border = (0..=16).flat_map(|i| {
            let t = i as f64 / 16.0;
            [(t * w, 0.0), (t * w, h), (0.0, t * h), (w, t * h)]
        });
        let reach = border
            .filter_map(|(x, y)| {
                let (x, y) = ((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy);
                camera.distortion.undistort(x, y).map(|(x, y)| x * x + y * y)
            })
            .fold(0.0, f64::max);
        Projector { camera: camera.clone(), reach: 1.1 * reach, plain: camera.distortion.is_none() }
    }

    /// Picture position and depth; `None` behind the camera or beyond the lens model's reach.
    // millions of cells are projected by one camera, whose numbers then stay in registers
    #[inline(always)]
    pub fn project(&self, point: DVec3) -> Option<(f64, f64, f64)> {
        let (ideal, depth) = Camera::ideal(self.camera.local(point))?;
        let pixel = match self.plain {
            true => self.camera.pixel_behind_lens(ideal.into()),
            false if ideal.length_squared() > self.reach => return None,
            false => self.camera.pixel(ideal),
        };
        Some((pixel.x, pixel.y, depth))
    }

    /// Returns whether the point is inside the frame.
    pub fn sees(&self, point: DVec3) -> bool {
        let (w, h) = (self.camera.width as f64, self.camera.height as f64);
        self.project(point).is_some_and(|(x, y, _)| x >= 0.0 && y >= 0.0 && x < w && y < h)
    }
}
