//! A capture and its views, as they are used from here on.

use crate::config::{MaskMeaning, MaskSource};
use crate::geom::{Aabb, Camera};
use crate::io::Limits;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

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

/// Where the head mask of one view is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ViewMask {
    /// There is none.
    None,
    /// The photograph's own alpha channel.
    Alpha,
    /// A picture beside it.
    File(PathBuf),
}

impl From<Option<PathBuf>> for ViewMask {
    fn from(file: Option<PathBuf>) -> ViewMask {
        file.map_or(ViewMask::None, ViewMask::File)
    }
}

/// How to open a capture.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureOptions {
    /// Whole factor by which photographs are averaged down, at least 1.
    pub downscale: u32,
    /// Which masks to use: those that are there, unless another source is set; none with [`MaskSource::Clicks`].
    pub masks: MaskSource,
    /// The only folder of masks, relative to the capture; empty to look beside the photographs.
    pub mask_dir: String,
    /// What they mean.
    pub mask_meaning: MaskMeaning,
    /// Are masks that cannot be right a matter of warnings only?
    pub trust_masks: bool,
    /// Metres per dataset unit.
    pub unit_m: f64,
    /// What is refused for its size.
    pub limits: Limits,
}

impl Default for CaptureOptions {
    fn default() -> CaptureOptions {
        CaptureOptions {
            downscale: 1,
            masks: MaskSource::Auto,
            mask_dir: String::new(),
            mask_meaning: MaskMeaning::Empty,
            trust_masks: false,
            unit_m: 1.0,
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
    /// Unit vector up in the world: given by the dataset (`up`), else the mean of
    /// the cameras' up vectors; the mean is snapped to a world axis within 20°, because datasets are
    /// nearly always aligned and an export is then turned by exactly 90°.
    pub up: Vec3,
    /// Where the dataset says the head is, in the world; of use where no masks say it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focus: Option<Aabb>,
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
    pub mask: ViewMask,
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
