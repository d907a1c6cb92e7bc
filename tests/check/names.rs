//! Photographs and masks under names that are nearly those of the camera files: read where only one
//! fits, else named.

use crate::capture_folder::open;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use tiface::capture::inspect::{Inspection, inspect};
use tiface::capture::{self, Capture, CaptureOptions, MaskSource, ViewMask};
use tiface::image::{Gray, Photo};
use tiface::io;

const SIZE: (u32, u32) = (24, 32);
const VIEWS: usize = 9;

/// Puts a picture into a capture: gray, or JPEG where its name says so.
fn picture(dir: &TempDir, name: &str) {
    let path = dir.path().join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let (width, height) = SIZE;
    let rgb: Vec<[u8; 3]> = (0..width * height).map(|i| [i as u8, (i / 3) as u8, 90]).collect();
    if name.to_lowercase().ends_with("jpg") {
        let photo = Photo { width, height, rgb, alpha: None };
        fs::write(&path, io::jpeg_bytes(&photo, 90, &path).unwrap()).unwrap();
    } else {
        io::write_png_rgb(&path, width, height, &rgb).unwrap();
    }
}

/// Puts the mask of a ball into a capture.
fn mask(dir: &TempDir, name: &str) {
    let path = dir.path().join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let (width, height) = SIZE;
    let is_inside = |i: u32| (i % width).abs_diff(12).pow(2) + (i / width).abs_diff(16).pow(2) < 64;
    let values = (0..width * height).map(|i| if is_inside(i) { 255 } else { 0 }).collect();
    io::write_png_gray(&path, &Gray { width, height, values }).unwrap();
}

/// A frame of `transforms.json`; cameras stand in a circle around the origin.
fn frame(i: usize, name: &str, more: &str) -> String {
    let (s, c) = (i as f64 * 0.7).sin_cos();
    let matrix = format!("[[{},0,{c},{}],[{c},0,{s},{}],[0,1,0,0],[0,0,0,1]]", -s, 2.0 * c, 2.0 * s);
    format!(r#"{{"file_path": "{name}", {more} "transform_matrix": {matrix}}}"#)
}

fn write_frames(dir: &TempDir, frames: &[String]) {
    let top = format!(r#""fl_x": 40, "w": {}, "h": {}"#, SIZE.0, SIZE.1);
    let json = format!("{{{top}, \"frames\": [{}]}}", frames.join(","));
    fs::write(dir.path().join("transforms.json"), json).unwrap();
}

/// The name of a view in a pattern: `{}` stands for its number.
fn named(pattern: &str, i: usize) -> String {
    pattern.replace("{}", &format!("{i:03}"))
}

/// A capture whose file names photographs by one pattern, with photographs and masks of others.
fn capture_of(name: &str, photo: &str, mask_name: &str) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let frames: Vec<String> = (0..VIEWS).map(|i| frame(i, &named(name, i), "")).collect();
    write_frames(&dir, &frames);
    for i in 0..VIEWS {
        picture(&dir, &named(photo, i));
        if !mask_name.is_empty() {
            mask(&dir, &named(mask_name, i));
        }
    }
    dir
}

fn inspected(dir: &TempDir) -> Inspection {
    inspect(dir.path(), &CaptureOptions::default())
}

fn below(dir: &TempDir, path: &Path) -> String {
    path.strip_prefix(dir.path()).unwrap().to_string_lossy().replace('\\', "/")
}

/// The photographs of the views, as paths below the capture.
fn photos(dir: &TempDir, c: &Capture) -> Vec<String> {
    c.views.iter().map(|view| below(dir, &view.photo)).collect()
}

/// The masks of the views, as paths below the capture; none for views without.
fn masks(dir: &TempDir, c: &Capture) -> Vec<String> {
    let file = |mask: &ViewMask| match mask {
        ViewMask::File(path) => Some(below(dir, path)),
        _ => None,
    };
    c.views.iter().filter_map(|view| file(&view.mask)).collect()
}

fn all(pattern: &str) -> Vec<String> {
    (0..VIEWS).map(|i| named(pattern, i)).collect()
}

fn says(texts: &[String], words: &[&str]) -> bool {
    texts.iter().any(|text| words.iter().all(|word| text.contains(word)))
}

#[test]
fn photographs_of_another_case_ending_unicode_form_or_folder_are_read_and_said_once() {
    let rows = [
        ("images/{}.jpg", "images/{}.JPG"),
        ("images/{}.jpg", "Images/{}.jpg"),
        ("images/{}.jpg", "images/{}.png"),
        ("images/zo\u{eb}_{}.png", "images/zoe\u{308}_{}.png"),
        ("images/01/{}.png", "images/{}.png"),
        ("images/{}.png", "images/01/{}.png"),
        ("{}.png", "photos/{}.png"),
        ("/home/me/data/head/images/{}.png", "images/{}.png"),
        ("C:\\\\head\\\\images\\\\{}.png", "images/{}.png"),
        ("../images/{}.png", "images/{}.png"),
    ];
    for (name, photo) in rows {
        let dir = capture_of(name, photo, "");
        let c = open(&dir).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(photos(&dir, &c), all(photo), "{name}");
        let said: Vec<_> = c.reasons.iter().filter(|r| r.contains("near names")).collect();
        assert!(said.len() == 1 && said[0].contains(&named(photo, 0)), "{name}: {:?}", c.reasons);
    }
    // nothing is said of what has the name that is given
    let dir = capture_of("images/{}.png", "images/{}.png", "masks/{}.png");
    let c = open(&dir).unwrap();
    assert!(!says(&c.reasons, &["near names"]) && masks(&dir, &c) == all("masks/{}.png"), "{:?}", c.reasons);
}

#[test]
fn a_photograph_that_was_put_aside_stays_missing() {
    for aside in ["left_out/003.png", "images/other/003.png"] {
        let dir = capture_of("images/{}.png", "images/{}.png", "");
        fs::create_dir_all(dir.path().join(aside).parent().unwrap()).unwrap();
        fs::rename(dir.path().join("images/003.png"), dir.path().join(aside)).unwrap();
        let c = open(&dir).unwrap();
        assert_eq!(c.views.len(), VIEWS - 1, "{aside}");
        assert!(
            says(&c.warnings, &["1 of 9 photographs are missing", "`images/003.png`"]),
            "{:?}",
            c.warnings
        );
    }
}

#[test]
fn photographs_that_are_missing_in_part_are_named_where_they_lie() {
    let dir = capture_of("images/{}.png", "images/{}.png", "");
    fs::create_dir(dir.path().join("images2")).unwrap();
    for i in [3, 4] {
        let name = named("{}.png", i);
        fs::rename(dir.path().join("images").join(&name), dir.path().join("images2").join(&name)).unwrap();
    }
    let c = open(&dir).unwrap();
    let words = ["2 of 9 photographs are missing", "`images2/003.png` is there", "move such files"];
    assert!(says(&c.warnings, &words), "{:?}", c.warnings);
}

#[test]
fn photographs_in_a_folder_that_says_of_others_are_a_warning_or_not_read() {
    let dir = capture_of("images/{}.png", "other_person/{}.png", "");
    let c = open(&dir).unwrap();
    assert_eq!(photos(&dir, &c), all("other_person/{}.png"));
    assert!(says(&c.warnings, &["near names", "`other_person/000.png`"]), "{:?}", c.warnings);
    for aside in ["images_distorted", "cropped", "old"] {
        let dir = capture_of("images/{}.png", &format!("{aside}/{{}}.png"), "");
        let e = open(&dir).unwrap_err().to_string();
        assert!(e.contains("missing") && e.contains(&format!("`{aside}/` has 9 pictures")), "{e}");
    }
}

#[test]
fn two_frames_never_share_a_photograph_that_was_found_nearby() {
    let dir = capture_of("images/{}.png", "images/{}.png", "");
    let mut frames: Vec<String> = (0..VIEWS).map(|i| frame(i, &format!("a/{i:03}.png"), "")).collect();
    frames.push(frame(9, "b/000.png", ""));
    write_frames(&dir, &frames);
    let c = open(&dir).unwrap();
    assert_eq!(photos(&dir, &c), all("images/{}.png")[1..]);
    assert!(
        says(&c.warnings, &["2 of 10", "`a/000.png`, `b/000.png`", "several frames would share"]),
        "{:?}",
        c.warnings
    );
    // the frame that has the very name keeps it
    frames.pop();
    frames[0] = frame(0, "images/000.png", "");
    frames[1] = frame(1, "images/000.jpg", "");
    write_frames(&dir, &frames[..2]);
    let c = open(&dir).unwrap();
    assert_eq!(photos(&dir, &c), ["images/000.png"]);
    assert!(says(&c.warnings, &["1 of 2", "`images/000.jpg`"]), "{:?}", c.warnings);
}

#[test]
fn photographs_that_fit_twice_or_not_at_all_are_named_with_what_is_there() {
    let dir = capture_of("images/{}.png", "left/{}.png", "");
    for i in 0..VIEWS {
        picture(&dir, &named("right/{}.png", i));
    }
    let e = open(&dir).unwrap_err();
    assert!(e.to_string().contains("`left/000.png` as well as `right/000.png`"), "{e}");
    assert!(!e.hint().is_empty());

    let dir = capture_of("images/{}.png", "shots/IMG_{}.png", "");
    let e = open(&dir).unwrap_err();
    assert!(e.to_string().contains("`shots/` has 9 pictures, such as `shots/IMG_000.png`"), "{e}");
}

#[test]
fn reduced_photographs_are_named_with_the_factor_that_reads_them() {
    let dir = capture_of("images/{}.png", "images_4/{}.png", "");
    let json = fs::read_to_string(dir.path().join("transforms.json")).unwrap();
    let whole =
        json.replace(r#""w": 24, "h": 32"#, r#""w": 96, "h": 128"#).replace("\"fl_x\": 40", "\"fl_x\": 160");
    fs::write(dir.path().join("transforms.json"), whole).unwrap();
    let e = open(&dir).unwrap_err();
    assert!(e.to_string().contains("`images_4/000.png` is there, reduced by 4"), "{e}");
    assert!(e.hint().contains("--set capture.downscale=4"), "{}", e.hint());
    // and that way works
    let c = capture::open(dir.path(), &CaptureOptions { downscale: 4, ..Default::default() }).unwrap();
    assert_eq!((photos(&dir, &c), c.views[0].camera.width), (all("images_4/{}.png"), 24));
    // cameras of that size need no factor
    fs::write(dir.path().join("transforms.json"), json).unwrap();
    let e = open(&dir).unwrap_err();
    assert!(e.hint().contains("rename `images_4/` to `images/`"), "{}", e.hint());
}

#[test]
fn names_that_lead_out_of_the_capture_stay_refused_if_nothing_inside_is_called_so() {
    for name in ["/home/me/elsewhere/{}.png", "../{}.png", "D:\\\\x\\\\{}.png"] {
        let dir = capture_of(name, "images/shot_{}.png", "");
        let e = open(&dir).unwrap_err();
        assert!(e.to_string().contains("outside the capture"), "{name}: {e}");
    }
    // what climbs out and is called like a file inside may mean another
    let dir = capture_of("../{}.png", "images/{}.png", "");
    assert!(open(&dir).unwrap_err().to_string().contains("outside the capture"));
}

/// The options that name a folder of masks.
fn in_folder(mask_dir: &str) -> CaptureOptions {
    CaptureOptions { mask_dir: mask_dir.into(), ..CaptureOptions::default() }
}

#[test]
fn masks_of_other_names_folders_and_formats_are_found() {
    let rows = [
        "mask/{}.png",
        "masks/{}.PNG",
        "Masks/{}.png",
        "masks/{}_mask.png",
        "masks/{}-mask.png",
        "masks/{}.mask.png",
        "masks/mask_{}.png",
        "masks/{}_alpha.png",
        "mattes/{}.png",
        "alpha/{}.png",
        "fg_masks/{}.png",
        "seg_masks/{}_seg.png",
        "matting/{}_matte.png",
        "images/masks/{}.png",
        "images/{}_mask.png",
    ];
    for name in rows {
        let dir = capture_of("images/{}.png", "images/{}.png", name);
        let c = open(&dir).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(masks(&dir, &c), all(name), "{name}");
        assert!(
            says(&c.reasons, &["head masks from", "9 of 9 views", &named(name, 0)]),
            "{name}: {:?}",
            c.reasons
        );
    }
    assert_eq!(inspected(&capture_of("images/{}.png", "images/{}.png", rows[0])).masks, VIEWS);
    // JPEG, and decomposed letters, which macOS writes
    let dir = capture_of("images/zo\u{eb}_{}.png", "images/zo\u{eb}_{}.png", "masks/zoe\u{308}_{}.png");
    assert_eq!(masks(&dir, &open(&dir).unwrap()), all("masks/zoe\u{308}_{}.png"));
    let dir = capture_of("images/{}.png", "images/{}.png", "");
    (0..VIEWS).for_each(|i| picture(&dir, &named("masks/{}.jpg", i)));
    assert_eq!(masks(&dir, &open(&dir).unwrap()), all("masks/{}.jpg"));
}

#[test]
fn the_first_folder_of_masks_wins_and_others_are_named() {
    let dir = capture_of("images/{}.png", "images/{}.png", "mattes/{}.png");
    (0..VIEWS).for_each(|i| mask(&dir, &named("mask/{}.png", i)));
    let c = open(&dir).unwrap();
    assert_eq!(masks(&dir, &c), all("mask/{}.png"));
    assert!(says(&c.reasons, &["other masks are not used", "`mattes/`"]), "{:?}", c.reasons);
    // the exact name is before all of them
    (0..VIEWS).for_each(|i| mask(&dir, &named("masks/{}.png", i)));
    assert_eq!(masks(&dir, &open(&dir).unwrap()), all("masks/{}.png"));
}

#[test]
fn masks_in_one_folder_may_be_of_several_formats() {
    let dir = capture_of("images/{}.png", "images/{}.png", "masks/{}.png");
    fs::rename(dir.path().join("masks/004.png"), dir.path().join("masks/004.PNG")).unwrap();
    let c = open(&dir).unwrap();
    assert_eq!(masks(&dir, &c).len(), VIEWS);
    assert!(says(&c.reasons, &["`masks/004.PNG`"]), "{:?}", c.reasons);
    // a word of masks is no other format
    fs::rename(dir.path().join("masks/004.PNG"), dir.path().join("masks/004_seg.png")).unwrap();
    assert_eq!(masks(&dir, &open(&dir).unwrap()).len(), VIEWS - 1);
}

#[test]
fn a_folder_of_masks_that_no_view_is_named_after_is_named_with_an_example_and_a_way() {
    let dir = capture_of("images/{}.png", "images/{}.png", "masks/person{}b.png");
    let found = inspected(&dir);
    let problem = found.problems.iter().find(|p| p.what.contains("head mask")).unwrap();
    for word in ["`masks/` has 9 pictures", "`masks/person000b.png`", "`masks/000.png`"] {
        assert!(problem.what.contains(word), "{word}: {}", problem.what);
    }
    assert!(says(&found.reasons, &["the capture has no masks", "`masks/`"]), "{found}");
    let required = capture::require_masks(&open(&dir).unwrap(), &CaptureOptions::default()).unwrap_err();
    assert_eq!(required.to_string(), problem.what);
    // two for a view
    let dir = capture_of("images/{}.png", "images/{}.png", "masks/{}_mask.png");
    (0..VIEWS).for_each(|i| mask(&dir, &named("masks/{}_alpha.png", i)));
    assert!(says(&inspected(&dir).reasons, &["`masks/` has 18 pictures", "several fit the view `000`"]));
    // a folder that is not called like masks, and the setting that reads it
    let dir = capture_of("images/{}.png", "images/{}.png", "bw/{}.png");
    assert!(says(&inspected(&dir).reasons, &["`bw/`", "--set capture.mask_dir=bw"]));
    let c = capture::open(dir.path(), &in_folder("bw")).unwrap();
    assert_eq!(masks(&dir, &c), all("bw/{}.png"));
}

#[test]
fn pictures_that_may_be_masks_are_named_where_there_are_no_others() {
    let rows = [
        ("parsing_masks/{}.png", "`parsing_masks/` has pictures named as the views, but its name"),
        ("output/{}.png", "--set capture.mask_dir=output"),
        ("images/{}-removebg-preview.png", "`images/000-removebg-preview.png` and others lie beside"),
        ("images/{}.png", "`images/000.png` and others lie beside"),
    ];
    for (name, words) in rows {
        let dir = capture_of("images/{}.jpg", "images/{}.jpg", name);
        let found = inspected(&dir);
        assert!(says(&found.reasons, &["the capture has no masks", words]), "{name}: {found}");
    }
    let dir = capture_of("images/{}.jpg", "images/{}.jpg", "depth/{}.png");
    assert!(!says(&inspected(&dir).reasons, &["depth"]));
}

#[test]
fn masks_that_are_counted_on_their_own_are_not_those_of_the_numbers() {
    // every second photograph, and masks from 1: half of the numbers are those of other views
    let dir = tempfile::tempdir().unwrap();
    let frames: Vec<String> = (0..VIEWS).map(|i| frame(i, &named("images/{}.png", 2 * i), "")).collect();
    write_frames(&dir, &frames);
    for i in 0..VIEWS {
        picture(&dir, &named("images/{}.png", 2 * i));
        mask(&dir, &format!("masks/{:05}.png", i + 1));
    }
    let found = inspected(&dir);
    let words = ["`masks/` has 9 pictures for 9 views, but only 4 have the same number", "`masks/000.png`"];
    assert!(found.masks == 0 && says(&found.reasons, &words), "{found}");
    // the numbers of all views, written without zeros
    (0..VIEWS).for_each(|i| fs::remove_file(dir.path().join(format!("masks/{:05}.png", i + 1))).unwrap());
    (0..VIEWS).for_each(|i| mask(&dir, &format!("masks/{}.png", 2 * i)));
    let c = open(&dir).unwrap();
    let own: Vec<String> = (0..VIEWS).map(|i| format!("masks/{}.png", 2 * i)).collect();
    assert_eq!(masks(&dir, &c), own);
}

#[test]
fn masks_of_another_side_or_of_a_part_of_the_head_are_not_the_heads() {
    for place in ["masks/left", "lip_masks", "dynamic_masks"] {
        let dir = capture_of("images/right/{}.png", "images/right/{}.png", &format!("{place}/{{}}.png"));
        let found = inspected(&dir);
        assert!(found.masks == 0 && says(&found.reasons, &["the capture has no masks"]), "{place}: {found}");
    }
    for place in ["masks/right", "masks/head", "handmade_masks"] {
        let name = format!("{place}/{{}}.png");
        let dir = capture_of("images/right/{}.png", "images/right/{}.png", &name);
        assert_eq!(masks(&dir, &open(&dir).unwrap()), all(&name), "{place}");
    }
}

#[test]
fn a_mask_folder_that_is_named_is_found_in_other_letters_and_from_outside() {
    let dir = capture_of("images/{}.png", "images/{}.png", "cutouts/{}_mask.PNG");
    for mask_dir in ["cutouts", "Cutouts", "head/cutouts", "/home/me/head/cutouts/"] {
        let c = capture::open(dir.path(), &in_folder(mask_dir)).unwrap_or_else(|e| panic!("{mask_dir}: {e}"));
        assert_eq!(masks(&dir, &c), all("cutouts/{}_mask.PNG"), "{mask_dir}");
    }
    let c = capture::open(dir.path(), &in_folder("mattes")).unwrap();
    assert!(
        masks(&dir, &c).is_empty() && says(&c.warnings, &["there is no folder `mattes`"]),
        "{:?}",
        c.warnings
    );
    assert!(capture::open(dir.path(), &in_folder("../mattes")).is_err());
}

#[test]
fn no_photograph_is_its_own_mask() {
    let dir = capture_of("images/{}.png", "images/{}.png", "");
    for masks in [MaskSource::Auto, MaskSource::Folder] {
        let options = CaptureOptions { masks, ..in_folder("images") };
        let e = capture::open(dir.path(), &options).unwrap_err();
        assert!(
            e.to_string().contains("`images/` holds the photographs") && e.hint().contains("NAME_mask.png"),
            "{e}"
        );
    }
    (0..VIEWS).for_each(|i| mask(&dir, &named("images/{}_mask.png", i)));
    let c = capture::open(dir.path(), &in_folder("images")).unwrap();
    assert_eq!(masks(&dir, &c), all("images/{}_mask.png"));
}

#[test]
fn masks_that_frames_name_are_found_nearby_and_never_among_the_photographs() {
    let with_masks = |name: &str, there: &str| {
        let dir = capture_of("images/{}.png", "images/{}.png", there);
        let more = |i: usize| format!("\"mask_path\": \"{}\",", named(name, i));
        let frames: Vec<String> =
            (0..VIEWS).map(|i| frame(i, &named("images/{}.png", i), &more(i))).collect();
        write_frames(&dir, &frames);
        dir
    };
    let rows = [
        ("masks/{}.png", "masks/{}.PNG"),
        ("masks/{}.png", "mask/{}.png"),
        ("masks/{}.png", "masks/{}_mask.png"),
        ("/home/me/head/masks/{}.png", "masks/{}.png"),
    ];
    for (name, there) in rows {
        let dir = with_masks(name, there);
        let c = open(&dir).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(masks(&dir, &c), all(there), "{name}");
        assert!(says(&c.reasons, &["9 masks are found under near names"]), "{:?}", c.reasons);
    }
    let dir = with_masks("masks/{}.png", "");
    assert!(open(&dir).unwrap_err().to_string().contains("mask it names"), "the photograph is none");
}

#[test]
fn masks_of_usable_pixels_are_found_by_near_names() {
    let dir = capture_of("images/{}.png", "images/{}.png", "masks/{}.png");
    fs::create_dir(dir.path().join("Valid")).unwrap();
    let bytes =
        io::npy_bytes("|b1", &[SIZE.1 as usize, SIZE.0 as usize], &vec![1; (SIZE.0 * SIZE.1) as usize]);
    for i in 0..VIEWS {
        fs::write(dir.path().join(named("Valid/{}_valid.npy", i)), &bytes).unwrap();
    }
    let c = open(&dir).unwrap();
    let valid: Vec<PathBuf> = c.views.iter().filter_map(|view| view.valid.clone()).collect();
    assert!(valid.len() == VIEWS && valid[0].ends_with("000_valid.npy"), "{valid:?}");
    assert!(says(&c.reasons, &["valid pixels from `Valid/`"]), "{:?}", c.reasons);
    // photographs to validate with are none
    let dir = capture_of("images/{}.png", "images/{}.png", "masks/{}.png");
    (0..VIEWS).for_each(|i| picture(&dir, &named("valid/{}.png", i)));
    assert!(open(&dir).unwrap().views.iter().all(|view| view.valid.is_none()));
}

#[test]
fn colmap_names_with_folders_are_found_flat_with_their_masks() {
    let dir = tempfile::tempdir().unwrap();
    let mut images = String::new();
    for i in 0..VIEWS {
        picture(&dir, &named("images/{}.png", i));
        mask(&dir, &named("masks/{}.png", i));
        // turned about the vertical, half a radian apart
        let (s, c) = (0.25 * i as f64).sin_cos();
        images += &format!("{} {c} 0 {s} 0 0 0 2 1 {}\n\n", i + 1, named("01/{}.png", i));
    }
    fs::create_dir_all(dir.path().join("sparse/0")).unwrap();
    let put = |name: &str, text: &str| fs::write(dir.path().join("sparse/0").join(name), text).unwrap();
    put("cameras.txt", &format!("1 PINHOLE {} {} 40 40 12 16\n", SIZE.0, SIZE.1));
    put("images.txt", &images);
    put("points3D.txt", "");
    let c = open(&dir).unwrap();
    assert_eq!((photos(&dir, &c), masks(&dir, &c)), (all("images/{}.png"), all("masks/{}.png")));
    assert!(says(&c.reasons, &["`images/000.png` is read for `01/000.png`"]), "{:?}", c.reasons);
}

/// A NeuS scene with photographs in a folder.
fn neus(folder: &str) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let mut zip = zip::ZipWriter::new(fs::File::create(dir.path().join("cameras_sphere.npz")).unwrap());
    for i in 0..VIEWS {
        picture(&dir, &named(&format!("{folder}/{{}}.png"), i));
        // K [R | t] with f = 40, the camera 2 behind the origin, turned about the vertical
        let (s, c) = (0.5 * i as f64).sin_cos();
        let rotation = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]];
        let t = [0.0, 0.0, 2.0];
        let k = [[40.0, 0.0, 12.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]];
        let mut rows: Vec<f64> = Vec::new();
        for k in k {
            let dot = |v: [f64; 3]| k[0] * v[0] + k[1] * v[1] + k[2] * v[2];
            rows.extend([0, 1, 2].map(|j| dot([rotation[0][j], rotation[1][j], rotation[2][j]])));
            rows.push(dot(t));
        }
        rows.extend([0.0, 0.0, 0.0, 1.0]);
        let bytes: Vec<u8> = rows.iter().flat_map(|v| v.to_le_bytes()).collect();
        zip.start_file(format!("world_mat_{i}.npy"), zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(&io::npy_bytes("<f8", &[4, 4], &bytes)).unwrap();
    }
    zip.finish().unwrap();
    dir
}

#[test]
fn neus_masks_that_are_not_as_many_as_the_photographs_are_paired_by_name_or_named() {
    let dir = neus("image");
    (0..VIEWS).for_each(|i| mask(&dir, &named("mask/{}.png", i)));
    mask(&dir, "mask/overview.png");
    let c = open(&dir).unwrap();
    assert_eq!(masks(&dir, &c), all("mask/{}.png"));
    assert!(says(&c.warnings, &["10 masks for 9 photographs", "`overview.png`"]), "{:?}", c.warnings);
    // as many as the photographs: in order, whatever they are called
    fs::remove_file(dir.path().join("mask/000.png")).unwrap();
    let c = open(&dir).unwrap();
    assert_eq!(masks(&dir, &c)[0], "mask/001.png");
    assert!(says(&c.warnings, &["in the order of the photographs", "`mask/002.png`"]), "{:?}", c.warnings);
    let dir = neus("image");
    (0..VIEWS + 1).for_each(|i| mask(&dir, &named("mask/x{}y.png", i)));
    let c = open(&dir).unwrap();
    assert!(masks(&dir, &c).is_empty() && says(&c.warnings, &["10 masks for 9 photographs", "only 0"]));
}

#[test]
fn masks_beside_the_photographs_are_not_counted_as_photographs() {
    let dir = neus("image");
    (0..VIEWS).for_each(|i| mask(&dir, &named("image/{}_mask.png", i)));
    let c = open(&dir).unwrap();
    assert_eq!((photos(&dir, &c), masks(&dir, &c)), (all("image/{}.png"), all("image/{}_mask.png")));
}

#[test]
fn cameras_without_names_find_a_folder_of_another_name_and_name_a_reduced_one() {
    let dir = neus("Image");
    assert_eq!(photos(&dir, &open(&dir).unwrap()), all("Image/{}.png"));
    let dir = neus("photos");
    let c = open(&dir).unwrap();
    assert!(
        photos(&dir, &c) == all("photos/{}.png") && says(&c.reasons, &["`photos/` is read"]),
        "{:?}",
        c.reasons
    );
    let e = open(&neus("image_2")).unwrap_err();
    assert!(e.to_string().contains("`image_2/` is there, reduced by 2") && !e.hint().is_empty(), "{e}");
}

#[test]
#[cfg(unix)]
fn a_capture_that_contains_itself_by_a_link_is_searched_to_an_end() {
    let dir = capture_of("images/{}.jpg", "images/{}.JPG", "");
    fs::create_dir_all(dir.path().join("a")).unwrap();
    std::os::unix::fs::symlink(dir.path(), dir.path().join("a/again")).unwrap();
    let c = open(&dir).unwrap();
    assert_eq!(photos(&dir, &c), all("images/{}.JPG"));
}
