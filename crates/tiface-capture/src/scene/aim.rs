//! Where a camera aims: through the middle of its mask, or along its axis.

use glam::{DVec3, Vec2};
use tiface_base::geom::Camera;
use tiface_base::image::Gray;

/// Returns the direction through the middle of a mask's weight, or along the viewing axis without
/// one.
pub(super) fn ray_to(camera: &Camera, mask: Option<&Gray>) -> (DVec3, DVec3) {
    let axis = -camera.rotation.z_axis;
    let Some(mask) = mask else { return (camera.position, axis) };
    let camera = camera.resized(mask.width, mask.height);
    let (mut x, mut y, mut weight) = (0.0, 0.0, 0.0);
    for (i, &v) in mask.values.iter().enumerate() {
        let v = v as f64;
        weight += v;
        x += v * ((i % mask.width as usize) as f64 + 0.5);
        y += v * ((i / mask.width as usize) as f64 + 0.5);
    }
    let middle = Vec2::new((x / weight) as f32, (y / weight) as f32);
    match camera.ray(middle) {
        Some(ray) if weight > 0.0 => (camera.position, ray.direction.as_dvec3()),
        _ => (camera.position, axis),
    }
}
