//! The squares of the training photographs that no field learns from: the weights of the blend are fitted there.

use crate::capture::{Capture, Split, View};
use crate::config::Config;
use crate::ensemble::{self, Tile};

/// The training views, each with its squares.
pub(super) fn held_out_tiles<'c>(capture: &'c Capture, config: &Config) -> Vec<(&'c View, Vec<Tile>)> {
    let (share, seed) = (config.capture.tiles, config.seed);
    let tiles = |(i, v): (usize, &'c View)| {
        (v, ensemble::tiles(v.camera.width, v.camera.height, share, seed, i as u64))
    };
    capture.split(Split::Train).enumerate().map(tiles).collect()
}
