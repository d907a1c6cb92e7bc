//! Reading of meshes from files of other programs: GLB, PLY and OBJ, from bytes.
//!
//! [`read`] returns the surface, [`read_with`] also its texture. The format is detected from the bytes, not from the
//! name. Every count is compared with the remaining bytes before any allocation, no other file is opened, and
//! non-finite numbers are refused.
//!
//! Positions are read in f64. Those of a mesh far from the origin, where f32 steps over its triangles, come around
//! an origin of their own, see [`ReadMesh::origin`].

use super::file_mesh::{HeadTexture, middle};
use super::obj::{self, picture_of_mtl};
use super::source::{PictureSource, ReadMesh, ReadOptions, Source};
use super::stored::HeadMesh;
use super::{glb_read, ply};
use crate::geom::{Atlas, Mesh, Similarity};
use crate::image::{Photo, linear_from_srgb, quantize, srgb_from_linear};
use crate::io::{self, Limits};
use crate::{Error, Result};
use glam::{DVec3, Vec3};
use std::path::{Path, PathBuf};

/// Returns the mesh in the bytes of a `.glb`, `.ply` or `.obj` file, in the file's own coordinates, rounded to f32:
/// for a mesh far from the origin see [`read_with`].
///
/// `path` is for messages only. Colors come back sRGB-coded; normals only when every vertex has
/// one. Polygons are fanned. Nothing is welded or repaired. Textures are passed over, sound or not.
///
/// # Errors
///
/// Fails if the bytes are none of these formats, break its rules, use unsupported features, hold no triangles, or
/// more than the limits of [`ReadOptions`].
pub fn read(bytes: &[u8], path: &Path) -> Result<Mesh> {
    let ReadMesh { places, mesh, .. } = parse(bytes, path, &ReadOptions::SURFACE)?;
    Ok(Mesh { positions: places.iter().map(|p| p.as_vec3()).collect(), ..mesh })
}

/// Returns a mesh around an origin of its own, with its texture as far as these bytes hold it.
///
/// # Errors
///
/// Fails like [`read`], and when the texture is wanted but broken, lies outside the file and its folder, or is one
/// of several.
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
    let found = if bytes.starts_with(b"glTF") {
        glb_read::read(bytes, source("GLB"))?
    } else if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
        ply::read(bytes, source("PLY"))?
    } else if looks_like_obj(bytes) {
        obj::read(bytes, source("OBJ"))?
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

/// Returns whether some early line starts with a keyword of OBJ.
fn looks_like_obj(bytes: &[u8]) -> bool {
    let start = &bytes[..bytes.len().min(1 << 16)];
    !start.contains(&0)
        && start.split(|&b| b == b'\n').any(|line| {
            let word = line.trim_ascii().split(|b| b.is_ascii_whitespace()).next().unwrap_or(b"");
            [&b"v"[..], b"f", b"o", b"g", b"vn", b"vt", b"mtllib"].contains(&word)
        })
}

/// The content of a mesh file.
#[derive(Debug)]
pub struct OpenedMesh {
    /// The mesh with its texture; the file's coordinates are taken for the world.
    pub head: HeadMesh,
    /// The texture coordinates of a missing texture.
    pub bare_atlas: Option<Atlas>,
    /// Features that cannot be shown.
    pub warnings: Vec<String>,
}

/// Returns the picture beside a mesh file; `None` if the file names none, or contains it.
///
/// # Errors
///
/// Fails if the material file that should name it cannot be read.
pub fn picture_beside(picture: Option<&PictureSource>, path: &Path) -> Result<Option<PathBuf>> {
    let name = match picture {
        Some(PictureSource::Beside(name)) => Some(name.clone()),
        Some(PictureSource::Material(mtl)) => {
            let mtl = path.with_file_name(mtl);
            picture_of_mtl(&io::read_maybe_empty(&mtl, &Limits::default())?, &mtl)?
        }
        Some(PictureSource::Inside(_)) | None => None,
    };
    Ok(name.map(|name| path.with_file_name(name)))
}

/// Opens a `.glb`, `.obj` or `.ply` file with its texture, and returns the features that cannot be shown.
///
/// # Errors
///
/// Fails if the surface itself cannot be read.
pub fn open_mesh(path: &Path) -> Result<OpenedMesh> {
    let bytes = io::read_bytes(path, &Limits::default())?;
    let mut warnings = Vec::new();
    let found = match read_with(&bytes, path, &ReadOptions::default()) {
        Ok(found) => found,
        Err(e) => {
            let found = read_with(&bytes, path, &ReadOptions::SURFACE)?;
            warnings.push(format!("{e}; shown without its texture"));
            found
        }
    };
    let ReadMesh { mesh, origin, atlas, picture, tint, .. } = found;
    let mut photo = open_picture(picture.as_ref(), path).unwrap_or_else(|e| {
        warnings.push(format!("{e}; shown without its texture"));
        None
    });
    if let (Some(photo), Some(tint)) = (&mut photo, tint) {
        multiply(photo, tint);
    }
    let (texture, bare_atlas) = match (atlas, photo) {
        (Some(atlas), Some(color)) => {
            let (width, height) = (color.width, color.height);
            (Some(HeadTexture::new(Atlas { width, height, ..atlas }, color)), None)
        }
        (None, Some(_)) => {
            let what = "has a texture, but does not say where in it all of its triangles lie";
            warnings.push(format!("`{}` {what}", path.display()));
            (None, None)
        }
        (atlas, None) => (None, atlas),
    };
    let world_from_scene = Similarity { translation: origin, ..Similarity::IDENTITY };
    Ok(OpenedMesh {
        head: HeadMesh { mesh, world_from_scene, texture, harmonics: None, shells: None },
        bare_atlas,
        warnings,
    })
}

/// Multiplies the linear light of a picture.
fn multiply(photo: &mut Photo, tint: [f32; 3]) {
    let coded = |byte: u8, factor: f32| {
        quantize(srgb_from_linear(linear_from_srgb(f32::from(byte) / 255.0) * factor))
    };
    for (channel, factor) in tint.into_iter().enumerate() {
        let table: [u8; 256] = std::array::from_fn(|byte| coded(byte as u8, factor));
        photo.rgb.iter_mut().for_each(|c| c[channel] = table[usize::from(c[channel])]);
    }
}

fn open_picture(picture: Option<&PictureSource>, path: &Path) -> Result<Option<Photo>> {
    let limits = Limits::default();
    if let Some(PictureSource::Inside(bytes)) = picture {
        return Ok(Some(io::parse_photo(bytes, path, &limits)?));
    }
    let beside = picture_beside(picture, path)?;
    Ok(beside.map(|file| io::read_photo(&file, None, &limits)).transpose()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tint_multiplies_light() {
        let mut photo = Photo { width: 2, height: 1, rgb: vec![[255; 3], [188, 9, 0]], alpha: None };
        multiply(&mut photo, [0.5, 1.0, 0.0]);
        // linear 0.5 is 188, linear 0.25 is 137
        assert_eq!(photo.rgb, [[188, 255, 0], [137, 9, 0]]);
    }
}
