//! A capture, its configuration and its run folder, which every stage works on.

use super::cameras::CameraCheck;
use super::clean::require_float_views;
use super::exposure::ExposureCheck;
use super::glare;
use super::inputs::{Inputs, missing_capture};
use super::path::CameraPath;
use super::{mask, scene_file};
use crate::config::{Config, RenderConfig, Stage};
use crate::metrics::Lpips;
use crate::run::Run;
use std::borrow::Cow;
use std::fmt::Display;
use std::io::ErrorKind::NotFound;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};
use tiface_capture::scene::{Scene, SceneBox};
use tiface_capture::{Capture, MaskReading, Split, View, ViewMask};
use tiface_surface::render::Residuals;

/// A capture, its configuration and its run folder.
pub struct Session<'a> {
    pub(super) capture: Capture,
    /// The capture as the stage `mask` read its masks, refined its poses, evened out its exposures
    /// and took glare out, once it is used.
    refined: OnceLock<Capture>,
    /// What the mesh misses of the training photographs, from the stage `render` to the blend.
    residuals: Mutex<Option<Arc<Residuals>>>,
    pub(super) config: &'a Config,
    pub(super) run: &'a Run,
    /// Inputs of the fingerprints of the stages besides the settings.
    pub(super) inputs: Inputs,
    /// The camera path that `render` shows instead of the held-out views.
    pub(super) path: Option<CameraPath>,
}

/// Folder of the demo's photographs, in its run.
pub const DEMO_CAPTURE: &str = "capture";

impl<'a> Session<'a> {
    /// Opens the capture and reads every byte of it once to compute its digest. Nothing is written.
    ///
    /// The capture of a finished run may have been moved. Its cameras are then restored from the
    /// run, and no stage can be worked on ([`Session::remember`]).
    pub fn open(config: &'a Config, run: &'a Run) -> Result<Session<'a>> {
        check_feasible(config)?;
        let (mut capture, inputs) = Inputs::read(config, run)?;
        capture.warnings.iter().for_each(|warning| run.warn("capture", warning));
        if inputs.clicks.is_some() {
            // later stages read the masks that the stage `mask` makes
            for view in &mut capture.views {
                view.mask = ViewMask::File(mask::mask_file(&run.path(Stage::Mask), &view.name));
                view.mask_turn = None;
                // whatever the capture's own masks are drawn in
                view.mask_reading = MaskReading::White;
            }
        }
        if is_demo(config, run) {
            capture.name = "demo".into();
        }
        Ok(Session {
            capture,
            refined: OnceLock::new(),
            residuals: Mutex::default(),
            config,
            run,
            inputs,
            path: None,
        })
    }

    /// Returns a session whose stage `render` makes the views of `render.cameras` in a folder of
    /// their own instead of the evaluation's views; a file of cameras is read here. For `test` the
    /// session is returned unchanged.
    pub fn with_camera_path(self, render: RenderConfig) -> Result<Session<'a>> {
        let path = CameraPath::new(render, &self.capture)?;
        Ok(Session { path, ..self })
    }

    /// Returns the capture with its mask files read as the stage `mask` found that they are to be
    /// read.
    pub(super) fn read_capture(&self) -> Result<Cow<'_, Capture>> {
        let mut capture = Cow::Borrowed(&self.capture);
        let applied = mask::apply_reading(&self.run.path(Stage::Mask), &mut capture);
        applied.map_err(|e| unusable(e, Stage::Mask))?;
        Ok(capture)
    }

    /// Returns the capture as the metrics use it: each view with the capture's own mask, if it has
    /// one. Own masks that do not say what is head are left out, with a warning.
    pub(super) fn evaluation_capture(&self) -> Result<Capture> {
        let mut capture = self.read_capture()?.into_owned();
        let Some(own) = &self.inputs.own_masks else { return Ok(capture) };
        let masked = |(view, (own, turn)): (&View, (&ViewMask, &Option<u8>))| {
            (*own != ViewMask::None).then(|| View { mask: own.clone(), mask_turn: *turn, ..view.clone() })
        };
        let views = capture.views.iter().zip(own.masks.iter().zip(&own.turns)).filter_map(masked).collect();
        let mut evaluated = Capture { views, ..capture.clone() };
        if let Err(e) = evaluated.settle_masks(&self.config.mask.head, &Limits::default()) {
            let text = format!("the capture's own masks are not used for the figures: {e}; {}", e.hint());
            self.run.warn(Stage::Metrics.as_str(), &text);
            return Ok(capture);
        }
        let has_own = capture.views.iter_mut().zip(&own.masks).filter(|(_, own)| **own != ViewMask::None);
        has_own.zip(evaluated.views).for_each(|((view, _), own)| *view = own);
        Ok(capture)
    }

    /// Returns the source of the masks that the figures of held-out views are restricted to:
    /// `capture`, `run` (this run made at least one of them, so other runs may evaluate
    /// differently) or `none`.
    pub(super) fn mask_source(&self, evaluated: &Capture) -> &'static str {
        let masks = self.capture.views.iter().zip(&evaluated.views);
        let all: Vec<_> = masks.map(|(view, evaluated)| (view.split, &view.mask, &evaluated.mask)).collect();
        let held_out: Vec<_> = all.iter().copied().filter(|(split, ..)| *split != Split::Train).collect();
        let masks = if held_out.is_empty() { all } else { held_out };
        match &self.inputs.own_masks {
            _ if masks.iter().all(|(_, _, evaluated)| **evaluated == ViewMask::None) => "none",
            Some(_) if !masks.iter().all(|(_, made, evaluated)| made != evaluated) => "run",
            _ => "capture",
        }
    }

    /// Returns the capture.
    pub fn capture(&self) -> &Capture {
        &self.capture
    }

    /// Returns the configuration.
    pub fn config(&self) -> &Config {
        self.config
    }

    /// Returns what the stage `mask` measured of the cameras.
    pub(super) fn camera_check(&self) -> Result<Option<CameraCheck>> {
        CameraCheck::read(&self.run.path(Stage::Mask)).map_err(|e| unusable(e, Stage::Mask))
    }

    /// Returns the exposures that the stage `mask` measured.
    pub(super) fn exposure(&self) -> Result<Option<ExposureCheck>> {
        ExposureCheck::read(&self.run.path(Stage::Mask)).map_err(|e| unusable(e, Stage::Mask))
    }

    /// Keeps the residuals of the held-out views for the blend's members, which have the same.
    pub(super) fn keep_residuals(&self, residuals: Option<Arc<Residuals>>) {
        *self.residuals.lock().unwrap_or_else(PoisonError::into_inner) = residuals;
    }

    /// Returns the residuals of the held-out views if this process has measured them, and forgets
    /// them.
    pub(super) fn take_residuals(&self) -> Option<Arc<Residuals>> {
        self.residuals.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Returns the capture with the poses that the stage `mask` refined, the exposures that it
    /// evened out and the glare that it found, for the stages after it.
    pub(super) fn refined_capture(&self) -> Result<&Capture> {
        if let Some(capture) = self.refined.get() {
            return Ok(capture);
        }
        let mut capture = self.read_capture()?.into_owned();
        self.camera_check()?.iter().for_each(|check| check.apply(&mut capture));
        self.exposure()?.iter().for_each(|check| check.apply(&mut capture));
        let found = glare::read(&self.run.path(Stage::Mask)).map_err(|e| unusable(e, Stage::Mask))?;
        found.into_iter().for_each(|found| glare::apply(found, &mut capture));
        Ok(self.refined.get_or_init(|| capture))
    }

    /// Returns the box and hull that the stage `mask` found.
    pub fn scene(&self) -> Result<Scene> {
        scene_file::read_scene(&self.run.path("mask/scene.json")).map_err(|e| unusable(e, Stage::Mask))
    }

    /// Writes `cameras.json`, if the photographs can be opened.
    pub(super) fn write_cameras(&self, idle: bool) -> Result<()> {
        if self.inputs.missing_capture.is_some() {
            return Ok(());
        }
        let scene = self.scene().map_err(|e| e.within("stage `mask`"))?;
        let (check, exposure) = (self.camera_check()?, self.exposure()?);
        let capture = self.read_capture()?;
        let cameras = scene_file::cameras_json(&capture, &scene, check.as_ref(), exposure.as_ref());
        self.write("cameras.json", &cameras, idle)
    }

    /// Returns how the views of the stage `render` are made: with the settings of the camera path,
    /// if the session has one.
    pub(super) fn render_config(&self) -> &RenderConfig {
        self.path.as_ref().map_or(&self.config.render, |path| &path.render)
    }

    /// Fails if one of these stages cannot be worked on, because an input of it is missing or was
    /// removed from the run.
    pub(super) fn require_work(&self, stages: &[Stage]) -> Result<()> {
        require_float_views(self.run, stages)?;
        self.require_inputs(stages)
    }

    /// Fails if an input of one of these stages is missing: photographs, checkpoints, networks or
    /// the device.
    pub(super) fn require_inputs(&self, stages: &[Stage]) -> Result<()> {
        if let Some(problem) = self.inputs.missing_capture.as_ref().filter(|_| !stages.is_empty()) {
            return Err(missing_capture(problem));
        }
        let mut lost = self
            .inputs
            .imports
            .iter()
            .filter(|i| stages.contains(&i.stage))
            .filter_map(|i| i.missing.clone());
        lost.next().map_or(Ok(()), Err)?;
        if stages.contains(&Stage::Metrics) {
            Lpips::open(self.config.metrics.lpips.as_ref(), self.config.mask.memory_gib)?;
        }
        #[cfg(not(feature = "matting"))]
        if self.inputs.clicks.is_some() && stages.contains(&Stage::Mask) {
            crate::mask::networks::Networks::open(&self.config.mask)?;
        }
        if !stages.iter().any(|stage| stage.uses_device()) {
            return Ok(());
        }
        let Some(device) = crate::field::require_device(&self.config.device)? else { return Ok(()) };
        // masks that are still to be made give another box than those of an earlier attempt
        let scene = if stages.contains(&Stage::Mask) { None } else { self.scene().ok() };
        let bounds = scene.map(|scene| scene.aabb);
        stages.iter().try_for_each(|&stage| match stage {
            Stage::Iface => crate::iface::require_fit(&self.config.iface, &device),
            Stage::Baseline | Stage::Tface => {
                crate::tface::require_fit(stage.as_str(), &self.config.radiance(stage), bounds, &device)
            }
            _ => Ok(()),
        })
    }

    /// Writes a file of the run itself. A write error is ignored if no work is left, because a
    /// finished run may lie on a read-only disk.
    pub(super) fn write(&self, name: &str, bytes: &[u8], idle: bool) -> Result<()> {
        match self.run.write(name, bytes) {
            Err(e) if idle => {
                self.run.warn("run", &format!("{e}; all requested stages are done"));
                Ok(())
            }
            other => other,
        }
    }
}

/// Refuses settings that contradict each other, and an invalid box.
pub fn check_feasible(config: &Config) -> Result<()> {
    if let Some((key, problem, hint)) = config.mesh.problem().or_else(|| config.mask.problem()) {
        return Err(Error::usage(format!("`{key}` {problem}"), hint));
    }
    SceneBox::parse(&config.capture.r#box)?;
    Ok(())
}

/// Returns whether the capture is the synthetic head of a demo, whose surface is known.
pub(super) fn is_demo(config: &Config, run: &Run) -> bool {
    io::real_path(&run.path(DEMO_CAPTURE)).is_ok_and(|made| made == config.capture.path)
}

/// Refuses a device that this build or this machine does not have, or that another process uses.
/// Finished stages need no device, so this is checked only if a stage that computes on it has work
/// left.
pub fn require_device(config: &Config) -> Result<()> {
    crate::field::require_device(&config.device).map(drop)
}

/// Returns the error for an unusable file that a stage of this run made: the hint is to make it
/// again.
pub(super) fn unusable(e: io::ReadError, stage: impl Display) -> Error {
    match &e {
        io::ReadError::Io { source, .. } if source.kind() != NotFound => e.into(),
        _ => Error::cannot(&e, format!("make it again: repeat the command with `--fresh {stage}`")),
    }
}
