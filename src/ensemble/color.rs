//! Correction of a member's colours: the paper blames an overall colour deviation of I-Face.
//!
//! If a surface of colour F should have had `A·F + b`, then over black, at opacity a, the render
//! `c = a·F` should have been `A·c + b·a`: with the offset times alpha the map is right for soft pixels
//! and leaves the background black. The fit is least squares on solid pixels, of the deviation from the
//! identity, which is pulled to 0:
//!
//! ```text
//! Σ |p − c − Δ·x|² + ρ |Δ|²,   x = (r, g, b, a),   A|b = I|0 + Δ
//! ```

use super::members::{all_finite, channels, in_bands};
use super::simplex::{factor, substitute};
use super::{EnsembleError, Member, Members, Target, fit::decibels};
use crate::image::Image;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Only pixels are fitted on where the member and the weight map are at least so opaque. At softer
/// ones an error of opacity would be taken for one of colour.
const SOLID: f32 = 0.95;

/// ρ is that of this many white pixels for each channel, or this share of those counted, whichever is
/// more: too little to bias what thousands of pixels say, enough that few cannot say much.
const LEAST_RIDGE: f64 = 16.0;
const RIDGE_SHARE: f64 = 1e-4;

/// What may be corrected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Correction {
    /// One factor for each channel.
    Gain,
    /// Any mix of the channels, and an offset.
    Affine,
}

/// `out = map · (r, g, b, alpha)`, over black.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ColorMap {
    /// One row for each channel of the result: factors of red, green, blue and alpha.
    pub rows: [[f32; 4]; 3],
}

/// PSNR in dB of one member alone over the pixels of the fit; `None` without any error.
///
/// After: without the clamping of [`ColorMap::apply`], which can only help.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ColorGain {
    /// As rendered.
    pub before: Option<f64>,
    /// With the correction.
    pub after: Option<f64>,
}

/// Sums over the views seen so far, of one member.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ColorFit {
    /// `Σ x xᵀ`.
    xx: [[f64; 4]; 4],
    /// `Σ (p − c) xᵀ`.
    ex: [[f64; 4]; 3],
    /// `Σ |p − c|²`.
    ee: f64,
    pixels: usize,
}

impl ColorFit {
    /// Adds one view.
    pub fn add(&mut self, member: &Member, target: &Target) -> Result<(), EnsembleError> {
        let members = Members::new(&[*member])?;
        members.check(target)?;
        let bands = in_bands(members.pixels(), |band| {
            let mut sums = ColorFit::default();
            let mut color = [[0f32; 4]];
            for i in band.filter(|&i| target.weight.values[i] as f32 >= SOLID * 255.0) {
                members.read(i, &mut color);
                if color[0][3] >= SOLID {
                    sums.count(color[0].map(f64::from), target.photo.rgb[i].map(|v| v as f64 / 255.0));
                }
            }
            sums
        });
        bands.iter().for_each(|b| self.merge(b));
        Ok(())
    }

    /// Adds the views of another.
    pub fn merge(&mut self, other: &ColorFit) {
        let ours = self.xx.iter_mut().chain(&mut self.ex).flatten();
        let theirs = other.xx.iter().chain(&other.ex).flatten();
        ours.zip(theirs).for_each(|(a, b)| *a += b);
        self.ee += other.ee;
        self.pixels += other.pixels;
    }

    /// How many pixels were solid enough to count.
    pub fn pixels(&self) -> usize {
        self.pixels
    }

    /// The correction of least squared error.
    pub fn solve(&self, kind: Correction) -> Result<ColorMap, EnsembleError> {
        if self.pixels == 0 {
            return Err(EnsembleError::NoPixels);
        }
        let ridge = (RIDGE_SHARE * self.pixels as f64).max(LEAST_RIDGE);
        let mut deviation = [[0f64; 4]; 3];
        match kind {
            Correction::Gain => {
                for j in 0..3 {
                    deviation[j][j] = self.ex[j][j] / (self.xx[j][j] + ridge);
                }
            }
            Correction::Affine => {
                let mut a = *self.xx.as_flattened().as_array::<16>().expect("4 rows of 4");
                (0..4).for_each(|j| a[5 * j] += ridge);
                // a sum of squares plus the ridge is positive definite; if rounding says otherwise,
                // nothing is corrected
                if factor(&mut a, 4) {
                    deviation = self.ex;
                    deviation.iter_mut().for_each(|row| substitute(&a, 4, row));
                }
            }
        }
        let mut map = ColorMap::identity();
        for (row, d) in map.rows.iter_mut().zip(deviation) {
            *row = std::array::from_fn(|k| (row[k] as f64 + d[k]) as f32);
        }
        Ok(map)
    }

    /// What a correction gains on the views seen; on held-out views when they are other ones than
    /// those it was solved on.
    pub fn gain(&self, map: &ColorMap) -> ColorGain {
        let mut error = self.ee;
        for (j, identity) in ColorMap::identity().rows.iter().enumerate() {
            let d: [f64; 4] = std::array::from_fn(|k| map.rows[j][k] as f64 - identity[k] as f64);
            for k in 0..4 {
                let row: f64 = (0..4).map(|l| self.xx[k][l] * d[l]).sum();
                error += d[k] * (row - 2.0 * self.ex[j][k]);
            }
        }
        let pixels = self.pixels as f64;
        ColorGain { before: decibels(self.ee, pixels), after: decibels(error, pixels) }
    }

    fn count(&mut self, x: [f64; 4], photo: [f64; 3]) {
        for k in 0..4 {
            for l in 0..4 {
                self.xx[k][l] += x[k] * x[l];
            }
        }
        for j in 0..3 {
            let e = photo[j] - x[j];
            (0..4).for_each(|k| self.ex[j][k] += e * x[k]);
            self.ee += e * e;
        }
        self.pixels += 1;
    }
}

impl ColorMap {
    /// Changes nothing.
    pub fn identity() -> ColorMap {
        ColorMap { rows: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]] }
    }

    /// Corrects a render, RGBA over black. Colour ends in 0..=alpha, alpha in 0..=1 and otherwise as
    /// it is. `name` is what errors call it.
    pub fn apply(&self, name: &str, image: &mut Image) -> Result<(), EnsembleError> {
        channels(|| format!("the view of member `{name}`"), image, 4)?;
        all_finite(name, image)?;
        image.data.as_chunks_mut::<4>().0.par_iter_mut().for_each(|pixel| {
            let x = pixel.map(|v| v.clamp(0.0, 1.0));
            for (p, row) in pixel.iter_mut().zip(&self.rows) {
                let value = row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + row[3] * x[3];
                *p = value.clamp(0.0, x[3]);
            }
            pixel[3] = x[3];
        });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::{Gray, Photo};
    use crate::kernel::rng::{normal, uniform};

    const SIZE: u32 = 128;

    /// Random solid colours from 0.2 to 0.7, and the photograph `map` makes of them plus noise.
    fn pair(map: impl Fn([f32; 3]) -> [f32; 3], seed: u64) -> (Image, Photo) {
        let mut image = Image::new(SIZE, SIZE, 4);
        let mut rgb = Vec::new();
        for (i, pixel) in image.data.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            let c: [f32; 3] = std::array::from_fn(|j| 0.2 + 0.5 * uniform(seed, j as u64, i as u64));
            *pixel = [c[0], c[1], c[2], 1.0];
            let noise = |j: usize| 0.005 * normal(seed, 10 + j as u64, i as u64);
            let photo = map(c);
            rgb.push(std::array::from_fn(|j| crate::image::quantise(photo[j] + noise(j))));
        }
        (image, Photo { width: SIZE, height: SIZE, rgb, alpha: None })
    }

    fn weight(value: u8) -> Gray {
        Gray { width: SIZE, height: SIZE, values: vec![value; (SIZE * SIZE) as usize] }
    }

    fn fit(image: &Image, photo: &Photo, weight: &Gray) -> ColorFit {
        let mut fit = ColorFit::default();
        fit.add(&Member { name: "iface", image, masked: true }, &Target { photo, weight }).unwrap();
        fit
    }

    #[test]
    fn a_known_affine_map_is_found_and_gains_what_it_should() {
        let truth = [[1.1, 0.05, 0.0, -0.04], [0.0, 0.9, 0.1, 0.03], [-0.05, 0.0, 1.0, 0.05]];
        let map = |c: [f32; 3]| truth.map(|r| r[0] * c[0] + r[1] * c[1] + r[2] * c[2] + r[3]);
        let (image, photo) = pair(map, 1);
        let fit = fit(&image, &photo, &weight(255));
        let found = fit.solve(Correction::Affine).unwrap();
        // along a channel the colours spread by 16384 · 0.5²/12 = 341; a ridge of 16 holds back 5 %
        for (a, b) in found.rows.as_flattened().iter().zip(truth.as_flattened()) {
            assert!((a - b).abs() < 0.01, "{found:?}");
        }
        let gain = fit.gain(&found);
        assert!(gain.after.unwrap() > 40.0 && gain.before.unwrap() < 30.0, "{gain:?}");
        // the sums say the same as the pixels, corrected one by one
        let mut corrected = image.clone();
        found.apply("iface", &mut corrected).unwrap();
        let squares = corrected.data.chunks(4).zip(&photo.rgb).flat_map(|(c, p)| {
            (0..3).map(|j| (c[j] as f64 - p[j] as f64 / 255.0).powi(2)).collect::<Vec<_>>()
        });
        let mse = squares.sum::<f64>() / (3.0 * (SIZE * SIZE) as f64);
        assert!((gain.after.unwrap() + 10.0 * mse.log10()).abs() < 1e-3);
        // and on fresh pixels it holds
        let (image, photo) = pair(map, 2);
        assert!(self::fit(&image, &photo, &weight(255)).gain(&found).after.unwrap() > 40.0);
    }

    #[test]
    fn gains_are_found_for_each_channel() {
        let (image, photo) = pair(|c| [1.2 * c[0], 0.9 * c[1], c[2]], 3);
        let fit = fit(&image, &photo, &weight(255));
        let map = fit.solve(Correction::Gain).unwrap();
        // Σ x² = 16384 · (0.45² + 0.5²/12) = 3659 for a channel, ridge 16: 0.2 · 3659/3675 = 0.199
        for (j, expected) in [1.199, 0.9, 1.0].into_iter().enumerate() {
            assert!((map.rows[j][j] - expected).abs() < 0.002, "{map:?}");
        }
        assert!(fit.gain(&map).after > fit.gain(&ColorMap::identity()).after);
        assert_eq!(fit.gain(&ColorMap::identity()).after, fit.gain(&map).before);
    }

    #[test]
    fn a_handful_of_pixels_changes_next_to_nothing() {
        let (image, photo) = pair(|_| [1.0, 0.0, 1.0], 4);
        let mut few = weight(0);
        few.values[..3].fill(255);
        let fit = fit(&image, &photo, &few);
        assert_eq!(fit.pixels(), 3);
        for kind in [Correction::Gain, Correction::Affine] {
            let map = fit.solve(kind).unwrap();
            let identity = ColorMap::identity();
            let moved =
                map.rows.as_flattened().iter().zip(identity.rows.as_flattened()).map(|(a, b)| (a - b).abs());
            // errors of at most 0.8 in three pixels against 16: below 3 · 0.8 / 16 = 0.15
            assert!(moved.fold(0.0, f32::max) < 0.15, "{map:?}");
        }
    }

    #[test]
    fn soft_pixels_are_not_fitted_on_and_an_empty_fit_is_an_error() {
        let (mut image, photo) = pair(|c| c, 5);
        assert_eq!(fit(&image, &photo, &weight(200)).pixels(), 0);
        image.data.as_chunks_mut::<4>().0.iter_mut().for_each(|p| p[3] = 0.9);
        let empty = fit(&image, &photo, &weight(255));
        assert_eq!(empty.pixels(), 0);
        assert_eq!(empty.solve(Correction::Affine), Err(EnsembleError::NoPixels));
        let small = Photo { width: 2, height: 2, rgb: vec![[0; 3]; 4], alpha: None };
        let member = Member { name: "iface", image: &image, masked: true };
        let target = Target { photo: &small, weight: &weight(255) };
        let e = ColorFit::default().add(&member, &target).unwrap_err();
        assert_eq!(e.to_string(), "the photograph is 2 × 2 pixels, expected 128 × 128");
    }

    #[test]
    fn a_corrected_render_stays_premultiplied_and_its_background_black() {
        let map = ColorMap { rows: [[1.0, 0.0, 0.0, 0.2], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 1.0, -0.5]] };
        let mut image = Image::new(3, 1, 4);
        image.data[4..8].copy_from_slice(&[0.2, 0.4, 0.1, 0.5]);
        image.data[8..12].copy_from_slice(&[0.2, 0.4, 0.6, 1.5]);
        map.apply("iface", &mut image).unwrap();
        assert_eq!(image.pixel(0, 0), [0.0; 4]);
        // red 0.2 + 0.2·0.5, green 0.8 → alpha 0.5, blue 0.1 − 0.25 → 0
        let near =
            |found: &[f32], expected: [f32; 4]| found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(near(image.pixel(1, 0), [0.3, 0.5, 0.0, 0.5]));
        assert!(near(image.pixel(2, 0), [0.4, 0.8, 0.1, 1.0]));
        image.data[0] = f32::NAN;
        assert!(matches!(map.apply("iface", &mut image), Err(EnsembleError::NotFinite { pixels: 1, .. })));
    }
}
