//! Checks of the photographs themselves: blur, overexposure, and pictures that occur twice.

use super::masks::few;
use tiface_base::image::{Gray, Photo, eroded, reduce_photo, resize_gray, working_size};

/// Longest side at which sharpness is compared, pixels.
const COMPARED_PX: u32 = 1024;

/// Sides of the thumbnails by which photographs are recognized as the same.
const THUMBNAIL: u32 = 32;

/// Pixels from the mask's outline that are not compared.
const MARGIN: usize = 3;

/// Minimum number of pixels to compare.
const MIN_PIXELS: usize = 1000;

/// A photograph is blurred below this share of the median photograph's sharpness. Sharp captures
/// have 0.82 at least; a blur of one pixel's deviation leaves 0.55 to 0.70.
const BLURRED: f64 = 0.78;

/// A head is overexposed from this share of saturated pixels on.
const OVEREXPOSED: f64 = 0.02;

/// Mean difference of two thumbnails below which they show the same picture, levels of 255.
const SAME: f64 = 0.25;

/// What is measured of one photograph, on the head where there is a mask.
pub(super) struct PhotoCheck {
    /// Squared gradients at one pixel over those at two; `None` where too little of the head shows.
    sharpness: Option<f64>,
    /// Share of pixels with a channel at its end.
    saturated: f64,
    thumbnail: Vec<u8>,
}

impl PhotoCheck {
    /// Measures a photograph; `mask` has its size.
    pub fn new(photo: &Photo, mask: Option<&Gray>) -> PhotoCheck {
        let size = working_size(photo.width, photo.height, COMPARED_PX);
        let (w, h) = (size.0 as usize, size.1 as usize);
        let inside = match mask {
            Some(mask) => resize_gray(mask, size).values.iter().map(|&m| m >= 240).collect(),
            None => vec![true; w * h],
        };
        let inside = eroded(inside, w, h, MARGIN);
        let reduced = reduce_photo(photo, size);
        let pixels = inside.iter().filter(|&&i| i).count();
        let at_end = |(color, inside): &(&[u8; 3], &bool)| **inside && color.iter().any(|&c| c >= 254);
        let saturated = reduced.rgb.iter().zip(&inside).filter(at_end).count();
        let gray = |photo: &Photo| -> Vec<f64> {
            photo.rgb.iter().map(|c| c.iter().map(|&c| f64::from(c)).sum()).collect()
        };
        let halves = (size.0 / 2, size.1 / 2);
        let sharpness = (pixels >= MIN_PIXELS).then(|| {
            let (fine, coarse) = (gray(&reduced), gray(&reduce_photo(&reduced, halves)));
            let (w2, h2) = (halves.0 as usize, halves.1 as usize);
            let inside_coarse: Vec<bool> =
                (0..w2 * h2).map(|i| inside[(i / w2 * h / h2) * w + i % w2 * w / w2]).collect();
            gradient_energy(&fine, &inside, w) / gradient_energy(&coarse, &inside_coarse, w2).max(1e-9)
        });
        let thumbnail = reduce_photo(&reduced, (size.0.min(THUMBNAIL), size.1.min(THUMBNAIL)));
        PhotoCheck {
            sharpness,
            saturated: saturated as f64 / pixels.max(1) as f64,
            thumbnail: thumbnail.rgb.into_flattened(),
        }
    }

    /// Returns whether two photographs are the same picture.
    fn same(&self, other: &PhotoCheck) -> bool {
        let (a, b) = (&self.thumbnail, &other.thumbnail);
        let difference: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
        a.len() == b.len() && difference < SAME * a.len() as f64
    }
}

/// Returns the mean squared difference of neighbors that both lie inside.
fn gradient_energy(values: &[f64], inside: &[bool], width: usize) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for i in (0..values.len()).filter(|&i| inside[i]) {
        let right = (i % width + 1 < width).then_some(i + 1);
        for j in [right, Some(i + width)].into_iter().flatten().filter(|&j| inside.get(j) == Some(&true)) {
            sum += (values[j] - values[i]).powi(2);
            count += 1;
        }
    }
    sum / count.max(1) as f64
}

/// Returns what is wrong with the photographs of a capture, in sentences.
pub(super) fn findings(photos: &[(&str, PhotoCheck)]) -> Vec<String> {
    let mut found = Vec::new();
    let mut sharpness: Vec<f64> = photos.iter().filter_map(|(_, check)| check.sharpness).collect();
    sharpness.sort_by(f64::total_cmp);
    if let Some(median) = sharpness.get(sharpness.len() / 2) {
        let share = |check: &PhotoCheck| check.sharpness.map(|s| s / median).filter(|s| *s < BLURRED);
        for (name, share) in photos.iter().filter_map(|(name, check)| Some((name, share(check)?))) {
            found.push(format!(
                "photograph `{name}` is blurred: it has {:.0} % of the fine detail of the others; replace it or leave it out",
                100.0 * share
            ));
        }
    }
    let over: Vec<&str> =
        photos.iter().filter(|(_, check)| check.saturated >= OVEREXPOSED).map(|(name, _)| *name).collect();
    if !over.is_empty() {
        found.push(format!(
            "overexposed, with a channel at 255 in at least {:.0} % of the head, where its color is lost: {}",
            100.0 * OVEREXPOSED,
            few(over)
        ));
    }
    for (k, (name, check)) in photos.iter().enumerate() {
        if let Some((first, _)) = photos[..k].iter().find(|(_, earlier)| earlier.same(check)) {
            found.push(format!(
                "photographs `{first}` and `{name}` are the same picture: leave one of them out, with its camera"
            ));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::math::rng::uniform;

    /// A pattern of 96 × 96 pixels with detail at every scale, or a mean of its neighborhoods.
    fn photo(seed: u64, blur: usize) -> Photo {
        let noise: Vec<u8> = (0..96 * 96).map(|i| (uniform(seed, 0, i) * 200.0) as u8).collect();
        let at = |x: usize, y: usize| {
            let (mut sum, mut n) = (0u32, 0);
            for v in y..(y + blur).min(96) {
                for u in x..(x + blur).min(96) {
                    (sum, n) = (sum + u32::from(noise[v * 96 + u]), n + 1);
                }
            }
            [(sum / n) as u8; 3]
        };
        let rgb = (0..96 * 96).map(|i| at(i % 96, i / 96)).collect();
        Photo { width: 96, height: 96, rgb, alpha: None }
    }

    #[test]
    fn a_blurred_an_overexposed_and_a_repeated_photograph_are_named_and_others_are_not() {
        let mut photos: Vec<Photo> = (0..6).map(|seed| photo(seed, 2)).collect();
        let check = |photos: &[Photo]| {
            let names = ["a", "b", "c", "d", "e", "f"];
            let checks: Vec<(&str, PhotoCheck)> =
                names.into_iter().zip(photos.iter().map(|p| PhotoCheck::new(p, None))).collect();
            findings(&checks)
        };
        assert_eq!(check(&photos), Vec::<String>::new());
        photos[1] = photo(1, 5);
        photos[2].rgb[1000..3000].iter_mut().for_each(|c| c[0] = 255);
        photos[5] = photos[4].clone();
        let found = check(&photos);
        assert_eq!(found.len(), 3, "{found:?}");
        assert!(found[0].contains("`b` is blurred"), "{found:?}");
        assert!(found[1].contains("overexposed") && found[1].ends_with("lost: `c`"), "{found:?}");
        assert!(found[2].contains("`e` and `f` are the same picture"), "{found:?}");
    }

    #[test]
    fn a_photograph_too_small_to_compare_is_not_called_blurred() {
        let small = Photo { width: 20, height: 20, rgb: vec![[90; 3]; 400], alpha: None };
        assert!(PhotoCheck::new(&small, None).sharpness.is_none());
    }
}
