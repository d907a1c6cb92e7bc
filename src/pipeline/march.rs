//! Views by marching rays through a field, a band of rows at a time: a photograph of twelve megapixels
//! has room for its picture, not for a ray and what it saw in every pixel.

use crate::geom::{Camera, Ray, RayResult, Similarity};
use crate::image::Image;
use crate::render::RenderedView;
use glam::Vec2;
use rayon::prelude::*;

/// Rays marched together: some megabytes, and enough for any number of threads.
const BAND: usize = 1 << 16;

/// The view of a camera in scene coordinates; depth and normals in the world.
///
/// Depth and normal are kept where the opacity is at least a half. Where the lens model folds over, no
/// ray is: the pixel stays empty. `see`: `[n]` rays → `[n]`, some tens of thousands at a time; where it
/// answers nothing, those pixels stay empty too.
pub(super) fn march(
    camera: &Camera,
    world_from_scene: &Similarity,
    with_normals: bool,
    see: impl Fn(&[Ray]) -> Vec<RayResult>,
) -> RenderedView {
    let (w, h) = (camera.width, camera.height);
    let sized = |wanted: bool| if wanted { (w, h) } else { (0, 0) };
    let (nw, nh) = sized(with_normals);
    let mut view = RenderedView {
        color: Image::new(w, h, 4),
        depth: Image::new(w, h, 1),
        normal: Image::new(nw, nh, 3),
    };
    let width = w as usize;
    let rows = (BAND / width.max(1)).max(1);
    for top in (0..h as usize).step_by(rows) {
        let pixels = top * width..(top + rows).min(h as usize) * width;
        let made: Vec<(usize, Ray)> = pixels
            .into_par_iter()
            .filter_map(|i| {
                let ray = camera.ray(Vec2::new((i % width) as f32 + 0.5, (i / width) as f32 + 0.5))?;
                Some((i, Ray { t_min: 0.0, t_max: f32::INFINITY, ..ray }))
            })
            .collect();
        let (at, rays): (Vec<usize>, Vec<Ray>) = made.into_iter().unzip();
        for ((i, ray), seen) in at.iter().zip(&rays).zip(see(&rays)) {
            let [r, g, b] = seen.color;
            view.color.data[4 * i..4 * i + 4].copy_from_slice(&[r, g, b, seen.opacity]);
            if seen.opacity >= 0.5 {
                let along = seen.depth * ray.direction.dot(camera.forward());
                view.depth.data[*i] = along * world_from_scene.scale as f32;
                if with_normals {
                    let normal = world_from_scene.direction(seen.normal);
                    view.normal.data[3 * i..3 * i + 3].copy_from_slice(&normal.to_array());
                }
            }
        }
    }
    view
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use std::cell::Cell;

    fn camera(width: u32, height: u32) -> Camera {
        Camera::above(width, height, width as f64, 3.0)
    }

    #[test]
    fn a_large_view_is_marched_in_bands_and_every_pixel_is_its_own() {
        let largest = Cell::new(0);
        // the plane z = 0, all opaque on the left, a quarter on the right
        let see = |rays: &[Ray]| -> Vec<RayResult> {
            largest.set(largest.get().max(rays.len()));
            let one = |ray: &Ray| RayResult {
                color: [0.5, 0.25, 0.0],
                opacity: if ray.direction.x < 0.0 { 1.0 } else { 0.25 },
                depth: -ray.origin.z / ray.direction.z,
                normal: Vec3::Z,
            };
            rays.iter().map(one).collect()
        };
        let world_from_scene = Similarity { scale: 2.0, ..Similarity::IDENTITY };
        let camera = camera(1000, 200);
        let view = march(&camera, &world_from_scene, false, see);
        assert!(largest.get() <= BAND && largest.get() > BAND / 2, "{}", largest.get());
        assert_eq!((view.normal.width, view.normal.data.len()), (0, 0));
        assert_eq!(view.color.pixel(10, 199), [0.5, 0.25, 0.0, 1.0]);
        assert_eq!(view.color.pixel(990, 0)[3], 0.25);
        // 3 scene units before the camera, 6 of the world; none where three quarters shine through
        assert!((view.depth.pixel(10, 199)[0] - 6.0).abs() < 1e-5);
        assert_eq!(view.depth.pixel(990, 0), [0.0]);
        let upright = march(&camera, &world_from_scene, true, see);
        assert_eq!(upright.normal.pixel(10, 5), [0.0, 0.0, 1.0]);
    }
}
