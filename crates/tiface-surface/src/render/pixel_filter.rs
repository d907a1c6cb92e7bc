//! The pixel filter of a camera.
//!
//! A ray-cast pixel is the mean over its square. Lens, sensor and the interpolation of its colors
//! spread the light of a photograph farther, which shows at outlines most. Convolved with a
//! Gaussian, a view comes closer to a photograph; [`PixelFilterFit`] finds its width with
//! photographs whose views are known.

use super::RenderedView;
use rayon::prelude::*;
use tiface_base::image::{Gray, Image, Photo, blurred};

/// Number of filters that are compared; that of index `k` has a deviation of `k` steps.
const COUNT: usize = 9;

/// Difference of the deviations of two neighboring filters, pixels.
const STEP_PX: f32 = 0.1;

/// Squared errors of views against photographs, for each filter.
#[derive(Clone, Debug, Default)]
pub struct PixelFilterFit {
    errors: [f64; COUNT],
}

impl PixelFilterFit {
    /// Adds a view that is not filtered yet and its photograph over black; both of one size.
    /// `weight` is 0 where they are not compared, `[height · width]`.
    pub fn add(&mut self, view: &RenderedView, photo: &Photo, weight: &Gray) {
        let error = |k: usize| -> f64 {
            let view = filtered(&view.color, k as f32 * STEP_PX);
            let pixels = view.data.as_chunks::<4>().0.iter().zip(&photo.rgb).zip(&weight.values);
            let squares = pixels.filter(|(_, weight)| **weight > 0).map(|((ours, theirs), _)| {
                (0..3).map(|c| f64::from(ours[c] - f32::from(theirs[c]) / 255.0).powi(2)).sum::<f64>()
            });
            squares.sum()
        };
        let errors: Vec<f64> = (0..COUNT).into_par_iter().map(error).collect();
        self.errors.iter_mut().zip(errors).for_each(|(sum, e)| *sum += e);
    }

    /// Returns the deviation of the Gaussian with the least error, pixels: 0 for none.
    pub fn deviation_px(&self) -> f32 {
        let least = (0..COUNT).min_by(|a, b| self.errors[*a].total_cmp(&self.errors[*b]));
        least.unwrap_or(0) as f32 * STEP_PX
    }
}

impl RenderedView {
    /// Convolves color and coverage with a Gaussian of this deviation, pixels; 0 changes nothing.
    pub fn filter(&mut self, deviation_px: f32) {
        if deviation_px > 0.0 {
            self.color = filtered(&self.color, deviation_px);
        }
    }
}

/// Returns a picture, RGBA, convolved with a Gaussian of this deviation, pixels.
fn filtered(picture: &Image, deviation_px: f32) -> Image {
    let mut filtered = picture.clone();
    if deviation_px > 0.0 {
        for k in 0..4 {
            let channel: Vec<f32> = picture.data.iter().skip(k).step_by(4).copied().collect();
            let channel = blurred(&channel, picture.width as usize, deviation_px);
            filtered.data.iter_mut().skip(k).step_by(4).zip(channel).for_each(|(to, v)| *to = v);
        }
    }
    filtered
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a view of stripes, some of which cover nothing.
    fn stripes() -> RenderedView {
        let mut view = RenderedView::new(24, 16, false);
        for (i, p) in view.color.data.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            *p = [[0.9, 0.5, 0.1, 1.0], [0.2, 0.3, 0.4, 1.0], [0.0; 4]][i % 24 / 3 % 3];
        }
        view
    }

    #[test]
    fn the_width_with_which_a_photograph_was_made_is_found() {
        for deviation in [0.0, 0.4, 0.7] {
            let mut taken = stripes();
            taken.filter(deviation);
            let coded = |p: &[f32; 4]| [p[0], p[1], p[2]].map(|v| (255.0 * v).round() as u8);
            let rgb: Vec<[u8; 3]> = taken.color.data.as_chunks().0.iter().map(coded).collect();
            let mut photo = Photo { width: 24, height: 16, rgb, alpha: None };
            // what does not count is not looked at
            photo.rgb[30] = [255; 3];
            let mut weight = Gray { width: 24, height: 16, values: vec![255; 24 * 16] };
            weight.values[30] = 0;
            let mut fit = PixelFilterFit::default();
            fit.add(&stripes(), &photo, &weight);
            assert!((fit.deviation_px() - deviation).abs() < 1e-6, "{} {deviation}", fit.deviation_px());
        }
        assert_eq!(PixelFilterFit::default().deviation_px(), 0.0);
    }

    #[test]
    fn a_filter_keeps_the_light_and_its_coverage_together() {
        let (before, mut after) = (stripes(), stripes());
        after.filter(0.5);
        // between a stripe and nothing, color and coverage fall alike
        for p in after.color.data.as_chunks::<4>().0.iter().filter(|p| p[3] > 0.0 && p[3] < 0.999) {
            assert!(p[0] <= 0.9 * p[3] + 1e-6 && p[0] >= 0.2 * p[3] - 1e-6, "{p:?}");
        }
        let sum = |view: &RenderedView| view.color.data.iter().sum::<f32>();
        assert!((sum(&before) - sum(&after)).abs() < 0.02 * sum(&before) && before != after);
        after = stripes();
        after.filter(0.0);
        assert!(before == after);
    }
}
