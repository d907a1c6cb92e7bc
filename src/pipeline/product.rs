//! What the stage `mesh` makes for people: a simplified mesh, its texture, and the files they become.
//!
//! ```text
//! mesh/surface.ply   the whole extraction with colours at its vertices, in the dataset's world
//!      parts         the same and the product, for the stages after this one
//!      head.glb …    the product as files
//! ```

use super::export::Export;
use crate::config::{MeshConfig, MeshFormat, MeshFrame, TextureFormat};
use crate::geom::{Atlas, Mesh, Similarity};
use crate::image::Photo;
use crate::mesh::files;
use crate::mesh::files::{ExportError, ExportOptions, distance_warning};
use crate::mesh::files::{Exported, Lobe, PictureFormat, TextureOptions, Textured};
use crate::{Error, Result};
use glam::{Mat3, Vec3};
use serde_json::{Map, json};

/// View-dependent colour of a texture.
#[derive(Clone, Debug, PartialEq)]
pub struct Lobes {
    /// One picture a spherical-harmonic function; a byte `b` is `(b − 128) / 127 · scale`.
    pub pictures: Vec<Photo>,
    /// Scale of each, sRGB-coded.
    pub scale: Vec<f32>,
    /// From directions of the dataset's world to those of the exported files.
    pub asset_from_world: Mat3,
}

/// The pictures of a mesh.
#[derive(Clone, Debug, PartialEq)]
pub struct Pictures {
    /// Where the triangles lie in them.
    pub atlas: Atlas,
    /// Base colour, sRGB-coded.
    pub color: Photo,
    /// Tangent-space normals.
    pub normal: Option<Photo>,
    /// What depends on the view.
    pub lobes: Option<Lobes>,
}

/// A mesh for people.
#[derive(Clone, Debug, PartialEq)]
pub struct Product {
    /// The surface in scene coordinates; without pictures it has colours at its vertices.
    pub mesh: Mesh,
    /// Where the scene sits in the dataset's world.
    pub world_from_scene: Similarity,
    /// Its texture, if it has one.
    pub pictures: Option<Pictures>,
}

impl Product {
    /// The product as the files of a format, the mesh first. `stem` names them.
    pub fn files(
        &self,
        format: MeshFormat,
        export: &Export,
        config: &MeshConfig,
        stem: &str,
    ) -> Result<Exported> {
        // an unlit material shows no normal map: who asks for one wants light
        let unlit = self.pictures.as_ref().is_none_or(|p| p.normal.is_none());
        let Product { mesh, world_from_scene, pictures } = self;
        let (up, unit_m, world_from_mesh) = match (format, export.frame) {
            // PLY keeps the dataset's world whatever the frame
            (MeshFormat::Ply, _) => (Vec3::Y, 1.0, *world_from_scene),
            (_, MeshFrame::Dataset) => (export.up, export.unit_m, *world_from_scene),
            (_, MeshFrame::Head) => (Vec3::Y, export.unit_m, export.head_from_mesh(mesh, world_from_scene)),
        };
        let options = ExportOptions { name: export.name.clone(), up, unit_m, unlit, world_from_mesh };
        let ending = super::export::ending(format);
        let alone = |bytes: Result<Vec<u8>, ExportError>| {
            let file = |bytes| (format!("{stem}.{ending}"), bytes);
            bytes.map(|b| Exported { files: vec![file(b)], warnings: Vec::new() })
        };
        let exported = match (pictures, format) {
            // colours at the vertices: one index, so the surface stays closed for whoever reads it
            (_, MeshFormat::Ply) => alone(files::placed_to_ply(mesh, world_from_scene)),
            (None, MeshFormat::Glb) => alone(files::to_glb(mesh, &options)),
            (None, MeshFormat::Obj) => alone(files::to_obj(mesh, &options)),
            (Some(p), _) => {
                let mut textured = Textured::new(mesh, &p.atlas, &p.color);
                textured.normal = p.normal.as_ref();
                if let Some(lobes) = &p.lobes {
                    let name = |k: usize| format!("lobe {k}");
                    let all = lobes.pictures.iter().enumerate();
                    textured.lobes = all.map(|(k, picture)| Lobe { name: name(k), picture }).collect();
                    textured.extras = extras(lobes);
                }
                let picture = match config.texture_format {
                    TextureFormat::Png => PictureFormat::Png,
                    TextureFormat::Jpeg => PictureFormat::Jpeg { quality: 92 },
                };
                let texture = TextureOptions { stem: stem.into(), picture, quantize: config.quantize };
                match format {
                    MeshFormat::Obj => files::textured_to_obj(&textured, &options, &texture),
                    _ => files::textured_to_glb(&textured, &options, &texture),
                }
            }
        };
        let mut exported = exported.map_err(|e| {
            let hint = e.hint();
            Error::cannot(e, hint)
        })?;
        if format != MeshFormat::Glb {
            exported.warnings.extend(distance_warning(mesh, &options, ending));
        }
        Ok(exported)
    }
}

/// What a reader must know to use the lobes.
fn extras(lobes: &Lobes) -> Map<String, serde_json::Value> {
    let mut extras = Map::new();
    let model = json!({
        "basis": "real spherical harmonics, order and signs of tiny-cuda-nn, of the unit direction from the \
                  surface to the viewer in the asset's coordinates",
        "functions": lobes.pictures.len(),
        "scale": lobes.scale,
        "decode": "(byte - 128) / 127 * scale",
        "color": "base colour + sum of decoded lobes times basis, all sRGB-coded",
    });
    extras.insert("view_dependent_color".into(), model);
    extras
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::config::Preset;
    use glam::{DMat3, DVec3, Vec2};
    use std::f32::consts::PI;

    pub fn product() -> Product {
        let at = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)];
        let mesh = Mesh {
            positions: at.map(|(x, y, z)| Vec3::new(x, y, z)).to_vec(),
            normals: vec![Vec3::Z; 4],
            colors: vec![[0.5; 3]; 4],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        };
        let photo = |b: u8| Photo { width: 8, height: 8, rgb: vec![[b, 1, 2]; 64], alpha: None };
        let atlas = Atlas {
            uvs: vec![Vec2::ZERO, Vec2::X, Vec2::ONE],
            triangles: vec![[0, 1, 2]; 4],
            width: 8,
            height: 8,
        };
        let lobes = Lobes {
            pictures: (0..4).map(|k| photo(100 + k)).collect(),
            scale: vec![0.1, 0.2, 0.3, 0.4],
            asset_from_world: Mat3::from_rotation_x(0.5),
        };
        let pictures = Pictures { atlas, color: photo(9), normal: Some(photo(128)), lobes: Some(lobes) };
        let world_from_scene = Similarity {
            scale: 0.125,
            rotation: DMat3::from_rotation_x(0.3),
            translation: DVec3::new(5e6, -3e6, 2e5),
        };
        Product { mesh, world_from_scene, pictures: Some(pictures) }
    }

    /// A wrinkled ball, closed, a scene of its own.
    fn ball() -> Mesh {
        let (across, down) = (40u32, 20u32);
        let at = |i: u32, j: u32| {
            let (a, b) = (i as f32 / across as f32 * 2.0 * PI, j as f32 / down as f32 * PI);
            let r = 0.95 + 0.05 * (7.0 * a).sin() * b.sin();
            r * Vec3::new(b.sin() * a.cos(), b.sin() * a.sin(), b.cos())
        };
        let mut mesh = Mesh { positions: vec![at(0, 0), at(0, down)], ..Mesh::default() };
        mesh.positions.extend((0..across * (down - 1)).map(|k| at(k % across, 1 + k / across)));
        let ring = |i: u32, j: u32| 2 + (j - 1) * across + i % across;
        for i in 0..across {
            mesh.triangles.push([0, ring(i, 1), ring(i + 1, 1)]);
            mesh.triangles.push([1, ring(i + 1, down - 1), ring(i, down - 1)]);
            for j in 1..down - 1 {
                let [a, b] = [ring(i, j), ring(i + 1, j)];
                let [c, d] = [ring(i + 1, j + 1), ring(i, j + 1)];
                mesh.triangles.extend([[a, d, c], [a, c, b]]);
            }
        }
        mesh.normals = mesh.positions.iter().map(|p| p.normalize()).collect();
        mesh.colors = vec![[0.5; 3]; mesh.positions.len()];
        mesh
    }

    /// Corners of the triangles of a GLB, relative to the node, and the node's translation.
    fn corners_of(glb: &[u8]) -> (Vec<[Vec3; 3]>, DVec3) {
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        let json: serde_json::Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
        let bin = &glb[28 + length..];
        let primitive = &json["meshes"][0]["primitives"][0];
        let bytes = |accessor: &serde_json::Value| {
            let accessor = &json["accessors"][accessor.as_u64().unwrap() as usize];
            let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
            let at = view["byteOffset"].as_u64().unwrap() as usize;
            &bin[at..at + view["byteLength"].as_u64().unwrap() as usize]
        };
        let number = |b: &[u8; 4]| f32::from_le_bytes(*b);
        let positions = bytes(&primitive["attributes"]["POSITION"]).as_chunks::<4>().0;
        let positions: Vec<Vec3> =
            positions.as_chunks::<3>().0.iter().map(|p| Vec3::from(p.each_ref().map(number))).collect();
        let indices = bytes(&primitive["indices"]).as_chunks::<2>().0; // fewer than 65 535
        let index = |b: &[u8; 2]| positions[u16::from_le_bytes(*b) as usize];
        let corners = indices.as_chunks::<3>().0.iter().map(|t| t.each_ref().map(index)).collect();
        let translation = &json["nodes"][0]["translation"];
        let k = |k: usize| translation[k].as_f64().unwrap_or(0.0);
        (corners, DVec3::new(k(0), k(1), k(2)))
    }

    /// A head of a quarter of a metre, six thousand kilometres from the origin: where f32 has steps of half a metre.
    #[test]
    fn a_head_at_the_end_of_the_world_keeps_its_shape_in_every_file() {
        let mesh = ball();
        assert!(mesh.is_closed());
        let mut far = product();
        far.pictures.as_mut().unwrap().atlas.triangles = vec![[0, 1, 2]; mesh.triangles.len()];
        far.mesh = mesh.clone();
        // as it is when it has been kept for a while
        let dir = tempfile::tempdir().unwrap();
        far.save(dir.path()).unwrap();
        let far = Product::load(dir.path()).unwrap();
        let place = far.world_from_scene;
        let exact = |p: Vec3| place.point_f64(p.as_dvec3());
        let mut export = Export {
            name: "x".into(),
            up: Vec3::Z,
            unit_m: 1.0,
            frame: MeshFrame::Dataset,
            cameras: vec![place.translation + DVec3::new(0.3, -0.6, 0.1)],
        };
        let config = MeshConfig::preset(Preset::Draft);
        let bare = Product { pictures: None, ..far.clone() };
        let close = 1e-6 * 0.25;
        for product in [&far, &bare] {
            export.frame = MeshFrame::Dataset;
            let glb = product.files(MeshFormat::Glb, &export, &config, "head").unwrap();
            assert_eq!(glb.warnings, Vec::<String>::new());
            let (corners, translation) = corners_of(&glb.files[0].1);
            // a document that is put together by hand for its node keeps what readers of lobes must know
            let notes =
                String::from_utf8_lossy(&glb.files[0].1).contains("\"extras\":{\"tiface\":{\"lobes\":[{");
            assert_eq!(notes, product.pictures.is_some());
            for (found, t) in corners.iter().zip(0..) {
                let expected = mesh.corners(t).map(exact);
                for (p, e) in found.iter().zip(expected) {
                    // z up: (x, y, z) becomes (x, z, −y)
                    let e = DVec3::new(e.x, e.z, -e.y) - translation;
                    assert!(p.as_dvec3().distance(e) < close, "{p} {e}");
                }
                let area = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a).length();
                let ratio = area(found.map(|p| p.as_dvec3())) / area(expected);
                assert!((ratio - 1.0).abs() < 1e-3, "triangle {t}: {ratio}");
            }
            // around the middle, looking at the camera
            export.frame = MeshFrame::Head;
            let glb = product.files(MeshFormat::Glb, &export, &config, "head").unwrap();
            let (corners, translation) = corners_of(&glb.files[0].1);
            assert_eq!(translation, DVec3::ZERO);
            let centre = exact(mesh.bounds().center());
            let front = ((export.cameras[0] - centre) * DVec3::new(1.0, 1.0, 0.0)).normalize();
            let axes = [DVec3::Z.cross(front), DVec3::Z, front];
            let turned = |p: Vec3| DVec3::from(axes.map(|a| a.dot(exact(p) - place.translation)));
            let all = || mesh.positions.iter().map(|&p| turned(p));
            let middle = 0.5 * (all().reduce(DVec3::min).unwrap() + all().reduce(DVec3::max).unwrap());
            for (found, t) in corners.iter().zip(0..) {
                for (p, e) in found.iter().zip(mesh.corners(t)) {
                    assert!(p.as_dvec3().distance(turned(e) - middle) < close, "{p}");
                }
            }
            assert!(
                product
                    .files(MeshFormat::Obj, &export, &config, "head")
                    .unwrap()
                    .warnings
                    .iter()
                    .all(|w| !w.contains("origin"))
            );

            export.frame = MeshFrame::Dataset;
            let obj = product.files(MeshFormat::Obj, &export, &config, "head").unwrap();
            assert!(
                obj.warnings.last().unwrap().contains("round its vertices to 5.0e-1"),
                "{:?}",
                obj.warnings
            );
            let text = String::from_utf8(obj.files[0].1.clone()).unwrap();
            let lines: Vec<&str> = text.lines().filter(|l| l.starts_with("v ")).collect();
            assert_eq!(lines.len(), mesh.positions.len());
            for (line, &p) in lines.iter().zip(&mesh.positions) {
                let v: Vec<f64> = line[2..].split(' ').map(|v| v.parse().unwrap()).collect();
                let e = exact(p);
                assert!(DVec3::new(v[0], v[1], v[2]).distance(DVec3::new(e.x, e.z, -e.y)) < close, "{line}");
            }

            let ply = product.files(MeshFormat::Ply, &export, &config, "head").unwrap();
            assert!(ply.warnings.last().unwrap().contains("the .ply lies"), "{:?}", ply.warnings);
            let bytes = &ply.files[0].1;
            let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
            assert!(String::from_utf8_lossy(&bytes[..end]).contains("property double x\n"));
            // three doubles, a normal, a colour
            for (row, &p) in bytes[end..].chunks(24 + 12 + 3).zip(&mesh.positions) {
                let v = row.as_chunks::<8>().0;
                let found =
                    DVec3::new(f64::from_le_bytes(v[0]), f64::from_le_bytes(v[1]), f64::from_le_bytes(v[2]));
                assert!(found.distance(exact(p)) < close);
            }
        }
    }

    #[test]
    fn every_format_has_its_files() {
        let export = Export {
            name: "x".into(),
            up: Vec3::Z,
            unit_m: 1.0,
            frame: MeshFrame::Dataset,
            cameras: vec![DVec3::new(0.0, -3.0, 0.0)],
        };
        let config = MeshConfig::preset(Preset::Draft);
        let names = |format| {
            let files = product().files(format, &export, &config, "head").unwrap().files;
            files.into_iter().map(|(name, _)| name).collect::<Vec<_>>()
        };
        assert_eq!(names(MeshFormat::Glb), ["head.glb"]);
        assert_eq!(names(MeshFormat::Obj), ["head.obj", "head.mtl", "head.png"]);
        assert_eq!(names(MeshFormat::Ply), ["head.ply"]);
    }
}
