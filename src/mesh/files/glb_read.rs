//! Reads a GLB: all triangles of the default scene, transformed by their nodes, and their base color.
//!
//! `gltf` parses the file; the document's references are checked here before they are used. Only data in the file is
//! read: buffers with a URI are refused.

use super::glb_json::{GlbNode, GlbPrimitive, GlbRoot, GlbTextureUse};
use super::source::{ParsedMesh, PictureSource, Source};
use crate::geom::{Atlas, Mesh};
use crate::image::{linear_from_srgb, srgb_from_linear};
use crate::{Result, io};
use glam::{DMat3, DMat4, DVec3, Vec2};
use gltf::Glb;
use gltf::json::accessor::{ComponentType as C, GenericComponentType, Type};
use gltf::json::mesh::{Mode, Semantic};
use gltf::json::validation::Checked::{Invalid, Valid};
use std::collections::BTreeSet;

/// The extension that allows 8 and 16 bits in more attributes.
pub(super) const QUANTIZED: &str = "KHR_mesh_quantization";
const SHORTENED: [C; 5] = [C::F32, C::I8, C::U8, C::I16, C::U16];

/// Extensions that leave shape and color attributes alone, or that are read.
fn is_harmless(extension: &str) -> bool {
    extension.starts_with("KHR_materials_")
        || extension == QUANTIZED
        || ["KHR_texture_transform", "EXT_texture_webp", "KHR_texture_basisu"].contains(&extension)
}

pub(super) fn read(bytes: &[u8], source: Source) -> Result<ParsedMesh> {
    let glb = chunks(bytes, source)?;
    let root = GlbRoot::parse(&glb.json, source)?;
    if let Some(extension) = root.extensions_required.iter().find(|e| !is_harmless(e)) {
        return Err(source.unsupported("`extensionsRequired`", format!("`{extension}`")));
    }
    let reader = GlbReader { root: &root, bin: glb.bin.as_deref().unwrap_or_default(), source };
    let mut gathered = Primitives::default();
    reader.each_part(|part| {
        // the soft layers surround the surface and are not part of it
        let material = part.primitive.material.and_then(|m| root.materials.get(m as usize));
        if material.is_some_and(|m| m.is_soft_layer()) {
            Ok(())
        } else {
            reader.add_triangles(part, &mut gathered)
        }
    })?;
    reader.finish(gathered)
}

/// Returns the JSON chunk and the binary one.
pub(super) fn chunks<'a>(bytes: &'a [u8], source: Source) -> Result<Glb<'a>> {
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

/// The reachable nodes that are still to be read, with their parents' transforms. Each occurs once.
struct NodeStack<'a> {
    reached: Vec<bool>,
    nodes: Vec<(u32, &'a GlbNode, DMat4)>,
}

/// Triangles of the default scene, in their node's position.
pub(super) struct GlbPart<'a> {
    /// Where in the file, for messages.
    at: String,
    /// The triangles and their material.
    pub primitive: &'a GlbPrimitive,
    matrix: DMat4,
}

/// The mesh under construction. Normals, colors and texture coordinates are kept only if every part has them; colors
/// also if a material without a texture has one.
#[derive(Default)]
pub(super) struct Primitives {
    pub positions: Vec<DVec3>,
    /// Everything but the positions.
    pub mesh: Mesh,
    /// Factors of the vertices' colors, for parts that have any.
    pub alphas: Vec<f32>,
    bare_normals: bool,
    bare_colors: bool,
    /// Whether a material without a texture has a color.
    tinted: bool,
    /// One for each vertex.
    pub uvs: Vec<Vec2>,
    bare_uvs: bool,
    /// The base colors of the parts; `None` for a part without.
    textures: BTreeSet<Option<u32>>,
    /// Factors of the parts with a texture.
    tints: Vec<Option<[f32; 3]>>,
}

impl Primitives {
    /// Whether the vertices have colors or opacity of their own.
    pub fn is_colored(&self) -> bool {
        !self.bare_colors || self.tinted
    }
}

pub(super) struct GlbReader<'a> {
    pub root: &'a GlbRoot,
    pub bin: &'a [u8],
    pub source: Source<'a>,
}

impl<'a> GlbReader<'a> {
    /// Looks up an index of the document.
    fn get<T>(&self, what: &str, all: &'a [T], index: u32) -> Result<&'a T> {
        all.get(index as usize).ok_or_else(|| {
            let count = all.len();
            self.source.broken(format!("{what} {index}"), format!("is named, but there are only {count}"))
        })
    }

    /// Pushes nodes on the stack, the first on top.
    fn push(&self, nodes: &[u32], parent: DMat4, tree: &mut NodeStack<'a>) -> Result<()> {
        for &index in nodes.iter().rev() {
            let node = self.get("node", &self.root.nodes, index)?;
            if std::mem::replace(&mut tree.reached[index as usize], true) {
                let what = "is reached twice: nodes must form a tree";
                return Err(self.source.broken(format!("node {index}"), what));
            }
            tree.nodes.push((index, node, parent));
        }
        Ok(())
    }

    fn finish(&self, gathered: Primitives) -> Result<ParsedMesh> {
        let Primitives {
            positions,
            mut mesh,
            bare_normals,
            bare_colors,
            tinted,
            uvs,
            bare_uvs,
            textures,
            mut tints,
            ..
        } = gathered;
        if bare_normals {
            mesh.normals.clear();
        }
        if bare_colors && !tinted {
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
        tints.dedup();
        if second.is_some() || tints.len() > 1 {
            return Err(self.source.unsupported("`materials`", "a mesh with several base colors"));
        }
        let picture = first.map(|texture| self.picture(texture, out.atlas.as_mut()));
        out.picture = picture.transpose()?;
        out.tint = tints.first().copied().flatten();
        Ok(out)
    }

    fn roots(&self) -> Result<Vec<u32>> {
        let GlbRoot { scenes, scene, nodes, .. } = self.root;
        match (scenes.get(scene.unwrap_or(0) as usize), scene) {
            (Some(scene), _) => Ok(scene.nodes.clone()),
            (None, Some(index)) => {
                Err(self.source.broken("`scene`", format!("{index} of {} scenes", scenes.len())))
            }
            (None, None) => {
                let mut is_root = vec![true; nodes.len()];
                for &child in nodes.iter().flat_map(|n| &n.children) {
                    is_root.get_mut(child as usize).into_iter().for_each(|slot| *slot = false);
                }
                Ok((0..nodes.len() as u32).filter(|&n| is_root[n as usize]).collect())
            }
        }
    }

    /// Calls `visit` for all parts with triangles, in the order of the scene.
    pub fn each_part(&self, mut visit: impl FnMut(&GlbPart<'a>) -> Result<()>) -> Result<()> {
        let root = self.root;
        if root.nodes.is_empty() {
            for mesh in 0..root.meshes.len() as u32 {
                self.parts_of(mesh, &GlbNode::default(), DMat4::IDENTITY, &mut visit)?;
            }
        }
        let mut tree = NodeStack { reached: vec![false; root.nodes.len()], nodes: Vec::new() };
        self.push(&self.roots()?, DMat4::IDENTITY, &mut tree)?;
        while let Some((index, node, parent)) = tree.nodes.pop() {
            let matrix = parent * node.parent_from_node();
            if !matrix.is_finite() {
                return Err(self.source.broken(format!("node {index}"), "its transform is not finite"));
            }
            if let Some(mesh) = node.mesh {
                self.parts_of(mesh, node, matrix, &mut visit)?;
            }
            self.push(&node.children, matrix, &mut tree)?;
        }
        Ok(())
    }

    fn parts_of(
        &self,
        index: u32,
        node: &GlbNode,
        matrix: DMat4,
        visit: &mut impl FnMut(&GlbPart<'a>) -> Result<()>,
    ) -> Result<()> {
        let mesh = self.get("mesh", &self.root.meshes, index)?;
        if let Some(feature) = node.deformation(mesh) {
            return Err(self.source.unsupported(format!("mesh {index}"), feature));
        }
        for (k, primitive) in mesh.primitives.iter().enumerate() {
            let at = format!("mesh {index}, primitive {k}");
            match primitive.mode {
                Valid(Mode::Triangles) => visit(&GlbPart { at, primitive, matrix })?,
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

    /// Adds every triangle of a part.
    pub fn add_triangles(&self, part: &GlbPart, out: &mut Primitives) -> Result<()> {
        let (GlbPart { at, primitive, matrix }, source) = (part, self.source);
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

        let linear = DMat3::from_mat4(*matrix);
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
                // the inverse transpose, up to a factor that normalizing removes, also for singular matrices
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
            None => {
                out.bare_colors = true;
                out.mesh.colors.resize(first + count, [1.0; 3]);
            }
            Some((colors, width)) => {
                let each = || colors.chunks_exact(width);
                let coded = |c: &[f64]| [c[0], c[1], c[2]].map(|v| srgb_from_linear(v as f32));
                out.mesh.colors.extend(each().map(coded));
                out.alphas.extend(each().filter_map(|c| c.get(3)).map(|&a| a as f32));
            }
        }
        let material = primitive.material.and_then(|m| self.root.materials.get(m as usize));
        let pbr = material.map(|m| &m.pbr_metallic_roughness).filter(|pbr| pbr.base_color_texture.is_none());
        if let Some([r, g, b]) = pbr.and_then(|pbr| pbr.tint()) {
            out.tinted = true;
            for color in &mut out.mesh.colors[first..] {
                let tint = |c: f32, f: f32| srgb_from_linear(linear_from_srgb(c) * f);
                *color = [tint(color[0], r), tint(color[1], g), tint(color[2], b)];
            }
        }
        if source.options.texture {
            let info = self.base_color(primitive.material)?;
            out.textures.insert(info.map(|i| i.index));
            if info.is_some() {
                out.tints.push(material.and_then(|m| m.pbr_metallic_roughness.tint()));
            }
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

    /// All numbers of an accessor, flat, and how many an element has; normalized integers become −1..=1. Finite.
    fn numbers(&self, index: u32, kinds: &[Type], components: &[C]) -> Result<(Vec<f64>, usize)> {
        let source = self.source;
        let accessor = self.get("accessor", &self.root.accessors, index)?;
        let at = format!("accessor {index}");
        if accessor.sparse.is_some() {
            return Err(source.unsupported(at, "a sparse accessor"));
        }
        let (width, component) = match (accessor.kind, accessor.component_type) {
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
        let (count, offset) = (accessor.count, accessor.byte_offset);
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

    /// Returns the bytes of a buffer view, and the stride it gives its elements.
    fn view(&self, index: u32) -> Result<(&'a [u8], Option<usize>)> {
        let source = self.source;
        let view = self.get("buffer view", &self.root.buffer_views, index)?;
        let broken = |what: String| source.broken(format!("buffer view {index}"), what);
        let buffer = self.root.buffers.get(view.buffer as usize);
        let buffer = buffer.ok_or_else(|| broken(format!("names buffer {}", view.buffer)))?;
        if buffer.uri.is_some() || view.buffer != 0 {
            let at = format!("buffer {}", view.buffer);
            return Err(source.unsupported(at, "a buffer outside the file"));
        }
        let (length, found) = (buffer.byte_length, self.bin.len());
        if length > found as u64 {
            return Err(source.broken("buffer 0", format!("{length} bytes, but the file holds {found}")));
        }
        let (start, bytes) = (view.byte_offset, view.byte_length);
        match start.checked_add(bytes).filter(|&end| end <= length) {
            Some(end) => Ok((&self.bin[start as usize..end as usize], view.byte_stride)),
            None => Err(broken(format!("{bytes} bytes from {start} do not fit into a buffer of {length}"))),
        }
    }

    /// Returns the base color texture of a material, if it has one.
    pub fn base_color(&self, material: Option<u32>) -> Result<Option<&'a GlbTextureUse>> {
        let Some(index) = material else { return Ok(None) };
        let material = self.get("material", &self.root.materials, index)?;
        let info = material.pbr_metallic_roughness.base_color_texture.as_ref();
        if info.is_some_and(|i| i.extensions.transform.is_some()) {
            return Err(self.source.unsupported(format!("material {index}"), "`KHR_texture_transform`"));
        }
        Ok(info)
    }

    /// Returns the picture behind a texture, and its size in the atlas. Its header is checked against the limits for
    /// pictures; it is not decoded.
    pub fn picture(&self, texture: u32, atlas: Option<&mut Atlas>) -> Result<PictureSource> {
        let source = self.source;
        let Some(index) = self.get("texture", &self.root.textures, texture)?.source else {
            let at = format!("texture {texture}");
            return Err(source.unsupported(at, "a texture without a PNG or JPEG of its own"));
        };
        let image = self.get("image", &self.root.images, index)?;
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
