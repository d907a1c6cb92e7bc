//! The face in one chart: what lies in front of a plane, as deep as it still lies flat.
//!
//! The library has no cost of seams, so its charts meet anywhere, half of their seams in the face.
//! Here the part of the surface around its foremost point, up to a plane across the direction the
//! face looks, is taken out, flattened in one piece by a smooth copy, and relaxed to its true
//! sizes; the rim is the plane's contour, short and out of the way. The rest is divided as any
//! surface.

use super::chart::{NONE, neighbors, part, straighten, stretch};
use super::divide::{STRETCH, divide};
use super::flatten::{ChartSet, STRETCHED, flatten};
use super::relax::relax;
use super::smooth::smoothed;
use glam::Vec3;
use tiface_base::geom::Mesh;
use tiface_base::{Monitor, Result};

/// The deepest plane lies so far behind the foremost point, in parts of the mesh's depth; the
/// others are closer by equal steps.
const MAX_CUT_DEPTH: f32 = 0.5;
const CUT_PLANES: usize = 16;

/// Flattenings that may fail.
const MAX_FAILURES: usize = 8;

/// Rounds of smoothing for the copy that is flattened. With 30 a nose still folds, with 120 the
/// ears of other heads do.
const FACE_SMOOTHING: usize = 60;

/// Most steps of relaxing.
const FACE_RELAXING: usize = 200;

/// The share of the surface that a face may have.
const MAX_FACE_SHARE: f64 = 0.3;

/// Maximum ratio of areas within a chart of the smooth copy: relaxing evens it out.
const MAX_FACE_STRETCH: f32 = 2.0 * STRETCHED;

/// Divides a mesh, with its face in one chart if possible.
pub(super) fn divide_around(mesh: &Mesh, front: Vec3, monitor: &dyn Monitor) -> Result<ChartSet> {
    for inside in caps(mesh, front.normalize()).take(MAX_FAILURES) {
        let (face, number) = part(mesh, |t| inside[t as usize]);
        let whole = vec![0; face.triangles.len()];
        let mut alone = flatten(&smoothed(&face, FACE_SMOOTHING), Some(&whole), MAX_FACE_STRETCH, monitor)?;
        let [chart] = &mut alone.charts[..] else { continue };
        relax(&face, chart, FACE_RELAXING);
        if stretch(&face, chart) > STRETCH {
            continue;
        }
        let (rest, rest_number) = part(mesh, |t| !inside[t as usize]);
        let mut all = divide(&rest, monitor)?.renumbered(&rest_number);
        let alone = alone.renumbered(&number);
        all.charts.extend(alone.charts);
        all.without.extend(alone.without);
        return Ok(all);
    }
    divide(mesh, monitor)
}

/// Caps worth flattening, the deepest first: for each triangle whether it belongs.
fn caps(mesh: &Mesh, front: Vec3) -> impl Iterator<Item = Vec<bool>> {
    let count = mesh.triangles.len();
    let adjacent = neighbors(mesh);
    let depth: Vec<f32> = (0..count as u32)
        .map(|t| {
            let [a, b, c] = mesh.corners(t).map(|p| p.dot(front));
            (a + b + c) / 3.0
        })
        .collect();
    let areas: Vec<f64> = (0..count as u32).map(|t| mesh.area(t)).collect();
    let whole: f64 = areas.iter().sum();
    let foremost = (0..count).fold(0, |best, t| if depth[t] > depth[best] { t } else { best });
    let (high, low) = (depth[foremost], depth.iter().copied().fold(f32::INFINITY, f32::min));
    (1..=CUT_PLANES).rev().filter_map(move |i| {
        let plane = high - (high - low) * MAX_CUT_DEPTH * i as f32 / CUT_PLANES as f32;
        let mut inside = cap(&adjacent, &depth, foremost as u32, plane);
        straighten(&adjacent, &mut inside);
        let share = (0..count).filter(|&t| inside[t]).map(|t| areas[t]).sum::<f64>() / whole;
        (share > 0.01 && share < MAX_FACE_SHARE).then_some(inside)
    })
}

/// Gives `number` to the first triangle and all connected ones without a number, and returns their
/// count.
fn flood(adjacent: &[[u32; 3]], piece: &mut [u32], first: u32, number: u32) -> usize {
    let (mut open, mut count) = (vec![first], 1);
    piece[first as usize] = number;
    while let Some(t) = open.pop() {
        for n in adjacent[t as usize] {
            if n != NONE && piece[n as usize] == NONE {
                piece[n as usize] = number;
                count += 1;
                open.push(n);
            }
        }
    }
    count
}

/// Returns what hangs together with the foremost triangle in front of the plane, and all it
/// encloses: eye sockets are deep.
fn cap(adjacent: &[[u32; 3]], depth: &[f32], foremost: u32, plane: f32) -> Vec<bool> {
    // What is behind the plane has a number, so it is not flooded; then the rest takes its place.
    let behind = u32::MAX - 1;
    let mut piece: Vec<u32> = depth.iter().map(|&d| if d > plane { NONE } else { behind }).collect();
    flood(adjacent, &mut piece, foremost, 0);
    piece.iter_mut().filter(|p| **p == behind).for_each(|p| *p = NONE);
    let (mut outside, mut most, mut number) = (NONE, 0, 0);
    for t in 0..adjacent.len() {
        if piece[t] == NONE {
            number += 1;
            let count = flood(adjacent, &mut piece, t as u32, number);
            if count > most {
                (outside, most) = (number, count);
            }
        }
    }
    // only the component of the foremost triangle: other pieces have charts of their own
    let mut own: Vec<u32> = piece.iter().map(|&p| if p == outside { behind } else { NONE }).collect();
    flood(adjacent, &mut own, foremost, 0);
    own.iter().map(|&p| p == 0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::tests::sphere;
    use tiface_base::Quiet;

    /// Returns a closed ball around the origin, a bump like a nose at its front (+z) and a dent
    /// below it.
    fn ball() -> Mesh {
        let mut mesh = sphere(40, 60);
        for p in &mut mesh.positions {
            let near = |q: Vec3| (-40.0 * p.distance_squared(q.normalize())).exp();
            let r = 1.0 + 0.15 * near(Vec3::Z) - 0.05 * near(Vec3::new(0.0, -0.5, 1.0));
            *p *= r;
        }
        mesh
    }

    #[test]
    fn the_face_is_one_chart_and_the_rest_the_librarys() {
        let mesh = ball();
        assert!(mesh.is_closed());
        let flat = divide_around(&mesh, Vec3::new(0.0, 0.0, 3.0), &Quiet).unwrap();
        let mut seen = vec![0; mesh.triangles.len()];
        flat.charts.iter().flat_map(|c| &c.triangles).for_each(|&t| seen[t as usize] += 1);
        assert!(seen.iter().all(|&n| n == 1) && flat.without.is_empty());
        // the nose, and its surroundings up to 30 degrees
        let chart = |t: u32| flat.charts.iter().position(|c| c.triangles.contains(&t));
        let near = |t: &u32| mesh.corners(*t).iter().all(|p| p.normalize().z > 0.87);
        let mut charts: Vec<_> = (0..mesh.triangles.len() as u32).filter(near).map(chart).collect();
        charts.dedup();
        assert_eq!(charts.len(), 1);
    }

    #[test]
    fn caps_are_discs_from_deep_to_shallow() {
        let mesh = ball();
        let found: Vec<Vec<bool>> = caps(&mesh, Vec3::Z).collect();
        assert!(found.len() > 2);
        let sizes: Vec<usize> = found.iter().map(|c| c.iter().filter(|i| **i).count()).collect();
        assert!(sizes.is_sorted_by(|a, b| a > b), "{sizes:?}");
        // one piece within, one without: the rim is one line
        let adjacent = neighbors(&mesh);
        for inside in found {
            for side in [true, false] {
                let first = inside.iter().position(|&i| i == side).unwrap();
                let mut own: Vec<u32> = inside.iter().map(|&i| if i == side { NONE } else { 7 }).collect();
                let count = flood(&adjacent, &mut own, first as u32, 1);
                assert_eq!(count, inside.iter().filter(|&&i| i == side).count());
            }
        }
    }

    #[test]
    fn a_dent_behind_the_plane_is_part_of_the_face() {
        // a strip: 0 in front, 1 behind, 2 in front, 3 to 6 behind
        let adjacent = [
            [NONE, 1, 2],
            [0, 2, NONE],
            [1, 0, 3],
            [2, 4, NONE],
            [3, 5, NONE],
            [4, 6, NONE],
            [5, NONE, NONE],
        ];
        let depth = [1.0, 0.2, 0.9, 0.1, 0.0, 0.0, 0.0];
        assert_eq!(cap(&adjacent, &depth, 0, 0.5), [true, true, true, false, false, false, false]);
    }
}
