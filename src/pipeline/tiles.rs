//! The squares of the training photographs that nothing learns from: the weights of the blend are fitted there.

use crate::Result;
use crate::capture::scene::Scene;
use crate::capture::{Capture, LoadedView, Split, View};
use crate::config::Config;
use crate::ensemble::{self, Tile};
use crate::geom::Camera;
use crate::image::Gray;
use crate::io::Limits;
use rayon::prelude::*;

/// The training views, each with its squares.
pub(super) fn held_out_tiles<'c>(capture: &'c Capture, config: &Config) -> Vec<(&'c View, Vec<Tile>)> {
    let (share, seed) = (config.capture.tiles, config.seed);
    let tiles = |(i, v): (usize, &'c View)| {
        (v, ensemble::tiles(v.camera.width, v.camera.height, share, seed, i as u64))
    };
    capture.split(Split::Train).enumerate().map(tiles).collect()
}

/// The photographs that are learned from, with their cameras in the scene. Pixels of `capture.tiles` count as not
/// valid.
pub(super) fn training_views(
    capture: &Capture,
    scene: &Scene,
    config: &Config,
) -> Result<Vec<(Camera, LoadedView)>> {
    let view = |(view, tiles): &(&View, Vec<Tile>)| {
        let mut loaded = view.load(&Limits::default())?;
        let (width, height) = (loaded.photo.width, loaded.photo.height);
        for tile in tiles {
            let all = || Gray { width, height, values: vec![255; loaded.photo.rgb.len()] };
            let values = &mut loaded.valid.get_or_insert_with(all).values;
            tile.pixels(width).for_each(|i| values[i] = 0);
        }
        Ok((view.camera.transformed(&scene.scene_from_world), loaded))
    };
    held_out_tiles(capture, config).par_iter().map(view).collect()
}
