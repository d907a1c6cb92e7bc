//! A mesh as USDZ: a stage of *Universal Scene Description* with its pictures in one file, which
//! Safari and the viewers of iPhone, iPad, Mac and Vision Pro show, also in the room.
//!
//! +Y up, meters, counter-clockwise, no subdivision. The stage is text (`.usda`), which every
//! reader of USDZ takes. Positions and texture coordinates are indexed apart, as in an OBJ: the
//! surface stays closed whatever its seams. A mesh far from the origin lies around its own middle,
//! with the way there in f64 on the node above it.
//!
//! Shading is `UsdPreviewSurface`, the only one that all of these viewers know, and it has no unlit
//! kind. Colors that already hold the light are therefore emitted, by a surface that reflects
//! nothing: black, and with the refractive index of air. What a viewer does to all colors at the
//! end, as tone mapping, it does to these, too.
//!
//! What is left out: soft layers, since no input of that shader makes what is emitted transparent,
//! Apple's viewers read no opacity from vertices, and USD defines no drawing order; and textures
//! that depend on the view.
//!
//! Names within the file do not depend on its own, so a file that is renamed has the same bytes.

use super::file_mesh::{ExportOptions, ExportedFiles, FileMesh, encode, lobes_left_out, safe_name};
use super::head_texture::HeadTexture;
use super::obj::Short;
use super::stored_zip::stored_zip;
use std::fmt::Write;
use tiface_base::Result;
use tiface_base::geom::{Aabb, Mesh};
use tiface_base::image::linear_from_srgb;

/// Returns a mesh as a `.usdz`, with the pictures of its texture inside; without a texture it is
/// colored by its vertices, which Apple's viewers do not show.
///
/// # Errors
///
/// Fails if the mesh is empty or damaged, if texture and mesh do not belong together, if an option
/// is invalid, or if the file would exceed 4 GiB.
pub fn to_usdz(mesh: &Mesh, texture: Option<&HeadTexture>, options: &ExportOptions) -> Result<ExportedFiles> {
    let mut file = FileMesh::new(mesh, texture, &options.file_from_mesh()?)?;
    let mut pictures = Vec::new();
    let mut look = Look { unlit: options.unlit, color: ColorOrigin::Constant, normal: None };
    if let Some(texture) = texture {
        file.colors = Vec::new();
        let (bytes, ending) = encode("base color", &texture.color, options.jpeg_quality)?;
        pictures.push((format!("color.{ending}"), bytes));
        look.color = ColorOrigin::Picture(format!("color.{ending}"));
        if let Some(map) = &texture.normal {
            let (bytes, ending) = encode("normal map", map, None)?;
            pictures.push((format!("normal.{ending}"), bytes));
            look.normal = Some(format!("normal.{ending}"));
        }
    } else if !file.colors.is_empty() {
        look.color = ColorOrigin::Vertices;
    }
    let stage = stage(&file, mesh.is_closed(), &look, &options.name);
    // the first file is the one that viewers open
    let mut files = vec![("head.usda", stage.as_bytes())];
    files.extend(pictures.iter().map(|(name, bytes)| (name.as_str(), &bytes[..])));
    let mut warnings: Vec<String> = lobes_left_out(texture, "usdz").into_iter().collect();
    if texture.is_none() {
        let text = "a .usdz without a texture is colored at its vertices, which Apple's viewers show as gray";
        warnings.push(text.into());
    }
    let name = format!("{}.usdz", safe_name(&options.stem));
    Ok(ExportedFiles { files: vec![(name, stored_zip(&files)?)], warnings })
}

/// How a mesh looks.
struct Look {
    unlit: bool,
    color: ColorOrigin,
    /// Name of the picture of a normal map.
    normal: Option<String>,
}

/// Where the color of a mesh comes from.
enum ColorOrigin {
    /// White.
    Constant,
    /// The vertices' own, in linear light.
    Vertices,
    /// The picture of this name.
    Picture(String),
}

/// Returns the text of the stage: a node with the mesh and its material.
fn stage(file: &FileMesh, is_closed: bool, look: &Look, name: &str) -> String {
    let root = identifier(name);
    let mut out = String::with_capacity(file.positions.len() * 80 + file.triangles.len() * 50);
    out += "#usda 1.0\n(\n";
    put(&mut out, 1, format_args!("defaultPrim = \"{root}\""));
    put(&mut out, 1, format_args!("doc = \"tiface {}\"", env!("CARGO_PKG_VERSION")));
    put(&mut out, 1, format_args!("metersPerUnit = 1"));
    put(&mut out, 1, format_args!("upAxis = \"Y\""));
    out += ")\n\n";
    put(&mut out, 0, format_args!("def Xform \"{root}\" ("));
    put(&mut out, 1, format_args!("assetInfo = {{"));
    put(&mut out, 2, format_args!("string name = {}", quoted(name)));
    put(&mut out, 1, format_args!("}}"));
    put(&mut out, 1, format_args!("kind = \"component\""));
    out += ")\n{\n";
    if file.is_far() {
        let [x, y, z] = file.translation.to_array();
        put(&mut out, 1, format_args!("double3 xformOp:translate = ({x}, {y}, {z})"));
        put(&mut out, 1, format_args!("uniform token[] xformOpOrder = [\"xformOp:translate\"]\n"));
    }
    put_mesh(&mut out, file, is_closed, &root);
    out += "\n";
    put_material(&mut out, look, &root);
    out + "}\n"
}

/// Adds a line at a depth of nesting.
fn put(out: &mut String, depth: usize, line: std::fmt::Arguments) {
    writeln!(out, "{:width$}{line}", "", width = 4 * depth).expect("writing to memory does not fail");
}

/// Adds an attribute that is an array of vectors, with the interpolation of its values if that is
/// not given by the attribute.
fn put_vectors<const N: usize>(
    out: &mut String,
    name: &str,
    interpolation: Option<&str>,
    values: impl Iterator<Item = [f32; N]>,
) {
    *out += &format!("        {name} = [");
    for (i, value) in values.enumerate() {
        *out += if i == 0 { "(" } else { ",(" };
        for (k, v) in value.into_iter().enumerate() {
            let comma = if k == 0 { "" } else { "," };
            write!(out, "{comma}{}", Short(v)).expect("writing to memory does not fail");
        }
        *out += ")";
    }
    *out += "]";
    if let Some(interpolation) = interpolation {
        *out += &format!(" (\n            interpolation = \"{interpolation}\"\n        )");
    }
    *out += "\n";
}

/// Adds an attribute that is an array of integers.
fn put_integers(out: &mut String, name: &str, values: impl Iterator<Item = u32>) {
    *out += &format!("        int[] {name} = [");
    for (i, value) in values.enumerate() {
        let comma = if i == 0 { "" } else { "," };
        write!(out, "{comma}{value}").expect("writing to memory does not fail");
    }
    *out += "]\n";
}

fn put_mesh(out: &mut String, file: &FileMesh, is_closed: bool, root: &str) {
    put(out, 1, format_args!("def Mesh \"Surface\" ("));
    put(out, 2, format_args!("prepend apiSchemas = [\"MaterialBindingAPI\"]"));
    put(out, 1, format_args!(")"));
    put(out, 1, format_args!("{{"));
    // the inside of an open mesh shows
    put(out, 2, format_args!("uniform bool doubleSided = {}", u8::from(!is_closed)));
    let bounds = Aabb::around(file.positions.iter().copied());
    put_vectors(out, "float3[] extent", None, [bounds.min, bounds.max].iter().map(|p| p.to_array()));
    put_integers(out, "faceVertexCounts", file.triangles.iter().map(|_| 3));
    put_integers(out, "faceVertexIndices", file.triangles.as_flattened().iter().copied());
    put(out, 2, format_args!("rel material:binding = </{root}/Material>"));
    if !file.normals.is_empty() {
        let normals = file.normals.iter().map(|n| n.to_array());
        put_vectors(out, "normal3f[] normals", Some("vertex"), normals);
    }
    put_vectors(out, "point3f[] points", None, file.positions.iter().map(|p| p.to_array()));
    if !file.colors.is_empty() {
        let linear = file.colors.iter().map(|c| c.map(linear_from_srgb));
        put_vectors(out, "color3f[] primvars:displayColor", Some("vertex"), linear);
    }
    if !file.corners.is_empty() {
        // v runs up
        let uvs = file.uvs.iter().map(|uv| [uv.x, 1.0 - uv.y]);
        put_vectors(out, "texCoord2f[] primvars:st", Some("faceVarying"), uvs);
        put_integers(out, "primvars:st:indices", file.corners.as_flattened().iter().copied());
    }
    put(out, 2, format_args!("uniform token subdivisionScheme = \"none\""));
    put(out, 1, format_args!("}}"));
}

fn put_material(out: &mut String, look: &Look, root: &str) {
    let material = format!("/{root}/Material");
    put(out, 1, format_args!("def Material \"Material\""));
    put(out, 1, format_args!("{{"));
    put(out, 2, format_args!("token outputs:surface.connect = <{material}/Surface.outputs:surface>\n"));
    let shown = if look.unlit { "emissiveColor" } else { "diffuseColor" };
    let mut inputs = match &look.color {
        ColorOrigin::Constant => vec![format!("color3f inputs:{shown} = (1, 1, 1)")],
        ColorOrigin::Vertices => {
            vec![format!("color3f inputs:{shown}.connect = <{material}/Color.outputs:result>")]
        }
        ColorOrigin::Picture(_) => {
            vec![format!("color3f inputs:{shown}.connect = <{material}/Color.outputs:rgb>")]
        }
    };
    if look.unlit {
        inputs.extend(["color3f inputs:diffuseColor = (0, 0, 0)", "float inputs:ior = 1"].map(String::from));
    }
    inputs.extend(["float inputs:metallic = 0", "float inputs:roughness = 1"].map(String::from));
    if look.normal.is_some() {
        inputs.push(format!("normal3f inputs:normal.connect = <{material}/Normal.outputs:rgb>"));
    }
    inputs.push("token outputs:surface".into());
    put_shader(out, "Surface", "UsdPreviewSurface", &inputs);
    match &look.color {
        ColorOrigin::Constant => {}
        ColorOrigin::Vertices => put_reader(out, "Color", "float3", "displayColor"),
        ColorOrigin::Picture(name) => put_picture(out, "Color", &material, name, "sRGB", &[]),
    }
    if let Some(name) = &look.normal {
        // from 0..=1 to -1..=1
        let decode = ["float4 inputs:bias = (-1, -1, -1, 0)", "float4 inputs:scale = (2, 2, 2, 1)"];
        put_picture(out, "Normal", &material, name, "raw", &decode);
    }
    if look.normal.is_some() || matches!(look.color, ColorOrigin::Picture(_)) {
        put_reader(out, "Coordinates", "float2", "st");
    }
    put(out, 1, format_args!("}}"));
}

/// Adds a shader of a material.
fn put_shader(out: &mut String, name: &str, kind: &str, lines: &[String]) {
    put(out, 2, format_args!("def Shader \"{name}\""));
    put(out, 2, format_args!("{{"));
    put(out, 3, format_args!("uniform token info:id = \"{kind}\""));
    lines.iter().for_each(|line| put(out, 3, format_args!("{line}")));
    put(out, 2, format_args!("}}"));
}

/// Adds a shader that reads an attribute of the mesh.
fn put_reader(out: &mut String, name: &str, kind: &str, attribute: &str) {
    let lines = [format!("string inputs:varname = \"{attribute}\""), format!("{kind} outputs:result")];
    put_shader(out, name, &format!("UsdPrimvarReader_{kind}"), &lines);
}

/// Adds a shader that reads a picture.
fn put_picture(out: &mut String, name: &str, material: &str, file: &str, space: &str, more: &[&str]) {
    let mut lines: Vec<String> = more.iter().map(|&line| line.into()).collect();
    lines.extend([
        format!("asset inputs:file = @{file}@"),
        format!("token inputs:sourceColorSpace = \"{space}\""),
        format!("float2 inputs:st.connect = <{material}/Coordinates.outputs:result>"),
        "token inputs:wrapS = \"clamp\"".into(),
        "token inputs:wrapT = \"clamp\"".into(),
        "float3 outputs:rgb".into(),
    ]);
    put_shader(out, name, "UsdUVTexture", &lines);
}

/// Returns a name as paths of USD have it: ASCII letters, digits and `_`, no digit in front.
fn identifier(name: &str) -> String {
    let safe = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    let name: String = name.trim().chars().map(safe).collect();
    match name.chars().next() {
        None => "mesh".into(),
        Some(first) if first.is_ascii_digit() => format!("_{name}"),
        Some(_) => name,
    }
}

/// Returns a string as USD has it, without control characters.
fn quoted(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars().filter(|c| !c.is_control()) {
        if matches!(c, '"' | '\\') {
            out.push('\\');
        }
        out.push(c);
    }
    out + "\""
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::file_mesh::tests::tetrahedron;
    use crate::files::read;
    use crate::files::stored_zip::tests::files_of;
    use glam::{DVec3, Vec3};
    use std::path::Path;
    use tiface_base::geom::Similarity;
    use tiface_base::io::{Limits, parse_photo};

    fn triangle() -> Mesh {
        Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.0, 0.0, 1e-7)],
            normals: vec![-Vec3::Y; 3],
            colors: vec![[1.0, 0.0, 0.0], [0.0; 3], [2.0, -1.0, 0.0]],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        }
    }

    /// Returns the stage of a USDZ and its other files.
    fn opened(usdz: &[u8]) -> (String, Vec<(String, Vec<u8>)>) {
        let mut files: Vec<_> = files_of(usdz).into_iter().map(|(name, data, _)| (name, data)).collect();
        let (name, stage) = files.remove(0);
        assert_eq!(name, "head.usda");
        (String::from_utf8(stage).unwrap(), files)
    }

    fn written(mesh: &Mesh, texture: Option<&HeadTexture>, options: &ExportOptions) -> Vec<u8> {
        to_usdz(mesh, texture, options).unwrap().files.remove(0).1
    }

    #[test]
    fn a_colored_triangle_is_this_stage() {
        let options = ExportOptions { up: Vec3::Z, name: "7 \"heads\"\n".into(), ..Default::default() };
        let (stage, others) = opened(&written(&triangle(), None, &options));
        // z becomes y; −y, the normal, becomes z; colors are 0 or 1, in linear light, too
        let expected = r#"    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "_7__heads_" (
    assetInfo = {
        string name = "7 \"heads\""
    }
    kind = "component"
)
{
    def Mesh "Surface" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {
        uniform bool doubleSided = 1
        float3[] extent = [(0,0,0),(1,1e-7,0)]
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0,1,2]
        rel material:binding = </_7__heads_/Material>
        normal3f[] normals = [(0,0,1),(0,0,1),(0,0,1)] (
            interpolation = "vertex"
        )
        point3f[] points = [(0,0,0),(1,0,0),(0,1e-7,0)]
        color3f[] primvars:displayColor = [(1,0,0),(0,0,0),(1,0,0)] (
            interpolation = "vertex"
        )
        uniform token subdivisionScheme = "none"
    }

    def Material "Material"
    {
        token outputs:surface.connect = </_7__heads_/Material/Surface.outputs:surface>

        def Shader "Surface"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:emissiveColor.connect = </_7__heads_/Material/Color.outputs:result>
            color3f inputs:diffuseColor = (0, 0, 0)
            float inputs:ior = 1
            float inputs:metallic = 0
            float inputs:roughness = 1
            token outputs:surface
        }
        def Shader "Color"
        {
            uniform token info:id = "UsdPrimvarReader_float3"
            string inputs:varname = "displayColor"
            float3 outputs:result
        }
    }
}
"#;
        assert!(stage.starts_with("#usda 1.0\n(\n    defaultPrim = \"_7__heads_\"\n    doc = \"tiface "));
        assert_eq!(&stage[stage.find("    metersPerUnit").unwrap()..], expected);
        assert!(others.is_empty());
        let warnings = to_usdz(&triangle(), None, &options).unwrap().warnings;
        assert!(warnings.len() == 1 && warnings[0].contains("without a texture"), "{warnings:?}");
    }

    #[test]
    fn a_textured_surface_stays_closed_and_brings_its_pictures() {
        let (mesh, texture) = tetrahedron();
        let bare = HeadTexture { normal: None, lobes: None, ..texture.clone() };
        let (stage, others) = opened(&written(&mesh, Some(&bare), &ExportOptions::default()));
        let [(name, picture)] = &others[..] else { panic!("{} pictures", others.len()) };
        assert_eq!(name, "color.png");
        assert_eq!(parse_photo(picture, Path::new(name), &Limits::default()).unwrap(), texture.color);
        let line = |start: &str| stage.lines().find(|l| l.trim_start().starts_with(start)).unwrap();
        // four vertices as they were, and three texture coordinates for each triangle
        assert_eq!(line("point3f[] points").matches('(').count(), 4);
        assert!(line("int[] faceVertexIndices").ends_with("[0,2,1,0,1,3,0,3,2,1,2,3]"));
        assert!(line("texCoord2f[] primvars:st").contains("[(0,1),(0,0.625),(0.375,1),"), "v runs up");
        assert!(line("int[] primvars:st:indices").ends_with("[0,1,2,3,4,5,6,7,8,9,10,11]"));
        assert!(line("uniform bool doubleSided").ends_with('0') && !stage.contains("displayColor"));
        assert!(stage.contains("emissiveColor.connect = </head/Material/Color.outputs:rgb>"));
        assert!(stage.contains("asset inputs:file = @color.png@"));
        // lit, with a normal map, and stored smaller
        let mapped = HeadTexture { normal: Some(texture.color.clone()), ..bare };
        let lit = ExportOptions { unlit: false, jpeg_quality: Some(90), ..ExportOptions::default() };
        let out = to_usdz(&mesh, Some(&mapped), &lit).unwrap();
        assert!(out.warnings.is_empty(), "{:?}", out.warnings);
        let (stage, others) = opened(&out.files[0].1);
        assert_eq!(
            others.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(),
            ["color.jpg", "normal.png"]
        );
        assert!(stage.contains("diffuseColor.connect = </head/Material/Color.outputs:rgb>"));
        assert!(stage.contains("normal3f inputs:normal.connect = </head/Material/Normal.outputs:rgb>"));
        assert!(!stage.contains("emissiveColor") && !stage.contains("inputs:ior"));
    }

    #[test]
    fn the_bytes_do_not_depend_on_the_name_of_the_file() {
        let (mesh, texture) = tetrahedron();
        let named = |stem: &str| {
            let options = ExportOptions { stem: stem.into(), ..ExportOptions::default() };
            to_usdz(&mesh, Some(&texture), &options).unwrap().files.remove(0)
        };
        let (a, b) = (named("a"), named("my head"));
        assert_eq!((a.0.as_str(), b.0.as_str()), ("a.usdz", "my_head.usdz"));
        assert!(a.1 == b.1);
    }

    #[test]
    fn a_mesh_far_away_lies_around_its_middle() {
        let world_from_mesh = Similarity::scale_translate(1.0, DVec3::new(5e6, 0.25, -3e6));
        let options = ExportOptions { world_from_mesh, ..ExportOptions::default() };
        let (mesh, texture) = tetrahedron();
        let (stage, _) = opened(&written(&mesh, Some(&texture), &options));
        // the middle of a box of one unit
        assert!(stage.contains("double3 xformOp:translate = (5000000.5, 0.75, -2999999.5)\n"), "{stage}");
        assert!(stage.contains("point3f[] points = [(-0.5,-0.5,-0.5),(0.5,-0.5,-0.5),"));
    }

    #[test]
    fn what_is_damaged_has_no_file() {
        let message = |mesh: &Mesh| to_usdz(mesh, None, &ExportOptions::default()).unwrap_err().to_string();
        assert!(message(&Mesh::default()).contains("no triangles"));
        for bad in [f32::NAN, f32::INFINITY] {
            let mut mesh = triangle();
            mesh.positions[1].y = bad;
            assert!(message(&mesh).contains("vertex 1"), "{bad}");
            let mut mesh = triangle();
            mesh.colors[2][0] = bad;
            assert!(message(&mesh).contains("vertex 2 has the color"), "{bad}");
        }
        let (mesh, mut texture) = tetrahedron();
        texture.atlas.uvs[5].y = f32::NAN;
        let e = to_usdz(&mesh, Some(&texture), &ExportOptions::default()).unwrap_err();
        assert!(e.to_string().contains("texture coordinate 5"), "{e}");
    }

    #[test]
    fn names_are_those_of_usd() {
        let names = ["head", "7", "Büste 2", "", " a/b.c "].map(identifier);
        assert_eq!(names, ["head", "_7", "B_ste_2", "mesh", "a_b_c"]);
        assert_eq!(quoted("a\\b\"c\"\u{7}\nä"), "\"a\\\\b\\\"c\\\"ä\"");
    }

    #[test]
    fn no_reader_takes_it_for_another_format() {
        let e =
            read(&written(&triangle(), None, &ExportOptions::default()), Path::new("a.usdz")).unwrap_err();
        assert!(e.to_string().contains("USDZ") && e.to_string().contains("not read"), "{e}");
    }
}
