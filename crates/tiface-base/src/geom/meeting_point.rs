//! Where rays meet, as nearly as they do.

use glam::{DMat3, DVec3};

/// Returns the point nearest to all rays, least squares: `Σ (I − ddᵀ)(p − o) = 0`. `None` when they
/// are parallel within about half a degree.
pub fn meeting_point(rays: &[(DVec3, DVec3)]) -> Option<DVec3> {
    // sums relative to one origin: far-away worlds would lose digits
    let base = rays.first()?.0;
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for &(origin, direction) in rays {
        let outer =
            DMat3::from_cols(direction * direction.x, direction * direction.y, direction * direction.z);
        let across = DMat3::IDENTITY - outer;
        a += across;
        b += across * (origin - base);
    }
    let n = rays.len() as f64;
    // for a small spread θ of directions the eigenvalues of A/n are 1, 1 and the variance of θ
    if (a * (1.0 / n)).determinant() < 1e-4 {
        return None;
    }
    Some(base + a.inverse() * b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_where_they_cross_and_parallel_ones_nowhere() {
        let p = DVec3::new(1e6, -2.0, 3.0);
        let rays: Vec<_> = [DVec3::X, DVec3::Y, DVec3::new(0.6, 0.0, 0.8)].map(|d| (p - 4.0 * d, d)).into();
        assert!(meeting_point(&rays).unwrap().distance(p) < 1e-6);
        let parallel = [(DVec3::ZERO, DVec3::X), (DVec3::Y, DVec3::X)];
        assert!(meeting_point(&parallel).is_none());
    }
}
