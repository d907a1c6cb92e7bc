//! A texture atlas: the surface cut into charts, laid flat, and packed into a square.
//!
//! ```text
//! a head: face, scalp, … → share out the texels ─┐
//! else: divide and flatten (uvunwrap) ───────────┴→ repair → pack → check
//!                        └── fails → one half square a triangle
//! ```
//!
//! Every triangle of the result has area, none is flipped, no two share any, and charts keep their
//! distance: that is checked exactly before an atlas is returned.
//!
//! Triangles that are flipped, cover others, or are too thin for 32-bit coordinates leave their
//! chart and become half squares of their own. What is left of a chart is packed again, part by
//! part.

mod chart;
mod disc;
mod divide;
mod flatten;
mod half_squares;
mod head;
mod pack;
mod patches;
mod planar;
mod regions;
mod relax;
mod resolution;
mod smooth;

use crate::files::{UvReport, seams_facing, uv_check};
use crate::{Warning, check_indices, setting};
use chart::{Flat, height};
use divide::divide;
use flatten::ChartSet;
use glam::{DVec2, Vec2, Vec3};
use half_squares::half_squares;
use head::divide_head;
use pack::{ChartPose, INITIAL_FILL, pack};
use patches::{neighbors, part};
use planar::planar;
use regions::Part;
pub use resolution::resolved;
use resolution::share_out;
use serde::Serialize;
use std::time::Instant;
use tiface_base::geom::{Atlas, Mesh, THOROUGH_EFFORT, overlaps, turn};
use tiface_base::{Error, Monitor, Result};
use upright::upright;

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
    /// Texels across and down.
    pub size_px: u32,
    /// What the charts of a head show; empty if no face was looked for or found.
    pub parts: Vec<PartReport>,
    /// Texels across from which on the face has all that photographs resolve.
    pub sufficient_px: Option<u32>,
    /// Length of the seams that face `front` within 45 degrees, over √area.
    pub seams_facing: Option<f64>,
    /// The atlas, measured.
    pub uv: UvReport,
    /// Wall time.
    pub seconds: f64,
}

/// A part of a head in its texture.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PartReport {
    /// What it shows: `face`, `left` and `right` of the scalp, `nape`, `chest`, `back`, or `cap`,
    /// what closes the shoulders.
    pub part: String,
    /// Its share of the surface.
    pub surface: f64,
    /// Its share of the texels that triangles cover.
    pub texels: f64,
    /// Texels along a unit of the mesh.
    pub density: f64,
}

/// A texture larger than this, over the size that suffices, is worth a warning: twice the texels.
const OVERSIZE: f64 = std::f64::consts::SQRT_2;

impl AtlasReport {
    /// Returns what is doubtful of the atlas.
    pub fn warnings(&self) -> Vec<Warning> {
        let no_charts =
            |reason: &String| Warning::NoCharts { gutter_px: self.gutter_px, reason: reason.clone() };
        let own = (self.repaired > 0).then_some(Warning::OwnCharts(self.repaired));
        // a preset's texture may well be a little larger than small photographs need
        let oversize = |px: &u32| f64::from(self.size_px) > OVERSIZE * f64::from(*px);
        let finer = self
            .sufficient_px
            .filter(oversize)
            .map(|sufficient_px| Warning::FinerThanPhotographs { sufficient_px, asked_px: self.size_px });
        finer.into_iter().chain(self.fallback.iter().map(no_charts)).chain(own).collect()
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
        let AtlasLayout { atlas, repaired, gutter_px, head } = layout;
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
            size_px: config.size_px,
            parts: head.as_ref().map_or_else(Vec::new, |head| part_reports(mesh, &atlas, &head.parts)),
            sufficient_px: head.and_then(|head| head.sufficient_px),
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
    /// Direction that the face looks in, in the mesh's coordinates: the surface is divided as a
    /// head, its face one chart with seams behind the ears and at crown, nape and collar, and
    /// texels by importance: more than twice as many along a line on the face as on a garment,
    /// hardly any on what closes the shoulders. That costs stretch: the nose is laid flat with the
    /// cheeks.
    pub front: Option<Vec3>,
    /// Up direction in the mesh's coordinates: the face stands upright in the texture. Only used
    /// with `front`.
    pub up: Option<Vec3>,
    /// The side of the finest texel that photographs resolve on each triangle ([`resolved`]): no
    /// chart of a head is finer. Only used with `front`.
    pub resolved: Option<Vec<f32>>,
}

impl Default for AtlasConfig {
    fn default() -> AtlasConfig {
        AtlasConfig { size_px: 2048, gutter_px: 8, front: None, up: None, resolved: None }
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
    /// Present if it was divided as a head.
    head: Option<HeadLayout>,
}

/// What an atlas of a head shows where.
#[derive(Clone)]
struct HeadLayout {
    /// The part of each triangle.
    parts: Vec<Part>,
    sufficient_px: Option<u32>,
}

/// Charts that have their sizes.
struct Pieces {
    charts: Vec<Flat>,
    /// Triangles in none of them.
    loose: Vec<u32>,
    /// A triangle of the chart that stands upright, and the up direction of the mesh.
    stands: Option<(u32, Vec3)>,
    /// Most texels along a unit of the charts.
    limit: f64,
    head: Option<HeadLayout>,
}

/// Thinner than this, in texels, and rounding to f32 could turn a triangle: eight times the
/// distance of two coordinates at 4096.
const THIN_PX: f64 = 2e-3;

/// Maximum number of rounds of repairing bad triangles.
const ROUNDS: usize = 5;

/// Lays a mesh out in charts.
fn by_charts(mesh: &Mesh, config: &AtlasConfig, monitor: &dyn Monitor) -> Result<AtlasLayout> {
    let pieces = match config.front {
        Some(front) => head_pieces(mesh, front, config, monitor)?,
        None => None,
    };
    let pieces = match pieces {
        Some(pieces) => pieces,
        None => plain_pieces(mesh, monitor)?,
    };
    let (found, limit) = (pieces.charts.len(), 64.max(mesh.triangles.len() / 20));
    if found > limit {
        return Err(Error::cannot(format!("{found} charts, more than {limit}, would be no better"), ""));
    }
    monitor.step(2, STEPS, &[("charts", found as f64)]);
    lay(mesh, pieces, config, monitor)
}

/// Returns the charts of a head, with texels by importance; `None` if it has no face.
fn head_pieces(
    mesh: &Mesh,
    front: Vec3,
    config: &AtlasConfig,
    monitor: &dyn Monitor,
) -> Result<Option<Pieces>> {
    let up = config.up.unwrap_or_else(|| front.normalize().any_orthonormal_vector());
    let Some(mut charts) = divide_head(mesh, front, up, monitor)? else { return Ok(None) };
    let inner = f64::from(config.size_px - 2 * config.gutter_px);
    let shares = share_out(&mut charts, config.resolved.as_deref(), INITIAL_FILL * inner * inner);
    let needed = |texels: f64| (texels / INITIAL_FILL).sqrt() + 2.0 * f64::from(config.gutter_px);
    let sufficient_px = shares.sufficient_texels.map(|texels| (needed(texels) / 64.0).ceil() as u32 * 64);
    let mut is_loose = vec![true; mesh.triangles.len()];
    let mut parts = vec![Part::Cap; mesh.triangles.len()];
    for chart in &charts {
        for &t in &chart.flat.triangles {
            (is_loose[t as usize], parts[t as usize]) = (false, chart.part);
        }
    }
    Ok(Some(Pieces {
        loose: (0..mesh.triangles.len() as u32).filter(|&t| is_loose[t as usize]).collect(),
        stands: config.up.map(|up| (charts[0].flat.triangles[0], up)),
        limit: shares.limit,
        head: Some(HeadLayout { parts, sufficient_px }),
        charts: charts.into_iter().map(|chart| chart.flat).collect(),
    }))
}

/// Returns the charts of a mesh that is not known to be a head: its flat pieces, and what
/// `uvunwrap` makes of the rest.
fn plain_pieces(mesh: &Mesh, monitor: &dyn Monitor) -> Result<Pieces> {
    let flat = planar(mesh, &neighbors(mesh));
    let mut taken = vec![false; mesh.triangles.len()];
    flat.iter().flat_map(|f| &f.triangles).for_each(|&t| taken[t as usize] = true);
    let (rest, number) = part(mesh, |t| !taken[t as usize]);
    let divided = if rest.triangles.is_empty() { ChartSet::default() } else { divide(&rest, monitor)? };
    let ChartSet { mut charts, without } = divided.renumbered(&number);
    charts.extend(flat);
    Ok(Pieces { charts, loose: without, stands: None, limit: f64::INFINITY, head: None })
}

/// Repairs charts and packs them.
fn lay(mesh: &Mesh, pieces: Pieces, config: &AtlasConfig, monitor: &dyn Monitor) -> Result<AtlasLayout> {
    let Pieces { mut charts, mut loose, stands, limit: max_scale, head } = pieces;
    let (size, gutter_px) = (f64::from(config.size_px), f64::from(config.gutter_px));
    let area: f64 = charts.iter().map(Flat::area).sum();
    // the scale that half of the texture would take
    let scale = size * (0.5 / area).sqrt();
    let laid = charts.iter().flat_map(|c| &c.triangles);
    let mean_scale = area / laid.map(|&t| mesh.area(t)).sum::<f64>();
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
        let leg = |t: u32| (2.0 * mesh.area(t) * mean_scale).sqrt().max(2.0 / scale);
        let halves = loose.iter().map(|&t| Flat::half_square(mesh, t, leg(t)));
        let all: Vec<Flat> = charts.iter().cloned().chain(halves).collect();
        let stands = match stands {
            Some((of_face, up)) => upright(mesh, &all, of_face, up),
            None => vec![None; all.len()],
        };
        let places = pack(&all, &stands, max_scale, [size, gutter_px], monitor)?;
        let atlas = placed(mesh, &all, &places, config);
        bad = faults(&atlas);
        if !bad.contains(&true) {
            return Ok(AtlasLayout { atlas, repaired: loose.len(), gutter_px, head });
        }
    }
    Err(Error::cannot(format!("bad triangles remain after {ROUNDS} rounds of repair"), ""))
}

/// Measures the parts of a head that have a place in its atlas.
fn part_reports(mesh: &Mesh, atlas: &Atlas, parts: &[Part]) -> Vec<PartReport> {
    let size = DVec2::new(f64::from(atlas.width), f64::from(atlas.height));
    let mut areas = [[0.0; 2]; Part::ALL.len()];
    for (t, &part) in parts.iter().enumerate() {
        let [a, b, c] = atlas.triangles[t].map(|i| atlas.uvs[i as usize].as_dvec2() * size);
        let [surface, texels] = &mut areas[part as usize];
        *surface += mesh.area(t as u32);
        *texels += 0.5 * (b - a).perp_dot(c - a).abs();
    }
    let whole = areas.iter().fold([0.0; 2], |sum, a| [sum[0] + a[0], sum[1] + a[1]]);
    let report = |part: Part| {
        let [surface, texels] = areas[part as usize];
        (surface > 0.0).then(|| PartReport {
            part: format!("{part:?}").to_lowercase(),
            surface: surface / whole[0],
            texels: texels / whole[1],
            density: (texels / surface).sqrt(),
        })
    };
    Part::ALL.into_iter().filter_map(report).collect()
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
mod head_tests;
#[cfg(test)]
mod tests;
mod upright;
