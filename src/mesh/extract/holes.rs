//! Small holes are closed by the triangulation of least area (Barequet & Sharir 1995; Liepa 2003, section 3).
//!
//! Extraction leaves none; faces that were dropped for lying on each other can, and meshes of others do. No
//! vertex is added, so nothing needs fairing: a hole worth that is larger than what is filled here.

use crate::geom::{Mesh, sorted_sides};
use glam::DVec3;
use std::collections::{HashMap, HashSet};

/// Sides of the largest hole that is filled.
const MOST_SIDES: usize = 64;

/// A triangle with less area than this share of a side's square is flat.
const FLAT: f64 = 1e-4;

/// Closes holes of at most 64 sides in place; every vertex must have one fan. Returns how many, and with how
/// many triangles.
pub(super) fn fill_holes(mesh: &mut Mesh) -> (usize, usize) {
    let mut next: HashMap<u32, u32> = HashMap::new();
    let mut rim = Vec::new();
    for run in sorted_sides(&mesh.triangles).chunk_by(|a, b| a.0 == b.0) {
        if let [(_, side)] = *run {
            let t = mesh.triangles[side as usize / 3];
            let (a, b) = (t[side as usize % 3], t[(side as usize + 1) % 3]);
            // around the hole the other way than along the triangle
            next.insert(b, a);
            rim.push(b);
        }
    }
    if rim.is_empty() {
        return (0, 0);
    }
    let sides: HashSet<(u32, u32)> = (mesh.triangles.iter())
        .flat_map(|t| (0..3).map(|k| (t[k].min(t[(k + 1) % 3]), t[k].max(t[(k + 1) % 3]))))
        .collect();
    rim.sort_unstable();
    let mut seen: HashSet<u32> = HashSet::new();
    let (mut holes, before) = (0, mesh.triangles.len());
    for start in rim {
        let mut hole = Vec::new();
        let mut v = start;
        // a chain that does not come back belongs to no hole
        while seen.insert(v) {
            hole.push(v);
            match next.get(&v) {
                Some(&n) => v = n,
                None => break,
            }
        }
        if v != start || !(3..=MOST_SIDES).contains(&hole.len()) {
            continue;
        }
        let points: Vec<DVec3> = hole.iter().map(|&v| mesh.positions[v as usize].as_dvec3()).collect();
        let n = hole.len();
        let taken = |i: usize, j: usize| {
            let beside = j == i + 1 || (i == 0 && j == n - 1);
            !beside && sides.contains(&(hole[i].min(hole[j]), hole[i].max(hole[j])))
        };
        if let Some(triangles) = least_area(&points, taken) {
            holes += 1;
            mesh.triangles.extend(triangles.into_iter().map(|t| t.map(|i| hole[i])));
        }
    }
    (holes, mesh.triangles.len() - before)
}

/// Returns the triangulation of a closed polygon with the least area, its corners in the polygon's order. A diagonal
/// that is `taken` would give an edge a third triangle; `None` if those cannot be avoided.
pub(super) fn least_area(points: &[DVec3], taken: impl Fn(usize, usize) -> bool) -> Option<Vec<[usize; 3]>> {
    let n = points.len();
    let at = |i: usize, j: usize| i * n + j;
    let mut cost = vec![f64::INFINITY; n * n];
    let mut apex = vec![usize::MAX; n * n];
    for i in 0..n - 1 {
        cost[at(i, i + 1)] = 0.0;
    }
    for span in 2..n {
        for i in 0..n - span {
            let j = i + span;
            if taken(i, j) {
                continue;
            }
            for k in i + 1..j {
                let area = 0.5 * (points[k] - points[i]).cross(points[j] - points[i]).length();
                // along a straight side a triangle without area would cost nothing: only if nothing else is left
                let across = points[j].distance_squared(points[i]);
                let flat = if area <= FLAT * across { across / FLAT } else { 0.0 };
                let sum = cost[at(i, k)] + cost[at(k, j)] + area + flat;
                if sum < cost[at(i, j)] {
                    cost[at(i, j)] = sum;
                    apex[at(i, j)] = k;
                }
            }
        }
    }
    if !cost[at(0, n - 1)].is_finite() {
        return None;
    }
    let (mut open, mut out) = (vec![(0, n - 1)], Vec::with_capacity(n - 2));
    while let Some((i, j)) = open.pop() {
        if j > i + 1 {
            let k = apex[at(i, j)];
            out.push([i, k, j]);
            open.extend([(i, k), (k, j)]);
        }
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// The unit cube with each face in 4 × 4 squares, two triangles each.
    fn cube() -> Mesh {
        let mut mesh = Mesh::default();
        let mut number: HashMap<[i32; 3], u32> = HashMap::new();
        let mut vertex = |p: [i32; 3]| {
            *number.entry(p).or_insert_with(|| {
                mesh.positions.push(Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32) / 4.0);
                mesh.positions.len() as u32 - 1
            })
        };
        let mut triangles = Vec::new();
        for axis in 0..3 {
            for (side, turned) in [(0, true), (4, false)] {
                for q in 0..16 {
                    let mut corner = |u: i32, v: i32| {
                        let mut p = [0; 3];
                        p[axis] = side;
                        p[(axis + 1) % 3] = q % 4 + u;
                        p[(axis + 2) % 3] = q / 4 + v;
                        vertex(p)
                    };
                    let [a, b, c, d] = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                    let two = [[a, b, c], [a, c, d]];
                    triangles.extend(two.map(|[a, b, c]| if turned { [a, c, b] } else { [a, b, c] }));
                }
            }
        }
        mesh.triangles = triangles;
        assert!(mesh.is_closed());
        mesh
    }

    fn volume(mesh: &Mesh) -> f64 {
        (mesh.triangles.iter())
            .map(|t| {
                let [a, b, c] = t.map(|i| mesh.positions[i as usize].as_dvec3());
                a.dot(b.cross(c)) / 6.0
            })
            .sum()
    }

    #[test]
    fn holes_in_a_plane_are_filled_as_they_were() {
        let mut mesh = cube();
        // a square of one face, and one triangle of another
        mesh.triangles.drain(40..42);
        mesh.triangles.remove(100);
        assert!(!mesh.is_closed());
        assert_eq!(fill_holes(&mut mesh), (2, 3));
        assert!(mesh.is_closed());
        assert!((volume(&mesh) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn a_hole_around_a_corner_is_filled_by_the_least_area() {
        let mut mesh = cube();
        let corner = mesh.positions.iter().position(|p| *p == Vec3::ONE).unwrap() as u32;
        mesh.triangles.retain(|t| !t.contains(&corner));
        assert_eq!(fill_holes(&mut mesh).0, 1);
        assert!(mesh.is_closed());
        // at most the corner's pyramid over the hole is missing: half of a sixteenth of a face, a quarter deep
        assert!(volume(&mesh) < 1.0 && volume(&mesh) > 1.0 - 1.0 / 64.0);
    }

    #[test]
    fn large_openings_and_closed_meshes_stay() {
        let mut mesh = cube();
        let whole = mesh.clone();
        assert_eq!(fill_holes(&mut mesh), (0, 0));
        assert_eq!(mesh, whole);
        // a long strip has more sides than are filled
        let strip =
            (0..40u32).flat_map(|i| [[2 * i, 2 * i + 2, 2 * i + 1], [2 * i + 1, 2 * i + 2, 2 * i + 3]]);
        let mut strip = Mesh {
            positions: (0..82).map(|i| Vec3::new((i / 2) as f32, (i % 2) as f32, 0.0)).collect(),
            triangles: strip.collect(),
            ..Mesh::default()
        };
        assert_eq!(fill_holes(&mut strip), (0, 0));
    }

    #[test]
    fn a_straight_side_of_many_vertices_gets_no_triangle_without_area() {
        // a square of 4 × 1 with the long sides in quarters
        let at = |i: usize| match i {
            0..=4 => DVec3::new(i as f64, 0.0, 0.0),
            _ => DVec3::new(9.0 - i as f64, 1.0, 0.0),
        };
        let points: Vec<DVec3> = (0..10).map(at).collect();
        let found = least_area(&points, |_, _| false).unwrap();
        let area = |t: &[usize; 3]| {
            let [a, b, c] = t.map(|i| points[i]);
            0.5 * (b - a).cross(c - a).z
        };
        assert!(found.iter().all(|t| area(t) > 0.1), "{found:?}");
        assert!((found.iter().map(area).sum::<f64>() - 4.0).abs() < 1e-12);
    }

    #[test]
    fn a_diagonal_that_is_an_edge_already_is_not_made_again() {
        // a square whose one diagonal is taken: the other, although it is the longer one in space
        let points = [DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.5), DVec3::Y];
        let free = least_area(&points, |_, _| false).unwrap();
        let by = |i: usize, j: usize| (i, j) == (0, 2);
        let forced = least_area(&points, by).unwrap();
        assert!(forced.iter().all(|t| !(t.contains(&0) && t.contains(&2))), "{forced:?} {free:?}");
        assert!(least_area(&points, |_, j| j != 3).is_some());
        assert!(least_area(&points, |i, j| (i, j) == (0, 2) || (i, j) == (1, 3)).is_none());
    }
}
