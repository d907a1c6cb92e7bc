//! A capture, its configuration and its run folder, which every stage works on.

use super::cameras::CameraCheck;
use super::clicks::MaskPrompts;
use super::lpips::measure;
use super::path::CameraPath;
use super::{mask, scene_file};
use crate::capture::scene::{Scene, SceneBox};
use crate::capture::{self, Capture, CaptureOptions, Split, View, ViewMask};
use crate::config::{Config, MaskSource, RenderConfig, Stage};
use crate::io::{self, Limits};
use crate::run::{Fingerprint, Run, read_record};
use crate::{Error, Result};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;
use std::io::ErrorKind::NotFound;
use std::path::Path;
use std::sync::OnceLock;

/// A capture, its configuration and its run folder.
pub struct Line<'a> {
    pub(super) capture: Capture,
    /// The capture with the poses that the stage `mask` refined, once they are used.
    refined: OnceLock<Capture>,
    pub(super) config: &'a Config,
    pub(super) run: &'a Run,
    /// Digest of everything read from the capture.
    pub(super) digest: String,
    /// Digest of each file and camera of the capture, keyed by the name shown to users; empty if the capture was
    /// restored from the run.
    inputs: BTreeMap<String, String>,
    /// The camera path that `render` shows instead of the held-out views.
    pub(super) path: Option<CameraPath>,
    /// Checkpoints that stages import instead of training.
    pub(super) imports: Vec<Import>,
    /// Why the capture cannot be opened, if it was restored from the run.
    pub(super) missing_capture: Option<String>,
    /// Whether the capture is the synthetic head, whose surface is known.
    pub(super) synthetic: bool,
    /// The clicks and networks that masks are made from, if masks are not read from the capture.
    pub(super) clicks: Option<MaskPrompts>,
    /// The capture's own masks, if the run makes others. The metrics use these, because a run must not influence the
    /// masks that it is evaluated with.
    pub(super) own_masks: Option<OwnMasks>,
    /// Digest of the network for LPIPS.
    pub(super) lpips: Option<String>,
}

/// Masks that the capture contains although the run makes its own.
pub(super) struct OwnMasks {
    /// One for each view.
    masks: Vec<ViewMask>,
    /// Digest of all these masks.
    pub digest: String,
}

/// A checkpoint that a stage imports instead of training.
pub(super) struct Import {
    /// The stage.
    pub stage: Stage,
    /// Digest of the file.
    pub digest: String,
    /// Why the file cannot be read, if its digest was restored from the run.
    missing: Option<Error>,
}

/// File name of the digests of the capture's files and cameras, in the folder of the stage `mask`.
const INPUTS: &str = "inputs.json";

impl<'a> Line<'a> {
    /// Opens the capture and reads every byte of it once to compute its digest. Nothing is written.
    ///
    /// The capture of a finished run may have been moved. Its cameras are then restored from the run, and no stage
    /// can be worked on ([`Line::remember`]).
    pub fn open(config: &'a Config, run: &'a Run) -> Result<Line<'a>> {
        check_feasible(config)?;
        let options = capture_options(config);
        let (mut capture, (digest, inputs), clicks, missing_capture) =
            match capture::open(Path::new(&config.capture.path), &options) {
                Err(e) => restore_from_run(config, run, e)?,
                Ok(capture) => {
                    capture::require_masks(&capture, &options)?;
                    let digest = capture_digest(&capture)?;
                    let kept = run.path(Stage::Mask).join(mask::CLICKS);
                    let clicks = MaskPrompts::open(&config.mask, &capture, &kept)?;
                    (capture, digest, clicks, None)
                }
            };
        let others = clicks.is_some() || config.mask.source == MaskSource::None;
        let own_masks = others.then(|| own_masks(&capture, &options)).transpose()?;
        let imports = imports(config, run)?;
        let lpips = lpips(config, run)?;
        capture.warnings.iter().for_each(|warning| run.warn("capture", warning));
        if clicks.is_some() {
            // later stages read the masks that the stage `mask` makes
            for view in &mut capture.views {
                view.mask = ViewMask::File(mask::mask_file(&run.path(Stage::Mask), &view.name));
            }
        }
        Ok(Line {
            capture,
            refined: OnceLock::new(),
            config,
            run,
            digest,
            inputs,
            path: None,
            imports,
            missing_capture,
            synthetic: false,
            clicks,
            own_masks,
            lpips,
        })
    }

    /// Returns this session with the synthetic head's known surface, which the metrics compare the mesh with.
    pub fn with_synthetic_truth(mut self) -> Line<'a> {
        self.synthetic = true;
        self.capture.name = "demo".into(); // its folder is called after what it holds
        self
    }

    /// Returns a session whose stage `render` makes the views of `render.cameras` in a folder of their own instead of
    /// the evaluation's views; a file of cameras is read here. For `test` the session is returned unchanged.
    pub fn with_camera_path(self, render: RenderConfig) -> Result<Line<'a>> {
        let path = CameraPath::new(render, &self.capture)?;
        Ok(Line { path, ..self })
    }

    /// Returns a view as the metrics use it: with the capture's own mask, if it has one.
    pub(super) fn evaluation_view(&self, view: &View) -> View {
        let place = self.capture.views.iter().position(|v| v.name == view.name);
        let own = self.own_masks.as_ref().zip(place).map(|(own, i)| own.masks[i].clone());
        View { mask: own.filter(|m| *m != ViewMask::None).unwrap_or(view.mask.clone()), ..view.clone() }
    }

    /// Returns the source of the masks that the figures of held-out views are restricted to: `capture`, `run` (this
    /// run made at least one of them, so other runs may evaluate differently) or `none`.
    pub(super) fn mask_source(&self) -> &'static str {
        let held_out: Vec<&View> = self.capture.views.iter().filter(|v| v.split != Split::Train).collect();
        let all: Vec<&View> = self.capture.views.iter().collect();
        let evaluated = if held_out.is_empty() { all } else { held_out };
        let is_own = |view: &&View| self.evaluation_view(view).mask != view.mask;
        match &self.own_masks {
            _ if evaluated.iter().all(|v| self.evaluation_view(v).mask == ViewMask::None) => "none",
            Some(_) if !evaluated.iter().all(is_own) => "run",
            _ => "capture",
        }
    }

    /// Returns the capture.
    pub fn capture(&self) -> &Capture {
        &self.capture
    }

    /// Returns the capture with the poses that the stage `mask` refined, for the stages after it.
    pub(super) fn refined_capture(&self) -> Result<&Capture> {
        if let Some(capture) = self.refined.get() {
            return Ok(capture);
        }
        let mut capture = self.capture.clone();
        let check = CameraCheck::read(&self.run.path(Stage::Mask)).map_err(|e| unusable(e, Stage::Mask))?;
        check.iter().for_each(|check| check.apply(&mut capture));
        Ok(self.refined.get_or_init(|| capture))
    }

    /// Returns the box and hull that the stage `mask` found.
    pub fn scene(&self) -> Result<Scene> {
        scene_file::read_scene(&self.run.path("mask/scene.json")).map_err(|e| unusable(e, Stage::Mask))
    }

    /// Writes `cameras.json`, if the photographs can be opened.
    pub(super) fn write_cameras(&self, idle: bool) -> Result<()> {
        if self.missing_capture.is_some() {
            return Ok(());
        }
        let scene = self.scene().map_err(|e| e.within("stage `mask`"))?;
        let check = CameraCheck::read(&self.run.path(Stage::Mask)).map_err(|e| unusable(e, Stage::Mask))?;
        let cameras = scene_file::cameras_json(&self.capture, &scene, check.as_ref());
        self.write("cameras.json", &cameras, idle)
    }

    /// Writes the digests of the capture's files that the stage `mask` reads, so that a later change can be named.
    pub(super) fn write_inputs(&self, folder: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(&self.inputs).unwrap_or_default();
        Ok(io::write_atomic(&folder.join(INPUTS), format!("{text}\n").as_bytes())?)
    }

    /// Returns the first file or camera of the capture that has changed since the stage `mask` ran, and how many
    /// others have; `None` if the run has no record of them.
    pub(super) fn changed_input(&self) -> Option<String> {
        let path = self.run.path(Stage::Mask).join(INPUTS);
        let old: BTreeMap<String, String> = io::read_typed(&path, &Limits::default()).ok()?;
        let names: BTreeSet<&String> = old.keys().chain(self.inputs.keys()).collect();
        let mut changed = names.into_iter().filter(|name| old.get(*name) != self.inputs.get(*name));
        let first = changed.next()?;
        let state = match (old.contains_key(first), self.inputs.contains_key(first)) {
            (true, true) => "has changed",
            (true, false) => "is no longer part of the capture",
            _ => "is new",
        };
        let more = match changed.count() {
            0 => String::new(),
            more => format!(", and {more} more differ"),
        };
        Some(format!("{first} {state}{more}"))
    }

    /// Returns how the views of the stage `render` are made: with the settings of the camera path, if the session has
    /// one.
    pub(super) fn render_config(&self) -> &RenderConfig {
        self.path.as_ref().map_or(&self.config.render, |path| &path.render)
    }

    /// Fails if an input of one of these stages is missing: photographs, checkpoints, networks or the device.
    pub(super) fn require_inputs(&self, stages: &[Stage]) -> Result<()> {
        if let Some(problem) = self.missing_capture.as_ref().filter(|_| !stages.is_empty()) {
            return Err(missing_capture(problem));
        }
        let mut lost =
            self.imports.iter().filter(|i| stages.contains(&i.stage)).filter_map(|i| i.missing.clone());
        lost.next().map_or(Ok(()), Err)?;
        if stages.contains(&Stage::Metrics) {
            measure(self.config)?;
        }
        #[cfg(not(feature = "matting"))]
        if self.clicks.is_some() && stages.contains(&Stage::Mask) {
            crate::mask::networks::Networks::open(&self.config.mask)?;
        }
        match stages.iter().any(|stage| stage.uses_device()) {
            true => require_device(self.config),
            false => Ok(()),
        }
    }

    /// Writes a file of the run itself. A write error is ignored if no work is left, because a finished run may lie
    /// on a read-only disk.
    pub(super) fn write(&self, name: &str, bytes: &[u8], idle: bool) -> Result<()> {
        match self.run.write(name, bytes) {
            Err(e) if idle => {
                self.run.warn("run", &format!("{e}; all that was asked for is done"));
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

/// Refuses a device that this build or this machine does not have, or that another process uses. Finished stages need
/// no device, so this is checked only if a stage that computes on it has work left.
pub fn require_device(config: &Config) -> Result<()> {
    crate::field::require_device(&config.device)
}

/// Returns the options with which the configuration opens a capture.
pub fn capture_options(config: &Config) -> CaptureOptions {
    let c = &config.capture;
    CaptureOptions {
        downscale: c.downscale,
        masks: if config.mask.made() { MaskSource::Clicks } else { config.mask.source },
        mask_dir: c.mask_dir.clone(),
        mask_meaning: config.mask.meaning,
        trust_masks: config.mask.trust,
        cameras: c.cameras,
        unit_m: c.unit_m,
        ..CaptureOptions::default()
    }
}

/// Returns the masks beside the photographs, although the run makes its own.
fn own_masks(capture: &Capture, options: &CaptureOptions) -> Result<OwnMasks> {
    let options = CaptureOptions { masks: MaskSource::Auto, ..options.clone() };
    // a capture that cannot be opened with its masks can still be used without them
    let found = capture::open(&capture.root, &options).map_or(Vec::new(), |c| c.views);
    let mask =
        |view: &View| found.iter().find(|v| v.name == view.name).map_or(ViewMask::None, |v| v.mask.clone());
    let masks: Vec<ViewMask> = capture.views.iter().map(mask).collect();
    let digests = masks.par_iter().map(|mask| match mask {
        ViewMask::File(path) => Ok(file_digest(path)?),
        // the photograph is already part of the capture's digest
        other => Ok(format!("{other:?}")),
    });
    let digests = digests.collect::<Result<Vec<String>>>()?;
    Ok(OwnMasks { masks, digest: Fingerprint::of_bytes(digests.join(" ").as_bytes()) })
}

/// Returns the digest of the whole capture (cameras, splits and the bytes of every picture), and that of each part.
fn capture_digest(capture: &Capture) -> Result<(String, BTreeMap<String, String>)> {
    let views = capture
        .views
        .par_iter()
        .map(|view| {
            let mut text = format!("{} {:?} {:?} {}", view.name, view.split, view.camera, view.downscale);
            let camera = Fingerprint::of_bytes(text.as_bytes());
            let mut inputs = vec![(format!("the camera of view `{}`", view.name), camera)];
            let mask = match &view.mask {
                ViewMask::File(path) => Some(path),
                _ => None,
            };
            for path in [Some(&view.photo), mask, view.valid.as_ref(), view.region.as_ref()] {
                text += " ";
                if let Some(path) = path {
                    let (digest, file) =
                        (file_digest(path)?, path.strip_prefix(&capture.root).unwrap_or(path));
                    text += &digest;
                    inputs.push((format!("`{}`", file.display()), digest));
                }
            }
            Ok((text, inputs))
        })
        .collect::<Result<Vec<_>>>()?;
    let (views, inputs): (Vec<String>, Vec<_>) = views.into_iter().unzip();
    let mut text = format!("{} {}", capture.up, views.join("\n"));
    if let Some(focus) = capture.focus {
        text += &format!("\n{focus:?}");
    }
    Ok((Fingerprint::of_bytes(text.as_bytes()), inputs.into_iter().flatten().collect()))
}

fn file_digest(path: &Path) -> Result<String, io::ReadError> {
    Ok(Fingerprint::of_bytes(&io::read_bytes(path, &Limits::default())?))
}

/// Returns the checkpoints that the configuration names. A stage that has imported one no longer needs the file: if
/// it has been moved, the digest is taken from the stage's record.
fn imports(config: &Config, run: &Run) -> Result<Vec<Import>> {
    let named = [(Stage::Baseline, &config.baseline.import), (Stage::Tface, &config.tface.import)];
    let open = |(stage, file): (Stage, &String)| match file_digest(Path::new(file)) {
        Ok(digest) => Ok(Import { stage, digest, missing: None }),
        Err(e) => {
            let record = read_record(&run.path(stage)).ok().flatten();
            let record = record.filter(|_| is_missing(&e) && saved_import(run, stage).as_ref() == Some(file));
            let digest = record.and_then(|r| r.fingerprint.inputs.get("import").cloned());
            let e = Error::from(e);
            digest.map(|digest| Import { stage, digest, missing: Some(e.clone()) }).ok_or(e)
        }
    };
    named.into_iter().filter(|(_, file)| !file.is_empty()).map(open).collect()
}

/// Returns the digest of the network for LPIPS, if one is named; finished metrics no longer need the file.
fn lpips(config: &Config, run: &Run) -> Result<Option<String>> {
    let file = &config.metrics.lpips;
    if file.is_empty() {
        return Ok(None);
    }
    let bytes = io::read_bytes(Path::new(file), &Limits { file_bytes: 2 << 30, ..Limits::default() });
    match bytes {
        Ok(bytes) => Ok(Some(Fingerprint::of_bytes(&bytes))),
        Err(e) => {
            let record = read_record(&run.path(Stage::Metrics)).ok().flatten();
            let same = || Config::of_run(run.dir()).is_some_and(|saved| saved.metrics.lpips == *file);
            let record = record.filter(|_| is_missing(&e) && same());
            let digest = record.and_then(|r| r.fingerprint.inputs.get("lpips").cloned());
            digest.map(Some).ok_or_else(|| e.into())
        }
    }
}

/// Returns the checkpoint that a stage imported when the run was last worked on, if it is recorded.
fn saved_import(run: &Run, stage: Stage) -> Option<String> {
    let saved = Config::of_run(run.dir())?;
    Some(if stage == Stage::Baseline { saved.baseline.import } else { saved.tface.import })
}

fn is_missing(e: &io::ReadError) -> bool {
    matches!(e, io::ReadError::Io { source, .. } if source.kind() == NotFound)
}

/// Restores what a run recorded of a capture that has been moved: its cameras, its digest, the clicks' digests, and
/// why it cannot be opened. A finished run no longer needs its photographs.
///
/// # Errors
///
/// `error` itself if the capture exists (the error then says what is wrong with it) or if the run does not exist yet;
/// otherwise that the run has not recorded its capture yet.
fn restore_from_run(
    config: &Config,
    run: &Run,
    error: Error,
) -> Result<(Capture, (String, BTreeMap<String, String>), Option<MaskPrompts>, Option<String>)> {
    let root = Path::new(&config.capture.path);
    if capture::has_cameras(root) || !io::is_file(&run.path("config.toml")) {
        return Err(error);
    }
    let problem = error.to_string();
    let record =
        read_record(&run.path(Stage::Mask)).ok().flatten().ok_or_else(|| missing_capture(&problem))?;
    let capture =
        scene_file::read_capture(&run.path("cameras.json"), root).map_err(|_| missing_capture(&problem))?;
    let mut inputs = record.fingerprint.inputs;
    let digest = inputs.remove("capture").unwrap_or_default();
    let clicks = config.mask.made().then(|| MaskPrompts::from_inputs(&inputs));
    Ok((capture, (digest, BTreeMap::new()), clicks, Some(problem)))
}

/// Returns the error for an unfinished run whose capture has been moved.
fn missing_capture(problem: &str) -> Error {
    Error::cannot(
        format!("the capture of this run cannot be opened: {problem}"),
        "say where it lies now: `--set capture.path=FOLDER`; the same photographs give the same run",
    )
}

/// Returns the error for an unusable file that a stage of this run made: the hint is to make it again.
pub(super) fn unusable(e: io::ReadError, stage: impl Display) -> Error {
    match &e {
        io::ReadError::Io { source, .. } if source.kind() != NotFound => e.into(),
        _ => Error::cannot(&e, format!("make it again: repeat the command with `--fresh {stage}`")),
    }
}
