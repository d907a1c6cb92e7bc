//! What a search for cameras needs before it begins: photographs that can be read, or frames of a
//! video, programs and room; and the copies that COLMAP works on.

use super::commands::Programs;
use super::output::{LOG, Output, PHOTOGRAPHS, Request};
use super::{MIN_VIEWS, MORE_OVERLAP, SfmOptions, Solution, Work, database_bytes};
use crate::folder::{CaptureFolder, FolderEntries, is_nameable, photographs, unnameable};
use crate::format::{self, CameraFiles};
use crate::frame::{CameraFrame, Intrinsics, Listing};
use crate::masks::few;
use crate::options::{CaptureOptions, MaskHead};
use crate::view::{Capture, View, ViewMask};
use crate::{build, convert};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::image::Photo;
use tiface_base::io::{self, Lock, VideoFrames};
use tiface_base::{Error, Fingerprint, Result};

const INSTALL_FFMPEG: &str = "install FFmpeg: `apt-get install ffmpeg` on Debian and Ubuntu, `brew install ffmpeg` on macOS, \
                              `winget install ffmpeg` on Windows";

/// A search for cameras that can begin: what may refuse it has been asked, and nothing has been
/// written.
pub struct Search<'a> {
    sfm: &'a SfmOptions<'a>,
    request: Request,
    work: Planned,
}

/// Work that a search has to do.
enum Planned {
    /// No work: the output folder has the result.
    Nothing(Solution),
    Photographs {
        capture: Box<Capture>,
        names: Vec<String>,
        files: Vec<String>,
        shared: bool,
        programs: Programs,
    },
    Video {
        video: PathBuf,
        every: usize,
        ffmpeg: PathBuf,
        programs: Programs,
    },
}

impl<'a> Search<'a> {
    /// Plans to find the cameras of a folder of photographs. Every photograph is read.
    ///
    /// # Errors
    ///
    /// Fails without COLMAP, if the folder has cameras or a picture cannot be read, if something
    /// would be overwritten, if the disk has too little room, and with
    /// [`ErrorKind::NotNow`](tiface_base::ErrorKind::NotNow) if another search works in the output
    /// folder.
    pub fn of_photographs(root: &Path, options: &CaptureOptions, sfm: &'a SfmOptions) -> Result<Search<'a>> {
        let options = CaptureOptions { downscale: 1, ..options.clone() };
        let mut capture = without_cameras(root, &options)?;
        let limits = &sfm.limits;
        let lens = |view: &View| {
            let info = io::picture_info(&view.photo, limits)?;
            Ok(((info.width, info.height), info.focal))
        };
        let lenses = capture.views.iter().map(lens).collect::<Result<HashSet<_>>>()?;
        let shared = lenses.len() == 1 && !sfm.lens_each;
        // everything is read once before the long work, and before anything is written
        let digests = capture.views.par_iter().map(|view| {
            view.load(limits)?;
            let mask = match &view.mask {
                ViewMask::File(file) => Fingerprint::of_file(file)?,
                own => format!("{own:?}"),
            };
            Ok((format!("{} {}", view.name, Fingerprint::of_file(&view.photo)?), mask))
        });
        let (photographs, mut masks): (Vec<_>, Vec<_>) =
            digests.collect::<Result<Vec<_>>>()?.into_iter().unzip();
        if options.head != MaskHead::White {
            masks.push(options.head.clone().into());
        }
        let digest = |parts: Vec<String>| Fingerprint::of_bytes(parts.join("\n").as_bytes());
        let fingerprint = asked(sfm).input(PHOTOGRAPHS, digest(photographs)).input("masks", digest(masks));
        let (output, request) = (Output::new(sfm), Request { source: io::real_path(root)?, fingerprint });
        if let Some(solution) = output.result_of(&request, None)? {
            return Ok(Search { sfm, request, work: Planned::Nothing(solution) });
        }
        capture.settle_masks(&options.head, limits)?;
        let programs = Programs::find(sfm)?;
        let (names, files) = convert::names_for_colmap(&capture)?;
        let copied: u64 = capture.views.iter().filter_map(|view| io::file_size(&view.photo)).sum();
        output.require_room(copied + database_bytes(names.len(), false))?;
        let capture = Box::new(capture);
        Ok(Search { sfm, request, work: Planned::Photographs { capture, names, files, shared, programs } })
    }

    /// Plans to find the cameras of the sharpest of each `every` frames of a video.
    ///
    /// # Errors
    ///
    /// Returns an error as [`Search::of_photographs`] does, and without FFmpeg.
    pub fn of_video(video: &Path, every: usize, sfm: &'a SfmOptions) -> Result<Search<'a>> {
        if !io::is_file(video) {
            return Err(Error::cannot(format!("there is no video `{}`", video.display()), "check the path"));
        }
        let fingerprint = asked(sfm).setting("every", every).input(PHOTOGRAPHS, Fingerprint::of_file(video)?);
        let request = Request { source: io::real_path(video)?, fingerprint };
        if let Some(solution) = Output::new(sfm).result_of(&request, None)? {
            return Ok(Search { sfm, request, work: Planned::Nothing(solution) });
        }
        let missing = || Error::cannot("`ffmpeg` is not installed", INSTALL_FFMPEG);
        let ffmpeg = io::find_program("ffmpeg").ok_or_else(missing)?;
        let programs = Programs::find(sfm)?;
        Output::new(sfm).require_room(database_bytes(MIN_VIEWS, true))?;
        Ok(Search { sfm, request, work: Planned::Video { video: video.into(), every, ffmpeg, programs } })
    }

    /// Returns whether the cameras have been found before.
    pub fn is_done(&self) -> bool {
        matches!(self.work, Planned::Nothing(_))
    }

    /// Finds the cameras, and leaves a capture; if the search [is done](Self::is_done), returns
    /// what was found before.
    ///
    /// # Errors
    ///
    /// Fails if a program does, if fewer than half of the photographs, or fewer than eight, are
    /// registered, and as the functions that plan it.
    pub fn run(self) -> Result<Solution> {
        let Search { sfm, request, work } = self;
        let output = Output::new(sfm);
        if let Planned::Nothing(solution) = work {
            return Ok(solution);
        }
        let (lock, found) = output.begin(&request)?;
        if let Some(solution) = found {
            return Ok(solution);
        }
        match work {
            Planned::Nothing(solution) => Ok(solution),
            Planned::Photographs { capture, names, files, shared, programs } => {
                let masked = copy_photographs(sfm, &output, &capture, &names, files)?;
                let (warnings, is_video) = (capture.warnings, false);
                Work { sfm, output, request, lock, programs, names, warnings, shared, masked, is_video }
                    .solve()
            }
            Planned::Video { video, every, ffmpeg, programs } => {
                let names = copy_frames(sfm, &output, &lock, &ffmpeg, &video, every)?;
                let (shared, masked, is_video) = (!sfm.lens_each, false, true);
                let warnings = Vec::new();
                Work { sfm, output, request, lock, programs, names, warnings, shared, masked, is_video }
                    .solve()
            }
        }
    }
}

/// Returns the fingerprint of the options.
pub(super) fn asked(sfm: &SfmOptions) -> Fingerprint {
    Fingerprint::default().setting("lens_each", sfm.lens_each).setting("glomap", sfm.glomap)
}

/// Copies photographs, and masks for the capture and for COLMAP; returns whether there are masks.
fn copy_photographs(
    sfm: &SfmOptions,
    output: &Output,
    capture: &Capture,
    names: &[String],
    mut files: Vec<String>,
) -> Result<bool> {
    let is_masked = |view: &View| view.mask != ViewMask::None;
    let masked = capture.views.iter().zip(names).filter(|(view, _)| is_masked(view));
    files.extend(masked.map(|(_, name)| format!("colmap/masks/{name}.png")));
    output.list(&files)?;
    convert::copy_for_colmap(capture, &sfm.out)?;
    let limits = &sfm.limits;
    // COLMAP ignores what is black: half transparent hair is the head's outline, which shows the
    // background as well
    capture.views.par_iter().zip(names).try_for_each(|(view, name)| -> Result<()> {
        let Some(mut mask) = view.load_mask(limits)? else { return Ok(()) };
        mask.values.iter_mut().for_each(|v| *v = if *v >= 128 { 255 } else { 0 });
        let file = output.work(&format!("masks/{name}.png"));
        file.parent().map_or(Ok(()), io::create_folder)?;
        Ok(io::write_png_gray(&file, &mask)?)
    })?;
    Ok(capture.views.iter().any(is_masked))
}

/// Writes the sharpest frames of a video, and returns their names.
fn copy_frames(
    sfm: &SfmOptions,
    output: &Output,
    lock: &Lock,
    ffmpeg: &Path,
    video: &Path,
    every: usize,
) -> Result<Vec<String>> {
    let images = sfm.out.join("images");
    io::create_folder(&images)?;
    (sfm.say)(&format!("ffmpeg decodes `{}`", video.display()));
    let mut names = Vec::new();
    let frames = VideoFrames::open(ffmpeg, video, &output.work(LOG), lock, &sfm.limits)?;
    sharpest(frames, every, |number, frame| {
        if (sfm.stop)() {
            return Err(Error::stopped("before its end").with_hint(""));
        }
        let name = format!("{number:06}.png");
        output.list(&[format!("images/{name}")])?;
        io::write_png_rgb(&images.join(&name), frame.width, frame.height, &frame.rgb)?;
        names.push(name);
        Ok(())
    })?;
    (sfm.say)(&format!("{} frames, the sharpest of each {every}", names.len()));
    require_enough(names.len(), video, "choose a smaller `--every`")?;
    Ok(names)
}

/// Hands on the sharpest of each `every` frames, with its number, and that of those left over at
/// the end.
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

/// Opens a folder of photographs as a capture whose cameras say nothing, for its photographs and
/// masks.
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
    let inside = FolderEntries::list(root).photographs().ok_or_else(none)?;
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
    let lens = Intrinsics { angle: [Some(1.0), None], ..Intrinsics::default() };
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

#[cfg(test)]
mod tests {
    use super::*;

    fn photo(width: u32, height: u32, value: impl Fn(u32, u32) -> u8) -> Photo {
        let rgb = (0..width * height).map(|i| [value(i % width, i / width); 3]).collect();
        Photo { width, height, rgb, alpha: None }
    }

    #[test]
    fn sharpness_is_the_mean_squared_step_along_rows_and_columns() {
        // 0 10   along rows 10² and 0², along columns 0² and 10²: 200 for four pixels
        // 0  0
        assert_eq!(sharpness(&photo(2, 2, |x, y| if (x, y) == (1, 0) { 10 } else { 0 })), 50.0);
        assert_eq!(sharpness(&photo(3, 1, |_, _| 7)), 0.0);
    }

    #[test]
    fn the_sharpest_of_each_window_is_kept_the_first_of_equal_ones_and_one_of_the_rest() {
        let steps = [3, 9, 1, /* */ 5, 5, 2, /* */ 0, 4];
        let frames = || steps.iter().map(|&step| Ok(photo(2, 1, move |x, _| if x == 0 { 0 } else { step })));
        let kept = |every: usize| {
            let mut kept = Vec::new();
            sharpest(frames(), every, |number, frame| {
                kept.push((number, frame.rgb[1][0]));
                Ok(())
            })
            .unwrap();
            kept
        };
        assert_eq!(kept(3), [(1, 9), (3, 5), (7, 4)]);
        assert_eq!(kept(1).len(), 8);
        assert_eq!(kept(100), [(1, 9)]);
        let cut = frames().take(2).chain([Err(Error::cannot("cut", ""))]);
        assert_eq!(sharpest(cut, 1, |_, _| Ok(())).unwrap_err().to_string(), "cut");
    }
}
