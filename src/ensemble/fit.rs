//! The weights of least squared error, from the products of the members' errors.
//!
//! With `Σ_k w_k = 1` the blend's error is the blend of the errors, `e = Σ_k w_k e_k`, so all that
//! a fit needs from the pixels is the matrix `D_kl = Σ ρ · e_k · e_l` over head pixels (counted ρ
//! each) and channels: the squared error is `wᵀDw`, and no large numbers cancel in it.

use super::least_squares::least;
use super::{BlendTarget, MAX_MEMBERS, Members, in_bands, no_members, normalized};
use tiface_base::{Error, Result};

/// How much larger the part of its squared error that a radiance field does not share with a mesh
/// is from a new camera than in squares left out of the photographs that it was learned from.
/// Weights that are best for held-out views of `lps`, `nefertiti` and the demo head, whole, have it
/// at 2.1, 2.6 and 2.5 with drafts and at 1.2 with `quick` when its field
/// learned for 450 steps.
/// At 1.5 drafts gain 0.05 to 0.2 dB and `quick` loses 0.02.
const UNSEEN_CAMERA: f64 = 1.5;

/// Sums over the pixels seen so far: `members²` numbers, so each view may keep its own.
///
/// The pixels must have been excluded from training, because a member looks better than it is on
/// its training pixels. They must never come from test views.
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

    /// Returns the sums that new cameras would give. `learned` tells which members are radiance
    /// fields, learned through the very cameras of the pixels: of their squared error, the part
    /// that they do not share with the other members counts `UNSEEN_CAMERA` times.
    pub fn for_new_cameras(&self, learned: &[bool]) -> Fit {
        let m = self.members;
        let mut out = self.clone();
        let others: Vec<usize> = (0..m).filter(|&l| !learned[l]).collect();
        if others.is_empty() {
            return out;
        }
        for k in (0..m).filter(|&k| learned[k]) {
            let shared: f64 = others.iter().map(|l| self.products[k * m + l]).sum();
            let own = self.products[k * m + k] - shared / others.len() as f64;
            out.products[k * m + k] += (UNSEEN_CAMERA - 1.0) * own.max(0.0);
        }
        out
    }

    /// Returns the weighted number of pixels.
    pub fn pixels(&self) -> f64 {
        self.pixels
    }

    /// Returns the weights `argmin wᵀDw`, `w ≥ 0`, `Σ w = 1`; `None` if no pixel counts. Identical
    /// members get equal weights.
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

    /// Returns the PSNR of the blend with these weights over the counted pixels of all views
    /// together, dB.
    ///
    /// Before 8-bit rounding, and one mean over all pixels, where `metrics` takes one for each
    /// view. `None` without pixels or without any error.
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

/// Returns the weights of least squared error over several views. A single member gets the whole
/// weight if it alone is no worse under cross-validation, in which each view is evaluated with
/// weights fitted to the others. `None` if no pixel counts.
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

/// Fits of the blend: known weights are found again, and scarce data change little.
#[cfg(test)]
mod tests {
    use super::*;
    use crate::ensemble::{Member, PAPER_WEIGHTS, blend};
    use tiface_base::image::{Gray, Image, Photo, quantize};
    use tiface_base::math::rng::{normal, uniform};

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
    fn the_own_error_of_a_learned_field_counts_half_more_from_new_cameras() {
        // errors 0.1 and −0.2: D = [[3, −6], [−6, 12]] · 0.01 a pixel; 3 + 0.5 (3 + 6) = 7.5 gives
        // (12 + 6) / (7.5 + 12 + 12) = 4 / 7 for 2 / 3
        let views = [view(|_, _| 0.7), view(|_, _| 0.4)];
        let sums = fit(&views, &photo(|_, _| 0.6), &everywhere());
        let w = |learned: &[bool]| sums.for_new_cameras(learned).solve().unwrap();
        assert!((w(&[false, false])[0] - 2.0 / 3.0).abs() < 1e-4);
        assert!((w(&[true, false])[0] - 4.0 / 7.0).abs() < 1e-4, "{:?}", w(&[true, false]));
        assert_eq!(w(&[true, true]), w(&[false, false]));
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

    /// Returns a view of two members with errors of these sizes, in this many of its pixels.
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
        // errors of the members: 0.1 and -0.3 in one view, -0.1 and 0.02 in the other. Over both,
        // (0.7, 0.3) is best; but the first alone asks for (0.75, 0.25) and the second for (0.17,
        // 0.83), which leave 0.0049 of the second and 0.0544 of the first, and the first member
        // alone 0.01 of each
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
