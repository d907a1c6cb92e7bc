//! `[mesh]`: the extracted surface.

use super::{Key, Preset};
use serde::{Deserialize, Serialize};

/// A mesh file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MeshFormat {
    /// glTF 2.0 binary.
    Glb,
    /// Wavefront.
    Obj,
    /// Stanford, binary.
    Ply,
}

/// The coordinates a mesh is exported in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MeshFrame {
    /// The dataset's own world, turned to +Y up where the format demands it.
    Dataset,
    /// +Y up through the crown, face towards +Z, origin at the centre of the box.
    Head,
}

/// Whose view of a texel is its colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TextureView {
    /// The mean over the training cameras that see it.
    Cameras,
    /// One that looks straight at the surface.
    Normal,
}

/// How a texture is stored inside or beside a mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TextureFormat {
    /// Lossless.
    Png,
    /// Smaller, quality 92.
    Jpeg,
}

/// How the surface is extracted and exported.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeshConfig {
    /// Samples along the longest side of the box.
    pub resolution: u32,
    /// Components with less than this share of the largest one's area are dropped.
    pub keep_share: f64,
    /// Every how many cells the field is asked first.
    pub coarse_step: u32,
    /// Newton steps that pull vertices onto the zero level.
    pub newton_steps: u32,
    /// How far vertices slide towards the middle of their neighbours with the first step.
    pub relax: f32,
    /// Also evaluate the whole grid and report what the sparse extraction lost.
    pub verify: bool,
    /// Close the surface where the frames cut the body; else it stays open there.
    pub cap: bool,
    /// Triangles of the product; 0 keeps all of the extraction.
    pub triangles: u32,
    /// Largest distance of the product from the field's surface, in cells of the extraction: simplification
    /// stops before it; 0 sets no limit.
    pub max_error: f32,
    /// Texels along each side of the texture; 0 leaves colours at the vertices.
    pub texture_px: u32,
    /// Samples along each side of a texel.
    pub texture_samples: u32,
    /// Texels that repeat a chart's border around it; charts lie twice as far apart.
    pub gutter_px: u32,
    /// Whose view of a texel is its colour.
    pub texture_view: TextureView,
    /// Degree of the view-dependent lobes in the GLB, 1 or 2; 0 for none.
    pub lobes: u32,
    /// A tangent-space map of the field's normals in the GLB.
    pub normal_map: bool,
    /// How pictures are stored in GLB and beside OBJ.
    pub texture_format: TextureFormat,
    /// Also keep the baked colour as `head.exr`, scene-linear.
    pub exr: bool,
    /// 16-bit coordinates in the GLB (`KHR_mesh_quantization`): half the size, but trimesh and open3d misread it.
    pub quantize: bool,
    /// Files to write.
    pub format: Vec<MeshFormat>,
    /// Coordinates to write them in.
    pub frame: MeshFrame,
}

pub(super) const KEYS: &[Key] = &[
    Key::number("resolution", "Samples along the longest side of the box.", 16.0, 4096.0),
    Key::number(
        "keep_share",
        "Components with less than this share of the largest are dropped; 1 keeps only the largest.",
        0.0,
        1.0,
    ),
    Key::number(
        "newton_steps",
        "Newton steps that pull vertices onto the zero level of the field.",
        0.0,
        8.0,
    ),
    Key::number(
        "coarse_step",
        "Every how many cells the field is asked first: 2, 4 or 8; smaller finds smaller loose pieces.",
        2.0,
        8.0,
    ),
    Key::number(
        "relax",
        "How far vertices slide towards the middle of their neighbours with the first step.",
        0.0,
        1.0,
    ),
    Key::word("verify", "Also evaluate the whole grid and report what the sparse extraction lost: slow."),
    Key::word("cap", "Close the surface where the frames cut the body: true or false."),
    Key::number("triangles", "Triangles of the product; 0 keeps all of the extraction.", 0.0, 1e8),
    Key::number(
        "max_error",
        "Largest distance of the product from the field's surface, in cells; 0 sets no limit.",
        0.0,
        100.0,
    ),
    Key::number(
        "texture_px",
        "Texels along each side of the texture; 0: colours at the vertices.",
        0.0,
        16384.0,
    ),
    Key::number("texture_samples", "Samples along each side of a texel.", 1.0, 8.0),
    Key::number("gutter_px", "Texels that repeat a chart's border around it.", 0.0, 256.0),
    Key::word(
        "texture_view",
        "Whose view of a texel is its colour: cameras (the mean of those that see it) or normal (straight at it).",
    ),
    Key::number("lobes", "Degree of view-dependent lobes in the GLB: 0 (none), 1 or 2.", 0.0, 2.0),
    Key::word("normal_map", "A tangent-space map of the field's normals in the GLB: true or false."),
    Key::word("texture_format", "How pictures are stored with the mesh: png or jpeg."),
    Key::word("exr", "Also keep the baked colour as head.exr, scene-linear: true or false."),
    Key::word("quantize", "16-bit coordinates in the GLB: half the size, misread by trimesh and open3d."),
    Key::word("format", "Files to write, a list of glb, obj, ply."),
    Key::word("frame", "Coordinates of the files: dataset, or head (+Y up, face towards +Z, centred)."),
];

impl MeshConfig {
    /// Texels of a picture; 0 without a texture.
    pub fn texels(&self) -> u64 {
        u64::from(self.texture_px).pow(2)
    }

    /// Pictures of a texture: colour, normals, lobes.
    pub fn pictures(&self) -> u64 {
        let lobes = if self.lobes == 0 { 0 } else { (u64::from(self.lobes) + 1).pow(2) };
        1 + u64::from(self.normal_map) + lobes
    }

    /// What the ranges of single keys cannot say: a key, its problem, and the way out.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let px = self.texture_px;
        if px == 0 {
            let asked = [
                (self.lobes > 0, "mesh.lobes"),
                (self.normal_map, "mesh.normal_map"),
                (self.exr, "mesh.exr"),
            ];
            return asked.iter().find(|(on, _)| *on).map(|(_, key)| {
                let problem = "asks for a picture, but `mesh.texture_px` is 0".to_owned();
                (*key, problem, "set `mesh.texture_px`, to 2048 for example")
            });
        }
        if px < 64 || self.gutter_px > px / 8 {
            let problem = format!("is {px}: no room for a gutter of {} texels", self.gutter_px);
            let hint = "it must be 0, or at least 64 and eight times `mesh.gutter_px`";
            return Some(("mesh.texture_px", problem, hint));
        }
        if self.lobes > 0 && self.texture_view == TextureView::Normal {
            let problem = "needs the views of cameras, but `mesh.texture_view` is normal".to_owned();
            return Some(("mesh.lobes", problem, "set `mesh.texture_view` to cameras"));
        }
        // held as floats while they are baked
        let pictures = self.pictures();
        let gib = (self.texels() * 21 * pictures) >> 30;
        (gib > 16).then(|| {
            let problem = format!("is {px}: {pictures} pictures of that size take {gib} GiB to bake");
            ("mesh.texture_px", problem, "lower it, or `mesh.lobes`")
        })
    }

    /// The values a preset starts with.
    pub fn preset(preset: Preset) -> MeshConfig {
        MeshConfig {
            resolution: if preset == Preset::Draft { 256 } else { 512 },
            keep_share: 1.0,
            coarse_step: 8,
            newton_steps: 2,
            relax: 0.5,
            verify: false,
            cap: true,
            triangles: 50_000,
            max_error: 0.0,
            texture_px: if preset == Preset::Draft { 1024 } else { 2048 },
            texture_samples: 2,
            gutter_px: 8,
            texture_view: TextureView::Cameras,
            lobes: 0,
            normal_map: false,
            texture_format: TextureFormat::Png,
            exr: false,
            quantize: false,
            format: vec![MeshFormat::Glb],
            frame: MeshFrame::Dataset,
        }
    }
}
