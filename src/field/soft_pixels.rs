//! Colors of soft pixels without the light of the background.
//!
//! Where the mask is soft, a photograph mixes head and background: `photo = α F + (1 − α) B` in
//! linear light. The published target `α · photo` darkens the head twice at soft pixels and keeps
//! part of the background's light. This module estimates the background `B` from nearby pixels that
//! are fully background, and subtracts it:
//! `target over black = coded(α F) = coded(photo − (1 − α) B)`, which is the color of a render over
//! black.

use tiface_base::image::{Gray, Photo, linear_from_srgb, quantize, srgb_from_linear};

/// Half edge of the window that collects background pixels, as a share of the picture's height.
const WINDOW: f32 = 0.02;

/// Colors over black of a photograph's soft pixels. All other pixels keep the photograph's color or
/// are black.
pub struct SoftPixels {
    /// Indices of the soft pixels, in ascending order.
    at: Vec<u32>,
    color: Vec<[u8; 3]>,
}

impl SoftPixels {
    /// Returns the color of pixel `p` over black: the photograph's where the mask is 255, black
    /// where it is 0.
    pub fn over_black(&self, photo: &Photo, mask: &Gray, p: usize) -> [u8; 3] {
        match mask.values[p] {
            0 => [0; 3],
            255 => photo.rgb[p],
            _ => self.at.binary_search(&(p as u32)).map_or([0; 3], |i| self.color[i]),
        }
    }
}

/// Removes the background's light from the soft pixels.
///
/// No channel exceeds the mask's alpha, so that color never requires more than the mask's opacity.
pub fn soft_pixels(photo: &Photo, mask: &Gray) -> SoftPixels {
    let (w, h) = (photo.width as usize, photo.height as usize);
    let linear: [f32; 256] = std::array::from_fn(|i| linear_from_srgb(i as f32 / 255.0));
    let at: Vec<u32> = (0..(w * h) as u32).filter(|&p| !matches!(mask.values[p as usize], 0 | 255)).collect();
    let reach = ((WINDOW * h as f32).ceil() as usize).max(2);
    // Large photographs are sampled every few pixels, because the background is smooth.
    let stride = (reach / 16).max(1);
    let over_black = |&p: &u32| {
        let p = p as usize;
        let (x, y) = (p % w, p / w);
        // Nearer background pixels weigh more. A window without background pixels estimates black.
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
        std::array::from_fn(|c| {
            let background = if weight > 0.0 { sum[c] / weight } else { 0.0 };
            let head = linear[photo.rgb[p][c] as usize] - (1.0 - alpha) * background;
            quantize(srgb_from_linear(head.max(0.0)).min(alpha))
        })
    };
    let color = at.iter().map(over_black).collect();
    SoftPixels { at, color }
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
        let soft = soft_pixels(&photo, &mask);
        let out: Vec<[u8; 3]> = (0..5).map(|p| soft.over_black(&photo, &mask, p)).collect();
        assert_eq!(soft.at, [2]);
        assert_eq!(out[0], [0; 3]);
        assert_eq!(out[3], photo.rgb[3]);
        // α F = 0.5 · 0.2 = 0.1 linear, coded 0.349
        assert!((out[2][0] as f32 / 255.0 - 0.349).abs() < 0.01, "{:?}", out[2]);
    }

    #[test]
    fn a_lamp_behind_thin_hair_leaves_no_light() {
        let photo = Photo { width: 2, height: 1, rgb: vec![[255; 3], [240; 3]], alpha: None };
        let mask = Gray { width: 2, height: 1, values: vec![0, 40] };
        assert!(soft_pixels(&photo, &mask).over_black(&photo, &mask, 1)[0] <= 40);
    }
}
