//! Mesh files made to hurt, and the message each must produce. Nothing here may panic, hang or
//! reserve memory for what a file merely claims.

use glam::Vec3;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use tiface::geom::Mesh;
use tiface::mesh::check::check;
use tiface::mesh::export::ExportOptions;
use tiface::mesh::read::{Limits, ReadMeshError, read, read_limited};
use tiface::mesh::{gltf::to_glb, obj::to_obj, ply::to_ply};

fn tetrahedron() -> Mesh {
    Mesh {
        positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
        normals: vec![-Vec3::ONE.normalize(), Vec3::X, Vec3::Y, Vec3::Z],
        colors: vec![[0.0, 0.2, 0.4], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
    }
}

/// A GLB of a document and bytes, sizes right.
fn glb(document: &Value, bin: &[u8]) -> Vec<u8> {
    let mut json = document.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = 28 + json.len() + bin.len();
    let mut out = b"glTF".to_vec();
    for word in [2, total as u32, json.len() as u32] {
        out.extend(word.to_le_bytes());
    }
    out.extend(b"JSON");
    out.extend(json);
    out.extend((bin.len() as u32).to_le_bytes());
    out.extend(b"BIN\0");
    out.extend(bin);
    out
}

/// Four corners (48 bytes), then three bytes-sized triangles and padding.
fn bin() -> Vec<u8> {
    let mut out: Vec<u8> = [0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    out.extend([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]);
    out
}

fn document() -> Value {
    json!({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": 12, "type": "SCALAR"}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 12}],
        "buffers": [{"byteLength": 60}]
    })
}

fn message(bytes: &[u8]) -> String {
    match read(bytes, Path::new("bad")) {
        Ok(mesh) => format!("read {} triangles", mesh.triangles.len()),
        Err(e) => {
            assert!(!e.hint().is_empty());
            e.to_string()
        }
    }
}

/// The document with one place changed.
fn with(pointer: &str, value: Value) -> Vec<u8> {
    let mut d = document();
    let (parent, key) = pointer.rsplit_once('/').unwrap();
    let parent = d.pointer_mut(parent).unwrap();
    match parent {
        Value::Array(items) => items[key.parse::<usize>().unwrap()] = value,
        other => other[key] = value,
    }
    glb(&d, &bin())
}

#[test]
fn a_sound_file_is_read() {
    let mesh = read(&glb(&document(), &bin()), Path::new("a.glb")).unwrap();
    assert!(mesh.is_closed());
    assert_eq!(mesh.positions, tetrahedron().positions);
}

#[test]
fn crooked_glbs_are_named_errors() {
    let cases: Vec<(Vec<u8>, &str)> = vec![
        (
            with("/accessors/0/count", json!(5)),
            "`bad`, accessor 0: 5 elements do not fit into the 48 bytes of its buffer view",
        ),
        (with("/accessors/0/count", json!(u64::MAX)), "accessor 0: 18446744073709551615 elements do not fit"),
        (with("/accessors/0/count", json!(0)), "accessor 0: has count 0"),
        (with("/accessors/0/count", json!(-1)), "the JSON chunk"),
        (with("/accessors/0/byteOffset", json!(u64::MAX)), "elements do not fit"),
        (with("/accessors/0/componentType", json!(5120)), "type VEC3 of components 5120, expected VEC3"),
        (with("/accessors/0/type", json!("VEC2")), "type VEC2"),
        (with("/accessors/0/sparse", json!({"count": 1})), "accessor 0: a sparse accessor is not supported"),
        (with("/accessors/0/bufferView", json!(9)), "buffer view 9: is named, but there are only 2"),
        (with("/accessors/0/bufferView", Value::Null), "has no buffer view"),
        (with("/accessors/1/count", json!(11)), "11 indices are not whole triangles"),
        (with("/accessors/1/componentType", json!(5126)), "accessor 1: type SCALAR of components 5126"),
        (with("/bufferViews/0/byteLength", json!(61)), "61 bytes from 0 do not fit into a buffer of 60"),
        (with("/bufferViews/0/byteOffset", json!(u64::MAX)), "do not fit into a buffer"),
        (with("/bufferViews/0/byteStride", json!(4)), "a stride of 4 bytes for elements of 12"),
        (with("/bufferViews/0/byteStride", json!(u64::MAX)), "elements do not fit"),
        (with("/bufferViews/0/buffer", json!(1)), "buffer view 0: names buffer 1"),
        (with("/buffers/0/byteLength", json!(61)), "buffer 0: 61 bytes, but the file holds 60"),
        (
            with("/buffers/0/uri", json!("../../etc/passwd")),
            "buffer 0: a buffer outside the file is not supported",
        ),
        (with("/buffers/0/uri", json!("http://example.com/a.bin")), "a buffer outside the file"),
        (with("/nodes/0/children", json!([0])), "node 0: is reached twice"),
        (
            with("/nodes", json!([{"children": [1]}, {"children": [0], "mesh": 0}])),
            "node 0: is reached twice",
        ),
        (with("/nodes/0/children", json!([7])), "node 7: is named, but there are only 1"),
        (with("/nodes/0/mesh", json!(3)), "mesh 3: is named"),
        (with("/nodes/0/scale", json!([1e300, 1e300, 1e300])), "not finite once its node has moved it"),
        (with("/nodes/0/matrix", json!([1, 2, 3])), "the JSON chunk"),
        (with("/scene", json!(4)), "`scene`: 4 of 1 scenes"),
        (with("/meshes/0/primitives/0/attributes", json!({})), "there is no `POSITION`"),
        (with("/meshes/0/primitives/0/attributes", json!({"POSITION": 99})), "accessor 99: is named"),
        (with("/meshes/0/primitives/0/mode", json!(5)), "primitive mode 5"),
        (with("/meshes/0/primitives/0/mode", json!(0)), "`bad` holds no triangles"),
        (
            with("/extensionsRequired", json!(["KHR_draco_mesh_compression"])),
            "`KHR_draco_mesh_compression` is not supported",
        ),
        (glb(&json!({}), &[]), "holds no triangles"),
        (b"glTF".to_vec(), "the file ends inside a header"),
        (b"glTF\x01\0\0\0\x20\0\0\0".to_vec(), "glTF version 1"),
        (b"glTF\x02\0\0\0\xff\xff\xff\xff".to_vec(), "says 4294967295 bytes, but the file has 12"),
    ];
    for (bytes, expected) in cases {
        let found = message(&bytes);
        assert!(found.contains(expected), "expected {expected:?}, found {found:?}");
    }
}

#[test]
fn numbers_and_indices_in_a_glb_are_checked() {
    let mut bytes = bin();
    bytes[48] = 4;
    assert!(message(&glb(&document(), &bytes)).contains("index 4, but there are 4 vertices"));
    for bad in [f32::NAN, f32::INFINITY] {
        let mut bytes = bin();
        bytes[12..16].copy_from_slice(&bad.to_le_bytes());
        assert!(message(&glb(&document(), &bytes)).contains("accessor 0: element 1 is"));
    }
    // 1e38 is a number: read, and survived by everything that looks at meshes
    let mut bytes = bin();
    bytes[12..16].copy_from_slice(&1e38f32.to_le_bytes());
    let mesh = read(&glb(&document(), &bytes), Path::new("a")).unwrap();
    assert!(check(&mesh, 1.0).closed);
}

#[test]
fn one_buffer_shown_many_times_meets_a_limit() {
    let mut d = document();
    let primitive = d["meshes"][0]["primitives"][0].clone();
    d["meshes"][0]["primitives"] = json!(vec![primitive; 100]);
    d["nodes"] = json!(vec![json!({"mesh": 0}); 100]);
    d["scenes"][0]["nodes"] = json!((0..100).collect::<Vec<_>>());
    let bytes = glb(&d, &bin());
    assert_eq!(read(&bytes, Path::new("a")).unwrap().triangles.len(), 40_000);
    let limits = Limits { triangles: 1000, ..Limits::default() };
    let e = read_limited(&bytes, Path::new("a"), &limits).unwrap_err();
    assert_eq!(e.to_string(), "`a` has more than 1000 triangles");
}

#[test]
fn a_mirroring_node_keeps_the_surface_outward() {
    let mut d = document();
    d["nodes"][0]["scale"] = json!([-1, 1, 1]);
    let mesh = read(&glb(&d, &bin()), Path::new("a")).unwrap();
    assert!(mesh.signed_volume() > 0.0 && mesh.bounds().min.x == -1.0);
}

#[test]
fn crooked_objs_are_named_errors() {
    let good = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n";
    for (end, expected) in [
        ("f 1 2 5\n", "`bad`, line 5: index `5`, but there are 4 vertices so far"),
        ("f 0 1 2\n", "index `0`"),
        ("f -5 1 2\n", "index `-5`"),
        ("f 1 2 99999999999999999999\n", "index `99999999999999999999`"),
        ("f 1 2\n", "a face with 2 corners"),
        ("f 1//1 2//1 3//1\n", "index `1`, but there are 0 normals so far"),
        ("f a b c\n", "index `a`"),
        ("v 1 2\n", "2 numbers, expected x y z"),
        ("v nan 0 0\n", "`nan` is not a finite number"),
        ("v inf 0 0\n", "`inf` is not a finite number"),
        ("v 1e39 0 0\n", "`1e39` is not a finite number"),
        ("v 1 2 \\\n3\n", "a continued line is not supported"),
        ("", "holds no triangles"),
    ] {
        let found = message(format!("{good}{end}").as_bytes());
        assert!(found.contains(expected), "expected {expected:?}, found {found:?}");
    }
}

#[test]
fn polygons_are_fanned_and_negative_indices_count_from_the_end() {
    let obj = "\u{feff}# hello\nmtllib ../../etc/passwd\no a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\r\n\
               usemtl x\nf 1/1 2/2 3/3 4/4\nf -4 -3 -2\n";
    let mesh = read(obj.as_bytes(), Path::new("a.obj")).unwrap();
    assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 2]]);
    assert!(mesh.colors.is_empty() && mesh.normals.is_empty());
}

fn ply(header: &str, body: &[u8]) -> Vec<u8> {
    [b"ply\n", header.as_bytes(), b"end_header\n", body].concat()
}

#[test]
fn crooked_plys_are_named_errors() {
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    let list = "property list uchar int vertex_indices\n";
    let ascii = |v: &str, f: &str, body: &str| {
        ply(&format!("format ascii 1.0\nelement vertex {v}\n{xyz}element face {f}\n{list}"), body.as_bytes())
    };
    let binary = |v: &str, f: &str, body: &[u8]| {
        ply(
            &format!("format binary_little_endian 1.0\nelement vertex {v}\n{xyz}element face {f}\n{list}"),
            body,
        )
    };
    let corners = "0 0 0 1 0 0 0 1 0\n";
    let cases = vec![
        (
            ascii("3", "1", "0 0 0 1 0 0 0 1 0\n3 0 1 3\n"),
            "`bad`, triangle 0: index 3, but there are 3 vertices",
        ),
        (ascii("3", "1", "0 0 0 1 0 0 0 1 nan\n3 0 1 2\n"), "vertex 2"),
        (ascii("3", "1", "0 0 0 1 0 0 0 1e39 0\n3 0 1 2\n"), "is not finite"),
        (ascii("3", "1", &format!("{corners}3 0 1 -1\n")), "face 0: index -1"),
        (ascii("3", "1", &format!("{corners}3 0 1 0.5\n")), "face 0: index 0.5"),
        (ascii("3", "1", &format!("{corners}-3 0 1 2\n")), "a list of -3 values does not fit"),
        (
            ascii("3", "1", &format!("{corners}1e18 0 1 2\n")),
            "a list of 1000000000000000000 values does not fit",
        ),
        (ascii("3", "1", &format!("{corners}nan 0 1 2\n")), "a list of NaN values does not fit"),
        (ascii("3", "1", "0 0 x 0 0 0 0 0 0\n"), "expected a number, found `x`"),
        (ascii("3", "0", corners), "holds no triangles"),
        (ascii("99999999999999999999", "0", ""), "`99999999999999999999` is not a count"),
        (
            binary("9999999999999", "0", b""),
            "element `vertex`: 9999999999999 of at least 12 bytes each, but 0 remain",
        ),
        (binary("18446744073709551615", "0", b""), "of at least 12 bytes each"),
        (binary("0", "4000000000", b""), "element `face`: 4000000000 of at least 1 bytes each"),
        (
            binary("1", "1", &[[0u8; 12].as_slice(), &[255, 0, 0]].concat()),
            "a list of 255 values does not fit",
        ),
        (ply("format ascii 2.0\nelement vertex 99\n", b""), "element `vertex`: has no properties"),
        (ply("format telepathy 1.0\n", b""), "format `telepathy` is unknown"),
        (ply("element vertex 1\nproperty quad x\n", b""), "type `quad` is unknown"),
        (ply("property float x\n", b""), "a property before any element"),
        (ply("hello\n", b""), "header line 2: `hello` is not understood"),
        (ply("", b""), "there was no `format`"),
        (b"ply\nformat ascii 1.0".to_vec(), "the header has no end"),
        (ply("format ascii 1.0\nelement vertex 0\nproperty float x\n", b""), "has no x, y, z"),
        (
            ply(&format!("format ascii 1.0\nelement tristrips 1\n{list}"), b"3 0 1 2"),
            "a triangle strip is not supported",
        ),
    ];
    for (bytes, expected) in cases {
        let found = message(&bytes);
        assert!(found.contains(expected), "expected {expected:?}, found {found:?}");
    }
}

#[test]
fn every_dialect_of_ply_gives_the_same_mesh() {
    let header = |format: &str| {
        format!(
            "format {format} 1.0\ncomment c\nelement extra 1\nproperty list uchar short junk\nelement vertex 4\n\
             property double x\nproperty float32 y\nproperty short z\nproperty ushort red\nproperty uchar green\n\
             property float blue\nelement face 1\nproperty uchar flag\nproperty list int uint vertex_index\n"
        )
    };
    let text = "2 7 -7\n0 0 0 65535 51 0.5\n1 0 0 0 0 0\n1 1 0 0 0 0\n0 1 0 0 0 0\n9 4 0 1 2 3\n";
    let mut little = vec![2, 7, 0, 0xf9, 0xff];
    let mut big = vec![2, 0, 7, 0xff, 0xf9];
    for (x, y, r, g, b) in [
        (0f64, 0f32, 65535u16, 51u8, 0.5f32),
        (1.0, 0.0, 0, 0, 0.0),
        (1.0, 1.0, 0, 0, 0.0),
        (0.0, 1.0, 0, 0, 0.0),
    ] {
        little.extend(
            [&x.to_le_bytes()[..], &y.to_le_bytes(), &[0, 0], &r.to_le_bytes(), &[g], &b.to_le_bytes()]
                .concat(),
        );
        big.extend(
            [&x.to_be_bytes()[..], &y.to_be_bytes(), &[0, 0], &r.to_be_bytes(), &[g], &b.to_be_bytes()]
                .concat(),
        );
    }
    little.push(9);
    big.push(9);
    for v in [4u32, 0, 1, 2, 3] {
        little.extend(v.to_le_bytes());
        big.extend(v.to_be_bytes());
    }
    let meshes: Vec<Mesh> =
        [("ascii", text.as_bytes()), ("binary_little_endian", &little), ("binary_big_endian", &big)]
            .into_iter()
            .map(|(format, body)| read(&ply(&header(format), body), Path::new("a")).unwrap())
            .collect();
    assert_eq!(meshes[0].triangles, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(meshes[0].colors[0], [1.0, 0.2, 0.5]);
    assert!(meshes[0] == meshes[1] && meshes[1] == meshes[2]);
}

#[test]
fn a_file_cut_at_any_byte_is_an_error_or_a_smaller_mesh_but_never_a_panic() {
    let (mesh, options) = (tetrahedron(), ExportOptions::default());
    let whole = [to_glb(&mesh, &options).unwrap(), to_obj(&mesh, &options).unwrap(), to_ply(&mesh).unwrap()];
    for bytes in &whole {
        assert_eq!(read(bytes, Path::new("a")).unwrap().triangles, mesh.triangles);
        for end in 0..bytes.len() {
            let cut = read(&bytes[..end], Path::new("a"));
            assert!(cut.is_err() || bytes.starts_with(b"#"), "GLB and PLY know their length: {end}");
        }
    }
}

#[test]
fn a_flipped_byte_anywhere_is_survived_by_reader_and_check() {
    let (mesh, options) = (tetrahedron(), ExportOptions::default());
    for bytes in [to_glb(&mesh, &options).unwrap(), to_obj(&mesh, &options).unwrap(), to_ply(&mesh).unwrap()]
    {
        for at in 0..bytes.len() {
            for value in [0x00, 0xff, b'9', b'-', bytes[at] ^ 0x80, bytes[at].wrapping_add(1)] {
                let mut bent = bytes.clone();
                bent[at] = value;
                if let Ok(mesh) = read(&bent, Path::new("a")) {
                    assert!(mesh.positions.iter().all(|p| p.is_finite()));
                    let count = mesh.positions.len() as u32;
                    assert!(mesh.triangles.iter().flatten().all(|&i| i < count));
                    check(&mesh, 1.0);
                }
            }
        }
    }
}

#[test]
fn what_is_no_mesh_at_all_is_said_so() {
    for bytes in [&b""[..], b"\0\0\0\0", b"hello world", b"{\"asset\": {}}", &[0xff; 64]] {
        assert!(matches!(read(bytes, Path::new("a")), Err(ReadMeshError::Unknown { .. })));
    }
    assert_eq!(message(b""), "`bad` is neither GLB, PLY nor OBJ");
}

#[test]
fn the_scans_of_the_captures_are_read() {
    let shared = std::env::var_os("TIFACE_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared")), PathBuf::from);
    for (capture, vertices, triangles) in [("lps", 139_894, 280_000), ("nefertiti", 10_000, 19_482)] {
        let path = shared.join("data/captures").join(capture).join("gt.ply");
        let Ok(bytes) = std::fs::read(&path) else {
            eprintln!("skipped: there is no {}", path.display());
            continue;
        };
        let mesh = read(&bytes, &path).unwrap();
        assert_eq!(
            (mesh.positions.len(), mesh.normals.len(), mesh.triangles.len()),
            (vertices, vertices, triangles)
        );
        eprintln!("{capture}\n{}", check(&mesh, 1.0));
    }
}
