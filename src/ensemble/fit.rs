//! The weights of least squared error, from the products of the members' errors.
//!
//! With `Σ_k w_k = 1` the blend's error is the blend of the errors, `e = Σ_k w_k e_k`, so all that a
//! fit needs from the pixels is the matrix `D_kl = Σ ρ · e_k · e_l` over head pixels (counted ρ
//! each) and channels: the squared error is `wᵀDw`, and no large numbers cancel in it.
//!
//! # Least squares
//!
//! Small and dense: the quadratic of least value on the simplex.
//!
//! # Tiles
//!
//! Tiles are squares of the training photographs that are excluded from training; the weights are fitted on them.
//!
//! Excluding whole views would harm the fields; excluding a few squares of each does not, since other views show the
//! same skin. The squares are large enough that their content cannot be guessed from the pixels around.

use super::{BlendTarget, Members, in_bands, no_members, normalized};
use crate::math::cholesky::{factor, substitute};
use crate::math::rng;
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
    substitute(&a, &mut x[..m]);
    substitute(&a, &mut y[..m]);
    let nu = (1.0 - x[..m].iter().sum::<f64>()) / y[..m].iter().sum::<f64>();
    for i in 0..m {
        x[i] += nu * y[i];
    }
    x[..m].iter().all(|v| *v >= 0.0).then_some(x)
}

/// The side of a tile is this part of the shorter side of its photograph: a third of an eye.
const TILES_PER_SIDE: u32 = 16;

/// The least side of a tile, pixels.
const MIN_TILE_PX: u32 = 8;

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
    let side = (shorter / TILES_PER_SIDE).max(MIN_TILE_PX).min(shorter);
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
    use crate::math::rng::uniform;

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

/// Fits of the blend: known weights are found again, and scarce data change little.
#[cfg(test)]
mod blend_tests {
    use super::*;
    use crate::ensemble::{Member, PAPER_WEIGHTS, blend};
    use crate::image::{Gray, Image, Photo, quantize};
    use crate::math::rng::{normal, uniform};

    const SIZE: u32 = 64;
    const PIXELS: usize = (SIZE * SIZE) as usize;

    fn view(color: impl Fn(usize, usize) -> f32) -> Image {
        let mut image = Image::new(SIZE, SIZE, 4);
        for (i, pixel) in image.data.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            *pixel = [color(i, 0), color(i, 1), color(i, 2), 1.0];
        }
        image
    }

    fn photo(color: impl Fn(usize, usize) -> f32) -> Photo {
        let rgb = (0..PIXELS).map(|i| std::array::from_fn(|j| quantize(color(i, j)))).collect();
        Photo { width: SIZE, height: SIZE, rgb, alpha: None }
    }

    fn everywhere() -> Gray {
        Gray { width: SIZE, height: SIZE, values: vec![255; PIXELS] }
    }

    /// Returns a color from 0.3 to 0.7.
    fn color(seed: u64, i: usize, j: usize) -> f32 {
        0.3 + 0.4 * uniform(seed, j as u64, i as u64)
    }

    fn noise(seed: u64, sigma: f32, i: usize, j: usize) -> f32 {
        sigma * normal(seed, 20 + j as u64, i as u64)
    }

    fn members(views: &[Image]) -> Members<'_> {
        let names = ["baseline", "tface", "iface", "other"];
        let list: Vec<Member> =
            views.iter().zip(names).map(|(image, name)| Member { name, image, masked: true }).collect();
        Members::new(&list).unwrap()
    }

    fn fit(views: &[Image], photo: &Photo, weight: &Gray) -> Fit {
        let mut fit = Fit::new(views.len()).unwrap();
        fit.add(&members(views), &BlendTarget { photo, weight }).unwrap();
        fit
    }

    #[test]
    fn two_flat_members_are_weighed_as_worked_by_hand() {
        // 0.2 and 0.4 around 68/255 = 0.2667: two thirds and a third; none beyond the greater one
        let views = [view(|_, _| 0.2), view(|_, _| 0.4)];
        let between = fit(&views, &photo(|_, _| 68.0 / 255.0), &everywhere());
        let w = between.solve().unwrap();
        assert!((w[0] - 2.0 / 3.0).abs() < 1e-4 && (w[1] - 1.0 / 3.0).abs() < 1e-4, "{w:?}");
        let beyond = fit(&views, &photo(|_, _| 0.6), &everywhere());
        assert_eq!(beyond.solve().unwrap(), [0.0, 1.0]);
        // error 0.2 of the second: −10 log10 0.04 = 13.9794; halves: 0.3, 10.4576
        assert!((beyond.psnr(&[0.0, 1.0]).unwrap().unwrap() - 13.9794).abs() < 1e-4);
        assert!((beyond.psnr(&[0.5, 0.5]).unwrap().unwrap() - 10.4576).abs() < 1e-4);
    }

    #[test]
    fn known_weights_are_found_again_inside_and_on_the_boundary() {
        for truth in [[0.1, 0.6, 0.3], [0.0, 0.7, 0.3], [0.0, 0.0, 1.0]] {
            let views: Vec<Image> = (0..3).map(|k| view(|i, j| color(k, i, j))).collect();
            let photo = photo(|i, j| {
                let mix: f32 = (0..3).map(|k| truth[k] * color(k as u64, i, j)).sum();
                mix + noise(9, 0.01, i, j)
            });
            let fit = fit(&views, &photo, &everywhere());
            let w = fit.solve().unwrap();
            assert!((0..3).all(|k| (w[k] - truth[k]).abs() < 0.005), "{truth:?} → {w:?}");
            assert!((w.iter().sum::<f32>() - 1.0).abs() < 1e-6 && w.iter().all(|v| *v >= 0.0));
            // no better than the noise of 0.01 (40 dB), and no worse than the truth
            let psnr = |w: &[f32]| fit.psnr(w).unwrap().unwrap();
            assert!((psnr(&w) - 40.0).abs() < 0.3 && psnr(&w) >= psnr(&truth) - 1e-9);
        }
    }

    #[test]
    fn the_sums_say_what_the_pixels_say() {
        let views: Vec<Image> = (0..3).map(|k| view(|i, j| color(k, i, j))).collect();
        let photo = photo(|i, j| color(7, i, j));
        let mut weight = everywhere();
        (0..PIXELS / 2).for_each(|i| weight.values[i] = 0);
        let blended = blend(&members(&views), &PAPER_WEIGHTS).unwrap();
        let squares = (PIXELS / 2..PIXELS)
            .flat_map(|i| (0..3).map(move |j| (i, j)))
            .map(|(i, j)| (blended.data[4 * i + j] as f64 - photo.rgb[i][j] as f64 / 255.0).powi(2));
        let expected = -10.0 * (squares.sum::<f64>() / (1.5 * PIXELS as f64)).log10();
        let found = fit(&views, &photo, &weight).psnr(&PAPER_WEIGHTS).unwrap().unwrap();
        assert!((found - expected).abs() < 1e-5, "{found} {expected}");
    }

    #[test]
    fn members_that_are_the_same_share_alike() {
        let views = [view(|i, j| color(1, i, j)), view(|i, j| color(1, i, j)), view(|i, j| color(2, i, j))];
        let photo = photo(|i, j| color(1, i, j) + noise(3, 0.02, i, j));
        let w = fit(&views, &photo, &everywhere()).solve().unwrap();
        assert!((w[0] - w[1]).abs() < 1e-4 && w[2] < 0.01, "{w:?}");
        // and a member that is perfect takes all, without dividing by 0
        let black = [view(|_, _| 0.0), view(|_, _| 1.0)];
        let perfect = fit(&black, &self::photo(|_, _| 0.0), &everywhere());
        assert_eq!(perfect.psnr(&[1.0, 0.0]).unwrap(), None);
        assert!(perfect.solve().unwrap()[0] > 0.999_999);
    }

    #[test]
    fn half_a_weight_counts_half_a_pixel_and_views_add_up() {
        let views = [view(|i, j| color(1, i, j)), view(|i, j| color(2, i, j))];
        let photo = photo(|i, j| color(3, i, j));
        let mut weight = everywhere();
        weight.values.fill(51); // a fifth
        let fifth = fit(&views, &photo, &weight);
        assert!((fifth.pixels() - PIXELS as f64 / 5.0).abs() < 1e-6);
        let whole = fit(&views, &photo, &everywhere());
        assert!(
            (fifth.psnr(&[0.5, 0.5]).unwrap().unwrap() - whole.psnr(&[0.5, 0.5]).unwrap().unwrap()).abs()
                < 1e-9
        );
        let mut twice = whole.clone();
        twice.merge(&whole).unwrap();
        let mut streamed = whole.clone();
        streamed.add(&members(&views), &BlendTarget { photo: &photo, weight: &everywhere() }).unwrap();
        assert!((twice.pixels() - streamed.pixels()).abs() < 1e-9);
        let (a, b) = (twice.solve().unwrap(), streamed.solve().unwrap());
        assert!((a[0] - b[0]).abs() < 1e-6);
    }

    /// Returns a view of two members with errors of these sizes, in so many of its pixels.
    fn noisy(seed: u64, sigmas: [f32; 2], pixels: usize) -> Fit {
        let views =
            [0, 1].map(|k| view(|i, j| color(seed, i, j) + noise(seed * 10 + k, sigmas[k as usize], i, j)));
        let mut weight = everywhere();
        weight.values[pixels..].fill(0);
        fit(&views, &photo(|i, j| color(seed, i, j)), &weight)
    }

    #[test]
    fn the_blend_of_a_capture_follows_its_better_member() {
        // independent errors a and b: weights as 1/a² and 1/b²
        for (sigmas, first) in [([0.02, 0.02], 0.5), ([0.02, 0.04], 0.8), ([0.04, 0.02], 0.2)] {
            let views: Vec<Fit> = (1..4).map(|seed| noisy(seed, sigmas, PIXELS)).collect();
            let w = fit_weights(&views).unwrap().unwrap();
            assert!((w[0] - first).abs() < 0.02 && (w[0] + w[1] - 1.0).abs() < 1e-6, "{sigmas:?} → {w:?}");
        }
    }

    #[test]
    fn where_no_weights_hold_on_other_views_the_best_member_stands_alone() {
        // errors of the members: 0.1 and -0.3 in one view, -0.1 and 0.02 in the other. Over both, (0.7, 0.3) is best;
        // but the first alone asks for (0.75, 0.25) and the second for (0.17, 0.83), which leave 0.0049 of the second
        // and 0.0544 of the first, and the first member alone 0.01 of each
        let of =
            |errors: [f32; 2]| fit(&errors.map(|e| view(|_, _| 0.4 + e)), &photo(|_, _| 0.4), &everywhere());
        let views = [of([0.1, -0.3]), of([-0.1, 0.02])];
        let mut both = views[0].clone();
        both.merge(&views[1]).unwrap();
        assert!((both.solve().unwrap()[0] - 0.7).abs() < 0.01);
        assert_eq!(fit_weights(&views).unwrap().unwrap(), [1.0, 0.0]);
        // one view has no other to judge it, and one without a pixel is none
        let one = noisy(1, [0.02, 0.04], PIXELS);
        assert_eq!(fit_weights(&[one.clone(), Fit::new(2).unwrap()]).unwrap(), one.solve());
        assert_eq!(fit_weights(&[]), Ok(None));
        assert_eq!(fit_weights(&[Fit::new(2).unwrap()]), Ok(None));
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let views = [view(|i, j| color(1, i, j)), view(|i, j| color(2, i, j))];
                let fit = fit(&views, &photo(|i, j| color(3, i, j)), &everywhere());
                let weights = fit.solve().unwrap();
                let out = blend(&members(&views), &weights).unwrap();
                (fit, weights, out)
            })
        };
        let one = run(1);
        let nan_free = |image: &Image| image.data.iter().all(|v| v.is_finite());
        assert!(nan_free(&one.2) && one == run(3) && one == run(5));
    }

    #[test]
    fn what_cannot_be_fitted_is_said() {
        assert_eq!(Fit::new(0).unwrap_err().to_string(), "there are no members to blend");
        assert_eq!(Fit::new(9).unwrap_err().to_string(), "9 members cannot be fitted, at most 8");
        assert_eq!(Fit::new(2).unwrap().solve(), None);

        let views = [view(|_, _| 0.5), view(|_, _| 0.5)];
        let (photo, weight) = (photo(|_, _| 0.5), Gray { width: 1, height: 1, values: vec![255] });
        let e = Fit::new(2)
            .unwrap()
            .add(&members(&views), &BlendTarget { photo: &photo, weight: &weight })
            .unwrap_err();
        assert_eq!(e.to_string(), "the weight map is 1 × 1 pixels, expected 64 × 64");
        let target = BlendTarget { photo: &photo, weight: &everywhere() };
        let e = Fit::new(3).unwrap().add(&members(&views), &target).unwrap_err();
        assert_eq!(e.to_string(), "there are 2 members, expected 3");
    }
}
