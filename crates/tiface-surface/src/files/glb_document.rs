//! A glTF document under construction, with its binary data: accessors, pictures, and the GLB
//! container.
//!
//! Every accessor has a view of its own, at a multiple of four bytes; `min` and `max` are the
//! stored numbers themselves. Views of pictures carry neither target nor stride.
//!
//! Compressed arrays lie in the file's buffer; their views are of a second one, which has no bytes
//! and which only decoders fill.

use super::meshopt::{EncodedArray, Encoder};
use glam::{DVec3, Vec2, Vec3, Vec4};
use gltf::json::accessor::{ComponentType, GenericComponentType, Type};
use gltf::json::buffer::{Stride, Target};
use gltf::json::image::MimeType;
use gltf::json::texture::{MagFilter, MinFilter, Sampler, WrappingMode};
use gltf::json::validation::Checked::Valid;
use gltf::json::validation::USize64;
use gltf::json::{self, Accessor, Image, Index, Root, Texture, Value};
use serde_json::json;
use tiface_base::geom::Aabb;
use tiface_base::{Error, Result};

/// Below this many vertices indices are 16 bit; 65 535 itself is kept free for primitive restart.
const SHORT_INDICES: usize = 65_535;

/// A glTF document under construction.
#[derive(Default)]
pub(super) struct GlbDocument {
    pub root: Root,
    pub bin: Vec<u8>,
    /// A node with its translation in f64: gltf-json's own is f32, and prints as numbers that read
    /// as others in f64.
    pub placed: Option<(Index<json::Node>, DVec3)>,
    /// Encoder of arrays; `None` stores them as they are.
    pub encoder: Option<Encoder>,
    encoded: Encoded,
}

/// Compressed arrays of a document.
#[derive(Default)]
struct Encoded {
    /// Views with what the extension says of them.
    views: Vec<(Index<json::buffer::View>, Value)>,
    /// Bytes of all arrays once they are decoded.
    bytes: u64,
}

const COMPRESSED: &str = "EXT_meshopt_compression";

impl GlbDocument {
    /// Adds a view of bytes at a multiple of four.
    fn view(&mut self, bytes: &[u8], target: Option<Target>) -> Index<json::buffer::View> {
        let view = self.root.push(json::buffer::View {
            buffer: Index::new(0),
            byte_length: USize64(bytes.len() as u64),
            byte_offset: Some(USize64(self.bin.len() as u64)),
            byte_stride: None,
            name: None,
            target: target.map(Valid),
            extensions: None,
            extras: Default::default(),
        });
        self.bin.extend_from_slice(bytes);
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        view
    }

    /// Adds elements without gaps, or returns an accessor of the same bytes: layers may cover the
    /// whole mesh. Only bytes are normalized.
    fn accessor(&mut self, bytes: &[u8], (component, type_): (ComponentType, Type)) -> Index<Accessor> {
        let is_same = |a: &Accessor| {
            let view = a.buffer_view.map(|view| &self.root.buffer_views[view.value()]);
            matches!(a.component_type, Valid(GenericComponentType(known)) if known == component)
                && a.type_ == Valid(type_)
                && view.is_some_and(|view| {
                    let start = view.byte_offset.map_or(0, |offset| offset.0 as usize);
                    self.bin[start..start + view.byte_length.0 as usize] == *bytes
                })
        };
        if let Some(known) = self.root.accessors.iter().position(is_same) {
            return Index::new(known as u32);
        }
        let is_index = matches!((component, type_), (ComponentType::U16 | ComponentType::U32, Type::Scalar));
        let target = if is_index { Target::ElementArrayBuffer } else { Target::ArrayBuffer };
        let view = self.view(bytes, Some(target));
        self.root.push(Accessor {
            buffer_view: Some(view),
            byte_offset: None,
            count: USize64((bytes.len() / (component.size() * type_.multiplicity())) as u64),
            component_type: Valid(GenericComponentType(component)),
            type_: Valid(type_),
            min: None,
            max: None,
            name: None,
            normalized: matches!(component, ComponentType::U8),
            sparse: None,
            extensions: None,
            extras: Default::default(),
        })
    }

    /// Adds an encoded array, with its view of the buffer that only decoders fill.
    fn add_encoded(&mut self, array: EncodedArray, target: Target) -> Index<Accessor> {
        let EncodedArray { bytes, count, stride, mode, filter, component, type_, normalized } = array;
        let length = (count * stride) as u64;
        let is_vertex = matches!(target, Target::ArrayBuffer);
        let view = self.root.push(json::buffer::View {
            buffer: Index::new(1),
            byte_length: USize64(length),
            byte_offset: Some(USize64(self.encoded.bytes)),
            byte_stride: is_vertex.then_some(Stride(stride)),
            name: None,
            target: Some(Valid(target)),
            extensions: None,
            extras: Default::default(),
        });
        let extension = json!({
            "buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len(), "byteStride": stride,
            "count": count, "mode": mode, "filter": filter,
        });
        self.encoded.views.push((view, extension));
        self.encoded.bytes += length.next_multiple_of(8);
        self.bin.extend(bytes);
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        self.root.push(Accessor {
            buffer_view: Some(view),
            byte_offset: None,
            count: USize64(count as u64),
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

    /// Adds vectors of f32, or with an encoder what it makes of them.
    fn vectors<T: bytemuck::NoUninit>(
        &mut self,
        values: &[T],
        encode: impl Fn(&mut Encoder, &[T]) -> EncodedArray,
    ) -> Index<Accessor> {
        match self.encoder.as_mut().map(|encoder| encode(encoder, values)) {
            Some(array) => self.add_encoded(array, Target::ArrayBuffer),
            None => self.floats(values),
        }
    }

    /// Adds unit vectors.
    pub fn directions(&mut self, values: &[Vec3]) -> Index<Accessor> {
        self.vectors(values, Encoder::directions)
    }

    /// Adds unit vectors with a sign.
    pub fn tangents(&mut self, values: &[Vec4]) -> Index<Accessor> {
        self.vectors(values, Encoder::tangents)
    }

    /// Adds texture coordinates in 0..=1.
    pub fn uvs(&mut self, values: &[Vec2]) -> Index<Accessor> {
        self.vectors(values, Encoder::uvs)
    }

    /// Adds colors of three numbers in 0..=1.
    pub fn colors(&mut self, values: &[Vec3]) -> Index<Accessor> {
        self.vectors(values, Encoder::colors)
    }

    /// Adds numbers, which encoders keep exactly.
    pub fn numbers(&mut self, values: &[f32]) -> Index<Accessor> {
        self.vectors(values, Encoder::numbers)
    }

    /// Numbers or vectors of f32: [`glam::Vec2`], `Vec3`, `Vec4` or arrays.
    fn floats<T: bytemuck::NoUninit>(&mut self, values: &[T]) -> Index<Accessor> {
        let kind = match size_of::<T>() / 4 {
            1 => Type::Scalar,
            2 => Type::Vec2,
            3 => Type::Vec3,
            _ => Type::Vec4,
        };
        self.accessor(bytes_of(values), (ComponentType::F32, kind))
    }

    /// Adds vectors of four bytes that stand for 0..=1.
    pub fn bytes(&mut self, values: &[[u8; 4]]) -> Index<Accessor> {
        if let Some(array) = self.encoder.as_mut().map(|encoder| encoder.bytes(values)) {
            return self.add_encoded(array, Target::ArrayBuffer);
        }
        self.accessor(bytes_of(values), (ComponentType::U8, Type::Vec4))
    }

    /// Positions with their bounds, which are mandatory.
    pub fn positions(&mut self, values: &[Vec3]) -> Index<Accessor> {
        if let Some((array, [low, high])) = self.encoder.as_mut().map(|encoder| encoder.positions(values)) {
            let index = self.add_encoded(array, Target::ArrayBuffer);
            let accessor = &mut self.root.accessors[index.value()];
            (accessor.min, accessor.max) = (Some(low.to_vec().into()), Some(high.to_vec().into()));
            return index;
        }
        let bounds = Aabb::around(values.iter().copied());
        let index = self.floats(values);
        let accessor = &mut self.root.accessors[index.value()];
        (accessor.min, accessor.max) =
            (Some(bounds.min.to_array().to_vec().into()), Some(bounds.max.to_array().to_vec().into()));
        index
    }

    /// Corners of triangles among `vertices` vertices.
    pub fn indices(&mut self, triangles: &[[u32; 3]], vertices: usize) -> Index<Accessor> {
        let (flat, short) = (triangles.as_flattened(), vertices < SHORT_INDICES);
        if let Some(array) = self.encoder.as_mut().map(|encoder| encoder.triangles(triangles, short)) {
            return self.add_encoded(array, Target::ElementArrayBuffer);
        }
        if short {
            let short: Vec<u16> = flat.iter().map(|&i| i as u16).collect();
            return self.accessor(bytes_of(&short), (ComponentType::U16, Type::Scalar));
        }
        self.accessor(bytes_of(flat), (ComponentType::U32, Type::Scalar))
    }

    /// Adds a picture as a texture that is filtered smoothly and not repeated.
    pub fn texture(&mut self, name: &str, bytes: &[u8], mime: &str) -> Index<Texture> {
        if self.root.samplers.is_empty() {
            self.root.push(Sampler {
                mag_filter: Some(Valid(MagFilter::Linear)),
                min_filter: Some(Valid(MinFilter::LinearMipmapLinear)),
                wrap_s: Valid(WrappingMode::ClampToEdge),
                wrap_t: Valid(WrappingMode::ClampToEdge),
                ..Default::default()
            });
        }
        let view = self.view(bytes, None);
        let source = self.root.push(Image {
            buffer_view: Some(view),
            mime_type: Some(MimeType(mime.into())),
            name: Some(name.into()),
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

    /// Returns the document and its bytes as one file.
    pub fn pack(mut self) -> Result<Vec<u8>> {
        self.root.asset.generator = Some(concat!("tiface ", env!("CARGO_PKG_VERSION")).into());
        self.root.push(json::Buffer {
            byte_length: USize64(self.bin.len() as u64),
            name: None,
            uri: None,
            extensions: None,
            extras: Default::default(),
        });
        if self.encoder.is_some() {
            for name in [COMPRESSED, "KHR_mesh_quantization"] {
                self.root.extensions_used.push(name.into());
                self.root.extensions_required.push(name.into());
            }
        }
        let GlbDocument { root, bin, placed, encoder, encoded } = self;
        let json = match (placed, encoder) {
            (None, None) => root.to_vec(),
            _ => serde_json::to_value(&root).and_then(|mut json| {
                if let Some((node, at)) = placed {
                    json["nodes"][node.value()]["translation"] = at.to_array().to_vec().into();
                }
                encoded.describe(&mut json);
                serde_json::to_vec(&json)
            }),
        };
        let json = json.expect("a document of plain numbers and names serializes");
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

impl Encoded {
    /// Adds what gltf-json has no types for: the extension of each view, and the buffer that only
    /// decoders fill.
    fn describe(self, json: &mut Value) {
        for (view, extension) in self.views {
            json["bufferViews"][view.value()]["extensions"] = json!({ COMPRESSED: extension });
        }
        if let Some(buffers) = json["buffers"].as_array_mut().filter(|_| self.bytes > 0) {
            buffers.push(json!({
                "byteLength": self.bytes,
                "extensions": { COMPRESSED: { "fallback": true } },
            }));
        }
    }
}

/// Numbers as glTF stores them. Its order is little endian, and so is every machine we build for.
fn bytes_of<T: bytemuck::NoUninit>(values: &[T]) -> &[u8] {
    const { assert!(cfg!(target_endian = "little"), "GLB is little endian") };
    bytemuck::cast_slice(values)
}
