//! A glTF document as it grows, with the bytes it speaks of: accessors, pictures, the GLB around them.
//!
//! Every accessor has a view of its own, at a multiple of four bytes; `min` and `max` are the stored
//! numbers themselves. Views of pictures carry neither target nor stride.

use crate::geom::Aabb;
use crate::{Error, Result};
use glam::{DVec3, Vec3};
use gltf::json::accessor::{ComponentType, GenericComponentType, Type};
use gltf::json::buffer::{Stride, Target};
use gltf::json::image::MimeType;
use gltf::json::texture::{Info, MagFilter, MinFilter, Sampler, WrappingMode};
use gltf::json::validation::{Checked::Valid, USize64};
use gltf::json::{Accessor, Image, Index, Root, Texture, Value};

/// Below this many vertices indices are 16 bit; 65 535 itself is kept free for primitive restart.
const SHORT_INDICES: usize = 65_535;

#[derive(Default)]
pub(super) struct GlbDocument {
    pub root: Root,
    pub bin: Vec<u8>,
    /// A node with its translation and scale in f64: gltf-json's own are f32, and print as numbers that read as others
    /// in f64.
    pub placed: Option<(Index<gltf::json::Node>, DVec3, f64)>,
}

impl GlbDocument {
    /// A view of bytes at a multiple of four.
    fn view(
        &mut self,
        bytes: &[u8],
        stride: Option<usize>,
        target: Option<Target>,
    ) -> Index<gltf::json::buffer::View> {
        let view = self.root.push(gltf::json::buffer::View {
            buffer: Index::new(0),
            byte_length: USize64(bytes.len() as u64),
            byte_offset: Some(USize64(self.bin.len() as u64)),
            byte_stride: stride.map(Stride),
            name: None,
            target: target.map(Valid),
            extensions: None,
            extras: Default::default(),
        });
        self.bin.extend_from_slice(bytes);
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        view
    }

    /// Elements of so many bytes each, or the accessor that has the same already: layers around a mesh have its corners.
    fn accessor(
        &mut self,
        bytes: &[u8],
        element: usize,
        (component, type_): (ComponentType, Type),
        normalized: bool,
    ) -> Index<Accessor> {
        let is_same = |a: &Accessor| {
            let view = a.buffer_view.map(|view| &self.root.buffer_views[view.value()]);
            let offset = view.and_then(|view| view.byte_offset).map_or(0, |offset| offset.0 as usize);
            matches!(a.component_type, Valid(GenericComponentType(known)) if known == component)
                && (a.type_, a.normalized) == (Valid(type_), normalized)
                && view.is_some_and(|view| view.byte_length.0 == bytes.len() as u64)
                && self.bin[offset..].starts_with(bytes)
        };
        if let Some(known) = self.root.accessors.iter().position(is_same) {
            return Index::new(known as u32);
        }
        let is_index = matches!(type_, Type::Scalar);
        let target = if is_index { Target::ElementArrayBuffer } else { Target::ArrayBuffer };
        let is_padded = element > component.size() * type_.multiplicity();
        let view = self.view(bytes, is_padded.then_some(element), Some(target));
        self.root.push(Accessor {
            buffer_view: Some(view),
            byte_offset: None,
            count: USize64((bytes.len() / element.max(1)) as u64),
            component_type: Valid(GenericComponentType(component)),
            type_: Valid(type_),
            min: None,
            max: None,
            name: None,
            normalized,
            sparse: None,
            extensions: None,
            extras: Default::default(),
        })
    }

    /// Vectors of f32: [`glam::Vec2`], `Vec3`, `Vec4` or arrays.
    pub fn floats<T: bytemuck::NoUninit>(&mut self, values: &[T]) -> Index<Accessor> {
        let kind = (ComponentType::F32, vector(size_of::<T>() / 4));
        self.accessor(bytes_of(values), size_of::<T>(), kind, false)
    }

    /// Vectors of integers that stand for 0..=1, or −1..=1 where they have a sign, a multiple of four bytes each; those of
    /// three have a fourth component that is not read.
    pub fn normalized<T: bytemuck::NoUninit>(
        &mut self,
        values: &[T],
        component: ComponentType,
        type_: Type,
    ) -> Index<Accessor> {
        self.accessor(bytes_of(values), size_of::<T>(), (component, type_), true)
    }

    /// Says the bounds of an accessor, which positions must do.
    pub fn bound(&mut self, accessor: Index<Accessor>, bounds: [impl Into<Value>; 2]) {
        let [min, max] = bounds.map(|bound| Some(bound.into()));
        let accessor = &mut self.root.accessors[accessor.value()];
        (accessor.min, accessor.max) = (min, max);
    }

    /// Positions with their bounds.
    pub fn positions(&mut self, values: &[Vec3]) -> Index<Accessor> {
        let bounds = Aabb::around(values.iter().copied());
        let accessor = self.floats(values);
        self.bound(accessor, [bounds.min, bounds.max].map(|corner| corner.to_array().to_vec()));
        accessor
    }

    /// Corners of triangles among `vertices` vertices.
    pub fn indices(&mut self, triangles: &[[u32; 3]], vertices: usize) -> Index<Accessor> {
        let flat = triangles.as_flattened();
        if vertices < SHORT_INDICES {
            let short: Vec<u16> = flat.iter().map(|&i| i as u16).collect();
            return self.accessor(bytes_of(&short), 2, (ComponentType::U16, Type::Scalar), false);
        }
        self.accessor(bytes_of(flat), 4, (ComponentType::U32, Type::Scalar), false)
    }

    /// A picture inside the file: filtered smoothly, not repeated.
    pub fn texture(&mut self, name: Option<String>, bytes: &[u8], mime: &str) -> Index<Texture> {
        if self.root.samplers.is_empty() {
            self.root.push(Sampler {
                mag_filter: Some(Valid(MagFilter::Linear)),
                min_filter: Some(Valid(MinFilter::LinearMipmapLinear)),
                wrap_s: Valid(WrappingMode::ClampToEdge),
                wrap_t: Valid(WrappingMode::ClampToEdge),
                ..Default::default()
            });
        }
        let view = self.view(bytes, None, None);
        let source = self.root.push(Image {
            buffer_view: Some(view),
            mime_type: Some(MimeType(mime.into())),
            name,
            uri: None,
            extensions: None,
            extras: Default::default(),
        });
        self.root.push(Texture {
            name: None,
            sampler: Some(Index::new(0)),
            source,
            extensions: None,
            extras: Default::default(),
        })
    }

    /// Makes a scene of a node, which is the one that viewers show.
    pub fn show(&mut self, node: Index<gltf::json::Node>) {
        let (extensions, extras) = Default::default();
        let scene = gltf::json::Scene { nodes: vec![node], name: None, extensions, extras };
        self.root.scene = Some(self.root.push(scene));
    }

    /// The document and its bytes as one file.
    pub fn pack(mut self) -> Result<Vec<u8>> {
        self.root.asset.generator = Some(concat!("tiface ", env!("CARGO_PKG_VERSION")).into());
        self.root.push(gltf::json::Buffer {
            byte_length: USize64(self.bin.len() as u64),
            name: None,
            uri: None,
            extensions: None,
            extras: Default::default(),
        });
        let GlbDocument { root, bin, placed } = self;
        let json = match placed {
            None => root.to_vec(),
            Some((node, at, scale)) => serde_json::to_value(&root).and_then(|mut json| {
                let node = &mut json["nodes"][node.value()];
                node["translation"] = at.to_array().to_vec().into();
                if scale != 1.0 {
                    node["scale"] = vec![scale; 3].into();
                }
                serde_json::to_vec(&json)
            }),
        };
        let json = json.expect("a document of plain numbers and names serialises");
        let bytes = 12 + 8 + json.len().next_multiple_of(4) as u64 + 8 + bin.len() as u64;
        let length = u32::try_from(bytes).map_err(|_| {
            let what = format!("the file would have {bytes} bytes, but a GLB holds at most {}", u32::MAX);
            Error::cannot(what, "ask for fewer triangles, or write a .ply")
        })?;
        let header = gltf::binary::Header { magic: *b"glTF", version: 2, length };
        let glb = gltf::Glb { header, json: json.into(), bin: Some(bin.into()) };
        Ok(glb.to_vec().expect("writing to memory does not fail"))
    }
}

/// A texture as a material names it.
pub(super) fn info(index: Index<Texture>) -> Info {
    Info { index, tex_coord: 0, extensions: None, extras: Default::default() }
}

fn vector(width: usize) -> Type {
    match width {
        2 => Type::Vec2,
        3 => Type::Vec3,
        _ => Type::Vec4,
    }
}

/// Numbers as glTF stores them. Its order is little endian, and so is every machine we build for.
fn bytes_of<T: bytemuck::NoUninit>(values: &[T]) -> &[u8] {
    const { assert!(cfg!(target_endian = "little"), "GLB is little endian") };
    bytemuck::cast_slice(values)
}
