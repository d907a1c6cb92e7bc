//! Meshes as tensors, for the stages after this one: in scene coordinates, since the world may lie so far away that
//! f32 could not hold a head in it.

use crate::geom::{Mesh, Similarity};
use crate::io::{self, Limits, ReadError, TensorValues};
use crate::{Error, Result};
use glam::{DMat3, DVec3, Vec3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Version of the layout; part of what the stage is, so that a mesh of another version is made again.
pub(crate) const FORMAT: &str = "tiface-mesh-2";

const MAKE_AGAIN: &str = "make the mesh again: `tiface mesh RUN --fresh mesh`";

pub(super) type Tensor = (String, Vec<usize>, TensorValues);

/// `[n, N]` numbers.
pub(super) fn floats<const N: usize>(name: &str, values: &[[f32; N]]) -> Tensor {
    (name.into(), vec![values.len(), N], TensorValues::F32(values.as_flattened().to_vec()))
}

/// `[n, 3]` indices.
pub(super) fn indices(name: &str, values: &[[u32; 3]]) -> Tensor {
    (name.into(), vec![values.len(), 3], TensorValues::U32(values.as_flattened().to_vec()))
}

/// The tensors of a mesh.
pub(super) fn geometry(mesh: &Mesh) -> Vec<Tensor> {
    vec![
        floats::<3>("positions", bytemuck::cast_slice(&mesh.positions)),
        floats::<3>("normals", bytemuck::cast_slice(&mesh.normals)),
        floats("colors", &mesh.colors),
        indices("triangles", &mesh.triangles),
    ]
}

/// The version as it stands in a file.
pub(super) fn format() -> BTreeMap<String, String> {
    BTreeMap::from([("format".to_owned(), FORMAT.to_owned())])
}

/// A file that cannot be used: what is missing or damaged can be made again.
pub(super) fn damaged(e: ReadError) -> Error {
    match &e {
        ReadError::Io { source, .. } if source.kind() != std::io::ErrorKind::NotFound => e.into(),
        _ => Error::cannot(&e, "make it again: repeat the command with `--fresh mesh`"),
    }
}

/// Tensors that have been read, and where.
pub(super) struct StoredTensors {
    path: PathBuf,
    tensors: BTreeMap<String, (Vec<usize>, TensorValues)>,
    pub metadata: BTreeMap<String, String>,
}

impl StoredTensors {
    pub fn open(path: &Path) -> Result<StoredTensors> {
        let wrong = |what: &str| Err(Error::cannot(format!("`{}`: {what}", path.display()), MAKE_AGAIN));
        if !io::is_file(path) {
            return wrong("it is not there");
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

    pub fn contains(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    pub fn missing(&self, name: &str) -> Error {
        let what = format!("`{}`: `{name}` is missing or of another shape", self.path.display());
        Error::cannot(what, MAKE_AGAIN)
    }

    pub fn wrong(&self, key: &str, found: impl ToString, expected: &str) -> Error {
        damaged(ReadError::value(&self.path, key, found, expected))
    }

    /// `[n, N]` numbers.
    pub fn rows<const N: usize>(&mut self, name: &str) -> Result<Vec<[f32; N]>> {
        match self.tensors.remove(name) {
            Some((shape, TensorValues::F32(v))) if shape.len() == 2 && shape[1] == N => {
                Ok(v.as_chunks::<N>().0.to_vec())
            }
            _ => Err(self.missing(name)),
        }
    }

    /// `[vertices, n, 3]` numbers, and `n`.
    pub fn per_vertex(&mut self, name: &str, vertices: usize) -> Result<(usize, Vec<[f32; 3]>)> {
        match self.tensors.remove(name) {
            Some((shape, TensorValues::F32(v)))
                if shape.len() == 3 && shape[0] == vertices && shape[1] > 0 && shape[2] == 3 =>
            {
                Ok((shape[1], v.as_chunks::<3>().0.to_vec()))
            }
            _ => Err(self.missing(name)),
        }
    }

    /// `[n, count]` numbers, a list for each of the `n`.
    pub fn each_of(&mut self, count: usize, name: &str) -> Result<Vec<Vec<f32>>> {
        match self.tensors.remove(name) {
            Some((shape, TensorValues::F32(v))) if shape.len() == 2 && shape[1] == count && count > 0 => {
                Ok(v.chunks_exact(count).map(<[f32]>::to_vec).collect())
            }
            _ => Err(self.missing(name)),
        }
    }

    /// `[n, 3]` numbers.
    pub fn vectors(&mut self, name: &str) -> Result<Vec<Vec3>> {
        Ok(self.rows(name)?.into_iter().map(Vec3::from).collect())
    }

    /// `[n, 3]` indices below a bound.
    pub fn indices(&mut self, name: &str, below: usize) -> Result<Vec<[u32; 3]>> {
        match self.tensors.remove(name) {
            Some((shape, TensorValues::U32(v)))
                if shape.len() == 2 && shape[1] == 3 && v.iter().all(|&i| (i as usize) < below) =>
            {
                Ok(v.as_chunks::<3>().0.to_vec())
            }
            _ => Err(self.missing(name)),
        }
    }

    pub fn mesh(&mut self) -> Result<Mesh> {
        let (positions, normals) = (self.vectors("positions")?, self.vectors("normals")?);
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
    pub fn similarity(&mut self, name: &str) -> Result<Similarity> {
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
