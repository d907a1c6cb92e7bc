//! `mask/scene.json` and `cameras.json`: where the head is, kept for later stages and for other
//! programs.

use super::cameras::CameraCheck;
use super::exposure::ExposureCheck;
use glam::Vec3;
use serde::Deserialize;
use serde_json::json;
use std::path::Path;
use tiface_base::Result;
use tiface_base::geom::{Aabb, BitGrid};
use tiface_base::io::{self, Limits, ReadError, WriteError};
use tiface_capture::scene::Scene;
use tiface_capture::{Capture, View};

/// Maximum number of cells along an axis of a hull; the stage makes 128.
const MAX_CELLS: usize = 1024;

/// Writes a scene with its hull.
pub(super) fn write_scene(path: &Path, scene: &Scene) -> Result<(), WriteError> {
    let text = serde_json::to_vec(scene).map_err(|e| WriteError::content(path, e.to_string()))?;
    io::write_atomic(path, &text)
}

/// Reads the file of [`write_scene`]; content that it cannot have written is refused with its key.
pub(super) fn read_scene(path: &Path) -> Result<Scene, ReadError> {
    let mut scene: Scene = io::read_typed(path, &Limits::default())?;
    let wrong = |key: &str, found: String, expected: &str| Err(ReadError::value(path, key, found, expected));
    if let Some((part, found, expected)) = scene.scene_from_world.problem() {
        return wrong(&format!("scene_from_world.{part}"), found, expected);
    }
    let Aabb { min, max } = scene.aabb;
    // the published box of radiance fields is larger than I-Face's
    if !(min.cmplt(max).all() && Aabb::SCENE.grown(1.0).contains(min) && Aabb::SCENE.grown(1.0).contains(max))
    {
        return wrong("aabb", format!("{min} to {max}"), "a box within -2 and 2, its lowest corner first");
    }
    if let Some(BitGrid { resolution, bits }) = scene.hull.take() {
        if !(2..=MAX_CELLS).contains(&resolution) {
            return wrong("hull.resolution", resolution.to_string(), &format!("2 to {MAX_CELLS}"));
        }
        let found = bits.len();
        let Some(hull) = BitGrid::from_words(resolution, bits) else {
            let expected = format!("{}, for {resolution}³ cells", resolution.pow(3).div_ceil(64));
            return wrong("hull.bits", format!("{found} words"), &expected);
        };
        if hull.count() == 0 {
            return wrong("hull.bits", "0 everywhere".into(), "at least one cell of the head");
        }
        scene.hull = Some(hull);
    }
    Ok(scene)
}

/// Returns the text of `cameras.json`: every view with split, intrinsics and pose, and the
/// transform from the world to the scene. `check` adds how well the poses fit, and the refined
/// ones, and `exposure` how the exposures differ.
pub(super) fn cameras_json(
    capture: &Capture,
    scene: &Scene,
    check: Option<&CameraCheck>,
    exposure: Option<&ExposureCheck>,
) -> Vec<u8> {
    let mut value = json!({
        "capture": capture.name,
        "format": capture.format,
        "up": capture.up.to_array(),
        "unit_m": capture.unit_m,
        "scene_from_world": scene.scene_from_world,
        "world_from_scene": scene.scene_from_world.inverse(),
        "views": capture.views,
    });
    if let Some(check) = check {
        value["fit"] = json!(check);
    }
    if let Some(exposure) = exposure {
        value["exposure"] = json!(exposure);
    }
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

/// Reads a capture from the text of [`cameras_json`]; `root` is the folder of its photographs.
pub(super) fn read_capture(path: &Path, root: &Path) -> Result<Capture, ReadError> {
    let file: CamerasFile = io::read_typed(path, &Limits::default())?;
    if file.views.is_empty() {
        return Err(ReadError::value(path, "views", "empty", "at least one view"));
    }
    for (k, view) in file.views.iter().enumerate() {
        // pictures are written under these names, so they must be safe
        let leads_out = view.name.split(['/', '\\']).any(|part| ["", ".", ".."].contains(&part));
        if leads_out || view.name.contains('\0') {
            let key = format!("views[{k}].name");
            return Err(ReadError::value(path, key, &view.name, "the name of a file in a folder"));
        }
    }
    Ok(Capture {
        root: root.into(),
        name: file.capture,
        format: file.format,
        reasons: Vec::new(),
        views: file.views,
        up: file.up,
        focus: None, // the scene is placed by now
        unit_m: file.unit_m,
        stray_masks: None,
        warnings: Vec::new(),
        readings: Vec::new(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3, Vec3};
    use serde_json::Value;
    use tiface_base::geom::Similarity;

    fn scene() -> Scene {
        let mut bits = vec![0; 8];
        bits[3] = 5;
        Scene {
            scene_from_world: Similarity {
                scale: 4.0,
                rotation: DMat3::from_rotation_z(0.3),
                translation: DVec3::new(1.0, -2.0, 5e6),
            },
            aabb: Aabb { min: Vec3::new(-1.0, -0.5, -0.7), max: Vec3::new(1.0, 0.6, 0.8) },
            hull: BitGrid::from_words(8, bits),
        }
    }

    /// Returns the error of reading a file after `change`.
    fn after(change: &dyn Fn(&mut Value)) -> Result<Scene, ReadError> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.json");
        write_scene(&path, &scene()).unwrap();
        let mut value = io::read_json(&path, &Limits::default()).unwrap();
        change(&mut value);
        std::fs::write(&path, value.to_string()).unwrap();
        read_scene(&path)
    }

    #[test]
    fn a_scene_is_read_back_as_it_was() {
        assert_eq!(after(&|_| {}).unwrap(), scene());
        assert_eq!(after(&|v| v["hull"] = Value::Null).unwrap().hull, None);
    }

    #[test]
    fn a_hostile_scene_is_refused_with_its_key() {
        let rows: [(&str, &dyn Fn(&mut Value)); 14] = [
            ("hull.resolution", &|v| v["hull"] = json!({"resolution": 0, "bits": []})),
            ("hull.resolution", &|v| v["hull"]["resolution"] = json!(1)),
            ("hull.resolution", &|v| v["hull"]["resolution"] = json!(u64::MAX)),
            ("hull.bits", &|v| v["hull"]["resolution"] = json!(9)),
            ("hull.bits", &|v| v["hull"]["bits"] = json!([0, 0, 0, 0, 0, 0, 0, 0])),
            ("scene_from_world.scale", &|v| v["scene_from_world"]["scale"] = json!(-1.0)),
            ("scene_from_world.scale", &|v| v["scene_from_world"]["scale"] = json!(0.0)),
            ("scene_from_world.scale", &|v| v["scene_from_world"]["scale"] = json!(1e-300)),
            ("scene_from_world.rotation", &|v| {
                v["scene_from_world"]["rotation"] = json!([0, 0, 0, 0, 0, 0, 0, 0, 0])
            }),
            ("scene_from_world.rotation", &|v| {
                v["scene_from_world"]["rotation"] = json!([-1, 0, 0, 0, 1, 0, 0, 0, 1])
            }),
            ("aabb", &|v| v["aabb"] = json!({"min": [1, 1, 1], "max": [-1, -1, -1]})),
            ("aabb", &|v| v["aabb"]["max"] = v["aabb"]["min"].clone()),
            ("aabb", &|v| v["aabb"]["max"][1] = json!(1e300)), // infinite in f32
            ("aabb", &|v| v["aabb"]["min"][2] = json!(-40.0)),
        ];
        for (i, (key, change)) in rows.iter().enumerate() {
            match after(change).unwrap_err() {
                ReadError::Value { path, key: named, .. } => {
                    assert!(named == *key && path.ends_with("scene.json"), "row {i}: {named}");
                }
                e => panic!("row {i}: {e}"),
            }
        }
        for key in ["scene_from_world", "aabb"] {
            let e = after(&|v| drop(v.as_object_mut().unwrap().remove(key))).unwrap_err();
            assert!(e.to_string().contains(key) && e.to_string().contains("scene.json"), "{e}");
        }
    }

    #[test]
    fn names_of_views_that_lead_out_of_a_folder_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cameras.json");
        let named = |name: &str| {
            let view = View::bare(name, tiface_base::geom::Camera::above(4, 4, 4.0, 3.0));
            let value =
                json!({"capture": "a", "format": "b", "up": [0, 0, 1], "unit_m": 1.0, "views": [view]});
            std::fs::write(&path, value.to_string()).unwrap();
            read_capture(&path, Path::new(""))
        };
        assert_eq!(named("a/b 1").unwrap().views.len(), 1);
        for name in ["../../a", "/a", "a/../b", "a//b", "..\\a", ".", "", "a\0"] {
            assert!(named(name).unwrap_err().to_string().contains("views[0].name"), "{name:?}");
        }
    }
}
