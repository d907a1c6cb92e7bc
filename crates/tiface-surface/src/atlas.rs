//! A texture atlas: the surface cut into charts, laid flat, and packed into a square.
//!
//! ```text
//! take out the face → divide and flatten (uvunwrap) → repair → pack → check
//!                                └── fails → one half square a triangle
//! ```
//!
//! Every triangle of the result has area, none is flipped, no two share any, and charts keep their
//! distance: that is checked exactly before an atlas is returned.
//!
//! Triangles that are flipped, cover others, or are too thin for 32-bit coordinates leave their
//! chart and become half squares of their own. What is left of a chart is packed again, part by
//! part.

mod chart;
mod divide;
mod face;
mod flatten;
mod half_squares;
mod pack;
mod relax;
mod smooth;

use crate::files::{UvReport, seams_facing, uv_check};
use crate::{Warning, check_indices, setting};
use chart::{Flat, height, neighbors, part, upright};
use divide::{divide, planar};
use face::divide_around;
use flatten::ChartSet;
use glam::{DVec2, Vec2, Vec3};
use half_squares::half_squares;
use pack::{ChartPose, pack};
use serde::Serialize;
use std::time::Instant;
use tiface_base::geom::{Atlas, Mesh, THOROUGH_EFFORT, overlaps, turn};
use tiface_base::{Error, Monitor, Result};

/// A report of an atlas: its construction and quality.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct AtlasReport {
    /// Why every triangle became a half square of its own; `None` if charts were possible.
    pub fallback: Option<String>,
    /// Triangles that would have been flipped, overlapping or without area, and got a small chart
    /// of their own.
    pub repaired: usize,
    /// Half the distance that charts keep, in texels: as configured, less only for the fall-back.
    pub gutter_px: f64,
    /// Length of the seams that face `front` within 45 degrees, over √area.
    pub seams_facing: Option<f64>,
    /// The atlas, measured.
    pub uv: UvReport,
    /// Wall time.
    pub seconds: f64,
}

impl AtlasReport {
    /// Returns what is doubtful of the atlas.
    pub fn warnings(&self) -> Vec<Warning> {
        let no_charts =
            |reason: &String| Warning::NoCharts { gutter_px: self.gutter_px, reason: reason.clone() };
        let own = (self.repaired > 0).then_some(Warning::OwnCharts(self.repaired));
        self.fallback.iter().map(no_charts).chain(own).collect()
    }
}

/// Lays a mesh into a square texture. Meant for closed meshes of up to some 200,000 triangles;
/// others work too.
///
/// ```
/// use glam::Vec3;
/// use tiface_base::geom::Mesh;
/// use tiface_surface::{AtlasConfig, atlas};
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
/// let (atlas, report) = atlas(&mesh, &config, &tiface_base::Quiet)?;
/// assert_eq!(atlas.triangles.len(), 8);
/// assert!(report.uv.is_sound() && report.uv.overlapping == 0);
/// # Ok::<(), tiface_base::Error>(())
/// ```
///
/// # Errors
///
/// A configuration out of range; a mesh without triangles, with an index out of range or a vertex
/// that is not finite; a texture too small for its triangles; a stop request.
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
    check_indices(mesh)?;
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

/// Number of steps reported to the monitor.
const STEPS: u64 = 4;

/// Options of an atlas.
#[derive(Clone, Debug, PartialEq)]
pub struct AtlasConfig {
    /// Texels across and down; 16..=16384.
    pub size_px: u32,
    /// Charts are at least twice this far from each other and from the border; 0..=256 and at most
    /// an eighth of the texture.
    pub gutter_px: u32,
    /// Direction that the face looks in, in the mesh's coordinates: the surface in front becomes
    /// one chart, with seams around it and none across. That costs stretch: the nose is laid flat
    /// with the cheeks. Flat pieces, the caps of a head, then get fewer texels.
    pub front: Option<Vec3>,
    /// Up direction in the mesh's coordinates: the chart in front stands upright in the texture.
    /// Only used with `front`.
    pub up: Option<Vec3>,
}

impl Default for AtlasConfig {
    fn default() -> AtlasConfig {
        AtlasConfig { size_px: 2048, gutter_px: 8, front: None, up: None }
    }
}

impl AtlasConfig {
    fn check(&self) -> Result<()> {
        setting((16..=16384).contains(&self.size_px), "AtlasConfig::size_px", "16..=16384", self.size_px)?;
        let narrow = self.gutter_px <= 256.min(self.size_px / 8);
        setting(
            narrow,
            "AtlasConfig::gutter_px",
            "0..=256 and at most an eighth of the texture's side",
            self.gutter_px,
        )?;
        let front = self.front.unwrap_or(Vec3::Z);
        setting(front.is_finite() && front != Vec3::ZERO, "AtlasConfig::front", "a direction", front)?;
        let up = self.up.unwrap_or(Vec3::Z);
        setting(up.is_finite() && up != Vec3::ZERO, "AtlasConfig::up", "a direction", up)
    }
}

/// An atlas in which every triangle has a place, none is flipped, flat or covers another.
struct AtlasLayout {
    atlas: Atlas,
    /// Triangles that got a chart of their own.
    repaired: usize,
    /// Half the distance that charts keep.
    gutter_px: f64,
}

/// Thinner than this, in texels, and rounding to f32 could turn a triangle: eight times the
/// distance of two coordinates at 4096.
const THIN_PX: f64 = 2e-3;

/// Scale of flat pieces of a head relative to the rest: caps, where the photographs end, which have
/// no detail.
const CAP_SCALE: f64 = 0.3;

/// Maximum number of rounds of repairing bad triangles.
const ROUNDS: usize = 5;

/// Lays a mesh out by `uvunwrap`, with a packer of our own.
fn by_charts(mesh: &Mesh, config: &AtlasConfig, monitor: &dyn Monitor) -> Result<AtlasLayout> {
    let mut flat = planar(mesh, &neighbors(mesh));
    let mut taken = vec![false; mesh.triangles.len()];
    flat.iter().flat_map(|f| &f.triangles).for_each(|&t| taken[t as usize] = true);
    let (rest, number) = part(mesh, |t| !taken[t as usize]);
    let mut flattened = match config.front {
        _ if rest.triangles.is_empty() => ChartSet::default(),
        Some(front) => divide_around(&rest, front, monitor)?,
        None => divide(&rest, monitor)?,
    }
    .renumbered(&number);
    if config.front.is_some() && !rest.triangles.is_empty() {
        flat.iter_mut().flat_map(|cap| &mut cap.points).for_each(|p| *p *= CAP_SCALE);
    }
    flattened.charts.extend(flat);
    let (found, limit) = (flattened.charts.len(), 64.max(mesh.triangles.len() / 20));
    if found > limit {
        return Err(Error::cannot(format!("{found} charts, more than {limit}, would be no better"), ""));
    }
    monitor.step(2, STEPS, &[("charts", found as f64)]);
    lay(mesh, flattened.charts, flattened.without, config, monitor)
}

/// Repairs charts and packs them; `loose` are triangles in none of them.
fn lay(
    mesh: &Mesh,
    mut charts: Vec<Flat>,
    mut loose: Vec<u32>,
    config: &AtlasConfig,
    monitor: &dyn Monitor,
) -> Result<AtlasLayout> {
    let size = f64::from(config.size_px);
    let area: f64 = charts.iter().map(Flat::area).sum();
    // the scale that half of the texture would take
    let scale = size * (0.5 / area).sqrt();
    let mut bad = vec![false; mesh.triangles.len()];
    for chart in &charts {
        for (k, &t) in chart.triangles.iter().enumerate() {
            bad[t as usize] = height(chart.at(k)) * scale < THIN_PX;
        }
    }
    let limit = 64.max(mesh.triangles.len() / 50);
    for _ in 0..ROUNDS {
        charts = charts.iter().flat_map(|c| c.parts(|k| !bad[c.triangles[k] as usize])).collect();
        loose.extend((0..mesh.triangles.len() as u32).filter(|&t| std::mem::take(&mut bad[t as usize])));
        if loose.len() > limit {
            let found = loose.len();
            return Err(Error::cannot(format!("{found} triangles, more than {limit}, need repair"), ""));
        }
        // as large as the triangle, but two texels at least
        let leg = |t: u32| (2.0 * mesh.area(t)).sqrt().max(2.0 / scale);
        let halves = loose.iter().map(|&t| Flat::half_square(mesh, t, leg(t)));
        let all: Vec<Flat> = charts.iter().cloned().chain(halves).collect();
        let stands = match config.front.zip(config.up) {
            Some((front, up)) => upright(mesh, &all, front, up),
            None => vec![None; all.len()],
        };
        let places = pack(&all, &stands, size, f64::from(config.gutter_px), monitor)?;
        let atlas = placed(mesh, &all, &places, config);
        bad = faults(&atlas);
        if !bad.contains(&true) {
            return Ok(AtlasLayout { atlas, repaired: loose.len(), gutter_px: f64::from(config.gutter_px) });
        }
    }
    Err(Error::cannot(format!("bad triangles remain after {ROUNDS} rounds of repair"), ""))
}

fn placed(mesh: &Mesh, charts: &[Flat], poses: &[ChartPose], config: &AtlasConfig) -> Atlas {
    let size = f64::from(config.size_px);
    let mut atlas = Atlas {
        uvs: Vec::with_capacity(charts.iter().map(|c| c.points.len()).sum()),
        triangles: vec![[0; 3]; mesh.triangles.len()],
        width: config.size_px,
        height: config.size_px,
    };
    for (chart, pose) in charts.iter().zip(poses) {
        let first = atlas.uvs.len() as u32;
        for &point in &chart.points {
            let p = pose.place(point) / size;
            // v runs down; as seen in the image the surface is not mirrored
            atlas.uvs.push(DVec2::new(p.x, 1.0 - p.y).as_vec2().clamp(Vec2::ZERO, Vec2::ONE));
        }
        for (corners, &t) in chart.corners.iter().zip(&chart.triangles) {
            atlas.triangles[t as usize] = corners.map(|i| first + i);
        }
    }
    atlas
}

/// Triangles that are clockwise or flat, and the thinner one of each pair that shares area.
fn faults(atlas: &Atlas) -> Vec<bool> {
    let corners = |t: usize| atlas.triangles[t].map(|i| atlas.uvs[i as usize]);
    // v runs down, so counter-clockwise turns the other way
    let upright: Vec<bool> = (0..atlas.triangles.len())
        .map(|t| {
            let [a, b, c] = corners(t);
            turn(a, b, c) < 0
        })
        .collect();
    let mut bad: Vec<bool> = upright.iter().map(|u| !u).collect();
    for (a, b) in overlaps(&atlas.uvs, &atlas.triangles, &upright, THOROUGH_EFFORT).pairs {
        let (a, b) = (a as usize, b as usize);
        if !bad[a] && !bad[b] {
            let thin = |t: usize| height(corners(t).map(|v| v.as_dvec2())).abs();
            bad[if thin(a) <= thin(b) { a } else { b }] = true;
        }
    }
    bad
}

#[cfg(test)]
mod tests;
