//! A mesh as GLB: glTF 2.0, binary, one file (Khronos, *glTF 2.0 Specification*).
//!
//! Right-handed, +Y up, metres, counter-clockwise. Colours that already hold the light are marked
//! `KHR_materials_unlit`, beside a rough non-metal for viewers that do not know it.
//!
//! Colour is either the vertices' own or a texture's, never both, since viewers multiply them:
//! `COLOR_0` is **linear** light, while our vertex colours and pictures are sRGB-coded. Pictures lie in
//! the file. A mesh far from the origin is written around its middle, which its node carries in f64: its shape
//! is as exact as that of any other.
//!
//! # Textures that depend on the view
//!
//! A texture that nothing refers to may be dropped by any tool, and the Khronos validator says so for
//! one that is named in `extras` alone. So each lobe is the base colour of a material of its own, which
//! the primitive offers as a variant (`KHR_materials_variants`). Viewers show the first material
//! unless somebody asks for a variant, and those that know nothing of variants always do. The first
//! material says how to use them:
//!
//! ```json
//! "extras": { "tiface": { …what the caller gave…,
//!   "lobes": [ { "name": "lobe 0", "texture": 1, "material": 1, "variant": 0 } ] } }
//! ```

use super::export::{ExportError, ExportOptions, ready};
use super::glb_document::{Document, info};
use super::tangents;
use super::textured::{
    Exported, PictureFormat, Split, TextureOptions, Textured, encode, prepare, safe_name, split,
};
use crate::geom::{Aabb, Mesh};
use crate::image::linear_from_srgb;
use glam::{DVec3, Vec3};
use gltf_json::extensions::mesh::{KhrMaterialsVariants, Mapping};
use gltf_json::extensions::scene::khr_materials_variants::Variant;
use gltf_json::material::{NormalTexture, PbrMetallicRoughness, StrengthFactor};
use gltf_json::mesh::{Mode, Primitive, Semantic};
use gltf_json::texture::Info;
use gltf_json::validation::Checked::Valid;
use gltf_json::{Index, Material};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// The mesh as the bytes of a `.glb` file, coloured by its vertices.
///
/// # Errors
///
/// [`ExportError`] when there is nothing to write, the mesh is damaged, an option makes no sense, or
/// the file would pass 4 GiB.
pub fn to_glb(mesh: &Mesh, options: &ExportOptions) -> Result<Vec<u8>, ExportError> {
    let ready = ready(mesh, &options.file_from_mesh()?)?;
    let translation = ready.translation;
    let shape = Split {
        positions: ready.positions,
        normals: ready.normals,
        colors: ready.colors,
        triangles: ready.triangles,
        ..Split::default()
    };
    let mut document = Document::default();
    let material = material(options, options.name.clone(), None);
    let material = document.root.push(material);
    finish(document, &shape, translation, false, material, None, options)
}

/// The mesh as one `.glb` file, with its pictures inside.
///
/// # Errors
///
/// [`ExportError`] when mesh, atlas and pictures do not belong together, before there are any bytes;
/// else as [`to_glb`].
pub fn textured_to_glb(
    textured: &Textured,
    options: &ExportOptions,
    texture: &TextureOptions,
) -> Result<Exported, ExportError> {
    let prepared = prepare(textured, &options.file_from_mesh()?)?;
    let ready = &prepared.ready;
    let tangents = textured.normal.map(|_| {
        let (positions, normals, triangles) = (&ready.positions, &ready.normals, &ready.triangles);
        tangents::of(positions, normals, triangles, &prepared.uvs, &prepared.corners)
    });
    let mut shape = split(&prepared, tangents.as_deref());
    shape.colors = Vec::new(); // viewers would multiply them into the texture

    let mut document = Document::default();
    let mut picture = |name: &str, picture, format| -> Result<Index<gltf_json::Texture>, ExportError> {
        let (bytes, ending) = encode(name, picture, format)?;
        Ok(document.texture(name, &bytes, ending))
    };
    let color = picture("base colour", textured.color, texture.picture)?;
    let normal = textured.normal.map(|map| picture("normal map", map, PictureFormat::Png)).transpose()?;
    let mut lobes = Vec::with_capacity(textured.lobes.len());
    for lobe in &textured.lobes {
        lobes.push(picture(&lobe.name, lobe.picture, texture.picture)?);
    }
    let mut main = material(options, options.name.clone(), Some(info(color)));
    main.normal_texture = normal.map(|index| NormalTexture {
        index,
        scale: 1.0,
        tex_coord: 0,
        extensions: None,
        extras: Default::default(),
    });
    main.extras = extras(textured, &lobes);
    let main = document.root.push(main);
    let variants = (!lobes.is_empty()).then(|| variants(&mut document, textured, &lobes, options));
    let bytes = finish(document, &shape, ready.translation, texture.quantize, main, variants, options)?;
    let mut warnings = Vec::new();
    if texture.quantize {
        warnings.push(
            "KHR_mesh_quantization: trimesh 5.2 and open3d 0.20 read wrong positions from this file; \
             Blender and three.js read it"
                .into(),
        );
    }
    Ok(Exported { files: vec![(format!("{}.glb", safe_name(&texture.stem)), bytes)], warnings })
}

/// One material for each lobe, offered by the primitive as variants.
fn variants(
    document: &mut Document,
    textured: &Textured,
    lobes: &[Index<gltf_json::Texture>],
    options: &ExportOptions,
) -> KhrMaterialsVariants {
    let mut mappings = Vec::with_capacity(lobes.len());
    let mut names = Vec::with_capacity(lobes.len());
    for (variant, (lobe, &texture)) in textured.lobes.iter().zip(lobes).enumerate() {
        let material = material(options, lobe.name.clone(), Some(info(texture)));
        let material = document.root.push(material).value() as u32;
        mappings.push(Mapping { material, variants: vec![variant as u32] });
        names.push(Variant { name: lobe.name.clone() });
    }
    document.root.extensions_used.push("KHR_materials_variants".into());
    document.root.extensions = Some(gltf_json::extensions::root::Root {
        khr_materials_variants: Some(gltf_json::extensions::root::KhrMaterialsVariants { variants: names }),
    });
    KhrMaterialsVariants { mappings }
}

/// What the first material says of the lobes; see the head of this file.
fn extras(textured: &Textured, lobes: &[Index<gltf_json::Texture>]) -> gltf_json::Extras {
    let mut ours: Map<String, Value> = textured.extras.clone();
    if !lobes.is_empty() {
        let list: Vec<Value> = textured
            .lobes
            .iter()
            .zip(lobes)
            .enumerate()
            .map(|(i, (lobe, texture))| {
                json!({"name": lobe.name, "texture": texture.value(), "material": i + 1, "variant": i})
            })
            .collect();
        ours.insert("lobes".into(), list.into());
    }
    if ours.is_empty() {
        return None;
    }
    let text = json!({ "tiface": ours }).to_string();
    Some(gltf_json::extras::RawValue::from_string(text).expect("a value is valid JSON"))
}

fn material(options: &ExportOptions, name: String, color: Option<Info>) -> Material {
    let unlit = options.unlit.then_some(gltf_json::extensions::material::Material {
        unlit: Some(gltf_json::extensions::material::Unlit {}),
    });
    Material {
        name: Some(name),
        pbr_metallic_roughness: PbrMetallicRoughness {
            base_color_texture: color,
            metallic_factor: StrengthFactor(0.0),
            roughness_factor: StrengthFactor(1.0),
            ..Default::default()
        },
        extensions: unlit,
        ..Default::default()
    }
}

/// Puts the shape under its material and packs the file.
fn finish(
    mut document: Document,
    shape: &Split,
    translation: DVec3,
    quantize: bool,
    material: Index<Material>,
    variants: Option<KhrMaterialsVariants>,
    options: &ExportOptions,
) -> Result<Vec<u8>, ExportError> {
    let mut node = gltf_json::Node { name: Some(options.name.clone()), ..Default::default() };
    let mut at = translation;
    let attributes = if quantize {
        let bounds = Aabb::around(shape.positions.iter().copied());
        let size = bounds.size().max_element();
        node.scale = Some([size; 3]);
        at += bounds.min.as_dvec3();
        document.root.extensions_used.push("KHR_mesh_quantization".into());
        document.root.extensions_required.push("KHR_mesh_quantization".into());
        short_attributes(&mut document, shape, bounds.min, size)
    } else {
        attributes(&mut document, shape)
    };
    node.translation = (at != DVec3::ZERO || quantize).then(|| at.as_vec3().to_array());
    let indices = document.indices(&shape.triangles, shape.positions.len());
    let root = &mut document.root;
    root.asset.generator = Some(concat!("tiface ", env!("CARGO_PKG_VERSION")).into());
    let primitive = Primitive {
        attributes,
        indices: Some(indices),
        material: Some(material),
        mode: Valid(Mode::Triangles),
        extensions: variants
            .map(|v| gltf_json::extensions::mesh::Primitive { khr_materials_variants: Some(v) }),
        extras: Default::default(),
        targets: None,
    };
    node.mesh = Some(root.push(gltf_json::Mesh {
        primitives: vec![primitive],
        name: Some(options.name.clone()),
        weights: None,
        extensions: None,
        extras: Default::default(),
    }));
    let node = root.push(node);
    root.scene = Some(root.push(gltf_json::Scene {
        nodes: vec![node],
        name: None,
        extensions: None,
        extras: Default::default(),
    }));
    if options.unlit {
        root.extensions_used.push("KHR_materials_unlit".into());
    }
    // within f32's reach its shortest digits will do
    if translation != DVec3::ZERO {
        document.far = Some((node, at));
    }
    document.pack()
}

type Attributes = BTreeMap<gltf_json::validation::Checked<Semantic>, Index<gltf_json::Accessor>>;

fn attributes(document: &mut Document, shape: &Split) -> Attributes {
    let mut attributes = BTreeMap::from([(Valid(Semantic::Positions), document.positions(&shape.positions))]);
    if !shape.normals.is_empty() {
        attributes.insert(Valid(Semantic::Normals), document.floats(&shape.normals));
    }
    if !shape.tangents.is_empty() {
        let tangents: Vec<[f32; 4]> = shape.tangents.iter().map(|t| t.to_array()).collect();
        attributes.insert(Valid(Semantic::Tangents), document.floats(&tangents));
    }
    if !shape.uvs.is_empty() {
        attributes.insert(Valid(Semantic::TexCoords(0)), document.floats(&shape.uvs));
    }
    if !shape.colors.is_empty() {
        let linear: Vec<Vec3> = shape.colors.iter().map(|c| c.map(linear_from_srgb).into()).collect();
        attributes.insert(Valid(Semantic::Colors(0)), document.floats(&linear));
    }
    attributes
}

/// The attributes of a textured shape in 16 bits.
fn short_attributes(document: &mut Document, shape: &Split, low: Vec3, size: f32) -> Attributes {
    let place = |p: &Vec3| ((p.as_dvec3() - low.as_dvec3()) / size as f64).as_vec3().to_array();
    let placed: Vec<[f32; 3]> = shape.positions.iter().map(place).collect();
    let position = document.short_positions(&placed);
    let mut attributes = BTreeMap::from([(Valid(Semantic::Positions), position)]);
    if !shape.normals.is_empty() {
        let normals = shape.normals.iter().map(|n| n.to_array());
        attributes.insert(Valid(Semantic::Normals), document.shorts(normals, true));
    }
    if !shape.tangents.is_empty() {
        let tangents = shape.tangents.iter().map(|t| t.to_array());
        attributes.insert(Valid(Semantic::Tangents), document.shorts(tangents, true));
    }
    let uvs = shape.uvs.iter().map(|uv| uv.to_array());
    attributes.insert(Valid(Semantic::TexCoords(0)), document.shorts(uvs, false));
    attributes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geom::Similarity;
    use crate::image::srgb_from_linear;
    use crate::io::{Limits, parse_photo};
    use crate::mesh::files::{Lobe, textured::tests::tetrahedron};
    use crate::mesh::files::{Texture, read, read_whole, weld};
    use std::path::Path;

    /// A strip of `vertices` points on a helix, coloured.
    fn strip(vertices: u32) -> Mesh {
        let at = |i: u32| Vec3::new((i as f32 * 0.1).cos(), i as f32 * 1e-3, (i as f32 * 0.1).sin());
        Mesh {
            positions: (0..vertices).map(at).collect(),
            normals: (0..vertices).map(|_| Vec3::Y).collect(),
            colors: (0..vertices).map(|i| [i as f32 / vertices as f32, 0.5, 1.0]).collect(),
            triangles: (0..vertices - 2).map(|i| [i, i + 1, i + 2]).collect(),
        }
    }

    fn json_of(glb: &[u8]) -> serde_json::Value {
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        serde_json::from_slice(&glb[20..20 + length]).unwrap()
    }

    #[test]
    fn what_is_written_reads_back() {
        let mesh = strip(100);
        let glb = to_glb(&mesh, &ExportOptions::default()).unwrap();
        let back = read(&glb, Path::new("a.glb")).unwrap();
        assert_eq!(
            (&back.positions, &back.normals, &back.triangles),
            (&mesh.positions, &mesh.normals, &mesh.triangles)
        );
        for (a, b) in back.colors.as_flattened().iter().zip(mesh.colors.as_flattened()) {
            assert!((a - b).abs() < 1e-5);
        }
        // 0.5 coded is 0.2140 linear (IEC 61966-2-1)
        assert!(
            (linear_from_srgb(0.5) - 0.2140).abs() < 1e-4 && (srgb_from_linear(0.2140) - 0.5).abs() < 1e-3
        );
    }

    #[test]
    fn indices_grow_to_four_bytes_at_65535_vertices() {
        for (vertices, component) in [(65_534, 5123), (65_535, 5125), (65_536, 5125)] {
            let glb = to_glb(&strip(vertices), &ExportOptions::default()).unwrap();
            let json = json_of(&glb);
            let at = json["meshes"][0]["primitives"][0]["indices"].as_u64().unwrap() as usize;
            assert_eq!(json["accessors"][at]["componentType"], component);
            let back = read(&glb, Path::new("a.glb")).unwrap();
            assert_eq!(back.triangles.last().unwrap()[2], vertices - 1);
        }
    }

    #[test]
    fn the_document_says_what_it_must() {
        let options =
            ExportOptions {
                name: "Büste 頭".into(), up: Vec3::Z, unit_m: 0.001, ..ExportOptions::default()
            };
        let mut mesh = strip(10);
        mesh.positions[3] = Vec3::new(0.1, 0.2, 0.3);
        let glb = to_glb(&mesh, &options).unwrap();
        assert_eq!(&glb[..4], b"glTF");
        assert_eq!(u32::from_le_bytes(glb[8..12].try_into().unwrap()) as usize, glb.len());
        assert_eq!(glb.len() % 4, 0);
        let json = json_of(&glb);
        assert_eq!(json["nodes"][0]["name"], "Büste 頭");
        assert_eq!(json["extensionsUsed"][0], "KHR_materials_unlit");
        assert!(json.get("extensionsRequired").is_none());
        assert_eq!(json["materials"][0]["pbrMetallicRoughness"]["metallicFactor"], 0.0);
        assert!(json["asset"]["generator"].as_str().unwrap().starts_with("tiface "));
        for view in json["bufferViews"].as_array().unwrap() {
            assert_eq!(view["byteOffset"].as_u64().unwrap() % 4, 0);
        }
        // (0.1, 0.2, 0.3) mm, z up → (0.1, 0.3, −0.2) mm
        let back = read(&glb, Path::new("a.glb")).unwrap();
        assert!(back.positions[3].distance(Vec3::new(1e-4, 3e-4, -2e-4)) < 1e-10);
        let max: Vec<f64> = serde_json::from_value(json["accessors"][0]["max"].clone()).unwrap();
        assert_eq!(max[0] as f32, back.bounds().max.x);
        let lit = to_glb(&mesh, &ExportOptions { unlit: false, ..options }).unwrap();
        assert!(json_of(&lit).get("extensionsUsed").is_none());
    }

    #[test]
    fn a_distant_mesh_is_carried_by_its_node() {
        let mut mesh = strip(50);
        for p in &mut mesh.positions {
            *p += Vec3::new(0.0, 10_000.0, 0.0);
        }
        let glb = to_glb(&mesh, &ExportOptions::default()).unwrap();
        assert!((json_of(&glb)["nodes"][0]["translation"][1].as_f64().unwrap() - 10_000.0).abs() < 1.0);
        let back = read(&glb, Path::new("a.glb")).unwrap();
        assert!(back.positions.iter().zip(&mesh.positions).all(|(a, b)| a.distance(*b) < 1e-3));
    }

    #[test]
    fn a_texture_replaces_the_vertex_colours_and_reads_back_exactly() {
        let (mesh, atlas, color) = tetrahedron();
        let textured = Textured::new(&mesh, &atlas, &color);
        let options = ExportOptions::default();
        let out = textured_to_glb(&textured, &options, &TextureOptions::default()).unwrap();
        assert_eq!((out.files[0].0.as_str(), out.files.len(), out.warnings.len()), ("head.glb", 1, 0));
        let json = json_of(&out.files[0].1);
        let attributes = json["meshes"][0]["primitives"][0]["attributes"].as_object().unwrap();
        assert_eq!(attributes.keys().collect::<Vec<_>>(), ["NORMAL", "POSITION", "TEXCOORD_0"]);
        let sampler = json!({"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071});
        assert_eq!(json["samplers"][0], sampler);
        let back = read_whole(&out.files[0].1, Path::new("a.glb")).unwrap();
        let Some(Texture::Inside(bytes)) = &back.texture else { panic!("{:?}", back.texture) };
        assert_eq!(parse_photo(bytes, Path::new("a"), &Limits::default()).unwrap(), color);
        let read_atlas = back.atlas.as_ref().unwrap();
        assert_eq!((read_atlas.width, read_atlas.height), (8, 4));
        for t in 0..4 {
            assert_eq!(back.mesh.corners(t), mesh.corners(t));
            assert_eq!(read_atlas.corners(t), atlas.corners(t));
        }
        assert!(!back.mesh.is_closed() && weld(&back.mesh).is_closed());
        assert_eq!(weld(&back.mesh).positions.len(), 4);
        assert_eq!(out, textured_to_glb(&textured, &options, &TextureOptions::default()).unwrap());
    }

    #[test]
    fn a_normal_map_brings_tangents_and_lobes_are_variants_with_notes() {
        let (mesh, atlas, color) = tetrahedron();
        let lobes = ["one", "two"].map(|name| Lobe { name: name.into(), picture: &color }).to_vec();
        let mut extras = Map::new();
        extras.insert("kind".into(), "spherical gaussian".into());
        let textured =
            Textured { normal: Some(&color), lobes, extras, ..Textured::new(&mesh, &atlas, &color) };
        let jpeg = TextureOptions { picture: PictureFormat::Jpeg { quality: 90 }, ..Default::default() };
        let out = textured_to_glb(&textured, &ExportOptions::default(), &jpeg).unwrap();
        let json = json_of(&out.files[0].1);
        let primitive = &json["meshes"][0]["primitives"][0];
        assert!(primitive["attributes"]["TANGENT"].is_number());
        let mimes: Vec<&str> =
            json["images"].as_array().unwrap().iter().map(|i| i["mimeType"].as_str().unwrap()).collect();
        assert_eq!(mimes, ["image/jpeg", "image/png", "image/jpeg", "image/jpeg"]);
        let ours = &json["materials"][0]["extras"]["tiface"];
        assert_eq!(ours["kind"], "spherical gaussian");
        assert_eq!(ours["lobes"][1], json!({"name": "two", "texture": 3, "material": 2, "variant": 1}));
        let mapping = &primitive["extensions"]["KHR_materials_variants"]["mappings"][1];
        assert_eq!(mapping, &json!({"material": 2, "variants": [1]}));
        assert_eq!(json["materials"][2]["pbrMetallicRoughness"]["baseColorTexture"]["index"], 3);
        let variants = &json["extensions"]["KHR_materials_variants"]["variants"];
        assert_eq!(variants, &json!([{"name": "one"}, {"name": "two"}]));
        assert!(json.get("extensionsRequired").is_none());
        let back = read_whole(&out.files[0].1, Path::new("a.glb")).unwrap();
        assert!(matches!(&back.texture, Some(Texture::Inside(b)) if b.starts_with(&[0xff, 0xd8])));
    }

    #[test]
    fn quantised_files_are_close_still_closed_and_come_with_a_warning() {
        let (mut mesh, atlas, color) = tetrahedron();
        for p in &mut mesh.positions {
            *p = *p * 0.25 + Vec3::new(0.5, 100.0, 1.0 / 3.0);
        }
        let textured = Textured { normal: Some(&color), ..Textured::new(&mesh, &atlas, &color) };
        let texture = TextureOptions { quantize: true, ..Default::default() };
        let out = textured_to_glb(&textured, &ExportOptions::default(), &texture).unwrap();
        assert!(out.warnings[0].contains("trimesh") && out.warnings[0].contains("open3d"));
        let json = json_of(&out.files[0].1);
        assert_eq!(json["extensionsRequired"], json!(["KHR_mesh_quantization"]));
        assert_eq!(json["accessors"][0]["max"], json!([65535, 65535, 65535]));
        let back = read_whole(&out.files[0].1, Path::new("a.glb")).unwrap();
        for t in 0..4 {
            for (a, b) in back.mesh.corners(t).iter().zip(mesh.corners(t)) {
                let a = (a.as_dvec3() + back.origin).as_vec3();
                // half of 0.25 / 65,535 is 1.9e-6; f32 at 100 m resolves 7.6e-6
                assert!(a.distance(b) < 1.2e-5, "{a} {b}");
            }
            for (a, b) in back.atlas.as_ref().unwrap().corners(t).iter().zip(atlas.corners(t)) {
                assert!(a.distance(b) < 8.0 / 65_535.0);
            }
        }
        assert!(weld(&back.mesh).is_closed());
    }

    #[test]
    fn a_distant_quantised_mesh_stands_where_it_should_to_the_micrometre() {
        let (mesh, atlas, color) = tetrahedron();
        let place = Similarity::scale_translate(0.25, DVec3::new(5e6, -3e6, 2e5 + 0.1));
        let options = ExportOptions { world_from_mesh: place, ..ExportOptions::default() };
        let texture = TextureOptions { quantize: true, ..Default::default() };
        let out = textured_to_glb(&Textured::new(&mesh, &atlas, &color), &options, &texture).unwrap();
        let json = json_of(&out.files[0].1);
        let vector = |what: &str| -> DVec3 {
            DVec3::from(serde_json::from_value::<[f64; 3]>(json["nodes"][0][what].clone()).unwrap())
        };
        // the corner of the cube is the tetrahedron's own, to within f32 around its middle
        assert!(vector("translation").distance(place.translation) < 1e-7, "{}", vector("translation"));
        assert!(vector("scale").distance(DVec3::splat(0.25)) < 1e-7);
    }

    #[test]
    fn an_empty_mesh_is_an_error() {
        assert_eq!(to_glb(&Mesh::default(), &ExportOptions::default()), Err(ExportError::Empty));
    }
}
