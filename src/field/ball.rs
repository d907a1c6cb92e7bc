//! Photographs of an analytic ball, the training data of self-tests and tests.

use glam::{DMat3, DVec3, Vec2, Vec3};
use tiface_base::geom::{BitGrid, Camera, Distortion};
use tiface_base::image::{Gray, Photo};
use tiface_capture::LoadedView;

/// Radius of the ball, scene units.
pub const BALL: f32 = 0.6;

/// Returns photographs from eight sides of a red and green ball in front of a blue wall.
pub fn views() -> Vec<LoadedView> {
    let color = |p: Vec3| if p.y > 0.0 { [200, 40, 30] } else { [40, 180, 60] };
    (0..8)
        .map(|i| view(40, i as f64 * std::f64::consts::TAU / 8.0, if i % 2 == 0 { 0.4 } else { -0.4 }, color))
        .collect()
}

/// Returns photographs of a ball textured with waves of a few pixels: nine from the front and three
/// from the back.
#[cfg(test)]
pub fn textured_views() -> Vec<LoadedView> {
    let waves = |p: Vec3| {
        let wave = |i: u64| {
            let [x, y, z] = [0, 1, 2].map(|k| 90.0 * tiface_base::math::rng::uniform(5, i, k) - 45.0);
            (p.dot(Vec3::new(x, y, z)) + i as f32).sin()
        };
        [(128.0 + 12.0 * (0..9).map(wave).sum::<f32>()) as u8; 3]
    };
    let before = (0..9).map(|i| (0.4 * (i % 3) as f64 - 0.4, 0.4 * (i / 3) as f64 - 0.4));
    let behind = (2..5).map(|i| (i as f64 * std::f64::consts::TAU / 6.0, 0.3));
    before.chain(behind).map(|(azimuth, elevation)| view(80, azimuth, elevation, waves)).collect()
}

/// Renders a photograph of the ball, with its mask.
pub fn view(size: u32, azimuth: f64, elevation: f64, color: impl Fn(Vec3) -> [u8; 3]) -> LoadedView {
    let rotation = DMat3::from_rotation_y(azimuth) * DMat3::from_rotation_x(-elevation);
    let camera = Camera {
        width: size,
        height: size,
        fx: 1.5 * size as f64,
        fy: 1.5 * size as f64,
        cx: 0.5 * size as f64,
        cy: 0.5 * size as f64,
        distortion: Distortion::default(),
        rotation,
        position: rotation * DVec3::new(0.0, 0.0, 3.0),
    };
    let mut rgb = Vec::new();
    let mut alpha = Vec::new();
    for y in 0..size {
        for x in 0..size {
            let ray = camera
                .ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5))
                .expect("a camera without a lens has a ray for every pixel");
            let b = ray.origin.dot(ray.direction);
            let discriminant = b * b - ray.origin.length_squared() + BALL * BALL;
            if discriminant > 0.0 {
                let p = ray.at(-b - discriminant.sqrt());
                rgb.push(color(p));
                alpha.push(255);
            } else {
                rgb.push([30, 30, 220]);
                alpha.push(0);
            }
        }
    }
    LoadedView {
        camera,
        photo: Photo { width: size, height: size, rgb, alpha: None },
        mask: Some(Gray { width: size, height: size, values: alpha }),
        valid: None,
        region: None,
    }
}

/// Returns the cells that contain the ball, with a margin of 0.1.
pub fn hull() -> BitGrid {
    cells_within(BALL + 0.1)
}

/// Returns the cells whose centers lie within a radius.
pub fn cells_within(radius: f32) -> BitGrid {
    let r = 32;
    let mut cells = BitGrid::filled(r, false);
    for i in 0..r * r * r {
        let c = Vec3::from_array([i / (r * r), i / r % r, i % r].map(|c| (c as f32 + 0.5) / 16.0 - 1.0));
        cells.set(i, c.length() < radius);
    }
    cells
}
