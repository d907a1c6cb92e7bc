//! Masks that are not white on black: in another color, as labels, as cutouts, or turned against
//! their photographs.

use crate::command::{code, err, out, tiface, worked};
use crate::kept::photographed;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;
use tiface::capture::inspect::{Inspection, inspect};
use tiface::capture::synthetic::SyntheticOptions;
use tiface::capture::{CaptureOptions, MaskMeaning};
use tiface::config::MaskHead;
use tiface::image::{Gray, Photo};
use tiface::io::{
    Limits, jpeg_bytes, read_gray, read_photo, write_png_gray, write_png_gray16, write_png_rgb,
    write_png_rgba,
};

/// A capture of eight photographs and a held-out one in `head`, of which `draw` writes each mask
/// again: the file, and the opacity of the head.
fn drawn(draw: impl Fn(&Path, &Gray)) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 32, height: 40, train: 8, test: 1, seed: 1 };
    photographed(&dir.path().join("head"), &options);
    for file in masks(dir.path()) {
        let mask = read_gray(&file, None, &Limits::default()).unwrap();
        draw(&file, &mask);
    }
    dir
}

/// The mask files, in the order of their views.
fn masks(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder.join("head/masks")).unwrap();
    let mut files: Vec<PathBuf> = entries.map(|e| e.unwrap().path()).collect();
    files.retain(|file| file.extension().is_some_and(|e| e == "png"));
    files.sort();
    files
}

fn in_color(mask: &Gray, [r, g, b]: [u8; 3]) -> Vec<[u8; 3]> {
    let share = |c: u8, m: u8| ((u16::from(c) * u16::from(m) + 127) / 255) as u8;
    mask.values.iter().map(|&m| [share(r, m), share(g, m), share(b, m)]).collect()
}

/// 0 outside, 1 in the upper half of the head and 2 in the lower.
fn label(mask: &Gray, i: usize) -> usize {
    let is_lower = i >= mask.values.len() / 2;
    if mask.values[i] < 128 { 0 } else { 1 + usize::from(is_lower) }
}

fn labeled(file: &Path, mask: &Gray, colors: [[u8; 3]; 3]) {
    let rgb: Vec<[u8; 3]> = (0..mask.values.len()).map(|i| colors[label(mask, i)]).collect();
    write_png_rgb(file, mask.width, mask.height, &rgb).unwrap();
}

fn label_grays(file: &Path, mask: &Gray, grays: [u8; 3]) {
    let values = (0..mask.values.len()).map(|i| grays[label(mask, i)]).collect();
    write_png_gray(file, &Gray { values, ..mask.clone() }).unwrap();
}

fn indexed(file: &Path, mask: &Gray, palette: &[u8]) {
    let mut encoder = png::Encoder::new(fs::File::create(file).unwrap(), mask.width, mask.height);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_palette(palette);
    let indices: Vec<u8> = (0..mask.values.len()).map(|i| label(mask, i) as u8).collect();
    encoder.write_header().unwrap().write_image_data(&indices).unwrap();
}

fn found(dir: &TempDir, head: &str) -> Inspection {
    let head = MaskHead::try_from(head.to_string()).unwrap();
    inspect(&dir.path().join("head"), &CaptureOptions { head, ..CaptureOptions::default() })
}

fn coverage(found: &Inspection) -> f64 {
    assert!(found.is_usable(), "{found}");
    found.coverage.unwrap().median
}

/// The same masks in white, inspected once.
fn plain() -> &'static Inspection {
    static PLAIN: OnceLock<Inspection> = OnceLock::new();
    PLAIN.get_or_init(|| found(&drawn(|_, _| {}), "white"))
}

/// Their coverage.
fn white() -> f64 {
    coverage(plain())
}

/// The only problem, and its hint.
fn refused(found: &Inspection) -> (String, String) {
    let [problem] = &found.problems[..] else { panic!("{found}") };
    (problem.what.clone(), problem.hint.clone())
}

#[test]
fn masks_in_one_color_or_gray_make_no_transparent_head() {
    let plain = plain();
    for color in [[80, 0, 255], [0, 255, 0], [128, 0, 0], [128; 3], [200; 3]] {
        let dir = drawn(|file, mask| {
            write_png_rgb(file, mask.width, mask.height, &in_color(mask, color)).unwrap();
        });
        let found = found(&dir, "white");
        assert!((coverage(&found) - coverage(plain)).abs() < 0.01, "{color:?}: {found}");
        let [r, g, b] = color;
        let shown = if r == g { format!("gray {r}") } else { format!("({r}, {g}, {b})") };
        let said = |text: &String| text.contains(&shown) && text.contains("taken for white");
        assert!(found.reasons.iter().any(said), "{color:?}: {found}");
        assert_eq!(found.warnings, plain.warnings, "{color:?}");
    }
}

#[test]
fn masks_in_one_color_may_have_the_noise_of_jpeg() {
    let whole = white();
    for color in [[80, 0, 255], [0, 255, 0], [128; 3]] {
        let dir = drawn(|file, mask| {
            let rgb = in_color(mask, color);
            let photo = Photo { width: mask.width, height: mask.height, rgb, alpha: None };
            fs::write(file, jpeg_bytes(&photo, 92, file).unwrap()).unwrap();
        });
        let found = found(&dir, "white");
        assert!((coverage(&found) - whole).abs() < 0.05, "{color:?}: {found}");
    }
}

#[test]
fn masks_of_zeros_and_ones_are_no_empty_masks() {
    let whole = white();
    for sixteen_bits in [false, true] {
        let dir = drawn(|file, mask| {
            let values: Vec<u16> = mask.values.iter().map(|&v| u16::from(v >= 128)).collect();
            match sixteen_bits {
                true => write_png_gray16(file, mask.width, mask.height, &values).unwrap(),
                false => {
                    let values = values.into_iter().map(|v| v as u8).collect();
                    write_png_gray(file, &Gray { values, ..mask.clone() }).unwrap();
                }
            }
        });
        let found = found(&dir, "white");
        assert!((coverage(&found) - whole).abs() < 0.03, "{found}");
        assert!(found.reasons.iter().any(|r| r.contains("gray 1 is taken for white")), "{found}");
    }
}

#[test]
fn labels_are_never_trained_on_in_silence() {
    let dir = drawn(|file, mask| label_grays(file, mask, [0, 1, 2]));
    let (what, hint) = refused(&found(&dir, "white"));
    assert!(what.contains("`masks/") && what.contains("gray 1") && what.contains("gray 2"), "{what}");
    assert!(hint.contains("mask.head=") && hint.contains("not-black"), "{hint}");
    // trusting masks is no word on what they mean
    for words in [&["iface", "head"][..], &["iface", "head", "--set", "mask.trust=true"]] {
        let o = tiface(dir.path(), words);
        assert!(code(&o) == 1 && err(&o).contains("mask.head="), "{words:?}: {}", err(&o));
    }
    assert!(!dir.path().join("runs/head/iface/checkpoint.safetensors").exists());
    let whole = coverage(&found(&dir, "1,2"));
    assert!((whole - white()).abs() < 0.03, "{whole}");
    assert_eq!(coverage(&found(&dir, "not-black")), whole);
    let part = found(&dir, "1").coverage.unwrap().median; // whatever else may be wrong with it
    assert!(part > 0.2 * whole && part < 0.8 * whole, "{part} of {whole}");
    let (what, _) = refused(&found(&dir, "7"));
    assert!(what.contains("mask.head=7") && what.contains("gray 1"), "{what}");
}

#[test]
fn a_gray_part_of_a_head_beside_a_white_one_is_no_half_transparent_head() {
    for grays in [[0, 255, 128], [0, 128, 255]] {
        let dir = drawn(|file, mask| label_grays(file, mask, grays));
        let (what, hint) = refused(&found(&dir, "white"));
        assert!(what.contains("as labels have") && what.contains("gray 128"), "{grays:?}: {what}");
        assert!(hint.contains("mask.head=") && hint.contains("not-black"), "{hint}");
        assert!((coverage(&found(&dir, "128,255")) - white()).abs() < 0.03);
    }
}

#[test]
fn labels_beside_a_value_for_nothing_are_no_white_masks() {
    // 255 is a thin border that counts for nothing
    let dir = drawn(|file, mask| {
        label_grays(file, mask, [0, 1, 1]);
        let mut labels = read_gray(file, None, &Limits::default()).unwrap();
        labels.values[..8].fill(255);
        write_png_gray(file, &labels).unwrap();
    });
    let (what, _) = refused(&found(&dir, "white"));
    assert!(what.contains("gray 1") && what.contains("gray 255"), "{what}");
    assert!((coverage(&found(&dir, "1")) - white()).abs() < 0.03);
}

#[test]
fn masks_in_several_colors_are_named_by_them() {
    let colors = [[0; 3], [128, 0, 0], [0, 128, 0]];
    let dir = drawn(|file, mask| labeled(file, mask, colors));
    let (what, hint) = refused(&found(&dir, "white"));
    assert!(what.contains("(128, 0, 0)") && what.contains("(0, 128, 0)"), "{what}");
    assert!(hint.contains("#800000") || hint.contains("#008000"), "{hint}");
    assert!((coverage(&found(&dir, "#800000,#008000")) - white()).abs() < 0.03);
    // a face in color on white
    let dir = drawn(|file, mask| labeled(file, mask, [[255; 3], [80, 0, 255], [80, 0, 255]]));
    refused(&found(&dir, "white"));
    assert!((coverage(&found(&dir, "#5000ff")) - white()).abs() < 0.03);
}

#[test]
fn indices_of_a_palette_are_labels() {
    let dir = drawn(|file, mask| indexed(file, mask, &[0, 0, 0, 128, 0, 0, 0, 128, 0]));
    let (what, hint) = refused(&found(&dir, "white"));
    assert!(what.contains("index 1 (128, 0, 0)") && what.contains("index 2 (0, 128, 0)"), "{what}");
    assert!(hint.contains("mask.head=1,2") || hint.contains("mask.head=2,1"), "{hint}");
    assert!((coverage(&found(&dir, "1,2")) - white()).abs() < 0.03);
    assert_eq!(coverage(&found(&dir, "2,1")), coverage(&found(&dir, "#800000,#008000")));
}

#[test]
fn photographs_in_the_place_of_masks_are_refused() {
    let dir = drawn(|_, _| {});
    for file in masks(dir.path()) {
        fs::copy(dir.path().join("head/images").join(file.file_name().unwrap()), &file).unwrap();
    }
    let found = found(&dir, "white");
    assert!(
        found.problems.iter().any(|p| p.what.contains("mask") && p.hint.contains("mask.head")),
        "{found}"
    );
}

#[test]
fn one_gray_mask_among_white_ones_is_named() {
    let dir = drawn(|_, _| {});
    let odd = &masks(dir.path())[3];
    let mask = read_gray(odd, None, &Limits::default()).unwrap();
    write_png_rgb(odd, mask.width, mask.height, &in_color(&mask, [128; 3])).unwrap();
    let (what, _) = refused(&found(&dir, "white"));
    let name = format!("masks/{}", odd.file_name().unwrap().to_str().unwrap());
    assert!(what.contains(&name) && what.contains("gray 128"), "{what}");
}

#[test]
fn the_alpha_of_cutouts_is_the_mask_and_said() {
    let whole = white();
    let dir = drawn(|file, mask| {
        let rgba: Vec<[u8; 4]> = mask.values.iter().map(|&m| [90, 60, 50, m]).collect();
        write_png_rgba(file, mask.width, mask.height, &rgba).unwrap();
    });
    for head in ["white", "not-black"] {
        let found = found(&dir, head);
        assert_eq!(coverage(&found), whole, "{head}");
        assert!(found.reasons.iter().any(|r| r.contains("alpha channel of 9 mask files")), "{found}");
    }
}

#[test]
fn masks_that_say_what_was_not_looked_at_are_read_by_their_values_as_well() {
    let share = |color: [u8; 3]| {
        let dir = drawn(|file, mask| {
            write_png_rgb(file, mask.width, mask.height, &in_color(mask, color)).unwrap();
        });
        let options = CaptureOptions { mask_meaning: MaskMeaning::Ignore, ..CaptureOptions::default() };
        inspect(&dir.path().join("head"), &options).valid_share.unwrap().median
    };
    let whole = share([255; 3]);
    assert!(whole > 0.1 && (share([0, 0, 255]) - whole).abs() < 0.01);
}

/// Runs the stage `mask`, and returns the masks that it wrote.
fn made(dir: &TempDir) -> Vec<Gray> {
    worked(&tiface(dir.path(), &["mask", "head"]));
    let at = |file: &PathBuf| dir.path().join("runs/head/mask").join(file.file_name().unwrap());
    masks(dir.path()).iter().map(|file| read_gray(&at(file), None, &Limits::default()).unwrap()).collect()
}

#[test]
fn a_run_reads_masks_in_a_color_as_white_ones() {
    let plain = drawn(|_, _| {});
    let truth: Vec<Gray> =
        masks(plain.path()).iter().map(|file| read_gray(file, None, &Limits::default()).unwrap()).collect();
    assert_eq!(made(&plain), truth);
    assert!(!plain.path().join("runs/head/mask/reading.json").exists());
    let dir = drawn(|file, mask| {
        write_png_rgb(file, mask.width, mask.height, &in_color(mask, [80, 0, 255])).unwrap();
    });
    for (made, truth) in made(&dir).iter().zip(&truth) {
        assert!(made.values.iter().zip(&truth.values).all(|(m, t)| m.abs_diff(*t) <= 17));
    }
    // later stages read the capture's own files, and find there how
    assert!(dir.path().join("runs/head/mask/reading.json").exists());
    let cameras = fs::read_to_string(dir.path().join("runs/head/cameras.json")).unwrap();
    assert!(cameras.contains("mask_reading"), "{cameras}");
}

#[test]
fn another_meaning_of_mask_values_makes_the_masks_again() {
    let dir = drawn(|file, mask| label_grays(file, mask, [0, 1, 2]));
    let run = |head: &str| tiface(dir.path(), &["mask", "head", "--set", &format!("mask.head={head}")]);
    worked(&run("1,2"));
    let o = run("not-black");
    assert!(code(&o) != 0 && err(&o).contains("mask.head"), "{}", err(&o));
    // the same words again find it done
    worked(&run("1,2"));
}

#[test]
fn a_wrong_value_of_the_head_is_named_with_its_key() {
    let dir = drawn(|_, _| {});
    for value in ["blue", "1,256", "#12345", "", "1,,2", "-1"] {
        let o = tiface(dir.path(), &["inspect", "head", "--set", &format!("mask.head={value}")]);
        assert_eq!(code(&o), 2, "{value}: {}", err(&o));
        assert!(err(&o).contains("`mask.head`") && err(&o).contains("not-black"), "{value}: {}", err(&o));
    }
    let o = tiface(dir.path(), &["config", "--explain", "mask.head"]);
    assert!(out(&o).contains("labels"), "{}", out(&o));
}

/// The bytes of a JPEG that EXIF turns in this way.
fn with_exif(photo: &Photo, orientation: u8) -> Vec<u8> {
    let plain = jpeg_bytes(photo, 95, Path::new("a.jpg")).unwrap();
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0".to_vec();
    exif[24] = orientation;
    let length = (exif.len() as u16 + 2).to_be_bytes();
    [&plain[..2], &[0xFF, 0xE1], &length, &exif, &plain[2..]].concat()
}

/// A mask as it lies after the turn of an EXIF orientation, 6 (clockwise) or 8.
fn turned(mask: &Gray, exif: u8) -> Gray {
    let (w, h) = (mask.width as usize, mask.height as usize);
    let at = |i: usize| {
        let (x, y) = (i % h, i / h);
        let (x, y) = if exif == 6 { (y, h - 1 - x) } else { (w - 1 - y, x) };
        mask.values[y * w + x]
    };
    Gray { width: mask.height, height: mask.width, values: (0..w * h).map(at).collect() }
}

#[test]
fn upright_masks_of_photographs_stored_on_their_side_are_turned() {
    let whole = white();
    for exif in [6, 8] {
        let dir = drawn(|file, mask| write_png_gray(file, &turned(mask, exif)).unwrap());
        for file in masks(dir.path()) {
            let photo = dir.path().join("head/images").join(file.file_name().unwrap());
            let pixels = read_photo(&photo, None, &Limits::default()).unwrap();
            fs::write(&photo, with_exif(&pixels, exif)).unwrap();
        }
        let found = found(&dir, "white");
        assert_eq!(coverage(&found), whole, "{exif}: {found}");
        let said = |r: &String| r.contains("9 masks lie on their side") && r.contains("EXIF");
        assert!(found.reasons.iter().any(said), "{found}");
    }
}

#[test]
fn turned_masks_without_exif_are_not_blamed_on_the_photographs() {
    let dir = drawn(|file, mask| write_png_gray(file, &turned(mask, 6)).unwrap());
    let (what, hint) = refused_first(&found(&dir, "white"));
    assert!(what.contains("the mask `") && what.contains("40 × 32") && what.contains("32 × 40"), "{what}");
    assert!(hint.contains("the mask is turned") && !hint.contains("the photograph lies"), "{hint}");
}

/// The first problem, and its hint.
fn refused_first(found: &Inspection) -> (String, String) {
    let problem = &found.problems[0];
    (problem.what.clone(), problem.hint.clone())
}
