//! The learned fields: the stages `baseline`, `tface` and `iface`, and their results when asked for.

use super::{Fields, Line, Radiance, Surface, bitmask, to_value};
use crate::capture::View;
use crate::capture::scene::Scene;
use crate::config::MaskUse;
use crate::ensemble::Tile;
use crate::field::pixels::TrainView;
use crate::iface::{self, IFace, IfaceError};
use crate::image::Gray;
use crate::io::Limits;
use crate::run::Done;
use crate::tface::{self, FieldMean, TfaceError};
use crate::{Error, ErrorKind, Result};
use rayon::prelude::*;
use serde_json::json;
use std::cell::OnceCell;
use std::path::Path;

impl Line<'_> {
    /// Stage `iface`: learns the field; goes on from its last checkpoint.
    pub fn iface(&self) -> Result<Done> {
        let plan = self.plan("iface");
        let identity = plan.fingerprint.digest();
        Ok(self.run.stage(plan, |stage| {
            let scene = self.scene_or_fail()?;
            let views = self.train_views(&scene, true)?;
            let (config, device) = (&self.config.iface, self.config.device.as_str());
            let hull = bitmask(&scene);
            let (folder, monitor) = (stage.folder(), stage.monitor());
            let seed = self.config.seed;
            let trained =
                iface::train(&views, hull.as_ref(), config, seed, device, folder, &identity, monitor);
            let (_, report) = trained.map_err(|e| self.iface_failure(e))?;
            report.warnings.iter().for_each(|w| stage.warn(w));
            Ok(to_value(&report))
        })?)
    }

    /// Stages `baseline` and `tface`: the same learning with other settings.
    pub fn radiance(&self, name: &'static str) -> Result<Done> {
        let plan = self.plan(name);
        let identity = plan.fingerprint.digest();
        Ok(self.run.stage(plan, |stage| {
            let scene = self.scene_or_fail()?;
            let config = self.vm(name);
            if !config.import.is_empty() {
                let (file, place) = (Path::new(&config.import), &scene.scene_from_world);
                tface::import_th(file, config.import_scale, place, stage.folder(), &identity)
                    .map_err(|e| self.tface_failure(name, e))?;
                return Ok(json!({"imported": config.import}));
            }
            // without masks nothing may know the head's outline nor what that carves; only the box stays
            let masked = config.masks != MaskUse::None;
            let views = self.train_views(&scene, masked)?;
            let hull = bitmask(&scene).filter(|_| masked);
            let (seed, device) = (self.config.seed, self.config.device.as_str());
            let (folder, monitor) = (stage.folder(), stage.monitor());
            let trained = tface::train(
                name,
                &views,
                scene.aabb,
                hull.as_ref(),
                &config,
                seed,
                device,
                folder,
                &identity,
                monitor,
            );
            let report = trained.map_err(|e| self.tface_failure(name, e))?;
            report.warnings.iter().for_each(|w| stage.warn(w));
            Ok(to_value(&report))
        })?)
    }

    /// The photographs that are learned from, in the scene. Pixels of `capture.tiles` count as not valid.
    pub(super) fn train_views(&self, scene: &Scene, masked: bool) -> Result<Vec<TrainView>> {
        let limits = Limits::default();
        let view = |(view, tiles): &(&View, Vec<Tile>)| {
            let loaded = view.load(&limits)?;
            let (width, height) = (loaded.photo.width, loaded.photo.height);
            let mut valid = loaded.valid;
            for tile in tiles {
                let all = || Gray { width, height, values: vec![255; loaded.photo.rgb.len()] };
                let values = &mut valid.get_or_insert_with(all).values;
                tile.pixels(width).for_each(|i| values[i] = 0);
            }
            Ok(TrainView {
                camera: view.camera.transformed(&scene.scene_from_world),
                photo: loaded.photo,
                mask: loaded.mask.filter(|_| masked),
                valid,
            })
        };
        self.tiles().par_iter().map(view).collect()
    }

    fn iface_failure(&self, e: IfaceError) -> Error {
        match e {
            IfaceError::Stopped { .. } => Error::stopped(e),
            IfaceError::Device(_) => device_failure(e),
            e => {
                let hint = e.hint().unwrap_or_default();
                Error::cannot(e, hint)
            }
        }
    }

    fn tface_failure(&self, stage: &'static str, e: TfaceError) -> Error {
        match e {
            TfaceError::Stopped { .. } => Error::stopped(e),
            TfaceError::Device(_) => device_failure(e),
            e => {
                let hint = e.hint(stage).unwrap_or_default();
                let settings = matches!(e, TfaceError::Settings { .. });
                let kind = if settings { ErrorKind::Usage } else { ErrorKind::Cannot };
                Error::new(kind, e).with_hint(hint)
            }
        }
    }
}

fn device_failure(e: impl std::error::Error + Send + Sync + 'static) -> Error {
    Error::usage(e, "choose another with `--device`")
}

/// The fields as they lie in the run.
pub struct Trained<'l> {
    line: &'l Line<'l>,
    iface: OnceCell<IFace>,
    tface: OnceCell<FieldMean>,
    baseline: OnceCell<FieldMean>,
}

impl<'l> Trained<'l> {
    /// Of a line; nothing is loaded yet.
    pub fn new(line: &'l Line<'l>) -> Trained<'l> {
        Trained { line, iface: OnceCell::new(), tface: OnceCell::new(), baseline: OnceCell::new() }
    }
}

impl Fields for Trained<'_> {
    fn surface(&self) -> Result<&dyn Surface> {
        let line = self.line;
        let load = || {
            let scene = line.scene_or_fail()?;
            let hull = bitmask(&scene);
            IFace::load(&line.run.path("iface"), &line.config.iface, hull.as_ref())
                .map_err(|e| line.iface_failure(e))
        };
        once(&self.iface, load).map(|f| f as &dyn Surface)
    }

    fn radiance(&self, stage: &'static str) -> Result<&dyn Radiance> {
        let line = self.line;
        let load = || {
            let (folder, count) = (line.run.path(stage), line.vm(stage).learned());
            FieldMean::load(&folder, count).map_err(|e| line.tface_failure(stage, e))
        };
        let cell = if stage == "baseline" { &self.baseline } else { &self.tface };
        once(cell, load).map(|f| f as &dyn Radiance)
    }
}

fn once<T>(cell: &OnceCell<T>, load: impl FnOnce() -> Result<T>) -> Result<&T> {
    if cell.get().is_none() {
        let _ = cell.set(load()?);
    }
    cell.get().ok_or_else(|| Error::cannot("no field", ""))
}
