//! Conjugate gradients for symmetric positive definite systems (Hestenes, Stiefel 1952),
//! preconditioned.

/// Returns the scalar product of two vectors.
#[inline]
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>()
}

/// Solves `A x = b` iteratively, starting from `x`, and returns the number of iterations.
///
/// `residual` is `b − A x` of the initial `x`. `apply` writes `A` times its first argument into the
/// second one, and `precondition` writes an approximate inverse of `A` times its first argument.
/// The iteration ends when `done(iteration, residual)` returns true, with iterations counted from
/// 0, or when `A` turns out not to be positive definite.
///
/// # Shapes
///
/// - x, residual, and the arguments of all closures: `[n]`
pub fn conjugate_gradients(
    x: &mut [f64],
    mut residual: Vec<f64>,
    apply: impl Fn(&[f64], &mut [f64]),
    precondition: impl Fn(&[f64], &mut [f64]),
    mut done: impl FnMut(usize, &[f64]) -> bool,
) -> usize {
    let n = x.len();
    let (mut scaled, mut direction, mut image) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
    let (mut energy, mut iteration) = (0.0, 0);
    while !done(iteration, &residual) {
        precondition(&residual, &mut scaled);
        let previous = std::mem::replace(&mut energy, dot(&residual, &scaled));
        let beta = if iteration == 0 { 0.0 } else { energy / previous };
        (0..n).for_each(|i| direction[i] = scaled[i] + beta * direction[i]);
        apply(&direction, &mut image);
        let curvature = dot(&direction, &image);
        if !(curvature > 0.0 && energy > 0.0) {
            break;
        }
        let step = energy / curvature;
        for i in 0..n {
            x[i] += step * direction[i];
            residual[i] -= step * image[i];
        }
        iteration += 1;
    }
    iteration
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_system_is_solved_in_as_many_iterations_as_it_has_unknowns() {
        // [4 1; 1 3] x = [1; 2] has x = [1/11; 7/11]
        let apply = |v: &[f64], out: &mut [f64]| {
            out.copy_from_slice(&[4.0 * v[0] + v[1], v[0] + 3.0 * v[1]]);
        };
        let mut x = [0.0; 2];
        let identity = |r: &[f64], z: &mut [f64]| z.copy_from_slice(r);
        let iterations =
            conjugate_gradients(&mut x, vec![1.0, 2.0], apply, identity, |_, r| dot(r, r) < 1e-24);
        assert_eq!(iterations, 2);
        assert!((x[0] - 1.0 / 11.0).abs() < 1e-12 && (x[1] - 7.0 / 11.0).abs() < 1e-12);
    }
}
