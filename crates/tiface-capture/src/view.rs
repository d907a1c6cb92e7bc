//! A capture and its views, as they are used from here on; and one view's pixels: photograph and
//! masks at the camera's size.

use super::downscale::{Average, average_gray, average_photo};
use super::mask_values::{MaskReading, MaskSurvey, MaskValues};
use super::options::{MaskHead, MaskMeaning, Reading};
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use tiface_base::geom::{Aabb, Camera};
use tiface_base::image::{Exposure, Glare, Gray, Photo};
use tiface_base::io::{self, Limits, NpyValues};
use tiface_base::{Error, Result};

/// Use of a view.
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
    /// Unit vector up in the world: given by the dataset (`up`), else the mean of the cameras' up
    /// vectors; the mean is snapped to a world axis within 20°, because datasets are nearly always
    /// aligned and an export is then turned by exactly 90°.
    pub up: Vec3,
    /// Where the dataset says the head is, in the world; of use where no masks say it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focus: Option<Aabb>,
    /// Meters per dataset unit.
    pub unit_m: f64,
    /// Where no mask is found: pictures that may be masks, and why they are not used, in a
    /// sentence.
    #[serde(skip)]
    pub stray_masks: Option<String>,
    /// Warnings, none of which stops the work.
    pub warnings: Vec<String>,
    /// All ways in which it can be read where its files leave something open, this one first; else
    /// none.
    #[serde(skip)]
    pub readings: Vec<Reading>,
}

/// One photograph with its camera.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct View {
    /// The photograph's path below the folder common to all, without ending: `024`, `left/07`.
    pub name: String,
    /// Its camera, at the size after downscaling.
    pub camera: Camera,
    /// Use of the view.
    pub split: Split,
    /// The photograph.
    pub photo: PathBuf,
    /// Where its head mask is.
    pub mask: ViewMask,
    /// Meaning of the mask's values.
    pub mask_meaning: MaskMeaning,
    /// How the pixels of its file are read.
    #[serde(default, skip_serializing_if = "MaskReading::is_white")]
    pub mask_reading: MaskReading,
    /// Which pixels are usable (`.npy` or picture).
    pub valid: Option<PathBuf>,
    /// The region that metrics look at (`face_masks/NAME.png`).
    pub region: Option<PathBuf>,
    /// Factor from the declared size to the camera's.
    pub downscale: u32,
    /// Size of the stored photograph after any EXIF turn: `declared`, or the camera's if it is
    /// already reduced.
    pub photo_size: (u32, u32),
    /// EXIF orientation, 5 to 8, that takes a mask which lies on its side to the photograph as it
    /// is read: the turn of the photograph's EXIF for a mask of the stored pixels, else its
    /// inverse.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub side_turn: Option<u8>,
    /// Size the cameras were calibrated for, before downscaling.
    pub declared: (u32, u32),
    /// The file that declares it.
    pub declared_by: String,
    /// The EXIF orientation by which the stored photograph is turned although its size does not ask
    /// for it.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub turn: Option<u8>,
    /// Orientation of the pictures of its mask, its usable pixels and its region.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mask_turn: Option<u8>,
    /// The exposure that is divided out of the photograph when it is read.
    #[serde(skip)]
    pub exposure: Option<Exposure>,
    /// The glare of lamps that is taken out of the photograph when it is read with its mask.
    #[serde(skip)]
    pub glare: Option<Glare>,
}

impl Capture {
    /// Returns the views of one split.
    pub fn split(&self, split: Split) -> impl Iterator<Item = &View> {
        self.views.iter().filter(move |v| v.split == split)
    }

    /// Reads all mask files in this way from here on.
    pub fn read_masks_as(&mut self, reading: &MaskReading) {
        self.views.iter_mut().for_each(|view| view.mask_reading = reading.clone());
    }

    /// Reads every mask file once and decides how all are read, for what uses a capture without the
    /// stage `mask`.
    ///
    /// # Errors
    ///
    /// Fails if a mask cannot be read, or if the values of the masks do not say what is head.
    pub fn settle_masks(&mut self, head: &MaskHead, limits: &Limits) -> Result<()> {
        self.read_masks_as(&MaskReading::asked(head));
        let mut survey = MaskSurvey::default();
        let is_file = |view: &&View| matches!(view.mask, ViewMask::File(_));
        let masked: Vec<&View> = self.views.iter().filter(is_file).collect();
        for views in masked.chunks(8) {
            let found = views.par_iter().map(|view| -> Result<_> {
                let mut values = None;
                let mask = view.load_mask_examined(limits, Some(&mut values))?;
                Ok((mask, values))
            });
            for (view, (mask, values)) in views.iter().zip(found.collect::<Result<Vec<_>>>()?) {
                view.survey(values, mask.as_ref(), &mut survey);
            }
        }
        let reading = survey.reading(head, &self.root)?;
        self.reasons.extend(survey.reasons(&reading));
        self.warnings.extend(survey.warnings(&reading));
        self.read_masks_as(&reading);
        Ok(())
    }
}

/// The pixels of a [`View`], all at the size of its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedView {
    /// Its camera: in the world, or for training in scene coordinates (the head's box is [-1, 1]³).
    pub camera: Camera,
    /// The photograph; its alpha is kept even when it is also the mask.
    pub photo: Photo,
    /// Soft head alpha: 0 = empty space. `None` without a mask, or when it means "not looked at".
    pub mask: Option<Gray>,
    /// 255 where the photograph is usable, else 0.
    pub valid: Option<Gray>,
    /// The region that metrics look at.
    pub region: Option<Gray>,
}

impl View {
    /// Returns a view of which nothing but name and camera matters.
    #[cfg(any(test, feature = "testing"))]
    pub fn bare(name: &str, camera: Camera) -> View {
        let size = (camera.width, camera.height);
        View {
            name: name.into(),
            camera,
            split: Split::Train,
            photo: PathBuf::new(),
            mask: ViewMask::None,
            mask_meaning: MaskMeaning::Empty,
            mask_reading: MaskReading::default(),
            side_turn: None,
            valid: None,
            region: None,
            downscale: 1,
            photo_size: size,
            declared: size,
            declared_by: String::new(),
            turn: None,
            mask_turn: None,
            exposure: None,
            glare: None,
        }
    }

    /// Reads the photograph alone, at the size of its camera, with its exposure divided out. Glare
    /// stays in: a mask tells lamps from the head.
    pub fn load_photo(&self, limits: &Limits) -> Result<Photo> {
        Ok(self.evened_out(self.stored_photo(limits)?))
    }

    fn evened_out(&self, photo: Photo) -> Photo {
        match &self.exposure {
            Some(exposure) => exposure.divided_out(photo),
            None => photo,
        }
    }

    /// Reads the photograph at its own size, turned as the camera sees it.
    pub fn whole_photo(&self, limits: &Limits) -> Result<Photo> {
        let photo = io::read_photo(&self.photo, Some(self.photo_size), limits)?;
        Ok(match self.turn {
            Some(exif) => io::turned_photo(photo, exif),
            None => photo,
        })
    }

    fn stored_photo(&self, limits: &Limits) -> Result<Photo> {
        let photo = self.whole_photo(limits)?;
        let found = (photo.width, photo.height);
        if found != self.photo_size {
            // it was replaced since the capture was opened
            return Err(self.size_error(&self.photo, found));
        }
        if found == (self.camera.width, self.camera.height) {
            return Ok(photo);
        }
        Ok(average_photo(&photo, self.downscale))
    }

    /// Reads the photograph, mask, valid mask and region of this view.
    pub fn load(&self, limits: &Limits) -> Result<LoadedView> {
        self.load_examined(limits, None)
    }

    /// [`View::load`], which also counts the values of the mask's file, if there is one.
    pub(crate) fn load_examined(
        &self,
        limits: &Limits,
        values: Option<&mut Option<MaskValues>>,
    ) -> Result<LoadedView> {
        let photo = self.stored_photo(limits)?;
        let mask = self.head_mask(photo.alpha.as_deref(), limits, values)?;
        // glare was measured at the photograph's own exposure
        let photo = match (&self.glare, &mask) {
            (Some(glare), Some(mask)) => glare.taken_out(photo, mask),
            _ => photo,
        };
        let photo = self.evened_out(photo);
        let valid = self
            .valid
            .as_deref()
            .map(|path| self.reduced(path, self.read_valid(path, limits)?, Average::Least));
        let mut valid = valid.transpose()?;
        let mask = match (mask, self.mask_meaning) {
            (Some(mask), MaskMeaning::Ignore) => {
                let looked_at = |m: u8, v: u8| if m >= 128 && v != 0 { 255 } else { 0 };
                let old = valid.take().map_or_else(|| vec![255; mask.values.len()], |v| v.values);
                let values = mask.values.iter().zip(old).map(|(&m, v)| looked_at(m, v)).collect();
                valid = Some(Gray { values, ..mask });
                None
            }
            (mask, _) => mask,
        };
        let region = self.region.as_deref().map(|path| {
            let region = io::read_gray(path, Some(self.photo_size), limits)?;
            self.reduced(path, region, Average::Mean)
        });
        let region = region.transpose()?;
        Ok(LoadedView { camera: self.camera.clone(), photo, mask, valid, region })
    }

    /// Returns the mask of this view at the camera's size, without its meaning; `None` without one.
    pub fn load_mask(&self, limits: &Limits) -> Result<Option<Gray>> {
        self.load_mask_examined(limits, None)
    }

    /// [`View::load_mask`], which also counts the values of the mask's file, if there is one.
    pub fn load_mask_examined(
        &self,
        limits: &Limits,
        values: Option<&mut Option<MaskValues>>,
    ) -> Result<Option<Gray>> {
        let alpha = match self.mask {
            ViewMask::Alpha => self.load_photo(limits)?.alpha,
            _ => None,
        };
        self.head_mask(alpha.as_deref(), limits, values)
    }

    /// Adds the values of this view's mask file, and the mask that was read of it, to those of
    /// other views.
    pub fn survey(&self, values: Option<MaskValues>, mask: Option<&Gray>, all: &mut MaskSurvey) {
        if let (ViewMask::File(path), Some(values)) = (&self.mask, values) {
            all.add(path, values, mask);
        }
    }

    /// Returns the soft mask at the camera's size.
    fn head_mask(
        &self,
        alpha: Option<&[u8]>,
        limits: &Limits,
        values: Option<&mut Option<MaskValues>>,
    ) -> Result<Option<Gray>> {
        let (width, height) = (self.camera.width, self.camera.height);
        match &self.mask {
            ViewMask::None => Ok(None),
            ViewMask::Alpha => Ok(alpha.map(|a| Gray { width, height, values: a.to_vec() })),
            ViewMask::File(path) => {
                let picture = io::read_mask(path, Some(self.photo_size), limits)?;
                if let Some(values) = values {
                    *values = Some(MaskValues::count(&picture));
                }
                self.reduced(path, self.mask_reading.read(picture), Average::Mean).map(Some)
            }
        }
    }

    /// Returns a valid mask as 0 or 255; `.npy` of shape (h, w) or (h, w, 1), or a picture.
    fn read_valid(&self, path: &Path, limits: &Limits) -> Result<Gray> {
        if path.extension().is_none_or(|e| e != "npy") {
            let mut gray = io::read_gray(path, Some(self.photo_size), limits)?;
            gray.values.iter_mut().for_each(|v| *v = if *v >= 128 { 255 } else { 0 });
            return Ok(gray);
        }
        let npy = io::read_npy(path, limits)?;
        let (height, width) = match npy.shape[..] {
            [h, w] | [h, w, 1] if h > 0 && w > 0 && h.max(w) <= limits.side_px as usize => (h, w),
            _ => {
                let what = format!("a valid mask of shape {:?}", npy.shape);
                let hint = "its shape must be (height, width) or (height, width, 1)";
                return Err(io::ReadError::unsupported(path, what, hint).into());
            }
        };
        let values = match npy.values {
            NpyValues::Bool(v) => v.into_iter().map(|b| if b { 255 } else { 0 }).collect(),
            NpyValues::Number(v) => v.into_iter().map(|x| if x != 0.0 { 255 } else { 0 }).collect(),
        };
        Ok(Gray { width: width as u32, height: height as u32, values })
    }

    /// Returns whether a picture of this size beside the photograph, such as a mask, has to be
    /// turned as [`View::side_turn`] says.
    pub(super) fn turns(&self, (width, height): (u32, u32)) -> bool {
        let fits = |size| size == self.declared || size == (self.camera.width, self.camera.height);
        self.side_turn.is_some() && !fits((width, height)) && fits((height, width))
    }

    fn reduced(&self, path: &Path, gray: Gray, average: Average) -> Result<Gray> {
        let gray = match self.mask_turn {
            Some(exif) => io::turned_gray(gray, exif),
            None => gray,
        };
        let found = (gray.width, gray.height);
        if found == (self.camera.width, self.camera.height) {
            Ok(gray)
        } else if found == self.declared {
            Ok(average_gray(&gray, self.downscale, average))
        } else if let Some(turn) = self.side_turn.filter(|_| self.turns(found)) {
            self.reduced(path, io::turned_gray(gray, turn), average)
        } else {
            Err(self.mask_size_error(path, found))
        }
    }

    fn size_error(&self, path: &Path, found: (u32, u32)) -> Error {
        wrong_size(&path.to_string_lossy(), found, self.declared, &self.declared_by, self.downscale)
    }

    /// Returns the error for a mask, or another picture beside the photograph, of another size.
    fn mask_size_error(&self, path: &Path, found: (u32, u32)) -> Error {
        let ((w, h), (pw, ph)) = (found, self.photo_size);
        let (picture, photo) = (path.display(), self.photo.display());
        let hint = if (h, w) == self.declared || (h, w) == self.photo_size {
            "the mask is turned by a quarter against its photograph: turn the mask (ImageMagick: `magick mogrify -rotate 90 \
             FILES`, or -90), or make masks from photographs that are stored upright, without an EXIF turn"
                .to_string()
        } else {
            format!("make masks at the size of their photographs, {pw} × {ph} pixels")
        };
        let problem =
            format_args!("the mask `{picture}` is {w} × {h} pixels, its photograph `{photo}` {pw} × {ph}");
        Error::cannot(problem, hint)
    }
}

/// Returns the EXIF orientation that undoes another one, of those that swap the sides.
pub(super) fn undone(exif: u8) -> u8 {
    match exif {
        6 => 8,
        8 => 6,
        other => other, // transposing twice changes nothing
    }
}

/// Returns the error for a picture whose size differs from the one that `file` declares; the hint
/// is their ratio.
pub(super) fn wrong_size(
    picture: &str,
    found: (u32, u32),
    declared: (u32, u32),
    file: &str,
    downscale: u32,
) -> Error {
    let factor = declared.0 / found.0.max(1);
    let hint = if factor > 1 && (declared.0 / factor, declared.1 / factor) == found {
        format!("use the full-size photographs, or set `capture.downscale = {factor}`")
    } else if downscale > 1 {
        format!("use photographs of that size, or smaller by exactly `capture.downscale = {downscale}`")
    } else if (found.1, found.0) == declared {
        format!(
            "if the photograph lies on its side, store it upright, without an EXIF turn; if it is upright, `{file}` has \
             its width and height (`w` and `h`) exchanged: correct them"
        )
    } else {
        format!("use photographs of that size, or correct `w` and `h` in `{file}`")
    };
    let ((w, h), (dw, dh)) = (found, declared);
    Error::cannot(format_args!("`{picture}` is {w} × {h} pixels, but `{file}` says {dw} × {dh}"), hint)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quarter_turns_are_undone() {
        // 1 2 3
        // 4 5 6
        let gray = Gray { width: 3, height: 2, values: vec![1, 2, 3, 4, 5, 6] };
        for exif in 5..=8 {
            let turned = io::turned_gray(gray.clone(), exif);
            assert_eq!((turned.width, turned.height), (2, 3));
            assert_eq!(io::turned_gray(turned, undone(exif)), gray, "{exif}");
        }
    }

    #[test]
    fn a_photograph_four_times_too_small_is_told_how_to_be_used() {
        let e = wrong_size("images/cam_07.jpg", (750, 1024), (3000, 4096), "transforms_train.json", 1);
        assert_eq!(
            e.to_string(),
            "`images/cam_07.jpg` is 750 × 1024 pixels, but `transforms_train.json` says 3000 × 4096"
        );
        assert_eq!(e.hint(), "use the full-size photographs, or set `capture.downscale = 4`");
    }
}
