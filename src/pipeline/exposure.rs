//! How exposure and white balance of a capture's photographs differ, in words, and what a run
//! divides out of them.
//!
//! The measurement is [`tiface_capture::rig::exposure`]'s. The stage `mask` makes it and writes
//! `exposure.json`; later stages read training photographs with their exposure divided out.
//! Held-out views are rendered with the mean exposure, and their own is used by the metrics alone.

use super::rig_photos::RigPhotos;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::Path;
use tiface_base::Result;
use tiface_base::error::counted;
use tiface_base::image::Exposure;
use tiface_base::io::{self, Limits, ReadError};
use tiface_capture::rig::exposure::{self, ExposureView, Incomparable, MIN_TRAINING_VIEWS};
use tiface_capture::{Capture, Split, View};

/// File name of the measurement, in the folder of the stage `mask`.
pub(super) const EXPOSURE: &str = "exposure.json";

/// The largest gain that is believed; the least is its inverse.
const LARGEST_GAIN: f32 = 100.0;

/// A view is named alone if it differs this many times as much as the median view.
const STANDS_OUT: f64 = 4.0;

/// Returns the reason for which exposures of these training views are not compared.
fn incomparable(why: Incomparable, train: &[&View]) -> String {
    let Incomparable::TooFewViews(measured) = why else {
        return "what the photographs share does not determine them".into();
    };
    let (count, needed) = (measured.iter().filter(|m| **m).count(), MIN_TRAINING_VIEWS);
    let left = train.iter().zip(&measured).filter(|(_, measured)| !**measured);
    let left: Vec<String> = left.map(|(view, _)| format!("`{}`", view.name)).collect();
    let views = counted(train.len(), "training view");
    match left.len() {
        0 => format!("there are {views} with a head mask, and at least {needed} are needed"),
        _ => format!(
            "{count} of {views} can be measured, and at least {needed} are needed: too little of the head is neither dark \
             nor saturated in {}",
            left.join(", ")
        ),
    }
}

/// The measurement of a capture's exposures.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct ExposureCheck {
    /// Whether differences in brightness, and in color, are divided out of the training
    /// photographs.
    evens_brightness: bool,
    evens_color: bool,
    /// Root mean square of the logarithms of the training views' brightness, and of their colors.
    brightness_spread: f64,
    color_spread: f64,
    views: Vec<MeasuredView>,
}

/// The measurement of one photograph.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct MeasuredView {
    view: String,
    split: Split,
    /// How many points of the head it shows.
    points: usize,
    /// Its exposure relative to the mean of the training views; missing where it shows too little.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    measured: Option<Exposure>,
    /// Exposure that is divided out of a training photograph, or out of a held-out one for figures
    /// at its own exposure.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    used: Option<Exposure>,
}

impl ExposureCheck {
    /// Measures exposures. Fails with the reason where too little can be compared.
    pub(super) fn measure(photos: &RigPhotos) -> Result<ExposureCheck, String> {
        let RigPhotos { views, train, cameras, surface, .. } = photos;
        let prepared: Vec<ExposureView> =
            photos.pictures.par_iter().map(|(photo, head)| ExposureView::new(photo, head)).collect();
        let fit = exposure::measure(&prepared, cameras, *train, surface)
            .map_err(|why| incomparable(why, &views[..*train]))?;
        let (brightness, color) = (fit.brightness_differs(), fit.color_differs());
        let used = |e: &Exposure| {
            let own = |k: usize| match (brightness, color) {
                (true, true) => e.gain[k],
                (true, false) => e.brightness(),
                (false, true) => e.gain[k] / e.brightness(),
                (false, false) => 1.0,
            };
            Exposure { gain: [0, 1, 2].map(own) }
        };
        let measured = |((view, &points), measured): ((&&View, &usize), &Option<Exposure>)| MeasuredView {
            view: view.name.clone(),
            split: view.split,
            points,
            measured: *measured,
            used: measured.as_ref().filter(|_| brightness || color).map(&used),
        };
        Ok(ExposureCheck {
            evens_brightness: brightness,
            evens_color: color,
            brightness_spread: fit.brightness_spread,
            color_spread: fit.color_spread,
            views: views.iter().zip(&fit.points).zip(&fit.exposures).map(measured).collect(),
        })
    }

    /// Returns the finding in one sentence.
    pub(super) fn sentence(&self) -> String {
        if !self.evens_out() {
            let alike = 100.0 * self.brightness_spread.max(self.color_spread);
            return format!("exposure and white balance are alike within {alike:.1} %");
        }
        let used =
            self.views.iter().filter(|v| v.split == Split::Train).filter_map(|v| Some((&v.view, v.used?)));
        let used: Vec<(&String, Exposure)> = used.collect();
        let mut bright: Vec<(f64, &String)> =
            used.iter().map(|(v, e)| (f64::from(e.brightness()), *v)).collect();
        bright.sort_by(|a, b| a.0.total_cmp(&b.0));
        let middle = bright[bright.len() / 2].0;
        let mut off: Vec<f64> = bright.iter().map(|(b, _)| (b / middle).ln().abs()).collect();
        off.sort_by(f64::total_cmp);
        let (last, usual) = (off[off.len() - 1], off[off.len() / 2]);
        let said = |(b, name): (f64, &String)| match b >= middle {
            true => format!("`{name}` is {:.0} % brighter", 100.0 * (b / middle - 1.0)),
            false => format!("`{name}` is {:.0} % darker", 100.0 * (1.0 - b / middle)),
        };
        let (darkest, brightest) = (bright[0], bright[bright.len() - 1]);
        let mut parts = Vec::new();
        if self.evens_brightness && last > STANDS_OUT * usual {
            let alone = if (brightest.0 / middle).ln() >= last { brightest } else { darkest };
            parts.push(format!("view {} than the others", said(alone)));
        } else if self.evens_brightness {
            let spread = 100.0 * self.brightness_spread;
            parts.push(format!("exposures differ by {spread:.0} % ({}, {})", said(brightest), said(darkest)));
        }
        if self.evens_color {
            parts.push(format!("white balance differs by {:.0} %", 100.0 * self.color_spread));
        }
        parts.join("; ")
    }

    /// Returns what is said of training views whose exposure could not be measured, if there are
    /// any.
    pub(super) fn not_measured(&self) -> Option<String> {
        let left = self.views.iter().filter(|v| v.split == Split::Train && v.measured.is_none());
        let left: Vec<String> = left.map(|v| format!("`{}`", v.view)).collect();
        (!left.is_empty()).then(|| {
            format!(
                "exposure is not measured where too little of the head is neither dark nor saturated: {}; such photographs \
                 are used as they are",
                left.join(", ")
            )
        })
    }

    /// Returns the finding with what a run does about it.
    pub(super) fn announcement(&self) -> String {
        let will = if self.evens_out() { "; a run evens it out" } else { "" };
        format!("{}{will}", self.sentence())
    }

    /// Returns whether exposures are divided out.
    pub(super) fn evens_out(&self) -> bool {
        self.evens_brightness || self.evens_color
    }

    /// Returns the finding for the stage's record.
    pub(super) fn summary(&self) -> serde_json::Value {
        serde_json::json!({
            "evens_brightness": self.evens_brightness,
            "evens_color": self.evens_color,
            "brightness_spread": self.brightness_spread,
            "color_spread": self.color_spread,
        })
    }

    /// Writes the measurement into the folder of the stage `mask`.
    pub(super) fn write(&self, folder: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).unwrap_or_default();
        Ok(io::write_atomic(&folder.join(EXPOSURE), format!("{text}\n").as_bytes())?)
    }

    /// Reads the file of [`ExposureCheck::write`], if there is one; exposures that it cannot have
    /// written are refused.
    pub(super) fn read(folder: &Path) -> Result<Option<ExposureCheck>, ReadError> {
        let path = folder.join(EXPOSURE);
        if !io::is_file(&path) {
            return Ok(None);
        }
        let check: ExposureCheck = io::read_typed(&path, &Limits::default())?;
        for (k, view) in check.views.iter().enumerate() {
            let Some(Exposure { gain }) = view.used else { continue };
            if !gain.iter().all(|g| (1.0 / LARGEST_GAIN..=LARGEST_GAIN).contains(g)) {
                let expected = format!("three numbers from {} to {LARGEST_GAIN}", 1.0 / LARGEST_GAIN);
                return Err(ReadError::value(
                    &path,
                    format!("views[{k}].used.gain"),
                    format!("{gain:?}"),
                    &expected,
                ));
            }
        }
        Ok(Some(check))
    }

    /// Has exposures divided out of the training photographs of a capture.
    pub(super) fn apply(&self, capture: &mut Capture) {
        for view in capture.views.iter_mut().filter(|v| v.split == Split::Train) {
            view.exposure = self.used(&view.name);
        }
    }

    /// Returns the exposure that is divided out of a view's photograph.
    pub(super) fn used(&self, view: &str) -> Option<Exposure> {
        self.views.iter().find(|v| v.view == view)?.used
    }
}
