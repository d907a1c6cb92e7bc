//! Views along a camera path: a separate output, made of the same fields as the evaluation's views.
//!
//! ```text
//! render/paths/orbit/tface/0001.png   around the head
//!              train/                 from the training cameras
//!              flight-1f0c2a9b/       from a file of cameras: its name, how its digest begins
//! ```
//!
//! No stage reads these views, so making or removing them does not affect the evaluation's views,
//! their blend or the metrics.

use crate::config::RenderConfig;
use std::path::Path;
use tiface_base::geom::Camera;
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Fingerprint, Result};
use tiface_capture::path::{NamedCamera, from_json};
use tiface_capture::{Capture, Split, View};

/// Folder of the paths, relative to the run: one folder for each path.
pub(super) const PATHS: &str = "render/paths";

/// Number of characters of a file's name kept before its digest: a file name is limited to 255
/// bytes.
const MAX_STEM_CHARS: usize = 50;

/// A set of cameras, and the settings of their views.
pub(super) struct CameraPath {
    /// Its folder, relative to the run.
    pub folder: String,
    /// The settings of the views.
    pub render: RenderConfig,
    /// `None` for an orbit, which depends on where the head is.
    pub cameras: Option<Vec<NamedCamera>>,
    /// Digest of the file that the cameras come from.
    pub digest: Option<String>,
}

impl CameraPath {
    /// Returns the path that `render.cameras` names, reading a file of cameras; `None` for the
    /// held-out views.
    pub fn new(render: RenderConfig, capture: &Capture) -> Result<Option<CameraPath>> {
        let mut digest = None;
        let (name, cameras) = match render.cameras.as_str() {
            "test" => return Ok(None),
            "train" => ("train".into(), Some(cameras_of(capture, Split::Train))),
            "orbit" => ("orbit".into(), None),
            file => {
                let bytes = io::read_bytes(Path::new(file), &Limits::default())?;
                let cameras = cameras_of_file(file, &bytes, &capture.views[0].camera)
                    .map_err(|e| e.within("stage `render`"))?;
                let stem = Path::new(file).file_stem().unwrap_or_default().to_string_lossy();
                let stem: String = stem.chars().take(MAX_STEM_CHARS).collect();
                let digest = digest.insert(Fingerprint::of_bytes(&bytes));
                (format!("{stem}-{}", &digest[..8]), Some(cameras))
            }
        };
        // float views are only kept for the ensemble, which does not read these views
        let render = RenderConfig { float: false, ..render };
        Ok(Some(CameraPath { folder: format!("{PATHS}/{name}"), render, cameras, digest }))
    }
}

/// Returns the cameras of one split, named like their photographs.
pub(super) fn cameras_of(capture: &Capture, split: Split) -> Vec<NamedCamera> {
    let named = |v: &View| NamedCamera { name: v.name.clone(), camera: v.camera.clone() };
    capture.split(split).map(named).collect()
}

/// Returns the cameras in the bytes of a file, each with a unique name.
pub(super) fn cameras_of_file(file: &str, bytes: &[u8], like: &Camera) -> Result<Vec<NamedCamera>> {
    let cameras = from_json(&String::from_utf8_lossy(bytes), like)?;
    let mut names: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).collect();
    names.sort_unstable();
    if let Some(twice) = names.windows(2).find(|w| w[0] == w[1]) {
        let problem = format!("`{file}` names two cameras `{}`", twice[0]);
        return Err(Error::cannot(problem, "give every frame a file name of its own"));
    }
    Ok(cameras)
}
