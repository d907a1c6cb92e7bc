//! The texture of a GLB: from a primitive's material to the bytes of a picture in the file.

use super::glb_read::{Document, Root};
use super::read::{ReadMeshError, Texture};
use crate::geom::Atlas;
use crate::io;
use serde::Deserialize;
use serde::de::IgnoredAny;
use std::collections::HashMap;

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct Material {
    pbr_metallic_roughness: Pbr,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
struct Pbr {
    base_color_texture: Option<Info>,
}

/// A texture as a material names it.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Info {
    pub index: usize,
    #[serde(default)]
    pub tex_coord: u32,
    #[serde(default)]
    extensions: HashMap<String, IgnoredAny>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct TextureEntry {
    source: Option<usize>,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct ImageEntry {
    buffer_view: Option<usize>,
    uri: Option<IgnoredAny>,
}

impl<'a> Document<'a> {
    /// The base colour texture of a material, if it has one.
    pub(super) fn base_color(
        &self,
        at: &str,
        material: Option<usize>,
    ) -> Result<Option<&'a Info>, ReadMeshError> {
        let Some(index) = material else { return Ok(None) };
        let materials = &self.root.materials;
        let material = materials.get(index).ok_or_else(|| {
            self.source.broken(at, format!("names material {index}, but there are only {}", materials.len()))
        })?;
        let info = material.pbr_metallic_roughness.base_color_texture.as_ref();
        if info.is_some_and(|i| i.extensions.contains_key("KHR_texture_transform")) {
            return Err(self.source.unsupported(format!("material {index}"), "`KHR_texture_transform`"));
        }
        Ok(info)
    }

    /// The picture behind a texture, and its size in the atlas. Its header is checked against the
    /// limits for pictures; it is not decoded.
    pub(super) fn picture(
        &self,
        texture: usize,
        atlas: Option<&mut Atlas>,
    ) -> Result<Texture, ReadMeshError> {
        let Root { textures, images, .. } = self.root;
        let source = self.source;
        let at = format!("texture {texture}");
        let entry = textures
            .get(texture)
            .ok_or_else(|| source.broken(&at, format!("is named, but there are only {}", textures.len())))?;
        let index = entry
            .source
            .ok_or_else(|| source.unsupported(&at, "a texture without a PNG or JPEG of its own"))?;
        let at = format!("image {index}");
        let image = images
            .get(index)
            .ok_or_else(|| source.broken(&at, format!("is named, but there are only {}", images.len())))?;
        if image.uri.is_some() {
            return Err(source.unsupported(at, "a picture outside the file"));
        }
        let view = image.buffer_view.ok_or_else(|| source.broken(&at, "has no buffer view"))?;
        let bytes = self.view(view)?;
        let info = io::parse_picture_info(bytes, source.path, &io::Limits::default())
            .map_err(|e| source.broken(&at, e.to_string()))?;
        if let Some(atlas) = atlas {
            (atlas.width, atlas.height) = (info.width, info.height);
        }
        Ok(Texture::Inside(bytes.to_vec()))
    }
}
