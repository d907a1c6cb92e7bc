//! Lenses of photographs in device memory: the twin of [`tiface_base::geom::Distortion`].

use burn::cubecl::{self, prelude::*};

/// A float of a view.
#[cube]
pub(super) fn number(views: &[u32], view: usize, i: usize) -> f32 {
    f32::reinterpret(views[view + i])
}

/// A point of the picture's plane.
#[derive(CubeType, Clone, Copy)]
pub(super) struct Point {
    pub x: f32,
    pub y: f32,
    /// Whether the lens shows a point there.
    pub found: bool,
}

/// A point distorted by a lens, and the Jacobian of the distortion.
#[derive(CubeType, Clone, Copy)]
struct DistortJacobian {
    x: f32,
    y: f32,
    xx: f32,
    xy: f32,
    yx: f32,
    yy: f32,
}

#[cube]
fn distort(views: &[u32], lens: usize, x: f32, y: f32) -> DistortJacobian {
    let (k1, k2, k3) = (number(views, lens, 2), number(views, lens, 3), number(views, lens, 4));
    let (k4, k5, k6) = (number(views, lens, 5), number(views, lens, 6), number(views, lens, 7));
    let (p1, p2) = (number(views, lens, 8), number(views, lens, 9));
    let (sx, sy) = (number(views, lens, 10), number(views, lens, 11));
    let r2 = x * x + y * y;
    let mut radial = 1.0f32 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let mut slope = k1 + r2 * (2.0f32 * k2 + 3.0f32 * r2 * k3);
    if views[lens] == 1 {
        radial += r2 * r2 * r2 * r2 * k4;
        slope += 4.0f32 * r2 * r2 * r2 * k4;
    } else {
        let under = 1.0f32 + r2 * (k4 + r2 * (k5 + r2 * k6));
        radial /= under;
        slope = (slope - radial * (k4 + r2 * (2.0f32 * k5 + 3.0f32 * r2 * k6))) / under;
    }
    slope *= 2.0f32;
    let cross = x * y * slope + 2.0f32 * p1 * x + 2.0f32 * p2 * y;
    DistortJacobian {
        x: x * radial + 2.0f32 * p1 * x * y + p2 * (r2 + 2.0f32 * x * x) + sx * r2,
        y: y * radial + p1 * (r2 + 2.0f32 * y * y) + 2.0f32 * p2 * x * y + sy * r2,
        xx: radial + x * x * slope + 2.0f32 * p1 * y + 6.0f32 * p2 * x + 2.0f32 * sx * x,
        xy: cross + 2.0f32 * sx * y,
        yx: cross + 2.0f32 * sy * x,
        yy: radial + y * y * slope + 6.0f32 * p1 * y + 2.0f32 * p2 * x + 2.0f32 * sy * y,
    }
}

/// Inverts the distortion of a lens; see [`tiface_base::geom::Distortion::undistort`].
#[cube]
pub(super) fn undistort(views: &[u32], lens: usize, xd: f32, yd: f32) -> Point {
    let mut x = xd;
    let mut y = yd;
    let mut found = true;
    if views[lens + 1] == 0 {
        for _ in 0..10u32 {
            let at = distort(views, lens, x, y);
            let (ex, ey) = (at.x - xd, at.y - yd);
            let det = at.xx * at.yy - at.xy * at.yx;
            found = found && det > 1e-6f32;
            let over = 1.0f32 / max(det, 1e-6f32);
            x -= (at.yy * ex - at.xy * ey) * over;
            y -= (at.xx * ey - at.yx * ex) * over;
        }
        let at = distort(views, lens, x, y);
        found = found && (at.x - xd).abs() + (at.y - yd).abs() < 1e-5f32;
        // tan θ / r of the projection
        let r = (x * x + y * y).sqrt();
        let widest = 1.569_796_3f32;
        let mut scale = 1.0f32;
        if views[lens] == 1 {
            found = found && r < widest;
            if r > 1e-4f32 {
                scale = min(r, widest).tan() / r;
            }
        }
        let omega = number(views, lens, 12);
        if views[lens] == 2 && omega.abs() > 1e-6f32 {
            let spread = 2.0f32 * (0.5f32 * omega).tan().abs();
            let angle = r * omega.abs();
            found = found && angle < widest;
            scale = omega.abs() / spread;
            if angle > 1e-4f32 {
                scale = min(angle, widest).tan() / (spread * r);
            }
        }
        x *= scale;
        y *= scale;
    }
    Point { x, y, found }
}
