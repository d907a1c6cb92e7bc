//! The weights of the blend, fitted on the squares of the training photographs that no field learned from.

use super::{Fields, Line, pictures};
use crate::Result;
use crate::capture::scene::Scene;
use crate::capture::{Split, View};
use crate::config::{Background, called};
use crate::ensemble::{self, EnsembleError, Fit, Target, Tile};
use crate::image::{Gray, Image, Photo};
use crate::io::Limits;
use crate::run::Stage;
use serde_json::{Value, json};

/// A mask and a valid mask count from here on, as in `metrics`.
const INSIDE: u8 = 128;

impl Line<'_> {
    /// The training views, each with the squares that no field learns from.
    pub(super) fn tiles(&self) -> Vec<(&View, Vec<Tile>)> {
        let (share, seed) = (self.config.capture.tiles, self.config.seed);
        let train = self.capture.split(Split::Train).enumerate();
        train
            .map(|(i, v)| (v, ensemble::tiles(v.camera.width, v.camera.height, share, seed, i as u64)))
            .collect()
    }

    /// Weights for the members, and what is known of them; alike where no tile shows the head.
    ///
    /// Only the tiles are rendered: a few percent of the pixels of the training views.
    pub(super) fn fit(&self, stage: &Stage, scene: &Scene, fields: &dyn Fields) -> Result<(Vec<f32>, Value)> {
        let methods = &self.config.ensemble.members;
        for method in methods {
            let (name, imports) = (method.stage(), &self.imports);
            if imports.iter().any(|(stage, _)| *stage == name) {
                stage.warn(&format!(
                    "`{name}` was not learned here and may know the pixels that weights are fitted on: its \
                     weight may be too large; ensemble.weights gives others"
                ));
            }
        }
        let meshes = self.meshes(methods)?;
        let eye = self.eye(scene, fields, &meshes, self.config.render.samples);
        let mut sums = Vec::new();
        for (view, tiles) in self.tiles() {
            let (photo, weight) = target(view)?;
            let camera = view.camera.transformed(&scene.scene_from_world);
            let mut sum = Fit::new(methods.len())?;
            for tile in tiles {
                let (photo, weight) = cut_out(&photo, &weight, tile);
                if weight.values.iter().all(|w| *w == 0) {
                    continue;
                }
                let part = camera.part(tile.x, tile.y, tile.side, tile.side);
                let mut images: Vec<Image> = Vec::new();
                for method in methods {
                    let shown = eye.view(*method, &part)?;
                    self.stop_here()?; // what it holds then is not whole
                    let empty = || Image::new(tile.side, tile.side, 4);
                    images.push(shown.map_or_else(empty, |view| view.color));
                }
                let target = Target { photo: &photo, weight: &weight };
                sum.add(&self.checked(&images)?, &target)?;
            }
            sums.push(sum);
        }
        let weights = match ensemble::weigh(&sums) {
            Err(EnsembleError::NoPixels) => {
                stage.warn("no square of capture.tiles shows the head: the members are blended alike");
                return Ok((self.shares(), Value::Null));
            }
            weights => weights?,
        };
        let mut all = Fit::new(methods.len())?;
        sums.iter().try_for_each(|sum| all.merge(sum))?;
        let psnr = |weights: &[f32]| all.psnr(weights);
        let mut alone = serde_json::Map::new();
        for (k, name) in self.members().into_iter().enumerate() {
            let one: Vec<f32> = (0..methods.len()).map(|l| if l == k { 1.0 } else { 0.0 }).collect();
            alone.insert(name.into(), json!(psnr(&one)?));
        }
        let each = self.members().into_iter().zip(&weights);
        let told: Vec<String> = each.map(|(name, w)| format!("{} {w:.3}", called(name))).collect();
        stage.note(&format!("fitted weights: {}", told.join(", ")));
        let record = json!({"pixels": all.pixels(), "psnr": psnr(&weights)?, "psnr_alone": alone});
        Ok((weights, record))
    }
}

/// What the members should have shown of a view, and where that counts.
fn target(view: &View) -> Result<(Photo, Gray)> {
    let loaded = view.load(&Limits::default())?;
    let photo = pictures::expected(&loaded.photo, loaded.mask.as_ref(), Background::None);
    let (width, height) = (photo.width, photo.height);
    let inside = |of: &Option<Gray>, i: usize| of.as_ref().is_none_or(|m| m.values[i] >= INSIDE);
    let counts = |i: usize| if inside(&loaded.mask, i) && inside(&loaded.valid, i) { 255 } else { 0 };
    let values = (0..photo.rgb.len()).map(counts).collect();
    Ok((photo, Gray { width, height, values }))
}

/// What of them is in a tile.
fn cut_out(photo: &Photo, weight: &Gray, tile: Tile) -> (Photo, Gray) {
    let (width, height) = (tile.side, tile.side);
    let rgb = tile.pixels(photo.width).map(|i| photo.rgb[i]).collect();
    let values = tile.pixels(weight.width).map(|i| weight.values[i]).collect();
    (Photo { width, height, rgb, alpha: None }, Gray { width, height, values })
}
