//! Cameras of novel views in a file.
//!
//! Two kinds of JSON are read: nerfstudio's camera path (`camera_path`, made in its viewer) and
//! `transforms.json` (`frames`). Both give camera-to-world matrices with OpenGL axes, as ours are,
//! and must be in the dataset's own world. A path from nerfstudio's viewer is only if its training
//! ran with `--orientation-method none --center-method none --auto-scale-poses False`.

use super::{NamedCamera, check_count, not_a_path};
use crate::transforms::camera_like;
use glam::{DMat3, DVec3};
use serde::Deserialize;
use serde_json::{Map, Value};
use tiface_base::Result;
use tiface_base::geom::{Camera, Distortion};

/// Largest side of a picture.
const MAX_SIDE: u32 = 16_384;

#[derive(Deserialize)]
struct PathFile {
    camera_path: Option<Vec<PathKey>>,
    camera_type: Option<String>,
    frames: Option<Vec<TransformsFrame>>,
    /// Size of the pictures, and intrinsics for all frames.
    #[serde(flatten)]
    numbers: Map<String, Value>,
}

#[derive(Deserialize)]
struct PathKey {
    camera_to_world: Vec<f64>,
    /// Vertical field of view, degrees.
    fov: Option<f64>,
}

#[derive(Deserialize)]
struct TransformsFrame {
    transform_matrix: Vec<Vec<f64>>,
    file_path: Option<String>,
    /// The frame's own intrinsics.
    #[serde(flatten)]
    numbers: Map<String, Value>,
}

/// Reads cameras from the text of a nerfstudio camera path or a `transforms.json`. Lens parameters
/// that the file lacks are taken from `like`.
///
/// # Errors
/// Fails if the text is neither, holds no cameras or too many, or if one of them is invalid.
pub fn from_json(text: &str, like: &Camera) -> Result<Vec<NamedCamera>> {
    let text = text.trim_start_matches('\u{feff}');
    let file: PathFile =
        serde_json::from_str(text).map_err(|e| not_a_path(format!("not a camera path: {e}")))?;
    let cameras: Vec<(Option<String>, Result<Camera, String>)> = match (&file.camera_path, &file.frames) {
        (Some(keys), _) => {
            check_count(keys.len())?;
            keys.iter().map(|key| (None, from_key(&file, key, like))).collect()
        }
        (None, Some(frames)) => {
            check_count(frames.len())?;
            frames.iter().map(|frame| (stem(frame), from_frame(&file.numbers, frame, like))).collect()
        }
        (None, None) => {
            let problem = "not a camera path: there is neither `camera_path` nor `frames`";
            return Err(not_a_path(problem.into()));
        }
    };
    let digits = cameras.len().to_string().len().max(4);
    let cameras = cameras.into_iter().enumerate().map(|(index, (name, camera))| {
        let name = name.unwrap_or_else(|| format!("{:0digits$}", index + 1));
        let camera = camera.map_err(|what| not_a_path(format!("camera {index}: {what}")))?;
        Ok(NamedCamera { name, camera })
    });
    cameras.collect()
}

/// Returns the photograph's name, without any path components.
fn stem(frame: &TransformsFrame) -> Option<String> {
    let last = frame.file_path.as_deref()?.rsplit(['/', '\\']).next()?;
    let stem = match last.rsplit_once('.') {
        Some((stem, _)) if !stem.is_empty() => stem,
        _ => last,
    };
    (!["", ".", ".."].contains(&stem)).then(|| stem.to_string())
}

fn from_key(file: &PathFile, key: &PathKey, like: &Camera) -> Result<Camera, String> {
    if let Some(kind) = file.camera_type.as_deref().filter(|k| *k != "perspective") {
        return Err(format!("is of type `{kind}`, expected `perspective`"));
    }
    let width = side(&file.numbers, "render_width", like.width)?;
    let height = side(&file.numbers, "render_height", like.height)?;
    let m = &key.camera_to_world;
    if m.len() != 16 && m.len() != 12 {
        return Err(format!("`camera_to_world` has {} numbers, expected 16", m.len()));
    }
    let rows: Vec<Vec<f64>> = m.chunks_exact(4).map(<[f64]>::to_vec).collect();
    let focal = match key.fov {
        Some(fov) if fov > 0.0 && fov < 179.0 => height as f64 / 2.0 / (fov.to_radians() / 2.0).tan(),
        Some(fov) => return Err(format!("`fov` is {fov}, expected degrees between 0 and 179")),
        None => like.fy * height as f64 / like.height as f64,
    };
    let (rotation, position) = pose(&rows)?;
    Ok(Camera {
        width,
        height,
        fx: focal,
        fy: focal,
        cx: width as f64 / 2.0,
        cy: height as f64 / 2.0,
        distortion: Distortion::default(),
        rotation,
        position,
    })
}

fn from_frame(shared: &Map<String, Value>, frame: &TransformsFrame, like: &Camera) -> Result<Camera, String> {
    let camera = camera_like(shared, &frame.numbers, like, pose(&frame.transform_matrix)?)?;
    match camera.width.max(camera.height) {
        ..=MAX_SIDE => Ok(camera),
        side => Err(format!("its picture has {side} pixels on a side, expected 1 to {MAX_SIDE}")),
    }
}

fn side(object: &Map<String, Value>, name: &str, other: u32) -> Result<u32, String> {
    match object.get(name).filter(|v| !v.is_null()) {
        None => Ok(other),
        Some(v) => match v.as_f64() {
            Some(v) if v.fract() == 0.0 && (1.0..=MAX_SIDE as f64).contains(&v) => Ok(v as u32),
            _ => Err(format!("`{name}` is {v}, expected 1 to {MAX_SIDE} pixels")),
        },
    }
}

/// Returns rotation and position of a camera-to-world matrix of 3 or 4 rows. A uniform scale, which
/// viewers leave in, is divided out.
fn pose(rows: &[Vec<f64>]) -> Result<(DMat3, DVec3), String> {
    if !(3..=4).contains(&rows.len()) || rows.iter().any(|r| r.len() != 4) {
        return Err("its matrix is not 4 × 4".into());
    }
    if rows.iter().flatten().any(|v| !v.is_finite()) {
        return Err("its matrix is not finite".into());
    }
    let column = |k: usize| DVec3::new(rows[0][k], rows[1][k], rows[2][k]);
    let matrix = DMat3::from_cols(column(0), column(1), column(2));
    let scale = matrix.determinant().cbrt();
    let rotation = matrix * (1.0 / scale);
    let off = rotation.transpose() * rotation - DMat3::IDENTITY;
    let is_rotation = scale > 1e-9 && off.to_cols_array().iter().all(|v| v.abs() < 1e-3);
    if !is_rotation {
        return Err("its matrix is not a rotation: mirrored, sheared or flat".into());
    }
    Ok((rotation, column(3)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::path::tests::like;
    use tiface_base::geom::Projection;

    #[test]
    fn a_nerfstudio_path_gives_its_cameras() {
        let text = r#"{"camera_type": "perspective", "render_height": 1080, "render_width": 1920, "fps": 24,
            "camera_path": [{"camera_to_world": [0,0,1,5, 1,0,0,6, 0,1,0,7, 0,0,0,1], "fov": 90, "aspect": 1}]}"#;
        let path = from_json(text, &like()).unwrap();
        let c = &path[0].camera;
        assert_eq!((c.width, c.height, path[0].name.as_str()), (1920, 1080, "0001"));
        // half the height over tan 45°
        assert!((c.fx - 540.0).abs() < 1e-9 && c.fx == c.fy && c.cx == 960.0);
        assert_eq!(c.position, DVec3::new(5.0, 6.0, 7.0));
        assert!(c.rotation.x_axis.distance(DVec3::Y) < 1e-12);
        let sphere = text.replace("perspective", "equirectangular");
        assert_eq!(
            from_json(&sphere, &like()).unwrap_err().to_string(),
            "camera 0: is of type `equirectangular`, expected `perspective`"
        );
    }

    #[test]
    fn transforms_json_gives_names_and_each_frames_own_lens() {
        let eye = "[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]";
        let text = format!(
            r#"{{"w": 100, "h": 50, "camera_angle_x": 1.5707963267948966, "k1": 0.2, "frames": [
            {{"file_path": "./images/cam_01.jpg", "transform_matrix": {eye}}},
            {{"file_path": "b", "fl_x": 70, "fl_y": 80, "cx": 40.5, "transform_matrix": {eye}}}]}}"#
        );
        let path = from_json(&text, &like()).unwrap();
        assert_eq!((path[0].name.as_str(), path[1].name.as_str()), ("cam_01", "b"));
        let (a, b) = (&path[0].camera, &path[1].camera);
        assert!((a.fx - 50.0).abs() < 1e-9 && a.fy == a.fx && a.cx == 50.0 && a.distortion.k1 == 0.2);
        assert_eq!((b.fx, b.fy, b.cx, b.cy), (70.0, 80.0, 40.5, 25.0));
        // a frame's own angle wins over the file's focal length: 50 / tan 45°
        let angle = text.replacen("\"w\"", "\"fl_x\": 10, \"w\"", 1).replace(
            "\"file_path\": \"b\", \"fl_x\": 70, \"fl_y\": 80",
            "\"camera_angle_x\": 1.5707963267948966",
        );
        assert!((from_json(&angle, &like()).unwrap()[1].camera.fx - 50.0).abs() < 1e-9);
        // every lens that captures may have
        let fisheye = text.replacen("\"w\"", "\"camera_model\": \"OPENCV_FISHEYE\", \"k4\": 0.3, \"w\"", 1);
        let lens = from_json(&fisheye, &like()).unwrap()[0].camera.distortion;
        assert_eq!((lens.projection, lens.k1, lens.k4), (Projection::Fisheye, 0.2, 0.3));
        // a file without a lens takes ours
        let bare = format!(r#"{{"frames": [{{"transform_matrix": {eye}}}]}}"#);
        let c = &from_json(&bare, &like()).unwrap()[0].camera;
        assert_eq!((c.fx, c.cx, c.distortion.k1, c.width), (500.0, 190.0, 0.1, 400));
    }

    #[test]
    fn crooked_files_are_named_errors() {
        let frames = |m: &str| format!(r#"{{"frames": [{{"transform_matrix": {m}}}]}}"#);
        for (text, part) in [
            ("[1, 2".to_string(), "not a camera path"),
            ("{}".to_string(), "neither"),
            (r#"{"frames": []}"#.to_string(), "0 cameras"),
            (frames("[[1,0],[0,1]]"), "not 4 × 4"),
            (frames("[[1,0,0,0],[0,1,0,0],[0,0,-1,0]]"), "not a rotation"),
            (frames("[[0,0,0,0],[0,0,0,0],[0,0,0,0]]"), "not a rotation"),
            (r#"{"camera_path": [{"camera_to_world": [1, 2]}]}"#.to_string(), "2 numbers"),
            (
                r#"{"render_width": 1e9, "camera_path": [{"camera_to_world": []}]}"#.to_string(),
                "render_width",
            ),
        ] {
            let message = from_json(&text, &like()).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
    }
}
