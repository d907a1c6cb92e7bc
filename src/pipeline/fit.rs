//! What the blend learns from the views that were set aside: corrections of colours, then weights.
//!
//! Those views belong to the split `val`: no field learned from them, and they are no test views.

use super::ensemble::ensemble_failure;
use super::render::fit_name;
use super::{Line, capture_failure, pictures, to_value};
use crate::capture::scene::Scene;
use crate::capture::{Split, View};
use crate::config::{Background, Correct, Fit};
use crate::ensemble::{
    ColorFit, ColorMap, Correction, EnsembleError, Member, RegionFit, RegionWeights, Stiffness, Target,
};
use crate::image::{Gray, Image, Photo};
use crate::io::Limits;
use crate::run::{Failure, Stage};
use serde_json::{Map, Value, json};

/// A mask and a valid mask count from here on, as in `metrics`.
const INSIDE: u8 = 128;

/// Weights to blend with.
pub(super) enum Blend {
    /// One for each member.
    Global(Vec<f32>),
    /// They change over the head.
    Regions(RegionWeights),
}

/// What was fitted.
pub(super) struct Fitted {
    /// One for each member; empty where colours are not corrected.
    pub maps: Vec<ColorMap>,
    /// The weights; those given where they are not fitted.
    pub blend: Blend,
    /// All of it, for `weights.json`.
    pub record: Value,
}

impl Fitted {
    /// Without the nodes of a grid and the rows of a matrix.
    pub fn summary(&self) -> Value {
        let mut short = self.record.clone();
        if let Value::Object(map) = &mut short {
            map.remove("regions");
            map.remove("corrections");
        }
        short
    }
}

impl Line<'_> {
    /// Fits what is asked for; `None` where nothing is.
    pub(super) fn fit(&self, stage: &Stage, scene: &Scene) -> Result<Option<Fitted>, Failure> {
        let c = &self.config.ensemble;
        if !c.fits() {
            return Ok(None);
        }
        let views: Vec<&View> = self.capture.split(Split::Val).collect();
        let kind = match c.correct {
            Correct::None => None,
            Correct::Gain => Some(Correction::Gain),
            Correct::Affine => Some(Correction::Affine),
        };
        let (maps, corrections) = match kind {
            None => (Vec::new(), Value::Null),
            Some(kind) => self.fit_colors(stage, &views, kind)?,
        };
        let sums = self.fit_sums(&views, scene, &maps)?;
        let mut all = RegionFit::new(c.members.len(), c.regions).map_err(ensemble_failure)?;
        sums.iter().try_for_each(|s| all.merge(s)).map_err(ensemble_failure)?;
        let given = self.given();
        let (blend, mut record) = self.solve(&all, &sums, &given).map_err(ensemble_failure)?;
        record.insert("views".into(), json!(views.iter().map(|v| &v.name).collect::<Vec<_>>()));
        if kind.is_some() {
            record.insert("correct".into(), json!(c.correct));
            record.insert("corrections".into(), corrections);
        }
        Ok(Some(Fitted { maps, blend, record: Value::Object(record) }))
    }

    /// The weights, and how they compare on the views they were fitted on and on views left out.
    fn solve(
        &self,
        all: &RegionFit,
        sums: &[RegionFit],
        given: &[f32],
    ) -> Result<(Blend, Map<String, Value>), EnsembleError> {
        let kind = self.config.ensemble.fit;
        let mut record = Map::new();
        record.insert("fit".into(), json!(kind));
        record.insert("psnr_given".into(), json!(all.global().psnr(given)?));
        if kind == Fit::None {
            return Ok((Blend::Global(given.to_vec()), record));
        }
        let global = all.global().solve()?;
        record.insert("weights".into(), json!(global));
        record.insert("psnr_global".into(), json!(all.global().psnr(&global)?));
        // judged by views that had no say; two are the least for that
        let left_out = |stiffness| match sums.len() {
            0 | 1 => Ok(None),
            _ => RegionFit::leave_one_out(sums, stiffness),
        };
        record.insert("psnr_global_left_out".into(), json!(left_out(None)?));
        if kind == Fit::Global {
            return Ok((Blend::Global(global), record));
        }
        let regions = all.solve(&global, Stiffness::default())?;
        record.insert("psnr_regions".into(), json!(all.psnr(&regions)?));
        record.insert("psnr_regions_left_out".into(), json!(left_out(Some(Stiffness::default()))?));
        record.insert("regions".into(), to_value(&regions));
        Ok((Blend::Regions(regions), record))
    }

    /// A correction for each member.
    fn fit_colors(
        &self,
        stage: &Stage,
        views: &[&View],
        kind: Correction,
    ) -> Result<(Vec<ColorMap>, Value), Failure> {
        let names = self.members();
        let mut fits = vec![ColorFit::default(); names.len()];
        for view in views {
            let (photo, weight) = target(view)?;
            for (k, image) in self.member_views(&fit_name(&view.name))?.iter().enumerate() {
                let member = Member { name: names[k], image, masked: true };
                fits[k].add(&member, &Target { photo: &photo, weight: &weight }).map_err(ensemble_failure)?;
            }
            self.stop_here()?;
        }
        let mut told = Map::new();
        let mut maps = Vec::new();
        for (fit, name) in fits.iter().zip(names) {
            let map = match fit.solve(kind) {
                Err(EnsembleError::NoPixels) => {
                    stage.warn(&format!("member `{name}` is nowhere solid: its colours stay as they are"));
                    ColorMap::identity()
                }
                map => map.map_err(ensemble_failure)?,
            };
            let gain = fit.gain(&map);
            told.insert(
                name.into(),
                json!({"rows": map.rows, "psnr": gain.before, "psnr_corrected": gain.after}),
            );
            maps.push(map);
        }
        Ok((maps, Value::Object(told)))
    }

    /// The sums of every view.
    fn fit_sums(&self, views: &[&View], scene: &Scene, maps: &[ColorMap]) -> Result<Vec<RegionFit>, Failure> {
        let c = &self.config.ensemble;
        let world_from_scene = scene.scene_from_world.inverse();
        let mut sums = Vec::new();
        for view in views {
            let mut images = self.member_views(&fit_name(&view.name))?;
            for ((map, image), name) in maps.iter().zip(&mut images).zip(self.members()) {
                map.apply(name, image).map_err(ensemble_failure)?;
            }
            let (photo, weight) = target(view)?;
            let camera = view.camera.transformed(&scene.scene_from_world);
            let points = match c.fit {
                Fit::Regions => self.points(&fit_name(&view.name), &camera, &world_from_scene)?,
                // no pixel has a point then, and all of them count for the global weights
                _ => nowhere(camera.width, camera.height),
            };
            let mut sum = RegionFit::new(c.members.len(), c.regions).map_err(ensemble_failure)?;
            let members = self.checked(&images)?;
            sum.add(&members, &points, &Target { photo: &photo, weight: &weight })
                .map_err(ensemble_failure)?;
            sums.push(sum);
            self.stop_here()?;
        }
        Ok(sums)
    }
}

fn nowhere(width: u32, height: u32) -> Image {
    let mut points = Image::new(width, height, 3);
    points.data.fill(f32::NAN);
    points
}

/// What the members should have shown of a view, and where that counts.
fn target(view: &View) -> Result<(Photo, Gray), Failure> {
    let loaded = view.load(&Limits::default()).map_err(capture_failure)?;
    let photo = pictures::expected(&loaded.photo, loaded.mask.as_ref(), Background::None);
    let (width, height) = (photo.width, photo.height);
    let inside = |of: &Option<Gray>, i: usize| of.as_ref().is_none_or(|m| m.values[i] >= INSIDE);
    let counts = |i: usize| if inside(&loaded.mask, i) && inside(&loaded.valid, i) { 255 } else { 0 };
    let values = (0..photo.rgb.len()).map(counts).collect();
    Ok((photo, Gray { width, height, values }))
}
