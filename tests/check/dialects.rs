//! `transforms.json` as other programs write it: read like the plain file, or refused with a word
//! on what is there.

use crate::kept::photographed;
use serde_json::{Value, json};
use std::fs;
use std::process::Command;
use tempfile::TempDir;
use tiface::capture::inspect::{Inspection, inspect};
use tiface::capture::synthetic::SyntheticOptions;
use tiface::capture::{self, Capture, CaptureOptions, Split, ViewMask};

/// Six photographs to learn from and two held out, with one camera file that is written as `edit`
/// leaves it.
fn made(edit: impl FnOnce(&mut Value)) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    photographed(dir.path(), &SyntheticOptions { width: 24, height: 32, train: 6, test: 2, seed: 1 });
    for file in ["transforms_train.json", "transforms_test.json"] {
        fs::remove_file(dir.path().join(file)).unwrap();
    }
    let file = dir.path().join("transforms.json");
    let mut json: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    edit(&mut json);
    fs::write(&file, json.to_string()).unwrap();
    dir
}

fn frames(json: &mut Value) -> &mut Vec<Value> {
    json["frames"].as_array_mut().unwrap()
}

fn open(dir: &TempDir) -> Capture {
    capture::open(dir.path(), &CaptureOptions::default()).unwrap()
}

fn inspected(dir: &TempDir) -> Inspection {
    inspect(dir.path(), &CaptureOptions::default())
}

/// Gives an object's value another key.
fn rename(object: &mut Value, from: &str, to: &str) {
    let object = object.as_object_mut().unwrap();
    let value = object.remove(from).unwrap();
    object.insert(to.into(), value);
}

/// Removes keys of an object.
fn without(object: &mut Value, keys: &[&str]) {
    object.as_object_mut().unwrap().retain(|key, _| !keys.contains(&key.as_str()));
}

/// Asserts that two captures have the same cameras, splits and masks.
fn assert_same(found: &Capture, plain: &Capture) {
    assert_eq!(found.views.len(), plain.views.len());
    for (a, b) in found.views.iter().zip(&plain.views) {
        assert_eq!(
            (&a.name, a.split, a.mask == ViewMask::None),
            (&b.name, b.split, b.mask == ViewMask::None)
        );
        let (c, d) = (&a.camera, &b.camera);
        assert_eq!(
            (c.width, c.height, c.cx, c.cy, c.distortion),
            (d.width, d.height, d.cx, d.cy, d.distortion)
        );
        assert!((c.fx / d.fx - 1.0).abs() < 1e-12 && (c.fy / d.fy - 1.0).abs() < 1e-12, "{}", a.name);
        assert!(c.position == d.position && c.rotation == d.rotation, "{}", a.name);
    }
}

/// Asserts that a capture has one problem, whose words and fix hold these.
fn assert_refused(dir: &TempDir, words: &[&str], fixes: &[&str]) {
    let found = inspected(dir);
    let [problem] = &found.problems[..] else { panic!("{found}") };
    let text = problem.to_string();
    assert!(words.iter().all(|word| text.contains(word)), "{words:?}: {found}");
    assert!(fixes.iter().all(|word| problem.hint.contains(word)), "{fixes:?}: {found}");
}

#[test]
fn distortion_params_of_frames_and_of_the_whole_file_are_no_longer_dropped() {
    let list = json!([-0.5, 0.1, 0.02, 0, 0.001, 0.002]);
    for at_the_top in [true, false] {
        let dir = made(|json| match at_the_top {
            true => json["distortion_params"] = list.clone(),
            false => frames(json).iter_mut().for_each(|frame| frame["distortion_params"] = list.clone()),
        });
        for view in &open(&dir).views {
            let d = view.camera.distortion;
            assert_eq!((d.k1, d.k2, d.k3, d.p1, d.p2), (-0.5, 0.1, 0.02, 0.001, 0.002));
        }
    }
    let dir = made(|json| json["distortion_params"] = json!([-0.5, 0.1, 0.001, 0.002]));
    assert_refused(&dir, &["distortion_params", "k1, k2, k3, k4, p1, p2"], &["correct"]);
}

#[test]
fn three_moments_of_a_head_are_refused_with_a_command_that_leaves_one() {
    let dir = made(|json| {
        let all = frames(json).clone();
        let at = |moment: usize| all.iter().map(move |frame| (moment, frame));
        let all: Vec<Value> = [0, 1, 2]
            .into_iter()
            .flat_map(at)
            .map(|(moment, frame)| {
                let mut frame = frame.clone();
                let name = frame["file_path"].as_str().unwrap().replace(".png", &format!("_{moment}.png"));
                frame["file_path"] = name.into();
                frame["timestep_index"] = moment.into();
                frame
            })
            .collect();
        *frames(json) = all;
    });
    for entry in fs::read_dir(dir.path().join("images")).unwrap() {
        let photo = entry.unwrap().path();
        for moment in 0..3 {
            let name = format!("{}_{moment}.png", photo.file_stem().unwrap().to_str().unwrap());
            fs::copy(&photo, photo.with_file_name(name)).unwrap();
        }
    }
    let found = inspected(&dir);
    let of = |p: &&capture::inspect::Problem| p.what.contains("3 moments (`timestep_index`: `0`, `1`, `2`)");
    let problem = found.problems.iter().find(of).unwrap_or_else(|| panic!("{found}"));
    let command = problem.hint.split('`').find(|part| part.starts_with("python3 ")).unwrap();
    if Command::new("python3").arg("--version").output().is_err() {
        return eprintln!("skipped: no `python3` to run the command of the hint");
    }
    if cfg!(unix) {
        let output = Command::new("sh").args(["-c", command]).current_dir(dir.path()).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        assert_eq!(open(&dir).views.len(), 8);
    }
}

#[test]
fn a_video_of_a_head_that_holds_still_is_no_moving_head() {
    let dir = made(|json| {
        frames(json).iter_mut().enumerate().for_each(|(i, frame)| frame["time"] = json!(i as f64 / 7.0));
    });
    let capture = open(&dir);
    assert!(capture.warnings.iter().any(|w| w.contains("8 moments (`time`)")), "{:?}", capture.warnings);
    let dir = made(|json| frames(json).iter_mut().for_each(|frame| frame["time"] = json!(0.5)));
    assert!(open(&dir).warnings.iter().all(|w| !w.contains("moment")));
}

/// Writes which photographs are for what into lists, as `spell` does, in the place of each frame's
/// own split.
fn listed(json: &mut Value, spell: fn(&str) -> String) {
    let mut lists = [vec![], vec![]];
    for frame in frames(json) {
        let frame = frame.as_object_mut().unwrap();
        let is_test = frame.remove("split").unwrap() == "test";
        lists[usize::from(is_test)].push(spell(frame["file_path"].as_str().unwrap()));
    }
    let [train, test] = lists;
    json["train_filenames"] = json!(train);
    json["test_filenames"] = json!(test);
}

#[test]
fn lists_of_splits_that_spell_names_otherwise_are_found_all_the_same() {
    let plain = open(&made(|_| {}));
    let spellings: [fn(&str) -> String; 6] = [
        |name| name.into(),
        |name| format!("./{name}"),
        |name| name.replace('/', "\\"),
        |name| name.replace("images/", ""),
        |name| name.replace(".png", ".jpg"),
        |name| format!("/home/someone/head/{name}"),
    ];
    for spell in spellings {
        assert_same(&open(&made(|json| listed(json, spell))), &plain);
    }
    let dir = made(|json| listed(json, |name| name.replace("images/", "frame_")));
    assert_refused(&dir, &["train_filenames", "frame_000.png"], &["file_path"]);
}

#[test]
fn photographs_in_no_list_of_splits_are_left_out_with_a_word() {
    let dir = made(|json| {
        listed(json, |name| name.into());
        json["train_filenames"].as_array_mut().unwrap().pop();
        json["test_filenames"].as_array_mut().unwrap().push("images/none.png".into());
    });
    let capture = open(&dir);
    let count = |split| capture.split(split).count();
    assert_eq!((count(Split::Train), count(Split::Test)), (5, 2));
    for word in ["left out", "`images/none.png`"] {
        assert!(capture.warnings.iter().any(|w| w.contains(word)), "{word}: {:?}", capture.warnings);
    }
}

#[test]
fn columns_in_the_place_of_rows_are_one_problem_of_the_file() {
    let transposed = |matrix: &Value| {
        let rows: [[f64; 4]; 4] = serde_json::from_value(matrix.clone()).unwrap();
        [0, 1, 2, 3].map(|c| rows.map(|row| row[c]))
    };
    for is_flat in [false, true] {
        let dir = made(|json| {
            for frame in frames(json) {
                let columns = transposed(&frame["transform_matrix"]);
                frame["transform_matrix"] = if is_flat { json!(columns.concat()) } else { json!(columns) };
            }
        });
        assert_refused(&dir, &["transposed", "8 of 8 frames"], &["numpy.array(matrix).T"]);
    }
    // one list, row by row, is read
    let flat = made(|json| {
        for frame in frames(json) {
            let rows: [[f64; 4]; 4] = serde_json::from_value(frame["transform_matrix"].clone()).unwrap();
            frame["transform_matrix"] = json!(rows.concat());
        }
    });
    assert_same(&open(&flat), &open(&made(|_| {})));
}

#[test]
fn a_pose_by_another_name_is_one_problem_that_names_it() {
    for (key, way) in
        [("c2w", "rename"), ("world_to_camera", "numpy.linalg.inv"), ("extrinsics", "world to camera")]
    {
        let dir =
            made(|json| frames(json).iter_mut().for_each(|frame| rename(frame, "transform_matrix", key)));
        assert_refused(&dir, &["no `transform_matrix`", key, "8 of 8 frames"], &[way, "+Y up"]);
    }
}

#[test]
fn normalized_principal_points_and_focal_lengths_are_told_in_pixels() {
    let dir = made(|json| (json["cx"], json["cy"]) = (json!(0.5), json!(0.5)));
    assert_refused(
        &dir,
        &["8 of 8 frames", "principal point", "normalized", "`cx` is 12.0 and `cy` is 16.0"],
        &[],
    );
    let dir = made(|json| (json["fl_x"], json["fl_y"]) = (json!(1.2), json!(1.2)));
    assert_refused(&dir, &["8 of 8 frames", "`fl_x` is 1.2", "normalized", "28.8 pixels"], &[]);
}

#[test]
fn lenses_by_the_keys_of_other_programs_are_read() {
    let plain = open(&made(|_| {}));
    let angle = 2.0 * (12.0 / plain.views[0].camera.fx).atan();
    let focal_in_frames = |json: &mut Value, key: &str, value: &dyn Fn(f64) -> Value| {
        let focal = json["fl_x"].as_f64().unwrap();
        without(json, &["fl_x", "fl_y", "cx", "cy"]);
        frames(json).iter_mut().for_each(|frame| frame[key] = value(focal));
    };
    let rows = |f: f64| json!([[f, 0, 12], [0, f, 16], [0, 0, 1]]);
    let made = [
        made(|json| {
            for (from, to) in [("fl_x", "fx"), ("fl_y", "fy"), ("w", "width"), ("h", "height")] {
                rename(json, from, to);
            }
        }),
        made(|json| {
            json["x_fov"] = angle.to_degrees().into();
            without(json, &["fl_x", "fl_y"]);
        }),
        made(|json| focal_in_frames(json, "intrinsic_matrix", &rows)),
        made(|json| focal_in_frames(json, "K", &|f| json!([f, 0, 0, 0, f, 0, 12, 16, 1]))),
        made(|json| focal_in_frames(json, "intrinsics", &|f| json!({"fx": f, "fy": f, "cx": 12, "cy": 16}))),
        made(|json| json["camera_model"] = "pinhole".into()),
        made(|json| frames(json).iter_mut().for_each(|frame| rename(frame, "file_path", "image_path"))),
    ];
    for (dir, word) in
        made.iter().zip(["`fx`", "`x_fov`", "`intrinsic_matrix`", "`K`", "`intrinsics`", "", "`image_path`"])
    {
        let found = open(dir);
        assert_same(&found, &plain);
        assert!(found.reasons.iter().any(|reason| reason.contains(word)), "{word}: {:?}", found.reasons);
    }
}

#[test]
fn a_focal_length_of_unknown_unit_is_named_by_its_key() {
    for (key, value) in
        [("focal_length", json!(50)), ("fov", json!(0.4)), ("intrinsics", json!([330, 330, 12, 16]))]
    {
        let dir = made(|json| {
            without(json, &["fl_x", "fl_y"]);
            json[key] = value;
        });
        assert_refused(&dir, &[&format!("`{key}`"), "8 of 8 frames"], &["`fl_x`", "`camera_angle_x`"]);
    }
}

#[test]
fn a_list_around_the_object_and_named_frames_are_read() {
    let plain = open(&made(|_| {}));
    let in_list = made(|json| *json = json!([json.take()]));
    let named = made(|json| {
        let named = |frame: &mut Value| {
            let name = frame.as_object_mut().unwrap().remove("file_path").unwrap();
            (name.as_str().unwrap().to_string(), frame.take())
        };
        let all = frames(json).iter_mut().map(named).collect();
        json["frames"] = Value::Object(all);
    });
    for dir in [in_list, named] {
        assert_same(&open(&dir), &plain);
    }
}

#[test]
fn masks_by_the_keys_of_vhap_and_insta_are_used_and_named() {
    for key in ["fg_mask_path", "seg_mask_path"] {
        let dir = made(|json| {
            for frame in frames(json) {
                let mask = frame["mask_path"].as_str().unwrap().replace("masks/", "fg_masks/");
                frame.as_object_mut().unwrap().remove("mask_path");
                frame[key] = mask.into();
            }
        });
        fs::rename(dir.path().join("masks"), dir.path().join("fg_masks")).unwrap();
        let found = open(&dir);
        assert_same(&found, &open(&made(|_| {})));
        let reason = format!("head masks from `{key}` of each frame, for 8 of 8 views");
        assert!(found.reasons.contains(&reason), "{:?}", found.reasons);
        // named, and not there
        fs::remove_dir_all(dir.path().join("fg_masks")).unwrap();
        let warnings = open(&dir).warnings;
        assert!(warnings.iter().any(|w| w.contains(key) && w.contains("missing")), "{warnings:?}");
    }
}

#[test]
fn no_key_is_passed_over_in_silence() {
    let dir = made(|json| {
        json["aabb_scale"] = 16.into();
        json["n_frames"] = 3.into();
        json["units"] = "millimeters".into();
        json["white_transparent"] = true.into();
        json["is_fisheye"] = "no".into();
        json["height"] = 1.7.into();
        frames(json).iter_mut().for_each(|frame| frame["lens_id"] = 7.into());
    });
    let capture = open(&dir);
    assert!(capture.reasons.iter().any(|r| r.contains("`aabb_scale`")), "{:?}", capture.reasons);
    assert!(capture.reasons.iter().any(|r| r.contains("`height`")), "{:?}", capture.reasons);
    for word in ["`lens_id`", "`n_frames`", "capture.unit_m = 0.001", "`white_transparent`", "`is_fisheye`"] {
        assert!(capture.warnings.iter().any(|w| w.contains(word)), "{word}: {:?}", capture.warnings);
    }
    assert!(open(&made(|_| {})).warnings.is_empty());
    for (key, value, word) in [
        ("dist_coeffs", json!([0.1, 0, 0, 0]), "order of its coefficients"),
        ("latlong", json!(true), "lens is not supported"),
        ("coordinate_system", json!("OpenCV"), "+Z"),
    ] {
        let found = inspected(&made(|json| json[key] = value));
        let is_said =
            found.problems.iter().any(|p| p.what.contains(&format!("`{key}`")) && p.what.contains(word));
        assert!(is_said, "{key}: {found}");
    }
}

#[test]
fn one_normalized_coordinate_of_the_principal_point_is_no_longer_taken_for_a_pixel() {
    let dir = made(|json| json["cx"] = json!(0.5));
    assert_refused(&dir, &["`cx` of the principal point is 0.5", "normalized", "`cx` is 12.0"], &[]);
}

#[test]
fn files_with_other_capitals_are_read_and_those_of_another_name_are_told_to_be_renamed() {
    let plain = open(&made(|_| {}));
    let renamed = |to: &str| {
        let dir = made(|_| {});
        fs::rename(dir.path().join("transforms.json"), dir.path().join(to)).unwrap();
        dir
    };
    for name in ["Transforms.json", "transforms.JSON"] {
        assert_same(&open(&renamed(name)), &plain);
    }
    for name in ["transforms_all.json", "head.json"] {
        assert_refused(&renamed(name), &[name, "by another name"], &["rename it to `transforms.json`"]);
    }
}

#[test]
fn a_spelling_that_says_something_else_than_the_one_that_is_read_is_a_problem() {
    let edits: [fn(&mut Value); 3] = [
        |json| json["fx"] = json!(2.0 * json["fl_x"].as_f64().unwrap()),
        |json| json["K"] = json!([[2.0 * json["fl_x"].as_f64().unwrap(), 0, 12], [0, 900, 16], [0, 0, 1]]),
        |json| {
            let f = json["fl_x"].as_f64().unwrap();
            json["camera_angle_x"] = (2.0 * (12.0 / f).atan()).into();
            without(json, &["fl_x", "fl_y", "cx", "cy"]);
            json["intrinsics"] = json!([f, f, 20, 16]);
        },
    ];
    for (edit, key) in edits.into_iter().zip(["`fx`", "`K`", "`intrinsics`"]) {
        assert_refused(&made(edit), &[key], &["all its photographs"]);
    }
    // those that agree are only named
    let same = open(&made(|json| {
        json["fx"] = json["fl_x"].clone();
        json["fov"] = 40.into();
    }));
    for words in ["since `fl_x` is there: `fx`", "since a focal length or an angle is there: `fov`"] {
        assert!(same.reasons.iter().any(|r| r.contains(words)), "{words}: {:?}", same.reasons);
    }
    assert_same(&same, &open(&made(|_| {})));
}

#[test]
fn keys_in_the_wrong_place_and_unknown_axes_are_no_longer_silent() {
    let found = open(&made(|json| {
        json["timestep_index"] = 3.into();
        json["image_name"] = "head".into();
        json["coordinate_system"] = "EPSG:4326".into();
        frames(json).iter_mut().for_each(|frame| frame["applied_scale"] = 3.into());
    }));
    for word in ["`timestep_index`", "`image_name`", "(`EPSG:4326`)", "`applied_scale`"] {
        assert!(found.warnings.iter().any(|w| w.contains(word)), "{word}: {:?}", found.warnings);
    }
    let dir = made(|json| json["camera_convention"] = "w2c".into());
    assert_refused(&dir, &["`camera_convention` (`w2c`)", "camera to the world"], &["numpy.linalg.inv"]);
}

#[test]
fn what_the_top_of_a_file_says_wrongly_is_a_problem_of_the_file() {
    let edits: [fn(&mut Value); 3] = [
        |json| json["fl_x"] = "330".into(),
        |json| json["k1"] = json!([0.1]),
        |json| {
            without(json, &["fl_x", "fl_y"]);
            json["camera_angle_x"] = 16.55.into();
        },
    ];
    for edit in edits {
        assert_refused(&made(edit), &["8 of 8 frames"], &["all its photographs"]);
    }
    let dir = made(|json| frames(json)[2]["fl_x"] = "330".into());
    assert_refused(&dir, &["frame `images/"], &["that frame"]);
}

#[test]
fn an_upright_photograph_is_not_said_to_lie_on_its_side() {
    let dir = made(|json| {
        (json["w"], json["h"], json["cx"], json["cy"]) = (json!(32), json!(24), json!(16), json!(12));
    });
    assert_refused(&dir, &["24 × 32", "32 × 24"], &["`w` and `h`", "exchanged"]);
}
