//! A mesh as GLB: glTF 2.0, binary, one file (Khronos, *glTF 2.0 Specification*).
//!
//! Right-handed, +Y up, metres, counter-clockwise. `COLOR_0` is **linear** light, while our vertex
//! colours are sRGB-coded. Colours that already hold the light are marked `KHR_materials_unlit`,
//! beside a rough non-metal for viewers that do not know it. Every accessor starts at a multiple of
//! four bytes; `min` and `max` are the stored f32 numbers themselves.

use super::export::{ExportError, ExportOptions, check_unit, ready, turn_to_y_up};
use crate::geom::{Aabb, Mesh};
use crate::image::linear_from_srgb;
use glam::Vec3;
use gltf_json::accessor::{ComponentType, GenericComponentType, Type};
use gltf_json::buffer::Target;
use gltf_json::material::{PbrMetallicRoughness, StrengthFactor};
use gltf_json::mesh::{Mode, Primitive, Semantic};
use gltf_json::validation::{Checked::Valid, USize64};
use gltf_json::{Accessor, Index, Root, Value};
use std::collections::BTreeMap;

/// Below this many vertices indices are 16 bit; 65 535 itself is kept free for primitive restart.
const SHORT_INDICES: usize = 65_535;

/// The mesh as the bytes of a `.glb` file.
///
/// # Errors
///
/// [`ExportError`] when there is nothing to write, the mesh is damaged, an option makes no sense, or
/// the file would pass 4 GiB.
pub fn to_glb(mesh: &Mesh, options: &ExportOptions) -> Result<Vec<u8>, ExportError> {
    check_unit(options.unit_m)?;
    let mesh = ready(mesh, turn_to_y_up(options.up)?, options.unit_m, true)?;
    let mut writer = Writer::default();
    let vertices = mesh.positions.len();

    let bounds = Aabb::around(mesh.positions.iter().copied());
    let position = writer.vectors(&mesh.positions, Some(bounds));
    let mut attributes = BTreeMap::from([(Valid(Semantic::Positions), position)]);
    if !mesh.normals.is_empty() {
        attributes.insert(Valid(Semantic::Normals), writer.vectors(&mesh.normals, None));
    }
    if !mesh.colors.is_empty() {
        let linear: Vec<Vec3> = mesh.colors.iter().map(|c| c.map(linear_from_srgb).into()).collect();
        attributes.insert(Valid(Semantic::Colors(0)), writer.vectors(&linear, None));
    }
    let flat = mesh.triangles.as_flattened();
    let indices = if vertices < SHORT_INDICES {
        let short: Vec<u16> = flat.iter().map(|&i| i as u16).collect();
        writer.push(
            bytes_of(&short),
            short.len(),
            ComponentType::U16,
            Type::Scalar,
            Target::ElementArrayBuffer,
        )
    } else {
        writer.push(bytes_of(flat), flat.len(), ComponentType::U32, Type::Scalar, Target::ElementArrayBuffer)
    };

    let Writer { mut root, bin } = writer;
    root.asset.generator = Some(concat!("tiface ", env!("CARGO_PKG_VERSION")).into());
    let material = root.push(material(options));
    let name = Some(options.name.clone());
    let primitive = Primitive {
        attributes,
        indices: Some(indices),
        material: Some(material),
        mode: Valid(Mode::Triangles),
        extensions: None,
        extras: Default::default(),
        targets: None,
    };
    let shape = root.push(gltf_json::Mesh {
        primitives: vec![primitive],
        name: name.clone(),
        weights: None,
        extensions: None,
        extras: Default::default(),
    });
    let translation = (mesh.translation != Vec3::ZERO).then(|| mesh.translation.to_array());
    let node = root.push(gltf_json::Node { mesh: Some(shape), name, translation, ..Default::default() });
    let scene = root.push(gltf_json::Scene {
        nodes: vec![node],
        name: None,
        extensions: None,
        extras: Default::default(),
    });
    root.scene = Some(scene);
    if options.unlit {
        root.extensions_used.push("KHR_materials_unlit".into());
    }
    root.push(gltf_json::Buffer {
        byte_length: USize64(bin.len() as u64),
        name: None,
        uri: None,
        extensions: None,
        extras: Default::default(),
    });
    pack(&root, bin)
}

fn material(options: &ExportOptions) -> gltf_json::Material {
    let unlit = options.unlit.then_some(gltf_json::extensions::material::Material {
        unlit: Some(gltf_json::extensions::material::Unlit {}),
    });
    gltf_json::Material {
        name: Some(options.name.clone()),
        pbr_metallic_roughness: PbrMetallicRoughness {
            metallic_factor: StrengthFactor(0.0),
            roughness_factor: StrengthFactor(1.0),
            ..Default::default()
        },
        extensions: unlit,
        ..Default::default()
    }
}

/// The document as it grows, with the bytes it speaks of.
#[derive(Default)]
struct Writer {
    root: Root,
    bin: Vec<u8>,
}

impl Writer {
    fn vectors(&mut self, values: &[Vec3], bounds: Option<Aabb>) -> Index<Accessor> {
        let accessor =
            self.push(bytes_of(values), values.len(), ComponentType::F32, Type::Vec3, Target::ArrayBuffer);
        if let Some(bounds) = bounds {
            let last = self.root.accessors.last_mut().expect("just pushed");
            last.min = Some(Value::from(bounds.min.to_array().to_vec()));
            last.max = Some(Value::from(bounds.max.to_array().to_vec()));
        }
        accessor
    }

    /// One accessor with a view of its own, at a multiple of four bytes.
    fn push(
        &mut self,
        bytes: &[u8],
        count: usize,
        component: ComponentType,
        type_: Type,
        target: Target,
    ) -> Index<Accessor> {
        let view = self.root.push(gltf_json::buffer::View {
            buffer: Index::new(0),
            byte_length: USize64(bytes.len() as u64),
            byte_offset: Some(USize64(self.bin.len() as u64)),
            byte_stride: None,
            name: None,
            target: Some(Valid(target)),
            extensions: None,
            extras: Default::default(),
        });
        self.bin.extend_from_slice(bytes);
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
            normalized: false,
            sparse: None,
            extensions: None,
            extras: Default::default(),
        })
    }
}

/// Numbers as glTF stores them. Its order is little endian, and so is every machine we build for.
fn bytes_of<T: bytemuck::NoUninit>(values: &[T]) -> &[u8] {
    const { assert!(cfg!(target_endian = "little"), "GLB is little endian") };
    bytemuck::cast_slice(values)
}

/// Header, JSON chunk padded with spaces, binary chunk padded with zeros.
fn pack(root: &Root, bin: Vec<u8>) -> Result<Vec<u8>, ExportError> {
    let mut json = root.to_vec().expect("a document of plain numbers and names serialises");
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::srgb_from_linear;
    use crate::mesh::read::read;
    use std::path::Path;

    /// A strip of `vertices` points on a helix, coloured.
    fn strip(vertices: u32) -> Mesh {
        let at = |i: u32| Vec3::new((i as f32 * 0.1).cos(), i as f32 * 1e-3, (i as f32 * 0.1).sin());
        Mesh {
            positions: (0..vertices).map(at).collect(),
            normals: (0..vertices).map(|_| Vec3::Y).collect(),
            colors: (0..vertices).map(|i| [i as f32 / vertices as f32, 0.5, 1.0]).collect(),
            triangles: (0..vertices - 2).map(|i| [i, i + 1, i + 2]).collect(),
        }
    }

    fn json_of(glb: &[u8]) -> serde_json::Value {
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        serde_json::from_slice(&glb[20..20 + length]).unwrap()
    }

    #[test]
    fn what_is_written_reads_back() {
        let mesh = strip(100);
        let glb = to_glb(&mesh, &ExportOptions::default()).unwrap();
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
            let glb = to_glb(&strip(vertices), &ExportOptions::default()).unwrap();
            let json = json_of(&glb);
            let at = json["meshes"][0]["primitives"][0]["indices"].as_u64().unwrap() as usize;
            assert_eq!(json["accessors"][at]["componentType"], component);
            let back = read(&glb, Path::new("a.glb")).unwrap();
            assert_eq!(back.triangles.last().unwrap()[2], vertices - 1);
        }
    }

    #[test]
    fn the_document_says_what_it_must() {
        let options = ExportOptions { name: "Büste 頭".into(), up: Vec3::Z, unit_m: 0.001, unlit: true };
        let mut mesh = strip(10);
        mesh.positions[3] = Vec3::new(0.1, 0.2, 0.3);
        let glb = to_glb(&mesh, &options).unwrap();
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
        let lit = to_glb(&mesh, &ExportOptions { unlit: false, ..options }).unwrap();
        assert!(json_of(&lit).get("extensionsUsed").is_none());
    }

    #[test]
    fn a_distant_mesh_is_carried_by_its_node() {
        let mut mesh = strip(50);
        for p in &mut mesh.positions {
            *p += Vec3::new(0.0, 10_000.0, 0.0);
        }
        let glb = to_glb(&mesh, &ExportOptions::default()).unwrap();
        assert!((json_of(&glb)["nodes"][0]["translation"][1].as_f64().unwrap() - 10_000.0).abs() < 1.0);
        let back = read(&glb, Path::new("a.glb")).unwrap();
        assert!(back.positions.iter().zip(&mesh.positions).all(|(a, b)| a.distance(*b) < 1e-3));
    }

    #[test]
    fn an_empty_mesh_is_an_error() {
        assert_eq!(to_glb(&Mesh::default(), &ExportOptions::default()), Err(ExportError::Empty));
    }
}
