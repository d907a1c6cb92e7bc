//! The parts of a GLB's JSON that are read: the surface, its nodes' transforms, and its base color.
//!
//! No other part of the file can cause an error, and numbers are f64: a node may lie kilometres from the origin,
//! where `gltf-json`'s f32 has steps of half a metre.

use super::source::Source;
use crate::Result;
use glam::{DMat4, DQuat, DVec3};
use gltf::json::accessor::{GenericComponentType, Type};
use gltf::json::mesh::{Mode, Semantic};
use gltf::json::validation::Checked;
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;
use std::collections::BTreeMap;

/// Most objects and arrays. One takes two bytes of JSON and up to 144 in memory, and twice that while a list grows.
const MOST_NESTED: usize = 1 << 20;
/// Most values. A key with an index takes six bytes of JSON and up to a hundred in memory.
const MOST_VALUES: usize = 4 << 20;

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
        if nested > MOST_NESTED || values > MOST_VALUES {
            let most = format!("more than {MOST_NESTED} objects and arrays or {MOST_VALUES} values");
            return Err(source.broken(at, format!("{nested} and {values}, {most}")));
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
    matrix: Option<Box<[f64; 16]>>,
    translation: Option<[f64; 3]>,
    rotation: Option<Box<[f64; 4]>>,
    scale: Option<[f64; 3]>,
    skin: Option<IgnoredAny>,
    weights: Option<Box<Value>>,
    extensions: GlbNodeExtensions,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct GlbNodeExtensions {
    #[serde(rename = "EXT_mesh_gpu_instancing")]
    instancing: Option<IgnoredAny>,
}

impl GlbNode {
    /// Features that move the triangles of a mesh away from their accessors and the nodes' transforms.
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
    pub extras: Value,
}

impl GlbMaterial {
    /// Whether the material says that it belongs to the soft layers around a mesh.
    pub fn is_soft_layer(&self) -> bool {
        self.extras["tiface"]["soft_layers"].is_u64()
    }
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct GlbPbr {
    pub base_color_texture: Option<GlbTextureUse>,
    /// Factors of colors and texture, whatever the JSON contains.
    pub base_color_factor: Value,
}

impl GlbPbr {
    /// Returns the linear red, green and blue factors of colors, if they are not all 1.
    pub fn tint(&self) -> Option<[f32; 3]> {
        let [r, g, b] = [0, 1, 2].map(|k| self.base_color_factor[k].as_f64().map(|v| v as f32));
        let tint = [r?, g?, b?];
        (tint.iter().all(|v| v.is_finite()) && tint != [1.0; 3]).then_some(tint)
    }
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
    pub transform: Option<IgnoredAny>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
pub(super) struct GlbTexture {
    pub source: Option<u32>,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
pub(super) struct GlbImage {
    pub buffer_view: Option<u32>,
    pub uri: Option<IgnoredAny>,
}

/// Tests node transforms; reading is tested in `tests/hostile_mesh.rs`.
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
