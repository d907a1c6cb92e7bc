//! Moves of vertices: the step towards a field's zero, and how much of a move triangles allow.

use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::{area_vector, shape};

/// Below this shape a face counts as spoiled, unless it was no better before.
pub(super) const MIN_QUALITY: f32 = 0.02;
/// A face may turn until this cosine against its direction at extraction.
pub(super) const MIN_TURN_COSINE: f32 = 0.2;

/// Returns the first-order step to a field's zero, `−f g / |g|²`; `None` if value or gradient is
/// unusable.
pub(super) fn newton(f: f32, g: Vec3) -> Option<Vec3> {
    let slope = g.length_squared();
    let step = -f / slope * g;
    (slope.is_finite() && slope >= 1e-12 && step.is_finite()).then_some(step)
}

/// Moves vertices all the way, half of it, a quarter, or not at all where a triangle would be
/// spoiled; returns how many were held back.
///
/// `at(v, p, share)` is where vertex `v`, now at `p`, is after that share of its way.
/// `spoiled(t, from, to)` is only evaluated for triangles of which a vertex moved.
pub(super) fn move_vertices(
    positions: &mut [Vec3],
    triangles: &[[u32; 3]],
    at: impl Fn(usize, Vec3, f32) -> Vec3,
    spoiled: impl Fn(usize, &[Vec3], &[Vec3]) -> bool + Sync,
) -> usize {
    const SHARES: [f32; 4] = [0.0, 0.25, 0.5, 1.0];
    let from = positions.to_vec();
    positions.iter_mut().enumerate().for_each(|(v, p)| *p = at(v, *p, 1.0));
    let mut share = vec![3u8; from.len()];
    let mut watched: Vec<usize> = (0..triangles.len()).collect();
    loop {
        let moved = |t: usize| triangles[t].iter().any(|&v| from[v as usize] != positions[v as usize]);
        let bad: Vec<usize> =
            watched.into_par_iter().filter(|&t| moved(t) && spoiled(t, &from, positions)).collect();
        let mut corners: Vec<u32> =
            bad.iter().flat_map(|&t| triangles[t]).filter(|&v| share[v as usize] > 0).collect();
        // triangles that were spoiled from the start do not hold vertices back
        if corners.is_empty() {
            break;
        }
        corners.sort_unstable();
        corners.dedup();
        let mut changed = vec![false; from.len()];
        for v in corners.into_iter().map(|v| v as usize) {
            share[v] -= 1;
            changed[v] = true;
            positions[v] = at(v, from[v], SHARES[share[v] as usize]);
        }
        let touched = |t: &usize| triangles[*t].iter().any(|&v| changed[v as usize]);
        watched = (0..triangles.len()).filter(touched).collect();
    }
    share.iter().filter(|&&s| s < 3).count()
}

/// What a move may do to a triangle.
pub(super) struct MoveLimits {
    /// Minimum cosine of the angle by which it turns.
    pub turn_cosine: f32,
    /// Minimum shape, unless it was no better before.
    pub quality: f32,
}

/// The limits for a surface as it was extracted.
pub(super) const EXTRACTED: MoveLimits = MoveLimits { turn_cosine: MIN_TURN_COSINE, quality: MIN_QUALITY };

/// Moves vertices to `targets`, or part of the way where a triangle would be spoiled. Returns the
/// number of vertices that were held back.
pub(super) fn move_to(
    positions: &mut [Vec3],
    triangles: &[[u32; 3]],
    targets: &[Vec3],
    limits: &MoveLimits,
) -> usize {
    let at = |i: usize, p: Vec3, share: f32| match share {
        1.0 => targets[i],
        _ => p + share * (targets[i] - p),
    };
    let spoiled = |t: usize, from: &[Vec3], to: &[Vec3]| {
        let [was, is] = [from, to].map(|p| triangles[t].map(|v| p[v as usize]));
        let (old, new) = (area_vector(was), area_vector(is));
        let along = old.dot(new);
        let turned = along <= limits.turn_cosine * old.length() * new.length() || along.is_nan();
        (turned && old != Vec3::ZERO) || (shape(is) < limits.quality && shape(is) < shape(was))
    };
    move_vertices(positions, triangles, at, spoiled)
}
