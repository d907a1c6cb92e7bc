//! The field has the last word: vertices go to its zero, or to where their triangles lie nearest to it.
//!
//! - Newton: `p −= f g / |g|²`, twice, each step cut at half the mean length of the vertex's edges.
//! - Fit: with every vertex on the surface the triangles are chords, all on one side of a curve. Offsets
//!   `δ` along the gradients minimise `∫ (d + Σ φᵢ δᵢ)²`, where `d` is the distance of the triangles to
//!   the surface and `φ` the hat functions: `M δ = −∫ d φᵢ`, `M` the mass matrix of the mesh, solved by
//!   conjugate gradients. That takes out three quarters of the error on a sphere.
//!
//! A vertex whose move would turn or spoil a triangle, as no collapse may, goes half the way, a quarter, or stays.

use super::collapse::{POOR, TURN, quality_of};
use crate::mesh::MeshError;
use glam::Vec3;
use rayon::prelude::*;

/// Values and gradients at points.
pub(super) type Field<'a> = dyn Fn(&[Vec3]) -> (Vec<f32>, Vec<Vec3>) + Sync + 'a;

/// Conjugate gradients on a mass matrix gain a digit in about five steps; two digits are ample.
const STEPS: usize = 12;

/// Asks the field in batches.
pub(super) fn ask(
    field: &Field,
    points: &[Vec3],
    batch: usize,
    stop: &dyn Fn() -> bool,
) -> Result<(Vec<f32>, Vec<Vec3>), MeshError> {
    let (mut values, mut gradients) = (Vec::with_capacity(points.len()), Vec::with_capacity(points.len()));
    for points in points.chunks(batch) {
        if stop() {
            return Err(MeshError::Stopped);
        }
        let (f, g) = field(points);
        if f.len() != points.len() || g.len() != points.len() {
            let (asked, answered) = (points.len(), f.len().min(g.len()));
            return Err(MeshError::Answer { what: "field", asked, answered });
        }
        values.extend(f);
        gradients.extend(g);
    }
    Ok((values, gradients))
}

/// First-order step to the surface, `−f g / |g|²`; none where the field says nothing useful.
pub(super) fn newton(f: f32, g: Vec3) -> Option<Vec3> {
    let slope = g.length_squared();
    let step = -f / slope * g;
    (slope.is_finite() && slope >= 1e-12 && step.is_finite()).then_some(step)
}

/// Half the mean length of the edges at each vertex: how far it may go in a step.
pub(super) fn reaches(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<f32> {
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
pub(super) fn move_to(positions: &mut [Vec3], triangles: &[[u32; 3]], targets: &[Vec3]) -> usize {
    const SHARES: [f32; 4] = [0.0, 0.25, 0.5, 1.0];
    let from = positions.to_vec();
    positions.copy_from_slice(targets);
    let area = |p: &[Vec3], t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| p[v as usize]);
        (b - a).cross(c - a)
    };
    let spoiled = |to: &[Vec3], t: &[u32; 3]| {
        if t.iter().all(|&v| from[v as usize] == to[v as usize]) {
            return false;
        }
        let (old, new) = (area(&from, t), area(to, t));
        let along = old.dot(new);
        let turned = along <= TURN * old.length() * new.length() || along.is_nan();
        let shape = quality_of(t.map(|v| to[v as usize]));
        (turned && old != Vec3::ZERO) || (shape < POOR && shape < quality_of(t.map(|v| from[v as usize])))
    };
    let mut share = vec![3u8; from.len()];
    let mut watched: Vec<u32> = (0..triangles.len() as u32).collect();
    loop {
        let bad: Vec<u32> =
            watched.par_iter().copied().filter(|&t| spoiled(positions, &triangles[t as usize])).collect();
        let mut corners: Vec<u32> =
            bad.iter().flat_map(|&t| triangles[t as usize]).filter(|&v| share[v as usize] > 0).collect();
        if corners.is_empty() {
            break;
        }
        corners.sort_unstable();
        corners.dedup();
        let mut changed = vec![false; from.len()];
        for &v in &corners {
            let v = v as usize;
            share[v] -= 1;
            changed[v] = true;
            positions[v] = from[v] + SHARES[share[v] as usize] * (targets[v] - from[v]);
        }
        watched = (0..triangles.len() as u32)
            .filter(|&t| triangles[t as usize].iter().any(|&v| changed[v as usize]))
            .collect();
    }
    share.iter().filter(|&&s| s < 3).count()
}

/// Offsets of all vertices along their normals that bring the triangles nearest to the surface, from the
/// signed distances at the vertices and at the middles of the triangles.
///
/// The rule `A (3/4 d(middle) + 1/12 Σ d(corner))` integrates quadratics exactly.
pub(super) fn offsets(
    positions: &[Vec3],
    triangles: &[[u32; 3]],
    at_vertices: &[f32],
    at_middles: &[f32],
) -> Vec<f64> {
    let areas: Vec<f64> = triangles
        .par_iter()
        .map(|t| {
            let [a, b, c] = t.map(|v| positions[v as usize]);
            0.5 * f64::from((b - a).cross(c - a).length())
        })
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
    let scaled = |r: &[f64]| -> Vec<f64> {
        r.iter().zip(&diagonal).map(|(r, d)| if *d > 0.0 { r / d } else { 0.0 }).collect()
    };
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut x = vec![0.0; n];
    let mut z = scaled(&residual);
    let mut direction = z.clone();
    let mut image = vec![0.0; n];
    let mut energy = dot(&residual, &z);
    for _ in 0..STEPS {
        times(&direction, &mut image);
        let along = dot(&direction, &image);
        if !(along > 0.0 && energy > 0.0) {
            break;
        }
        let step = energy / along;
        for i in 0..n {
            x[i] += step * direction[i];
            residual[i] -= step * image[i];
        }
        z = scaled(&residual);
        let next = dot(&residual, &z);
        for i in 0..n {
            direction[i] = z[i] + next / energy * direction[i];
        }
        energy = next;
    }
    x
}

/// The middles of triangles.
pub(super) fn middles(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<Vec3> {
    triangles.iter().map(|t| t.iter().map(|&v| positions[v as usize] / 3.0).sum()).collect()
}
