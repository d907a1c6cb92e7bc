//! A head divided where an artist cuts: the face one chart, seams behind the ears, at crown, nape
//! and collar ([`regions`](super::regions)). Every chart begins as a disc without folds and is
//! relaxed to its true sizes, so rough hair costs stretch, never more charts.

use super::chart::{Flat, stretch};
use super::disc::embedded;
use super::divide::{STRETCH, components, halves};
use super::patches::neighbors;
use super::regions::{Head, Part};
use super::relax::relax;
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::Mesh;
use tiface_base::{Monitor, Result};

/// A head has at most this many charts, unless pieces of it hang together nowhere.
pub(super) const MAX_CHARTS: usize = 12;

/// Where the line behind the ears may lie, in parts of the head's depth: the face's chart is the
/// first that stretches little.
const EARS: [f32; 3] = [0.62, 0.52, 0.42];

/// Mean area stretch that a face may have.
const FACE_STRETCH: f64 = 1.08;

/// Most steps of relaxing: at 300 the face of `lps` has a mean area stretch of 1.06, at 800 of
/// 1.02.
const RELAXING: usize = 800;

/// Times that a region that is no disc is halved.
const HALVINGS: usize = 6;

/// A chart and what it shows.
pub(super) struct HeadChart {
    pub flat: Flat,
    pub part: Part,
}

/// Divides a head; `None` if it has no part that could be its face.
pub(super) fn divide_head(
    mesh: &Mesh,
    front: Vec3,
    up: Vec3,
    monitor: &dyn Monitor,
) -> Result<Option<Vec<HeadChart>>> {
    let adjacent = neighbors(mesh);
    let head = Head::new(mesh, &adjacent, front, up);
    let mut best: Option<(f64, Flat, Vec<u32>, Vec<Part>)> = None;
    for depth in EARS {
        monitor.check_stop()?;
        let (region, part) = head.regions(depth);
        let Some(face) = part.iter().position(|p| *p == Part::Face) else { continue };
        let Some(flat) = laid(mesh, &head.smooth, &of(&region, face)) else { continue };
        let stretch = stretch(mesh, &flat);
        if best.as_ref().is_none_or(|b| stretch < b.0) {
            best = Some((stretch, flat, region, part));
        }
        if stretch < FACE_STRETCH {
            break;
        }
    }
    let Some((_, face, region, part)) = best else { return Ok(None) };
    let others: Vec<usize> = (0..part.len()).filter(|&r| part[r] != Part::Face).collect();
    let mut charts: Vec<HeadChart> = others
        .par_iter()
        .flat_map_iter(|&r| {
            let flats = discs(mesh, &head.smooth, &adjacent, of(&region, r), HALVINGS);
            flats.into_iter().map(|flat| HeadChart { flat, part: part[r] }).collect::<Vec<_>>()
        })
        .collect();
    charts.insert(0, HeadChart { flat: face, part: Part::Face });
    monitor.check_stop()?;
    halve_stretched(mesh, &mut charts);
    charts.iter_mut().for_each(|chart| sized(mesh, &mut chart.flat));
    Ok(Some(charts))
}

/// Gives a chart the area of its surface.
fn sized(mesh: &Mesh, flat: &mut Flat) {
    let surface: f64 = flat.triangles.iter().map(|&t| mesh.area(t)).sum();
    let scale = (surface / flat.area()).sqrt();
    flat.points.iter_mut().for_each(|p| *p *= scale);
}

fn of(region: &[u32], wanted: usize) -> Vec<u32> {
    (0..region.len() as u32).filter(|&t| region[t as usize] as usize == wanted).collect()
}

/// Returns triangles as one chart of their true sizes; `None` if they are no disc.
fn laid(mesh: &Mesh, smooth: &Mesh, triangles: &[u32]) -> Option<Flat> {
    // the true shape begins closer to its sizes, the smooth one has no needles
    let mut flat = embedded(mesh, triangles).or_else(|| embedded(smooth, triangles))?;
    relax(mesh, &mut flat, RELAXING);
    Some(flat)
}

/// Returns connected triangles as charts; what is no disc is halved across its longest extent.
/// Triangles that never become one are left out.
fn discs(
    mesh: &Mesh,
    smooth: &Mesh,
    adjacent: &[[u32; 3]],
    triangles: Vec<u32>,
    halvings: usize,
) -> Vec<Flat> {
    if triangles.is_empty() {
        return Vec::new();
    }
    if let Some(flat) = laid(mesh, smooth, &triangles) {
        return vec![flat];
    }
    if halvings == 0 {
        return Vec::new();
    }
    let middle = |t: u32| smooth.corners(t).iter().sum::<Vec3>() / 3.0;
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    triangles.iter().for_each(|&t| (low, high) = (low.min(middle(t)), high.max(middle(t))));
    let (axis, center) = ((high - low).max_position(), 0.5 * (low + high));
    let mut side = vec![0u8; adjacent.len()];
    triangles.iter().for_each(|&t| side[t as usize] = 1 + u8::from(middle(t)[axis] > center[axis]));
    let piece = components(adjacent, &side);
    let mut numbers: Vec<u32> = triangles.iter().map(|&t| piece[t as usize]).collect();
    numbers.sort_unstable();
    numbers.dedup();
    let pieces = numbers.into_iter().map(|n| of(&piece, n as usize));
    pieces.flat_map(|p| discs(mesh, smooth, adjacent, p, halvings - 1)).collect()
}

/// Halves the chart that stretches most, the face's never, as long as there may be more charts.
fn halve_stretched(mesh: &Mesh, charts: &mut Vec<HeadChart>) {
    let mut kept: Vec<HeadChart> = Vec::new();
    while charts.len() + kept.len() < MAX_CHARTS {
        let cost = |c: &HeadChart| (stretch(mesh, &c.flat) - STRETCH) * c.flat.area();
        let costs: Vec<f64> = charts.iter().map(cost).collect();
        let open = (0..charts.len()).filter(|&c| charts[c].part != Part::Face && costs[c] > 0.0);
        let Some(worst) = open.max_by(|&a, &b| costs[a].total_cmp(&costs[b])) else { break };
        let HeadChart { flat, part } = charts.swap_remove(worst);
        let mut pieces = halves(&flat);
        if charts.len() + kept.len() + pieces.len() > MAX_CHARTS {
            kept.push(HeadChart { flat, part });
            continue;
        }
        pieces.iter_mut().for_each(|piece| relax(mesh, piece, RELAXING / 3));
        charts.extend(pieces.into_iter().map(|flat| HeadChart { flat, part }));
    }
    charts.append(&mut kept);
}
