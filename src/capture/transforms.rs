//! `transforms.json` and its split forms: the dialects of NeRF-Blender, instant-ngp and nerfstudio.
//!
//! Poses are camera-to-world with OpenGL axes in all three. Intrinsics may stand at the top or in each
//! frame; a frame's own win. Unknown keys are ignored; known ones of the wrong type are errors.

use super::listing::{Frame, Lens, Listing};
use super::names::Place;
use super::pose;
use super::{CaptureError, CaptureOptions, Split};
use crate::geom::Distortion;
use crate::io::{self, ReadError};
use glam::DVec3;
use serde_json::{Map, Value};

type Object = Map<String, Value>;

/// Lists the frames of `files`, in order; everything wrong goes to the listing's problems.
pub(super) fn list(place: &Place, files: &[&str], options: &CaptureOptions, listing: &mut Listing) {
    for &file in files {
        let split = match file {
            "transforms_train.json" => Some(Split::Train),
            "transforms_val.json" => Some(Split::Val),
            "transforms_test.json" => Some(Split::Test),
            _ => None,
        };
        if let Err(problem) = list_file(place, file, split, options, listing) {
            listing.problems.push(problem);
        }
    }
    if listing.frames.len() > options.limits.views {
        listing.problems.push(CaptureError::Read(ReadError::TooLarge {
            path: place.root().into(),
            what: "the number of views",
            found: listing.frames.len() as u64,
            limit: options.limits.views as u64,
        }));
        listing.frames.clear();
    }
}

fn list_file(
    place: &Place,
    file: &str,
    split: Option<Split>,
    options: &CaptureOptions,
    listing: &mut Listing,
) -> Result<(), CaptureError> {
    let path = place.root().join(file);
    if place.file(file, file.as_ref())?.is_none() {
        return Err(CaptureError::Outside { file: file.into(), name: file.into() });
    }
    let value = io::read_json(&path, &options.limits)?;
    let structure = |problem: String, hint: &str| CaptureError::Structure {
        file: file.into(),
        problem,
        hint: hint.into(),
    };
    let top = value
        .as_object()
        .ok_or_else(|| structure("it is not a JSON object".into(), "it must begin with `{`"))?;
    let frames = top.get("frames").and_then(Value::as_array).ok_or_else(|| {
        structure("it has no list `frames`".into(), "each entry of `frames` describes one photograph")
    })?;
    if frames.is_empty() {
        return Err(structure(
            "its list `frames` is empty".into(),
            "it must describe at least one photograph",
        ));
    }
    if frames.len() > options.limits.views {
        return Err(CaptureError::Read(ReadError::TooLarge {
            path,
            what: "the number of frames",
            found: frames.len() as u64,
            limit: options.limits.views as u64,
        }));
    }
    notes(top, file, listing);
    let named = named_splits(top).map_err(|problem| structure(problem, "list file names there"))?;
    let mut ignored = Vec::new();
    for (i, entry) in frames.iter().enumerate() {
        let number = format!("#{i}");
        let name = entry.get("file_path").and_then(Value::as_str);
        let problem = |problem: String| CaptureError::Frame {
            file: file.into(),
            frame: name.unwrap_or(&number).into(),
            problem,
            hint: "correct that frame, or remove it".into(),
        };
        let parsed = match (entry.as_object(), name) {
            (Some(entry), Some(name)) => {
                parse_frame(top, entry, name, split.or(named.of(name)), &mut ignored)
            }
            _ => Err("it has no `file_path`".into()),
        };
        let mut frame = match parsed {
            Ok(frame) => frame,
            Err(text) => {
                listing.problems.push(problem(text));
                continue;
            }
        };
        frame.file = file.into();
        let beside = |key: &str| -> Result<_, CaptureError> {
            let Some(name) = entry.get(key).and_then(Value::as_str) else { return Ok(None) };
            place.file(file, &place.relative(file, name)?)
        };
        let files = place
            .photo(file, &frame.name, options.downscale)
            .and_then(|photo| Ok((photo, beside("mask_path")?, beside("face_mask_path")?)));
        match files {
            Ok(((relative, photo), mask, region)) => {
                if entry.get("mask_path").is_some() && mask.is_none() && photo.is_some() {
                    listing.problems.push(problem("the mask it names is missing".into()));
                }
                listing.frames.push(Frame { relative, photo, mask, region, ..frame });
            }
            Err(problem) => listing.problems.push(problem),
        }
    }
    ignored.dedup();
    for model in ignored {
        listing.warnings.push(format!(
            "`{file}` gives distortion for the camera model `{model}`, which has none; it is not used"
        ));
    }
    Ok(())
}

/// Things at the top that change nothing here but that a person should know.
fn notes(top: &Object, file: &str, listing: &mut Listing) {
    if top.contains_key("applied_transform") || top.contains_key("applied_scale") {
        listing.reasons.push(format!(
            "`{file}` says its world was moved (`applied_transform`): results come out in the moved world"
        ));
    }
    if listing.up.is_none()
        && let Some(up) = top.get("up").and_then(Value::as_array)
        && let [Some(x), Some(y), Some(z)] = [0, 1, 2].map(|k| up.get(k).and_then(Value::as_f64))
        && let Some(up) = DVec3::new(x, y, z).try_normalize()
    {
        listing.up = Some(up);
    }
}

/// nerfstudio's `train_filenames`, `val_filenames`, `test_filenames`.
#[derive(Default)]
struct NamedSplits<'a> {
    lists: Vec<(Split, std::collections::HashSet<&'a str>)>,
}

impl NamedSplits<'_> {
    fn of(&self, name: &str) -> Option<Split> {
        self.lists.iter().find(|(_, names)| names.contains(name)).map(|(split, _)| *split)
    }
}

fn named_splits(top: &Object) -> Result<NamedSplits<'_>, String> {
    let mut splits = NamedSplits::default();
    let keys =
        [("train_filenames", Split::Train), ("val_filenames", Split::Val), ("test_filenames", Split::Test)];
    for (key, split) in keys {
        if let Some(value) = top.get(key) {
            let names = value.as_array().and_then(|a| a.iter().map(Value::as_str).collect());
            splits.lists.push((split, names.ok_or_else(|| format!("`{key}` is not a list of names"))?));
        }
    }
    Ok(splits)
}

fn parse_frame(
    top: &Object,
    entry: &Object,
    name: &str,
    split: Option<Split>,
    ignored: &mut Vec<String>,
) -> Result<Frame, String> {
    let matrix = entry.get("transform_matrix").ok_or("it has no `transform_matrix`")?;
    let (rotation, position) = pose::pose(&matrix_rows(matrix)?)?;
    let split = match entry.get("split").map(|s| s.as_str()) {
        None => split,
        Some(Some("train")) => Some(Split::Train),
        Some(Some("val" | "eval" | "validation")) => Some(Split::Val),
        Some(Some("test")) => Some(Split::Test),
        Some(other) => {
            return Err(format!("its split is `{}`; known are train, val, test", other.unwrap_or("?")));
        }
    };
    Ok(Frame {
        file: String::new(),
        name: name.into(),
        photo: None,
        relative: Default::default(),
        split,
        lens: lens(top, entry, ignored)?,
        rotation,
        position,
        mask: None,
        region: None,
    })
}

/// The upper three rows of a 3×4 or 4×4 matrix.
fn matrix_rows(value: &Value) -> Result<[[f64; 4]; 3], String> {
    let shape = "its `transform_matrix` is not 4 × 4 or 3 × 4 numbers";
    let rows = value.as_array().filter(|r| r.len() == 3 || r.len() == 4).ok_or(shape)?;
    let mut out = [[0.0; 4]; 4];
    out[3] = [0.0, 0.0, 0.0, 1.0];
    for (row, to) in rows.iter().zip(&mut out) {
        let row = row.as_array().filter(|r| r.len() == 4).ok_or(shape)?;
        for (v, to) in row.iter().zip(to) {
            *to = v.as_f64().ok_or(shape)?;
        }
    }
    let last = out[3];
    if last[..3].iter().any(|v| v.abs() > 1e-6) || (last[3] - 1.0).abs() > 1e-6 {
        return Err(format!("the last row of its `transform_matrix` is {last:?}, not 0 0 0 1"));
    }
    Ok([out[0], out[1], out[2]])
}

fn lens(top: &Object, entry: &Object, ignored: &mut Vec<String>) -> Result<Lens, String> {
    let number = |of: &Object, key: &str| match of.get(key) {
        None | Some(Value::Null) => Ok(None),
        Some(v) => v.as_f64().map(Some).ok_or_else(|| format!("`{key}` is {v}, not a number")),
    };
    let either = |key: &str| Ok::<_, String>(number(entry, key)?.or(number(top, key)?));
    let side = |key: &str| match either(key)? {
        None => Ok(None),
        Some(v) if v.fract() == 0.0 && (1.0..=1e6).contains(&v) => Ok(Some(v as u32)),
        Some(v) => Err(format!("`{key}` is {v}, not a whole number of pixels")),
    };
    let fisheye = [entry, top].iter().any(|o| o.get("is_fisheye").and_then(Value::as_bool) == Some(true));
    let model = [entry, top].iter().find_map(|o| o.get("camera_model")).and_then(Value::as_str);
    let model = if fisheye { "OPENCV_FISHEYE (`is_fisheye`)" } else { model.unwrap_or("OPENCV") };
    let k = |key: &str| Ok::<_, String>(either(key)?.unwrap_or(0.0));
    let found = Distortion { k1: k("k1")?, k2: k("k2")?, k3: k("k3")?, p1: k("p1")?, p2: k("p2")? };
    let distortion = match model {
        "OPENCV" | "FULL_OPENCV" | "SIMPLE_RADIAL" | "RADIAL" => found,
        "PINHOLE" | "SIMPLE_PINHOLE" | "PERSPECTIVE" => {
            if !found.is_none() {
                ignored.push(model.into());
            }
            Distortion::default()
        }
        other => {
            return Err(format!(
                "its camera model `{other}` is not supported (OPENCV, RADIAL and PINHOLE models are); \
                 undistort the photographs first"
            ));
        }
    };
    for key in ["k4", "k5", "k6"] {
        if k(key)? != 0.0 && !model.contains("PINHOLE") {
            return Err(format!(
                "its lens has `{key}`, which is not supported; undistort the photographs first"
            ));
        }
    }
    let size = match (side("w")?, side("h")?) {
        (Some(w), Some(h)) => Some((w, h)),
        (None, None) => None,
        _ => return Err("it has only one of `w` and `h`".into()),
    };
    // whoever names a focal length or an angle names all of them: a frame's own angle must not be
    // overruled by the whole file's focal length
    let own = ["fl_x", "fl_y", "camera_angle_x", "camera_angle_y"].iter().any(|k| entry.contains_key(*k));
    let of = if own { entry } else { top };
    let lens = Lens {
        size,
        focal: [number(of, "fl_x")?, number(of, "fl_y")?],
        angle: [number(of, "camera_angle_x")?, number(of, "camera_angle_y")?],
        center: [either("cx")?, either("cy")?],
        distortion,
    };
    for (key, a) in [("camera_angle_x", lens.angle[0]), ("camera_angle_y", lens.angle[1])] {
        if a.is_some_and(|a| !(a > 0.0 && a < std::f64::consts::PI)) {
            return Err(format!("`{key}` is {}, not an angle between 0 and π", a.unwrap_or(0.0)));
        }
    }
    Ok(lens)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn object(text: &str) -> Object {
        serde_json::from_str(text).unwrap()
    }

    fn lens_of(top: &str, entry: &str) -> Result<Lens, String> {
        lens(&object(top), &object(entry), &mut Vec::new())
    }

    #[test]
    fn a_frames_own_intrinsics_win_over_the_files() {
        let top = r#"{"fl_x": 10, "fl_y": 11, "cx": 5, "cy": 6, "w": 20, "h": 12, "k1": 0.1}"#;
        let l = lens_of(top, r#"{"camera_angle_x": 1.0, "cx": 7, "k1": 0.2}"#).unwrap();
        assert_eq!((l.focal, l.angle), ([None, None], [Some(1.0), None]));
        assert_eq!((l.center, l.size), ([Some(7.0), Some(6.0)], Some((20, 12))));
        assert_eq!(l.distortion.k1, 0.2);
        assert_eq!(lens_of(top, "{}").unwrap().focal, [Some(10.0), Some(11.0)]);
    }

    #[test]
    fn lenses_that_are_not_supported_are_named() {
        for (top, word) in [
            (r#"{"camera_model": "OPENCV_FISHEYE"}"#, "OPENCV_FISHEYE"),
            (r#"{"is_fisheye": true}"#, "is_fisheye"),
            (r#"{"camera_model": "EQUIRECTANGULAR"}"#, "EQUIRECTANGULAR"),
            (r#"{"k4": 0.1}"#, "k4"),
            (r#"{"w": 10.5, "h": 3}"#, "10.5"),
            (r#"{"fl_x": "wide"}"#, "fl_x"),
            (r#"{"camera_angle_x": 4.0}"#, "camera_angle_x"),
        ] {
            assert!(lens_of(top, "{}").unwrap_err().contains(word), "{top}");
        }
    }

    #[test]
    fn matrices_of_three_and_four_rows_are_read() {
        let rows = "[1,0,0,5],[0,1,0,6],[0,0,1,7]";
        let three: Value = serde_json::from_str(&format!("[{rows}]")).unwrap();
        let four: Value = serde_json::from_str(&format!("[{rows},[0,0,0,1]]")).unwrap();
        assert_eq!(matrix_rows(&three).unwrap(), matrix_rows(&four).unwrap());
        let bad: Value = serde_json::from_str(&format!("[{rows},[0,0,1,1]]")).unwrap();
        assert!(matrix_rows(&bad).unwrap_err().contains("last row"));
        assert!(matrix_rows(&Value::Null).is_err());
    }
}
