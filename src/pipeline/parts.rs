//! What the stage `mesh` keeps for the stages after it, in scene coordinates: the world may lie so far away that
//! f32 could not hold a head in it.
//!
//! ```text
//! mesh/parts/surface.safetensors   the whole extraction and its cap: what rays are cast at
//!            geometry.safetensors, color.png, normal.png, lobe_K.png   the product
//! ```

use super::product::{Lobes, Pictures, Product};
use super::unusable;
use crate::geom::{Aabb, Atlas, Mesh, Similarity};
use crate::image::Photo;
use crate::io::{self, Limits, ReadError, TensorValues};
use crate::mesh::{Cap, Skin};
use crate::{Error, Result};
use glam::{DMat3, DVec3, Mat3, Vec2, Vec3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Version of the layout; part of what the stage is, so that a mesh of another version is made again.
pub(super) const FORMAT: &str = "tiface-mesh-2";

/// The whole surface.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Whole {
    /// Without colours: those of rays are the field's.
    pub mesh: Mesh,
    /// What closes it where the box ends.
    pub cap: Option<Cap>,
}

type Tensor = (String, Vec<usize>, TensorValues);

fn floats<const N: usize>(name: &str, values: &[[f32; N]]) -> Tensor {
    (name.into(), vec![values.len(), N], TensorValues::F32(values.as_flattened().to_vec()))
}

fn indices(name: &str, values: &[[u32; 3]]) -> Tensor {
    (name.into(), vec![values.len(), 3], TensorValues::U32(values.as_flattened().to_vec()))
}

fn geometry(mesh: &Mesh) -> Vec<Tensor> {
    vec![
        floats::<3>("positions", bytemuck::cast_slice(&mesh.positions)),
        floats::<3>("normals", bytemuck::cast_slice(&mesh.normals)),
        floats("colors", &mesh.colors),
        indices("triangles", &mesh.triangles),
    ]
}

fn format() -> BTreeMap<String, String> {
    BTreeMap::from([("format".to_owned(), FORMAT.to_owned())])
}

impl Whole {
    /// Writes it into the folder of the parts.
    pub fn save(&self, folder: &Path) -> Result<()> {
        io::create_folder(folder)?;
        let mut tensors = geometry(&self.mesh);
        if let Some(cap) = &self.cap {
            let of = |value: &dyn Fn(&Skin) -> [f32; 3]| cap.ring.iter().map(value).collect::<Vec<_>>();
            tensors.push(floats("cap_box", &[cap.bounds.min.to_array(), cap.bounds.max.to_array()]));
            tensors.push(floats("cap_near", &[[cap.near]]));
            tensors.push(floats("cap_ring", &of(&|s| s.position.to_array())));
            tensors.push(floats("cap_ring_normals", &of(&|s| s.normal.to_array())));
            tensors.push(floats("cap_ring_colors", &of(&|s| s.color)));
        }
        Ok(io::write_tensors(&folder.join("surface.safetensors"), &tensors, &format())?)
    }

    /// Reads it back.
    pub fn load(folder: &Path) -> Result<Whole> {
        let mut parts = Parts::open(folder.join("surface.safetensors"))?;
        let mesh = parts.mesh()?;
        if !parts.tensors.contains_key("cap_box") {
            return Ok(Whole { mesh, cap: None });
        }
        let near = parts.rows::<1>("cap_near")?;
        let (corners, ring) = (parts.rows::<3>("cap_box")?, parts.rows::<3>("cap_ring")?);
        let (normals, colors) = (parts.rows::<3>("cap_ring_normals")?, parts.rows::<3>("cap_ring_colors")?);
        let ([low, high], [[near]]) = (&corners[..], &near[..]) else { return Err(parts.missing("cap_box")) };
        if normals.len() != ring.len() || colors.len() != ring.len() {
            return Err(parts.missing("cap_ring"));
        }
        let skin = |((p, n), &color): ((&[f32; 3], &[f32; 3]), &[f32; 3])| Skin {
            position: Vec3::from(*p),
            normal: Vec3::from(*n),
            color,
        };
        let ring = ring.iter().zip(&normals).zip(&colors).map(skin).collect();
        let bounds = Aabb { min: Vec3::from(*low), max: Vec3::from(*high) };
        if bounds.min.cmpge(bounds.max).any() {
            let found = format!("{} to {}", bounds.min, bounds.max);
            return Err(parts.wrong("cap_box", found, "a box, its lowest corner first"));
        }
        if *near < 0.0 {
            return Err(parts.wrong("cap_near", near, "0 or more"));
        }
        Ok(Whole { mesh, cap: Some(Cap { bounds, near: *near, ring }) })
    }
}

impl Product {
    /// Writes the parts into a folder.
    pub fn save(&self, folder: &Path) -> Result<()> {
        io::create_folder(folder)?;
        let mut tensors = geometry(&self.mesh);
        let Similarity { scale, rotation, translation } = self.world_from_scene;
        let mut place = vec![scale];
        place.extend(rotation.to_cols_array());
        place.extend(translation.to_array());
        tensors.push(("world_from_scene".into(), vec![place.len()], TensorValues::F64(place)));
        let mut metadata = format();
        if let Some(p) = &self.pictures {
            tensors.push(floats::<2>("uvs", bytemuck::cast_slice(&p.atlas.uvs)));
            tensors.push(indices("uv_triangles", &p.atlas.triangles));
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
                tensors.push(floats::<1>("lobe_scale", bytemuck::cast_slice(&lobes.scale)));
                tensors.push(floats("asset_from_world", &lobes.asset_from_world.to_cols_array_2d()));
            }
        }
        Ok(io::write_tensors(&folder.join("geometry.safetensors"), &tensors, &metadata)?)
    }

    /// Reads the parts back.
    ///
    /// # Errors
    ///
    /// Parts that are missing, damaged or of another version; the way out is to make them again.
    pub fn load(folder: &Path) -> Result<Product> {
        let mut parts = Parts::open(folder.join("geometry.safetensors"))?;
        let mesh = parts.mesh()?;
        let world_from_scene = parts.similarity("world_from_scene")?;
        if !parts.tensors.contains_key("uvs") {
            return Ok(Product { mesh, world_from_scene, pictures: None });
        }
        let photo = |name: &str, size: Option<(u32, u32)>| -> Result<Photo> {
            let read = io::read_photo(&folder.join(name), size, &Limits::default());
            let photo = read.map_err(|e| unusable(e, "mesh"))?;
            let found = (photo.width, photo.height);
            match size.filter(|size| *size != found) {
                None => Ok(photo),
                Some(size) => {
                    let found = format!("{} × {} pixels", found.0, found.1);
                    let expected = format!("{} × {}, as `color.png`", size.0, size.1);
                    Err(unusable(ReadError::value(&folder.join(name), "size", found, expected), "mesh"))
                }
            }
        };
        let color = photo("color.png", None)?;
        let size = Some((color.width, color.height));
        let uvs: Vec<Vec2> = parts.rows::<2>("uvs")?.into_iter().map(Vec2::from).collect();
        let triangles = parts.indices("uv_triangles", uvs.len())?;
        if triangles.len() != mesh.triangles.len() {
            return Err(parts.missing("uv_triangles"));
        }
        let atlas = Atlas { uvs, triangles, width: color.width, height: color.height };
        let normal = parts.metadata.get("normal").map(|_| photo("normal.png", size)).transpose()?;
        let mut lobes = None;
        if parts.tensors.contains_key("lobe_scale") {
            let scale = parts.rows::<1>("lobe_scale")?.into_flattened();
            let turned = parts.rows::<3>("asset_from_world")?;
            let &[x, y, z] = &turned[..] else { return Err(parts.missing("asset_from_world")) };
            if scale.len() > 16 {
                return Err(parts.missing("lobe_scale"));
            }
            let pictures =
                (0..scale.len()).map(|k| photo(&format!("lobe_{k}.png"), size)).collect::<Result<_, _>>()?;
            let asset_from_world = Mat3::from_cols_array_2d(&[x, y, z]);
            lobes = Some(Lobes { pictures, scale, asset_from_world });
        }
        Ok(Product { mesh, world_from_scene, pictures: Some(Pictures { atlas, color, normal, lobes }) })
    }
}

/// Tensors that have been read, and where.
struct Parts {
    path: PathBuf,
    tensors: BTreeMap<String, (Vec<usize>, TensorValues)>,
    metadata: BTreeMap<String, String>,
}

impl Parts {
    fn open(path: PathBuf) -> Result<Parts> {
        let wrong = |what: &str| {
            Error::cannot(
                format!("`{}`: {what}", path.display()),
                "make the mesh again: `tiface mesh RUN --fresh mesh`",
            )
        };
        if !io::is_file(&path) {
            return Err(wrong("it is not there"));
        }
        let (tensors, metadata) =
            io::read_tensors(&path, &Limits::default()).map_err(|e| unusable(e, "mesh"))?;
        match metadata.get("format").map(String::as_str) {
            Some(FORMAT) => Ok(Parts { path, tensors, metadata }),
            found => Err(wrong(&format!(
                "its layout is `{}`, expected `{FORMAT}`: another version wrote it",
                found.unwrap_or("unnamed")
            ))),
        }
    }

    fn missing(&self, name: &str) -> Error {
        Error::cannot(
            format!("`{}`: `{name}` is missing or of another shape", self.path.display()),
            "make the mesh again: `tiface mesh RUN --fresh mesh`",
        )
    }

    fn wrong(&self, key: &str, found: impl ToString, expected: &str) -> Error {
        unusable(ReadError::value(&self.path, key, found, expected), "mesh")
    }

    /// `[n, N]` numbers.
    fn rows<const N: usize>(&mut self, name: &str) -> Result<Vec<[f32; N]>> {
        match self.tensors.remove(name) {
            Some((shape, TensorValues::F32(v))) if shape.len() == 2 && shape[1] == N => {
                Ok(v.as_chunks::<N>().0.to_vec())
            }
            _ => Err(self.missing(name)),
        }
    }

    /// `[n, 3]` indices below a bound.
    fn indices(&mut self, name: &str, below: usize) -> Result<Vec<[u32; 3]>> {
        match self.tensors.remove(name) {
            Some((shape, TensorValues::U32(v)))
                if shape.len() == 2 && shape[1] == 3 && v.iter().all(|&i| (i as usize) < below) =>
            {
                Ok(v.as_chunks::<3>().0.to_vec())
            }
            _ => Err(self.missing(name)),
        }
    }

    fn mesh(&mut self) -> Result<Mesh> {
        let vectors = |rows: Vec<[f32; 3]>| rows.into_iter().map(Vec3::from).collect::<Vec<_>>();
        let positions = vectors(self.rows("positions")?);
        let normals = vectors(self.rows("normals")?);
        let colors = self.rows("colors")?;
        for (name, found) in [("normals", normals.len()), ("colors", colors.len())] {
            if found != 0 && found != positions.len() {
                return Err(self.missing(name));
            }
        }
        let triangles = self.indices("triangles", positions.len())?;
        if triangles.is_empty() {
            return Err(self.wrong("triangles", "an empty list", "at least one"));
        }
        Ok(Mesh { positions, normals, colors, triangles })
    }

    /// Scale, rotation by columns, translation.
    fn similarity(&mut self, name: &str) -> Result<Similarity> {
        let Some((_, TensorValues::F64(v))) = self.tensors.remove(name) else {
            return Err(self.missing(name));
        };
        let &[scale, a, b, c, d, e, f, g, h, i, x, y, z] = &v[..] else { return Err(self.missing(name)) };
        let rotation = DMat3::from_cols_array(&[a, b, c, d, e, f, g, h, i]);
        let found = Similarity { scale, rotation, translation: DVec3::new(x, y, z) };
        match found.problem() {
            None => Ok(found),
            Some((part, found, expected)) => Err(self.wrong(&format!("{name}.{part}"), found, expected)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::product::tests::product;
    use super::*;

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
    fn a_surface_comes_back_with_its_cap() {
        let dir = tempfile::tempdir().unwrap();
        let skin = |x: f32| Skin { position: Vec3::splat(x), normal: Vec3::Y, color: [x, 0.5, 0.25] };
        let cap = Cap { bounds: Aabb::SCENE, near: 1e-5, ring: vec![skin(0.1), skin(0.2)] };
        let mesh = Mesh { colors: Vec::new(), ..product().mesh };
        for cap in [Some(Cap { ring: Vec::new(), ..cap.clone() }), Some(cap), None] {
            let whole = Whole { mesh: mesh.clone(), cap };
            whole.save(dir.path()).unwrap();
            assert_eq!(Whole::load(dir.path()).unwrap(), whole);
        }
    }

    /// A picture of another size than the texture.
    fn odd() -> Photo {
        Photo { width: 3, height: 1, rgb: vec![[1, 2, 3]; 3], alpha: None }
    }

    #[test]
    fn a_hostile_cap_is_refused_with_its_key() {
        let dir = tempfile::tempdir().unwrap();
        let error = |bounds: Aabb, near: f32| {
            let mesh = Mesh { colors: Vec::new(), ..product().mesh };
            Whole { mesh, cap: Some(Cap { bounds, near, ring: Vec::new() }) }.save(dir.path()).unwrap();
            let error = Whole::load(dir.path()).unwrap_err();
            assert!(error.hint().contains("--fresh mesh"), "{error:?}");
            error.to_string()
        };
        let swapped = Aabb { min: Vec3::ONE, max: Vec3::NEG_ONE };
        assert!(error(swapped, 1e-5).contains("`cap_box`"));
        assert!(error(Aabb::SCENE, -1.0).contains("`cap_near` is -1, expected 0 or more"));
        std::fs::write(dir.path().join("surface.safetensors"), b"torn").unwrap();
        assert!(Whole::load(dir.path()).unwrap_err().hint().contains("--fresh mesh"));
    }

    #[test]
    fn damaged_and_older_parts_are_named_with_the_way_out() {
        let dir = tempfile::tempdir().unwrap();
        let error = |change: &dyn Fn(&mut Product)| {
            let mut product = product();
            change(&mut product);
            product.save(dir.path()).unwrap();
            let error = Product::load(dir.path()).unwrap_err();
            assert!(error.hint().contains("--fresh mesh"), "{error:?}");
            error.to_string()
        };
        assert!(error(&|p| p.mesh.triangles[2] = [0, 1, 9]).contains("`triangles`"));
        assert!(error(&|p| p.mesh.normals.truncate(2)).contains("`normals`"));
        assert!(error(&|p| p.mesh.triangles.clear()).contains("`triangles`"));
        assert!(error(&|p| p.world_from_scene.scale = -1.0).contains("`world_from_scene.scale` is -1"));
        assert!(error(&|p| p.world_from_scene.scale = 0.0).contains("`world_from_scene.scale`"));
        assert!(
            error(&|p| p.world_from_scene.rotation.x_axis *= -1.0).contains("`world_from_scene.rotation`")
        );
        assert!(error(&|p| p.pictures.as_mut().unwrap().normal = Some(odd())).contains("`size`"));
        assert!(
            error(&|p| p.pictures.as_mut().unwrap().atlas.triangles.truncate(1)).contains("uv_triangles")
        );
        let old = BTreeMap::from([("format".to_owned(), "tiface-mesh-1".to_owned())]);
        io::write_tensors(&dir.path().join("geometry.safetensors"), &geometry(&product().mesh), &old)
            .unwrap();
        for error in [
            Product::load(dir.path()).unwrap_err(),
            Product::load(&dir.path().join("nothing")).unwrap_err(),
            Whole::load(&dir.path().join("nothing")).unwrap_err(),
        ] {
            assert!(error.hint().contains("--fresh mesh"), "{error:?}");
        }
        assert!(Product::load(dir.path()).unwrap_err().to_string().contains("`tiface-mesh-1`"));
    }
}
