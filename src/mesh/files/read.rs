//! Meshes from files others wrote: GLB, PLY and OBJ, from bytes.
//!
//! [`read`] gives the surface, [`read_whole`] also its texture. What the bytes are decides, not the name. Every
//! count is compared with the bytes that remain before anything is reserved, no other file is opened, and numbers
//! that are not finite are refused.
//!
//! Positions are read in f64. Those of a mesh far from the origin, where f32 steps over its triangles, come around
//! an origin of their own, see [`ReadMesh::origin`].

use super::export::middle;
use super::{glb_read, obj_read, ply_read};
use crate::geom::{Atlas, Mesh};
use glam::{DVec3, Vec3};
use std::path::{Path, PathBuf};

/// How much a file may ask for. GLB can show one buffer many times, so bytes alone do not bound it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Most vertices.
    pub vertices: usize,
    /// Most triangles, after polygons are fanned.
    pub triangles: usize,
    /// Most bytes of JSON in a GLB.
    pub json: usize,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits { vertices: 30_000_000, triangles: 30_000_000, json: 64 << 20 }
    }
}

/// Why bytes are not a mesh.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadMeshError {
    /// None of the formats.
    #[error("`{}` is neither GLB, PLY nor OBJ", path.display())]
    Unknown {
        /// Which file.
        path: PathBuf,
    },
    /// A file that breaks its own rules.
    #[error("`{}`, {at}: {what}", path.display())]
    Broken {
        /// Which file.
        path: PathBuf,
        /// What it is: `GLB`, `PLY`, `OBJ` or `MTL`.
        format: &'static str,
        /// Where in it.
        at: String,
        /// What is wrong: expected and found.
        what: String,
    },
    /// A file that is right, but beyond this reader.
    #[error("`{}`, {at}: {feature} is not supported", path.display())]
    Unsupported {
        /// Which file.
        path: PathBuf,
        /// What it is, as in [`ReadMeshError::Broken`].
        format: &'static str,
        /// Where in it.
        at: String,
        /// What it uses.
        feature: String,
    },
    /// More than [`Limits`] allow.
    #[error("`{}` has more than {limit} {what}", path.display())]
    TooMany {
        /// Which file.
        path: PathBuf,
        /// Of what.
        what: &'static str,
        /// How many are allowed.
        limit: usize,
    },
    /// No triangles.
    #[error("`{}` holds no triangles", path.display())]
    Empty {
        /// Which file.
        path: PathBuf,
    },
}

crate::error::error_from!(ReadMeshError, Cannot);

impl ReadMeshError {
    /// The way out.
    pub fn hint(&self) -> &'static str {
        match self {
            ReadMeshError::Unknown { .. } => {
                "export it as .glb, .ply or .obj; a .gltf beside a .bin is not read"
            }
            ReadMeshError::Broken { format: "GLB", .. } => {
                "export it again; the Khronos validator explains a GLB in detail"
            }
            ReadMeshError::Broken { .. } => {
                "export it again, or open it in Blender or MeshLab and save it anew from there"
            }
            ReadMeshError::Unsupported { format: "GLB", .. } => {
                "export it as a plain .glb without compression, with one picture inside"
            }
            ReadMeshError::Unsupported { .. } => {
                "export it with one texture that lies in the same folder, or as a .glb with the picture inside"
            }
            ReadMeshError::TooMany { .. } => "simplify it first",
            ReadMeshError::Empty { .. } => "export a surface, not points or curves",
        }
    }
}

/// A mesh from the bytes of a `.glb`, `.ply` or `.obj` file, in the file's own coordinates, rounded to f32: for a
/// mesh far from the origin see [`read_placed`].
///
/// `path` is for messages only. Colours come back sRGB-coded; normals only when every vertex has
/// one. Polygons are fanned. Nothing is welded or repaired. Textures are passed over, sound or not.
pub fn read(bytes: &[u8], path: &Path) -> Result<Mesh, ReadMeshError> {
    read_limited(bytes, path, &Limits::default())
}

/// [`read`] with limits of one's own.
pub fn read_limited(bytes: &[u8], path: &Path, limits: &Limits) -> Result<Mesh, ReadMeshError> {
    let Parsed { positions, mesh, .. } = any(bytes, path, limits, false)?;
    Ok(Mesh { positions: positions.iter().map(|p| p.as_vec3()).collect(), ..mesh })
}

/// A mesh as it was read, with its texture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadMesh {
    /// The surface, its positions relative to `origin`.
    pub mesh: Mesh,
    /// Where in the file's coordinates the mesh's are 0: the middle of a mesh that lies more than fifteen of its
    /// sizes from the file's origin, else that.
    pub origin: DVec3,
    /// Where its triangles lie in the texture, if the file says so for all of them. The size is that
    /// of the picture in the file, else 0 × 0. Coordinates are finite; in files of others they may
    /// leave 0..=1, where a texture repeats.
    pub atlas: Option<Atlas>,
    /// The base colour.
    pub texture: Option<Texture>,
}

/// Where the base colour of a file is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Texture {
    /// In the file: PNG or JPEG, for [`crate::io::parse_photo`]. Its header is within the limits for
    /// pictures; nothing more is known.
    Inside(Vec<u8>),
    /// In a picture of this bare name, in the same folder.
    Beside(String),
    /// In the picture that [`super::picture_of_mtl`] finds in the `.mtl` of this bare name, in the same folder.
    Material(String),
}

/// A mesh with its texture, as far as these bytes hold it.
///
/// # Errors
///
/// As [`read`]; and when the texture is broken, lies outside the file and its folder, or when there are
/// several.
pub fn read_whole(bytes: &[u8], path: &Path) -> Result<ReadMesh, ReadMeshError> {
    Ok(any(bytes, path, &Limits::default(), true)?.placed())
}

/// [`read_whole`] without the texture, sound or not.
///
/// # Errors
///
/// As [`read`].
pub fn read_placed(bytes: &[u8], path: &Path) -> Result<ReadMesh, ReadMeshError> {
    Ok(any(bytes, path, &Limits::default(), false)?.placed())
}

/// What the reader of a format finds: a [`ReadMesh`] whose positions are still the file's.
#[derive(Default)]
pub(super) struct Parsed {
    pub positions: Vec<DVec3>,
    /// All but the positions.
    pub mesh: Mesh,
    pub atlas: Option<Atlas>,
    pub texture: Option<Texture>,
}

impl Parsed {
    fn placed(self) -> ReadMesh {
        let Parsed { positions, mut mesh, atlas, texture } = self;
        // the box of what is shown: loose vertices may be anywhere
        let corners = mesh.triangles.iter().flatten().map(|&i| positions[i as usize]);
        let (low, high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let (center, _, far) = middle(corners.fold((low, high), |(low, high), p| (low.min(p), high.max(p))));
        // rounded as export does, so that what it wrote comes back as it was
        let origin = if far { center.as_vec3().as_dvec3() } else { DVec3::ZERO };
        // −0 stays what it was
        let place = |p: &DVec3| if far { (p - origin).as_vec3() } else { p.as_vec3() };
        mesh.positions = positions.iter().map(place).collect::<Vec<Vec3>>();
        ReadMesh { mesh, origin, atlas, texture }
    }
}

fn any(bytes: &[u8], path: &Path, limits: &Limits, textures: bool) -> Result<Parsed, ReadMeshError> {
    let source = |format| Source { path, format, limits, textures };
    let whole = if bytes.starts_with(b"glTF") {
        glb_read::read(bytes, source("GLB"))?
    } else if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
        ply_read::read(bytes, source("PLY"))?
    } else if looks_like_obj(bytes) {
        obj_read::read(bytes, source("OBJ"))?
    } else {
        return Err(ReadMeshError::Unknown { path: path.into() });
    };
    if whole.mesh.triangles.is_empty() {
        return Err(ReadMeshError::Empty { path: path.into() });
    }
    Ok(whole)
}

/// Does some early line start with a word of OBJ?
fn looks_like_obj(bytes: &[u8]) -> bool {
    let start = &bytes[..bytes.len().min(1 << 16)];
    !start.contains(&0)
        && start.split(|&b| b == b'\n').any(|line| {
            let word = line.trim_ascii().split(|b| b.is_ascii_whitespace()).next().unwrap_or(b"");
            [&b"v"[..], b"f", b"o", b"g", b"vn", b"vt", b"mtllib"].contains(&word)
        })
}

/// Which file is read, how much it may ask for, and whether its texture is wanted.
#[derive(Clone, Copy)]
pub(super) struct Source<'a> {
    pub path: &'a Path,
    pub format: &'static str,
    pub limits: &'a Limits,
    pub textures: bool,
}

impl Source<'_> {
    pub fn broken(&self, at: impl Into<String>, what: impl Into<String>) -> ReadMeshError {
        let (path, format) = (self.path.into(), self.format);
        ReadMeshError::Broken { path, format, at: at.into(), what: what.into() }
    }

    pub fn unsupported(&self, at: impl Into<String>, feature: impl Into<String>) -> ReadMeshError {
        let (path, format) = (self.path.into(), self.format);
        ReadMeshError::Unsupported { path, format, at: at.into(), feature: feature.into() }
    }

    /// The name of a file in the same folder: no path, no address.
    pub fn bare_name(&self, at: impl Into<String>, name: &str) -> Result<String, ReadMeshError> {
        let name = name.trim();
        let name = name.strip_prefix("./").unwrap_or(name);
        let is_bare = !name.is_empty()
            && name != ".."
            && !name.contains(|c: char| c.is_control() || "/\\:".contains(c));
        if is_bare { Ok(name.into()) } else { Err(self.unsupported(at, "a texture outside the folder")) }
    }

    /// Are this many vertices and triangles allowed?
    pub fn allow(&self, vertices: usize, triangles: usize) -> Result<(), ReadMeshError> {
        let Limits { vertices: v, triangles: t, .. } = *self.limits;
        for (what, found, limit) in [("vertices", vertices, v), ("triangles", triangles, t)] {
            if found > limit {
                return Err(ReadMeshError::TooMany { path: self.path.into(), what, limit });
            }
        }
        Ok(())
    }
}
