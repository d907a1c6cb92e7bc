//! Meshes as other programs write them: `check` and `preview` give one answer, and say why a color
//! is not shown.

use crate::command::{code, err, out, said, tiface, worked};
use crate::tiny;
use serde_json::{Value, json};
use std::path::Path;

/// A color that no light and no clamping makes.
const SKIN: [u8; 3] = [200, 100, 50];

/// Corners, texture coordinates and faces of a tetrahedron.
const CORNERS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
const FACES: [[usize; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

/// An OBJ with texture coordinates, behind these lines.
fn obj(head: &str) -> String {
    let mut text = head.to_owned();
    CORNERS.iter().for_each(|[x, y, z]| text += &format!("v {x} {y} {z}\n"));
    text += "vt 0.1 0.1\nvt 0.9 0.1\nvt 0.1 0.9\nvt 0.9 0.9\n";
    for [a, b, c] in FACES.map(|f| f.map(|v| v + 1)) {
        text += &format!("f {a}/{a} {b}/{b} {c}/{c}\n");
    }
    text
}

/// A PLY with more properties of vertices and faces, and their values.
fn ply(comments: &str, vertex: [&str; 2], face: [&str; 2]) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\n{comments}element vertex 4\nproperty float x\nproperty float y\nproperty float z\n{}\
         element face 4\nproperty list uchar int vertex_indices\n{}end_header\n",
        vertex[0], face[0]
    );
    CORNERS.iter().for_each(|[x, y, z]| text += &format!("{x} {y} {z} {}\n", vertex[1]));
    FACES.iter().for_each(|[a, b, c]| text += &format!("3 {a} {b} {c} {}\n", face[1]));
    text
}

/// A picture of one color.
fn picture() -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::RgbImage::from_pixel(4, 4, image::Rgb(SKIN))
        .write_to(&mut bytes, image::ImageFormat::Png)
        .unwrap();
    bytes.into_inner()
}

/// A folder with these files.
fn folder(files: &[(&str, &[u8])]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        let path = dir.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    dir
}

/// What `check` and `preview` say of a mesh, and its picture.
struct Shown {
    check: Value,
    preview: String,
    seen: image::RgbaImage,
}

fn shown(dir: &Path, name: &str) -> Shown {
    let check = out_of(&tiface(dir, &["check", name, "--json"]));
    let preview = tiface(dir, &["preview", name, "--size", "48", "--out", "seen.png"]);
    let preview = worked(&preview);
    let seen = image::load_from_memory(&std::fs::read(dir.join("seen.png")).unwrap()).unwrap().into_rgba8();
    Shown { check: serde_json::from_str(&check).unwrap(), preview, seen }
}

fn out_of(output: &std::process::Output) -> String {
    assert_eq!(code(output), 0, "{}", said(output));
    out(output)
}

impl Shown {
    /// Returns whether all that is opaque has one color, within a few steps.
    fn is(&self, color: [u8; 3]) -> bool {
        let mut opaque = self.seen.pixels().filter(|p| p.0[3] == 255).peekable();
        opaque.peek().is_some() && opaque.all(|p| (0..3).all(|k| p.0[k].abs_diff(color[k]) < 4))
    }

    /// Returns whether both commands say this.
    fn says(&self, text: &str) -> bool {
        let check = format!("{} {}", self.check["texture_problem"], self.check["notes"]);
        check.contains(text) && self.preview.contains(text)
    }

    fn has_texture(&self) -> bool {
        self.check["has_texture"] == true && self.check["texture_problem"].is_null()
    }
}

impl std::fmt::Debug for Shown {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}\n{}\n{:?}", self.check, self.preview, self.seen.get_pixel(24, 27))
    }
}

#[test]
fn a_texture_is_shown_whatever_stands_around_its_name() {
    let materials = "newmtl skin 1\nKd 1 1 1\n";
    for (library, mtl, map, file) in [
        ("\"my head.mtl\"", "my head.mtl", "map_Kd \"my head.png\"", "my head.png"),
        ("my head.mtl", "my head.mtl", "map_Kd my head.png", "my head.png"),
        ("./a.mtl", "a.mtl", "map_kd a.png", "a.png"),
        ("a.mtl", "a.mtl", "map_Kd -s 1 1 1 -clamp on -bm 0.5 a b.png", "a b.png"),
        ("a.mtl", "a.mtl", "map_Kd textures/a.png", "textures/a.png"),
        ("a.mtl", "a.mtl", "map_Kd ..\\textures\\a.png", "textures/a.png"),
        ("a.mtl", "a.mtl", "map_Kd textures\\a.png", "textures/a.png"),
        ("C:\\scans\\a.mtl", "a.mtl", "map_Kd \"C:\\Users\\me\\my scans\\a.png\"", "a.png"),
        ("a.mtl", "a.mtl", "map_Kd /home/me/textures/a.png", "a.png"),
        ("a.mtl", "a.mtl", "map_Kd Head.PNG", "head.png"),
        ("materials/a.mtl", "materials/a.mtl", "map_Kd a.png", "materials/a.png"),
        ("a.mtl", "a.mtl", "map_Ke a.png", "a.png"),
    ] {
        let text = obj(&format!("mtllib {library}\nusemtl \"skin 1\"\n"));
        let materials = format!("{materials}{map}\n");
        let dir = folder(&[("h.obj", text.as_bytes()), (mtl, materials.as_bytes()), (file, &picture())]);
        let found = shown(dir.path(), "h.obj");
        assert!(found.has_texture() && found.is(SKIN), "{library} {map}: {found:?}");
        // a file that is taken for another is told
        let is_other = map.contains(['\\', '/']) && !map.ends_with(" textures/a.png") || map.contains("Head");
        assert_eq!(
            found.says("in its folder is taken"),
            is_other || library.contains('\\'),
            "{map}: {found:?}"
        );
    }
}

#[test]
fn a_picture_that_is_not_there_is_no_texture() {
    let dir =
        folder(&[("h.obj", obj("mtllib h.mtl\n").as_bytes()), ("h.mtl", b"newmtl a\nmap_Kd tex.jpg\n")]);
    let found = shown(dir.path(), "h.obj");
    assert!(found.says("tex.jpg") && found.says("which is not there"), "{found:?}");
    assert!(found.check["has_texture"] == false && found.check["uv"].is_object(), "{found:?}");
    let text = out_of(&tiface(dir.path(), &["check", "h.obj"]));
    assert!(text.contains("colors               NO\n") && text.contains("NOT SHOWN"), "{text}");
    // a torn picture is none, too
    std::fs::write(dir.path().join("tex.jpg"), "torn").unwrap();
    let found = shown(dir.path(), "h.obj");
    assert!(found.says("tex.jpg") && found.check["has_texture"] == false, "{found:?}");
    // as files of OBJ and PLY that name what is not there
    std::fs::write(dir.path().join("p.ply"), ply("comment TextureFile no.png\n", [ST, "0 0"], ["", ""]))
        .unwrap();
    assert!(shown(dir.path(), "p.ply").says("no.png"));
}

#[test]
fn metrics_say_of_a_mesh_what_check_says() {
    let dir =
        folder(&[("h.obj", obj("mtllib h.mtl\n").as_bytes()), ("h.mtl", b"newmtl a\nmap_Kd tex.jpg\n")]);
    tiny::capture(dir.path());
    let words = ["metrics", "head", "--mesh", "h.obj", "--out", "judged/"];
    let text = worked(&tiny::tiface(dir.path(), &words).output().unwrap());
    assert!(text.contains("tex.jpg") && text.contains("which is not there"), "{text}");
}

#[test]
fn colors_that_count_to_255_are_not_white() {
    let colored = |rgb: &str| {
        let text = obj("");
        let lines = text.lines().map(|line| match line.starts_with("v ") {
            true => format!("{line} {rgb}\n"),
            false => format!("{line}\n"),
        });
        folder(&[("h.obj", lines.collect::<String>().as_bytes())])
    };
    let found = shown(colored("200 100 50").path(), "h.obj");
    assert!(found.is(SKIN) && found.says("divided by 255"), "{found:?}");
    // in range nothing is said
    let found = shown(colored("0.7843 0.3922 0.1961").path(), "h.obj");
    assert!(found.is(SKIN) && found.check["notes"].is_null(), "{found:?}");
    let found = shown(colored("0.7843 0.3922 0.1961 0.5").path(), "h.obj");
    assert!(found.is(SKIN) && found.says("alpha"), "{found:?}");
}

#[test]
fn colors_of_zbrush_in_comments_are_shown() {
    let paint = format!("#MRGB {}\n", "ffc86432".repeat(4));
    let found = shown(folder(&[("h.obj", (obj("") + &paint).as_bytes())]).path(), "h.obj");
    assert!(found.is(SKIN), "{found:?}");
    let few = format!("#MRGB {}\n", "ffc86432".repeat(3));
    let found = shown(folder(&[("h.obj", (obj("") + &few).as_bytes())]).path(), "h.obj");
    assert!(found.says("`#MRGB` is not shown: it has 3 colors for 4 vertices"), "{found:?}");
}

#[test]
fn a_byte_order_mark_hides_no_vertex_and_no_material() {
    let text = format!("\u{feff}{}", obj("").replace("vt ", "mtllib a.mtl\nvt "));
    let mtl = b"\xef\xbb\xbfnewmtl a\nmap_Kd a.png\n";
    let ply = format!("\u{feff}{}", ply("comment TextureFile a.png\n", [ST, "0.5 0.5"], ["", ""]));
    let (text, ply) = (text.as_bytes(), ply.as_bytes());
    let dir = folder(&[("h.obj", text), ("a.mtl", mtl), ("a.png", &picture()), ("p.ply", ply)]);
    for name in ["h.obj", "p.ply"] {
        let found = shown(dir.path(), name);
        assert!(found.check["vertices"] == 4 && found.has_texture() && found.is(SKIN), "{name} {found:?}");
    }
    // as carriage returns alone hide no line
    let returns = |text: &[u8]| String::from_utf8_lossy(text).replace('\n', "\r").into_bytes();
    let dir = folder(&[("h.obj", &returns(text)), ("a.mtl", &returns(mtl)), ("a.png", &picture())]);
    let found = shown(dir.path(), "h.obj");
    assert!(found.check["vertices"] == 4 && found.has_texture() && found.is(SKIN), "{found:?}");
    let wide: Vec<u8> = obj("").encode_utf16().flat_map(u16::to_le_bytes).collect();
    let wide = [&[0xff, 0xfe][..], &wide].concat();
    let dir = folder(&[("h.obj", &wide), ("t.obj", obj("mtllib t.mtl\n").as_bytes()), ("t.mtl", &wide)]);
    let o = tiface(dir.path(), &["check", "h.obj"]);
    assert!(code(&o) == 1 && err(&o).contains("UTF-16"), "{}", err(&o));
    assert!(shown(dir.path(), "t.obj").says("`t.mtl`, byte 0: text in UTF-16"));
}

#[test]
fn the_color_of_materials_is_shown_if_it_is_one() {
    let mtl = b"newmtl skin\nKd 0.7843 0.3922 0.1961\nd 0.5\nnewmtl eye\nKd 0.1 0.1 0.9\nnewmtl grey\nKd 0.8 0.8 0.8\n";
    let dir =
        |used: &str| folder(&[("h.obj", obj(&format!("mtllib a.mtl\n{used}")).as_bytes()), ("a.mtl", mtl)]);
    let found = shown(dir("usemtl skin\n").path(), "h.obj");
    assert!(
        found.is(SKIN) && found.says("`Kd`") && found.says("`d` makes the material `skin` transparent"),
        "{found:?}"
    );
    // gray is what programs write of a mesh without color
    let found = shown(dir("usemtl grey\n").path(), "h.obj");
    assert!(found.check["has_colors"] == false, "{found:?}");
}

#[test]
fn several_materials_with_one_picture_have_one_texture() {
    let text = obj("mtllib a.mtl\nusemtl a\n").replace("f 1/1 4/4 3/3", "usemtl b\nf 1/1 4/4 3/3");
    let mtl =
        |second: &str| format!("newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd {second}\nnewmtl c\nmap_Kd c.png\n");
    let one = mtl("a.png");
    let dir = folder(&[("h.obj", text.as_bytes()), ("a.mtl", one.as_bytes()), ("a.png", &picture())]);
    let found = shown(dir.path(), "h.obj");
    assert!(found.has_texture() && found.is(SKIN), "{found:?}");
    // of two pictures both are named
    std::fs::write(dir.path().join("a.mtl"), mtl("b.png")).unwrap();
    let found = shown(dir.path(), "h.obj");
    assert!(found.says("`a.png` and `b.png`") && found.check["has_texture"] == false, "{found:?}");
}

const ST: &str = "property float s\nproperty float t\n";

/// Properties of three names and a type.
fn color(kind: &str, names: [&str; 3]) -> String {
    names.map(|name| format!("property {kind} {name}\n")).concat()
}

#[test]
fn colors_of_a_ply_are_known_by_their_names_and_their_range() {
    let plain = ["red", "green", "blue"];
    let diffuse = ["diffuse_red", "diffuse_green", "diffuse_blue"];
    let alpha = "property uchar alpha\n";
    for (properties, values, note) in [
        (color("uchar", plain), "200 100 50", ""),
        (color("uchar", diffuse), "200 100 50", ""),
        (color("uchar", ["r", "g", "b"]), "200 100 50", ""),
        (color("uchar", ["Red", "Green", "Blue"]), "200 100 50", ""),
        (color("uchar", ["ambient_red", "ambient_green", "ambient_blue"]), "200 100 50", ""),
        // 0x00C86432, also behind an alpha of 255, and as the bits of a float
        ("property uint rgb\n".into(), "13132850", ""),
        ("property uint rgba\n".into(), "4291322930", ""),
        ("property int rgb\n".into(), "-3644366", ""),
        ("property float rgb\n".into(), "1.8403042e-38", ""),
        (color("float", plain), "0.7843 0.3922 0.1961", ""),
        (color("float", plain), "200 100 50", "divided by 255"),
        (color("int", diffuse), "200 100 50", "divided by 255"),
        (color("ushort", plain), "51400 25700 12850", ""),
        (color("uchar", plain) + alpha, "200 100 50 255", ""),
        (color("uchar", plain) + alpha, "200 100 50 51", "alpha down to 0.20"),
    ] {
        let text = ply("", [&properties, values], ["", ""]);
        let found = shown(folder(&[("h.ply", text.as_bytes())]).path(), "h.ply");
        assert!(found.is(SKIN) && found.check["has_colors"] == true, "{properties}{values}: {found:?}");
        assert!(if note.is_empty() { found.check["notes"].is_null() } else { found.says(note) }, "{found:?}");
    }
    let text = ply("", ["", ""], [&color("uchar", plain), "200 100 50"]);
    let found = shown(folder(&[("h.ply", text.as_bytes())]).path(), "h.ply");
    assert!(found.is(SKIN) && found.says("faces have colors"), "{found:?}");
}

#[test]
fn texture_coordinates_of_a_ply_stand_at_vertices_or_at_corners() {
    let one = "comment TextureFile \"my tex.png\"\n";
    let two = "comment TextureFile other.png\ncomment TextureFile my tex.png\n";
    let wedge = "property list uchar float texcoord\n";
    let paged = format!("{wedge}property int texnumber\n");
    for (comments, vertex, face) in [
        (one, [ST, "0.1 0.9"], ["", ""]),
        (one, ["property float u\nproperty float v\n", "0.1 0.9"], ["", ""]),
        (one, ["property float texture_u\nproperty float texture_v\n", "0.1 0.9"], ["", ""]),
        (one, ["", ""], [wedge, "6 0.1 0.1 0.9 0.1 0.1 0.9"]),
        (two, ["", ""], [paged.as_str(), "6 0.1 0.1 0.9 0.1 0.1 0.9 1"]),
    ] {
        let text = ply(comments, vertex, face);
        let dir = folder(&[("h.ply", text.as_bytes()), ("my tex.png", &picture())]);
        let found = shown(dir.path(), "h.ply");
        assert!(found.has_texture() && found.is(SKIN), "{text}: {found:?}");
    }
    for (comments, face, problem) in [
        (one, [wedge, "4 0.1 0.1 0.9 0.1"], "face 0: 4 numbers in `texcoord`, expected u and v of 3 corners"),
        (one, [wedge, "6 0.1 0.1 0.9 nan 0.1 0.9"], "face 0: its texture coordinate is not finite"),
        (one, [wedge, "0"], "does not say where in it all of its triangles lie"),
        (two, [wedge, "6 0.1 0.1 0.9 0.1 0.1 0.9"], "a second texture, `my tex.png` beside `other.png`"),
    ] {
        let text = ply(comments, ["", ""], face);
        let found = shown(folder(&[("h.ply", text.as_bytes()), ("my tex.png", &picture())]).path(), "h.ply");
        assert!(found.says(problem) && found.check["has_texture"] == false, "{problem}: {found:?}");
    }
}

/// Parts of a glTF of the tetrahedron with texture coordinates and a picture in it.
fn document() -> (Value, Vec<u8>) {
    let mut bin: Vec<u8> = CORNERS.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
    bin.extend([0.1f32, 0.1, 0.9, 0.1, 0.1, 0.9, 0.9, 0.9].iter().flat_map(|v| v.to_le_bytes()));
    bin.extend(FACES.as_flattened().iter().map(|&v| v as u8));
    bin.extend([0; 4]); // colors from 92 on, if they are wanted
    bin.extend(SKIN.repeat(4));
    let (start, picture) = (bin.len(), picture());
    bin.extend(&picture);
    bin.resize(bin.len().next_multiple_of(4), 0);
    let view = |at: usize, length: usize| json!({"buffer": 0, "byteOffset": at, "byteLength": length});
    let json = json!({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}], "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]},
            {"bufferView": 1, "componentType": 5121, "count": 12, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 4, "componentType": 5121, "count": 4, "type": "VEC3"}],
        "bufferViews": [view(0, 48), view(80, 12), view(48, 32), view(start, picture.len()), view(96, 12)],
        "buffers": [{"byteLength": bin.len()}],
    });
    (json, bin)
}

fn glb(document: &Value, bin: &[u8]) -> Vec<u8> {
    let mut json = document.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut out = b"glTF".to_vec();
    let total = 28 + json.len() + bin.len();
    [2, total as u32, json.len() as u32].iter().for_each(|v| out.extend(v.to_le_bytes()));
    [b"JSON", &json[..]].iter().for_each(|part| out.extend(*part));
    out.extend((bin.len() as u32).to_le_bytes());
    [b"BIN\0", bin].iter().for_each(|part| out.extend(*part));
    out
}

/// What is shown of the document once it was changed.
fn changed(change: impl Fn(&mut Value)) -> Shown {
    let (mut json, bin) = document();
    change(&mut json);
    shown(folder(&[("h.glb", &glb(&json, &bin)), ("my head.png", &picture())]).path(), "h.glb")
}

#[test]
fn colors_of_a_glb_are_shown_from_older_materials_and_from_light() {
    let found = changed(|_| {});
    assert!(found.has_texture() && found.is(SKIN) && found.check["notes"].is_null(), "{found:?}");
    let specular = |content: Value| json!([{"extensions": {"KHR_materials_pbrSpecularGlossiness": content}}]);
    let found = changed(|d| d["materials"] = specular(json!({"diffuseTexture": {"index": 0}})));
    assert!(found.has_texture() && found.is(SKIN) && found.says("pbrSpecularGlossiness"), "{found:?}");
    // linear 0.5 is 188
    let found = changed(|d| d["materials"] = specular(json!({"diffuseFactor": [0.5, 0, 0, 1]})));
    assert!(found.is([188, 0, 0]), "{found:?}");
    let light = json!({"emissiveTexture": {"index": 0}, "emissiveFactor": [1, 1, 1],
        "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}});
    for light in [light, json!({"emissiveTexture": {"index": 0}})] {
        let found = changed(|d| d["materials"] = json!([light]));
        assert!(found.has_texture() && found.is(SKIN), "{found:?}");
        assert!(found.says("light that the material emits"), "{found:?}");
    }
    let found = changed(|d| d["materials"][0]["extensions"] = json!({"KHR_materials_unlit": {}}));
    assert!(found.has_texture() && found.is(SKIN), "{found:?}");
    // an offset and a scale, which a picture of one color does not show
    let part = json!({"KHR_texture_transform": {"offset": [0.5, 0.5], "scale": [0.5, 0.5]}});
    let found = changed(|d| {
        d["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = part.clone();
        d["extensionsRequired"] = json!(["KHR_texture_transform"]);
    });
    assert!(found.has_texture() && found.is(SKIN), "{found:?}");
}

#[test]
fn vertex_colors_of_a_glb_in_bytes_are_shown_even_if_nothing_says_that_they_count_to_255() {
    let found = |normalized: bool| {
        changed(|d| {
            d["meshes"][0]["primitives"][0]["attributes"] = json!({"POSITION": 0, "COLOR_0": 3});
            d["materials"] = json!([{}]);
            d["accessors"][3]["normalized"] = json!(normalized);
        })
    };
    // light: 200 / 255 is 229 in sRGB, 100 / 255 is 168, 50 / 255 is 122
    let right = found(true);
    assert!(right.is([229, 168, 122]) && right.check["notes"].is_null(), "{right:?}");
    let said = found(false);
    assert!(said.is([229, 168, 122]) && said.says("divided by 255"), "{said:?}");
}

#[test]
fn what_a_glb_does_not_show_is_left_out_and_said() {
    let hidden = json!({"mesh": 0, "translation": [5, 0, 0], "extensions": {"KHR_node_visibility": {"visible": false}}});
    let found = changed(|d| {
        d["nodes"] =
            json!([{"mesh": 0}, {"children": [2], "extensions": hidden["extensions"]}, {"mesh": 0}, hidden]);
        d["scenes"][0]["nodes"] = json!([0, 1, 3]);
    });
    assert!(found.check["pieces"] == 1 && found.says("2 hidden nodes left out"), "{found:?}");
    let found = changed(|d| d["nodes"] = json!([{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}]));
    assert!(
        found.check["pieces"] == 1 && found.says("1 node outside the default scene left out"),
        "{found:?}"
    );
    // a visible node is shown
    let found = changed(|d| {
        let visible = json!({"mesh": 0, "translation": [5, 0, 0], "extensions": {"KHR_node_visibility": {}}});
        d["nodes"] = json!([{"mesh": 0}, visible]);
        d["scenes"][0]["nodes"] = json!([0, 1]);
    });
    assert!(found.check["pieces"] == 2 && found.check["notes"].is_null(), "{found:?}");
}

#[test]
fn compressed_files_are_named_with_a_way_that_works() {
    for (extension, way) in
        [("KHR_draco_mesh_compression", "Blender"), ("EXT_meshopt_compression", "three.js")]
    {
        let (mut json, bin) = document();
        json["extensionsRequired"] = json!([extension]);
        let dir = folder(&[("h.glb", &glb(&json, &bin))]);
        for command in ["check", "preview"] {
            let o = tiface(dir.path(), &[command, "h.glb"]);
            assert!(code(&o) == 1 && err(&o).contains(extension) && err(&o).contains(way), "{}", err(&o));
        }
    }
    let found = changed(|d| {
        d["textures"] = json!([{"extensions": {"KHR_texture_basisu": {"source": 0}}}]);
        d["extensionsRequired"] = json!(["KHR_texture_basisu"]);
    });
    assert!(found.says("KHR_texture_basisu") && found.says("PNG or JPEG"), "{found:?}");
}

#[test]
fn pictures_and_buffers_of_a_gltf_are_read_from_its_folder_and_from_its_text() {
    use base64::prelude::{BASE64_STANDARD, Engine};
    let data = |kind: &str, bytes: &[u8]| format!("data:{kind};base64,{}", BASE64_STANDARD.encode(bytes));
    let embedded = data("image/png", &picture());
    for uri in ["my%20head.png", embedded.as_str(), "C:\\a\\my head.png"] {
        let found = changed(|d| d["images"] = json!([{"uri": uri}]));
        assert!(found.has_texture() && found.is(SKIN), "{uri}: {found:?}");
    }
    let found = changed(|d| d["images"] = json!([{"uri": "../gone.png"}]));
    assert!(found.says("gone.png") && found.says("which is not there"), "{found:?}");
    let (json, bin) = document();
    let inside = data("application/octet-stream", &bin);
    for uri in ["the%20data.bin", inside.as_str()] {
        let mut json = json.clone();
        json["buffers"][0]["uri"] = json!(uri);
        let dir = folder(&[("h.gltf", json.to_string().as_bytes()), ("the data.bin", &bin)]);
        let found = shown(dir.path(), "h.gltf");
        assert!(found.has_texture() && found.is(SKIN), "{uri}: {found:?}");
    }
    // several buffers: the picture lies in the second
    let mut several = json.clone();
    let second = several["bufferViews"][3]["byteOffset"].as_u64().unwrap() as usize;
    several["buffers"] = json!([
        {"uri": "a.bin", "byteLength": second},
        {"uri": data("application/octet-stream", &bin[second..]), "byteLength": bin.len() - second}]);
    several["bufferViews"][3]["buffer"] = json!(1);
    several["bufferViews"][3]["byteOffset"] = json!(0);
    let with =
        |document: &Value| folder(&[("h.gltf", document.to_string().as_bytes()), ("a.bin", &bin[..second])]);
    let found = shown(with(&several).path(), "h.gltf");
    assert!(found.has_texture() && found.is(SKIN), "{found:?}");
    for (place, wrong, expected) in [
        ("/bufferViews/1/buffer", json!(2), "view 1 does not lie in one of them"),
        ("/bufferViews/1/byteLength", json!(second), "view 1 does not lie in one of them"),
        ("/bufferViews/1/byteOffset", json!(u64::MAX), "view 1 does not lie in one of them"),
        ("/buffers/0/byteLength", json!(second + 1), "but its data has"),
        ("/buffers/1/uri", Value::Null, "1 has no `uri` that can be read"),
    ] {
        let mut broken = several.clone();
        *broken.pointer_mut(place).unwrap() = wrong;
        let o = tiface(with(&broken).path(), &["check", "h.gltf"]);
        assert!(code(&o) == 1 && err(&o).contains(expected), "{place}: {}", err(&o));
    }
    let mut json = json;
    json["buffers"][0]["uri"] = json!("gone.bin");
    let dir = folder(&[("h.gltf", json.to_string().as_bytes())]);
    let o = tiface(dir.path(), &["check", "h.gltf"]);
    assert!(code(&o) == 1 && err(&o).contains("gone.bin"), "{}", err(&o));
}

#[test]
fn both_kinds_of_stl_are_read_whatever_their_header_says() {
    let facets = FACES.map(|face| face.map(|v| CORNERS[v]));
    let mut text = String::from("solid head\n");
    let mut binary = b"solid but binary".to_vec();
    binary.resize(80, b' ');
    binary.extend(4u32.to_le_bytes());
    for facet in facets {
        text += "facet normal 0 0 0\nouter loop\n";
        facet.iter().for_each(|[x, y, z]| text += &format!("vertex {x} {y} {z}\n"));
        text += "endloop\nendfacet\n";
        binary.extend([0; 12]);
        binary.extend(facet.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
        binary.extend([0; 2]);
    }
    text += "endsolid head\n";
    let torn = text.replacen("endfacet", "vertex 1 1 1\nendfacet", 1).replacen("endloop\n", "", 1);
    let dir = folder(&[("t.stl", text.as_bytes()), ("b.stl", &binary), ("torn.stl", torn.as_bytes())]);
    for name in ["t.stl", "b.stl"] {
        let found = shown(dir.path(), name);
        let report = &found.check;
        assert_eq!((&report["triangles"], &report["welded_vertices"]), (&json!(4), &json!(4)), "{name}");
        assert!(report["closed"] == true && report["has_texture"] == false, "{name}: {found:?}");
    }
    let o = tiface(dir.path(), &["check", "torn.stl"]);
    assert!(code(&o) == 1 && err(&o).contains("a facet of 4 corners"), "{}", err(&o));
}

#[test]
fn formats_that_are_not_read_are_named_with_a_way_that_works() {
    let formats: [(&[u8], &str, &str); 6] = [
        (b"Kaydara FBX Binary  \0\x1a\0", "FBX", "Blender"),
        (b"; FBX 7.3.0 project file\n", "FBX as text", "Blender"),
        (b"OFF\n4 4 0\n0 0 0\n", "OFF", "MeshLab"),
        (b"PK\x03\x04\x14\0\0\0", "USDZ, 3MF", "MeshLab"),
        (b"#usda 1.0\n", "USD", "Blender"),
        (b"<?xml version=\"1.0\"?>\n<COLLADA>", "COLLADA", "Blender"),
    ];
    for (bytes, name, way) in formats {
        let dir = folder(&[("h.bin", bytes)]);
        for command in ["check", "preview"] {
            let o = tiface(dir.path(), &[command, "h.bin"]);
            assert!(code(&o) == 1 && err(&o).contains(name) && err(&o).contains(way), "{}", err(&o));
        }
    }
}

#[test]
fn decimal_commas_are_named_with_the_way_to_points() {
    let text = obj("").replacen("v 1 0 0", "v 1,5 0,0 0,0", 1);
    let rows = ply("", ["", ""], ["", ""]).replacen("1 0 0", "1,5 0,0 0,0", 1);
    let facet =
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 1,5 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n";
    for (name, text) in [("h.obj", text.as_str()), ("h.ply", &rows), ("h.stl", facet)] {
        let o = tiface(folder(&[(name, text.as_bytes())]).path(), &["check", name]);
        assert_eq!(code(&o), 1, "{name}");
        assert!(err(&o).contains("`1,5`") && err(&o).contains("decimal points: `1.5`"), "{}", err(&o));
    }
    // a texture coordinate alone does not stop the mesh
    let text = obj("mtllib a.mtl\n").replacen("vt 0.1", "vt 0,1", 1);
    let dir =
        folder(&[("h.obj", text.as_bytes()), ("a.mtl", b"newmtl a\nmap_Kd a.png\n"), ("a.png", &picture())]);
    let found = shown(dir.path(), "h.obj");
    assert!(found.says("decimal points: `0.1`") && found.check["has_texture"] == false, "{found:?}");
}

#[test]
fn colors_of_a_ply_under_other_names_are_not_white_in_silence() {
    for (properties, values) in [
        ("property float intensity\n", "0.5"),
        ("property uchar vertex_color\n", "7"),
        (color("float", ["f_dc_0", "f_dc_1", "f_dc_2"]).as_str(), "0 0 0"),
        ("property float rgb\n", "13132850"),
        ("property float rgb\n", "nan"),
    ] {
        let text = ply("", [properties, values], ["", ""]);
        let found = shown(folder(&[("h.ply", text.as_bytes())]).path(), "h.ply");
        let name = properties.split_whitespace().nth(2).unwrap();
        let problem = format!("the property `{name}` of `vertex` is not shown");
        assert!(found.says(&problem) && found.check["has_colors"] == false, "{properties}: {found:?}");
    }
    // colors of both vertices and faces: one is named
    let colors = color("uchar", ["red", "green", "blue"]);
    let text = ply("", [&colors, "200 100 50"], [&colors, "1 2 3"]);
    let found = shown(folder(&[("h.ply", text.as_bytes())]).path(), "h.ply");
    assert!(found.is(SKIN) && found.says("those of its vertices are shown"), "{found:?}");
    let text = ply("", ["property float scattered\n", "0.5"], ["", ""]);
    let found = shown(folder(&[("h.ply", text.as_bytes())]).path(), "h.ply");
    assert!(found.check["notes"].is_null(), "{found:?}");
}

#[test]
fn materials_of_several_files_are_all_looked_at() {
    let (picture, red) = (picture(), b"newmtl b\nKd 1 0 0\n");
    let seen = |libraries: &str| {
        let text = obj(&format!("{libraries}\nusemtl a\n"));
        let textured = b"newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd other.png\n";
        let files: [(&str, &[u8]); 5] = [
            ("h.obj", text.as_bytes()),
            ("b.mtl", red),
            ("t/a.mtl", textured),
            ("t/a.png", &picture),
            ("b c.mtl", red),
        ];
        shown(folder(&files).path(), "h.obj")
    };
    for libraries in [
        "mtllib b.mtl t/a.mtl # both",
        "mtllib b.mtl\nmtllib t/a.mtl",
        "mtllib \"b c.mtl\" t/a.mtl",
        "mtllib b c.mtl\nmtllib t/a.mtl\nmtllib b.mtl",
    ] {
        let found = seen(libraries);
        assert!(found.has_texture() && found.is(SKIN), "{libraries}: {found:?}");
        assert!(found.check["notes"].is_null(), "{libraries}: {found:?}");
    }
    // of two files one is not there
    let found = seen("mtllib gone.mtl t/a.mtl");
    assert!(
        found.has_texture() && found.is(SKIN) && found.says("names `gone.mtl`, which is not"),
        "{found:?}"
    );
    let found = seen("mtllib b.mtl gone.mtl");
    assert!(found.says("gone.mtl") && found.says("`b.mtl` has no material `a`"), "{found:?}");
    assert!(found.check["has_colors"] == false, "white is no color of materials: {found:?}");
    let found = seen("mtllib no such.mtl");
    assert!(found.says("names `no such.mtl`, which is not there"), "{found:?}");
}

#[test]
fn a_picture_of_another_format_is_named_and_read_once_it_is_converted() {
    let text = obj("mtllib h.mtl\n");
    let tga = [&[0u8, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0, 24, 0][..], &[50, 100, 200]].concat();
    let files: [(&str, &[u8]); 3] =
        [("h.obj", text.as_bytes()), ("h.mtl", b"newmtl a\nmap_Kd tex.tga\n"), ("tex.tga", &tga)];
    let dir = folder(&files);
    let found = shown(dir.path(), "h.obj");
    assert!(found.says("tex.tga") && found.says("convert it to PNG"), "{found:?}");
    std::fs::write(dir.path().join("Tex.png"), picture()).unwrap();
    let found = shown(dir.path(), "h.obj");
    assert!(found.has_texture() && found.is(SKIN), "{found:?}");
    assert!(found.says("`tex.tga` is not read; `Tex.png` beside it is taken"), "{found:?}");
}

#[test]
fn vertex_colors_of_a_part_of_a_glb_are_not_dropped_in_silence() {
    let found = changed(|d| {
        let bare = json!({"attributes": {"POSITION": 0}, "indices": 1});
        let mut colored = bare.clone();
        colored["attributes"]["COLOR_0"] = json!(3);
        d["meshes"][0]["primitives"] = json!([bare, colored]);
    });
    assert!(found.says("some parts of the mesh have no `COLOR_0`"), "{found:?}");
    let found = changed(|d| {
        d["meshes"][0]["primitives"] = json!([{"attributes": {"POSITION": 0, "COLOR_1": 3}, "indices": 1}]);
    });
    assert!(found.says("they are not in `COLOR_0`"), "{found:?}");
}

#[test]
fn an_obj_is_read_with_comments_behind_names_keys_in_capitals_and_normals_that_are_no_numbers() {
    let mtl = b"newmtl a\nmap_Kd a.png # of the left side\n";
    for head in
        ["mtllib a.mtl # mine\n", "MTLLIB a.mtl\nUseMtl a\n", "mtllib a.mtl\nvn nan -nan(ind) 1.#QNAN\n"]
    {
        let text = obj(head);
        let dir = folder(&[("h.obj", text.as_bytes()), ("a.mtl", mtl), ("a.png", &picture())]);
        let found = shown(dir.path(), "h.obj");
        assert!(found.has_texture() && found.is(SKIN), "{head}: {found:?}");
        assert_eq!(found.says("normals are not read"), head.contains("nan"), "{head}: {found:?}");
    }
}

#[test]
fn a_ply_with_normals_that_are_no_numbers_is_read_without_them() {
    let normals = "property float nx\nproperty float ny\nproperty float nz\n".to_owned();
    let colored = normals + &color("uchar", ["red", "green", "blue"]);
    let text = ply("", [&colored, "nan nan nan 200 100 50"], ["", ""]);
    let found = shown(folder(&[("h.ply", text.as_bytes())]).path(), "h.ply");
    assert!(found.is(SKIN) && found.says("normals are not read"), "{found:?}");
}
