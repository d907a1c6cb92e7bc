//! The trained fields: the stages `baseline`, `tface` and `iface`, and the loading of their
//! results.
//!
//! The tiles of the training photographs that are excluded from training are chosen here too: the
//! ensemble's weights are fitted on them.

use super::session::Session;
use super::surface::{Fields, Radiance, Surface, march};
use crate::config::iface::FieldKind;
use crate::config::{Config, MaskUse, Preset, Stage};
use crate::ensemble::{self, Tile};
use crate::field::compute_device;
use crate::field::training::TrainingSession;
use crate::iface::{self, DensityField, IFace, SDF_TEST};
use crate::run::StageDir;
use crate::tface::{self, FieldMean, VM_TEST};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::cell::OnceCell;
use std::path::Path;
use tiface_base::geom::Camera;
use tiface_base::image::Gray;
use tiface_base::io::Limits;
use tiface_base::{Error, Result};
use tiface_capture::scene::Scene;
use tiface_capture::{Capture, LoadedView, Split, View};
use tiface_surface::render::RenderedView;

/// Trains or imports the field of a stage; training resumes from the last checkpoint.
pub(super) fn learn(
    stage: Stage,
    capture: &Capture,
    scene: &Scene,
    config: &Config,
    dir: &StageDir,
) -> Result<Value> {
    let session = TrainingSession {
        stage: stage.as_str(),
        seed: seed(stage, config),
        device: &config.device,
        dir: dir.folder(),
        identity: dir.identity(),
        monitor: dir.monitor(),
    };
    let (report, warnings) = train(stage, capture, scene, config, &session)?;
    warnings.iter().for_each(|w| dir.warn(w));
    Ok(report)
}

/// Returns the random seed of a stage. The published radiance fields use another seed than I-Face's
/// 42; a seed in the settings changes both.
pub(super) fn seed(stage: Stage, config: &Config) -> u64 {
    match config.preset {
        Preset::Paper if stage != Stage::Iface => config.seed ^ 42 ^ 20_211_202,
        _ => config.seed,
    }
}

/// Trains or imports the field of a stage in a session. Returns its report and warnings.
pub(super) fn train(
    stage: Stage,
    capture: &Capture,
    scene: &Scene,
    config: &Config,
    session: &TrainingSession,
) -> Result<(Value, Vec<String>)> {
    let hull = scene.hull.as_ref();
    if stage == Stage::Iface {
        let views = train_views(capture, scene, config, true)?;
        if config.iface.field == FieldKind::Density {
            let (_, report) = iface::train_density(&views, &config.iface, session)?;
            return Ok((json!(report), report.warnings));
        }
        let (_, report) = iface::train(&views, hull, &config.iface, session)?;
        return Ok((json!(report), report.warnings));
    }
    // `baseline` and `tface` run the same training with different settings
    let c = config.radiance(stage);
    if !c.import.is_empty() {
        tface::import(Path::new(&c.import), c.import_scale, &scene.scene_from_world, session)?;
        return Ok((json!({"imported": c.import}), Vec::new()));
    }
    // without masks the training must use neither the head's outline nor the hull carved from it;
    // only the box stays
    let masked = c.masks != MaskUse::None;
    let views = train_views(capture, scene, config, masked)?;
    let report = tface::train(views, scene.aabb, hull.filter(|_| masked), &c, session)?;
    Ok((json!(report), report.warnings))
}

/// Returns the training photographs, in the scene. Pixels of `capture.tiles` count as not valid.
pub(super) fn train_views(
    capture: &Capture,
    scene: &Scene,
    config: &Config,
    masked: bool,
) -> Result<Vec<LoadedView>> {
    let views = training_views(capture, scene, config)?.into_iter();
    let view = |view: LoadedView| LoadedView { mask: view.mask.filter(|_| masked), region: None, ..view };
    Ok(views.map(view).collect())
}

/// The trained fields of a run, each loaded when it is first used.
struct TrainedFields<'l> {
    session: &'l Session<'l>,
    iface: OnceCell<Box<dyn Surface>>,
    tface: OnceCell<FieldMean>,
    baseline: OnceCell<FieldMean>,
}

/// Returns the trained fields of a run; nothing is loaded yet.
pub(super) fn trained_fields<'l>(session: &'l Session<'l>) -> impl Fields {
    TrainedFields { session, iface: OnceCell::new(), tface: OnceCell::new(), baseline: OnceCell::new() }
}

impl Fields for TrainedFields<'_> {
    fn surface(&self) -> Result<&dyn Surface> {
        let Session { run, config, .. } = self.session;
        let load = || -> Result<Box<dyn Surface>> {
            let folder = run.path(Stage::Iface);
            if config.iface.field == FieldKind::Density {
                return Ok(Box::new(DensityField::load(&folder, &config.iface)?));
            }
            let scene = self.session.scene()?;
            let field = IFace::load(&folder, &config.iface, scene.hull.as_ref())?;
            let field = field.on(compute_device(&config.device, &SDF_TEST)?);
            Ok(Box::new(field))
        };
        once(&self.iface, load).map(|f| &**f)
    }

    fn radiance(&self, stage: Stage) -> Result<&dyn Radiance> {
        let Session { run, config, .. } = self.session;
        let load = || {
            let count = config.radiance(stage).learned();
            let field = FieldMean::load(stage.as_str(), &run.path(stage), count)?;
            let field = field.on(compute_device(&config.device, &VM_TEST)?);
            Ok(field)
        };
        let cell = if stage == Stage::Baseline { &self.baseline } else { &self.tface };
        once(cell, load).map(|f| f as &dyn Radiance)
    }

    fn warnings(&self) -> Vec<&str> {
        let radiance = [&self.baseline, &self.tface].into_iter().filter_map(|f| f.get()?.gpu_failure());
        radiance.chain(self.iface.get().and_then(|f| f.warning())).collect()
    }
}

/// A function that renders a field as a camera in the scene sees it.
pub(super) type FieldLook = Box<dyn Fn(&Camera) -> RenderedView>;

/// Returns a renderer for the newest checkpoint of a stage's field in a run, finished or not. If
/// several fields are trained one after the other, the first one is used.
pub(super) fn load_field(run: &Path, config: &Config, scene: &Scene, stage: Stage) -> Result<FieldLook> {
    let (folder, world_from_scene) = (run.join(stage.as_str()), scene.scene_from_world.inverse());
    if stage == Stage::Iface && config.iface.field == FieldKind::Density {
        let field = DensityField::load(&folder, &config.iface)?;
        return Ok(Box::new(move |camera| {
            march(camera, &world_from_scene, false, |rays| field.render(rays))
        }));
    }
    if stage == Stage::Iface {
        let field = IFace::load(&folder, &config.iface, scene.hull.as_ref())?;
        return Ok(Box::new(move |camera| {
            march(camera, &world_from_scene, false, |rays| field.render(rays))
        }));
    }
    let field = FieldMean::load(stage.as_str(), &folder, 1)?;
    Ok(Box::new(move |camera| {
        march(camera, &world_from_scene, false, |rays| field.render(rays, camera.forward()))
    }))
}

fn once<T>(cell: &OnceCell<T>, load: impl FnOnce() -> Result<T>) -> Result<&T> {
    if cell.get().is_none() {
        let _ = cell.set(load()?);
    }
    cell.get().ok_or_else(|| Error::cannot("no field", ""))
}

/// Returns the training views, each with its tiles.
pub(super) fn held_out_tiles<'c>(capture: &'c Capture, config: &Config) -> Vec<(&'c View, Vec<Tile>)> {
    let (share, seed) = (config.capture.tiles, config.seed);
    let tiles = |(i, v): (usize, &'c View)| {
        (v, ensemble::tiles(v.camera.width, v.camera.height, share, seed, i as u64))
    };
    capture.split(Split::Train).enumerate().map(tiles).collect()
}

/// Returns the training photographs, with their cameras in the scene. Pixels of `capture.tiles`
/// count as not valid.
pub(super) fn training_views(capture: &Capture, scene: &Scene, config: &Config) -> Result<Vec<LoadedView>> {
    let views = held_out_tiles(capture, config);
    views.par_iter().map(|(view, tiles)| training_view(view, tiles, scene)).collect()
}

/// Returns a training photograph, with its camera in the scene. Pixels of the tiles count as not
/// valid.
pub(super) fn training_view(view: &View, tiles: &[Tile], scene: &Scene) -> Result<LoadedView> {
    let mut loaded = view.load(&Limits::default())?;
    let (width, height) = (loaded.photo.width, loaded.photo.height);
    for tile in tiles {
        let all = || Gray { width, height, values: vec![255; loaded.photo.rgb.len()] };
        let values = &mut loaded.valid.get_or_insert_with(all).values;
        tile.pixels(width).for_each(|i| values[i] = 0);
    }
    loaded.camera = view.camera.transformed(&scene.scene_from_world);
    Ok(loaded)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_published_seeds_are_those_of_the_paper_alone() {
        let paper = Config::preset(Preset::Paper);
        assert_eq!(
            [Stage::Baseline, Stage::Tface, Stage::Iface].map(|s| seed(s, &paper)),
            [20_211_202, 20_211_202, 42]
        );
        let other = Config { seed: 43, ..paper };
        assert!(seed(Stage::Tface, &other) != 20_211_202 && seed(Stage::Iface, &other) == 43);
        assert_eq!(seed(Stage::Tface, &Config::preset(Preset::Draft)), 42);
    }
}
