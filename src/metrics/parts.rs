//! Metrics of parts of the head, and its coverage.
//!
//! | part | pixels |
//! | --- | --- |
//! | opaque | the mask is 1 (alpha ≥ 0.999): neither background nor partial coverage counts |
//! | edge | within 3 pixels of the mask's 0.5 contour, on either side; the frame's border is none |
//! | skin, hair | pixels of the region of interest, as [`Tones`] classifies them |
//!
//! Pixels are covered if the render's opacity is at least 0.5. Head pixels that are not covered are
//! missing, covered pixels without head are extra; [`PartMetrics::psnr_cap`] is the masked PSNR of
//! a picture with the photograph's own colors in every covered pixel.

mod tones;

pub use tones::Tones;

use super::{picture, rounded};
use serde::Serialize;
use tiface_base::image::{Gray, INSIDE, Image, Photo, grow};
use tiface_capture::LoadedView;

/// Half of the band around the mask's contour, pixels.
const EDGE_PX: f32 = 3.0;

/// The masks of one photograph; all of one size.
#[derive(Clone, Copy)]
pub struct Masks<'a> {
    /// Soft alpha of the head.
    pub mask: &'a Gray,
    /// Pixels where the photograph can be used; all if absent.
    pub valid: Option<&'a Gray>,
    /// Face, ears and hair, without neck and garment.
    pub region: Option<&'a Gray>,
}

impl Masks<'_> {
    /// Loads the masks of a view; `None` without a mask of the head.
    pub fn of(view: &LoadedView) -> Option<Masks<'_>> {
        let (valid, region) = (view.valid.as_ref(), view.region.as_ref());
        view.mask.as_ref().map(|mask| Masks { mask, valid, region })
    }

    /// Returns width and height.
    fn size(&self) -> (usize, usize) {
        (self.mask.width as usize, self.mask.height as usize)
    }

    fn is_valid(&self, i: usize) -> bool {
        self.valid.is_none_or(|v| v.values[i] >= INSIDE)
    }

    fn all(&self, holds: impl Fn(usize, u8) -> bool) -> Vec<bool> {
        self.mask.values.iter().enumerate().map(|(i, &m)| self.is_valid(i) && holds(i, m)).collect()
    }
}

/// Metrics of one view, or their means over views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct PartMetrics {
    /// PSNR over the opaque pixels, dB.
    pub psnr_opaque: Option<f64>,
    /// PSNR along the outline, dB.
    pub psnr_edge: Option<f64>,
    /// PSNR over the region's skin, dB.
    pub psnr_skin: Option<f64>,
    /// PSNR over the region's hair, its soft rim included, dB.
    pub psnr_hair: Option<f64>,
    /// Number of head pixels that are not covered.
    pub missing: Option<f64>,
    /// Number of covered pixels without head.
    pub extra: Option<f64>,
    /// Masked PSNR that coverage allows, dB; `None` also if no pixel is missing.
    pub psnr_cap: Option<f64>,
}

impl PartMetrics {
    /// Returns the means over the views that have a value, for each metric.
    pub fn mean(views: &[PartMetrics]) -> PartMetrics {
        let mean = |of: fn(&PartMetrics) -> Option<f64>| super::mean(views, of);
        PartMetrics {
            psnr_opaque: mean(|v| v.psnr_opaque),
            psnr_edge: mean(|v| v.psnr_edge),
            psnr_skin: mean(|v| v.psnr_skin),
            psnr_hair: mean(|v| v.psnr_hair),
            missing: mean(|v| v.missing),
            extra: mean(|v| v.extra),
            psnr_cap: mean(|v| v.psnr_cap),
        }
    }
}

/// Evaluates a render part by part, over the background it was made for.
///
/// `expected` is the photograph over the same background, `behind` that background's color
/// (sRGB-coded), `opacity` the render's alpha if it is known, `[height · width]`. Sizes agree, as
/// [`super::compare`] makes sure.
pub fn parts(
    render: &Image,
    expected: &Photo,
    masks: Masks,
    opacity: Option<&[f32]>,
    behind: [f32; 3],
    tones: Option<&Tones>,
) -> PartMetrics {
    let (ours, theirs) = (rounded(render), picture(expected));
    let psnr = |inside: &[bool]| super::psnr(&ours, &theirs, Some(inside));
    let (skin, hair) = match tones.and_then(|t| t.split(expected, masks)) {
        Some((skin, hair)) => (psnr(&skin), psnr(&hair)),
        None => (None, None),
    };
    let mut found = PartMetrics {
        psnr_opaque: psnr(&masks.all(|_, m| m == u8::MAX)),
        psnr_edge: psnr(&edge(masks)),
        psnr_skin: skin,
        psnr_hair: hair,
        ..PartMetrics::default()
    };
    if let Some(opacity) = opacity {
        let covered = |i: usize| opacity[i] >= 0.5;
        let count = |of: Vec<bool>| of.into_iter().filter(|x| *x).count() as f64;
        let missing = masks.all(|i, m| m >= INSIDE && !covered(i));
        // the best possible picture: the photograph in covered pixels, the background elsewhere
        let mut best = theirs.clone();
        for (p, _) in best.data.as_chunks_mut::<3>().0.iter_mut().zip(&missing).filter(|(_, m)| **m) {
            *p = behind;
        }
        found.psnr_cap = super::psnr(&best, &theirs, Some(&masks.all(|_, m| m >= INSIDE)));
        found.missing = Some(count(missing));
        found.extra = Some(count(masks.all(|i, m| m < INSIDE && covered(i))));
    }
    found
}

/// Returns the band around the mask's contour.
fn edge(masks: Masks) -> Vec<bool> {
    let head = masks.mask.inside();
    let rest: Vec<bool> = head.iter().map(|h| !h).collect();
    let (width, height) = masks.size();
    let [to_head, to_rest] = [&head, &rest].map(|set| grow(set, width, height, EDGE_PX));
    masks.all(|i, _| to_head[i] && to_rest[i])
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn gray(width: u32, values: Vec<u8>) -> Gray {
        Gray { width, height: values.len() as u32 / width, values }
    }

    pub(super) fn only(mask: &Gray) -> Masks<'_> {
        Masks { mask, valid: None, region: None }
    }

    /// Returns a photograph and a render of a row of gray values of 1/255.
    fn rows(photo: &[u8], render: &[u8]) -> (Photo, Image) {
        let width = photo.len() as u32;
        let mut image = Image::new(width, 1, 4);
        for (p, &v) in image.data.as_chunks_mut::<4>().0.iter_mut().zip(render) {
            *p = [v as f32 / 255.0; 4];
        }
        (Photo { width, height: 1, rgb: photo.iter().map(|&v| [v; 3]).collect(), alpha: None }, image)
    }

    pub(super) fn close(found: Option<f64>, expected: f64) {
        assert!((found.unwrap() - expected).abs() < 1e-3, "{found:?}, expected {expected}");
    }

    #[test]
    fn soft_pixels_are_no_opaque_ones_and_the_edge_has_both_sides() {
        // head ends between pixels 3 and 4; three pixels on each side are the edge: 1 to 6
        let mask = gray(10, vec![255, 255, 255, 200, 100, 0, 0, 0, 0, 0]);
        let (photo, render) = rows(&[102; 10], &[51, 102, 102, 0, 102, 102, 153, 0, 0, 0]);
        let found = parts(&render, &photo, only(&mask), None, [0.0; 3], None);
        // opaque 0, 1, 2: errors 0.2, 0, 0 → −10 log10(0.04 / 3) = 18.7506
        close(found.psnr_opaque, 18.7506);
        // edge 1 … 6: errors 0.4 and 0.2 → −10 log10((0.16 + 0.04) / 6) = 14.7712
        close(found.psnr_edge, 14.7712);
        assert_eq!((found.psnr_skin, found.missing, found.psnr_cap), (None, None, None));
        let valid = gray(10, vec![255, 255, 255, 0, 255, 255, 255, 255, 255, 255]);
        let masks = Masks { valid: Some(&valid), ..only(&mask) };
        // without pixel 3: 0.04 over five → 20.9691
        close(parts(&render, &photo, masks, None, [0.0; 3], None).psnr_edge, 20.9691);
    }

    #[test]
    fn the_frame_is_no_outline() {
        let mask = gray(4, vec![255; 16]);
        assert!(edge(only(&mask)).iter().all(|e| !e));
    }

    #[test]
    fn what_is_missing_limits_the_figure_and_what_is_extra_is_counted() {
        let mask = gray(5, vec![255, 255, 255, 255, 0]);
        let (photo, render) = rows(&[102, 102, 102, 102, 0], &[102; 5]);
        let opacity = [1.0, 0.5, 0.49, 1.0, 0.7];
        let over_black = parts(&render, &photo, only(&mask), Some(&opacity), [0.0; 3], None);
        assert_eq!((over_black.missing, over_black.extra), (Some(1.0), Some(1.0)));
        // one of four pixels shows black for 0.4: −10 log10(0.16 / 4) = 13.9794
        close(over_black.psnr_cap, 13.9794);
        // … and white: −10 log10(0.36 / 4) = 10.4576
        let over_white = parts(&render, &photo, only(&mask), Some(&opacity), [1.0; 3], None);
        close(over_white.psnr_cap, 10.4576);
        let whole = parts(&render, &photo, only(&mask), Some(&[1.0; 5]), [0.0; 3], None);
        assert_eq!((whole.missing, whole.psnr_cap), (Some(0.0), None));
    }

    #[test]
    fn means_are_over_the_views_that_have_a_figure() {
        let one = PartMetrics { missing: Some(10.0), psnr_cap: Some(30.0), ..PartMetrics::default() };
        let two = PartMetrics { missing: Some(0.0), ..PartMetrics::default() };
        let mean = PartMetrics::mean(&[one, two]);
        assert_eq!((mean.missing, mean.psnr_cap, mean.psnr_edge), (Some(5.0), Some(30.0), None));
    }
}
