//! Stage: compares views with photographs, and a mesh with a reference.
//!
//! Views are compared as they would be after a trip through an 8-bit file: every value is rounded
//! to 1/255 first. Figures are in f64, averaged per image, then over images. A figure that has no
//! value (no pixels in the mask, an image smaller than the window, no difference at all) is `None`,
//! `null` in the JSON, and does not take part in the mean.
//!
//! ```
//! use tiface::image::Image;
//! use tiface::metrics::{psnr, ssim_valid};
//!
//! let black = Image::new(16, 16, 3);
//! let mut gray = black.clone();
//! gray.data.fill(0.1);
//! // an error of 0.1 everywhere: -10 log10(0.01) = 20 dB
//! assert!((psnr(&black, &gray, None).unwrap() - 20.0).abs() < 1e-4);
//! assert_eq!(psnr(&gray, &gray, None), None); // no difference at all
//! assert!(ssim_valid(&black, &gray).unwrap() < 0.1);
//! ```

pub mod distance;
#[cfg(feature = "matting")]
mod lpips;
mod parts;
mod psnr;
mod ssim;

pub use lpips::Lpips;
pub use parts::{Masks, PartMetrics, Tones, parts};
pub use psnr::psnr;
pub use ssim::{Ssim, ssim, ssim_reflect_map, ssim_valid};

#[cfg(not(feature = "matting"))]
use crate::onnx as lpips;
use serde::Serialize;
use tiface_base::image::{Gray, INSIDE, Image, Photo, quantize};
use tiface_base::{Error, Result};

/// Metrics of one view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewMetrics {
    /// The photograph's name.
    pub name: String,
    /// PSNR of the whole frame, dB.
    pub psnr: Option<f64>,
    /// SSIM of the whole frame, the published variant ([`ssim_valid`]).
    pub ssim: Option<f64>,
    /// PSNR over the pixels that are in the mask and valid, dB.
    pub psnr_masked: Option<f64>,
    /// Mean of [`ssim_reflect_map`] over the pixels that are in the mask and valid.
    pub ssim_masked: Option<f64>,
    /// LPIPS of the whole frame, if a network was given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
}

/// Means over all views that have a value.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Means {
    /// Mean of `psnr`.
    pub psnr: Option<f64>,
    /// Mean of `ssim`.
    pub ssim: Option<f64>,
    /// Mean of `psnr_masked`.
    pub psnr_masked: Option<f64>,
    /// Mean of `ssim_masked`.
    pub ssim_masked: Option<f64>,
    /// Mean of `lpips`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
}

/// The content of `metrics.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Metrics {
    /// Means over all views.
    pub mean: Means,
    /// Metrics of each view, in the order given.
    pub views: Vec<ViewMetrics>,
}

impl Metrics {
    /// Returns the views with their means.
    pub fn new(views: Vec<ViewMetrics>) -> Metrics {
        let mean = |of: fn(&ViewMetrics) -> Option<f64>| mean(&views, of);
        let mean = Means {
            psnr: mean(|v| v.psnr),
            ssim: mean(|v| v.ssim),
            psnr_masked: mean(|v| v.psnr_masked),
            ssim_masked: mean(|v| v.ssim_masked),
            lpips: mean(|v| v.lpips),
        };
        Metrics { mean, views }
    }
}

/// Returns the mean over the views that have a value.
fn mean<V>(views: &[V], of: fn(&V) -> Option<f64>) -> Option<f64> {
    let values: Vec<f64> = views.iter().filter_map(of).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Compares a render with the photograph of the same view.
///
/// A render with alpha is taken as it is over black. `mask` says where the head is, `valid` where
/// the photograph can be used; both count from half. Without a mask the masked figures are `None`.
///
/// # Errors
/// Fails if the sizes differ, or if the render has no three or four channels.
pub fn compare(
    name: &str,
    render: &Image,
    photo: &Photo,
    mask: Option<&Gray>,
    valid: Option<&Gray>,
) -> Result<ViewMetrics> {
    compare_in(name, render, photo, [mask], valid).map(|[metrics]| metrics)
}

/// Compares a render with the photograph of the same view in several masks, as [`compare`] does in
/// one: what they share is computed once.
///
/// # Errors
/// Fails as [`compare`] does.
pub fn compare_in<const N: usize>(
    name: &str,
    render: &Image,
    photo: &Photo,
    masks: [Option<&Gray>; N],
    valid: Option<&Gray>,
) -> Result<[ViewMetrics; N]> {
    let problem = |text: String| {
        let hint = "render the view again at the size of the photograph";
        Err(Error::cannot(format_args!("view `{name}`: {text}"), hint))
    };
    let (width, height) = (photo.width, photo.height);
    let size = |m: &Gray| (m.width, m.height);
    let render_size = [("render", Some((render.width, render.height)))].into_iter();
    let mask_sizes = masks.iter().map(|mask| ("mask", mask.map(size)));
    for (what, found) in render_size.chain(mask_sizes).chain([("valid mask", valid.map(size))]) {
        if let Some((w, h)) = found.filter(|&found| found != (width, height)) {
            return problem(format!("the {what} is {w} × {h} pixels, expected {width} × {height}"));
        }
    }
    if !(3..=4).contains(&render.channels) {
        return problem(format!("the render has {} channels, expected 3 or 4", render.channels));
    }
    let (ours, theirs) = (rounded(render), picture(photo));
    let whole = psnr(&ours, &theirs, None);
    let ssim = match masks.iter().any(Option::is_some) {
        true => ssim(&ours, &theirs),
        false => Ssim { valid: ssim_valid(&ours, &theirs), reflect_map: None },
    };
    let usable = |i: usize| valid.is_none_or(|v| v.values[i] >= INSIDE);
    Ok(masks.map(|mask| {
        let inside: Option<Vec<bool>> =
            mask.map(|m| (0..m.values.len()).map(|i| m.values[i] >= INSIDE && usable(i)).collect());
        let ssim_masked = inside.as_ref().and_then(|inside| {
            let map = ssim.reflect_map.iter().flatten();
            let chosen: Vec<f64> = map.zip(inside).filter(|(_, m)| **m).map(|(s, _)| *s).collect();
            (!chosen.is_empty()).then(|| chosen.iter().sum::<f64>() / chosen.len() as f64)
        });
        ViewMetrics {
            name: name.into(),
            psnr: whole,
            ssim: ssim.valid,
            psnr_masked: inside.as_ref().and_then(|m| psnr(&ours, &theirs, Some(m))),
            ssim_masked,
            lpips: None,
        }
    }))
}

/// Rounds the colors to 8 bits and back; NaN becomes 0.
fn rounded(image: &Image) -> Image {
    let mut out = Image::new(image.width, image.height, 3);
    for (o, i) in out.data.as_chunks_mut::<3>().0.iter_mut().zip(image.data.chunks_exact(image.channels)) {
        *o = [i[0], i[1], i[2]].map(|v| quantize(v) as f32 / 255.0);
    }
    out
}

/// Converts a photograph to floats.
fn picture(photo: &Photo) -> Image {
    let mut out = Image::new(photo.width, photo.height, 3);
    for (o, rgb) in out.data.as_chunks_mut::<3>().0.iter_mut().zip(&photo.rgb) {
        *o = rgb.map(|v| v as f32 / 255.0);
    }
    out
}

/// Two pictures of the specification's golden value G7: a pattern and itself shifted by 3.
#[cfg(test)]
fn golden() -> (Image, Image) {
    let make = |shift: usize| {
        let mut image = Image::new(24, 24, 3);
        for y in 0..24 {
            for x in 0..24 {
                for c in 0..3 {
                    let v = (7 * x + 13 * y + 5 * c + shift) % 32;
                    image.pixel_mut(x as u32, y as u32)[c] = v as f32 / 31.0;
                }
            }
        }
        image
    };
    (make(0), make(3))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn photo(width: u32, height: u32, value: u8) -> Photo {
        Photo { width, height, rgb: vec![[value; 3]; (width * height) as usize], alpha: None }
    }

    fn flat(width: u32, height: u32, value: f32) -> Image {
        let mut image = Image::new(width, height, 4);
        image.data.fill(value);
        image
    }

    #[test]
    fn a_uniform_error_has_the_psnr_of_its_size() {
        // 51/255 against 0.4 → 102/255: error 0.2, −10 log10(0.04) = 13.9794
        let m = compare("a", &flat(16, 16, 0.4), &photo(16, 16, 51), None, None).unwrap();
        assert!((m.psnr.unwrap() - 13.9794).abs() < 1e-4);
        assert_eq!((m.psnr_masked, m.ssim_masked), (None, None));
        // SSIM of two constants: (2·0.4·0.2 + c1)/(0.4² + 0.2² + c1), c1 = 1e-4
        let expected = (2.0 * 0.4 * 0.2 + 1e-4) / (0.16 + 0.04 + 1e-4);
        assert!((m.ssim.unwrap() - expected).abs() < 1e-6);
    }

    #[test]
    fn only_pixels_in_the_mask_and_valid_count() {
        let mut render = flat(16, 16, 0.2);
        render.pixel_mut(3, 3).fill(0.6); // wrong by 0.4, but masked out
        render.pixel_mut(4, 4).fill(0.6); // in the mask, not valid
        render.pixel_mut(5, 5).fill(0.4); // counted: error 0.2 in one of two pixels
        let mut mask = Gray { width: 16, height: 16, values: vec![0; 256] };
        let mut valid = Gray { values: vec![255; 256], ..mask.clone() };
        for at in [4 * 17, 5 * 17, 6 * 17] {
            mask.values[at] = 200;
        }
        mask.values[3 * 17] = 127;
        valid.values[4 * 17] = 0;
        let m = compare("a", &render, &photo(16, 16, 51), Some(&mask), Some(&valid)).unwrap();
        // −10 log10(0.04 / 2) = 16.9897
        assert!((m.psnr_masked.unwrap() - 16.9897).abs() < 1e-4);
        assert!(m.ssim_masked.unwrap() < 1.0);
    }

    #[test]
    fn figures_in_several_masks_are_those_in_each() {
        let ramp = |by: f32| Image {
            data: (0..24 * 20 * 4).map(|i| (i as f32 * by).sin().abs()).collect(),
            ..Image::new(24, 20, 4)
        };
        let (render, valid) = (ramp(0.37), Gray { width: 24, height: 20, values: vec![255; 480] });
        let rgb = (0..480u32).map(|i| [(i * 7) as u8, (i * 13) as u8, (i * 29) as u8]).collect();
        let photo = Photo { width: 24, height: 20, rgb, alpha: None };
        let half = |right: bool| Gray {
            values: (0..480).map(|i| if (i % 24 < 12) == right { 255 } else { 0 }).collect(),
            ..valid.clone()
        };
        let (left, right) = (half(false), half(true));
        let masks = [None, Some(&left), Some(&right)];
        let each = masks.map(|mask| compare("a", &render, &photo, mask, Some(&valid)).unwrap());
        assert_eq!(compare_in("a", &render, &photo, masks, Some(&valid)).unwrap(), each);
        assert!(each[0].ssim_masked.is_none() && each[1].ssim_masked != each[2].ssim_masked);
        assert!(each[1].psnr_masked != each[2].psnr_masked && each[0].ssim == each[1].ssim);
    }

    #[test]
    fn what_is_undefined_is_none_and_null() {
        let empty = Gray { width: 8, height: 8, values: vec![0; 64] };
        let m = compare("a", &flat(8, 8, 0.2), &photo(8, 8, 51), Some(&empty), None).unwrap();
        // equal pictures have no finite PSNR; 8 pixels hold no window of 11
        assert_eq!((m.psnr, m.ssim, m.psnr_masked, m.ssim_masked), (None, None, None, None));
        let all = Metrics::new(vec![m.clone(), ViewMetrics { psnr: Some(20.0), ..m }]);
        assert_eq!(all.mean.psnr, Some(20.0));
        let json = serde_json::to_value(&all).unwrap();
        assert!(json["mean"]["ssim"].is_null() && json["views"][0]["psnr"].is_null());
    }

    #[test]
    fn another_size_is_an_error() {
        let e = compare("cam", &flat(8, 9, 0.0), &photo(8, 8, 0), None, None).unwrap_err();
        assert_eq!(e.to_string(), "view `cam`: the render is 8 × 9 pixels, expected 8 × 8");
    }
}
