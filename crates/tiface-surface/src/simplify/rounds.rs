//! Rounds of collapses and evaluations of the field: to a number of triangles, or to as few as an
//! error allows.
//!
//! Between two evaluations of the field a collapse is only believed to stray as far as its new
//! vertex lies from the planes before it, added up. Each round may use what the measured error
//! leaves at each vertex, and is measured: at corners, middles of edges and of triangles. A round
//! that went too far is undone and repeated with a smaller part. A ball takes 2.2 to 2.4 times the
//! fewest triangles that would do.

use super::collapse::reduce;
use super::rings::{FIXED, Rings};
use super::to_field::{VertexPlacement, project_to_field};
use super::{SimplifyReport, Task};
use crate::evaluate;
use crate::extract::BATCH;
use crate::moves::newton;
use glam::Vec3;
use tiface_base::Result;
use tiface_base::geom::Mesh;

/// Collapses edges down to the requested number of triangles, then moves the vertices onto the
/// field's zero.
pub(super) fn counted(mesh: &Mesh, task: &Task, report: &mut SimplifyReport) -> Result<Mesh> {
    let mut rings = prepare(mesh, report);
    rings.importance.clone_from(&task.config.importance);
    reduce(&mut rings, task, task.config.triangles, None, report)?;
    let (mut out, fixed) = rings.into_mesh();
    if let Some(field) = task.field {
        project_to_field(&mut out, &fixed, field, task, VertexPlacement::Nearest, report)?;
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
        project_to_field(&mut next, &fixed, field, task, VertexPlacement::OnSurface, report)?;
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
        project_to_field(&mut good, &fixed, field, task, VertexPlacement::OnSurface, report)?;
    }
    Ok(good)
}

fn worst(errors: &[f32]) -> f32 {
    errors.iter().copied().fold(0.0, f32::max)
}

/// Returns for every vertex the largest distance to the surface at corners, middles of edges and
/// middles of the triangles around it.
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
