//! An analytic ball to train on: what the tests of learned fields share.

use super::pixels::TrainView;
use crate::Monitor;
use crate::geom::{Camera, Distortion};
use crate::image::{Gray, Photo};
use crate::io::{Limits, TensorValues, Tensors, read_tensors, write_tensors};
use crate::kernel::march::Bitmask;
use glam::{DMat3, DVec3, Vec2, Vec3};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

const SIZE: u32 = 40;
/// Its radius.
pub const BALL: f32 = 0.6;

/// A red and green ball in front of a blue wall, seen from eight sides.
pub fn views() -> Vec<TrainView> {
    (0..8)
        .map(|i| view(i as f64 * std::f64::consts::TAU / 8.0, if i % 2 == 0 { 0.4 } else { -0.4 }))
        .collect()
}

fn view(azimuth: f64, elevation: f64) -> TrainView {
    let rotation = DMat3::from_rotation_y(azimuth) * DMat3::from_rotation_x(-elevation);
    let camera = Camera {
        width: SIZE,
        height: SIZE,
        fx: 60.0,
        fy: 60.0,
        cx: 20.0,
        cy: 20.0,
        distortion: Distortion::default(),
        rotation,
        position: rotation * DVec3::new(0.0, 0.0, 3.0),
    };
    let mut rgb = Vec::new();
    let mut alpha = Vec::new();
    for y in 0..SIZE {
        for x in 0..SIZE {
            let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).unwrap();
            let b = ray.origin.dot(ray.direction);
            let discriminant = b * b - ray.origin.length_squared() + BALL * BALL;
            if discriminant > 0.0 {
                let p = ray.at(-b - discriminant.sqrt());
                rgb.push(if p.y > 0.0 { [200, 40, 30] } else { [40, 180, 60] });
                alpha.push(255);
            } else {
                rgb.push([30, 30, 220]);
                alpha.push(0);
            }
        }
    }
    TrainView {
        camera,
        photo: Photo { width: SIZE, height: SIZE, rgb, alpha: None },
        mask: Some(Gray { width: SIZE, height: SIZE, values: alpha }),
        valid: None,
    }
}

pub fn hull() -> Bitmask {
    let r = 32;
    let mut hull = Bitmask::filled(r, false);
    for i in 0..r * r * r {
        let c = Vec3::from_array([i / (r * r), i / r % r, i % r].map(|c| (c as f32 + 0.5) / 16.0 - 1.0));
        hull.set(i, c.length() < BALL + 0.1);
    }
    hull
}

pub fn temporary() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

/// Asks to stop after so many steps.
pub struct StopAfter(AtomicU64);

impl StopAfter {
    pub fn new(steps: u64) -> StopAfter {
        StopAfter(AtomicU64::new(steps))
    }
}

impl Monitor for StopAfter {
    fn step(&self, _: u64, _: u64, _: &[(&str, f64)]) {
        self.0.fetch_sub(1, Ordering::SeqCst);
    }
    fn stop(&self) -> bool {
        self.0.load(Ordering::SeqCst) == 0
    }
}

/// Writes the newest checkpoint of a stage folder again, with a change.
pub fn tampered(dir: &Path, change: impl FnOnce(&mut Tensors)) {
    let path = super::checkpoint::newest(dir);
    let mut all = read_tensors(&path, &Limits::default()).unwrap();
    change(&mut all);
    let tensors: Vec<_> = all.0.into_iter().map(|(name, (shape, values))| (name, shape, values)).collect();
    write_tensors(&path, &tensors, &all.1).unwrap();
}

/// A change that makes a number of the metadata this one.
pub fn says(key: &str, value: &str) -> impl Fn(&mut Tensors) {
    move |(_, metadata)| drop(metadata.insert(key.into(), value.into()))
}

/// A change that makes the first value of a tensor negative.
pub fn negative(name: &str) -> impl Fn(&mut Tensors) {
    move |(tensors, _)| match &mut tensors.get_mut(name).unwrap().1 {
        TensorValues::F32(values) => values[0] = -1.0,
        other => panic!("{name}: {other:?}"),
    }
}
