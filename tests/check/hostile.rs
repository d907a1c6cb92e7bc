//! Crafted and unlucky files: each ends in the named error that says which file and where, never in
//! a panic, a hang or a large allocation. One test per row of the specification's table of hostile
//! input.

use crate::capture_folder::open;
use crate::kept::copy;
use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use tiface::capture::inspect::inspect;
use tiface::capture::{self, CaptureOptions, MaskMeaning, MaskSource, Split, ViewMask};
use tiface::io::{self, Limits, NpyValues, ReadError, TensorValues};

/// The channel of depth.
const DEPTH: &[&[&str]] = &[&["Z"]];

fn limits() -> Limits {
    Limits::default()
}

/// A file in a folder of its own.
fn file(name: &str, bytes: &[u8]) -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    fs::write(&path, bytes).unwrap();
    (dir, path)
}

fn names_file(error: &dyn std::fmt::Display, name: &str) {
    assert!(error.to_string().contains(name), "the message does not name {name}: {error}");
}

fn png(width: u32, height: u32) -> Vec<u8> {
    let (_dir, path) = file("p.png", b"");
    let rgb: Vec<[u8; 3]> = (0..width * height).map(|i| [i as u8, (i * 7) as u8, 90]).collect();
    io::write_png_rgb(&path, width, height, &rgb).unwrap();
    fs::read(path).unwrap()
}

fn jpeg(width: u32, height: u32) -> Vec<u8> {
    let rgb: Vec<u8> = (0..width * height * 3).map(|i| (i * 31 % 251) as u8).collect();
    let mut out = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, 90)
        .encode(&rgb, width, height, image::ExtendedColorType::Rgb8)
        .unwrap();
    out
}

/// A JPEG of one even color written by hand: `components` without subsampling, every coefficient 0.
/// Huffman tables have the single code `0`, for "no difference" (DC) and "end of block" (AC).
fn flat_jpeg(width: u16, height: u16, components: u8, progressive: bool) -> Vec<u8> {
    let mut b = vec![0xFF, 0xD8, 0xFF, 0xDB, 0, 67, 0];
    b.extend([1u8; 64]);
    b.extend([0xFF, if progressive { 0xC2 } else { 0xC0 }, 0, 8 + 3 * components, 8]);
    b.extend([height.to_be_bytes(), width.to_be_bytes()].as_flattened());
    b.push(components);
    (1..=components).for_each(|id| b.extend([id, 0x11, 0]));
    for class in [0x00, 0x10] {
        b.extend([0xFF, 0xC4, 0, 20, class, 1]);
        b.extend([0u8; 15]);
        b.push(0);
    }
    b.extend([0xFF, 0xDA, 0, 6 + 2 * components, components]);
    (1..=components).for_each(|id| b.extend([id, 0]));
    b.extend([0, if progressive { 0 } else { 63 }, 0]);
    let blocks = width.div_ceil(8) as usize * height.div_ceil(8) as usize * components as usize;
    let bits = blocks * if progressive { 1 } else { 2 };
    b.extend(vec![0u8; bits / 8]);
    if !bits.is_multiple_of(8) {
        b.push(0xFF >> (bits % 8)); // the rest is padded with ones
        if b.ends_with(&[0xFF]) {
            b.push(0);
        }
    }
    b.extend([0xFF, 0xD9]);
    b
}

fn npy(descr: &str, order: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n");
    let mut b = b"\x93NUMPY\x01\x00".to_vec();
    b.extend((header.len() as u16).to_le_bytes());
    b.extend(header.as_bytes());
    b.extend(data);
    b
}

fn tensors() -> Vec<u8> {
    let list = [
        ("a".to_string(), vec![2, 2], TensorValues::F32(vec![1.0, 2.0, 3.0, 4.0])),
        ("b".to_string(), vec![1], TensorValues::U64(vec![9])),
    ];
    io::tensor_bytes(&list, &[("step".to_string(), "3".to_string())].into()).unwrap()
}

/// A safetensors file with this header and this many bytes of data.
fn tensor_file(header: &str, data: usize) -> Vec<u8> {
    let mut b = (header.len() as u64).to_le_bytes().to_vec();
    b.extend(header.as_bytes());
    b.extend(vec![0; data]);
    b
}

fn exr(width: u32, height: u32) -> Vec<u8> {
    let (_dir, path) = file("p.exr", b"");
    let z: Vec<f32> = (0..width * height).map(|i| i as f32).collect();
    io::write_exr(&path, width, height, &[("Z", &z)]).unwrap();
    fs::read(path).unwrap()
}

// --------------------------------------------------------------------------------------------- any

#[test]
fn an_empty_file_is_empty_for_every_reader() {
    let (_d, path) = file("nothing", b"");
    let all: Vec<ReadError> = vec![
        io::read_photo(&path, None, &limits()).unwrap_err(),
        io::picture_info(&path, &limits()).unwrap_err(),
        io::read_gray(&path, None, &limits()).unwrap_err(),
        io::read_exr(&path, DEPTH, &limits()).unwrap_err(),
        io::read_npy(&path, &limits()).unwrap_err(),
        io::read_json(&path, &limits()).unwrap_err(),
        io::read_tensors(&path, &limits()).unwrap_err(),
    ];
    for e in all {
        assert!(matches!(e, ReadError::Empty { .. }), "{e}");
        names_file(&e, "nothing");
        assert!(!e.hint().is_empty());
    }
}

#[test]
fn what_is_not_a_regular_file_is_named_and_never_waited_for() {
    let dir = tempfile::tempdir().unwrap();
    let e = io::read_npy(dir.path(), &limits()).unwrap_err();
    assert!(matches!(e, ReadError::NotAFile { kind: "a folder", .. }), "{e}");
    #[cfg(unix)]
    {
        let pipe = dir.path().join("pipe.png");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        if made.is_ok_and(|s| s.success()) {
            let e = io::read_photo(&pipe, None, &limits()).unwrap_err();
            assert!(matches!(e, ReadError::NotAFile { kind: "a named pipe", .. }), "{e}");
            names_file(&e, "pipe.png");
        } else {
            eprintln!("skipped: there is no `mkfifo` here");
        }
        let (a, b) = (dir.path().join("a.json"), dir.path().join("b.json"));
        std::os::unix::fs::symlink(&a, &b).unwrap();
        std::os::unix::fs::symlink(&b, &a).unwrap();
        let e = io::read_json(&a, &limits()).unwrap_err();
        assert!(matches!(e, ReadError::Io { .. }), "{e}");
        names_file(&e, "a.json");
        let e = io::read_bytes(Path::new("/dev/zero"), &limits()).unwrap_err();
        assert!(matches!(e, ReadError::NotAFile { kind: "a device", .. }), "{e}");
    }
}

#[test]
#[cfg(unix)]
fn a_file_that_may_not_be_read_is_named() {
    use std::os::unix::fs::PermissionsExt;
    let (_d, path) = file("secret.npy", b"x");
    fs::set_permissions(&path, fs::Permissions::from_mode(0o000)).unwrap();
    if fs::read(&path).is_ok() {
        eprintln!("skipped: this user may read everything");
        return;
    }
    let e = io::read_npy(&path, &limits()).unwrap_err();
    assert!(matches!(e, ReadError::Io { .. }) && e.hint().contains("chmod"), "{e}");
}

#[test]
fn the_content_decides_the_format_whatever_the_ending_says() {
    let (_d, path) = file("really_a_png.jpg", &png(4, 3));
    assert_eq!(io::read_photo(&path, None, &limits()).unwrap().width, 4);
    let (_d, path) = file("really_a_jpeg.png", &jpeg(8, 8));
    assert_eq!(io::read_photo(&path, None, &limits()).unwrap().height, 8);
    for (bytes, word) in [
        (&b"GIF89a......"[..], "GIF"),
        (b"RIFF....WEBPVP8 ", "WebP"),
        (b"II*\0........", "TIFF"),
        (b"\0\0\0\x18ftypheic", "HEIF"),
    ] {
        let (_d, path) = file("photo.png", bytes);
        let e = io::read_photo(&path, None, &limits()).unwrap_err();
        assert!(matches!(e, ReadError::Unsupported { .. }) && e.to_string().contains(word), "{e}");
    }
    let (_d, path) = file("photo.png", b"hello, this is text");
    let e = io::read_photo(&path, None, &limits()).unwrap_err();
    assert!(matches!(e, ReadError::Damaged { offset: Some(0), .. }), "{e}");
}

/// Reads bytes with every reader; only panics matter.
fn read_all(dir: &Path, bytes: &[u8]) {
    // small limits keep the many mutants with huge but allowed sizes fast
    let limits = Limits { side_px: 1024, decoded_bytes: 16 << 20, ..limits() };
    let path = dir.join("mutant");
    fs::write(&path, bytes).unwrap();
    let _ = io::read_photo(&path, None, &limits);
    let _ = io::picture_info(&path, &limits);
    let _ = io::read_gray(&path, None, &limits);
    let _ = io::read_exr(&path, DEPTH, &limits);
    let _ = io::parse_npy(&path, bytes, &limits);
    let _ = io::parse_json(&path, bytes, &limits);
    let _ = io::parse_tensors(&path, bytes, &limits);
}

#[test]
fn truncation_at_every_byte_is_an_error_with_the_path() {
    let json = br#"{"w": 3, "frames": [{"file_path": "a", "x": [1, -2.5e3, null, true]}]}"#.to_vec();
    let progressive = flat_jpeg(24, 18, 1, true);
    let array = npy("'<f4'", "False", "(2, 2)", &[0; 16]);
    type Read = fn(&Path, &Limits) -> Option<ReadError>;
    let cases: [(&str, Vec<u8>, Read); 7] = [
        ("cut.png", png(7, 5), |p, l| io::read_photo(p, None, l).err()),
        ("cut.jpg", jpeg(17, 9), |p, l| io::read_photo(p, None, l).err()),
        ("cut-progressive.jpg", progressive, |p, l| io::read_photo(p, None, l).err()),
        ("cut.exr", exr(9, 40), |p, l| io::read_exr(p, DEPTH, l).err()),
        ("cut.npy", array, |p, l| io::read_npy(p, l).err()),
        ("cut.json", json, |p, l| io::read_json(p, l).err()),
        ("cut.safetensors", tensors(), |p, l| io::read_tensors(p, l).err()),
    ];
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes, read) in cases {
        let path = dir.path().join(name);
        fs::write(&path, &bytes).unwrap();
        assert!(read(&path, &limits()).is_none(), "{name} is not sound to begin with");
        for n in 0..bytes.len() {
            fs::write(&path, &bytes[..n]).unwrap();
            let e = read(&path, &limits()).unwrap_or_else(|| panic!("{name} cut to {n} bytes was accepted"));
            names_file(&e, name);
        }
    }
}

#[test]
fn no_flipped_byte_makes_a_reader_panic() {
    let dir = tempfile::tempdir().unwrap();
    let files = [
        png(5, 3),
        jpeg(9, 9),
        flat_jpeg(24, 18, 1, true),
        exr(5, 3),
        npy("'<f4'", "True", "(2, 2)", &[0; 16]),
        br#"{"a": [1, 2, {"b": -1.5e3}], "c": "\u00e4"}"#.to_vec(),
        tensors(),
    ];
    for bytes in files {
        for i in 0..bytes.len() {
            for flip in [0xFF, 0x01] {
                let mut mutant = bytes.clone();
                mutant[i] ^= flip;
                read_all(dir.path(), &mutant);
            }
        }
    }
}

// -------------------------------------------------------------------------------------- PNG · JPEG

/// Replaces the size in a PNG's header, with a correct checksum.
fn resized_png(width: u32, height: u32) -> Vec<u8> {
    let mut b = png(4, 4);
    b[16..20].copy_from_slice(&width.to_be_bytes());
    b[20..24].copy_from_slice(&height.to_be_bytes());
    let crc = crc32(&b[12..29]);
    b[29..33].copy_from_slice(&crc.to_be_bytes());
    b
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |mut crc, &b| {
        crc ^= b as u32;
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
        }
        crc
    })
}

#[test]
fn a_bomb_is_refused_by_its_size_before_it_is_decoded() {
    for (w, h) in [(65_535, 65_535), (16_385, 1), (u32::MAX, 1)] {
        let (_d, path) = file("bomb.png", &resized_png(w, h));
        let e = io::read_photo(&path, None, &limits()).unwrap_err();
        assert!(matches!(e, ReadError::TooLarge { limit: 16_384, .. }), "{w} × {h}: {e}");
        names_file(&e, "bomb.png");
    }
    // within the limits, but 800 MB cannot come from 60 bytes
    let (_d, path) = file("bomb.png", &resized_png(16_384, 16_384));
    let e = io::read_photo(&path, None, &limits()).unwrap_err();
    assert!(e.to_string().contains("cannot come from"), "{e}");
    let mut big = jpeg(8, 8);
    let frame = big.windows(2).position(|w| w == [0xFF, 0xC0]).unwrap();
    big[frame + 5..frame + 9].copy_from_slice(&[0xFF; 4]);
    let (_d, path) = file("bomb.jpg", &big);
    let e = io::read_photo(&path, None, &limits()).unwrap_err();
    assert!(matches!(e, ReadError::TooLarge { found: 65_535, .. }), "{e}");
}

#[test]
fn a_small_jpeg_that_claims_a_large_picture_is_refused_and_an_even_one_is_read() {
    for progressive in [false, true] {
        for components in [1, 3] {
            // nothing packs a picture tighter than this
            let mut b = flat_jpeg(200, 123, components, progressive);
            let (_d, path) = file("even.jpg", &b);
            assert_eq!(io::read_photo(&path, None, &limits()).unwrap().rgb.len(), 200 * 123);
            let frame = b.windows(2).position(|w| w == [0xFF, 0xC0] || w == [0xFF, 0xC2]).unwrap();
            b[frame + 5..frame + 9].copy_from_slice(&[0x3F, 0xFF, 0x3F, 0xFF]);
            let (_d, path) = file("bomb.jpg", &b);
            let e = io::read_photo(&path, None, &limits()).unwrap_err();
            assert!(e.to_string().contains("16383 × 16383 pixels cannot come from"), "{e}");
            names_file(&e, "bomb.jpg");
        }
    }
}

#[test]
fn a_picture_with_a_wrong_checksum_or_damaged_data_is_an_error() {
    let mut b = png(40, 40);
    let middle = b.len() / 2;
    b[middle] ^= 0x10;
    let (_d, path) = file("torn.png", &b);
    let e = io::read_photo(&path, None, &limits()).unwrap_err();
    assert!(matches!(e, ReadError::Damaged { format: "PNG", .. }), "{e}");
    names_file(&e, "torn.png");
    // a JPEG whose second half a crash left as zeros
    let mut b = jpeg(64, 64);
    let half = b.len() / 2;
    b[half..].fill(0);
    let (_d, path) = file("torn.jpg", &b);
    let e = io::read_photo(&path, None, &limits()).unwrap_err();
    assert!(matches!(e, ReadError::Damaged { format: "JPEG", .. }), "{e}");
}

#[test]
fn gray_palette_and_sixteen_bit_pictures_are_accepted_and_cmyk_is_refused() {
    use image::{ExtendedColorType, ImageEncoder};
    let encode = |bytes: &[u8], color| {
        let mut out = Vec::new();
        image::codecs::png::PngEncoder::new(&mut out).write_image(bytes, 2, 1, color).unwrap();
        out
    };
    for (bytes, color) in [
        (&[10u8, 200][..], ExtendedColorType::L8),
        (&[10, 255, 200, 255], ExtendedColorType::La8),
        (&[10, 10, 200, 200], ExtendedColorType::L16),
    ] {
        let (_d, path) = file("g.png", &encode(bytes, color));
        let p = io::read_photo(&path, None, &limits()).unwrap();
        assert_eq!(p.rgb, [[10; 3], [200; 3]], "{color:?}");
    }
    let (_d, path) = file("palette.png", &palette_png());
    assert_eq!(io::read_photo(&path, None, &limits()).unwrap().rgb, [[1, 2, 3], [250, 0, 9]]);

    let (_d, path) = file("print.jpg", &flat_jpeg(8, 8, 4, false));
    for e in
        [io::read_photo(&path, None, &limits()).unwrap_err(), io::picture_info(&path, &limits()).unwrap_err()]
    {
        assert!(matches!(e, ReadError::Unsupported { .. }) && e.hint().contains("sRGB"), "{e}");
        names_file(&e, "print.jpg");
    }
    let (_d, path) = file("p.jpg", &flat_jpeg(24, 18, 1, true));
    assert_eq!(io::read_photo(&path, None, &limits()).unwrap().rgb.len(), 24 * 18);
}

/// Two pixels, 1 bit each, from a palette; deflate "stored" block.
fn palette_png() -> Vec<u8> {
    let mut b = b"\x89PNG\r\n\x1a\n".to_vec();
    let mut chunk = |kind: &[u8], data: &[u8]| {
        b.extend((data.len() as u32).to_be_bytes());
        let body = [kind, data].concat();
        b.extend(&body);
        b.extend(crc32(&body).to_be_bytes());
    };
    chunk(b"IHDR", &[0, 0, 0, 2, 0, 0, 0, 1, 1, 3, 0, 0, 0]);
    chunk(b"PLTE", &[1, 2, 3, 250, 0, 9]);
    // zlib: header, final stored block of 2 bytes (filter 0, bits 01......), Adler-32 of 00 40
    chunk(b"IDAT", &[0x78, 1, 1, 2, 0, 0xFD, 0xFF, 0, 0x40, 0, 0x42, 0, 0x41]);
    chunk(b"IEND", &[]);
    b
}

#[test]
fn an_exif_turn_is_applied_only_when_the_declared_size_agrees() {
    // EXIF with one entry: orientation (0x0112) = 6, a quarter turn
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0".to_vec();
    let mut app1 = vec![0xFF, 0xE1];
    app1.extend((exif.len() as u16 + 2).to_be_bytes());
    app1.append(&mut exif);
    let plain = jpeg(16, 8);
    let turned = [&plain[..2], &app1, &plain[2..]].concat();
    let (_d, path) = file("side.jpg", &turned);
    assert_eq!(io::picture_info(&path, &limits()).unwrap().exif, 6);
    let info = io::picture_info(&path, &limits()).unwrap();
    assert_eq!(
        (info.size(Some((16, 8))), info.size(Some((8, 16))), info.size(None)),
        ((16, 8), (8, 16), (16, 8))
    );
    let stored = io::read_photo(&path, Some((16, 8)), &limits()).unwrap();
    assert_eq!((stored.width, stored.height), (16, 8));
    let upright = io::read_photo(&path, Some((8, 16)), &limits()).unwrap();
    assert_eq!((upright.width, upright.height), (8, 16));
    // code 6: shown turned clockwise, so the stored bottom-left corner comes to the top left
    assert_eq!(upright.rgb[0], stored.rgb[7 * 16]);
}

// --------------------------------------------------------------------------------------------- EXR

fn layer(
    names: &[&str],
    size: (usize, usize),
    at: (i32, i32),
) -> exr::prelude::Layer<exr::prelude::AnyChannels<exr::prelude::FlatSamples>> {
    use exr::prelude::*;
    let values: Vec<f32> = (0..size.0 * size.1).map(|i| i as f32 + 1.0).collect();
    let list = names.iter().map(|n| AnyChannel::new(*n, FlatSamples::F32(values.clone()))).collect();
    let attributes = LayerAttributes::named(names[0]).with_position(Vec2(at.0, at.1));
    Layer::new(size, attributes, Encoding::UNCOMPRESSED, AnyChannels::sort(list))
}

#[test]
fn a_data_window_is_placed_inside_the_display_window() {
    use exr::prelude::*;
    // display (10, 10) 4 × 3; data (9, 11) 3 × 2: its first column is outside
    let display = IntegerBounds::new((10, 10), (4, 3));
    let attributes = ImageAttributes::new(display);
    let picture = Image::empty(attributes).with_layer(layer(&["Z"], (3, 2), (9, 11)));
    let mut out = Cursor::new(Vec::new());
    picture.write().to_buffered(&mut out).unwrap();
    let (_d, path) = file("window.exr", &out.into_inner());
    let read = io::read_exr(&path, DEPTH, &limits()).unwrap();
    assert_eq!((read.image.width, read.image.height), (4, 3));
    let rows = [0., 0., 0., 0., 2., 3., 0., 0., 5., 6., 0., 0.];
    assert_eq!(read.image.data, rows);
}

#[test]
fn the_first_layer_with_the_channels_is_read_and_others_are_listed() {
    use exr::prelude::*;
    let layers: Layers<AnyChannels<FlatSamples>> =
        [layer(&["A"], (2, 1), (0, 0)), layer(&["R", "G", "B"], (2, 1), (0, 0))].into_iter().collect();
    let picture = Image::from_layers(ImageAttributes::new(IntegerBounds::new((0, 0), (2, 1))), layers);
    let mut out = Cursor::new(Vec::new());
    picture.write().to_buffered(&mut out).unwrap();
    let (_d, path) = file("parts.exr", &out.into_inner());
    let read = io::read_exr(&path, &[&["N.X", "N.Y", "N.Z"], &["R", "G", "B"]], &limits()).unwrap();
    assert_eq!(read.image.data, [1., 1., 1., 2., 2., 2.]);
    let e = io::read_exr(&path, &[&["W"]], &limits()).unwrap_err();
    assert!(matches!(e, ReadError::Unsupported { .. }) && e.to_string().contains("`A"), "{e}");
    names_file(&e, "parts.exr");
}

#[test]
fn deep_and_subsampled_and_huge_exr_pictures_are_refused_by_name() {
    let mut deep = exr(4, 4);
    deep[5] |= 0x08;
    let (_d, path) = file("deep.exr", &deep);
    let e = io::read_exr(&path, DEPTH, &limits()).unwrap_err();
    assert!(matches!(e, ReadError::Unsupported { .. }) && e.to_string().contains("deep"), "{e}");

    // channel list entry of `Z`: name, type i32, linear and 3 reserved bytes, then the two
    // samplings
    let mut sub = exr(4, 4);
    let list = sub.windows(7).position(|w| w == b"chlist\0").unwrap() + 11;
    assert_eq!(&sub[list..list + 2], b"Z\0");
    sub[list + 10] = 2;
    let (_d, path) = file("sub.exr", &sub);
    let e = io::read_exr(&path, DEPTH, &limits()).unwrap_err();
    names_file(&e, "sub.exr");

    let mut huge = exr(4, 4);
    let window = huge.windows(6).position(|w| w == b"box2i\0").unwrap() + 10;
    huge[window + 8..window + 12].copy_from_slice(&(1_000_000i32).to_le_bytes());
    let (_d, path) = file("huge.exr", &huge);
    let e = io::read_exr(&path, DEPTH, &limits()).unwrap_err();
    assert!(matches!(e, ReadError::TooLarge { .. }), "{e}");
}

#[test]
fn values_that_are_not_finite_become_zero_and_are_counted() {
    let (_d, path) = file("nan.exr", b"");
    io::write_exr(&path, 3, 1, &[("Z", &[f32::NAN, 2.0, f32::INFINITY])]).unwrap();
    let read = io::read_exr(&path, DEPTH, &limits()).unwrap();
    assert_eq!((read.image.data.as_slice(), read.replaced), (&[0.0, 2.0, 0.0][..], 2));
}

// --------------------------------------------------------------------------------------------- npy

#[test]
fn hostile_npy_headers_are_refused_and_unusual_ones_are_read() {
    let read = |bytes: &[u8]| {
        let (_d, path) = file("a.npy", bytes);
        let result = io::read_npy(&path, &limits());
        if let Err(e) = &result {
            names_file(e, "a.npy");
        }
        result
    };
    let mut v2 = b"\x93NUMPY\x02\x00".to_vec();
    v2.extend(0xFFFF_FFF0u32.to_le_bytes());
    v2.extend([0; 64]);
    assert!(matches!(read(&v2), Err(ReadError::TooLarge { found: 0xFFFF_FFF0, .. })));
    let overflow = npy("'<f8'", "False", "(4294967296, 4294967296, 4)", &[0; 8]);
    assert!(matches!(read(&overflow), Err(ReadError::Damaged { .. })));
    let large = npy("'|u1'", "False", "(1000000000000,)", &[0; 8]);
    assert!(matches!(read(&large), Err(ReadError::Damaged { .. })));
    let pickle = npy("'|O'", "False", "(1,)", b"\x80\x04N.");
    let e = read(&pickle).unwrap_err();
    assert!(matches!(e, ReadError::Unsupported { .. }) && e.to_string().contains("pickle"), "{e}");
    assert!(matches!(read(&npy("'|u1'", "False", "(2,)", &[1, 2, 3])), Err(ReadError::Damaged { .. })));
    assert!(matches!(read(&npy("'|u1'", "False", "(-2,)", &[1, 2])), Err(ReadError::Damaged { .. })));
    assert!(matches!(read(b"\x93NUMPY\x09\x00\x00\x00"), Err(ReadError::Damaged { offset: Some(6), .. })));
    let many = format!("({})", "1,".repeat(40));
    assert!(matches!(read(&npy("'|u1'", "False", &many, &[1])), Err(ReadError::Damaged { .. })));

    // Fortran order, big-endian, float16, bool, 0-d
    let numbers = |b: &[u8]| match read(b).unwrap().values {
        NpyValues::Number(v) => v,
        NpyValues::Bool(v) => v.into_iter().map(|b| b as u8 as f64).collect(),
    };
    assert_eq!(numbers(&npy("'>i2'", "True", "(2, 2)", &[0, 1, 0, 3, 0, 2, 0, 4])), [1., 2., 3., 4.]);
    assert_eq!(numbers(&npy("'<f2'", "False", "(1,)", &[0, 0x3C])), [1.0]);
    assert_eq!(numbers(&npy("'|b1'", "False", "(2,)", &[1, 0])), [1.0, 0.0]);
    assert_eq!(numbers(&npy("'|u1'", "False", "()", &[5])), [5.0]);
}

// ------------------------------------------------------------------------------------- safetensors

#[test]
fn hostile_safetensors_are_refused_whole() {
    let read = |bytes: &[u8]| {
        let (_d, path) = file("c.safetensors", bytes);
        let e = io::read_tensors(&path, &limits()).unwrap_err();
        names_file(&e, "c.safetensors");
        e
    };
    let mut long = 100_000_000u64.to_le_bytes().to_vec();
    long.extend([b' '; 100]);
    for bytes in [&long[..], &u64::MAX.to_le_bytes()] {
        let e = read(bytes);
        assert!(matches!(e, ReadError::Damaged { offset: Some(0), .. }), "{e}");
    }

    let one = |name: &str| format!(r#""{name}":{{"dtype":"F32","shape":[0],"data_offsets":[0,0]}}"#);
    let names: Vec<String> = (0..10_002).map(|i| one(&format!("{i}"))).collect();
    assert!(matches!(read(&tensor_file(&format!("{{{}}}", names.join(",")), 0)), ReadError::TooLarge { .. }));
    let twice = tensor_file(&format!("{{{},{}}}", one("w"), one("w")), 0);
    let e = read(&twice);
    assert!(matches!(e, ReadError::Json { .. }) && e.to_string().contains("`w` appears twice"), "{e}");

    let entry = |name: &str, dtype: &str, shape: &str, a: u64, b: u64| {
        format!(r#""{name}":{{"dtype":"{dtype}","shape":{shape},"data_offsets":[{a},{b}]}}"#)
    };
    let bad = [
        // overlap, hole, beyond the end, backwards, shape that overflows, shape that does not fit
        format!("{{{},{}}}", entry("a", "F32", "[2]", 0, 8), entry("b", "F32", "[2]", 4, 12)),
        format!("{{{},{}}}", entry("a", "F32", "[1]", 0, 4), entry("b", "F32", "[1]", 8, 12)),
        format!("{{{}}}", entry("a", "F32", "[1000]", 0, 4000)),
        format!("{{{}}}", entry("a", "F32", "[3]", 12, 0)),
        format!("{{{}}}", entry("a", "F32", "[4294967296,4294967296,4]", 0, 12)),
        format!("{{{}}}", entry("a", "F32", "[2]", 0, 12)),
    ];
    for header in bad {
        let e = read(&tensor_file(&header, 12));
        assert!(matches!(e, ReadError::Damaged { .. }), "{header}: {e}");
    }
    let e = read(&tensor_file(&format!("{{{}}}", entry("a", "F16", "[6]", 0, 12)), 12));
    assert!(matches!(e, ReadError::Unsupported { .. }) && e.to_string().contains("F16"), "{e}");
    for value in [f32::NAN, f32::NEG_INFINITY] {
        let mut b = tensor_file(&format!("{{{}}}", entry("weights", "F32", "[3]", 0, 12)), 8);
        b.extend(value.to_le_bytes());
        let e = read(&b);
        assert!(e.to_string().contains("`weights` is not finite at index 2"), "{e}");
    }
}

// ------------------------------------------------------------------------ JSON and names: captures

/// Identity pose on a ring, looking at the origin.
fn matrix(i: usize) -> String {
    let a = i as f64 * 0.7;
    let (s, c) = a.sin_cos();
    // columns right (−s, c, 0), up (0, 0, 1), back (c, s, 0); position 2 · back
    format!("[[{},0,{c},{}],[{c},0,{s},{}],[0,1,0,0],[0,0,0,1]]", -s, 2.0 * c, 2.0 * s)
}

fn frame(i: usize, name: &str) -> String {
    format!(r#"{{"file_path": "{name}", "transform_matrix": {}}}"#, matrix(i))
}

/// A capture of 8 × 6 pictures `images/0.png`... with this JSON; `{}` in it stands for its frames.
fn capture_with(json: impl Fn(&[String]) -> String, photos: usize) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir(dir.path().join("images")).unwrap();
    for i in 0..photos {
        fs::write(dir.path().join(format!("images/{i}.png")), png(8, 6)).unwrap();
    }
    let frames: Vec<String> = (0..photos).map(|i| frame(i, &format!("images/{i}.png"))).collect();
    fs::write(dir.path().join("transforms.json"), json(&frames)).unwrap();
    dir
}

fn sound(frames: &[String]) -> String {
    format!(
        r#"{{"camera_angle_x": 0.8, "w": 8, "h": 6, "unknown": {{"x": []}}, "frames": [{}]}}"#,
        frames.join(",")
    )
}

#[test]
fn a_small_sound_capture_opens_in_every_dialect() {
    let plain = open(&capture_with(sound, 9)).unwrap();
    assert_eq!(plain.split(Split::Test).count(), 2); // views 0 and 8 of nine
    // with a byte order mark, CRLF, without endings, `./`, backslashes, 3×4 matrices, per-frame
    // lenses
    let dialects: [fn(&[String]) -> String; 6] = [
        |f| format!("\u{FEFF}{}", sound(f).replace(", ", ",\r\n")),
        |f| sound(f).replace(".png", ""),
        |f| sound(f).replace("images/", "./images/"),
        |f| sound(f).replace("images/", "images\\\\"),
        |f| sound(f).replace(",[0,0,0,1]]", "]"),
        |f| {
            sound(f)
                .replace(r#""camera_angle_x": 0.8, "w": 8, "h": 6,"#, "")
                .replace("{\"file", "{\"fl_x\": 9.461, \"file")
        },
    ];
    for json in dialects {
        let c = open(&capture_with(json, 9)).unwrap();
        assert_eq!((c.views.len(), c.views[3].name.as_str()), (9, "3"));
        // 4 / tan 0.4 = 9.461
        assert!((c.views[0].camera.fx - 9.461).abs() < 1e-3);
    }
}

#[test]
fn hostile_json_is_refused_with_file_and_place() {
    let says = |json: &dyn Fn(&[String]) -> String, words: &[&str]| {
        let e = open(&capture_with(json, 3)).unwrap_err();
        for word in words.iter().chain(&["transforms.json"]) {
            assert!(e.to_string().contains(word), "{word}: {e}");
        }
    };
    says(&|_| "[".repeat(100_000), &["nested too deeply"]);
    says(&|f| sound(f).replace(r#""w": 8"#, r#""w": 8, "w": 9"#), &["`w` appears twice", "line 1"]);
    says(&|f| sound(f).replace("0.8", "NaN"), &["`NaN`"]);
    says(&|f| sound(f).replace("0.8", "1e999"), &["out of range"]);
    says(&|_| "{}".into(), &["no list `frames`"]);
    says(&|_| r#"{"frames": []}"#.into(), &["empty"]);
    says(&|_| "[1]".into(), &["not a JSON object"]);
    says(&|_| r#"{"frames": [{}, 7]}"#.into(), &["#0", "file_path"]);
    says(&|f| sound(f).replace("transform_matrix", "pose"), &["images/0.png", "transform_matrix"]);
    says(&|f| sound(f).replace(r#""camera_angle_x": 0.8, "#, ""), &["images/0.png", "fl_x"]);
    says(&|f| sound(f).replace("0.8,", r#"0.8, "camera_model": "EQUIRECTANGULAR","#), &["EQUIRECTANGULAR"]);
    says(&|f| sound(f).replace("[0,1,0,0]", "[0,-1,0,0]"), &["images/0.png", "mirrors"]);
    says(&|f| sound(f).replace("[0,1,0,0]", "[0,1.02,0,0]"), &["not orthonormal"]);
    says(&|f| sound(f).replace("[0,1,0,0]", "[0,0,0,0]"), &["singular"]);
    says(&|f| sound(f).replace("[0,0,0,1]", "[0,0,1,1]"), &["last row"]);
    says(&|f| sound(f).replace("[0,1,0,0]", "[0,1,0]"), &["4 × 4"]);
    says(&|f| sound(f).replacen("\"file", "\"split\": \"holdout\", \"file", 1), &["holdout"]);
    let scaled = |f: &[String]| {
        // the pose of frame 0: right (0, 1, 0), up (0, 0, 1), back (1, 0, 0), twice as long
        sound(f).replacen(&matrix(0), "[[0,0,2,2],[2,0,0,0],[0,2,0,0],[0,0,0,1]]", 1)
    };
    says(&scaled, &["images/0.png", "scales, by 2.0"]);
}

#[test]
fn more_frames_than_views_are_allowed_is_an_error_in_a_moment() {
    // one more than counters of views can hold
    let many = |_: &[String]| format!(r#"{{"frames": [{}0]}}"#, "0,".repeat(65_535));
    let e = open(&capture_with(many, 1)).unwrap_err();
    assert!(e.to_string().contains("the number of views is 65536, the limit is 65535"), "{e}");
    // a million entries are more values than one file may hold
    let e =
        open(&capture_with(|_| format!(r#"{{"frames": [{}0]}}"#, "[],".repeat(9_000_000)), 1)).unwrap_err();
    assert!(e.to_string().contains("too many values"), "{e}");
}

#[test]
fn names_that_lead_out_of_the_capture_are_refused() {
    for name in ["../outside.png", "/etc/passwd", "images/../../x.png", "C:\\\\x.png", "..\\\\x.png"] {
        let made = capture_with(|f| sound(f).replacen("images/0.png", name, 1), 3);
        // what a name leads to is there
        let dir = tempfile::tempdir().unwrap();
        let head = copy(made.path(), &dir.path().join("head"));
        fs::write(dir.path().join("outside.png"), png(8, 6)).unwrap();
        let e = capture::open(&head, &CaptureOptions::default()).unwrap_err();
        assert!(e.to_string().contains("outside the capture") && !e.hint().is_empty(), "{name}: {e}");
    }
}

#[test]
#[cfg(unix)]
fn a_capture_whose_files_are_links_into_a_store_is_read() {
    use std::os::unix::fs::symlink;
    let store = capture_with(sound, 5);
    let options = CaptureOptions::default();
    // every file a link, as git-annex, DVC and caches of data sets keep them
    let files = tempfile::tempdir().unwrap();
    fs::create_dir(files.path().join("images")).unwrap();
    let names = (0..5).map(|i| format!("images/{i}.png")).chain(["transforms.json".into()]);
    names.for_each(|name| symlink(store.path().join(&name), files.path().join(&name)).unwrap());
    // or the folder of photographs alone
    let folder = tempfile::tempdir().unwrap();
    fs::copy(store.path().join("transforms.json"), folder.path().join("transforms.json")).unwrap();
    symlink(store.path().join("images"), folder.path().join("images")).unwrap();
    for dir in [&files, &folder] {
        let c = open(dir).unwrap();
        assert!(c.views.len() == 5 && c.views.iter().all(|v| v.load(&limits()).is_ok()));
    }
    // what a camera file names outside stays outside
    for name in ["../secret.png", "images/../../secret.png", "/etc/passwd"] {
        let json = sound(&[frame(0, name), frame(1, "images/1.png")]);
        fs::write(folder.path().join("transforms.json"), json).unwrap();
        let e = capture::open(folder.path(), &options).unwrap_err();
        assert!(e.to_string().contains("outside the capture"), "{name}: {e}");
    }
}

#[test]
fn photographs_that_are_tiff_or_webp_are_named_with_the_way_out() {
    let names =
        [("0.tif", &b"II*\0 and more"[..], "a TIFF"), ("0.webp", b"RIFF\0\0\0\0WEBPVP8 ", "a WebP picture")];
    for (name, bytes, what) in names {
        // named with its ending or without, or listed in a folder
        for named in [format!("images/{name}"), "images/0".into(), String::new()] {
            let dir = tempfile::tempdir().unwrap();
            fs::create_dir(dir.path().join("images")).unwrap();
            fs::write(dir.path().join("images").join(name), bytes).unwrap();
            if named.is_empty() {
                fs::write(dir.path().join("poses_bounds.npy"), poses(1, 6.0, 8.0)).unwrap();
            } else {
                fs::write(dir.path().join("transforms.json"), sound(&[frame(0, &named)])).unwrap();
            }
            let found = inspect(dir.path(), &CaptureOptions::default());
            let problem = &found.problems[0];
            assert!(problem.what.contains(what) && problem.what.contains(name), "{named}: {found}");
            assert!(problem.hint.contains("convert it to PNG or JPEG") && found.format.is_some(), "{found}");
        }
    }
}

#[test]
fn strange_names_inside_the_capture_are_read() {
    let dir = capture_with(sound, 3);
    let long = "n".repeat(251);
    let names = ["with space; rm -rf.png".to_string(), "ümlaut.png".into(), format!("{long}.png")];
    let frames: Vec<String> = names
        .iter()
        .enumerate()
        .map(|(i, n)| {
            fs::write(dir.path().join("images").join(n), png(8, 6)).unwrap();
            frame(i, &format!("images/{n}"))
        })
        .collect();
    fs::write(dir.path().join("transforms.json"), sound(&frames)).unwrap();
    let c = open(&dir).unwrap();
    assert_eq!(c.views[0].name, "with space; rm -rf");
    assert_eq!(c.views[2].name, long);
    assert!(c.views.iter().all(|v| v.load(&limits()).is_ok()));
}

#[test]
fn twins_by_case_are_a_warning_and_twins_by_name_an_error() {
    let dir = capture_with(sound, 0);
    for n in ["a.png", "A.png", "a.jpg"] {
        fs::write(dir.path().join("images").join(n), png(8, 6)).unwrap();
    }
    let two = |a: &str, b: &str| sound(&[frame(0, &format!("images/{a}")), frame(1, &format!("images/{b}"))]);
    fs::write(dir.path().join("transforms.json"), two("a.png", "A.png")).unwrap();
    match open(&dir) {
        Ok(c) => assert!(c.warnings.iter().any(|w| w.contains("case")), "{:?}", c.warnings),
        Err(e) => panic!("{e}"),
    }
    fs::write(dir.path().join("transforms.json"), two("a.png", "a.jpg")).unwrap();
    let e = open(&dir).unwrap_err();
    assert!(e.to_string().contains("would both be called `a`"), "{e}");
}

#[test]
#[cfg(unix)]
fn a_file_name_that_is_not_utf8_is_an_error_where_names_are_listed() {
    use std::os::unix::ffi::OsStrExt;
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir(dir.path().join("images")).unwrap();
    fs::write(dir.path().join("images").join(std::ffi::OsStr::from_bytes(b"a\xFF.png")), png(8, 6)).unwrap();
    fs::write(dir.path().join("poses_bounds.npy"), poses(1, 6.0, 8.0)).unwrap();
    let e = open(&dir).unwrap_err();
    assert!(e.to_string().contains("not UTF-8"), "{e}");
}

#[test]
fn missing_photographs_are_counted_and_listed() {
    let dir = capture_with(sound, 5);
    fs::remove_file(dir.path().join("images/3.png")).unwrap();
    let c = open(&dir).unwrap();
    assert_eq!(c.views.len(), 4);
    assert!(
        c.warnings.iter().any(|w| w.contains("1 of 5") && w.contains("`images/3.png`")),
        "{:?}",
        c.warnings
    );
    for i in [0, 1, 2, 4] {
        fs::remove_file(dir.path().join(format!("images/{i}.png"))).unwrap();
    }
    let e = open(&dir).unwrap_err();
    assert!(e.to_string().contains("has no usable view: 5 of 5"), "{e}");
}

#[test]
fn a_size_that_is_not_the_declared_one_says_the_factor() {
    let dir = capture_with(|f| sound(f).replace(r#""w": 8, "h": 6"#, r#""w": 32, "h": 24"#), 3);
    let e = open(&dir).unwrap_err();
    assert_eq!(e.to_string(), "`images/0.png` is 8 × 6 pixels, but `transforms.json` says 32 × 24");
    assert_eq!(e.hint(), "use the full-size photographs, or set `capture.downscale = 4`");
    let c = capture::open(dir.path(), &CaptureOptions { downscale: 4, ..Default::default() }).unwrap();
    assert_eq!((c.views[0].camera.width, c.views[0].photo_size), (8, (8, 6)));
    assert_eq!(c.views[0].load(&limits()).unwrap().photo.rgb.len(), 48);
}

/// A folder with these files, `/` at the end for folders, and what opening it prints: the message
/// and the suggested fix.
fn unread(names: &[(&str, &[u8])]) -> (String, String) {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in names {
        let path = dir.path().join(name);
        if name.ends_with('/') {
            fs::create_dir_all(path).unwrap();
        } else {
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, bytes).unwrap();
        }
    }
    let e = open(&dir).unwrap_err();
    assert!(e.to_string().contains("is not a capture"), "{e}");
    let root = dir.path().display().to_string();
    (e.to_string().replace(&root, "ROOT"), e.hint().replace(&root, "ROOT"))
}

#[test]
fn formats_that_are_not_read_are_named_with_the_way_from_there() {
    let photo = png(4, 4);
    let picture = |name: &'static str| (name, &photo[..]);
    let rows: [(&[(&str, &[u8])], &str, &str); 18] = [
        (
            &[picture("images/0.png"), ("MeshroomCache/", b""), ("head.mg", b"{}")],
            "a Meshroom project (`MeshroomCache`)",
            "`ExportColmap`",
        ),
        (
            &[picture("0.png"), ("cameras.sfm", b"{}")],
            "Meshroom project (`cameras.sfm`)",
            "aliceVision_exportColmap",
        ),
        (
            &[picture("images/0.png"), ("reconstruction.json", b"[]")],
            "an OpenSfM project (`reconstruction.json`)",
            "`opensfm export_colmap ROOT`",
        ),
        (
            &[picture("0.png"), ("sfm_data.json", b"{}")],
            "an OpenMVG scene",
            "openMVG_main_openMVG2Colmap -i ROOT/sfm",
        ),
        (
            &[picture("0.jpg"), ("bundle/bundle.out", b"# Bundle file v0.3")],
            "a Bundler scene (`bundle/bundle.out`)",
            "InterfaceVisualSFM -i ROOT/bundle/bundle.out",
        ),
        (&[picture("0.jpg"), ("a.nvm", b"NVM_V3")], "a VisualSFM scene (`a.nvm`)", "`sparse/0`"),
        (
            &[picture("images/00000000.jpg"), ("cams/00000000_cam.txt", b"extrinsic")],
            "an MVSNet scene (`cams/00000000_cam.txt`)",
            "InterfaceMVSNet -i ROOT",
        ),
        (&[picture("images/0.png"), ("a.psx", b"<")], "Metashape project (`a.psx`)", "Export Cameras"),
        (&[picture("0.png"), ("a.rcproj", b"x")], "RealityCapture project (`a.rcproj`)", "as CSV"),
        (&[("calibration/camera_params.json", b"{}")], "NeRSemble", "`world_2_cam`"),
        (
            &[("KRT", b"400002"), ("images/", b"")],
            "Multiface recording (`KRT`)",
            "one frame of one expression",
        ),
        (&[("params.json", b"{}"), picture("0.jpg")], "FaceScape tuple (`params.json`)", "`I_Rt`"),
        (
            &[("keyframes/images/", b"")],
            "Polycam raw export (`keyframes`)",
            "polycam --data ROOT --output-dir NEW",
        ),
        (
            &[("sparse/0/", b""), picture("images/0.jpg")],
            "an incomplete COLMAP project (`sparse`)",
            "`colmap mapper`",
        ),
        (
            &[picture("b.JPG"), picture("a.jpg")],
            "photographs without cameras (`a.jpg`)",
            "find them with COLMAP: `tiface cameras ROOT`",
        ),
        (&[picture("input/1.png")], "photographs without cameras (`1.png`)", "`tiface cameras ROOT`"),
        (&[("head.MOV", b"ftyp")], "a video (`head.MOV`)", "`tiface cameras --video ROOT/head.MOV`"),
        (
            &[("scan/transforms.json", b"{}")],
            "its subfolder `scan` contains `transforms.json`",
            "`ROOT/scan`",
        ),
    ];
    for (files, what, way) in rows {
        let (message, hint) = unread(files);
        assert!(message.contains(what), "{what}: {message}");
        assert!(hint.contains(way), "{what}: {hint}");
    }
    // other tools' XML and CSV are not theirs, and a list of parameters without photographs is of
    // no format
    let (message, hint) =
        unread(&[("a.xml", b"<svg/>"), ("b.csv", b"a,b\n"), ("params.json", b"{}"), ("notes.txt", b"x")]);
    for format in ["transforms.json", "LLFF", "COLMAP", "NeuS", "H3DS", "Metashape", "RealityCapture"] {
        assert!(message.contains(format), "{message}");
    }
    assert!(
        message.ends_with("nearest is `a.xml`, which has no `<chunk` as Metashape's cameras have"),
        "{message}"
    );
    for format in
        ["Meshroom", "OpenSfM", "Bundler", "NVM", "MVSNet", "Polycam", "NeRSemble", "Multiface", "FaceScape"]
    {
        assert!(hint.contains(format), "{hint}");
    }
    for (name, words) in [
        (
            "transforms_all.json",
            "`transforms_all.json`: if it is such a file, rename it to `transforms.json`",
        ),
        ("poses.npy", "rename it to `poses_bounds.npy`"),
        ("cams.npz", "rename it to `cameras_sphere.npz`"),
        ("list.csv", "does not begin with `#name,x,y,alt`"),
    ] {
        let (message, _) = unread(&[(name, b"x")]);
        assert!(message.contains(words), "{message}");
    }
}

#[test]
fn a_file_in_the_place_of_a_folder_says_which_folder() {
    let of = |name: &str| {
        let (dir, path) = file(name, b"x");
        let e = capture::open(&path, &CaptureOptions::default()).unwrap_err();
        assert!(e.to_string().contains("is not a capture"), "{e}");
        (e.to_string(), e.hint().replace(&dir.path().display().to_string(), "ROOT"))
    };
    assert_eq!(of("transforms.json").1, "give its folder: `ROOT`");
    let (message, hint) = of("head.mp4");
    assert!(
        message.contains("it is a video") && hint.contains("tiface cameras --video ROOT/head.mp4"),
        "{hint}"
    );
}

#[test]
fn a_folder_without_cameras_says_what_was_looked_for() {
    let dir = tempfile::tempdir().unwrap();
    let e = open(&dir).unwrap_err();
    assert!(e.to_string().contains("is not a capture") && e.to_string().contains("transforms.json"), "{e}");
    fs::create_dir(dir.path().join("sparse")).unwrap();
    assert!(open(&dir).unwrap_err().to_string().contains("COLMAP"));
    let (_d, path) = file("x.json", b"{}");
    let e = capture::open(&path, &CaptureOptions::default()).unwrap_err();
    assert!(e.to_string().contains("is not a capture"), "{e}");
    assert!(capture::open(&path.join("none"), &CaptureOptions::default()).is_err());
}

// --------------------------------------------------------------------------- masks, poses, inspect

/// LLFF rows of the same ring as [`matrix`].
fn poses(n: usize, height: f64, width: f64) -> Vec<u8> {
    let focal = 0.5 * width / 0.4f64.tan();
    let mut data = Vec::new();
    for i in 0..n {
        let (s, c) = (i as f64 * 0.7).sin_cos();
        // columns down (0, 0, −1), right (−s, c, 0), back (c, s, 0), position 2 · back, (h, w, f)
        let rows = [[0., -s, c, 2. * c, height], [0., c, s, 2. * s, width], [-1., 0., 0., 0., focal]];
        for v in rows.as_flattened().iter().chain(&[0.1, 9.0]) {
            data.extend(v.to_le_bytes());
        }
    }
    npy("'<f8'", "False", &format!("({n}, 17)"), &data)
}

#[test]
fn llff_poses_alone_make_a_capture_and_disagreeing_ones_an_error() {
    let dir = capture_with(sound, 9);
    fs::write(dir.path().join("poses_bounds.npy"), poses(9, 6.0, 8.0)).unwrap();
    let with_json = open(&dir).unwrap();
    assert!(with_json.reasons.iter().any(|r| r.contains("agrees with the JSON about 9 cameras")));
    fs::remove_file(dir.path().join("transforms.json")).unwrap();
    let alone = open(&dir).unwrap();
    assert_eq!(alone.views.len(), 9);
    for (a, b) in alone.views.iter().zip(&with_json.views) {
        assert!(a.name == b.name && a.camera.position.distance(b.camera.position) < 1e-12);
        assert!((a.camera.fx - b.camera.fx).abs() < 1e-9 && a.split == b.split);
    }
    fs::write(dir.path().join("poses_bounds.npy"), poses(8, 6.0, 8.0)).unwrap();
    assert!(open(&dir).unwrap_err().to_string().contains("8 rows"));

    let moved = capture_with(|f| sound(f).replacen("[0,1,0,0]", "[0,1,0,0.5]", 1), 9);
    fs::write(moved.path().join("poses_bounds.npy"), poses(9, 6.0, 8.0)).unwrap();
    let e = open(&moved).unwrap_err();
    assert!(e.to_string().contains("disagree about frame `images/0.png`"), "{e}");
    names_file(&e, "poses_bounds.npy");
}

#[test]
fn ilsh_folders_take_the_matte_for_the_head_and_npy_for_valid_pixels() {
    let dir = capture_with(sound, 3);
    for folder in ["vit_mask", "masks"] {
        fs::create_dir(dir.path().join(folder)).unwrap();
    }
    let mut usable = [1u8; 48];
    usable[5] = 0;
    for i in 0..3 {
        let matte = tiface::image::Gray { width: 8, height: 6, values: (0..48).map(|v| v * 5).collect() };
        io::write_png_gray(&dir.path().join(format!("vit_mask/{i}.png")), &matte).unwrap();
        let shape = if i == 0 { "(6, 8, 1)" } else { "(6, 8)" };
        fs::write(dir.path().join(format!("masks/{i}.npy")), npy("'|b1'", "False", shape, &usable)).unwrap();
    }
    let c = open(&dir).unwrap();
    assert!(matches!(&c.views[1].mask, ViewMask::File(p) if p.ends_with("vit_mask/1.png")));
    let v = c.views[0].load(&limits()).unwrap();
    assert_eq!(v.mask.unwrap().values[7], 35);
    let valid = v.valid.unwrap().values;
    assert_eq!((valid[4], valid[5], valid.len()), (255, 0, 48));
    // a valid mask of another size is named
    fs::write(dir.path().join("masks/2.npy"), npy("'|b1'", "False", "(2, 2)", &[1; 4])).unwrap();
    let e = open(&dir).unwrap().views[2].load(&limits()).unwrap_err();
    assert!(e.to_string().contains("is 2 × 2 pixels"), "{e}");
    names_file(&e, "2.npy");
}

#[test]
fn alpha_is_the_mask_unless_it_is_opaque_everywhere() {
    for (alpha, expected) in [(90u8, true), (255, false)] {
        let dir = capture_with(|f| sound(f).replace(".png", ""), 0);
        let mut frames = Vec::new();
        for i in 0..4 {
            let rgba: Vec<[u8; 4]> = (0..48).map(|k| [k, 9, 9, if k == 20 { alpha } else { 255 }]).collect();
            io::write_png_rgba(&dir.path().join(format!("images/r_{i}.png")), 8, 6, &rgba).unwrap();
            frames.push(frame(i, &format!("./images/r_{i}")));
        }
        fs::write(dir.path().join("transforms.json"), sound(&frames)).unwrap();
        let c = open(&dir).unwrap();
        assert_eq!(c.views[0].mask == ViewMask::Alpha, expected);
        assert_eq!(c.warnings.iter().any(|w| w.contains("opaque")), !expected);
        let loaded = c.views[0].load(&limits()).unwrap();
        assert_eq!(loaded.mask.map(|m| m.values[20]), expected.then_some(90));
    }
}

#[test]
fn inspecting_reports_every_problem_not_the_first() {
    let dir = capture_with(
        |f| {
            let mut f = f.to_vec();
            f[1] = f[1].replace("[0,1,0,0]", "[0,-1,0,0]"); // mirrored
            f[2] = f[2].replace("images/2.png", "../2.png"); // outside
            f.push(frame(9, "images/none.png")); // missing
            sound(&f)
        },
        8,
    );
    fs::write(dir.path().join("images/4.png"), png(5, 5)).unwrap(); // another size
    let whole = png(8, 6);
    let mut torn = whole.clone();
    let data = torn.windows(4).position(|w| w == b"IDAT").unwrap();
    torn[data + 12] ^= 0x55; // the header is fine, the pixels are not
    fs::write(dir.path().join("images/5.png"), &torn).unwrap();
    let found = inspect(dir.path(), &CaptureOptions::default());
    let text = found.to_string();
    for word in ["mirrors", "outside the capture", "5 × 5", "`images/none.png`", "5.png` is not a valid PNG"]
    {
        assert!(text.contains(word), "{word} is missing in\n{text}");
    }
    assert!(!found.is_usable() && found.problems.len() >= 4);
    assert!(found.problems.iter().all(|p| !p.hint.is_empty()));
}

#[test]
fn a_problem_of_every_frame_is_one_line_with_a_count() {
    let dir = capture_with(|f| sound(f).replace("{\"file", "{\"mask_path\": \"m.png\", \"file"), 24);
    let found = inspect(dir.path(), &CaptureOptions::default());
    let masks: Vec<_> =
        found.problems.iter().filter(|p| p.what.contains("mask it names is missing")).collect();
    assert!(matches!(&masks[..], [p] if p.count == 24 && p.what.contains("`images/0.png`")), "{found}");
    assert!(
        found.to_string().contains("24 times, the first: `transforms.json`, frame `images/0.png`"),
        "{found}"
    );

    // numbers that differ, and photographs that cannot be read, count together as well; other
    // problems do not
    let dir = capture_with(
        |f| {
            let moved = |(i, f): (usize, &String)| match i {
                0..6 => f.replace("[0,1,0,0]", &format!("[0,1.0{},0,0]", i + 2)),
                6 => f.replace("transform_matrix", "pose"),
                _ => f.clone(),
            };
            sound(&f.iter().enumerate().map(moved).collect::<Vec<_>>())
        },
        12,
    );
    for i in 7..10 {
        fs::write(dir.path().join(format!("images/{i}.png")), b"no picture at all").unwrap();
    }
    let found = inspect(dir.path(), &CaptureOptions::default());
    let counts: Vec<usize> = found.problems.iter().map(|p| p.count).collect();
    assert!(counts.starts_with(&[6, 1, 3]), "{found}");
}

#[test]
fn each_broken_camera_file_is_a_problem_of_its_own() {
    let dir = tempfile::tempdir().unwrap();
    for file in ["transforms_train.json", "transforms_test.json"] {
        fs::write(dir.path().join(file), r#"{"frames": []}"#).unwrap();
    }
    let found = inspect(dir.path(), &CaptureOptions::default());
    for file in ["transforms_train.json", "transforms_test.json"] {
        let what = format!("`{file}`: its list `frames` is empty");
        assert!(found.problems.iter().any(|p| p.what == what && p.count == 1), "{found}");
    }
}

#[test]
fn null_and_lenient_keys_of_another_type_count_as_absent() {
    let top = "{\"up\": null, \"train_filenames\": null, \"val_filenames\": null, \"is_fisheye\": \"no\", ";
    let frame = "{\"camera_model\": 3, \"face_mask_path\": 7, \"file";
    let plain = open(&capture_with(sound, 9)).unwrap();
    for up in ["null", "\"z\"", "[0, \"z\", 1]"] {
        let top = top.replacen("null", up, 1);
        let dir = capture_with(|f| sound(f).replacen('{', &top, 1).replace("{\"file", frame), 9);
        let found = open(&dir).unwrap();
        let cameras =
            |c: &capture::Capture| c.views.iter().map(|v| (v.camera.clone(), v.split)).collect::<Vec<_>>();
        assert_eq!((found.up, cameras(&found)), (plain.up, cameras(&plain)), "{up}");
    }
}

/// A capture of nine photographs, seven of them to learn from, with masks of these.
fn masked(views: &[usize]) -> TempDir {
    let dir = capture_with(sound, 9);
    fs::create_dir(dir.path().join("masks")).unwrap();
    let values = (0..48).map(|i| if (i % 8) / 4 == 1 { 255 } else { 0 }).collect();
    let mask = tiface::image::Gray { width: 8, height: 6, values };
    for i in views {
        io::write_png_gray(&dir.path().join(format!("masks/{i}.png")), &mask).unwrap();
    }
    dir
}

#[test]
fn photographs_without_masks_do_not_pass_inspection() {
    let problem = |dir: &TempDir, options: &CaptureOptions| {
        let found = inspect(dir.path(), options);
        let of = |p: &&tiface::capture::inspect::Problem| p.hint.contains("--page");
        let problem = found.problems.iter().find(of).cloned();
        assert!(problem.is_none() || !found.to_string().contains("no problems found"));
        // what stops training is what inspection says
        let open = capture::open(dir.path(), options).unwrap();
        let required = capture::require_masks(&open, options);
        assert_eq!(required.as_ref().err().map(|e| e.to_string()), problem.as_ref().map(|p| p.what.clone()));
        problem
    };
    let default = CaptureOptions::default();
    // views 0 and 8 are held out: training needs no masks of theirs
    for views in [&[][..], &[0, 8]] {
        let missing = problem(&masked(views), &default).unwrap();
        assert!(
            missing.what.contains("no photograph that is learned from has a head mask"),
            "{}",
            missing.what
        );
        for way in
            ["tiface mask ", "--page", "masks/NAME.png", "mask_path", "rembg p -om", "--set mask.source=none"]
        {
            assert!(missing.hint.contains(way), "{way}: {}", missing.hint);
        }
    }
    let missing = problem(&masked(&[1, 2, 3]), &default).unwrap();
    assert!(
        missing.what.contains("4 of 7") && missing.what.contains("`4`, `5`, `6`, `7`"),
        "{}",
        missing.what
    );
    let some = masked(&[1, 2, 3, 4]);
    assert_eq!(problem(&some, &default), None);
    let warnings = open(&some).unwrap().warnings;
    assert!(
        warnings.iter().any(|w| w.contains("5 views without a mask")
            && w.contains("stages that use masks ignore these views")),
        "{warnings:?}"
    );
    // no masks were asked for, or views without one are to be used whole
    assert_eq!(problem(&masked(&[]), &CaptureOptions { masks: MaskSource::None, ..default.clone() }), None);
    let ignore = CaptureOptions { mask_meaning: MaskMeaning::Ignore, ..default.clone() };
    assert_eq!(problem(&masked(&[1]), &ignore), None);
    // a folder that was named, and holds none
    let named = CaptureOptions { masks: MaskSource::Folder, mask_dir: "mattes".into(), ..default };
    assert!(problem(&masked(&[1, 2, 3, 4]), &named).is_some());
    // clicks that lie there are the shortest way
    let dir = masked(&[]);
    fs::write(dir.path().join("prompts.json"), b"{}").unwrap();
    let e = capture::require_masks(&open(&dir).unwrap(), &CaptureOptions::default()).unwrap_err();
    assert!(
        e.hint().contains(&format!("--prompts {}", dir.path().join("prompts.json").display())),
        "{}",
        e.hint()
    );
}

#[test]
fn a_capture_without_a_place_for_the_head_is_a_named_problem() {
    // all frames with one pose
    let dir = capture_with(
        |f| sound(&f.iter().enumerate().map(|(i, f)| f.replace(&matrix(i), &matrix(0))).collect::<Vec<_>>()),
        9,
    );
    let found = inspect(dir.path(), &CaptureOptions::default());
    assert!(found.problems.iter().any(|p| p.what.contains("stand at one place")), "{found}");
    // white masks everywhere
    let dir = capture_with(sound, 9);
    fs::create_dir(dir.path().join("masks")).unwrap();
    let white = tiface::image::Gray { width: 8, height: 6, values: vec![255; 48] };
    for i in 0..9 {
        io::write_png_gray(&dir.path().join(format!("masks/{i}.png")), &white).unwrap();
    }
    let found = inspect(dir.path(), &CaptureOptions::default());
    assert!(found.problems.iter().any(|p| p.what.contains("white everywhere")), "{found}");
    assert!(found.warnings.iter().any(|w| w.contains("white everywhere in 9 views")), "{found}");
}
