//! Camera files that are nearly right, models in other places, and the known cameras of other
//! programs: read, or named with a way that works.

use crate::capture_folder::{open, put};
use crate::command::{code, err, out, tiface};
use glam::{DMat3, DQuat, DVec3, Vec3};
use std::fs;
use tempfile::TempDir;
use tiface::capture::{Capture, Split};
use tiface::io;

const SIZE: (u32, u32) = (24, 32);
const VIEWS: usize = 5;

fn photograph(dir: &TempDir, name: &str, size: (u32, u32)) {
    let path = dir.path().join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let rgb: Vec<[u8; 3]> = (0..size.0 * size.1).map(|i| [i as u8, (i / 7) as u8, 40]).collect();
    io::write_png_rgb(&path, size.0, size.1, &rgb).unwrap();
}

/// A folder with photographs `00.png` and so on.
fn photographs(folder: &str) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    (0..VIEWS).for_each(|i| photograph(&dir, &format!("{folder}/{i:02}.png"), SIZE));
    dir
}

/// What opening a folder says: the message and the suggested fix, with `ROOT` for the folder of the
/// test.
fn refused(dir: &TempDir, inner: &str) -> (String, String) {
    let e = open(&dir.path().join(inner)).unwrap_err();
    let roots = [dir.path().canonicalize().unwrap(), dir.path().to_path_buf()];
    let plain = |text: &str| {
        roots.iter().fold(text.to_string(), |text, root| text.replace(&root.display().to_string(), "ROOT"))
    };
    (plain(&e.to_string()), plain(e.hint()))
}

fn says(dir: &TempDir, inner: &str, words: &[&str]) {
    let (message, hint) = refused(dir, inner);
    for word in words {
        assert!(message.contains(word) || hint.contains(word), "`{word}` is missing in: {message}; {hint}");
    }
}

/// OpenCV camera in the world (columns right, down, ahead) and its position.
fn pose(i: usize) -> (DMat3, DVec3) {
    let a = 0.3 + 0.6 * i as f64;
    let ahead = DVec3::new(-a.cos(), -a.sin(), -0.2).normalize();
    let right = ahead.cross(DVec3::Z).normalize();
    (DMat3::from_cols(right, ahead.cross(right), ahead), DVec3::new(2.0 * a.cos(), 2.0 * a.sin(), 0.4))
}

/// Checks that all views have these cameras of a pinhole with a focal length of 40 pixels.
fn sees(c: &Capture, center: [f64; 2]) {
    assert_eq!(c.views.len(), VIEWS);
    for (i, view) in c.views.iter().enumerate() {
        let (rotation, position) = pose(i);
        for point in [DVec3::ZERO, DVec3::new(0.2, -0.1, 0.3)] {
            let p = rotation.transpose() * (point - position);
            let (pixel, _) = view.camera.project(point.as_vec3()).unwrap();
            let expected = [0, 1].map(|k| 40.0 * p[k] / p.z + center[k]);
            let off = (f64::from(pixel.x) - expected[0]).hypot(f64::from(pixel.y) - expected[1]);
            assert!(off < 1e-3, "{}: {off} pixels off", view.name);
        }
        assert!(view.camera.position.distance(position) < 1e-6, "{}", view.name);
    }
}

// ---------------------------------------------------------------------------------- RealityCapture

const HEADER: &str = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n";

/// Heading, pitch and roll: Rz(−heading) Rx(pitch) Ry(roll) in OpenGL axes; 45 · 32 / 36 = 40
/// pixels.
fn table() -> String {
    let row = |i: usize| {
        let (rotation, at) = pose(i);
        let m = rotation * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let angles = [m.y_axis.x.atan2(m.y_axis.y), m.y_axis.z.asin(), (-m.x_axis.z).atan2(m.z_axis.z)];
        let [heading, pitch, roll] = angles.map(f64::to_degrees);
        let numbers = [at.x, at.y, at.z, heading, pitch, roll].map(|v| format!("{v:.9}")).join(",");
        format!("{i:02}.png,{numbers},45,0,0,0,0,0,0,0,0\n")
    };
    HEADER.to_string() + &(0..VIEWS).map(row).collect::<String>()
}

/// The table with another separator, and another decimal point.
fn separated(by: &str, point: &str) -> String {
    let field = |text: &str| if text.ends_with(".png") { text.to_string() } else { text.replace('.', point) };
    let line = |line: &str| line.split(',').map(field).collect::<Vec<_>>().join(by) + "\n";
    table().lines().map(line).collect()
}

#[test]
fn a_table_of_realitycapture_is_read_whatever_separates_and_encodes_it() {
    let utf16 = |mark: &[u8], unit: fn(u16) -> [u8; 2]| {
        [mark, &table().encode_utf16().flat_map(unit).collect::<Vec<u8>>()].concat()
    };
    let quoted = table().replace(".png", ".png\"").replace("\n0", "\n\"0");
    let in_quotes = |line: &str| format!("\"{line}\"\n");
    let all_quoted: String = separated("\",\"", ",").lines().map(in_quotes).collect();
    let capital = table().replace("#name,x,y,alt,heading", "Name,X,Y,Alt,Heading");
    let tables: [(&str, Vec<u8>, &str); 13] = [
        ("cameras.csv", table().into(), ""),
        ("cameras.csv", separated(";", ",").into(), "`;`, decimal commas"),
        ("cameras.csv", separated(";", ".").into(), "`;`"),
        ("cameras.csv", separated("\t", ",").into(), "tabs, decimal commas"),
        ("cameras.tsv", separated("\t", ".").into(), "tabs"),
        ("cameras.txt", separated("  ", ".").into(), "blanks"),
        ("cameras.csv", all_quoted.into(), "decimal commas"),
        ("cameras.csv", format!("\u{FEFF}{}", table().replace('\n', "\r\n")).into(), ""),
        ("cameras.csv", format!("sep=;\r\n# cameras 5\r\n{}", separated(";", ",")).into(), "decimal commas"),
        ("cameras.csv", quoted.into(), ""),
        ("cameras.csv", capital.into(), ""),
        ("cameras.csv", utf16(b"\xFF\xFE", u16::to_le_bytes), "UTF-16"),
        ("cameras.csv", utf16(b"\xFE\xFF", u16::to_be_bytes), "UTF-16"),
    ];
    for (i, (name, text, reason)) in tables.into_iter().enumerate() {
        let dir = photographs("images");
        put(&dir, name, &text);
        let c = open(dir.path()).unwrap_or_else(|e| panic!("table {i}: {e}"));
        assert_eq!(c.format, "RealityCapture");
        sees(&c, [12.0, 16.0]);
        assert!(c.reasons.iter().any(|r| r.contains(reason)), "table {i}: {:?}", c.reasons);
    }
}

#[test]
fn commas_between_and_inside_numbers_are_counted_and_not_taken_for_a_lens() {
    let dir = photographs("images");
    // six decimals in a row: 22 values
    put(&dir, "cameras.csv", separated(",", ","));
    says(
        &dir,
        "",
        &[
            "`cameras.csv`",
            "line 2: 22 values for 16 columns: commas both between and inside numbers",
            "decimal point",
        ],
    );
    put(&dir, "cameras.csv", separated(";", ",").replacen(",", ".", 1));
    says(&dir, "", &["some of its numbers have a comma, others a point"]);
    put(&dir, "cameras.csv", table().replace("heading,pitch,roll,f", "omega,phi,kappa,g"));
    says(&dir, "", &["it has no `heading`", "`Internal/External camera parameters`"]);
}

#[test]
fn positions_without_a_lens_are_named_as_such() {
    for (name, text) in [
        ("cameras.txt", "# Cameras (2)\n# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11\n00.png\t1\t2\t3\n"),
        ("reference.csv", "#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll\n00.png,1,2,3,4,5,6\n"),
    ] {
        let dir = photographs("images");
        put(&dir, name, text);
        says(&dir, "", &["a table of positions and angles", name, "it has no lens", "Export Cameras"]);
    }
}

// ------------------------------------------------------------------------------------------ COLMAP

/// Cameras and images of a model as text.
fn model() -> [String; 2] {
    let row = |i: usize| {
        let (rotation, at) = pose(i);
        let q = DQuat::from_mat3(&rotation.transpose());
        let t = -(rotation.transpose() * at);
        format!("{} {} {} {} {} {} {} {} 1 {i:02}.png\n\n", i + 1, q.w, q.x, q.y, q.z, t.x, t.y, t.z)
    };
    ["1 PINHOLE 24 32 40 40 12 16\n".into(), (0..VIEWS).map(row).collect()]
}

fn put_model(dir: &TempDir, folder: &str) {
    let [cameras, images] = model();
    put(dir, &format!("{folder}/cameras.txt"), cameras);
    put(dir, &format!("{folder}/images.txt"), images);
}

#[test]
fn a_model_whose_files_have_capitals_is_read() {
    for [cameras, images] in [["Cameras.txt", "Images.txt"], ["CAMERAS.TXT", "images.txt"]] {
        let dir = photographs("images");
        let [first, second] = model();
        put(&dir, &format!("sparse/0/{cameras}"), first);
        put(&dir, &format!("sparse/0/{images}"), second);
        put(&dir, "sparse/0/Points3D.txt", "1 0.1 0 0 9 9 9 0.5 1 0\n2 0 0.1 0 9 9 9 0.5 1 0\n");
        let c = open(dir.path()).unwrap();
        sees(&c, [12.0, 16.0]);
        let reasons = c.reasons.join("; ");
        assert!(
            reasons.contains(&format!("sparse/0/{cameras}")) && reasons.contains("2 points"),
            "{reasons}"
        );
    }
}

#[test]
fn a_model_is_found_in_the_places_where_programs_put_it() {
    for place in [
        "sparse/1",
        "sparse/12",
        "colmap/sparse/1",
        "colmap_sparse/0",
        "colmap_text",
        "colmap",
        "hloc/sparse/0",
        "hloc",
        "sfm",
        "model",
        "known/sparse",
        "undistorted/sparse",
        "dense/0/sparse",
        "dense/sparse",
    ] {
        let dir = photographs("images");
        put_model(&dir, place);
        sees(&open(dir.path()).unwrap_or_else(|e| panic!("{place}: {e}")), [12.0, 16.0]);
    }
    // the first of several, saying so
    let dir = photographs("images");
    put_model(&dir, "sparse/1");
    put_model(&dir, "sparse/2");
    let c = open(dir.path()).unwrap();
    assert!(
        c.warnings.iter().any(|w| w.contains("`sparse/2`") && !w.contains("`sparse/1`")),
        "{:?}",
        c.warnings
    );
}

#[test]
fn an_undistorted_model_is_of_the_photographs_beside_it() {
    let dir = photographs("dense/0/images");
    (0..VIEWS).for_each(|i| photograph(&dir, &format!("images/{i:02}.png"), (30, 40)));
    put_model(&dir, "dense/0/sparse");
    let c = open(dir.path()).unwrap();
    sees(&c, [12.0, 16.0]);
    assert!(c.views[0].photo.ends_with("dense/0/images/00.png"), "{:?}", c.views[0].photo);
    assert!(c.reasons.iter().any(|r| r.contains("`dense/0/images/`")), "{:?}", c.reasons);
}

#[test]
fn a_distorted_model_is_of_the_photographs_in_input_and_of_no_others() {
    let dir = photographs("input");
    (0..VIEWS).for_each(|i| photograph(&dir, &format!("images/{i:02}.png"), SIZE));
    put_model(&dir, "distorted/sparse/0");
    let c = open(dir.path()).unwrap();
    sees(&c, [12.0, 16.0]);
    assert!(c.views[0].photo.ends_with("input/00.png"), "{:?}", c.views[0].photo);
    fs::remove_dir_all(dir.path().join("input")).unwrap();
    says(&dir, "", &["5 of 5 photographs are missing"]);
    // once undistorted, the plain model counts
    put_model(&dir, "sparse/0");
    assert!(open(dir.path()).unwrap().views[0].photo.ends_with("images/00.png"));
}

#[test]
fn a_folder_inside_a_capture_is_answered_with_the_one_above() {
    let dir = photographs("head/images");
    put_model(&dir, "head/sparse/0");
    for inner in ["head/sparse/0", "head/sparse", "head/images"] {
        says(
            &dir,
            inner,
            &[
                "is not a capture: it is a part of one",
                "sparse/0/cameras.txt",
                "give the folder above: `ROOT/head`",
            ],
        );
    }
    assert_eq!(open(&dir.path().join("head")).unwrap().views.len(), VIEWS);
    // relative, as a user types it
    for words in [["inspect", "sparse/0"], ["inspect", "images"], ["inspect", "."]] {
        let folder = if words[1] == "." { dir.path().join("head/sparse/0") } else { dir.path().join("head") };
        let output = tiface(&folder, &words);
        assert_eq!(code(&output), 1, "{}", err(&output));
        assert!(out(&output).contains("give the folder above"), "{words:?}: {}", out(&output));
    }
    // a model with its photographs is one by itself
    let own = photographs("head/sparse");
    put_model(&own, "head/sparse");
    sees(&open(&own.path().join("head/sparse")).unwrap(), [12.0, 16.0]);
}

#[test]
fn a_subfolder_with_cameras_is_advised_only_with_what_it_lacks() {
    let dir = photographs("head/images");
    put_model(&dir, "head/sparse/0");
    says(
        &dir,
        "",
        &["its subfolder `head` contains `sparse/0/cameras.txt`", "give that folder: `ROOT/head`"],
    );
    let dir = photographs("images");
    put_model(&dir, "scan/sparse/0");
    says(&dir, "", &["`sparse/0/cameras.txt`, but no photographs", "move what is in `ROOT/scan` to `ROOT`"]);
    fs::rename(dir.path().join("scan/sparse"), dir.path().join("sparse")).unwrap();
    assert_eq!(open(dir.path()).unwrap().views.len(), VIEWS);
    let dir = tempfile::tempdir().unwrap();
    put_model(&dir, "scan/sparse/0");
    says(&dir, "", &["but no photographs", "put the photographs there", "`ROOT/scan`"]);
}

#[test]
fn a_model_in_an_unknown_place_or_of_two_kinds_is_named_with_its_place() {
    let dir = photographs("images");
    put_model(&dir, "exports/first/text");
    says(&dir, "", &["`exports/first/text`", "cp -r ROOT/exports/first/text ROOT/sparse/0"]);
    let dir = photographs("heads/one/images");
    put_model(&dir, "heads/one/sparse/0");
    says(&dir, "", &["`heads/one/sparse/0`", "give the folder of that capture: `ROOT/heads/one`"]);
    let dir = photographs("images");
    put_model(&dir, "sparse/0");
    fs::rename(dir.path().join("sparse/0/cameras.txt"), dir.path().join("sparse/0/cameras.bin")).unwrap();
    says(
        &dir,
        "",
        &["`sparse/0/cameras.bin` and `sparse/0/images.txt` are not of one kind", "model_converter"],
    );
}

// -------------------------------------------------------------------------------- folders of poses

/// Rows of the camera-to-world matrix.
fn matrix(i: usize) -> String {
    let (r, t) = pose(i);
    let row = |k: usize| format!("{} {} {} {}\n", r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]);
    (0..3).map(row).collect::<String>() + "0 0 0 1\n"
}

fn pose_folder(photos: &str, intrinsics: &str, text: &str) -> TempDir {
    let dir = photographs(photos);
    put(&dir, intrinsics, text);
    (0..VIEWS).for_each(|i| put(&dir, &format!("pose/{i:02}.txt"), matrix(i)));
    dir
}

#[test]
fn folders_of_poses_of_nsvf_srn_and_scannet_are_read() {
    let k = "40 0 11.5 0\n0 40 15.5 0\n0 0 1 0\n0 0 0 1\n";
    for (photos, intrinsics, text) in [
        ("rgb", "intrinsics.txt", k),
        ("rgb", "intrinsics.txt", "40 0 11.5\n0 40 15.5\n0 0 1\n"),
        // the middle is the middle
        ("rgb", "intrinsics.txt", "40.0 12.0 16.0 0.\n0. 0. 0.\n0.\n1.\n32 24\n"),
        ("color", "intrinsic/intrinsic_color.txt", k),
    ] {
        let dir = pose_folder(photos, intrinsics, text);
        let c = open(dir.path()).unwrap();
        assert_eq!(c.format, "NSVF");
        sees(&c, [12.0, 16.0]);
        assert!(
            c.warnings.iter().any(|w| w.contains("`pose/*.txt`") && w.contains("to the world")),
            "{:?}",
            c.warnings
        );
        assert!(
            c.reasons[0].contains("`pose/*.txt`") && c.reasons[0].contains(intrinsics),
            "{:?}",
            c.reasons
        );
    }
    // of photographs of another size
    let dir = pose_folder("rgb", "intrinsics.txt", "40.0 12.0 16.0 0.\n0. 0. 0.\n0.\n1.\n128 96\n");
    says(&dir, "", &["is 24 × 32 pixels, but `pose/00.txt` says 96 × 128", "`capture.downscale = 4`"]);
}

#[test]
fn names_of_nsvf_say_what_is_held_out_and_its_box_where_the_head_is() {
    let dir = tempfile::tempdir().unwrap();
    put(&dir, "intrinsics.txt", "40 0 11.5 0\n0 40 15.5 0\n0 0 1 0\n0 0 0 1\n");
    put(&dir, "bbox.txt", "-0.5 -0.5 -0.25 0.5 0.5 0.75 0.1\n");
    for (i, name) in ["0_a", "0_b", "0_c", "1_a", "2_a"].into_iter().enumerate() {
        photograph(&dir, &format!("rgb/{name}.png"), SIZE);
        put(&dir, &format!("pose/{name}.txt"), matrix(i));
    }
    photograph(&dir, "rgb/0_z.png", SIZE);
    let c = open(dir.path()).unwrap();
    let count = |split| c.split(split).count();
    assert_eq!((count(Split::Train), count(Split::Val), count(Split::Test)), (3, 1, 1));
    let focus = c.focus.unwrap();
    assert_eq!((focus.min, focus.max), (Vec3::new(-0.5, -0.5, -0.25), Vec3::new(0.5, 0.5, 0.75)));
    assert!(
        c.warnings.iter().any(|w| w.contains("1 photographs have no pose") && w.contains("`0_z.png`")),
        "{:?}",
        c.warnings
    );
}

#[test]
fn poses_that_are_no_cameras_are_refused_by_their_file() {
    let k = "40 0 11.5 0\n0 40 15.5 0\n0 0 1 0\n0 0 0 1\n";
    let dir = pose_folder("rgb", "intrinsics.txt", k);
    let transposed = {
        let (r, t) = pose(2);
        let column = |c: DVec3, w: f64| format!("{} {} {} {w}\n", c.x, c.y, c.z);
        [column(r.x_axis, 0.0), column(r.y_axis, 0.0), column(r.z_axis, 0.0), column(t, 1.0)].concat()
    };
    for (text, words) in [
        (transposed, "its last row is not `0 0 0 1`"),
        ("1 2 3 4 5".into(), "it has 5 numbers, not the 16 of a matrix"),
        ("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1".into(), "mirrors"),
        ("1 0 zero 0".into(), "`zero` is no number"),
        (String::new(), "is empty"),
    ] {
        put(&dir, "pose/02.txt", text);
        says(&dir, "", &["pose/02.txt", words]);
    }
    put(&dir, "pose/02.txt", "-inf ".repeat(16));
    let c = open(dir.path()).unwrap();
    assert_eq!(c.views.len(), VIEWS - 1);
    assert!(c.warnings.iter().any(|w| w.contains("`pose/02.txt`")), "{:?}", c.warnings);
    for text in ["40 40 12 16\n", "40\n", "40 3 11.5\n0 40 15.5\n0 0 1\n", "nan 0 0\n0 40 15.5\n0 0 1\n"] {
        put(&dir, "intrinsics.txt", text);
        says(&dir, "", &["`intrinsics.txt`"]);
    }
}

#[test]
fn folders_of_poses_and_photographs_of_other_names_are_read() {
    let k = "40 0 11.5 0\n0 40 15.5 0\n0 0 1 0\n0 0 0 1\n";
    for (photos, poses) in [("rgb", "poses"), ("imgs", "pose"), ("imgs", "poses")] {
        let dir = pose_folder(photos, "intrinsics.txt", k);
        fs::rename(dir.path().join("pose"), dir.path().join(poses)).unwrap();
        let c = open(dir.path()).unwrap();
        sees(&c, [12.0, 16.0]);
        assert!(c.reasons[0].contains(&format!("`{poses}/*.txt`")), "{:?}", c.reasons);
    }
}

#[test]
fn poses_in_a_folder_with_other_axes_are_told_how_to_turn_them() {
    let k = "40 0 11.5 0\n0 40 15.5 0\n0 0 1 0\n0 0 0 1\n";
    let rows = |r: DMat3, t: DVec3| {
        let row = |k: usize| format!("{} {} {} {}\n", r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]);
        (0..3).map(row).collect::<String>() + "0 0 0 1\n"
    };
    let dir = pose_folder("rgb", "intrinsics.txt", k);
    for i in 0..VIEWS {
        let (r, t) = pose(i);
        let opengl = r * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        put(&dir, &format!("pose/{i:02}.txt"), rows(opengl, t));
    }
    says(&dir, "", &["`pose/*.txt`", "look away", "second and third columns", "invert them"]);
}

// ---------------------------------------------------------------------------------- other programs

#[test]
fn known_cameras_of_other_programs_are_never_called_photographs_without_cameras() {
    let rows: [(&str, &[(&str, &str)], &str, &str); 24] = [
        (
            "rgbd",
            &[("metadata.json", r#"{"h": 32, "w": 24, "K": [1], "poses": [[0]]}"#)],
            "a Record3D recording (`metadata.json`)",
            "ns-process-data record3d --data ROOT --output-dir NEW",
        ),
        (
            "images",
            &[("frame_00000.json", r#"{"cameraPoseARFrame": [1]}"#)],
            "a scan of 3D Scanner App",
            "`cameraPoseARFrame` is `transform_matrix`",
        ),
        (
            "images",
            &[("images/00.json", r#"{"intrinsics": [1], "cameraPoseARFrame": [1]}"#)],
            "a scan of 3D Scanner App (ARKit) (`images/00.json`)",
            "`cameraPoseARFrame` is `transform_matrix`",
        ),
        (
            "images",
            &[("frames/00.json", r#"{"cameraIntrinsics": [1], "transform": [1]}"#)],
            "axes are not known (`frames/00.json`)",
            "`transform_matrix`",
        ),
        (
            "images",
            &[("meta_data.json", r#"{"frames": [{"camtoworld": []}]}"#)],
            "an sdfstudio scene (`meta_data.json`)",
            "`camtoworld`",
        ),
        (
            "images",
            &[("cameras.json", r#"{"KRT": []}"#)],
            "an EyefulTower scene (`cameras.json`)",
            "`cameras.xml`",
        ),
        (
            "rgb/1x",
            &[("camera/00.json", "{}")],
            "a Nerfies or HyperNeRF capture (`camera/00.json`)",
            "`orientation`",
        ),
        ("images", &[("intri.yml", "%YAML:1.0")], "an EasyMocap recording (`intri.yml`)", "`Rot_NAME`"),
        (
            "images",
            &[("cams/00000017_cam.txt", "extrinsic")],
            "an MVSNet scene (`cams/00000017_cam.txt`)",
            "InterfaceMVSNet -i ROOT",
        ),
        (
            "images",
            &[("scene.mvs", "MVS")],
            "an OpenMVS scene (`scene.mvs`)",
            "InterfaceCOLMAP -i ROOT/scene.mvs",
        ),
        (
            "images",
            &[("cfg_args", "Namespace()"), ("cameras.json", "[]")],
            "3D Gaussian splatting (`cfg_args`)",
            "`source_path`",
        ),
        (
            "images",
            &[("dataparser_transforms.json", "{}")],
            "a trained scene of nerfstudio",
            "`data` in `config.yml`",
        ),
        ("other", &[("base.ingp", "x")], "a snapshot of instant-ngp (`base.ingp`)", "`transforms.json`"),
        ("images", &[("head.mlp", "<x>")], "a MeshLab project (`head.mlp`)", "Agisoft xml"),
        ("other", &[("head.blend", "BLENDER")], "a Blender scene (`head.blend`)", "BlenderNeRF"),
        ("other", &[("head.psht", "x")], "a PostShot project (`head.psht`)", "tiface cameras"),
        (
            "images",
            &[("a.xml", "<BlocksExchange version=\"3\">")],
            "a ContextCapture export (`a.xml`)",
            "Import Cameras",
        ),
        (
            "images",
            &[("dino_par.txt", "1\n00.png 1 2")],
            "a DTU or Middlebury scene (`dino_par.txt`)",
            "K [R | t]",
        ),
        (
            "images",
            &[("traj.txt", "1 0 0 0 0 0 0 1")],
            "cameras in a form whose axes are not known (`traj.txt`)",
            "`transform_matrix`",
        ),
        (
            "images",
            &[("head_trajectory.log", "0 0 0\n1 0 0 0")],
            "axes are not known (`head_trajectory.log`)",
            "tiface cameras ROOT",
        ),
        (
            "images",
            &[("poses.npy", "x")],
            "axes are not known (`poses.npy`)",
            "rename it to `poses_bounds.npy`",
        ),
        ("frames", &[("poses/00.txt", "1")], "axes are not known (`poses/00.txt`)", "camera to world"),
        ("images", &[("extrinsics.json", "{}")], "axes are not known (`extrinsics.json`)", "camera to world"),
        (
            "images",
            &[("calibration.csv", "name,w,h,rx,ry,rz")],
            "axes are not known (`calibration.csv`)",
            "`fl_x`",
        ),
    ];
    for (photos, files, what, way) in rows {
        let dir = photographs(photos);
        files.iter().for_each(|(name, text)| put(&dir, name, text));
        let (message, hint) = refused(&dir, "");
        assert!(message.contains(what) && !message.contains("without cameras"), "{what}: {message}");
        assert!(hint.contains(way), "{what}: {hint}");
    }
    // what is beside them and is none does not hide the way
    let dir = photographs("images");
    put(&dir, "notes.csv", "a,b\n");
    put(&dir, "head.blend", "BLENDER");
    says(
        &dir,
        "",
        &["photographs without cameras", "`tiface cameras ROOT`", "`notes.csv`, which does not begin with"],
    );
}

#[test]
fn a_file_is_answered_by_what_it_is() {
    let dir = tempfile::tempdir().unwrap();
    for (name, what, way) in [
        ("head.zip", "it is an archive", "unzip ROOT/head.zip -d NEW"),
        ("head.tar.gz", "it is an archive", "tar -xf ROOT/head.tar.gz -C NEW"),
        ("head.7z", "it is an archive", "unpack it into a folder"),
        ("head.blend", "a file of a Blender scene", "BlenderNeRF"),
        ("head.mlp", "a file of a MeshLab project", "Export active rasters"),
        ("head.psx", "a file of a Metashape project", "Export Cameras"),
        ("head.rcproj", "a file of a RealityCapture project", "as CSV"),
        ("head.r3d", "a file of a Record3D recording", "ns-process-data record3d --data ROOT"),
        ("head.ingp", "a file of a snapshot of instant-ngp", "transforms.json"),
        ("head.ply", "it is a mesh or a cloud of points", "tiface check ROOT/head.ply"),
        ("cameras.xml", "it is a file", "give its folder: `ROOT`"),
    ] {
        put(&dir, name, "x");
        says(&dir, name, &[what, way]);
    }
    let packed = tempfile::tempdir().unwrap();
    put(&packed, "head.zip", "PK");
    says(&packed, "", &["a packed capture (`head.zip`)", "unzip ROOT/head.zip"]);
    let model = photographs("images");
    put_model(&model, "sparse/0");
    says(&model, "sparse/0/cameras.txt", &["it is a file", "give the folder above: `ROOT`"]);
}
