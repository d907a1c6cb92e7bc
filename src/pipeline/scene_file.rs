//! `mask/scene.json` and `cameras.json`: where the head is, kept between stages and for other programs.

use crate::capture::scene::{Hull, Scene};
use crate::capture::{Capture, View};
use crate::geom::{Aabb, Similarity};
use crate::io::{self, Limits, ReadError, WriteError};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::path::Path;

#[derive(Serialize, Deserialize)]
struct SceneFile {
    scene_from_world: Similarity,
    aabb: Aabb,
    hull: Option<Hull>,
}

/// Writes a scene with its hull.
pub(super) fn write_scene(path: &Path, scene: &Scene) -> Result<(), WriteError> {
    let file =
        SceneFile { scene_from_world: scene.scene_from_world, aabb: scene.aabb, hull: scene.hull.clone() };
    let text = serde_json::to_vec(&file)
        .map_err(|e| WriteError::Content { path: path.into(), problem: e.to_string() })?;
    io::write_atomic(path, &text)
}

/// Reads what [`write_scene`] wrote.
pub(super) fn read_scene(path: &Path) -> Result<Scene, ReadError> {
    let value = io::read_json(path, &Limits::default())?;
    let wrong = |problem: String| ReadError::Json { path: path.into(), line: 1, column: 1, problem };
    let file: SceneFile = serde_json::from_value(value).map_err(|e| wrong(e.to_string()))?;
    if let Some(hull) = &file.hull
        && hull.resolution.checked_pow(3).map(|n| n.div_ceil(64)) != Some(hull.bits.len())
    {
        return Err(wrong(format!("a hull of {}³ cells in {} words", hull.resolution, hull.bits.len())));
    }
    Ok(Scene { scene_from_world: file.scene_from_world, aabb: file.aabb, hull: file.hull })
}

/// The text of `cameras.json`: every view with split, intrinsics and pose, and how the scene sits in
/// the world.
pub(super) fn cameras_json(capture: &Capture, scene: &Scene) -> Vec<u8> {
    let value = json!({
        "capture": capture.name,
        "format": capture.format,
        "up": capture.up.to_array(),
        "unit_m": capture.unit_m,
        "scene_from_world": scene.scene_from_world,
        "world_from_scene": scene.scene_from_world.inverse(),
        "views": capture.views,
    });
    format!("{value:#}\n").into_bytes()
}

#[derive(Deserialize)]
struct CamerasFile {
    capture: String,
    format: String,
    up: Vec3,
    unit_m: f64,
    views: Vec<View>,
}

/// Reads the capture that [`cameras_json`] was written of; `root` is where its photographs were.
pub(super) fn read_capture(path: &Path, root: &Path) -> Result<Capture, ReadError> {
    let value = io::read_json(path, &Limits::default())?;
    let wrong = |problem: String| ReadError::Json { path: path.into(), line: 1, column: 1, problem };
    let file: CamerasFile = serde_json::from_value(value).map_err(|e| wrong(e.to_string()))?;
    if file.views.is_empty() {
        return Err(wrong("there are no views".into()));
    }
    Ok(Capture {
        root: root.into(),
        name: file.capture,
        format: file.format,
        reasons: Vec::new(),
        views: file.views,
        up: file.up,
        unit_m: file.unit_m,
        warnings: Vec::new(),
    })
}
