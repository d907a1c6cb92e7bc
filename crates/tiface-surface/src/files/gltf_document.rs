//! The JSON of a GLB, as far as it is read.

use super::source::Source;
use glam::{DMat4, DQuat, DVec3};
use gltf::json::accessor::{GenericComponentType, Type};
use gltf::json::mesh::{Mode, Semantic};
use gltf::json::validation::Checked;
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;
use std::collections::BTreeMap;
use tiface_base::Result;
use tiface_base::geom::sphharm::COEFFICIENTS_OF_DEGREE_2;

/// Maximum number of objects and arrays. One takes two bytes of JSON and up to 144 in memory, and
/// twice that while a list grows.
const MAX_NESTED: usize = 1 << 20;
/// Maximum number of values. A key with an index takes six bytes of JSON and up to a hundred in
/// memory.
const MAX_VALUES: usize = 4 << 20;

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct GlbRoot {
    pub accessors: Vec<GlbAccessor>,
    pub buffer_views: Vec<GlbView>,
    pub buffers: Vec<GlbBuffer>,
    pub meshes: Vec<GlbMesh>,
    pub nodes: Vec<GlbNode>,
    pub scenes: Vec<GlbScene>,
    pub scene: Option<u32>,
    pub extensions_required: Vec<String>,
    pub materials: Vec<GlbMaterial>,
    pub textures: Vec<GlbTexture>,
    pub images: Vec<GlbImage>,
}

impl GlbRoot {
    /// Parses the document, after bounding the memory that it may take.
    pub fn parse(json: &[u8], source: Source) -> Result<GlbRoot> {
        let at = "the JSON chunk";
        // brackets in strings count too, but a file has few unless it is an attack
        let count = |marks: &[u8]| json.iter().filter(|b| marks.contains(b)).count();
        let (nested, values) = (count(b"{["), count(b"{[,"));
        if nested > MAX_NESTED || values > MAX_VALUES {
            let limit = format!("more than {MAX_NESTED} objects and arrays or {MAX_VALUES} values");
            return Err(source.broken(at, format!("{nested} and {values}, {limit}")));
        }
        serde_json::from_slice(json).map_err(|e| source.broken(at, e))
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct GlbAccessor {
    pub buffer_view: Option<u32>,
    #[serde(default)]
    pub byte_offset: u64,
    pub component_type: Checked<GenericComponentType>,
    pub count: u64,
    #[serde(rename = "type")]
    pub kind: Checked<Type>,
    #[serde(default)]
    pub normalized: bool,
    pub sparse: Option<IgnoredAny>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct GlbView {
    pub buffer: u32,
    #[serde(default)]
    pub byte_offset: u64,
    pub byte_length: u64,
    pub byte_stride: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct GlbBuffer {
    pub byte_length: u64,
    pub uri: Option<IgnoredAny>,
}

#[derive(Deserialize)]
pub(super) struct GlbMesh {
    pub primitives: Vec<GlbPrimitive>,
    /// Weights of morph targets, for nodes that have none of their own.
    #[serde(default)]
    pub weights: Value,
}

#[derive(Deserialize)]
pub(super) struct GlbPrimitive {
    pub attributes: BTreeMap<Checked<Semantic>, u32>,
    pub indices: Option<u32>,
    #[serde(default)]
    pub mode: Checked<Mode>,
    pub material: Option<u32>,
    /// Morph targets.
    pub targets: Option<IgnoredAny>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct GlbNode {
    pub mesh: Option<u32>,
    pub children: Vec<u32>,
    pub matrix: Option<Box<[f64; 16]>>,
    pub translation: Option<[f64; 3]>,
    pub rotation: Option<Box<[f64; 4]>>,
    pub scale: Option<[f64; 3]>,
    pub skin: Option<IgnoredAny>,
    pub weights: Option<Box<Value>>,
    pub extensions: GlbNodeExtensions,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct GlbNodeExtensions {
    #[serde(rename = "EXT_mesh_gpu_instancing")]
    pub instancing: Option<IgnoredAny>,
    #[serde(rename = "KHR_node_visibility")]
    pub visibility: Option<GlbVisibility>,
}

#[derive(Deserialize)]
#[serde(default)]
pub(super) struct GlbVisibility {
    pub visible: bool,
}

impl Default for GlbVisibility {
    fn default() -> GlbVisibility {
        GlbVisibility { visible: true }
    }
}

impl GlbNode {
    /// Returns whether the node hides itself and the nodes below it.
    pub fn is_hidden(&self) -> bool {
        self.extensions.visibility.as_ref().is_some_and(|v| !v.visible)
    }

    /// Features that move the triangles of a mesh away from their accessors and the nodes'
    /// transforms.
    pub fn deformation(&self, mesh: &GlbMesh) -> Option<&'static str> {
        let weights = self.weights.as_deref().unwrap_or(&mesh.weights);
        let is_morphed = mesh.primitives.iter().any(|p| p.targets.is_some())
            && weights.as_array().into_iter().flatten().any(|w| w.as_f64().is_some_and(|w| w != 0.0));
        let found = [
            (self.skin.is_some(), "a skin"),
            (is_morphed, "a morph target whose weight is not 0"),
            (self.extensions.instancing.is_some(), "`EXT_mesh_gpu_instancing`"),
        ];
        found.into_iter().find_map(|(is_there, name)| is_there.then_some(name))
    }

    /// Returns the transform from the node's coordinates to its parent's.
    pub fn parent_from_node(&self) -> DMat4 {
        if let Some(matrix) = &self.matrix {
            return DMat4::from_cols_array(matrix);
        }
        let q = self.rotation.as_deref().map_or(DQuat::IDENTITY, |q| DQuat::from_array(*q));
        let q = if q.length() > 0.0 { q / q.length() } else { DQuat::IDENTITY };
        DMat4::from_scale_rotation_translation(
            self.scale.map_or(DVec3::ONE, DVec3::from),
            q,
            self.translation.map_or(DVec3::ZERO, DVec3::from),
        )
    }
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct GlbScene {
    pub nodes: Vec<u32>,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct GlbMaterial {
    pub pbr_metallic_roughness: GlbPbr,
    pub emissive_texture: Option<Box<GlbTextureUse>>,
    /// Any JSON value, as in [`GlbPbr`].
    pub emissive_factor: Box<Value>,
    pub extensions: GlbMaterialExtensions,
    pub extras: Value,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct GlbMaterialExtensions {
    #[serde(rename = "KHR_materials_pbrSpecularGlossiness")]
    pub specular: Option<Box<GlbSpecular>>,
}

/// The older model of materials, which Sketchfab wrote.
#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct GlbSpecular {
    pub diffuse_texture: Option<GlbTextureUse>,
    pub diffuse_factor: Value,
}

/// Lobes of a material: the texture and the scale of each.
#[derive(Clone, PartialEq)]
pub(super) struct GlbLobes {
    pub textures: Vec<u32>,
    pub scale: Vec<f32>,
}

/// The color of a material: its texture, its linear factors if they are not all 1, and a sentence
/// if it is no base color.
#[derive(Clone, Copy, Default)]
pub(super) struct GlbColor<'a> {
    pub texture: Option<&'a GlbTextureUse>,
    pub tint: Option<[f32; 3]>,
    pub note: Option<&'static str>,
}

impl GlbMaterial {
    /// Returns whether the material is marked as one of the soft layers around a mesh.
    pub fn is_soft_layer(&self) -> bool {
        self.extras["tiface"]["soft_layers"].is_u64()
    }

    /// Returns the lobes beside the base color, if the material is marked as one of ours with some.
    pub fn lobes(&self) -> Option<GlbLobes> {
        let notes = &self.extras["tiface"];
        let texture = |lobe: &Value| u32::try_from(lobe["texture"].as_u64()?).ok();
        let number = |v: &Value| v.as_f64().map(|v| v as f32).filter(|v| v.is_finite());
        let textures: Option<Vec<u32>> = notes["lobes"].as_array()?.iter().map(texture).collect();
        let scale: Option<Vec<f32>> =
            notes["view_dependent_color"]["scale"].as_array()?.iter().map(number).collect();
        let found = GlbLobes { textures: textures?, scale: scale? };
        let fits = found.textures.len() == found.scale.len()
            && (1..=COEFFICIENTS_OF_DEGREE_2).contains(&found.scale.len());
        fits.then_some(found)
    }

    /// Returns the color that shows most: the base color, that of the older model, or light that
    /// the material emits.
    pub fn color(&self) -> GlbColor<'_> {
        let pbr = &self.pbr_metallic_roughness;
        let base = factors(&pbr.base_color_factor);
        let tint = |factors: Option<[f32; 3]>| factors.filter(|f| *f != [1.0; 3]);
        if pbr.base_color_texture.is_some() {
            return GlbColor { texture: pbr.base_color_texture.as_ref(), tint: tint(base), note: None };
        }
        if let Some(specular) = &self.extensions.specular
            && (specular.diffuse_texture.is_some() || base.is_none())
        {
            let note = Some("the diffuse color of `KHR_materials_pbrSpecularGlossiness` is shown");
            let tint = tint(factors(&specular.diffuse_factor));
            return GlbColor { texture: specular.diffuse_texture.as_ref(), tint, note };
        }
        let is_dark = base.is_none_or(|f| f == [0.0; 3]);
        let texture = self.emissive_texture.as_deref();
        // a picture without a factor is black by the letter of glTF, which nobody meant
        let default = texture.filter(|_| self.emissive_factor.is_null()).map(|_| [1.0; 3]);
        let light = factors(&self.emissive_factor).or(default).filter(|f| is_dark && *f != [0.0; 3]);
        match light {
            Some(light) if texture.is_some() || base.is_some() => {
                let note = Some("there is no base color; the light that the material emits is shown");
                GlbColor { texture, tint: tint(Some(light)), note }
            }
            _ => GlbColor { texture: None, tint: tint(base), note: None },
        }
    }
}

/// Returns linear red, green and blue, if a value is a list of them.
fn factors(value: &Value) -> Option<[f32; 3]> {
    let [r, g, b] = [0, 1, 2].map(|k| value[k].as_f64().map(|v| v as f32));
    Some([r?, g?, b?]).filter(|all| all.iter().all(|v| v.is_finite()))
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct GlbPbr {
    pub base_color_texture: Option<GlbTextureUse>,
    /// Factors of colors and texture; any JSON value.
    pub base_color_factor: Value,
}

/// A material's reference to a texture.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct GlbTextureUse {
    pub index: u32,
    #[serde(default)]
    pub tex_coord: u32,
    #[serde(default)]
    pub extensions: GlbTextureExtensions,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct GlbTextureExtensions {
    #[serde(rename = "KHR_texture_transform")]
    pub transform: Option<Box<GlbTransform>>,
}

/// Where a texture's part of a picture lies.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct GlbTransform {
    pub offset: [f64; 2],
    pub scale: [f64; 2],
    pub rotation: f64,
    pub tex_coord: Option<u32>,
}

impl Default for GlbTransform {
    fn default() -> GlbTransform {
        GlbTransform { offset: [0.0; 2], scale: [1.0; 2], rotation: 0.0, tex_coord: None }
    }
}

impl GlbTextureUse {
    /// Returns the set of texture coordinates that it takes.
    pub fn set(&self) -> u32 {
        let other = self.extensions.transform.as_ref().and_then(|transform| transform.tex_coord);
        other.unwrap_or(self.tex_coord)
    }

    /// Returns a texture coordinate, scaled and moved as it says.
    pub fn placed(&self, uv: [f64; 2]) -> [f64; 2] {
        match &self.extensions.transform {
            None => uv,
            Some(to) => [0, 1].map(|k| to.offset[k] + to.scale[k] * uv[k]),
        }
    }
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct GlbTexture {
    pub source: Option<u32>,
    pub extensions: GlbPictureFormats,
}

/// Pictures in formats that are not read.
#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct GlbPictureFormats {
    #[serde(rename = "KHR_texture_basisu")]
    basisu: Option<IgnoredAny>,
    #[serde(rename = "EXT_texture_webp")]
    webp: Option<IgnoredAny>,
    #[serde(rename = "EXT_texture_avif")]
    avif: Option<IgnoredAny>,
}

impl GlbPictureFormats {
    /// Returns the name of a format that takes the place of PNG or JPEG.
    pub fn name(&self) -> Option<&'static str> {
        let all = [
            (&self.basisu, "KTX2 (`KHR_texture_basisu`)"),
            (&self.webp, "WebP (`EXT_texture_webp`)"),
            (&self.avif, "AVIF (`EXT_texture_avif`)"),
        ];
        all.into_iter().find_map(|(found, name)| found.as_ref().map(|_| name))
    }
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct GlbImage {
    pub buffer_view: Option<u32>,
    pub uri: Option<String>,
}

/// Tests node transforms; reading is tested in `tests/check/hostile_mesh.rs`.
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn translation_rotation_and_scale_apply_in_gltf_order() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let node = GlbNode {
            translation: Some([10.0, 0.0, 0.0]),
            rotation: Some(Box::new([0.0, 0.0, half, half])), // a quarter turn about z: x → y
            scale: Some([2.0, 1.0, 1.0]),
            ..GlbNode::default()
        };
        // (1, 0, 0) → scaled (2, 0, 0) → turned (0, 2, 0) → moved (10, 2, 0)
        let p = node.parent_from_node().transform_point3(DVec3::X);
        assert!(p.distance(DVec3::new(10.0, 2.0, 0.0)) < 1e-12);
        assert_eq!(GlbNode::default().parent_from_node(), DMat4::IDENTITY);
    }

    #[test]
    fn a_full_document_takes_a_few_hundred_megabytes() {
        let largest = [
            size_of::<GlbAccessor>(),
            size_of::<GlbView>(),
            size_of::<GlbMesh>(),
            size_of::<GlbPrimitive>(),
            size_of::<GlbNode>(),
            size_of::<GlbMaterial>(),
        ];
        assert!(largest.iter().all(|&size| size <= 144), "{largest:?}");
    }
}
