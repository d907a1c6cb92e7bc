//! The weights of least squared error, from the products of the members' errors.
//!
//! With `Σ_k w_k = 1` the blend's error is the blend of the errors, `e = Σ_k w_k e_k`, so all that a
//! fit needs from the pixels is the matrix `D_kl = Σ ρ · e_k · e_l` over head pixels (counted ρ
//! each) and channels: the squared error is `wᵀDw`, and no large numbers cancel in it.

use super::members::{in_bands, no_members, normalized};
use super::simplex::{self, MAX_MEMBERS};
use super::{BlendTarget, Members};
use crate::{Error, Result};

/// Sums over the pixels seen so far: `members²` numbers, so each view may keep its own.
///
/// Give it pixels that were held out of training: on those it learned from a member looks better
/// than it is. Never test views.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    members: usize,
    /// D, `[members · members]`, symmetric.
    products: Vec<f64>,
    /// How many pixels, each by its weight.
    pixels: f64,
}

impl Fit {
    /// Of no views yet. At most [`MAX_MEMBERS`] members.
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

    /// Adds the views of another. The last bits depend on the order, nothing else does.
    pub fn merge(&mut self, other: &Fit) -> Result<()> {
        self.same_members(other.members)?;
        self.products.iter_mut().zip(&other.products).for_each(|(a, b)| *a += b);
        self.pixels += other.pixels;
        Ok(())
    }

    /// How many pixels were counted, each by its weight.
    pub fn pixels(&self) -> f64 {
        self.pixels
    }

    /// The weights: `argmin wᵀDw`, `w ≥ 0`, `Σ w = 1`; `None` where no pixel counts. Members that are alike share
    /// alike.
    pub fn solve(&self) -> Option<Vec<f32>> {
        if self.pixels <= 0.0 {
            return None;
        }
        let m = self.members;
        // far below what 8 bits can tell; it decides only between members that are the same
        let trace: f64 = (0..m).map(|k| self.products[k * m + k]).sum();
        let ridge = (1e-9 * trace / m as f64).max(1e-30);
        let mut h = self.products.clone();
        (0..m).for_each(|k| h[k * m + k] += ridge);
        let weights = simplex::least(&h, &vec![0.0; m]);
        Some(weights[..m].iter().map(|w| *w as f32).collect())
    }

    /// PSNR of the blend with these weights over the counted pixels of all views together, dB.
    ///
    /// Before 8-bit rounding, and one mean over all pixels, where `metrics` takes one for each view.
    /// `None` without pixels or without any error.
    pub fn psnr(&self, weights: &[f32]) -> Result<Option<f64>> {
        let weights = normalized(weights, self.members)?;
        // a number unless there are no pixels or no error
        let decibels = -10.0 * (self.error(&weights) / (3.0 * self.pixels)).log10();
        Ok(decibels.is_finite().then_some(decibels))
    }

    /// wᵀDw.
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

/// The weights of least squared error over several views; all of one member where that member alone is no
/// worse on views that had no say, each judged with the weights of the others. `None` where no pixel counts.
pub fn weigh(views: &[Fit]) -> Result<Option<Vec<f32>>> {
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
        // the only view with a pixel: nothing can judge it
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
