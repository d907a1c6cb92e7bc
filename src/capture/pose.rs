//! Pose matrices: a rotation and a position, or a reason why not.

use glam::{DMat3, DVec3};

/// How far `RᵀR` may be from the identity.
const TOLERANCE: f64 = 1e-3;

/// Rotation and position of the upper three rows of a camera-to-world matrix; the rotation comes back
/// exactly orthonormal. The problem says whether the matrix mirrors, scales or shears.
pub(super) fn pose(rows: &[[f64; 4]; 3]) -> Result<(DMat3, DVec3), String> {
    if rows.iter().flatten().any(|v| !v.is_finite()) {
        return Err("its pose holds a number that is not finite".into());
    }
    let column = |k: usize| DVec3::new(rows[0][k], rows[1][k], rows[2][k]);
    let rotation = orthonormal(DMat3::from_cols(column(0), column(1), column(2)))?;
    Ok((rotation, column(3)))
}

/// The nearest rotation to one that is a rotation within [`TOLERANCE`].
pub(super) fn orthonormal(m: DMat3) -> Result<DMat3, String> {
    let lengths = [m.x_axis.length(), m.y_axis.length(), m.z_axis.length()];
    let determinant = m.determinant();
    let volume = lengths[0] * lengths[1] * lengths[2];
    if volume <= 1e-30 || determinant.abs() < 1e-6 * volume {
        return Err("its rotation is singular: it flattens space".into());
    }
    if determinant < 0.0 {
        return Err(format!("its rotation mirrors (determinant {determinant:.4}), cameras cannot"));
    }
    let error = m.transpose() * m - DMat3::IDENTITY;
    let worst = error.to_cols_array().iter().fold(0.0f64, |a, b| a.max(b.abs()));
    if worst > TOLERANCE {
        let mean = (lengths[0] + lengths[1] + lengths[2]) / 3.0;
        let scaled = (m.transpose() * m) * (1.0 / (mean * mean)) - DMat3::IDENTITY;
        if scaled.to_cols_array().iter().all(|e| e.abs() <= TOLERANCE) {
            return Err(format!("its rotation also scales, by {mean:.6}"));
        }
        return Err(format!(
            "its rotation is not orthonormal: RᵀR differs from the identity by {worst:.4} (allowed {TOLERANCE})"
        ));
    }
    // Newton's iteration for the polar decomposition; from 1e-3 three steps reach 1e-16
    let mut r = m;
    for _ in 0..4 {
        r = (r + r.inverse().transpose()) * 0.5;
    }
    Ok(r)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(m: DMat3) -> [[f64; 4]; 3] {
        [0, 1, 2].map(|r| [m.x_axis[r], m.y_axis[r], m.z_axis[r], r as f64])
    }

    #[test]
    fn a_rotation_passes_and_is_made_exact() {
        let r = DMat3::from_rotation_y(0.3) * DMat3::from_rotation_x(1.0);
        let (found, position) = pose(&rows(r * 1.0003)).unwrap();
        assert!((found - r).to_cols_array().iter().all(|e| e.abs() < 1e-12));
        assert_eq!(position, DVec3::new(0.0, 1.0, 2.0));
    }

    #[test]
    fn mirrors_scales_shears_and_flat_ones_are_told_apart() {
        let says = |m: DMat3| pose(&rows(m)).unwrap_err();
        assert!(says(DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0))).contains("mirrors"));
        assert!(says(DMat3::IDENTITY * 2.0).contains("scales, by 2.0"));
        assert!(says(DMat3::from_diagonal(DVec3::new(1.0, 1.01, 1.0))).contains("not orthonormal"));
        assert!(says(DMat3::from_diagonal(DVec3::new(1.0, 1.0, 0.0))).contains("singular"));
        assert!(says(DMat3::IDENTITY * f64::NAN).contains("not finite"));
    }
}
