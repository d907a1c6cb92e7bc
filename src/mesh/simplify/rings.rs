//! The mesh while it shrinks: which triangles are around each vertex.
//!
//! Flat arrays only. The rings of all vertices lie in one pool; a ring that outgrows its slot moves
//! to the pool's end. A collapse of (a, b) gives b's triangles to a and drops the one or two that held
//! the edge; nothing else in the mesh changes its number.
//!
//! # Held vertices
//!
//! Vertices where the mesh is no manifold surface stay as they are.
//!
//! On an edge with more than two triangles, or with two that run the same way, and at a vertex whose
//! triangles form more than one fan, the link condition does not apply. Such vertices stay as they are,
//! so that a mesh with a flaw keeps the flaw and gets no others.
//!
//! # Quadrics
//!
//! Distance of a point from the planes of the triangles around a vertex: Garland, Heckbert 1997, without
//! memory (Lindstrom, Turk 1998).
//!
//! Around a vertex `v` with triangles of unit normal `n` and area `A`, all of whose planes pass through
//! `v`, the quadric is `Q(x) = (x − v)ᵀ S (x − v)` with `S = Σ A n nᵀ`. Since it forgets the triangles of
//! former steps, six numbers a vertex are enough, and because they are relative to the vertex, f32 holds
//! them wherever the mesh lies. An edge (a, b) costs the least of `Q_a + Q_b`, found in f64.
//!
//! # Collapses
//!
//! The conditions of an edge collapse, and the collapse itself.
//!
//! The link condition (Dey, Edelsbrunner, Guha, Nekhayev 1999): edge (a, b) may collapse without change
//! of topology when every vertex joined to both is opposite to the edge in one of its triangles, and,
//! with a border taken as joined to one vertex more, the same holds of edges. The triangles that stay
//! may not turn by more than 60° nor become worse than a quality of 0.05, unless they were worse.

use crate::geom::{Mesh, area_vector, cofactors, shape};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Stands for the corners of a dropped triangle.
pub(super) const NONE: u32 = u32::MAX;

/// A border edge resists leaving its line as much as a triangle of this many times its length squared.
const BORDER_WEIGHT: f32 = 3.0;

#[derive(Clone, Copy, Debug, Default)]
struct RingSlot {
    start: u32,
    len: u32,
    capacity: u32,
}

/// A mesh under collapse.
#[derive(Clone)]
pub(super) struct Rings {
    pub positions: Vec<Vec3>,
    /// Empty, or one a vertex.
    pub colors: Vec<[f32; 3]>,
    /// Dropped triangles are [`NONE`] thrice.
    pub triangles: Vec<[u32; 3]>,
    /// `√A n` of each triangle.
    pub leans: Vec<Vec3>,
    pub spreads: Vec<PlaneQuadric>,
    pub flags: Vec<u8>,
    /// Incremented whenever a collapse changes or removes a vertex.
    pub stamps: Vec<u32>,
    /// Triangles that are left.
    pub count: usize,
    slots: Vec<RingSlot>,
    pool: Vec<u32>,
}

impl Rings {
    /// Around the triangles of `mesh`, whose indices must be in range and positions finite. Triangles
    /// with a repeated vertex are left out.
    pub(super) fn new(mesh: &Mesh) -> Rings {
        let n = mesh.positions.len();
        let triangles: Vec<[u32; 3]> =
            mesh.triangles.iter().copied().filter(|t| t[0] != t[1] && t[1] != t[2] && t[2] != t[0]).collect();
        let colors = if mesh.colors.len() == n { mesh.colors.clone() } else { Vec::new() };
        let mut rings = Rings {
            positions: mesh.positions.clone(),
            colors,
            leans: vec![Vec3::ZERO; triangles.len()],
            spreads: vec![PlaneQuadric::default(); n],
            flags: vec![0; n],
            stamps: vec![0; n],
            count: triangles.len(),
            slots: vec![RingSlot::default(); n],
            pool: vec![0; 3 * triangles.len()],
            triangles,
        };
        for &v in rings.triangles.as_flattened() {
            rings.slots[v as usize].capacity += 1;
        }
        let mut start = 0;
        for slot in &mut rings.slots {
            slot.start = start;
            start += slot.capacity;
        }
        for (t, triangle) in rings.triangles.iter().enumerate() {
            for &v in triangle {
                let slot = &mut rings.slots[v as usize];
                rings.pool[(slot.start + slot.len) as usize] = t as u32;
                slot.len += 1;
            }
        }
        rings.flags = (0..n as u32)
            .into_par_iter()
            .map_init(Vec::new, |sides, v| {
                sides.clear();
                sides.extend(rings.ring(v).iter().map(|&t| rings.opposite(t, v)));
                kind(sides)
            })
            .collect();
        rings.measure();
        rings
    }

    /// Returns the triangles around a vertex.
    pub(super) fn ring(&self, v: u32) -> &[u32] {
        let slot = self.slots[v as usize];
        &self.pool[slot.start as usize..(slot.start + slot.len) as usize]
    }

    /// Returns the number of triangles around a vertex; 0 if it was removed.
    pub(super) fn valence(&self, v: u32) -> usize {
        self.slots[v as usize].len as usize
    }

    /// Changes with either end: stamps only grow, so their sum stays the same only if both do.
    pub(super) fn stamp(&self, a: u32, b: u32) -> u32 {
        self.stamps[a as usize].wrapping_add(self.stamps[b as usize])
    }

    /// Returns the three corners of a triangle.
    pub(super) fn corners(&self, t: u32) -> [Vec3; 3] {
        self.triangles[t as usize].map(|v| self.positions[v as usize])
    }

    /// Returns the triangles that are left.
    pub(super) fn alive(&self) -> impl Iterator<Item = u32> {
        (0..self.triangles.len() as u32).filter(|&t| self.triangles[t as usize][0] != NONE)
    }

    /// Returns which corner of a triangle a vertex is; 2 if neither of the first two.
    pub(super) fn corner_of(&self, t: u32, v: u32) -> usize {
        self.triangles[t as usize][..2].iter().position(|&w| w == v).unwrap_or(2)
    }

    /// Returns the other two corners of a triangle, in order.
    pub(super) fn opposite(&self, t: u32, v: u32) -> (u32, u32) {
        let (triangle, k) = (self.triangles[t as usize], self.corner_of(t, v));
        (triangle[(k + 1) % 3], triangle[(k + 2) % 3])
    }

    /// Leans and spreads of everything, from the positions as they are now.
    fn measure(&mut self) {
        self.spreads.fill(PlaneQuadric::default());
        for t in 0..self.triangles.len() {
            let triangle = self.triangles[t];
            if triangle[0] == NONE {
                continue;
            }
            let s = lean(area_vector(self.corners(t as u32)));
            self.leans[t] = s;
            for v in triangle {
                self.spreads[v as usize].add(s);
            }
        }
        for v in 0..self.positions.len() as u32 {
            if self.flags[v as usize] & BORDER != 0 {
                self.measure_at(v);
            }
        }
    }

    /// The spread of one vertex, with the planes through its border edges, upright on their triangles.
    pub(super) fn measure_at(&mut self, v: u32) {
        let mut spread = PlaneQuadric::default();
        let at = self.positions[v as usize];
        for &t in self.ring(v) {
            let s = self.leans[t as usize];
            spread.add(s);
            if self.flags[v as usize] & BORDER == 0 {
                continue;
            }
            let (p, q) = self.opposite(t, v);
            for w in [p, q] {
                if self.flags[w as usize] & BORDER != 0 && self.shared(v, w) == 1 {
                    let edge = self.positions[w as usize] - at;
                    spread.add(BORDER_WEIGHT.sqrt() * s.normalize_or_zero().cross(edge));
                }
            }
        }
        self.spreads[v as usize] = spread;
    }

    /// Returns how many triangles share both vertices.
    fn shared(&self, v: u32, w: u32) -> usize {
        self.ring(v).iter().filter(|&&t| self.triangles[t as usize].contains(&w)).count()
    }

    /// Sets the ring of a vertex, in place if its slot has the capacity.
    pub(super) fn set_ring(&mut self, v: u32, ring: &[u32]) {
        let slot = &mut self.slots[v as usize];
        slot.len = ring.len() as u32;
        if slot.len > slot.capacity {
            slot.start = self.pool.len() as u32;
            slot.capacity = slot.len;
            self.pool.extend_from_slice(ring);
        } else {
            self.pool[slot.start as usize..][..ring.len()].copy_from_slice(ring);
        }
    }

    /// Takes one triangle out of a vertex's ring.
    pub(super) fn leave(&mut self, v: u32, t: u32) {
        let slot = &mut self.slots[v as usize];
        let ring = &mut self.pool[slot.start as usize..(slot.start + slot.len) as usize];
        if let Some(i) = ring.iter().position(|&other| other == t) {
            ring[i] = ring[ring.len() - 1];
            slot.len -= 1;
        }
    }

    /// Compacts the arrays, keeping the order of the remaining vertices and triangles. Also returns which vertices
    /// must not move: those of borders, and where the mesh is not a manifold.
    pub(super) fn into_mesh(self) -> (Mesh, Vec<bool>) {
        let mut fixed = Vec::new();
        let mut number = vec![NONE; self.positions.len()];
        let mut mesh = Mesh::default();
        for v in 0..self.positions.len() {
            if self.slots[v].len > 0 {
                number[v] = mesh.positions.len() as u32;
                mesh.positions.push(self.positions[v]);
                fixed.push(self.flags[v] & (BORDER | FIXED) != 0);
                if let Some(&color) = self.colors.get(v) {
                    mesh.colors.push(color);
                }
            }
        }
        let alive = self.triangles.iter().filter(|t| t[0] != NONE);
        mesh.triangles = alive.map(|t| t.map(|v| number[v as usize])).collect();
        (mesh, fixed)
    }
}

/// Flag of a vertex at an edge with one triangle.
pub(super) const BORDER: u8 = 1;
/// Takes part in no collapse and does not move.
pub(super) const FIXED: u8 = 2;

/// Returns the flags of a vertex, [`BORDER`] or [`FIXED`] or neither, by the sides opposite to it, each from one neighbor
/// to the next: one closed walk through all of them is the inside of a surface, one open walk its border.
pub(super) fn kind(sides: &mut [(u32, u32)]) -> u8 {
    sides.sort_unstable();
    let after = |w: u32| sides.binary_search_by_key(&w, |side| side.0).ok();
    if sides.is_empty() {
        return 0;
    }
    if sides.windows(2).any(|pair| pair[0].0 == pair[1].0) {
        return FIXED;
    }
    // A walk from anywhere either comes back, or ends at a border.
    let walk = |start: usize| {
        let (mut at, mut steps) = (start, 1);
        loop {
            match after(sides[at].1) {
                None => return (steps, true),
                Some(next) if next == start => return (steps, false),
                Some(_) if steps == sides.len() => return (usize::MAX, false),
                Some(next) => (at, steps) = (next, steps + 1),
            }
        }
    };
    match walk(0) {
        (steps, false) if steps == sides.len() => return 0,
        (_, false) => return FIXED,
        (_, true) => {}
    }
    // The border begins at the one side whose first neighbor ends none.
    let mut ends: Vec<u32> = sides.iter().map(|side| side.1).collect();
    ends.sort_unstable();
    let begin = (0..sides.len()).find(|&i| ends.binary_search(&sides[i].0).is_err());
    match begin.map(walk) {
        Some((steps, true)) if steps == sides.len() => BORDER,
        _ => FIXED,
    }
}

/// Share of the trace added to the diagonal, about the middle of the edge: pulls the best point to the middle
/// where the triangles do not say (flat or along a crease). More costs accuracy: on a head simplified to
/// a fifth, 1e-5, 1e-4, 1e-3 leave it 0.0198, 0.0206, 0.0223 off (in 512ths of the cube).
const MIDPOINT_WEIGHT: f64 = 1e-5;

/// Share of the trace, times the squared half edge, added to the cost: short edges go first where all is
/// flat, which halves the slivers of 1e-5 and costs no accuracy.
const LENGTH_WEIGHT: f64 = 3e-5;

/// The best point lies at most this many edge lengths from the edge's middle.
const MAX_OFFSET: f64 = 1.5;

/// The symmetric matrix `Σ A n nᵀ`: xx, xy, xz, yy, yz, zz.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct PlaneQuadric([f32; 6]);

/// `√A n` (up to √2) of a triangle from twice its area vector, whose outer product is its share of a
/// [`PlaneQuadric`]; zero for one without area.
pub(super) fn lean(area: Vec3) -> Vec3 {
    let length = area.length();
    if length > 0.0 { area / length.sqrt() } else { Vec3::ZERO }
}

/// Returns the outer product of a vector with itself.
#[inline]
fn outer(s: Vec3) -> [f32; 6] {
    [s.x * s.x, s.x * s.y, s.x * s.z, s.y * s.y, s.y * s.z, s.z * s.z]
}

impl PlaneQuadric {
    #[inline]
    pub(super) fn add(&mut self, s: Vec3) {
        self.0.iter_mut().zip(outer(s)).for_each(|(m, p)| *m += p);
    }

    #[inline]
    pub(super) fn subtract(&mut self, s: Vec3) {
        self.0.iter_mut().zip(outer(s)).for_each(|(m, p)| *m -= p);
    }

    #[inline]
    fn plus(&self, other: &PlaneQuadric, sign: f64) -> [f64; 6] {
        [0, 1, 2, 3, 4, 5].map(|i| f64::from(self.0[i]) + sign * f64::from(other.0[i]))
    }
}

#[inline]
fn times(m: &[f64; 6], v: DVec3) -> DVec3 {
    DVec3::new(
        m[0] * v.x + m[1] * v.y + m[2] * v.z,
        m[1] * v.x + m[3] * v.y + m[4] * v.z,
        m[2] * v.x + m[4] * v.y + m[5] * v.z,
    )
}

/// The targets of a collapse.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CollapseTarget {
    /// Anywhere.
    Free,
    /// Only its first end.
    First,
    /// Only its second end.
    Second,
}

/// Returns the best point for the collapse of edge (a, b), and its cost: squared distance times area.
///
/// Where the 3 × 3 system is worse than a condition of 1e6 or its solution lies far off, the better of
/// the ends and the middle.
pub(super) fn best(
    a: Vec3,
    qa: &PlaneQuadric,
    b: Vec3,
    qb: &PlaneQuadric,
    freedom: CollapseTarget,
) -> (Vec3, f32) {
    let (da, db) = (a.as_dvec3(), b.as_dvec3());
    let (middle, half) = (0.5 * (da + db), 0.5 * (db - da));
    // With y from the middle: (y + h)ᵀ A (y + h) + (y − h)ᵀ B (y − h)
    //   = yᵀ (A + B) y + 2 yᵀ (A − B) h + hᵀ (A + B) h.
    let sum = qa.plus(qb, 1.0);
    let slope = times(&qa.plus(qb, -1.0), half);
    let trace = sum[0] + sum[3] + sum[5];
    let pull = MIDPOINT_WEIGHT * trace;
    let reach = half.length_squared();
    let constant = half.dot(times(&sum, half)) + LENGTH_WEIGHT * trace * reach;
    let cost = |y: DVec3| (y.dot(times(&sum, y)) + 2.0 * y.dot(slope) + constant).max(0.0) as f32;
    match freedom {
        CollapseTarget::First => return (a, cost(-half)),
        CollapseTarget::Second => return (b, cost(half)),
        CollapseTarget::Free => {}
    }
    if let Some(y) = solve([sum[0] + pull, sum[1], sum[2], sum[3] + pull, sum[4], sum[5] + pull], -slope)
        && y.length_squared() <= 4.0 * MAX_OFFSET * MAX_OFFSET * reach
    {
        // Since (A + B + pull) y = −slope: yᵀ (A + B) y = −y · slope − pull |y|².
        let cost = constant + y.dot(slope) - pull * y.length_squared();
        return ((middle + y).as_vec3(), cost.max(0.0) as f32);
    }
    let mut best = (middle.as_vec3(), cost(DVec3::ZERO));
    for (point, c) in [(a, cost(-half)), (b, cost(half))] {
        if c < best.1 {
            best = (point, c);
        }
    }
    best
}

/// Solves the symmetric system by cofactors; `None` where its condition is above about 1e6.
#[inline]
fn solve(m: [f64; 6], r: DVec3) -> Option<DVec3> {
    let (c, det) = cofactors(m);
    let [xx, _, _, yy, _, zz] = m;
    let trace = xx + yy + zz;
    // For eigenvalues p ≥ q ≥ r > 0: det = pqr and the sum of the principal minors c is about pq, so
    // their quotient is about r, to be compared with the trace, about p.
    let minors = c[0] + c[3] + c[5];
    if !(trace > 0.0 && det > 1e-6 * trace * minors && det.is_finite()) {
        return None;
    }
    let y = times(&c, r) / det;
    y.is_finite().then_some(y)
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
    leans: Vec<Vec3>,
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
        self.leans.clear();
        let mut worst = None;
        for side in &self.sides {
            let (p, q) = (rings.positions[side.from as usize], rings.positions[side.to as usize]);
            let (u, v) = (p - x, q - x);
            let area = u.cross(v);
            let sum = u.length_squared() + v.length_squared() + (q - p).length_squared();
            // Lengths, not their squares: the latter leave f32 where edges are shorter than 1e-7.
            let (size, old) = (area.length(), rings.leans[side.triangle as usize]);
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
            self.leans.push(lean(area));
        }
        true
    }

    /// Returns the triangles of both ends, before the collapse.
    pub(super) fn triangles(&self) -> impl Iterator<Item = u32> {
        self.sides.iter().map(|side| side.triangle).chain(self.dropped.iter().map(|dropped| dropped.0))
    }

    /// Returns the largest distance of `x` from the planes of the triangles of both ends.
    pub(super) fn strays(&self, rings: &Rings, x: Vec3) -> f32 {
        let far = |t: u32| {
            let at = rings.positions[rings.triangles[t as usize][0] as usize];
            rings.leans[t as usize].normalize_or_zero().dot(x - at).abs()
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
        rings.positions[a as usize] = x;
        rings.flags[a as usize] |= rings.flags[b as usize];
        rings.stamps[a as usize] += 1;
        rings.stamps[b as usize] += 1;
        for &(t, opposite) in &self.dropped {
            rings.triangles[t as usize] = [NONE; 3];
            rings.spreads[opposite as usize].subtract(rings.leans[t as usize]);
            rings.leave(opposite, t);
            rings.count -= 1;
        }
        self.ring.clear();
        let mut spread = PlaneQuadric::default();
        for (i, (side, &lean)) in self.sides.iter().zip(&self.leans).enumerate() {
            let t = side.triangle as usize;
            if i >= self.of_a {
                let k = rings.corner_of(side.triangle, b);
                rings.triangles[t][k] = a;
            }
            for w in [side.from, side.to] {
                let other = &mut rings.spreads[w as usize];
                other.subtract(rings.leans[t]);
                other.add(lean);
            }
            rings.leans[t] = lean;
            spread.add(lean);
            self.ring.push(side.triangle);
        }
        rings.spreads[a as usize] = spread;
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

/// Returns the best place for the collapse of (a, b), and its cost; `None` if an end is fixed.
#[inline]
pub(super) fn place(rings: &Rings, a: u32, b: u32) -> Option<(Vec3, f32)> {
    let (fa, fb) = (rings.flags[a as usize], rings.flags[b as usize]);
    if (fa | fb) & (FIXED) != 0 {
        return None;
    }
    let freedom = match (fa & BORDER != 0, fb & BORDER != 0) {
        (true, false) => CollapseTarget::First,
        (false, true) => CollapseTarget::Second,
        _ => CollapseTarget::Free,
    };
    let [pa, pb] = [a, b].map(|v| rings.positions[v as usize]);
    Some(best(pa, &rings.spreads[a as usize], pb, &rings.spreads[b as usize], freedom))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_closed_walk_is_inside_an_open_one_a_border_and_two_are_held() {
        assert_eq!(kind(&mut [(1, 2), (3, 1), (2, 3)]), 0);
        assert_eq!(kind(&mut [(3, 4), (1, 2), (2, 3)]), BORDER);
        assert_eq!(kind(&mut [(1, 2)]), BORDER);
        assert_eq!(kind(&mut [(1, 2), (2, 3), (3, 1), (4, 5), (5, 6), (6, 4)]), FIXED);
        assert_eq!(kind(&mut [(1, 2), (3, 4)]), FIXED);
        assert_eq!(kind(&mut []), 0);
    }

    #[test]
    fn a_third_triangle_on_an_edge_holds_it_whichever_way_it_runs() {
        assert_eq!(kind(&mut [(1, 2), (2, 3), (3, 1), (1, 4)]), FIXED);
        assert_eq!(kind(&mut [(1, 2), (2, 3), (3, 1), (4, 1)]), FIXED);
        // into a loop that does not hold the start
        assert_eq!(kind(&mut [(0, 1), (1, 2), (2, 1)]), FIXED);
    }

    #[test]
    fn many_sides_are_told_apart_the_same_way() {
        let mut sides: Vec<(u32, u32)> = (0..40).map(|i| ((i * 7) % 40, (i * 7 + 1) % 40)).collect();
        assert_eq!(kind(&mut sides), 0);
        sides.pop();
        assert_eq!(kind(&mut sides), BORDER);
        sides.push((7, 99));
        assert_eq!(kind(&mut sides), FIXED);
    }

    fn spread(s: &[Vec3]) -> PlaneQuadric {
        let mut q = PlaneQuadric::default();
        s.iter().for_each(|&s| q.add(s));
        q
    }

    #[test]
    fn three_planes_meet_in_their_corner() {
        // The end a lies in the planes x = 0 and y = 0, the end b in z = 0: they meet in (0, 0, 0).
        let (a, b) = (Vec3::new(0.0, 0.0, 1.0), Vec3::new(0.3, 0.2, 0.0));
        let (x, cost) = best(a, &spread(&[Vec3::X, Vec3::Y]), b, &spread(&[Vec3::Z]), CollapseTarget::Free);
        assert!(x.length() < 1e-4, "{x}");
        // shortness alone: 3e-5 · trace 3 · |h|² = 9e-5 · (0.09 + 0.04 + 1) / 4
        assert!((cost - 2.5425e-5).abs() < 5e-6, "{cost}");
    }

    #[test]
    fn a_flat_edge_goes_to_its_middle_and_a_crease_along_itself() {
        let (a, b) = (Vec3::ZERO, Vec3::X);
        let flat = spread(&[Vec3::Z, Vec3::Z]);
        let (x, cost) = best(a, &flat, b, &flat, CollapseTarget::Free);
        assert_eq!(x, Vec3::new(0.5, 0.0, 0.0));
        assert!((cost - 3e-5).abs() < 1e-9); // 3e-5 · 4 · 0.25
        let crease = spread(&[Vec3::Z, Vec3::Y]);
        assert_eq!(best(a, &crease, b, &flat, CollapseTarget::Free).0, Vec3::new(0.5, 0.0, 0.0));
    }

    #[test]
    fn a_held_end_stays_and_says_what_it_costs() {
        // b leaves the plane x = 1 of its own by 1: cost 1 plus 3e-5 · 2 · 0.25.
        let (a, b) = (Vec3::ZERO, Vec3::X);
        let (x, cost) = best(a, &spread(&[Vec3::Z]), b, &spread(&[Vec3::X]), CollapseTarget::First);
        assert_eq!(x, a);
        assert!((cost - 1.000015).abs() < 1e-6);
        assert_eq!(best(a, &spread(&[Vec3::Z]), b, &spread(&[Vec3::X]), CollapseTarget::Second).0, b);
    }

    #[test]
    fn nothing_around_is_no_reason_to_divide_by_zero() {
        let none = PlaneQuadric::default();
        assert_eq!(
            best(Vec3::ZERO, &none, Vec3::X, &none, CollapseTarget::Free),
            (Vec3::new(0.5, 0.0, 0.0), 0.0)
        );
        assert_eq!(lean(Vec3::ZERO), Vec3::ZERO);
        assert_eq!(solve([1.0, 0.0, 0.0, 1e-3, 0.0, 1e-7], DVec3::ONE), None);
    }

    #[test]
    fn subtracting_what_was_added_leaves_nothing() {
        let mut q = spread(&[Vec3::new(1.0, 2.0, 3.0)]);
        q.subtract(Vec3::new(1.0, 2.0, 3.0));
        assert_eq!(q, PlaneQuadric::default());
    }
}

#[cfg(test)]
mod collapse_tests {
    use super::*;
    use crate::geom::Mesh;

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
        // Over and under the triangle 0, 1, 2, which is no face: 0 and 1 have 2 for a common neighbor.
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
}
