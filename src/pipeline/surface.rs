//! The interface of a trained field that later stages use, so that another field can stand in for
//! it.
//!
//! Views are made by marching rays through a field, a band of rows at a time: for a photograph of
//! twelve megapixels, memory holds the picture, but not a ray and its result for every pixel.

use crate::config::Stage;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use tiface_base::Result;
use tiface_base::geom::{BitGrid, Camera, Ray, RayResult, SdfField, Similarity};
use tiface_surface::Cap;
use tiface_surface::render::RenderedView;

/// A signed distance that may also be rendered by marching rays through it.
pub trait Surface: SdfField {
    /// Returns the view of a camera in scene coordinates by marching rays through the field itself;
    /// depth and normals are in the world. `None` if the field is only a surface.
    fn volume(&self, _camera: &Camera, _world_from_scene: &Similarity) -> Option<RenderedView> {
        None
    }

    /// Returns warnings about the evaluations so far, for example that a GPU failed.
    fn warning(&self) -> Option<&str> {
        None
    }
}

/// A field within the visual hull, with the color of the cap that closes its surface.
#[derive(Clone, Copy)]
pub(super) struct CappedField<'a> {
    pub field: &'a dyn Surface,
    /// Visual hull of the masks; points outside it are outside the surface.
    pub hull: Option<&'a BitGrid>,
    /// The cap where the frames cut the body.
    pub cap: Option<&'a Cap>,
}

impl SdfField for CappedField<'_> {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        self.field.sdf(points)
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        self.field.sdf_gradient(points)
    }

    /// Returns colors; the cap has its own.
    fn colors(&self, points: &[Vec3], normals: &[Vec3], counts: &[u32], away: &[Vec3]) -> Vec<[f32; 3]> {
        let mut colors = self.field.colors(points, normals, counts, away);
        if let Some(cap) = self.cap {
            let mut rest = &mut colors[..];
            for (p, &count) in points.iter().zip(counts) {
                let (own, after) = rest.split_at_mut(count as usize);
                rest = after;
                if cap.holds(*p) {
                    own.fill(cap.color(*p));
                }
            }
        }
        colors
    }

    fn sharpness(&self, points: &[Vec3]) -> Vec<f32> {
        self.field.sharpness(points)
    }

    fn excludes(&self, point: Vec3) -> bool {
        self.hull.is_some_and(|hull| !hull.contains(point))
    }
}

/// A field that is rendered by marching rays through it.
pub trait Radiance: Sync {
    /// Returns color and depth along rays in scene coordinates, for a camera that looks along the
    /// unit vector `forward`; no normals are computed. `[n]` → `[n]`.
    fn render_rays(&self, rays: &[Ray], forward: Vec3) -> Vec<RayResult>;
}

/// The trained fields, each loaded when it is first used.
pub trait Fields {
    /// Returns I-Face.
    fn surface(&self) -> Result<&dyn Surface>;

    /// Returns the field of the stage `baseline` or `tface`.
    fn radiance(&self, stage: Stage) -> Result<&dyn Radiance>;

    /// Returns warnings about the fields' evaluations so far.
    fn warnings(&self) -> Vec<&str> {
        Vec::new()
    }
}

impl Surface for crate::iface::IFace {
    fn volume(&self, camera: &Camera, world_from_scene: &Similarity) -> Option<RenderedView> {
        Some(march(camera, world_from_scene, true, |rays| self.render(rays)))
    }

    fn warning(&self) -> Option<&str> {
        self.gpu_failure()
    }
}

impl Surface for crate::iface::DensityField {
    fn volume(&self, camera: &Camera, world_from_scene: &Similarity) -> Option<RenderedView> {
        Some(march(camera, world_from_scene, false, |rays| self.render(rays)))
    }
}

impl Radiance for crate::tface::FieldMean {
    fn render_rays(&self, rays: &[Ray], forward: Vec3) -> Vec<RayResult> {
        self.render(rays, forward)
    }
}

/// Number of rays marched together: a few megabytes, and enough for any number of threads.
pub(super) const BAND: usize = 1 << 16;

/// Renders a camera in scene coordinates; depth and normals are in the world.
///
/// Depth and normal are kept where the opacity is at least a half. A pixel where the lens model
/// folds over has no ray and stays empty. `render_rays` maps `[n]` rays to `[n]` colors, some tens
/// of thousands at a time; where it returns nothing, those pixels stay empty too.
pub(super) fn march(
    camera: &Camera,
    world_from_scene: &Similarity,
    with_normals: bool,
    render_rays: impl Fn(&[Ray]) -> Vec<RayResult>,
) -> RenderedView {
    let (w, h) = (camera.width, camera.height);
    let mut view = RenderedView::new(w, h, with_normals);
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
        for ((i, ray), result) in at.iter().zip(&rays).zip(render_rays(&rays)) {
            let [r, g, b] = result.color;
            view.color.data[4 * i..4 * i + 4].copy_from_slice(&[r, g, b, result.opacity]);
            if result.opacity >= 0.5 {
                let along = result.depth * ray.direction.dot(camera.forward());
                view.depth.data[*i] = along * world_from_scene.scale as f32;
                if with_normals {
                    let normal = world_from_scene.direction(result.normal);
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
        let render_rays = |rays: &[Ray]| -> Vec<RayResult> {
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
        let view = march(&camera, &world_from_scene, false, render_rays);
        assert!(largest.get() <= BAND && largest.get() > BAND / 2, "{}", largest.get());
        assert_eq!((view.normal.width, view.normal.data.len()), (0, 0));
        assert_eq!(view.color.pixel(10, 199), [0.5, 0.25, 0.0, 1.0]);
        assert_eq!(view.color.pixel(990, 0)[3], 0.25);
        // 3 scene units before the camera, 6 of the world; none where three quarters shine through
        assert!((view.depth.pixel(10, 199)[0] - 6.0).abs() < 1e-5);
        assert_eq!(view.depth.pixel(990, 0), [0.0]);
        let upright = march(&camera, &world_from_scene, true, render_rays);
        assert_eq!(upright.normal.pixel(10, 5), [0.0, 0.0, 1.0]);
    }
}
