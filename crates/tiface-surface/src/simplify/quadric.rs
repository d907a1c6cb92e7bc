//! Distance of a point from the planes of the triangles around a vertex: Garland, Heckbert 1997,
//! without memory (Lindstrom, Turk 1998).
//!
//! Around a vertex `v` with triangles of unit normal `n` and area `A`, all of whose planes pass
//! through `v`, the quadric is `Q(x) = (x − v)ᵀ S (x − v)` with `S = Σ A n nᵀ`. Since it forgets
//! the triangles of former steps, six numbers a vertex are enough, and because they are relative to
//! the vertex, f32 holds them wherever the mesh lies. An edge (a, b) costs the least of
//! `Q_a + Q_b`, found in f64.

use glam::{DVec3, Vec3};
use tiface_base::geom::cofactors;

/// Share of the trace added to the diagonal, about the middle of the edge: pulls the best point to
/// the middle where the triangles do not say (flat or along a crease). More costs accuracy: on a
/// head simplified to a fifth, 1e-5, 1e-4, 1e-3 leave it 0.0198, 0.0206, 0.0223 off (in 512ths of
/// the cube).
const MIDPOINT_WEIGHT: f64 = 1e-5;

/// Share of the trace, times the squared half edge, added to the cost: short edges go first where
/// all is flat, which halves the slivers of 1e-5 and costs no accuracy.
const LENGTH_WEIGHT: f64 = 3e-5;

/// The best point lies at most this many edge lengths from the edge's middle.
const MAX_OFFSET: f64 = 1.5;

/// The symmetric matrix `Σ A n nᵀ`: xx, xy, xz, yy, yz, zz.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct PlaneQuadric([f32; 6]);

/// `√A n` (up to √2) of a triangle from twice its area vector, whose outer product is its share of
/// a [`PlaneQuadric`]; zero for one without area.
pub(super) fn scaled_normal(area: Vec3) -> Vec3 {
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

/// Where the new vertex of a collapse may lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum AllowedTarget {
    /// Anywhere.
    Free,
    /// Only its first end.
    First,
    /// Only its second end.
    Second,
}

/// Returns the best point for the collapse of edge (a, b), and its cost: squared distance times
/// area.
///
/// Where the 3 × 3 system is worse than a condition of 1e6 or its solution lies far off, the better
/// of the ends and the middle.
pub(super) fn best(
    a: Vec3,
    qa: &PlaneQuadric,
    b: Vec3,
    qb: &PlaneQuadric,
    allowed: AllowedTarget,
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
    match allowed {
        AllowedTarget::First => return (a, cost(-half)),
        AllowedTarget::Second => return (b, cost(half)),
        AllowedTarget::Free => {}
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
    // For eigenvalues p ≥ q ≥ r > 0: det = pqr and the sum of the principal minors c is about pq,
    // so their quotient is about r, to be compared with the trace, about p.
    let minors = c[0] + c[3] + c[5];
    if !(trace > 0.0 && det > 1e-6 * trace * minors && det.is_finite()) {
        return None;
    }
    let y = times(&c, r) / det;
    y.is_finite().then_some(y)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quadric(s: &[Vec3]) -> PlaneQuadric {
        let mut q = PlaneQuadric::default();
        s.iter().for_each(|&s| q.add(s));
        q
    }

    #[test]
    fn three_planes_meet_in_their_corner() {
        // The end a lies in the planes x = 0 and y = 0, the end b in z = 0: they meet in (0, 0, 0).
        let (a, b) = (Vec3::new(0.0, 0.0, 1.0), Vec3::new(0.3, 0.2, 0.0));
        let (x, cost) = best(a, &quadric(&[Vec3::X, Vec3::Y]), b, &quadric(&[Vec3::Z]), AllowedTarget::Free);
        assert!(x.length() < 1e-4, "{x}");
        // shortness alone: 3e-5 · trace 3 · |h|² = 9e-5 · (0.09 + 0.04 + 1) / 4
        assert!((cost - 2.5425e-5).abs() < 5e-6, "{cost}");
    }

    #[test]
    fn a_flat_edge_goes_to_its_middle_and_a_crease_along_itself() {
        let (a, b) = (Vec3::ZERO, Vec3::X);
        let flat = quadric(&[Vec3::Z, Vec3::Z]);
        let (x, cost) = best(a, &flat, b, &flat, AllowedTarget::Free);
        assert_eq!(x, Vec3::new(0.5, 0.0, 0.0));
        assert!((cost - 3e-5).abs() < 1e-9); // 3e-5 · 4 · 0.25
        let crease = quadric(&[Vec3::Z, Vec3::Y]);
        assert_eq!(best(a, &crease, b, &flat, AllowedTarget::Free).0, Vec3::new(0.5, 0.0, 0.0));
    }

    #[test]
    fn a_held_end_stays_and_says_what_it_costs() {
        // b leaves the plane x = 1 of its own by 1: cost 1 plus 3e-5 · 2 · 0.25.
        let (a, b) = (Vec3::ZERO, Vec3::X);
        let (x, cost) = best(a, &quadric(&[Vec3::Z]), b, &quadric(&[Vec3::X]), AllowedTarget::First);
        assert_eq!(x, a);
        assert!((cost - 1.000015).abs() < 1e-6);
        assert_eq!(best(a, &quadric(&[Vec3::Z]), b, &quadric(&[Vec3::X]), AllowedTarget::Second).0, b);
    }

    #[test]
    fn nothing_around_is_no_reason_to_divide_by_zero() {
        let none = PlaneQuadric::default();
        assert_eq!(
            best(Vec3::ZERO, &none, Vec3::X, &none, AllowedTarget::Free),
            (Vec3::new(0.5, 0.0, 0.0), 0.0)
        );
        assert_eq!(scaled_normal(Vec3::ZERO), Vec3::ZERO);
        assert_eq!(solve([1.0, 0.0, 0.0, 1e-3, 0.0, 1e-7], DVec3::ONE), None);
    }

    #[test]
    fn subtracting_what_was_added_leaves_nothing() {
        let mut q = quadric(&[Vec3::new(1.0, 2.0, 3.0)]);
        q.subtract(Vec3::new(1.0, 2.0, 3.0));
        assert_eq!(q, PlaneQuadric::default());
    }
}
