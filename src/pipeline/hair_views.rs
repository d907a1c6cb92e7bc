//! Views of T-Face from between the cameras: what soft layers and their colors are fitted to
//! besides the photographs.
//!
//! Photographs show each strand from a few directions; T-Face, which learned from all of them, from
//! any. Only pixels that look at layers are rendered.

use super::surface::{BAND, Radiance};
use glam::Vec2;
use rayon::prelude::*;
use tiface_base::geom::{Bvh, Camera, Mesh, Ray, RayResult, ShellCaster, Shells};
use tiface_base::image::{Gray, Photo, quantize};
use tiface_base::{Monitor, Result};
use tiface_capture::LoadedView;
use tiface_capture::path::between;

/// Maximum number of views. On the man of the results (`docs/soft-layers.md`) 56 gain less than
/// 0.02 dB, 20 lose 0.1 to 0.3.
pub(super) const VIEWS: usize = 32;

/// Maximum length of the longer side of a view, pixels. There 512 gain 0.07 dB for a quarter of the
/// stage's time.
pub(super) const SIDE_PX: u32 = 384;

/// Returns views of a field from between the cameras, which are in the scene; of each, pixels that
/// look at soft layers are valid.
///
/// # Errors
///
/// A request to stop.
pub(super) fn hair_views(
    mesh: &Mesh,
    shells: &Shells,
    cameras: &[Camera],
    field: &dyn Radiance,
    monitor: &dyn Monitor,
) -> Result<Vec<LoadedView>> {
    let (core, around) = shells.on_core(mesh);
    let (bvh, layers) = (Bvh::new(&core), ShellCaster::new(&core, &around));
    let center = core.bounds().center().as_dvec3();
    let view = |camera: Camera| {
        monitor.check_stop()?;
        let camera = no_larger(camera);
        let meets = |i: u32| {
            let at = Vec2::new((i % camera.width) as f32 + 0.5, (i / camera.width) as f32 + 0.5);
            let Some(ray) = camera.ray(at) else { return Meets::Nothing };
            let end = bvh.closest_hit(&ray).map_or(f32::INFINITY, |hit| hit.t);
            let mut is_soft = false;
            layers.cast(&ray, end, |_, _, _| is_soft = true);
            match is_soft {
                true => Meets::Layers(Ray { t_min: 0.0, t_max: f32::INFINITY, ..ray }),
                false if end.is_finite() => Meets::Head,
                false => Meets::Nothing,
            }
        };
        let met: Vec<Meets> = (0..camera.width * camera.height).into_par_iter().map(meets).collect();
        Ok(rendered(camera, &met, field))
    };
    between(cameras, center, VIEWS).into_iter().map(view).collect()
}

/// What the middle of a pixel looks at.
enum Meets {
    Layers(Ray),
    Head,
    Nothing,
}

/// Returns a view of a field where layers are met.
fn rendered(camera: Camera, met: &[Meets], field: &dyn Radiance) -> LoadedView {
    let soft = |m: &Meets| if let Meets::Layers(ray) = m { Some(*ray) } else { None };
    let rays: Vec<Ray> = met.iter().filter_map(soft).collect();
    let mut results = rays.chunks(BAND).flat_map(|rays| field.render_rays(rays, camera.forward()));
    let pixel = |m: &Meets| match m {
        Meets::Layers(_) => match results.next() {
            Some(RayResult { color, opacity, .. }) if opacity.is_finite() => {
                (color.map(|c| quantize(c / opacity.max(1e-6))), quantize(opacity), u8::MAX)
            }
            _ => ([0; 3], 0, 0),
        },
        Meets::Head => ([0; 3], u8::MAX, 0),
        Meets::Nothing => ([0; 3], 0, 0),
    };
    let (width, height) = (camera.width, camera.height);
    let (mut rgb, mut mask, mut valid) = (Vec::new(), Vec::new(), Vec::new());
    for (color, opacity, is_valid) in met.iter().map(pixel) {
        rgb.push(color);
        mask.push(opacity);
        valid.push(is_valid);
    }
    let gray = |values| Some(Gray { width, height, values });
    LoadedView {
        camera,
        photo: Photo { width, height, rgb, alpha: None },
        mask: gray(mask),
        valid: gray(valid),
        region: None,
    }
}

/// Returns the camera of a picture of at most [`SIDE_PX`] a side.
fn no_larger(camera: Camera) -> Camera {
    let longer = camera.width.max(camera.height);
    if longer <= SIDE_PX {
        return camera;
    }
    let side = |side: u32| ((f64::from(side) * f64::from(SIDE_PX) / f64::from(longer)).round() as u32).max(1);
    camera.resized(side(camera.width), side(camera.height))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3, Vec3};
    use tiface_base::Quiet;
    use tiface_base::geom::ShellLayer;

    /// Premultiplied orange of half an opacity, wherever one looks.
    struct Haze;

    impl Radiance for Haze {
        fn render_rays(&self, rays: &[Ray], _: Vec3) -> Vec<RayResult> {
            assert!(rays.iter().all(|ray| ray.t_min == 0.0 && ray.t_max == f32::INFINITY));
            let haze = RayResult { color: [0.4, 0.2, 0.0], opacity: 0.5, ..RayResult::default() };
            vec![haze; rays.len()]
        }
    }

    /// Returns an octahedron of radius 1 and a layer of radius 1.5 around its upper half.
    fn hair() -> (Mesh, Shells) {
        let axes = [Vec3::X, Vec3::Z, -Vec3::X, -Vec3::Z, Vec3::Y, -Vec3::Y];
        let sides = (0..4).flat_map(|i| [[i, 4, (i + 1) % 4], [i, (i + 1) % 4, 5]]);
        let triangles = sides.map(|t| [t[0], t[2], t[1]]).collect();
        let mesh = Mesh { positions: axes.to_vec(), normals: axes.to_vec(), triangles, ..Mesh::default() };
        let layer = ShellLayer { offsets: vec![0.5; 6], alphas: vec![0.0, 0.0, 0.0, 0.0, 0.5, 0.0] };
        (mesh, Shells { layers: vec![layer], ..Shells::default() })
    }

    #[test]
    fn views_show_the_field_where_layers_are_and_the_head_elsewhere() {
        let (mesh, shells) = hair();
        let camera = |angle: f64| {
            let rotation = DMat3::from_rotation_y(angle);
            let front = Camera::above(40, 60, 60.0, 4.0);
            Camera { rotation, position: rotation * DVec3::new(0.0, 0.0, 4.0), ..front }
        };
        let views = hair_views(&mesh, &shells, &[camera(0.0), camera(0.6)], &Haze, &Quiet).unwrap();
        assert_eq!(views.len(), 1);
        let LoadedView { camera: between, photo, mask, valid, .. } = &views[0];
        assert!((between.position - camera(0.3).position).length() < 1e-9);
        let (mask, valid) = (mask.as_ref().unwrap(), valid.as_ref().unwrap());
        let at = |point: Vec3| {
            let seen = between.project_inside(point).unwrap();
            let i = seen.y as usize * 40 + seen.x as usize;
            (valid.values[i], mask.values[i], photo.rgb[i])
        };
        // before the head, beside it, below it, and nowhere
        let orange = (u8::MAX, 128, [204, 102, 0]);
        assert_eq!(at(Vec3::new(0.0, 0.3, 0.0)), orange);
        assert_eq!(at(Vec3::new(0.0, 1.3, 0.0)), orange);
        assert_eq!(at(Vec3::new(0.0, -0.5, 0.0)), (0, u8::MAX, [0; 3]));
        assert_eq!(at(Vec3::new(0.0, -1.3, 0.0)), (0, 0, [0; 3]));
    }

    #[test]
    fn views_are_no_larger_than_the_field_resolves() {
        let size = |width, height| {
            let camera = no_larger(Camera::above(width, height, f64::from(width), 4.0));
            (camera.width, camera.height, camera.fx)
        };
        assert_eq!(size(384, 300), (384, 300, 384.0));
        assert_eq!(size(3000, 4000), (288, 384, 288.0));
        assert_eq!(size(100_000, 10), (384, 1, 384.0));
    }
}
