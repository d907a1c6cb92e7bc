//! Compression of the arrays in a GLB: `EXT_meshopt_compression` of integers of 8 and 16 bits,
//! which stand in the place of floats (`KHR_mesh_quantization`).
//!
//! Positions are on a grid of 65 534 steps along the longest side, 5 µm on a head, and the mesh's
//! node brings them to their place; equal positions stay equal, so a closed surface stays closed.
//! Texture coordinates and colors have 16 bits, normals and tangents 8. The encoder compresses what
//! changes little from one vertex to the next: triangles come in an order in which neighbors follow
//! each other, and vertices in the order of their first use.
//!
//! `KHR_meshopt_compression`, its newer form, allows version 1 of the vertex codec and filters of
//! colors, and its arrays are a tenth smaller; but of the readers of the older form few know it.

use glam::{Vec2, Vec3, Vec4};
use gltf::json::accessor::{ComponentType, Type};
use meshoptimizer_rs::codec::{
    IndexEncoding, VertexEncoding, encode_filter_oct, encode_index_buffer, encode_vertex_buffer,
};
use meshoptimizer_rs::{Limits, Workspace, optimize_vertex_cache};
use tiface_base::geom::Aabb;

/// Largest integer of a position.
const GRID: f32 = 32767.0;

/// Version 0, the only one of `EXT_meshopt_compression`; it knows no levels.
const VERTEX_CODEC: VertexEncoding = match VertexEncoding::new(0, 0) {
    Ok(codec) => codec,
    Err(_) => unreachable!(),
};

/// Bits of each number of a normal or tangent.
const DIRECTION_BITS: u32 = 8;

/// The grid of the positions in a file, and the encoder.
pub(super) struct Encoder {
    /// Place of the integer 0.
    pub center: Vec3,
    /// Length of a step.
    pub step: f32,
    workspace: Workspace,
}

/// An array as it is stored.
pub(super) struct EncodedArray {
    pub bytes: Vec<u8>,
    pub count: usize,
    /// Bytes of each element once it is decoded.
    pub stride: usize,
    pub mode: &'static str,
    /// What decoders do last.
    pub filter: &'static str,
    pub component: ComponentType,
    pub type_: Type,
    /// Whether the integers stand for 0..=1 or -1..=1.
    pub normalized: bool,
}

impl Encoder {
    /// Returns an encoder for positions within a box.
    pub fn new(bounds: Aabb) -> Encoder {
        // a box without size has one place, which any step reaches
        let longest = (0.5 * bounds.size().max_element()).max(f32::MIN_POSITIVE * GRID);
        let limits = Limits { max_bytes: usize::MAX, max_work: u64::MAX }; // the mesh is our own
        Encoder { center: bounds.center(), step: longest / GRID, workspace: Workspace::new(limits) }
    }

    /// Returns the integers of a position.
    fn place(&self, position: Vec3) -> [i16; 3] {
        ((position - self.center) / self.step).to_array().map(|v| v.round().clamp(-GRID, GRID) as i16)
    }

    /// Encodes positions, and returns their least and largest integers.
    pub fn positions(&mut self, values: &[Vec3]) -> (EncodedArray, [[i16; 3]; 2]) {
        let places: Vec<[i16; 3]> = values.iter().map(|&p| self.place(p)).collect();
        let extreme = |k: usize, of: fn(i16, i16) -> i16| places.iter().map(|p| p[k]).reduce(of).unwrap_or(0);
        let bounds = [i16::min, i16::max].map(|of| [0, 1, 2].map(|k| extreme(k, of)));
        let records: Vec<[i16; 4]> = places.iter().map(|&[x, y, z]| [x, y, z, 0]).collect();
        let array = self.attributes(&records, (ComponentType::I16, Type::Vec3), false);
        (array, bounds)
    }

    /// Encodes texture coordinates.
    pub fn uvs(&mut self, values: &[Vec2]) -> EncodedArray {
        let records: Vec<[u16; 2]> = values.iter().map(|uv| uv.to_array().map(unsigned)).collect();
        self.attributes(&records, (ComponentType::U16, Type::Vec2), true)
    }

    /// Encodes colors of three numbers in 0..=1.
    pub fn colors(&mut self, values: &[Vec3]) -> EncodedArray {
        let records: Vec<[u16; 4]> =
            values.iter().map(|c| [unsigned(c.x), unsigned(c.y), unsigned(c.z), 0]).collect();
        self.attributes(&records, (ComponentType::U16, Type::Vec3), true)
    }

    /// Encodes bytes that stand for 0..=1.
    pub fn bytes(&mut self, values: &[[u8; 4]]) -> EncodedArray {
        self.attributes(values, (ComponentType::U8, Type::Vec4), true)
    }

    /// Encodes numbers exactly.
    pub fn numbers(&mut self, values: &[f32]) -> EncodedArray {
        self.attributes(values, (ComponentType::F32, Type::Scalar), false)
    }

    /// Encodes unit vectors.
    pub fn directions(&mut self, values: &[Vec3]) -> EncodedArray {
        let records: Vec<Vec4> = values.iter().map(|n| n.extend(0.0)).collect();
        EncodedArray { type_: Type::Vec3, ..self.tangents(&records) }
    }

    /// Encodes unit vectors with a sign.
    pub fn tangents(&mut self, values: &[Vec4]) -> EncodedArray {
        let numbers: &[f32] = bytemuck::cast_slice(values);
        let octahedral = encode_filter_oct(values.len(), 4, DIRECTION_BITS, numbers, &mut self.workspace)
            .expect(UNLIMITED);
        let records: &[[u8; 4]] = bytemuck::cast_slice(&octahedral);
        let array = self.attributes(records, (ComponentType::I8, Type::Vec4), true);
        EncodedArray { filter: "OCTAHEDRAL", ..array }
    }

    fn attributes<T: bytemuck::NoUninit>(
        &mut self,
        records: &[T],
        (component, type_): (ComponentType, Type),
        normalized: bool,
    ) -> EncodedArray {
        let (count, stride) = (records.len(), size_of::<T>());
        let raw = bytemuck::cast_slice(records);
        let bytes =
            encode_vertex_buffer(raw, count, stride, VERTEX_CODEC, &mut self.workspace).expect(UNLIMITED);
        let (mode, filter) = ("ATTRIBUTES", "NONE");
        EncodedArray { bytes, count, stride, mode, filter, component, type_, normalized }
    }

    /// Encodes the corners of triangles among `vertices` vertices, in an order of its own.
    pub fn triangles(&mut self, triangles: &[[u32; 3]], short: bool) -> EncodedArray {
        let corners = triangles.as_flattened();
        let bytes =
            encode_index_buffer(corners, IndexEncoding::DEFAULT, &mut self.workspace).expect(UNLIMITED);
        let (component, stride) = if short { (ComponentType::U16, 2) } else { (ComponentType::U32, 4) };
        let (mode, filter, type_) = ("TRIANGLES", "NONE", Type::Scalar);
        EncodedArray {
            bytes,
            count: corners.len(),
            stride,
            mode,
            filter,
            component,
            type_,
            normalized: false,
        }
    }
}

/// Why encoding does not fail: strides and bits are constants of the format.
const UNLIMITED: &str = "arrays of a checked mesh are encoded without limits";

/// Returns the integer that stands for a number in 0..=1.
fn unsigned(value: f32) -> u16 {
    (value.clamp(0.0, 1.0) * 65535.0).round() as u16
}

/// Returns triangles in an order in which neighbors follow each other.
pub(super) fn in_cache_order(triangles: &[[u32; 3]], vertices: usize) -> Vec<[u32; 3]> {
    let mut workspace = Workspace::new(Limits { max_bytes: usize::MAX, max_work: u64::MAX });
    let corners = optimize_vertex_cache(triangles.as_flattened(), vertices, &mut workspace);
    corners.expect(UNLIMITED).as_chunks::<3>().0.to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::testing::ball;
    use crate::files::file_mesh::FileMesh;
    use crate::files::{ExportOptions, HeadTexture, to_glb};
    use glam::DVec3;
    use meshoptimizer_rs::codec::{BufferView, Filter, Mode};
    use serde_json::Value;
    use std::collections::BTreeMap;
    use tiface_base::geom::{Mesh, Similarity};

    fn number(value: &Value) -> usize {
        value.as_u64().unwrap_or(0) as usize
    }

    /// Returns the document of a GLB and its binary chunk.
    fn opened(glb: &[u8]) -> (Value, &[u8]) {
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        (serde_json::from_slice(&glb[20..20 + length]).unwrap(), &glb[28 + length..])
    }

    /// Returns the elements of an accessor as its integers, decoded by the extension of its view;
    /// floats as their bits.
    fn decoded((json, bin): (&Value, &[u8]), accessor: &Value) -> Vec<Vec<i64>> {
        let accessor = &json["accessors"][number(accessor)];
        let view = &json["bufferViews"][number(&accessor["bufferView"])];
        assert_eq!(view["buffer"], 1);
        let said = &view["extensions"]["EXT_meshopt_compression"];
        let [mode, filter] = ["mode", "filter"].map(|key| said[key].as_str().unwrap());
        let (count, stride) = (number(&said["count"]), number(&said["byteStride"]));
        assert_eq!((number(&accessor["count"]), number(&view["byteLength"])), (count, count * stride));
        let (mode, filter) = (Mode::parse(mode).unwrap(), Filter::parse(filter).unwrap());
        let source = &bin[number(&said["byteOffset"])..][..number(&said["byteLength"])];
        let layout = BufferView::new(mode, filter, count, stride).unwrap();
        let bytes = layout.decode(source, &mut Workspace::default()).unwrap();
        let width = [("SCALAR", 1), ("VEC2", 2), ("VEC3", 3), ("VEC4", 4)];
        let width = width.iter().find(|(name, _)| accessor["type"] == *name).unwrap().1;
        let element = |record: &[u8]| -> Vec<i64> {
            let word = |k: usize, size: usize| record[size * k..size * (k + 1)].to_vec();
            let of = |k: usize| match accessor["componentType"].as_u64().unwrap() {
                5120 => i64::from(word(k, 1)[0] as i8),
                5121 => i64::from(word(k, 1)[0]),
                5122 => i64::from(i16::from_le_bytes(word(k, 2).try_into().unwrap())),
                5123 => i64::from(u16::from_le_bytes(word(k, 2).try_into().unwrap())),
                _ => i64::from(u32::from_le_bytes(word(k, 4).try_into().unwrap())),
            };
            (0..width).map(of).collect()
        };
        bytes.chunks(stride).map(element).collect()
    }

    /// Returns triangles as indices of another mesh, each from its smallest corner on, sorted.
    fn sorted(triangles: &[[u32; 3]], source: &[u32]) -> Vec<[u32; 3]> {
        let turned = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| source[v as usize]);
            [[a, b, c], [b, c, a], [c, a, b]].into_iter().min().unwrap()
        };
        let mut all: Vec<[u32; 3]> = triangles.iter().map(turned).collect();
        all.sort();
        all
    }

    #[test]
    fn a_compressed_ball_has_the_same_corners_and_stays_closed() {
        let head = ball();
        let texture = HeadTexture { normal: None, lobes: None, ..head.texture.clone().unwrap() };
        // a far one, of 2.4 m
        let world_from_mesh = Similarity::scale_translate(0.1, DVec3::new(3e6, 0.0, 1.0));
        let plain = ExportOptions { world_from_mesh, ..ExportOptions::default() };
        let small = ExportOptions { compress: true, ..plain.clone() };
        let write = |options| to_glb(&head.mesh, Some(&texture), head.shells.as_ref(), options).unwrap();
        let glb = write(&small);
        assert!(glb == write(&small) && glb != write(&plain));
        let (json, bin) = opened(&glb);
        let names = ["EXT_meshopt_compression", "KHR_mesh_quantization"];
        assert_eq!(json["extensionsRequired"], serde_json::json!(names));
        assert_eq!(json["buffers"][1]["extensions"][names[0]]["fallback"], true);
        assert_eq!(number(&json["buffers"][0]["byteLength"]), bin.len());
        let nodes = json["nodes"].as_array().unwrap();
        let node = nodes.iter().find(|n| n.get("scale").is_some()).unwrap();
        let three = |value: &Value| DVec3::from_array([0, 1, 2].map(|k| value[k].as_f64().unwrap()));
        let (translation, scale) = (three(&node["translation"]), three(&node["scale"]));
        // 2.4 m and a layer of 0.12 m on each side, in 65 534 steps
        assert!(scale.x > 2.4 / 65534.0 && scale.x < 2.7 / 65534.0, "{scale}");

        // the triangles are those of the mesh, in another order
        let head = head.as_drawn();
        let split = FileMesh::new(&head.mesh, Some(&texture), &world_from_mesh).unwrap().split(false);
        let expected = split.in_cache_order();
        let own: Vec<u32> = (0..head.mesh.positions.len() as u32).collect();
        assert_eq!(sorted(&expected.triangles, &expected.source), sorted(&head.mesh.triangles, &own));
        // which the file has, each from any of its corners on
        let primitive = &json["meshes"][0]["primitives"][0];
        let array = |name: &str| decoded((&json, bin), &primitive["attributes"][name]);
        let indices: Vec<u32> =
            decoded((&json, bin), &primitive["indices"]).iter().map(|i| i[0] as u32).collect();
        let triangles = indices.as_chunks::<3>().0;
        let all: Vec<u32> = (0..expected.positions.len() as u32).collect();
        for (found, expected) in triangles.iter().zip(&expected.triangles) {
            assert_eq!(sorted(&[*found], &all), sorted(&[*expected], &all));
        }
        let (positions, uvs, normals) = (array("POSITION"), array("TEXCOORD_0"), array("NORMAL"));
        assert_eq!((triangles.len(), positions.len()), (expected.triangles.len(), expected.positions.len()));
        for (v, place) in positions.iter().enumerate() {
            let place = DVec3::from_array([0, 1, 2].map(|k| place[k] as f64));
            let apart = translation + scale * place - expected.translated(expected.positions[v]);
            assert!(apart.abs().max_element() < 0.51 * scale.x, "{v}: {apart}");
            for k in 0..2 {
                assert!((uvs[v][k] as f32 / 65535.0 - expected.uvs[v][k]).abs() < 0.51 / 65535.0, "{v}");
            }
            let normal = Vec3::from_array([0, 1, 2].map(|k| normals[v][k] as f32 / 127.0));
            assert!(normal.distance(expected.normals[v]) < 0.02, "{v}: {normal}");
        }
        // closed once equal positions are one
        let numbers: BTreeMap<&Vec<i64>, u32> = positions.iter().zip(0..).collect();
        let welded = Mesh {
            positions: vec![Vec3::ZERO; positions.len()],
            triangles: triangles.iter().map(|t| t.map(|v| numbers[&positions[v as usize]])).collect(),
            ..Mesh::default()
        };
        assert!(welded.is_closed());
        // the layer is over the upper half, as in the plain file
        let layer = &json["meshes"][1]["primitives"][0];
        let alphas = decoded((&json, bin), &layer["attributes"]["COLOR_0"]);
        assert!(alphas.iter().all(|c| [0, 255].contains(&c[3])) && alphas.iter().any(|c| c[3] == 255));
    }

    #[test]
    fn lobes_of_a_compressed_file_are_half_as_fine() {
        let head = ball();
        let side = |compress: bool| {
            let options = ExportOptions { compress, ..ExportOptions::default() };
            let glb = to_glb(&head.mesh, head.texture.as_ref(), None, &options).unwrap();
            let (json, bin) = opened(&glb);
            let images = json["images"].as_array().unwrap();
            let image = images.iter().find(|image| image["name"] == "lobe 0").unwrap();
            let view = &json["bufferViews"][number(&image["bufferView"])];
            // a PNG's header has the width after 16 bytes
            let at = number(&view["byteOffset"]) + 16;
            u32::from_be_bytes(bin[at..at + 4].try_into().unwrap())
        };
        // 512 texels of color, an eighth of them of lobes; the ball's own are too fine
        assert_eq!((side(false), side(true)), (512, 64));
    }

    #[test]
    fn colors_numbers_and_tangents_come_back() {
        let bounds = Aabb::around([Vec3::ZERO, Vec3::ONE]);
        let mut encoder = Encoder::new(bounds);
        let back = |array: &EncodedArray| {
            let filter = Filter::parse(array.filter).unwrap();
            let layout = BufferView::new(Mode::Attributes, filter, array.count, array.stride).unwrap();
            layout.decode(&array.bytes, &mut Workspace::default()).unwrap()
        };
        // 0.5 is 32767.5 of 65535, and rounds away from 0
        let colors = encoder.colors(&[Vec3::new(0.0, 0.5, 1.0)]);
        assert_eq!(back(&colors), [0, 0, 0, 128, 255, 255, 0, 0]);
        assert_eq!((colors.stride, colors.type_, colors.normalized), (8, Type::Vec3, true));
        let numbers = encoder.numbers(&[1.5, -7.0]);
        assert_eq!(back(&numbers), [1.5f32.to_le_bytes(), (-7.0f32).to_le_bytes()].concat());
        let tangents = encoder.tangents(&[Vec4::new(0.0, -1.0, 0.0, -1.0), Vec4::new(1.0, 0.0, 0.0, 1.0)]);
        assert_eq!(
            back(&tangents).iter().map(|&b| b as i8).collect::<Vec<_>>(),
            [0, -127, 0, -127, 127, 0, 0, 127]
        );
        // a mesh of one place has a file, too
        let mut point = Encoder::new(Aabb::around([Vec3::ONE]));
        let (_, [low, high]) = point.positions(&[Vec3::ONE, Vec3::ONE]);
        assert_eq!((low, high, point.center), ([0; 3], [0; 3], Vec3::ONE));
    }
}
