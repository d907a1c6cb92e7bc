//! The scene without masks: the box of the region that 40 % of the cameras have in their frame, no
//! farther from the meeting point of the viewing axes than 0.6 of the cameras' median distance to
//! it; drawn tighter around the dataset's points within it, or the dataset's own box.

use super::aim::ray_to;
use super::{Scene, aim, head_outside, scene_from, world_box};
use crate::projector::Projector;
use crate::view::View;
use glam::{DVec3, Vec3};
use tiface_base::Result;
use tiface_base::geom::{Aabb, Camera, CellCube, drop_small_components, extent_of_cells};
use tiface_base::math::rank::median;

/// Minimum number of points for a box around them.
const MIN_POINTS: usize = 100;

/// Returns the box of the points that the cameras see, without one percent on each side, enlarged
/// by a twentieth; `None` for too few points.
pub(crate) fn around_points(views: &[View], points: &[DVec3]) -> Option<Aabb> {
    if points.len() < MIN_POINTS {
        return None;
    }
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera.clone()).collect();
    let seen = world_box(&from_frusta(&cameras, None).ok()?);
    let within: Vec<Vec3> = points.iter().map(|p| p.as_vec3()).filter(|p| seen.contains(*p)).collect();
    if within.len() < MIN_POINTS {
        return None;
    }
    let [x, y, z] = [0, 1, 2].map(|k| {
        let mut along: Vec<f32> = within.iter().map(|p| p[k]).collect();
        along.sort_by(f32::total_cmp);
        (along[along.len() / 100], along[along.len() - 1 - along.len() / 100])
    });
    let (min, max) = (Vec3::new(x.0, y.0, z.0), Vec3::new(x.1, y.1, z.1));
    let more = 0.05 * (max - min);
    Some(Aabb { min: (min - more).max(seen.min), max: (max + more).min(seen.max) })
}

/// Returns the scene of a box in the world, without a hull; `None` for a flat box.
fn from_box(b: Aabb) -> Option<Scene> {
    let (size, middle) = (b.size().as_dvec3(), b.center().as_dvec3());
    let half = 0.5 * size.max_element();
    if !(half.is_finite() && size.min_element() > 1e-3 * half) {
        return None;
    }
    let reach = (0.5 * size / half).as_vec3();
    let aabb = Aabb { min: -reach, max: reach };
    Some(Scene { scene_from_world: scene_from(middle, half), aabb, hull: None })
}

/// Returns the scene without masks, from the frames of the cameras or the box of the dataset.
pub(super) fn from_frusta(cameras: &[Camera], focus: Option<Aabb>) -> Result<Scene> {
    if let Some(scene) = focus.and_then(from_box) {
        return Ok(scene);
    }
    let some: Vec<&Camera> = cameras.iter().collect();
    let axes: Vec<_> = cameras.iter().map(|c| ray_to(c, None)).collect();
    let center = aim(&some, &axes)?;
    let mut distances: Vec<f64> = cameras.iter().map(|c| c.position.distance(center)).collect();
    let half = 0.6 * median(&mut distances, f64::total_cmp).unwrap_or(0.0);
    let cube = CellCube { center, half, n: 48 };
    let projectors: Vec<Projector> = cameras.iter().map(Projector::new).collect();
    let least = (2 * cameras.len()).div_ceil(5).max(2);
    let mut kept = vec![false; cube.n.pow(3)];
    for (i, cell) in kept.iter_mut().enumerate() {
        let p = cube.cell_center(i / (cube.n * cube.n), i / cube.n % cube.n, i % cube.n);
        *cell = p.distance(center) <= half && projectors.iter().filter(|c| c.sees(p)).count() >= least;
    }
    drop_small_components(&mut kept, cube.n, 1.0);
    let Some(extent) = extent_of_cells(&kept, cube.n) else {
        let seen = projectors.iter().filter(|c| c.sees(center)).count();
        return Err(head_outside(seen, cameras.len()));
    };
    let lo = DVec3::from(extent.map(|(lo, _)| lo as f64));
    let hi = DVec3::from(extent.map(|(_, hi)| hi as f64 + 1.0));
    let middle = center - half + 0.5 * (lo + hi) * cube.cell();
    let size = (hi - lo) * cube.cell();
    let half = 0.5 * size.max_element();
    let reach = (0.5 * size / half).as_vec3();
    Ok(Scene {
        scene_from_world: scene_from(middle, half),
        aabb: Aabb { min: -reach, max: reach },
        hull: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{SceneOptions, fit};
    use crate::synthetic;

    #[test]
    fn points_draw_the_box_tighter_and_a_flat_box_is_no_scene() {
        let options = synthetic::SyntheticOptions::default();
        let cameras: Vec<Camera> =
            synthetic::cameras(&options).into_iter().map(|(camera, _)| camera).collect();
        let views: Vec<View> = cameras.iter().map(|camera| View::bare("", camera.clone())).collect();
        let mut points: Vec<DVec3> =
            synthetic::SyntheticHead.surface_points(2000, 3).iter().map(|p| p.as_dvec3()).collect();
        points.push(DVec3::splat(500.0)); // what else is in the pictures
        points.push(DVec3::splat(f64::NAN));
        let found = around_points(&views, &points).unwrap();
        let truth = synthetic::SyntheticHead.bounds();
        let off = (found.min - truth.min).abs().max((found.max - truth.max).abs());
        assert!(off.max_element() < 0.1 * truth.size().max_element(), "{found:?} {truth:?}");
        assert_eq!(around_points(&views, &points[..99]), None);
        let options = SceneOptions { focus: Some(found), ..SceneOptions::default() };
        let (scene, _) = fit(&cameras, &vec![None; cameras.len()], &options).unwrap();
        assert!((world_box(&scene).min - found.min).abs().max_element() < 1e-3);
        assert!(from_box(Aabb { min: Vec3::ZERO, max: Vec3::new(1.0, 1.0, 0.0) }).is_none());
    }
}
