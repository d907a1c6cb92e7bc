//! COLMAP's models: every lens to the last digits, every format there and back, and every hostile
//! file refused by name.

use crate::capture_folder::{open, put, refused};
use crate::kept::photographed;
use glam::{DMat3, DQuat, DVec3, Vec2};
use std::fs;
use std::path::Path;
use tempfile::TempDir;
use tiface::capture::convert::{CameraFormat, convert};
use tiface::capture::inspect::inspect;
use tiface::capture::synthetic::SyntheticOptions;
use tiface::capture::{self, Capture, CaptureOptions, Split, ViewMask};
use tiface::geom::Projection;
use tiface::io::{self, Limits};

/// Number, name and parameters of every model, of a camera of 160 × 120 pixels.
const MODELS: [(i32, &str, &[f64]); 11] = [
    (0, "SIMPLE_PINHOLE", &[210.5, 80.25, 59.75]),
    (1, "PINHOLE", &[210.5, 211.25, 80.25, 59.75]),
    (2, "SIMPLE_RADIAL", &[210.5, 80.25, 59.75, -0.12]),
    (3, "RADIAL", &[210.5, 80.25, 59.75, -0.12, 0.03]),
    (4, "OPENCV", &[210.5, 211.25, 80.25, 59.75, -0.12, 0.03, 0.002, -0.001]),
    (5, "OPENCV_FISHEYE", &[210.5, 211.25, 80.25, 59.75, 0.03, -0.01, 0.004, -0.001]),
    (6, "FULL_OPENCV", &[210.5, 211.25, 80.25, 59.75, 0.3, -0.1, 0.002, -0.001, 0.01, 0.2, 0.05, 0.01]),
    (7, "FOV", &[210.5, 211.25, 80.25, 59.75, 0.85]),
    (8, "SIMPLE_RADIAL_FISHEYE", &[210.5, 80.25, 59.75, 0.03]),
    (9, "RADIAL_FISHEYE", &[210.5, 80.25, 59.75, 0.03, -0.01]),
    (
        10,
        "THIN_PRISM_FISHEYE",
        &[210.5, 211.25, 80.25, 59.75, 0.03, -0.01, 0.002, -0.001, 0.004, -0.001, 0.003, -0.002],
    ),
];

/// Where the cameras stand: quaternion (w, x, y, z) and translation, camera from world.
fn pose(i: usize) -> ([f64; 4], DVec3) {
    let a = 0.5 * i as f64;
    let ahead = DVec3::new(-a.cos(), -a.sin(), 0.1).normalize();
    let right = ahead.cross(DVec3::Z).normalize();
    let world_from_camera = DMat3::from_cols(right, ahead.cross(right), ahead);
    let q = DQuat::from_mat3(&world_from_camera.transpose());
    let center = DVec3::new(2.0 * a.cos(), 2.0 * a.sin(), 0.3);
    ([q.w, q.x, q.y, q.z], -(world_from_camera.transpose() * center))
}

fn photograph(path: &Path, width: u32, height: u32) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let rgb: Vec<[u8; 3]> = (0..width * height).map(|i| [i as u8, (i / 7) as u8, 40]).collect();
    io::write_png_rgb(path, width, height, &rgb).unwrap();
}

#[derive(Clone)]
struct Row {
    id: u32,
    quaternion: [f64; 4],
    translation: DVec3,
    camera: u32,
    name: Vec<u8>,
}

/// One camera for each model and one image for each camera.
fn rows() -> Vec<Row> {
    let row = |i: usize| {
        let (quaternion, translation) = pose(i);
        let name = format!("cam {i}/{i:02}.png").into_bytes();
        Row { id: i as u32 + 1, quaternion, translation, camera: i as u32 + 10, name }
    };
    (0..MODELS.len()).map(row).collect()
}

fn cameras_bin() -> Vec<u8> {
    let mut b = (MODELS.len() as u64).to_le_bytes().to_vec();
    for (i, (model, _, values)) in MODELS.iter().enumerate() {
        b.extend((i as u32 + 10).to_le_bytes());
        b.extend(model.to_le_bytes());
        b.extend([160u64, 120].map(u64::to_le_bytes).as_flattened());
        values.iter().for_each(|v| b.extend(v.to_le_bytes()));
    }
    b
}

fn images_bin(rows: &[Row]) -> Vec<u8> {
    let mut b = (rows.len() as u64).to_le_bytes().to_vec();
    for row in rows {
        b.extend(row.id.to_le_bytes());
        row.quaternion.iter().chain(&row.translation.to_array()).for_each(|v| b.extend(v.to_le_bytes()));
        b.extend(row.camera.to_le_bytes());
        b.extend(&row.name);
        b.push(0);
        b.extend(2u64.to_le_bytes());
        b.extend([7u8; 48]); // two points
    }
    b
}

fn points_bin() -> Vec<u8> {
    let mut b = 2u64.to_le_bytes().to_vec();
    for _ in 0..2 {
        b.extend([0u8; 43]);
        b.extend(1u64.to_le_bytes());
        b.extend([0u8; 8]);
    }
    b
}

/// A capture of these images and all camera models, with photographs in folders of their own.
fn capture_of(rows: &[Row]) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("sparse/0");
    fs::create_dir_all(&model).unwrap();
    fs::write(model.join("cameras.bin"), cameras_bin()).unwrap();
    fs::write(model.join("images.bin"), images_bin(rows)).unwrap();
    for row in rows {
        let name = std::str::from_utf8(&row.name).unwrap();
        photograph(&dir.path().join("images").join(name), 160, 120);
    }
    dir
}

fn as_text(ending: &str) -> (String, String) {
    let numbers = |v: &[f64]| v.iter().map(|x| x.to_string()).collect::<Vec<_>>().join(" ");
    let camera = |(i, (_, name, values)): (usize, &(i32, &str, &[f64]))| {
        format!("{} {name} 160 120 {}{ending}", i + 10, numbers(values))
    };
    let image = |row: &Row| {
        let Row { id, quaternion, translation, camera, name } = row;
        let (q, t) = (numbers(quaternion), numbers(&translation.to_array()));
        // the points of every second image are missing
        let points = if id % 2 == 0 { "1 2 -1 3.5 4.5 17" } else { "" };
        format!("{id} {q} {t} {camera} {}{ending}{points}{ending}", String::from_utf8_lossy(name))
    };
    let cameras: String = MODELS.iter().enumerate().map(camera).collect();
    let images: String = rows().iter().map(image).collect();
    (format!("# Camera list{ending}{cameras}"), format!("# Image list{ending}# two lines{ending}{images}"))
}

#[test]
fn every_camera_model_is_read_to_the_last_digits_from_binary_and_text() {
    let binary = capture_of(&rows());
    let text = capture_of(&rows());
    fs::remove_dir_all(text.path().join("sparse")).unwrap();
    let (cameras, images) = as_text("\r\n");
    put(&text, "sparse/cameras.txt", cameras);
    put(&text, "sparse/images.txt", images);
    let (binary, text) = (open(&binary).unwrap(), open(&text).unwrap());
    assert_eq!((binary.format.as_str(), binary.views.len()), ("COLMAP", MODELS.len()));
    assert!(text.reasons[0].contains("`sparse/cameras.txt`, `sparse/images.txt`"), "{:?}", text.reasons);
    for (i, (a, b)) in binary.views.iter().zip(&text.views).enumerate() {
        assert_eq!((&a.name, &a.camera, a.split), (&b.name, &b.camera, b.split));
        assert_eq!(a.name, format!("cam {i}/{i:02}"));
        // world to picture by COLMAP's own steps, and the camera's
        let c = &a.camera;
        let (quaternion, translation) = pose(i);
        let [w, x, y, z] = quaternion;
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
        let center = -(rotation.transpose() * translation);
        assert!(c.position.distance(center) < 1e-9);
        for point in [DVec3::new(0.1, -0.2, 0.3), DVec3::ZERO, DVec3::new(-0.3, 0.25, -0.1)] {
            let p = rotation * point + translation;
            let values = MODELS[i].2;
            let one = matches!(
                MODELS[i].1,
                "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE"
            );
            let (fx, fy, cx, cy) = match (one, values) {
                (true, [f, cx, cy, ..]) => (f, f, cx, cy),
                (_, [fx, fy, cx, cy, ..]) => (fx, fy, cx, cy),
                _ => unreachable!(),
            };
            let (u, v) = bent(MODELS[i].1, values, p.x / p.z, p.y / p.z);
            let q = c.rotation.transpose() * (point - c.position);
            let (x, y) = c.distortion.apply(q.x / -q.z, -q.y / -q.z);
            let off = (fx * u + cx - (c.fx * x + c.cx)).abs() + (fy * v + cy - (c.fy * y + c.cy)).abs();
            assert!(off < 1e-9, "{}: {off}", MODELS[i].1);
        }
    }
    assert_eq!(binary.views[7].camera.distortion.projection, Projection::Fov);
}

/// COLMAP's documentation, model by model.
fn bent(model: &str, v: &[f64], x: f64, y: f64) -> (f64, f64) {
    let r = x.hypot(y);
    let fisheye = |k: &[f64]| {
        let t = r.atan();
        let sum: f64 = k.iter().enumerate().map(|(i, k)| k * t.powi(2 * i as i32 + 2)).sum();
        let s = if r > 0.0 { t * (1.0 + sum) / r } else { 1.0 };
        (s * x, s * y)
    };
    let brown = |u: f64, w: f64, radial: f64, p1: f64, p2: f64| {
        let r2 = u * u + w * w;
        (
            u * radial + 2.0 * p1 * u * w + p2 * (r2 + 2.0 * u * u),
            w * radial + 2.0 * p2 * u * w + p1 * (r2 + 2.0 * w * w),
        )
    };
    let r2 = r * r;
    match model {
        "SIMPLE_PINHOLE" | "PINHOLE" => (x, y),
        "SIMPLE_RADIAL" => (x * (1.0 + v[3] * r2), y * (1.0 + v[3] * r2)),
        "RADIAL" => brown(x, y, 1.0 + v[3] * r2 + v[4] * r2 * r2, 0.0, 0.0),
        "OPENCV" => brown(x, y, 1.0 + v[4] * r2 + v[5] * r2 * r2, v[6], v[7]),
        "FULL_OPENCV" => {
            let over = 1.0 + v[4] * r2 + v[5] * r2.powi(2) + v[8] * r2.powi(3);
            brown(x, y, over / (1.0 + v[9] * r2 + v[10] * r2.powi(2) + v[11] * r2.powi(3)), v[6], v[7])
        }
        "FOV" => {
            let s = if r > 0.0 { (2.0 * r * (0.5 * v[4]).tan()).atan() / (r * v[4]) } else { 1.0 };
            (s * x, s * y)
        }
        "OPENCV_FISHEYE" => fisheye(&v[4..8]),
        "SIMPLE_RADIAL_FISHEYE" => fisheye(&v[3..4]),
        "RADIAL_FISHEYE" => fisheye(&v[3..5]),
        "THIN_PRISM_FISHEYE" => {
            let s = if r > 0.0 { r.atan() / r } else { 1.0 };
            let (u, w) = (s * x, s * y);
            let t2 = u * u + w * w;
            let radial = 1.0 + v[4] * t2 + v[5] * t2.powi(2) + v[8] * t2.powi(3) + v[9] * t2.powi(4);
            let (a, b) = brown(u, w, radial, v[6], v[7]);
            (a + v[10] * t2, b + v[11] * t2)
        }
        other => unreachable!("{other}"),
    }
}

#[test]
fn rays_leave_where_points_arrive_for_every_camera_model() {
    for view in &open(&capture_of(&rows())).unwrap().views {
        for k in 0..81 {
            let pixel = Vec2::new(20.0 * (k % 9) as f32, 15.0 * (k / 9) as f32);
            let ray = view.camera.ray(pixel).unwrap_or_else(|| panic!("{} at {pixel}", view.name));
            let (back, _) = view.camera.project(ray.at(2.0)).unwrap();
            assert!(back.distance(pixel) < 1e-3, "{}: {pixel} comes back as {back}", view.name);
        }
    }
}

#[test]
fn masks_splits_points_rigs_and_models_in_other_places_are_found() {
    let dir = capture_of(&rows());
    for i in 0..MODELS.len() {
        let gray = tiface::image::Gray { width: 160, height: 120, values: vec![(i * 20) as u8; 160 * 120] };
        // COLMAP's own name for half of them, a plain one for the others
        let ending = if i % 2 == 0 { ".png.png" } else { ".png" };
        let path = dir.path().join(format!("masks/cam {i}/{i:02}{ending}"));
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        io::write_png_gray(&path, &gray).unwrap();
    }
    put(&dir, "sparse/0/points3D.bin", points_bin());
    put(&dir, "sparse/0/test.txt", "cam 3/03.png\n\ncam 4/04.png\r\ncam 77/77.png\n");
    put(&dir, "sparse/1/cameras.bin", "x");
    let c = open(&dir).unwrap();
    assert!(c.views.iter().all(|v| matches!(v.mask, ViewMask::File(_))), "{:?}", c.reasons);
    let held: Vec<&str> = c.split(Split::Test).map(|v| v.name.as_str()).collect();
    assert_eq!(held, ["cam 3/03", "cam 4/04"]);
    assert!(c.reasons.iter().any(|r| r.contains("2 points of COLMAP")), "{:?}", c.reasons);
    assert!(c.warnings.iter().any(|w| w.contains("`sparse/1`")), "{:?}", c.warnings);
    assert!(c.warnings.iter().any(|w| w.contains("`cam 77/77.png`")), "{:?}", c.warnings);

    // the folder itself, and photographs in a folder of another name
    let flat = tempfile::tempdir().unwrap();
    fs::rename(dir.path().join("images"), flat.path().join("input")).unwrap();
    put(&flat, "cameras.bin", cameras_bin());
    put(&flat, "images.bin", images_bin(&rows()));
    assert_eq!(open(&flat).unwrap().views.len(), MODELS.len());
    let beside = tempfile::tempdir().unwrap();
    for i in 0..MODELS.len() {
        fs::rename(flat.path().join(format!("input/cam {i}")), beside.path().join(format!("cam {i}")))
            .unwrap();
    }
    put(&beside, "colmap/sparse/0/cameras.bin", cameras_bin());
    put(&beside, "colmap/sparse/0/images.bin", images_bin(&rows()));
    assert_eq!(open(&beside).unwrap().views.len(), MODELS.len());
}

#[test]
#[cfg(unix)]
fn a_model_that_is_a_link_into_a_store_is_read() {
    let (store, dir) = (capture_of(&rows()), tempfile::tempdir().unwrap());
    for folder in ["sparse", "images"] {
        std::os::unix::fs::symlink(store.path().join(folder), dir.path().join(folder)).unwrap();
    }
    assert_eq!(open(&dir).unwrap().views.len(), open(&store).unwrap().views.len());
}

/// What is flipped of a byte.
const FLIPS: [u8; 3] = [0x01, 0x80, 0xFF];

/// Cuts a file of the model of these images at every byte, and changes every byte by this many of
/// [`FLIPS`], which take turns. A cut, and a byte too many, are refused by name; no change makes
/// the reader panic.
fn damage_is_refused(rows: &[Row], name: &str, bytes: &[u8], flips: usize) {
    let dir = capture_of(rows);
    let few = Limits { views: 1000, ..Limits::default() };
    let options = CaptureOptions { limits: few, ..CaptureOptions::default() };
    let name = format!("sparse/0/{name}");
    for cut in 0..bytes.len() {
        put(&dir, &name, &bytes[..cut]);
        refused(&dir, &[&name]);
    }
    for at in 0..bytes.len() {
        for turn in 0..flips {
            let mut flipped = bytes.to_vec();
            flipped[at] ^= FLIPS[(at + turn) % FLIPS.len()];
            put(&dir, &name, &flipped);
            let _ = capture::open(dir.path(), &options);
        }
    }
    put(&dir, &name, [bytes, b"x"].concat());
    refused(&dir, &[&name, "1 bytes are left over"]);
    put(&dir, &name, bytes);
    assert!(open(&dir).is_ok());
}

#[test]
fn no_cut_and_no_flipped_byte_of_a_model_does_more_than_refuse_it() {
    let rows = rows();
    damage_is_refused(&rows, "cameras.bin", &cameras_bin(), 1);
    // images and points are alike: in three of them, each byte of an image meets each flip
    let few = &rows[..3];
    damage_is_refused(few, "images.bin", &images_bin(few), 1);
    damage_is_refused(few, "points3D.bin", &points_bin(), 1);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; every flip of every byte, with an image for each of eleven models"]
fn no_flip_of_any_byte_of_a_model_does_more_than_refuse_it() {
    let rows = rows();
    for (name, bytes) in
        [("cameras.bin", cameras_bin()), ("images.bin", images_bin(&rows)), ("points3D.bin", points_bin())]
    {
        damage_is_refused(&rows, name, &bytes, FLIPS.len());
    }
}

#[test]
fn hostile_numbers_and_names_are_refused_by_name() {
    let with = |change: &dyn Fn(&mut Vec<Row>)| {
        let mut changed = rows();
        change(&mut changed);
        let dir = capture_of(&rows());
        put(&dir, "sparse/0/images.bin", images_bin(&changed));
        dir
    };
    let images = "`sparse/0/images.bin`, frame `cam 2/02.png`";
    refused(&with(&|r| r[2].quaternion[1] = f64::NAN), &[images, "not finite"]);
    refused(&with(&|r| r[2].translation.y = f64::INFINITY), &[images, "not finite"]);
    refused(&with(&|r| r[2].quaternion = [0.0; 4]), &[images, "quaternion is zero"]);
    refused(&with(&|r| r[2].camera = 99), &[images, "camera 99 is not in the cameras file"]);
    refused(&with(&|r| r[2].id = 2), &["appears twice"]);
    refused(&with(&|r| r[2].name = r[1].name.clone()), &["would both be called `cam 1/01`"]);
    for name in ["../../x.png", "/etc/passwd", "C:\\x.png", "..\\..\\x.png", ""] {
        let dir = with(&|r| r[2].name = name.as_bytes().to_vec());
        if name.is_empty() {
            let c = open(&dir).unwrap(); // no photograph is called nothing: it is missing
            assert!(
                c.warnings.iter().any(|w| w.contains("1 of 11 photographs are missing")),
                "{:?}",
                c.warnings
            );
        } else {
            refused(&dir, &["sparse/0/images.bin", "outside the capture"]);
        }
    }
    refused(&with(&|r| r[2].name = vec![0xFF, 0xFE]), &["images.bin", "not UTF-8", "at byte"]);
    refused(&with(&|r| r[10].name = vec![b'a'; 9000]), &["a name does not end within 4096 bytes"]);
    let missing = with(&|r| r[2].name = b"none.png".to_vec());
    let c = open(&missing).unwrap();
    assert!(c.warnings[0].contains("1 of 11 photographs are missing: `none.png`"), "{:?}", c.warnings);
    // a longer quaternion is the same rotation
    let c = open(&with(&|r| r[2].quaternion = r[2].quaternion.map(|v| 3.0 * v))).unwrap();
    let plain = open(&capture_of(&rows())).unwrap();
    let turned = c.views[2].camera.rotation - plain.views[2].camera.rotation;
    assert!(turned.to_cols_array().iter().all(|v| v.abs() < 1e-12));

    let dir = capture_of(&rows());
    let huge = |count: u64, rest: &[u8]| [&count.to_le_bytes()[..], rest].concat();
    for count in [1 << 63, u64::MAX, 1 << 40] {
        for name in ["cameras.bin", "images.bin", "points3D.bin"] {
            let own = fs::read(dir.path().join("sparse/0").join(name));
            put(&dir, &format!("sparse/0/{name}"), huge(count, &[1; 200]));
            refused(&dir, &[name, &format!("it says {count}")]);
            match own {
                Ok(bytes) => put(&dir, &format!("sparse/0/{name}"), bytes),
                Err(_) => fs::remove_file(dir.path().join("sparse/0").join(name)).unwrap(),
            }
        }
    }
    let options =
        CaptureOptions { limits: Limits { views: 5, ..Limits::default() }, ..CaptureOptions::default() };
    let e = capture::open(dir.path(), &options).unwrap_err();
    assert!(e.to_string().contains("number of views is 11, the limit is 5"), "{e}");

    let camera = |model: i32, width: u64| {
        let mut b = cameras_bin();
        b[12..16].copy_from_slice(&model.to_le_bytes());
        b[16..24].copy_from_slice(&width.to_le_bytes());
        b
    };
    put(&dir, "sparse/0/cameras.bin", camera(11, 160));
    refused(&dir, &["cameras.bin", "`RAD_TAN_THIN_PRISM_FISHEYE` is not supported", "image_undistorter"]);
    put(&dir, "sparse/0/cameras.bin", camera(77, 160));
    refused(&dir, &["number 77"]);
    for width in [0, 1 << 60] {
        put(&dir, "sparse/0/cameras.bin", camera(0, width));
        refused(&dir, &["frame `cam 0/00.png`", "camera 10 is of"]);
    }
    put(&dir, "sparse/0/cameras.bin", camera(0, 170));
    refused(&dir, &["is 160 × 120 pixels", "says 170 × 120"]);
    put(&dir, "sparse/0/images.bin", huge(0, b""));
    refused(&dir, &["images.bin", "it has no images"]);
    assert!(!inspect(dir.path(), &CaptureOptions::default()).is_usable());
}

#[test]
fn hostile_text_is_refused_with_its_line() {
    let dir = tempfile::tempdir().unwrap();
    photograph(&dir.path().join("images/a b.png"), 160, 120);
    let camera = "1 PINHOLE 160 120 200 200 80 60\n";
    let image = "1 1 0 0 0 0 0 2 1 a b.png\n";
    let with = |cameras: &str, images: &str| {
        put(&dir, "sparse/0/cameras.txt", cameras);
        put(&dir, "sparse/0/images.txt", images);
    };
    for images in [
        format!("{image}\n"),
        image.into(),
        format!("# x\n\n{image}1 2 -1\n"),
        image.replace('\n', "\r\n\r\n"),
    ] {
        with(camera, &images);
        let c = open(&dir).unwrap();
        assert_eq!((c.views.len(), c.views[0].name.as_str()), (1, "a b"));
        assert_eq!(c.views[0].camera.position, DVec3::new(0.0, 0.0, -2.0));
    }
    for (cameras, images, words) in [
        ("1 PINHOLE 160 120 200 200 80\n", image, &["cameras.txt`: line 1", "a parameter of the lens"][..]),
        ("1 PINHOLE 160 120 200 200 80 60 7\n", image, &["`7` is left over"]),
        ("1 MAGIC 160 120 200\n", image, &["`MAGIC` is not supported"]),
        ("# no camera\n", image, &["camera 1 is not in the cameras file"]),
        ("1 PINHOLE wide 120 200 200 80 60\n", image, &["`wide` is not a width"]),
        ("1 PINHOLE 160 120 nan 200 80 60\n", image, &["is NaN"]),
        ("1 PINHOLE 160 120 200 200 80 60\n1 PINHOLE 160 120 200 200 80 60\n", image, &["line 2", "twice"]),
        (camera, "1 1 0 0 0 0 0 2 1\n", &["images.txt`: line 1", "a photograph's name"]),
        (camera, "1 1 0 0 0 0 nan 2 1 a b.png\n", &["not finite"]),
        (camera, "1 1 0 0 x 0 0 2 1 a b.png\n", &["`x` is not a number of a pose"]),
        (
            camera,
            "1 1 0 0 0 0 0 2 1 a b.png\n2 1 0 0 0 0 0 2 9 c.png\n",
            &["line 2", "takes two lines", "camera 9"],
        ),
        (camera, "99999999999 1 0 0 0 0 0 2 1 a b.png\n", &["the number of an image"]),
    ] {
        with(cameras, images);
        refused(&dir, words);
    }
    put(&dir, "sparse/0/images.txt", [0xFF, 0xFE, 0x00]);
    refused(&dir, &["images.txt", "not UTF-8"]);
    with(camera, image);
    fs::remove_file(dir.path().join("sparse/0/cameras.txt")).unwrap();
    refused(&dir, &["COLMAP"]);
}

fn same(a: &Capture, b: &Capture, masks: bool) {
    assert_eq!((a.views.len(), a.up), (b.views.len(), b.up));
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!((&a.name, a.split, a.declared), (&b.name, b.split, b.declared));
        let (c, d) = (&a.camera, &b.camera);
        assert!(c.position.distance(d.position) < 1e-12, "{}", a.name);
        assert!((c.rotation - d.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-14), "{}", a.name);
        assert_eq!((c.fx, c.fy, c.cx, c.cy, c.distortion), (d.fx, d.fy, d.cx, d.cy, d.distortion));
        let limits = Limits::default();
        let (x, y) = (a.load(&limits).unwrap(), b.load(&limits).unwrap());
        assert_eq!(x.photo, y.photo);
        assert!(!masks || (x.mask == y.mask && x.mask.is_some() && x.region == y.region));
    }
}

#[test]
fn every_format_is_written_and_read_again() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let options = CaptureOptions::default();
    let small = SyntheticOptions { width: 24, height: 30, train: 6, test: 3, seed: 1 };
    photographed(&at("head"), &small);
    let head = capture::open(&at("head"), &options).unwrap();
    let mut last = head.clone();
    for (step, format) in [CameraFormat::Colmap, CameraFormat::Transforms].into_iter().enumerate() {
        let folder = at(&format!("step {step}"));
        let from = last;
        let done = convert(&from, format, &folder).unwrap();
        assert_eq!((done.views, done.masks, &done.folder), (9, 9, &folder));
        last = capture::open(&folder, &options).unwrap();
        let warned = done.warnings.iter().any(|w| w.contains("COLMAP has no up direction"));
        let up = if warned { head.up } else { last.up };
        same(&head, &Capture { up, ..last.clone() }, true);
        // what is there is never touched
        let e = convert(&from, format, &folder).unwrap_err();
        assert!(e.to_string().contains("already exists"), "{e}");
    }
    assert!(last.format.starts_with("transforms"), "{}", last.format);
}

/// The head with one photograph under another name.
fn renamed(head: &Capture, index: usize, name: &str, dir: &Path) -> Capture {
    let photo = dir.join(name);
    fs::create_dir_all(photo.parent().unwrap()).unwrap();
    fs::copy(&head.views[index].photo, &photo).unwrap();
    let mut capture = head.clone();
    capture.views[index].name = Path::new(name).with_extension("").to_string_lossy().into_owned();
    capture.views[index].photo = photo;
    capture
}

#[test]
fn a_held_out_name_that_a_format_cannot_carry_is_refused_not_learned() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let options = CaptureOptions::default();
    let small = SyntheticOptions { width: 24, height: 30, train: 6, test: 2, seed: 1 };
    photographed(&at("head"), &small);
    let head = capture::open(&at("head"), &options).unwrap();
    let held_out = head.views.iter().rposition(|v| v.split == Split::Test).unwrap();
    let names = ["#a.png", "#d/a.png", " a.png", "a.png ", "a\nb.png", "a\rb.png", "c:a.png"];
    for (i, name) in names.into_iter().enumerate() {
        let from = renamed(&head, held_out, name, &at("names"));
        let e = convert(&from, CameraFormat::Colmap, &at("c")).unwrap_err();
        assert!(e.to_string().contains(name) && !at("c").exists(), "{e}");
        let folder = at(&format!("t{i}"));
        convert(&from, CameraFormat::Transforms, &folder).unwrap();
        let again = capture::open(&folder, &options).unwrap();
        let splits = |c: &Capture| c.views.iter().map(|v| v.split).collect::<Vec<_>>();
        assert_eq!(splits(&again), splits(&from), "{name:?}");
    }
    // one that is learned from stands in the binary file alone
    for name in ["#a.png", "a.png "] {
        let from = renamed(&head, 0, name, &at("names"));
        let folder = at(&format!("learned{name}"));
        convert(&from, CameraFormat::Colmap, &folder).unwrap();
        assert_eq!(capture::open(&folder, &options).unwrap().split(Split::Test).count(), 2, "{name:?}");
    }
}

#[test]
fn splits_that_only_look_like_every_eighth_survive_every_format() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let options = CaptureOptions::default();
    let opened = |train, test| {
        let folder = at(&format!("head {train} {test}"));
        photographed(&folder, &SyntheticOptions { width: 24, height: 30, train, test, seed: 1 });
        capture::open(&folder, &options).unwrap()
    };
    // `a-1.png` comes before `a.png`, but `a` before `a-1`: readers differ on which of them is the
    // first
    let head = opened(4, 1);
    let first = renamed(&head, 0, "a.png", &at("names"));
    let mut twins = renamed(&first, 1, "a-1.png", &at("names"));
    for split in 0..2 {
        twins.views.iter_mut().for_each(|v| v.split = Split::Train);
        twins.views[split].split = Split::Test;
        twins.views.iter_mut().skip(2).for_each(|v| v.name = format!("b{}", v.name));
        check(&twins, &at(&format!("twins {split}")));
    }
    // the first of three views is held out, though a split by every eighth view would hold out none
    let mut three = opened(2, 1);
    three
        .views
        .iter_mut()
        .enumerate()
        .for_each(|(i, v)| v.split = if i == 0 { Split::Test } else { Split::Train });
    check(&three, &at("three"));

    fn check(from: &Capture, folder: &Path) {
        for (name, format) in [("t", CameraFormat::Transforms), ("c", CameraFormat::Colmap)] {
            let folder = folder.join(name);
            convert(from, format, &folder).unwrap();
            let again = capture::open(&folder, &CaptureOptions::default()).unwrap();
            let held_out = |c: &Capture| c.split(Split::Test).map(|v| v.name.clone()).collect::<Vec<_>>();
            assert_eq!(held_out(&again), held_out(from));
        }
    }
}

#[test]
fn text_files_of_a_model_may_be_empty_and_binary_ones_not() {
    let dir = capture_of(&rows());
    let (cameras, images) = as_text("\n");
    for name in ["cameras", "images"] {
        fs::remove_file(dir.path().join(format!("sparse/0/{name}.bin"))).unwrap();
    }
    put(&dir, "sparse/0/cameras.txt", &cameras);
    put(&dir, "sparse/0/images.txt", &images);
    for name in ["points3D", "test"] {
        put(&dir, &format!("sparse/0/{name}.txt"), "");
    }
    // COLMAP's manual makes `points3D.txt` empty for known poses; `test.txt` then holds nothing out
    let c = open(&dir).unwrap();
    assert_eq!((c.split(Split::Train).count(), c.split(Split::Test).count()), (MODELS.len(), 0));
    put(&dir, "sparse/0/images.txt", "");
    refused(&dir, &["images.txt", "it has no images"]);
    put(&dir, "sparse/0/images.txt", &images);
    put(&dir, "sparse/0/cameras.txt", "");
    refused(&dir, &["its camera 10 is not in the cameras file"]);
    let dir = capture_of(&rows());
    put(&dir, "sparse/0/points3D.bin", "");
    refused(&dir, &["points3D.bin", "empty"]);
}

#[test]
fn all_lenses_survive_and_a_reduced_capture_is_refused() {
    let dir = capture_of(&rows());
    let from = open(&dir).unwrap();
    for (name, format) in [("t", CameraFormat::Transforms), ("c", CameraFormat::Colmap)] {
        let folder = dir.path().join(name);
        convert(&from, format, &folder).unwrap();
        same(&from, &capture::open(&folder, &CaptureOptions::default()).unwrap(), false);
    }
    let reduced = CaptureOptions { downscale: 2, ..CaptureOptions::default() };
    let reduced = capture::open(dir.path(), &reduced).unwrap();
    let e = convert(&reduced, CameraFormat::Colmap, &dir.path().join("r")).unwrap_err();
    assert!(e.to_string().contains("at reduced size"), "{e}");
}
