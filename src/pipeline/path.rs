//! Views along a path of cameras: a product of its own, made of the same fields as the evaluation's views.
//!
//! ```text
//! render/paths/orbit/tface/0001.png   around the head
//!              train/                 from where it was learned
//!              flight-1f0c2a9b/       from a file of cameras: its name, and the beginning of its digest
//! ```
//!
//! No stage reads them, so none is out of date with them: they come and go without the evaluation's views, their
//! blend and the metrics.

use super::{FORMAT, Line};
use crate::capture::Split;
use crate::config::{Config, RenderConfig};
use crate::io::{self, Limits};
use crate::render::path::{NamedCamera, from_json};
use crate::run::{Fingerprint, Plan, read_record, read_status};
use crate::{Error, Result};
use std::path::Path;

/// Below the run: one folder for each path.
const PATHS: &str = "render/paths";

/// So many characters of a file's name stand before its digest: a name has room for 255 bytes.
const STEM: usize = 50;

/// Which cameras, and how their views are made.
pub(super) struct CameraPath {
    /// Its folder, below the run.
    pub folder: String,
    /// How the views are made.
    pub render: RenderConfig,
    /// `None` for an orbit: where it is depends on the head.
    pub cameras: Option<Vec<NamedCamera>>,
    /// Of the file the cameras come from.
    digest: Option<String>,
}

impl<'a> Line<'a> {
    /// Returns the line whose stage `render` makes views of `render.cameras` in a folder of their own, and not those
    /// of the evaluation; a file of cameras is read here. For `test` the line as it is.
    pub fn along(mut self, render: RenderConfig) -> Result<Line<'a>> {
        if render.cameras == "test" {
            return Ok(self);
        }
        let mut digest = None;
        let (name, cameras) = match render.cameras.as_str() {
            "train" => ("train".into(), Some(self.of(Split::Train))),
            "orbit" => ("orbit".into(), None),
            file => {
                let bytes = io::read_bytes(Path::new(file), &Limits::default())?;
                let cameras = self.cameras_of_file(file, &bytes).map_err(|e| e.within("stage `render`"))?;
                let stem = Path::new(file).file_stem().unwrap_or_default().to_string_lossy();
                let stem: String = stem.chars().take(STEM).collect();
                let digest = digest.insert(Fingerprint::of_bytes(&bytes));
                (format!("{stem}-{}", &digest[..8]), Some(cameras))
            }
        };
        // what is kept in float is kept for a blend, and these views are in none
        let render = RenderConfig { float: false, ..render };
        self.path = Some(CameraPath { folder: format!("{PATHS}/{name}"), render, cameras, digest });
        Ok(self)
    }

    /// The folder of the views that this line makes, below the run.
    pub fn views(&self) -> &str {
        self.path.as_ref().map_or("render", |path| &path.folder)
    }

    /// Folders below the run that are out of date when a stage is made anew, in the order of the line: its own, those
    /// of what builds on it, and views of paths that show it. Where views of a path are made anew, they alone.
    pub fn out_of_date(&self, stage: &str) -> Result<Vec<String>> {
        if stage == "render" && self.path.is_some() {
            return Ok(vec![self.views().into()]);
        }
        let mut names: Vec<String> = self.followers(stage).iter().map(|s| s.to_string()).collect();
        for folder in io::list_folders(&self.run.path(PATHS))? {
            let Ok(Some(status)) = read_status(&folder) else { continue };
            if status.fingerprint.inputs.keys().any(|input| names.contains(input)) {
                let name = folder.file_name().unwrap_or_default().to_string_lossy();
                names.push(format!("{PATHS}/{name}"));
            }
        }
        Ok(names)
    }

    /// Removes what is out of date when a stage is made anew on the way to `until`; nothing, if what `until` asks for
    /// would be refused then.
    pub fn fresh(&self, stage: &str, until: &str) -> Result<()> {
        self.is_there()?;
        let names = self.out_of_date(stage)?;
        // a finished blend is not cleared for views that it could not be made of again
        let blended = names.iter().any(|n| n == "ensemble")
            && !self.config.ensemble.members.is_empty()
            && read_record(&self.run.path("ensemble")).ok().flatten().is_some();
        if blended {
            self.can_blend()?;
        }
        self.agrees(until, &names)?;
        Ok(self.run.fresh(&names)?)
    }

    /// What the views of a path are made of.
    pub(super) fn path_plan<'p>(&'p self, path: &'p CameraPath) -> Plan<'p> {
        let CameraPath { folder, render, cameras, digest } = path;
        let mut settings = Config { render: render.clone(), ..self.config.clone() }.values("render");
        settings.remove("render.float");
        if cameras.is_some() {
            settings.remove("render.orbit_views");
        }
        let mut fingerprint = Fingerprint::new(FORMAT, settings);
        if let Some(digest) = digest {
            // what the file holds matters, not where it lies
            fingerprint.settings.remove("render.cameras");
            fingerprint = fingerprint.input("cameras", digest);
        }
        for stage in super::plan::shown(&render.method) {
            fingerprint = fingerprint.input(stage, self.plan(stage).fingerprint.digest());
        }
        let pixels = |c: &crate::geom::Camera| c.width as u64 * c.height as u64;
        let all = match cameras {
            Some(cameras) => cameras.iter().map(|c| pixels(&c.camera)).sum(),
            None => self.capture.views.first().map_or(0, |v| pixels(&v.camera)) * render.orbit_views as u64,
        };
        let needs_bytes = (16 << 20) + 6 * all * render.method.len().max(1) as u64;
        Plan { name: folder, fingerprint, device: &self.config.device, needs_bytes, saves: false }
    }

    fn cameras_of_file(&self, file: &str, bytes: &[u8]) -> Result<Vec<NamedCamera>> {
        let like = &self.capture.views[0].camera;
        let cameras = from_json(&String::from_utf8_lossy(bytes), like)?;
        let mut names: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).collect();
        names.sort_unstable();
        if let Some(twice) = names.windows(2).find(|w| w[0] == w[1]) {
            let problem = format!("`{file}` names two cameras `{}`", twice[0]);
            return Err(Error::cannot(problem, "give every frame a file name of its own"));
        }
        Ok(cameras)
    }
}
