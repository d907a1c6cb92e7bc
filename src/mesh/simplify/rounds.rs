//! Collapses in the order of their cost, then all vertices to the field.
//!
//! # An error to keep
//!
//! As few triangles as an error allows.
//!
//! Between two evaluations of the field a collapse is only believed to stray as far as its new vertex lies from
//! the planes before it, added up. Each round may use what the measured error leaves at each vertex, and
//! is measured: at corners, middles of edges and of triangles. A round that went too far is undone and
//! repeated with a smaller part. A ball takes 2.2 to 2.4 times the fewest triangles that would do.
//!
//! # The field
//!
//! The field has the last word: vertices go to its zero, or to where their triangles lie nearest to it.
//!
//! - Newton: `p −= f g / |g|²`, twice, each step cut at half the mean length of the vertex's edges.
//! - Fit: with every vertex on the surface the triangles are chords, all on one side of a curve. Offsets
//!   `δ` along the gradients minimize `∫ (d + Σ φᵢ δᵢ)²`, where `d` is the distance of the triangles to
//!   the surface and `φ` the hat functions: `M δ = −∫ d φᵢ`, `M` the mass matrix of the mesh, solved by
//!   conjugate gradients. That takes out three quarters of the error on a sphere.
//!
//! A vertex whose move would turn a triangle or make it a sliver, as no collapse may, moves half the way, a quarter, or stays.
//!
//! # The queue
//!
//! Edges in the order of their cost, to a sixteenth of an octave.
//!
//! A heap would order exactly, at a cache miss a level. Here an edge falls into a bucket by the upper
//! bits of its cost (positive floats are ordered as their bits), and a bucket is worked through first
//! in, first out, which also visits neighbours in memory one after another. Outdated entries stay
//! where they are: the caller recognises them by `stamp`.

use super::crossing::{Sheets, crossings};
use super::rings::{BORDER, EdgeLink, FIXED, MIN_QUALITY, MIN_TURN_COSINE, Rings, place};
use super::{SimplifyConfig, SimplifyReport};
use crate::geom::{Aabb, Mesh, SdfField, area_vector, shape};
use crate::math::cg::conjugate_gradients;
use crate::mesh::evaluate;
use crate::mesh::extract::BATCH;
use crate::mesh::moves::{move_vertices, newton};
use crate::{Monitor, Result};
use glam::Vec3;
use rayon::prelude::*;

/// Buckets that a cost may have grown since the edge was entered: a quarter of it.
const COST_SLACK: usize = 4;

/// Maximum number of edges of a new vertex that are queued, the cheapest first. The vertices around have theirs
/// from before; all seven would take a tenth longer and win a hundredth of the error.
const EDGES_PER_VERTEX: usize = 3;

/// Number of collapses between two checks for a stop request.
const STOP_CHECK_INTERVAL: usize = 1 << 12;

/// The data shared by all rounds.
#[derive(Clone, Copy)]
pub(super) struct Task<'a> {
    pub field: Option<&'a dyn SdfField>,
    pub config: &'a SimplifyConfig,
    /// Whether collapses are tested for crossings.
    pub apart: bool,
    pub monitor: &'a dyn Monitor,
}

/// Collapses edges down to the requested number of triangles, then moves the vertices onto the field's zero.
pub(super) fn counted(mesh: &Mesh, task: &Task, report: &mut SimplifyReport) -> Result<Mesh> {
    let mut rings = prepare(mesh, report);
    reduce(&mut rings, task, task.config.triangles, None, report)?;
    let (mut out, fixed) = rings.into_mesh();
    if let Some(field) = task.field {
        settle(&mut out, &fixed, field, task, VertexPlacement::Nearest, report)?;
    }
    let values = [("triangles", out.triangles.len() as f64), ("refused", report.refused as f64)];
    task.monitor.step(1, 1, &values);
    Ok(out)
}

/// Returns a mesh ready for collapses.
fn prepare(mesh: &Mesh, report: &mut SimplifyReport) -> Rings {
    let rings = Rings::new(mesh);
    report.degenerate += mesh.triangles.len() - rings.triangles.len();
    report.held = rings.flags.iter().filter(|&&f| f & FIXED != 0).count();
    rings
}

/// Collapses edges until `target` triangles are left, or no edge may. With `budgets`, a collapse may not
/// stray farther from the planes before it than both its ends have left, and uses that up.
pub(super) fn reduce(
    rings: &mut Rings,
    task: &Task,
    target: usize,
    mut budgets: Option<&mut [f32]>,
    report: &mut SimplifyReport,
) -> Result<()> {
    let mut star = EdgeLink::new(rings.positions.len());
    let mut sheets = task.apart.then(|| Sheets::new(rings));
    let mut breath = 0;
    let mut offers: Vec<(u32, u32)> = Vec::new();
    // A refused collapse may become possible when its surroundings change, so repeat until none is.
    loop {
        let before = rings.count;
        let mut queue = fill(rings);
        while rings.count > target {
            breath += 1;
            if breath % STOP_CHECK_INTERVAL == 0 {
                task.monitor.check_stop()?;
            }
            let Some((bucket, Entry { a, b, stamp })) = queue.pop() else { break };
            if rings.stamp(a, b) != stamp {
                continue; // an end was removed, or its edges were entered again
            }
            let Some((x, cost)) = place(rings, a, b) else { continue };
            let now = EdgeQueue::bucket(cost);
            if now > bucket + COST_SLACK {
                queue.push(now, Entry { a, b, stamp });
                continue;
            }
            if !star.gather(rings, a, b) || !star.fits(rings, x) {
                report.refused += 1;
                continue;
            }
            if let Some(budgets) = budgets.as_deref_mut() {
                let left = budgets[a as usize].min(budgets[b as usize]) - star.strays(rings, x);
                if left < 0.0 {
                    report.refused += 1;
                    continue;
                }
                budgets[a as usize] = left;
            }
            if let Some(sheets) = &mut sheets {
                let made = star.sides.iter().map(|s| {
                    let [p, q] = [s.from, s.to].map(|v| rings.positions[v as usize]);
                    ([a, s.from, s.to], [x, p, q])
                });
                if sheets.would_cross(rings, star.triangles(), made) {
                    report.crossing += 1;
                    continue;
                }
                for side in &star.sides {
                    let [p, q] = [side.from, side.to].map(|v| rings.positions[v as usize]);
                    let old = Aabb::around(rings.corners(side.triangle));
                    sheets.enter(side.triangle, Aabb::around([x, p, q]), Some(old));
                }
            }
            star.apply(rings, a, b, x);
            report.collapses += 1;
            offers.clear();
            for &w in &star.around {
                if let Some((_, cost)) = place(rings, a, w) {
                    offers.push((EdgeQueue::bucket(cost) as u32, w));
                }
            }
            if offers.len() > EDGES_PER_VERTEX {
                offers.select_nth_unstable(EDGES_PER_VERTEX - 1);
                offers.truncate(EDGES_PER_VERTEX);
            }
            for &(bucket, w) in &offers {
                queue.push(bucket as usize, Entry { a, b: w, stamp: rings.stamp(a, w) });
            }
        }
        if rings.count <= target || rings.count as f64 > 0.99 * before as f64 {
            return Ok(());
        }
    }
}

/// Returns all edges.
fn fill(rings: &Rings) -> EdgeQueue {
    let mut queue = EdgeQueue::new();
    for t in rings.alive() {
        let triangle = rings.triangles[t as usize];
        for k in 0..3 {
            let (a, b) = (triangle[k], triangle[(k + 1) % 3]);
            // inner edges are visited from both ends, border edges from one
            let border = rings.flags[a as usize] & rings.flags[b as usize] & BORDER != 0;
            if (a < b || border)
                && let Some((_, cost)) = place(rings, a, b)
            {
                queue.push(EdgeQueue::bucket(cost), Entry { a, b, stamp: rings.stamp(a, b) });
            }
        }
    }
    queue
}

/// Placement of the vertices.
#[derive(Clone, Copy)]
enum VertexPlacement {
    /// On the field's zero. Between them the triangles are chords.
    OnSurface,
    /// At the least-squares zero of their triangles.
    Nearest,
}

/// Takes the vertices that are not `fixed` to the field, and their normals from it.
fn settle(
    mesh: &mut Mesh,
    fixed: &[bool],
    field: &dyn SdfField,
    task: &Task,
    placement: VertexPlacement,
    report: &mut SimplifyReport,
) -> Result<()> {
    let reaches = reaches(&mesh.positions, &mesh.triangles);
    let start = mesh.positions.clone();
    let mut gradients = Vec::new();
    let steps = match placement {
        VertexPlacement::OnSurface => 2,
        VertexPlacement::Nearest => 1,
    };
    for _ in 0..steps {
        let (values, slopes) = evaluate(field, &mesh.positions, BATCH, task.monitor)?;
        report.asked += values.len();
        let targets: Vec<Vec3> = match placement {
            VertexPlacement::OnSurface => (0..values.len())
                .map(|i| {
                    let step = newton(values[i], slopes[i]).filter(|_| !fixed[i]).unwrap_or(Vec3::ZERO);
                    mesh.positions[i] + step.clamp_length_max(reaches[i])
                })
                .collect(),
            VertexPlacement::Nearest => {
                let points = middles(&mesh.positions, &mesh.triangles);
                let (f, g) = evaluate(field, &points, BATCH, task.monitor)?;
                report.asked += f.len();
                let signed = |f: &[f32], g: &[Vec3]| -> Vec<f32> {
                    let d = |(&f, &g): (&f32, &Vec3)| newton(f, g).map_or(0.0, |s| s.length().copysign(f));
                    f.iter().zip(g).map(d).collect()
                };
                let (at_vertices, at_middles) = (signed(&values, &slopes), signed(&f, &g));
                let shift = offsets(&mesh.positions, &mesh.triangles, &at_vertices, &at_middles);
                (0..values.len())
                    .map(|i| {
                        let normal = if fixed[i] { Vec3::ZERO } else { slopes[i].normalize_or_zero() };
                        let step = shift[i] as f32 * normal;
                        let step = if step.is_finite() { step } else { Vec3::ZERO };
                        mesh.positions[i] + step.clamp_length_max(reaches[i])
                    })
                    .collect()
            }
        };
        report.held_back += move_to(&mut mesh.positions, &mesh.triangles, &targets);
        gradients = slopes;
    }
    if task.apart {
        report.held_back += without_crossings(&mut mesh.positions, &mesh.triangles, &start);
    }
    mesh.normals = mesh.angle_weighted_normals();
    for (normal, g) in mesh.normals.iter_mut().zip(&gradients) {
        if g.is_finite() && g.length() >= 1e-6 {
            *normal = g.normalize_or(*normal);
        }
    }
    Ok(())
}

/// Takes back the moves of triangles that meet others now and did not at `start`; how many vertices.
fn without_crossings(positions: &mut [Vec3], triangles: &[[u32; 3]], start: &[Vec3]) -> usize {
    const TRIES: usize = 8;
    let mut old = None;
    let mut back = 0;
    for _ in 0..TRIES {
        let found = crossings(positions, triangles);
        if found.is_empty() {
            return back;
        }
        let old = old.get_or_insert_with(|| crossings(start, triangles));
        let mut any = false;
        for t in found.iter().filter(|t| old.binary_search(t).is_err()) {
            for v in triangles[*t as usize].map(|v| v as usize) {
                any |= positions[v] != start[v];
                back += usize::from(positions[v] != start[v]);
                positions[v] = start[v];
            }
        }
        if !any {
            return back;
        }
    }
    positions.copy_from_slice(start);
    back
}

/// Maximum numbers of rounds and of undone rounds.
const MAX_ROUNDS: usize = 24;
const MAX_UNDONE_ROUNDS: usize = 5;
/// A round gives up at most this share of the triangles: measuring often is cheaper than undoing.
const MAX_SHARE_PER_ROUND: f64 = 0.5;
/// A round that takes less than this share was the last.
const MIN_SHARE_PER_ROUND: f64 = 0.03;

/// Simplifies until the error or the number of triangles is reached.
pub(super) fn bounded(mesh: &Mesh, task: &Task, report: &mut SimplifyReport) -> Result<Mesh> {
    let (error, target) = (task.config.error, task.config.triangles.max(1));
    let Some(field) = task.field else {
        let mut rings = prepare(mesh, report);
        let mut budgets = vec![error; rings.positions.len()];
        reduce(&mut rings, task, target, Some(&mut budgets), report)?;
        return Ok(rings.into_mesh().0);
    };
    let mut good = mesh.clone();
    let mut at = measure(&good, task, report)?;
    report.worst = Some(worst(&at));
    let (mut part, mut undone) = (1.0, 0);
    for round in 0..MAX_ROUNDS {
        let before = good.triangles.len();
        let mut rings = prepare(&good, report);
        let mut budgets: Vec<f32> = at.iter().map(|e| part * (error - e)).collect();
        let goal = target.max((MAX_SHARE_PER_ROUND * before as f64) as usize);
        reduce(&mut rings, task, goal, Some(&mut budgets), report)?;
        let (mut next, fixed) = rings.into_mesh();
        if next.triangles.len() == before {
            break;
        }
        settle(&mut next, &fixed, field, task, VertexPlacement::OnSurface, report)?;
        let errors = measure(&next, task, report)?;
        let found = worst(&errors);
        let after = next.triangles.len();
        task.monitor.step(
            round as u64 + 1,
            MAX_ROUNDS as u64,
            &[("triangles", after as f64), ("worst", f64::from(found))],
        );
        // An input that is farther off than `error` may at least not become worse.
        if found > error.max(report.worst.unwrap_or(0.0)) {
            undone += 1;
            part *= 0.6;
            if undone > MAX_UNDONE_ROUNDS {
                break;
            }
            continue;
        }
        (good, at) = (next, errors);
        report.worst = Some(found);
        if after <= target || after as f64 > (1.0 - MIN_SHARE_PER_ROUND) * before as f64 {
            break;
        }
    }
    if good.normals.is_empty() {
        // no collapse is possible: the input mesh, with normals
        let fixed = vec![true; good.positions.len()];
        settle(&mut good, &fixed, field, task, VertexPlacement::OnSurface, report)?;
    }
    Ok(good)
}

fn worst(errors: &[f32]) -> f32 {
    errors.iter().copied().fold(0.0, f32::max)
}

/// Returns for every vertex the largest distance to the surface at corners, middles of edges and middles of the
/// triangles around it.
fn measure(mesh: &Mesh, task: &Task, report: &mut SimplifyReport) -> Result<Vec<f32>> {
    let mut errors = vec![0.0f32; mesh.positions.len()];
    let Some(field) = task.field else { return Ok(errors) };
    // Each inner edge once, with its place.
    let mut points = mesh.positions.clone();
    let mut whom: Vec<[u32; 3]> = (0..points.len() as u32).map(|v| [v; 3]).collect();
    for t in &mesh.triangles {
        let corners = t.map(|v| mesh.positions[v as usize]);
        points.push((corners[0] + corners[1] + corners[2]) / 3.0);
        whom.push(*t);
        for k in 0..3 {
            let n = (k + 1) % 3;
            if t[k] < t[n] {
                points.push(0.5 * (corners[k] + corners[n]));
                whom.push([t[k], t[n], t[n]]);
            }
        }
    }
    let (f, g) = evaluate(field, &points, BATCH, task.monitor)?;
    report.asked += f.len();
    for (i, whom) in whom.iter().enumerate() {
        let d = newton(f[i], g[i]).map_or(0.0, Vec3::length);
        for &v in whom {
            errors[v as usize] = errors[v as usize].max(d);
        }
    }
    Ok(errors)
}

/// Conjugate gradients on a mass matrix gain a digit in about five steps; two digits are ample.
const STEPS: usize = 12;

/// Returns half the mean length of the edges at each vertex: how far it may go in a step.
fn reaches(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<f32> {
    let mut sums = vec![(0.0f32, 0.0f32); positions.len()];
    for t in triangles {
        for k in 0..3 {
            let (v, w) = (t[k] as usize, t[(k + 1) % 3] as usize);
            let length = positions[v].distance(positions[w]);
            for i in [v, w] {
                sums[i].0 += length;
                sums[i].1 += 1.0;
            }
        }
    }
    sums.iter().map(|&(sum, n)| if n > 0.0 { 0.5 * sum / n } else { 0.0 }).collect()
}

/// Moves vertices to `targets`, or part of the way; how many were held back.
fn move_to(positions: &mut [Vec3], triangles: &[[u32; 3]], targets: &[Vec3]) -> usize {
    let at = |i: usize, p: Vec3, share: f32| match share {
        1.0 => targets[i],
        _ => p + share * (targets[i] - p),
    };
    let spoiled = |t: usize, from: &[Vec3], to: &[Vec3]| {
        let [was, is] = [from, to].map(|p| triangles[t].map(|v| p[v as usize]));
        let (old, new) = (area_vector(was), area_vector(is));
        let along = old.dot(new);
        let turned = along <= MIN_TURN_COSINE * old.length() * new.length() || along.is_nan();
        (turned && old != Vec3::ZERO) || (shape(is) < MIN_QUALITY && shape(is) < shape(was))
    };
    move_vertices(positions, triangles, at, spoiled)
}

/// Offsets of all vertices along their normals that bring the triangles nearest to the surface, from the
/// signed distances at the vertices and at the middles of the triangles.
///
/// The rule `A (3/4 d(middle) + 1/12 Σ d(corner))` integrates quadratics exactly.
fn offsets(positions: &[Vec3], triangles: &[[u32; 3]], at_vertices: &[f32], at_middles: &[f32]) -> Vec<f64> {
    let areas: Vec<f64> = triangles
        .par_iter()
        .map(|t| 0.5 * f64::from(area_vector(t.map(|v| positions[v as usize])).length()))
        .collect();
    // All over A / 12: the mass matrix of a triangle is then 2 on the diagonal and 1 beside it.
    let times = |x: &[f64], y: &mut [f64]| {
        y.fill(0.0);
        for (t, area) in triangles.iter().zip(&areas) {
            let [a, b, c] = t.map(|v| v as usize);
            let sum = x[a] + x[b] + x[c];
            y[a] += area * (sum + x[a]);
            y[b] += area * (sum + x[b]);
            y[c] += area * (sum + x[c]);
        }
    };
    let n = positions.len();
    let (mut residual, mut diagonal) = (vec![0.0f64; n], vec![0.0f64; n]);
    for (i, t) in triangles.iter().enumerate() {
        // 12 (3/4 · 1/3 d + 1/12 dᵢ) = 3 d + dᵢ
        for v in t.map(|v| v as usize) {
            residual[v] -= areas[i] * f64::from(3.0 * at_middles[i] + at_vertices[v]);
            diagonal[v] += 2.0 * areas[i];
        }
    }
    let scaled = |r: &[f64], z: &mut [f64]| {
        for (z, (r, d)) in z.iter_mut().zip(r.iter().zip(&diagonal)) {
            *z = if *d > 0.0 { r / d } else { 0.0 };
        }
    };
    let mut x = vec![0.0; n];
    conjugate_gradients(&mut x, residual, times, scaled, |round, _| round == STEPS);
    x
}

/// Returns the middles of triangles.
pub(super) fn middles(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<Vec3> {
    triangles.iter().map(|t| t.iter().map(|&v| positions[v as usize] / 3.0).sum()).collect()
}

/// Number of leading bits of a cost that select its bucket: sign and exponent, and four bits of the mantissa.
const SHIFT: u32 = 19;

/// A queued edge with the stamps of its ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Entry {
    a: u32,
    b: u32,
    /// Sum of the ends' stamps.
    stamp: u32,
}

/// The buckets.
struct EdgeQueue {
    buckets: Vec<Vec<Entry>>,
    /// No bucket below this one has entries.
    lowest: usize,
    /// Being worked through: entries, how many are done, their bucket.
    current: Vec<Entry>,
    done: usize,
    bucket: usize,
}

impl EdgeQueue {
    fn new() -> EdgeQueue {
        let buckets = vec![Vec::new(); (f32::INFINITY.to_bits() >> SHIFT) as usize + 1];
        EdgeQueue { buckets, lowest: usize::MAX, current: Vec::new(), done: 0, bucket: 0 }
    }

    /// Returns the bucket of a cost ≥ 0; NaN goes last.
    fn bucket(cost: f32) -> usize {
        // + 0 makes −0 and 0 equal
        let cost = if cost.is_nan() { f32::INFINITY } else { cost.max(0.0) + 0.0 };
        (cost.to_bits() >> SHIFT) as usize
    }

    fn push(&mut self, bucket: usize, entry: Entry) {
        self.buckets[bucket].push(entry);
        self.lowest = self.lowest.min(bucket);
    }

    /// Returns the next entry and its bucket.
    fn pop(&mut self) -> Option<(usize, Entry)> {
        while self.done == self.current.len() {
            self.current.clear();
            self.done = 0;
            let next = (self.lowest..self.buckets.len()).find(|&i| !self.buckets[i].is_empty());
            self.lowest = next.unwrap_or(usize::MAX);
            self.bucket = next?;
            std::mem::swap(&mut self.current, &mut self.buckets[self.bucket]);
        }
        self.done += 1;
        Some((self.bucket, self.current[self.done - 1]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cheap_edges_come_first_and_equal_ones_in_their_order() {
        let mut q = EdgeQueue::new();
        for (a, cost) in [(0, 2.0), (1, 1e-20), (2, 2.01), (3, 0.0), (4, f32::NAN), (5, 1e30)] {
            q.push(EdgeQueue::bucket(cost), Entry { a, b: 9, stamp: 0 });
        }
        let order: Vec<u32> = std::iter::from_fn(|| q.pop()).map(|(_, e)| e.a).collect();
        assert_eq!(order, [3, 1, 0, 2, 5, 4]);
        q.push(EdgeQueue::bucket(1.0), Entry { a: 7, b: 9, stamp: 0 });
        assert_eq!(q.pop().map(|(_, e)| e.a), Some(7));
        assert_eq!(q.pop(), None);
    }
}
