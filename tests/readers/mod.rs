//! Every reader of bytes that somebody else may have written, by name.
//!
//! `tests/fuzz.rs` feeds them what lies in `tests/seeds/NAME`, and what it makes of that.

use glam::{DMat3, DVec3};
use std::fs;
use std::path::Path;
use tiface::capture::{self, CaptureOptions};
use tiface::config::{Config, Preset, Sources};
use tiface::geom::{Camera, Distortion};
use tiface::iface::IFace;
use tiface::io::{self, Limits};
use tiface::mesh::files::{ExtractedSurface, HeadMesh, ReadOptions, check_around, open_mesh, read_with};
use tiface::pipeline::Session;
use tiface::report::RunRow;
use tiface::report::experiment::{ExperimentRow, read_published};
use tiface::run::{Run, RunStatus, read_estimate, read_record, read_status};
use tiface::tface::TFace;

/// A reader gets a folder of its own, prepared by [`prepare`], and the bytes. It must come back,
/// with whatever it makes of them, in words.
pub type Reader = fn(&Path, &[u8]) -> String;

/// By the name of their seeds.
pub const READERS: [(&str, Reader); 23] = [
    ("camera_path", camera_path),
    ("cameras", cameras),
    ("colmap_binary", |dir, bytes| model(dir, bytes, "bin")),
    ("colmap_text", |dir, bytes| model(dir, bytes, "txt")),
    ("config", config),
    ("exr", exr),
    ("iface", iface),
    ("llff", |dir, bytes| open(dir, "poses_bounds.npy", bytes)),
    ("mask", mask),
    ("mesh", mesh),
    ("metashape", |dir, bytes| open(dir, "cameras.xml", bytes)),
    ("mtl", mtl),
    ("neus", |dir, bytes| open(dir, "cameras_sphere.npz", bytes)),
    ("npy", |dir, bytes| outcome(io::parse_npy(dir, bytes, &limits()))),
    ("photo", photo),
    ("pose_folder", pose_folder),
    ("prompts", |dir, bytes| outcome(tiface::mask::prompts::parse_prompts(dir, bytes, &limits()))),
    ("published", published),
    ("realitycapture", realitycapture),
    ("run", run),
    ("surface", surface),
    ("tface", tface),
    ("transforms", |dir, bytes| open(dir, "transforms.json", bytes)),
];

/// Photographs of a capture in these tests.
const VIEWS: usize = 3;

/// Small, so that what is large but allowed costs no time.
fn limits() -> Limits {
    Limits { side_px: 1024, decoded_bytes: 16 << 20, json_values: 1 << 16, ..Limits::default() }
}

/// Returns the message of an error, or nothing.
fn outcome<T, E: std::fmt::Display>(result: Result<T, E>) -> String {
    result.err().map(|e| e.to_string()).unwrap_or_default()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn put(dir: &Path, name: &str, bytes: &[u8]) {
    fs::write(dir.join(name), bytes).unwrap();
}

/// Makes what a reader expects beside the bytes.
pub fn prepare(dir: &Path) {
    for folder in ["images", "image", "run/mask", "head"] {
        fs::create_dir_all(dir.join(folder)).unwrap();
    }
    for i in 0..VIEWS {
        let rgb = vec![[90 * i as u8; 3]; 16 * 12];
        for folder in ["images", "image"] {
            io::write_png_rgb(&dir.join(format!("{folder}/{i:02}.png")), 16, 12, &rgb).unwrap();
        }
    }
    io::write_png_rgb(&dir.join("head/color.png"), 1, 1, &[[9; 3]]).unwrap();
}

/// A capture with these cameras; all it says of itself is looked at, too.
fn open(dir: &Path, name: &str, bytes: &[u8]) -> String {
    put(dir, name, bytes);
    let options = CaptureOptions { limits: limits(), ..CaptureOptions::default() };
    outcome(capture::open(dir, &options))
}

/// Parts of an input that stands for several files.
fn parts(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    const BETWEEN: &[u8] = b"\n--8<--\n";
    let mut rest = Some(bytes);
    std::iter::from_fn(move || {
        let all = rest?;
        let cut = all.windows(BETWEEN.len()).position(|w| w == BETWEEN);
        rest = cut.map(|at| &all[at + BETWEEN.len()..]);
        Some(&all[..cut.unwrap_or(all.len())])
    })
}

/// Cameras, images and points of COLMAP.
fn model(dir: &Path, bytes: &[u8], ending: &str) -> String {
    fs::create_dir_all(dir.join("sparse/0")).unwrap();
    let mut parts = parts(bytes);
    for name in ["cameras", "images", "points3D"] {
        let path = dir.join(format!("sparse/0/{name}.{ending}"));
        match parts.next() {
            Some(part) => fs::write(path, part).unwrap(),
            None => drop(fs::remove_file(path)),
        }
    }
    let options = CaptureOptions { limits: limits(), ..CaptureOptions::default() };
    outcome(capture::open(dir, &options))
}

/// Intrinsics, one pose and a box of NSVF.
fn pose_folder(dir: &Path, bytes: &[u8]) -> String {
    fs::create_dir_all(dir.join("pose")).unwrap();
    let mut parts = parts(bytes);
    for name in ["intrinsics.txt", "pose/00.txt", "bbox.txt"] {
        match parts.next() {
            Some(part) => put(dir, name, part),
            None => drop(fs::remove_file(dir.join(name))),
        }
    }
    let options = CaptureOptions { limits: limits(), ..CaptureOptions::default() };
    outcome(capture::open(dir, &options))
}

/// A table, or a sidecar of the first photograph.
fn realitycapture(dir: &Path, bytes: &[u8]) -> String {
    let (xmp, csv) = (dir.join("images/00.xmp"), dir.join("registration.csv"));
    let is_xmp = bytes.trim_ascii_start().starts_with(b"<");
    let (path, other) = if is_xmp { (xmp, csv) } else { (csv, xmp) };
    drop(fs::remove_file(other));
    fs::write(path, bytes).unwrap();
    let options = CaptureOptions { limits: limits(), ..CaptureOptions::default() };
    outcome(capture::open(dir, &options))
}

fn photo(dir: &Path, bytes: &[u8]) -> String {
    let info = io::parse_picture_info(bytes, dir, &limits());
    let photo = io::parse_photo(bytes, dir, &limits());
    if let (Ok(photo), Ok(info)) = (&photo, &info) {
        let sizes = [(info.width, info.height), (info.height, info.width)];
        assert!(sizes.contains(&(photo.width, photo.height)), "the header says another size");
    }
    outcome(photo) + &outcome(info)
}

fn mask(dir: &Path, bytes: &[u8]) -> String {
    put(dir, "mask.png", bytes);
    outcome(io::read_gray(&dir.join("mask.png"), None, &limits()))
}

fn exr(dir: &Path, bytes: &[u8]) -> String {
    put(dir, "picture.exr", bytes);
    let read = |channels: &[&[&str]]| outcome(io::read_exr(&dir.join("picture.exr"), channels, &limits()));
    read(&[&["R", "G", "B"]]) + &read(&[&["Z"]])
}

/// GLB, glTF, OBJ, PLY or STL, as `check` looks at it.
fn mesh(dir: &Path, bytes: &[u8]) -> String {
    if bytes.trim_ascii_start().starts_with(b"{") {
        put(dir, "a.gltf", bytes);
        return outcome(open_mesh(&dir.join("a.gltf")));
    }
    let options = ReadOptions { vertices: 1 << 16, triangles: 1 << 16, json: 1 << 20, texture: true };
    let found = read_with(bytes, &dir.join("a.mesh"), &options);
    if let Ok(found) = &found {
        check_around(&found.mesh, found.origin, 1.0);
    }
    outcome(found)
}

/// The material beside an OBJ.
fn mtl(dir: &Path, bytes: &[u8]) -> String {
    put(dir, "a.obj", b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n");
    put(dir, "a.mtl", bytes);
    outcome(open_mesh(&dir.join("a.obj")))
}

/// A run's own surface, or head: each is read from files of its own.
fn surface(dir: &Path, bytes: &[u8]) -> String {
    put(dir, "head/geometry.safetensors", bytes);
    put(dir, "head/surface.safetensors", bytes);
    let tensors = outcome(io::parse_tensors(dir, bytes, &limits()));
    let (surface, head) = (ExtractedSurface::load(&dir.join("head")), HeadMesh::load(&dir.join("head")));
    if surface.is_ok() || head.is_ok() { tensors } else { tensors + &outcome(surface) + &outcome(head) }
}

/// A checkpoint of T-Face.
fn tface(dir: &Path, bytes: &[u8]) -> String {
    put(dir, "head/checkpoint.safetensors", bytes);
    outcome(TFace::load("tface", &dir.join("head")))
}

/// A checkpoint of I-Face with the settings of its seeds.
fn iface(dir: &Path, bytes: &[u8]) -> String {
    put(dir, "head/checkpoint.safetensors", bytes);
    let mut config = Config::preset(Preset::Draft).iface;
    (config.steps, config.levels, config.log2_table, config.occupancy_resolution) = (2, 1, 4, 16);
    outcome(IFace::load(&dir.join("head"), &config, None))
}

fn config(_: &Path, bytes: &[u8]) -> String {
    let file = ("config.toml".to_string(), text(bytes));
    let found = Config::resolve(&Sources { files: vec![file], ..Sources::default() });
    if let Ok(config) = &found {
        // what is taken can be passed back
        let again = Sources { files: vec![("again".into(), config.to_toml())], ..Sources::default() };
        assert_eq!(Config::resolve(&again).unwrap().to_toml(), config.to_toml());
    }
    outcome(found)
}

fn published(_: &Path, bytes: &[u8]) -> String {
    let row = ExperimentRow { table: "tface", row: "full", title: "", run: "", pictures: "" };
    outcome(read_published(&text(bytes), &[row], "published.csv"))
}

/// Records and statuses of a run, what it may cost, what it ended with, and what a page and a list
/// say of it.
fn run(dir: &Path, bytes: &[u8]) -> String {
    let mask = dir.join("run/mask");
    let mut parts = parts(bytes);
    put(&mask, "done.json", parts.next().unwrap_or_default());
    put(&mask, "status.json", parts.next().unwrap_or_default());
    put(&dir.join("run"), "estimate.json", parts.next().unwrap_or(b"{}"));
    put(&dir.join("run"), "failed.json", parts.next().unwrap_or_default());
    RunRow::read(&dir.join("run"), dir);
    RunStatus::read(&dir.join("run"));
    outcome(read_record(&mask)) + &outcome(read_status(&mask)) + &outcome(read_estimate(&dir.join("run")))
}

/// The copies of its inputs that a run keeps, with the photographs removed.
fn cameras(dir: &Path, bytes: &[u8]) -> String {
    let run = Run::quiet(&dir.join("run"));
    let mut parts = parts(bytes);
    put(run.dir(), "cameras.json", parts.next().unwrap_or_default());
    put(&run.path("mask"), "done.json", parts.next().unwrap_or_default());
    put(run.dir(), "config.toml", b"");
    let mut config = Config::preset(Preset::Draft);
    config.capture.path = dir.join("gone");
    config.device = "cpu".into();
    outcome(Session::open(&config, &run))
}

fn camera_path(_: &Path, bytes: &[u8]) -> String {
    let like = Camera {
        width: 16,
        height: 12,
        fx: 20.0,
        fy: 20.0,
        cx: 8.0,
        cy: 6.0,
        distortion: Distortion::default(),
        rotation: DMat3::IDENTITY,
        position: DVec3::ZERO,
    };
    outcome(tiface::capture::path::from_json(&text(bytes), &like))
}
