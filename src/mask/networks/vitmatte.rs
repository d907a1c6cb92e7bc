//! ViTMatte goes from a trimap to a soft alpha (Yao et al. 2024). It sees four channels, color and
//! trimap, at a multiple of 32 pixels. Two conventions exist:
//!
//! | | colors | unknown |
//! | --- | --- | --- |
//! | original code | ImageNet's mean and deviation | exactly 0.5 |
//! | transformers | 0.5 and 0.5 (or as its file says) | 128 / 255 |
//!
//! The file `preprocessor_config.json` beside the network means the second; without it, the first.

use super::processor::{self, IMAGENET, Normal};
use crate::config::VitmatteColors;
use crate::onnx::{NetworkArray, NetworkSession, Role};
use std::path::Path;
use tiface_base::image::{Gray, Photo};
use tiface_base::{Error, Result};

/// The picture is padded to a multiple of this: 16 pixels a token, halved once more in the detail
/// head.
const STEP: usize = 32;

/// A ViTMatte network.
pub(super) struct VitMatte {
    pub(super) session: NetworkSession,
    normal: Normal,
    /// Whether the input is the thirds of the original code, instead of the trimap divided by 255.
    thirds: bool,
}

impl VitMatte {
    /// Opens the file; `colors` may override the configuration file beside it.
    pub(super) fn open(path: &Path, array_bytes: u64, colors: VitmatteColors) -> Result<VitMatte> {
        let mut session = NetworkSession::open(Role::VITMATTE, path, array_bytes)?;
        let half = Normal { mean: [0.5; 3], std: [0.5; 3] };
        let normal = match colors {
            VitmatteColors::Imagenet => None,
            VitmatteColors::Half => Some(half),
            VitmatteColors::Auto => processor::find(path, "vitmatte")?.map(|p| p.normal),
        };
        let thirds = normal.is_none();
        let how = if thirds { "as in the original code" } else { "as in transformers" };
        session.file.contract += &format!(", colors {how}");
        Ok(VitMatte { session, normal: normal.unwrap_or(IMAGENET), thirds })
    }

    /// Width and height with padding: the multiple of 32 that holds the photograph, or what the
    /// file fixes.
    pub(super) fn padded(&self, width: usize, height: usize) -> Result<(usize, usize)> {
        let fit = |old: usize, axis: usize| match self.session.input_extent("pixel_values", axis) {
            None => Some(old.next_multiple_of(STEP)),
            Some(fixed) => (fixed >= old && fixed % STEP == 0).then_some(fixed),
        };
        match (fit(width, 3), fit(height, 2)) {
            (Some(w), Some(h)) => Ok((w, h)),
            _ => {
                let (file, shape) =
                    (self.session.file.path.display(), self.session.inputs[0].shape_in_words());
                Err(Error::cannot(
                    format!("the photograph has {width} × {height} pixels, but `{file}` takes only {shape}"),
                    "use the network's file that leaves width and height open",
                ))
            }
        }
    }

    /// Returns the colors and trimap as the network takes them: `[1, 4, h, w]`, zeros right and
    /// below.
    pub(super) fn pixels(&self, photo: &Photo, trimap: &Gray, padded: (usize, usize)) -> NetworkArray {
        let (w, h) = padded;
        let width = photo.width as usize;
        let mut values = self.normal.planes(&photo.rgb, width, padded, 4);
        for (i, &t) in trimap.values.iter().enumerate() {
            let at = i / width * w + i % width;
            values[3 * w * h + at] = match t {
                t if !self.thirds => f32::from(t) / 255.0,
                // a trimap may come from anywhere
                0..85 => 0.0,
                85..170 => 0.5,
                _ => 1.0,
            };
        }
        NetworkArray::new(&[1, 4, h, w], values)
    }

    /// Alpha in 0..=1 of each pixel, `[height · width]`, as the network says it: no cutting near 0
    /// and 1.
    pub(super) fn alpha(&self, photo: &Photo, trimap: &Gray) -> Result<Vec<f32>> {
        let (width, height) = (photo.width as usize, photo.height as usize);
        let (w, h) = self.padded(width, height)?;
        let pixels = self.pixels(photo, trimap, (w, h));
        let given = self.session.run(&[("pixel_values", pixels)])?;
        let alphas = &given[0];
        self.session.expect(0, alphas, &[Some(1), Some(1), Some(h), Some(w)])?;
        if let Some(v) = alphas.values.iter().find(|v| !(-0.01..=1.01).contains(*v)) {
            return Err(self.session.unusable("alphas", format!("it holds {v}, expected 0 to 1")));
        }
        let rows = alphas.values.chunks_exact(w).take(height);
        Ok(rows.flat_map(|row| row[..width].iter().map(|v| v.clamp(0.0, 1.0))).collect())
    }
}
