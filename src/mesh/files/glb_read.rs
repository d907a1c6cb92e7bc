//! GLB → mesh: all triangles of the default scene, moved to where their nodes put them, and their base colour.
//!
//! `gltf` takes the file apart; what the document names is checked here before it is used, since the checks of
//! `gltf` panic on an index that is out of range and refuse 16-bit coordinates. Only what lies in the file is read:
//! buffers with an address are refused, whatever it is.

use super::source::{ParsedMesh, PictureSource, Source};
use crate::geom::{Atlas, Mesh};
use crate::image::srgb_from_linear;
use crate::{Result, io};
use glam::{DMat3, DMat4, DQuat, DVec3, Vec2};
use gltf::Glb;
use gltf::json::accessor::{ComponentType as C, GenericComponentType, Type};
use gltf::json::mesh::{Mode, Primitive, Semantic};
use gltf::json::validation::Checked::{Invalid, Valid};
use gltf::json::{self, Accessor, Index, Node, Root, buffer, texture};
use std::collections::BTreeSet;

/// What allows 8 and 16 bits in more attributes.
const QUANTIZED: &str = "KHR_mesh_quantization";
const SHORTENED: [C; 5] = [C::F32, C::I8, C::U8, C::I16, C::U16];

/// Extensions that leave shape and colour attributes alone, or that are read.
fn is_harmless(extension: &str) -> bool {
    extension.starts_with("KHR_materials_")
        || extension == QUANTIZED
        || ["KHR_texture_transform", "EXT_texture_webp", "KHR_texture_basisu"].contains(&extension)
}

pub(super) fn read(bytes: &[u8], source: Source) -> Result<ParsedMesh> {
    let glb = chunks(bytes, source)?;
    let root: Root = serde_json::from_slice(&glb.json).map_err(|e| source.broken("the JSON chunk", e))?;
    if let Some(extension) = root.extensions_required.iter().find(|e| !is_harmless(e)) {
        return Err(source.unsupported("`extensionsRequired`", format!("`{extension}`")));
    }
    let reader = GlbReader { root: &root, bin: glb.bin.as_deref().unwrap_or_default(), source };
    let mut gathered = Primitives::default();
    if root.nodes.is_empty() {
        for mesh in 0..root.meshes.len() as u32 {
            reader.add(Index::new(mesh), DMat4::IDENTITY, &mut gathered)?;
        }
    }
    let mut seen = vec![false; root.nodes.len()];
    let mut stack: Vec<(Index<Node>, DMat4)> =
        reader.roots()?.into_iter().rev().map(|n| (n, DMat4::IDENTITY)).collect();
    while let Some((index, parent)) = stack.pop() {
        let at = || format!("node {index}");
        let node: &Node = reader.get("node", index)?;
        if std::mem::replace(&mut seen[index.value()], true) {
            return Err(source.broken(at(), "is reached twice: nodes must form a tree"));
        }
        let matrix = parent * local(node);
        if !matrix.is_finite() {
            return Err(source.broken(at(), "its transform is not finite"));
        }
        if let Some(mesh) = node.mesh {
            reader.add(mesh, matrix, &mut gathered)?;
        }
        stack.extend(node.children.iter().flatten().rev().map(|&c| (c, matrix)));
    }
    reader.finish(gathered)
}

/// The JSON chunk and the binary one.
fn chunks<'a>(bytes: &'a [u8], source: Source) -> Result<Glb<'a>> {
    let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let (Some(version), Some(total)) = (word(4), word(8)) else {
        return Err(source.broken(format!("byte {}", bytes.len()), "the file ends inside a header"));
    };
    if version != 2 {
        return Err(source.unsupported("byte 4", format!("glTF version {version}")));
    }
    // `gltf` subtracts its header from this length unchecked
    if !(12..=bytes.len()).contains(&(total as usize)) {
        return Err(source.broken("byte 8", format!("says {total} bytes, but the file has {}", bytes.len())));
    }
    let glb = Glb::from_slice(&bytes[..total as usize]).map_err(|e| source.broken("byte 12", e))?;
    let (found, most) = (glb.json.len(), source.options.json);
    if found > most {
        return Err(source.broken("byte 12", format!("{found} bytes of JSON, more than {most}")));
    }
    Ok(glb)
}

fn local(node: &Node) -> DMat4 {
    if let Some(matrix) = node.matrix {
        return DMat4::from_cols_array(&matrix.map(f64::from));
    }
    let q = node.rotation.unwrap_or_default().0.map(f64::from);
    let q = DQuat::from_array(q);
    let q = if q.length() > 0.0 { q / q.length() } else { DQuat::IDENTITY };
    let vector = |v: [f32; 3]| DVec3::from(v.map(f64::from));
    DMat4::from_scale_rotation_translation(
        node.scale.map_or(DVec3::ONE, vector),
        q,
        node.translation.map_or(DVec3::ZERO, vector),
    )
}

/// The mesh as it grows. Normals, colours and texture coordinates survive only if every part has them.
#[derive(Default)]
struct Primitives {
    positions: Vec<DVec3>,
    /// The rest of it.
    mesh: Mesh,
    bare_normals: bool,
    bare_colors: bool,
    /// One for each vertex.
    uvs: Vec<Vec2>,
    bare_uvs: bool,
    /// The base colours of the parts; `None` for a part without.
    textures: BTreeSet<Option<u32>>,
}

struct GlbReader<'a> {
    root: &'a Root,
    bin: &'a [u8],
    source: Source<'a>,
}

impl<'a> GlbReader<'a> {
    /// What an index names.
    fn get<T>(&self, what: &str, index: Index<T>) -> Result<&'a T>
    where
        Root: AsRef<[T]>,
    {
        let all: &'a [T] = self.root.as_ref();
        let (at, count) = (format!("{what} {index}"), all.len());
        let found = all.get(index.value());
        found.ok_or_else(|| self.source.broken(at, format!("is named, but there are only {count}")))
    }

    fn finish(&self, gathered: Primitives) -> Result<ParsedMesh> {
        let Primitives { positions, mut mesh, bare_normals, bare_colors, uvs, bare_uvs, textures } = gathered;
        if bare_normals {
            mesh.normals.clear();
        }
        if bare_colors {
            mesh.colors.clear();
        }
        let mut out = ParsedMesh { positions, mesh, ..ParsedMesh::default() };
        if !self.source.options.texture || out.mesh.triangles.is_empty() {
            return Ok(out);
        }
        if !bare_uvs {
            out.atlas = Some(Atlas { uvs, triangles: out.mesh.triangles.clone(), width: 0, height: 0 });
        }
        let mut textures = textures.into_iter();
        let (first, second) = (textures.next().flatten(), textures.next());
        if second.is_some() {
            return Err(self.source.unsupported("`materials`", "a mesh with several base colours"));
        }
        let picture = first.map(|texture| self.picture(Index::new(texture), out.atlas.as_mut()));
        out.picture = picture.transpose()?;
        Ok(out)
    }

    fn roots(&self) -> Result<Vec<Index<Node>>> {
        let Root { scenes, scene, nodes, .. } = self.root;
        match (scenes.get(scene.map_or(0, |s| s.value())), scene) {
            (Some(scene), _) => Ok(scene.nodes.clone()),
            (None, Some(index)) => {
                Err(self.source.broken("`scene`", format!("{index} of {} scenes", scenes.len())))
            }
            (None, None) => {
                let children = nodes.iter().flat_map(|n| n.children.iter().flatten());
                let children: BTreeSet<usize> = children.map(|c| c.value()).collect();
                let all = 0..nodes.len();
                Ok(all.filter(|n| !children.contains(n)).map(|n| Index::new(n as u32)).collect())
            }
        }
    }

    /// Adds every triangle of a glTF mesh.
    fn add(&self, index: Index<json::Mesh>, matrix: DMat4, out: &mut Primitives) -> Result<()> {
        let mesh: &json::Mesh = self.get("mesh", index)?;
        for (k, primitive) in mesh.primitives.iter().enumerate() {
            let at = format!("mesh {index}, primitive {k}");
            match primitive.mode {
                Valid(Mode::Triangles) => self.add_triangles(&at, primitive, matrix, out)?,
                Valid(mode @ (Mode::TriangleStrip | Mode::TriangleFan)) => {
                    let feature = format!("primitive mode {} (strips and fans)", mode.as_gl_enum());
                    return Err(self.source.unsupported(at, feature));
                }
                Valid(_) => {} // points and lines have no surface
                Invalid => return Err(self.source.broken(at, "its primitive mode is unknown")),
            }
        }
        Ok(())
    }

    fn add_triangles(
        &self,
        at: &str,
        primitive: &Primitive,
        matrix: DMat4,
        out: &mut Primitives,
    ) -> Result<()> {
        let source = self.source;
        let of = |semantic: Semantic| primitive.attributes.get(&Valid(semantic)).copied();
        let position = of(Semantic::Positions).ok_or_else(|| source.broken(at, "there is no `POSITION`"))?;
        let short: &[C] =
            if self.root.extensions_required.iter().any(|e| e == QUANTIZED) { &SHORTENED } else { &[C::F32] };
        let (positions, _) = self.numbers(position, &[Type::Vec3], short)?;
        let count = positions.len() / 3;
        let indices: Vec<u32> = match primitive.indices {
            Some(i) => {
                let (numbers, _) = self.numbers(i, &[Type::Scalar], &[C::U8, C::U16, C::U32])?;
                numbers.into_iter().map(|v| v as u32).collect()
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
        // One value a vertex of an attribute that a part may lack.
        let attribute = |semantic: Semantic, kinds: &[Type], components: &[C]| {
            let name = semantic.to_string();
            let Some(index) = of(semantic) else { return Ok(None) };
            let (numbers, width) = self.numbers(index, kinds, components)?;
            let found = numbers.len() / width;
            if found != count {
                return Err(source.broken(at, format!("{found} of `{name}` for {count} of `POSITION`")));
            }
            Ok(Some((numbers, width)))
        };
        match attribute(Semantic::Normals, &[Type::Vec3], short)? {
            None => out.bare_normals = true,
            Some((normals, _)) => {
                // the inverse transpose, up to a factor that normalising removes, also for singular matrices
                let cofactor = DMat3::from_cols(
                    linear.y_axis.cross(linear.z_axis),
                    linear.z_axis.cross(linear.x_axis),
                    linear.x_axis.cross(linear.y_axis),
                ) * if mirrored { -1.0 } else { 1.0 };
                let moved = |n: &[f64; 3]| (cofactor * DVec3::from(*n)).normalize_or_zero().as_vec3();
                out.mesh.normals.extend(normals.as_chunks::<3>().0.iter().map(moved));
            }
        }
        match attribute(Semantic::Colors(0), &[Type::Vec3, Type::Vec4], &[C::F32, C::U8, C::U16])? {
            None => out.bare_colors = true,
            Some((colors, width)) => out.mesh.colors.extend(
                colors.chunks_exact(width).map(|c| [c[0], c[1], c[2]].map(|v| srgb_from_linear(v as f32))),
            ),
        }
        if source.options.texture {
            let info = self.base_color(primitive.material)?;
            out.textures.insert(info.map(|i| i.index.value() as u32));
            let set = info.map_or(0, |i| i.tex_coord);
            match attribute(Semantic::TexCoords(set), &[Type::Vec2], &SHORTENED)? {
                Some((uvs, _)) => {
                    let uv = |&[u, v]: &[f64; 2]| Vec2::new(u as f32, v as f32);
                    out.uvs.extend(uvs.as_chunks::<2>().0.iter().map(uv));
                }
                None if info.is_some() => {
                    return Err(source.broken(at, format!("there is no `TEXCOORD_{set}`")));
                }
                None => out.bare_uvs = true,
            }
        }
        for t in indices.as_chunks::<3>().0 {
            let [a, b, c] = t.map(|i| first as u32 + i);
            out.mesh.triangles.push(if mirrored { [a, c, b] } else { [a, b, c] });
        }
        Ok(())
    }

    /// All numbers of an accessor, flat, and how many an element has; normalised integers become −1..=1. Finite.
    fn numbers(&self, index: Index<Accessor>, kinds: &[Type], components: &[C]) -> Result<(Vec<f64>, usize)> {
        let source = self.source;
        let accessor: &Accessor = self.get("accessor", index)?;
        let at = format!("accessor {index}");
        if accessor.sparse.is_some() {
            return Err(source.unsupported(at, "a sparse accessor"));
        }
        let (width, component) = match (accessor.type_, accessor.component_type) {
            (Valid(kind), Valid(GenericComponentType(c)))
                if kinds.contains(&kind) && components.contains(&c) =>
            {
                (kind.multiplicity(), c)
            }
            (kind, component) => {
                let kind =
                    if let Valid(kind) = kind { format!("{kind:?}") } else { "an unknown type".into() };
                let found = match component {
                    Valid(GenericComponentType(c)) => format!("{c:?}"),
                    Invalid => "an unknown component".into(),
                };
                let [kinds, components] = [names(kinds), names(components)];
                let what = format!("{kind} of {found}, expected {kinds} of {components}");
                return Err(source.broken(at, what));
            }
        };
        let (count, offset) = (accessor.count.0, accessor.byte_offset.unwrap_or_default().0);
        if count == 0 {
            return Err(source.broken(at, "has count 0, expected at least 1"));
        }
        let view = accessor.buffer_view.ok_or_else(|| source.broken(&at, "has no buffer view"))?;
        let (bytes, stride) = self.view(view)?;
        let element = component.size() * width;
        let stride = stride.unwrap_or(element);
        if stride < element {
            return Err(source.broken(at, format!("a stride of {stride} bytes for elements of {element}")));
        }
        // offset + stride (count − 1) + element ≤ bytes, without overflow and before reserving
        let needed = (stride as u64).checked_mul(count - 1);
        let needed = needed.and_then(|n| n.checked_add(offset)?.checked_add(element as u64));
        if needed.is_none_or(|n| n > bytes.len() as u64) {
            let what =
                format!("{count} elements do not fit into the {} bytes of its buffer view", bytes.len());
            return Err(source.broken(at, what));
        }
        let mut numbers = Vec::with_capacity(count as usize * width);
        for i in 0..count as usize {
            let start = offset as usize + i * stride;
            for b in bytes[start..start + element].chunks_exact(component.size()) {
                let (value, top) = match component {
                    C::U8 => (f64::from(b[0]), 255.0),
                    C::I8 => (f64::from(b[0] as i8), 127.0),
                    C::I16 => (f64::from(i16::from_le_bytes([b[0], b[1]])), 32767.0),
                    C::U16 => (f64::from(u16::from_le_bytes([b[0], b[1]])), 65535.0),
                    C::U32 => (f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])), 1.0),
                    C::F32 => (f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])), 1.0),
                };
                if !value.is_finite() {
                    return Err(
                        source.broken(at, format!("element {i} is {value}, expected a finite number"))
                    );
                }
                numbers.push(if accessor.normalized { (value / top).max(-1.0) } else { value });
            }
        }
        Ok((numbers, width))
    }

    /// The bytes of a buffer view, and the stride it gives its elements.
    fn view(&self, index: Index<buffer::View>) -> Result<(&'a [u8], Option<usize>)> {
        let source = self.source;
        let view: &buffer::View = self.get("buffer view", index)?;
        let broken = |what: String| source.broken(format!("buffer view {index}"), what);
        let buffer: &json::Buffer =
            self.root.get(view.buffer).ok_or_else(|| broken(format!("names buffer {}", view.buffer)))?;
        if buffer.uri.is_some() || view.buffer.value() != 0 {
            let at = format!("buffer {}", view.buffer);
            return Err(source.unsupported(at, "a buffer outside the file"));
        }
        let (length, found) = (buffer.byte_length.0, self.bin.len());
        if length > found as u64 {
            return Err(source.broken("buffer 0", format!("{length} bytes, but the file holds {found}")));
        }
        let (start, bytes) = (view.byte_offset.unwrap_or_default().0, view.byte_length.0);
        match start.checked_add(bytes).filter(|&end| end <= length) {
            Some(end) => Ok((&self.bin[start as usize..end as usize], view.byte_stride.map(|s| s.0))),
            None => Err(broken(format!("{bytes} bytes from {start} do not fit into a buffer of {length}"))),
        }
    }

    /// The base colour texture of a material, if it has one.
    fn base_color(&self, material: Option<Index<json::Material>>) -> Result<Option<&'a texture::Info>> {
        let Some(index) = material else { return Ok(None) };
        let material: &json::Material = self.get("material", index)?;
        let info = material.pbr_metallic_roughness.base_color_texture.as_ref();
        let extensions = info.and_then(|i| i.extensions.as_ref());
        if extensions.is_some_and(|e| e.texture_transform.is_some()) {
            return Err(self.source.unsupported(format!("material {index}"), "`KHR_texture_transform`"));
        }
        Ok(info)
    }

    /// The picture behind a texture, and its size in the atlas. Its header is checked against the
    /// limits for pictures; it is not decoded.
    fn picture(&self, texture: Index<json::Texture>, atlas: Option<&mut Atlas>) -> Result<PictureSource> {
        let source = self.source;
        let index = self.get("texture", texture)?.source;
        if index.value() == u32::MAX as usize {
            // as `gltf` says that there is none
            return Err(source
                .unsupported(format!("texture {texture}"), "a texture without a PNG or JPEG of its own"));
        }
        let image: &json::Image = self.get("image", index)?;
        let at = format!("image {index}");
        if image.uri.is_some() {
            return Err(source.unsupported(at, "a picture outside the file"));
        }
        let view = image.buffer_view.ok_or_else(|| source.broken(&at, "has no buffer view"))?;
        let (bytes, _) = self.view(view)?;
        let info = io::parse_picture_info(bytes, source.path, &io::Limits::default())
            .map_err(|e| source.broken(&at, e))?;
        if let Some(atlas) = atlas {
            (atlas.width, atlas.height) = (info.width, info.height);
        }
        Ok(PictureSource::Inside(bytes.to_vec()))
    }
}

/// "A, B or C".
fn names<T: std::fmt::Debug>(all: &[T]) -> String {
    let names: Vec<String> = all.iter().map(|v| format!("{v:?}")).collect();
    let (last, rest) = names.split_last().expect("something is always allowed");
    if rest.is_empty() { last.clone() } else { format!("{} or {last}", rest.join(", ")) }
}

/// Not a test of reading (those are in `tests/hostile_mesh.rs`), but of where nodes put things.
#[cfg(test)]
mod tests {
    use super::*;
    use gltf::json::scene::UnitQuaternion;

    #[test]
    fn translation_rotation_and_scale_apply_in_gltf_order() {
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let node = Node {
            translation: Some([10.0, 0.0, 0.0]),
            rotation: Some(UnitQuaternion([0.0, 0.0, half, half])), // a quarter turn about z: x → y
            scale: Some([2.0, 1.0, 1.0]),
            ..Node::default()
        };
        // (1, 0, 0) → scaled (2, 0, 0) → turned (0, 2, 0) → moved (10, 2, 0)
        let p = local(&node).transform_point3(DVec3::X);
        assert!(p.distance(DVec3::new(10.0, 2.0, 0.0)) < 1e-6);
        assert_eq!(local(&Node::default()), DMat4::IDENTITY);
    }
}
