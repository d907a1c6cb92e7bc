//! Meshes from files others wrote: GLB, PLY and OBJ, from bytes.
//!
//! [`read`] gives the surface, [`read_with`] also its texture. What the bytes are decides, not the name. Every
//! count is compared with the bytes that remain before anything is reserved, no other file is opened, and numbers
//! that are not finite are refused.
//!
//! Positions are read in f64. Those of a mesh far from the origin, where f32 steps over its triangles, come around
//! an origin of their own, see [`ReadMesh::origin`].

use super::file_mesh::middle;
use super::source::{ParsedMesh, PictureSource, ReadOptions, Source};
use super::{glb_read, obj_read, ply_read};
use crate::geom::{Atlas, Mesh};
use crate::{Error, Result};
use glam::{DVec3, Vec3};
use std::path::Path;

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
    /// The base color.
    pub picture: Option<PictureSource>,
    /// Linear red, green and blue that it is multiplied with, if the file says so.
    pub tint: Option<[f32; 3]>,
}

/// Returns the mesh in the bytes of a `.glb`, `.ply` or `.obj` file, in the file's own coordinates, rounded to f32:
/// for a mesh far from the origin see [`read_with`].
///
/// `path` is for messages only. Colors come back sRGB-coded; normals only when every vertex has
/// one. Polygons are fanned. Nothing is welded or repaired. Textures are passed over, sound or not.
///
/// # Errors
///
/// The bytes are none of these formats, break its rules, use what is not supported, hold no triangles, or more than
/// the limits of [`ReadOptions`].
pub fn read(bytes: &[u8], path: &Path) -> Result<Mesh> {
    let ParsedMesh { positions, mesh, .. } = parse(bytes, path, &ReadOptions::SURFACE)?;
    Ok(Mesh { positions: positions.iter().map(|p| p.as_vec3()).collect(), ..mesh })
}

/// Returns a mesh around an origin of its own, with its texture as far as these bytes hold it.
///
/// # Errors
///
/// As [`read`]; and when the texture is wanted but broken, lies outside the file and its folder, or when there are
/// several.
pub fn read_with(bytes: &[u8], path: &Path, options: &ReadOptions) -> Result<ReadMesh> {
    let ParsedMesh { positions, mut mesh, atlas, picture, tint } = parse(bytes, path, options)?;
    // the box of what is shown: loose vertices may be anywhere
    let corners = mesh.triangles.iter().flatten().map(|&i| positions[i as usize]);
    let (low, high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (center, _, far) = middle(corners.fold((low, high), |(low, high), p| (low.min(p), high.max(p))));
    // rounded as export does, so that what it wrote comes back as it was
    let origin = if far { center.as_vec3().as_dvec3() } else { DVec3::ZERO };
    // −0 stays what it was
    let place = |p: &DVec3| if far { (p - origin).as_vec3() } else { p.as_vec3() };
    mesh.positions = positions.iter().map(place).collect::<Vec<Vec3>>();
    Ok(ReadMesh { mesh, origin, atlas, picture, tint })
}

fn parse(bytes: &[u8], path: &Path, options: &ReadOptions) -> Result<ParsedMesh> {
    let source = |format| Source { path, format, options };
    let found = if bytes.starts_with(b"glTF") {
        glb_read::read(bytes, source("GLB"))?
    } else if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
        ply_read::read(bytes, source("PLY"))?
    } else if looks_like_obj(bytes) {
        obj_read::read(bytes, source("OBJ"))?
    } else {
        let hint = "export it as .glb, .ply or .obj; a .gltf beside a .bin is not read";
        return Err(Error::cannot(format!("`{}` is neither GLB, PLY nor OBJ", path.display()), hint));
    };
    if found.mesh.triangles.is_empty() {
        let what = format!("`{}` holds no triangles", path.display());
        return Err(Error::cannot(what, "export a surface, not points or curves"));
    }
    Ok(found)
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
