//! One collapse: may it be, and doing it.
//!
//! The link condition (Dey, Edelsbrunner, Guha, Nekhayev 1999): edge (a, b) may collapse without change
//! of topology when every vertex joined to both is opposite to the edge in one of its triangles, and,
//! with a border taken as joined to one vertex more, the same holds of edges. The triangles that stay
//! may not turn by more than 60° nor become worse than a quality of 0.05, unless they were worse.

use super::rings::{BORDER, CollapseTarget, HELD, NONE, PlaneQuadric, Rings, best, lean};
use crate::geom::shape;
use glam::Vec3;

/// Cosine of how far a triangle may turn: 60°.
pub(super) const TURN: f32 = 0.5;
/// Least quality `4 √3 area / Σ length²` of a triangle.
pub(super) const POOR: f32 = 0.05;
/// No collapse leaves a vertex with more triangles than this, unless one of its ends had more.
const CROWN: usize = 20;

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
    /// Neighbours of the vertex to be.
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

    /// Looks around edge (a, b); false when its collapse would change the topology.
    pub(super) fn gather(&mut self, rings: &Rings, a: u32, b: u32) -> bool {
        if self.epoch >= u32::MAX - 2 {
            self.marks.fill(0);
            self.epoch = 0;
        }
        self.epoch += 2;
        // marks for neighbours of a, and for those of b alone
        let (near_a, near_b) = (self.epoch, self.epoch + 1);
        self.sides.clear();
        self.dropped.clear();
        self.around.clear();
        let (va, vb) = (rings.valence(a), rings.valence(b));
        if va + vb > (CROWN + 4).max(va.max(vb) + 4) {
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
            if area.dot(old) <= TURN * size * old.length() && old != Vec3::ZERO {
                return false;
            }
            let quality = 2.0 * 3f32.sqrt() * size / sum;
            if quality < POOR || quality.is_nan() {
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

/// Returns the best place for the collapse of (a, b), and its cost; `None` where an end is not to be touched.
#[inline]
pub(super) fn place(rings: &Rings, a: u32, b: u32) -> Option<(Vec3, f32)> {
    let (fa, fb) = (rings.flags[a as usize], rings.flags[b as usize]);
    if (fa | fb) & (HELD) != 0 {
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
        // Over and under the triangle 0, 1, 2, which is no face: 0 and 1 have 2 for a common neighbour.
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
