//! A disc laid flat without a fold, whatever its shape: its border on a circle, every other point
//! at a weighted mean of its neighbors (Tutte 1963, *How to draw a graph*; Floater 1997). Positive
//! weights and a convex border leave no triangle clockwise; cotangents keep angles where they can.

use super::chart::{Flat, twice_area};
use super::patches::NONE;
use glam::DVec2;
use std::collections::HashMap;
use std::f64::consts::TAU;
use tiface_base::geom::{Mesh, fans, sorted_sides};
use tiface_base::math::cg::{conjugate_gradients, dot};

/// Bounds of a cotangent: angles between 6 and 87 degrees keep theirs.
const COTANGENTS: [f64; 2] = [0.05, 10.0];

/// The residual, over that at the beginning, at which points are where they belong, and the most
/// rounds until then.
const RESIDUAL: f64 = 1e-12;
const ROUNDS: usize = 5000;

/// Returns connected triangles as a chart; `None` if they are no disc.
pub(super) fn embedded(mesh: &Mesh, triangles: &[u32]) -> Option<Flat> {
    let mut flat = unfolded(mesh, triangles);
    let rim = rim(&flat)?;
    let place = |i: u32, corners: &[u32]| mesh.positions[corners[i as usize] as usize].as_dvec3();
    let vertex = vertices(mesh, &flat);
    let lengths: Vec<f64> = (0..rim.len())
        .map(|k| place(rim[k], &vertex).distance(place(rim[(k + 1) % rim.len()], &vertex)))
        .collect();
    let whole: f64 = lengths.iter().sum();
    // two points never in one place
    let least = 1e-3 * whole / rim.len() as f64;
    let around: f64 = lengths.iter().map(|l| l.max(least)).sum();
    let mut run = 0.0;
    for (&point, length) in rim.iter().zip(&lengths) {
        flat.points[point as usize] = DVec2::from_angle(TAU * run / around);
        run += length.max(least);
    }
    let mut is_free = vec![true; flat.points.len()];
    rim.iter().for_each(|&i| is_free[i as usize] = false);
    let edges = edges(mesh, &flat);
    let [x, y] = [0, 1].map(|axis| {
        let start = flat.points.iter().map(|p| p[axis]).collect();
        means(start, &is_free, &edges)
    });
    flat.points = x.into_iter().zip(y).map(|(x, y)| DVec2::new(x, y)).collect();
    (0..flat.corners.len()).all(|k| twice_area(flat.at(k)) > 0.0).then_some(flat)
}

/// Returns triangles as a chart whose points have no place yet. A vertex where several fans of them
/// meet is several points.
fn unfolded(mesh: &Mesh, triangles: &[u32]) -> Flat {
    let faces: Vec<[u32; 3]> = triangles.iter().map(|&t| mesh.triangles[t as usize]).collect();
    let mut fans = fans(&faces, &sorted_sides(&faces));
    let mut number = vec![NONE; 3 * faces.len()];
    let mut count = 0;
    let corners = (0..faces.len() as u32).map(|t| {
        [0, 1, 2].map(|k| {
            let slot = &mut number[fans.find(3 * t + k) as usize];
            if *slot == NONE {
                *slot = count;
                count += 1;
            }
            *slot
        })
    });
    let corners: Vec<[u32; 3]> = corners.collect();
    Flat { triangles: triangles.to_vec(), corners, points: vec![DVec2::ZERO; count as usize] }
}

/// Returns the vertex of each point of a chart.
fn vertices(mesh: &Mesh, flat: &Flat) -> Vec<u32> {
    let mut vertex = vec![NONE; flat.points.len()];
    for (&t, corners) in flat.triangles.iter().zip(&flat.corners) {
        (0..3).for_each(|k| vertex[corners[k] as usize] = mesh.triangles[t as usize][k]);
    }
    vertex
}

/// Returns the points along the border of a chart, counter-clockwise; `None` if it is no disc.
fn rim(flat: &Flat) -> Option<Vec<u32>> {
    let outline = flat.outline();
    let next: HashMap<u32, u32> = outline.iter().copied().collect();
    let first = outline.first()?.0;
    let (mut rim, mut at) = (vec![first], *next.get(&first)?);
    while at != first && rim.len() <= outline.len() {
        rim.push(at);
        at = *next.get(&at)?;
    }
    let (faces, sides) = (flat.corners.len(), (3 * flat.corners.len() + outline.len()) / 2);
    let euler = (flat.points.len() + faces) as i64 - sides as i64;
    (rim.len() == outline.len() && euler == 1).then_some(rim)
}

/// Returns the edges of a chart: their ends and weights.
fn edges(mesh: &Mesh, flat: &Flat) -> Vec<(u32, u32, f64)> {
    let sides = sorted_sides(&flat.corners);
    let weight = |corner: u32| {
        let (t, k) = (flat.triangles[corner as usize / 3], corner as usize % 3);
        let p = mesh.corners(t).map(|p| p.as_dvec3());
        let (u, v) = (p[k] - p[(k + 2) % 3], p[(k + 1) % 3] - p[(k + 2) % 3]);
        let [low, high] = COTANGENTS;
        let cotangent = u.dot(v) / u.cross(v).length();
        if cotangent.is_nan() { low } else { cotangent.clamp(low, high) }
    };
    let ends = |key: u64| ((key >> 32) as u32, key as u32);
    sides
        .chunk_by(|a, b| a.0 == b.0)
        .map(|run| (ends(run[0].0).0, ends(run[0].0).1, run.iter().map(|side| weight(side.1)).sum()))
        .collect()
}

/// Moves the free points to the weighted means of their neighbors.
fn means(mut x: Vec<f64>, is_free: &[bool], edges: &[(u32, u32, f64)]) -> Vec<f64> {
    let mut diagonal = vec![0.0; x.len()];
    for &(a, b, w) in edges {
        diagonal[a as usize] += w;
        diagonal[b as usize] += w;
    }
    let apply = |x: &[f64], out: &mut [f64]| {
        (0..x.len()).for_each(|i| out[i] = diagonal[i] * x[i]);
        for &(a, b, w) in edges {
            let (a, b) = (a as usize, b as usize);
            out[a] -= w * x[b];
            out[b] -= w * x[a];
        }
        (0..x.len()).filter(|&i| !is_free[i]).for_each(|i| out[i] = 0.0);
    };
    let mut residual = vec![0.0; x.len()];
    apply(&x, &mut residual);
    residual.iter_mut().for_each(|r| *r = -*r);
    let end = RESIDUAL * RESIDUAL * dot(&residual, &residual);
    let scaled = |r: &[f64], out: &mut [f64]| (0..r.len()).for_each(|i| out[i] = r[i] / diagonal[i]);
    conjugate_gradients(&mut x, residual, apply, scaled, |round, r| round == ROUNDS || dot(r, r) <= end);
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// Returns `n` × `n` squares in a plane, two triangles each, pulled out to a bulb of this
    /// height in the middle that is wider than its neck.
    fn bulb(n: u32, height: f32) -> Mesh {
        let at = |i: u32| Vec3::new((i % (n + 1)) as f32, (i / (n + 1)) as f32, 0.0);
        let middle = Vec3::new(n as f32, n as f32, 0.0) / 2.0;
        let positions = (0..(n + 1) * (n + 1)).map(|i| {
            let away = at(i) - middle;
            let share = (1.0 - away.length() / (0.4 * n as f32)).max(0.0);
            // radially out again between a quarter and three quarters of the way up
            middle + away * (1.0 + 3.0 * share * share) + height * share * Vec3::Z
        });
        let squares = (0..n * n).map(|q| q % n + (n + 1) * (q / n));
        let triangles = squares.flat_map(|a| [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
        Mesh { positions: positions.collect(), triangles: triangles.collect(), ..Mesh::default() }
    }

    #[test]
    fn a_bulb_is_laid_flat_without_a_fold() {
        let mesh = bulb(16, 40.0);
        let all: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
        let flat = embedded(&mesh, &all).unwrap();
        assert!((0..all.len()).all(|k| twice_area(flat.at(k)) > 0.0));
        // the border is the unit circle, and the triangles fill its polygon
        let rim = rim(&flat).unwrap();
        assert_eq!(rim.len(), 64);
        assert!(rim.iter().all(|&i| (flat.points[i as usize].length() - 1.0).abs() < 1e-12));
        assert!(flat.area() < std::f64::consts::PI && flat.area() > 3.1);
    }

    #[test]
    fn only_discs_are_laid_flat() {
        let mesh = bulb(6, 0.0);
        let of = |wanted: &dyn Fn(u32) -> bool| -> Vec<u32> {
            (0..mesh.triangles.len() as u32).filter(|&t| wanted(t / 2)).collect()
        };
        // a ring of squares, and two squares apart
        assert!(embedded(&mesh, &of(&|q| q != 14)).is_none());
        assert!(embedded(&mesh, &of(&|q| q == 0 || q == 20)).is_none());
        // a ring that is closed by a corner only is a disc: the corner is two points
        let open = of(&|q| ![14, 21].contains(&q) && (q / 6 > 1 || q % 6 < 3) && q % 6 < 5);
        assert!(embedded(&mesh, &open).is_some() || open.is_empty());
    }
}
