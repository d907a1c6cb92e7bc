//! `[iface]`: the signed-distance field and its training.

use super::table::table;
use serde::{Deserialize, Serialize};

/// How the occupancy grid decides which cells to march through.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OccupancyRule {
    /// Cells within a band around the zero set, inside the visual hull; rays end deep inside.
    #[default]
    Band,
    /// nerfacc 0.3.3: decaying maximum of the opacity at jittered points, thresholded.
    Nerfacc,
}

/// Background while training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// Black for target and render.
    Black,
    /// One random color per ray, the same for target and render.
    #[default]
    Random,
}

/// Target color over black of a pixel with a soft mask.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Foreground {
    /// Alpha times the photograph, the background's light included (published).
    Photo,
    /// The photograph less the background's light, estimated from pixels nearby.
    #[default]
    Estimated,
}

/// Kind of field.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FieldKind {
    /// A signed distance (NeuS).
    #[default]
    Sdf,
    /// A density (Instant-NeRF).
    Density,
}

/// Initial surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Start {
    /// A sphere of half the box (Gropp et al. 2020, Atzmon, Lipman 2020).
    Sphere,
    /// Fitted to the visual hull's distance before training; a sphere where there is no hull.
    #[default]
    Hull,
}

table! {
    /// Settings of the stage `iface`. Lengths are in field units: the scene's box is
    /// `[-radius, radius]³`.
    pub struct IfaceConfig;
    keys {
        /// Kind of field: sdf (signed distance, as in NeuS) or density (Instant-NeRF, in preset
        /// paper).
        field: FieldKind [Iface] => FieldKind::Sdf;
        /// Optimizer steps.
        steps: u64, 1.0..=1e7 [Iface] => 3000, 8000, 20_000, 900;
        /// Rays per step at the start.
        rays: usize, 1.0..=1_048_576.0 [Iface] => 1024, 1024, 256;
        /// Largest number of rays per step; the number adapts to `samples`.
        max_rays: usize, 1.0..=1_048_576.0 [Iface] => 8192;
        /// Target number of samples per step, over all rays.
        samples: usize, 64.0..=1e8 [Iface] => 16_384, 24_576, 262_144;
        /// Levels of the hash grid.
        levels: usize, 1.0..=32.0 [Iface] => 14, 14, 16, 12;
        /// Cells per axis of the coarsest level.
        base_resolution: u32, 2.0..=1024.0 [Iface] => 16, 16, 32;
        /// Ratio of the resolutions of consecutive levels.
        growth: f64, 1.0..=4.0 [Iface] => 1.4, 1.4, 1.319_507_910_772_894_2;
        /// Binary logarithm of a level's largest table.
        log2_table: u32, 4.0..=24.0 [Iface] => 17, 19, 19, 18;
        /// Largest ratio of the local to the smallest width of the surface, for hair (spatially
        /// varying sharpness, after Adaptive Shells, Wang et al. 2023); 1: one sharpness everywhere
        /// (published).
        soften: f64, 1.0..=1e3 [Iface] => 8.0, 8.0, 1.0;
        /// Learning rate of the hash table at its peak.
        lr_table: f64, 0.0..=1.0 [Iface] => 1e-2;
        /// Learning rate of the networks at its peak.
        lr_network: f64, 0.0..=1.0 [Iface] => 5e-3, 5e-3, 1e-2;
        /// Weight of the mask's binary cross entropy.
        mask: f64, 0.0..=1e6 [Iface] => 0.1;
        /// Weight of the eikonal loss, mean (‖∇sdf‖ − 1)².
        eikonal: f64, 0.0..=1e6 [Iface] => 0.1;
        /// Weight of the sparsity term, the mean of exp(-scale * |sdf|).
        sparsity: f64, 0.0..=1e6 [Iface] => 0.0, 0.0, 0.5;
        /// Weight of the distance to multi-view stereo points, which are found on the surface after
        /// 0.6 of the steps; 0: none (published).
        stereo: f64, 0.0..=1e6 [Iface] => 0.02, 0.02, 0.0;
        /// Cells per axis of the occupancy grid.
        occupancy_resolution: usize, 8.0..=1024.0 [Iface] => 160, 160, 128;
        /// Seconds between checkpoints.
        checkpoint_s: f64, 0.05..=86_400.0 [nothing] => 60.0;
    }
    constants {
        /// Levels that are active at the first step.
        start_levels: usize => 6, 6, 16;
        /// Share of the steps after which all levels are active; they are activated at equal
        /// intervals.
        all_levels: f64 => 0.25, 0.25, 0.0;
        /// Whether the color network also reads the hash features.
        color_skip: bool => true, true, false;
        /// Weight along a ray above which the color of a sample counts, which is that of TensoRF;
        /// 0: each sample has its color (published).
        min_weight: f32 => 1e-4, 1e-4, 0.0;
        /// Neighboring samples of a ray share a color, that of the heaviest, until their weights
        /// sum to this (published: each has its own). At 0.05 a draft evaluates 0.4 times the
        /// colors, takes seven eighths of the CPU time, and loses 0.02 to 0.07 dB.
        group_weight: f32 => 0.05, 0.0, 0.0;
        /// Half edge of the field's box.
        radius: f32 => 1.0, 1.0, 0.3;
        /// Initial surface.
        start: Start => Start::Hull, Start::Hull, Start::Sphere;
        /// Learning rate of the variance at its peak. Four times the published one: with local
        /// softness, skin may become as sharp as it is.
        lr_variance: f64 => 4e-3, 4e-3, 1e-3;
        /// Share of the steps over which the rates warm up linearly, from 1 % of the peak.
        warmup: f64 => 0.025;
        /// Learning rate at the end, as a share of the peak; exponential in between.
        lr_final: f64 => 0.05, 0.02, 0.1;
        /// Decoupled weight decay of the networks and the variance.
        weight_decay: f64 => 0.0, 0.0, 0.01;
        /// Decoupled weight decay of the hash table.
        table_decay: f64 => 0.0, 0.0, 0.01;
        /// Update only rows of the table that a sample touched.
        touched_rows: bool => true, true, false;
        /// Weight of the squared color error.
        rgb_mse: f64 => 10.0;
        /// Weight of the squared color error of single samples, Σ w ‖c − target‖² on rays that are
        /// all head. The blend alone leaves each sample's color free, and a mesh shows a single
        /// one.
        rgb_sample: f64 => 3.0, 3.0, 0.0;
        /// Scale of the sparsity term, mean exp(−scale · |sdf|).
        sparsity_scale: f64 => 50.0, 50.0, 1.0;
        /// Start value of the variance v; inv_s = exp(10 v).
        variance: f64 => 0.3;
        /// Share of the steps over which NeuS' cosine is annealed.
        anneal_end: f64 => 0.35, 0.35, 1.0;
        /// Rule that selects occupied cells.
        occupancy: OccupancyRule => OccupancyRule::Band, OccupancyRule::Band, OccupancyRule::Nerfacc;
        /// Share of the steps between updates of the occupancy grid (`band` rule).
        occupancy_every: f64 => 0.08;
        /// Half width of the band in units of 1 / local sharpness.
        band: f32 => 4.0, 4.0, 6.0;
        /// Share of the steps after which stereo points are searched for: the surface is accurate
        /// to a pixel or two by then.
        stereo_at: f64 => 0.6;
        /// March step in units of 1 / inv_s, the sharpest (`band` rule).
        march: f32 => 1.0;
        /// Shortest march step of the `band` rule. Drafts with 0.006 and 16,384 samples a step take
        /// a fifth less CPU time than with 0.004 and 24,576, and their views are as good.
        min_step: f32 => 0.006, 0.003, 0.004;
        /// Longest march step of the `band` rule.
        max_step: f32 => 0.05;
        /// Steps across the box's diagonal (`nerfacc` rule).
        samples_per_ray: usize => 1024;
        /// Shift the samples of each ray by a random fraction of a step.
        jitter: bool => true, true, false;
        /// Background while training.
        background: Background => Background::Random, Background::Random, Background::Black;
        /// Start with a gradient of length one. The published start is a unit sphere of the
        /// networks' own coordinates, and so has gradients of 1 / radius.
        unit_start: bool => true, true, false;
        /// Start the features that go to the color network apart from each other. The published
        /// start gives all thirteen the sdf's own weights, and color is learned late.
        spread_features: bool => true, true, false;
        /// Target color of a pixel with a soft mask.
        foreground: Foreground => Foreground::Estimated, Foreground::Estimated, Foreground::Photo;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use tiface_kernels::cpu::hash;
    use tiface_kernels::cpu::sdf::FieldShape;

    /// What follows from the published settings, as the published code's own printout and
    /// arithmetic have it.
    #[test]
    fn the_paper_preset_makes_the_published_grid_network_and_lattice() {
        let p = IfaceConfig::preset(Preset::Paper);
        let levels = hash::levels(p.levels, p.base_resolution, p.growth, p.log2_table);
        // 6,984,576 entries of two features; the first four levels are whole, all others 2^19
        // entries
        assert_eq!(hash::entries(&levels), 6_984_576);
        let side = |l: usize| levels[l].scale.ceil() as u32 + 1;
        assert_eq!([0, 1, 2, 3, 4, 8, 15].map(side), [32, 43, 56, 74, 98, 295, 2049]);
        // 3 + 32 inputs; geometry 35·64 + 64 + 64·13 + 13, color (64·32 + 64·64 + 3·64) of the
        // published 7168, whose last layer is padded to 16
        let shape =
            FieldShape { levels, radius: p.radius, active: 16, color_skip: p.color_skip, soften: 0.0 };
        assert_eq!(shape.layout().len(), 2240 + 64 + 832 + 13 + 7168 - 13 * 64);
        // the cube's edge by 1024, with nerfacc's 1.732: 1.732 · 0.6 / 1024
        let step = 1.732 * 2.0 * p.radius / p.samples_per_ray as f32;
        assert!((step - 0.001_014_843_75).abs() < 1e-9, "{step}");
        // the budget is what the first batch would have if no cell were empty
        assert_eq!(p.samples, p.rays * p.samples_per_ray);
        // inv_s starts at 20.0855
        assert!(((10.0 * p.variance).exp() - 20.0855).abs() < 1e-4);
        // nothing of what is not published
        assert_eq!((p.stereo, p.rgb_sample, p.soften, p.jitter), (0.0, 0.0, 1.0, false));
    }
}
