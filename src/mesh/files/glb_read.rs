//! GLB → mesh: all triangles of the default scene, moved to where their nodes put them.
//!
//! Only what lies in the file is read: buffers with an address are refused, whatever it is.

use super::glb_texture::{ImageEntry, Material, TextureEntry};
use super::read::{Parsed, ReadMeshError, Source};
use crate::geom::{Atlas, Mesh};
use crate::image::srgb_from_linear;
use glam::{DMat3, DMat4, DQuat, DVec3, Vec2};
use serde::Deserialize;
use std::collections::{BTreeSet, HashMap};

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct Root {
    accessors: Vec<Accessor>,
    buffer_views: Vec<View>,
    buffers: Vec<Buffer>,
    meshes: Vec<Shape>,
    nodes: Vec<Node>,
    scenes: Vec<Scene>,
    scene: Option<usize>,
    extensions_required: Vec<String>,
    pub(super) materials: Vec<Material>,
    pub(super) textures: Vec<TextureEntry>,
    pub(super) images: Vec<ImageEntry>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: u64,
    component_type: u32,
    count: u64,
    #[serde(rename = "type")]
    kind: String,
    #[serde(default)]
    normalized: bool,
    sparse: Option<serde::de::IgnoredAny>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: u64,
    byte_length: u64,
    byte_stride: Option<u64>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Buffer {
    byte_length: u64,
    uri: Option<String>,
}

#[derive(Deserialize)]
struct Shape {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    attributes: HashMap<String, usize>,
    indices: Option<usize>,
    mode: Option<u32>,
    material: Option<usize>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Node {
    mesh: Option<usize>,
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Scene {
    nodes: Vec<usize>,
}

/// What allows 8 and 16 bits in more attributes.
const QUANTIZED: &str = "KHR_mesh_quantization";

/// Extensions that leave shape and colour attributes alone, or that are read.
fn is_harmless(extension: &str) -> bool {
    extension.starts_with("KHR_materials_")
        || extension == QUANTIZED
        || ["KHR_texture_transform", "EXT_texture_webp", "KHR_texture_basisu"].contains(&extension)
}

pub(super) fn read(bytes: &[u8], source: Source) -> Result<Parsed, ReadMeshError> {
    let (json, bin) = chunks(bytes, source)?;
    let root: Root =
        serde_json::from_slice(json).map_err(|e| source.broken("the JSON chunk", e.to_string()))?;
    if let Some(extension) = root.extensions_required.iter().find(|e| !is_harmless(e)) {
        return Err(source.unsupported("`extensionsRequired`", format!("`{extension}`")));
    }
    let document = Document { root: &root, bin, source };
    let mut gathered = Gathered::default();
    if root.nodes.is_empty() {
        for shape in 0..root.meshes.len() {
            document.add(shape, DMat4::IDENTITY, &mut gathered)?;
        }
    }
    let mut seen = vec![false; root.nodes.len()];
    let mut stack: Vec<(usize, DMat4)> =
        document.roots()?.into_iter().rev().map(|n| (n, DMat4::IDENTITY)).collect();
    while let Some((index, parent)) = stack.pop() {
        let at = || format!("node {index}");
        let node = root.nodes.get(index).ok_or_else(|| {
            source.broken(at(), format!("is named, but there are only {}", root.nodes.len()))
        })?;
        if std::mem::replace(&mut seen[index], true) {
            return Err(source.broken(at(), "is reached twice: nodes must form a tree"));
        }
        let matrix = parent * local(node);
        if !matrix.is_finite() {
            return Err(source.broken(at(), "its transform is not finite"));
        }
        if let Some(shape) = node.mesh {
            document.add(shape, matrix, &mut gathered)?;
        }
        stack.extend(node.children.iter().rev().map(|&c| (c, matrix)));
    }
    document.whole(gathered)
}

/// The JSON chunk and the binary one (empty when absent).
fn chunks<'a>(bytes: &'a [u8], source: Source) -> Result<(&'a [u8], &'a [u8]), ReadMeshError> {
    let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let cut = |at: usize| source.broken(format!("byte {at}"), "the file ends inside a header");
    let version = word(4).ok_or_else(|| cut(4))?;
    if version != 2 {
        return Err(source.unsupported("byte 4", format!("glTF version {version}")));
    }
    let total = word(8).ok_or_else(|| cut(8))? as usize;
    if total > bytes.len() {
        return Err(source.broken("byte 8", format!("says {total} bytes, but the file has {}", bytes.len())));
    }
    let bytes = &bytes[..total];
    let chunk = |at: usize, kind: &[u8; 4]| -> Result<&'a [u8], ReadMeshError> {
        let length = word(at).ok_or_else(|| cut(at))? as usize;
        let data = bytes.get(at + 8..).ok_or_else(|| cut(at))?;
        if bytes[at + 4..at + 8] != *kind {
            let name = String::from_utf8_lossy(kind);
            return Err(source
                .broken(format!("byte {at}"), format!("expected a `{}` chunk", name.trim_matches('\0'))));
        }
        data.get(..length).ok_or_else(|| {
            source
                .broken(format!("byte {at}"), format!("a chunk of {length} bytes, but {} remain", data.len()))
        })
    };
    let json = chunk(12, b"JSON")?;
    if json.len() > source.limits.json {
        return Err(source
            .broken("byte 12", format!("{} bytes of JSON, more than {}", json.len(), source.limits.json)));
    }
    let next = (20 + json.len()).next_multiple_of(4);
    let bin = if next < bytes.len() { chunk(next, b"BIN\0")? } else { &[] };
    Ok((json, bin))
}

fn local(node: &Node) -> DMat4 {
    if let Some(matrix) = &node.matrix {
        return DMat4::from_cols_array(matrix);
    }
    let [x, y, z, w] = node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
    let q = DQuat::from_xyzw(x, y, z, w);
    let q = if q.length() > 0.0 { q / q.length() } else { DQuat::IDENTITY };
    DMat4::from_scale_rotation_translation(
        node.scale.map_or(DVec3::ONE, DVec3::from),
        q,
        node.translation.map_or(DVec3::ZERO, DVec3::from),
    )
}

/// The mesh as it grows. Normals, colours and texture coordinates survive only if every part has them.
#[derive(Default)]
struct Gathered {
    positions: Vec<DVec3>,
    /// The rest of it.
    mesh: Mesh,
    bare_normals: bool,
    bare_colors: bool,
    /// One for each vertex.
    uvs: Vec<Vec2>,
    bare_uvs: bool,
    /// The base colours of the parts; `None` for a part without.
    textures: BTreeSet<Option<usize>>,
}

pub(super) struct Document<'a> {
    pub(super) root: &'a Root,
    pub(super) bin: &'a [u8],
    pub(super) source: Source<'a>,
}

impl<'a> Document<'a> {
    fn whole(&self, gathered: Gathered) -> Result<Parsed, ReadMeshError> {
        let Gathered { positions, mut mesh, bare_normals, bare_colors, uvs, bare_uvs, textures } = gathered;
        if bare_normals {
            mesh.normals.clear();
        }
        if bare_colors {
            mesh.colors.clear();
        }
        let wanted = self.source.textures && !mesh.triangles.is_empty();
        let mut atlas = (wanted && !bare_uvs).then(|| Atlas {
            uvs,
            triangles: mesh.triangles.clone(),
            width: 0,
            height: 0,
        });
        let texture = match textures.iter().collect::<Vec<_>>()[..] {
            [Some(texture)] if wanted => Some(self.picture(*texture, atlas.as_mut())?),
            [] | [None] => None,
            _ if !wanted => None,
            _ => return Err(self.source.unsupported("`materials`", "a mesh with several base colours")),
        };
        Ok(Parsed { positions, mesh, atlas, texture })
    }

    fn roots(&self) -> Result<Vec<usize>, ReadMeshError> {
        let Root { scenes, scene, nodes, .. } = self.root;
        let index = scene.unwrap_or(0);
        match scenes.get(index) {
            Some(scene) => Ok(scene.nodes.clone()),
            None if scene.is_some() => {
                Err(self.source.broken("`scene`", format!("{index} of {} scenes", scenes.len())))
            }
            None => {
                let mut is_child = vec![false; nodes.len()];
                for &c in nodes.iter().flat_map(|n| &n.children) {
                    if let Some(slot) = is_child.get_mut(c) {
                        *slot = true;
                    }
                }
                Ok((0..nodes.len()).filter(|&n| !is_child[n]).collect())
            }
        }
    }

    /// Adds every triangle of a glTF mesh.
    fn add(&self, shape: usize, matrix: DMat4, out: &mut Gathered) -> Result<(), ReadMeshError> {
        let meshes = &self.root.meshes;
        let primitives = &meshes
            .get(shape)
            .ok_or_else(|| {
                self.source
                    .broken(format!("mesh {shape}"), format!("is named, but there are only {}", meshes.len()))
            })?
            .primitives;
        for (k, primitive) in primitives.iter().enumerate() {
            let at = format!("mesh {shape}, primitive {k}");
            match primitive.mode.unwrap_or(4) {
                4 => self.add_triangles(&at, primitive, matrix, out)?,
                0..=3 => {} // points and lines have no surface
                mode => {
                    return Err(self
                        .source
                        .unsupported(at, format!("primitive mode {mode} (strips and fans)")));
                }
            }
        }
        Ok(())
    }

    fn add_triangles(
        &self,
        at: &str,
        primitive: &Primitive,
        matrix: DMat4,
        out: &mut Gathered,
    ) -> Result<(), ReadMeshError> {
        let source = self.source;
        let Some(&position) = primitive.attributes.get("POSITION") else {
            return Err(source.broken(at, "there is no `POSITION`"));
        };
        let short: &[u32] =
            if self.root.extensions_required.iter().any(|e| e == QUANTIZED) { &SHORTENED } else { &[FLOAT] };
        let positions = self.numbers(position, "VEC3", short)?;
        let count = positions.len() / 3;
        let indices: Vec<u32> = match primitive.indices {
            Some(i) => {
                self.numbers(i, "SCALAR", &[BYTE, SHORT, INT])?.into_iter().map(|v| v as u32).collect()
            }
            None => (0..count as u32).collect(),
        };
        if !indices.len().is_multiple_of(3) {
            return Err(source.broken(at, format!("{} indices are not whole triangles", indices.len())));
        }
        if let Some(i) = indices.iter().find(|&&i| i as usize >= count) {
            return Err(source.broken(at, format!("index {i}, but there are {count} vertices")));
        }
        let first = out.positions.len();
        source.allow(first + count, out.mesh.triangles.len() + indices.len() / 3)?;

        let linear = DMat3::from_mat4(matrix);
        let mirrored = linear.determinant() < 0.0;
        for p in positions.as_chunks::<3>().0 {
            let moved = matrix.transform_point3(DVec3::from(*p));
            if !moved.as_vec3().is_finite() {
                return Err(source.broken(at, "a vertex is not finite once its node has moved it"));
            }
            out.positions.push(moved);
        }
        // the inverse transpose, up to a factor that normalising removes, also for singular matrices
        let cofactor = DMat3::from_cols(
            linear.y_axis.cross(linear.z_axis),
            linear.z_axis.cross(linear.x_axis),
            linear.x_axis.cross(linear.y_axis),
        ) * if mirrored { -1.0 } else { 1.0 };
        let of = |name: &str| primitive.attributes.get(name).copied();
        out.bare_normals |= of("NORMAL").is_none();
        if let Some(normal) = of("NORMAL") {
            let normals = self.numbers(normal, "VEC3", short)?;
            self.same_count(at, "NORMAL", normals.len() / 3, count)?;
            let moved = |n: &[f64; 3]| (cofactor * DVec3::from(*n)).normalize_or_zero().as_vec3();
            out.mesh.normals.extend(normals.as_chunks::<3>().0.iter().map(moved));
        }
        out.bare_colors |= of("COLOR_0").is_none();
        if let Some(color) = of("COLOR_0") {
            let wide = self.root.accessors.get(color).is_some_and(|a| a.kind == "VEC4");
            let kind = if wide { "VEC4" } else { "VEC3" };
            let colors = self.numbers(color, kind, &[FLOAT, BYTE, SHORT])?;
            let width = if wide { 4 } else { 3 };
            self.same_count(at, "COLOR_0", colors.len() / width, count)?;
            out.mesh.colors.extend(
                colors.chunks_exact(width).map(|c| [c[0], c[1], c[2]].map(|v| srgb_from_linear(v as f32))),
            );
        }
        if source.textures {
            let info = self.base_color(at, primitive.material)?;
            out.textures.insert(info.map(|i| i.index));
            let name = format!("TEXCOORD_{}", info.map_or(0, |i| i.tex_coord));
            match of(&name) {
                Some(uv) => {
                    let uvs = self.numbers(uv, "VEC2", &SHORTENED)?;
                    self.same_count(at, &name, uvs.len() / 2, count)?;
                    let uv = |&[u, v]: &[f64; 2]| Vec2::new(u as f32, v as f32);
                    out.uvs.extend(uvs.as_chunks::<2>().0.iter().map(uv));
                }
                None if info.is_some() => return Err(source.broken(at, format!("there is no `{name}`"))),
                None => out.bare_uvs = true,
            }
        }
        for t in indices.as_chunks::<3>().0 {
            let [a, b, c] = t.map(|i| first as u32 + i);
            out.mesh.triangles.push(if mirrored { [a, c, b] } else { [a, b, c] });
        }
        Ok(())
    }

    fn same_count(&self, at: &str, name: &str, found: usize, expected: usize) -> Result<(), ReadMeshError> {
        if found == expected {
            return Ok(());
        }
        Err(self.source.broken(at, format!("{found} of `{name}` for {expected} of `POSITION`")))
    }

    /// All numbers of an accessor, flat; normalised integers become 0..=1. Finite.
    fn numbers(&self, index: usize, kind: &str, components: &[u32]) -> Result<Vec<f64>, ReadMeshError> {
        let (source, root) = (self.source, self.root);
        let at = format!("accessor {index}");
        let broken = |what: String| source.broken(at.clone(), what);
        let accessor = root
            .accessors
            .get(index)
            .ok_or_else(|| broken(format!("is named, but there are only {}", root.accessors.len())))?;
        if accessor.sparse.is_some() {
            return Err(source.unsupported(at, "a sparse accessor"));
        }
        if accessor.kind != kind || !components.contains(&accessor.component_type) {
            return Err(broken(format!(
                "type {} of components {}, expected {kind} of {components:?}",
                accessor.kind, accessor.component_type
            )));
        }
        if accessor.count == 0 {
            return Err(broken("has count 0, expected at least 1".into()));
        }
        let width = match kind {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            _ => 4,
        };
        let size: u64 = match accessor.component_type {
            BYTE | SIGNED_BYTE => 1,
            SHORT | SIGNED_SHORT => 2,
            _ => 4,
        };
        let element = size * width;
        let bytes = self.view(accessor.buffer_view.ok_or_else(|| broken("has no buffer view".into()))?)?;
        let stride = root.buffer_views[accessor.buffer_view.unwrap_or(0)].byte_stride.unwrap_or(element);
        if stride < element {
            return Err(broken(format!("a stride of {stride} bytes for elements of {element}")));
        }
        // offset + stride (count − 1) + element ≤ bytes, without overflow and before reserving
        let needed = stride
            .checked_mul(accessor.count - 1)
            .and_then(|n| n.checked_add(accessor.byte_offset))
            .and_then(|n| n.checked_add(element));
        if needed.is_none_or(|n| n > bytes.len() as u64) {
            return Err(broken(format!(
                "{} elements do not fit into the {} bytes of its buffer view",
                accessor.count,
                bytes.len()
            )));
        }
        let mut numbers = Vec::with_capacity((accessor.count * width) as usize);
        for i in 0..accessor.count as usize {
            let start = accessor.byte_offset as usize + i * stride as usize;
            for b in bytes[start..start + element as usize].chunks_exact(size as usize) {
                let (value, top) = match accessor.component_type {
                    BYTE => (b[0] as f64, 255.0),
                    SIGNED_BYTE => (b[0] as i8 as f64, 127.0),
                    SIGNED_SHORT => (i16::from_le_bytes([b[0], b[1]]) as f64, 32767.0),
                    SHORT => (u16::from_le_bytes([b[0], b[1]]) as f64, 65535.0),
                    INT => (u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as f64, 1.0),
                    _ => (f32::from_le_bytes([b[0], b[1], b[2], b[3]]) as f64, 1.0),
                };
                if !value.is_finite() {
                    return Err(broken(format!("element {i} is {value}, expected a finite number")));
                }
                numbers.push(if accessor.normalized { (value / top).max(-1.0) } else { value });
            }
        }
        Ok(numbers)
    }

    /// The bytes of a buffer view.
    pub(super) fn view(&self, index: usize) -> Result<&'a [u8], ReadMeshError> {
        let (source, root) = (self.source, self.root);
        let broken = |what: String| source.broken(format!("buffer view {index}"), what);
        let view = root
            .buffer_views
            .get(index)
            .ok_or_else(|| broken(format!("is named, but there are only {}", root.buffer_views.len())))?;
        let buffer =
            root.buffers.get(view.buffer).ok_or_else(|| broken(format!("names buffer {}", view.buffer)))?;
        if buffer.uri.is_some() || view.buffer != 0 {
            return Err(source.unsupported(format!("buffer {}", view.buffer), "a buffer outside the file"));
        }
        if buffer.byte_length > self.bin.len() as u64 {
            let found = self.bin.len();
            return Err(source
                .broken("buffer 0", format!("{} bytes, but the file holds {found}", buffer.byte_length)));
        }
        let end = view.byte_offset.checked_add(view.byte_length).filter(|&end| end <= buffer.byte_length);
        match end {
            Some(end) => Ok(&self.bin[view.byte_offset as usize..end as usize]),
            None => Err(broken(format!(
                "{} bytes from {} do not fit into a buffer of {}",
                view.byte_length, view.byte_offset, buffer.byte_length
            ))),
        }
    }
}

const SIGNED_BYTE: u32 = 5120;
const BYTE: u32 = 5121;
const SIGNED_SHORT: u32 = 5122;
const SHORT: u32 = 5123;
const INT: u32 = 5125;
const FLOAT: u32 = 5126;
const SHORTENED: [u32; 5] = [FLOAT, SIGNED_BYTE, BYTE, SIGNED_SHORT, SHORT];

/// Not a test of reading (those are in `tests/hostile_mesh.rs`), but of where nodes put things.
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn translation_rotation_and_scale_apply_in_gltf_order() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let node = Node {
            translation: Some([10.0, 0.0, 0.0]),
            rotation: Some([0.0, 0.0, half, half]), // a quarter turn about z: x → y
            scale: Some([2.0, 1.0, 1.0]),
            ..Node::default()
        };
        // (1, 0, 0) → scaled (2, 0, 0) → turned (0, 2, 0) → moved (10, 2, 0)
        let p = local(&node).transform_point3(DVec3::X);
        assert!(p.distance(DVec3::new(10.0, 2.0, 0.0)) < 1e-12);
        assert_eq!(local(&Node::default()), DMat4::IDENTITY);
    }
}
