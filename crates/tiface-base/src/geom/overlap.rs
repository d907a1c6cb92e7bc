//! Which triangles of an atlas share area, decided without rounding.
//!
//! Two triangles share area unless a side of one of them has the whole other one on its far side:
//! the separating axes of convex polygons in the plane. Each decision is the sign of an orientation
//! determinant of f32 coordinates, exact after Shewchuk (1997). So triangles that share a side or a
//! corner, or merely touch, never count.
//!
//! Beside that: whether two triangles in space pass through each other, and how far the charts of
//! an atlas are apart.

use super::boxes::{Boxes, DBox, DEFAULT_EFFORT, share_out};
use glam::{DVec2, DVec3, Vec2};
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
fn separates<V: Copy>(a: [V; 3], b: [V; 3], turn: impl Fn(V, V, V) -> i32) -> bool {
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

/// Returns whether two triangles meet in more than the corners they share.
pub fn intersect(p: [DVec3; 3], p_ids: [u32; 3], q: [DVec3; 3], q_ids: [u32; 3]) -> bool {
    let shared = |ids: [u32; 3], others: [u32; 3]| ids.map(|i| others.contains(&i));
    let (in_p, in_q) = (shared(p_ids, q_ids), shared(q_ids, p_ids));
    let count = in_p.iter().filter(|&&s| s).count();
    if count == 3 {
        return true;
    }
    let sides = q.map(|v| orient(p[0], p[1], p[2], v));
    match sides {
        [0, 0, 0] => return overlap_in_plane(p, q),
        [1, 1, 1] | [-1, -1, -1] => return false, // apart
        _ => {}
    }
    // The edge opposite a shared corner, or every edge without one; with a shared edge, none.
    let crosses = |a: [DVec3; 3], touching: [bool; 3], b: [DVec3; 3]| {
        (0..3).any(|k| {
            let next = (k + 1) % 3;
            !touching[k] && !touching[next] && pierces(a[k], a[next], b)
        })
    };
    count < 2 && (crosses(p, in_p, q) || crosses(q, in_q, p))
}

/// Returns whether the segment goes from one side of the triangle to the other, through it or its
/// border.
fn pierces(from: DVec3, to: DVec3, [a, b, c]: [DVec3; 3]) -> bool {
    if orient(a, b, c, from) * orient(a, b, c, to) >= 0 {
        return false;
    }
    let turns = [orient(from, to, a, b), orient(from, to, b, c), orient(from, to, c, a)];
    turns.iter().all(|&s| s >= 0) || turns.iter().all(|&s| s <= 0)
}

/// Sign of the determinant of `(a − d, b − d, c − d)`; 0 where rounding could decide it.
pub(super) fn orient(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> i32 {
    let (a, b, c) = (a - d, b - d, c - d);
    let det = a.dot(b.cross(c));
    let (x, y, z) = (a.abs(), b.abs(), c.abs());
    let permanent =
        x.x * (y.y * z.z + y.z * z.y) + x.y * (y.z * z.x + y.x * z.z) + x.z * (y.x * z.y + y.y * z.x);
    // (7 + 56 u) u with u = 2⁻⁵³ (Shewchuk 1997), and a little for the differences
    if det.abs() <= 1e-15 * permanent { 0 } else { det.signum() as i32 }
}

/// Returns whether two triangles of one plane share area: not if a side of either separates them.
fn overlap_in_plane(p: [DVec3; 3], q: [DVec3; 3]) -> bool {
    let normal = (p[1] - p[0]).cross(p[2] - p[0]).abs();
    let flat = |v: DVec3| {
        if normal.x >= normal.y && normal.x >= normal.z {
            DVec2::new(v.y, v.z)
        } else if normal.y >= normal.z {
            DVec2::new(v.z, v.x)
        } else {
            DVec2::new(v.x, v.y)
        }
    };
    let turn = |a: DVec2, b: DVec2, c: DVec2| {
        let (x, y) = ((b.x - a.x) * (c.y - a.y), (b.y - a.y) * (c.x - a.x));
        if (x - y).abs() <= 1e-15 * (x.abs() + y.abs()) { 0 } else { (x - y).signum() as i32 }
    };
    let (p, q) = (p.map(flat), q.map(flat));
    !separates(p, q, turn) && !separates(q, p, turn)
}

/// A piece of a chart's outline, in texels.
#[derive(Clone, Copy, Debug)]
pub struct OutlineSide {
    /// Which chart.
    pub chart: u32,
    /// Its ends.
    pub from: DVec2,
    /// Its ends.
    pub to: DVec2,
}

/// Distance between charts.
pub struct ChartDistance {
    /// The smallest distance between sides of different charts, up to the given limit; `None` with
    /// fewer than two charts.
    pub distance: Option<f64>,
    /// Number of sides that were not compared with all neighbors: then the distance is an upper
    /// bound.
    pub left: usize,
}

/// Returns the smallest distance between sides of different charts, up to `farthest`, beyond which
/// it is given as that.
pub fn nearest_charts(sides: &[OutlineSide], farthest: f64) -> ChartDistance {
    if sides.iter().all(|s| s.chart == sides[0].chart) {
        return ChartDistance { distance: None, left: 0 };
    }
    let span = |s: &OutlineSide| DBox::around([s.from, s.to].map(|p| p.extend(0.0)));
    let boxes = Boxes::new(sides.iter().map(span));
    // Neighbors in the tree are mostly neighbors in the plane: a first bound, so that the search
    // has a short way to go.
    let order: Vec<u32> = boxes.order().collect();
    let mut bound = farthest;
    for near in order.windows(LEAF_NEIGHBORS) {
        let side = &sides[near[0] as usize];
        let others = near[1..].iter().map(|&i| &sides[i as usize]).filter(|s| s.chart != side.chart);
        bound = others.fold(bound, |nearest, other| nearest.min(distance(side, other)));
    }
    let shared = share_out(sides.len(), DEFAULT_EFFORT / 2, |i, effort| {
        let (side, mut nearest) = (&sides[i], bound);
        if nearest > 0.0 {
            boxes.meeting(&span(side).grown(bound), effort, |j, effort| {
                let other = &sides[j as usize];
                if side.chart < other.chart {
                    if !effort.spend(SIDE_DISTANCE_COST) {
                        return false;
                    }
                    nearest = nearest.min(distance(side, other));
                }
                nearest > 0.0
            });
        }
        nearest
    });
    let nearest = shared.found.into_iter().fold(bound, f64::min);
    // nothing is nearer than touching
    ChartDistance { distance: Some(nearest), left: if nearest > 0.0 { shared.unfinished.len() } else { 0 } }
}

/// Number of successive sides in the order of the tree that are compared first.
const LEAF_NEIGHBORS: usize = 8;

/// Cost of a distance of two sides, in comparisons of boxes.
const SIDE_DISTANCE_COST: usize = 8;

fn point_distance(p: DVec2, s: &OutlineSide) -> f64 {
    let along = s.to - s.from;
    let t = (p - s.from).dot(along) / along.length_squared();
    p.distance(s.from + along * if t.is_nan() { 0.0 } else { t.clamp(0.0, 1.0) })
}

fn distance(a: &OutlineSide, b: &OutlineSide) -> f64 {
    let turn = |s: &OutlineSide, p: DVec2| (s.to - s.from).perp_dot(p - s.from);
    if turn(a, b.from) * turn(a, b.to) < 0.0 && turn(b, a.from) * turn(b, a.to) < 0.0 {
        return 0.0; // they cross
    }
    let ends = [point_distance(a.from, b), point_distance(a.to, b), point_distance(b.from, a)];
    ends.into_iter().fold(point_distance(b.to, a), f64::min)
}

#[cfg(test)]
mod tests {
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

    fn side(chart: u32, p: [f64; 4]) -> OutlineSide {
        OutlineSide { chart, from: DVec2::new(p[0], p[1]), to: DVec2::new(p[2], p[3]) }
    }

    fn nearest(sides: &[OutlineSide], farthest: f64) -> Option<f64> {
        let ChartDistance { distance, left } = nearest_charts(sides, farthest);
        assert_eq!(left, 0);
        distance
    }

    #[test]
    fn distances_are_between_different_charts_only() {
        let a = side(0, [0.0, 0.0, 10.0, 0.0]);
        assert_eq!(nearest(&[a, side(0, [0.0, 1.0, 10.0, 1.0])], 64.0), None);
        assert_eq!(nearest(&[a, side(1, [3.0, 5.0, 3.0, 9.0])], 64.0), Some(5.0));
        assert_eq!(nearest(&[a, side(1, [3.0, -5.0, 3.0, 9.0])], 64.0), Some(0.0)); // crossing
        assert_eq!(nearest(&[a, side(1, [13.0, 4.0, 19.0, 4.0])], 64.0), Some(5.0)); // 3, 4, 5
        assert_eq!(nearest(&[a, side(1, [0.0, 900.0, 1.0, 900.0])], 64.0), Some(64.0));
        assert_eq!(nearest(&[], 64.0), None);
    }

    #[test]
    fn far_and_long_sides_agree_with_all_pairs() {
        // sides on two combs of slanted teeth
        let sides: Vec<OutlineSide> = (0..200)
            .map(|i| {
                let x = 3.0 * f64::from(i) + f64::from(i % 7);
                let chart = (i / 2) as u32;
                side(chart, [x, f64::from(i % 5), x + 900.0, 500.0 + 20.0 * f64::from(i)])
            })
            .collect();
        let mut least = f64::INFINITY;
        for a in &sides {
            for b in &sides {
                if a.chart != b.chart {
                    least = least.min(distance(a, b));
                }
            }
        }
        assert_eq!(nearest(&sides, 64.0), Some(least));
    }
}
