//! From a mesh to its atlas by the library: divide, flatten, repair, pack, and look at the result.
//!
//! Triangles that are flipped, cover others, or are too thin for 32-bit coordinates leave their chart and become
//! half squares of their own. What is left of a chart is packed again, part by part.

use super::divide::divide;
use super::face::divide_around;
use super::flat::{Flat, height};
use super::layout::{AtlasConfig, AtlasLayout, STEPS};
use super::library::ChartSet;
use super::pack::{ChartPose, pack};
use super::patch::{neighbours, part};
use super::planar::planar;
use super::upright::upright;
use crate::geom::{Atlas, Mesh, THOROUGH, overlaps, turn};
use crate::{Error, Monitor, Result};
use glam::{DVec2, Vec2};

/// Thinner than this, in texels, and rounding to f32 could turn a triangle: eight times the distance of two
/// coordinates at 4096.
const THIN_PX: f64 = 2e-3;

/// How often bad triangles are looked for before it is given up.
const ROUNDS: usize = 5;

/// Lays a mesh out by `uvunwrap`, with a packer of our own.
pub(super) fn by_charts(mesh: &Mesh, config: &AtlasConfig, monitor: &dyn Monitor) -> Result<AtlasLayout> {
    let flat = planar(mesh, &neighbours(mesh));
    let mut taken = vec![false; mesh.triangles.len()];
    flat.iter().flat_map(|f| &f.triangles).for_each(|&t| taken[t as usize] = true);
    let (rest, number) = part(mesh, |t| !taken[t as usize]);
    let mut flattened = match config.front {
        _ if rest.triangles.is_empty() => ChartSet::default(),
        Some(front) => divide_around(&rest, front, monitor)?,
        None => divide(&rest, monitor)?,
    }
    .renumbered(&number);
    flattened.charts.extend(flat);
    let (found, most) = (flattened.charts.len(), 64.max(mesh.triangles.len() / 20));
    if found > most {
        return Err(Error::cannot(format!("{found} charts, more than {most}, would be no better"), ""));
    }
    monitor.step(2, STEPS, &[("charts", found as f64)]);
    lay(mesh, flattened.charts, flattened.without, config, monitor)
}

/// Repairs charts and packs them; `loose` are triangles in none of them.
pub(super) fn lay(
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
    let most = 64.max(mesh.triangles.len() / 50);
    for _ in 0..ROUNDS {
        charts = charts.iter().flat_map(|c| c.parts(|k| !bad[c.triangles[k] as usize])).collect();
        loose.extend((0..mesh.triangles.len() as u32).filter(|&t| std::mem::take(&mut bad[t as usize])));
        if loose.len() > most {
            let found = loose.len();
            return Err(Error::cannot(format!("{found} triangles, more than {most}, need repair"), ""));
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
    Err(Error::cannot(format!("there were bad triangles after {ROUNDS} rounds of repair"), ""))
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
            let p = pose.of(point) / size;
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
    for (a, b) in overlaps(&atlas.uvs, &atlas.triangles, &upright, THOROUGH).pairs {
        let (a, b) = (a as usize, b as usize);
        if !bad[a] && !bad[b] {
            let thin = |t: usize| height(corners(t).map(|v| v.as_dvec2())).abs();
            bad[if thin(a) <= thin(b) { a } else { b }] = true;
        }
    }
    bad
}
