//! The keys of a lens in the spellings of several programs, read as one spelling of each.

use super::Object;
use super::agreement::{FOCAL_KEYS, Known, PINHOLE, numbers};
use serde_json::Value;
use std::collections::BTreeSet;
use tiface_base::io;

/// The other keys that may stand at the top for all frames.
pub(super) const SHARED_KEYS: &str =
    "w h cx cy k1 k2 k3 k4 k5 k6 p1 p2 sx1 sy1 omega is_fisheye camera_model distortion_params";

/// Keys of one frame only.
pub(super) const FRAME_KEYS: &str = "file_path split mask_path fg_mask_path seg_mask_path face_mask_path";

/// Keys that count as absent where their value is of another type, and whether it is of theirs.
const LENIENT_KEYS: [(&str, fn(&Value) -> bool); 5] = [
    ("is_fisheye", is_switch),
    ("camera_model", Value::is_string),
    ("face_mask_path", Value::is_string),
    ("fg_mask_path", Value::is_string),
    ("seg_mask_path", Value::is_string),
];

/// Returns whether a value is true or false, or 1 or 0 as some programs write these.
fn is_switch(value: &Value) -> bool {
    value.is_boolean() || [Some(0), Some(1)].contains(&value.as_u64())
}

/// Other spellings that can mean one thing only, and the key that each stands for.
pub(super) const ALIASES: [(&str, &str); 22] = [
    ("fx", "fl_x"),
    ("fy", "fl_y"),
    ("focal_x", "fl_x"),
    ("focal_y", "fl_y"),
    ("c_x", "cx"),
    ("c_y", "cy"),
    ("W", "w"),
    ("H", "h"),
    ("width", "w"),
    ("height", "h"),
    ("image_width", "w"),
    ("image_height", "h"),
    ("img_width", "w"),
    ("img_height", "h"),
    ("image_path", "file_path"),
    ("img_path", "file_path"),
    ("rgb_path", "file_path"),
    ("image_name", "file_path"),
    ("img_name", "file_path"),
    ("image_file", "file_path"),
    ("filename", "file_path"),
    ("file_name", "file_path"),
];

/// Keys of matrices of intrinsics: fx 0 cx, 0 fy cy, 0 0 1.
pub(super) const MATRICES: [&str; 8] = [
    "intrinsic_matrix",
    "intrinsics_matrix",
    "camera_matrix",
    "camera_intrinsics",
    "camera_intrinsic",
    "intrinsics",
    "intrinsic",
    "K",
];

/// Keys that may be a focal length or an angle, of a unit that is not known; named where there is
/// no other.
pub(super) const FOCAL_WORDS: [&str; 24] = [
    "focal",
    "focal_length",
    "focal_length_x",
    "focal_length_y",
    "focal_length_mm",
    "focal_mm",
    "focal_px",
    "flx",
    "fl",
    "f",
    "fov",
    "fov_x",
    "fov_y",
    "fovx",
    "fovy",
    "FovX",
    "FovY",
    "FoVx",
    "FoVy",
    "hfov",
    "vfov",
    "cam_angle_x",
    "camera_angle",
    "camera_fov",
];

/// Other findings in the lenses of a file.
#[derive(Default)]
pub(super) struct LensNotes {
    /// Camera models without distortion whose frames have some.
    pub ignored: BTreeSet<String>,
    /// Spellings that were read, with what they were read as.
    pub taken: BTreeSet<(&'static str, &'static str)>,
    /// Spellings that were not read, by the reason.
    pub skipped: BTreeSet<(String, &'static str)>,
    /// Keys that disagree with the values read, and cannot decide.
    pub doubts: BTreeSet<String>,
    /// Keys whose value is of another type than it must be.
    pub misread: BTreeSet<&'static str>,
}

/// Why what is not understood is not read.
const UNCLEAR: &str = "what is meant is not known";

/// Returns what is read of an object, with one spelling of each key. Keys that `beyond` has are not
/// taken from others.
pub(super) fn canonical(
    object: &Object,
    beyond: Option<&Object>,
    notes: &mut LensNotes,
) -> Result<Object, String> {
    let mut lens = CanonicalLens { object, beyond, out: given(object, notes), notes };
    lens.add_aliases()?;
    lens.add_angles()?;
    lens.add_matrices()?;
    lens.add_distortion()?;
    Ok(lens.out)
}

/// Returns the keys of an object that are spelled as they are read, if their values can be used.
fn given(object: &Object, notes: &mut LensNotes) -> Object {
    let is_given = |key: &str, value: &Value| match LENIENT_KEYS.iter().find(|(name, _)| key == *name) {
        Some((_, is_usable)) => is_usable(value),
        None => !value.is_null(),
    };
    let keys = SHARED_KEYS.split(' ').chain(FRAME_KEYS.split(' ')).chain(FOCAL_KEYS);
    let given = keys.filter_map(|key| object.get_key_value(key)).filter(|(key, value)| is_given(key, value));
    let mut out: Object = given.map(|(key, value)| (key.clone(), value.clone())).collect();
    let misread = LENIENT_KEYS.into_iter().filter(|(key, is_usable)| {
        object.get(*key).is_some_and(|value| !value.is_null() && !is_usable(value))
    });
    notes.misread.extend(misread.map(|(key, _)| key));
    if let Some(value) = out.get_mut("is_fisheye").filter(|value| value.is_number()) {
        let is_on = *value == 1;
        *value = is_on.into();
        notes.taken.insert(("is_fisheye", if is_on { "true" } else { "false" }));
    }
    out
}

/// An object that is being read.
struct CanonicalLens<'a> {
    object: &'a Object,
    /// The top of the file; `None` for the top itself.
    beyond: Option<&'a Object>,
    /// What was read, with one spelling of each key.
    out: Object,
    notes: &'a mut LensNotes,
}

impl<'a> CanonicalLens<'a> {
    fn is_known(&self, key: &str) -> bool {
        let is_of_file = |top: &Object| key != "file_path" && top.contains_key(key);
        self.out.contains_key(key) || self.beyond.is_some_and(is_of_file)
    }

    /// Returns the value of another spelling.
    fn other(&self, key: &str) -> Option<&'a Value> {
        self.object.get(key).filter(|value| !value.is_null())
    }

    fn skip(&mut self, why: impl Into<String>, key: &'static str) {
        self.notes.skipped.insert((why.into(), key));
    }

    /// Reads other spellings of keys.
    fn add_aliases(&mut self) -> Result<(), String> {
        for (alias, key) in ALIASES {
            // the top of a file has no photograph
            let value = self.other(alias).filter(|_| key != "file_path" || self.beyond.is_some());
            let Some(value) = value else { continue };
            let fits = match key {
                "file_path" => value.is_string(),
                "w" | "h" => value.is_u64() && self.object.get(&partner(alias)).is_some_and(Value::is_u64),
                _ => value.is_number(),
            };
            if fits && !self.is_known(key) {
                self.out.insert(key.into(), value.clone());
                self.notes.taken.insert((alias, key));
            } else if fits {
                let known = Known { own: &self.out, top: self.beyond };
                known.check_alias(alias, key, value, &mut self.notes.doubts)?;
                self.skip(format!("`{key}` is there"), alias);
            } else {
                self.skip(UNCLEAR, alias);
            }
        }
        Ok(())
    }

    /// Reads angles in degrees.
    fn add_angles(&mut self) -> Result<(), String> {
        for (key, angle, focal) in [("x_fov", "camera_angle_x", "fl_x"), ("y_fov", "camera_angle_y", "fl_y")]
        {
            let Some(value) = self.other(key) else { continue };
            if let Some(known) = [focal, angle].into_iter().find(|key| self.is_known(key)) {
                self.skip(format!("`{known}` is there"), key);
                continue;
            }
            self.out.insert(angle.into(), degrees(key, value)?.into());
            self.notes.taken.insert((key, "an angle in degrees"));
        }
        Ok(())
    }

    /// Reads matrices of intrinsics, or checks them where a focal length is known.
    fn add_matrices(&mut self) -> Result<(), String> {
        for key in MATRICES {
            let Some(value) = self.other(key) else { continue };
            let found = matrix(key, value)?;
            if FOCAL_KEYS.iter().any(|key| self.is_known(key)) {
                let known = Known { own: &self.out, top: self.beyond };
                match (found, numbers(value)) {
                    (Some(found), _) => known.check_matrix(key, found, &mut self.notes.doubts)?,
                    (None, Some(four)) => known.check_list(key, four)?,
                    (None, None) => {}
                }
                self.skip("a focal length or an angle is there", key);
                continue;
            }
            let Some(found) = found else {
                self.skip(UNCLEAR, key);
                continue;
            };
            for (key, value) in PINHOLE.into_iter().zip(found) {
                self.out.entry(key).or_insert_with(|| value.into());
            }
            self.notes.taken.insert((key, "intrinsics in pixels"));
        }
        Ok(())
    }

    /// Reads the list of distortion parameters into one key each.
    fn add_distortion(&mut self) -> Result<(), String> {
        let Some(value) = self.out.get("distortion_params") else { return Ok(()) };
        let of = |key: &str| self.out.get(key).or_else(|| self.beyond?.get(key));
        let model = of("camera_model").and_then(Value::as_str).unwrap_or_default().to_ascii_uppercase();
        let is_fisheye = of("is_fisheye") == Some(&Value::Bool(true)) || model.contains("FISHEYE");
        for (key, value) in distortion_params(value, is_fisheye)? {
            self.out.insert(key.into(), value.into());
        }
        self.notes.taken.insert(("distortion_params", "k1, k2, k3, k4, p1, p2"));
        Ok(())
    }
}

/// Returns the other side's spelling of a width or height: a height alone may be one of anything.
fn partner(side: &str) -> String {
    match side {
        "W" => "H".into(),
        "H" => "W".into(),
        width if width.ends_with("width") => width.replace("width", "height"),
        height => height.replace("height", "width"),
    }
}

/// Returns the radians of instant-ngp's `x_fov` and `y_fov`, which are degrees.
fn degrees(key: &str, value: &Value) -> Result<f64, String> {
    match value.as_f64() {
        Some(degrees) if degrees > std::f64::consts::PI && degrees < 180.0 => Ok(degrees.to_radians()),
        _ => Err(format!(
            "`{key}` is {}, expected degrees between 4 and 180 (radians are called `camera_angle_{}`)",
            short(value),
            &key[..1]
        )),
    }
}

/// Skew beyond this share of the focal length is no pinhole's.
const SKEW: f64 = 1e-3;

/// Returns fx, fy, cx, cy of a matrix of intrinsics as rows or as one list, row by row or column by
/// column, which its zeros tell apart; or of an object of that name. `None` for anything else, such
/// as a list of four numbers.
fn matrix(key: &str, value: &Value) -> Result<Option<[f64; 4]>, String> {
    if let Value::Object(named) = value {
        let of = |names: [&str; 2]| names.iter().find_map(|name| named.get(*name)?.as_f64());
        let found = [of(["fl_x", "fx"]), of(["fl_y", "fy"]), of(["cx", "c_x"]), of(["cy", "c_y"])];
        let [Some(fx), Some(fy), Some(cx), Some(cy)] = found else { return Ok(None) };
        return Ok(Some([fx, fy, cx, cy]));
    }
    let Some(list) = value.as_array() else { return Ok(None) };
    let rows: Option<Vec<Vec<f64>>> =
        list.iter().take(5).map(|row| row.as_array()?.iter().take(5).map(Value::as_f64).collect()).collect();
    let flat: Option<Vec<f64>> = list.iter().take(17).map(Value::as_f64).collect();
    let m: [[f64; 3]; 3] = match (rows, flat) {
        (Some(rows), _)
            if [3, 4].contains(&rows.len()) && rows.iter().all(|row| [3, 4].contains(&row.len())) =>
        {
            [0, 1, 2].map(|r| [rows[r][0], rows[r][1], rows[r][2]])
        }
        (_, Some(v)) if v.len() == 9 => [0, 1, 2].map(|r| [v[3 * r], v[3 * r + 1], v[3 * r + 2]]),
        _ => return Ok(None),
    };
    let ends = |m: [[f64; 3]; 3]| m[2] == [0.0, 0.0, 1.0] && m[1][0] == 0.0;
    let columns = [0, 1, 2].map(|r| [m[0][r], m[1][r], m[2][r]]);
    let m = if ends(m) { m } else { columns };
    if !ends(m) {
        return Ok(None);
    }
    if m[0][1].abs() > SKEW * m[0][0].abs() {
        return Err(format!("its `{key}` shears pixels, by {}: undistort the photographs first", m[0][1]));
    }
    Ok(Some([m[0][0], m[1][1], m[0][2], m[1][2]]))
}

/// Returns the coefficients in nerfstudio's `distortion_params`. Its loader takes six, k1 k2 k3 k4
/// p1 p2; OpenCV's lists of four and five have p1 in the third place, so that those are read only
/// where both orders mean the same.
fn distortion_params(value: &Value, is_fisheye: bool) -> Result<Vec<(&'static str, f64)>, String> {
    const ORDER: [&str; 6] = ["k1", "k2", "k3", "k4", "p1", "p2"];
    let values: Vec<f64> = io::typed(value).map_err(|[key, found, expected]| {
        format!("its `distortion_params{}` is {found}, expected {expected}", key.trim_start_matches('.'))
    })?;
    let is_clear = match values.len() {
        6 => true,
        4 if is_fisheye => true,
        0..=5 => values.iter().skip(2).all(|v| *v == 0.0),
        _ => values.iter().skip(6).all(|v| *v == 0.0),
    };
    if !is_clear {
        return Err(format!(
            "its `distortion_params` holds {} numbers, expected the 6 of nerfstudio: k1, k2, k3, k4, p1, p2 \
             (OpenCV's order is k1, k2, p1, p2, k3)",
            values.len()
        ));
    }
    let values = values.into_iter().chain(std::iter::repeat(0.0));
    Ok(ORDER.into_iter().zip(values).collect())
}

/// Returns the beginning of a value, for a message.
fn short(value: &Value) -> String {
    match value {
        Value::Array(_) => "a list".into(),
        Value::Object(_) => "an object".into(),
        value => crate::folder::shortened(&value.to_string()),
    }
}
