//! From a mesh to its atlas by the library: divide, flatten, mend, pack, and look at the result.
//!
//! Triangles that are flipped, cover others, or are too thin for 32-bit coordinates leave their chart and become
//! half squares of their own. What is left of a chart is packed again, part by part.

use super::divide::divide;
use super::face::divide_around;
use super::flat::{Flat, height};
use super::library::Flattened;
use super::pack::pack;
use super::patch::{neighbours, part};
use super::planar::planar;
use super::{AtlasConfig, Laid, Refusal, Unwrap};
use crate::Monitor;
use crate::geom::{Atlas, Mesh, THOROUGH, overlaps, turn};
use glam::{DVec2, Vec2};

/// Thinner than this, in texels, and rounding to f32 could turn a triangle: eight times the distance of two
/// coordinates at 4096.
const THIN_PX: f64 = 2e-3;

/// How often bad triangles are looked for before it is given up.
const ROUNDS: usize = 5;

/// `uvunwrap`, with a packer of our own.
pub(super) struct Library;

impl Unwrap for Library {
    fn unwrap(&self, mesh: &Mesh, config: &AtlasConfig, monitor: &dyn Monitor) -> Result<Laid, Refusal> {
        let flat = planar(mesh, &neighbours(mesh));
        let mut taken = vec![false; mesh.triangles.len()];
        flat.iter().flat_map(|f| &f.triangles).for_each(|&t| taken[t as usize] = true);
        let (rest, number) = part(mesh, |t| !taken[t as usize]);
        let mut flattened = match config.front {
            _ if rest.triangles.is_empty() => Flattened { charts: Vec::new(), without: Vec::new() },
            Some(front) => divide_around(&rest, front, monitor)?,
            None => divide(&rest, monitor)?,
        }
        .renumbered(&number);
        flattened.charts.extend(flat);
        let most = 64.max(mesh.triangles.len() / 20);
        if flattened.charts.len() > most {
            let found = flattened.charts.len();
            return Err(Refusal::Because(format!("{found} charts, more than {most}, would be no better")));
        }
        monitor.step(2, super::STEPS, &[("charts", flattened.charts.len() as f64)]);
        lay(mesh, flattened.charts, flattened.without, config, monitor)
    }
}

/// Mends charts and packs them; `loose` are triangles in none of them.
pub(super) fn lay(
    mesh: &Mesh,
    mut charts: Vec<Flat>,
    mut loose: Vec<u32>,
    config: &AtlasConfig,
    monitor: &dyn Monitor,
) -> Result<Laid, Refusal> {
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
            return Err(Refusal::Because(format!(
                "{} triangles, more than {most}, need mending",
                loose.len()
            )));
        }
        let mended = loose.len();
        let halves = loose.iter().map(|&t| Flat::half_square(mesh, t, half_square_leg(mesh, t, scale)));
        let all: Vec<Flat> = charts.iter().cloned().chain(halves).collect();
        let places = pack(&all, size, f64::from(config.gutter_px), &|| monitor.stop())?;
        let atlas = placed(mesh, &all, |c, p| places[c].of(p), config);
        bad = faults(&atlas);
        if !bad.contains(&true) {
            return Ok(Laid { atlas, mended, gutter_px: f64::from(config.gutter_px) });
        }
    }
    Err(Refusal::Because(format!("there were bad triangles after {ROUNDS} rounds of mending")))
}

/// As large as the triangle, but two texels at least.
fn half_square_leg(mesh: &Mesh, t: u32, scale: f64) -> f64 {
    let [a, b, c] = mesh.corners(t).map(|p| p.as_dvec3());
    let area = 0.5 * (b - a).cross(c - a).length();
    (2.0 * area).sqrt().max(2.0 / scale)
}

fn placed(
    mesh: &Mesh,
    charts: &[Flat],
    place: impl Fn(usize, DVec2) -> DVec2,
    config: &AtlasConfig,
) -> Atlas {
    let size = f64::from(config.size_px);
    let mut atlas = Atlas {
        uvs: Vec::with_capacity(charts.iter().map(|c| c.points.len()).sum()),
        triangles: vec![[0; 3]; mesh.triangles.len()],
        width: config.size_px,
        height: config.size_px,
    };
    for (c, chart) in charts.iter().enumerate() {
        let first = atlas.uvs.len() as u32;
        for &point in &chart.points {
            let p = place(c, point) / size;
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
