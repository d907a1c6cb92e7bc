//! Vertices of a simplified mesh to the field's zero, or to where their triangles lie nearest to
//! it.
//!
//! - Newton: `p −= f g / |g|²`, twice, each step cut at half the mean length of the vertex's edges.
//! - Fit: with every vertex on the surface the triangles are chords, all on one side of a curve.
//!   Offsets `δ` along the gradients minimize `∫ (d + Σ φᵢ δᵢ)²`, where `d` is the distance of the
//!   triangles to the surface and `φ` the hat functions: `M δ = −∫ d φᵢ`, `M` the mass matrix of
//!   the mesh, solved by conjugate gradients. That takes out three quarters of the error on a
//!   sphere.
//!
//! A vertex whose move would turn a triangle or make it a sliver, as no collapse may, moves half
//! the way, a quarter, or stays.

use super::collapse::{MIN_QUALITY, MIN_TURN_COSINE};
use super::crossing::without_crossings;
use super::{SimplifyReport, Task};
use crate::evaluate;
use crate::extract::BATCH;
use crate::moves::{MoveLimits, move_to, newton};
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::Result;
use tiface_base::geom::{Mesh, SdfField, area_vector};
use tiface_base::math::cg::conjugate_gradients;

/// Placement of the vertices.
#[derive(Clone, Copy)]
pub(super) enum VertexPlacement {
    /// On the field's zero. Between them the triangles are chords.
    OnSurface,
    /// At the least-squares zero of their triangles.
    Nearest,
}

/// The limits of a collapse hold for moves after it.
const LIMITS: MoveLimits = MoveLimits { turn_cosine: MIN_TURN_COSINE, quality: MIN_QUALITY };

/// Moves the vertices that are not `fixed` to the field, and takes their normals from it.
pub(super) fn project_to_field(
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
        report.held_back += move_to(&mut mesh.positions, &mesh.triangles, &targets, &LIMITS);
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

/// Offsets of all vertices along their normals that bring the triangles nearest to the surface,
/// from the signed distances at the vertices and at the middles of the triangles.
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
fn middles(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<Vec3> {
    triangles.iter().map(|t| t.iter().map(|&v| positions[v as usize] / 3.0).sum()).collect()
}
