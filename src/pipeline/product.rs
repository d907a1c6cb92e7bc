//! What the stage `mesh` makes for people: a simplified mesh, its texture, and the files they become.
//!
//! ```text
//! mesh/surface.ply            the whole extraction with colours at its vertices: what rays are cast at
//!      parts/geometry.safetensors, color.png, normal.png, lobe_K.png     the product in the dataset's world
//!      head.glb …             the product as files
//! ```

use super::export::Export;
use crate::config::{MeshConfig, MeshFormat, MeshFrame, TextureFormat};
use crate::geom::{Atlas, Mesh};
use crate::image::Photo;
use crate::io::{self, Limits, TensorValues};
use crate::mesh::export::{ExportError, ExportOptions};
use crate::mesh::textured::{Exported, Lobe, PictureFormat, TextureOptions, Textured};
use crate::mesh::{gltf, obj, ply};
use crate::run::Failure;
use glam::{Mat3, Vec2, Vec3};
use serde_json::{Map, json};
use std::collections::BTreeMap;
use std::path::Path;

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

/// A mesh for people, in the dataset's world.
#[derive(Clone, Debug, PartialEq)]
pub struct Product {
    /// The surface; without pictures it has colours at its vertices.
    pub mesh: Mesh,
    /// Its texture, if it has one.
    pub pictures: Option<Pictures>,
}

/// Version of the layout of `parts`.
const FORMAT: &str = "tiface-mesh-1";

impl Product {
    /// Writes the parts into a folder.
    pub fn save(&self, folder: &Path) -> Result<(), Failure> {
        io::create_folder(folder)?;
        let floats = |v: &[Vec3]| (vec![v.len(), 3], TensorValues::F32(bytemuck::cast_slice(v).to_vec()));
        let indices = |v: &[[u32; 3]]| (vec![v.len(), 3], TensorValues::U32(v.as_flattened().to_vec()));
        let colors: Vec<Vec3> = self.mesh.colors.iter().map(|c| Vec3::from(*c)).collect();
        let mut tensors = vec![
            ("positions", floats(&self.mesh.positions)),
            ("normals", floats(&self.mesh.normals)),
            ("colors", floats(&colors)),
            ("triangles", indices(&self.mesh.triangles)),
        ];
        let mut metadata = BTreeMap::from([("format".to_owned(), FORMAT.to_owned())]);
        if let Some(p) = &self.pictures {
            let uvs: &[f32] = bytemuck::cast_slice(&p.atlas.uvs);
            tensors.push(("uvs", (vec![p.atlas.uvs.len(), 2], TensorValues::F32(uvs.to_vec()))));
            tensors.push(("uv_triangles", indices(&p.atlas.triangles)));
            let write = |name: String, photo: &Photo| {
                io::write_png_rgb(&folder.join(name), photo.width, photo.height, &photo.rgb)
            };
            write("color.png".into(), &p.color)?;
            if let Some(normal) = &p.normal {
                write("normal.png".into(), normal)?;
                metadata.insert("normal".into(), "normal.png".into());
            }
            if let Some(lobes) = &p.lobes {
                for (k, picture) in lobes.pictures.iter().enumerate() {
                    write(format!("lobe_{k}.png"), picture)?;
                }
                tensors
                    .push(("lobe_scale", (vec![lobes.scale.len()], TensorValues::F32(lobes.scale.clone()))));
                let turned = lobes.asset_from_world.to_cols_array().to_vec();
                tensors.push(("asset_from_world", (vec![3, 3], TensorValues::F32(turned))));
            }
        }
        let tensors: Vec<_> = tensors.into_iter().map(|(n, (s, v))| (n.to_owned(), s, v)).collect();
        Ok(io::write_tensors(&folder.join("geometry.safetensors"), &tensors, &metadata)?)
    }

    /// Reads the parts back.
    pub fn load(folder: &Path) -> Result<Product, Failure> {
        let path = folder.join("geometry.safetensors");
        let (mut tensors, metadata) = io::read_tensors(&path, &Limits::default())?;
        let wrong = |what: &str| {
            Failure::cannot(
                format!("`{}`: {what}", path.display()),
                "make the mesh again: `tiface mesh RUN --fresh mesh`",
            )
        };
        if metadata.get("format").map(String::as_str) != Some(FORMAT) {
            return Err(wrong("its layout is another version's"));
        }
        let mut floats = |name: &str, width: usize| -> Option<Vec<f32>> {
            match tensors.remove(name)? {
                (shape, TensorValues::F32(v)) if shape.get(1).is_none_or(|&w| w == width) => Some(v),
                _ => None,
            }
        };
        let vectors = |v: Vec<f32>| -> Vec<Vec3> { v.chunks_exact(3).map(Vec3::from_slice).collect() };
        let missing = |name: &str| wrong(&format!("`{name}` is missing or of another shape"));
        let positions = vectors(floats("positions", 3).ok_or_else(|| missing("positions"))?);
        let normals = vectors(floats("normals", 3).ok_or_else(|| missing("normals"))?);
        let colors = floats("colors", 3).ok_or_else(|| missing("colors"))?;
        let uvs = floats("uvs", 2);
        let (scale, turned) = (floats("lobe_scale", 1), floats("asset_from_world", 3));
        let mut indices = |name: &str, below: usize| match tensors.remove(name) {
            Some((shape, TensorValues::U32(v))) if shape.get(1) == Some(&3) => {
                let sound = v.iter().all(|&i| (i as usize) < below);
                if sound { Ok(v.as_chunks::<3>().0.to_vec()) } else { Err(missing(name)) }
            }
            _ => Err(missing(name)),
        };
        let triangles = indices("triangles", positions.len())?;
        let mesh = Mesh { positions, normals, colors: colors.as_chunks::<3>().0.to_vec(), triangles };
        let Some(uvs) = uvs else { return Ok(Product { mesh, pictures: None }) };
        let photo = |name: &str, size: Option<(u32, u32)>| -> Result<Photo, Failure> {
            Ok(io::read_photo(&folder.join(name), size, &Limits::default())?.photo)
        };
        let color = photo("color.png", None)?;
        let size = Some((color.width, color.height));
        let triangles = indices("uv_triangles", uvs.len() / 2)?;
        if triangles.len() != mesh.triangles.len() {
            return Err(missing("uv_triangles"));
        }
        let uvs = uvs.chunks_exact(2).map(Vec2::from_slice).collect();
        let atlas = Atlas { uvs, triangles, width: color.width, height: color.height };
        let normal = metadata.get("normal").map(|_| photo("normal.png", size)).transpose()?;
        let lobes = match (scale, turned) {
            (Some(scale), Some(turned)) if turned.len() == 9 && scale.len() <= 16 => {
                let pictures = (0..scale.len())
                    .map(|k| photo(&format!("lobe_{k}.png"), size))
                    .collect::<Result<_, _>>()?;
                Some(Lobes { pictures, scale, asset_from_world: Mat3::from_cols_slice(&turned) })
            }
            (None, None) => None,
            _ => return Err(missing("lobe_scale")),
        };
        Ok(Product { mesh, pictures: Some(Pictures { atlas, color, normal, lobes }) })
    }

    /// The product as the files of a format, the mesh first. `stem` names them.
    pub fn files(
        &self,
        format: MeshFormat,
        export: &Export,
        config: &MeshConfig,
        stem: &str,
    ) -> Result<Exported, Failure> {
        // an unlit material shows no normal map: who asks for one wants light
        let unlit = self.pictures.as_ref().is_none_or(|p| p.normal.is_none());
        let options =
            ExportOptions { name: export.name.clone(), up: export.up, unit_m: export.unit_m, unlit };
        // PLY keeps the dataset's world whatever the frame
        let (mesh, options) = match (format, export.frame) {
            (MeshFormat::Ply, _) | (_, MeshFrame::Dataset) => (self.mesh.clone(), options),
            (_, MeshFrame::Head) => {
                let turned = self.mesh.transformed(&export.head_from_world(&self.mesh));
                (turned, ExportOptions { up: Vec3::Y, ..options })
            }
        };
        let alone = |bytes: Result<Vec<u8>, ExportError>| {
            bytes.map(|b| Exported {
                files: vec![(format!("{stem}.{}", super::export::ending(format)), b)],
                warnings: Vec::new(),
            })
        };
        let exported = match (&self.pictures, format) {
            // colours at the vertices: one index, so the surface stays closed for whoever reads it
            (_, MeshFormat::Ply) => alone(ply::to_ply(&mesh)),
            (None, MeshFormat::Glb) => alone(gltf::to_glb(&mesh, &options)),
            (None, MeshFormat::Obj) => alone(obj::to_obj(&mesh, &options)),
            (Some(p), _) => {
                let mut textured = Textured::new(&mesh, &p.atlas, &p.color);
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
                    MeshFormat::Obj => obj::textured_to_obj(&textured, &options, &texture),
                    _ => gltf::textured_to_glb(&textured, &options, &texture),
                }
            }
        };
        exported.map_err(|e| {
            let hint = e.hint();
            Failure::cannot(e, hint)
        })
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
mod tests {
    use super::*;
    use crate::config::Preset;

    fn product() -> Product {
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
        Product { mesh, pictures: Some(pictures) }
    }

    #[test]
    fn parts_are_read_back_as_they_were() {
        let dir = tempfile::tempdir().unwrap();
        let whole = product();
        whole.save(dir.path()).unwrap();
        assert_eq!(Product::load(dir.path()).unwrap(), whole);
        let bare = Product { pictures: None, ..whole };
        bare.save(dir.path()).unwrap();
        assert_eq!(Product::load(dir.path()).unwrap(), bare);
    }

    #[test]
    fn damaged_parts_are_named_with_the_way_out() {
        let dir = tempfile::tempdir().unwrap();
        let mut product = product();
        product.mesh.triangles[2] = [0, 1, 9];
        product.save(dir.path()).unwrap();
        let error = Product::load(dir.path()).unwrap_err();
        assert!(format!("{error:?}").contains("triangles"), "{error:?}");
        assert!(Product::load(&dir.path().join("nothing")).is_err());
    }

    #[test]
    fn every_format_has_its_files() {
        let export = Export {
            name: "x".into(),
            up: Vec3::Z,
            unit_m: 1.0,
            frame: MeshFrame::Dataset,
            cameras: vec![Vec3::new(0.0, -3.0, 0.0)],
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
