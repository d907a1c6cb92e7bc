//! What the later stages need of a learned field, and of anything else that can stand in for it.

use crate::capture::synthetic::SyntheticHead;
use crate::geom::{Camera, Similarity};
use crate::render::RenderedView;
use glam::Vec3;

/// A coloured signed distance in scene coordinates.
pub trait Surface: Sync {
    /// Signed distance, negative inside. `[n, 3]` → `[n]`.
    fn sdf(&self, points: &[Vec3]) -> Vec<f32>;

    /// Signed distance and its gradient. `[n, 3]` → `[n]`, `[n, 3]`.
    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>);

    /// sRGB-coded colour of surface points with unit normals, seen along unit directions, away from the
    /// camera. All `[n, 3]`.
    fn color(&self, points: &[Vec3], normals: &[Vec3], directions: &[Vec3]) -> Vec<[f32; 3]>;

    /// The view of a camera in scene coordinates by marching through the field itself; depth and
    /// normals in the world. `None` for what is only a surface.
    fn volume(&self, camera: &Camera, world_from_scene: &Similarity) -> Option<RenderedView>;
}

#[cfg(feature = "cpu")]
impl Surface for crate::iface::IFace {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        self.sdf(points)
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        self.sdf_gradient(points)
    }

    fn color(&self, points: &[Vec3], normals: &[Vec3], directions: &[Vec3]) -> Vec<[f32; 3]> {
        self.color(points, normals, directions)
    }

    fn volume(&self, camera: &Camera, world_from_scene: &Similarity) -> Option<RenderedView> {
        use crate::geom::Ray;
        use crate::image::Image;
        use glam::Vec2;
        let (w, h) = (camera.width, camera.height);
        let (mut rays, mut pixels) = (Vec::new(), Vec::new());
        for i in 0..w * h {
            // where the lens model folds over, no ray is: the pixel stays empty
            if let Some(ray) = camera.ray(Vec2::new((i % w) as f32 + 0.5, (i / w) as f32 + 0.5)) {
                rays.push(Ray { t_min: 0.0, t_max: f32::INFINITY, ..ray });
                pixels.push((i % w, i / w));
            }
        }
        let mut view = RenderedView {
            color: Image::new(w, h, 4),
            depth: Image::new(w, h, 1),
            normal: Image::new(w, h, 3),
        };
        for ((ray, seen), (x, y)) in rays.iter().zip(self.render(&rays)).zip(pixels) {
            let [r, g, b] = seen.color;
            view.color.pixel_mut(x, y).copy_from_slice(&[r, g, b, seen.opacity]);
            if seen.opacity >= 0.5 {
                let along = seen.depth * ray.direction.dot(camera.forward());
                view.depth.pixel_mut(x, y)[0] = along * world_from_scene.scale as f32;
                let normal = world_from_scene.direction(seen.normal);
                view.normal.pixel_mut(x, y).copy_from_slice(&normal.to_array());
            }
        }
        Some(view)
    }
}

/// The demo head itself, as a perfectly learned field would be; painted in one colour.
pub struct Exact {
    /// Where the scene sits.
    pub world_from_scene: Similarity,
}

impl Surface for Exact {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        let scale = self.world_from_scene.scale as f32;
        points.iter().map(|&p| SyntheticHead.sdf(self.world_from_scene.point(p)) / scale).collect()
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        // the scene is scaled and moved, never turned: slopes are the same
        let gradient = |&p: &Vec3| SyntheticHead.gradient(self.world_from_scene.point(p));
        (self.sdf(points), points.iter().map(gradient).collect())
    }

    fn color(&self, points: &[Vec3], _: &[Vec3], _: &[Vec3]) -> Vec<[f32; 3]> {
        vec![[0.6, 0.5, 0.4]; points.len()]
    }

    fn volume(&self, _: &Camera, _: &Similarity) -> Option<RenderedView> {
        None
    }
}
