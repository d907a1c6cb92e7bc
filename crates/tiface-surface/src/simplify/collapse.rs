//! Collapses of edges in the order of their cost, to a sixteenth of an octave.
//!
//! An edge may collapse under the link condition (Dey, Edelsbrunner, Guha, Nekhayev 1999): edge (a,
//! b) may collapse without change of topology when every vertex joined to both is opposite to the
//! edge in one of its triangles, and, with a border taken as joined to one vertex more, the same
//! holds of edges. The triangles that stay may not turn by more than 60° nor become worse than a
//! quality of 0.05, unless they were worse.
//!
//! A heap would order edges exactly, at a cache miss a level. Here an edge falls into a bucket by
//! the upper bits of its cost (positive floats are ordered as their bits), and a bucket is worked
//! through first in, first out, which also visits neighbors in memory one after another. Outdated
//! entries stay where they are: the caller recognizes them by `stamp`.

use super::crossing::CrossingIndex;
use super::quadric::{AllowedTarget, PlaneQuadric, best, scaled_normal};
use super::rings::{BORDER, FIXED, NONE, Rings};
use super::{SimplifyReport, Task};
use glam::Vec3;
use tiface_base::Result;
use tiface_base::geom::{Aabb, shape};

/// Buckets that a cost may have grown since the edge was entered: a quarter of it.
const COST_SLACK: usize = 4;

/// Maximum number of edges of a new vertex that are queued, the cheapest first. The vertices around
/// have theirs from before; all seven would take a tenth longer and win a hundredth of the error.
const EDGES_PER_VERTEX: usize = 3;

/// Number of collapses between two checks for a stop request.
const STOP_CHECK_INTERVAL: usize = 1 << 12;

/// Collapses edges until `target` triangles are left, or no edge may. With `budgets`, a collapse
/// may not stray farther from the planes before it than both its ends have left, and uses that up.
pub(super) fn reduce(
    rings: &mut Rings,
    task: &Task,
    target: usize,
    mut budgets: Option<&mut [f32]>,
    report: &mut SimplifyReport,
) -> Result<()> {
    let mut star = EdgeLink::new(rings.positions.len());
    let mut index = task.apart.then(|| CrossingIndex::new(rings));
    let mut breath = 0;
    let mut offers: Vec<(u32, u32)> = Vec::new();
    // A refused collapse may become possible when its surroundings change, so repeat until none is.
    loop {
        let before = rings.count;
        let mut queue = fill(rings);
        while rings.count > target {
            breath += 1;
            if breath % STOP_CHECK_INTERVAL == 0 {
                task.monitor.check_stop()?;
            }
            let Some((bucket, Entry { a, b, stamp })) = queue.pop() else { break };
            if rings.stamp(a, b) != stamp {
                continue; // an end was removed, or its edges were entered again
            }
            let Some((x, cost)) = collapse_target(rings, a, b) else { continue };
            let now = EdgeQueue::bucket(cost);
            if now > bucket + COST_SLACK {
                queue.push(now, Entry { a, b, stamp });
                continue;
            }
            if !star.gather(rings, a, b) || !star.fits(rings, x) {
                report.refused += 1;
                continue;
            }
            if let Some(budgets) = budgets.as_deref_mut() {
                let left = budgets[a as usize].min(budgets[b as usize]) - star.max_plane_distance(rings, x);
                if left < 0.0 {
                    report.refused += 1;
                    continue;
                }
                budgets[a as usize] = left;
            }
            if let Some(index) = &mut index {
                let made = star.sides.iter().map(|s| {
                    let [p, q] = [s.from, s.to].map(|v| rings.positions[v as usize]);
                    ([a, s.from, s.to], [x, p, q])
                });
                if index.would_cross(rings, star.triangles(), made) {
                    report.crossing += 1;
                    continue;
                }
                for side in &star.sides {
                    let [p, q] = [side.from, side.to].map(|v| rings.positions[v as usize]);
                    let old = Aabb::around(rings.corners(side.triangle));
                    index.enter(side.triangle, Aabb::around([x, p, q]), Some(old));
                }
            }
            star.apply(rings, a, b, x);
            report.collapses += 1;
            offers.clear();
            for &w in &star.around {
                if let Some((_, cost)) = collapse_target(rings, a, w) {
                    offers.push((EdgeQueue::bucket(cost) as u32, w));
                }
            }
            if offers.len() > EDGES_PER_VERTEX {
                offers.select_nth_unstable(EDGES_PER_VERTEX - 1);
                offers.truncate(EDGES_PER_VERTEX);
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

/// Returns a queue of all edges.
fn fill(rings: &Rings) -> EdgeQueue {
    let mut queue = EdgeQueue::new();
    for t in rings.alive() {
        let triangle = rings.triangles[t as usize];
        for k in 0..3 {
            let (a, b) = (triangle[k], triangle[(k + 1) % 3]);
            // inner edges are visited from both ends, border edges from one
            let border = rings.flags[a as usize] & rings.flags[b as usize] & BORDER != 0;
            if (a < b || border)
                && let Some((_, cost)) = collapse_target(rings, a, b)
            {
                queue.push(EdgeQueue::bucket(cost), Entry { a, b, stamp: rings.stamp(a, b) });
            }
        }
    }
    queue
}

/// Cosine of how far a triangle may turn: 60°.
pub(super) const MIN_TURN_COSINE: f32 = 0.5;
/// Least quality `4 √3 area / Σ length²` of a triangle.
pub(super) const MIN_QUALITY: f32 = 0.05;
/// No collapse leaves a vertex with more triangles than this, unless one of its ends had more.
const MAX_VALENCE: usize = 20;

/// A triangle that will have the new vertex for a corner, and its other two corners in order.
#[derive(Clone, Copy)]
pub(super) struct FanTriangle {
    pub triangle: u32,
    pub from: u32,
    pub to: u32,
}

/// The neighborhood of an edge, reused between collapses to save allocations.
#[derive(Default)]
pub(super) struct EdgeLink {
    /// Triangles of a, then of b, that stay; the first `of_a` are a's.
    pub sides: Vec<FanTriangle>,
    of_a: usize,
    /// Triangles that hold the edge, with the vertex opposite to it.
    dropped: Vec<(u32, u32)>,
    /// Neighbors of the vertex to be.
    pub around: Vec<u32>,
    scaled_normals: Vec<Vec3>,
    ring: Vec<u32>,
    marks: Vec<u32>,
    epoch: u32,
}

impl EdgeLink {
    pub(super) fn new(vertices: usize) -> EdgeLink {
        EdgeLink { marks: vec![0; vertices], ..EdgeLink::default() }
    }

    /// Collects the neighborhood of edge (a, b); false if its collapse would change the topology.
    pub(super) fn gather(&mut self, rings: &Rings, a: u32, b: u32) -> bool {
        if self.epoch >= u32::MAX - 2 {
            self.marks.fill(0);
            self.epoch = 0;
        }
        self.epoch += 2;
        // marks for neighbors of a, and for those of b alone
        let (near_a, near_b) = (self.epoch, self.epoch + 1);
        self.sides.clear();
        self.dropped.clear();
        self.around.clear();
        let (va, vb) = (rings.valence(a), rings.valence(b));
        if va + vb > (MAX_VALENCE + 4).max(va.max(vb) + 4) {
            return false;
        }
        for &t in rings.ring(a) {
            let (from, to) = rings.opposite(t, a);
            for w in [from, to] {
                if self.marks[w as usize] != near_a && w != b {
                    self.marks[w as usize] = near_a;
                    self.around.push(w);
                }
            }
            if from == b {
                self.dropped.push((t, to));
            } else if to == b {
                self.dropped.push((t, from));
            } else {
                self.sides.push(FanTriangle { triangle: t, from, to });
            }
        }
        self.of_a = self.sides.len();
        let opposite = match self.dropped[..] {
            [(_, c)] => [c, c],
            [(_, c), (_, d)] if c != d => [c, d],
            _ => return false,
        };
        let borders = (rings.flags[a as usize] & BORDER, rings.flags[b as usize] & BORDER);
        if borders.0 & borders.1 != 0 && self.dropped.len() == 2 {
            return false; // would pinch the surface between two borders
        }
        let spans = |s: &FanTriangle| [s.from, s.to] == opposite || [s.to, s.from] == opposite;
        let mut closes = false;
        for &t in rings.ring(b) {
            let (from, to) = rings.opposite(t, b);
            if from == a || to == a {
                continue;
            }
            for w in [from, to] {
                if self.marks[w as usize] < near_a {
                    self.marks[w as usize] = near_b;
                    self.around.push(w);
                } else if self.marks[w as usize] == near_a && !opposite.contains(&w) {
                    return false;
                }
            }
            let side = FanTriangle { triangle: t, from, to };
            closes |= spans(&side);
            self.sides.push(side);
        }
        if self.sides.is_empty() || (closes && self.sides[..self.of_a].iter().any(spans)) {
            return false; // nothing would be left, or two triangles over the same corners
        }
        true
    }

    /// Returns whether the triangles that stay would be sound with the new vertex at `x`.
    pub(super) fn fits(&mut self, rings: &Rings, x: Vec3) -> bool {
        self.scaled_normals.clear();
        let mut worst = None;
        for side in &self.sides {
            let (p, q) = (rings.positions[side.from as usize], rings.positions[side.to as usize]);
            let (u, v) = (p - x, q - x);
            let area = u.cross(v);
            let sum = u.length_squared() + v.length_squared() + (q - p).length_squared();
            // Lengths, not their squares: the latter leave f32 where edges are shorter than 1e-7.
            let (size, old) = (area.length(), rings.scaled_normals[side.triangle as usize]);
            if area.dot(old) <= MIN_TURN_COSINE * size * old.length() && old != Vec3::ZERO {
                return false;
            }
            let quality = 2.0 * 3f32.sqrt() * size / sum;
            if quality < MIN_QUALITY || quality.is_nan() {
                let worst = *worst.get_or_insert_with(|| self.worst(rings));
                if quality <= worst || quality.is_nan() {
                    return false;
                }
            }
            self.scaled_normals.push(scaled_normal(area));
        }
        true
    }

    /// Returns the triangles of both ends, before the collapse.
    pub(super) fn triangles(&self) -> impl Iterator<Item = u32> {
        self.sides.iter().map(|side| side.triangle).chain(self.dropped.iter().map(|dropped| dropped.0))
    }

    /// Returns the largest distance of `x` from the planes of the triangles of both ends.
    pub(super) fn max_plane_distance(&self, rings: &Rings, x: Vec3) -> f32 {
        let far = |t: u32| {
            let at = rings.positions[rings.triangles[t as usize][0] as usize];
            rings.scaled_normals[t as usize].normalize_or_zero().dot(x - at).abs()
        };
        self.triangles().map(far).fold(0.0, f32::max)
    }

    /// Returns the worst quality among all triangles of both ends.
    fn worst(&self, rings: &Rings) -> f32 {
        self.triangles().map(|t| shape(rings.corners(t))).fold(f32::INFINITY, f32::min)
    }

    /// Collapses edge (a, b), last gathered and found fit, into a at `x`.
    pub(super) fn apply(&mut self, rings: &mut Rings, a: u32, b: u32, x: Vec3) {
        if !rings.colors.is_empty() {
            let (from, to) = (rings.positions[a as usize], rings.positions[b as usize]);
            let edge = to - from;
            let share = ((x - from).dot(edge) / edge.length_squared()).clamp(0.0, 1.0);
            let share = if share.is_nan() { 0.5 } else { share };
            let (ca, cb) = (rings.colors[a as usize], rings.colors[b as usize]);
            rings.colors[a as usize] = [0, 1, 2].map(|k| ca[k] + share * (cb[k] - ca[k]));
        }
        if !rings.importance.is_empty() {
            rings.importance[a as usize] = rings.mean_importance(a, b);
        }
        rings.positions[a as usize] = x;
        rings.flags[a as usize] |= rings.flags[b as usize];
        rings.stamps[a as usize] += 1;
        rings.stamps[b as usize] += 1;
        for &(t, opposite) in &self.dropped {
            rings.triangles[t as usize] = [NONE; 3];
            rings.quadrics[opposite as usize].subtract(rings.scaled_normals[t as usize]);
            rings.leave(opposite, t);
            rings.count -= 1;
        }
        self.ring.clear();
        let mut quadric = PlaneQuadric::default();
        for (i, (side, &normal)) in self.sides.iter().zip(&self.scaled_normals).enumerate() {
            let t = side.triangle as usize;
            if i >= self.of_a {
                let k = rings.corner_of(side.triangle, b);
                rings.triangles[t][k] = a;
            }
            for w in [side.from, side.to] {
                let other = &mut rings.quadrics[w as usize];
                other.subtract(rings.scaled_normals[t]);
                other.add(normal);
            }
            rings.scaled_normals[t] = normal;
            quadric.add(normal);
            self.ring.push(side.triangle);
        }
        rings.quadrics[a as usize] = quadric;
        rings.set_ring(a, &self.ring);
        rings.set_ring(b, &[]);
        if rings.flags[a as usize] & BORDER != 0 {
            rings.measure_at(a);
        }
        for &w in &self.around {
            if rings.flags[w as usize] & BORDER != 0 {
                rings.measure_at(w);
            }
        }
    }
}

/// Returns the position of the new vertex of a collapse of (a, b), and its cost; `None` if an end
/// is fixed.
#[inline]
pub(super) fn collapse_target(rings: &Rings, a: u32, b: u32) -> Option<(Vec3, f32)> {
    let (fa, fb) = (rings.flags[a as usize], rings.flags[b as usize]);
    if (fa | fb) & (FIXED) != 0 {
        return None;
    }
    let allowed = match (fa & BORDER != 0, fb & BORDER != 0) {
        (true, false) => AllowedTarget::First,
        (false, true) => AllowedTarget::Second,
        _ => AllowedTarget::Free,
    };
    let [pa, pb] = [a, b].map(|v| rings.positions[v as usize]);
    let (x, cost) = best(pa, &rings.quadrics[a as usize], pb, &rings.quadrics[b as usize], allowed);
    Some((x, if rings.importance.is_empty() { cost } else { rings.mean_importance(a, b) * cost }))
}

/// Number of leading bits of a cost that select its bucket: sign and exponent, and four bits of the
/// mantissa.
const SHIFT: u32 = 19;

/// A queued edge with the stamps of its ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Entry {
    a: u32,
    b: u32,
    /// Sum of the ends' stamps.
    stamp: u32,
}

/// Edges in buckets by cost.
struct EdgeQueue {
    buckets: Vec<Vec<Entry>>,
    /// No bucket below this one has entries.
    lowest: usize,
    /// Being worked through: entries, how many are done, their bucket.
    current: Vec<Entry>,
    done: usize,
    bucket: usize,
}

impl EdgeQueue {
    fn new() -> EdgeQueue {
        let buckets = vec![Vec::new(); (f32::INFINITY.to_bits() >> SHIFT) as usize + 1];
        EdgeQueue { buckets, lowest: usize::MAX, current: Vec::new(), done: 0, bucket: 0 }
    }

    /// Returns the bucket of a cost ≥ 0; NaN goes last.
    fn bucket(cost: f32) -> usize {
        // + 0 makes −0 and 0 equal
        let cost = if cost.is_nan() { f32::INFINITY } else { cost.max(0.0) + 0.0 };
        (cost.to_bits() >> SHIFT) as usize
    }

    fn push(&mut self, bucket: usize, entry: Entry) {
        self.buckets[bucket].push(entry);
        self.lowest = self.lowest.min(bucket);
    }

    /// Returns the next entry and its bucket.
    fn pop(&mut self) -> Option<(usize, Entry)> {
        while self.done == self.current.len() {
            self.current.clear();
            self.done = 0;
            let next = (self.lowest..self.buckets.len()).find(|&i| !self.buckets[i].is_empty());
            self.lowest = next.unwrap_or(usize::MAX);
            self.bucket = next?;
            std::mem::swap(&mut self.current, &mut self.buckets[self.bucket]);
        }
        self.done += 1;
        Some((self.bucket, self.current[self.done - 1]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::geom::Mesh;

    fn may(triangles: &[[u32; 3]], a: u32, b: u32) -> bool {
        let n = triangles.iter().flatten().max().unwrap() + 1;
        // on a parabola, so that nothing is degenerate
        let positions: Vec<Vec3> = (0..n).map(|i| i as f32).map(|x| Vec3::new(x, x * x, x * x * x)).collect();
        let rings = Rings::new(&Mesh { positions, triangles: triangles.to_vec(), ..Mesh::default() });
        EdgeLink::new(n as usize).gather(&rings, a, b)
    }

    #[test]
    fn a_tetrahedron_gives_no_edge_and_an_octahedron_every_one() {
        assert!(!may(&[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], 0, 1));
        let octahedron =
            [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]];
        assert!(may(&octahedron, 0, 1) && may(&octahedron, 2, 4) && may(&octahedron, 5, 3));
    }

    #[test]
    fn the_waist_of_a_double_pyramid_must_not_close() {
        // Over and under the triangle 0, 1, 2, which is no face: 0 and 1 have 2 for a common
        // neighbor.
        let waist = [[0, 1, 3], [1, 2, 3], [2, 0, 3], [1, 0, 4], [2, 1, 4], [0, 2, 4]];
        assert!(!may(&waist, 0, 1));
        assert!(may(&waist, 0, 3)); // leaves the tetrahedron 0, 1, 2, 4
    }

    #[test]
    fn borders_shrink_but_do_not_meet() {
        assert!(!may(&[[0, 1, 2]], 0, 1));
        // two triangles: the diagonal joins two borders, an outer edge may go
        let square = [[0, 1, 2], [0, 2, 3]];
        assert!(!may(&square, 0, 2));
        assert!(may(&square, 0, 1));
        // a ring between two borders of three: their last edges stay, and they do not meet
        let hole = [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]];
        assert!(!may(&hole, 0, 1) && !may(&hole, 3, 4));
        assert!(!may(&hole, 0, 4));
    }

    #[test]
    fn shape_is_one_for_equilateral_and_none_on_a_line() {
        let c = Vec3::new(0.5, 0.75f32.sqrt(), 0.0);
        assert!((shape([Vec3::ZERO, Vec3::X, c]) - 1.0).abs() < 1e-6);
        assert_eq!(shape([Vec3::ZERO, Vec3::X, 2.0 * Vec3::X]), 0.0);
        assert_eq!(shape([Vec3::X; 3]), 0.0);
    }

    #[test]
    fn cheap_edges_come_first_and_equal_ones_in_their_order() {
        let mut q = EdgeQueue::new();
        for (a, cost) in [(0, 2.0), (1, 1e-20), (2, 2.01), (3, 0.0), (4, f32::NAN), (5, 1e30)] {
            q.push(EdgeQueue::bucket(cost), Entry { a, b: 9, stamp: 0 });
        }
        let order: Vec<u32> = std::iter::from_fn(|| q.pop()).map(|(_, e)| e.a).collect();
        assert_eq!(order, [3, 1, 0, 2, 5, 4]);
        q.push(EdgeQueue::bucket(1.0), Entry { a: 7, b: 9, stamp: 0 });
        assert_eq!(q.pop().map(|(_, e)| e.a), Some(7));
        assert_eq!(q.pop(), None);
    }
}
