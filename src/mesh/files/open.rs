//! A mesh file with the pictures of its texture, wherever they lie.

use super::head::HeadMesh;
use super::obj_read::picture_of_mtl;
use super::read::{ReadMesh, read_with};
use super::source::{PictureSource, ReadOptions};
use super::texture::HeadTexture;
use crate::Result;
use crate::geom::{Atlas, Similarity};
use crate::image::{Photo, linear_from_srgb, quantize, srgb_from_linear};
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
            picture_of_mtl(&io::read_maybe_empty(&mtl, &Limits::default())?, &mtl)?
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
    let ReadMesh { mesh, origin, atlas, picture, tint } = found;
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

/// Multiplies the light of a picture.
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
