//! Arithmetic of bodies that are compiled per CPU level: matrix blocks and a few transcendental
//! functions.
//!
//! Fixed-width arrays are left to the autovectorizer. Each hot body is `#[inline(always)]` and
//! generic over `F` ("has fused multiply-add"), instantiated inside a `#[target_feature]` wrapper
//! that [`tiface_base::dispatch!`] chooses at run time. `f32::mul_add` without hardware FMA is a
//! library call, hence [`fma`].
//!
//! Products are compiled apart from their callers, and for vectors of 512 bits too.

use tiface_base::dispatch;

/// `a · b + c`, fused where the hardware can.
#[inline(always)]
pub fn fma<const F: bool>(a: f32, b: f32, c: f32) -> f32 {
    if F { a.mul_add(b, c) } else { a * b + c }
}

/// Rows of the accumulator block. With eight rows the accumulators no longer stay in the 16 vector
/// registers of AVX2, and the block is forty times slower.
pub const ROWS: usize = 4;

/// Rows of the accumulator block for vectors of 512 bits, of which there are 32: half as many reads
/// of `B` a product.
const TALL_ROWS: usize = 2 * ROWS;

/// One block `C[R, NR] (+)= Σ_p A[R, p] · B[p, NR]`; `A` is strided, rows of `B` and `C`
/// contiguous.
#[inline(always)]
fn block<const F: bool, const R: usize, const NR: usize>(
    k: usize,
    a: &[f32],
    row_stride: usize,
    column_stride: usize,
    b: &[f32],
    ldb: usize,
    c: &mut [f32],
    ldc: usize,
    add: bool,
) {
    assert!(a.len() > (R - 1) * row_stride + (k - 1) * column_stride);
    assert!(b.len() >= (k - 1) * ldb + NR);
    assert!(c.len() >= (R - 1) * ldc + NR);
    let mut acc = [[0f32; NR]; R];
    for p in 0..k {
        // SAFETY: the three extents were asserted above and p < k.
        let row: &[f32; NR] = unsafe { &*(b.as_ptr().add(p * ldb) as *const [f32; NR]) };
        for i in 0..R {
            // SAFETY: as above, i < R.
            let v = unsafe { *a.get_unchecked(i * row_stride + p * column_stride) };
            for l in 0..NR {
                acc[i][l] = fma::<F>(v, row[l], acc[i][l]);
            }
        }
    }
    for i in 0..R {
        let out = &mut c[i * ldc..][..NR];
        for l in 0..NR {
            out[l] = if add { out[l] + acc[i][l] } else { acc[i][l] };
        }
    }
}

#[inline(always)]
fn gemm_body<const F: bool>(
    size: (usize, usize, usize),
    a: &[f32],
    strides: (usize, usize),
    b: &[f32],
    ldb: usize,
    c: &mut [f32],
    ldc: usize,
    add: bool,
) {
    columns::<F, ROWS, 16>(size, a, strides, b, ldb, c, ldc, add, 0);
}

/// As [`gemm_body`], with blocks of 8 rows and 32 columns for vectors of 512 bits. The sums are the
/// same.
#[inline(always)]
fn gemm_wide<const F: bool>(
    size: (usize, usize, usize),
    a: &[f32],
    strides: (usize, usize),
    b: &[f32],
    ldb: usize,
    c: &mut [f32],
    ldc: usize,
    add: bool,
) {
    let done = size.1 / 32 * 32;
    columns::<F, TALL_ROWS, 32>((size.0, done, size.2), a, strides, b, ldb, c, ldc, add, 0);
    columns::<F, TALL_ROWS, 16>(size, a, strides, b, ldb, c, ldc, add, done);
}

/// Computes the columns of a product from `first` on, in blocks of `NR`, the last 8 in one of 8.
#[inline(always)]
fn columns<const F: bool, const R: usize, const NR: usize>(
    size: (usize, usize, usize),
    a: &[f32],
    strides: (usize, usize),
    b: &[f32],
    ldb: usize,
    c: &mut [f32],
    ldc: usize,
    add: bool,
    first: usize,
) {
    let n = size.1;
    debug_assert!(size.0.is_multiple_of(ROWS) && n.is_multiple_of(8));
    let mut j = first;
    while j + NR <= n {
        rows::<F, R, NR>(size, a, strides, &b[j..], ldb, &mut c[j..], ldc, add);
        j += NR;
    }
    if j < n {
        rows::<F, R, 8>(size, a, strides, &b[j..], ldb, &mut c[j..], ldc, add);
    }
}

/// Computes the first `NR` columns of a product, in blocks of `R` rows, the last [`ROWS`] in one of
/// their own. These columns of `B` stay in the first-level cache meanwhile.
#[inline(always)]
fn rows<const F: bool, const R: usize, const NR: usize>(
    (m, _, k): (usize, usize, usize),
    a: &[f32],
    (row_stride, column_stride): (usize, usize),
    b: &[f32],
    ldb: usize,
    c: &mut [f32],
    ldc: usize,
    add: bool,
) {
    let tall = m - m % R;
    for i in (0..tall).step_by(R) {
        let (a, c) = (&a[i * row_stride..], &mut c[i * ldc..]);
        block::<F, R, NR>(k, a, row_stride, column_stride, b, ldb, c, ldc, add);
    }
    for i in (tall..m).step_by(ROWS) {
        let (a, c) = (&a[i * row_stride..], &mut c[i * ldc..]);
        block::<F, ROWS, NR>(k, a, row_stride, column_stride, b, ldb, c, ldc, add);
    }
}

dispatch! {
    /// `C[m, n] (+)= A[m, k] · B[k, n]` for a `size` of `(m, n, k)`: `m` a multiple of 4, `n` a
    /// multiple of 8.
    ///
    /// `A[i, p] = a[i · strides.0 + p · strides.1]`, so a transpose costs nothing.
    pub fn gemm / gemm_body / gemm_wide (
        size: (usize, usize, usize), a: &[f32], strides: (usize, usize), b: &[f32], ldb: usize,
        c: &mut [f32], ldc: usize, add: bool,
    )
}

/// eˣ, relative error below 9e-8 on [-87, 88]; clamped outside. Branch-free, so loops vectorize.
#[inline(always)]
pub fn exp<const F: bool>(x: f32) -> f32 {
    let x = x.clamp(-87.0, 88.0);
    // x = n ln 2 + r, |r| ≤ ln 2 / 2; ln 2 in two parts (Cody, Waite) keeps r exact.
    let rounded = fma::<F>(x, std::f32::consts::LOG2_E, 12_582_912.0);
    let n = rounded - 12_582_912.0;
    let r = fma::<F>(n, -0.693_145_75, x);
    let r = fma::<F>(n, -1.428_606_8e-6, r);
    let p = fma::<F>(r, 1.0 / 5040.0, 1.0 / 720.0);
    let p = fma::<F>(r, p, 1.0 / 120.0);
    let p = fma::<F>(r, p, 1.0 / 24.0);
    let p = fma::<F>(r, p, 1.0 / 6.0);
    let p = fma::<F>(r, p, 0.5);
    // only the last addition rounds at the precision of the result
    let p = fma::<F>(r * r, p, r) + 1.0;
    // The lowest bits of `rounded` are n in [-126, 127], which becomes the exponent. A cast of n to
    // an integer would saturate, which keeps loops from being vectorized.
    p * f32::from_bits((rounded.to_bits() << 23).wrapping_add(127 << 23))
}

/// ln(1 + e) for e in [0, 1], error below 2e-7 relative: 2 artanh(e / (2 + e)).
#[inline(always)]
pub fn ln_1p<const F: bool>(e: f32) -> f32 {
    let t = e / (2.0 + e);
    let s = t * t;
    let p = fma::<F>(s, 1.0 / 13.0, 1.0 / 11.0);
    let p = fma::<F>(s, p, 1.0 / 9.0);
    let p = fma::<F>(s, p, 1.0 / 7.0);
    let p = fma::<F>(s, p, 1.0 / 5.0);
    let p = fma::<F>(s, p, 1.0 / 3.0);
    let p = fma::<F>(s, p, 1.0);
    2.0 * t * p
}

/// Returns `g` if `h` is positive, else 0: the gradient of a relu whose output is `h`. A branch
/// would become a masked store, which takes tens of cycles on some CPUs.
#[inline(always)]
pub fn relu_gradient(g: f32, h: f32) -> f32 {
    f32::from_bits(g.to_bits() & u32::from(h > 0.0).wrapping_neg())
}

/// 1 / (1 + e⁻ˣ).
#[inline(always)]
pub fn sigmoid<const F: bool>(x: f32) -> f32 {
    1.0 / (1.0 + exp::<F>(-x))
}

/// Returns σ(x) and σ(−x) = 1 − σ(x), for |x| ≤ 87 with a relative error below 3e-7: the smaller
/// one has no cancellation.
#[inline(always)]
pub fn sigmoid_and_complement<const F: bool>(x: f32) -> [f32; 2] {
    let e = exp::<F>(-x.abs());
    let large = 1.0 / (1.0 + e);
    let small = e * large;
    if x < 0.0 { [small, large] } else { [large, small] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_and_its_kin_agree_with_f64() {
        for i in -8000..=8000 {
            let x = i as f32 * 0.01;
            let want = (x as f64).exp();
            assert!(((exp::<false>(x) as f64 - want) / want).abs() < 9e-8, "exp {x}");
            assert!(((exp::<true>(x) as f64 - want) / want).abs() < 9e-8, "exp {x}");
            let both = [x, -x].map(|x| 1.0 / (1.0 + (-x as f64).exp()));
            for (got, want) in sigmoid_and_complement::<true>(x).into_iter().zip(both) {
                assert!(((got as f64 - want) / want).abs() < 3e-7, "sigmoid {x}");
            }
        }
        for i in 0..=1000 {
            let e = i as f32 / 1000.0;
            assert!((ln_1p::<true>(e) as f64 - (e as f64).ln_1p()).abs() < 2e-7, "ln_1p {e}");
        }
    }

    #[test]
    fn gemm_agrees_with_three_loops_for_both_orders_and_on_every_level() {
        type Gemm = fn((usize, usize, usize), &[f32], (usize, usize), &[f32], usize, &mut [f32], usize, bool);
        let (m, n, k) = (12, 56, 5); // blocks of 8 and 4 rows, of 32, 16 and 8 columns
        let a: Vec<f32> = (0..m * k).map(|i| (i as f32 * 0.37).sin()).collect();
        let b: Vec<f32> = (0..k * n).map(|i| (i as f32 * 0.61).cos()).collect();
        let at: Vec<f32> = (0..m * k).map(|i| a[(i % m) * k + i / m]).collect(); // [k, m]
        let levels: [Gemm; 4] = [gemm_body::<false>, gemm_body::<true>, gemm_wide::<true>, gemm];
        let results = levels.map(|gemm| {
            let (mut c, mut t) = (vec![0.5; m * n], vec![0.0; m * n]);
            gemm((m, n, k), &a, (k, 1), &b, n, &mut c, n, true);
            gemm((m, n, k), &at, (1, m), &b, n, &mut t, n, false);
            for i in 0..m {
                for j in 0..n {
                    let want: f32 = (0..k).map(|p| a[i * k + p] * b[p * n + j]).sum();
                    assert!((c[i * n + j] - want - 0.5).abs() < 1e-5);
                    assert!((t[i * n + j] - want).abs() < 1e-5);
                }
            }
            (c, t)
        });
        // wide blocks give the bytes of narrow ones, and so does whatever this CPU runs
        assert_eq!(results[1], results[2]);
        assert!(results[..2].contains(&results[3]));
    }
}
