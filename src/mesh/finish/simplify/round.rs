//! Collapses in the order of their cost, then all vertices to the field.

use super::collapse::{Star, place};
use super::crossing::{Sheets, crossings};
use super::fit::{middles, move_to, offsets, reaches};
use super::hold::{BORDER, HELD};
use super::options::{SimplifyConfig, SimplifyReport, VertexPlacement};
use super::queue::{EdgeQueue, Entry};
use super::rings::{CROWDED, Rings};
use crate::geom::{Aabb, Mesh};
use crate::mesh::input::{Field, evaluate};
use crate::mesh::moves::newton;
use crate::{Monitor, Result};
use glam::Vec3;

/// Buckets that a cost may have grown since the edge was entered: a quarter of it.
const SLACK: usize = 4;

/// Of the edges of a new vertex only this many, the cheapest, are entered. The vertices around have theirs
/// from before; all seven would take a tenth longer and win a hundredth of the error.
const OFFERS: usize = 3;

/// Asking whether to stop costs nothing this often.
const BREATH: usize = 1 << 12;

/// Which collapses are tested for crossings.
#[derive(Clone, Copy)]
pub(super) enum CrossingSearch<'a> {
    Nowhere,
    /// Around these points, within these distances.
    Near(&'a [(Vec3, f32)]),
    Everywhere,
}

impl CrossingSearch<'_> {
    /// Returns whether a collapse here is to be tested.
    fn at(&self, p: Vec3) -> bool {
        match self {
            CrossingSearch::Nowhere => false,
            CrossingSearch::Near(balls) => balls.iter().any(|(c, r)| p.distance_squared(*c) <= r * r),
            CrossingSearch::Everywhere => true,
        }
    }

    fn is_nowhere(&self) -> bool {
        matches!(self, CrossingSearch::Nowhere)
    }
}

/// What every round needs to know.
#[derive(Clone, Copy)]
pub(super) struct Task<'a> {
    pub field: Option<&'a Field<'a>>,
    pub config: &'a SimplifyConfig,
    pub look: CrossingSearch<'a>,
    pub monitor: &'a dyn Monitor,
}

/// Collapses down to the number of triangles asked for, then takes the vertices to the field.
pub(super) fn counted(mesh: &Mesh, task: &Task, report: &mut SimplifyReport) -> Result<Mesh> {
    let mut rings = prepare(mesh, task, report);
    reduce(&mut rings, task, task.config.triangles, None, report)?;
    let (mut out, fixed) = rings.into_mesh();
    if let Some(field) = task.field {
        settle(&mut out, &fixed, field, task, task.config.placement, report)?;
    }
    let values = [("triangles", out.triangles.len() as f64), ("refused", report.refused as f64)];
    task.monitor.step(1, 1, &values);
    Ok(out)
}

/// A mesh ready for collapses.
pub(super) fn prepare(mesh: &Mesh, task: &Task, report: &mut SimplifyReport) -> Rings {
    let mut rings = Rings::new(mesh);
    report.degenerate += mesh.triangles.len() - rings.triangles.len();
    report.held = rings.flags.iter().filter(|&&f| f & HELD != 0).count();
    if !task.look.is_nowhere() {
        for (flags, &p) in rings.flags.iter_mut().zip(&rings.positions) {
            *flags |= if task.look.at(p) { CROWDED } else { 0 };
        }
    }
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
    let mut star = Star::new(rings.positions.len());
    let mut sheets = (!task.look.is_nowhere()).then(|| Sheets::new(rings));
    let mut breath = 0;
    let mut offers: Vec<(u32, u32)> = Vec::new();
    // What was refused may be possible when all around has changed: so once more until nothing is.
    loop {
        let before = rings.count;
        let mut queue = fill(rings);
        while rings.count > target {
            breath += 1;
            if breath % BREATH == 0 {
                task.monitor.check_stop()?;
            }
            let Some((bucket, Entry { a, b, stamp })) = queue.pop() else { break };
            if rings.stamp(a, b) != stamp {
                continue; // an end is gone, or its edges were entered anew
            }
            let Some((x, cost)) = place(rings, a, b) else { continue };
            let now = EdgeQueue::bucket(cost);
            if now > bucket + SLACK {
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
                let crowded = (rings.flags[a as usize] | rings.flags[b as usize]) & CROWDED != 0;
                let made = star.sides.iter().map(|s| {
                    let [p, q] = [s.from, s.to].map(|v| rings.positions[v as usize]);
                    ([a, s.from, s.to], [x, p, q])
                });
                if crowded && sheets.would_cross(rings, star.triangles(), made) {
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
            if offers.len() > OFFERS {
                offers.select_nth_unstable(OFFERS - 1);
                offers.truncate(OFFERS);
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

/// All edges.
fn fill(rings: &Rings) -> EdgeQueue {
    let mut queue = EdgeQueue::new();
    for t in rings.alive() {
        let triangle = rings.triangles[t as usize];
        for k in 0..3 {
            let (a, b) = (triangle[k], triangle[(k + 1) % 3]);
            // inner edges are met from both ends, those of a border from one
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

/// Takes the vertices that are not `fixed` to the field, and their normals from it.
pub(super) fn settle(
    mesh: &mut Mesh,
    fixed: &[bool],
    field: &Field,
    task: &Task,
    placement: VertexPlacement,
    report: &mut SimplifyReport,
) -> Result<()> {
    let reaches = reaches(&mesh.positions, &mesh.triangles);
    let start = mesh.positions.clone();
    let batch = task.config.batch;
    let mut gradients = Vec::new();
    let steps = match placement {
        VertexPlacement::OnSurface => 2,
        VertexPlacement::Nearest => 1,
    };
    for _ in 0..steps {
        let (values, slopes) = evaluate(field, &mesh.positions, batch, task.monitor)?;
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
                let (f, g) = evaluate(field, &points, batch, task.monitor)?;
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
    if !task.look.is_nowhere() {
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
