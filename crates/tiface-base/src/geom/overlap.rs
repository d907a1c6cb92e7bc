//! Which triangles of an atlas share area, decided without rounding.
//!
//! Two triangles share area unless a side of one of them has the whole other one on its far side:
//! the separating axes of convex polygons in the plane. Each decision is the sign of an orientation
//! determinant of f32 coordinates, exact after Shewchuk (1997). So triangles that share a side or a
//! corner, or merely touch, never count.

use super::boxes::{Boxes, DBox, share_out};
use glam::{DVec2, Vec2};
use rayon::prelude::*;

/// On which side of the line a → b is c: 1 where (b − a) × (c − a) is positive, −1 where negative,
/// 0 on it.
#[inline]
pub fn turn(a: Vec2, b: Vec2, c: Vec2) -> i32 {
    let coord = |v: Vec2| robust::Coord { x: f64::from(v.x), y: f64::from(v.y) };
    let area = robust::orient2d(coord(a), coord(b), coord(c));
    i32::from(area > 0.0) - i32::from(area < 0.0)
}

/// Returns whether two triangles, neither without area, share area.
pub(crate) fn share_area(p: [Vec2; 3], q: [Vec2; 3]) -> bool {
    !separates(p, q, turn) && !separates(q, p, turn)
}

/// Returns whether a side of a triangle has all of another one on its far side, by the sign of a
/// turn.
pub(super) fn separates<V: Copy>(a: [V; 3], b: [V; 3], turn: impl Fn(V, V, V) -> i32) -> bool {
    let inner = turn(a[0], a[1], a[2]);
    (0..3).any(|k| b.iter().all(|&v| turn(a[k], a[(k + 1) % 3], v) * inner <= 0))
}

/// Returns the area two triangles share, in the square of the coordinates' unit.
pub fn shared_area(p: [DVec2; 3], q: [DVec2; 3]) -> f64 {
    // Sutherland and Hodgman 1974: the first one clipped by the sides of the second.
    let winding = (q[1] - q[0]).perp_dot(q[2] - q[0]).signum();
    let mut polygon = p.to_vec();
    for k in 0..3 {
        let (from, along) = (q[k], q[(k + 1) % 3] - q[k]);
        let side = |v: DVec2| along.perp_dot(v - from) * winding;
        let old = std::mem::take(&mut polygon);
        for i in 0..old.len() {
            let (a, b) = (old[i], old[(i + 1) % old.len()]);
            let (s, t) = (side(a), side(b));
            if s >= 0.0 {
                polygon.push(a);
            }
            if s * t < 0.0 {
                polygon.push(a + (b - a) * (s / (s - t)));
            }
        }
    }
    let twice: f64 = (0..polygon.len()).map(|i| polygon[i].perp_dot(polygon[(i + 1) % polygon.len()])).sum();
    0.5 * twice.abs()
}

/// Pairs of triangles that share area.
pub struct Overlaps {
    /// Each pair once, lower index first, in order.
    pub pairs: Vec<(u32, u32)>,
    /// Number of triangles that share area with another one.
    pub covered: usize,
    /// Number of triangles that were not compared with all neighbors of higher index: then both
    /// numbers above are lower bounds.
    pub left: usize,
}

/// Effort per triangle while an atlas is made, when all of its overlaps are needed.
pub const THOROUGH_EFFORT: usize = 1 << 16;

/// Cost of testing a pair, in comparisons of boxes, and of keeping and measuring one.
const PAIR_TEST_COST: usize = 12;
const OVERLAP_COST: usize = 64;

/// Finds the pairs among the triangles that `fit`, for so much effort a triangle; those must be
/// finite and have area.
pub fn overlaps(uvs: &[Vec2], triangles: &[[u32; 3]], fit: &[bool], effort: usize) -> Overlaps {
    let corners = |t: u32| triangles[t as usize].map(|i| uvs[i as usize]);
    let listed: Vec<u32> = (0..triangles.len() as u32).filter(|&t| fit[t as usize]).collect();
    let span = |t: u32| DBox::around(corners(t).map(|v| v.as_dvec2().extend(0.0)));
    let boxes = Boxes::new(listed.iter().map(|&t| span(t)));
    let shared = share_out(listed.len(), effort, |i, effort| {
        let (a, mut pairs) = (listed[i], Vec::new());
        boxes.meeting(&span(a), effort, |j, effort| {
            let b = listed[j as usize];
            if b <= a {
                return true;
            }
            let meets = effort.spend(PAIR_TEST_COST) && share_area(corners(a), corners(b));
            if meets && effort.spend(OVERLAP_COST) {
                pairs.push((a, b));
            }
            true
        });
        pairs
    });
    let mut pairs: Vec<(u32, u32)> = shared.found.into_iter().flatten().collect();
    pairs.par_sort_unstable();
    let mut covered = vec![false; triangles.len()];
    pairs.iter().for_each(|&(a, b)| (covered[a as usize], covered[b as usize]) = (true, true));
    if !shared.unfinished.is_empty() {
        // copies cover each other; for the others any one will do, whatever its index
        let bits = |t: u32| {
            let mut bits = corners(t).map(|v| (v + 0.0).to_array().map(f32::to_bits));
            bits.sort_unstable();
            bits
        };
        let mut keyed: Vec<_> = listed.par_iter().map(|&t| (bits(t), t)).collect();
        keyed.par_sort_unstable();
        for copies in keyed.chunk_by(|a, b| a.0 == b.0).filter(|copies| copies.len() > 1) {
            copies.iter().for_each(|&(_, t)| covered[t as usize] = true);
        }
        let rest: Vec<u32> = listed.iter().copied().filter(|&t| !covered[t as usize]).collect();
        let known = share_out(rest.len(), effort / 4, |i, effort| {
            let (a, mut known) = (rest[i], false);
            boxes.meeting(&span(a), effort, |j, effort| {
                let b = listed[j as usize];
                known = a != b && effort.spend(PAIR_TEST_COST) && share_area(corners(a), corners(b));
                !known
            });
            known
        });
        rest.iter().zip(known.found).for_each(|(&t, known)| covered[t as usize] = known);
    }
    let covered = covered.iter().filter(|&&c| c).count();
    Overlaps { pairs, covered, left: shared.unfinished.len() }
}

#[cfg(test)]
mod tests {
    use super::super::boxes::DEFAULT_EFFORT;
    use super::*;

    fn at(p: [f32; 6]) -> [Vec2; 3] {
        [Vec2::new(p[0], p[1]), Vec2::new(p[2], p[3]), Vec2::new(p[4], p[5])]
    }

    #[test]
    fn turning_is_exact_where_f64_is_not() {
        // c lies on the line through a and b but for one ulp of f32, near 1: the determinant is
        // about 1e-15.
        let (a, b) = (Vec2::new(0.1, 0.1), Vec2::new(0.9, 0.9));
        assert_eq!(turn(a, b, Vec2::new(0.5, 0.5)), 0);
        assert_eq!(turn(a, b, Vec2::new(0.5, 0.5f32.next_up())), 1);
        assert_eq!(turn(a, b, Vec2::new(0.5, 0.5f32.next_down())), -1);
        // far from the origin beside nothing: differences are not exact in f64
        let (a, b) = (Vec2::new(1e-30, 0.0), Vec2::new(1.0, 0.0));
        assert_eq!(turn(a, b, Vec2::new(0.5, 1e-38)), 1);
    }

    #[test]
    fn neighbors_touch_and_do_not_overlap() {
        let t = at([0.0, 0.0, 1.0, 0.0, 0.0, 1.0]);
        assert!(!share_area(t, at([1.0, 0.0, 1.0, 1.0, 0.0, 1.0]))); // a common side
        assert!(!share_area(t, at([0.5, 0.5, 1.0, 1.0, 0.9, 1.0]))); // a corner on a side
        assert!(share_area(t, at([0.5f32.next_down(), 0.5, 1.0, 1.0, 0.9, 1.0])));
        assert!(share_area(t, t));
        assert!(share_area(t, at([0.1, 0.1, 0.1, 0.2, 0.2, 0.1]))); // inside, wound the other way
    }

    #[test]
    fn the_shared_area_is_that_of_the_common_polygon() {
        let d = |t: [Vec2; 3]| t.map(|v| v.as_dvec2());
        let t = d(at([0.0, 0.0, 2.0, 0.0, 0.0, 2.0]));
        // half of the unit square, all of it where x + y <= 2
        let half = d(at([0.0, 0.0, 1.0, 0.0, 1.0, 1.0]));
        assert!((shared_area(t, half) - 0.5).abs() < 1e-15);
        assert!((shared_area(half, t) - 0.5).abs() < 1e-15);
        assert_eq!(shared_area(t, d(at([3.0, 3.0, 4.0, 3.0, 3.0, 4.0]))), 0.0);
    }

    #[test]
    fn planted_overlaps_are_found_once_each_among_many() {
        // a fan-free grid of 2 · 30² triangles, and one more over two of them
        let n = 30u32;
        let at = |i: u32, j: u32| i * (n + 1) + j;
        let mut uvs: Vec<Vec2> = (0..=n)
            .flat_map(|i| (0..=n).map(move |j| Vec2::new(i as f32, j as f32) / (2.0 * n as f32)))
            .collect();
        let mut triangles = Vec::new();
        for i in 0..n {
            for j in 0..n {
                triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        let all = overlaps(&uvs, &triangles, &vec![true; triangles.len()], DEFAULT_EFFORT);
        assert!(all.pairs.is_empty() && all.left == 0);
        // across the diagonal of the quad (0, 0), within it
        let s = 1.0 / 60.0;
        uvs.extend([Vec2::new(0.4, 0.2) * s, Vec2::new(0.8, 0.6) * s, Vec2::new(0.2, 0.8) * s]);
        let first = uvs.len() as u32 - 3;
        triangles.push([first, first + 1, first + 2]);
        let all = overlaps(&uvs, &triangles, &vec![true; triangles.len()], DEFAULT_EFFORT);
        assert_eq!(all.pairs, [(0, 1800), (1, 1800)]);
    }

    #[test]
    fn a_heap_of_texture_wide_triangles_ends() {
        let uvs = vec![Vec2::ZERO, Vec2::X, Vec2::Y];
        let triangles = vec![[0, 1, 2]; 40_000];
        let found = overlaps(&uvs, &triangles, &vec![true; triangles.len()], DEFAULT_EFFORT);
        assert!(found.left > 39_000 && found.pairs.len() * OVERLAP_COST <= DEFAULT_EFFORT * triangles.len());
        // what each of them finds first is enough to know that it is covered, but not by how many
        assert_eq!(found.covered, triangles.len());
    }
}
