//! Captures whose files leave open which photograph belongs to which camera, or how photographs
//! lie: what photographs show decides it, and where they cannot, the program says so.

use crate::command::{code, out, said, tiface, worked};
use crate::kept::photographed;
use serde_json::Value;
use std::fs;
use std::io::Write;
use std::path::Path;
use tempfile::TempDir;
use tiface::capture::synthetic::{self, SyntheticOptions};
use tiface::capture::{self, Capture, CaptureOptions, MaskSource, ViewMask};
use tiface::config::CameraPoses;
use tiface::geom::Camera;
use tiface::image::Photo;
use tiface::io::{self, Limits};
use tiface::pipeline::open_capture;

/// The head that is photographed: as few and as small photographs as points of it are found again
/// in.
const HEAD: SyntheticOptions = SyntheticOptions { width: 144, height: 180, train: 14, test: 1, seed: 1 };

/// How many photographs it has.
const COUNT: usize = HEAD.train + HEAD.test;

fn cameras() -> Vec<Camera> {
    synthetic::cameras(&HEAD).into_iter().map(|(camera, _)| camera).collect()
}

/// Copies photographs and masks of the head to two folders of a capture. `names` says how the
/// picture of a camera is called in each, without ending.
fn pictures(to: &Path, folders: [&str; 2], names: [&dyn Fn(usize) -> String; 2]) {
    let head = tempfile::tempdir().unwrap();
    photographed(&head.path().join("head"), &HEAD);
    for ((from, folder), name) in ["images", "masks"].iter().zip(folders).zip(names) {
        fs::create_dir_all(to.join(folder)).unwrap();
        for i in 0..COUNT {
            let picture = head.path().join(format!("head/{from}/{i:03}.png"));
            fs::copy(picture, to.join(format!("{folder}/{}.png", name(i)))).unwrap();
        }
    }
}

fn plain(i: usize) -> String {
    i.to_string()
}

fn doubles(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Writes the rows of cameras as LLFF's loaders read them.
fn write_llff(root: &Path, cameras: &[Camera]) {
    let row = |c: &Camera| -> Vec<f64> {
        let (r, hwf) = (c.rotation, [f64::from(c.height), f64::from(c.width), c.fx]);
        let line = |k: usize| [-r.y_axis[k], r.x_axis[k], r.z_axis[k], c.position[k], hwf[k]];
        [line(0), line(1), line(2)].concat().into_iter().chain([0.5, 2.0]).collect()
    };
    let rows: Vec<f64> = cameras.iter().flat_map(row).collect();
    let bytes = io::npy_bytes("<f8", &[cameras.len(), 17], &doubles(&rows));
    fs::write(root.join("poses_bounds.npy"), bytes).unwrap();
}

/// Writes the projections of cameras as NeuS reads them.
fn write_neus(root: &Path, cameras: &[Camera]) {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let stored = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    for (i, c) in cameras.iter().enumerate() {
        let axes = [c.rotation.x_axis, -c.rotation.y_axis, -c.rotation.z_axis];
        let seen = axes.map(|axis| [axis.x, axis.y, axis.z, -axis.dot(c.position)]);
        let [x, y, z] = seen;
        let along = |f: f64, axis: [f64; 4], center: f64| -> Vec<f64> {
            (0..4).map(|k| f * axis[k] + (center - 0.5) * z[k]).collect()
        };
        let rows = [along(c.fx, x, c.cx), along(c.fy, y, c.cy), z.to_vec(), vec![0.0, 0.0, 0.0, 1.0]];
        zip.start_file(format!("world_mat_{i}.npy"), stored).unwrap();
        zip.write_all(&io::npy_bytes("<f8", &[4, 4], &doubles(&rows.concat()))).unwrap();
    }
    fs::write(root.join("cameras_sphere.npz"), zip.finish().unwrap().into_inner()).unwrap();
}

/// Cameras as they follow each other where photographs without leading zeros are taken in the order
/// of their names.
fn in_name_order(cameras: &[Camera]) -> Vec<Camera> {
    let mut order: Vec<usize> = (0..cameras.len()).collect();
    order.sort_by_key(|i| i.to_string());
    order.into_iter().map(|i| cameras[i].clone()).collect()
}

/// Returns whether each view, named by the number of its camera behind these letters, has that
/// camera, and a mask of its own.
fn has_own_cameras(capture: &Capture, before: &str) -> bool {
    let exact = cameras();
    capture.views.len() == exact.len()
        && capture.views.iter().all(|view| {
            let number: usize = view.name.strip_prefix(before).unwrap().parse().unwrap();
            view.camera.position.distance(exact[number].position) < 1e-6
        })
}

fn opened(root: &Path) -> Capture {
    open_capture(root, &CaptureOptions::default()).unwrap()
}

fn says(texts: &[String], words: &[&str]) -> bool {
    texts.iter().any(|text| words.iter().all(|word| text.contains(word)))
}

#[test]
fn photographs_without_leading_zeros_are_paired_with_cameras_by_number() {
    let dir = tempfile::tempdir().unwrap();
    let name = |i: usize| format!("view{i}");
    pictures(dir.path(), ["images", "masks"], [&name, &name]);
    write_llff(dir.path(), &cameras());
    let capture = opened(dir.path());
    assert!(has_own_cameras(&capture, "view"), "{:?}", capture.reasons);
    let words = ["paired with cameras by number, view0, view1, view2, view3, …: so", "in name order"];
    assert!(says(&capture.reasons, &words), "{:?}", capture.reasons);
    for view in &capture.views {
        assert!(
            matches!(&view.mask, ViewMask::File(path) if path.ends_with(format!("masks/{}.png", view.name)))
        );
    }
    // `inspect` says the same, and that the poses fit
    let found = tiface(
        dir.path(),
        &["inspect", ".", "--set", "capture.exposure=given", "--set", "capture.glare=given"],
    );
    let text = worked(&found);
    assert!(text.contains("paired with cameras by number") && text.contains("poses fit within 0."), "{text}");
}

#[test]
fn photographs_in_the_order_of_their_names_keep_it_where_their_cameras_do() {
    let dir = tempfile::tempdir().unwrap();
    pictures(dir.path(), ["images", "masks"], [&plain, &plain]);
    write_llff(dir.path(), &in_name_order(&cameras()));
    let capture = opened(dir.path());
    assert!(has_own_cameras(&capture, ""), "{:?}", capture.reasons);
    assert!(says(&capture.reasons, &["paired with cameras in name order, 0, 1, 10, 11, …: so", "by number"]));
}

#[test]
fn masks_of_other_names_move_along_with_their_photographs() {
    // masks without leading zeros, photographs with and without them
    for (zeros, before) in [(false, ""), (true, "0")] {
        let dir = tempfile::tempdir().unwrap();
        let name = |i: usize| if zeros { format!("{i:03}") } else { plain(i) };
        let mask = |i: usize| format!("of{i}");
        pictures(dir.path(), ["image", "mask"], [&name, &mask]);
        write_neus(dir.path(), &cameras());
        let capture = opened(dir.path());
        assert!(has_own_cameras(&capture, before), "{:?}", capture.reasons);
        assert_eq!(
            says(&capture.reasons, &["paired with cameras by number"]),
            !zeros,
            "{:?}",
            capture.reasons
        );
        for view in &capture.views {
            let number: usize = view.name.parse().unwrap();
            let mask = format!("mask/of{number}.png");
            assert!(matches!(&view.mask, ViewMask::File(path) if path.ends_with(&mask)), "{:?}", view.mask);
        }
    }
}

#[test]
fn masks_that_only_order_pairs_are_paired_by_what_fits() {
    // masks are numbered from 1 without leading zeros, in the order of the photographs
    let dir = tempfile::tempdir().unwrap();
    pictures(dir.path(), ["image", "mask"], [&|i| format!("{i:03}"), &|i| plain(i + 1)]);
    write_neus(dir.path(), &cameras());
    let capture = opened(dir.path());
    assert!(
        says(&capture.reasons, &["masks are paired with photographs by number"]),
        "{:?}",
        capture.reasons
    );
    let own = |i: usize| matches!(&capture.views[i].mask, ViewMask::File(p) if p.ends_with(format!("mask/{}.png", i + 1)));
    assert!((0..COUNT).all(own));
}

#[test]
fn photographs_of_a_smooth_head_are_paired_by_their_masks() {
    let dir = tempfile::tempdir().unwrap();
    pictures(dir.path(), ["images", "masks"], [&plain, &plain]);
    for i in 0..COUNT {
        let path = dir.path().join(format!("images/{i}.png"));
        let pixels = vec![[120, 110, 100]; (HEAD.width * HEAD.height) as usize];
        io::write_png_rgb(&path, HEAD.width, HEAD.height, &pixels).unwrap();
    }
    for (cameras, order) in [(cameras(), "by number"), (in_name_order(&cameras()), "in name order")] {
        write_llff(dir.path(), &cameras);
        let capture = opened(dir.path());
        assert!(has_own_cameras(&capture, ""), "{:?}", capture.reasons);
        let words = ["paired with cameras", order, "so their masks contradict each other by"];
        assert!(says(&capture.reasons, &words), "{:?}", capture.reasons);
    }
}

#[test]
fn an_order_that_nothing_decides_is_refused_with_both_and_a_way_on() {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir(dir.path().join("images")).unwrap();
    for i in 0..12 {
        let path = dir.path().join(format!("images/{i}.png"));
        io::write_png_rgb(&path, 24, 30, &[[90, 80, 70]; 720]).unwrap();
    }
    let small = SyntheticOptions { width: 24, height: 30, train: 12, test: 0, seed: 1 };
    let cameras: Vec<Camera> = synthetic::cameras(&small).into_iter().map(|(camera, _)| camera).collect();
    write_llff(dir.path(), &cameras);
    let error = open_capture(dir.path(), &CaptureOptions::default()).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("0, 1, 10, 11, …") && text.contains("0, 1, 2, 3, …"), "{text}");
    assert!(error.hint().contains("leading zeros") && error.hint().contains("capture.cameras=given"));
    let found = tiface(dir.path(), &["inspect", "."]);
    assert!(code(&found) == 1 && out(&found).contains("0, 1, 10, 11, …"), "{}", said(&found));
    assert!(!out(&found).contains("no problems found"));
    // without masks nothing can be measured, and LLFF's own order is kept with a word on the other
    let bare = CaptureOptions { masks: MaskSource::None, ..CaptureOptions::default() };
    let capture = open_capture(dir.path(), &bare).unwrap();
    let words = ["nothing but name order pairs", "0, 1, 10, 11, …", "0, 1, 2, 3, …", "leading zeros"];
    assert!(says(&capture.warnings, &words), "{:?}", capture.warnings);
    // the way on: names stay in their order, with a word
    let given = CaptureOptions { cameras: CameraPoses::Given, ..CaptureOptions::default() };
    let capture = open_capture(dir.path(), &given).unwrap();
    assert!(says(&capture.warnings, &["nothing but name order pairs photographs with cameras"]));
    // with leading zeros there is one order
    for i in 0..10 {
        let at = |name: String| dir.path().join("images").join(name);
        fs::rename(at(format!("{i}.png")), at(format!("0{i}.png"))).unwrap();
    }
    assert_eq!(opened(dir.path()).views.len(), 12);
}

#[test]
fn a_run_keeps_the_order_that_was_decided_and_resumes_with_it() {
    let dir = tempfile::tempdir().unwrap();
    let head = dir.path().join("head");
    pictures(&head, ["images", "masks"], [&plain, &plain]);
    write_llff(&head, &cameras());
    let words = "mask head --run run --set capture.cameras=given --set capture.exposure=given --set capture.glare=given";
    let words: Vec<&str> = words.split(' ').collect();
    let first = worked(&tiface(dir.path(), &words));
    assert!(first.contains("paired with cameras by number"), "{first}");
    let text = fs::read_to_string(dir.path().join("run/cameras.json")).unwrap();
    let written: Value = serde_json::from_str(&text).unwrap();
    let exact = cameras();
    for view in written["views"].as_array().unwrap() {
        let number: usize = view["name"].as_str().unwrap().parse().unwrap();
        let x = view["camera"]["position"][0].as_f64().unwrap();
        assert!((x - exact[number].position.x).abs() < 1e-6, "{number}");
    }
    let done = fs::read(dir.path().join("run/mask/done.json")).unwrap();
    worked(&tiface(dir.path(), &words));
    assert!(done == fs::read(dir.path().join("run/mask/done.json")).unwrap(), "the stage was made again");
}

/// A capture whose photographs are JPEGs that ask for a half turn; `turned` says whether
/// photographs, and masks, are stored turned.
fn half_turned(turned: [bool; 2]) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    photographed(dir.path(), &HEAD);
    let limits = Limits::default();
    for i in 0..COUNT {
        let at = |name: &str| dir.path().join(name);
        let (image, mask) = (at(&format!("images/{i:03}.png")), at(&format!("masks/{i:03}.png")));
        let photo = io::read_photo(&image, None, &limits).unwrap();
        let photo = if turned[0] { io::turned_photo(photo, 3) } else { photo };
        fs::remove_file(&image).unwrap();
        fs::write(image.with_extension("jpg"), with_exif(&photo, 3)).unwrap();
        if turned[1] {
            let gray = io::turned_gray(io::read_gray(&mask, None, &limits).unwrap(), 3);
            io::write_png_gray(&mask, &gray).unwrap();
        }
    }
    for name in ["transforms.json", "transforms_train.json", "transforms_test.json"] {
        let file = dir.path().join(name);
        let mut value: Value = serde_json::from_str(&fs::read_to_string(&file).unwrap()).unwrap();
        for frame in value["frames"].as_array_mut().unwrap() {
            let path = frame["file_path"].as_str().unwrap().replace(".png", ".jpg");
            frame["file_path"] = path.into();
        }
        fs::write(&file, value.to_string()).unwrap();
    }
    dir
}

/// A JPEG file with this EXIF orientation.
fn with_exif(photo: &Photo, orientation: u8) -> Vec<u8> {
    let mut jpeg = io::jpeg_bytes(photo, 97, Path::new("photo.jpg")).unwrap();
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0]);
    let mut segment = vec![0xFF, 0xE1];
    segment.extend((exif.len() as u16 + 2).to_be_bytes());
    segment.extend(exif);
    jpeg.splice(2..2, segment);
    jpeg
}

/// Returns the mean difference of two photographs' values.
fn difference(a: &Photo, b: &Photo) -> f64 {
    let values = a.rgb.as_flattened().iter().zip(b.rgb.as_flattened());
    values.map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / (3.0 * a.rgb.len() as f64)
}

#[test]
fn photographs_are_turned_by_half_as_exif_asks_where_their_cameras_expect_that() {
    let limits = Limits::default();
    let plain = tempfile::tempdir().unwrap();
    photographed(plain.path(), &HEAD);
    let upright = &capture::open(plain.path(), &CaptureOptions::default()).unwrap().views[4];
    for masks in [false, true] {
        let dir = half_turned([true, masks]);
        let capture = opened(dir.path());
        let words = ["turned as EXIF asks", "so", "as stored"];
        assert!(says(&capture.reasons, &words), "{:?} {:?}", capture.reasons, capture.warnings);
        assert_eq!(
            says(&capture.reasons, &["masks are turned as EXIF asks"]),
            masks,
            "{:?}",
            capture.reasons
        );
        let view = &capture.views[4];
        assert_eq!((view.turn, view.mask_turn), (Some(3), masks.then_some(3)));
        let (found, exact) = (view.load(&limits).unwrap(), upright.load(&limits).unwrap());
        assert!(difference(&found.photo, &exact.photo) < 8.0 && found.mask == exact.mask);
    }
}

#[test]
fn photographs_that_fit_as_stored_are_not_turned_whatever_exif_asks() {
    let dir = half_turned([false, false]);
    let capture = opened(dir.path());
    assert!(says(&capture.reasons, &["as stored, not turned as EXIF asks: so"]), "{:?}", capture.warnings);
    assert!(capture.views.iter().all(|view| view.turn.is_none() && view.mask_turn.is_none()));
    assert!(!says(&capture.warnings, &["EXIF"]), "{:?}", capture.warnings);
}

#[test]
fn a_turn_that_nothing_decides_is_left_with_a_word_that_claims_nothing() {
    let dir = half_turned([true, false]);
    fs::remove_dir_all(dir.path().join("masks")).unwrap();
    let text = fs::read_to_string(dir.path().join("transforms.json")).unwrap();
    let mut value: Value = serde_json::from_str(&text).unwrap();
    for frame in value["frames"].as_array_mut().unwrap() {
        frame.as_object_mut().unwrap().retain(|key, _| !key.contains("mask"));
    }
    for name in ["transforms_train.json", "transforms_test.json"] {
        fs::remove_file(dir.path().join(name)).unwrap();
    }
    fs::write(dir.path().join("transforms.json"), value.to_string()).unwrap();
    let capture = opened(dir.path());
    let words = ["EXIF asks to turn 15 photographs; nothing shows whether the cameras expect that"];
    assert!(says(&capture.warnings, &words), "{:?}", capture.warnings);
    assert!(!says(&capture.warnings, &["as the cameras expect"]));
    assert!(capture.views.iter().all(|view| view.turn.is_none()));
}

#[test]
fn photographs_of_other_cameras_stop_a_run_and_are_not_refined() {
    let dir = tempfile::tempdir().unwrap();
    photographed(dir.path(), &HEAD);
    for name in ["transforms_train.json", "transforms_test.json"] {
        fs::remove_file(dir.path().join(name)).unwrap();
    }
    let file = dir.path().join("transforms.json");
    let mut value: Value = serde_json::from_str(&fs::read_to_string(&file).unwrap()).unwrap();
    let frames = value["frames"].as_array_mut().unwrap();
    let matrices: Vec<Value> = frames.iter().map(|frame| frame["transform_matrix"].clone()).collect();
    for (i, frame) in frames.iter_mut().enumerate() {
        frame["transform_matrix"] = matrices[(4 * i + 3) % COUNT].clone();
    }
    fs::write(&file, value.to_string()).unwrap();
    let found = tiface(dir.path(), &["inspect", ".", "--json", "--set", "mask.trust=true"]);
    let result: Value = serde_json::from_str(&out(&found)).unwrap();
    let problems = result["problems"].to_string();
    assert!(code(&found) == 1 && problems.contains("what"), "{}", said(&found));
    assert!(problems.contains("capture.cameras=given") && !problems.contains("a run refines"), "{problems}");
}
