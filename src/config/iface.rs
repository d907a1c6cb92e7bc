//! `[iface]`: the signed-distance field and its training.

use serde::{Deserialize, Serialize};

/// How the occupancy grid decides which cells to march through.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OccupancyRule {
    /// Cells within a band around the zero set, inside the visual hull; rays end deep inside.
    Band,
    /// nerfacc 0.3.3: decaying maximum of the opacity at jittered points, thresholded.
    Nerfacc,
}

/// What is behind the head while training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// Black for target and render.
    Black,
    /// One random colour per ray, the same for target and render.
    Random,
}

/// What a pixel with a soft mask should look like over black.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Foreground {
    /// Alpha times the photograph, stage light included (published).
    Photo,
    /// The photograph less the stage's light, estimated from pixels nearby.
    Estimated,
}

/// Where the surface starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Start {
    /// A sphere of half the box (Gropp et al. 2020, Atzmon, Lipman 2020).
    Sphere,
    /// Fitted to the visual hull's distance before training; a sphere where there is no hull.
    Hull,
}

/// Settings of the `iface` stage. Lengths are in field units: the scene's box is `[-radius, radius]³`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IfaceConfig {
    /// Optimiser steps.
    pub steps: u64,
    /// Rays per step at the start.
    pub rays: usize,
    /// Upper bound of rays per step; the count adapts to the sample budget.
    pub max_rays: usize,
    /// Samples a step aims for.
    pub samples: usize,
    /// Levels of the hash grid.
    pub levels: usize,
    /// Resolution of the coarsest level.
    pub base_resolution: u32,
    /// Growth of the resolution from level to level.
    pub growth: f64,
    /// Binary logarithm of a level's largest table.
    pub log2_table: u32,
    /// Levels that take part from the first step.
    pub start_levels: usize,
    /// One more level every so many steps (0: all at once).
    pub level_every: u64,
    /// Does the colour network read the hash features beside the geometry network's outputs?
    pub color_skip: bool,
    /// How many times softer than its sharpest the surface may be where that pays; 1: one sharpness everywhere.
    pub soften: f64,
    /// Half edge of the field's box.
    pub radius: f32,
    /// Where the surface starts.
    pub start: Start,
    /// Learning rate of the hash table at its peak.
    pub lr_table: f64,
    /// Learning rate of the networks at its peak.
    pub lr_network: f64,
    /// Learning rate of the variance at its peak.
    pub lr_variance: f64,
    /// Steps of linear warm-up from 1 % of the peak.
    pub warmup: u64,
    /// Learning rate at the end, as a share of the peak; exponential in between.
    pub lr_final: f64,
    /// Decoupled weight decay of the networks and the variance.
    pub weight_decay: f64,
    /// Decoupled weight decay of the hash table.
    pub table_decay: f64,
    /// Update only rows of the table that a sample touched.
    pub touched_rows: bool,
    /// Weight of the squared colour error.
    pub rgb_mse: f64,
    /// Weight of the absolute colour error.
    pub rgb_l1: f64,
    /// Weight of the squared colour error of single samples, Σ w ‖c − target‖² on rays that are all head. The
    /// blend alone leaves each sample's colour free, and a mesh shows a single one.
    pub rgb_sample: f64,
    /// Weight of the mask's binary cross entropy.
    pub mask: f64,
    /// Weight of (‖∇sdf‖ − 1)².
    pub eikonal: f64,
    /// Weight of the sparsity term.
    pub sparsity: f64,
    /// Scale of the sparsity term, mean exp(−scale · |sdf|).
    pub sparsity_scale: f64,
    /// Start value of the variance v; inv_s = exp(10 v).
    pub variance: f64,
    /// Steps over which the cosine is annealed.
    pub anneal_end: u64,
    /// How cells are kept.
    pub occupancy: OccupancyRule,
    /// Cells per axis of the occupancy grid.
    pub occupancy_resolution: usize,
    /// Steps between updates of the occupancy grid.
    pub occupancy_every: u64,
    /// Half width of the band in units of 1 / local sharpness.
    pub band: f32,
    /// March step in units of 1 / inv_s, the sharpest (`band` rule).
    pub march: f32,
    /// Shortest march step of the `band` rule.
    pub min_step: f32,
    /// Longest march step of the `band` rule.
    pub max_step: f32,
    /// Steps across the box's diagonal (`nerfacc` rule).
    pub samples_per_ray: usize,
    /// Shift each ray's lattice by a random part of a step.
    pub jitter: bool,
    /// What is behind the head while training.
    pub background: Background,
    /// Start with a gradient of length one. The published start is a unit sphere of the networks' own
    /// coordinates, and so has gradients of 1 / radius.
    pub unit_start: bool,
    /// Start the features that go to the colour network apart from each other. The published start gives
    /// all thirteen the sdf's own weights, and colour is learned late.
    pub spread_features: bool,
    /// What a pixel with a soft mask should look like.
    pub foreground: Foreground,
    /// Seconds between checkpoints.
    pub checkpoint_s: f64,
}

impl IfaceConfig {
    /// Minutes on two cores: for a first look.
    pub fn draft() -> IfaceConfig {
        IfaceConfig {
            steps: 3000,
            rays: 1024,
            max_rays: 8192,
            samples: 24_576,
            levels: 14,
            base_resolution: 16,
            growth: 1.4,
            log2_table: 18,
            start_levels: 6,
            level_every: 100,
            color_skip: true,
            soften: 8.0,
            radius: 1.0,
            start: Start::Hull,
            lr_table: 1e-2,
            lr_network: 5e-3,
            // four times as published: where softness is local, skin may become as sharp as it is
            lr_variance: 4e-3,
            warmup: 100,
            lr_final: 0.05,
            weight_decay: 0.0,
            table_decay: 0.0,
            touched_rows: true,
            rgb_mse: 10.0,
            rgb_l1: 0.0,
            rgb_sample: 3.0,
            mask: 0.1,
            eikonal: 0.1,
            sparsity: 0.0,
            sparsity_scale: 50.0,
            variance: 0.3,
            anneal_end: 1000,
            occupancy: OccupancyRule::Band,
            occupancy_resolution: 160,
            occupancy_every: 50,
            band: 4.0,
            march: 1.0,
            min_step: 0.004,
            max_step: 0.05,
            samples_per_ray: 1024,
            jitter: true,
            background: Background::Random,
            unit_start: true,
            spread_features: true,
            foreground: Foreground::Estimated,
            checkpoint_s: 60.0,
        }
    }

    /// The default: better and slower.
    pub fn standard() -> IfaceConfig {
        IfaceConfig {
            steps: 8000,
            log2_table: 19,
            level_every: 250,
            anneal_end: 3000,
            lr_final: 0.02,
            min_step: 0.003,
            ..IfaceConfig::draft()
        }
    }

    /// The published recipe (`neus-blender_ilsh`), for comparison.
    pub fn paper() -> IfaceConfig {
        IfaceConfig {
            steps: 20_000,
            rays: 256,
            max_rays: 8192,
            samples: 256 * 1024,
            levels: 16,
            base_resolution: 32,
            growth: 1.319_507_910_772_894_2,
            log2_table: 19,
            start_levels: 16,
            level_every: 0,
            color_skip: false,
            soften: 1.0,
            radius: 0.3,
            start: Start::Sphere,
            lr_table: 1e-2,
            lr_network: 1e-2,
            lr_variance: 1e-3,
            warmup: 500,
            lr_final: 0.1,
            weight_decay: 0.01,
            table_decay: 0.01,
            touched_rows: false,
            rgb_mse: 10.0,
            rgb_l1: 0.0,
            rgb_sample: 0.0,
            mask: 0.1,
            eikonal: 0.1,
            sparsity: 0.5,
            sparsity_scale: 1.0,
            variance: 0.3,
            anneal_end: 20_000,
            occupancy: OccupancyRule::Nerfacc,
            occupancy_resolution: 128,
            occupancy_every: 16,
            band: 6.0,
            march: 1.0,
            min_step: 0.004,
            max_step: 0.05,
            samples_per_ray: 1024,
            jitter: false,
            background: Background::Black,
            unit_start: false,
            spread_features: false,
            foreground: Foreground::Photo,
            checkpoint_s: 120.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_preset_has_the_published_numbers() {
        let p = IfaceConfig::paper();
        assert_eq!((p.steps, p.rays, p.max_rays, p.samples), (20_000, 256, 8192, 262_144));
        assert_eq!((p.levels, p.base_resolution, p.log2_table), (16, 32, 19));
        assert_eq!((p.mask, p.eikonal, p.sparsity, p.sparsity_scale), (0.1, 0.1, 0.5, 1.0));
        assert_eq!((p.weight_decay, p.table_decay, p.lr_variance), (0.01, 0.01, 0.001));
        assert_eq!((p.color_skip, p.soften), (false, 1.0));
    }
}
