//! Cameras of photographs that have none: structure from motion by COLMAP (Schönberger, Frahm
//! 2016), a program that is installed beside this one.
//!
//! Photographs, or the sharpest frames of a video, are copied to `OUT/images/`, with masks to
//! `OUT/masks/`; COLMAP works in `OUT/colmap/`, where its log stays. The model is opened as a
//! capture is, and renamed to `OUT/sparse/0` at last, so that a folder that has it is complete.
//! Features are searched inside the head masks where there are any: behind a turntable the
//! background moves otherwise than the head. Where fewer than 80 % of the photographs are
//! registered, a second attempt accepts weak features as well, which smooth skin has more of, and a
//! third one searches the whole photographs.
//!
//! The mapper fits one coefficient of distortion, because few views cannot tell more. A lens that
//! all photographs share is then refined as OPENCV's model with its principal point where that is
//! observable: a wide lens and many points.

mod commands;
mod output;
mod search;

pub use search::Search;

use super::colmap::{self, ModelFiles, SparseModel};
use super::folder::{CaptureFolder, is_common_name};
use super::frame::Listing;
use super::masks::few;
use super::options::CaptureOptions;
use super::view::View;
use super::{MaskSource, build};
use commands::{Programs, Spelling};
use output::{LOG, NAMES, Output, Request};
use serde::{Deserialize, Serialize};
use std::collections::HashSet;
use std::ffi::OsString;
use std::path::{Component, Path, PathBuf};
use tiface_base::io::{self, Limits, Lock, Program, ProgramFailure};
use tiface_base::{Error, Result};

/// Fewest photographs that a capture can have.
const MIN_VIEWS: usize = 8;

/// Share of the photographs with a camera that is enough: no other attempt is made.
const ENOUGH: f64 = 0.8;

/// Reprojection errors above this are warned of. Those of sharp photographs are below one pixel.
const MAX_ERROR_PX: f64 = 2.0;

/// Most pictures of which each is matched with every other; frames of a longer video with those
/// near in time.
const MAX_EXHAUSTIVE: usize = 200;

/// A principal point is refined with this many registered photographs, of this many points each,
/// and a focal length of at most this many long sides. On a head of 24 photographs at 2.6 long
/// sides and 180 points it moved by a quarter of the width; on one of 50 at 0.7 and 690 it came
/// within half a pixel of its calibration.
const OBSERVABLE: (usize, usize, f64) = (20, 300, 1.5);

/// How far refinement may move focal length and principal point to be believed, as a share of the
/// longest side.
const MAX_MOVE: f64 = 0.05;

/// Bytes of COLMAP's database for a picture: 8192 features of 128 bytes, and six numbers for where
/// each is.
const PICTURE_BYTES: u64 = 8192 * (128 + 24);

/// Bytes of the database for two pictures that are matched, on average.
const PAIR_BYTES: u64 = 2 << 10;

/// Advice where COLMAP ended otherwise than it should.
const READ_LOG: &str = "the end of the log says why; if memory ran out, set RAYON_NUM_THREADS=1, which is COLMAP's number of \
                        threads as well, or reduce the photographs";

/// Advice where too few photographs were registered.
const MORE_OVERLAP: &str = "photograph the head again, sharply and in even light, from all sides with 10° to 15° between \
                            neighbors, while it holds still; a textured background that stays with the head helps";

/// Where the result goes, and how it is found.
pub struct SfmOptions<'a> {
    /// The new capture.
    pub out: PathBuf,
    /// Whether each photograph has a lens of its own, even if sizes and focal lengths agree.
    pub lens_each: bool,
    /// Whether GLOMAP, or the global mapper that it became, finds the poses from COLMAP's matches.
    pub glomap: bool,
    /// Limits of what is read.
    pub limits: Limits,
    /// Receives a line about each step.
    pub say: &'a dyn Fn(&str),
    /// Whether to stop.
    pub stop: &'a dyn Fn() -> bool,
}

/// Cameras that were found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Solution {
    /// The new capture.
    pub folder: PathBuf,
    /// Number of photographs, or of frames of the video.
    pub photographs: usize,
    /// Number of photographs with a camera.
    pub registered: usize,
    /// Photographs without a camera.
    pub left_out: Vec<String>,
    /// Mean reprojection error, pixels, of the mapper's model: before the principal point is
    /// refined.
    pub error_px: f64,
    /// Whether features were searched inside head masks only.
    pub masked: bool,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Returns the folder of the new capture where none is named: that of the photographs with
/// `_cameras`, or the nearest above it whose name is not one that all captures give their
/// photographs; of a video, its name.
pub fn default_folder(from: &Path, is_video: bool) -> PathBuf {
    let above = from.components().rev().map_while(|part| match part {
        Component::Normal(name) => Some(name.to_string_lossy().into_owned()),
        _ => None,
    });
    let name = match is_video {
        true => from.file_stem().map(|stem| stem.to_string_lossy().into_owned()),
        false => above.clone().find(|name| !is_common_name(name)).or(above.clone().next()),
    };
    format!("{}_cameras", name.as_deref().unwrap_or("capture")).into()
}

/// Returns about how many bytes COLMAP's database of these pictures has.
fn database_bytes(pictures: usize, is_video: bool) -> u64 {
    let n = pictures as u64;
    let pairs = if is_video && pictures > MAX_EXHAUSTIVE { 20 * n } else { n * n / 2 };
    n * PICTURE_BYTES + pairs * PAIR_BYTES
}

/// Returns the error of a program's command that failed.
fn failed_command(program: &str, arguments: &[OsString], failure: &ProgramFailure, log: &Path) -> Error {
    let (command, status, log) = (arguments[0].to_string_lossy(), &failure.status, log.display());
    Error::cannot(format!("`{program} {command}` failed ({status}); its log is `{log}`"), READ_LOG)
}

/// Differences of an attempt from the first one.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Attempt {
    /// Features are searched inside the masks.
    masked: bool,
    /// Weak features are accepted.
    weak: bool,
}

/// The largest model of an attempt.
struct Model {
    attempt: Attempt,
    folder: PathBuf,
    found: SparseModel,
    /// How many models there are.
    pieces: usize,
    /// Models that cannot be read.
    unreadable: Vec<Error>,
}

/// Photographs in the output folder whose cameras are being found.
struct Work<'a> {
    sfm: &'a SfmOptions<'a>,
    output: Output<'a>,
    request: Request,
    lock: Lock,
    programs: Programs,
    names: Vec<String>,
    /// Warnings about the photographs.
    warnings: Vec<String>,
    /// All photographs are by one lens.
    shared: bool,
    masked: bool,
    is_video: bool,
}

impl Work<'_> {
    /// Shows a command as a user would type it, and runs it; returns how it failed, if it did.
    fn run(&self, program: &Path, arguments: &[OsString], log: &Path) -> Result<Option<ProgramFailure>> {
        let words: Vec<_> = arguments.iter().map(|word| word.to_string_lossy()).collect();
        let name = program.file_stem().unwrap_or_default().to_string_lossy();
        (self.sfm.say)(&format!("{name} {}", words.join(" ")));
        Program::start(program, arguments, log, &self.lock, false)?.wait(self.sfm.stop)
    }

    /// Runs a command of COLMAP that has to succeed.
    fn require(&self, arguments: &[OsString], log: &Path) -> Result<()> {
        let failed = self.run(&self.programs.colmap, arguments, log)?;
        failed.map_or(Ok(()), |failure| Err(failed_command("colmap", arguments, &failure, log)))
    }

    /// Returns the largest model that an attempt finds.
    fn attempt(&self, attempt: Attempt, spelling: &Spelling) -> Result<Option<Model>> {
        let folder = self.output.work(match attempt {
            Attempt { weak: false, .. } => "1",
            Attempt { masked, .. } if masked == self.masked => "2",
            _ => "3",
        });
        let (log, models) = (self.output.work(LOG), folder.join("models"));
        self.output.require_room(database_bytes(self.names.len(), self.is_video))?;
        io::create_folder(&models)?;
        let commands = self.commands(attempt, &folder, spelling);
        self.require(&commands.extractor, &log)?;
        self.require(&commands.matcher, &log)?;
        if let Some(calibrator) = &commands.calibrator {
            // a lens that it cannot calibrate keeps the focal length that was guessed
            self.run(&self.programs.colmap, calibrator, &log)?;
        }
        // a mapper that finds no model fails as well, but ends itself
        let (program, name) = self.programs.mapper();
        let crash = self.run(program, &commands.mapper, &log)?.filter(|failure| failure.is_crash);
        let names: HashSet<&String> = self.names.iter().collect();
        let (mut best, mut pieces, mut unreadable) = (None::<(PathBuf, SparseModel)>, 0, Vec::new());
        for folder in io::list_folders(&models)? {
            match SparseModel::read(&folder, &self.sfm.limits) {
                Ok(mut found) => {
                    found.names.retain(|name| names.contains(name));
                    pieces += 1;
                    if best.as_ref().is_none_or(|(_, other)| found.names.len() > other.names.len()) {
                        best = Some((folder, found));
                    }
                }
                Err(problem) => unreadable.push(problem),
            }
        }
        let enough = |found: &SparseModel| found.names.len() as f64 >= ENOUGH * self.names.len() as f64;
        if let Some(failure) = crash
            && !best.as_ref().is_some_and(|(_, found)| enough(found))
        {
            return Err(failed_command(name, &commands.mapper, &failure, &log));
        }
        match best {
            Some((folder, found)) => Ok(Some(Model { attempt, folder, found, pieces, unreadable })),
            None => unreadable.into_iter().next().map_or(Ok(None), Err),
        }
    }

    fn solve(self) -> Result<Solution> {
        self.list_names()?;
        let spelling = self.spelling()?;
        let (n, masked) = (self.names.len(), self.masked);
        let mut attempts = vec![Attempt { masked, weak: false }, Attempt { masked, weak: true }];
        if masked {
            attempts.push(Attempt { masked: false, weak: true });
        }
        let registered = |model: &Option<Model>| model.as_ref().map_or(0, |m| m.found.names.len());
        let is_usable = |found: usize| found >= MIN_VIEWS && 2 * found >= n;
        let (mut best, mut warnings) = (None::<Model>, self.warnings.clone());
        for attempt in attempts {
            if attempt.weak {
                let how =
                    if attempt.masked == masked { "with weak features as well" } else { "without masks" };
                let found = registered(&best);
                (self.sfm.say)(&format!("{found} of {n} photographs have a camera: once more, {how}"));
            }
            match self.attempt(attempt, &spelling) {
                Ok(model) if registered(&model) > registered(&best) => best = model,
                Ok(_) => {}
                // what an earlier attempt found counts, whatever becomes of another one
                Err(e) if is_usable(registered(&best)) && !e.kind().is_stop() => {
                    warnings.push(format!("another attempt failed: {e}"));
                    break;
                }
                Err(e) => return Err(e),
            }
            if registered(&best) as f64 >= ENOUGH * n as f64 {
                break;
            }
        }
        let found = registered(&best);
        let Some(model) = best.filter(|_| is_usable(found)) else {
            let what = format!("COLMAP found cameras for {found} of {n} photographs");
            let what = format!("{what}; its log is `{}`", self.output.work(LOG).display());
            return Err(Error::cannot(what, MORE_OVERLAP));
        };
        self.finish(model, warnings)
    }

    /// Names the photographs to COLMAP where a user has put other pictures beside them.
    fn list_names(&self) -> Result<()> {
        let names: HashSet<&String> = self.names.iter().collect();
        let inside = io::file_sizes(&self.sfm.out.join("images"), &|_| false)?;
        if inside.keys().any(|name| !names.contains(name)) {
            io::write_atomic(&self.output.work(NAMES), (self.names.join("\n") + "\n").as_bytes())?;
        }
        Ok(())
    }

    /// Refines the lens, and moves the model to where captures have it.
    fn finish(&self, model: Model, mut warnings: Vec<String>) -> Result<Solution> {
        let n = self.names.len();
        let left_out: Vec<String> =
            self.names.iter().filter(|name| !model.found.names.contains(*name)).cloned().collect();
        let registered = n - left_out.len();
        let SparseModel { error_px, .. } = model.found;
        if !left_out.is_empty() {
            let (names, left) = (few(&left_out), left_out.len());
            warnings.push(format!("{left} of {n} photographs have no camera, and are left out: {names}"));
        }
        if model.pieces > 1 {
            let text = "pieces that COLMAP could not join, of which the largest is used";
            warnings.push(format!("there are {} {text}", model.pieces));
        }
        warnings.extend(model.unreadable.iter().map(|problem| format!("a piece is left out: {problem}")));
        if error_px > MAX_ERROR_PX {
            let text = "the photographs are blurred, or do not show one still head";
            warnings.push(format!("the mean reprojection error is {error_px:.1} pixels: {text}"));
        }
        if self.masked && !model.attempt.masked {
            warnings.push("features of the background were used, too, so it must not have moved".into());
        }
        let refined = self.refined(&model)?.unwrap_or(model.folder);
        io::rename(&refined, &self.output.work("model"))?;
        self.open_model(registered, error_px)?;
        let solution = Solution {
            folder: self.sfm.out.clone(),
            photographs: n,
            registered,
            left_out,
            error_px,
            masked: model.attempt.masked,
            warnings,
        };
        self.output.finish(&self.request, &solution)?;
        Ok(solution)
    }

    /// Opens the model as `inspect` and `run` will: poses and lenses may be nonsense all the same.
    fn open_model(&self, registered: usize, error_px: f64) -> Result<()> {
        let limits = self.sfm.limits.clone();
        let options = CaptureOptions { masks: MaskSource::None, limits, ..CaptureOptions::default() };
        let folder = CaptureFolder::new(&self.sfm.out, &options)?;
        let files = ModelFiles::new("colmap/model", "bin");
        let mut listing = Listing::default();
        let problem = colmap::list(&folder, &files, &mut listing).err();
        let capture = build(&folder, "COLMAP", &mut listing);
        let views = capture.map_or(Vec::new(), |capture| capture.views);
        let is_at = |view: &View| view.camera.position == views[0].camera.position;
        let problem = problem.or_else(|| listing.problems.into_iter().next()).map(|e| e.to_string());
        let problem = problem.or_else(|| match views.len() {
            opened if opened < registered => {
                Some(format!("only {opened} of {registered} views can be opened"))
            }
            _ if views.iter().all(is_at) => Some("all its cameras are in one place".into()),
            _ => (!error_px.is_finite()).then(|| "its points have no reprojection error".into()),
        });
        let Some(problem) = problem else { return Ok(()) };
        let log = self.output.work(LOG);
        let what = format!("COLMAP's model cannot be used: {problem}; its log is `{}`", log.display());
        Err(Error::cannot(what, "repeat the command: COLMAP does not find the same twice"))
    }

    /// Returns the folder of the model with the lens refined; `None` where its principal point is
    /// not observable.
    fn refined(&self, model: &Model) -> Result<Option<PathBuf>> {
        let SparseModel { names, sightings, .. } = &model.found;
        let Some((side, before)) = model.found.shared_lens().filter(|_| self.shared) else { return Ok(None) };
        let is_observable =
            names.len() >= OBSERVABLE.0 && *sightings >= OBSERVABLE.1 && before[0] <= OBSERVABLE.2 * side;
        let Some(cameras) = model.found.as_opencv().filter(|_| is_observable) else { return Ok(None) };
        let (file, refined) = (model.folder.join("cameras.bin"), self.output.work("refined"));
        let given = io::read_bytes(&file, &self.sfm.limits)?;
        io::create_folder(&refined)?;
        io::write_atomic(&file, &cameras)?;
        let mut arguments: Vec<OsString> = vec!["bundle_adjuster".into(), "--input_path".into()];
        arguments.extend([OsString::from(&model.folder), "--output_path".into(), OsString::from(&refined)]);
        arguments.extend(["--BundleAdjustment.refine_principal_point", "1"].map(OsString::from));
        let failed = self.run(&self.programs.colmap, &arguments, &self.output.work(LOG))?;
        // without a refined model the mapper's remains
        let after = SparseModel::read(&refined, &self.sfm.limits).ok().filter(|_| failed.is_none());
        let after = after.and_then(|found| found.shared_lens());
        let is_near = |(_, lens): &(f64, [f64; 3])| {
            lens.iter().zip(&before).all(|(after, before)| (after - before).abs() <= MAX_MOVE * side)
        };
        io::write_atomic(&file, &given)?;
        Ok(after.filter(is_near).map(|_| refined))
    }
}

#[cfg(test)]
mod tests;
