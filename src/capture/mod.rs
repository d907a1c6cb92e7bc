//! What was photographed, from where: a folder of photographs of one head with calibrated cameras.
//!
//! [`open`] recognises the format, checks every name, size and pose before anything is trained, and
//! leaves the world as the dataset has it. [`View::load`] brings one photograph with its masks into
//! memory; [`scene`] says where the head is; [`inspect`] reports everything that can be found wrong.

pub(crate) mod carve;
mod error;
mod foreign;
pub mod inspect;
mod listing;
mod llff;
mod load;
mod masks;
mod names;
mod pose;
pub mod scene;
pub mod synthetic;
mod transforms;
mod well_seen;

pub use error::CaptureError;
pub use load::LoadedView;
pub use masks::{coverage, findings, require_masks};
pub use well_seen::well_seen;

use crate::geom::Camera;
use crate::io::{self, Limits, PictureInfo, Turn};
use glam::{DVec3, Vec3};
use listing::{Frame, Listing};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// What a view is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Learned from.
    Train,
    /// Watched while learning.
    Val,
    /// Held out for the numbers.
    Test,
}

/// Where a view's head mask comes from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskSource {
    /// There is none.
    None,
    /// The photograph's own alpha channel.
    Alpha,
    /// A picture beside it.
    File(PathBuf),
}

/// Which masks to look for.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum MaskChoice {
    /// The first that is there: alpha, `mask_path`, `vit_mask/`, `masks/NAME.png`, `masks/NAME.jpg.png`.
    #[default]
    Auto,
    /// Only the photographs' alpha.
    Alpha,
    /// Only this folder, relative to the capture.
    Folder(String),
    /// None, even if there are some.
    None,
}

/// What the rest of the picture, outside a mask, is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskMeaning {
    /// Empty space: a head mask.
    #[default]
    Empty,
    /// Not looked at, as nerfstudio understands `mask_path`: it joins the valid mask.
    Ignore,
}

/// How to open a capture.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureOptions {
    /// Whole factor by which photographs are averaged down, at least 1.
    pub downscale: u32,
    /// Which masks to use.
    pub masks: MaskChoice,
    /// What they mean.
    pub mask_meaning: MaskMeaning,
    /// Metres per dataset unit.
    pub unit_m: f64,
    /// The world's up direction; found from the dataset when absent.
    pub up: Option<Vec3>,
    /// What is refused for its size.
    pub limits: Limits,
}

impl Default for CaptureOptions {
    fn default() -> CaptureOptions {
        CaptureOptions {
            downscale: 1,
            masks: MaskChoice::Auto,
            mask_meaning: MaskMeaning::Empty,
            unit_m: 1.0,
            up: None,
            limits: Limits::default(),
        }
    }
}

/// A folder of photographs of one head, understood.
#[derive(Clone, Debug, Serialize)]
pub struct Capture {
    /// The folder.
    pub root: PathBuf,
    /// Its name.
    pub name: String,
    /// The format, in words.
    pub format: String,
    /// Why it is taken for that, and what else was found: one sentence each.
    pub reasons: Vec<String>,
    /// Every view with a photograph, in the dataset's order, splits one after the other.
    pub views: Vec<View>,
    /// Unit vector up in the world: given by the options, else by the dataset (`up`), else the mean of
    /// the cameras' up vectors; the mean is snapped to a world axis within 20°, because datasets are
    /// nearly always aligned and an export is then turned by exactly 90°.
    pub up: Vec3,
    /// Metres per dataset unit.
    pub unit_m: f64,
    /// What a person should know; nothing here stops the work.
    pub warnings: Vec<String>,
}

/// One photograph with its camera.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct View {
    /// The photograph's path below the folder common to all, without ending: `024`, `left/07`.
    pub name: String,
    /// Its camera, at the size after downscaling.
    pub camera: Camera,
    /// What it is for.
    pub split: Split,
    /// The photograph.
    pub photo: PathBuf,
    /// Where its head mask is.
    pub mask: MaskSource,
    /// What the mask means.
    pub mask_meaning: MaskMeaning,
    /// Which pixels are usable (`.npy` or picture).
    pub valid: Option<PathBuf>,
    /// The region that metrics look at (`face_masks/NAME.png`).
    pub region: Option<PathBuf>,
    /// Factor from the declared size to the camera's.
    pub downscale: u32,
    /// Size of the stored photograph after any EXIF turn: `declared`, or the camera's if it is already
    /// reduced.
    pub photo_size: (u32, u32),
    /// Size the cameras were calibrated for, before downscaling.
    pub declared: (u32, u32),
    /// The file that declares it.
    pub declared_by: String,
}

impl Capture {
    /// The views of one split.
    pub fn split(&self, split: Split) -> impl Iterator<Item = &View> {
        self.views.iter().filter(move |v| v.split == split)
    }
}

/// Opens a capture, or says the first thing that is wrong with it; [`inspect::inspect`] says all.
pub fn open(root: &Path, options: &CaptureOptions) -> Result<Capture, CaptureError> {
    let found = gather(root, options);
    match (found.problems.into_iter().next(), found.capture) {
        (Some(problem), _) => Err(problem),
        (None, Some(capture)) => Ok(capture),
        (None, None) => Err(CaptureError::NoViews { root: root.into(), found: "no frames".into() }),
    }
}

/// A capture with everything that is wrong with it.
pub(crate) struct Gathered {
    pub capture: Option<Capture>,
    pub problems: Vec<CaptureError>,
    /// The largest disagreement of the two pose files, if there are two.
    pub agreements: Vec<llff::Agreement>,
}

/// The files that describe the cameras.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Format {
    /// `transforms*.json`, with the `poses_bounds*.npy` to check them against.
    Transforms { files: Vec<&'static str>, poses: Vec<&'static str> },
    /// `poses_bounds*.npy` alone.
    Llff { poses: Vec<&'static str> },
}

impl Format {
    fn of(root: &Path) -> Result<Format, CaptureError> {
        if !io::is_folder(root) {
            if io::is_file(root) {
                return Err(foreign::explain_file(root));
            }
            io::read_bytes(root, &Limits::default())?; // names what it is instead, or that it is not there
        }
        let there = |names: &[&'static str]| -> Vec<&'static str> {
            names.iter().copied().filter(|n| io::is_file(&root.join(n))).collect()
        };
        let split = there(&["transforms_train.json", "transforms_val.json", "transforms_test.json"]);
        let poses = match there(&["poses_bounds_train.npy", "poses_bounds_test.npy"]) {
            none if none.is_empty() => there(&["poses_bounds.npy"]),
            some => some,
        };
        if split.contains(&"transforms_train.json") {
            return Ok(Format::Transforms { files: split, poses });
        }
        let whole = there(&["transforms.json"]);
        if !whole.is_empty() {
            return Ok(Format::Transforms { files: whole, poses });
        }
        if !poses.is_empty() {
            return Ok(Format::Llff { poses });
        }
        Err(foreign::explain(root))
    }

    fn name(&self) -> &'static str {
        match self {
            Format::Transforms { poses, .. } if !poses.is_empty() => "transforms.json with LLFF poses",
            Format::Transforms { .. } => "transforms.json",
            Format::Llff { .. } => "LLFF poses",
        }
    }

    fn reasons(&self) -> Vec<String> {
        let quote = |names: &[&str]| names.iter().map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ");
        match self {
            Format::Transforms { files, poses } if !poses.is_empty() => {
                vec![format!("cameras from {}, checked against {}", quote(files), quote(poses))]
            }
            Format::Transforms { files, .. } => vec![format!("cameras from {}", quote(files))],
            Format::Llff { poses } => vec![format!("cameras from {}, no JSON beside", quote(poses))],
        }
    }
}

/// Reads and checks everything but the pixels.
pub(crate) fn gather(root: &Path, options: &CaptureOptions) -> Gathered {
    let stop = |problem| Gathered { capture: None, problems: vec![problem], agreements: Vec::new() };
    if options.downscale == 0 || !(options.unit_m > 0.0 && options.unit_m.is_finite()) {
        return stop(CaptureError::Option {
            problem: format!(
                "downscale {} and unit {} m must be positive",
                options.downscale, options.unit_m
            ),
        });
    }
    let format = match Format::of(root) {
        Ok(format) => format,
        Err(problem) => return stop(problem),
    };
    let place = match names::Place::new(root) {
        Ok(place) => place,
        Err(problem) => return stop(problem),
    };
    let (mut listing, mut agreements) = (Listing::default(), Vec::new());
    listing.reasons = format.reasons();
    match &format {
        Format::Transforms { files, poses } => {
            transforms::list(&place, files, options, &mut listing);
            if listing.problems.is_empty() {
                agreements = llff::check(&place, poses, options, &mut listing);
            }
        }
        Format::Llff { poses } => llff::list(&place, poses, options, &mut listing),
    }
    let capture = build(&place, format.name(), &mut listing, options);
    Gathered { capture, problems: listing.problems, agreements }
}

/// Frames with a photograph become views; what is wrong goes to the listing.
fn build(
    place: &names::Place,
    format: &str,
    listing: &mut Listing,
    options: &CaptureOptions,
) -> Option<Capture> {
    let total = listing.frames.len();
    let (frames, missing): (Vec<Frame>, Vec<Frame>) =
        std::mem::take(&mut listing.frames).into_iter().partition(|f| f.photo.is_some());
    if !missing.is_empty() {
        let list = masks::few(missing.iter().map(|f| f.name.as_str()));
        let text = format!("{} of {total} photographs are missing: {list}", missing.len());
        if frames.is_empty() {
            listing.problems.push(CaptureError::NoViews { root: place.root().into(), found: text });
            return None;
        }
        listing.warnings.push(format!("{text}; their views are left out"));
    }
    if frames.is_empty() {
        if listing.problems.is_empty() {
            let found = "the camera files list no frames".into();
            listing.problems.push(CaptureError::NoViews { root: place.root().into(), found });
        }
        return None;
    }

    let (folder, stems) = names::view_names(&frames);
    let mut seen: HashMap<&str, &str> = HashMap::new();
    let mut folded: HashMap<String, &str> = HashMap::new();
    for (frame, name) in frames.iter().zip(&stems) {
        if let Some(first) = seen.insert(name, &frame.name) {
            listing.problems.push(CaptureError::SameName {
                file: frame.file.clone(),
                name: name.clone(),
                first: first.into(),
                second: frame.name.clone(),
            });
        } else if let Some(twin) = folded.insert(name.to_lowercase(), name) {
            listing.warnings.push(format!(
                "the views `{twin}` and `{name}` differ only in case; on some disks their results would share a file"
            ));
        }
    }

    let infos: Vec<_> = frames
        .par_iter()
        .map(|f| io::picture_info(f.photo.as_deref().unwrap_or(Path::new("")), &options.limits))
        .collect();
    let mut turned = Vec::new();
    let mut views = Vec::new();
    let mut kept = Vec::new();
    for ((frame, name), info) in frames.into_iter().zip(stems).zip(infos) {
        let view = info
            .map_err(CaptureError::from)
            .and_then(|info| Ok((info, view(place, &frame, name, &info, options)?)));
        match view {
            Ok((info, view)) => {
                if info.exif > 1 && matches!(turn_of(&info, &view), Turn::Ignored(_)) {
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
            "{} photographs ask to be turned (EXIF) but are used as stored, as their cameras expect: {}",
            turned.len(),
            masks::few(turned.iter().map(String::as_str))
        ));
    }
    if views.is_empty() {
        return None;
    }
    name_splits(&mut views, &kept, listing);
    masks::choose(place, &folder, &mut views, &kept, options, listing);

    let up = up(&views, listing.up, options);
    let name = place.root().file_name().map_or("capture".into(), |n| n.to_string_lossy().into_owned());
    Some(Capture {
        root: place.root().into(),
        name,
        format: format.into(),
        reasons: std::mem::take(&mut listing.reasons),
        views,
        up,
        unit_m: options.unit_m,
        warnings: std::mem::take(&mut listing.warnings),
    })
}

fn turn_of(info: &PictureInfo, view: &View) -> Turn {
    let stored = (info.width, info.height);
    if info.size(Some(view.declared)) == stored { Turn::Ignored(info.exif) } else { Turn::Applied(info.exif) }
}

fn view(
    place: &names::Place,
    frame: &Frame,
    name: String,
    info: &PictureInfo,
    options: &CaptureOptions,
) -> Result<View, CaptureError> {
    let d = options.downscale;
    let declared = frame.lens.size.unwrap_or((info.width, info.height));
    let target = (declared.0 / d, declared.1 / d);
    let frame_error = |problem: String| CaptureError::Frame {
        file: frame.file.clone(),
        frame: frame.name.clone(),
        problem,
        hint: "correct that frame, or remove it".into(),
    };
    if target.0 == 0 || target.1 == 0 {
        return Err(frame_error(format!(
            "nothing is left of {} × {} pixels after dividing by {d}",
            declared.0, declared.1
        )));
    }
    let photo = frame.photo.clone().unwrap_or_default();
    let full = frame.lens.camera(declared, frame.rotation, frame.position).map_err(frame_error)?;
    let (camera, photo_size) = if info.size(Some(declared)) == declared {
        (load::downscaled(&full, d), declared)
    } else if info.size(Some(target)) == target {
        (full.resized(target.0, target.1), target) // the photographs are already smaller
    } else {
        let found = info.size(Some(declared));
        return Err(CaptureError::size(place.shown(&photo), found, declared, frame.file.clone(), d));
    };
    Ok(View {
        name,
        camera,
        split: frame.split.unwrap_or(Split::Train),
        photo,
        mask: MaskSource::None,
        mask_meaning: options.mask_meaning,
        valid: None,
        region: None,
        downscale: d,
        photo_size,
        declared,
        declared_by: frame.file.clone(),
    })
}

/// Named splits are kept; otherwise every 8th view in name order, starting with the first, is held out.
fn name_splits(views: &mut [View], kept: &[(Frame, PictureInfo)], listing: &mut Listing) {
    if kept.iter().any(|(f, _)| f.split.is_some()) {
        if !views.iter().any(|v| v.split == Split::Train) {
            listing.warnings.push("no view is marked for training".into());
        }
        if !views.iter().any(|v| v.split == Split::Test) {
            listing.warnings.push("no view is held out for testing".into());
        }
        return;
    }
    if views.len() < 4 {
        listing.warnings.push(format!("all {} views are trained on, none is held out", views.len()));
        return;
    }
    let mut order: Vec<usize> = (0..views.len()).collect();
    order.sort_by(|&a, &b| views[a].name.cmp(&views[b].name));
    for (rank, i) in order.into_iter().enumerate() {
        views[i].split = if rank % 8 == 0 { Split::Test } else { Split::Train };
    }
    listing.reasons.push("no splits are named: every 8th view in name order is held out for testing".into());
}

fn up(views: &[View], named: Option<DVec3>, options: &CaptureOptions) -> Vec3 {
    if let Some(up) = options.up.and_then(Vec3::try_normalize) {
        return up;
    }
    if let Some(up) = named {
        return up.normalize().as_vec3();
    }
    let mean: DVec3 = views.iter().map(|v| v.camera.rotation.y_axis).sum();
    // cameras whose ups cancel say nothing; +Y is what most formats mean
    let mean = mean.try_normalize().unwrap_or(DVec3::Y);
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    axes.iter()
        .flat_map(|&a| [a, -a])
        .find(|a| a.dot(mean) > 20f64.to_radians().cos())
        .unwrap_or(mean)
        .as_vec3()
}
