//! Conjugate gradients for symmetric positive definite systems (Hestenes, Stiefel 1952), preconditioned.

/// The scalar product.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>()
}

/// Improves `x` until `done` of a round, from 0, and the residual; returns the rounds made.
///
/// `residual` is the right side less the matrix times `x`. `apply` writes the matrix times its first argument into the
/// second, `precondition` an approximate inverse times it. Also ends where the matrix turns out not to be positive.
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
    let (mut energy, mut round) = (0.0, 0);
    while !done(round, &residual) {
        precondition(&residual, &mut scaled);
        let before = std::mem::replace(&mut energy, dot(&residual, &scaled));
        let keep = if round == 0 { 0.0 } else { energy / before };
        (0..n).for_each(|i| direction[i] = scaled[i] + keep * direction[i]);
        apply(&direction, &mut image);
        let along = dot(&direction, &image);
        if !(along > 0.0 && energy > 0.0) {
            break;
        }
        let step = energy / along;
        for i in 0..n {
            x[i] += step * direction[i];
            residual[i] -= step * image[i];
        }
        round += 1;
    }
    round
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_rounds_as_unknowns_solve_a_system() {
        // [4 1; 1 3] x = [1; 2] has x = [1/11; 7/11]
        let apply = |v: &[f64], out: &mut [f64]| {
            out.copy_from_slice(&[4.0 * v[0] + v[1], v[0] + 3.0 * v[1]]);
        };
        let mut x = [0.0; 2];
        let plain = |r: &[f64], z: &mut [f64]| z.copy_from_slice(r);
        let rounds = conjugate_gradients(&mut x, vec![1.0, 2.0], apply, plain, |_, r| dot(r, r) < 1e-24);
        assert_eq!(rounds, 2);
        assert!((x[0] - 1.0 / 11.0).abs() < 1e-12 && (x[1] - 7.0 / 11.0).abs() < 1e-12);
    }
}
