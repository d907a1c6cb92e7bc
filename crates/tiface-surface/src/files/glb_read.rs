//! Reads a GLB: all triangles of the default scene, transformed by their nodes, and their base
//! color.
//!
//! `gltf` takes the container apart. Of its JSON only what is read here can cause an error, and
//! numbers are f64: a node may lie kilometers from the origin, where `gltf-json`'s f32 has steps of
//! half a meter. The document's references are checked before they are used. Only data in the file
//! is read: buffers with a URI are refused, and a picture with one is named for the caller to open.

use super::color_range::bring_into_range;
use super::gltf_document::{GlbLobes, GlbNode, GlbPrimitive, GlbRoot, GlbTextureUse};
use super::source::{LobeSource, PictureSource, ReadMesh, Source};
use super::uri::{data_of_uri, name_of_uri};
use glam::{DMat3, DMat4, DVec3, Vec2};
use gltf::Glb;
use gltf::json::accessor::{ComponentType as C, GenericComponentType, Type};
use gltf::json::mesh::{Mode, Semantic};
use gltf::json::validation::Checked::{Invalid, Valid};
use std::collections::BTreeSet;
use tiface_base::error::counted;
use tiface_base::geom::Atlas;
use tiface_base::image::{linear_from_srgb, srgb_from_linear};
use tiface_base::{Result, io};

/// The extension that allows 8 and 16 bits in more attributes.
const QUANTIZED: &str = "KHR_mesh_quantization";
const SHORTENED: [C; 5] = [C::F32, C::I8, C::U8, C::I16, C::U16];

/// Returns whether an extension leaves shape and color attributes alone, or is read.
fn is_harmless(extension: &str) -> bool {
    extension.starts_with("KHR_materials_")
        || extension == QUANTIZED
        || ["KHR_texture_transform", "EXT_texture_webp", "KHR_texture_basisu", "KHR_node_visibility"]
            .contains(&extension)
}

/// How to undo the compressions of meshes and pictures.
fn way_without(extension: &str) -> Option<&'static str> {
    match extension {
        "KHR_draco_mesh_compression" => {
            Some("open it in Blender, which decodes Draco, and export it as .glb without compression")
        }
        "EXT_meshopt_compression" | "KHR_meshopt_compression" => {
            Some("open it in the editor of three.js, which decodes meshopt, and export it as GLB")
        }
        _ => None,
    }
}

pub(super) fn read(bytes: &[u8], source: Source) -> Result<ReadMesh> {
    let glb = chunks(bytes, source)?;
    let root = GlbRoot::parse(&glb.json, source)?;
    if let Some(extension) = root.extensions_required.iter().find(|e| !is_harmless(e)) {
        let error = source.unsupported("`extensionsRequired`", format!("`{extension}`"));
        return Err(way_without(extension).map_or(error.clone(), |way| error.with_hint(way)));
    }
    let short = root.extensions_required.iter().any(|e| e == QUANTIZED);
    let mut reader = GlbReader {
        root: &root,
        bin: glb.bin.as_deref().unwrap_or_default(),
        source,
        short: if short { &SHORTENED } else { &[C::F32] },
        out: ReadMesh { atlas: Some(Atlas::default()), ..ReadMesh::default() },
        bare_normals: false,
        bare_colors: false,
        tinted: false,
        textures: BTreeSet::new(),
        tints: Vec::new(),
        lobes: Vec::new(),
    };
    reader.scene()?;
    reader.finish()
}

/// Returns the JSON chunk and the binary one.
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
    let (found, limit) = (glb.json.len(), source.options.json);
    if found > limit {
        return Err(source.broken("byte 12", format!("{found} bytes of JSON, more than {limit}")));
    }
    Ok(glb)
}

/// Returns a number of an accessor, and the one that stands for 1 if it is normalized.
fn number(component: C, b: &[u8]) -> (f64, f64) {
    match component {
        C::U8 => (f64::from(b[0]), 255.0),
        C::I8 => (f64::from(b[0] as i8), 127.0),
        C::I16 => (f64::from(i16::from_le_bytes([b[0], b[1]])), 32767.0),
        C::U16 => (f64::from(u16::from_le_bytes([b[0], b[1]])), 65535.0),
        C::U32 => (f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])), 1.0),
        C::F32 => (f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])), 1.0),
    }
}

/// The reachable nodes that are still to be read, with their parents' transforms. Each occurs once.
struct NodeStack<'a> {
    reached: Vec<bool>,
    nodes: Vec<NodeToRead<'a>>,
}

struct NodeToRead<'a> {
    index: u32,
    node: &'a GlbNode,
    parent: DMat4,
    /// Whether it or a node above it is hidden.
    is_hidden: bool,
}

/// A primitive that is being added.
struct GlbPart<'a> {
    /// Its place in the document, for messages.
    at: &'a str,
    primitive: &'a GlbPrimitive,
    /// Index of its first vertex in the mesh.
    first: usize,
    /// Its node's transform without the translation.
    linear: DMat3,
}

impl GlbPart<'_> {
    /// Returns the accessor of an attribute.
    fn accessor(&self, semantic: Semantic) -> Option<u32> {
        self.primitive.attributes.get(&Valid(semantic)).copied()
    }

    fn is_mirrored(&self) -> bool {
        self.linear.determinant() < 0.0
    }
}

/// A document and the mesh that is read from it. Normals, colors and texture coordinates are kept
/// only if every part has them; colors also if a material without a texture has one.
struct GlbReader<'a> {
    root: &'a GlbRoot,
    bin: &'a [u8],
    source: Source<'a>,
    /// Components that positions and normals may have.
    short: &'static [C],
    out: ReadMesh,
    bare_normals: bool,
    bare_colors: bool,
    /// Whether a material without a texture has a color.
    tinted: bool,
    /// The base colors of the parts; `None` for a part without.
    textures: BTreeSet<Option<u32>>,
    /// Factors of the parts with a texture.
    tints: Vec<Option<[f32; 3]>>,
    /// Lobes of the parts with a texture; `None` for a part without, or turned by its nodes.
    lobes: Vec<Option<GlbLobes>>,
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
    fn push(&self, nodes: &[u32], parent: DMat4, hidden: bool, tree: &mut NodeStack<'a>) -> Result<()> {
        for &index in nodes.iter().rev() {
            let node = self.get("node", &self.root.nodes, index)?;
            if std::mem::replace(&mut tree.reached[index as usize], true) {
                let what = "is reached twice: nodes must form a tree";
                return Err(self.source.broken(format!("node {index}"), what));
            }
            tree.nodes.push(NodeToRead { index, node, parent, is_hidden: hidden || node.is_hidden() });
        }
        Ok(())
    }

    fn finish(mut self) -> Result<ReadMesh> {
        if self.bare_normals {
            self.out.mesh.normals.clear();
        }
        if self.out.mesh.seen_by.len() != self.out.places.len() {
            self.out.mesh.seen_by.clear();
        }
        if self.bare_colors && !self.tinted {
            if self.out.mesh.colors.iter().any(|c| *c != [1.0; 3]) {
                self.out.note("vertex colors are not shown: some parts of the mesh have no `COLOR_0`");
            }
            self.out.mesh.colors.clear();
        }
        if !self.source.options.texture || self.out.mesh.triangles.is_empty() {
            return Ok(ReadMesh { atlas: None, ..self.out });
        }
        if let Some(atlas) = &mut self.out.atlas {
            atlas.triangles.clone_from(&self.out.mesh.triangles);
        }
        let mut textures = std::mem::take(&mut self.textures).into_iter();
        let (first, second) = (textures.next().flatten(), textures.next());
        self.tints.dedup();
        if second.is_some() || self.tints.len() > 1 {
            return Err(self.source.unsupported("`materials`", "a mesh with several base colors"));
        }
        self.out.tint = self.tints.first().copied().flatten();
        if let Some(texture) = first {
            let (picture, size) = self.picture(texture)?;
            if let (Some(atlas), Some([width, height])) = (&mut self.out.atlas, size) {
                (atlas.width, atlas.height) = (width, height);
            }
            self.out.picture = Some(picture);
        }
        self.lobes.dedup();
        if let ([Some(lobes)], None) = (&self.lobes[..], self.out.tint) {
            let pictures = lobes.textures.iter().map(|texture| match self.picture(*texture)? {
                (PictureSource::Inside(bytes), _) => Ok(bytes),
                _ => Err(self.source.unsupported("lobes", "a picture outside of the file")),
            });
            match pictures.collect::<Result<_>>() {
                Ok(pictures) => self.out.lobes = Some(LobeSource { pictures, scale: lobes.scale.clone() }),
                Err(e) => self.out.note(format!("colors that change with the view are not shown: {e}")),
            }
        }
        Ok(self.out)
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

    /// Reads all parts with triangles, in the order of the scene.
    fn scene(&mut self) -> Result<()> {
        let root = self.root;
        if root.nodes.is_empty() {
            for mesh in 0..root.meshes.len() as u32 {
                self.parts_of(mesh, &GlbNode::default(), DMat4::IDENTITY)?;
            }
        }
        let mut tree = NodeStack { reached: vec![false; root.nodes.len()], nodes: Vec::new() };
        self.push(&self.roots()?, DMat4::IDENTITY, false, &mut tree)?;
        let mut hidden = 0;
        while let Some(NodeToRead { index, node, parent, is_hidden }) = tree.nodes.pop() {
            let matrix = parent * node.parent_from_node();
            if !matrix.is_finite() {
                return Err(self.source.broken(format!("node {index}"), "its transform is not finite"));
            }
            match node.mesh {
                Some(_) if is_hidden => hidden += 1,
                Some(mesh) => self.parts_of(mesh, node, matrix)?,
                None => {}
            }
            self.push(&node.children, matrix, is_hidden, &mut tree)?;
        }
        let elsewhere =
            root.nodes.iter().zip(&tree.reached).filter(|(node, reached)| node.mesh.is_some() && !*reached);
        let elsewhere = elsewhere.count();
        if hidden > 0 {
            let hidden = counted(hidden, "hidden node");
            self.out.note(format!("{hidden} left out (`KHR_node_visibility`)"));
        }
        if elsewhere > 0 {
            let elsewhere = counted(elsewhere, "node");
            self.out.note(format!("{elsewhere} outside the default scene left out"));
        }
        if hidden > 0 && self.out.mesh.triangles.is_empty() {
            return Err(self.source.unsupported("`nodes`", "a scene whose meshes are all hidden"));
        }
        Ok(())
    }

    fn parts_of(&mut self, index: u32, node: &GlbNode, matrix: DMat4) -> Result<()> {
        let mesh = self.get("mesh", &self.root.meshes, index)?;
        if let Some(feature) = node.deformation(mesh) {
            return Err(self.source.unsupported(format!("mesh {index}"), feature));
        }
        for (k, primitive) in mesh.primitives.iter().enumerate() {
            let at = format!("mesh {index}, primitive {k}");
            match primitive.mode {
                Valid(Mode::Triangles) => self.add_triangles(&at, primitive, matrix)?,
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

    /// Adds every triangle of a part, unless it is a soft layer around the surface.
    fn add_triangles(&mut self, at: &str, primitive: &GlbPrimitive, matrix: DMat4) -> Result<()> {
        let source = self.source;
        let material = primitive.material.and_then(|m| self.root.materials.get(m as usize));
        if material.is_some_and(|m| m.is_soft_layer()) {
            self.out.soft_layers += 1;
            return Ok(());
        }
        let part = GlbPart { at, primitive, first: self.out.places.len(), linear: DMat3::from_mat4(matrix) };
        let position = part.accessor(Semantic::Positions);
        let position = position.ok_or_else(|| source.broken(at, "there is no `POSITION`"))?;
        let (positions, _) = self.numbers(position, &[Type::Vec3], self.short)?;
        let count = positions.len() / 3;
        let indices = self.indices(&part, count)?;
        source.allow(part.first + count, self.out.mesh.triangles.len() + indices.len() / 3)?;
        for p in positions.as_chunks::<3>().0 {
            let moved = matrix.transform_point3(DVec3::from(*p));
            if !moved.as_vec3().is_finite() {
                return Err(source.broken(at, "a vertex is not finite once its node has moved it"));
            }
            self.out.places.push(moved);
        }
        self.add_normals(&part)?;
        self.add_colors(&part)?;
        self.add_seen_by(&part);
        let color = material.map(|m| m.color()).unwrap_or_default();
        color.note.into_iter().for_each(|note| self.out.note(note));
        if let Some(factors) = color.tint.filter(|_| color.texture.is_none()) {
            self.tinted = true;
            let colors = &mut self.out.mesh.colors[part.first..];
            for (c, f) in colors.iter_mut().flat_map(|c| c.iter_mut().zip(factors)) {
                *c = srgb_from_linear(linear_from_srgb(*c) * f);
            }
        }
        if source.options.texture {
            self.add_texture(&part, color.tint)?;
        }
        let mirrored = part.is_mirrored();
        for t in indices.as_chunks::<3>().0 {
            let [a, b, c] = t.map(|i| part.first as u32 + i);
            self.out.mesh.triangles.push(if mirrored { [a, c, b] } else { [a, b, c] });
        }
        Ok(())
    }

    /// Returns the indices of a part of `count` vertices, three for each triangle.
    fn indices(&self, part: &GlbPart, count: usize) -> Result<Vec<u32>> {
        let (source, at) = (self.source, part.at);
        let indices: Vec<u32> = match part.primitive.indices {
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
        Ok(indices)
    }

    /// Returns one value a vertex of an attribute, flat, and its number of components; `None` if
    /// the part lacks it. The positions of the part have been added.
    fn attribute(
        &self,
        part: &GlbPart,
        semantic: Semantic,
        kinds: &[Type],
        components: &[C],
    ) -> Result<Option<(Vec<f64>, usize)>> {
        let name = semantic.to_string();
        let Some(index) = part.accessor(semantic) else { return Ok(None) };
        let (numbers, width) = self.numbers(index, kinds, components)?;
        let (found, count) = (numbers.len() / width, self.out.places.len() - part.first);
        if found != count {
            let what = format!("{found} of `{name}` for {count} of `POSITION`");
            return Err(self.source.broken(part.at, what));
        }
        Ok(Some((numbers, width)))
    }

    fn add_normals(&mut self, part: &GlbPart) -> Result<()> {
        let Some((normals, _)) = self.attribute(part, Semantic::Normals, &[Type::Vec3], self.short)? else {
            self.bare_normals = true;
            return Ok(());
        };
        // the inverse transpose, up to a factor that normalizing removes, also for singular
        // matrices
        let linear = part.linear;
        let cofactor = DMat3::from_cols(
            linear.y_axis.cross(linear.z_axis),
            linear.z_axis.cross(linear.x_axis),
            linear.x_axis.cross(linear.y_axis),
        ) * if part.is_mirrored() { -1.0 } else { 1.0 };
        let moved = |n: &[f64; 3]| (cofactor * DVec3::from(*n)).normalize_or_zero().as_vec3();
        self.out.mesh.normals.extend(normals.as_chunks::<3>().0.iter().map(moved));
        Ok(())
    }

    /// Adds the colors at the vertices; white, where a part has none.
    fn add_colors(&mut self, part: &GlbPart) -> Result<()> {
        let (kinds, components) = ([Type::Vec3, Type::Vec4], [C::F32, C::U8, C::U16]);
        let Some((colors, width)) = self.attribute(part, Semantic::Colors(0), &kinds, &components)? else {
            self.bare_colors = true;
            if part.primitive.attributes.keys().any(|key| matches!(key, Valid(Semantic::Colors(_)))) {
                let what = "vertex colors are not shown: they are not in `COLOR_0`, but in another set";
                self.out.note(what);
            }
            self.out.mesh.colors.resize(self.out.places.len(), [1.0; 3]);
            return Ok(());
        };
        let linear = |c: &[f64]| [c[0], c[1], c[2]].map(|v| v as f32);
        let mut linear: Vec<[f32; 3]> = colors.chunks_exact(width).map(linear).collect();
        bring_into_range(&mut linear, "`COLOR_0`").into_iter().for_each(|note| self.out.note(note));
        if width == 4 && colors.chunks_exact(4).any(|c| c[3] < 1.0) {
            self.out.note("`COLOR_0` has an alpha below 1; it is shown opaque");
        }
        self.out.mesh.colors.extend(linear.into_iter().map(|c| c.map(srgb_from_linear)));
        Ok(())
    }

    /// Adds the numbers of cameras, if all parts before have them, too. Another program's attribute
    /// of this name may be of any kind, and is left out then.
    fn add_seen_by(&mut self, part: &GlbPart) {
        let kinds = (&[Type::Scalar], &[C::F32]);
        let found = self.attribute(part, Semantic::Extras("SEEN_BY".into()), kinds.0, kinds.1);
        let Ok(Some((numbers, _))) = found else { return };
        if self.out.mesh.seen_by.len() == part.first {
            self.out.mesh.seen_by.extend(numbers.into_iter().map(|n| n.round().clamp(0.0, 255.0) as u8));
        }
    }

    /// Adds the texture coordinates, and the texture and its factor to those of the other parts.
    fn add_texture(&mut self, part: &GlbPart, tint: Option<[f32; 3]>) -> Result<()> {
        let used = self.texture_of(part.primitive.material)?;
        self.textures.insert(used.map(|i| i.index));
        if used.is_some() {
            let material = part.primitive.material.and_then(|m| self.root.materials.get(m as usize));
            // directions are those of the file's axes
            let lobes = material.and_then(|m| m.lobes()).filter(|_| part.linear == DMat3::IDENTITY);
            self.lobes.push(lobes);
            self.tints.push(tint);
        }
        let set = used.map_or(0, GlbTextureUse::set);
        match (self.attribute(part, Semantic::TexCoords(set), &[Type::Vec2], &SHORTENED)?, used) {
            (Some((uvs, _)), _) => {
                let placed = |uv: &[f64; 2]| used.map_or(*uv, |used| used.placed(*uv)).map(|v| v as f32);
                let uvs: Vec<Vec2> = uvs.as_chunks::<2>().0.iter().map(|uv| placed(uv).into()).collect();
                if uvs.iter().any(|uv| !uv.is_finite()) {
                    return Err(self.source.broken(part.at, "a texture coordinate is not finite"));
                }
                self.out.atlas.iter_mut().for_each(|atlas| atlas.uvs.extend(&uvs));
            }
            (None, Some(_)) => {
                return Err(self.source.broken(part.at, format!("there is no `TEXCOORD_{set}`")));
            }
            (None, None) => self.out.atlas = None,
        }
        Ok(())
    }

    /// Returns all numbers of an accessor, flat, and how many an element has; normalized integers
    /// become −1..=1. Finite.
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
                let (value, top) = number(component, b);
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

    /// Returns the texture that colors a material, if it has one.
    fn texture_of(&self, material: Option<u32>) -> Result<Option<&'a GlbTextureUse>> {
        let Some(index) = material else { return Ok(None) };
        let texture = self.get("material", &self.root.materials, index)?.color().texture;
        // programs do not agree on which way it turns
        if texture.and_then(|t| t.extensions.transform.as_ref()).is_some_and(|to| to.rotation != 0.0) {
            let feature = "`KHR_texture_transform` with a rotation";
            return Err(self.source.unsupported(format!("material {index}"), feature));
        }
        Ok(texture)
    }

    /// Returns the picture behind a texture, and its size if it is in the file. Its header is
    /// checked against the limits for pictures; it is not decoded.
    fn picture(&self, texture: u32) -> Result<(PictureSource, Option<[u32; 2]>)> {
        let source = self.source;
        let texture_at = format!("texture {texture}");
        let texture = self.get("texture", &self.root.textures, texture)?;
        let Some(index) = texture.source else {
            let feature = "a texture without a PNG or JPEG of its own";
            let Some(format) = texture.extensions.name() else {
                return Err(source.unsupported(texture_at, feature));
            };
            let error = source.unsupported(texture_at, format!("{feature}, but in {format},"));
            return Err(error.with_hint(
                "export it with PNG or JPEG; the editor of three.js reads KTX2 and WebP and exports PNG",
            ));
        };
        let image = self.get("image", &self.root.images, index)?;
        let at = format!("image {index}");
        let bytes = match &image.uri {
            None => {
                let view = image.buffer_view.ok_or_else(|| source.broken(&at, "has no buffer view"))?;
                self.view(view)?.0.to_vec()
            }
            Some(uri) => match data_of_uri(uri) {
                None => return Ok((PictureSource::Beside(name_of_uri(uri)), None)),
                Some(data) => data.ok_or_else(|| source.broken(&at, "its data URI is not Base64"))?,
            },
        };
        let info = io::parse_picture_info(&bytes, source.path, &io::Limits::default())
            .map_err(|e| source.broken(&at, e))?;
        Ok((PictureSource::Inside(bytes), Some([info.width, info.height])))
    }
}

/// "A, B or C".
fn names<T: std::fmt::Debug>(all: &[T]) -> String {
    let names: Vec<String> = all.iter().map(|v| format!("{v:?}")).collect();
    let (last, rest) = names.split_last().expect("something is always allowed");
    if rest.is_empty() { last.clone() } else { format!("{} or {last}", rest.join(", ")) }
}
