//! Cameras of photographs that have none: structure from motion by COLMAP (Schönberger, Frahm 2016), a program that is
//! installed beside this one.
//!
//! Photographs, or the sharpest frames of a video, are copied to `OUT/images/`, with masks to `OUT/masks/`; COLMAP works in
//! `OUT/colmap/`, where its log stays, and the model is renamed to `OUT/sparse/0` at last, so that a folder that has it is
//! complete. Features are searched inside the head masks where there are any: behind a turntable the background moves
//! otherwise than the head. Where fewer than 80 % of the photographs are registered, a second attempt accepts weak
//! features as well, which smooth skin has more of, and a third one searches the whole photographs.
//!
//! The mapper fits one coefficient of distortion, because few views cannot tell more. A lens that all photographs share is
//! then refined as OPENCV's model with its principal point where that is observable: a wide lens and many points.

use super::colmap::Found;
use super::folder::{CaptureFolder, FolderEntries, is_nameable, photographs, unnameable};
use super::format::{self, CameraFiles};
use super::frame::{CameraFrame, Intrinsics, Listing};
use super::masks::few;
use super::view::{Capture, CaptureOptions, ViewMask};
use super::{build, convert};
use crate::error::counted;
use crate::image::Photo;
use crate::io::{self, Limits, Program, VideoFrames};
use crate::{Error, Result};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::HashSet;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// File of the programs' messages. It marks a folder as an attempt of ours, whose pictures the next attempt clears, so its name
/// is not one that other programs use.
const LOG: &str = "tiface_cameras.log";

/// Fewest photographs that a capture can have.
const MIN_VIEWS: usize = 8;

/// Share of the photographs with a camera that is enough: no other attempt is made.
const ENOUGH: f64 = 0.8;

/// Reprojection errors above this are warned of. Those of sharp photographs are below one pixel.
const MAX_ERROR_PX: f64 = 2.0;

/// Most pictures of which each is matched with every other; frames of a longer video with those near in time.
const MAX_EXHAUSTIVE: usize = 200;

/// A principal point is refined with this many registered photographs, of this many points each, and a focal length of at
/// most this many long sides. On a head of 24 photographs at 2.6 long sides and 180 points it moved by a quarter of the
/// width; on one of 50 at 0.7 and 690 it came within half a pixel of its calibration.
const OBSERVABLE: (usize, usize, f64) = (20, 300, 1.5);

/// How far refinement may move focal length and principal point to be believed, as a share of the longest side.
const MAX_MOVE: f64 = 0.05;

const INSTALL_COLMAP: &str = "install COLMAP: `apt-get install colmap` on Debian and Ubuntu, `brew install colmap` on macOS; on \
                              Windows, unpack the release from https://github.com/colmap/colmap/releases and add its folder \
                              to PATH";

const INSTALL_GLOMAP: &str = "leave out `--glomap`, or install GLOMAP: https://github.com/colmap/glomap";

const INSTALL_FFMPEG: &str = "install FFmpeg: `apt-get install ffmpeg` on Debian and Ubuntu, `brew install ffmpeg` on macOS, \
                              `winget install ffmpeg` on Windows";

/// Advice where too few photographs were registered.
const MORE_OVERLAP: &str = "photograph the head again, sharply and in even light, from all sides with 10° to 15° between \
                            neighbors, while it holds still; a textured background that stays with the head helps";

/// Where the result goes, and how it is found.
pub struct SfmOptions<'a> {
    /// The new capture.
    pub out: PathBuf,
    /// Whether each photograph has a lens of its own, even if sizes and focal lengths agree.
    pub lens_each: bool,
    /// Whether GLOMAP finds the poses from COLMAP's matches.
    pub glomap: bool,
    /// Limits of what is read.
    pub limits: Limits,
    /// Receives a line about each step.
    pub say: &'a dyn Fn(&str),
    /// Whether to stop.
    pub stop: &'a dyn Fn() -> bool,
}

/// Cameras that were found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Solution {
    /// The new capture.
    pub folder: PathBuf,
    /// Number of photographs, or of frames of the video.
    pub photographs: usize,
    /// Number of photographs with a camera.
    pub registered: usize,
    /// Photographs without a camera.
    pub left_out: Vec<String>,
    /// Mean reprojection error, pixels, of the mapper's model: before the principal point is refined.
    pub error_px: f64,
    /// Whether features were searched inside head masks only.
    pub masked: bool,
    /// What a user should know.
    pub warnings: Vec<String>,
}

/// Finds the cameras of a folder of photographs, and leaves a capture.
///
/// # Errors
///
/// Fails without COLMAP, if the folder has cameras or a picture cannot be read, if something finished would be overwritten,
/// and if fewer than half of the photographs, or fewer than eight, are registered.
pub fn from_photographs(root: &Path, options: &CaptureOptions, sfm: &SfmOptions) -> Result<Solution> {
    let options = CaptureOptions { downscale: 1, ..options.clone() };
    let capture = without_cameras(root, &options)?;
    let lens = |view: &super::View| {
        let info = io::picture_info(&view.photo, &sfm.limits)?;
        Ok(((info.width, info.height), info.focal))
    };
    let lenses = capture.views.iter().map(lens).collect::<Result<HashSet<_>>>()?;
    let limits = &sfm.limits;
    // everything is read once before the long work, and before anything is written
    capture.views.par_iter().try_for_each(|view| view.load(limits).map(drop))?;
    let programs = Programs::find(sfm)?;
    let masks = prepare(sfm, root)?.join("masks");
    let names = convert::copy_for_colmap(&capture, &sfm.out)?;
    // COLMAP ignores what is black: half transparent hair is the head's outline, which shows the background as well
    capture.views.par_iter().zip(&names).try_for_each(|(view, name)| -> Result<()> {
        let Some(mut mask) = view.load_mask(limits)? else { return Ok(()) };
        mask.values.iter_mut().for_each(|v| *v = if *v >= 128 { 255 } else { 0 });
        io::create_folder(&masks)?;
        Ok(io::write_png_gray(&masks.join(format!("{name}.png")), &mask)?)
    })?;
    let masked = capture.views.iter().any(|view| view.mask != ViewMask::None);
    let shared = lenses.len() == 1 && !sfm.lens_each;
    let found = Work { sfm, programs, names, shared, masked, is_video: false }.solve()?;
    Ok(Solution { warnings: [capture.warnings, found.warnings].concat(), ..found })
}

/// Finds the cameras of the sharpest of each `every` frames of a video, and leaves a capture of these frames.
///
/// # Errors
///
/// As [`from_photographs`], and without FFmpeg.
pub fn from_video(video: &Path, every: usize, sfm: &SfmOptions) -> Result<Solution> {
    if !io::is_file(video) {
        return Err(Error::cannot(format!("there is no video `{}`", video.display()), "check the path"));
    }
    let missing = || Error::cannot("`ffmpeg` is not installed", INSTALL_FFMPEG);
    let ffmpeg = io::find_program("ffmpeg").ok_or_else(missing)?;
    let programs = Programs::find(sfm)?;
    let log = prepare(sfm, video)?.join(LOG);
    let images = sfm.out.join("images");
    io::create_folder(&images)?;
    (sfm.say)(&format!("ffmpeg decodes `{}`", video.display()));
    let mut names = Vec::new();
    sharpest(VideoFrames::open(&ffmpeg, video, &log, &sfm.limits)?, every, |number, frame| {
        if (sfm.stop)() {
            return Err(Error::stopped("before its end").with_hint(""));
        }
        let name = format!("{number:06}.png");
        io::write_png_rgb(&images.join(&name), frame.width, frame.height, &frame.rgb)?;
        names.push(name);
        Ok(())
    })?;
    (sfm.say)(&format!("{} frames, the sharpest of each {every}", names.len()));
    require_enough(names.len(), video, "choose a smaller `--every`")?;
    Work { sfm, programs, names, shared: !sfm.lens_each, masked: false, is_video: true }.solve()
}

/// Hands on the sharpest of each `every` frames, with its number, and that of those left over at the end.
fn sharpest(
    frames: impl Iterator<Item = Result<Photo>>,
    every: usize,
    mut keep: impl FnMut(usize, &Photo) -> Result<()>,
) -> Result<()> {
    let mut best: Option<(f64, usize, Photo)> = None;
    for (i, frame) in frames.enumerate() {
        let frame = frame?;
        let sharpness = sharpness(&frame);
        if best.as_ref().is_none_or(|(of_best, ..)| sharpness > *of_best) {
            best = Some((sharpness, i, frame));
        }
        if (i + 1) % every.max(1) == 0
            && let Some((_, number, frame)) = best.take()
        {
            keep(number, &frame)?;
        }
    }
    best.map_or(Ok(()), |(_, number, frame)| keep(number, &frame))
}

/// Returns the mean squared gradient of the green channel, which blur lowers.
fn sharpness(photo: &Photo) -> f64 {
    let w = photo.width as usize;
    let squared = |a: &[u8; 3], b: &[u8; 3]| (i64::from(a[1]) - i64::from(b[1])).pow(2);
    let along = photo.rgb.chunks(w).flat_map(|row| row.windows(2)).map(|p| squared(&p[0], &p[1]));
    let down = photo.rgb.iter().zip(photo.rgb.iter().skip(w)).map(|(a, b)| squared(a, b));
    along.chain(down).sum::<i64>() as f64 / photo.rgb.len().max(1) as f64
}

/// Opens a folder of photographs as a capture whose cameras say nothing, for its photographs and masks.
fn without_cameras(root: &Path, options: &CaptureOptions) -> Result<Capture> {
    let shown = root.display();
    if io::is_file(root) {
        return Err(format::explain_file(root));
    }
    let folder = CaptureFolder::new(root, options)?;
    if let Some(files) = CameraFiles::find(root) {
        let what = format!("`{shown}` has cameras: `{}`", files.first());
        let hint =
            "`tiface inspect` says what they are; to find others, give a folder with the photographs alone";
        return Err(Error::cannot(what, hint));
    }
    let none = || {
        Error::cannot(
            format!("`{shown}` has no photographs, nor has `images/` in it"),
            "give the folder that holds them, as PNG or JPEG; for a video, `tiface cameras --video FILE`",
        )
    };
    let inside = FolderEntries::of(root).photographs().ok_or_else(none)?;
    let mut names = photographs(&inside)?;
    names.retain(|name| is_nameable(name));
    let unnameable = unnameable(&inside)?;
    let unnameable = (!unnameable.is_empty()).then(|| {
        let (count, names) = (counted(unnameable.len(), "photograph"), few(&unnameable));
        format!("{count} left out, whose name begins with a dot or has `\\` in it: {names}; rename what is to be used")
    });
    require_enough(names.len(), root, MORE_OVERLAP).map_err(|e| match &unnameable {
        Some(text) => Error::cannot(format!("{e}; {text}"), e.hint()),
        None => e,
    })?;
    let mut listing = Listing { warnings: Vec::from_iter(unnameable), ..Listing::default() };
    let base = inside.strip_prefix(root).unwrap_or(Path::new(""));
    let lens = Intrinsics { focal: [Some(1.0); 2], ..Intrinsics::default() };
    let pose = (DMat3::IDENTITY, DVec3::ZERO);
    for name in &names {
        let photo = folder.photo(name, &base.join(name).to_string_lossy())?;
        listing.frames.push(CameraFrame::new(name, name, photo, lens, pose));
    }
    let capture = build(&folder, "photographs", &mut listing);
    match (listing.problems.into_iter().next(), capture) {
        (None, Some(capture)) => Ok(capture),
        (problem, _) => Err(problem.unwrap_or_else(none)),
    }
}

fn require_enough(found: usize, place: &Path, hint: &str) -> Result<()> {
    if found >= MIN_VIEWS {
        return Ok(());
    }
    let place = place.display();
    Err(Error::cannot(
        format!("`{place}` has {found} photographs, and at least {MIN_VIEWS} are needed"),
        hint,
    ))
}

/// Creates the output folder, clears what an unfinished attempt left in it, and returns the folder that COLMAP works in.
fn prepare(sfm: &SfmOptions, from: &Path) -> Result<PathBuf> {
    let work = sfm.out.join("colmap");
    if io::exists(&sfm.out) {
        let is_inside = io::real_path(from)?.starts_with(io::real_path(&sfm.out)?);
        let is_empty = io::is_folder(&sfm.out)
            && io::list_files(&sfm.out)?.is_empty()
            && io::list_folders(&sfm.out)?.is_empty();
        let is_unfinished = io::is_file(&work.join(LOG)) && !io::exists(&sfm.out.join("sparse/0"));
        if is_inside || !is_empty && !is_unfinished {
            let message = format!("`{}` already exists", sfm.out.display());
            return Err(Error::cannot(message, "name a new folder with `--out`: nothing is overwritten"));
        }
        for folder in ["colmap", "images", "masks", "valid", "face_masks"] {
            io::clear_folder(&sfm.out.join(folder), "", &|_| false)?;
        }
    }
    io::create_folder(&work)?;
    io::write_atomic(&work.join(LOG), b"")?;
    Ok(work)
}

/// The programs that find cameras.
struct Programs {
    colmap: PathBuf,
    glomap: Option<PathBuf>,
}

impl Programs {
    fn find(sfm: &SfmOptions) -> Result<Programs> {
        let find = |name: &str, hint: &str| {
            io::find_program(name).ok_or_else(|| Error::cannot(format!("`{name}` is not installed"), hint))
        };
        let colmap = find("colmap", INSTALL_COLMAP)?;
        let glomap = sfm.glomap.then(|| find("glomap", INSTALL_GLOMAP)).transpose()?;
        Ok(Programs { colmap, glomap })
    }
}

/// What an attempt does differently from others.
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
    found: Found,
    /// How many models there are.
    pieces: usize,
}

/// Photographs in the output folder whose cameras are being found.
struct Work<'a> {
    sfm: &'a SfmOptions<'a>,
    programs: Programs,
    names: Vec<String>,
    /// All photographs are by one lens.
    shared: bool,
    masked: bool,
    is_video: bool,
}

impl Work<'_> {
    fn folder(&self, name: &str) -> PathBuf {
        self.sfm.out.join("colmap").join(name)
    }

    /// Shows a command as a user would type it, and runs it; returns what is wrong with its end, if anything.
    fn run(&self, program: &Path, arguments: &[OsString], log: &Path) -> Result<Option<String>> {
        let words: Vec<_> = arguments.iter().map(|word| word.to_string_lossy()).collect();
        let name = program.file_stem().unwrap_or_default().to_string_lossy();
        (self.sfm.say)(&format!("{name} {}", words.join(" ")));
        Program::start(program, arguments, log, false)?.wait(self.sfm.stop)
    }

    /// Runs a command of COLMAP that has to succeed.
    fn require(&self, arguments: &[OsString], log: &Path) -> Result<()> {
        let Some(wrong) = self.run(&self.programs.colmap, arguments, log)? else { return Ok(()) };
        let (command, log) = (arguments[0].to_string_lossy(), log.display());
        let hint = "the end of the log says why; if memory ran out, set RAYON_NUM_THREADS=1, which is COLMAP's number of \
                    threads as well, or reduce the photographs";
        Err(Error::cannot(format!("`colmap {command}` failed ({wrong}); its log is `{log}`"), hint))
    }

    /// Returns whether COLMAP names options as since 3.13, which moved some from `Sift…` to `Feature…`.
    fn has_new_names(&self) -> Result<bool> {
        let help = self.folder("options.txt");
        self.require(&["feature_extractor".into(), "-h".into()], &help)?;
        let text = io::read_maybe_empty(&help, &self.sfm.limits)?;
        Ok(String::from_utf8_lossy(&text).contains("FeatureExtraction.use_gpu"))
    }

    /// Returns the arguments of feature extraction, matching and mapping.
    fn arguments(&self, attempt: Attempt, folder: &Path, new_names: bool) -> [Vec<OsString>; 3] {
        let Attempt { masked, weak } = attempt;
        let threads = rayon::current_num_threads().to_string();
        let kind = if new_names { "Feature" } else { "Sift" };
        let on_cpu = |task: &str| format!("--{kind}{task}.use_gpu 0 --{kind}{task}.num_threads {threads}");
        let [database, models] = ["database.db", "models"].map(|name| folder.join(name));
        let (images, masks) = (self.sfm.out.join("images"), self.folder("masks"));
        let command = |name: &str, paths: &[(&str, &Path)], words: String| -> Vec<OsString> {
            let paths = paths.iter().flat_map(|(option, path)| [OsString::from(option), path.into()]);
            let words = words.split_whitespace().map(OsString::from);
            [name.into()].into_iter().chain(paths).chain(words).collect()
        };
        let database: (&str, &Path) = ("--database_path", &database);
        let paths = [database, ("--image_path", &images), ("--ImageReader.mask_path", &masks)];
        let mut words = on_cpu("Extraction") + " --ImageReader.camera_model SIMPLE_RADIAL";
        words += if self.shared { " --ImageReader.single_camera 1" } else { "" };
        if weak {
            words += " --SiftExtraction.peak_threshold 0.002 --SiftExtraction.estimate_affine_shape 1 \
                      --SiftExtraction.domain_size_pooling 1";
        }
        let extractor = command("feature_extractor", &paths[..if masked { 3 } else { 2 }], words);
        let is_long = self.is_video && self.names.len() > MAX_EXHAUSTIVE;
        let matcher = if is_long { "sequential_matcher" } else { "exhaustive_matcher" };
        let guided = if weak { format!(" --{kind}Matching.guided_matching 1") } else { String::new() };
        let matcher = command(matcher, &[database], on_cpu("Matching") + &guided);
        let is_glomap = self.programs.glomap.is_some();
        let words = if is_glomap { String::new() } else { format!("--Mapper.num_threads {threads}") };
        let mapper = command("mapper", &[paths[0], paths[1], ("--output_path", &models)], words);
        [extractor, matcher, mapper]
    }

    /// Returns the largest model that an attempt finds.
    fn attempt(&self, attempt: Attempt, new_names: bool) -> Result<Option<Model>> {
        let folder = self.folder(match attempt {
            Attempt { weak: false, .. } => "1",
            Attempt { masked, .. } if masked == self.masked => "2",
            _ => "3",
        });
        let (log, models) = (self.folder(LOG), folder.join("models"));
        io::create_folder(&models)?;
        let [extractor, matcher, mapper] = self.arguments(attempt, &folder, new_names);
        self.require(&extractor, &log)?;
        self.require(&matcher, &log)?;
        // a mapper that finds no model fails as well
        self.run(self.programs.glomap.as_ref().unwrap_or(&self.programs.colmap), &mapper, &log)?;
        let folders = io::list_folders(&models)?;
        let all = folders.iter().map(|folder| Ok((folder, Found::read(folder, &self.sfm.limits)?)));
        let all = all.collect::<Result<Vec<_>>>()?;
        let pieces = all.len();
        let best = all.into_iter().rev().max_by_key(|(_, found)| found.names.len());
        Ok(best.map(|(folder, found)| Model { attempt, folder: folder.clone(), found, pieces }))
    }

    fn solve(self) -> Result<Solution> {
        let new_names = self.has_new_names()?;
        let (n, masked) = (self.names.len(), self.masked);
        let mut attempts = vec![Attempt { masked, weak: false }, Attempt { masked, weak: true }];
        if masked {
            attempts.push(Attempt { masked: false, weak: true });
        }
        let registered = |model: &Option<Model>| model.as_ref().map_or(0, |m| m.found.names.len());
        let mut best: Option<Model> = None;
        for attempt in attempts {
            if attempt.weak {
                let how =
                    if attempt.masked == masked { "with weak features as well" } else { "without masks" };
                let found = registered(&best);
                (self.sfm.say)(&format!("{found} of {n} photographs have a camera: once more, {how}"));
            }
            let model = self.attempt(attempt, new_names)?;
            if registered(&model) > registered(&best) {
                best = model;
            }
            if registered(&best) as f64 >= ENOUGH * n as f64 {
                break;
            }
        }
        let found = registered(&best);
        let Some(model) = best.filter(|_| found >= MIN_VIEWS && 2 * found >= n) else {
            let what = format!("COLMAP found cameras for {found} of {n} photographs");
            let what = format!("{what}; its log is `{}`", self.folder(LOG).display());
            return Err(Error::cannot(what, MORE_OVERLAP));
        };
        self.finish(model)
    }

    /// Refines the lens, and moves the model to where captures have it.
    fn finish(&self, model: Model) -> Result<Solution> {
        let n = self.names.len();
        let left_out: Vec<String> =
            self.names.iter().filter(|name| !model.found.names.contains(*name)).cloned().collect();
        let registered = n - left_out.len();
        let mut warnings = Vec::new();
        let Found { error_px, .. } = model.found;
        if !left_out.is_empty() {
            let (names, left) = (few(&left_out), left_out.len());
            warnings.push(format!("{left} of {n} photographs have no camera, and are left out: {names}"));
        }
        if model.pieces > 1 {
            let text = "pieces that COLMAP could not join, of which the largest is used";
            warnings.push(format!("there are {} {text}", model.pieces));
        }
        if error_px > MAX_ERROR_PX {
            let text = "the photographs are blurred, or do not show one still head";
            warnings.push(format!("the mean reprojection error is {error_px:.1} pixels: {text}"));
        }
        if self.masked && !model.attempt.masked {
            warnings.push("features of the background were used, too, so it must not have moved".into());
        }
        let refined = self.refined(&model)?.unwrap_or(model.folder);
        io::create_folder(&self.sfm.out.join("sparse"))?;
        io::rename(&refined, &self.sfm.out.join("sparse/0"))?;
        io::clear_folder(&self.folder(""), LOG, &|_| false)?;
        Ok(Solution {
            folder: self.sfm.out.clone(),
            photographs: n,
            registered,
            left_out,
            error_px,
            masked: model.attempt.masked,
            warnings,
        })
    }

    /// Returns the folder of the model with the lens refined; `None` where its principal point is not observable.
    fn refined(&self, model: &Model) -> Result<Option<PathBuf>> {
        let Found { names, sightings, .. } = &model.found;
        let Some((side, before)) = model.found.shared_lens().filter(|_| self.shared) else { return Ok(None) };
        let is_observable =
            names.len() >= OBSERVABLE.0 && *sightings >= OBSERVABLE.1 && before[0] <= OBSERVABLE.2 * side;
        let Some(cameras) = model.found.as_opencv().filter(|_| is_observable) else { return Ok(None) };
        let (file, refined) = (model.folder.join("cameras.bin"), self.folder("refined"));
        let given = io::read_bytes(&file, &self.sfm.limits)?;
        io::create_folder(&refined)?;
        io::write_atomic(&file, &cameras)?;
        let mut arguments: Vec<OsString> = vec!["bundle_adjuster".into(), "--input_path".into()];
        arguments.extend([OsString::from(&model.folder), "--output_path".into(), OsString::from(&refined)]);
        arguments.extend(["--BundleAdjustment.refine_principal_point", "1"].map(OsString::from));
        let wrong = self.run(&self.programs.colmap, &arguments, &self.folder(LOG))?;
        // without a refined model the mapper's remains
        let after = Found::read(&refined, &self.sfm.limits).ok().filter(|_| wrong.is_none());
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
