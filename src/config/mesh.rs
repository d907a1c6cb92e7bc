//! `[mesh]`: the extracted surface.

use super::key;
use super::table::table;
use serde::{Deserialize, Serialize};
use std::str::FromStr;
use tiface_base::{Error, Result};
use tiface_surface::files::LOBE_TEXEL;

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
    /// Universal Scene Description, a zip.
    Usdz,
}

impl MeshFormat {
    /// All formats.
    pub const ALL: [MeshFormat; 4] = [MeshFormat::Glb, MeshFormat::Obj, MeshFormat::Ply, MeshFormat::Usdz];

    /// Its word, which is the ending of its files.
    pub fn as_str(self) -> &'static str {
        match self {
            MeshFormat::Glb => "glb",
            MeshFormat::Obj => "obj",
            MeshFormat::Ply => "ply",
            MeshFormat::Usdz => "usdz",
        }
    }
}

impl FromStr for MeshFormat {
    type Err = Error;

    fn from_str(word: &str) -> Result<MeshFormat> {
        MeshFormat::ALL.into_iter().find(|format| format.as_str() == word).ok_or_else(|| {
            Error::usage(format!("there is no mesh format `{word}`"), "use glb, obj, ply or usdz")
        })
    }
}

/// What becomes of handles: loops of hair, holes between locks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Genus {
    /// They stay.
    Keep,
    /// Small ones are cut or filled.
    Simple,
}

/// Where the colors of the mesh come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ColorSource {
    /// Fitted to the photographs; the network's where no photograph shows the surface.
    Photographs,
    /// The color network's (published).
    Network,
}

/// What is around the mesh where the head is softer than a surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Hair {
    /// Translucent layers, where photographs that were left out look better with them.
    Shells,
    /// Nothing.
    None,
}

/// Views that hair is fitted to besides the photographs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum HairViews {
    /// T-Face's where its stage is made anyway.
    Auto,
    /// T-Face's, from between the cameras.
    Tface,
    /// None.
    None,
}

table! {
    /// How the surface is extracted and becomes the head mesh.
    pub struct MeshConfig;
    keys {
        /// Grid samples along the longest side of the box.
        resolution: u32, 16.0..=4096.0 [Surface] => 256, 512, 512;
        /// Topological handles, such as loops of hair: keep, or simple (cut or filled, up to a loop
        /// of 0.15 of the surface's longest side, about 45 mm on a head).
        genus: Genus [Surface] => Genus::Simple, Genus::Simple, Genus::Keep;
        /// Close the surface where the frames cut the body: true or false.
        #[flag("no-cap", Switch("false"), ["mesh"], "Leave the mesh open where the frames cut the body")]
        cap: bool [Surface] => true, true, false;
        /// Number of triangles after simplification; 0 keeps all.
        #[flag("triangles", Text("N"), ["mesh"])]
        triangles: u32, 0.0..=1e8 [Head] => 50_000, 50_000, 0;
        /// Largest distance of the simplified mesh from the field's surface, cells; 0: no limit.
        max_error: f32, 0.0..=100.0 [Head] => 0.0;
        /// Source of the colors: photographs (fitted to them) or network (published).
        color: ColorSource [Surface]
            => ColorSource::Photographs, ColorSource::Photographs, ColorSource::Network;
        /// Side of the texture, texels; 0: colors at the vertices.
        #[flag("texture", Text("PX"), ["mesh"],
            "Side of the texture, texels; 0 stores colors at the vertices")]
        texture_px: u32, 0.0..=16384.0 [Head] => 1024, 2048, 0;
        /// Degree of the view-dependent spherical harmonics in the GLB: 0 (none), 1 or 2; limits
        /// all views of the mesh. Fewer if photographs do not support as many; none without a
        /// texture.
        #[flag("lobes", Text("DEGREE"), ["mesh"],
            "Degree of the view-dependent spherical harmonics in the GLB: 0, 1 or 2")]
        lobes: u32, 0.0..=2.0 [Head] => 2, 2, 0;
        /// Hair and other soft outlines: shells (translucent layers in the GLB, where they help) or
        /// none. raycast renders them with `mesh.color=photographs`.
        #[flag("hair", Text("KIND"), ["mesh"],
            "Hair and other soft outlines: shells (translucent layers, where they help) or none")]
        hair: Hair [Head] => Hair::Shells, Hair::Shells, Hair::None;
        /// Views that soft layers and their colors are fitted to besides the photographs: tface
        /// (T-Face's from between the cameras; it is trained before the mesh is made), none, or
        /// auto (tface where the same command needs T-Face anyway, as `tiface run` does; a mesh
        /// that is there keeps its own). Views of T-Face take a third of the time of the stage
        /// `mesh`, which preset quick saves.
        #[flag("hair-views", Text("KIND"), ["mesh"],
            "Views that hair is fitted to besides the photographs: tface (T-Face is trained first), none, or \
             auto (tface where the command needs it anyway; an existing mesh keeps its own); none in preset quick")]
        hair_views: HairViews [Head if |c| c.mesh.uses_tface()]
            => HairViews::Auto, HairViews::Auto, HairViews::Auto, HairViews::None;
        /// Write a tangent-space map of the unsimplified normals to GLB and USDZ: true or false.
        #[flag("normal-map", Switch("true"), ["mesh"],
            "Store the detail that simplification removes in a normal map; makes the material lit")]
        normal_map: bool [Head] => false;
        /// Write the baked color to head.exr too, scene-linear: true or false.
        exr: bool [Files] => false;
        /// Formats to write, a list of glb, obj, ply, usdz; `tiface export` writes others of a
        /// finished run.
        #[flag("format", Text("LIST"), ["mesh"], "Formats to write: glb, obj, ply, usdz")]
        format: Vec<MeshFormat> [Files] => vec![MeshFormat::Glb];
    }
    constants {
        /// Evaluate the whole grid, and keep every surface found (published).
        dense: bool => false, false, true;
        /// Share of the cameras that must have the median cell of a slab in their frames, or the
        /// body is cut off above it. On `lps` a sixth keeps 8 cm more than a third does and the
        /// lower half of that is off by 1 to 4 cm; a quarter keeps 3.4 cm whose median error is 1
        /// to 2 mm, and covers as much of the training views.
        seen_by: f64 => 0.25, 0.25, 1.0 / 3.0;
        /// Samples along each side of a texel, where colors are the network's.
        texture_samples: u32 => 2;
        /// Texels that repeat a chart's border around it; charts lie twice as far apart.
        gutter_px: u32 => 8;
    }
}

impl MeshConfig {
    /// Texels of a picture; 0 without a texture.
    pub fn texels(&self) -> u64 {
        u64::from(self.texture_px).pow(2)
    }

    /// Pictures of lobes, one a function.
    fn lobe_pictures(&self) -> u64 {
        if self.lobes == 0 { 0 } else { (u64::from(self.lobes) + 1).pow(2) }
    }

    /// Number of pictures of the texture's size that a texture holds: color, normals, lobes.
    pub fn pictures(&self) -> u64 {
        1 + u64::from(self.normal_map) + self.lobe_pictures().div_ceil(u64::from(LOBE_TEXEL).pow(2))
    }

    /// Returns whether soft layers are fitted to views of T-Face.
    pub fn uses_tface(&self) -> bool {
        self.hair == Hair::Shells && self.hair_views == HairViews::Tface
    }

    /// Returns what the ranges of single keys cannot say: a key, its problem, and a suggested fix.
    pub fn problem(&self) -> Option<(&'static str, String, &'static str)> {
        let px = self.texture_px;
        if px == 0 {
            let asked = [(self.normal_map, key!(mesh.normal_map)), (self.exr, key!(mesh.exr))];
            return asked.iter().find(|(on, _)| *on).map(|(_, key)| {
                let problem = "asks for a picture, but `mesh.texture_px` is 0".to_owned();
                (*key, problem, "set `mesh.texture_px`, to 2048 for example")
            });
        }
        if px < 64 || self.gutter_px > px / 8 {
            let problem = format!("is {px}: no room for a gutter of {} texels", self.gutter_px);
            let hint = "it must be 0, or at least 64";
            return Some((key!(mesh.texture_px), problem, hint));
        }
        // held as floats while they are baked, lobes of the network as fine as the color; and the
        // sums of a fit for each texel
        let (pictures, fit) = match self.color {
            ColorSource::Photographs => (self.pictures(), 250),
            ColorSource::Network => (1 + u64::from(self.normal_map) + self.lobe_pictures(), 0),
        };
        let gib = (self.texels() * (21 * pictures + fit)) >> 30;
        (gib > 16).then(|| {
            let problem = format!("is {px}: {pictures} pictures of that size take {gib} GiB to make");
            (key!(mesh.texture_px), problem, "lower it, or `mesh.lobes`, or set `mesh.color=network`")
        })
    }
}
