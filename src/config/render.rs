//! `[render]`: the views made of the result.

use super::stage::Stage;
use super::table::table;
use serde::{Deserialize, Serialize};

/// A way to make a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// The radiance field without masks, marched and composited.
    Baseline,
    /// T-Face, marched and composited.
    Tface,
    /// I-Face's field, marched and composited.
    #[serde(alias = "iface")]
    Volume,
    /// Rays cast at I-Face's mesh with all that is known of its color: the head mesh with colors
    /// fitted to the photographs, or the whole extraction with those of the network, by
    /// `mesh.color`.
    Raycast,
    /// Rays cast at the product, its base color alone: what any viewer of `head.glb` shows.
    Plain,
    /// The same with its lobes: what viewers of ours show.
    Textured,
    /// The same, rasterized in a fraction of the time.
    Raster,
}

/// Pictures that are judged, in pipeline order: their word in folders, the configuration and
/// `metrics.json`, and what they are called. All but the last are those of [`Method`].
pub const NAMES: [(&str, &str); 8] = [
    ("baseline", "baseline"),
    ("tface", "T-Face"),
    ("volume", "I-Face"),
    ("raycast", "I-Face's mesh"),
    ("plain", "head.glb in any viewer"),
    ("textured", "head.glb with lobes"),
    ("raster", "head.glb with lobes, rasterized"),
    ("ensemble", "blend"),
];

/// Returns the display name of a method: `I-Face (volume)`; the word itself if it is the same, or
/// of no method.
pub fn display_name(word: &str) -> String {
    match NAMES.iter().find(|(w, title)| *w == word && title != w) {
        Some((_, title)) => format!("{title} ({word})"),
        None => word.into(),
    }
}

impl Method {
    /// Its word in the configuration, and the folder of its pictures below `render/`.
    pub fn as_str(self) -> &'static str {
        NAMES[self as usize].0
    }

    /// Returns the stage whose result it shows.
    pub fn stage(self) -> Stage {
        match self {
            Method::Baseline => Stage::Baseline,
            Method::Tface => Stage::Tface,
            Method::Volume => Stage::Iface,
            Method::Raycast | Method::Plain | Method::Textured | Method::Raster => Stage::Mesh,
        }
    }
}

/// A picture file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PictureFormat {
    /// 8-bit sRGB, straight alpha.
    Png,
    /// Float, scene-linear, premultiplied, with depth and normals.
    Exr,
}

/// The background of the views.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ViewBackground {
    /// Black.
    Black,
    /// White.
    White,
    /// Nothing: real alpha.
    None,
}

table! {
    /// Cameras, methods and format of the rendered views.
    pub struct RenderConfig;
    keys {
        /// Cameras of `tiface render`: test (held-out views), train, orbit or a file
        /// (transforms.json or a nerfstudio camera path). Blend and metrics always use test.
        #[flag("cameras", Text("WHICH"), ["render"],
            "Cameras: test (the held-out views), train, orbit or a file (a nerfstudio camera path or a \
             transforms.json)")]
        cameras: String [Path if |c| !c.render.cameras_are_a_file()] => "test".into();
        /// Methods, a list of baseline, tface, volume (I-Face), raycast (I-Face's mesh with
        /// view-dependent color), plain (head.glb, as any viewer shows it), textured (head.glb with
        /// its lobes, as viewers of ours show it) and raster (the same, rasterized).
        #[flag("with", Text("LIST"), ["render"],
            "Methods, separated by commas: baseline, tface, volume (I-Face), raycast (I-Face's mesh), plain \
             (head.glb, as any viewer shows it), textured (with its lobes) and raster (the same, rasterized)")]
        method: Vec<Method> [Views]
            => vec![Method::Tface, Method::Raycast, Method::Plain, Method::Textured],
            vec![Method::Tface, Method::Raycast, Method::Plain, Method::Textured],
            vec![Method::Baseline, Method::Tface, Method::Volume, Method::Raycast];
        /// Number of views of an orbit around the head.
        orbit_views: u32, 1.0..=10_000.0 [Path if |c| c.render.cameras == "orbit"] => 36;
        /// Rays along each side of a pixel of the mesh; twice as many at its edges.
        samples: u32, 1.0..=8.0 [Views] => 2;
        /// Show views of raycast as photographs are: add what the mesh misses of the nearest
        /// training photographs, which must be there, and filter pixels as they do: true or false.
        /// No exported file has it.
        residuals: bool [Views if |c| c.render.method.contains(&Method::Raycast)] => true, true, false;
        /// Picture format: png (8-bit sRGB) or exr (float, with depth and normals).
        #[flag("format", Text("FORMAT"), ["render"], "Picture format: png or exr")]
        format: PictureFormat [Views] => PictureFormat::Png;
        /// Background: black, white or none (alpha channel).
        #[flag("background", Text("BACKGROUND"), ["render"], "Background: black, white or none")]
        background: ViewBackground [Views] => ViewBackground::None;
        /// Store every view in float too, in METHOD/float, for the blend: true or false.
        float: bool [HeldOut] => true;
    }
}

impl RenderConfig {
    /// Returns whether the cameras come from a file.
    pub fn cameras_are_a_file(&self) -> bool {
        !["test", "train", "orbit"].contains(&self.cameras.as_str())
    }

    /// Returns whether views of these methods show residuals.
    pub fn shows_residuals(&self, methods: &[Method]) -> bool {
        self.residuals && methods.contains(&Method::Raycast)
    }

    /// Returns the stages whose results its views show.
    pub fn shows(&self) -> Vec<Stage> {
        let is_shown = |s: &Stage| *s == Stage::Mask || self.method.iter().any(|m| m.stage() == *s);
        Stage::ALL.into_iter().filter(is_shown).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_picture_has_one_word_and_one_name() {
        use Method::*;
        let methods = [Baseline, Tface, Volume, Raycast, Plain, Textured, Raster];
        for (method, (word, _)) in methods.into_iter().zip(NAMES) {
            // the word of the folder is the word of the configuration
            assert_eq!((serde_json::json!(method), method.as_str()), (serde_json::json!(word), word));
        }
        assert_eq!(display_name("volume"), "I-Face (volume)");
        assert_eq!((display_name("baseline"), display_name("truth")), ("baseline".into(), "truth".into()));
    }
}
