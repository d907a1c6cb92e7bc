//! Documentation and ranges of `[iface]`, and which of its recipes a preset means.

use super::iface::IfaceConfig;
use super::{Key, Preset};

pub(super) const KEYS: &[Key] = &[
    Key::number("steps", "Optimiser steps.", 1.0, 1e7),
    Key::number("rays", "Rays per step at the start.", 1.0, 1_048_576.0),
    Key::number(
        "max_rays",
        "Upper bound of rays per step; the count adapts to the sample budget.",
        1.0,
        1_048_576.0,
    ),
    Key::number("samples", "Samples along rays that a step aims for.", 64.0, 1e8),
    Key::number("levels", "Levels of the hash grid.", 1.0, 32.0),
    Key::number("base_resolution", "Cells per axis of the coarsest level.", 2.0, 1024.0),
    Key::number("growth", "Growth of the resolution from level to level.", 1.0, 4.0),
    Key::number("log2_table", "Binary logarithm of a level's largest table.", 4.0, 24.0),
    Key::number("start_levels", "Levels that take part from the first step.", 1.0, 32.0),
    Key::number("level_every", "One more level every so many steps; 0 takes all at once.", 0.0, 1e7),
    Key::word(
        "color_skip",
        "The colour network reads the hash features too, true or false (published: false).",
    ),
    Key::number(
        "soften",
        "How many times softer than its sharpest the surface may be where that pays, as in hair; 1 is one sharpness \
         everywhere (published).",
        1.0,
        1e3,
    ),
    Key::number("radius", "Half edge of the field's box.", 1e-3, 1e3),
    Key::word("start", "Where the surface starts: hull (the masks' visual hull) or sphere."),
    Key::number("lr_table", "Learning rate of the hash table at its peak.", 0.0, 1.0),
    Key::number("lr_network", "Learning rate of the networks at its peak.", 0.0, 1.0),
    Key::number("lr_variance", "Learning rate of the variance at its peak.", 0.0, 1.0),
    Key::number("warmup", "Steps of linear warm-up from 1 % of the peak.", 0.0, 1e7),
    Key::number("lr_final", "Learning rate at the end, as a share of the peak.", 1e-9, 1.0),
    Key::number("weight_decay", "Decoupled weight decay of the networks and the variance.", 0.0, 1.0),
    Key::number("table_decay", "Decoupled weight decay of the hash table.", 0.0, 1.0),
    Key::word("touched_rows", "Update only rows of the table that a sample touched: true or false."),
    Key::number("rgb_mse", "Weight of the squared colour error.", 0.0, 1e6),
    Key::number(
        "rgb_sample",
        "Weight of the squared colour error of single samples (published: 0).",
        0.0,
        1e6,
    ),
    Key::number("rgb_l1", "Weight of the absolute colour error.", 0.0, 1e6),
    Key::number("mask", "Weight of the mask's binary cross entropy.", 0.0, 1e6),
    Key::number("eikonal", "Weight of the loss that keeps the gradient's length at 1.", 0.0, 1e6),
    Key::number("sparsity", "Weight of the sparsity term, the mean of exp(-scale * |sdf|).", 0.0, 1e6),
    Key::number("sparsity_scale", "Scale of the sparsity term.", 0.0, 1e6),
    Key::number("variance", "Start value of the variance v; the sharpness inv_s is exp(10 v).", 0.0, 1.0),
    Key::number("anneal_end", "Steps over which NeuS' cosine is annealed; 0 does not.", 0.0, 1e7),
    Key::word(
        "occupancy",
        "Which cells are marched through: band (around the zero set) or nerfacc (the published rule).",
    ),
    Key::number("occupancy_resolution", "Cells per axis of the occupancy grid.", 8.0, 1024.0),
    Key::number("occupancy_every", "Steps between updates of the occupancy grid.", 1.0, 1e7),
    Key::number("band", "Half width of the band in units of 1 / local sharpness.", 0.1, 1e3),
    Key::number("march", "March step in units of 1 / inv_s, the sharpest (band rule).", 1e-3, 1e3),
    Key::number("min_step", "Shortest march step of the band rule.", 1e-6, 10.0),
    Key::number("max_step", "Longest march step of the band rule.", 1e-6, 10.0),
    Key::number("samples_per_ray", "Steps across the box's diagonal (nerfacc rule).", 1.0, 65_536.0),
    Key::word("jitter", "Shift each ray's samples by a random part of a step: true or false."),
    Key::word("unit_start", "Start with gradients of length one (published: 1 / radius)."),
    Key::word("spread_features", "Start the colour features apart from each other (published: all alike)."),
    Key::word("background", "Behind the head while training: black, or random (one colour per ray)."),
    Key::word(
        "foreground",
        "Soft pixels over black: photo (alpha times it), or estimated (stage light taken out).",
    ),
    Key::number("checkpoint_s", "Seconds between checkpoints.", 0.05, 86_400.0),
];

impl IfaceConfig {
    /// The values a preset starts with.
    pub fn preset(preset: Preset) -> IfaceConfig {
        match preset {
            Preset::Draft => IfaceConfig::draft(),
            Preset::Standard => IfaceConfig::standard(),
            Preset::Paper => IfaceConfig::paper(),
        }
    }
}
