//! The weights of least squared error, from the products of the members' errors.
//!
//! With `Σ_k w_k = 1` the blend's error is the blend of the errors, `e = Σ_k w_k e_k`, so all that a
//! fit needs from the pixels is the matrix `D_kl = Σ ρ · e_k · e_l` over head pixels (counted ρ
//! each) and channels: the squared error is `wᵀDw`, and no large numbers cancel in it.
//!
//! # Least squares
//!
//! Small dense least squares: Cholesky, and the quadratic of least value on the simplex.
//!
//! # Tiles
//!
//! Tiles are squares of the training photographs that are excluded from training; the weights are fitted on them.
//!
//! Excluding whole views would harm the fields; excluding a few squares of each does not, since other views show the
//! same skin. The squares are large enough that their content cannot be guessed from the pixels around.

use super::members::{in_bands, no_members, normalized};
use super::{BlendTarget, Members};
use crate::kernel::cpu::rng;
use crate::{Error, Result};

/// Sums over the pixels seen so far: `members²` numbers, so each view may keep its own.
///
/// The pixels must have been excluded from training, because a member looks better than it is on its training pixels.
/// They must never come from test views.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    members: usize,
    /// D, `[members · members]`, symmetric.
    products: Vec<f64>,
    /// Weighted number of pixels.
    pixels: f64,
}

impl Fit {
    /// Returns a fit without views, of at most [`MAX_MEMBERS`] members.
    pub fn new(members: usize) -> Result<Fit> {
        match members {
            0 => Err(no_members()),
            1..=MAX_MEMBERS => Ok(Fit::empty(members)),
            found => Err(Error::cannot(
                format!("{found} members cannot be fitted, at most {MAX_MEMBERS}"),
                "blend them with weights of your own, or fit fewer",
            )),
        }
    }

    fn empty(members: usize) -> Fit {
        Fit { members, products: vec![0.0; members * members], pixels: 0.0 }
    }

    /// Adds one view, or a part of it. Cut the members as they will be cut when they are blended.
    pub fn add(&mut self, members: &Members, target: &BlendTarget) -> Result<()> {
        self.same_members(members.count())?;
        members.check(target)?;
        let bands = in_bands(members.pixels(), |band| {
            let mut sums = Fit::empty(self.members);
            members.errors(target, band, |_, weight, errors| sums.count(weight, errors));
            sums
        });
        bands.iter().try_for_each(|band| self.merge(band))
    }

    /// Adds the views of another fit. Only the last bits depend on the order.
    pub fn merge(&mut self, other: &Fit) -> Result<()> {
        self.same_members(other.members)?;
        self.products.iter_mut().zip(&other.products).for_each(|(a, b)| *a += b);
        self.pixels += other.pixels;
        Ok(())
    }

    /// Returns the weighted number of pixels.
    pub fn pixels(&self) -> f64 {
        self.pixels
    }

    /// Returns the weights `argmin wᵀDw`, `w ≥ 0`, `Σ w = 1`; `None` if no pixel counts. Identical members get equal
    /// weights.
    pub fn solve(&self) -> Option<Vec<f32>> {
        if self.pixels <= 0.0 {
            return None;
        }
        let m = self.members;
        // far below 8-bit resolution, so it only decides between identical members
        let trace: f64 = (0..m).map(|k| self.products[k * m + k]).sum();
        let ridge = (1e-9 * trace / m as f64).max(1e-30);
        let mut h = self.products.clone();
        (0..m).for_each(|k| h[k * m + k] += ridge);
        let weights = least(&h, &vec![0.0; m]);
        Some(weights[..m].iter().map(|w| *w as f32).collect())
    }

    /// Returns the PSNR of the blend with these weights over the counted pixels of all views together, dB.
    ///
    /// Before 8-bit rounding, and one mean over all pixels, where `metrics` takes one for each view.
    /// `None` without pixels or without any error.
    pub fn psnr(&self, weights: &[f32]) -> Result<Option<f64>> {
        let weights = normalized(weights, self.members)?;
        // finite unless there are no pixels or no error
        let decibels = -10.0 * (self.error(&weights) / (3.0 * self.pixels)).log10();
        Ok(decibels.is_finite().then_some(decibels))
    }

    /// Returns wᵀDw.
    fn error(&self, weights: &[f32]) -> f64 {
        let m = self.members;
        let row = |k: usize| -> f64 { (0..m).map(|l| self.products[k * m + l] * weights[l] as f64).sum() };
        (0..m).map(|k| weights[k] as f64 * row(k)).sum()
    }

    fn same_members(&self, found: usize) -> Result<()> {
        if found == self.members {
            return Ok(());
        }
        Err(Error::cannot(
            format!("there are {found} members, expected {}", self.members),
            "give every view the same members, in the same order",
        ))
    }

    #[inline]
    fn count(&mut self, weight: f64, errors: &[[f64; 3]]) {
        for (k, a) in errors.iter().enumerate() {
            for (l, b) in errors.iter().enumerate() {
                let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
                self.products[k * self.members + l] += weight * dot;
            }
        }
        self.pixels += weight;
    }
}

/// Returns the weights of least squared error over several views. A single member gets the whole weight if it alone
/// is no worse under cross-validation, in which each view is evaluated with weights fitted to the others. `None` if
/// no pixel counts.
pub fn fit_weights(views: &[Fit]) -> Result<Option<Vec<f32>>> {
    let Some(first) = views.first() else { return Ok(None) };
    let merged = |left_out: Option<usize>| -> Result<Fit> {
        let mut all = Fit::empty(first.members);
        let kept = views.iter().enumerate().filter(|(i, _)| Some(*i) != left_out);
        kept.map(|(_, view)| view).try_for_each(|view| all.merge(view))?;
        Ok(all)
    };
    let all = merged(None)?;
    let Some(weights) = all.solve() else { return Ok(None) };
    let mut unseen = 0.0;
    for (i, view) in views.iter().enumerate().filter(|(_, view)| view.pixels > 0.0) {
        // this is the only view with pixels, so nothing remains to cross-validate with
        let Some(others) = merged(Some(i))?.solve() else { return Ok(Some(weights)) };
        unseen += view.error(&others);
    }
    let alone = |k: usize| all.products[k * all.members + k];
    let best = (0..all.members).min_by(|&a, &b| alone(a).total_cmp(&alone(b)));
    Ok(Some(match best.filter(|&k| unseen >= alone(k)) {
        Some(best) => (0..all.members).map(|k| if k == best { 1.0 } else { 0.0 }).collect(),
        None => weights,
    }))
}

/// Maximum number of members in a fit.
pub const MAX_MEMBERS: usize = 8;

/// Factors the symmetric positive definite `a` (`[n · n]`, its lower half is read) in place, A = LLᵀ.
/// False where it is not positive definite.
fn factor(a: &mut [f64], n: usize) -> bool {
    for j in 0..n {
        for i in j..n {
            let dot: f64 = (0..j).map(|k| a[i * n + k] * a[j * n + k]).sum();
            let rest = a[i * n + j] - dot;
            if i == j {
                // also false for NaN
                if !(rest > 0.0 && rest.is_finite()) {
                    return false;
                }
                a[i * n + j] = rest.sqrt();
            } else {
                a[i * n + j] = rest / a[j * n + j];
            }
        }
    }
    true
}

/// Solves A x = b in place with the factor of A.
fn substitute(l: &[f64], n: usize, x: &mut [f64]) {
    for i in 0..n {
        let dot: f64 = (0..i).map(|k| l[i * n + k] * x[k]).sum();
        x[i] = (x[i] - dot) / l[i * n + i];
    }
    for i in (0..n).rev() {
        let dot: f64 = (i + 1..n).map(|k| l[k * n + i] * x[k]).sum();
        x[i] = (x[i] - dot) / l[i * n + i];
    }
}

/// `argmin ½ wᵀHw − gᵀw` with `w ≥ 0`, `Σ w = 1`; H `[n · n]` symmetric positive definite, n ≤ 8.
///
/// The least value lies inside the face of some members that are above 0. There are at most 255
/// faces; on each one the minimum without bounds is `H w = g + ν`, ν such that the sum is 1, and the
/// best of those that have no weight below 0 is the answer. Exact, no iteration.
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

/// Returns the minimum on one face, if it has no weight below 0. Corners need no equations, so a solution always
/// exists.
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
    substitute(&a, m, &mut x[..m]);
    substitute(&a, m, &mut y[..m]);
    let nu = (1.0 - x[..m].iter().sum::<f64>()) / y[..m].iter().sum::<f64>();
    for i in 0..m {
        x[i] += nu * y[i];
    }
    x[..m].iter().all(|v| *v >= 0.0).then_some(x)
}

/// The side of a tile is this part of the shorter side of its photograph: a third of an eye.
const PARTS: u32 = 16;

/// The least side of a tile, pixels.
const LEAST: u32 = 8;

/// A square of a photograph.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// Its first column.
    pub x: u32,
    /// Its first row.
    pub y: u32,
    /// Pixels along each side.
    pub side: u32,
}

impl Tile {
    /// Returns the pixels of the tile in a picture `width` wide, row by row.
    pub fn pixels(self, width: u32) -> impl Iterator<Item = usize> {
        let Tile { x, y, side } = self;
        (y..y + side).flat_map(move |y| (x..x + side).map(move |x| y as usize * width as usize + x as usize))
    }
}

/// Returns the tiles of photograph number `view`: about `share` of its pixels, at least one tile, each at a random
/// position in its own cell of a grid; none if `share` is 0. The same arguments give the same tiles.
pub fn tiles(width: u32, height: u32, share: f64, seed: u64, view: u64) -> Vec<Tile> {
    let shorter = width.min(height);
    let side = (shorter / PARTS).max(LEAST).min(shorter);
    if share <= 0.0 || side == 0 {
        return Vec::new();
    }
    let cell = side as f64 / share.min(1.0).sqrt();
    // a cell holds its tile
    let cells = |length: u32| ((length as f64 / cell).round() as u32).clamp(1, length / side);
    let (columns, rows) = (cells(width), cells(height));
    let place = |length: u32, count: u32, at: u32, stream: u64, tile: u64| {
        let (from, to) = (length * at / count, length * (at + 1) / count);
        from + rng::below(seed, stream, tile, (to - from - side + 1) as u64) as u32
    };
    (0..columns * rows)
        .map(|i| Tile {
            x: place(width, columns, i % columns, 2 * view, i as u64),
            y: place(height, rows, i / columns, 2 * view + 1, i as u64),
            side,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::cpu::rng::uniform;

    #[test]
    fn cholesky_solves_a_system_worked_by_hand() {
        // [4 2; 2 5] x = [8; 14]  →  x = (12/16, 40/16) = (0.75, 2.5)
        let mut a = [4.0, 2.0, 2.0, 5.0];
        assert!(factor(&mut a, 2));
        let mut x = [8.0, 14.0];
        substitute(&a, 2, &mut x);
        assert!((x[0] - 0.75).abs() < 1e-14 && (x[1] - 2.5).abs() < 1e-14);
        assert!(!factor(&mut [1.0, 2.0, 2.0, 1.0], 2)); // determinant −3
    }

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

    #[test]
    fn tiles_never_overlap_and_are_about_the_share_that_was_asked_for() {
        for (width, height) in [(384, 512), (3000, 4096), (640, 90), (17, 9), (5, 4), (1, 1)] {
            for share in [0.001, 0.04, 0.25] {
                let made = tiles(width, height, share, 42, 3);
                assert_eq!(made, tiles(width, height, share, 42, 3));
                let mut taken = vec![false; (width * height) as usize];
                for i in made.iter().flat_map(|t| t.pixels(width)) {
                    assert!(!std::mem::replace(&mut taken[i], true), "{width} × {height}, {share}");
                }
                let found = made.iter().map(|t| t.side * t.side).sum::<u32>() as f64;
                let wanted = share * (width * height) as f64;
                if width > 100 && share > 0.01 && height > 100 {
                    assert!(
                        (0.7..1.4).contains(&(found / wanted)),
                        "{width} × {height}: {found} of {wanted}"
                    );
                }
                assert!(!made.is_empty());
            }
        }
        assert!(tiles(384, 512, 0.0, 42, 3).is_empty());
        assert_ne!(tiles(384, 512, 0.04, 42, 3), tiles(384, 512, 0.04, 42, 4));
        assert_ne!(tiles(384, 512, 0.04, 42, 3), tiles(384, 512, 0.04, 43, 3));
    }
}
