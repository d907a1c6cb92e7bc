//! A texture atlas: the surface cut into charts, laid flat, and packed into a square.
//!
//! ```text
//! take out the face → divide and flatten (uvunwrap) → mend → pack → check
//!                                └── fails → one half square a triangle
//! ```
//!
//! Every triangle of the result has area, none is flipped, no two share any, and charts keep their distance: that
//! is looked at, exactly, before an atlas is returned.

mod divide;
mod face;
mod flat;
mod lay;
mod library;
mod pack;
mod patch;
mod planar;
mod raster;
mod relax;
mod smooth;
mod squares;

use crate::Monitor;
use crate::geom::{Atlas, Mesh};
use crate::mesh::MeshError;
use crate::mesh::files::{UvReport, seams_facing, uv_check};
use glam::Vec3;
use lay::Library;
use serde::{Deserialize, Serialize};
use squares::HalfSquares;
use std::time::Instant;

/// How a mesh is laid into its texture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AtlasConfig {
    /// Texels across and down; 16..=16384.
    pub size_px: u32,
    /// Charts are at least twice this far from each other and from the border; 0..=256 and at most an eighth of
    /// the texture.
    pub gutter_px: u32,
    /// Where the face looks, in the mesh's coordinates: what lies there becomes one chart, with seams around it
    /// and none across. That costs stretch: the nose is laid flat with the cheeks.
    pub front: Option<Vec3>,
}

impl Default for AtlasConfig {
    fn default() -> AtlasConfig {
        AtlasConfig { size_px: 2048, gutter_px: 8, front: None }
    }
}

impl AtlasConfig {
    /// Every value in its range, else [`MeshError::Config`] that names the key.
    pub fn check(&self) -> Result<(), MeshError> {
        let bad = |key, expected, found: String| Err(MeshError::Config { key, expected, found });
        if !(16..=16384).contains(&self.size_px) {
            return bad("size_px", "16..=16384", self.size_px.to_string());
        }
        if self.gutter_px > 256 || self.gutter_px > self.size_px / 8 {
            let expected = "0..=256 and at most an eighth of the texture's side";
            return bad("gutter_px", expected, self.gutter_px.to_string());
        }
        match self.front {
            Some(v) if !v.is_finite() || v == Vec3::ZERO => bad("front", "a direction", v.to_string()),
            _ => Ok(()),
        }
    }
}

/// How an atlas came about, and how good it is.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct AtlasReport {
    /// Why every triangle became a half square of its own; none when charts were possible.
    pub fallback: Option<String>,
    /// Triangles that would have been flipped, overlapping or without area, and got a small chart of their own.
    pub mended: usize,
    /// Half the distance that charts keep, in texels: as configured, less only for the fall-back.
    pub gutter_px: f64,
    /// Length of the seams that look along `front` within 45 degrees, over √area.
    pub seams_facing: Option<f64>,
    /// The atlas, measured.
    pub uv: UvReport,
    /// Wall time.
    pub seconds: f64,
}

impl AtlasReport {
    /// What a person should know, in sentences.
    pub fn warnings(&self) -> Vec<String> {
        let mut out = Vec::new();
        if let Some(reason) = &self.fallback {
            let gutter = self.gutter_px;
            out.push(format!(
                "every triangle has a piece of the texture of its own, {gutter:.1} texels of gutter: {reason}"
            ));
        }
        if self.mended > 0 {
            out.push(format!(
                "{} triangles could not stay in their chart and got one of their own",
                self.mended
            ));
        }
        out
    }
}

const STEPS: u64 = 4;

/// A way to lay a mesh out.
trait Unwrap {
    /// Every triangle placed, none flipped, flat or covering another.
    fn unwrap(&self, mesh: &Mesh, config: &AtlasConfig, monitor: &dyn Monitor) -> Result<Laid, Refusal>;
}

/// An atlas that keeps what [`Unwrap`] promises.
struct Laid {
    atlas: Atlas,
    mended: usize,
    gutter_px: f64,
}

/// Why a way did not lead to an atlas.
#[derive(Debug)]
enum Refusal {
    Stopped,
    TooSmall,
    Because(String),
}

impl Refusal {
    fn because(reason: &str) -> Refusal {
        Refusal::Because(reason.into())
    }
}

/// Lays a mesh into a square texture. Meant for closed meshes of up to some 200,000 triangles; others work too.
///
/// # Errors
///
/// A configuration out of range; a mesh without triangles, with an index out of range or a vertex that is not
/// finite; a texture too small for its triangles; a stop that the monitor asked for.
pub fn atlas(
    mesh: &Mesh,
    config: &AtlasConfig,
    monitor: &dyn Monitor,
) -> Result<(Atlas, AtlasReport), MeshError> {
    atlas_by(&Library, mesh, config, monitor)
}

fn atlas_by(
    first: &dyn Unwrap,
    mesh: &Mesh,
    config: &AtlasConfig,
    monitor: &dyn Monitor,
) -> Result<(Atlas, AtlasReport), MeshError> {
    let begin = Instant::now();
    config.check()?;
    is_sound(mesh)?;
    let (mut laid, mut fallback) = match first.unwrap(mesh, config, monitor) {
        Ok(laid) => (Some(laid), None),
        Err(Refusal::Stopped) => return Err(MeshError::Stopped),
        Err(Refusal::TooSmall) => (None, Some("the charts do not fit into the texture".into())),
        Err(Refusal::Because(reason)) => (None, Some(reason)),
    };
    loop {
        let Laid { atlas, mended, gutter_px } = match laid.take() {
            Some(laid) => laid,
            None => HalfSquares.unwrap(mesh, config, monitor).map_err(|_| MeshError::AtlasTooSmall {
                size_px: config.size_px,
                triangles: mesh.triangles.len(),
            })?,
        };
        monitor.step(STEPS - 1, STEPS, &[("mended", mended as f64)]);
        if monitor.stop() {
            return Err(MeshError::Stopped);
        }
        let uv = uv_check(mesh, &atlas);
        let apart = uv.chart_distance_px.unwrap_or(f64::INFINITY).min(uv.border_distance_px);
        // a thousandth of a texel: coordinates are rounded to f32
        if (!uv.is_sound() || apart < 2.0 * gutter_px - 1e-3) && fallback.is_none() {
            fallback = Some(format!(
                "the finished atlas did not pass its check ({} overlapping, {} flipped, {} without area, {} outside, \
                 {apart:.3} texels apart)",
                uv.overlapping, uv.flipped, uv.zero_area, uv.outside
            ));
            continue;
        }
        monitor.step(STEPS, STEPS, &[("charts", uv.charts as f64), ("used", uv.used)]);
        let report = AtlasReport {
            fallback,
            mended,
            gutter_px,
            seams_facing: config.front.map(|front| seams_facing(mesh, &atlas, front)),
            uv,
            seconds: begin.elapsed().as_secs_f64(),
        };
        return Ok((atlas, report));
    }
}

fn is_sound(mesh: &Mesh) -> Result<(), MeshError> {
    if mesh.triangles.is_empty() {
        return Err(MeshError::NoTriangles);
    }
    let vertices = mesh.positions.len();
    for (triangle, corners) in mesh.triangles.iter().enumerate() {
        for &vertex in corners {
            match mesh.positions.get(vertex as usize) {
                None => return Err(MeshError::Index { triangle, index: vertex, vertices }),
                Some(p) if !p.is_finite() => {
                    return Err(MeshError::NotFinite { count: 1, first: vertex as usize });
                }
                _ => {}
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
