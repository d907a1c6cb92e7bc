//! A texture atlas: the surface cut into charts, laid flat, and packed into a square.
//!
//! ```text
//! take out the face → divide and flatten (uvunwrap) → repair → pack → check
//!                                └── fails → one half square a triangle
//! ```
//!
//! Every triangle of the result has area, none is flipped, no two share any, and charts keep their distance: that
//! is looked at, exactly, before an atlas is returned.

mod divide;
mod face;
mod flat;
mod lay;
mod layout;
mod library;
mod pack;
mod patch;
mod planar;
mod raster;
mod relax;
mod smooth;
mod squares;
mod upright;

pub use layout::AtlasConfig;

use crate::geom::{Atlas, Mesh};
use crate::mesh::files::{UvReport, seams_facing, uv_check};
use crate::mesh::input::sound;
use crate::{Error, Monitor, Result};
use lay::by_charts;
use layout::{AtlasLayout, STEPS};
use serde::Serialize;
use squares::half_squares;
use std::time::Instant;

/// How an atlas came about, and how good it is.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct AtlasReport {
    /// Why every triangle became a half square of its own; none when charts were possible.
    pub fallback: Option<String>,
    /// Triangles that would have been flipped, overlapping or without area, and got a small chart of their own.
    pub repaired: usize,
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
    /// Returns what a person should know, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let mut out = Vec::new();
        if let Some(reason) = &self.fallback {
            let gutter = self.gutter_px;
            out.push(format!(
                "every triangle has a piece of the texture of its own, {gutter:.1} texels of gutter: {reason}"
            ));
        }
        if self.repaired > 0 {
            out.push(format!(
                "{} triangles could not stay in their chart and got one of their own",
                self.repaired
            ));
        }
        out
    }
}

/// Lays a mesh into a square texture. Meant for closed meshes of up to some 200,000 triangles; others work too.
///
/// ```
/// use glam::Vec3;
/// use tiface::geom::Mesh;
/// use tiface::mesh::{AtlasConfig, atlas};
///
/// let mesh = Mesh {
///     positions: vec![Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z],
///     normals: vec![Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z],
///     triangles: vec![
///         [0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5],
///     ],
///     ..Mesh::default()
/// };
/// let config = AtlasConfig { size_px: 128, gutter_px: 2, ..AtlasConfig::default() };
/// let (atlas, report) = atlas(&mesh, &config, &tiface::Quiet)?;
/// assert_eq!(atlas.triangles.len(), 8);
/// assert!(report.uv.is_sound() && report.uv.overlapping == 0);
/// # Ok::<(), tiface::Error>(())
/// ```
///
/// # Errors
///
/// A configuration out of range; a mesh without triangles, with an index out of range or a vertex that is not
/// finite; a texture too small for its triangles; a stop that the monitor asked for.
pub fn atlas(mesh: &Mesh, config: &AtlasConfig, monitor: &dyn Monitor) -> Result<(Atlas, AtlasReport)> {
    atlas_by(by_charts, mesh, config, monitor)
}

fn atlas_by(
    charts: impl Fn(&Mesh, &AtlasConfig, &dyn Monitor) -> Result<AtlasLayout>,
    mesh: &Mesh,
    config: &AtlasConfig,
    monitor: &dyn Monitor,
) -> Result<(Atlas, AtlasReport)> {
    let begin = Instant::now();
    config.check()?;
    if mesh.triangles.is_empty() {
        return Err(Error::cannot("the mesh has no triangles", "check that `mesh` ended with a surface"));
    }
    sound(mesh)?;
    let mut fallback = None;
    let mut layout = match charts(mesh, config, monitor) {
        Err(e) if !e.kind().is_stop() => {
            fallback = Some(e.to_string());
            half_squares(mesh, config)?
        }
        other => other?,
    };
    loop {
        let AtlasLayout { atlas, repaired, gutter_px } = layout;
        monitor.step(STEPS - 1, STEPS, &[("repaired", repaired as f64)]);
        monitor.check_stop()?;
        let uv = uv_check(mesh, &atlas);
        let apart = uv.chart_distance_px.unwrap_or(f64::INFINITY).min(uv.border_distance_px);
        // a thousandth of a texel: coordinates are rounded to f32
        if (!uv.is_sound() || apart < 2.0 * gutter_px - 1e-3) && fallback.is_none() {
            fallback = Some(format!(
                "the finished atlas did not pass its check ({} overlapping, {} flipped, {} without area, {} outside, \
                 {apart:.3} texels apart)",
                uv.overlapping, uv.flipped, uv.zero_area, uv.outside
            ));
            layout = half_squares(mesh, config)?;
            continue;
        }
        monitor.step(STEPS, STEPS, &[("charts", uv.charts as f64), ("used", uv.used)]);
        let report = AtlasReport {
            fallback,
            repaired,
            gutter_px,
            seams_facing: config.front.map(|front| seams_facing(mesh, &atlas, front)),
            uv,
            seconds: begin.elapsed().as_secs_f64(),
        };
        return Ok((atlas, report));
    }
}

#[cfg(test)]
mod tests;
