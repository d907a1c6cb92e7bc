#![doc = include_str!("../README.md")]
//!
//! # Modules
//!
//! - [`open`] recognizes the format, checks every name, size and pose, and leaves the world as the
//!   dataset has it. [`View::load`] brings one photograph with its masks into memory.
//! - [`inspect`] reports everything that can be found wrong, and [`convert`] writes cameras in
//!   another format. [`sfm`] finds cameras by COLMAP.
//! - [`scene`] says where the head is, by the visual hull of the masks.
//! - [`rig`] measures how well poses fit each other, and finds better ones; [`rig::exposure`]
//!   measures exposures.
//! - [`path`] makes and reads the cameras of new views.
//! - [`synthetic`] photographs an analytic head.

mod carve;
mod colmap;
pub mod convert;
mod downscale;
mod folder;
mod format;
mod frame;
pub mod inspect;
mod lens_model;
mod llff;
mod mask_checks;
mod mask_names;
mod mask_values;
mod masks;
mod metashape;
mod missing;
mod near;
mod neus;
mod options;
mod order;
pub mod path;
mod photo_checks;
mod pose_folder;
mod programs;
mod projector;
mod realitycapture;
pub mod rig;
pub mod scene;
pub mod sfm;
pub mod synthetic;
mod table;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
mod transforms;
mod upright;
mod view;

pub use format::{not_a_capture, resembles_capture};
pub use mask_checks::{MASK_HINT, coverage, findings, refuse};
pub use mask_values::{MaskReading, MaskSurvey, MaskValues};
pub use masks::require_masks;
pub use options::{
    CameraPoses, CaptureOptions, Exposures, Glares, HeadValue, MaskHead, MaskMeaning, MaskSource, Reading,
};
pub use order::by_number;
pub use projector::Projector;
pub use scene::well_seen;
pub use view::{Capture, LoadedView, Split, View, ViewMask};

use downscale::downscaled;
use folder::{CaptureFolder, in_frame, no_views};
use format::CameraFiles;
use frame::{CameraFrame, Listing};
use glam::{DMat3, DVec3, Vec3};
use masks::few;
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::io::{self, Limits, PictureInfo};
use tiface_base::{Error, Result};
use view::{undone, wrong_size};

/// Opens a capture, or returns the first thing that is wrong with it; [`inspect::inspect`] returns
/// all.
pub fn open(root: &Path, options: &CaptureOptions) -> Result<Capture> {
    let (capture, listing) = gather(root, options);
    match (listing.problems.into_iter().next(), capture) {
        (Some(problem), _) => Err(problem),
        (None, Some(capture)) => Ok(capture),
        (None, None) => Err(no_views(root, "no frames")),
    }
}

/// Returns whether a folder has camera files of a format that is read, whatever may be wrong with
/// them.
pub fn has_cameras(root: &Path) -> bool {
    io::is_folder(root) && CameraFiles::find(root).is_some()
}

/// Returns the usable part of a capture, and everything that was found: problems, warnings,
/// reasons.
fn gather(root: &Path, options: &CaptureOptions) -> (Option<Capture>, Listing) {
    // messages join names to it: no `/` at its end
    let root = &root.components().collect::<PathBuf>();
    let mut listing = Listing::default();
    let (folder, files) = match open_folder(root, options) {
        Ok(opened) => opened,
        Err(problem) => {
            listing.problems.push(problem);
            return (None, listing);
        }
    };
    let (format, reason) = files.describe();
    listing.format = Some(format);
    listing.reasons.push(reason);
    let listed = match &files {
        CameraFiles::Transforms { json, poses } => {
            transforms::list(&folder, json, &mut listing);
            if listing.problems.is_empty() {
                llff::check(&folder, poses, &mut listing);
            }
            Ok(())
        }
        CameraFiles::Llff(poses) => llff::list(&folder, poses, &mut listing),
        CameraFiles::Colmap(files) => colmap::list(&folder, files, &mut listing),
        CameraFiles::Neus(file) => neus::list(&folder, file, &mut listing),
        CameraFiles::Metashape(file) => metashape::list(&folder, file, &mut listing),
        CameraFiles::RealityCapture(file) => realitycapture::list_csv(&folder, file, &mut listing),
        CameraFiles::Xmp(inside) => realitycapture::list_xmp(&folder, inside, &mut listing),
        CameraFiles::Poses(files) => pose_folder::list(&folder, files, &mut listing),
    };
    listing.problems.extend(listed.err());
    if let Err(problem) = options.limits.check_views(root, listing.frames.len()) {
        listing.problems.push(problem.into());
        listing.frames.clear();
    }
    (build(&folder, format, &mut listing), listing)
}

fn open_folder<'a>(root: &'a Path, options: &'a CaptureOptions) -> Result<(CaptureFolder<'a>, CameraFiles)> {
    let (downscale, unit_m) = (options.downscale, options.unit_m);
    if downscale == 0 || !(unit_m > 0.0 && unit_m.is_finite()) {
        return Err(Error::cannot(
            format_args!("downscale {downscale} and unit {unit_m} m must be positive"),
            "choose a whole factor of at least 1 and a positive unit",
        ));
    }
    if io::is_file(root) {
        return Err(format::explain_file(root));
    } else if !io::exists(root) {
        let meant = io::similar(root).map(|found| format!("did you mean `{}`? ", found.display()));
        let hint = "check the path: a capture is a folder of photographs and cameras";
        let hint = meant.unwrap_or_default() + hint;
        return Err(Error::cannot(format_args!("`{}` does not exist", root.display()), hint));
    } else if !io::is_folder(root) {
        io::read_bytes(root, &options.limits)?; // names what it is instead
    }
    let files = CameraFiles::find(root).ok_or_else(|| format::explain(root))?;
    if let Some(error) = format::without_photographs(root, &files) {
        return Err(error);
    }
    Ok((CaptureFolder::new(root, options)?, files))
}

/// Frames with a photograph become views; what is wrong goes to the listing.
fn build(folder: &CaptureFolder, format: &str, listing: &mut Listing) -> Option<Capture> {
    let CaptureFolder { root, options, .. } = *folder;
    let frames = frames_with_photographs(folder, listing)?;
    let (common, names) = folder::view_names(&frames);
    check_names(&frames, &names, listing);
    let UsableViews { mut views, kept, turn_is_open } = usable_views(folder, frames, names, listing);
    if views.is_empty() {
        return None;
    }
    name_splits(&mut views, &kept, listing);
    if let Err(problem) = masks::choose(folder, &common, &mut views, &kept, listing) {
        listing.problems.push(problem);
    }
    let has_files = views
        .iter()
        .zip(&kept)
        .any(|(view, (_, info))| info.is_turn_open() && matches!(view.mask, ViewMask::File(_)));
    let readings = match options.reading {
        Some(_) => Vec::new(),
        None => readings(listing, turn_is_open, has_files),
    };
    name_turned_masks(&views, &options.limits, listing);
    let (up, rolled) = up(&views, listing.up);
    listing.warnings.extend(rolled);
    Some(Capture {
        root: root.into(),
        name: root.file_name().map_or("capture".into(), |n| n.to_string_lossy().into_owned()),
        format: format.into(),
        reasons: std::mem::take(&mut listing.reasons),
        up,
        focus: listing.focus.or_else(|| scene::around_points(&views, &listing.points)),
        views,
        unit_m: options.unit_m,
        stray_masks: listing.stray_masks.take(),
        warnings: std::mem::take(&mut listing.warnings),
        readings,
    })
}

/// Returns the frames whose photograph is there, `None` if there are none; the listing tells of the
/// others.
fn frames_with_photographs(folder: &CaptureFolder, listing: &mut Listing) -> Option<Vec<CameraFrame>> {
    let total = listing.frames.len();
    let near = missing::confirm_near(folder, listing);
    let (frames, missing): (Vec<CameraFrame>, Vec<CameraFrame>) =
        std::mem::take(&mut listing.frames).into_iter().partition(|f| f.photo.is_some());
    let (mut found, mut there, mut hint) =
        ("the camera files list no frames".to_string(), String::new(), None);
    if !missing.is_empty() {
        let names = few(missing.iter().map(|f| &f.name));
        found = format!("{} of {total} photographs are missing: {names}", missing.len());
        (there, hint) = near.explain(folder, &missing, frames.is_empty());
    }
    if frames.is_empty() {
        if !missing.is_empty() || listing.problems.is_empty() {
            let problem = no_views(folder.root, &(found + &there));
            listing.problems.push(match hint {
                Some(hint) => problem.with_hint(hint),
                None => problem,
            });
        }
        return None;
    } else if !missing.is_empty() {
        let hint = hint.map_or(String::new(), |hint| format!("; {hint}"));
        listing.warnings.push(format!("{found}; their views are left out{there}{hint}"));
    }
    Some(frames)
}

/// The views that can be used, each with its frame and photograph.
struct UsableViews {
    views: Vec<View>,
    kept: Vec<(CameraFrame, PictureInfo)>,
    /// Whether nothing shows if some of the photographs are to be turned.
    turn_is_open: bool,
}

/// Makes a view of each frame whose photograph fits its camera; `names` are those of the views.
fn usable_views(
    folder: &CaptureFolder,
    frames: Vec<CameraFrame>,
    names: Vec<String>,
    listing: &mut Listing,
) -> UsableViews {
    let infos: Vec<_> = frames
        .par_iter()
        .map(|f| io::picture_info(f.photo.as_deref().unwrap_or(Path::new("")), &folder.options.limits))
        .collect();
    let (mut kept_turns, mut open_turns) = (Vec::new(), Vec::new());
    let (mut views, mut kept) = (Vec::new(), Vec::new());
    for ((frame, name), info) in frames.into_iter().zip(names).zip(infos) {
        let view = info.map_err(Error::from).and_then(|i| Ok((i, view(folder, &frame, name, &i)?)));
        match view {
            Ok((info, view)) => {
                let is_stored = info.size(Some(view.declared)) == (info.width, info.height);
                if is_turn_open(&frame, &info) {
                    open_turns.push(view.name.clone());
                } else if info.exif > 1 && is_stored {
                    kept_turns.push(view.name.clone());
                }
                views.push(view);
                kept.push((frame, info));
            }
            Err(problem) => listing.problems.push(problem),
        }
    }
    let is_read_as_asked = folder.options.reading.is_some();
    warn_of_turns(&kept_turns, if is_read_as_asked { &[] } else { &open_turns }, listing);
    UsableViews { views, kept, turn_is_open: !open_turns.is_empty() }
}

/// Warns of photographs that are used as stored although EXIF asks to turn them: those whose size
/// shows that this is right, and those of which nothing does.
fn warn_of_turns(kept: &[String], open: &[String], listing: &mut Listing) {
    let asks = |views: &[String]| format!("EXIF asks to turn {}", counted(views.len(), "photograph"));
    if !kept.is_empty() {
        listing.warnings.push(format!(
            "{}, used as stored, since the cameras are for that size: {}",
            asks(kept),
            few(kept)
        ));
    }
    if !open.is_empty() {
        listing.warnings.push(format!(
            "{}; nothing shows whether the cameras expect that, and they are used as stored: {}; look at them (`tiface \
             mask CAPTURE --page`), and if they are upside down, mirrored or on their side, store them turned, without \
             EXIF (ImageMagick: `magick mogrify -auto-orient FILES`)",
            asks(open),
            few(open)
        ));
    }
}

/// Returns the ways in which a capture can be read, that of its files' order and without turns
/// first; none where only that one is possible. `has_masks` says whether there are files of masks
/// that may be turned.
fn readings(listing: &Listing, turn_is_open: bool, has_masks: bool) -> Vec<Reading> {
    let choices = |is_open: bool| if is_open { &[false, true][..] } else { &[false][..] };
    let mut all = Vec::new();
    for &turned in choices(turn_is_open) {
        for &masks_turned in choices(turn_is_open && has_masks) {
            for &by_number in choices(listing.order_is_open) {
                for &masks_by_number in choices(listing.mask_order_is_open) {
                    all.push(Reading { by_number, masks_by_number, turned, masks_turned });
                }
            }
        }
    }
    if all.len() > 1 { all } else { Vec::new() }
}

/// Views of one name are a problem, names that differ only in case a warning.
fn check_names(frames: &[CameraFrame], names: &[String], listing: &mut Listing) {
    let mut seen: HashMap<&str, &str> = HashMap::new();
    let mut folded: HashMap<String, &str> = HashMap::new();
    for (CameraFrame { file, name: second, .. }, name) in frames.iter().zip(names) {
        if let Some(first) = seen.insert(name, second) {
            listing.problems.push(Error::cannot(
                format_args!("`{file}`: `{first}` and `{second}` would both be called `{name}`"),
                "rename one of the photographs, or remove one frame",
            ));
        } else if name.split('/').any(|part| part.starts_with('.')) {
            listing.warnings.push(format!(
                "the view `{name}` of `{second}` has a name that begins with a dot: its results are hidden files, which \
                 reports leave out; rename the photograph"
            ));
        } else if let Some(twin) = folded.insert(name.to_lowercase(), name) {
            listing.warnings.push(format!(
                "the views `{twin}` and `{name}` differ only in case; on some disks their results would share a file"
            ));
        }
    }
}

/// Returns whether the size of a photograph does not say whether its cameras expect the turn that
/// EXIF asks for.
fn is_turn_open(frame: &CameraFrame, info: &PictureInfo) -> bool {
    info.is_turn_open() || (info.exif > 4 && frame.intrinsics.size.is_none())
}

fn view(folder: &CaptureFolder, frame: &CameraFrame, name: String, info: &PictureInfo) -> Result<View> {
    let d = folder.options.downscale;
    let Reading { turned, masks_turned, .. } = folder.reading();
    let (w, h) = match frame.intrinsics.size {
        Some(size) => size,
        None if turned && info.exif > 4 => (info.height, info.width),
        None => (info.width, info.height),
    };
    let declared = (w, h);
    let target = (w / d, h / d);
    let problem = |problem: String| in_frame(&frame.file, &frame.name, problem);
    if target.0 == 0 || target.1 == 0 {
        return Err(problem(format!("nothing is left of {w} × {h} pixels after dividing by {d}")));
    }
    let photo = frame.photo.clone().unwrap_or_default();
    let turn = |is_turned: bool| (is_turned && info.is_turn_open()).then_some(info.exif);
    let full = frame.intrinsics.camera(declared, frame.rotation, frame.position).map_err(problem)?;
    let (camera, photo_size) = if info.size(Some(declared)) == declared {
        (downscaled(&full, d), declared)
    } else if info.size(Some(target)) == target {
        (full.resized(target.0, target.1), target) // the photographs are already smaller
    } else {
        let found = info.size(Some(declared));
        return Err(wrong_size(&folder.shown(&photo), found, declared, &frame.file, d));
    };
    let is_turned = photo_size != (info.width, info.height);
    let side_turn =
        (5..=8).contains(&info.exif).then(|| if is_turned { info.exif } else { undone(info.exif) });
    Ok(View {
        name,
        camera,
        split: frame.split.unwrap_or(Split::Train),
        photo,
        mask: ViewMask::None,
        mask_meaning: folder.options.mask_meaning,
        mask_reading: MaskReading::asked(&folder.options.head),
        valid: None,
        region: None,
        downscale: d,
        photo_size,
        side_turn,
        declared,
        declared_by: frame.file.clone(),
        turn: turn(turned),
        mask_turn: turn(masks_turned),
        exposure: None,
        glare: None,
    })
}

/// Says which masks lie on their side against a photograph that EXIF turns: they are turned when
/// they are read.
fn name_turned_masks(views: &[View], limits: &Limits, listing: &mut Listing) {
    let is_turned = |view: &&View| match &view.mask {
        ViewMask::File(path) if view.side_turn.is_some() => {
            // what cannot be read is said when it is read
            let info = io::picture_info(path, limits);
            info.is_ok_and(|info| view.turns(info.size(Some(view.photo_size))))
        }
        _ => false,
    };
    let turned: Vec<&str> = views.iter().filter(is_turned).map(|view| view.name.as_str()).collect();
    if !turned.is_empty() {
        listing.reasons.push(format!(
            "{} lie on their side against their photographs, and are turned as EXIF says of these: {}",
            counted(turned.len(), "mask"),
            few(turned)
        ));
    }
}

/// Named splits are kept; otherwise [`every_eighth`] view is held out.
fn name_splits(views: &mut [View], kept: &[(CameraFrame, PictureInfo)], listing: &mut Listing) {
    if kept.iter().any(|(f, _)| f.split.is_some()) {
        let wanted = [(Split::Train, "marked for training"), (Split::Test, "held out for testing")];
        for (_, text) in wanted.iter().filter(|(split, _)| !views.iter().any(|v| v.split == *split)) {
            listing.warnings.push(format!("no view is {text}"));
        }
        return;
    }
    if views.len() < 4 {
        listing.warnings.push(format!("all {} views are trained on, none is held out", views.len()));
        return;
    }
    let splits = every_eighth(views.iter().map(|v| v.name.as_str()));
    views.iter_mut().zip(splits).for_each(|(view, split)| view.split = split);
    listing.reasons.push("no splits are named: every 8th view in name order is held out for testing".into());
}

/// Returns the splits of a capture that names none: every 8th view in name order, starting with the
/// first, is held out, but none of fewer than four.
fn every_eighth<'n>(names: impl Iterator<Item = &'n str>) -> Vec<Split> {
    let mut order: Vec<(&str, usize)> = names.zip(0..).collect();
    order.sort_unstable();
    let mut splits = vec![Split::Train; order.len()];
    if order.len() >= 4 {
        order.into_iter().step_by(8).for_each(|(_, i)| splits[i] = Split::Test);
    }
    splits
}

/// Up in the world, as the dataset says, else as the cameras stand; and a warning if the cameras
/// are rolled.
fn up(views: &[View], named: Option<DVec3>) -> (Vec3, Option<String>) {
    if let Some(up) = named {
        return (up.normalize().as_vec3(), None);
    }
    let cameras: Vec<DMat3> = views.iter().map(|v| v.camera.rotation).collect();
    let (up, rolled) = upright::upward(&cameras);
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|a| [a, -a]);
    let near = axes.into_iter().find(|a| a.dot(up) > 20f64.to_radians().cos());
    let warning = (rolled > 0).then(|| {
        let (n, all) = (rolled, views.len());
        let half = if 2 * n > all { "; should it be upside down, name it with `up` in `transforms.json`" } else { "" };
        format!("{n} of {all} cameras are rolled by a quarter turn or more; up is where most image axes are level{half}")
    });
    (near.unwrap_or(up).as_vec3(), warning)
}
