//! A mesh as GLB: glTF 2.0, binary, one file (Khronos, *glTF 2.0 Specification*).
//!
//! Right-handed, +Y up, meters, counter-clockwise. Colors that already hold the light are marked
//! `KHR_materials_unlit`, beside a rough non-metal for viewers that do not know it.
//!
//! Color is either the vertices' own or a texture's, never both, since viewers multiply them:
//! `COLOR_0` is **linear** light, while our vertex colors and pictures are sRGB-coded. Pictures lie
//! in the file. A mesh far from the origin is written around its middle, which its node carries in
//! f64: its shape is as exact as that of any other.
//!
//! Layers around the mesh ([`Shells`]) are a mesh of their own, a child of the mesh's node, which
//! is then what is opaque under them ([`Shells::on_core`]): one primitive each, the innermost
//! first, blended, with the mesh's base color times the alpha of `COLOR_0`, drawn from both sides,
//! since path tracers draw both anyway. glTF defines no drawing order: the layers look right where
//! primitives are drawn in the file's order, after all opaque ones, or sorted by distance. Their
//! material says `"extras": { "tiface": { "soft_layers": 4 } }`.
//!
//! How many cameras see a vertex is its attribute `_SEEN_BY`, if the mesh knows: a number as float,
//! which programs that import attributes can mask by.
//!
//! [`ExportOptions::compress`] stores arrays as `EXT_meshopt_compression`: a fifth of the bytes,
//! for programs that know it. Vertices and triangles come in another order then, and lobes are half
//! as fine.
//!
//! Textures that depend on the view: tools may drop a texture that nothing refers to, and the
//! Khronos validator warns about a texture that only `extras` refers to. So each lobe is the base
//! color of a material of its own, which the primitive offers as a variant
//! (`KHR_materials_variants`). Viewers show the first material unless the user selects a variant;
//! viewers without support for variants always do. The first material, and that of the layers,
//! describe how to use the lobes, whose directions are turned to the file's coordinates:
//!
//! ```json
//! "extras": { "tiface": {
//!   "lobes": [ { "name": "lobe 0", "texture": 1, "material": 1, "variant": 0 } ],
//!   "view_dependent_color": { …how their bytes become a color… } } }
//! ```

use super::file_mesh::{ExportOptions, FileMesh, encode};
use super::glb_document::GlbDocument;
use super::head_texture::{HeadTexture, LOBE_TEXEL, Lobes};
use super::meshopt::Encoder;
use super::wrong_length;
use glam::Vec3;
use gltf::json::extensions::scene::khr_materials_variants::Variant;
use gltf::json::extensions::{material, mesh, root};
use gltf::json::material::{NormalTexture, PbrMetallicRoughness, StrengthFactor};
use gltf::json::mesh::{Mode, Primitive, Semantic};
use gltf::json::texture::Info;
use gltf::json::validation::Checked::Valid;
use gltf::json::{self, Index, Material, Texture, Value};
use serde_json::{Map, json};
use std::collections::BTreeMap;
use tiface_base::Result;
use tiface_base::geom::{Aabb, Mesh, ShellLayer, Shells};
use tiface_base::image::{Photo, linear_from_srgb, quantize};

/// Returns a mesh as the bytes of a `.glb` file, with the pictures of its texture inside; without a
/// texture it is colored by its vertices.
///
/// # Errors
///
/// Fails if the mesh is empty or damaged, if texture and mesh do not belong together, if an option
/// is invalid, or if the file would exceed 4 GiB.
///
/// # Examples
///
/// ```
/// use glam::Vec3;
/// use std::path::Path;
/// use tiface_base::geom::Mesh;
/// use tiface_surface::files::{ExportOptions, read, to_glb};
///
/// let tetrahedron = Mesh {
///     positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
///     triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
///     ..Mesh::default()
/// };
/// let glb = to_glb(&tetrahedron, None, None, &ExportOptions::default())?;
/// assert_eq!(read(&glb, Path::new("a.glb"))?, tetrahedron);
/// # Ok::<(), tiface_base::Error>(())
/// ```
pub fn to_glb(
    mesh: &Mesh,
    texture: Option<&HeadTexture>,
    shells: Option<&Shells>,
    options: &ExportOptions,
) -> Result<Vec<u8>> {
    let file_from_mesh = options.file_from_mesh()?;
    // a mesh without normals has no layers
    let shells = shells.filter(|_| !mesh.normals.is_empty());
    if let Some(Shells { layers, depths }) = shells {
        let of_layer = |l: &ShellLayer| [("offsets", l.offsets.len()), ("alphas", l.alphas.len())];
        let depths = (!depths.is_empty()).then_some(("depths", depths.len()));
        for (what, found) in layers.iter().flat_map(of_layer).chain(depths) {
            if found != mesh.positions.len() {
                return Err(wrong_length(found, what, mesh.positions.len()));
            }
        }
    }
    let shown = shells.map(|shells| shells.on_core(mesh));
    let (mesh, shells) = shown.as_ref().map_or((mesh, None), |(core, shells)| (core, Some(shells)));
    let file = FileMesh::new(mesh, texture, &file_from_mesh)?;
    let mut file = file.split(texture.is_some_and(|t| t.normal.is_some()));
    let mut document = GlbDocument::default();
    if options.compress {
        file = file.in_cache_order();
        let offsets = shells.iter().flat_map(|s| &s.layers).flat_map(|layer| &layer.offsets);
        let margin = file_from_mesh.scale as f32 * offsets.fold(0.0f32, |most, o| most.max(o.abs()));
        document.encoder = Some(Encoder::new(Aabb::around(file.positions.iter().copied()).grown(margin)));
    }
    let mut main = material(options, options.name.clone());
    let (mut lobes, mut notes) = (Vec::new(), Map::new());
    if let Some(texture) = texture {
        file.colors = Vec::new(); // viewers would multiply them into the texture
        let mut picture = |name: &str, picture: &Photo, quality| -> Result<Index<json::Texture>> {
            let (bytes, ending) = encode(name, picture, quality)?;
            let mime = if ending == "png" { "image/png" } else { "image/jpeg" };
            Ok(document.texture(name, &bytes, mime))
        };
        let color = picture("base color", &texture.color, options.jpeg_quality)?;
        main.pbr_metallic_roughness.base_color_texture = Some(info(color));
        if let Some(map) = &texture.normal {
            let index = picture("normal map", map, None)?;
            let extras = Default::default();
            main.normal_texture =
                Some(NormalTexture { index, scale: 1.0, tex_coord: 0, extensions: None, extras });
        }
        // a reader knows no coordinates but the file's
        let turned = texture.lobes.as_ref().and_then(|l| l.in_coordinates(file_from_mesh.rotation_f32()));
        // half as fine where bytes count: four lobes weigh as much as the color otherwise
        let finest = texture.color.width.max(texture.color.height).div_ceil(2 * LOBE_TEXEL);
        let turned = if options.compress { turned.map(|l| l.reduced(finest)) } else { turned };
        for (k, lobe) in turned.iter().flat_map(|l| &l.pictures).enumerate() {
            lobes.push(picture(&lobe_name(k), lobe, None)?);
        }
        notes = turned.map(|l| lobe_notes(&l, &lobes)).unwrap_or_default();
    }
    if !notes.is_empty() {
        main.extras = extras(notes.clone());
    }
    let main = document.root.push(main);
    let variants = (!lobes.is_empty()).then(|| variants(&mut document, &lobes, options));
    let layers = match shells {
        Some(shells) => {
            let scale = file_from_mesh.scale as f32;
            let texture =
                document.root.materials[main.value()].pbr_metallic_roughness.base_color_texture.clone();
            soft_layers(&mut document, &file, (shells, scale), (texture, notes), options)
        }
        None => None,
    };
    finish(document, &file, main, variants, layers, options)
}

/// Writes soft layers as a glTF mesh; see the head of this file. They have the mesh's texture, and
/// its notes about lobes. `None` if no layer is visible.
fn soft_layers(
    document: &mut GlbDocument,
    file: &FileMesh,
    (shells, scale): (&Shells, f32),
    (texture, mut notes): (Option<json::texture::Info>, Map<String, Value>),
    options: &ExportOptions,
) -> Option<json::Mesh> {
    let name = format!("{} soft layers", options.name);
    let mut soft = material(options, name.clone());
    soft.pbr_metallic_roughness.base_color_texture = texture;
    soft.alpha_mode = Valid(json::material::AlphaMode::Blend);
    soft.double_sided = true;
    let white = [1.0; 3];
    let mut primitives = Vec::new();
    for layer in &shells.layers {
        let part = file.under(layer);
        if part.triangles.is_empty() {
            continue;
        }
        let indices = document.indices(&part.triangles, part.positions.len());
        let color = |(v, source): (usize, &u32)| {
            let [r, g, b] = part.colors.get(v).map_or(white, |c| c.map(linear_from_srgb));
            [r, g, b, layer.alphas[*source as usize]].map(quantize)
        };
        let colors: Vec<[u8; 4]> = part.source.iter().enumerate().map(color).collect();
        let mut attributes = BTreeMap::from([
            (Valid(Semantic::Positions), document.positions(&part.moved(layer, scale))),
            (Valid(Semantic::Colors(0)), document.bytes(&colors)),
        ]);
        if !part.uvs.is_empty() {
            attributes.insert(Valid(Semantic::TexCoords(0)), document.uvs(&part.uvs));
        }
        // an unlit material needs no normals
        if !options.unlit {
            attributes.insert(Valid(Semantic::Normals), document.directions(&part.normals));
        }
        primitives.push(primitive(attributes, indices));
    }
    if primitives.is_empty() {
        return None;
    }
    notes.insert("soft_layers".into(), json!(primitives.len()));
    soft.extras = extras(notes);
    let material = document.root.push(soft);
    primitives.iter_mut().for_each(|p| p.material = Some(material));
    Some(mesh(primitives, Some(name)))
}

fn mesh(primitives: Vec<Primitive>, name: Option<String>) -> json::Mesh {
    json::Mesh { primitives, name, weights: None, extensions: None, extras: Default::default() }
}

fn primitive(attributes: Attributes, indices: Index<json::Accessor>) -> Primitive {
    Primitive {
        attributes,
        indices: Some(indices),
        material: None,
        mode: Valid(Mode::Triangles),
        extensions: None,
        extras: Default::default(),
        targets: None,
    }
}

fn lobe_name(k: usize) -> String {
    format!("lobe {k}")
}

/// Adds one material for each lobe, offered by the primitive as variants.
fn variants(
    document: &mut GlbDocument,
    lobes: &[Index<json::Texture>],
    options: &ExportOptions,
) -> mesh::KhrMaterialsVariants {
    let (mut mappings, mut names) = (Vec::new(), Vec::new());
    for (variant, &texture) in lobes.iter().enumerate() {
        let name = lobe_name(variant);
        let mut material = material(options, name.clone());
        material.pbr_metallic_roughness.base_color_texture = Some(info(texture));
        let material = document.root.push(material).value() as u32;
        mappings.push(mesh::Mapping { material, variants: vec![variant as u32] });
        names.push(Variant { name });
    }
    document.root.extensions_used.push("KHR_materials_variants".into());
    document.root.extensions =
        Some(root::Root { khr_materials_variants: Some(root::KhrMaterialsVariants { variants: names }) });
    mesh::KhrMaterialsVariants { mappings }
}

/// Returns what a material's `extras` say about the lobes; see the head of this file.
fn lobe_notes(lobes: &Lobes, textures: &[Index<json::Texture>]) -> Map<String, Value> {
    let list = textures.iter().enumerate().map(|(i, texture)| {
        json!({"name": lobe_name(i), "texture": texture.value(), "material": i + 1, "variant": i})
    });
    let model = json!({
        "basis": "real spherical harmonics, order and signs of tiny-cuda-nn, of the unit direction from the \
                  surface to the viewer in the asset's coordinates",
        "functions": lobes.pictures.len(),
        "scale": lobes.scale,
        "decode": "(byte - 128) / 127 * scale",
        "color": "base color + sum of decoded lobes times basis, all sRGB-coded",
    });
    Map::from_iter([
        ("view_dependent_color".into(), model),
        ("lobes".into(), list.collect::<Vec<Value>>().into()),
    ])
}

/// Returns our `extras` of a material.
fn extras(notes: Map<String, Value>) -> json::Extras {
    let text = json!({ "tiface": notes }).to_string();
    Some(json::extras::RawValue::from_string(text).expect("a value is valid JSON"))
}

fn material(options: &ExportOptions, name: String) -> Material {
    let unlit = || material::Material { unlit: Some(material::Unlit {}) };
    Material {
        name: Some(name),
        pbr_metallic_roughness: PbrMetallicRoughness {
            metallic_factor: StrengthFactor(0.0),
            roughness_factor: StrengthFactor(1.0),
            ..Default::default()
        },
        extensions: options.unlit.then(unlit),
        ..Default::default()
    }
}

/// Adds the mesh with its material and packs the file.
fn finish(
    mut document: GlbDocument,
    file: &FileMesh,
    material: Index<Material>,
    variants: Option<mesh::KhrMaterialsVariants>,
    layers: Option<json::Mesh>,
    options: &ExportOptions,
) -> Result<Vec<u8>> {
    let name = Some(options.name.clone());
    let grid = document.encoder.as_ref().map(|encoder| (encoder.center, encoder.step));
    let place = file.translated(grid.map_or(Vec3::ZERO, |(center, _)| center));
    let is_placed = file.is_far() || grid.is_some();
    let translation = is_placed.then(|| place.as_vec3().to_array());
    let scale = grid.map(|(_, step)| [step; 3]);
    let attributes = attributes(&mut document, file);
    let indices = document.indices(&file.triangles, file.positions.len());
    let root = &mut document.root;
    let primitive = Primitive {
        material: Some(material),
        extensions: variants.map(|v| mesh::Primitive { khr_materials_variants: Some(v) }),
        ..primitive(attributes, indices)
    };
    let mesh = root.push(mesh(vec![primitive], Some(options.name.clone())));
    let node = root.push(json::Node { name, translation, scale, mesh: Some(mesh), ..Default::default() });
    if let Some(layers) = layers {
        let name = layers.name.clone();
        let mesh = Some(root.push(layers));
        let child = root.push(json::Node { name, mesh, ..Default::default() });
        root.nodes[node.value()].children = Some(vec![child]);
    }
    let (extensions, extras) = Default::default();
    let scene = json::Scene { nodes: vec![node], name: None, extensions, extras };
    document.root.scene = Some(document.root.push(scene));
    if options.unlit {
        document.root.extensions_used.push("KHR_materials_unlit".into());
    }
    // within f32's precision its shortest digits suffice
    document.placed = is_placed.then_some((node, place));
    document.pack()
}

type Attributes = BTreeMap<json::validation::Checked<Semantic>, Index<json::Accessor>>;

fn attributes(document: &mut GlbDocument, file: &FileMesh) -> Attributes {
    let mut attributes = BTreeMap::from([(Valid(Semantic::Positions), document.positions(&file.positions))]);
    if !file.normals.is_empty() {
        attributes.insert(Valid(Semantic::Normals), document.directions(&file.normals));
    }
    if !file.tangents.is_empty() {
        attributes.insert(Valid(Semantic::Tangents), document.tangents(&file.tangents));
    }
    if !file.uvs.is_empty() {
        attributes.insert(Valid(Semantic::TexCoords(0)), document.uvs(&file.uvs));
    }
    if !file.colors.is_empty() {
        let linear: Vec<Vec3> = file.colors.iter().map(|c| c.map(linear_from_srgb).into()).collect();
        attributes.insert(Valid(Semantic::Colors(0)), document.colors(&linear));
    }
    if !file.seen_by.is_empty() {
        let numbers: Vec<f32> = file.seen_by.iter().map(|&n| f32::from(n)).collect();
        attributes.insert(Valid(Semantic::Extras("SEEN_BY".into())), document.numbers(&numbers));
    }
    attributes
}

/// Returns a material's reference to a texture.
fn info(index: Index<Texture>) -> Info {
    Info { index, tex_coord: 0, extensions: None, extras: Default::default() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::file_mesh::tests::tetrahedron;
    use crate::files::{PictureSource, ReadOptions, read, read_with, weld};
    use std::path::Path;
    use tiface_base::geom::ShellLayer;
    use tiface_base::geom::sphharm::combine;
    use tiface_base::image::srgb_from_linear;
    use tiface_base::io::{Limits, parse_photo};

    /// Returns a strip of `vertices` points on a helix, colored.
    fn strip(vertices: u32) -> Mesh {
        let at = |i: u32| Vec3::new((i as f32 * 0.1).cos(), i as f32 * 1e-3, (i as f32 * 0.1).sin());
        Mesh {
            positions: (0..vertices).map(at).collect(),
            normals: (0..vertices).map(|_| Vec3::Y).collect(),
            colors: (0..vertices).map(|i| [i as f32 / vertices as f32, 0.5, 1.0]).collect(),
            seen_by: Vec::new(),
            triangles: (0..vertices - 2).map(|i| [i, i + 1, i + 2]).collect(),
        }
    }

    #[test]
    fn a_file_says_how_many_cameras_see_each_vertex() {
        let mesh = Mesh { seen_by: vec![0, 1, 2, 3, 255], ..strip(5) };
        let glb = to_glb(&mesh, None, None, &ExportOptions::default()).unwrap();
        let json = json_of(&glb);
        let accessor = &json["meshes"][0]["primitives"][0]["attributes"]["_SEEN_BY"];
        let accessor = &json["accessors"][accessor.as_u64().unwrap() as usize];
        assert_eq!((&accessor["type"], &accessor["componentType"]), (&"SCALAR".into(), &5126.into()));
        // vertices, not indices
        let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        assert_eq!(view["target"], 34962);
        assert_eq!(read(&glb, Path::new("a.glb")).unwrap().seen_by, mesh.seen_by);
        // split at seams
        let head = crate::files::testing::tetrahedron();
        let glb = to_glb(&head.mesh, head.texture.as_ref(), None, &ExportOptions::default()).unwrap();
        let back = read(&glb, Path::new("a.glb")).unwrap();
        for (p, n) in back.positions.iter().zip(&back.seen_by) {
            let of = head.mesh.positions.iter().position(|q| q == p).unwrap();
            assert_eq!(*n, head.mesh.seen_by[of], "{p}");
        }
        assert_eq!(back.seen_by.len(), back.positions.len());
    }

    fn json_of(glb: &[u8]) -> serde_json::Value {
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        serde_json::from_slice(&glb[20..20 + length]).unwrap()
    }

    #[test]
    fn what_is_written_reads_back() {
        let mesh = strip(100);
        let glb = to_glb(&mesh, None, None, &ExportOptions::default()).unwrap();
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
            let glb = to_glb(&strip(vertices), None, None, &ExportOptions::default()).unwrap();
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
        let glb = to_glb(&mesh, None, None, &options).unwrap();
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
        let lit = to_glb(&mesh, None, None, &ExportOptions { unlit: false, ..options }).unwrap();
        assert!(json_of(&lit).get("extensionsUsed").is_none());
    }

    #[test]
    fn a_distant_mesh_is_carried_by_its_node() {
        let mut mesh = strip(50);
        for p in &mut mesh.positions {
            *p += Vec3::new(0.0, 10_000.0, 0.0);
        }
        let glb = to_glb(&mesh, None, None, &ExportOptions::default()).unwrap();
        assert!((json_of(&glb)["nodes"][0]["translation"][1].as_f64().unwrap() - 10_000.0).abs() < 1.0);
        let back = read(&glb, Path::new("a.glb")).unwrap();
        assert!(back.positions.iter().zip(&mesh.positions).all(|(a, b)| a.distance(*b) < 1e-3));
    }

    #[test]
    fn a_texture_replaces_the_vertex_colors_and_reads_back_exactly() {
        let (mesh, texture) = tetrahedron();
        let (atlas, options) = (&texture.atlas, ExportOptions::default());
        let glb = to_glb(&mesh, Some(&texture), None, &options).unwrap();
        let json = json_of(&glb);
        let attributes = json["meshes"][0]["primitives"][0]["attributes"].as_object().unwrap();
        assert_eq!(attributes.keys().collect::<Vec<_>>(), ["NORMAL", "POSITION", "TEXCOORD_0"]);
        let sampler = json!({"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071});
        assert_eq!(json["samplers"][0], sampler);
        let back = read_with(&glb, Path::new("a.glb"), &ReadOptions::default()).unwrap();
        let Some(PictureSource::Inside(bytes)) = &back.picture else { panic!("{:?}", back.picture) };
        assert_eq!(parse_photo(bytes, Path::new("a"), &Limits::default()).unwrap(), texture.color);
        let read_atlas = back.atlas.as_ref().unwrap();
        assert_eq!((read_atlas.width, read_atlas.height), (8, 4));
        for t in 0..4 {
            assert_eq!(back.mesh.corners(t), mesh.corners(t));
            assert_eq!(read_atlas.corners(t), atlas.corners(t));
        }
        assert!(!back.mesh.is_closed() && weld(&back.mesh).is_closed());
        assert_eq!(weld(&back.mesh).positions.len(), 4);
        assert_eq!(glb, to_glb(&mesh, Some(&texture), None, &options).unwrap());
    }

    #[test]
    fn a_normal_map_brings_tangents_and_lobes_are_variants_with_notes() {
        let (mesh, mut texture) = tetrahedron();
        let color = texture.color.clone();
        texture.normal = Some(color.clone());
        let pictures = vec![color.clone(), color];
        texture.lobes = Some(Lobes { pictures, scale: vec![0.5, 0.25], turned: glam::Mat3::IDENTITY });
        let jpeg = ExportOptions { jpeg_quality: Some(90), ..ExportOptions::default() };
        let glb = to_glb(&mesh, Some(&texture), None, &jpeg).unwrap();
        let json = json_of(&glb);
        let primitive = &json["meshes"][0]["primitives"][0];
        assert!(primitive["attributes"]["TANGENT"].is_number());
        let mimes: Vec<&str> =
            json["images"].as_array().unwrap().iter().map(|i| i["mimeType"].as_str().unwrap()).collect();
        assert_eq!(mimes, ["image/jpeg", "image/png", "image/png", "image/png"]);
        let ours = &json["materials"][0]["extras"]["tiface"];
        assert_eq!(ours["view_dependent_color"]["scale"], json!([0.5, 0.25]));
        assert_eq!(ours["lobes"][1], json!({"name": "lobe 1", "texture": 3, "material": 2, "variant": 1}));
        let mapping = &primitive["extensions"]["KHR_materials_variants"]["mappings"][1];
        assert_eq!(mapping, &json!({"material": 2, "variants": [1]}));
        assert_eq!(json["materials"][2]["pbrMetallicRoughness"]["baseColorTexture"]["index"], 3);
        let variants = &json["extensions"]["KHR_materials_variants"]["variants"];
        assert_eq!(variants, &json!([{"name": "lobe 0"}, {"name": "lobe 1"}]));
        assert!(json.get("extensionsRequired").is_none());
        let back = read_with(&glb, Path::new("a.glb"), &ReadOptions::default()).unwrap();
        assert!(matches!(&back.picture, Some(PictureSource::Inside(b)) if b.starts_with(&[0xff, 0xd8])));
    }

    #[test]
    fn lobes_add_the_same_color_in_every_frame_of_the_file() {
        let head = crate::files::testing::tetrahedron();
        let texture = head.texture.as_ref().unwrap();
        let kept = texture.lobes.as_ref().unwrap();
        let decoded = |pictures: &[tiface_base::image::Photo], scale: &[f32]| -> Vec<[f32; 3]> {
            let value = |(p, s): (&tiface_base::image::Photo, &f32)| {
                p.rgb[9].map(|b| (f32::from(b) - 128.0) / 127.0 * s)
            };
            pictures.iter().zip(scale).map(value).collect()
        };
        let own = decoded(&kept.pictures, &kept.scale);
        for up in [Vec3::Y, Vec3::Z, Vec3::new(0.6, 0.0, -0.8)] {
            let options = ExportOptions { up, ..ExportOptions::default() };
            let glb = to_glb(&head.mesh, Some(texture), None, &options).unwrap();
            let json = json_of(&glb);
            let notes = &json["materials"][0]["extras"]["tiface"];
            let scale: Vec<f32> =
                serde_json::from_value(notes["view_dependent_color"]["scale"].clone()).unwrap();
            let bin = &glb[28 + u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize..];
            let picture = |lobe: &serde_json::Value| {
                let texture = &json["textures"][lobe["texture"].as_u64().unwrap() as usize];
                let image = &json["images"][texture["source"].as_u64().unwrap() as usize];
                let view = &json["bufferViews"][image["bufferView"].as_u64().unwrap() as usize];
                let at = view["byteOffset"].as_u64().unwrap_or(0) as usize;
                let bytes = &bin[at..at + view["byteLength"].as_u64().unwrap() as usize];
                parse_photo(bytes, Path::new("a"), &Limits::default()).unwrap()
            };
            let pictures: Vec<_> = notes["lobes"].as_array().unwrap().iter().map(picture).collect();
            assert_eq!((pictures.len(), pictures[0].width), (4, 4));
            let found = decoded(&pictures, &scale);
            let file_from_mesh = options.file_from_mesh().unwrap().rotation_f32();
            for d in [Vec3::X, Vec3::NEG_Y, Vec3::new(0.6, 0.0, -0.8), Vec3::new(-0.48, 0.64, 0.6)] {
                let was = Vec3::from(combine(&own, (kept.turned * d).to_array()));
                let is = Vec3::from(combine(&found, (file_from_mesh * d).to_array()));
                // four functions of about 0.5, each rounded by half a 48th of up to 0.4
                assert!(is.abs_diff_eq(was, 0.01) && was.length() > 0.05, "{up} {d}: {is} {was}");
            }
        }
    }

    #[test]
    fn an_empty_mesh_is_an_error() {
        let e = to_glb(&Mesh::default(), None, None, &ExportOptions::default()).unwrap_err();
        assert!(e.to_string().contains("no triangles"), "{e}");
    }

    #[test]
    fn soft_layers_are_a_mesh_of_their_own_that_no_reader_of_ours_takes_for_the_surface() {
        let head = crate::files::testing::tetrahedron();
        let options = ExportOptions { unit_m: 0.5, ..ExportOptions::default() };
        // the surface is what is opaque under the layers: a quarter of a unit deeper, along +z
        let core = head.clone().as_drawn().mesh;
        let deeper = |(a, b): (&Vec3, &Vec3)| (*a - *b).abs_diff_eq(Vec3::Z / 4.0, 1e-6);
        assert!(head.mesh.positions.iter().zip(&core.positions).all(deeper));
        let bare = to_glb(&core, head.texture.as_ref(), None, &options).unwrap();
        let glb = to_glb(&head.mesh, head.texture.as_ref(), head.shells.as_ref(), &options).unwrap();
        let surface = |glb: &[u8]| read(glb, Path::new("a.glb")).unwrap();
        assert_eq!(surface(&glb), surface(&bare));
        let json = json_of(&glb);
        // readers that take the first mesh or node get the head
        assert_eq!(json["nodes"][0]["children"], json!([1]));
        assert_eq!((&json["nodes"][1]["mesh"], &json["scenes"][0]["nodes"]), (&json!(1), &json!([0])));
        let layers = json["meshes"][1]["primitives"].as_array().unwrap();
        assert_eq!(layers.len(), 2);
        for layer in layers {
            let material = &json["materials"][layer["material"].as_u64().unwrap() as usize];
            assert_eq!(
                (&material["alphaMode"], &material["extras"]["tiface"]["soft_layers"]),
                (&json!("BLEND"), &json!(2))
            );
            assert_eq!(material["pbrMetallicRoughness"]["baseColorTexture"]["index"], 0);
            assert_eq!(material["doubleSided"], true);
            assert_eq!(
                json["accessors"][layer["attributes"]["COLOR_0"].as_u64().unwrap() as usize]["type"],
                "VEC4"
            );
        }
        // layers change with the view as the surface does
        for key in ["lobes", "view_dependent_color"] {
            let notes = json["materials"].as_array().unwrap().iter().map(|m| &m["extras"]["tiface"][key]);
            let notes: Vec<_> = notes.filter(|notes| !notes.is_null()).collect();
            assert!(notes.len() == 2 && notes[0] == notes[1], "{notes:?}");
        }
        // vertex 2 stands at y = 1, which is half a meter here, its normal is +z and the first
        // layer lies 0.3 before it
        let part = FileMesh::new(&head.mesh, None, &options.file_from_mesh().unwrap())
            .unwrap()
            .under(&head.shells.as_ref().unwrap().layers[0]);
        let at = part.source.iter().position(|&v| v == 2).unwrap();
        let moved = part.moved(&head.shells.unwrap().layers[0], 0.5);
        assert!(moved[at].distance(Vec3::new(0.0, 0.5, 0.15)) < 1e-6);
        assert_eq!(part.triangles.len(), 4);
    }

    /// Returns the bytes of an accessor of a GLB.
    fn bytes_of_accessor<'a>(glb: &'a [u8], json: &serde_json::Value, at: &serde_json::Value) -> &'a [u8] {
        let number = |v: &serde_json::Value| v.as_u64().unwrap_or(0) as usize;
        let accessor = &json["accessors"][number(at)];
        let view = &json["bufferViews"][number(&accessor["bufferView"])];
        let binary = &glb[20 + u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize + 8..];
        &binary[number(&view["byteOffset"])..][..number(&view["byteLength"])]
    }

    #[test]
    fn a_file_holds_the_triangles_of_each_layer_that_rays_meet() {
        // the first layer is on the first half of a strip, the second on a tenth in the middle
        let mesh = strip(200);
        let layer = |from: usize, to: usize| ShellLayer {
            offsets: vec![from as f32 * 1e-3 + 0.5; 200],
            alphas: (0..200).map(|v| if (from..to).contains(&v) { 51.0 / 255.0 } else { 0.0 }).collect(),
        };
        let shells = Shells { layers: vec![layer(0, 100), layer(90, 110)], ..Shells::default() };
        let glb = to_glb(&mesh, None, Some(&shells), &ExportOptions::default()).unwrap();
        let json = json_of(&glb);
        let primitives = json["meshes"][1]["primitives"].as_array().unwrap();
        assert_eq!(primitives.len(), 2);
        for (primitive, layer) in primitives.iter().zip(&shells.layers) {
            let floats = |name: &str| -> Vec<f32> {
                let bytes = bytes_of_accessor(&glb, &json, &primitive["attributes"][name]);
                bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
            };
            let at = floats("POSITION");
            let colors = bytes_of_accessor(&glb, &json, &primitive["attributes"]["COLOR_0"]);
            let indices = bytes_of_accessor(&glb, &json, &primitive["indices"]).as_chunks::<2>().0;
            let count = json["accessors"][primitive["indices"].as_u64().unwrap() as usize]["count"].as_u64();
            let corners: Vec<usize> =
                indices.iter().take(count.unwrap() as usize).map(|b| u16::from_le_bytes(*b).into()).collect();
            // what ray caster and rasterizer draw
            let (surface, _) = layer.surface(&mesh);
            assert_eq!(corners.len(), 3 * surface.triangles.len());
            let used = corners.iter().max().unwrap() + 1;
            assert!(used < 200 && at.len() == 3 * used, "no more vertices than its triangles have");
            for (&corner, &v) in corners.iter().zip(surface.triangles.as_flattened()) {
                let p = Vec3::new(at[3 * corner], at[3 * corner + 1], at[3 * corner + 2]);
                assert!(p.distance(surface.positions[v as usize]) < 1e-6);
                assert_eq!(f32::from(colors[4 * corner + 3]) / 255.0, layer.alphas[v as usize]);
            }
        }
    }
}
