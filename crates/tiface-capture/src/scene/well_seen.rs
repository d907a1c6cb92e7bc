//! The part of the scene's box that enough cameras see.
//!
//! A body that the frames cut continues where hardly any camera sees it; a field can only guess
//! that part. Training still needs that part (rays of good pixels pass through it), the mesh does
//! not: it is closed by a flat cap where too few cameras see the body.

use super::Scene;
use crate::projector::Projector;
use glam::{DVec3, Vec3};
use tiface_base::geom::{Aabb, Camera};
use tiface_base::math::rank::median;

/// Returns the part of the scene's box, in scene coordinates, whose outermost slabs of hull cells
/// are, in the median, inside the frames of a `share` of the cameras, 0..=1 (three at least).
/// `cameras` are in the world; only the face that looks most downward moves (`up` is a world
/// direction): frames cut heads below, and a body whose shoulders end in walls left and right looks
/// like a box.
///
/// Without a hull, and where every slab is seen, the whole box.
pub fn well_seen(scene: &Scene, cameras: &[Camera], up: Vec3, share: f64) -> Aabb {
    let Some(hull) = &scene.hull else { return scene.aabb };
    let least = ((share * cameras.len() as f64).ceil() as usize).max(3).min(cameras.len());
    let projectors: Vec<Projector> = cameras.iter().map(Projector::new).collect();
    let world_from_scene = scene.scene_from_world.inverse();
    let r = hull.resolution;
    let cell = 2.0 / r as f64;
    let middle = |i: usize| (i as f64 + 0.5) * cell - 1.0;
    // how many cameras see each cell of a slab across an axis; the median decides
    let seen_enough = |axis: usize, slab: usize| -> Option<bool> {
        let mut seen: Vec<usize> = Vec::new();
        for a in 0..r {
            for b in 0..r {
                let mut c = [a, b, slab];
                // the slab's index goes to its axis, (a, b) to the others in turn
                c.rotate_left(2 - axis);
                if hull.get((c[0] * r + c[1]) * r + c[2]) {
                    let p = world_from_scene.point_f64(DVec3::from_array(c.map(middle)));
                    seen.push(projectors.iter().filter(|q| q.sees(p)).count());
                }
            }
        }
        Some(median(&mut seen, usize::cmp)? >= least)
    };
    let mut low = scene.aabb.min;
    let mut high = scene.aabb.max;
    let up = scene.scene_from_world.direction(up);
    let axis = up.abs().max_position();
    let good: Vec<usize> = (0..r).filter(|&s| seen_enough(axis, s) == Some(true)).collect();
    let poor: Vec<usize> = (0..r).filter(|&s| seen_enough(axis, s) == Some(false)).collect();
    let (Some(&first), Some(&last)) = (good.first(), good.last()) else { return scene.aabb };
    // it moves only where a poorly seen slab lies beyond the last good one
    let below = poor.iter().filter(|&&s| s < first).max();
    let above = poor.iter().filter(|&&s| s > last).min();
    match (up[axis] > 0.0, below, above) {
        (true, Some(&edge), _) => low[axis] = low[axis].max(((edge + 1) as f64 * cell - 1.0) as f32),
        (false, _, Some(&edge)) => high[axis] = high[axis].min((edge as f64 * cell - 1.0) as f32),
        _ => {}
    }
    Aabb { min: low, max: high.max(low + Vec3::splat(cell as f32)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;
    use tiface_base::geom::{BitGrid, Distortion, Similarity};

    /// Eight cameras around the y axis at distance 4, looking at the middle from `height` above.
    fn cameras(height: f64) -> Vec<Camera> {
        (0..8)
            .map(|i| {
                let turn = DMat3::from_rotation_y(i as f64 * std::f64::consts::TAU / 8.0);
                Camera {
                    width: 100,
                    height: 100,
                    fx: 200.0,
                    fy: 200.0,
                    cx: 50.0,
                    cy: 50.0,
                    distortion: Distortion::default(),
                    rotation: turn,
                    position: turn * DVec3::new(0.0, height, 4.0),
                }
            })
            .collect()
    }

    fn scene() -> Scene {
        Scene {
            scene_from_world: Similarity::IDENTITY,
            aabb: Aabb::SCENE,
            hull: Some(BitGrid::filled(16, true)),
        }
    }

    #[test]
    fn what_every_frame_holds_is_kept_whole() {
        // half the frame at distance 3, the nearest: 50 / 200 · 3 = 0.75; at 4: 1.0; median cells
        // are in
        let wide: Vec<Camera> =
            cameras(0.0).into_iter().map(|c| Camera { fx: 80.0, fy: 80.0, ..c }).collect();
        assert_eq!(well_seen(&scene(), &wide, Vec3::Y, 1.0 / 3.0), Aabb::SCENE);
    }

    #[test]
    fn a_body_that_the_frames_cut_below_ends_where_they_end() {
        // one unit up: the frame reaches from about 0 to 2 on the axis, so the lower half is not
        // seen
        let part = well_seen(&scene(), &cameras(1.0), Vec3::Y, 1.0 / 3.0);
        assert_eq!((part.max, part.min.x, part.min.z), (Vec3::ONE, -1.0, -1.0));
        assert!(part.min.y > -0.3 && part.min.y < 0.3, "{part:?}");
    }

    #[test]
    fn fewer_cameras_keep_more_of_a_body() {
        // five cameras look one unit higher than the other three, whose frames reach farther down
        let split: Vec<Camera> =
            cameras(1.5).into_iter().take(5).chain(cameras(0.5).into_iter().skip(5)).collect();
        let low = |share: f64| well_seen(&scene(), &split, Vec3::Y, share).min.y;
        // three of eight are the least of either share; more than half are those that look higher
        assert_eq!(low(0.25), low(0.375));
        assert!(low(0.25) + 0.5 < low(0.6), "{} {}", low(0.25), low(0.6));
    }
}
