//! The keys of `transforms.json`, by the programs that write them: which are read, which change
//! nothing here, and which change what a file means although they are not supported.
//!
//! No key is passed over in silence: those that change nothing, or are not read because another one
//! is, are a reason, unknown ones and those in the wrong place a warning, and those that change the
//! meaning a warning or a problem of their own.

use super::{Object, moments, pose, spellings};
use crate::folder::{in_file, shortened};
use crate::frame::Listing;
use crate::masks::few;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// The keys of one program, separated by blanks.
struct Dialect {
    /// The programs, for messages.
    program: &'static str,
    /// Keys that are read.
    read: &'static str,
    /// Keys that say nothing about cameras or photographs, or nothing that matters here.
    harmless: &'static str,
}

/// All known keys, at the top of a file or in a frame. Those in [`CHANGES`] and the spellings in
/// [`spellings`] come on top.
const DIALECTS: [Dialect; 8] = [
    Dialect {
        program: "NeRF-Blender and D-NeRF",
        read: "frames file_path transform_matrix camera_angle_x camera_angle_y time",
        harmless: "rotation near far light_angle",
    },
    Dialect {
        program: "instant-ngp and BlenderNeRF",
        read: "w h fl_x fl_y x_fov y_fov cx cy k1 k2 k3 k4 p1 p2 is_fisheye up n_frames",
        // `scale`, `offset` and the boxes say how instant-ngp fits the world into its own cube
        harmless: "aabb_scale aabb render_aabb render_aabb_to_local scale offset sharpness \
                   sharpness_discard_threshold sharpen importance_sampling n_extra_learnable_dims \
                   enable_depth_loading enable_ray_loading integer_depth_scale depth_path envmap fix_premult \
                   normal_mts_args driver_parameters background_color",
    },
    Dialect {
        program: "nerfstudio",
        read: "camera_model distortion_params applied_transform applied_scale mask_path train_filenames \
               val_filenames test_filenames",
        harmless: "ply_file_path depth_file_path depth_unit_scale_factor normal_file_path semantic_file_path \
                   orientation_override colmap_im_id auto_scale_poses_override has_mask",
    },
    Dialect {
        program: "scanners on phones",
        read: "timestamp",
        harmless: "blur_score confidence_path depth_confidence_path exposure_time iso_speed",
    },
    Dialect {
        program: "VHAP and GaussianAvatars",
        read: "timestep_index timestep_id flame_param_path fg_mask_path",
        harmless: "timestep_indices timestep_index_original camera_indices camera_index camera_id \
                   static_flame_param_path canonical_flame_param_path",
    },
    Dialect {
        program: "INSTA, NerFace and HyperNeRF",
        read: "seg_mask_path exp_path mesh_path expression frame_time timestep time_step time_id time_index \
               warp_id",
        harmless: "bbox lms_path landmarks appearance_id exp bg_path",
    },
    Dialect {
        program: "sdfstudio",
        read: "",
        harmless: "mono_depth_path mono_normal_path has_mono_prior has_sensor_depth has_foreground_mask \
                   pairs worldtogt scene_box index",
    },
    Dialect {
        program: "tiface, and COLMAP's lens models",
        read: "k5 k6 sx1 sy1 omega split face_mask_path units unit",
        harmless: "bounds_near_far normal_path",
    },
];

/// Keys that are read at the top of a file only, besides those of [`spellings`].
const OF_FILES: &str = "frames up n_frames applied_transform applied_scale units unit train_filenames \
                        val_filenames test_filenames";

/// Keys that change what a file means, and are not supported.
struct Change {
    /// The spellings, separated by blanks.
    keys: &'static str,
    /// Whether a value has that effect.
    has_effect: fn(&Value) -> bool,
    /// Keys of which one beside it makes this one redundant, separated by blanks.
    unless: &'static str,
    says: &'static str,
    /// Advice; empty for a warning.
    hint: &'static str,
}

const CHANGES: [Change; 10] = [
    Change {
        keys: "rolling_shutter",
        has_effect: is_nonzero,
        unless: "",
        says: "the rows of a photograph were seen at different moments, which is not modeled",
        hint: "",
    },
    Change {
        keys: "transform_matrix_start transform_matrix_end",
        has_effect: is_given,
        unless: "",
        says: "the camera moved during the exposure, which is not modeled",
        hint: "",
    },
    Change {
        keys: "white_transparent black_transparent",
        has_effect: is_true,
        unless: "",
        says: "instant-ngp takes pixels of that color for background; here only masks say what is background",
        hint: "",
    },
    Change {
        keys: "is_bad",
        has_effect: is_true,
        unless: "",
        says: "ScanNet++ marks blurred photographs so and leaves them out; here they are used",
        hint: "",
    },
    Change {
        keys: "fisheye_crop_radius",
        has_effect: is_nonzero,
        unless: "",
        says: "nerfstudio uses a circle of each photograph; here all of it is used, unless `valid/NAME.npy` \
               says which pixels are usable",
        hint: "",
    },
    Change {
        keys: "ftheta_p0 latlong equirectangular skew",
        has_effect: is_true,
        unless: "",
        says: "such a lens is not supported",
        hint: "undistort the photographs first (panoramas: cut perspective views out of them), and write the \
               lens that is left",
    },
    Change {
        keys: "camera_type",
        has_effect: is_other_camera,
        unless: "camera_model",
        says: "it names a lens that is not perspective",
        hint: "write `camera_model`: `OPENCV`, `OPENCV_FISHEYE` or another of COLMAP's names",
    },
    Change {
        keys: "distortion distortions distortion_coefficients distortion_coeffs dist_coeffs dist \
               radial_distortion",
        has_effect: is_nonzero,
        unless: "k1 distortion_params",
        says: "the order of its coefficients is not known",
        hint: "write them by name: `k1`, `k2`, `p1`, `p2`, `k3` (OpenCV's order), or `k1` to `k4` and \
               `\"camera_model\": \"OPENCV_FISHEYE\"`",
    },
    Change {
        keys: "principal_point principal_point_x ppx",
        has_effect: is_given,
        unless: "cx",
        says: "the principal point is not read from it, since its unit and origin are not known",
        hint: "write `cx` and `cy` in pixels from the top left corner",
    },
    Change {
        keys: "tangential_distortion",
        has_effect: is_nonzero,
        unless: "p1 distortion_params",
        says: "its coefficients are not read",
        hint: "write them by name: `p1`, `p2`",
    },
];

fn is_given(value: &Value) -> bool {
    !value.is_null()
}

fn is_true(value: &Value) -> bool {
    !matches!(value, Value::Null | Value::Bool(false)) && value.as_f64() != Some(0.0)
}

/// Returns whether a number, or one in a list or an object, is not zero. JSON is read with bounded
/// depth.
fn is_nonzero(value: &Value) -> bool {
    match value {
        Value::Number(v) => v.as_f64() != Some(0.0),
        Value::Array(list) => list.iter().any(is_nonzero),
        Value::Object(object) => object.values().any(is_nonzero),
        _ => false,
    }
}

fn is_other_camera(value: &Value) -> bool {
    let name = value.as_str().unwrap_or_default().to_ascii_lowercase();
    !["", "perspective", "pinhole"].contains(&name.as_str())
}

/// The effect of a key, and the advice, which is empty for a warning.
type Word = (&'static str, &'static str);

/// Keys of the axes of cameras, or of the world.
const AXES: &str = "coordinate_system coordinate_convention camera_convention convention";

/// Returns what a value of one of [`AXES`] changes; nothing for the axes that are taken here.
fn axes(key: &str, value: &Value) -> Option<Word> {
    let name = value.as_str().unwrap_or_default().to_ascii_lowercase().replace([' ', '-'], "_");
    let has = |words: &str| words.split(' ').any(|word| name.contains(word));
    let opencv = (
        "cameras look along +Z with +Y down there, and along -Z with +Y up here",
        "negate the second and third column of each `transform_matrix` (camera to world), and remove the key",
    );
    if value.is_null() || value.as_str().is_some_and(|text| text.trim().is_empty()) || name == "gl" {
        None
    } else if has("opencv open_cv colmap rdf") {
        Some(opencv)
    } else if has("w2c world2cam world_to_cam worldtocam") && !has("c2w") {
        Some((
            "each `transform_matrix` must take the camera to the world, and this says the opposite",
            "invert each matrix (`numpy.linalg.inv`) and remove the key; if they are camera to world already, only \
             remove it",
        ))
    } else if has("left_hand lefthand") {
        Some((
            "axes are right-handed here",
            "write right-handed poses: camera to world, the camera with +X right, +Y up and looking along -Z",
        ))
    } else if has("opengl open_gl blender nerf ngp arkit rub right_up_back right_hand righthand")
        || has("c2w cam2world cam_to_world camera_to_world camtoworld z_up y_up")
    {
        None
    } else if has("down") {
        Some(opencv)
    } else if key == "camera_convention" {
        Some((
            "its value is not known, and poses depend on it",
            "write `transform_matrix` as camera to world, the camera with +X right, +Y up and looking along -Z, \
             and `opengl` here",
        ))
    } else {
        let says = "its value is not known and not looked at; poses are taken as camera to world, with cameras \
                    that have +X right, +Y up and look along -Z";
        Some((says, ""))
    }
}

/// Where a key is read.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Place {
    Anywhere,
    Top,
    Frame,
}

/// How a known key is used.
#[derive(Clone, Copy)]
enum Use {
    Read(Place),
    /// With what is read instead.
    Beaten(&'static str),
    /// With the programs that write it; empty for spellings of several.
    Ignored(&'static str),
    Changes(&'static Change),
    /// One of [`AXES`].
    Axes,
}

/// The keys of a file, as they are met.
pub(super) struct KeyLog {
    known: HashMap<&'static str, Use>,
    ignored: BTreeSet<&'static str>,
    /// The programs that write these.
    programs: BTreeSet<&'static str>,
    /// Keys that are not read because others are, and the reason.
    beaten: BTreeSet<(String, &'static str)>,
    /// Keys that are read elsewhere only, at the top and in frames.
    misplaced: [BTreeSet<&'static str>; 2],
    unknown: BTreeSet<String>,
    /// By key: the change, its value where that is a word, where it was first met, and how often.
    changes: BTreeMap<&'static str, (Word, String, String, usize)>,
}

/// Maximum number of unknown keys that are remembered.
const MAX_UNKNOWN: usize = 1000;

impl KeyLog {
    pub fn new() -> KeyLog {
        let words = |text: &'static str, is: Use| text.split_whitespace().map(move |key| (key, is));
        let read = |place| Use::Read(place);
        let dialects = DIALECTS.iter().flat_map(|d| {
            words(d.read, read(Place::Anywhere)).chain(words(d.harmless, Use::Ignored(d.program)))
        });
        let aliases = spellings::ALIASES.iter().map(|(key, of)| match *of {
            "file_path" => (*key, Use::Read(Place::Frame)),
            _ => (*key, Use::Read(Place::Anywhere)),
        });
        let matrices = spellings::MATRICES.iter().map(|key| (*key, Use::Read(Place::Anywhere)));
        let focal = spellings::FOCAL_WORDS
            .iter()
            .map(|key| (*key, Use::Beaten("a focal length or an angle is there")));
        let poses = pose::names().map(|key| (key, Use::Beaten("`transform_matrix` is there")));
        let changes = CHANGES.iter().flat_map(|change| words(change.keys, Use::Changes(change)));
        let axes = words(AXES, Use::Axes);
        let moments = moments::KEYS.iter().filter(|(_, is_telling)| *is_telling);
        let frames = moments.map(|(key, _)| (*key, Use::Read(Place::Frame)));
        let frames = frames.chain(words(spellings::FRAME_KEYS, read(Place::Frame)));
        let frames = frames.chain([("transform_matrix", Use::Read(Place::Frame))]);
        let files = words(OF_FILES, read(Place::Top));
        // what comes later counts
        let known = focal.chain(poses).chain(dialects).chain(aliases).chain(matrices);
        let known = known.chain(changes).chain(axes).chain(frames).chain(files).collect();
        KeyLog {
            known,
            ignored: BTreeSet::new(),
            programs: BTreeSet::new(),
            beaten: BTreeSet::new(),
            misplaced: [BTreeSet::new(), BTreeSet::new()],
            unknown: BTreeSet::new(),
            changes: BTreeMap::new(),
        }
    }

    /// Looks at the keys of the top of a file (`place` is empty) or of a frame.
    pub fn look(&mut self, object: &Object, place: &str) {
        let here = if place.is_empty() { Place::Top } else { Place::Frame };
        for (key, value) in object {
            let word = match self.known.get_key_value(key.as_str()) {
                Some((key, Use::Read(there))) => {
                    if ![Place::Anywhere, here].contains(there) && !value.is_null() {
                        self.misplaced[usize::from(here == Place::Frame)].insert(*key);
                    }
                    None
                }
                Some((key, Use::Beaten(by))) => {
                    if !value.is_null() {
                        self.beaten.insert((by.to_string(), *key));
                    }
                    None
                }
                Some((key, Use::Ignored(program))) => {
                    self.ignored.insert(*key);
                    self.programs.insert(*program);
                    None
                }
                Some((key, Use::Changes(change))) => {
                    let says_so = |key| object.get(key).is_some_and(|v| is_nonzero(v) || v.is_string());
                    let is_redundant = change.unless.split(' ').any(says_so);
                    let has_effect = !is_redundant && (change.has_effect)(value);
                    has_effect.then_some((*key, (change.says, change.hint)))
                }
                Some((key, Use::Axes)) => axes(key, value).map(|word| (*key, word)),
                None => {
                    if self.unknown.len() < MAX_UNKNOWN {
                        self.unknown.insert(shortened(key));
                    }
                    None
                }
            };
            if let Some((key, word)) = word {
                let shown = value.as_str().map_or(String::new(), |text| format!(" (`{}`)", shortened(text)));
                let first = || (word, shown, place.to_string(), 0);
                self.changes.entry(key).or_insert_with(first).3 += 1;
            }
        }
    }

    /// Says what was not looked at, spellings that were `skipped` included, and refuses what
    /// changes the meaning. What something else stands for is named only where that could be read.
    pub fn report(
        mut self,
        file: &str,
        skipped: BTreeSet<(String, &'static str)>,
        has_failed: bool,
        listing: &mut Listing,
    ) {
        if !self.ignored.is_empty() {
            let programs: Vec<&str> = self.programs.into_iter().collect();
            let (names, of) = (few(&self.ignored), programs.join("; "));
            listing
                .reasons
                .push(format!("not looked at in `{file}`, since nothing here depends on it: {names} ({of})"));
        }
        self.beaten.extend(skipped);
        let mut beaten: BTreeMap<String, Vec<&str>> = BTreeMap::new();
        for (by, key) in self.beaten.into_iter().filter(|_| !has_failed) {
            beaten.entry(by).or_default().push(key);
        }
        let not_read =
            |(by, keys): (String, Vec<&str>)| format!("not read in `{file}`, since {by}: {}", few(keys));
        listing.reasons.extend(beaten.into_iter().map(not_read));
        let places = ["at the top, but they belong into frames", "in frames, but they belong to the top"];
        for (place, keys) in places.into_iter().zip(&self.misplaced).filter(|(_, keys)| !keys.is_empty()) {
            listing
                .warnings
                .push(format!("`{file}` has keys {place}, and they are not looked at there: {}", few(keys)));
        }
        if !self.unknown.is_empty() {
            let names = few(&self.unknown);
            listing.warnings.push(format!(
                "`{file}` has keys that are not known and not looked at: {names}; if one says how cameras \
                 stand or see, the result will be wrong"
            ));
        }
        for (key, ((says, hint), shown, place, count)) in self.changes {
            let frames = match (place.as_str(), count) {
                ("", _) => String::new(),
                (first, 1) => format!(" of frame `{first}`"),
                (first, n) => format!(" of {n} frames, the first `{first}`"),
            };
            if hint.is_empty() {
                listing.warnings.push(format!("`{file}`: `{key}`{shown}{frames}: {says}"));
            } else {
                listing.problems.push(in_file(file, format_args!("`{key}`{shown}{frames}: {says}"), hint));
            }
        }
    }
}

/// Returns the meters of the unit that a file names, if that is a known unit of length.
pub(super) fn unit_m(top: &Object) -> Option<(&str, f64)> {
    let name = ["units", "unit"].iter().find_map(|key| top.get(*key)?.as_str())?;
    let meters = match name.trim().to_ascii_lowercase().trim_end_matches('s') {
        "m" | "metre" | "meter" => 1.0,
        "dm" | "decimetre" | "decimeter" => 0.1,
        "cm" | "centimetre" | "centimeter" => 0.01,
        "mm" | "millimetre" | "millimeter" => 0.001,
        "in" | "inch" | "inche" => 0.0254,
        _ => return None,
    };
    Some((name, meters))
}

#[cfg(test)]
mod tests {
    use super::super::agreement::FOCAL_KEYS;
    use super::*;

    #[test]
    fn every_key_is_in_one_dialect_and_those_for_all_frames_are_read() {
        let mut seen: HashMap<&str, &str> = HashMap::new();
        for Dialect { program, read, harmless } in &DIALECTS {
            for key in read.split_whitespace().chain(harmless.split_whitespace()) {
                assert_eq!(seen.insert(key, program), None, "`{key}` of {program}");
            }
        }
        let log = KeyLog::new();
        for key in spellings::SHARED_KEYS.split(' ').chain(FOCAL_KEYS) {
            assert!(matches!(log.known.get(key), Some(Use::Read(_))), "`{key}`");
        }
        for (alias, key) in spellings::ALIASES {
            assert!(
                matches!(log.known.get(alias), Some(Use::Read(_))) && seen.contains_key(key),
                "`{alias}`"
            );
        }
    }

    #[test]
    fn what_is_not_known_is_a_warning_and_what_changes_the_meaning_has_a_word() {
        let top = r#"{"fl_x": 9, "aabb_scale": 16, "lens_id": 3, "latlong": true, "rolling_shutter": [0, 0, 0, 0]}"#;
        let mut log = KeyLog::new();
        log.look(&serde_json::from_str(top).unwrap(), "");
        log.look(&serde_json::from_str(r#"{"dist": [0.1, 0, 0, 0]}"#).unwrap(), "a.png");
        log.look(&serde_json::from_str(r#"{"dist": [0.1, 0, 0, 0], "k1": 0.1}"#).unwrap(), "b.png");
        let mut listing = Listing::default();
        log.report("t.json", BTreeSet::new(), false, &mut listing);
        assert!(matches!(&listing.reasons[..], [r] if r.contains("`aabb_scale`")), "{:?}", listing.reasons);
        assert!(matches!(&listing.warnings[..], [w] if w.contains("`lens_id`")), "{:?}", listing.warnings);
        let problems: Vec<String> = listing.problems.iter().map(tiface_base::Error::to_string).collect();
        assert_eq!(
            problems,
            [
                "`t.json`: `dist` of frame `a.png`: the order of its coefficients is not known",
                "`t.json`: `latlong`: such a lens is not supported"
            ]
        );
    }

    #[test]
    fn keys_in_the_wrong_place_and_those_that_others_stand_for_have_a_word() {
        let mut log = KeyLog::new();
        let top =
            r#"{"split": {"train": []}, "mask_path": "x", "timestep_index": 3, "timestamp": 1, "up": [0]}"#;
        log.look(&serde_json::from_str(top).unwrap(), "");
        let own =
            r#"{"split": "train", "up": [0, 1, 0], "applied_scale": 3, "fov": 40, "pose": [1], "time": 0.5}"#;
        log.look(&serde_json::from_str(own).unwrap(), "a.png");
        let mut listing = Listing::default();
        log.report("t.json", BTreeSet::from([("`fl_x` is there".to_string(), "fx")]), false, &mut listing);
        let has = |texts: &[String], words: &[&str]| {
            assert!(
                texts.iter().any(|text| words.iter().all(|word| text.contains(word))),
                "{words:?}: {texts:?}"
            );
        };
        has(&listing.warnings, &["at the top", "`mask_path`", "`split`", "`timestep_index`"]);
        has(&listing.warnings, &["in frames", "`applied_scale`", "`up`"]);
        assert!(listing.warnings.len() == 2 && listing.problems.is_empty(), "{listing:?}");
        has(&listing.reasons, &["a focal length or an angle is there", "`fov`"]);
        has(&listing.reasons, &["`transform_matrix` is there", "`pose`"]);
        has(&listing.reasons, &["`fl_x` is there", "`fx`"]);
        assert!(listing.reasons.iter().all(|r| !r.contains("depends on it")), "{:?}", listing.reasons);
    }

    #[test]
    fn only_known_words_for_the_axes_that_are_taken_pass() {
        let word = |key: &str, name: &str| axes(key, &Value::from(name));
        for name in ["", "OpenGL", "opengl_c2w", "Blender", "nerfstudio", "c2w", "gl", "right-handed", "RUB"]
        {
            assert_eq!(word("camera_convention", name), None, "{name}");
        }
        for (name, hint) in [
            ("OpenCV", "negate"),
            ("colmap", "negate"),
            ("x right, y down, z forward", "negate"),
            ("w2c", "numpy.linalg.inv"),
            ("world-to-camera", "numpy.linalg.inv"),
            ("RUB_left_handed", "right-handed"),
        ] {
            let found = word("coordinate_system", name).unwrap();
            assert!(found.1.contains(hint), "{name}: {found:?}");
        }
        assert!(word("camera_convention", "xyz").unwrap().1.contains("`opengl`"));
        assert!(word("coordinate_system", "EPSG:4326").unwrap().1.is_empty());
        assert!(
            axes("convention", &serde_json::json!(3)).is_some() && axes("convention", &Value::Null).is_none()
        );
    }

    #[test]
    fn units_are_known_in_both_spellings() {
        let unit =
            |name: &str| unit_m(serde_json::json!({ "units": name }).as_object().unwrap()).map(|u| u.1);
        assert_eq!(
            ["metres", "Meters", "m", "mm", "inches"].map(unit),
            [1.0, 1.0, 1.0, 0.001, 0.0254].map(Some)
        );
        assert_eq!(unit("arbitrary"), None);
    }
}
