//! Small dense symmetric systems by Cholesky's factorization. Plain loops give the same bits on
//! every CPU, which libraries that choose instructions at run time do not.

/// Factors a symmetric matrix as `L Lᵀ` in place. Only its lower half is read and written. Returns
/// whether it is positive definite; if not, the matrix is left half factored.
///
/// # Shapes
///
/// - matrix: `[n, n]`
#[inline]
pub fn factor(matrix: &mut [f64], n: usize) -> bool {
    for i in 0..n {
        for k in 0..=i {
            let (before, row) = matrix.split_at_mut(i * n);
            let other = if k < i { &before[k * n..][..k + 1] } else { &row[..k + 1] };
            let rest = row[k] - (0..k).map(|j| row[j] * other[j]).sum::<f64>();
            row[k] = match k < i {
                true => rest / other[k],
                false if rest > 0.0 && rest.is_finite() => rest.sqrt(),
                false => return false, // also for NaN
            };
        }
    }
    true
}

/// Solves `L Lᵀ x = b` in place, with a factor of [`factor`].
#[inline]
pub fn substitute(factor: &[f64], x: &mut [f64]) {
    let n = x.len();
    for i in 0..n {
        let sum: f64 = (0..i).map(|j| factor[i * n + j] * x[j]).sum();
        x[i] = (x[i] - sum) / factor[i * n + i];
    }
    for i in (0..n).rev() {
        let sum: f64 = (i + 1..n).map(|j| factor[j * n + i] * x[j]).sum();
        x[i] = (x[i] - sum) / factor[i * n + i];
    }
}

/// Solves `matrix · x = right` for a symmetric positive definite matrix, of which the lower half is
/// given. `None` for any other one, and where the solution is not finite.
pub fn solve(mut matrix: Vec<f64>, mut right: Vec<f64>) -> Option<Vec<f64>> {
    if !factor(&mut matrix, right.len()) {
        return None;
    }
    substitute(&matrix, &mut right);
    right.iter().all(|v| v.is_finite()).then_some(right)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_factor_solves_a_system_worked_by_hand() {
        // [4 2; 2 5] x = [8; 14]  →  x = (12/16, 40/16) = (0.75, 2.5)
        let mut a = [4.0, 2.0, 2.0, 5.0];
        assert!(factor(&mut a, 2));
        let mut x = [8.0, 14.0];
        substitute(&a, &mut x);
        assert!((x[0] - 0.75).abs() < 1e-14 && (x[1] - 2.5).abs() < 1e-14);
        assert!(!factor(&mut [1.0, 2.0, 2.0, 1.0], 2)); // determinant −3
    }

    #[test]
    fn a_system_is_solved_as_by_hand() {
        // [4 1; 1 3] x = [1; 2] has x = [1/11; 7/11]; the upper half is not read
        let x = solve(vec![4.0, f64::NAN, 1.0, 3.0], vec![1.0, 2.0]).unwrap();
        assert!((x[0] - 1.0 / 11.0).abs() < 1e-15 && (x[1] - 7.0 / 11.0).abs() < 1e-15, "{x:?}");
        assert!(solve(vec![1.0, 0.0, 2.0, 1.0], vec![1.0, 1.0]).is_none());
    }
}
