//! What the fingerprints of the stages depend on besides the settings: digests of every file that a
//! run reads.
//!
//! A finished run no longer needs these files: the digests of those that have been moved are
//! restored from its records.

use super::clicks::MaskPrompts;
use super::readings::{Settled, decide_reading};
use super::{mask, scene_file};
use crate::config::{Config, MaskSource, SETTINGS_FILE, Stage};
use crate::run::{Run, read_record, taken_for_capture};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind::NotFound;
use std::path::Path;
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Fingerprint, Result};
use tiface_capture::{self as capture, Capture, CaptureOptions, Reading, View, ViewMask};

/// Digests of what the stages read from outside the run.
#[derive(Default)]
pub(super) struct Inputs {
    /// Digest of everything read from the capture.
    pub digest: String,
    /// Digest of each file and camera of the capture, keyed by the name shown to users; empty if
    /// the capture was restored from the run.
    files: BTreeMap<String, String>,
    /// Why the capture cannot be opened, if it was restored from the run.
    pub missing_capture: Option<String>,
    /// The clicks and networks that masks are made from, if masks are not read from the capture.
    pub clicks: Option<MaskPrompts>,
    /// The capture's own masks, if the run makes others. The metrics use these, because a run must
    /// not influence the masks that it is evaluated with.
    pub own_masks: Option<OwnMasks>,
    /// Checkpoints that stages import instead of training.
    pub imports: Vec<Import>,
    /// Digest of the network for LPIPS.
    pub lpips: Option<String>,
}

/// Masks that the capture contains although the run makes its own.
pub(super) struct OwnMasks {
    /// One for each view.
    pub masks: Vec<ViewMask>,
    /// The turn of each.
    pub turns: Vec<Option<u8>>,
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
    pub missing: Option<Error>,
}

/// File name of the digests of the capture's files and cameras, in the folder of the stage `mask`.
const INPUTS: &str = "inputs.json";

impl Inputs {
    /// Opens the capture and reads every file that the stages will read, to compute its digest.
    pub fn read(config: &Config, run: &Run) -> Result<(Capture, Inputs)> {
        let mut options = capture_options(config);
        let root = &config.capture.path;
        let opened = capture::open(root, &options).map_err(|e| taken_for_capture(root).unwrap_or(e));
        let (capture, mut inputs) = match opened.and_then(|capture| decide_reading(capture, &options)) {
            Err(e) => restore_from_run(config, run, e)?,
            Ok(Settled { mut capture, reading, reason, .. }) => {
                options.reading = reading;
                // who trains is told of what the files do not say
                capture.warnings.extend(reason.filter(|_| reading != Some(Reading::default())));
                capture::require_masks(&capture, &options)?;
                let (digest, files) = capture_digest(&capture)?;
                let kept = run.path(Stage::Mask).join(mask::CLICKS);
                let clicks = MaskPrompts::open(&config.mask, &capture, &kept)?;
                (capture, Inputs { digest, files, clicks, ..Inputs::default() })
            }
        };
        if inputs.clicks.is_some() || config.mask.source == MaskSource::None {
            inputs.own_masks = Some(own_masks(&capture, &options)?);
        }
        inputs.imports = imports(config, run)?;
        inputs.lpips = lpips(config, run)?;
        Ok((capture, inputs))
    }

    /// Returns the names and digests of what a stage reads from outside the run.
    pub fn read_by(&self, stage: Stage) -> Vec<(&'static str, String)> {
        match stage {
            Stage::Mask => {
                let clicks = self.clicks.iter().flat_map(|clicks| clicks.inputs.iter().cloned());
                std::iter::once(("capture", self.digest.clone())).chain(clicks).collect()
            }
            Stage::Baseline | Stage::Tface => {
                let imported = self.imports.iter().filter(|import| import.stage == stage);
                imported.map(|import| ("import", import.digest.clone())).collect()
            }
            Stage::Metrics => {
                let own = self.own_masks.iter().map(|own| ("own masks", own.digest.clone()));
                own.chain(self.lpips.iter().map(|digest| ("lpips", digest.clone()))).collect()
            }
            Stage::Iface | Stage::Mesh | Stage::Render | Stage::Ensemble => Vec::new(),
        }
    }

    /// Writes the digests of the capture's files that the stage `mask` reads, so that a later
    /// change can be named.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(&self.files).unwrap_or_default();
        Ok(io::write_atomic(&folder.join(INPUTS), format!("{text}\n").as_bytes())?)
    }

    /// Returns the first file or camera of the capture that has changed since the stage `mask` ran,
    /// and how many others have; `None` if the run has no record of them.
    pub fn changed(&self, run: &Run) -> Option<String> {
        let path = run.path(Stage::Mask).join(INPUTS);
        let old: BTreeMap<String, String> = io::read_typed(&path, &Limits::default()).ok()?;
        let names: BTreeSet<&String> = old.keys().chain(self.files.keys()).collect();
        let mut changed = names.into_iter().filter(|name| old.get(*name) != self.files.get(*name));
        let first = changed.next()?;
        let state = match (old.contains_key(first), self.files.contains_key(first)) {
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
}

/// Returns the masks beside the photographs, although the run makes its own.
fn own_masks(capture: &Capture, options: &CaptureOptions) -> Result<OwnMasks> {
    let options = CaptureOptions { masks: MaskSource::Auto, ..options.clone() };
    // a capture that cannot be opened with its masks can still be used without them
    let found = capture::open(&capture.root, &options).map_or(Vec::new(), |c| c.views);
    let mask = |view: &View| {
        let found = found.iter().find(|v| v.name == view.name);
        found.map_or((ViewMask::None, None), |v| (v.mask.clone(), v.mask_turn))
    };
    let (masks, turns): (Vec<ViewMask>, Vec<Option<u8>>) = capture.views.iter().map(mask).unzip();
    let digests = masks.par_iter().map(|mask| match mask {
        ViewMask::File(path) => Ok(file_digest(path)?),
        // the photograph is already part of the capture's digest
        other => Ok(format!("{other:?}")),
    });
    let digests = digests.collect::<Result<Vec<String>>>()?;
    Ok(OwnMasks { masks, turns, digest: Fingerprint::of_bytes(digests.join(" ").as_bytes()) })
}

/// Returns the digest of the whole capture (cameras, splits and the bytes of every picture), and
/// that of each part.
fn capture_digest(capture: &Capture) -> Result<(String, BTreeMap<String, String>)> {
    let views = capture
        .views
        .par_iter()
        .map(|view| {
            let mut text = format!("{} {:?} {:?} {}", view.name, view.split, view.camera, view.downscale);
            if view.turn.is_some() || view.mask_turn.is_some() {
                text += &format!(" {:?} {:?}", view.turn, view.mask_turn);
            }
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

/// Returns the options with which the configuration opens a capture.
pub fn capture_options(config: &Config) -> CaptureOptions {
    let c = &config.capture;
    CaptureOptions {
        downscale: c.downscale,
        masks: if config.mask.makes_masks() { MaskSource::Clicks } else { config.mask.source },
        mask_dir: c.mask_dir.clone(),
        mask_meaning: config.mask.meaning,
        head: config.mask.head.clone(),
        trust_masks: config.mask.trust,
        cameras: c.cameras,
        exposure: c.exposure,
        glare: c.glare,
        unit_m: c.unit_m,
        result_file: SETTINGS_FILE,
        ..CaptureOptions::default()
    }
}

fn file_digest(path: &Path) -> Result<String, io::ReadError> {
    Ok(Fingerprint::of_bytes(&io::read_bytes(path, &Limits::default())?))
}

/// Returns the checkpoints that the configuration names. A stage that has imported one no longer
/// needs the file: if it has been moved, the digest is taken from the stage's record.
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

/// Returns the digest of the network for LPIPS, if one is named; finished metrics no longer need
/// the file.
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

/// Restores what a run recorded of a capture that has been moved: its cameras, its digest, the
/// clicks' digests, and why it cannot be opened. A finished run no longer needs its photographs.
///
/// # Errors
///
/// `error` itself if the capture exists (the error then says what is wrong with it) or if the run
/// does not exist yet; otherwise that the run has not recorded its capture yet.
fn restore_from_run(config: &Config, run: &Run, error: Error) -> Result<(Capture, Inputs)> {
    let root = &config.capture.path;
    if capture::has_cameras(root) || !io::is_file(&run.path(SETTINGS_FILE)) {
        return Err(error);
    }
    let problem = error.to_string();
    let record =
        read_record(&run.path(Stage::Mask)).ok().flatten().ok_or_else(|| missing_capture(&problem))?;
    let capture =
        scene_file::read_capture(&run.path("cameras.json"), root).map_err(|_| missing_capture(&problem))?;
    let mut inputs = record.fingerprint.inputs;
    let digest = inputs.remove("capture").unwrap_or_default();
    let clicks = config.mask.makes_masks().then(|| MaskPrompts::from_inputs(&inputs));
    Ok((capture, Inputs { digest, clicks, missing_capture: Some(problem), ..Inputs::default() }))
}

/// Returns the error for an unfinished run whose capture has been moved.
pub(super) fn missing_capture(problem: &str) -> Error {
    Error::cannot(
        format!("the capture of this run cannot be opened: {problem}"),
        "name its current folder with `--set capture.path=FOLDER`; the same photographs continue the same run",
    )
}
