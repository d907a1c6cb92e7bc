//! `tiface preview` as a user sees it, of files that others write.

use crate::command::{code, err, out, tiface};
use image::{AnimationDecoder, RgbaImage};
use std::io::Cursor;
use std::path::Path;

/// A tetrahedron without normals, texture coordinates and colors.
const OBJ: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";

/// The same as PLY, red at all vertices.
const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
    property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 4\n\
    property list uchar int vertex_indices\nend_header\n0 0 0 255 0 0\n1 0 0 255 0 0\n0 1 0 255 0 0\n0 0 1 255 0 0\n\
    3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n";

/// Two triangles of one mesh, each of a material with a color: the left one red, the right one
/// green (linear 0.5).
fn two_materials() -> Vec<u8> {
    let corners = [
        [-1.0f32, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        [-0.5, 1.0, 0.0],
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.5, 1.0, 0.0],
    ];
    let bin: Vec<u8> = corners.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
    let accessor = |view: u32| serde_json::json!({"bufferView": view, "componentType": 5126, "count": 3, "type": "VEC3", "min": [-1, 0, 0], "max": [1, 1, 0]});
    let part = |k: u32| serde_json::json!({"attributes": {"POSITION": k}, "material": k});
    let material = |color: [f32; 4]| serde_json::json!({"pbrMetallicRoughness": {"baseColorFactor": color}});
    let json = serde_json::json!({
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 72}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 36}],
        "accessors": [accessor(0), accessor(1)],
        "materials": [material([1.0, 0.0, 0.0, 1.0]), material([0.0, 0.5, 0.0, 1.0])],
        "meshes": [{"primitives": [part(0), part(1)]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    });
    let mut json = json.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut out = b"glTF".to_vec();
    let total = 12 + 8 + json.len() + 8 + bin.len();
    [2, total as u32, json.len() as u32].iter().for_each(|v| out.extend(v.to_le_bytes()));
    out.extend(b"JSON");
    out.extend(&json);
    out.extend((bin.len() as u32).to_le_bytes());
    out.extend(b"BIN\0");
    out.extend(&bin);
    out
}

#[test]
fn materials_without_textures_give_their_colors() {
    let dir = folder();
    std::fs::write(dir.path().join("two.glb"), two_materials()).unwrap();
    let o = tiface(dir.path(), &["preview", "two.glb", "--size", "64"]);
    assert!(code(&o) == 0 && err(&o).is_empty(), "{}", err(&o));
    let seen = picture(&dir.path().join("two_preview.png"));
    let has = |color: [u8; 4]| seen.pixels().any(|p| p.0 == color);
    // linear 0.5 is 188 in sRGB
    assert!(has([255, 0, 0, 255]) && has([0, 188, 0, 255]));
}

fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("a.obj"), OBJ).unwrap();
    std::fs::write(dir.path().join("b.ply"), PLY).unwrap();
    dir
}

fn picture(file: &Path) -> RgbaImage {
    image::load_from_memory(&std::fs::read(file).unwrap()).unwrap().into_rgba8()
}

#[test]
fn a_file_becomes_a_picture_with_alpha_around_it() {
    let dir = folder();
    let o = tiface(dir.path(), &["preview", "b.ply", "--size", "64", "--json"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
    assert!(out(&o).contains("\"preview\":[\"b_preview.png\"]"));
    let seen = picture(&dir.path().join("b_preview.png"));
    assert_eq!(seen.dimensions(), (64, 64));
    // its colors as they are, in the middle; nothing in the corner
    assert_eq!((seen.get_pixel(32, 36).0, seen.get_pixel(0, 0).0), ([255, 0, 0, 255], [0; 4]));
    // without colors lamps show the shape, over what was asked for
    let words = ["preview", "a.obj", "--size", "64", "--background", "white", "--out", "c.png"];
    assert_eq!(code(&tiface(dir.path(), &words)), 0);
    let seen = picture(&dir.path().join("c.png"));
    let [r, g, b, a] = seen.get_pixel(32, 36).0;
    assert!(r == g && g == b && a == 255 && (40..250).contains(&r), "{r} {g} {b}");
    assert_eq!(seen.get_pixel(0, 0).0, [255; 4]);
}

#[test]
fn a_mesh_of_any_size_looks_the_same() {
    let dir = folder();
    let scaled = |factor: &str| {
        PLY.replace("1 0 0 255", &format!("{factor} 0 0 255"))
            .replace("0 1 0 255", &format!("0 {factor} 0 255"))
            .replace("0 0 1 255", &format!("0 0 {factor} 255"))
    };
    let seen = ["1", "1e30", "1e-30"].map(|factor| {
        std::fs::write(dir.path().join("s.ply"), scaled(factor)).unwrap();
        let o = tiface(dir.path(), &["preview", "s.ply", "--size", "64"]);
        assert_eq!(code(&o), 0, "{factor}: {}", err(&o));
        picture(&dir.path().join("s_preview.png"))
    });
    for other in &seen[1..] {
        let differ = seen[0].pixels().zip(other.pixels()).filter(|(a, b)| a != b).count();
        // the center is rounded elsewhere
        assert!(differ < 40, "{differ}");
    }
}

#[test]
fn a_turntable_turns_and_a_sheet_has_eight_pictures() {
    let dir = folder();
    let turn = |out: &str| {
        let words = ["preview", "b.ply", "--turntable", "--frames", "4", "--size", "48", "--out", out];
        let o = tiface(dir.path(), &words);
        assert_eq!(code(&o), 0, "{out}: {}", err(&o));
    };
    turn("turn.png");
    turn("turn.gif");
    turn("frames/");
    let bytes = std::fs::read(dir.path().join("turn.png")).unwrap();
    let decoder = image::codecs::png::PngDecoder::new(Cursor::new(&bytes)).unwrap().apng().unwrap();
    let frames = decoder.into_frames().collect_frames().unwrap();
    assert_eq!(frames.len(), 4);
    assert_eq!(frames[2].buffer(), &picture(&dir.path().join("frames/0003.png")));
    assert_ne!(frames[0].buffer(), frames[1].buffer());
    assert!(std::fs::read(dir.path().join("turn.gif")).unwrap().starts_with(b"GIF89a"));
    let o = tiface(dir.path(), &["preview", "b.ply", "--sheet", "--size", "40", "--out", "new/"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
    assert_eq!(picture(&dir.path().join("new/b_sheet.png")).dimensions(), (160, 80));
    // the pictures have no labels: the answer names them
    let rows = "row 1     front, left, right, back\nrow 2     top, wireframe, normals, shape\n";
    assert!(out(&o).ends_with(rows), "{}", out(&o));
}

#[test]
fn what_a_killed_turntable_left_half_written_is_removed_by_the_next() {
    let dir = folder();
    let frames = dir.path().join("t");
    std::fs::create_dir(&frames).unwrap();
    // the numbers of a process that has ended and of one that has not
    let mut ended =
        std::process::Command::new(env!("CARGO_BIN_EXE_tiface")).arg("--version").spawn().unwrap();
    ended.wait().unwrap();
    let [left, written] = [ended.id(), std::process::id()].map(|pid| format!(".0002.png.{pid}.tmp"));
    let beside = format!(".turn.png.{}.tmp", ended.id());
    for file in
        [&frames.join(&left), &frames.join(&written), &dir.path().join(&beside), &dir.path().join(&left)]
    {
        std::fs::write(file, "half").unwrap();
    }
    for out in ["t/", "turn.png"] {
        let words = ["preview", "b.ply", "--turntable", "--frames", "2", "--size", "16", "--out", out];
        let o = tiface(dir.path(), &words);
        assert_eq!(code(&o), 0, "{}", err(&o));
    }
    assert!(!frames.join(&left).exists() && !dir.path().join(beside).exists());
    // what another process writes is its own, and what another command left beside is not this
    // one's
    assert!(frames.join(written).exists() && dir.path().join(left).exists());
}

#[test]
fn what_cannot_be_shown_is_said() {
    let dir = folder();
    std::fs::create_dir(dir.path().join("empty")).unwrap();
    std::fs::write(dir.path().join("points.obj"), "v 0 0 0\nv 1 0 0\n").unwrap();
    std::fs::write(dir.path().join("dot.obj"), "v 3 3 3\nv 3 3 3\nv 3 3 3\nf 1 2 3\n").unwrap();
    std::fs::write(dir.path().join("lost.obj"), format!("mtllib lost.mtl\nvt 0 0\n{OBJ}")).unwrap();
    for (words, expected, text) in [
        (&["preview", "a.obj", "--light", "uv"][..], 1, "has no texture coordinates"),
        (&["preview", "absent.glb"], 1, "absent.glb"),
        (&["preview", "points.obj"], 1, "holds no triangles"),
        (&["preview", "a.obj", "--out", "a.jpg"], 2, "writes no such file"),
        (&["preview", "a.obj", "--out", "a.gif"], 2, "writes no such file"),
        (&["preview", "a.obj", "--size", "0"], 2, "--size"),
        (&["preview", "dot.obj"], 1, "lie at one place"),
        // nothing is ignored in silence
        (&["preview", "a.obj", "--frames", "9"], 2, "--turntable"),
        (&["preview", "a.obj", "--page", "--size", "64"], 2, "--size"),
        (&["preview", "empty", "--up", "z"], 2, "a run has its own up axis"),
        (&["preview", "a.obj", "--cameras", "test"], 1, "there are no cameras"),
        (&["preview", "empty"], 1, "has no mesh yet"),
        // shown all the same
        (&["preview", "lost.obj", "--size", "32"], 0, "shown without its texture"),
    ] {
        let o = tiface(dir.path(), words);
        assert_eq!(code(&o), expected, "{words:?}: {}", err(&o));
        assert!(err(&o).contains(text), "{words:?}: {}", err(&o));
    }
}
