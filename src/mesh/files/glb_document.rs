//! A glTF document as it grows, with the bytes it speaks of: accessors, pictures, the GLB around them.
//!
//! Every accessor has a view of its own, at a multiple of four bytes; `min` and `max` are the stored
//! numbers themselves. Views of pictures carry neither target nor stride.

use super::export::ExportError;
use crate::geom::Aabb;
use glam::{DVec3, Vec3};
use gltf_json::accessor::{ComponentType, GenericComponentType, Type};
use gltf_json::buffer::{Stride, Target};
use gltf_json::image::MimeType;
use gltf_json::texture::{Info, MagFilter, MinFilter, Sampler, WrappingMode};
use gltf_json::validation::{Checked::Valid, USize64};
use gltf_json::{Accessor, Image, Index, Root, Texture, Value};

/// Below this many vertices indices are 16 bit; 65 535 itself is kept free for primitive restart.
const SHORT_INDICES: usize = 65_535;

#[derive(Default)]
pub(super) struct Document {
    pub root: Root,
    pub bin: Vec<u8>,
    /// A node, and where it stands in f64: gltf-json's own translations are f32, and print as numbers that read
    /// as others in f64.
    pub far: Option<(Index<gltf_json::Node>, DVec3)>,
}

impl Document {
    /// A view of bytes at a multiple of four.
    fn view(
        &mut self,
        bytes: &[u8],
        target: Option<Target>,
        stride: Option<usize>,
    ) -> Index<gltf_json::buffer::View> {
        let view = self.root.push(gltf_json::buffer::View {
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

    fn accessor(
        &mut self,
        view: Index<gltf_json::buffer::View>,
        count: usize,
        component: ComponentType,
        type_: Type,
        normalized: bool,
    ) -> Index<Accessor> {
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

    /// Vectors of f32: [`glam::Vec2`], `Vec3`, `Vec4` or arrays.
    pub fn floats<T: bytemuck::NoUninit>(&mut self, values: &[T]) -> Index<Accessor> {
        let view = self.view(bytes_of(values), Some(Target::ArrayBuffer), None);
        self.accessor(view, values.len(), ComponentType::F32, vector(size_of::<T>() / 4), false)
    }

    /// Positions, which must say their bounds.
    pub fn positions(&mut self, values: &[Vec3]) -> Index<Accessor> {
        let bounds = Aabb::around(values.iter().copied());
        let accessor = self.floats(values);
        self.bounds(bounds.min.to_array(), bounds.max.to_array());
        accessor
    }

    /// Bounds of the accessor made last.
    fn bounds<T: Into<Value>>(&mut self, min: [T; 3], max: [T; 3]) {
        let last = self.root.accessors.last_mut().expect("bounds follow their accessor");
        last.min = Some(Value::from(min.map(Into::into).to_vec()));
        last.max = Some(Value::from(max.map(Into::into).to_vec()));
    }

    /// Vectors of 16 bits: 0..=1, or −1..=1 with `signed`. Each starts at a multiple of four bytes.
    pub fn shorts<const N: usize>(
        &mut self,
        values: impl Iterator<Item = [f32; N]>,
        signed: bool,
    ) -> Index<Accessor> {
        let (width, mut count) = (N.next_multiple_of(2), 0);
        let mut bytes: Vec<u8> = Vec::new();
        for value in values {
            for v in value {
                bytes.extend(if signed {
                    ((v.clamp(-1.0, 1.0) * 32767.0).round() as i16).to_le_bytes()
                } else {
                    unsigned_short(v).to_le_bytes()
                });
            }
            count += 1;
            bytes.resize(count * 2 * width, 0);
        }
        let view = self.view(&bytes, Some(Target::ArrayBuffer), Some(2 * width));
        let component = if signed { ComponentType::I16 } else { ComponentType::U16 };
        self.accessor(view, count, component, vector(N), true)
    }

    /// Positions in 16 bits, 0..=1 in a cube to be placed by the node.
    pub fn short_positions(&mut self, values: &[[f32; 3]]) -> Index<Accessor> {
        let (mut low, mut high) = ([u16::MAX; 3], [0; 3]);
        for value in values {
            for k in 0..3 {
                let v = unsigned_short(value[k]);
                (low[k], high[k]) = (low[k].min(v), high[k].max(v));
            }
        }
        let accessor = self.shorts(values.iter().copied(), false);
        self.bounds(low, high);
        accessor
    }

    /// Corners of triangles among `vertices` vertices.
    pub fn indices(&mut self, triangles: &[[u32; 3]], vertices: usize) -> Index<Accessor> {
        let flat = triangles.as_flattened();
        let target = Some(Target::ElementArrayBuffer);
        let (view, component) = if vertices < SHORT_INDICES {
            let short: Vec<u16> = flat.iter().map(|&i| i as u16).collect();
            (self.view(bytes_of(&short), target, None), ComponentType::U16)
        } else {
            (self.view(bytes_of(flat), target, None), ComponentType::U32)
        };
        self.accessor(view, flat.len(), component, Type::Scalar, false)
    }

    /// A picture inside the file: filtered smoothly, not repeated.
    pub fn texture(&mut self, name: &str, bytes: &[u8], ending: &str) -> Index<Texture> {
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
        let mime = if ending == "png" { "image/png" } else { "image/jpeg" };
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

    /// Header, JSON chunk padded with spaces, binary chunk padded with zeros.
    pub fn pack(mut self) -> Result<Vec<u8>, ExportError> {
        self.root.push(gltf_json::Buffer {
            byte_length: USize64(self.bin.len() as u64),
            name: None,
            uri: None,
            extensions: None,
            extras: Default::default(),
        });
        let Document { root, bin, far } = self;
        let json = match far {
            None => root.to_vec(),
            Some((node, at)) => serde_json::to_value(&root).and_then(|mut json| {
                json["nodes"][node.value()]["translation"] = at.to_array().to_vec().into();
                serde_json::to_vec(&json)
            }),
        };
        let mut json = json.expect("a document of plain numbers and names serialises");
        json.resize(json.len().next_multiple_of(4), b' ');
        let bytes = 12 + 8 + json.len() as u64 + 8 + bin.len() as u64;
        let total = u32::try_from(bytes).map_err(|_| ExportError::TooLarge { bytes })?;
        let mut out = Vec::with_capacity(total as usize);
        out.extend_from_slice(b"glTF");
        for word in [2, total, json.len() as u32] {
            out.extend_from_slice(&word.to_le_bytes());
        }
        out.extend_from_slice(b"JSON");
        out.extend_from_slice(&json);
        out.extend_from_slice(&(bin.len() as u32).to_le_bytes());
        out.extend_from_slice(b"BIN\0");
        out.extend_from_slice(&bin);
        Ok(out)
    }
}

/// A texture as a material names it.
pub(super) fn info(index: Index<Texture>) -> Info {
    Info { index, tex_coord: 0, extensions: None, extras: Default::default() }
}

fn unsigned_short(v: f32) -> u16 {
    (v.clamp(0.0, 1.0) * 65535.0).round() as u16
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
