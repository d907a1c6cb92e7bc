//! A surface divided into few charts: along the lines of a smooth copy, what is too small joined to
//! a neighbor, laid flat, and relaxed to the sizes of the true surface.
//!
//! ```text
//! smooth → divide (uvunwrap) → join the small → flatten the regions → relax on the true surface
//! ```
//!
//! Divided as it is, a learned head gives hundreds of charts: a rough garment or the rim of a cap
//! tilts single triangles away from the mean of their chart, and each of them costs a gutter and a
//! seam.

use super::chart::{Flat, stretch};
use super::flatten::{ChartSet, STRETCHED, flatten};
use super::patches::{NONE, neighbors, straighten};
use super::relax::relax;
use super::smooth::smoothed;
use glam::{DVec2, Vec2};
use rayon::prelude::*;
use std::collections::HashMap;
use tiface_base::geom::{Mesh, Sets, THOROUGH_EFFORT, overlaps};
use tiface_base::{Monitor, Result};

/// Rounds of smoothing for the copy that is divided. Of `lps` at 50 k triangles: 515 charts
/// without, 22 with 3 rounds, 19 with 30; with 60, limbs become strings.
const SMOOTHING: usize = 30;

/// Share of the surface below which a chart joins a neighbor.
const MIN_CHART_SHARE: f64 = 0.008;

/// Times that regions are joined and laid flat.
const JOINS: usize = 2;

/// Maximum number of steps of relaxing, and of triangles times steps: charts of very many triangles
/// are smooth ones, whose sizes are nearly right after half of the steps.
const RELAXING: usize = 100;
const RELAXING_WORK: usize = 1_000_000;

/// Mean area stretch, (r + 1/r) / 2, r being the scale of areas, from which a relaxed chart is
/// halved, and which a face may have.
pub(super) const STRETCH: f64 = 1.05;

/// Maximum number of times a chart is halved.
const SPLITS: usize = 3;

/// Divides a mesh and lays it flat.
pub(super) fn divide(mesh: &Mesh, monitor: &dyn Monitor) -> Result<ChartSet> {
    let adjacent = neighbors(mesh);
    let smooth = smoothed(mesh, SMOOTHING);
    let mut best = flatten(&smooth, None, STRETCHED, monitor)?;
    for _ in 0..JOINS {
        let labels = joined(mesh, &adjacent, labels(&best, mesh.triangles.len()), MIN_CHART_SHARE);
        let regions = labels.iter().max().map_or(0, |most| *most as usize + 1);
        if regions == best.charts.len() {
            break;
        }
        let next = flatten(&smooth, Some(&labels), STRETCHED, monitor)?;
        if next.charts.len() >= best.charts.len() {
            break;
        }
        best = next;
    }
    best.charts = best.charts.into_par_iter().flat_map_iter(|chart| settled(mesh, chart, SPLITS)).collect();
    Ok(best)
}

/// Returns a chart at its true sizes, or its halves if it cannot have them without stretching.
fn settled(mesh: &Mesh, mut chart: Flat, splits: usize) -> Vec<Flat> {
    let steps = (RELAXING_WORK / chart.triangles.len().max(1)).clamp(RELAXING / 4, RELAXING);
    relax(mesh, &mut chart, steps);
    if splits == 0 || stretch(mesh, &chart) <= STRETCH {
        return uncovered(chart);
    }
    halves(&chart).into_iter().flat_map(|half| settled(mesh, half, splits - 1)).collect()
}

/// Returns the parts of a chart on both sides of a line across its longer side.
pub(super) fn halves(chart: &Flat) -> Vec<Flat> {
    let middle = |k: usize| chart.at(k).iter().sum::<DVec2>() / 3.0;
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for p in &chart.points {
        (low, high) = (low.min(*p), high.max(*p));
    }
    let axis = if high.x - low.x >= high.y - low.y { DVec2::X } else { DVec2::Y };
    let line = 0.5 * (low + high).dot(axis);
    let half = |side: bool| chart.parts(|k| (middle(k).dot(axis) < line) == side);
    [true, false].into_iter().flat_map(half).collect()
}

/// Returns a chart in pieces that do not cover themselves: relaxing lets borders go where they
/// like, and where two of them meet, the smaller of the two strips that lie over each other becomes
/// a chart of its own.
fn uncovered(chart: Flat) -> Vec<Flat> {
    let points: Vec<Vec2> = chart.points.iter().map(|p| p.as_vec2()).collect();
    let pairs = overlaps(&points, &chart.corners, &vec![true; chart.corners.len()], THOROUGH_EFFORT).pairs;
    if pairs.is_empty() {
        return vec![chart];
    }
    let mut over = vec![false; chart.corners.len()];
    pairs.iter().for_each(|&(a, b)| (over[a as usize], over[b as usize]) = (true, true));
    let place: HashMap<u32, u32> = chart.triangles.iter().zip(0..).map(|(&t, k)| (t, k)).collect();
    let mut strips: Vec<Vec<u32>> = chart
        .parts(|k| over[k])
        .iter()
        .map(|strip| strip.triangles.iter().map(|t| place[t]).collect())
        .collect();
    strips.sort_by_key(Vec::len);
    let mut strip_of = vec![NONE; chart.corners.len()];
    for (s, strip) in strips.iter().enumerate() {
        strip.iter().for_each(|&k| strip_of[k as usize] = s as u32);
    }
    let mut taken = vec![false; strips.len()];
    for &(a, b) in &pairs {
        let (a, b) = (strip_of[a as usize], strip_of[b as usize]);
        if !taken[a as usize] && !taken[b as usize] {
            taken[a.min(b) as usize] = true;
        }
    }
    let loose = |k: usize| strip_of[k] != NONE && taken[strip_of[k] as usize];
    let mut out = chart.parts(|k| !loose(k));
    out.extend(chart.parts(loose));
    out
}

/// Returns the chart of each triangle; one without a chart has a number of its own.
fn labels(flat: &ChartSet, count: usize) -> Vec<u32> {
    let mut label = vec![NONE; count];
    for (c, chart) in flat.charts.iter().enumerate() {
        chart.triangles.iter().for_each(|&t| label[t as usize] = c as u32);
    }
    let alone = label.iter_mut().filter(|l| **l == NONE);
    alone.zip(flat.charts.len() as u32..).for_each(|(l, next)| *l = next);
    label
}

/// Returns the number of each triangle's connected piece of one region, counted from 0.
pub(super) fn components<L: PartialEq>(adjacent: &[[u32; 3]], region: &[L]) -> Vec<u32> {
    let mut sets = Sets::new(region.len());
    for (t, beside) in adjacent.iter().enumerate() {
        for &n in beside.iter().filter(|&&n| n != NONE && region[n as usize] == region[t]) {
            sets.join(t as u32, n);
        }
    }
    numbered((0..region.len() as u32).map(|t| sets.find(t)))
}

/// Returns the labels as numbers from 0, in the order in which they appear.
fn numbered(labels: impl Iterator<Item = u32>) -> Vec<u32> {
    let mut number = HashMap::new();
    labels
        .map(|l| {
            let next = number.len() as u32;
            *number.entry(l).or_insert(next)
        })
        .collect()
}

/// Returns the region of each triangle, numbered from 0: its `label`, or the neighbor that joined
/// it because one had less than a share of the surface.
pub(super) fn joined(mesh: &Mesh, adjacent: &[[u32; 3]], mut label: Vec<u32>, min_share: f64) -> Vec<u32> {
    let regions = label.iter().max().map_or(0, |most| most + 1);
    let mut area = vec![0.0; regions as usize];
    // shared border of regions, both ways
    let mut border: Vec<HashMap<u32, f64>> = vec![HashMap::new(); regions as usize];
    for (t, &own) in label.iter().enumerate() {
        let p = mesh.corners(t as u32).map(|p| p.as_dvec3());
        area[own as usize] += mesh.area(t as u32);
        for k in 0..3 {
            let n = adjacent[t][k];
            if n != NONE && label[n as usize] != own {
                *border[own as usize].entry(label[n as usize]).or_default() += p[k].distance(p[(k + 1) % 3]);
            }
        }
    }
    let min_area = min_share * area.iter().sum::<f64>();
    let mut into: Vec<u32> = (0..regions).collect();
    let mut open: Vec<u32> = (0..regions).filter(|&r| area[r as usize] < min_area).collect();
    // the smallest first, so that confetti becomes pieces before pieces are given away
    while let Some(at) = (0..open.len()).min_by(|&a, &b| {
        area[open[a] as usize].total_cmp(&area[open[b] as usize]).then(open[a].cmp(&open[b]))
    }) {
        let small = open.swap_remove(at);
        let longest = border[small as usize].iter().max_by(|a, b| a.1.total_cmp(b.1).then(b.0.cmp(a.0)));
        let Some((&host, _)) = longest else { continue };
        into[small as usize] = host;
        area[host as usize] += area[small as usize];
        for (other, length) in std::mem::take(&mut border[small as usize]) {
            border[other as usize].remove(&small);
            if other != host {
                *border[other as usize].entry(host).or_default() += length;
                *border[host as usize].entry(other).or_default() += length;
            }
        }
        if area[host as usize] >= min_area {
            open.retain(|&r| r != host);
        }
    }
    let root = |mut r: u32| {
        while into[r as usize] != r {
            r = into[r as usize];
        }
        r
    };
    label.iter_mut().for_each(|l| *l = root(*l));
    straighten(adjacent, &mut label);
    numbered(label.into_iter())
}

#[cfg(test)]
mod tests {

    use super::super::patches::neighbors;
    use super::*;
    use glam::Vec3;
    use tiface_base::Quiet;

    /// `n` × `n` unit squares, two triangles each, with heights.
    fn sheet(n: u32, height: impl Fn(u32, u32) -> f32) -> Mesh {
        let at = |i: u32| (i % (n + 1), i / (n + 1));
        let positions =
            (0..(n + 1) * (n + 1)).map(at).map(|(x, y)| Vec3::new(x as f32, y as f32, height(x, y)));
        let squares = (0..n * n).map(|q| q % n + (n + 1) * (q / n));
        let triangles = squares.flat_map(|a| [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
        Mesh { positions: positions.collect(), triangles: triangles.collect(), ..Mesh::default() }
    }

    fn charts(mesh: &Mesh, label: impl Fn(u32) -> u32) -> ChartSet {
        let mut of: Vec<Flat> = Vec::new();
        for t in 0..mesh.triangles.len() as u32 {
            let l = label(t) as usize;
            of.resize(of.len().max(l + 1), Flat::default());
            of[l].triangles.push(t);
        }
        ChartSet { charts: of, without: Vec::new() }
    }

    #[test]
    fn a_crumb_joins_the_neighbor_with_the_longest_border() {
        // 20 × 20 squares: left and right half, and one square on the left of the line between them
        let mesh = sheet(20, |_, _| 0.0);
        let crumb = |q: u32| q % 20 == 9 && q / 20 == 10;
        let flat = charts(&mesh, |t| if crumb(t / 2) { 2 } else { u32::from(t / 2 % 20 >= 10) });
        let labels = joined(&mesh, &neighbors(&mesh), labels(&flat, mesh.triangles.len()), MIN_CHART_SHARE);
        // three of its sides are the left half's
        assert!((0..800).all(|t: u32| labels[t as usize] == u32::from(t / 2 % 20 >= 10)));
    }

    #[test]
    fn triangles_without_a_chart_find_one_and_islands_stay() {
        let mut mesh = sheet(20, |_, _| 0.0);
        let island = mesh.positions.len() as u32;
        mesh.positions.extend([Vec3::ONE * 40.0, Vec3::new(41.0, 40.0, 40.0), Vec3::new(40.0, 41.0, 40.0)]);
        mesh.triangles.push([island, island + 1, island + 2]);
        let mut flat = charts(&mesh, |t| u32::from(t == 800));
        flat.charts[0].triangles.retain(|t| !(300..303).contains(t));
        let labels = joined(&mesh, &neighbors(&mesh), labels(&flat, mesh.triangles.len()), MIN_CHART_SHARE);
        assert!((0..800).all(|t| labels[t] == 0) && labels[800] == 1);
    }

    #[test]
    fn the_smaller_of_two_strips_over_each_other_becomes_a_chart() {
        // a strip of 40 squares bent to a spiral: its last squares lie over its first
        let mut chart = Flat::default();
        for i in 0..=40 {
            let turn = f64::from(i) / 36.0 * std::f64::consts::TAU;
            let at = DVec2::from_angle(turn);
            chart.points.extend([0.8 * at, at]);
        }
        for i in 0..40u32 {
            chart.corners.extend([[2 * i, 2 * i + 1, 2 * i + 3], [2 * i, 2 * i + 3, 2 * i + 2]]);
        }
        chart.triangles = (100..180).collect();
        let pieces = uncovered(chart);
        let mut sizes: Vec<usize> = pieces.iter().map(|p| p.triangles.len()).collect();
        sizes.sort_unstable();
        // four squares lie over four others
        assert_eq!(sizes, [8, 72]);
        for piece in pieces {
            assert_eq!(uncovered(piece).len(), 1);
        }
    }

    #[test]
    fn rough_ground_becomes_few_charts_that_keep_their_areas() {
        // heights of up to a square's width from a fixed hash: sides that lean 45 degrees
        // everywhere
        let rough = |x: u32, y: u32| ((x * 7919 + y * 104_729) % 97) as f32 / 97.0;
        let mesh = sheet(40, rough);
        let direct = flatten(&mesh, None, STRETCHED, &Quiet).unwrap();
        let divided = divide(&mesh, &Quiet).unwrap();
        assert!(
            divided.charts.len() <= 2,
            "{} charts, {} without",
            divided.charts.len(),
            direct.charts.len()
        );
        let mut seen = vec![0; mesh.triangles.len()];
        divided.charts.iter().flat_map(|c| &c.triangles).for_each(|&t| seen[t as usize] += 1);
        assert!(seen.iter().all(|&n| n == 1));
        assert!(divided.charts.iter().all(|c| stretch(&mesh, c) < STRETCH));
    }
}
