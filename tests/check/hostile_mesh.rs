//! Malformed and malicious mesh files, and the message each must produce. Nothing here may panic,
//! hang or reserve memory for what a file merely claims.

use crate::clicked;
use glam::{DVec3, Vec3};
use serde_json::{Value, json};
use std::path::Path;
use tiface::geom::{Atlas, Mesh, Similarity};
use tiface::image::Photo;
use tiface::mesh::files::{
    CheckReport, ExportOptions, HeadTexture, PictureSource, ReadMesh, ReadOptions, check, check_around,
    open_mesh, read, read_with, to_glb, to_obj, to_ply, uv_check, weld,
};

fn tetrahedron() -> Mesh {
    Mesh {
        positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
        normals: vec![-Vec3::ONE.normalize(), Vec3::X, Vec3::Y, Vec3::Z],
        colors: vec![[0.0, 0.2, 0.4], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        ..Mesh::default()
    }
}

/// A GLB of a document and bytes, sizes right.
fn glb(document: &Value, bin: &[u8]) -> Vec<u8> {
    glb_of(document.to_string().into_bytes(), bin)
}

fn glb_of(mut json: Vec<u8>, bin: &[u8]) -> Vec<u8> {
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

/// A mesh with its texture.
fn read_whole(bytes: &[u8], path: &Path) -> tiface::Result<ReadMesh> {
    read_with(bytes, path, &ReadOptions::default())
}

/// The mesh as a GLB, an OBJ and a PLY.
fn files(mesh: &Mesh, texture: Option<&HeadTexture>, options: &ExportOptions) -> [Vec<u8>; 3] {
    let [obj, ply] = [to_obj, to_ply].map(|to| to(mesh, texture, options).unwrap().files.remove(0).1);
    [to_glb(mesh, texture, None, options).unwrap(), obj, ply]
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
        (with("/accessors/0/componentType", json!(5120)), "accessor 0: Vec3 of I8, expected Vec3 of F32"),
        (
            with("/accessors/0/componentType", json!(1)),
            "accessor 0: Vec3 of an unknown component, expected Vec3",
        ),
        (with("/accessors/0/type", json!("VEC2")), "accessor 0: Vec2 of F32, expected Vec3"),
        (with("/accessors/0/type", json!("VEC5")), "accessor 0: an unknown type of F32, expected Vec3"),
        (
            with(
                "/accessors/0/sparse",
                json!({"count": 1, "indices": {"bufferView": 0, "componentType": 5123}, "values": {"bufferView": 0}}),
            ),
            "accessor 0: a sparse accessor is not supported",
        ),
        (with("/accessors/0/sparse", json!({"count": 1})), "accessor 0: a sparse accessor is not supported"),
        (with("/accessors/0/bufferView", json!(9)), "buffer view 9: is named, but there are only 2"),
        (with("/accessors/0/bufferView", Value::Null), "has no buffer view"),
        (with("/accessors/1/count", json!(11)), "11 indices are not whole triangles"),
        (
            with("/accessors/1/componentType", json!(5126)),
            "accessor 1: Scalar of F32, expected Scalar of U8, U16 or U32",
        ),
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
        (
            with(
                "/nodes",
                json!([{"children": [1], "scale": [1e38, 1, 1]}, {"scale": [1e38, 1, 1], "mesh": 0}]),
            ),
            "not finite once its node has moved it",
        ),
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
        (glb(&json!({"asset": {"version": "2.0"}}), &[]), "holds no triangles"),
        (glb(&json!({}), &[]), "holds no triangles"),
        (with("/meshes/0/primitives/0/indices", json!(1u64 << 32)), "the JSON chunk"),
        (b"glTF".to_vec(), "the file ends inside a header"),
        (b"glTF\x01\0\0\0\x20\0\0\0".to_vec(), "glTF version 1"),
        (b"glTF\x02\0\0\0\xff\xff\xff\xff".to_vec(), "says 4294967295 bytes, but the file has 12"),
        (b"glTF\x02\0\0\0\x0b\0\0\0".to_vec(), "says 11 bytes, but the file has 12"),
        (b"glTF\x02\0\0\0\x0c\0\0\0".to_vec(), "`bad`, byte 12: "),
    ];
    for (bytes, expected) in cases {
        let found = message(&bytes);
        assert!(found.contains(expected), "expected {expected:?}, found {found:?}");
    }
}

#[test]
fn what_is_not_read_of_a_glb_cannot_refuse_it() {
    let odd = json!([{"odd": [true, null]}, 7]);
    let mut d = document();
    for name in ["animations", "skins", "cameras", "samplers", "extensions", "asset", "extras"] {
        d[name] = odd.clone();
    }
    // an empty scene beside the one that counts; targets, weights and names of strange types
    d["scenes"] = json!([{"nodes": [0], "name": 3}, {}]);
    d["accessors"][0]["min"] = odd.clone();
    d["meshes"][0]["weights"] = json!([odd, 0]);
    d["meshes"][0]["primitives"][0]["targets"] = odd.clone();
    d["meshes"][0]["primitives"][0]["extensions"] = odd.clone();
    d["bufferViews"][0]["target"] = odd.clone();
    d["materials"] = json!([{"alphaMode": odd, "pbrMetallicRoughness": {"baseColorFactor": odd}}]);
    assert_eq!(message(&glb(&d, &bin())), "read 4 triangles");
    assert!(message(&with("/scenes/0", json!({}))).contains("holds no triangles"));
}

#[test]
fn a_mesh_that_skins_morphs_or_instances_move_is_refused_not_measured_elsewhere() {
    let refusal = |node: Value, mesh: Value, targets: Value| {
        let mut d = document();
        d["nodes"][0].as_object_mut().unwrap().extend(node.as_object().unwrap().clone());
        d["meshes"][0]["weights"] = mesh;
        d["meshes"][0]["primitives"][0]["targets"] = targets;
        message(&glb(&d, &bin()))
    };
    let targets = || json!([{"POSITION": 0}]);
    for (node, mesh, targets, expected) in [
        (json!({"skin": 0}), json!(null), json!(null), "`bad`, mesh 0: a skin is not supported"),
        (json!({}), json!([0.5]), targets(), "mesh 0: a morph target whose weight is not 0 is not supported"),
        (json!({"weights": [0, 1]}), json!([0, 0]), targets(), "a morph target whose weight is not 0"),
        // a node's weights come before its mesh's
        (json!({"weights": [0]}), json!([1]), targets(), "read 4 triangles"),
        (json!({"weights": [1]}), json!([1]), json!(null), "read 4 triangles"),
        (
            json!({"extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}}),
            json!(null),
            json!(null),
            "mesh 0: `EXT_mesh_gpu_instancing` is not supported",
        ),
    ] {
        let found = refusal(node, mesh, targets);
        assert!(found.contains(expected), "{found}");
    }
}

#[test]
fn nodes_far_from_the_origin_keep_their_distance() {
    // f32 has steps of a half at 4 500 000: both nodes would stand at the same place, or half a
    // unit apart
    for x in ["translation", "matrix"] {
        let node = |at: f64| {
            let matrix = json!([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, at, 0, 0, 1]);
            let place = if x == "matrix" { matrix } else { json!([at, 0, 0]) };
            json!({"mesh": 0, x: place})
        };
        let mut d = document();
        d["nodes"] = json!([node(4_500_000.1), node(4_500_000.4)]);
        d["scenes"][0]["nodes"] = json!([0, 1]);
        let found = read_whole(&glb(&d, &bin()), Path::new("a")).unwrap();
        // a corner at 0 of both: 0.3 apart, and the first 4 500 000.1 from the origin
        let [first, second] = [0, 4].map(|v| found.mesh.positions[v].as_dvec3() + found.origin);
        assert!((first.x - 4_500_000.1).abs() < 1e-6, "{first}");
        assert!((second.x - first.x - 0.3).abs() < 1e-6, "{first} {second}");
    }
}

#[test]
fn json_that_would_fill_the_memory_is_refused_before_it_is_parsed() {
    let many = |item: &str, count: usize| {
        let json = format!("{{\"materials\": [{item}{}]}}", format!(",{item}").repeat(count - 1));
        glb_of(json.into_bytes(), &[])
    };
    // the document and its list are two more
    assert!(message(&many("{}", (1 << 20) - 2)).contains("holds no triangles"));
    assert!(message(&many("{}", (1 << 20) - 1)).contains("1048577 and 2097151, more than 1048576 objects"));
    assert!(message(&many("0", 4 << 20)).contains("or 4194304 values"));
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
    let limits = ReadOptions { triangles: 1000, ..ReadOptions::default() };
    let e = read_with(&bytes, Path::new("a"), &limits).unwrap_err();
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
        ("vn 0 0 1\nf 1//1 2//2 3//1\n", "`bad`, line 6: index `2`, but there are 1 normals so far"),
        ("f 1 2 \\\n\\\n9\n", "`bad`, line 5: index `9`"),
        ("f a b c\n", "index `a`"),
        ("v 1 2\n", "2 numbers, expected x y z"),
        ("v nan 0 0\n", "`nan` is not a finite number"),
        ("v inf 0 0\n", "`inf` is not a finite number"),
        ("v 1e39 0 0\n", "`1e39` is not a finite number"),
        ("v 1 2 \\\n\n", "2 numbers, expected x y z"),
        ("", "holds no triangles"),
    ] {
        let found = message(format!("{good}{end}").as_bytes());
        assert!(found.contains(expected), "expected {expected:?}, found {found:?}");
    }
}

#[test]
fn obj_files_may_continue_lines_add_comments_and_name_normals_they_do_not_write() {
    let corners = "v 0 0 0 # first\nv 1 0 \\\n0\nv 0 1 0\n# not continued \\\nv 0 0 1\n";
    for (faces, triangles) in [
        ("f 1 3 2 # comment", vec![[0, 2, 1]]),
        ("f 1 3 \\\r\n 2 \\\r\n 4\r\n", vec![[0, 2, 1], [0, 1, 3]]),
        ("f 1//1 3//2 2//3", vec![[0, 2, 1]]),
        ("f 1 3 2 \\", vec![[0, 2, 1]]),
    ] {
        let mesh = read(format!("{corners}{faces}").as_bytes(), Path::new("a")).unwrap();
        assert_eq!((mesh.triangles, mesh.normals.len()), (triangles, 0), "{faces}");
        assert_eq!(mesh.positions, tetrahedron().positions);
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

/// A 1 × 1 PNG whose header may lie about its size; the sums of the chunks are right.
fn png(width: u32, height: u32) -> Vec<u8> {
    let chunk = |kind: &[u8], data: &[u8]| {
        let whole = [kind, data].concat();
        let sum = crc32fast::hash(&whole).to_be_bytes();
        [&(data.len() as u32).to_be_bytes()[..], &whole, &sum].concat()
    };
    let size = [width.to_be_bytes(), height.to_be_bytes()].concat();
    // one gray pixel, stored: filter 0, value 7; Adler-32 of (0, 7) is 1 + 0 + 7 = 8, and 1 + 8 = 9
    let data = [0x78, 0x01, 1, 2, 0, 0xfd, 0xff, 0, 7, 0, 9, 0, 8];
    [
        &b"\x89PNG\r\n\x1a\n"[..],
        &chunk(b"IHDR", &[&size[..], &[8, 0, 0, 0, 0]].concat()),
        &chunk(b"IDAT", &data),
        &chunk(b"IEND", b""),
    ]
    .concat()
}

/// The tetrahedron with texture coordinates (32 bytes from 60) and a picture (from 92).
fn textured(picture: &[u8], uvs: [[f32; 2]; 4]) -> (Value, Vec<u8>) {
    let mut bin = bin();
    bin.extend(uvs.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
    bin.extend(picture);
    let mut d = document();
    d["buffers"][0]["byteLength"] = json!(bin.len());
    bin.resize(bin.len().next_multiple_of(4), 0);
    let views = d["bufferViews"].as_array_mut().unwrap();
    views.push(json!({"buffer": 0, "byteOffset": 60, "byteLength": 32}));
    views.push(json!({"buffer": 0, "byteOffset": 92, "byteLength": picture.len()}));
    let accessor = json!({"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2"});
    d["accessors"].as_array_mut().unwrap().push(accessor);
    d["images"] = json!([{"bufferView": 3, "mimeType": "image/png"}]);
    d["textures"] = json!([{"source": 0}]);
    d["materials"] = json!([{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]);
    let primitive = &mut d["meshes"][0]["primitives"][0];
    primitive["attributes"]["TEXCOORD_0"] = json!(2);
    primitive["material"] = json!(0);
    (d, bin)
}

const UVS: [[f32; 2]; 4] = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.5]];

/// The textured tetrahedron as `KHR_mesh_quantization` writes it, 16 bits a number, at (5, 1, 2), a
/// quarter large.
fn quantized() -> Vec<u8> {
    let corners: [[u16; 4]; 4] = [[0; 4], [65535, 0, 0, 0], [0, 65535, 0, 0], [0, 0, 65535, 0]];
    let mut bin: Vec<u8> = corners.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
    bin.extend(
        [[0i8, 0, -127, 0], [127, 0, 0, 0], [0, 127, 0, 0], [0, 0, 127, 0]]
            .as_flattened()
            .iter()
            .map(|v| *v as u8),
    );
    bin.extend(
        [[0u16, 0], [65535, 0], [0, 65535], [32768, 32768]]
            .as_flattened()
            .iter()
            .flat_map(|v| v.to_le_bytes()),
    );
    bin.extend(&self::bin()[48..]);
    let picture = png(1, 1);
    bin.extend(&picture);
    let mut d = textured(&picture, UVS).0;
    d["extensionsUsed"] = json!(["KHR_mesh_quantization"]);
    d["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    d["buffers"][0]["byteLength"] = json!(bin.len());
    bin.resize(bin.len().next_multiple_of(4), 0);
    d["nodes"][0]["scale"] = json!([0.25, 0.25, 0.25]);
    d["nodes"][0]["translation"] = json!([5, 1, 2]);
    d["bufferViews"] = json!([
        {"buffer": 0, "byteLength": 32, "byteStride": 8},
        {"buffer": 0, "byteOffset": 64, "byteLength": 12},
        {"buffer": 0, "byteOffset": 48, "byteLength": 16},
        {"buffer": 0, "byteOffset": 76, "byteLength": picture.len()},
        {"buffer": 0, "byteOffset": 32, "byteLength": 16, "byteStride": 4},
    ]);
    let accessor = |view: u32, component: u32, kind: &str| json!({"bufferView": view, "componentType": component, "count": 4, "type": kind, "normalized": true});
    d["accessors"][0] = accessor(0, 5123, "VEC3");
    d["accessors"][2] = accessor(2, 5123, "VEC2");
    d["accessors"].as_array_mut().unwrap().push(accessor(4, 5120, "VEC3"));
    d["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = json!(3);
    glb(&d, &bin)
}

#[test]
fn sixteen_bit_coordinates_of_others_are_read() {
    let found = read_whole(&quantized(), Path::new("a")).unwrap();
    // 65535 is one, a quarter of it from (5, 1, 2) on
    let at = |x: f32, y: f32, z: f32| Vec3::new(5.0, 1.0, 2.0) + 0.25 * Vec3::new(x, y, z);
    assert_eq!(found.origin, DVec3::new(5.125, 1.125, 2.125));
    let expected = [at(0., 0., 0.), at(1., 0., 0.), at(0., 1., 0.), at(0., 0., 1.)];
    assert_eq!(read(&quantized(), Path::new("a")).unwrap().positions, expected);
    assert_eq!(found.mesh.normals, [-Vec3::Z, Vec3::X, Vec3::Y, Vec3::Z]);
    assert!(found.mesh.is_closed() && found.picture.is_some());
    // 32768 / 65535 is a half and 1/131070
    assert!((found.atlas.unwrap().uvs[3].x - 0.5 - 1.0 / 131_070.0).abs() < 1e-7);
    // without the extension that allows them they are refused
    let mut bytes = quantized();
    let at = bytes.windows(18).position(|w| w == b"extensionsRequired").unwrap();
    bytes[at] = b'X';
    assert!(message(&bytes).contains("accessor 0: Vec3 of U16, expected Vec3 of F32"));
}

fn whole_message(bytes: &[u8]) -> String {
    match read_whole(bytes, Path::new("bad")) {
        Ok(whole) => format!("read, texture {}", whole.picture.is_some()),
        Err(e) => {
            assert!(!e.hint().is_empty());
            e.to_string()
        }
    }
}

#[test]
fn crooked_textures_are_named_errors_but_leave_the_surface_readable() {
    let (d, bin) = textured(&png(1, 1), UVS);
    let good = read_whole(&glb(&d, &bin), Path::new("a")).unwrap();
    let atlas = good.atlas.unwrap();
    assert_eq!((atlas.width, atlas.height, atlas.uvs[3].to_array()), (1, 1, [0.5, 0.5]));
    assert!(good.picture.is_some());
    let info = "/materials/0/pbrMetallicRoughness/baseColorTexture";
    let cases = [
        ("/accessors/2/count", json!(5), "accessor 2: 5 elements do not fit into the 32 bytes"),
        ("/accessors/2/count", json!(3), "3 of `TEXCOORD_0` for 4 of `POSITION`"),
        ("/accessors/2/byteOffset", json!(u64::MAX), "elements do not fit"),
        ("/accessors/2/type", json!("VEC3"), "accessor 2: Vec3 of F32, expected Vec2"),
        ("/accessors/2/componentType", json!(5125), "accessor 2: Vec2 of U32, expected Vec2"),
        ("/bufferViews/2/byteLength", json!(1 << 20), "do not fit into a buffer of"),
        ("/meshes/0/primitives/0/attributes/TEXCOORD_0", json!(9), "accessor 9: is named"),
        ("/meshes/0/primitives/0/material", json!(1), "material 1: is named, but there are only 1"),
        (info, json!({"index": 3}), "texture 3: is named, but there are only 1"),
        (info, json!({"index": -1}), "the JSON chunk"),
        (info, json!({"index": 0, "texCoord": 1}), "there is no `TEXCOORD_1`"),
        (
            info,
            json!({"index": 0, "extensions": {"KHR_texture_transform": {"rotation": 1.5}}}),
            "`KHR_texture_transform` with a rotation is not supported",
        ),
        ("/textures/0/source", json!(4), "image 4: is named, but there are only 1"),
        ("/textures/0/source", Value::Null, "texture 0: a texture without a PNG or JPEG of its own"),
        ("/textures/0", json!({}), "texture 0: a texture without a PNG or JPEG of its own"),
        ("/images/0/bufferView", json!(4), "buffer view 4: is named, but there are only 4"),
        ("/images/0/bufferView", Value::Null, "image 0: has no buffer view"),
        ("/images/0/bufferView", json!(0), "image 0: "), // positions are no picture
        ("/bufferViews/3/byteLength", json!(1 << 30), "do not fit into a buffer of"),
        ("/bufferViews/3/byteLength", json!(20), "image 0: "),
        // names of files are only names until the mesh is opened
        ("/images/0/uri", json!("../../etc/passwd"), "read, texture true"),
        ("/images/0/uri", json!("data:image/png;base64,AAAA"), "image 0: "),
        ("/images/0/uri", json!("data:image/png;base64,?"), "image 0: its data URI is not Base64"),
    ];
    for (pointer, value, expected) in cases {
        let mut d = d.clone();
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        match d.pointer_mut(parent).unwrap_or_else(|| panic!("{pointer}")) {
            Value::Array(items) => items[key.parse::<usize>().unwrap()] = value,
            other => other[key] = value,
        }
        let bytes = glb(&d, &bin);
        let found = whole_message(&bytes);
        assert!(found.contains(expected), "{pointer}: expected {expected:?}, found {found:?}");
        // who wants the surface alone does not care
        if expected != "the JSON chunk" && !pointer.starts_with("/bufferViews/2") {
            assert!(read(&bytes, Path::new("a")).is_ok(), "{pointer}");
        }
    }
}

#[test]
fn texture_coordinates_that_are_not_numbers_are_refused_in_every_format() {
    for bad in [f32::NAN, f32::INFINITY] {
        let mut uvs = UVS;
        uvs[2][1] = bad;
        let (d, bin) = textured(&png(1, 1), uvs);
        assert!(whole_message(&glb(&d, &bin)).contains("accessor 2: element 2 is"));
    }
    let obj =
        |vt: &str, f: &str| whole_message(format!("v 0 0 0\nv 1 0 0\nv 0 1 0\n{vt}\nf {f}\n").as_bytes());
    assert!(obj("vt nan 0", "1 2 3").contains("`bad`, line 4: `nan` is not a finite number"));
    assert!(obj("vt 0", "1 2 3").contains("1 numbers, expected u v"));
    assert!(obj("vt 0 0", "1/2 2/1 3/1").contains("index `2`, but there are 1 texture coordinates so far"));
    assert!(obj("vt 0 0", "1/0 2/1 3/1").contains("index `0`"));
    assert_eq!(obj("vt 0 0", "1/1 2/1 3/-1"), "read, texture false");
    let header = "format ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                  property float s\nproperty float t\nelement face 1\n\
                  property list uchar int vertex_indices\n";
    let bytes = ply_of(header, b"0 0 0 0 0\n1 0 0 0 nan\n0 1 0 0 0\n3 0 1 2\n");
    assert!(whole_message(&bytes).contains("vertex 1: its texture coordinate is not finite"));
    assert!(read(&bytes, Path::new("a")).is_ok());
}

#[test]
fn pictures_that_claim_too_much_are_refused_before_they_are_decoded() {
    // a side above the limit; an area above it
    for (width, height) in [(1_000_000, 1), (u32::MAX, u32::MAX), (16_384, 200_000)] {
        let (d, bin) = textured(&png(width, height), UVS);
        let found = whole_message(&glb(&d, &bin));
        assert!(found.contains("`bad`, image 0: ") && found.contains("longest side"), "{found}");
    }
    // within the limits but more than 13 bytes can hold: named when it is decoded
    let (d, bin) = textured(&png(16_384, 16_384), UVS);
    let whole = read_whole(&glb(&d, &bin), Path::new("a")).unwrap();
    let Some(PictureSource::Inside(bytes)) = whole.picture else { panic!("no picture") };
    let e = tiface::io::parse_photo(&bytes, Path::new("a"), &tiface::io::Limits::default()).unwrap_err();
    assert!(e.to_string().contains("cannot come from"), "{e}");
}

#[test]
fn names_of_textures_never_leave_the_folder() {
    let dir = tempfile::tempdir().unwrap();
    let inside = dir.path().join("mesh");
    std::fs::create_dir(&inside).unwrap();
    let picture = png(1, 1);
    // what must not be opened would be read
    std::fs::write(dir.path().join("a.png"), &picture).unwrap();
    std::fs::write(dir.path().join("a.mtl"), "newmtl a\nmap_Kd a.png\n").unwrap();
    std::fs::write(inside.join("good.mtl"), "newmtl a\nKd 1 1 1\n").unwrap();
    let above = dir.path().display().to_string();
    let problem = |name: &str, text: String| {
        std::fs::write(inside.join(name), text).unwrap();
        open_mesh(&inside.join("head.obj")).unwrap().texture_problem.unwrap_or_default()
    };
    for name in
        ["../a", "..\\a", &format!("{above}/a"), "x/../../a", "http://example.com/a", "c:a", "..", "/", ""]
    {
        let obj = |mtl: &str| format!("mtllib {mtl}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n");
        let found = problem("head.obj", obj(&format!("{name}.mtl")));
        assert!(found.contains("which is not there"), "{name}: {found}");
        problem("head.obj", obj("good.mtl"));
        let found = problem("good.mtl", format!("newmtl a\nmap_Kd \"{name}.png\"\n"));
        assert!(found.contains("which is not there"), "{name}: {found}");
        std::fs::remove_file(inside.join("head.obj")).unwrap();
    }
}

#[test]
fn several_materials_have_no_single_atlas() {
    let (mut d, bin) = textured(&png(1, 1), UVS);
    let primitive = d["meshes"][0]["primitives"][0].clone();
    d["meshes"][0]["primitives"].as_array_mut().unwrap().push(primitive);
    assert_eq!(whole_message(&glb(&d, &bin)), "read, texture true"); // one texture, twice
    d["meshes"][0]["primitives"][1]["material"] = Value::Null;
    assert!(whole_message(&glb(&d, &bin)).contains("a mesh with several base colors is not supported"));
    let obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\nusemtl b\nf 1 2 3\nusemtl b\nf 1 2 3\n";
    let found = read_whole(obj.as_bytes(), Path::new("a")).unwrap();
    assert_eq!(found.materials, [(0, "a".to_owned()), (1, "b".to_owned())]);
}

#[test]
fn a_bent_byte_in_a_textured_file_is_survived() {
    let mesh = tetrahedron();
    let uvs = (0..12).map(|i| glam::Vec2::new((i % 4) as f32 / 4.0, (i / 4) as f32 / 4.0)).collect();
    let triangles = (0..4).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    let atlas = Atlas { uvs, triangles, width: 2, height: 2 };
    let color = Photo { width: 2, height: 2, rgb: vec![[9, 8, 7]; 4], alpha: None };
    let texture = HeadTexture::new(atlas, color);
    let written = files(&mesh, Some(&texture), &ExportOptions::default());
    for (bytes, knows_its_length) in written.iter().zip([true, false, false]).chain([(&quantized(), true)]) {
        assert!(read_whole(bytes, Path::new("a")).unwrap().atlas.is_some());
        for at in 0..bytes.len() {
            for value in [0x00, 0xff, b'9', b'-', bytes[at] ^ 0x80, bytes[at].wrapping_add(1)] {
                let mut bent = bytes.clone();
                bent[at] = value;
                let Ok(found) = read_whole(&bent, Path::new("a")) else { continue };
                let Some(atlas) = found.atlas else { continue };
                assert_eq!(atlas.triangles.len(), found.mesh.triangles.len());
                assert!(atlas.uvs.iter().all(|uv| uv.is_finite()));
                let count = atlas.uvs.len() as u32;
                assert!(atlas.triangles.iter().flatten().all(|&i| i < count));
            }
            assert!(at == 0 || !knows_its_length || read_whole(&bytes[..at], Path::new("a")).is_err());
        }
    }
}

fn ply_of(header: &str, body: &[u8]) -> Vec<u8> {
    [b"ply\n", header.as_bytes(), b"end_header\n", body].concat()
}

#[test]
fn crooked_plys_are_named_errors() {
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    let list = "property list uchar int vertex_indices\n";
    let ascii = |v: &str, f: &str, body: &str| {
        ply_of(
            &format!("format ascii 1.0\nelement vertex {v}\n{xyz}element face {f}\n{list}"),
            body.as_bytes(),
        )
    };
    let binary = |v: &str, f: &str, body: &[u8]| {
        ply_of(
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
        (ply_of("format ascii 2.0\nelement vertex 99\n", b""), "element `vertex`: has no properties"),
        (ply_of("format telepathy 1.0\n", b""), "format `telepathy` is unknown"),
        (ply_of("element vertex 1\nproperty quad x\n", b""), "type `quad` is unknown"),
        (ply_of("property float x\n", b""), "a property before any element"),
        (ply_of("hello\n", b""), "header line 2: `hello` is not understood"),
        (ply_of("", b""), "there was no `format`"),
        (b"ply\nformat ascii 1.0".to_vec(), "the header has no end"),
        (ply_of("format ascii 1.0\nelement vertex 0\nproperty float x\n", b""), "has no x, y, z"),
        (
            ply_of(
                &format!("format ascii 1.0\nelement vertex 1\n{xyz}element vertex 1\n{xyz}"),
                b"0 0 0 0 0 0",
            ),
            "element `vertex`: comes twice",
        ),
        (
            ply_of(&format!("format ascii 1.0\nelement tristrips 1\n{list}"), b"3 0 1 2"),
            "triangle 0: index 0, but there are 0 vertices",
        ),
        (
            ply_of(&format!("format ascii 1.0\nelement tristrips 1\n{list}"), b"3 0 1 -2"),
            "strip 0: index -2, expected a whole number from −1",
        ),
    ];
    for (bytes, expected) in cases {
        let found = message(&bytes);
        assert!(found.contains(expected), "expected {expected:?}, found {found:?}");
    }
}

#[test]
fn a_ply_is_read_whatever_ends_its_lines() {
    let header = |format: &str| {
        format!(
            "ply\nformat {format} 1.0\ncomment c\nelement vertex 3\nproperty float x\nproperty float y\n\
             property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        )
    };
    // its first byte is a line feed
    let x = f32::from_bits(0x3f80_000a);
    let mut body: Vec<u8> =
        [x, 0., 0., 1., 2., 0., 0., 1., 3.].iter().flat_map(|v| v.to_le_bytes()).collect();
    body.extend([3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    for ending in ["\n", "\r\n", "\r"] {
        let text = header("ascii") + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
        let mesh = read(text.replace('\n', ending).as_bytes(), Path::new("a")).unwrap();
        assert_eq!((mesh.positions[1], &mesh.triangles[..]), (Vec3::X, &[[0, 1, 2]][..]));
        let binary =
            [header("binary_little_endian").replace('\n', ending).into_bytes(), body.clone()].concat();
        let mesh = read(&binary, Path::new("a")).unwrap();
        assert_eq!((mesh.positions[0].x, mesh.positions[2].z), (x, 3.0), "{ending:?}");
    }
}

#[test]
fn triangle_strips_of_a_ply_are_cut_into_triangles() {
    let bytes = ply_of(
        "format ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n\
         element tristrips 1\nproperty list int int vertex_indices\n",
        b"0 0 0  1 0 0  0 1 0  1 1 0  0 2 0\n11 0 1 2 3 -1 2 3 3 4 -1 0\n",
    );
    // 0 1 2, then 2 1 3 the other way round; then 2 3 3 and 3 3 4, which are none; a lone corner is
    // none either
    assert_eq!(read(&bytes, Path::new("a")).unwrap().triangles, [[0, 1, 2], [2, 1, 3]]);
}

#[test]
fn restarts_and_repeated_corners_of_strips_are_no_triangles() {
    // 100 × "0 1 2 −1 2 2 2 −1": eight values and one triangle each
    let strip = " 0 1 2 -1 2 2 2 -1".repeat(100);
    let bytes = ply_of(
        "format ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
         element tristrips 1\nproperty list int int vertex_indices\n",
        format!("0 0 0  1 0 0  0 1 0\n800{strip}\n").as_bytes(),
    );
    let most = |triangles| {
        let limits = ReadOptions { triangles, ..ReadOptions::default() };
        read_with(&bytes, Path::new("a"), &limits)
    };
    assert_eq!(most(100).unwrap().mesh.triangles.len(), 100);
    assert_eq!(most(99).unwrap_err().to_string(), "`a` has more than 99 triangles");
}

#[test]
fn advice_fits_the_format() {
    let hint = |bytes: &[u8]| read_whole(bytes, Path::new("a")).unwrap_err().hint().to_owned();
    let glb = with("/accessors/0/count", json!(5));
    let (obj, ply) = (&b"v 0 0 0\nf 1 2 3\n"[..], &b"ply\nformat telepathy 1.0\n"[..]);
    assert!(hint(&glb).contains("Khronos"));
    for text in [obj, ply] {
        assert!(!hint(text).contains("GLB") && !hint(text).contains("Khronos"), "{}", hint(text));
    }
    let header = "format ascii 1.0\ncomment TextureFile a.png\ncomment TextureFile b.png\nelement vertex 3\n\
                  property float x\nproperty float y\nproperty float z\nelement face 1\n\
                  property list uchar int vertex_indices\n";
    let several = &ply_of(header, b"0 0 0 1 0 0 0 1 0\n3 0 1 2\n");
    assert!(hint(several).contains("one texture") && !hint(several).contains("compression"));
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
            .map(|(format, body)| read(&ply_of(&header(format), body), Path::new("a")).unwrap())
            .collect();
    assert_eq!(meshes[0].triangles, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(meshes[0].colors[0], [1.0, 0.2, 0.5]);
    assert!(meshes[0] == meshes[1] && meshes[1] == meshes[2]);
}

#[test]
fn a_file_cut_at_any_byte_is_an_error_or_a_smaller_mesh_but_never_a_panic() {
    let (mesh, options) = (tetrahedron(), ExportOptions::default());
    for bytes in &files(&mesh, None, &options) {
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
    for bytes in files(&mesh, None, &options) {
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

/// The whole report of a file, as `tiface check` makes it. Nothing here takes more than a second or
/// two.
fn report(bytes: &[u8]) -> CheckReport {
    let begin = std::time::Instant::now();
    let whole = read_whole(bytes, Path::new("a")).unwrap();
    let uv =
        whole.atlas.map(|atlas| uv_check(&weld(&whole.mesh), &Atlas { width: 1024, height: 1024, ..atlas }));
    let report = CheckReport { uv, ..check_around(&whole.mesh, whole.origin, 1.0) };
    assert!(begin.elapsed().as_secs() < 120, "{:?}", begin.elapsed());
    report
}

#[test]
fn quads_that_each_show_the_whole_texture_are_counted_not_waited_for() {
    let n = 64;
    let mut obj = String::from("vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n");
    (0..=n).for_each(|i| (0..=n).for_each(|j| obj += &format!("v {i} {j} 0\n")));
    let v = |i: usize, j: usize| i * (n + 1) + j + 1;
    for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))) {
        let [a, b, c, d] = [v(i, j), v(i + 1, j), v(i + 1, j + 1), v(i, j + 1)];
        obj += &format!("f {a}/1 {b}/2 {c}/3 {d}/4\n");
    }
    let r = report(obj.as_bytes());
    let uv = r.uv.as_ref().unwrap();
    // every triangle lies on 4,095 others: 8 million pairs, of which some are measured
    assert_eq!((r.triangles, uv.overlapping, uv.chart_distance_px), (8192, 8192, Some(0.0)));
    assert!(uv.overlaps_left > 7000 && !uv.is_sound());
    assert_eq!((uv.chart_distance_left, r.self_intersections, r.self_intersections_left), (0, 0, 0));
    let text = r.require(&["sound-uv"]).unwrap_err().to_string() + &uv.to_string();
    assert!(text.matches("at least 8192 triangles").count() == 2 && text.contains("not compared further"));
    assert!(r.require(&["no-self-intersections"]).is_ok());
}

#[test]
fn thousands_of_parallel_slivers_are_counted_not_waited_for() {
    let mut obj = String::new();
    for k in 0..8000 {
        // along a diagonal, in space and in the texture, so that all boxes meet and no two
        // triangles do
        let e = f64::from(k) / 800_000.0;
        let (x, y) = (1.0 + e, 1.0 - e);
        obj += &format!("v {e} {} {e}\nv {x} {y} {x}\nv {} {} {x}\n", -e, x + 1e-7, y - 1e-7);
        obj += &format!("vt {e} 0\nvt {} 1\nvt {} 1\n", 0.9 + e, 0.9 + e + 1e-6);
        let a = 3 * k + 1;
        obj += &format!("f {a}/{a} {}/{} {}/{}\n", a + 1, a + 1, a + 2, a + 2);
    }
    let r = report(obj.as_bytes());
    let uv = r.uv.as_ref().unwrap();
    assert!(r.self_intersections_left > 1000 && uv.chart_distance_left > 1000, "{r}\n{uv}");
    // none was found, but the search was not complete
    let text = r.require(&["no-self-intersections"]).unwrap_err().to_string();
    assert!(text.contains("not compared further"), "{text}");
    assert!(uv.to_string().contains("at most 0.") && r.to_string().contains("at least "), "{r}\n{uv}");
}

#[test]
fn a_shape_shown_many_times_in_one_place_is_looked_at_once() {
    let mut d = document();
    let primitive = d["meshes"][0]["primitives"][0].clone();
    d["meshes"][0]["primitives"] = json!(vec![primitive; 100]);
    d["nodes"] = json!(vec![json!({"mesh": 0}); 100]);
    d["scenes"][0]["nodes"] = json!((0..100).collect::<Vec<_>>());
    let r = report(&glb(&d, &bin()));
    assert_eq!((r.triangles, r.self_intersections, r.self_intersections_left), (40_000, 40_000, 0));
    // the same a little beside itself each time
    for (k, node) in d["nodes"].as_array_mut().unwrap().iter_mut().enumerate() {
        node["translation"] = json!([1e-5 * k as f64, 1e-5 * k as f64, 1e-5 * k as f64]);
    }
    let r = report(&glb(&d, &bin()));
    assert_eq!(r.self_intersections, 40_000);
}

#[test]
fn an_edge_of_many_triangles_with_coordinates_of_their_own_is_no_more_work_than_others() {
    let n = 50_000;
    let mut obj = String::from("v 0 0 0\nv 0 0 1\n");
    for k in 0..n {
        let (x, u) = (f64::from(k), f64::from(k) / f64::from(n));
        obj += &format!("v {} {} 0.5\nvt {u} 0\nvt {u} 1\nvt {} 0.5\n", x.cos(), x.sin(), u + 1e-5);
    }
    for k in 0..n {
        obj += &format!("f 1/{} 2/{} {}/{}\n", 3 * k + 1, 3 * k + 2, k + 3, 3 * k + 3);
    }
    let r = report(obj.as_bytes());
    assert_eq!((r.nonmanifold_edges, r.uv.unwrap().charts), (1, n as usize));
}

/// A closed ball of 0.25 m, without its poles' many corners: 24 × 12 quads a side.
fn ball() -> (Mesh, Atlas) {
    let (across, down) = (48u32, 24u32);
    let at = |i: u32, j: u32| {
        let (a, b) =
            (i as f32 / across as f32 * std::f32::consts::TAU, j as f32 / down as f32 * std::f32::consts::PI);
        0.125 * Vec3::new(b.sin() * a.cos(), b.sin() * a.sin(), b.cos())
    };
    let mut mesh = Mesh { positions: vec![at(0, 0), at(0, down)], ..Mesh::default() };
    mesh.positions.extend((0..across * (down - 1)).map(|k| at(k % across, 1 + k / across)));
    let ring = |i: u32, j: u32| 2 + (j - 1) * across + i % across;
    for i in 0..across {
        mesh.triangles.push([0, ring(i, 1), ring(i + 1, 1)]);
        mesh.triangles.push([1, ring(i + 1, down - 1), ring(i, down - 1)]);
        for j in 1..down - 1 {
            let [a, b, c, d] = [ring(i, j), ring(i + 1, j), ring(i + 1, j + 1), ring(i, j + 1)];
            mesh.triangles.extend([[a, d, c], [a, c, b]]);
        }
    }
    mesh.normals = mesh.positions.iter().map(|p| p.normalize()).collect();
    let uvs = vec![glam::Vec2::ZERO, glam::Vec2::X, glam::Vec2::Y];
    let atlas = Atlas { uvs, triangles: vec![[0, 1, 2]; mesh.triangles.len()], width: 2, height: 2 };
    (mesh, atlas)
}

/// A thousand and ten thousand kilometers from the origin, where f32 has steps of 6 cm and a meter.
#[test]
fn a_head_far_from_the_origin_is_watertight_in_every_format() {
    let (mesh, atlas) = ball();
    let near = check(&mesh, 1.0);
    assert!(near.closed && near.self_intersections == 0);
    let color = Photo { width: 2, height: 2, rgb: vec![[9, 8, 7]; 4], alpha: None };
    let texture = HeadTexture::new(atlas, color);
    for away in [DVec3::new(1e6, -1e6, 1e6), DVec3::new(0.0, 1e7, 3e6)] {
        let place = Similarity::scale_translate(1.0, away);
        let options = ExportOptions { world_from_mesh: place, ..ExportOptions::default() };
        let written = [files(&mesh, None, &options), files(&mesh, Some(&texture), &options)].concat();
        for (k, bytes) in written.iter().enumerate() {
            for options in [ReadOptions::SURFACE, ReadOptions::default()] {
                let found = read_with(bytes, Path::new("a"), &options).unwrap();
                let r = check_around(&found.mesh, found.origin, 1.0);
                let same = |r: &CheckReport| (r.closed, r.manifold, r.welded_vertices, r.euler, r.degenerate);
                assert_eq!(same(&r), same(&near), "{away} file {k}");
                assert_eq!(r.self_intersections, 0, "{away} file {k}");
                let [found, expected] = [r.volume_l, near.volume_l].map(Option::unwrap);
                assert!((found / expected - 1.0).abs() < 1e-3, "{away} file {k}: {found}");
                for axis in 0..3 {
                    let expected = away[axis] + near.min[axis];
                    assert!((r.min[axis] - expected).abs() < 1e-5, "{away} file {k}: {:?}", r.min);
                }
            }
        }
    }
}

/// Loose vertices may be anywhere: only what is shown says where a mesh is.
#[test]
fn a_loose_vertex_does_not_move_the_origin_of_a_far_mesh() {
    let obj = "v 0 0 0\nv 1e7 1e7 1e7\nv 10000000.125 1e7 1e7\nv 1e7 10000000.125 1e7\nf 2 3 4\n";
    let found = read_whole(obj.as_bytes(), Path::new("a")).unwrap();
    let [a, b, _] = found.mesh.corners(0);
    assert_eq!((b - a, found.origin), (0.125 * Vec3::X, DVec3::splat(1e7)));
    // near the origin nothing moves
    let found =
        read_whole(&files(&tetrahedron(), None, &ExportOptions::default())[1], Path::new("a")).unwrap();
    assert_eq!((found.origin, found.mesh.positions), (DVec3::ZERO, tetrahedron().positions));
}

#[test]
fn what_is_no_mesh_at_all_is_said_so() {
    for bytes in [&b""[..], b"\0\0\0\0", b"hello world", b"{\"a\": {}}", &[0xff; 64]] {
        let e = read(bytes, Path::new("a")).unwrap_err();
        assert_eq!(e.to_string(), "`a` is neither GLB, PLY, OBJ nor STL");
    }
    assert_eq!(message(b""), "`bad` is neither GLB, PLY, OBJ nor STL");
}

#[test]
fn the_scans_of_the_captures_are_read() {
    for (capture, vertices, triangles) in [("lps", 139_894, 280_000), ("nefertiti", 10_000, 19_482)] {
        let Some(path) = clicked::folder(capture).map(|folder| folder.join("gt.ply")) else { continue };
        let bytes = std::fs::read(&path).unwrap();
        let mesh = read(&bytes, &path).unwrap();
        assert_eq!(
            (mesh.positions.len(), mesh.normals.len(), mesh.triangles.len()),
            (vertices, vertices, triangles)
        );
        eprintln!("{capture}\n{}", check(&mesh, 1.0));
    }
}
