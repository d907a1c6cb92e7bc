//! Foreground estimation: the photograph as it would be over black.
//!
//! Where the mask is soft, a photograph mixes head and background: `photo = α F + (1 − α) B` in linear light. The
//! published target `α · photo` darkens the head twice there and keeps part of the background's light. Here the
//! background `B` is estimated from the pixels nearby that are all background, and taken away:
//! `target over black = coded(α F) = coded(photo − (1 − α) B)`, which is what a render over black shows.

use crate::image::{Gray, Photo, linear_from_srgb, quantize, srgb_from_linear};

/// Half edge of the window that collects background pixels, as a share of the picture's height.
const WINDOW: f32 = 0.02;

/// Colors over black for every pixel: the photograph where the mask is full, black where it is empty.
///
/// No channel exceeds the mask's alpha, so that color never asks for more than the mask's opacity.
pub fn over_black(photo: &Photo, mask: &Gray) -> Vec<[u8; 3]> {
    let (w, h) = (photo.width as usize, photo.height as usize);
    let linear: [f32; 256] = std::array::from_fn(|i| linear_from_srgb(i as f32 / 255.0));
    let soft: Vec<usize> = (0..w * h).filter(|&p| !matches!(mask.values[p], 0 | 255)).collect();
    let mut out: Vec<[u8; 3]> =
        photo.rgb.iter().zip(&mask.values).map(|(rgb, &a)| if a == 255 { *rgb } else { [0; 3] }).collect();
    let reach = ((WINDOW * h as f32).ceil() as usize).max(2);
    // large photographs are looked at every few pixels: the background is smooth
    let stride = (reach / 16).max(1);
    for p in soft {
        let (x, y) = (p % w, p / w);
        // nearer background pixels count more; a window without any leaves it black
        let (mut sum, mut weight) = ([0f32; 3], 0f32);
        for v in (y.saturating_sub(reach)..(y + reach + 1).min(h)).step_by(stride) {
            for u in (x.saturating_sub(reach)..(x + reach + 1).min(w)).step_by(stride) {
                let q = v * w + u;
                if mask.values[q] == 0 {
                    let d2 = (u.abs_diff(x).pow(2) + v.abs_diff(y).pow(2)) as f32;
                    let k = 1.0 / (d2 * d2);
                    weight += k;
                    (0..3).for_each(|c| sum[c] += k * linear[photo.rgb[q][c] as usize]);
                }
            }
        }
        let alpha = mask.values[p] as f32 / 255.0;
        out[p] = std::array::from_fn(|c| {
            let background = if weight > 0.0 { sum[c] / weight } else { 0.0 };
            let head = linear[photo.rgb[p][c] as usize] - (1.0 - alpha) * background;
            quantize(srgb_from_linear(head.max(0.0)).min(alpha))
        });
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_light_of_the_background_is_taken_out_of_a_mixed_pixel() {
        // a row: background (linear 0.5), mixed half and half, head (linear 0.2)
        let coded = |l: f32| quantize(srgb_from_linear(l));
        let rgb = [0.5, 0.5, 0.35, 0.2, 0.2].map(|l| [coded(l); 3]).to_vec();
        let photo = Photo { width: 5, height: 1, rgb, alpha: None };
        let mask = Gray { width: 5, height: 1, values: vec![0, 0, 128, 255, 255] };
        let out = over_black(&photo, &mask);
        assert_eq!(out[0], [0; 3]);
        assert_eq!(out[3], photo.rgb[3]);
        // α F = 0.5 · 0.2 = 0.1 linear, coded 0.349
        assert!((out[2][0] as f32 / 255.0 - 0.349).abs() < 0.01, "{:?}", out[2]);
    }

    #[test]
    fn a_lamp_behind_thin_hair_leaves_no_light() {
        let photo = Photo { width: 2, height: 1, rgb: vec![[255; 3], [240; 3]], alpha: None };
        let mask = Gray { width: 2, height: 1, values: vec![0, 40] };
        let out = over_black(&photo, &mask);
        assert!(out[1][0] <= 40);
    }
}
