//! The surface inside one cell, with the topology of the trilinear interpolant.
//!
//! Corners are numbered `x + 2y + 4z`. Edges 0..4 run along x (`y + 2z`), 4..8 along y
//! (`4 + x + 2z`), 8..12 along z (`8 + x + 2y`). A case is the eight inside bits.
//!
//! 1. **Faces.** Every crossed edge is entered from one face and left through another, so directed
//!    segments on the six faces close into loops. A face with two diagonal corners inside is
//!    decided by the sign of its saddle, `a c > b d` (Nielson, Hamann 1991): exact in f64 for f32
//!    values, the same for both cells that share the face. A tie joins the outside.
//! 2. **Body.** Loops joined by a tunnel are found by a sweep. At height w the interpolant is
//!    bilinear with corners linear in w; its zero set is at most two arcs, whose pairing changes
//!    only where a vertical edge is crossed or where `A(w) C(w) − B(w) D(w) = 0`, a quadratic.
//!    Between those heights every arc is a path on the surface between two points of the loops: so
//!    loops at its ends belong together. This decides all cases of Chernyaev 1995, those corrected
//!    by Custodio et al. 2013 included (10, 12, 13), from one axis: a trilinear surface has no
//!    piece that meets no side face.
//! 3. **Triangles.** A disk spans each lone loop, a strip joins two. No inner edge joins two
//!    vertices on one cube face, because the neighbor may use the same pair and the edge would have
//!    four faces. A loop that allows no such triangulation gets a vertex in its middle.

use glam::Vec3;
use std::sync::LazyLock;

/// The corners of each edge, lower first.
pub(super) const EDGES: [[u8; 2]; 12] =
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

/// The corners of each face, counter-clockwise seen from outside the cell.
const FACES: [[u8; 4]; 6] =
    [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// First of the vertex codes that name inner vertices instead of edges.
const INNER: u8 = 12;

/// Returns where the surface crosses an edge, 0..=1 from the end with value `a`; one end is inside
/// (< 0), the other outside (≥ 0). Kept off the nodes: vertices never coincide and no face loses
/// its area when a node is exactly zero.
pub(super) fn crossing(a: f32, b: f32) -> f64 {
    let (a, b) = (f64::from(a), f64::from(b));
    (a / (a - b)).clamp(1.0 / 1024.0, 1023.0 / 1024.0)
}

/// A cell's triangles; vertex codes below [`INNER`] are edges, the others index `inner`.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct CellSurface {
    /// Counter-clockwise seen from outside the surface.
    pub triangles: Vec<[u8; 3]>,
    /// Inner vertices in cell units, each coordinate in 0..1.
    pub inner: Vec<[f64; 3]>,
}

/// Output of the triangles and inner vertices of some cells, one cell after the other.
pub(super) struct CellOutput<'a> {
    pub triangles: &'a mut [[u32; 3]],
    pub inner: &'a mut [Vec3],
    /// Index of the first of `inner`.
    pub first_inner: u32,
}

impl CellOutput<'_> {
    /// Writes a cell with these vertices on its edges: the surface of its case, or the one that was
    /// resolved. `point` places its inner vertices.
    #[inline]
    pub(super) fn write(
        &mut self,
        case: &Case,
        resolved: Option<CellSurface>,
        ids: &[u32; 12],
        point: impl Fn([f64; 3]) -> Vec3,
    ) {
        let Some(surface) = resolved else {
            let own = self.triangles.split_off_mut(..case.count as usize).unwrap_or_default();
            for (out, t) in own.iter_mut().zip(&case.triangles) {
                *out = [ids[t[0] as usize], ids[t[1] as usize], ids[t[2] as usize]];
            }
            return;
        };
        let id = |code: u8| match code {
            0..INNER => ids[code as usize],
            _ => self.first_inner + u32::from(code - INNER),
        };
        let own = self.triangles.split_off_mut(..surface.triangles.len()).unwrap_or_default();
        own.iter_mut().zip(&surface.triangles).for_each(|(out, t)| *out = t.map(id));
        let own = self.inner.split_off_mut(..surface.inner.len()).unwrap_or_default();
        own.iter_mut().zip(&surface.inner).for_each(|(out, &at)| *out = point(at));
        self.first_inner += surface.inner.len() as u32;
    }
}

/// The part of a cell's topology that depends on its case alone.
#[derive(Clone, Copy)]
pub(super) struct Case {
    /// Number of used entries of `triangles`.
    pub count: u8,
    /// The values matter: see [`resolve`].
    pub ambiguous: bool,
    /// Up to five triangles of edge codes.
    pub triangles: [[u8; 3]; 5],
    /// By how much each of the eight running vertex counters of a row of cells advances past this
    /// cell: four rows of x edges, two of y edges, two of z edges.
    pub advance: [u32; 8],
}

/// The 256 cases.
pub(super) static CASES: LazyLock<[Case; 256]> = LazyLock::new(|| std::array::from_fn(|i| build(i as u8)));

fn bit(case: u8, corner: u8) -> bool {
    case >> corner & 1 == 1
}

/// Returns whether this edge is crossed.
pub(super) fn crossed(case: u8, edge: usize) -> bool {
    bit(case, EDGES[edge][0]) != bit(case, EDGES[edge][1])
}

fn build(case: u8) -> Case {
    let advance = [0, 1, 2, 3, 4, 6, 8, 10].map(|e| u32::from(crossed(case, e)));
    let mut out = Case { count: 0, ambiguous: false, triangles: [[0; 3]; 5], advance };
    let loops = Loops::trace(case, |_| {
        out.ambiguous = true;
        false
    });
    out.ambiguous |= loops.loops.len() > 1;
    if !out.ambiguous && loops.loops.len() == 1 {
        // Edge midpoints stand for the crossings: the choice of diagonals holds for any values.
        let at = std::array::from_fn(|e| edge_position(e, 0.5));
        let mut surface = CellSurface::default();
        disk(&loops.loops[0], &at, &mut surface);
        // A lone unambiguous loop has at most seven vertices and always a triangulation (tested).
        out.count = surface.triangles.len() as u8;
        out.triangles[..surface.triangles.len()].copy_from_slice(&surface.triangles);
    }
    out
}

fn edge_position(edge: usize, t: f64) -> [f64; 3] {
    let corner = EDGES[edge][0];
    let mut p = [f64::from(corner & 1), f64::from(corner >> 1 & 1), f64::from(corner >> 2)];
    p[edge / 4] = t;
    p
}

fn edge_between(a: u8, b: u8) -> u8 {
    let (a, b) = (a.min(b), a.max(b));
    match b - a {
        1 => a >> 1,
        2 => 4 + (a & 1) + (a >> 2 << 1),
        _ => 8 + a,
    }
}

/// Returns whether two edges lie on one cube face: they do when they agree on a coordinate that is
/// fixed for both.
fn share_face(a: u8, b: u8) -> bool {
    let (ca, cb) = (EDGES[a as usize], EDGES[b as usize]);
    (0..3).any(|axis| {
        let fixed = a / 4 != axis && b / 4 != axis;
        fixed && (ca[0] >> axis & 1) == (cb[0] >> axis & 1)
    })
}

/// The closed curves in which the surface meets the cell's six faces, as lists of edges.
struct Loops {
    loops: Vec<Vec<u8>>,
    /// Which loop an edge is on; 255 when it is not crossed.
    of: [u8; 12],
}

impl Loops {
    /// `joined` is called for every ambiguous face: are its inside corners connected across it?
    fn trace(case: u8, mut joined: impl FnMut(&[u8; 4]) -> bool) -> Loops {
        let mut next = [255u8; 12];
        for face in &FACES {
            let inside = face.map(|c| bit(case, c));
            let edge = |i: usize| edge_between(face[i % 4], face[(i + 1) % 4]);
            // Walking round the face, a segment runs from where the walk enters the inside to where
            // it leaves, which keeps the inside on the same hand in all six.
            let enters: Vec<usize> = (0..4).filter(|&i| !inside[i] && inside[(i + 1) % 4]).collect();
            match enters[..] {
                [i] => {
                    let leave = (0..4).find(|&i| inside[i] && !inside[(i + 1) % 4]);
                    next[edge(i) as usize] = edge(leave.expect("what enters also leaves"));
                }
                [i, j] => {
                    // Separate: cut off each inside corner; joined: cut off each outside corner.
                    let step = if joined(face) { 3 } else { 1 };
                    next[edge(i) as usize] = edge(i + step);
                    next[edge(j) as usize] = edge(j + step);
                }
                _ => {}
            }
        }
        let mut out = Loops { loops: Vec::new(), of: [255; 12] };
        for start in 0..12u8 {
            if next[start as usize] == 255 || out.of[start as usize] != 255 {
                continue;
            }
            let mut list = Vec::new();
            let mut e = start;
            while out.of[e as usize] == 255 {
                out.of[e as usize] = out.loops.len() as u8;
                list.push(e);
                e = next[e as usize];
            }
            out.loops.push(list);
        }
        out
    }
}

/// Returns the surface in a cell with these values: inside corners (bits of `case`) below zero, the
/// others at or above it, all finite.
pub(super) fn resolve(case: u8, values: &[f32; 8]) -> CellSurface {
    let v = values.map(f64::from);
    let loops = Loops::trace(case, |face| {
        let [a, b, c, d] = face.map(|i| v[i as usize]);
        if bit(case, face[0]) { a * c > b * d } else { b * d > a * c }
    });
    let at: [[f64; 3]; 12] = std::array::from_fn(|e| {
        let [a, b] = EDGES[e].map(|c| values[c as usize]);
        edge_position(e, if crossed(case, e) { crossing(a, b) } else { 0.5 })
    });
    let group = join(case, &v, &loops);
    let mut out = CellSurface::default();
    for (i, list) in loops.loops.iter().enumerate() {
        let mates: Vec<usize> = (0..loops.loops.len()).filter(|&j| group[j] == group[i]).collect();
        match mates[..] {
            [a, b] => {
                if a == i {
                    tunnel(list, &loops.loops[b], &at, &mut out);
                }
            }
            // Three loops on one piece do not occur; were rounding to say so, disks are still
            // closed.
            _ => disk(list, &at, &mut out),
        }
    }
    out
}

/// Returns which loops lie on one piece of the surface: equal numbers.
fn join(case: u8, v: &[f64; 8], loops: &Loops) -> [u8; 4] {
    let mut group = [0, 1, 2, 3];
    if loops.loops.len() < 2 {
        return group;
    }
    // The four vertical edges in order around the square, with their height of crossing.
    const UPRIGHT: [usize; 4] = [8, 9, 11, 10];
    // Side faces between consecutive uprights: bottom edge, top edge.
    const SIDE: [[usize; 2]; 4] = [[0, 2], [5, 7], [1, 3], [4, 6]];
    let low = UPRIGHT.map(|e| v[EDGES[e][0] as usize]);
    let rise: [f64; 4] = std::array::from_fn(|i| v[EDGES[UPRIGHT[i]][1] as usize] - low[i]);
    let root: [Option<f64>; 4] =
        std::array::from_fn(|i| crossed(case, UPRIGHT[i]).then(|| low[i] / -rise[i]));

    let qa = rise[0] * rise[2] - rise[1] * rise[3];
    let qb = low[0] * rise[2] + low[2] * rise[0] - low[1] * rise[3] - low[3] * rise[1];
    let qc = low[0] * low[2] - low[1] * low[3];
    let mut heights = vec![0.0, 1.0];
    heights.extend(root.iter().flatten());
    heights.extend(quadratic_roots(qa, qb, qc).into_iter().flatten());
    heights.retain(|w| (0.0..=1.0).contains(w));
    heights.sort_by(f64::total_cmp);

    let mut union = |a: u8, b: u8| {
        let (from, to) = (group[a as usize].max(group[b as usize]), group[a as usize].min(group[b as usize]));
        group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
    };
    for slab in heights.windows(2) {
        if slab[1] <= slab[0] {
            continue;
        }
        let w = 0.5 * (slab[0] + slab[1]);
        let inside: [bool; 4] = std::array::from_fn(|i| {
            let [bottom, top] = EDGES[UPRIGHT[i]];
            bit(case, if root[i].is_some_and(|r| w > r) { top } else { bottom })
        });
        // The loop of the arc's end on each side face; a face with two segments is passed below
        // both of its uprights' crossings or above both.
        let end: [Option<u8>; 4] = std::array::from_fn(|i| {
            let n = (i + 1) % 4;
            if inside[i] == inside[n] {
                return None;
            }
            let [bottom, top] = SIDE[i];
            let four = [bottom, top, UPRIGHT[i], UPRIGHT[n]].iter().all(|&e| crossed(case, e));
            let edge = if four {
                if root[i].is_some_and(|r| w < r) { bottom } else { top }
            } else {
                [bottom, top, UPRIGHT[i], UPRIGHT[n]].into_iter().find(|&e| crossed(case, e))?
            };
            Some(loops.of[edge])
        });
        match end {
            [Some(ab), Some(bc), Some(cd), Some(da)] => {
                let corner: [f64; 4] = std::array::from_fn(|i| low[i] + rise[i] * w);
                let (ac, bd) = (corner[0] * corner[2], corner[1] * corner[3]);
                // As on a face, a tie joins the outside.
                let joined = if inside[0] { ac > bd } else { bd > ac };
                if joined == inside[0] {
                    // A and C meet: the arcs cut off B and D.
                    union(ab, bc);
                    union(cd, da);
                } else {
                    union(da, ab);
                    union(bc, cd);
                }
            }
            _ => {
                let mut ends = end.into_iter().flatten();
                if let (Some(a), Some(b)) = (ends.next(), ends.next()) {
                    union(a, b);
                }
            }
        }
    }
    group
}

/// Real roots of `a x² + b x + c`, without cancellation.
fn quadratic_roots(a: f64, b: f64, c: f64) -> [Option<f64>; 2] {
    let discriminant = b * b - 4.0 * a * c;
    if discriminant < 0.0 {
        return [None, None];
    }
    let q = -0.5 * (b + discriminant.sqrt().copysign(b));
    let finite = |x: f64| x.is_finite().then_some(x);
    [finite(q / a), finite(c / q)]
}

fn distance_squared(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum()
}

/// Spans a loop with triangles: the shortest allowed diagonals, else a fan about its middle.
fn disk(list: &[u8], at: &[[f64; 3]; 12], out: &mut CellSurface) {
    let n = list.len();
    // cost[i][j]: the cheapest triangulation of the polygon i..=j, its chord included.
    let mut cost = [[f64::INFINITY; 12]; 12];
    let mut apex = [[0usize; 12]; 12];
    for span in 1..n {
        for i in 0..n - span {
            let j = i + span;
            if span == 1 {
                cost[i][j] = 0.0;
                continue;
            }
            let side = span == n - 1;
            if !side && share_face(list[i], list[j]) {
                continue;
            }
            let own = if side { 0.0 } else { distance_squared(at[list[i] as usize], at[list[j] as usize]) };
            for k in i + 1..j {
                let c = cost[i][k] + cost[k][j] + own;
                if c < cost[i][j] {
                    (cost[i][j], apex[i][j]) = (c, k);
                }
            }
        }
    }
    if cost[0][n - 1].is_finite() {
        let mut stack = vec![(0, n - 1)];
        while let Some((i, j)) = stack.pop() {
            if j > i + 1 {
                let k = apex[i][j];
                out.triangles.push([list[i], list[k], list[j]]);
                stack.extend([(i, k), (k, j)]);
            }
        }
        return;
    }
    let center = INNER + out.inner.len() as u8;
    let mean = |axis: usize| list.iter().map(|&e| at[e as usize][axis]).sum::<f64>() / n as f64;
    out.inner.push([mean(0), mean(1), mean(2)]);
    out.triangles.extend((0..n).map(|i| [list[i], list[(i + 1) % n], center]));
}

/// Joins two loops by a closed strip of triangles with the shortest allowed rungs; where the faces
/// forbid every such strip, by two with a ring of inner vertices between them.
fn tunnel(p: &[u8], q: &[u8], at: &[[f64; 3]; 12], out: &mut CellSurface) {
    // Seen from the tunnel's axis the two loops run against each other: walk q backwards.
    let q: Vec<u8> = q.iter().rev().copied().collect();
    let direct = StripSearch::run(p, &q, at, false);
    if let Some((steps, start)) = direct {
        return strip(p, &q, &steps, start, out);
    }
    // Without the rule a strip always exists: both loops have at least three vertices.
    let Some((steps, start)) = StripSearch::run(p, &q, at, true) else { return };
    let first = INNER + out.inner.len() as u8;
    let ring: Vec<u8> = (first..).take(p.len()).collect();
    // Each ring vertex: halfway from its vertex of p to the mean of those of q it has rungs to.
    let mut reach = vec![[0.0f64; 4]; p.len()];
    let (mut i, mut j) = (0, start);
    for &along_p in &steps {
        let end = at[q[j % q.len()] as usize];
        let sum = &mut reach[i % p.len()];
        (0..3).for_each(|axis| sum[axis] += end[axis]);
        sum[3] += 1.0;
        if along_p { i += 1 } else { j += 1 }
    }
    for (sum, &e) in reach.iter().zip(p) {
        let near = at[e as usize];
        out.inner.push(std::array::from_fn(|axis| 0.5 * (near[axis] + sum[axis] / sum[3])));
    }
    let turn: Vec<bool> = (0..2 * p.len()).map(|s| s % 2 == 0).collect();
    strip(p, &ring, &turn, 0, out);
    strip(&ring, &q, &steps, start, out);
}

/// Adds the triangles of a strip: each step goes on along p or along q.
fn strip(p: &[u8], q: &[u8], steps: &[bool], start: usize, out: &mut CellSurface) {
    let (mut i, mut j) = (0, start);
    for &along_p in steps {
        let (a, b) = (p[i % p.len()], q[j % q.len()]);
        if along_p {
            out.triangles.push([a, p[(i + 1) % p.len()], b]);
            i += 1;
        } else {
            out.triangles.push([a, q[(j + 1) % q.len()], b]);
            j += 1;
        }
    }
}

/// All strips between two loops, cheapest kept: such cells are rare and their loops short.
struct StripSearch<'a> {
    p: &'a [u8],
    q: &'a [u8],
    at: &'a [[f64; 3]; 12],
    /// Rungs may lie on cube faces.
    free: bool,
    start: usize,
    steps: Vec<bool>,
    best: (f64, Vec<bool>, usize),
}

impl StripSearch<'_> {
    /// Returns the steps of the best strip and the vertex of q it starts from.
    fn run(p: &[u8], q: &[u8], at: &[[f64; 3]; 12], free: bool) -> Option<(Vec<bool>, usize)> {
        let best = (f64::INFINITY, Vec::new(), 0);
        let mut search = StripSearch { p, q, at, free, start: 0, steps: Vec::new(), best };
        for start in 0..q.len() {
            search.start = start;
            search.walk(0, 0, 0.0, 0, 0);
        }
        let (cost, steps, start) = search.best;
        cost.is_finite().then_some((steps, start))
    }

    /// Stands on rung (i, j) counted from the start; the last `run_p` steps went along p, or the
    /// last `run_q` along q. A full turn around one loop about one vertex would use a rung twice.
    fn walk(&mut self, i: usize, j: usize, cost: f64, run_p: usize, run_q: usize) {
        let (m, n) = (self.p.len(), self.q.len());
        let (a, b) = (self.p[i % m], self.q[(self.start + j) % n]);
        if (!self.free && share_face(a, b)) || run_p == m || run_q == n || cost >= self.best.0 {
            return;
        }
        if i == m && j == n {
            self.best = (cost, self.steps.clone(), self.start);
            return;
        }
        let cost = cost + distance_squared(self.at[a as usize], self.at[b as usize]);
        if i < m {
            self.steps.push(true);
            self.walk(i + 1, j, cost, run_p + 1, 0);
            self.steps.pop();
        }
        if j < n {
            self.steps.push(false);
            self.walk(i, j + 1, cost, 0, run_q + 1);
            self.steps.pop();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;
    use tiface_base::math::rng::mix;

    /// Uniform in -1..1, from a counter: SplitMix64.
    fn noise(seed: &mut u64) -> f32 {
        *seed = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
        (mix(*seed) >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }

    fn case_of(values: &[f32; 8]) -> u8 {
        (0..8).fold(0, |c, i| c | u8::from(values[i] < 0.0) << i)
    }

    #[test]
    fn edges_between_corners_are_the_table_read_backwards() {
        for (e, [a, b]) in EDGES.into_iter().enumerate() {
            assert_eq!(edge_between(b, a), e as u8);
        }
        // Edge 0 lies on y = 0 and z = 0; edge 1 on y = 1, z = 0; edge 3 on y = 1, z = 1.
        assert!(share_face(0, 1) && !share_face(0, 3) && share_face(0, 4) && !share_face(0, 7));
    }

    #[test]
    fn one_corner_is_one_triangle_wound_away_from_it() {
        let case = CASES[1];
        assert_eq!((case.count, case.ambiguous), (1, false));
        // Edges 0, 4, 8 along x, y, z from the origin; seen from (1, 1, 1) they turn in that order.
        let mut t = case.triangles[0];
        let first = t.iter().position(|&e| e == 0).unwrap();
        t.rotate_left(first);
        assert_eq!(t, [0, 4, 8]);
    }

    #[test]
    fn every_plain_case_fits_the_table_and_every_diagonal_leaves_the_faces() {
        for (i, case) in CASES.iter().enumerate().filter(|(_, c)| !c.ambiguous) {
            let crossings = (0..12).filter(|&e| crossed(i as u8, e)).count();
            assert_eq!(case.count as usize, crossings.saturating_sub(2), "case {i}");
        }
    }

    #[test]
    fn opposite_corners_join_through_a_tunnel_only_when_the_body_saddle_is_inside() {
        // Corners 0 and 7 at -1, the rest at r: F(½,½,½) = (6 r - 2) / 8, inside for r < 1/3.
        for (r, triangles) in [(0.1, 6), (0.3, 6), (0.36, 2), (1.0, 2)] {
            let mut v = [r; 8];
            (v[0], v[7]) = (-1.0, -1.0);
            assert_eq!(resolve(case_of(&v), &v).triangles.len(), triangles, "r = {r}");
        }
    }

    #[test]
    fn a_face_tie_joins_the_outside() {
        // Corners 0 and 3 of the face z = 0 inside at -1, 1 and 2 outside at +1: a c = b d.
        let v = [-1.0, 1.0, 1.0, -1.0, 9.0, 9.0, 9.0, 9.0];
        assert_eq!(resolve(case_of(&v), &v).triangles.len(), 2);
    }

    /// Resolves random cells, and returns how many had a tunnel.
    fn random_cells(count: u32) -> usize {
        let mut seed = 7;
        let mut strips = 0;
        for round in 0..count {
            let spread = if round % 2 == 0 { 0 } else { 1 };
            let v: [f32; 8] = std::array::from_fn(|_| {
                let x = noise(&mut seed);
                if spread == 1 { x.signum() * x * x * x * x } else { x }
            });
            let case = case_of(&v);
            let cell = resolve(case, &v);
            let mut edges: HashMap<(u8, u8), i32> = HashMap::new();
            for t in &cell.triangles {
                for k in 0..3 {
                    *edges.entry((t[k], t[(k + 1) % 3])).or_default() += 1;
                }
            }
            for (&(a, b), &n) in &edges {
                assert_eq!(n, 1, "{v:?}");
                let inner = edges.contains_key(&(b, a));
                let on_face = a < INNER && b < INNER && share_face(a, b);
                assert_eq!(inner, !on_face, "{v:?}: edge {a} {b}");
            }
            // No piece carries three loops, and every tunnel found a strip, so faces = vertices.
            let loops = Loops::trace(case, |f| {
                let [a, b, c, d] = f.map(|i| f64::from(v[i as usize]));
                if bit(case, f[0]) { a * c > b * d } else { b * d > a * c }
            });
            let group = join(case, &v.map(f64::from), &loops);
            let joined = (0..loops.loops.len()).filter(|&i| group[i] != i as u8).count();
            assert!(joined <= 1, "{v:?}: {group:?}");
            let crossings = (0..12).filter(|&e| crossed(case, e)).count();
            let disks = loops.loops.len() - 2 * joined;
            let expected = crossings - 2 * disks + 2 * cell.inner.len();
            assert_eq!(cell.triangles.len(), expected, "{v:?}");
            strips += joined;
        }
        strips
    }

    #[test]
    fn in_every_cell_inner_edges_have_two_opposite_faces_and_keep_off_the_cube_faces() {
        let strips = random_cells(40_000);
        assert!(strips > 100, "{strips}");
    }

    #[test]
    #[ignore = "long: run by `tools/test.sh all`; 400,000 cells take seconds"]
    fn in_very_many_cells_inner_edges_have_two_opposite_faces_and_keep_off_the_cube_faces() {
        let strips = random_cells(400_000);
        assert!(strips > 1000, "{strips}");
    }
}
