use super::*;
use glam::{DMat3, DVec3};
use std::f32::consts::TAU;
use tiface_base::math::rng;

const SIZE: usize = 96;

/// Returns a camera that looks at the origin from a direction, at distance 3: a pixel at the origin
/// is 3 / 150 = 0.02 long.
fn camera_from(from: DVec3) -> Camera {
    let back = from.normalize();
    let right = DVec3::Y.cross(back).normalize();
    let rotation = DMat3::from_cols(right, back.cross(right), back);
    Camera { rotation, position: 3.0 * back, ..Camera::above(SIZE as u32, SIZE as u32, 150.0, 0.0) }
}

fn cameras() -> Vec<Camera> {
    let at = |i: usize| {
        let a = i as f64 * f64::from(TAU) / 6.0;
        camera_from(DVec3::new(0.5 * a.cos(), 0.5 * a.sin(), 1.0))
    };
    (0..6).map(at).chain([camera_from(DVec3::new(0.05, 0.0, 1.0))]).collect()
}

/// Returns the brightness of a texture of waves with lengths of four to twelve pixels in all
/// directions.
fn texture(seed: u64, p: Vec3) -> f32 {
    let wave = |i: u64| {
        let (angle, phase) = (TAU * rng::uniform(seed, 1, i), TAU * rng::uniform(seed, 2, i));
        let length = 0.02 * (4.0 + 8.0 * rng::uniform(seed, 3, i));
        (TAU / length * (p.x * angle.cos() + p.y * angle.sin()) + phase).sin()
    };
    0.4 + 0.03 * (0..12).map(wave).sum::<f32>()
}

/// Renders photographs of `color` on the surface with the given height over (x, y), with noise,
/// gain and offset.
fn photographs(
    cameras: &[Camera],
    height: impl Fn(f32, f32) -> f32,
    color: impl Fn(usize, Vec3) -> f32,
) -> Vec<StereoView> {
    let view = |(v, camera): (usize, &Camera)| {
        let mut depth = Vec::new();
        let gray = (0..SIZE * SIZE)
            .map(|i| {
                let (x, y) = (i % SIZE, i / SIZE);
                let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).unwrap();
                // the surface is flat enough for a fixed-point iteration to find the hit
                let mut p = ray.at(-ray.origin.z / ray.direction.z);
                for _ in 0..20 {
                    p = ray.at((height(p.x, p.y) - ray.origin.z) / ray.direction.z);
                }
                if x % 4 == 2 && y % 4 == 2 {
                    depth.push(camera.project(p).unwrap().1);
                }
                let noise = rng::normal(9, v as u64, i as u64) / 255.0;
                (0.7 + 0.1 * v as f32) * color(v, p) + 0.02 * v as f32 + noise
            })
            .collect();
        StereoView { camera: camera.clone(), gray, usable: vec![true; SIZE * SIZE], cell: 4, depth }
    };
    cameras.iter().enumerate().map(view).collect()
}

/// Returns surfels two pixels apart, `off` pixels above the plane, with normals that are tilted
/// against it.
fn surfels(off: f32) -> Vec<Surfel> {
    let normal = Vec3::new(0.1, -0.08, 1.0).normalize();
    let at = |i: usize| Vec3::new((i % 15) as f32 * 0.04 - 0.28, (i / 15) as f32 * 0.04 - 0.28, off * 0.02);
    (0..225).map(|i| Surfel { position: at(i), normal }).collect()
}

/// Returns the median error in pixels, and the number of points.
fn median(points: &[StereoPoint], height: impl Fn(f32, f32) -> f32) -> (f32, usize) {
    let off = |p: &StereoPoint| ((p.position.z - height(p.position.x, p.position.y)) / 0.02).abs();
    let mut off: Vec<f32> = points.iter().map(off).collect();
    off.sort_by(f32::total_cmp);
    (off.get(off.len() / 2).copied().unwrap_or(f32::NAN), off.len())
}

#[test]
fn a_plane_is_found_to_a_tenth_of_a_pixel_whatever_gain_and_offset() {
    let cameras = cameras();
    let views = photographs(&cameras, |_, _| 0.0, |_, p| texture(1, p));
    for off in [-2.0, 1.5] {
        let found = matches(&views, &surfels(off));
        let (error, count) = median(&found, |_, _| 0.0);
        assert!(count > 200 && error < 0.05, "{count} points, {error} px");
        // normals become those of the plane: the initial ones are 7 degrees off
        let upright = found.iter().filter(|p| p.normal.z > 0.9986).count();
        assert!(upright > 180, "{upright} within 3 degrees");
        let kept = confirmed(&found, 0.04);
        assert!(kept.len() > 190 && kept.iter().all(|p| p.position.z.abs() < 0.01), "{}", kept.len());
    }
}

#[test]
fn a_curved_surface_is_found_too() {
    // a sphere of radius 2, 100 pixels; a flat patch lies some 0.1 pixels inside it
    let height = |x: f32, y: f32| (4.0 - x * x - y * y).sqrt() - 2.0;
    let cameras = cameras();
    let views = photographs(&cameras, height, |_, p| texture(2, p));
    let surfels: Vec<Surfel> = surfels(1.0)
        .iter()
        .map(|s| {
            let (x, y) = (s.position.x, s.position.y);
            let normal = Vec3::new(x, y, height(x, y) + 2.0).normalize();
            Surfel { position: Vec3::new(x, y, height(x, y)) + 0.02 * normal, normal }
        })
        .collect();
    let (error, count) = median(&matches(&views, &surfels), height);
    assert!(count > 200 && error < 0.12, "{count} points, {error} px");
}

#[test]
fn without_texture_or_with_another_in_every_photograph_nothing_is_found() {
    let cameras = cameras();
    let flat = photographs(&cameras, |_, _| 0.0, |_, _| 0.5);
    let others = photographs(&cameras, |_, _| 0.0, |v, p| texture(10 + v as u64, p));
    for views in [flat, others] {
        assert_eq!(confirmed(&matches(&views, &surfels(0.5)), 0.04), []);
    }
}

#[test]
fn a_photograph_of_something_else_is_left_out() {
    let cameras = cameras();
    let views = photographs(&cameras, |_, _| 0.0, |v, p| texture(if v == 2 { 7 } else { 1 }, p));
    let (error, count) = median(&matches(&views, &surfels(1.5)), |_, _| 0.0);
    assert!(count > 150 && error < 0.06, "{count} points, {error} px");
    // without four of seven photographs too few remain, except where another fits by chance
    let views = photographs(&cameras, |_, _| 0.0, |v, p| texture(if v > 2 { 7 + v as u64 } else { 1 }, p));
    let left = confirmed(&matches(&views, &surfels(1.5)), 0.04).len();
    assert!(left < 22, "{left} of 225");
}

#[test]
fn an_unoccluded_point_is_visible_and_owned_by_its_most_frontal_view() {
    let cameras = cameras();
    let mut views = photographs(&cameras, |_, _| 0.0, |_, p| texture(1, p));
    let s = Surfel { position: Vec3::ZERO, normal: Vec3::Z };
    assert_eq!(visible_in(&views, &s).len(), 7);
    assert_eq!(visible_in(&views, &s)[0], 6);
    // a pixel is 3 / 150
    assert!((owned_footprint(&views, 6, &s).unwrap() - 0.02).abs() < 1e-4);
    assert_eq!(owned_footprint(&views, 0, &s), None);
    // an occluder lies 0.5 before the point; the tolerance is 5 + 6 pixels, 0.22
    views[6].depth.iter_mut().for_each(|d| *d -= 0.5);
    assert!(!visible_in(&views, &s).contains(&6));
    // a pixel that is not usable
    views[3].usable.fill(false);
    assert_eq!(visible_in(&views, &s).len(), 5);
    // a surfel that faces away
    assert!(visible_in(&views, &Surfel { normal: -Vec3::Z, ..s }).is_empty());
}

#[test]
fn a_point_that_its_neighbors_contradict_is_dropped() {
    let point = |i: usize| StereoPoint {
        position: Vec3::new((i % 5) as f32, (i / 5) as f32, if i == 12 { 2.0 } else { 0.0 }),
        normal: Vec3::Z,
        footprint: 0.5,
        sigma: 0.5,
    };
    let points: Vec<StereoPoint> = (0..25).map(point).collect();
    let kept = confirmed(&points, 1.0);
    assert_eq!(kept.len(), 24);
    assert!(kept.iter().all(|p| p.position.z == 0.0));
    // points with too few neighbors are not confirmed
    assert_eq!(confirmed(&points[..3], 1.0), []);
}

#[test]
fn the_peak_of_a_parabola() {
    // 1 − (x − 0.25)² at −1, 0, 1
    assert_eq!(steps_to_peak([-0.5625, 0.9375, 0.4375]), 0.25);
    assert_eq!(steps_to_peak([0.0, 0.5, 0.9]), 1.0);
    let (offset, value, curvature) = parabola([-0.5625, 0.9375, 0.4375], 1.0).unwrap();
    assert_eq!((offset, value, curvature), (0.25, 1.0, 2.0));
    assert_eq!(parabola([0.0, 0.5, 0.6], 1.0), None);
    assert_eq!(parabola([0.5, 0.5, 0.5], 1.0), None);
}
