//! What was photographed, from where: a folder of photographs of one head with calibrated cameras.
//!
//! [`open`] recognizes the format, checks every name, size and pose before anything is trained, and
//! leaves the world as the dataset has it. [`View::load`] brings one photograph with its masks into
//! memory; [`scene`] says where the head is; [`inspect`] reports everything that can be found wrong.
//!
//! ```
//! use tiface::capture::{self, CaptureOptions, Split, synthetic};
//!
//! let folder = tempfile::tempdir()?;
//! let options = synthetic::SyntheticOptions { width: 24, height: 30, train: 4, test: 1, seed: 1 };
//! synthetic::write_capture(folder.path(), &options)?;
//!
//! let capture = capture::open(folder.path(), &CaptureOptions::default())?;
//! assert_eq!(capture.split(Split::Train).count(), 4);
//! let view = &capture.views[0];
//! let pixels = view.load(&Default::default())?;
//! assert_eq!((view.name.as_str(), pixels.photo.width, pixels.photo.height), ("000", 24, 30));
//! assert_eq!(pixels.mask.unwrap().values.len(), 24 * 30);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub(crate) mod carve;
mod colmap;
pub mod convert;
mod folder;
mod format;
mod frame;
pub mod inspect;
mod llff;
mod mask_names;
mod masks;
mod metashape;
mod missing;
mod near;
mod neus;
mod photo_checks;
mod realitycapture;
pub mod scene;
pub mod sfm;
pub mod synthetic;
mod transforms;
mod view;

pub use crate::config::{MaskMeaning, MaskSource};
pub use format::is_run;
pub use masks::{MASK_HINT, coverage, findings, refuse, require_masks};
pub use scene::well_seen;
pub(crate) use transforms::camera_like;
pub use view::{Capture, CaptureOptions, LoadedView, Split, View, ViewMask};

use crate::error::counted;
use crate::io::{self, PictureInfo};
use crate::{Error, Result};
use folder::{CaptureFolder, in_frame, no_views};
use format::CameraFiles;
use frame::{CameraFrame, Listing};
use glam::{DMat3, DVec3, Vec3};
use masks::few;
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::Path;
use view::{downscaled, wrong_size};

/// Opens a capture, or returns the first thing that is wrong with it; [`inspect::inspect`] returns all.
pub fn open(root: &Path, options: &CaptureOptions) -> Result<Capture> {
    let (capture, listing) = gather(root, options);
    match (listing.problems.into_iter().next(), capture) {
        (Some(problem), _) => Err(problem),
        (None, Some(capture)) => Ok(capture),
        (None, None) => Err(no_views(root, "no frames")),
    }
}

/// Returns whether a folder has camera files of a format that is read, whatever may be wrong with them.
pub fn has_cameras(root: &Path) -> bool {
    io::is_folder(root) && CameraFiles::find(root).is_some()
}

/// Returns the usable part of a capture, and everything that was found: problems, warnings, reasons.
fn gather(root: &Path, options: &CaptureOptions) -> (Option<Capture>, Listing) {
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
    Ok((CaptureFolder::new(root, options)?, files))
}

/// Frames with a photograph become views; what is wrong goes to the listing.
fn build(folder: &CaptureFolder, format: &str, listing: &mut Listing) -> Option<Capture> {
    let CaptureFolder { root, options, .. } = *folder;
    let total = listing.frames.len();
    let near = missing::settle(folder, listing);
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
            let problem = no_views(root, &(found + &there));
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

    let (common, names) = folder::view_names(&frames);
    check_names(&frames, &names, listing);
    let infos: Vec<_> = frames
        .par_iter()
        .map(|f| io::picture_info(f.photo.as_deref().unwrap_or(Path::new("")), &options.limits))
        .collect();
    let (mut turned, mut views, mut kept) = (Vec::new(), Vec::new(), Vec::new());
    for ((frame, name), info) in frames.into_iter().zip(names).zip(infos) {
        let view = info.map_err(Error::from).and_then(|i| Ok((i, view(folder, &frame, name, &i)?)));
        match view {
            Ok((info, view)) => {
                if info.exif > 1 && info.size(Some(view.declared)) == (info.width, info.height) {
                    turned.push(view.name.clone());
                }
                views.push(view);
                kept.push((frame, info));
            }
            Err(problem) => listing.problems.push(problem),
        }
    }
    if !turned.is_empty() {
        listing.warnings.push(format!(
            "EXIF asks to turn {}, used as stored, as the cameras expect: {}",
            counted(turned.len(), "photograph"),
            few(turned)
        ));
    }
    if views.is_empty() {
        return None;
    }
    name_splits(&mut views, &kept, listing);
    if let Err(problem) = masks::choose(folder, &common, &mut views, &kept, listing) {
        listing.problems.push(problem);
    }
    Some(Capture {
        root: root.into(),
        name: root.file_name().map_or("capture".into(), |n| n.to_string_lossy().into_owned()),
        format: format.into(),
        reasons: std::mem::take(&mut listing.reasons),
        up: up(&views, listing.up),
        focus: listing.focus.or_else(|| scene::around_points(&views, &listing.points)),
        views,
        unit_m: options.unit_m,
        stray_masks: listing.stray_masks.take(),
        warnings: std::mem::take(&mut listing.warnings),
    })
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

fn view(folder: &CaptureFolder, frame: &CameraFrame, name: String, info: &PictureInfo) -> Result<View> {
    let d = folder.options.downscale;
    let (w, h) = frame.intrinsics.size.unwrap_or((info.width, info.height));
    let declared = (w, h);
    let target = (w / d, h / d);
    let problem = |problem: String| in_frame(&frame.file, &frame.name, problem);
    if target.0 == 0 || target.1 == 0 {
        return Err(problem(format!("nothing is left of {w} × {h} pixels after dividing by {d}")));
    }
    let photo = frame.photo.clone().unwrap_or_default();
    let full = frame.intrinsics.camera(declared, frame.rotation, frame.position).map_err(problem)?;
    let (camera, photo_size) = if info.size(Some(declared)) == declared {
        (downscaled(&full, d), declared)
    } else if info.size(Some(target)) == target {
        (full.resized(target.0, target.1), target) // the photographs are already smaller
    } else {
        let found = info.size(Some(declared));
        return Err(wrong_size(&folder.shown(&photo), found, declared, &frame.file, d));
    };
    Ok(View {
        name,
        camera,
        split: frame.split.unwrap_or(Split::Train),
        photo,
        mask: ViewMask::None,
        mask_meaning: folder.options.mask_meaning,
        valid: None,
        region: None,
        downscale: d,
        photo_size,
        declared,
        declared_by: frame.file.clone(),
        exposure: None,
    })
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

/// Returns the splits of a capture that names none: every 8th view in name order, starting with the first, is held out,
/// but none of fewer than four.
fn every_eighth<'n>(names: impl Iterator<Item = &'n str>) -> Vec<Split> {
    let mut order: Vec<(&str, usize)> = names.zip(0..).collect();
    order.sort_unstable();
    let mut splits = vec![Split::Train; order.len()];
    if order.len() >= 4 {
        order.into_iter().step_by(8).for_each(|(_, i)| splits[i] = Split::Test);
    }
    splits
}

/// Up in the world: as the dataset says, else as the cameras stand.
fn up(views: &[View], named: Option<DVec3>) -> Vec3 {
    if let Some(up) = named {
        return up.normalize().as_vec3();
    }
    let up = upward(views.iter().map(|v| v.camera.rotation));
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|a| [a, -a]);
    let near = axes.into_iter().find(|a| a.dot(up) > 20f64.to_radians().cos());
    near.unwrap_or(up).as_vec3()
}

/// Returns the direction perpendicular to the right axes of cameras: those of a level camera are horizontal, however much it
/// looks down. Where all look the same way, it is the mean of their ups, which is tilted by how much they look down.
fn upward(cameras: impl Iterator<Item = DMat3> + Clone) -> DVec3 {
    /// Weight of the mean.
    const MEAN: f64 = 0.01;
    let mean: DVec3 = cameras.clone().map(|c| c.y_axis).sum();
    let n = cameras.clone().count() as f64;
    // cameras whose ups cancel say nothing; +Y is what most formats mean
    let Some(mean) = mean.try_normalize().filter(|_| mean.length() > 1e-6 * n) else { return DVec3::Y };
    let square =
        |c: DMat3| DMat3::from_cols(c.x_axis * c.x_axis.x, c.x_axis * c.x_axis.y, c.x_axis * c.x_axis.z);
    let spread = cameras.map(square).fold(MEAN * n * DMat3::IDENTITY, |sum, s| sum + s);
    (spread.inverse() * mean).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn up_is_found_in_any_world_although_cameras_in_front_look_down() {
        let world = DMat3::from_rotation_x(0.7) * DMat3::from_rotation_z(-0.5);
        let looking_down = |azimuth: f64| {
            world * DMat3::from_rotation_y(azimuth) * DMat3::from_rotation_x(-25f64.to_radians())
        };
        let off =
            |cameras: &[DMat3]| upward(cameras.iter().copied()).angle_between(world * DVec3::Y).to_degrees();
        let ring: Vec<DMat3> = (-8..=8).map(|i| looking_down(0.15 * f64::from(i))).collect();
        assert!(off(&ring) < 1.0, "{}", off(&ring));
        // the mean of their ups, where nothing else is known
        assert!((off(&[looking_down(0.0); 3]) - 25.0).abs() < 1e-6);
        // cameras that stand on their heads cancel the others
        assert_eq!(
            upward([DMat3::IDENTITY, DMat3::from_rotation_z(std::f64::consts::PI)].into_iter()),
            DVec3::Y
        );
    }
}
