//! The lens of a frame: its own keys and those for all frames, as intrinsics.

use super::agreement::FOCAL_KEYS;
use super::spellings::{FOCAL_WORDS, LensNotes, MATRICES, SHARED_KEYS, canonical};
use super::{Fault, Object};
use crate::frame::Intrinsics;
use crate::lens_model::{self, LensModel};
use glam::{DMat3, DVec3};
use serde::Deserialize;
use serde_json::Value;
use tiface_base::geom::{Camera, Distortion};
use tiface_base::io;

/// Values read of a frame, intrinsics from the top included.
#[derive(Default, Deserialize)]
#[serde(default)]
pub(super) struct FrameKeys {
    pub file_path: String,
    pub split: Option<String>,
    pub mask_path: Option<String>,
    pub fg_mask_path: Option<String>,
    pub seg_mask_path: Option<String>,
    pub face_mask_path: Option<String>,
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
    /// There for messages only: [`canonical`] names its coefficients.
    distortion_params: Option<Vec<f64>>,
    /// Whether the frame itself says something of its lens.
    #[serde(skip)]
    has_own_lens: bool,
}

impl FrameKeys {
    /// Returns the keys of a frame, with those from the top that it lacks; both are [`canonical`].
    pub fn merged(top: &Object, own: Object) -> Result<FrameKeys, Fault> {
        let own_focal = FOCAL_KEYS.iter().any(|key| own.contains_key(*key));
        let has_own_lens = own_focal || SHARED_KEYS.split(' ').any(|key| own.contains_key(key));
        let shared = SHARED_KEYS.split(' ').chain(FOCAL_KEYS.into_iter().filter(|_| !own_focal));
        let (mut merged, mut from_top) = (own, Vec::new());
        for (key, value) in shared.filter_map(|key| top.get_key_value(key)) {
            if !merged.contains_key(key) {
                merged.insert(key.clone(), value.clone());
                from_top.push(key.as_str());
            }
        }
        let keys = io::typed::<FrameKeys>(&Value::Object(merged)).map_err(|[key, found, expected]| {
            let text = format!("its `{key}` is {found}, expected {expected}");
            let name = key.trim_start_matches('.').split(['.', '[']).next().unwrap_or_default();
            if from_top.contains(&name) { of_all(text) } else { Fault::Frame(text) }
        })?;
        Ok(FrameKeys { has_own_lens, ..keys })
    }

    /// Returns the fault of its lens: of the whole file where the frame says nothing of it.
    pub fn fault(&self, text: String) -> Fault {
        if self.has_own_lens { Fault::Frame(text) } else { of_all(text) }
    }
}

/// Returns the fault of what a file says of all its photographs.
fn of_all(text: String) -> Fault {
    Fault::File { text, hint: OF_ALL.into() }
}

/// Advice for keys at the top of a file.
pub(super) const OF_ALL: &str = "correct what the file says of all its photographs";

/// Returns the camera of a frame, whose pose is known. What neither it nor the top of its file says
/// of the lens is as `like` has it.
pub(crate) fn camera_like(
    top: &Object,
    own: &Object,
    like: &Camera,
    (rotation, position): (DMat3, DVec3),
) -> Result<Camera, String> {
    let mut notes = LensNotes::default();
    let top = canonical(top, None, &mut notes)?;
    let own = canonical(own, Some(&top), &mut notes)?;
    let keys = FrameKeys::merged(&top, own).map_err(Fault::into_text)?;
    let lens = intrinsics(&keys, &mut notes)?;
    let size = lens.size.unwrap_or((like.width, like.height));
    if lens.has_focal() {
        return lens.camera(size, rotation, position);
    }
    let like = like.resized(size.0, size.1);
    let [cx, cy] = [lens.center[0].unwrap_or(like.cx), lens.center[1].unwrap_or(like.cy)];
    let distortion = if lens.distortion.is_none() { like.distortion } else { lens.distortion };
    Ok(Camera { cx, cy, distortion, rotation, position, ..like })
}

/// Returns the mistake of a frame that has no focal length, with the keys of it or of its file that
/// may hold one.
pub(super) fn no_focal(top: &Object, own: &Object) -> Fault {
    let words = MATRICES.iter().chain(&FOCAL_WORDS);
    let has = |key: &&&str| [own, top].iter().any(|object| object.get(**key).is_some_and(|v| !v.is_null()));
    let there: Vec<String> = words.filter(has).map(|key| format!("`{key}`")).collect();
    let text = "it has neither `fl_x` nor `camera_angle_x`, nor has the whole file";
    let hint = "write `fl_x` and `fl_y`, the focal length in pixels (in millimeters it is multiplied by the \
                picture's width and divided by the sensor's), or `camera_angle_x`, the full horizontal angle \
                of view in radians";
    match there.is_empty() {
        true => Fault::File { text: text.into(), hint: hint.into() },
        false => Fault::File {
            text: format!(
                "{text}; {} may hold it, in a unit or an order that is not known",
                there.join(", ")
            ),
            hint: hint.into(),
        },
    }
}

pub(super) fn intrinsics(keys: &FrameKeys, notes: &mut LensNotes) -> Result<Intrinsics, String> {
    let side = |key: &str, value: Option<f64>| match value {
        Some(v) if v.fract() != 0.0 || !(1.0..=1e6).contains(&v) => {
            Err(format!("`{key}` is {v}, not a whole number of pixels"))
        }
        _ => Ok(value.map(|v| v as u32)),
    };
    let distortion = distortion(keys, &model(keys), notes)?;
    let (w, h) = (side("w", keys.w)?, side("h", keys.h)?);
    if w.is_some() != h.is_some() {
        return Err("it has only one of `w` and `h`".into());
    }
    let angle = [keys.camera_angle_x, keys.camera_angle_y];
    for (key, angle) in ["camera_angle_x", "camera_angle_y"].into_iter().zip(angle) {
        if let Some(a) = angle.filter(|a| !(*a > 0.0 && *a < std::f64::consts::PI)) {
            let text = format!("`{key}` is {a}, not an angle between 0 and π");
            let radians =
                if a > 0.0 && a < 180.0 { format!("; {a}° are {:.6}", a.to_radians()) } else { "".into() };
            return Err(text + &radians);
        }
    }
    let (focal, center) = ([keys.fl_x, keys.fl_y], [keys.cx, keys.cy]);
    Ok(Intrinsics { size: w.zip(h), focal, angle, center, distortion })
}

/// Returns the lens model by COLMAP's name, in capital letters. COLMAP's FISHEYE is OPENCV_FISHEYE
/// without coefficients, and other programs say it of that one.
fn model(keys: &FrameKeys) -> String {
    let name = keys.camera_model.as_deref().unwrap_or("OPENCV");
    let name = name.trim().to_ascii_uppercase().replace(['-', ' '], "_");
    match name.as_str() {
        _ if keys.is_fisheye => "OPENCV_FISHEYE".into(),
        "FISHEYE" | "SIMPLE_FISHEYE" => "OPENCV_FISHEYE".into(),
        _ => name,
    }
}

/// Returns the coefficients that a model has. OPENCV and FISHEYE are said of lenses with k1, k2, k3
/// as well, and nerfstudio's perspective k4 exists in no other program.
fn distortion(keys: &FrameKeys, model: &str, notes: &mut LensNotes) -> Result<Distortion, String> {
    let &FrameKeys { k1, k2, k3, k4, k5, k6, p1, p2, sx1, sy1, omega, .. } = keys;
    let given = Distortion { k1, k2, k3, p1, p2, k4, k5, k6, sx1, sy1, omega, ..Distortion::default() };
    let parameters = match model {
        "PERSPECTIVE" | "PINHOLE" | "SIMPLE_PINHOLE" => {
            if !given.is_none() {
                notes.ignored.insert(model.into());
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
        if *lens_model::coefficient(&mut { given }, key) != 0.0 {
            let list = if keys.distortion_params.is_some() { " (in `distortion_params`)" } else { "" };
            return Err(format!(
                "its lens has `{key}`{list}, which its camera model `{model}` has not; undistort the \
                 photographs first"
            ));
        }
    }
    let distortion = Distortion { projection: lens_model::projection(model), ..given };
    lens_model::check_distortion(&distortion)?;
    Ok(distortion)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(top: &str, entry: &str) -> Result<(Intrinsics, LensNotes), String> {
        let mut notes = LensNotes::default();
        let object = |text: &str| -> Object { serde_json::from_str(text).unwrap() };
        let top = canonical(&object(top), None, &mut notes)?;
        let own = canonical(&object(entry), Some(&top), &mut notes)?;
        let keys = FrameKeys::merged(&top, own).map_err(Fault::into_text)?;
        let found = intrinsics(&keys, &mut notes)?;
        Ok((found, notes))
    }

    fn intrinsics_of(top: &str, entry: &str) -> Result<Intrinsics, String> {
        Ok(read(top, entry)?.0)
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
            (r#"{"camera_angle_x": 40}"#, "40° are 0.698132"),
            (r#"{"x_fov": 0.7}"#, "camera_angle_x"),
            (r#"{"K": [[9, 1, 5], [0, 9, 6], [0, 0, 1]]}"#, "shears"),
        ] {
            assert!(intrinsics_of(top, "{}").unwrap_err().contains(word), "{top}");
        }
    }

    #[test]
    fn distortion_params_are_read_in_nerfstudios_order_and_others_refused() {
        let k = |text: &str| {
            intrinsics_of(&format!(r#"{{"fl_x": 9, "k1": 0.5, "distortion_params": {text}}}"#), "{}")
        };
        let d = k("[0.1, 0.2, 0.3, 0, 0.4, 0.5]").unwrap().distortion;
        assert_eq!((d.k1, d.k2, d.k3, d.k4, d.p1, d.p2), (0.1, 0.2, 0.3, 0.0, 0.4, 0.5));
        // both orders of four and five mean this
        for text in ["[0.1, 0.2, 0, 0]", "[0.1, 0.2, 0, 0, 0]", "[0.1, 0.2]"] {
            let d = k(text).unwrap().distortion;
            assert_eq!((d.k1, d.k2, d.k3, d.p1), (0.1, 0.2, 0.0, 0.0), "{text}");
        }
        for text in ["[0.1, 0.2, 0.3, 0]", "[0, 0, 0, 0, 0.1]", "[0, 0, 0, 0.1, 0, 0]", "[\"a\"]", "3"] {
            assert!(k(text).unwrap_err().contains("distortion_params"), "{text}");
        }
        let fisheye = r#"{"camera_model": "OPENCV_FISHEYE", "distortion_params": [0.1, 0.2, 0.3, 0.4]}"#;
        assert_eq!(intrinsics_of(fisheye, "{}").unwrap().distortion.k4, 0.4);
        // a frame's own win over those of the file
        let both = intrinsics_of(r#"{"k1": 0.1}"#, r#"{"distortion_params": [0.3, 0, 0, 0, 0, 0]}"#);
        assert_eq!(both.unwrap().distortion.k1, 0.3);
    }

    #[test]
    fn models_in_small_letters_are_those_in_capitals() {
        for (small, large) in [("opencv", "OPENCV"), ("simple_radial", "SIMPLE_RADIAL"), ("fov", "FOV")] {
            let of = |name: &str| intrinsics_of(&format!(r#"{{"camera_model": "{name}"}}"#), "{}").unwrap();
            assert_eq!(of(small), of(large));
        }
        let fisheye = intrinsics_of(r#"{"camera_model": "fisheye", "k4": 0.1}"#, "{}").unwrap();
        assert_eq!(fisheye.distortion.projection, tiface_base::geom::Projection::Fisheye);
        assert!(
            intrinsics_of(r#"{"camera_model": "pinhole", "k1": 0.1}"#, "{}").unwrap().distortion.is_none()
        );
    }

    #[test]
    fn other_spellings_are_read_where_they_mean_one_thing() {
        for text in [
            r#"{"fx": 9, "fy": 8, "cx": 5, "cy": 6, "width": 10, "height": 12}"#,
            r#"{"K": [[9, 0, 5], [0, 8, 6], [0, 0, 1]], "w": 10, "h": 12}"#,
            r#"{"intrinsic_matrix": [9, 0, 0, 0, 8, 0, 5, 6, 1], "w": 10, "h": 12}"#,
            r#"{"intrinsics": {"fx": 9, "fy": 8, "cx": 5, "cy": 6}, "w": 10, "h": 12}"#,
            r#"{"intrinsics": [[9, 0, 5, 0], [0, 8, 6, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "w": 10, "h": 12}"#,
        ] {
            for (top, own) in [(text, "{}"), ("{}", text)] {
                let (l, notes) = read(top, own).unwrap();
                assert_eq!((l.focal, l.center), ([Some(9.0), Some(8.0)], [Some(5.0), Some(6.0)]), "{text}");
                assert!(l.size == Some((10, 12)) && !notes.taken.is_empty(), "{text}");
            }
        }
        let l = intrinsics_of(r#"{"x_fov": 90}"#, "{}").unwrap();
        assert!((l.angle[0].unwrap() - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        // what is there by its own name is not replaced
        let l = intrinsics_of(r#"{"fl_x": 10, "fl_y": 10, "x_fov": 20}"#, r#"{"fx": 10, "K": [1, 2, 3]}"#)
            .unwrap();
        assert_eq!((l.focal, l.angle), ([Some(10.0), Some(10.0)], [None, None]));
    }

    #[test]
    fn what_is_not_read_and_says_something_else_than_what_is_read_is_refused() {
        let top = r#"{"fl_x": 500, "fl_y": 500, "cx": 48, "cy": 64, "w": 96, "h": 128}"#;
        for own in [
            r#"{"fx": 330}"#,
            r#"{"K": [[330, 0, 48], [0, 330, 64], [0, 0, 1]]}"#,
            r#"{"K": [[500, 0, 58], [0, 500, 64], [0, 0, 1]]}"#,
            r#"{"intrinsics": [500, 500, 58, 64]}"#,
        ] {
            let text = intrinsics_of(top, own).unwrap_err();
            assert!(text.contains("remove"), "{own}: {text}");
        }
        for own in [
            r#"{"fx": 500.1, "fy": 500}"#,
            r#"{"K": [[500, 0, 47.5], [0, 500, 63.5], [0, 0, 1]], "fov": 40}"#,
            r#"{"intrinsics": [500, 500, 48, 64]}"#,
            r#"{"intrinsics": [500, 48, 500, 64], "K": null}"#,
        ] {
            assert_eq!(intrinsics_of(top, own), intrinsics_of(top, "{}"), "{own}");
        }
        // 2 atan(48 / 330)
        let angle = |more: &str| intrinsics_of(&format!(r#"{{"camera_angle_x": 0.28888, {more}}}"#), "{}");
        let size = r#""w": 96, "h": 128"#;
        for more in ["[330, 330, 48, 64]", "[[330, 0, 48], [0, 330, 64], [0, 0, 1]]"] {
            assert!(angle(&format!(r#""intrinsics": {more}, {size}"#)).is_ok(), "{more}");
            assert!(angle(&format!(r#""intrinsics": {more}"#)).is_ok(), "{more}");
            let moved = more.replace("48", "58");
            assert!(
                angle(&format!(r#""intrinsics": {moved}, {size}"#)).unwrap_err().contains("`cx`"),
                "{moved}"
            );
        }
        // the photographs tell which size is theirs
        let (found, notes) = read(top, r#"{"width": 960, "height": 1280}"#).unwrap();
        assert_eq!(found.size, Some((96, 128)));
        assert!(notes.doubts.contains("`width` is 960, but `w` is 96, which is read"), "{:?}", notes.doubts);
    }

    #[test]
    fn a_fisheye_lens_may_be_told_by_a_number() {
        for (value, is_one) in [("1", true), ("0", false), ("true", true), ("2", false)] {
            let (found, notes) = read(&format!(r#"{{"is_fisheye": {value}, "fl_x": 9}}"#), "{}").unwrap();
            assert_eq!(
                found.distortion.projection == tiface_base::geom::Projection::Fisheye,
                is_one,
                "{value}"
            );
            assert_eq!(notes.misread.is_empty(), value != "2");
        }
    }

    #[test]
    fn a_focal_length_that_is_not_read_is_named_by_its_key() {
        let top: Object = serde_json::from_str(r#"{"fov": 40, "intrinsics": [9, 9, 5, 5]}"#).unwrap();
        let Fault::File { text, hint } = no_focal(&top, &Object::new()) else { panic!("of one frame") };
        assert!(text.contains("`intrinsics`, `fov` may hold it") && hint.contains("`fl_x`"), "{text}");
    }
}
