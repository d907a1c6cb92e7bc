//! Reading of meshes from files of other programs: GLB, PLY, OBJ and STL, from bytes.
//!
//! [`read`] returns the surface, [`read_with`] also its texture; [`open_mesh`](super::open_mesh)
//! opens a file with the pictures beside it. The format is detected from the bytes, not from the
//! name. Every count is compared with the remaining bytes before any allocation, no other file is
//! opened, and non-finite numbers are refused.
//!
//! Positions are read in f64. Those of a mesh far from the origin, where f32 steps over its
//! triangles, come around an origin of their own, see [`ReadMesh::origin`].

use super::file_mesh::middle;
use super::foreign::refusal;
use super::source::{ReadMesh, ReadOptions, Source, line_end, without_byte_order_mark};
use super::{glb_read, obj_read, ply_read, stl};
use glam::{DVec3, Vec3};
use std::path::Path;
use tiface_base::geom::Mesh;
use tiface_base::{Error, Result};

/// Returns the mesh in the bytes of a `.glb`, `.ply`, `.obj` or `.stl` file, in the file's own
/// coordinates, rounded to f32: for a mesh far from the origin see [`read_with`].
///
/// `path` is for messages only. Colors come back sRGB-coded; normals only when every vertex has
/// one. Polygons are fanned. Nothing is welded or repaired. Textures are passed over, sound or not.
///
/// # Errors
///
/// Fails if the bytes are none of these formats, break its rules, use unsupported features, hold no
/// triangles, or more than the limits of [`ReadOptions`].
pub fn read(bytes: &[u8], path: &Path) -> Result<Mesh> {
    let ReadMesh { places, mesh, .. } = parse(bytes, path, &ReadOptions::SURFACE)?;
    Ok(Mesh { positions: places.iter().map(|p| p.as_vec3()).collect(), ..mesh })
}

/// Returns a mesh around an origin of its own, with its texture as far as these bytes hold it.
///
/// # Errors
///
/// Fails like [`read`], and when the texture is wanted but broken, or is one of several.
pub fn read_with(bytes: &[u8], path: &Path, options: &ReadOptions) -> Result<ReadMesh> {
    let mut out = parse(bytes, path, options)?;
    let places = std::mem::take(&mut out.places);
    // the box of the used vertices: loose ones may be anywhere
    let corners = out.mesh.triangles.iter().flatten().map(|&i| places[i as usize]);
    let (low, high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (center, _, far) = middle(corners.fold((low, high), |(low, high), p| (low.min(p), high.max(p))));
    // rounded as export does, so that exported positions are read back exactly
    let origin = if far { center.as_vec3().as_dvec3() } else { DVec3::ZERO };
    // −0 is kept
    let place = |p: &DVec3| if far { (p - origin).as_vec3() } else { p.as_vec3() };
    out.mesh.positions = places.iter().map(place).collect::<Vec<Vec3>>();
    Ok(ReadMesh { origin, ..out })
}

fn parse(bytes: &[u8], path: &Path, options: &ReadOptions) -> Result<ReadMesh> {
    let source = |format| Source { path, format, options };
    let bytes = without_byte_order_mark(bytes);
    let found = if bytes.starts_with(b"glTF") {
        glb_read::read(bytes, source("GLB"))?
    } else if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
        ply_read::read(bytes, source("PLY"))?
    } else if stl::is_stl(bytes) {
        stl::read(bytes, source("STL"))?
    } else if let Some(named) = refusal(bytes, path) {
        return Err(named);
    } else if looks_like_obj(bytes) {
        obj_read::read(bytes, source("OBJ"))?
    } else {
        let hint = "export it as .glb, .ply or .obj";
        return Err(Error::cannot(format!("`{}` is neither GLB, PLY, OBJ nor STL", path.display()), hint));
    };
    if found.mesh.triangles.is_empty() {
        let what = format!("`{}` holds no triangles", path.display());
        return Err(Error::cannot(what, "export a surface, not points or curves"));
    }
    Ok(found)
}

/// Returns whether some early line starts with a keyword of OBJ.
fn looks_like_obj(bytes: &[u8]) -> bool {
    let start = &bytes[..bytes.len().min(1 << 16)];
    let end = line_end(bytes);
    !start.contains(&0)
        && start.split(|&b| b == end).any(|line| {
            let word = line.trim_ascii().split(|b| b.is_ascii_whitespace()).next().unwrap_or(b"");
            [&b"v"[..], b"f", b"o", b"g", b"vn", b"vt", b"mtllib"].contains(&word)
        })
}
