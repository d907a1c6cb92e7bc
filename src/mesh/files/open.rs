//! A mesh file with the pictures of its texture, wherever they lie.

use super::head::HeadMesh;
use super::obj_read::picture_of_mtl;
use super::read::{ReadMesh, read_with};
use super::source::{PictureSource, ReadOptions};
use super::texture::HeadTexture;
use crate::Result;
use crate::geom::{Atlas, Similarity};
use crate::image::Photo;
use crate::io::{self, Limits};
use std::path::{Path, PathBuf};

/// What a mesh file holds.
#[derive(Debug)]
pub struct OpenedMesh {
    /// The mesh with its texture; the file's coordinates are taken for the world.
    pub head: HeadMesh,
    /// Where the triangles would lie in a texture that is not there.
    pub bare_atlas: Option<Atlas>,
    /// What cannot be shown.
    pub warnings: Vec<String>,
}

/// The picture that lies beside a mesh file; `None` where the file names none, or has it inside.
///
/// # Errors
///
/// The material file that should name it cannot be read.
pub fn picture_beside(picture: Option<&PictureSource>, path: &Path) -> Result<Option<PathBuf>> {
    let name = match picture {
        Some(PictureSource::Beside(name)) => Some(name.clone()),
        Some(PictureSource::Material(mtl)) => {
            let mtl = path.with_file_name(mtl);
            picture_of_mtl(&io::read_bytes(&mtl, &Limits::default())?, &mtl)?
        }
        Some(PictureSource::Inside(_)) | None => None,
    };
    Ok(name.map(|name| path.with_file_name(name)))
}

/// Opens a `.glb`, `.obj` or `.ply` file with its texture, and says what of it cannot be shown.
///
/// # Errors
///
/// The surface itself cannot be read.
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
    let ReadMesh { mesh, origin, atlas, picture } = found;
    let photo = open_picture(picture.as_ref(), path).unwrap_or_else(|e| {
        warnings.push(format!("{e}; shown without its texture"));
        None
    });
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

fn open_picture(picture: Option<&PictureSource>, path: &Path) -> Result<Option<Photo>> {
    let limits = Limits::default();
    if let Some(PictureSource::Inside(bytes)) = picture {
        return Ok(Some(io::parse_photo(bytes, path, &limits)?));
    }
    let beside = picture_beside(picture, path)?;
    Ok(beside.map(|file| io::read_photo(&file, None, &limits)).transpose()?)
}
