//! What a model's files hold.

use super::super::lens::LensModel;
use glam::DVec3;
use std::collections::HashMap;

/// Kind of a sensor that takes images.
pub(super) const CAMERA: i32 = 0;

/// Every file of a model.
#[derive(Debug, Default)]
pub(super) struct Model {
    pub cameras: HashMap<u32, Camera>,
    pub images: Vec<Image>,
    pub rigs: Vec<Rig>,
    pub frames: Vec<Frame>,
    /// Those that were found, where they are given.
    pub points: Option<Vec<DVec3>>,
}

/// One lens, shared by images.
#[derive(Clone, Debug)]
pub(super) struct Camera {
    pub model: &'static LensModel,
    pub width: u64,
    pub height: u64,
    pub values: Vec<f64>,
}

/// One registered photograph.
#[derive(Clone, Debug)]
pub(super) struct Image {
    pub id: u32,
    /// Camera from world.
    pub pose: Rigid,
    pub camera: u32,
    pub name: String,
}

/// A rotation (w, x, y, z) and a translation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rigid {
    pub quaternion: [f64; 4],
    pub translation: DVec3,
}

impl Default for Rigid {
    fn default() -> Rigid {
        Rigid { quaternion: [1.0, 0.0, 0.0, 0.0], translation: DVec3::ZERO }
    }
}

impl From<[f64; 7]> for Rigid {
    fn from([w, qx, qy, qz, x, y, z]: [f64; 7]) -> Rigid {
        Rigid { quaternion: [w, qx, qy, qz], translation: DVec3::new(x, y, z) }
    }
}

/// Sensors that move together; the first one is where the rig is.
#[derive(Clone, Debug)]
pub(super) struct Rig {
    pub id: u32,
    /// Kind, number, sensor from rig.
    pub sensors: Vec<(i32, u32, Option<Rigid>)>,
}

/// A rig at a moment.
#[derive(Clone, Debug)]
pub(super) struct Frame {
    pub id: u32,
    pub rig: u32,
    /// Rig from world.
    pub pose: Rigid,
    /// Kind and number of the sensor, number of the image.
    pub data: Vec<(i32, u32, u32)>,
}
