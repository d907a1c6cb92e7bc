//! The region weights of least squared error, held back where there is little to learn from.
//!
//! ```text
//! Σ ρ |Σ_n φ_n Σ_k w_nk e_k|²  +  s·λ Σ_n |w_n − w̄|²  +  s·μ Σ_{n~m} |w_n − w_m|²
//! ```
//!
//! over the weights `w_n` of all nodes, each of them shares with sum 1. `w̄` are the global weights,
//! `n~m` neighbours along an axis, and s is what a node's share of the pixels would add if the members
//! differed everywhere as they do on average: λ and μ are then numbers around 1 for any capture.
//!
//! Node after node is set to its best shares with all others kept (exactly, see `simplex`), forward
//! and backward over the grid until nothing moves. Each step can only lower the sum, which is convex:
//! the result is its minimum, and never worse on these pixels than the global weights it starts from.

use super::blend::{check_points, point};
use super::fit::{decibels, dot};
use super::members::{in_bands, normalised};
use super::regions::Grid;
use super::{EnsembleError, Fit, Members, RegionWeights, Target, simplex};
use crate::image::Image;

/// A node weighs at least as if it had this many pixels, so that a handful of them in an almost
/// empty capture still gives the global weights. Errors of neighbouring pixels are alike: this many
/// are worth perhaps ten that are not.
const LEAST_PIXELS: f64 = 256.0;

/// Sweeps over the grid; tens are enough.
const SWEEPS: usize = 400;

/// How strongly the weights of a region are held back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stiffness {
    /// λ, the pull to the global weights.
    pub to_global: f64,
    /// μ, the pull to the neighbours along each axis.
    pub to_neighbours: f64,
}

impl Default for Stiffness {
    fn default() -> Stiffness {
        Stiffness { to_global: 0.1, to_neighbours: 0.03 }
    }
}

/// Sums over the views seen so far. As for [`Fit`]: held-out views, never test views.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionFit {
    grid: Grid,
    /// `[cells][36 pairs of corners][pairs of members]`: `Σ ρ φ_a φ_b e_k · e_l`, a ≤ b, k ≤ l.
    products: Vec<f64>,
    /// Of all pixels.
    all: Fit,
    /// Of the pixels without a point.
    pointless: Fit,
}

impl RegionFit {
    /// Of no views yet; a grid of `nodes`³ over the scene box ([`super::NODES`] suits a head).
    pub fn new(members: usize, nodes: usize) -> Result<RegionFit, EnsembleError> {
        let (grid, all) = (Grid::new(nodes)?, Fit::new(members)?);
        Ok(RegionFit {
            grid,
            products: vec![0.0; grid.cells() * 36 * pairs(members)],
            pointless: all.clone(),
            all,
        })
    }

    /// Adds one view. `points`: as for [`super::blend_regions`].
    pub fn add(&mut self, members: &Members, points: &Image, target: &Target) -> Result<(), EnsembleError> {
        self.all.same_members(members.count())?;
        members.check(target)?;
        check_points(members, points)?;
        let bands = in_bands(members.pixels(), |band| {
            let m = members.count();
            let mut sums = RegionFit {
                products: vec![0.0; self.products.len()],
                grid: self.grid,
                all: Fit::empty(m),
                pointless: Fit::empty(m),
            };
            members.errors(target, band, |i, weight, errors| {
                sums.all.count(weight, errors);
                match self.grid.locate(point(points, i)) {
                    None => sums.pointless.count(weight, errors),
                    Some((cell, tents)) => sums.count(cell, &tents, weight, errors),
                }
            });
            sums
        });
        bands.iter().for_each(|b| self.sum(b));
        Ok(())
    }

    /// Adds the views of another, which must have the same grid.
    pub fn merge(&mut self, other: &RegionFit) -> Result<(), EnsembleError> {
        self.all.same_members(other.all.members())?;
        if self.grid != other.grid {
            let (found, expected) = (other.grid.count(), self.grid.count());
            return Err(EnsembleError::NodeCount { found, expected });
        }
        self.sum(other);
        Ok(())
    }

    /// The sums without regions, for the global weights.
    pub fn global(&self) -> &Fit {
        &self.all
    }

    /// The weights of every node. `global`: those of [`Fit::solve`], or the paper's.
    pub fn solve(&self, global: &[f32], stiffness: Stiffness) -> Result<RegionWeights, EnsembleError> {
        let Stiffness { to_global, to_neighbours } = stiffness;
        for (name, value) in [("to_global", to_global), ("to_neighbours", to_neighbours)] {
            if !(value.is_finite() && value >= 0.0) {
                return Err(EnsembleError::Stiffness { name, value });
            }
        }
        let m = self.all.members();
        let global = normalised(global, m)?;
        if self.all.pixels() <= 0.0 {
            return Err(EnsembleError::NoPixels);
        }
        let start: Vec<f64> = global.iter().map(|w| *w as f64).collect();
        let blocks = self.blocks();
        let scale = self.scale(&blocks);
        // λ = 0 in an empty corner would leave nothing to decide by
        let pull = (scale * to_global).max(1e-9 * scale);
        let weights = descend(self.grid, &blocks, &start, pull, scale * to_neighbours);
        let nodes = weights.chunks(m).map(|w| w.iter().map(|v| *v as f32).collect()).collect();
        RegionWeights::new(self.grid.nodes(), global, nodes)
    }

    /// PSNR of the blend with these regions over the counted pixels of all views together, dB; as
    /// [`Fit::psnr`]. Regions fitted on some views can so be judged on others.
    pub fn psnr(&self, regions: &RegionWeights) -> Result<Option<f64>, EnsembleError> {
        self.all.same_members(regions.members())?;
        let (found, expected) = (regions.grid().count(), self.grid.count());
        if found != expected {
            return Err(EnsembleError::NodeCount { found, expected });
        }
        Ok(decibels(self.error(regions), self.all.pixels()))
    }

    /// PSNR over the pixels of all views together, each view blended with weights that were fitted
    /// on the others: what the stiffness (`None`: global weights everywhere) gains on fresh views.
    pub fn leave_one_out(
        views: &[RegionFit],
        stiffness: Option<Stiffness>,
    ) -> Result<Option<f64>, EnsembleError> {
        if views.len() < 2 {
            return Err(EnsembleError::Views { found: views.len() });
        }
        let (mut error, mut pixels) = (0.0, 0.0);
        for (i, view) in views.iter().enumerate() {
            let mut rest = RegionFit::new(view.all.members(), view.grid.nodes())?;
            for other in views.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, v)| v) {
                rest.merge(other)?;
            }
            let global = rest.all.solve()?;
            error += match stiffness {
                None => view.all.error(&global),
                Some(stiffness) => view.error(&rest.solve(&global, stiffness)?),
            };
            pixels += view.all.pixels();
        }
        Ok(decibels(error, pixels))
    }

    fn error(&self, regions: &RegionWeights) -> f64 {
        let m = self.all.members();
        let mut error = self.pointless.error(regions.global());
        for (cell, products) in self.products.chunks_exact(36 * pairs(m)).enumerate() {
            for ((a, b), block) in corner_pairs().zip(products.chunks_exact(pairs(m))) {
                let (u, v) = (self.grid.node(cell, a), self.grid.node(cell, b));
                let (u, v) = (regions.node(u), regions.node(v));
                let twice = if a == b { 1.0 } else { 2.0 };
                for (k, u) in u.iter().enumerate() {
                    for (l, v) in v.iter().enumerate() {
                        error += twice * *u as f64 * *v as f64 * block[pair(k, l)];
                    }
                }
            }
        }
        error
    }

    #[inline]
    fn count(&mut self, cell: usize, tents: &[f64; 8], weight: f64, errors: &[[f64; 3]]) {
        let size = pairs(errors.len());
        let mut products = [0.0; pairs(super::MAX_MEMBERS)];
        for (l, b) in errors.iter().enumerate() {
            for (k, a) in errors[..=l].iter().enumerate() {
                products[pair(k, l)] = weight * dot(a, b);
            }
        }
        let cell = &mut self.products[cell * 36 * size..(cell + 1) * 36 * size];
        for ((a, b), block) in corner_pairs().zip(cell.chunks_exact_mut(size)) {
            let both = tents[a] * tents[b];
            block.iter_mut().zip(&products).for_each(|(s, p)| *s += both * p);
        }
    }

    fn sum(&mut self, other: &RegionFit) {
        self.products.iter_mut().zip(&other.products).for_each(|(a, b)| *a += b);
        self.all.sum(&other.all);
        self.pointless.sum(&other.pointless);
    }

    /// The normal equations: `[nodes][27 neighbours][pairs of members]`, the node itself is 13.
    fn blocks(&self) -> Vec<f64> {
        let size = pairs(self.all.members());
        let mut blocks = vec![0.0; self.grid.count() * 27 * size];
        for (cell, products) in self.products.chunks_exact(36 * size).enumerate() {
            for ((a, b), block) in corner_pairs().zip(products.chunks_exact(size)) {
                let mut put = |from: usize, to: usize| {
                    let step = |bit: usize| 1 + (to >> bit & 1) - (from >> bit & 1);
                    let place = step(0) + 3 * step(1) + 9 * step(2);
                    let at = (self.grid.node(cell, from) * 27 + place) * size;
                    blocks[at..at + size].iter_mut().zip(block).for_each(|(s, p)| *s += p);
                };
                put(a, b);
                if a != b {
                    put(b, a);
                }
            }
        }
        blocks
    }

    /// s of the module's formula.
    fn scale(&self, blocks: &[f64]) -> f64 {
        let size = pairs(self.all.members());
        let seen = blocks.chunks_exact(27 * size).filter(|node| node.iter().any(|v| *v != 0.0)).count();
        let located = self.all.pixels() - self.pointless.pixels();
        let each = (located / seen.max(1) as f64).max(LEAST_PIXELS);
        (each * self.all.disagreement() / self.all.pixels()).max(1e-30)
    }
}

/// Minimises over all nodes, beginning at `start` everywhere. Result `[nodes · members]`.
fn descend(grid: Grid, blocks: &[f64], start: &[f64], pull: f64, smooth: f64) -> Vec<f64> {
    let (m, n, size) = (start.len(), grid.nodes(), pairs(start.len()));
    let mut w = start.repeat(grid.count());
    let mut h = vec![0.0; m * m];
    let mut g = vec![0.0; m];
    for sweep in 0..SWEEPS {
        let mut moved = 0f64;
        for turn in 0..grid.count() {
            let node = if sweep % 2 == 0 { turn } else { grid.count() - 1 - turn };
            let own = &blocks[node * 27 * size..(node + 1) * 27 * size];
            let beside: Vec<usize> = grid.beside(node).collect();
            for k in 0..m {
                g[k] = pull * start[k] + smooth * beside.iter().map(|b| w[b * m + k]).sum::<f64>();
                for l in 0..m {
                    h[k * m + l] = own[13 * size + pair(k, l)];
                }
                h[k * m + k] += pull + smooth * beside.len() as f64;
            }
            for (place, block) in own.chunks_exact(size).enumerate().filter(|(place, _)| *place != 13) {
                if block.iter().all(|v| *v == 0.0) {
                    continue; // never seen, or beyond the grid
                }
                let other = (node + place % 3 + n * (place / 3 % 3) + n * n * (place / 9)) - (1 + n + n * n);
                for k in 0..m {
                    g[k] -= (0..m).map(|l| block[pair(k, l)] * w[other * m + l]).sum::<f64>();
                }
            }
            let best = simplex::least(&h, &g);
            for (old, new) in w[node * m..(node + 1) * m].iter_mut().zip(best) {
                moved = moved.max((*old - new).abs());
                *old = new;
            }
        }
        if moved < 1e-7 {
            break;
        }
    }
    w
}

/// Pairs of members, each with itself too.
const fn pairs(members: usize) -> usize {
    members * (members + 1) / 2
}

/// The place of a pair among them.
#[inline]
fn pair(k: usize, l: usize) -> usize {
    let (low, high) = if k < l { (k, l) } else { (l, k) };
    high * (high + 1) / 2 + low
}

/// The 36 pairs of a cell's corners, each with itself too.
#[inline]
fn corner_pairs() -> impl Iterator<Item = (usize, usize)> {
    (0..8).flat_map(|a| (a..8).map(move |b| (a, b)))
}
