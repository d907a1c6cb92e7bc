//! The capture as a run remembers it: a run that is done does not need its photographs any more.

use super::{clicks::Clicks, scene_file};
use crate::Result;
use crate::capture::{Capture, CaptureError};
use crate::config::Config;
use crate::io;
use crate::run::{Run, read_record};
use std::path::Path;

/// What of a click's mask comes from files, as `clicks` names them.
const CLICKED: [&str; 4] = ["clicks", "sam", "sam_decoder", "vitmatte"];

/// What the stage `mask` was told.
pub(super) struct Remembered {
    pub capture: Capture,
    pub digest: String,
    pub clicks: Option<Clicks>,
}

/// What a run remembers of a capture that is no longer there. `None` if it is there, and `error` tells what is wrong
/// with it, or if there is no run yet.
///
/// # Errors
///
/// A run that has not come far enough to remember it.
pub(super) fn remembered(config: &Config, run: &Run, error: &CaptureError) -> Result<Option<Remembered>> {
    let root = Path::new(&config.capture.path);
    let is_there = io::is_folder(root) && !matches!(error, CaptureError::NotACapture { .. });
    if is_there || !io::is_file(&run.path("config.toml")) {
        return Ok(None);
    }
    let gone = || super::gone(&error.to_string());
    let record = read_record(&run.path("mask")).ok().flatten().ok_or_else(gone)?;
    let capture = scene_file::read_capture(&run.path("cameras.json"), root).map_err(|_| gone())?;
    let input = |name: &&'static str| Some((*name, record.fingerprint.inputs.get(*name)?.clone()));
    let clicks = config.mask.clicked().then(|| Clicks {
        of: Vec::new(),
        file: Vec::new(),
        inputs: CLICKED.iter().filter_map(input).collect(),
    });
    let digest = record.fingerprint.inputs.get("capture").cloned().unwrap_or_default();
    Ok(Some(Remembered { capture, digest, clicks }))
}
