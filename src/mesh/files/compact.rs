//! A GLB small enough to embed in a page, for display only.
//!
//! Data that is not displayed is dropped: other scenes, normal maps, tangents, unused pictures. Positions become 16
//! bit of the longest side (steps of 8 µm for a head), normals 8 bit, texture coordinates 16 bit
//! (`KHR_mesh_quantization`); the base color becomes a JPEG of at most [`COLOR_PX`] texels along a side, the
//! functions of view-dependent color, which are smooth, of [`LOBE_PX`]. A picture with alpha is kept unchanged. Parts
//! keep their order, because blended parts are drawn in it.
//!
//! A head of 50,000 triangles, 1,024² texels and four lobes (`draft`): 4.3 MB become 0.9.

use super::glb::{GlbDocument, extras, info, mesh, primitive};
use super::glb_json::GlbRoot;
use super::glb_read::{GlbReader, Primitives, QUANTIZED, chunks};
use super::source::{PictureSource, ReadOptions, Source};
use crate::image::{Photo, linear_from_srgb, reduce_photo, working_size};
use crate::io::{self, Limits};
use crate::{Error, Result};
use glam::{DVec3, Vec3};
use gltf::json::accessor::{ComponentType, Type};
use gltf::json::material::{AlphaCutoff, AlphaMode, PbrBaseColorFactor};
use gltf::json::mesh::{Primitive, Semantic};
use gltf::json::validation::Checked::Valid;
use gltf::json::{self, Index, Material};
use serde::Deserialize;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

/// Longest side of a base color.
const COLOR_PX: u32 = 2048;
/// Longest side of a function of view-dependent color.
const LOBE_PX: u32 = 512;
/// Errors of this JPEG are below those of the texture: 40 dB.
const QUALITY: u8 = 88;

/// Returns a smaller copy of a GLB, +Y up, with everything that viewers display of its default scene: triangles, base
/// colors and view-dependent colors. `path` is for messages only.
///
/// # Errors
///
/// Fails like [`super::read()`], and when a picture is broken or the mesh uses features that a page does not show.
pub fn compact_glb(bytes: &[u8], path: &Path) -> Result<Vec<u8>> {
    let source = Source { path, format: "GLB", options: &ReadOptions::DEFAULT };
    let glb = chunks(bytes, source)?;
    let root = GlbRoot::parse(&glb.json, source)?;
    let looks: FileMaterials =
        serde_json::from_slice(&glb.json).map_err(|e| source.broken("`materials`", e))?;
    let reader = GlbReader { root: &root, bin: glb.bin.as_deref().unwrap_or_default(), source };
    let (mut parts, mut file) = (Vec::new(), Packed::default());
    let (mut vertices, mut triangles) = (0, 0);
    reader.each_part(|part| {
        let mut own = Primitives::default();
        reader.add_triangles(part, &mut own)?;
        vertices += own.positions.len();
        triangles += own.mesh.triangles.len();
        source.allow(vertices, triangles)?;
        parts.push((own, part.primitive.material));
        Ok(())
    })?;
    parts.retain(|(part, _)| !part.mesh.triangles.is_empty());
    if parts.is_empty() {
        let what = format!("`{}` holds no triangles", path.display());
        return Err(Error::cannot(what, "export a surface, not points or curves"));
    }
    let all = || parts.iter().flat_map(|(part, _)| part.positions.iter().copied());
    let low = all().reduce(DVec3::min).unwrap_or_default();
    let size = (all().reduce(DVec3::max).unwrap_or_default() - low).max_element();
    let size = if size > 0.0 { size } else { 1.0 };
    let mut primitives = Vec::new();
    for (part, material) in &parts {
        let material = material.map(|m| file.material(m, &looks, &reader)).transpose()?;
        primitives.push(Primitive { material, ..file.primitive(part, low, size) });
    }
    let Packed { mut document, .. } = file;
    let mesh = Some(document.root.push(mesh(primitives, None)));
    let node = document.root.push(json::Node { mesh, ..Default::default() });
    document.show(node);
    document.placed = Some((node, low, size));
    document.root.extensions_used = vec![QUANTIZED.into()];
    document.root.extensions_required = vec![QUANTIZED.into()];
    document.pack()
}

/// The materials of a file.
#[derive(Deserialize)]
struct FileMaterials {
    #[serde(default)]
    materials: Vec<Value>,
}

/// A file under construction.
#[derive(Default)]
struct Packed {
    document: GlbDocument,
    /// New indices of the file's textures, with the side they were made for, and of its materials.
    known: (BTreeMap<(u32, u32), Index<json::Texture>>, BTreeMap<u32, Index<Material>>),
}

impl Packed {
    fn primitive(&mut self, part: &Primitives, low: DVec3, size: f64) -> Primitive {
        let document = &mut self.document;
        let short = |v: f32| (v * 65535.0).round() as u16;
        let place = |p: &DVec3| ((*p - low) / size * 65535.0).to_array().map(|v| v.round() as u16);
        let places: Vec<[u16; 4]> = part.positions.iter().map(place).map(|[x, y, z]| [x, y, z, 0]).collect();
        let position = document.normalized(&places, ComponentType::U16, Type::Vec3);
        let bound = |pick: fn(u16, u16) -> u16| {
            (0..3).map(|k| places.iter().map(|p| p[k]).reduce(pick)).collect::<Vec<_>>()
        };
        document.bound(position, [bound(u16::min), bound(u16::max)]);
        let mut attributes = BTreeMap::from([(Valid(Semantic::Positions), position)]);
        let (vertices, mesh) = (places.len(), &part.mesh);
        if mesh.normals.len() == vertices {
            let normal = |n: &Vec3| {
                let [x, y, z] = (*n * 127.0).round().to_array().map(|v| v as i8);
                [x, y, z, 0]
            };
            let normals: Vec<[i8; 4]> = mesh.normals.iter().map(normal).collect();
            let normals = document.normalized(&normals, ComponentType::I8, Type::Vec3);
            attributes.insert(Valid(Semantic::Normals), normals);
        }
        if part.uvs.len() == vertices {
            let inside = part.uvs.iter().all(|uv| (0.0..=1.0).contains(&uv.x) && (0.0..=1.0).contains(&uv.y));
            let uvs = if inside {
                let uvs: Vec<[u16; 2]> = part.uvs.iter().map(|uv| uv.to_array().map(short)).collect();
                document.normalized(&uvs, ComponentType::U16, Type::Vec2)
            } else {
                document.floats(&part.uvs)
            };
            attributes.insert(Valid(Semantic::TexCoords(0)), uvs);
        }
        if part.is_colored() {
            let alpha = |i: usize| *part.alphas.get(i).unwrap_or(&1.0);
            let color = |(i, c): (usize, &[f32; 3])| {
                let [r, g, b] = c.map(|v| short(linear_from_srgb(v)));
                [r, g, b, short(alpha(i))]
            };
            let colors = if mesh.colors.iter().all(|c| *c == [1.0; 3]) {
                // a texture for alpha alone: a byte is enough
                let white = |i| [255, 255, 255, (alpha(i) * 255.0).round() as u8];
                let colors: Vec<[u8; 4]> = (0..vertices).map(white).collect();
                document.normalized(&colors, ComponentType::U8, Type::Vec4)
            } else {
                let colors: Vec<[u16; 4]> = mesh.colors.iter().enumerate().map(color).collect();
                document.normalized(&colors, ComponentType::U16, Type::Vec4)
            };
            attributes.insert(Valid(Semantic::Colors(0)), colors);
        }
        primitive(attributes, document.indices(&mesh.triangles, vertices))
    }

    /// The new number of a material.
    fn material(&mut self, index: u32, looks: &FileMaterials, reader: &GlbReader) -> Result<Index<Material>> {
        if let Some(&known) = self.known.1.get(&index) {
            return Ok(known);
        }
        let texture = reader.base_color(Some(index))?.map(|texture| texture.index);
        let old = looks.materials.get(index as usize).unwrap_or(&Value::Null);
        let mut new = Material {
            alpha_mode: Valid(match old["alphaMode"].as_str() {
                Some("BLEND") => AlphaMode::Blend,
                Some("MASK") => AlphaMode::Mask,
                _ => AlphaMode::Opaque,
            }),
            alpha_cutoff: old["alphaCutoff"].as_f64().map(|cutoff| AlphaCutoff(cutoff as f32)),
            ..Material::default()
        };
        let pbr = &mut new.pbr_metallic_roughness;
        let factor =
            |k: usize| old["pbrMetallicRoughness"]["baseColorFactor"][k].as_f64().unwrap_or(1.0) as f32;
        pbr.base_color_factor = PbrBaseColorFactor(match texture {
            Some(_) => [0, 1, 2, 3].map(factor),
            // the vertex colors already contain this factor
            None => [1.0, 1.0, 1.0, factor(3)],
        });
        let texture = texture.map(|texture| self.texture(texture, COLOR_PX, reader)).transpose()?;
        pbr.base_color_texture = texture.map(info);
        if let Some(notes) = old.pointer("/extras/tiface").filter(|notes| notes["lobes"].is_array()) {
            let mut notes = notes.clone();
            for lobe in notes["lobes"].as_array_mut().into_iter().flatten() {
                let texture = lobe["texture"].as_u64().and_then(|t| u32::try_from(t).ok());
                let Some(texture) = texture else {
                    return Err(reader
                        .source
                        .broken(format!("material {index}"), "a lobe without a texture"));
                };
                *lobe = json!({"texture": self.texture(texture, LOBE_PX, reader)?.value()});
            }
            new.extras = extras(notes);
        }
        let new = self.document.root.push(new);
        self.known.1.insert(index, new);
        Ok(new)
    }

    /// Returns the new index of a texture with at most `side` texels along a side.
    fn texture(&mut self, index: u32, side: u32, reader: &GlbReader) -> Result<Index<json::Texture>> {
        if let Some(&known) = self.known.0.get(&(index, side)) {
            return Ok(known);
        }
        let path = reader.source.path;
        let PictureSource::Inside(bytes) = reader.picture(index, None)? else {
            return Err(reader.source.unsupported(format!("texture {index}"), "a picture outside the file"));
        };
        let photo = io::parse_photo(&bytes, path, &Limits::default())?;
        let clear = photo.alpha.as_ref().is_some_and(|alpha| alpha.iter().any(|&a| a < 255));
        let (bytes, mime) = if clear { (bytes, "image/png") } else { smaller(bytes, &photo, side, path)? };
        let texture = self.document.texture(None, &bytes, mime);
        self.known.0.insert((index, side), texture);
        Ok(texture)
    }
}

/// Returns a picture as a JPEG, or unchanged if that is smaller.
fn smaller(bytes: Vec<u8>, photo: &Photo, side: u32, path: &Path) -> Result<(Vec<u8>, &'static str)> {
    let size = working_size(photo.width, photo.height, side);
    let jpeg = io::jpeg_bytes(&reduce_photo(photo, size), QUALITY, path)?;
    let mime = if bytes.starts_with(&[0xFF, 0xD8]) { "image/jpeg" } else { "image/png" };
    let keep = bytes.len() <= jpeg.len() && size == (photo.width, photo.height);
    Ok(if keep { (bytes, mime) } else { (jpeg, "image/jpeg") })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::files::file_mesh::tests::tetrahedron;
    use crate::mesh::files::{ExportOptions, Lobes, read, read_with, to_glb};

    #[test]
    fn a_small_copy_has_its_shape_colors_and_lobes_and_drops_what_is_not_seen() {
        let (mesh, mut texture) = tetrahedron();
        texture.normal = Some(texture.color.clone());
        let pictures = vec![texture.color.clone(); 4];
        texture.lobes = Some(Lobes {
            pictures,
            scale: vec![0.5, 0.25, 0.1, 0.2],
            asset_from_world: glam::Mat3::IDENTITY,
        });
        let glb = to_glb(&mesh, Some(&texture), None, &ExportOptions::default()).unwrap();
        let path = Path::new("a.glb");
        let small = compact_glb(&glb, path).unwrap();
        let back = read_with(&small, path, &ReadOptions::default()).unwrap();
        let whole = read_with(&glb, path, &ReadOptions::default()).unwrap();
        assert_eq!(back.mesh.triangles.len(), 4);
        // half a step of 16 bits of the longest side, 1, and a byte of a normal
        let near = |a: glam::Vec3, b: glam::Vec3, far: f32| a.distance(b) <= far;
        for t in 0..4 {
            let corners = back.mesh.corners(t).into_iter().zip(whole.mesh.corners(t));
            assert!(corners.into_iter().all(|(a, b)| near(a, b, 2e-5)));
        }
        let normals = back.mesh.normals.iter().zip(&whole.mesh.normals);
        assert!(normals.into_iter().all(|(a, b)| near(*a, *b, 0.01)));
        let text = String::from_utf8_lossy(&small).into_owned();
        assert_eq!(text.matches("\"source\":").count(), 5); // base color and lobes: no normal map
        assert!(text.contains("\"scale\":[0.5,0.25,0.1") && !text.contains("KHR_materials_variants"));
        // a second time it stays what it is
        assert_eq!(read(&compact_glb(&small, path).unwrap(), path).unwrap(), read(&small, path).unwrap());
        assert!(compact_glb(&glb[..40], path).is_err() && compact_glb(b"glTF", path).is_err());
    }

    #[test]
    fn soft_layers_stay_in_their_order_with_their_alphas() {
        let head = crate::mesh::files::test_head();
        let options = ExportOptions::default();
        let glb = to_glb(&head.mesh, head.texture.as_ref(), head.shells.as_ref(), &options).unwrap();
        let small = compact_glb(&glb, Path::new("a.glb")).unwrap();
        let source = Source { path: Path::new("a.glb"), format: "GLB", options: &ReadOptions::DEFAULT };
        let chunks = chunks(&small, source).unwrap();
        let json: Value = serde_json::from_slice(&chunks.json).unwrap();
        let parts = json["meshes"][0]["primitives"].as_array().unwrap();
        let mode =
            |p: &Value| json["materials"][p["material"].as_u64().unwrap() as usize]["alphaMode"].clone();
        assert_eq!(parts.iter().map(mode).collect::<Vec<_>>(), ["OPAQUE", "BLEND", "BLEND"].map(Value::from));
        // one base color for all of them, and four lobes
        assert_eq!(json["textures"].as_array().unwrap().len(), 5);
        let root = GlbRoot::parse(&chunks.json, source).unwrap();
        let reader = GlbReader { root: &root, bin: chunks.bin.as_deref().unwrap(), source };
        let mut alphas = Vec::new();
        let gather = |part: &_| {
            let mut own = Primitives::default();
            reader.add_triangles(part, &mut own).map(|()| alphas.push(own.alphas))
        };
        reader.each_part(gather).unwrap();
        assert!(
            alphas[0].iter().all(|a| *a == 1.0) && alphas[1].iter().any(|a| (a - 0.25).abs() < 2e-3),
            "{alphas:?}"
        );
        // corners and places in the texture lie in the file once
        let view = |p: &Value, key: &str| {
            let at = p.pointer(key).and_then(Value::as_u64).unwrap() as usize;
            json["accessors"][at]["bufferView"].clone()
        };
        for key in ["/indices", "/attributes/TEXCOORD_0"] {
            assert_eq!(view(&parts[1], key), view(&parts[2], key));
        }
    }

    #[test]
    fn a_mesh_far_away_and_its_colors_keep_their_digits() {
        let (mut mesh, _) = tetrahedron();
        mesh.positions.iter_mut().for_each(|p| p.x += 4096.0);
        mesh.colors = (0..4).map(|i| [0.2 * i as f32, 0.5, 1.0]).collect();
        let path = Path::new("a.glb");
        let glb = to_glb(&mesh, None, None, &ExportOptions::default()).unwrap();
        let back = read(&compact_glb(&glb, path).unwrap(), path).unwrap();
        let whole = read(&glb, path).unwrap();
        for (a, b) in back.colors.as_flattened().iter().zip(whole.colors.as_flattened()) {
            assert!((a - b).abs() < 1e-3, "{a} {b}");
        }
        assert!(back.positions.iter().zip(&whole.positions).all(|(a, b)| a.distance(*b) < 1e-3));
    }

    #[test]
    fn what_has_no_colors_of_its_own_gets_none_and_a_tint_counts_once() {
        let (mut mesh, _) = tetrahedron();
        mesh.colors.clear();
        let path = Path::new("a.glb");
        let glb = to_glb(&mesh, None, None, &ExportOptions::default()).unwrap();
        assert!(read(&compact_glb(&glb, path).unwrap(), path).unwrap().colors.is_empty());
        // (0.25, 0.5, 1) linear, over white
        let source = Source { path, format: "GLB", options: &ReadOptions::DEFAULT };
        let chunks = chunks(&glb, source).unwrap();
        let mut json: Value = serde_json::from_slice(&chunks.json).unwrap();
        json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = json!([0.25, 0.5, 1.0, 0.5]);
        let mut text = json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let bin = chunks.bin.unwrap();
        let header = gltf::binary::Header { magic: *b"glTF", version: 2, length: 0 };
        let tinted = gltf::Glb { header, json: text.into(), bin: Some(bin) }.to_vec().unwrap();
        let small = compact_glb(&tinted, path).unwrap();
        let found = read(&small, path).unwrap().colors[0];
        let expected = [0.25, 0.5, 1.0].map(crate::image::srgb_from_linear);
        assert!((0..3).all(|k| (found[k] - expected[k]).abs() < 1e-3), "{found:?}");
    }
}
