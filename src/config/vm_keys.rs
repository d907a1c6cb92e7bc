//! Documentation and ranges of `[baseline]` and `[tface]`.

use super::Key;

pub(super) const KEYS: &[Key] = &[
    Key::word("import", "A published .th checkpoint to take instead of training; empty to train."),
    Key::number(
        "import_scale",
        "Length of a dataset unit in the imported checkpoint's world (published: 1 / 0.3).",
        1e-6,
        1e6,
    ),
    Key::number(
        "fields",
        "Fields learned one after the other from different random numbers; their mean is what is seen. Only one \
         where import names a file.",
        1.0,
        16.0,
    ),
    Key::number("steps", "Optimiser steps of each field.", 1.0, 1e7),
    Key::number("rays", "Rays per step.", 1.0, 1_048_576.0),
    Key::word("masks", "What masks do to the photographs: none, binary (a little head is head) or soft."),
    Key::word(
        "foreground",
        "Soft pixels over black: photo (alpha times it), or estimated (stage light taken out).",
    ),
    Key::word(
        "mask_loss",
        "How opacity is held to the mask: none, l2 (opacity² of background rays) or ce (cross entropy).",
    ),
    Key::number("mask_weight", "Weight of the mask loss.", 0.0, 1e6),
    Key::word(
        "background",
        "Behind the head while training: random, black, or reference (published: white in half of the batches, \
         against a black target).",
    ),
    Key::word("start", "Cells that may hold anything at first: hull (the masks' visual hull) or box."),
    Key::word("whole_frame", "Draw any pixel of the frames, not only those near the masks: true or false."),
    Key::number("voxels_start", "Voxels of the box at the start.", 8.0, 1e12),
    Key::number("voxels_final", "Voxels of the box after the last upsampling.", 8.0, 1e12),
    Key::number("upsample_steps", "Steps after which the grids are made finer, a rising list.", 0.0, 1e7),
    Key::number("mask_steps", "Steps after which the alpha mask is rebuilt, a rising list.", 0.0, 1e7),
    Key::number("mask_threshold", "Smallest alpha of a grid step kept in the alpha mask.", 0.0, 1.0),
    Key::number("density_rank", "Channels of the density's planes xy, xz, yz.", 0.0, 1024.0),
    Key::number("color_rank", "Channels of the appearance's planes xy, xz, yz.", 0.0, 1024.0),
    Key::number("features", "Outputs of the basis matrix.", 1.0, 512.0),
    Key::number("hidden", "Width of the decoder's hidden layers, a multiple of 8.", 8.0, 1024.0),
    Key::number("view_frequencies", "Frequencies of the view direction's encoding.", 0.0, 16.0),
    Key::number("feature_frequencies", "Frequencies of the features' encoding.", 0.0, 16.0),
    Key::word("activation", "From a feature to a density: relu or softplus."),
    Key::number("density_shift", "Added to the feature before softplus.", -1e3, 1e3),
    Key::number("distance_scale", "Optical length of a scene unit at density 1.", 1e-6, 1e6),
    Key::number("step_ratio", "March step as a share of the distance of vertices.", 1e-2, 100.0),
    Key::number("weight_threshold", "Colour is asked only of samples with more weight.", 0.0, 1.0),
    Key::number("stop", "A ray ends where less than this of its light is left (published: 0).", 0.0, 1.0),
    Key::number("lr_grid", "Learning rate of planes and lines.", 0.0, 1.0),
    Key::number("lr_network", "Learning rate of the basis matrix and the decoder.", 0.0, 1.0),
    Key::number("lr_final", "Learning rate at the end without resets, as a share of the first.", 1e-9, 1.0),
    Key::word("lr_reset", "Start the learning rates again at every upsampling: true or false."),
    Key::number("tv_density", "Weight of the density planes' total variation, times 0.01.", 0.0, 1e6),
    Key::number("tv_color", "Weight of the appearance planes' total variation, times 0.01.", 0.0, 1e6),
    Key::number("l1_start", "Weight of the density's L1 norm until the first alpha mask.", 0.0, 1e6),
    Key::number("l1_rest", "Weight of the density's L1 norm afterwards.", 0.0, 1e6),
    Key::number("ortho", "Weight of the lines' orthogonality.", 0.0, 1e6),
    Key::number("checkpoint_s", "Seconds between checkpoints.", 0.05, 86_400.0),
];
