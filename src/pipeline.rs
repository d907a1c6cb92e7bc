//! The line: from photographs to a mesh, views and numbers. The only place where stages meet.
//!
//! ```text
//! mask      which pixels are the head, and where that puts it in space
//! baseline  a radiance field learned from whole photographs
//! tface     the same, learned from masked ones
//! iface     a signed distance learned from the masked photographs
//! mesh      its zero level set, closed, in the dataset's world
//! render    held-out views, by marching the fields and by casting rays at the mesh
//! ensemble  those views become one
//! metrics   all of them against the photographs
//! ```
//!
//! Views from other cameras, a turntable for example, are a product beside the line ([`Line::along`]).
//!
//! Each stage names those it reads from ([`Line::needs`]); a command runs what its stage needs and
//! nothing else. What shapes a stage is known before it runs: its settings, and the same of the stages
//! it needs. So all fingerprints can be computed at once ([`Line::plan`]), a dry run tells what would
//! be done, and a finished stage is skipped without loading anything. The device is not part of it: it
//! decides how fast a field is learned, not what it is.

use crate::{Error, Result};
mod clicks;
mod ensemble;
mod export;
#[cfg(feature = "cpu")]
mod fields;
mod finish;
mod fit;
mod march;
mod mask;
mod mesh;
mod metrics;
mod networks;
mod page;
mod parts;
mod path;
mod pictures;
mod plan;
mod product;
mod remembered;
mod render;
mod scene_file;
mod surface;
mod truth;

pub use export::Export;
#[cfg(feature = "cpu")]
pub use fields::Trained;
pub use march::Seen;
pub use mask::{click_page, disagreements};
pub use product::{Lobes, Pictures, Product};
pub use surface::{Fields, Radiance, Surface};
pub use truth::{Truth, against_truth};

use crate::capture::scene::Scene;
use crate::capture::{self, Capture, CaptureOptions, MaskChoice};
use crate::config::{Config, MaskMeaning, MaskSource};
use crate::io::{self, Limits};
#[cfg(feature = "cpu")]
use crate::run::Done;
use crate::run::{Fingerprint, Run};
use rayon::prelude::*;
use remembered::remembered;
use serde_json::Value;
use std::path::Path;

/// The stages in order.
pub const STAGES: &[&str] = &["mask", "baseline", "tface", "iface", "mesh", "render", "ensemble", "metrics"];

/// Raised when the meaning of a stage's files changes.
const FORMAT: u32 = 2;

/// Every stage that `until` needs, and itself, each only if it is not done.
#[cfg(feature = "cpu")]
pub fn reconstruct(line: &Line, until: &str) -> Result<Vec<(&'static str, Done)>> {
    let fields = Trained::new(line);
    let mut done = Vec::new();
    for name in line.order(until) {
        let stage = match name {
            "mask" => line.mask()?,
            "baseline" | "tface" => line.radiance(name)?,
            "iface" => line.iface()?,
            "mesh" => line.mesh(&fields)?,
            "render" => line.render(&fields)?,
            "ensemble" => line.ensemble(&fields)?,
            _ => line.metrics()?,
        };
        done.push((name, stage));
    }
    let idle = done.iter().all(|(_, stage)| stage.skipped);
    line.unless_idle(idle, line.report())?;
    Ok(done)
}

/// A capture, its configuration and its run folder.
pub struct Line<'a> {
    capture: Capture,
    config: &'a Config,
    run: &'a Run,
    /// Digest of everything read from the capture.
    digest: String,
    /// What `render` shows instead of the held-out views.
    path: Option<path::CameraPath>,
    /// Digests of checkpoints that stages take instead of learning.
    imports: Vec<(&'static str, String)>,
    /// Why the capture cannot be opened, where it is only as the run remembers it.
    gone: Option<String>,
    /// Is the capture the demo head, whose surface is known?
    synthetic: bool,
    /// What masks are made from, if not found.
    clicks: Option<clicks::Clicks>,
}

impl<'a> Line<'a> {
    /// Opens the capture and reads every byte of it once, for its digest. Nothing is written.
    ///
    /// The capture of a run that is done may lie somewhere else by now: its cameras are then those that the run
    /// remembers, and nothing can be worked on ([`Line::remember`]).
    pub fn open(config: &'a Config, run: &'a Run, synthetic: bool) -> Result<Line<'a>> {
        feasible(config)?;
        let options = capture_options(config);
        let (capture, digest, clicks, gone) = match capture::open(Path::new(&config.capture.path), &options) {
            Err(e) => match remembered(config, run, &e)? {
                Some(known) => (known.capture, known.digest, known.clicks, Some(e.to_string())),
                None => return Err(e.into()),
            },
            Ok(mut capture) => {
                capture::require_masks(&capture, &options)?;
                if synthetic {
                    // its folder is called after what it holds
                    capture.name = "demo".into();
                }
                let digest = capture_digest(&capture)?;
                let kept = run.path("mask").join(mask::CLICKS);
                let clicks = clicks::clicks(&config.mask, &capture, &kept)?;
                (capture, digest, clicks, None)
            }
        };
        let of_file = |file: &str| -> Result<String> {
            Ok(Fingerprint::of_bytes(&io::read_bytes(Path::new(file), &Limits::default())?))
        };
        let mut imports = Vec::new();
        for (stage, file) in [("baseline", &config.baseline.import), ("tface", &config.tface.import)] {
            if !file.is_empty() {
                imports.push((stage, of_file(file)?));
            }
        }
        for warning in &capture.warnings {
            run.warn("capture", warning);
        }
        let mut line = Line { capture, config, run, digest, path: None, imports, gone, synthetic, clicks };
        if line.clicks.is_some() {
            // what later stages read is what the stage `mask` makes
            let files: Vec<_> = line.capture.views.iter().map(|v| line.mask_file(&v.name)).collect();
            for (view, file) in line.capture.views.iter_mut().zip(files) {
                view.mask = capture::MaskSource::File(file);
            }
        }
        Ok(line)
    }

    /// The capture.
    pub fn capture(&self) -> &Capture {
        &self.capture
    }

    /// The box and hull that the stage `mask` found.
    pub fn scene(&self) -> Result<Scene> {
        self.scene_or_fail().map_err(|e| e.within("stage `mask`"))
    }

    fn scene_or_fail(&self) -> Result<Scene> {
        scene_file::read_scene(&self.run.path("mask/scene.json")).map_err(|e| unusable(e, "mask"))
    }

    /// An error if the capture is no longer there: nothing can be worked on then.
    fn is_there(&self) -> Result<()> {
        match &self.gone {
            Some(problem) => Err(gone(problem)),
            None => Ok(()),
        }
    }

    /// A file of the run itself that cannot be written is no failure where nothing is left to do: a run that is done
    /// may lie where nobody may write.
    fn unless_idle(&self, idle: bool, written: Result<()>) -> Result<()> {
        match written {
            Err(e) if idle => {
                self.run.warn("run", &format!("{e}; all that was asked for is done"));
                Ok(())
            }
            other => other,
        }
    }

    fn stop_here(&self) -> Result<()> {
        match self.run.stop().requested() {
            Some(_) => Err(self.run.stop().error("what is complete is kept")),
            None => Ok(()),
        }
    }
}

/// Refuses settings that contradict each other, and a device that this build cannot learn on.
pub fn feasible(config: &Config) -> Result<()> {
    if let Some((key, problem, hint)) = config.mesh.problem().or_else(|| config.mask.problem()) {
        return Err(Error::usage(format!("`{key}` {problem}"), hint));
    }
    #[cfg(feature = "cpu")]
    crate::field::device(&config.device)?;
    Ok(())
}

/// How the configuration opens a capture.
pub fn capture_options(config: &Config) -> CaptureOptions {
    let c = &config.capture;
    CaptureOptions {
        downscale: c.downscale,
        masks: match config.mask.source {
            _ if config.mask.clicked() => MaskChoice::None,
            MaskSource::Clicks => MaskChoice::None,
            MaskSource::Auto if c.mask_dir.is_empty() => MaskChoice::Auto,
            MaskSource::Auto | MaskSource::Folder => MaskChoice::Folder(c.mask_dir.clone()),
            MaskSource::Alpha => MaskChoice::Alpha,
            MaskSource::None => MaskChoice::None,
        },
        mask_meaning: match config.mask.meaning {
            MaskMeaning::Empty => capture::MaskMeaning::Empty,
            MaskMeaning::Ignore => capture::MaskMeaning::Ignore,
        },
        unit_m: c.unit_m,
        ..CaptureOptions::default()
    }
}

/// Digest of all that a capture means: cameras, splits and the bytes of every picture.
fn capture_digest(capture: &Capture) -> Result<String> {
    let limits = Limits::default();
    let views = capture
        .views
        .par_iter()
        .map(|view| {
            let mut text = format!("{} {:?} {:?} {}", view.name, view.split, view.camera, view.downscale);
            let mask = match &view.mask {
                capture::MaskSource::File(path) => Some(path),
                _ => None,
            };
            for path in [Some(&view.photo), mask, view.valid.as_ref(), view.region.as_ref()] {
                text += " ";
                if let Some(path) = path {
                    text += &Fingerprint::of_bytes(&io::read_bytes(path, &limits)?);
                }
            }
            Ok(text)
        })
        .collect::<Result<Vec<_>, io::ReadError>>()?;
    Ok(Fingerprint::of_bytes(format!("{} {}", capture.up, views.join("\n")).as_bytes()))
}

/// The capture of a run that has work left is no longer where it was.
fn gone(problem: &str) -> Error {
    Error::cannot(
        format!("the capture of this run cannot be opened: {problem}"),
        "say where it lies now: `--set capture.path=FOLDER`; the same photographs give the same run",
    )
}

/// A file that a stage of this run made cannot be used: the way out is to make it again.
fn unusable(e: io::ReadError, stage: &str) -> Error {
    match &e {
        io::ReadError::Io { source, .. } if source.kind() != std::io::ErrorKind::NotFound => e.into(),
        _ => Error::cannot(&e, format!("make it again: repeat the command with `--fresh {stage}`")),
    }
}

/// Figures as JSON; what is not finite becomes null.
fn to_value(figures: &impl serde::Serialize) -> Value {
    serde_json::to_value(figures).unwrap_or(Value::Null)
}

#[cfg(feature = "cpu")]
fn bitmask(scene: &Scene) -> Option<crate::kernel::march::Bitmask> {
    let hull = scene.hull.as_ref()?;
    Some(crate::kernel::march::Bitmask { resolution: hull.resolution, bits: hull.bits.clone() })
}

#[cfg(test)]
mod clicks_tests;
#[cfg(test)]
mod ensemble_tests;
#[cfg(test)]
mod line_tests;
#[cfg(test)]
mod path_tests;
