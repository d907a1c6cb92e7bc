//! What a model's files hold.

use super::super::lens::LensModel;
use glam::DVec3;
use std::collections::HashMap;

/// Every file of a model.
#[derive(Debug, Default)]
pub(super) struct Model {
    pub cameras: HashMap<u32, Camera>,
    pub images: Vec<Image>,
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

impl From<[f64; 7]> for Rigid {
    fn from([w, qx, qy, qz, x, y, z]: [f64; 7]) -> Rigid {
        Rigid { quaternion: [w, qx, qy, qz], translation: DVec3::new(x, y, z) }
    }
}
