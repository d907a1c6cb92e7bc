//! Meshes as tensors, for later stages: in scene coordinates, because the world may be so far away
//! that f32 could not represent a head in it.
//!
//! - The extracted surface: the target of ray casting.
//! - The head mesh: the simplified mesh with its texture.
//!
//! ```text
//! geometry.safetensors             the mesh, and where it lies in its texture
//! color.png normal.png lobe_K.png  the pictures of its texture
//! ```

use super::head_texture::{HeadTexture, Lobes};
use crate::extract::{Cap, RimVertex};
use glam::{DMat3, DVec3, Mat3, Vec2, Vec3};
use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use tiface_base::error::Cause;
use tiface_base::geom::{Aabb, Atlas, Harmonics, Mesh, ShellLayer, Shells, Similarity};
use tiface_base::image::Photo;
use tiface_base::io::{self, Limits, ReadError, TensorValues};
use tiface_base::{Error, Result};

/// Version of the layout; part of the stage's fingerprint, so that a mesh of another version is
/// made again.
pub const FORMAT: &str = "tiface-mesh-2";

/// Returns the error for a file that its writer has to write again.
fn stale(what: impl Display) -> Error {
    Error::cannot(what, "save the mesh again").with_cause(Cause::Stale)
}

type Tensor = (String, Vec<usize>, TensorValues);

/// `[n, N]` numbers.
fn floats<const N: usize>(name: &str, values: &[[f32; N]]) -> Tensor {
    (name.into(), vec![values.len(), N], TensorValues::F32(values.as_flattened().to_vec()))
}

/// `[n, 3]` indices.
fn indices(name: &str, values: &[[u32; 3]]) -> Tensor {
    (name.into(), vec![values.len(), 3], TensorValues::U32(values.as_flattened().to_vec()))
}

/// Returns the tensors of a mesh.
fn geometry(mesh: &Mesh) -> Vec<Tensor> {
    vec![
        floats::<3>("positions", bytemuck::cast_slice(&mesh.positions)),
        floats::<3>("normals", bytemuck::cast_slice(&mesh.normals)),
        floats("colors", &mesh.colors),
        indices("triangles", &mesh.triangles),
    ]
    .into_iter()
    .chain((!mesh.seen_by.is_empty()).then(|| {
        let numbers = mesh.seen_by.iter().map(|&n| u32::from(n)).collect();
        ("seen_by".into(), vec![mesh.seen_by.len()], TensorValues::U32(numbers))
    }))
    .collect()
}

/// Returns the version as it is written in a file.
fn format() -> BTreeMap<String, String> {
    BTreeMap::from([("format".to_owned(), FORMAT.to_owned())])
}

/// Returns the error for an unusable file: missing or damaged ones can be made again.
fn damaged(e: ReadError) -> Error {
    match &e {
        ReadError::Io { source, .. } if source.kind() != std::io::ErrorKind::NotFound => e.into(),
        _ => stale(&e),
    }
}

/// Tensors of a file, with its path.
struct StoredTensors {
    path: PathBuf,
    tensors: BTreeMap<String, (Vec<usize>, TensorValues)>,
    metadata: BTreeMap<String, String>,
}

impl StoredTensors {
    fn open(path: &Path) -> Result<StoredTensors> {
        let wrong = |what: &str| Err(stale(format!("`{}`: {what}", path.display())));
        if !io::is_file(path) {
            return wrong("the file is missing");
        }
        let (tensors, metadata) = io::read_tensors(path, &Limits::default()).map_err(damaged)?;
        match metadata.get("format").map(String::as_str) {
            Some(FORMAT) => Ok(StoredTensors { path: path.into(), tensors, metadata }),
            found => wrong(&format!(
                "its layout is `{}`, expected `{FORMAT}`: another version wrote it",
                found.unwrap_or("unnamed")
            )),
        }
    }

    fn contains(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    fn missing(&self, name: &str) -> Error {
        stale(format!("`{}`: `{name}` is missing or of another shape", self.path.display()))
    }

    fn wrong(&self, key: &str, found: impl ToString, expected: &str) -> Error {
        damaged(ReadError::value(&self.path, key, found, expected))
    }

    /// Numbers of a shape that `fits`.
    fn numbers(&mut self, name: &str, fits: impl Fn(&[usize]) -> bool) -> Result<(Vec<usize>, Vec<f32>)> {
        match self.tensors.remove(name) {
            Some((shape, TensorValues::F32(values))) if fits(&shape) => Ok((shape, values)),
            _ => Err(self.missing(name)),
        }
    }

    /// `[n, N]` numbers.
    fn rows<const N: usize>(&mut self, name: &str) -> Result<Vec<[f32; N]>> {
        let (_, values) = self.numbers(name, |shape| shape.len() == 2 && shape[1] == N)?;
        Ok(values.as_chunks::<N>().0.to_vec())
    }

    /// `[n, count]` numbers, a list for each of the `n`.
    fn each_of(&mut self, count: usize, name: &str) -> Result<Vec<Vec<f32>>> {
        let (_, values) = self.numbers(name, |shape| shape.len() == 2 && shape[1] == count && count > 0)?;
        Ok(values.chunks_exact(count).map(<[f32]>::to_vec).collect())
    }

    /// Returns a matrix by its columns.
    fn matrix(&mut self, name: &str) -> Result<Mat3> {
        let &[x, y, z] = &self.rows::<3>(name)?[..] else { return Err(self.missing(name)) };
        Ok(Mat3::from_cols(x.into(), y.into(), z.into()))
    }

    /// `[n, 3]` numbers.
    fn vectors(&mut self, name: &str) -> Result<Vec<Vec3>> {
        Ok(self.rows(name)?.into_iter().map(Vec3::from).collect())
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
        let (positions, normals) = (self.vectors("positions")?, self.vectors("normals")?);
        let colors = self.rows("colors")?;
        for (name, found) in [("normals", normals.len()), ("colors", colors.len())] {
            if found != 0 && found != positions.len() {
                return Err(self.missing(name));
            }
        }
        let seen_by = match self.tensors.remove("seen_by") {
            None => Vec::new(),
            Some((shape, TensorValues::U32(v)))
                if shape == [positions.len()] && v.iter().all(|&n| n <= u32::from(u8::MAX)) =>
            {
                v.into_iter().map(|n| n as u8).collect()
            }
            Some(_) => return Err(self.missing("seen_by")),
        };
        let triangles = self.indices("triangles", positions.len())?;
        if triangles.is_empty() {
            return Err(self.wrong("triangles", "an empty list", "at least one"));
        }
        Ok(Mesh { positions, normals, colors, seen_by, triangles })
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

const SURFACE_FILE: &str = "surface.safetensors";

/// The whole zero level set of a field, in scene coordinates.
#[derive(Clone, Debug, PartialEq)]
pub struct ExtractedSurface {
    /// The mesh, without colors, because rays take the field's.
    pub mesh: Mesh,
    /// The cap that closes it where the box ends.
    pub cap: Option<Cap>,
}

impl ExtractedSurface {
    /// Writes the surface into a folder, which is created if necessary.
    ///
    /// # Errors
    ///
    /// Fails if the folder cannot be written to.
    pub fn save(&self, folder: &Path) -> Result<()> {
        io::create_folder(folder)?;
        let mut tensors = geometry(&self.mesh);
        if let Some(cap) = &self.cap {
            let of = |value: &dyn Fn(&RimVertex) -> [f32; 3]| cap.ring.iter().map(value).collect::<Vec<_>>();
            tensors.push(floats("cap_box", &[cap.bounds.min.to_array(), cap.bounds.max.to_array()]));
            tensors.push(floats("cap_near", &[[cap.near]]));
            tensors.push(floats("cap_ring", &of(&|s| s.position.to_array())));
            tensors.push(floats("cap_ring_normals", &of(&|s| s.normal.to_array())));
            tensors.push(floats("cap_ring_colors", &of(&|s| s.color)));
        }
        Ok(io::write_tensors(&folder.join(SURFACE_FILE), &tensors, &format())?)
    }

    /// Reads the surface from a folder.
    ///
    /// # Errors
    ///
    /// Fails if the file is missing, damaged or of another version; the suggested fix is to make it
    /// again.
    pub fn load(folder: &Path) -> Result<ExtractedSurface> {
        let mut stored = StoredTensors::open(&folder.join(SURFACE_FILE))?;
        let mesh = stored.mesh()?;
        if !stored.contains("cap_box") {
            return Ok(ExtractedSurface { mesh, cap: None });
        }
        let near = stored.rows::<1>("cap_near")?;
        let (corners, ring) = (stored.vectors("cap_box")?, stored.vectors("cap_ring")?);
        let (normals, colors) = (stored.vectors("cap_ring_normals")?, stored.rows("cap_ring_colors")?);
        let (&[min, max], &[[near]]) = (&corners[..], &near[..]) else {
            return Err(stored.missing("cap_box"));
        };
        if normals.len() != ring.len() || colors.len() != ring.len() {
            return Err(stored.missing("cap_ring"));
        }
        let ring = ring.into_iter().zip(normals).zip(colors);
        let ring = ring.map(|((position, normal), color)| RimVertex { position, normal, color }).collect();
        if min.cmpge(max).any() {
            return Err(stored.wrong("cap_box", format!("{min} to {max}"), "a box, its lowest corner first"));
        }
        if near < 0.0 {
            return Err(stored.wrong("cap_near", near, "0 or more"));
        }
        Ok(ExtractedSurface { mesh, cap: Some(Cap { bounds: Aabb { min, max }, near, ring }) })
    }
}

const HEAD_FILE: &str = "geometry.safetensors";

/// Maximum number of functions of a spherical-harmonic color.
const MAX_LOBES: usize = 16;

/// A simplified mesh with its texture.
#[derive(Clone, Debug, PartialEq)]
pub struct HeadMesh {
    /// The surface in scene coordinates; without a texture it has colors at its vertices.
    pub mesh: Mesh,
    /// The transform from the scene to the dataset's world.
    pub world_from_scene: Similarity,
    /// Its texture, if it has one.
    pub texture: Option<HeadTexture>,
    /// View-dependent color added to its base color, if it was fitted to photographs.
    pub harmonics: Option<Harmonics>,
    /// Soft layers around it, if they show more of the head.
    pub shells: Option<Shells>,
}

impl HeadMesh {
    /// Returns the head as its soft layers are drawn: around the opaque core under them.
    ///
    /// # Panics
    ///
    /// Those of [`Shells::on_core`].
    pub fn as_drawn(mut self) -> HeadMesh {
        if let Some(shells) = self.shells.take() {
            let (core, shells) = shells.on_core(&self.mesh);
            (self.mesh, self.shells) = (core, Some(shells));
        }
        self
    }

    /// Writes the mesh into a folder, which is created if necessary.
    ///
    /// # Errors
    ///
    /// Fails if the folder cannot be written to.
    pub fn save(&self, folder: &Path) -> Result<()> {
        io::create_folder(folder)?;
        let mut tensors = geometry(&self.mesh);
        let Similarity { scale, rotation, translation } = self.world_from_scene;
        let mut place = vec![scale];
        place.extend(rotation.to_cols_array());
        place.extend(translation.to_array());
        tensors.push(("world_from_scene".into(), vec![place.len()], TensorValues::F64(place)));
        if let Some(harmonics) = &self.harmonics {
            let count = harmonics.functions;
            let values = harmonics.coefficients.as_flattened().to_vec();
            let shape = vec![harmonics.coefficients.len() / count, count, 3];
            tensors.push(("harmonics".into(), shape, TensorValues::F32(values)));
            tensors.push(floats("harmonics_from_scene", &harmonics.turned.to_cols_array_2d()));
        }
        if let Some(Shells { layers, depths }) = &self.shells {
            let tensor = |name: &str, values: &dyn Fn(&ShellLayer) -> Vec<f32>| {
                let all: Vec<f32> = layers.iter().flat_map(values).collect();
                (name.into(), vec![layers.len(), self.mesh.positions.len()], TensorValues::F32(all))
            };
            tensors.push(tensor("shell_offsets", &|layer| layer.offsets.clone()));
            tensors.push(tensor("shell_alphas", &|layer| layer.alphas.clone()));
            if !depths.is_empty() {
                tensors.push(floats::<1>("shell_depths", bytemuck::cast_slice(depths)));
            }
        }
        let mut metadata = format();
        if let Some(texture) = &self.texture {
            tensors.push(floats::<2>("uvs", bytemuck::cast_slice(&texture.atlas.uvs)));
            tensors.push(indices("uv_triangles", &texture.atlas.triangles));
            let write = |name: &str, photo: &Photo| {
                io::write_png_rgb(&folder.join(name), photo.width, photo.height, &photo.rgb)
            };
            write("color.png", &texture.color)?;
            if let Some(normal) = &texture.normal {
                write("normal.png", normal)?;
                metadata.insert("normal".into(), "normal.png".into());
            }
            if let Some(lobes) = &texture.lobes {
                for (k, picture) in lobes.pictures.iter().enumerate() {
                    write(&format!("lobe_{k}.png"), picture)?;
                }
                tensors.push(floats::<1>("lobe_scale", bytemuck::cast_slice(&lobes.scale)));
                tensors.push(floats("lobes_from_scene", &lobes.turned.to_cols_array_2d()));
            }
        }
        Ok(io::write_tensors(&folder.join(HEAD_FILE), &tensors, &metadata)?)
    }

    /// Reads the mesh from a folder.
    ///
    /// # Errors
    ///
    /// Fails if files are missing, damaged or of another version; the suggested fix is to make them
    /// again.
    pub fn load(folder: &Path) -> Result<HeadMesh> {
        let mut stored = StoredTensors::open(&folder.join(HEAD_FILE))?;
        let (mesh, world_from_scene) = (stored.mesh()?, stored.similarity("world_from_scene")?);
        let texture = stored.contains("uvs").then(|| load_texture(folder, &mut stored, &mesh)).transpose()?;
        let harmonics =
            stored.contains("harmonics").then(|| load_harmonics(&mut stored, &mesh)).transpose()?;
        let shells = stored.contains("shell_alphas").then(|| load_shells(&mut stored, &mesh)).transpose()?;
        Ok(HeadMesh { mesh, world_from_scene, texture, harmonics, shells })
    }
}

fn load_texture(folder: &Path, stored: &mut StoredTensors, mesh: &Mesh) -> Result<HeadTexture> {
    let color = load_photo(folder, "color.png", None)?;
    let (width, height) = (color.width, color.height);
    let uvs: Vec<Vec2> = stored.rows::<2>("uvs")?.into_iter().map(Vec2::from).collect();
    let triangles = stored.indices("uv_triangles", uvs.len())?;
    if triangles.len() != mesh.triangles.len() {
        return Err(stored.missing("uv_triangles"));
    }
    let mut texture = HeadTexture::new(Atlas { uvs, triangles, width, height }, color);
    let size = Some((width, height));
    if stored.metadata.contains_key("normal") {
        texture.normal = Some(load_photo(folder, "normal.png", size)?);
    }
    if stored.contains("lobe_scale") {
        let scale = stored.rows::<1>("lobe_scale")?.into_flattened();
        let turned = stored.matrix("lobes_from_scene")?;
        if !(1..=MAX_LOBES).contains(&scale.len()) {
            return Err(stored.missing("lobe_scale"));
        }
        let name = |k: usize| format!("lobe_{k}.png");
        let first = load_photo(folder, &name(0), None)?;
        let (w, h) = (first.width, first.height);
        if u64::from(w) * u64::from(height) != u64::from(h) * u64::from(width) {
            let expected = format!("the shape of `color.png`, {width} × {height}");
            let found = format!("{w} × {h} pixels");
            return Err(damaged(ReadError::value(&folder.join(name(0)), "size", found, expected)));
        }
        let others = (1..scale.len()).map(|k| load_photo(folder, &name(k), Some((w, h))));
        let pictures = std::iter::once(Ok(first)).chain(others).collect::<Result<_>>()?;
        texture.lobes = Some(Lobes { pictures, scale, turned });
    }
    Ok(texture)
}

fn load_harmonics(stored: &mut StoredTensors, mesh: &Mesh) -> Result<Harmonics> {
    let vertices = mesh.positions.len();
    let fits = |shape: &[usize]| matches!(*shape, [n, count, 3] if n == vertices && (1..=MAX_LOBES).contains(&count));
    let (shape, values) = stored.numbers("harmonics", fits)?;
    let turned = stored.matrix("harmonics_from_scene")?;
    Ok(Harmonics { functions: shape[1], coefficients: values.as_chunks::<3>().0.to_vec(), turned })
}

fn load_shells(stored: &mut StoredTensors, mesh: &Mesh) -> Result<Shells> {
    let vertices = mesh.positions.len();
    if mesh.normals.len() != vertices {
        return Err(stored.missing("normals"));
    }
    let (offsets, alphas) =
        (stored.each_of(vertices, "shell_offsets")?, stored.each_of(vertices, "shell_alphas")?);
    if offsets.len() != alphas.len() || !alphas.iter().flatten().all(|a| (0.0..=1.0).contains(a)) {
        return Err(stored.missing("shell_alphas"));
    }
    let depths = stored.contains("shell_depths").then(|| stored.rows::<1>("shell_depths")).transpose()?;
    let depths = depths.unwrap_or_default().into_flattened();
    if !depths.is_empty() && depths.len() != vertices {
        return Err(stored.missing("shell_depths"));
    }
    let layer = |(offsets, alphas)| ShellLayer { offsets, alphas };
    Ok(Shells { layers: offsets.into_iter().zip(alphas).map(layer).collect(), depths })
}

/// Loads a picture of the texture, of this size if one is given.
fn load_photo(folder: &Path, name: &str, size: Option<(u32, u32)>) -> Result<Photo> {
    let path = folder.join(name);
    let photo = io::read_photo(&path, size, &Limits::default()).map_err(damaged)?;
    let (w, h) = (photo.width, photo.height);
    match size.filter(|size| *size != (w, h)) {
        None => Ok(photo),
        Some(size) => {
            let expected = format!("{} × {}, as the first", size.0, size.1);
            Err(damaged(ReadError::value(&path, "size", format!("{w} × {h} pixels"), expected)))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::tetrahedron;
    use super::*;
    use glam::Vec3;

    #[test]
    fn a_surface_comes_back_with_its_cap() {
        let dir = tempfile::tempdir().unwrap();
        let skin = |x: f32| RimVertex { position: Vec3::splat(x), normal: Vec3::Y, color: [x, 0.5, 0.25] };
        let cap = Cap { bounds: Aabb::SCENE, near: 1e-5, ring: vec![skin(0.1), skin(0.2)] };
        let mesh = Mesh { colors: Vec::new(), ..tetrahedron().mesh };
        for cap in [Some(Cap { ring: Vec::new(), ..cap.clone() }), Some(cap), None] {
            let whole = ExtractedSurface { mesh: mesh.clone(), cap };
            whole.save(dir.path()).unwrap();
            assert_eq!(ExtractedSurface::load(dir.path()).unwrap(), whole);
        }
    }

    #[test]
    fn a_hostile_cap_is_refused_with_its_key() {
        let dir = tempfile::tempdir().unwrap();
        let error = |bounds: Aabb, near: f32| {
            let mesh = Mesh { colors: Vec::new(), ..tetrahedron().mesh };
            ExtractedSurface { mesh, cap: Some(Cap { bounds, near, ring: Vec::new() }) }
                .save(dir.path())
                .unwrap();
            let error = ExtractedSurface::load(dir.path()).unwrap_err();
            assert_eq!(error.cause(), Some(Cause::Stale), "{error:?}");
            error.to_string()
        };
        let swapped = Aabb { min: Vec3::ONE, max: Vec3::NEG_ONE };
        assert!(error(swapped, 1e-5).contains("`cap_box`"));
        assert!(error(Aabb::SCENE, -1.0).contains("`cap_near` is -1, expected 0 or more"));
        std::fs::write(dir.path().join("surface.safetensors"), b"torn").unwrap();
        assert_eq!(ExtractedSurface::load(dir.path()).unwrap_err().cause(), Some(Cause::Stale));
        let missing = ExtractedSurface::load(&dir.path().join("nothing")).unwrap_err();
        assert!(missing.cause() == Some(Cause::Stale) && !missing.hint().is_empty(), "{missing:?}");
    }

    #[test]
    fn parts_are_read_back_as_they_were() {
        let dir = tempfile::tempdir().unwrap();
        let whole = tetrahedron();
        whole.save(dir.path()).unwrap();
        assert_eq!(HeadMesh::load(dir.path()).unwrap(), whole);
        let bare = HeadMesh { texture: None, harmonics: None, shells: None, ..whole };
        bare.save(dir.path()).unwrap();
        assert_eq!(HeadMesh::load(dir.path()).unwrap(), bare);
    }

    /// Returns a picture of another size than the texture.
    fn odd() -> Photo {
        Photo { width: 3, height: 1, rgb: vec![[1, 2, 3]; 3], alpha: None }
    }

    #[test]
    fn damaged_and_older_parts_are_named_with_a_fix() {
        let dir = tempfile::tempdir().unwrap();
        let error = |change: &dyn Fn(&mut HeadMesh)| {
            let mut head = tetrahedron();
            change(&mut head);
            head.save(dir.path()).unwrap();
            let error = HeadMesh::load(dir.path()).unwrap_err();
            assert_eq!(error.cause(), Some(Cause::Stale), "{error:?}");
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
        assert!(error(&|p| p.texture.as_mut().unwrap().normal = Some(odd())).contains("`size`"));
        // lobes may be coarser than the color, all of them alike and in its shape
        fn lobe(p: &mut HeadMesh, k: usize) -> &mut Photo {
            &mut p.texture.as_mut().unwrap().lobes.as_mut().unwrap().pictures[k]
        }
        assert!(error(&|p| *lobe(p, 0) = odd()).contains("the shape of `color.png`, 8 × 8"));
        assert!(error(&|p| *lobe(p, 2) = odd()).contains("4 × 4, as the first"));
        assert!(error(&|p| p.texture.as_mut().unwrap().atlas.triangles.truncate(1)).contains("uv_triangles"));
        let cut = |p: &mut HeadMesh| p.harmonics.as_mut().unwrap().coefficients.truncate(12);
        assert!(error(&cut).contains("`harmonics`"));
        let opaque = |p: &mut HeadMesh| p.shells.as_mut().unwrap().layers[1].alphas[2] = 1.5;
        assert!(error(&opaque).contains("`shell_alphas`"));
        let short = |p: &mut HeadMesh| p.shells.as_mut().unwrap().depths.truncate(3);
        assert!(error(&short).contains("`shell_depths`"));
        let old = std::collections::BTreeMap::from([("format".to_owned(), "tiface-mesh-1".to_owned())]);
        io::write_tensors(&dir.path().join("geometry.safetensors"), &geometry(&tetrahedron().mesh), &old)
            .unwrap();
        for error in [
            HeadMesh::load(dir.path()).unwrap_err(),
            HeadMesh::load(&dir.path().join("nothing")).unwrap_err(),
        ] {
            assert_eq!(error.cause(), Some(Cause::Stale), "{error:?}");
        }
        assert!(HeadMesh::load(dir.path()).unwrap_err().to_string().contains("`tiface-mesh-1`"));
    }
}
