//! ViTMatte: from a trimap to a soft alpha, with a file of the user (Yao et al. 2024).
//!
//! The network sees four channels, colour and trimap, at a multiple of 32 pixels. Two conventions exist:
//!
//! | | colours | unsure |
//! | --- | --- | --- |
//! | original code | ImageNet's mean and deviation | exactly 0.5 |
//! | transformers | 0.5 and 0.5 (or as its file says) | 128 / 255 |
//!
//! The file `preprocessor_config.json` beside the network means the second; without it, the first.

use super::onnx::{Contract, MaskNetworkError, Runtime, Session, SessionLimits, Tensor};
use super::processor::{self, IMAGENET, Normal};
use crate::image::{Gray, Photo};
use std::path::Path;

/// The picture is padded to a multiple of this: 16 pixels a token, halved once more in the detail head.
const STEP: usize = 32;

/// How ViTMatte is shown colours and the trimap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VitMatteColours {
    /// As in the original code: ImageNet's mean and deviation; the trimap is exactly 0, 0.5 or 1.
    ImageNet,
    /// As in transformers' processor: 0.5 and 0.5; the trimap divided by 255.
    Transformers,
}

/// A ViTMatte network.
pub(super) struct VitMatte {
    pub(super) session: Session,
    normal: Normal,
    colours: VitMatteColours,
}

impl VitMatte {
    /// Opens the file; `colours` overrides what lies beside it.
    pub(super) fn open(
        path: &Path,
        runtime: Option<&Runtime>,
        limits: &SessionLimits,
        colours: Option<VitMatteColours>,
    ) -> Result<VitMatte, MaskNetworkError> {
        let session = Session::open(path, runtime, limits)?;
        if session.contract != Contract::VitMatte {
            return Err(MaskNetworkError::WrongRole {
                path: path.into(),
                is: session.contract.to_string(),
                given_as: "the ViTMatte network".into(),
            });
        }
        let half = Normal { mean: [0.5; 3], std: [0.5; 3] };
        let (colours, normal) = match colours {
            Some(VitMatteColours::ImageNet) => (VitMatteColours::ImageNet, IMAGENET),
            Some(VitMatteColours::Transformers) => (VitMatteColours::Transformers, half),
            None => match processor::beside(path, "vitmatte")? {
                Some(processor) => (VitMatteColours::Transformers, processor.normal),
                None => (VitMatteColours::ImageNet, IMAGENET),
            },
        };
        Ok(VitMatte { session, normal, colours })
    }

    /// Which convention is obeyed.
    pub(super) fn colours(&self) -> VitMatteColours {
        self.colours
    }

    /// Width and height with padding: the multiple of 32 that holds the photograph, or what the file fixes.
    pub(super) fn padded(&self, width: usize, height: usize) -> Result<(usize, usize), MaskNetworkError> {
        let fit = |old: usize, axis: usize| match self.session.input_extent("pixel_values", axis) {
            None => Some(old.next_multiple_of(STEP)),
            Some(fixed) => (fixed >= old && fixed % STEP == 0).then_some(fixed),
        };
        match (fit(width, 3), fit(height, 2)) {
            (Some(w), Some(h)) => Ok((w, h)),
            _ => Err(MaskNetworkError::Photo {
                problem: format!(
                    "it has {width} × {height} pixels, but `{}` takes only {}",
                    self.session.path.display(),
                    self.session.interface.inputs[0].shape_in_words()
                ),
                hint: "use the network's file that leaves width and height open".into(),
            }),
        }
    }

    /// Makes the plan for photographs of this size.
    pub(super) fn prepare(&self, width: usize, height: usize) -> Result<(), MaskNetworkError> {
        let (w, h) = self.padded(width, height)?;
        let blank = Tensor::f32(&[1, 4, h, w], vec![0.0; 4 * h * w]);
        self.session.prepare(&[("pixel_values", blank)], &["alphas"])
    }

    /// Colours and trimap as the network takes them: `[1, 4, h, w]`, zeros right and below.
    pub(super) fn pixels(&self, photo: &Photo, trimap: &Gray, padded: (usize, usize)) -> Tensor {
        let (w, h) = padded;
        let plane = w * h;
        let mut values = vec![0.0; 4 * plane];
        let width = photo.width as usize;
        for (i, (colour, &t)) in photo.rgb.iter().zip(&trimap.values).enumerate() {
            let at = i / width * w + i % width;
            for c in 0..3 {
                values[c * plane + at] = self.normal.apply(colour[c], c);
            }
            values[3 * plane + at] = match (self.colours, t) {
                (VitMatteColours::Transformers, t) => f32::from(t) / 255.0,
                // the original code's thirds: a trimap may come from anywhere
                (VitMatteColours::ImageNet, 0..85) => 0.0,
                (VitMatteColours::ImageNet, 85..170) => 0.5,
                (VitMatteColours::ImageNet, _) => 1.0,
            };
        }
        Tensor::f32(&[1, 4, h, w], values)
    }

    /// Alpha in 0..=1 of each pixel, `[height · width]`, as the network says it: no cutting near 0 and 1.
    pub(super) fn alpha(&self, photo: &Photo, trimap: &Gray) -> Result<Vec<f32>, MaskNetworkError> {
        let (width, height) = (photo.width as usize, photo.height as usize);
        let (w, h) = self.padded(width, height)?;
        let pixels = self.pixels(photo, trimap, (w, h));
        let given = self.session.run(&[("pixel_values", pixels)], &["alphas"])?;
        let Some(alphas) = given.first().filter(|a| a.shape == [1, 1, h, w]) else {
            let shape = given.first().map(|a| a.shape.clone()).unwrap_or_default();
            return Err(self
                .session
                .unusable("alphas", format!("it is {shape:?}, expected [1, 1, {h}, {w}]")));
        };
        if let Some(v) = alphas.values.iter().find(|v| !(-0.01..=1.01).contains(*v)) {
            return Err(self.session.unusable("alphas", format!("it holds {v}, expected 0 to 1")));
        }
        let rows = alphas.values.chunks_exact(w).take(height);
        Ok(rows.flat_map(|row| row[..width].iter().map(|v| v.clamp(0.0, 1.0))).collect())
    }
}
