//! Closed-form matting (Levin, Lischinski, Weiss 2008): the opacity of the unknown band from the
//! photograph.
//!
//! Where colors of head and background each lie on a line within every 3 × 3 window, alpha is an
//! affine function of color in that window. Its deviation from one, over all windows, is a
//! quadratic form `αᵀ L α` with
//!
//! ```text
//! L_ij = Σ_w  δ_ij − (1 + (I_i − μ_w)ᵀ (Σ_w + ε/9 · 1)⁻¹ (I_j − μ_w)) / 9
//! ```
//!
//! (their equation 12; `I` coded color in 0..=1). Definite pixels are constrained to their value by
//! a weight, and `(L + D) α = D b` is solved by conjugate gradients, preconditioned by an
//! incomplete Cholesky factor with the pattern of `L` itself.
//!
//! Beyond the paper, the hard mask is the prior of unknown pixels, with a weight far below the
//! constraint's. Where the photograph says what alpha is, that changes little; where colors of head
//! and background are alike (dark hair before a dark background), alpha stays near the cut instead
//! of bleeding through the band. Measured on three views each of two heads, mean squared error
//! without and with it: hard masks cut from clicks 2.9 and 3.0, 2.7 and 2.1 of 1000; true ones 2.3
//! and 1.6, 1.6 and 1.2; 2 pixels too wide 2.8 and 2.7, 1.4 and 1.3; 2 too narrow 2.0 and 1.7, 1.8
//! and 1.8. Rounds of conjugate gradients fall from 70 to 42.
//!
//! Only windows that hold an unknown pixel are assembled, so work and memory follow the band, not
//! the picture: about 310 bytes for each of its pixels and their neighbors within two. A row has 25
//! entries; being symmetric, 12 before the diagonal are kept. A sparse direct factorization
//! (`faer`) was tried in their place: it is no faster, and for 750 × 1024 unknown pixels it takes
//! 1.9 GB where this takes 0.25.

use super::{HEAD, UNKNOWN};
use tiface_base::geom::cofactors;
use tiface_base::image::{Gray, Photo};
use tiface_base::math::cg::{self, dot};
use tiface_base::{Error, Result};

/// Options of the solver.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClosedFormOptions {
    /// Noise of colors, added to their covariance; squared color differences of 0..=1.
    pub epsilon: f64,
    /// Weight of the constraint that definite pixels have their value.
    pub constraint_weight: f64,
    /// Weight of the hard mask as the prior of unknown pixels; 0 as published.
    pub prior_weight: f64,
    /// Ends when the residual is this small against the right-hand side.
    pub tolerance: f64,
    /// Rounds of conjugate gradients at most.
    pub rounds: usize,
}

impl Default for ClosedFormOptions {
    fn default() -> ClosedFormOptions {
        ClosedFormOptions {
            epsilon: 1e-5,
            constraint_weight: 100.0,
            prior_weight: 3e-3,
            tolerance: 1e-7,
            rounds: 2000,
        }
    }
}

/// An alpha for every pixel, and the effort of solving it.
#[derive(Clone, Debug, PartialEq)]
pub struct Matte {
    /// `[height · width]`, clamped to 0..=1, which the solution may overshoot.
    pub alpha: Vec<f32>,
    /// Rounds of conjugate gradients.
    pub rounds: usize,
    /// Pixels that were solved for, definite ones at the rim of the band among them.
    pub unknowns: usize,
}

/// Neighbors that come before a pixel, in raster order: (columns, rows).
#[rustfmt::skip]
const BEFORE: [(i32, i32); 12] = [
    (-2, -2), (-1, -2), (0, -2), (1, -2), (2, -2),
    (-2, -1), (-1, -1), (0, -1), (1, -1), (2, -1),
    (-2, 0), (-1, 0),
];

/// A symmetric matrix with the stencil of two pixels each way, over the pixels that take part.
struct Stencil {
    diagonal: Vec<f64>,
    /// Entries before the diagonal, as [`BEFORE`]; 0 where that neighbor takes no part.
    lower: Vec<[f64; 12]>,
    /// Which row each neighbor is; the row itself where it takes no part.
    column: Vec<[u32; 12]>,
}

impl Stencil {
    /// `y = A x`
    fn times(&self, x: &[f64], y: &mut [f64]) {
        y.fill(0.0);
        for i in 0..x.len() {
            let xi = x[i];
            let mut sum = self.diagonal[i] * xi;
            for (&a, &j) in self.lower[i].iter().zip(&self.column[i]) {
                sum += a * x[j as usize];
                y[j as usize] += a * xi;
            }
            y[i] += sum;
        }
    }

    /// `L` of `A ≈ L Lᵀ` with the pattern of `A`. An incomplete factor can fail where a whole one
    /// cannot, so the diagonal is raised until it does not (Manteuffel 1980).
    fn factor(&self) -> IncompleteCholesky<'_> {
        let shared = shared_neighbors();
        let mut raised = 0.0;
        loop {
            if let Some(factor) = self.factor_raised(1.0 + raised, &shared) {
                return factor;
            }
            raised = if raised == 0.0 { 1e-4 } else { 4.0 * raised };
        }
    }

    fn factor_raised(
        &self,
        raised: f64,
        shared: &[Vec<(usize, usize)>; 12],
    ) -> Option<IncompleteCholesky<'_>> {
        let n = self.diagonal.len();
        let mut factor =
            IncompleteCholesky { inverse: vec![0.0; n], lower: vec![[0.0; 12]; n], column: &self.column };
        for i in 0..n {
            let mut row = self.lower[i];
            let mut pivot = raised * self.diagonal[i];
            for s in 0..12 {
                let j = self.column[i][s] as usize;
                if j == i {
                    continue;
                }
                let other = &factor.lower[j];
                let known: f64 = shared[s].iter().map(|&(a, b)| row[a] * other[b]).sum();
                row[s] = (row[s] - known) * factor.inverse[j];
                pivot -= row[s] * row[s];
            }
            // a pivot that has lost nearly everything makes a factor worse than none. Raised often
            // enough, any diagonal outweighs its row; what is no number then ends the gradients
            if pivot <= 1e-3 * self.diagonal[i] && raised < 1e6 {
                return None;
            }
            factor.lower[i] = row;
            factor.inverse[i] = 1.0 / pivot.sqrt();
        }
        Some(factor)
    }
}

/// An incomplete Cholesky factor with the pattern of its matrix.
struct IncompleteCholesky<'a> {
    /// One over the diagonal.
    inverse: Vec<f64>,
    lower: Vec<[f64; 12]>,
    column: &'a [[u32; 12]],
}

impl IncompleteCholesky<'_> {
    /// Solves `L Lᵀ z = r`.
    fn solve(&self, r: &[f64], z: &mut [f64]) {
        for i in 0..r.len() {
            let mut sum = r[i];
            for (&l, &j) in self.lower[i].iter().zip(&self.column[i]) {
                sum -= l * z[j as usize]; // a missing neighbor is the row itself, with entry 0
            }
            z[i] = sum * self.inverse[i];
        }
        for i in (0..r.len()).rev() {
            z[i] *= self.inverse[i];
            let zi = z[i];
            for (&l, &j) in self.lower[i].iter().zip(&self.column[i]) {
                z[j as usize] -= l * zi;
            }
        }
    }
}

/// For each neighbor `s`: pairs (slot of the row, slot of that neighbor) that mean the same pixel,
/// before it.
fn shared_neighbors() -> [Vec<(usize, usize)>; 12] {
    std::array::from_fn(|s| {
        let pairs = (0..s).filter_map(|a| {
            let wanted = (BEFORE[a].0 - BEFORE[s].0, BEFORE[a].1 - BEFORE[s].1);
            BEFORE.iter().position(|&b| b == wanted).map(|b| (a, b))
        });
        pairs.collect()
    })
}

/// Returns the alpha of a photograph from its hard mask (head at 128 and more) and trimap (0, 128,
/// 255); all of one size.
///
/// # Errors
/// When the rounds are not enough or the numbers run away, and when no 3 × 3 window fits into the
/// picture.
///
/// # Examples
///
/// A dark half and a bright one, the columns where they meet unknown:
///
/// ```
/// use tiface::image::{Gray, Photo};
/// use tiface::mask::matting::closed_form::{ClosedFormOptions, closed_form};
///
/// let row: Vec<[u8; 3]> = [20, 20, 70, 170, 220, 220].map(|v| [v, v, v / 2]).into();
/// let photo = Photo { width: 6, height: 4, rgb: row.repeat(4), alpha: None };
/// let gray = |row: [u8; 6]| Gray { width: 6, height: 4, values: row.repeat(4) };
/// let (mask, trimap) = (gray([0, 0, 0, 255, 255, 255]), gray([0, 0, 128, 128, 255, 255]));
///
/// let options = ClosedFormOptions { prior_weight: 0.0, ..ClosedFormOptions::default() };
/// let matte = closed_form(&photo, &mask, &trimap, &options)?;
/// // alpha is linear in color: (70 − 20) / 200 and (170 − 20) / 200
/// assert!((matte.alpha[2] - 0.25).abs() < 0.01 && (matte.alpha[3] - 0.75).abs() < 0.01);
/// # Ok::<(), tiface::Error>(())
/// ```
pub fn closed_form(photo: &Photo, mask: &Gray, trimap: &Gray, options: &ClosedFormOptions) -> Result<Matte> {
    assert_eq!((photo.width, photo.height), (mask.width, mask.height));
    assert_eq!((photo.width, photo.height), (trimap.width, trimap.height));
    let definite = |v: u8| if v == HEAD { 1.0 } else { 0.0 };
    let mut alpha: Vec<f32> = trimap.values.iter().map(|&v| definite(v)).collect();
    if !trimap.values.contains(&UNKNOWN) {
        return Ok(Matte { alpha, rounds: 0, unknowns: 0 });
    }
    if photo.width < 3 || photo.height < 3 {
        return Err(unsolved("the picture is narrower than the windows of 3 × 3".into()));
    }
    let (mut matrix, pixels) = assemble(photo, trimap, options.epsilon);
    let mut right = vec![0.0; pixels.len()];
    let mut x = vec![0.0; pixels.len()];
    for (i, &pixel) in pixels.iter().enumerate() {
        let (value, hard) = (trimap.values[pixel as usize], mask.values[pixel as usize] >= 128);
        let (head, weight) = if value == UNKNOWN {
            (hard, options.prior_weight)
        } else {
            (value == HEAD, options.constraint_weight)
        };
        x[i] = if head { 1.0 } else { 0.0 };
        right[i] = weight * x[i];
        matrix.diagonal[i] += weight;
    }
    let rounds = conjugate_gradients(&matrix, &right, &mut x, options)?;
    for (&pixel, &value) in pixels.iter().zip(&x) {
        if trimap.values[pixel as usize] == UNKNOWN {
            alpha[pixel as usize] = value.clamp(0.0, 1.0) as f32;
        }
    }
    Ok(Matte { alpha, rounds, unknowns: pixels.len() })
}

/// Returns the matting Laplacian of the windows that hold an unknown pixel, and which pixel each
/// row is.
fn assemble(photo: &Photo, trimap: &Gray, epsilon: f64) -> (Stencil, Vec<u32>) {
    const NONE: u32 = u32::MAX;
    let (width, height) = (photo.width as usize, photo.height as usize);
    let unknown = |i: usize| trimap.values[i] == UNKNOWN;
    let mut centers = Vec::new();
    let mut row_of = vec![NONE; width * height];
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let window = [y - 1, y, y + 1].map(|y| y * width + x);
            if window.iter().any(|&i| unknown(i - 1) || unknown(i) || unknown(i + 1)) {
                centers.push(window[1] as u32);
                window.iter().for_each(|&i| row_of[i - 1..=i + 1].fill(0));
            }
        }
    }
    let mut pixels = Vec::new();
    for (i, row) in row_of.iter_mut().enumerate().filter(|(_, row)| **row != NONE) {
        *row = pixels.len() as u32;
        pixels.push(i as u32);
    }
    let column = pixels.iter().enumerate().map(|(row, &pixel)| {
        let (x, y) = ((pixel as usize % width) as i32, (pixel as usize / width) as i32);
        BEFORE.map(|(dx, dy)| {
            let (x, y) = (x + dx, y + dy);
            let inside = x >= 0 && y >= 0 && (x as usize) < width;
            let other = if inside { row_of[y as usize * width + x as usize] } else { NONE };
            if other == NONE { row as u32 } else { other }
        })
    });
    let n = pixels.len();
    let mut matrix = Stencil { diagonal: vec![0.0; n], lower: vec![[0.0; 12]; n], column: column.collect() };

    // within a window, which slot of the later pixel the earlier one is
    let slot = |later: usize, earlier: usize| {
        let at = |k: usize| ((k % 3) as i32, (k / 3) as i32);
        let step = (at(earlier).0 - at(later).0, at(earlier).1 - at(later).1);
        BEFORE.iter().position(|&b| b == step).unwrap_or(0)
    };
    let slots: [[usize; 9]; 9] =
        std::array::from_fn(|a| std::array::from_fn(|b| if b < a { slot(a, b) } else { 0 }));
    for &center in &centers {
        let center = center as usize;
        let at: [usize; 9] = std::array::from_fn(|k| center + (k / 3) * width + k % 3 - width - 1);
        let (difference, scaled) = window(&at.map(|i| photo.rgb[i]), epsilon);
        let rows = at.map(|i| row_of[i] as usize);
        for a in 0..9 {
            let (d, row) = (difference[a], rows[a]);
            let affinity = |b: usize| {
                let s: [f64; 3] = scaled[b];
                (1.0 + d[0] * s[0] + d[1] * s[1] + d[2] * s[2]) / 9.0
            };
            matrix.diagonal[row] += 1.0 - affinity(a);
            let entries = &mut matrix.lower[row];
            for b in 0..a {
                entries[slots[a][b]] -= affinity(b);
            }
        }
    }
    (matrix, pixels)
}

/// Returns the colors of a window less their mean, `d`, and `(Σ + ε/9 · 1)⁻¹ d`.
fn window(colors: &[[u8; 3]; 9], epsilon: f64) -> ([[f64; 3]; 9], [[f64; 3]; 9]) {
    let coded = colors.map(|c| c.map(|v| v as f64 / 255.0));
    let mean: [f64; 3] = std::array::from_fn(|k| coded.iter().map(|c| c[k]).sum::<f64>() / 9.0);
    let difference = coded.map(|c| [c[0] - mean[0], c[1] - mean[1], c[2] - mean[2]]);
    let covariance = |i: usize, j: usize| difference.iter().map(|d| d[i] * d[j]).sum::<f64>() / 9.0;
    let more = epsilon / 9.0;
    let symmetric = [
        covariance(0, 0) + more,
        covariance(0, 1),
        covariance(0, 2),
        covariance(1, 1) + more,
        covariance(1, 2),
        covariance(2, 2) + more,
    ];
    let (cofactors, determinant) = cofactors(symmetric);
    let inverse = cofactors.map(|c| c / determinant);
    (difference, difference.map(|d| product(&inverse, d)))
}

/// Returns a symmetric matrix `xx xy xz yy yz zz` times a vector.
fn product([xx, xy, xz, yy, yz, zz]: &[f64; 6], [x, y, z]: [f64; 3]) -> [f64; 3] {
    [xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z]
}

fn unsolved(why: String) -> Error {
    Error::cannot(why, "keep the hard mask, or widen the unknown region")
}

/// Preconditioned conjugate gradients from the start in `x`; returns the rounds made.
fn conjugate_gradients(
    matrix: &Stencil,
    right: &[f64],
    x: &mut [f64],
    options: &ClosedFormOptions,
) -> Result<usize> {
    let scale = dot(right, right).sqrt();
    if scale == 0.0 {
        x.fill(0.0); // no definite head beside the band: alpha 0 satisfies everything
        return Ok(0);
    }
    let factor = matrix.factor();
    let mut start = vec![0.0; x.len()];
    matrix.times(x, &mut start);
    start.iter_mut().zip(right).for_each(|(s, right)| *s = right - *s);
    let (mut residual, tolerance) = (f64::INFINITY, options.tolerance);
    let done = |round: usize, r: &[f64]| {
        residual = dot(r, r).sqrt() / scale;
        residual <= tolerance || round == options.rounds || !residual.is_finite()
    };
    let (times, solve) =
        (|p: &[f64], ap: &mut [f64]| matrix.times(p, ap), |r: &[f64], z: &mut [f64]| factor.solve(r, z));
    let rounds = cg::conjugate_gradients(x, start, times, solve, done);
    if residual <= tolerance {
        return Ok(rounds);
    }
    Err(unsolved(format!("the residual is still {residual:.1e} after {rounds} rounds, not {tolerance:.0e}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::io::{Limits, NpyValues, read_gray, read_npy, read_photo};

    /// Photograph with two colors that meet softly, and noise; trimap unknown in the middle.
    fn small(width: usize, height: usize) -> (Photo, Gray) {
        let mut state = 3u64;
        let mut noise = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 59) as f64
        };
        let mut rgb = Vec::new();
        for i in 0..width * height {
            let a = ((i % width) as f64 / width as f64 * 3.0 - 1.0).clamp(0.0, 1.0);
            rgb.push([30.0 + 170.0 * a, 60.0 + 40.0 * a, 90.0 - 50.0 * a].map(|v| (v + noise()) as u8));
        }
        let value = |x: usize| match 3 * x / width {
            0 => 0,
            1 => UNKNOWN,
            _ => HEAD,
        };
        let values = (0..width * height).map(|i| value(i % width)).collect();
        let (width, height) = (width as u32, height as u32);
        (Photo { width, height, rgb, alpha: None }, Gray { width, height, values })
    }

    /// Returns the head from the middle of the band on.
    fn cut(trimap: &Gray) -> Gray {
        let head = |i: usize| 2 * (i as u32 % trimap.width) >= trimap.width;
        Gray { values: (0..trimap.values.len()).map(|i| if head(i) { 255 } else { 0 }).collect(), ..*trimap }
    }

    /// As published: without a prior.
    const PUBLISHED: ClosedFormOptions = ClosedFormOptions {
        epsilon: 1e-5,
        constraint_weight: 100.0,
        prior_weight: 0.0,
        tolerance: 1e-7,
        rounds: 2000,
    };

    /// Returns the equations entry by entry over the whole picture, solved by elimination.
    fn dense(photo: &Photo, mask: &Gray, trimap: &Gray, options: &ClosedFormOptions) -> Vec<f64> {
        let (w, h) = (photo.width as usize, photo.height as usize);
        let n = w * h;
        let mut a = vec![vec![0.0; n + 1]; n];
        for cy in 1..h - 1 {
            for cx in 1..w - 1 {
                let at: Vec<usize> = (0..9).map(|k| (cy + k / 3 - 1) * w + cx + k % 3 - 1).collect();
                let color = |i: usize| photo.rgb[i].map(|v| v as f64 / 255.0);
                let mean: Vec<f64> =
                    (0..3).map(|k| at.iter().map(|&i| color(i)[k]).sum::<f64>() / 9.0).collect();
                let off = |i: usize| glam::DVec3::from_array(std::array::from_fn(|k| color(i)[k] - mean[k]));
                let mut cov = glam::DMat3::ZERO;
                for &i in &at {
                    let d = off(i);
                    cov += glam::DMat3::from_cols(d * d.x, d * d.y, d * d.z) * (1.0 / 9.0);
                }
                let inverse = (cov + glam::DMat3::IDENTITY * (options.epsilon / 9.0)).inverse();
                for &i in &at {
                    for &j in &at {
                        let same = if i == j { 1.0 } else { 0.0 };
                        a[i][j] += same - (1.0 + off(i).dot(inverse * off(j))) / 9.0;
                    }
                }
            }
        }
        for i in 0..n {
            let unknown = trimap.values[i] == UNKNOWN;
            let weight = if unknown { options.prior_weight } else { options.constraint_weight };
            let head = if unknown { mask.values[i] == 255 } else { trimap.values[i] == HEAD };
            a[i][i] += weight;
            a[i][n] = if head { weight } else { 0.0 };
        }
        for k in 0..n {
            for i in k + 1..n {
                let f = a[i][k] / a[k][k];
                for j in k..=n {
                    a[i][j] -= f * a[k][j];
                }
            }
        }
        let mut x = vec![0.0; n];
        for i in (0..n).rev() {
            let rest: f64 = (i + 1..n).map(|j| a[i][j] * x[j]).sum();
            x[i] = (a[i][n] - rest) / a[i][i];
        }
        x
    }

    #[test]
    fn gradients_find_what_elimination_finds() {
        let (photo, trimap) = small(12, 10);
        let mask = cut(&trimap);
        for prior_weight in [0.0, 3e-3, 1.0] {
            let options = ClosedFormOptions { tolerance: 1e-11, prior_weight, ..PUBLISHED };
            let truth = dense(&photo, &mask, &trimap, &options);
            let matte = closed_form(&photo, &mask, &trimap, &options).unwrap();
            // elimination ties definite pixels softly over the whole picture; far ones only here
            for i in (0..120).filter(|&i| trimap.values[i] == UNKNOWN) {
                let difference = (matte.alpha[i] as f64 - truth[i].clamp(0.0, 1.0)).abs();
                assert!(
                    difference < 2e-4,
                    "prior {prior_weight}, {i}: {} against {}",
                    matte.alpha[i],
                    truth[i]
                );
            }
            // columns 4 to 7 are unknown: windows reach to columns 2 to 9, all 10 rows
            assert_eq!(matte.unknowns, 80);
        }
    }

    #[test]
    fn where_the_photograph_says_nothing_the_mask_is_kept() {
        let (mut photo, trimap) = small(30, 20);
        photo.rgb.fill([60; 3]);
        let mask = cut(&trimap);
        let far = |prior_weight: f64| {
            let options = ClosedFormOptions { prior_weight, ..PUBLISHED };
            let alpha = closed_form(&photo, &mask, &trimap, &options).unwrap().alpha;
            let apart = alpha.iter().zip(&mask.values).map(|(a, &m)| (a - m as f32 / 255.0).powi(2));
            apart.sum::<f32>()
        };
        assert!(far(0.3) < 0.8 * far(0.0), "{} against {}", far(0.3), far(0.0));
    }

    #[test]
    fn the_matrix_is_that_of_the_formula_and_its_rows_sum_to_nothing() {
        let (photo, mut trimap) = small(9, 7);
        trimap.values.fill(UNKNOWN);
        let (matrix, pixels) = assemble(&photo, &trimap, 1e-5);
        assert_eq!(pixels.len(), 63);
        let mut sums = vec![0.0; 63];
        matrix.times(&[1.0; 63], &mut sums);
        assert!(sums.iter().all(|s| s.abs() < 1e-9), "{sums:?}");
        // a corner is in one window, the middle in nine: 1 − (1 + d·s) / 9 lies in 0..8/9 for each
        assert!(matrix.diagonal[0] > 0.0 && matrix.diagonal[0] < 8.0 / 9.0);
        assert!(matrix.diagonal[31] > 1.0 && matrix.diagonal[31] < 8.0);
    }

    #[test]
    fn the_factor_solves_a_matrix_without_fill_exactly() {
        // in one row of pixels a stencil of two before the diagonal leaves no fill
        let n = 30;
        let column = |i: u32| {
            let mut c = [i; 12];
            c[10] = if i >= 2 { i - 2 } else { i };
            c[11] = if i >= 1 { i - 1 } else { i };
            c
        };
        let lower = |i: usize| {
            let mut l = [0.0; 12];
            l[10] = if i >= 2 { -0.7 } else { 0.0 };
            l[11] = if i >= 1 { 0.4 } else { 0.0 };
            l
        };
        let matrix = Stencil {
            diagonal: vec![2.5; n],
            lower: (0..n).map(lower).collect(),
            column: (0..n as u32).map(column).collect(),
        };
        let x: Vec<f64> = (0..n).map(|i| (i * i % 7) as f64 - 3.0).collect();
        let (mut b, mut z) = (vec![0.0; n], vec![0.0; n]);
        matrix.times(&x, &mut b);
        matrix.factor().solve(&b, &mut z);
        assert!(x.iter().zip(&z).all(|(x, z)| (x - z).abs() < 1e-12), "{z:?}");
    }

    #[test]
    fn too_few_rounds_are_an_error_that_says_how_far_it_came() {
        let (photo, trimap) = small(40, 30);
        let options = ClosedFormOptions { rounds: 2, ..PUBLISHED };
        let error = closed_form(&photo, &cut(&trimap), &trimap, &options).unwrap_err();
        assert!(error.to_string().contains("after 2 rounds, not 1e-7"), "{error}");
    }

    #[test]
    fn pictures_without_a_band_or_without_room_for_a_window_are_no_trouble() {
        let (photo, mut trimap) = small(12, 10);
        trimap.values.iter_mut().for_each(|v| *v = if *v == HEAD { HEAD } else { 0 });
        let matte = closed_form(&photo, &cut(&trimap), &trimap, &PUBLISHED).unwrap();
        assert!(matte.alpha.iter().zip(&trimap.values).all(|(&a, &v)| a == v as f32 / 255.0));
        let (photo, trimap) = small(12, 2);
        let error = closed_form(&photo, &cut(&trimap), &trimap, &PUBLISHED).unwrap_err();
        assert!(error.to_string().contains("narrower than the windows"), "{error}");
        let (photo, mut trimap) = small(12, 10);
        trimap.values.fill(UNKNOWN);
        let matte = closed_form(&photo, &cut(&trimap), &trimap, &PUBLISHED).unwrap();
        assert!(matte.alpha.iter().all(|&a| a == 0.0));
    }

    #[test]
    fn alphas_equal_those_of_the_reference() {
        let shared = std::env::var("TIFACE_SHARED")
            .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into());
        let folder = std::path::Path::new(&shared).join("data/mask-models/classical");
        if !folder.is_dir() {
            eprintln!("skipped: the alphas of the reference are not at {}", folder.display());
            return;
        }
        let limits = Limits::default();
        let photo = read_photo(&folder.join("image.png"), None, &limits).unwrap();
        let mask = read_gray(&folder.join("mask.png"), None, &limits).unwrap();
        let trimap = read_gray(&folder.join("trimap_k3_i3.png"), None, &limits).unwrap();
        for (name, epsilon) in [("1e-05", 1e-5), ("1e-07", 1e-7)] {
            let truth = read_npy(&folder.join(format!("closed_form_eps{name}.npy")), &limits).unwrap();
            let NpyValues::Number(truth) = truth.values else { panic!("numbers are expected") };
            let start = std::time::Instant::now();
            let options = ClosedFormOptions { epsilon, ..PUBLISHED };
            let matte = closed_form(&photo, &mask, &trimap, &options).unwrap();
            let apart = matte.alpha.iter().zip(&truth).map(|(a, b)| (*a as f64 - b).abs());
            let worst = apart.fold(0.0, f64::max);
            eprintln!(
                "epsilon {name}: {worst:.1e} from the reference, {} unknowns, {} rounds, {:.0} ms",
                matte.unknowns,
                matte.rounds,
                1e3 * start.elapsed().as_secs_f64()
            );
            assert!(worst < 5e-3, "epsilon {name}: {worst}");
        }
    }
}
