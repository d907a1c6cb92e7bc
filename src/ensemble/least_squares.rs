//! Small dense least squares: the quadratic of least value on the simplex.

use super::MAX_MEMBERS;
use tiface_base::math::cholesky::{factor, substitute};

/// `argmin ½ wᵀHw − gᵀw` with `w ≥ 0`, `Σ w = 1`; H `[n · n]` symmetric positive definite, n ≤ 8.
///
/// The least value lies inside the face of some members that are above 0. There are at most 255
/// faces; on each one the minimum without bounds is `H w = g + ν`, ν such that the sum is 1, and
/// the best of those that have no weight below 0 is the answer. Exact, no iteration.
pub(super) fn least(h: &[f64], g: &[f64]) -> [f64; MAX_MEMBERS] {
    let n = g.len();
    let mut best = [0.0; MAX_MEMBERS];
    let mut best_value = f64::INFINITY;
    for face in 1u32..1 << n {
        let mut on = [0usize; MAX_MEMBERS];
        let mut count = 0;
        for k in (0..n).filter(|k| face >> k & 1 == 1) {
            on[count] = k;
            count += 1;
        }
        let on = &on[..count];
        let Some(inside) = on_face(h, g, on) else { continue };
        let mut w = [0.0; MAX_MEMBERS];
        for (k, v) in on.iter().zip(inside) {
            w[*k] = v;
        }
        let value: f64 =
            (0..n).map(|k| w[k] * (0.5 * (0..n).map(|l| h[k * n + l] * w[l]).sum::<f64>() - g[k])).sum();
        if value < best_value {
            (best, best_value) = (w, value);
        }
    }
    best
}

/// Returns the minimum on one face, if it has no weight below 0. Corners need no equations, so a
/// solution always exists.
fn on_face(h: &[f64], g: &[f64], on: &[usize]) -> Option<[f64; MAX_MEMBERS]> {
    let (n, m) = (g.len(), on.len());
    let mut x = [0.0; MAX_MEMBERS];
    if m == 1 {
        x[0] = 1.0;
        return Some(x);
    }
    let mut a = [0.0; MAX_MEMBERS * MAX_MEMBERS];
    let mut y = [0.0; MAX_MEMBERS];
    for i in 0..m {
        (x[i], y[i]) = (g[on[i]], 1.0);
        for j in 0..m {
            a[i * m + j] = h[on[i] * n + on[j]];
        }
    }
    if !factor(&mut a, m) {
        return None;
    }
    substitute(&a, &mut x[..m]);
    substitute(&a, &mut y[..m]);
    let nu = (1.0 - x[..m].iter().sum::<f64>()) / y[..m].iter().sum::<f64>();
    for i in 0..m {
        x[i] += nu * y[i];
    }
    x[..m].iter().all(|v| *v >= 0.0).then_some(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::math::rng::uniform;

    #[test]
    fn the_nearest_point_of_the_simplex_is_found_inside_on_an_edge_and_in_a_corner() {
        // H = I: the projection of g
        let eye = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let near = |g: [f64; 3], expected: [f64; 3]| {
            let w = least(&eye, &g);
            assert!((0..3).all(|k| (w[k] - expected[k]).abs() < 1e-14), "{g:?} → {w:?}");
        };
        near([0.3, 0.4, 0.6], [0.2, 0.3, 0.5]); // a tenth too much each
        near([0.7, 0.7, -1.0], [0.5, 0.5, 0.0]);
        near([3.0, 0.5, 0.0], [1.0, 0.0, 0.0]);
    }

    #[test]
    fn no_random_point_of_the_simplex_is_lower() {
        let n = 5;
        for seed in 0..20 {
            // H = BᵀB + 0.01
            let b: Vec<f64> = (0..n * n).map(|i| uniform(seed, 1, i as u64) as f64 - 0.5).collect();
            let mut h = vec![0.0; n * n];
            for i in 0..n {
                for j in 0..n {
                    h[i * n + j] = (0..n).map(|k| b[k * n + i] * b[k * n + j]).sum();
                }
                h[i * n + i] += 0.01;
            }
            let g: Vec<f64> = (0..n).map(|i| uniform(seed, 2, i as u64) as f64 * 0.2).collect();
            let value = |w: &[f64]| -> f64 {
                let row = |k: usize| (0..n).map(|l| h[k * n + l] * w[l]).sum::<f64>();
                (0..n).map(|k| w[k] * (0.5 * row(k) - g[k])).sum()
            };
            let w = least(&h, &g);
            assert!((w.iter().sum::<f64>() - 1.0).abs() < 1e-12 && w.iter().all(|v| *v >= 0.0));
            let ours = value(&w[..n]);
            for t in 0..500 {
                let draw = |k: u64| -(uniform(seed, 3, t * 8 + k) as f64).max(1e-9).ln();
                let raw: Vec<f64> = (0..n as u64).map(draw).collect();
                let sum: f64 = raw.iter().sum();
                let other: Vec<f64> = raw.iter().map(|v| v / sum).collect();
                assert!(value(&other) >= ours - 1e-12);
            }
        }
    }
}
