//! View-dependent color in a few numbers a texel: real spherical harmonics of the direction to the
//! viewer.
//!
//! A texel's color seen from direction `d` is `base + Σ_k L_k Y_k(d)`, sRGB-coded, with `Y` up to
//! degree 1 (4 functions) or 2 (9) in the order and signs of [`tiface_base::geom::sphharm::sh16`];
//! [`tiface_base::geom::sphharm::combine`] sums them. `base` is what an ordinary viewer shows. The
//! coefficients minimize, over the cameras that see the point,
//!
//! ```text
//! Σ_i w_i ‖base + Σ_k L_k Y_k(d_i) − c_i‖² + λ Σ_i w_i Σ_k ‖L_k‖²
//! ```
//!
//! Cameras see a point from one side only, so that without the ridge term λ the functions would be
//! free to grow in directions without cameras.

use glam::Vec3;
use tiface_base::geom::sphharm::{COEFFICIENTS_OF_DEGREE_2, sh16};

/// Weight of the ridge term: colors of a light stage change by a few percent of their range over a
/// quarter of a turn, their noise is about as large.
const RIDGE: f64 = 0.02;

/// Coefficients `[functions][rgb]` that best turn `base` into `colors` seen from `directions`
/// (unit, towards the viewer) with `weights`. Zero if no camera sees the point.
///
/// # Shapes
///
/// - directions, weights, colors: `[n]`; base and colors sRGB-coded
/// - out: `[functions]`, at most [`COEFFICIENTS_OF_DEGREE_2`]
pub(super) fn fit_lobes(
    base: [f32; 3],
    directions: &[Vec3],
    weights: &[f32],
    colors: &[[f32; 3]],
    out: &mut [[f32; 3]],
) {
    let n = out.len();
    out.fill([0.0; 3]);
    let total: f64 = weights.iter().map(|&w| f64::from(w)).sum();
    if total <= 0.0 || n > COEFFICIENTS_OF_DEGREE_2 {
        return;
    }
    let mut a = [[0f64; COEFFICIENTS_OF_DEGREE_2]; COEFFICIENTS_OF_DEGREE_2];
    let mut b = [[0f64; 3]; COEFFICIENTS_OF_DEGREE_2];
    for ((d, &w), c) in directions.iter().zip(weights).zip(colors) {
        let y = sh16(d.to_array());
        let w = f64::from(w) / total;
        for i in 0..n {
            let wy = w * f64::from(y[i]);
            for j in 0..=i {
                a[i][j] += wy * f64::from(y[j]);
            }
            for k in 0..3 {
                b[i][k] += wy * f64::from(c[k] - base[k]);
            }
        }
    }
    // Cholesky, in place: the ridge makes the matrix positive
    for i in 0..n {
        a[i][i] += RIDGE;
        for j in 0..=i {
            let mut sum = a[i][j];
            for k in 0..j {
                sum -= a[i][k] * a[j][k];
            }
            a[i][j] = if i == j { sum.max(1e-12).sqrt() } else { sum / a[j][j] };
        }
    }
    for k in 0..3 {
        let mut x = [0f64; COEFFICIENTS_OF_DEGREE_2];
        for i in 0..n {
            let sum: f64 = (0..i).map(|j| a[i][j] * x[j]).sum();
            x[i] = (b[i][k] - sum) / a[i][i];
        }
        for i in (0..n).rev() {
            let sum: f64 = (i + 1..n).map(|j| a[j][i] * x[j]).sum();
            x[i] = (x[i] - sum) / a[i][i];
            out[i][k] = x[i] as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::geom::sphharm::{combine, functions};
    use tiface_base::math::rng;

    fn add(coefficients: &[[f32; 3]], d: Vec3) -> [f32; 3] {
        combine(coefficients, d.to_array())
    }

    fn directions(n: u64) -> Vec<Vec3> {
        let at = |i: u64| Vec3::from_array(std::array::from_fn(|a| rng::normal(1, 2, 3 * i + a as u64)));
        (0..n).map(|i| at(i).normalize()).collect()
    }

    #[test]
    fn a_color_that_is_linear_in_the_direction_comes_back() {
        let d = directions(200);
        let truth = |d: &Vec3| [0.5 + 0.1 * d.x, 0.4 - 0.05 * d.y, 0.3 + 0.02 * d.z];
        let colors: Vec<_> = d.iter().map(truth).collect();
        let mut out = [[0f32; 3]; 4];
        fit_lobes([0.5, 0.4, 0.3], &d, &vec![1.0; 200], &colors, &mut out);
        for d in &d {
            let (got, want) = (add(&out, *d), truth(d));
            // the ridge takes 0.02 / (0.02 + 0.49²/3) = 20 % of each coefficient
            for k in 0..3 {
                assert!((got[k] - 0.8 * (want[k] - [0.5, 0.4, 0.3][k])).abs() < 0.012, "{got:?} {want:?}");
            }
        }
    }

    #[test]
    fn every_degree_improves_and_a_single_view_stays_small() {
        let d = directions(60);
        let colors: Vec<[f32; 3]> = d.iter().map(|d| [0.4 + 0.2 * d.x * d.y + 0.1 * d.z; 3]).collect();
        let error = |degree: u32| -> f32 {
            let mut out = [[0f32; 3]; COEFFICIENTS_OF_DEGREE_2];
            let out = &mut out[..functions(degree)];
            fit_lobes([0.4; 3], &d, &vec![1.0; 60], &colors, out);
            d.iter().zip(&colors).map(|(d, c)| (0.4 + add(out, *d)[0] - c[0]).powi(2)).sum()
        };
        let none: f32 = colors.iter().map(|c| (0.4 - c[0]).powi(2)).sum();
        assert!(error(2) < 0.5 * error(1) && error(1) < 0.8 * none, "{} {} {none}", error(2), error(1));
        let mut out = [[0f32; 3]; 4];
        fit_lobes([0.5; 3], &[Vec3::Z], &[0.3], &[[0.6; 3]], &mut out);
        // from that side it is nearly right, from the other it is no worse than the base
        assert!((add(&out, Vec3::Z)[0] - 0.1).abs() < 0.02 && add(&out, -Vec3::Z)[0].abs() < 0.1);
        fit_lobes([0.5; 3], &[], &[], &[], &mut out);
        assert_eq!(out, [[0.0; 3]; 4]);
    }
}
