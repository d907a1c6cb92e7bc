//! The texture of a head mesh, and whether it belongs to its mesh.

use super::faults::wrong_picture;
use crate::Result;
use crate::geom::Atlas;
use crate::image::Photo;
use glam::Mat3;

/// The texture of a mesh: where its triangles lie, and the pictures they lie in.
#[derive(Clone, Debug, PartialEq)]
pub struct HeadTexture {
    /// Where the triangles lie in the pictures.
    pub atlas: Atlas,
    /// Base color, sRGB-coded; its alpha is not written.
    pub color: Photo,
    /// Normals in tangent space: linear, +X along u, +Y up the picture (OpenGL), for the tangents of
    /// [`super::tangents()`]. GLB only.
    pub normal: Option<Photo>,
    /// What depends on the view. GLB only.
    pub lobes: Option<Lobes>,
}

/// View-dependent color of a texture: spherical harmonics of the direction to the viewer.
#[derive(Clone, Debug, PartialEq)]
pub struct Lobes {
    /// One picture a spherical-harmonic function; a byte `b` is `(b − 128) / 127 · scale`.
    pub pictures: Vec<Photo>,
    /// Scale of each, sRGB-coded.
    pub scale: Vec<f32>,
    /// From directions of the dataset's world to those of the exported files.
    pub asset_from_world: Mat3,
}

impl HeadTexture {
    /// Returns a texture of a base color alone.
    pub fn new(atlas: Atlas, color: Photo) -> HeadTexture {
        HeadTexture { atlas, color, normal: None, lobes: None }
    }

    /// The pictures of the lobes, if there are any.
    pub(super) fn lobe_pictures(&self) -> &[Photo] {
        self.lobes.as_ref().map_or(&[], |l| &l.pictures)
    }

    /// Every picture is whole, and of the atlas's shape; its scale is free.
    pub(super) fn check_pictures(&self) -> Result<()> {
        self.check("base color", &self.color)?;
        self.normal.as_ref().map_or(Ok(()), |normal| self.check("normal map", normal))?;
        let mut lobes = self.lobe_pictures().iter().enumerate();
        lobes.try_for_each(|(k, picture)| self.check(&format!("texture `lobe {k}`"), picture))
    }

    fn check(&self, what: &str, picture: &Photo) -> Result<()> {
        let (w, h) = (u64::from(picture.width), u64::from(picture.height));
        if w * h == 0 || w * h != picture.rgb.len() as u64 {
            let found = format!("{} pixels for {w} × {h}", picture.rgb.len());
            return Err(wrong_picture(what, found, "one for each, and at least one"));
        }
        if w * u64::from(self.atlas.height) != h * u64::from(self.atlas.width) {
            let expected = format!("the shape of its atlas, {} × {}", self.atlas.width, self.atlas.height);
            return Err(wrong_picture(what, format!("{w} × {h} pixels"), &expected));
        }
        Ok(())
    }
}
