//! `transforms.json` and its split forms: the dialects of NeRF-Blender, instant-ngp and nerfstudio.
//!
//! Poses are camera-to-world with OpenGL axes in all three. Intrinsics may stand at the top or in each
//! frame; a frame's own win. Unknown keys are ignored, `null` counts as absent; known ones of the wrong type are
//! errors, but for [`LENIENT_KEYS`] and `up`, which count as absent as well.

use super::folder::{CaptureFolder, in_file, in_frame};
use super::frame::{self, CameraFrame, Intrinsics, LensModel, Listing};
use super::view::Split;
use crate::Result;
use crate::geom::{Camera, Distortion};
use crate::io;
use glam::{DMat3, DVec3};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::collections::HashSet;

type Object = Map<String, Value>;

/// Keys of the focal length. A frame that has one of them takes none from the top, or its own angle would be overruled by
/// the whole file's focal length.
const FOCAL_KEYS: [&str; 4] = ["fl_x", "fl_y", "camera_angle_x", "camera_angle_y"];

/// The other keys that may stand at the top for all frames.
const SHARED_KEYS: &str = "w h cx cy k1 k2 k3 k4 k5 k6 p1 p2 sx1 sy1 omega is_fisheye camera_model";

/// Keys that count as absent where their value is of another type, and whether it is of theirs.
const LENIENT_KEYS: [(&str, fn(&Value) -> bool); 3] = [
    ("is_fisheye", Value::is_boolean),
    ("camera_model", Value::is_string),
    ("face_mask_path", Value::is_string),
];

/// What is read at the top of a file, besides frames, intrinsics and `up`.
#[derive(Default, Deserialize)]
#[serde(default)]
struct TopKeys {
    // nerfstudio's splits
    train_filenames: Option<HashSet<String>>,
    val_filenames: Option<HashSet<String>>,
    test_filenames: Option<HashSet<String>>,
}

impl TopKeys {
    fn split(&self, name: &str) -> Option<Split> {
        let lists = [
            (&self.train_filenames, Split::Train),
            (&self.val_filenames, Split::Val),
            (&self.test_filenames, Split::Test),
        ];
        let has = |names: &Option<HashSet<String>>| names.as_ref().is_some_and(|names| names.contains(name));
        lists.iter().find(|(names, _)| has(names)).map(|(_, split)| *split)
    }
}

/// What is read of a frame, intrinsics from the top included.
#[derive(Default, Deserialize)]
#[serde(default)]
struct FrameKeys {
    file_path: String,
    transform_matrix: Vec<Vec<f64>>,
    split: Option<String>,
    mask_path: Option<String>,
    face_mask_path: Option<String>,
    w: Option<f64>,
    h: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    k1: f64,
    k2: f64,
    k3: f64,
    k4: f64,
    k5: f64,
    k6: f64,
    p1: f64,
    p2: f64,
    sx1: f64,
    sy1: f64,
    omega: f64,
    is_fisheye: bool,
    camera_model: Option<String>,
}

impl FrameKeys {
    fn read(top: &Object, entry: &Value) -> Result<FrameKeys, String> {
        let own = entry.as_object().ok_or("it is not a JSON object")?;
        for key in ["file_path", "transform_matrix"] {
            if own.get(key).is_none_or(Value::is_null) {
                return Err(format!("it has no `{key}`"));
            }
        }
        FrameKeys::merged(top, own)
    }

    fn merged(top: &Object, own: &Object) -> Result<FrameKeys, String> {
        let own_focal = FOCAL_KEYS.iter().any(|key| own.contains_key(*key));
        let shared = SHARED_KEYS.split(' ').chain(FOCAL_KEYS.into_iter().filter(|_| !own_focal));
        let shared = shared.filter_map(|key| top.get_key_value(key));
        let is_given =
            |(key, value): &(&String, &Value)| match LENIENT_KEYS.iter().find(|(name, _)| key == name) {
                Some((_, is_usable)) => is_usable(value),
                None => !value.is_null(),
            };
        let merged: Object = (shared.filter(is_given).chain(own.iter().filter(is_given)))
            .map(|(key, value)| (key.clone(), value.clone()))
            .collect();
        io::typed(&Value::Object(merged))
            .map_err(|[key, found, expected]| format!("its `{key}` is {found}, expected {expected}"))
    }
}

/// Lists the frames of `files`, in order; everything wrong goes to the listing's problems.
pub(super) fn list(folder: &CaptureFolder, files: &[&str], listing: &mut Listing) {
    for file in files {
        if let Err(problem) = list_file(folder, file, listing) {
            listing.problems.push(problem);
        }
    }
}

fn list_file(folder: &CaptureFolder, file: &str, listing: &mut Listing) -> Result<()> {
    let limits = &folder.options.limits;
    let path = folder.root.join(file);
    let value = io::read_json(&path, limits)?;
    let Some(top) = value.as_object() else {
        return Err(in_file(file, "it is not a JSON object", "it must begin with `{`"));
    };
    let Some(frames) = top.get("frames").and_then(Value::as_array) else {
        let hint = "each entry of `frames` describes one photograph";
        return Err(in_file(file, "it has no list `frames`", hint));
    };
    if frames.is_empty() {
        let hint = "it must describe at least one photograph";
        return Err(in_file(file, "its list `frames` is empty", hint));
    }
    limits.check_views(&path, frames.len())?;
    let about: TopKeys = io::typed(&value).map_err(|[key, found, expected]| {
        in_file(
            file,
            format_args!("`{key}` is {found}, expected {expected}"),
            "it must be a list of file names",
        )
    })?;
    if top.contains_key("applied_transform") || top.contains_key("applied_scale") {
        listing.reasons.push(format!(
            "`{file}` says its world was moved (`applied_transform`): results come out in the moved world"
        ));
    }
    let up = top.get("up").and_then(|up| match io::typed::<Vec<f64>>(up).ok()?.as_slice() {
        &[x, y, z, ..] => DVec3::new(x, y, z).try_normalize(),
        _ => None,
    });
    listing.up = listing.up.or(up);
    let split_of_file = match file {
        "transforms_train.json" => Some(Split::Train),
        "transforms_val.json" => Some(Split::Val),
        "transforms_test.json" => Some(Split::Test),
        _ => None,
    };
    let mut ignored = Vec::new();
    for (i, entry) in frames.iter().enumerate() {
        let name = entry.get("file_path").and_then(Value::as_str);
        let number = format!("#{i}");
        let problem = |text: String| in_frame(file, name.unwrap_or(&number), text);
        let frame = FrameKeys::read(top, entry).map_err(problem).and_then(|keys| {
            let split = split_of_file.or(about.split(&keys.file_path));
            let pose =
                upper_rows(&keys.transform_matrix).and_then(|rows| frame::pose(&rows)).map_err(problem)?;
            let split = named_split(keys.split.as_deref(), split).map_err(problem)?;
            let intrinsics = intrinsics(&keys, &mut ignored).map_err(problem)?;
            let photo = folder.photo(file, &keys.file_path)?;
            let beside = |name: &Option<String>| -> Result<_> {
                let named = name.as_ref().map(|name| folder.relative(file, name)).transpose()?;
                Ok(named.and_then(|name| folder.file(&name)))
            };
            let mask = keys.mask_path.as_ref().map(|name| folder.mask(file, name)).transpose()?.flatten();
            let region = beside(&keys.face_mask_path)?;
            if keys.mask_path.is_some() && mask.is_none() && photo.1.is_some() {
                listing.problems.push(problem("the mask it names is missing".into()));
            }
            let frame = CameraFrame::new(file, &keys.file_path, photo, intrinsics, pose);
            Ok(CameraFrame { split, mask, region, ..frame })
        });
        match frame {
            Ok(frame) => listing.frames.push(frame),
            Err(problem) => listing.problems.push(problem),
        }
    }
    ignored.sort();
    ignored.dedup();
    for model in ignored {
        listing.warnings.push(format!(
            "`{file}` gives distortion for the camera model `{model}`, which has none; it is not used"
        ));
    }
    Ok(())
}

/// Returns the camera of a frame, whose pose is known. What neither it nor the top of its file says of the lens is as
/// `like` has it.
pub(crate) fn camera_like(
    top: &Object,
    own: &Object,
    like: &Camera,
    (rotation, position): (DMat3, DVec3),
) -> Result<Camera, String> {
    let lens = intrinsics(&FrameKeys::merged(top, own)?, &mut Vec::new())?;
    let size = lens.size.unwrap_or((like.width, like.height));
    if lens.focal.iter().chain(&lens.angle).any(Option::is_some) {
        return lens.camera(size, rotation, position);
    }
    let like = like.resized(size.0, size.1);
    let [cx, cy] = [lens.center[0].unwrap_or(like.cx), lens.center[1].unwrap_or(like.cy)];
    let distortion = if lens.distortion.is_none() { like.distortion } else { lens.distortion };
    Ok(Camera { cx, cy, distortion, rotation, position, ..like })
}

/// Returns the split a frame names, else the one it is in otherwise.
fn named_split(name: Option<&str>, otherwise: Option<Split>) -> Result<Option<Split>, String> {
    match name {
        None => Ok(otherwise),
        Some("train") => Ok(Some(Split::Train)),
        Some("val" | "eval" | "validation") => Ok(Some(Split::Val)),
        Some("test") => Ok(Some(Split::Test)),
        Some(other) => Err(format!("its split is `{other}`; known are train, val, test")),
    }
}

/// Returns the upper three rows of a 3×4 or 4×4 matrix.
fn upper_rows(matrix: &[Vec<f64>]) -> Result<[[f64; 4]; 3], String> {
    let rows: Option<Vec<[f64; 4]>> = matrix.iter().map(|row| row.as_slice().try_into().ok()).collect();
    let ([a, b, c], last) = match rows.as_deref() {
        Some(&[a, b, c]) => ([a, b, c], [0.0, 0.0, 0.0, 1.0]),
        Some(&[a, b, c, last]) => ([a, b, c], last),
        _ => return Err("its `transform_matrix` is not 4 × 4 or 3 × 4 numbers".into()),
    };
    if last[..3].iter().any(|v| v.abs() > 1e-6) || (last[3] - 1.0).abs() > 1e-6 {
        return Err(format!("the last row of its `transform_matrix` is {last:?}, not 0 0 0 1"));
    }
    Ok([a, b, c])
}

fn intrinsics(keys: &FrameKeys, ignored: &mut Vec<String>) -> Result<Intrinsics, String> {
    let side = |key: &str, value: Option<f64>| match value {
        Some(v) if v.fract() != 0.0 || !(1.0..=1e6).contains(&v) => {
            Err(format!("`{key}` is {v}, not a whole number of pixels"))
        }
        _ => Ok(value.map(|v| v as u32)),
    };
    let model = keys.camera_model.as_deref().unwrap_or("OPENCV");
    let model = if keys.is_fisheye { "OPENCV_FISHEYE" } else { model };
    let distortion = distortion(keys, model, ignored)?;
    let (w, h) = (side("w", keys.w)?, side("h", keys.h)?);
    if w.is_some() != h.is_some() {
        return Err("it has only one of `w` and `h`".into());
    }
    let angle = [keys.camera_angle_x, keys.camera_angle_y];
    for (key, angle) in ["camera_angle_x", "camera_angle_y"].into_iter().zip(angle) {
        if let Some(a) = angle.filter(|a| !(*a > 0.0 && *a < std::f64::consts::PI)) {
            return Err(format!("`{key}` is {a}, not an angle between 0 and π"));
        }
    }
    let (focal, center) = ([keys.fl_x, keys.fl_y], [keys.cx, keys.cy]);
    Ok(Intrinsics { size: w.zip(h), focal, angle, center, distortion })
}

/// Returns the coefficients that a model has. OPENCV and FISHEYE are said of lenses with k1, k2, k3 as well, and
/// nerfstudio's perspective k4 exists in no other program.
fn distortion(keys: &FrameKeys, model: &str, ignored: &mut Vec<String>) -> Result<Distortion, String> {
    let &FrameKeys { k1, k2, k3, k4, k5, k6, p1, p2, sx1, sy1, omega, .. } = keys;
    let given = Distortion { k1, k2, k3, p1, p2, k4, k5, k6, sx1, sy1, omega, ..Distortion::default() };
    let parameters = match model {
        "PERSPECTIVE" | "PINHOLE" | "SIMPLE_PINHOLE" => {
            if !given.is_none() {
                ignored.push(model.into());
            }
            return Ok(Distortion::default());
        }
        "OPENCV" | "RADIAL" | "SIMPLE_RADIAL" => "k1 k2 k3 p1 p2",
        "FULL_OPENCV" => "k1 k2 k3 k4 k5 k6 p1 p2",
        "OPENCV_FISHEYE" | "RADIAL_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" => "k1 k2 k3 k4",
        other => LensModel::named(other)?.parameters,
    };
    let all = "k1 k2 k3 k4 k5 k6 p1 p2 sx1 sy1 omega".split(' ');
    for key in all.filter(|key| !parameters.split(' ').any(|p| p == *key)) {
        if *frame::coefficient(&mut { given }, key) != 0.0 {
            return Err(format!(
                "its lens has `{key}`, which its camera model `{model}` has not; undistort the photographs first"
            ));
        }
    }
    let distortion = Distortion { projection: frame::projection(model), ..given };
    frame::check_distortion(&distortion)?;
    Ok(distortion)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn object(text: &str) -> Object {
        serde_json::from_str(text).unwrap()
    }

    fn intrinsics_of(top: &str, entry: &str) -> Result<Intrinsics, String> {
        let mut entry = object(entry);
        entry.extend(object(r#"{"file_path": "a", "transform_matrix": []}"#));
        intrinsics(&FrameKeys::read(&object(top), &entry.into())?, &mut Vec::new())
    }

    #[test]
    fn a_frames_own_intrinsics_win_over_the_files() {
        let top = r#"{"fl_x": 10, "fl_y": 11, "cx": 5, "cy": 6, "w": 20, "h": 12, "k1": 0.1}"#;
        let l = intrinsics_of(top, r#"{"camera_angle_x": 1.0, "cx": 7, "k1": 0.2}"#).unwrap();
        assert_eq!((l.focal, l.angle), ([None, None], [Some(1.0), None]));
        assert_eq!((l.center, l.size), ([Some(7.0), Some(6.0)], Some((20, 12))));
        assert_eq!(l.distortion.k1, 0.2);
        assert_eq!(intrinsics_of(top, "{}").unwrap().focal, [Some(10.0), Some(11.0)]);
    }

    #[test]
    fn lenses_that_are_not_supported_are_named() {
        for (top, word) in [
            (r#"{"camera_model": "OPENCV_FISHEYE", "p1": 0.1}"#, "OPENCV_FISHEYE"),
            (r#"{"is_fisheye": true, "k5": 0.1}"#, "k5"),
            (r#"{"camera_model": "FOV", "omega": 4.0}"#, "omega"),
            (r#"{"camera_model": "EQUIRECTANGULAR"}"#, "EQUIRECTANGULAR"),
            (r#"{"k4": 0.1}"#, "k4"),
            (r#"{"w": 10.5, "h": 3}"#, "10.5"),
            (r#"{"fl_x": "wide"}"#, "fl_x"),
            (r#"{"camera_angle_x": 4.0}"#, "camera_angle_x"),
        ] {
            assert!(intrinsics_of(top, "{}").unwrap_err().contains(word), "{top}");
        }
    }

    #[test]
    fn a_camera_model_without_distortion_is_warned_of_once() {
        use crate::capture::synthetic::{SyntheticOptions, shared::write_capture};
        let dir = tempfile::tempdir().unwrap();
        let options = SyntheticOptions { width: 16, height: 20, train: 4, test: 2, seed: 1 };
        write_capture(dir.path(), &options);
        std::fs::remove_file(dir.path().join("transforms_train.json")).unwrap();
        let file = dir.path().join("transforms.json");
        let mut json: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        for (i, frame) in json["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
            frame["k1"] = 0.1.into();
            frame["camera_model"] = ["PINHOLE", "PERSPECTIVE"][i % 2].into();
        }
        std::fs::write(&file, json.to_string()).unwrap();
        let capture = crate::capture::open(dir.path(), &Default::default()).unwrap();
        let warned = capture.warnings.iter().filter(|w| w.contains("it is not used"));
        assert_eq!(warned.count(), 2, "{:?}", capture.warnings);
    }

    #[test]
    fn matrices_of_three_and_four_rows_are_read() {
        let three = vec![vec![1., 0., 0., 5.], vec![0., 1., 0., 6.], vec![0., 0., 1., 7.]];
        let with = |last: [f64; 4]| [three.clone(), vec![last.to_vec()]].concat();
        assert_eq!(upper_rows(&three).unwrap(), upper_rows(&with([0., 0., 0., 1.])).unwrap());
        assert!(upper_rows(&with([0., 0., 1., 1.])).unwrap_err().contains("last row"));
        assert!(upper_rows(&[]).is_err());
        let text = FrameKeys::read(
            &Object::new(),
            &serde_json::json!({"file_path": "a", "transform_matrix": [[1, "x"]]}),
        );
        assert_eq!(text.err().unwrap(), "its `transform_matrix[0][1]` is \"x\", expected a number");
    }
}
