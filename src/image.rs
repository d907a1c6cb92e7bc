//! Pictures in memory: 8-bit photographs and float renders.
//!
//! The fields learn and render **sRGB-coded** color, as the published system does, so a render
//! here is coded too and meets linear light only at the edge (EXR, glTF vertex colors, filtering).

mod exposure;
mod resize;

pub use exposure::Exposure;
pub use resize::{
    bilinear, enlarge, reduce_photo, reduce_to_rows, resize_gray, resize_hard, size_at_rows, working_size,
};

/// sRGB-coded from linear (IEC 61966-2-1), any value clamped to 0..=1.
pub fn srgb_from_linear(c: f32) -> f32 {
    let c = c.clamp(0.0, 1.0);
    if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }
}

/// Linear from sRGB-coded, any value clamped to 0..=1.
pub fn linear_from_srgb(s: f32) -> f32 {
    let s = s.clamp(0.0, 1.0);
    if s <= 0.040_45 { s / 12.92 } else { ((s + 0.055) / 1.055).powf(2.4) }
}

/// A photograph as it lies in host memory: 8 bit, sRGB-coded, row-major, top row first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Photo {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[height · width]` colors.
    pub rgb: Vec<[u8; 3]>,
    /// `[height · width]` alpha of an RGBA file (straight: color not multiplied); `None` without.
    pub alpha: Option<Vec<u8>>,
}

/// One 8-bit channel: a soft mask (0 = not head, 255 = head) or a valid mask (0 or 255).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gray {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[height · width]` values.
    pub values: Vec<u8>,
}

/// A float picture with `channels` interleaved values a pixel, row-major, top row first.
///
/// Renders are RGBA: sRGB-coded color over black (premultiplied), alpha = opacity. Depth has one
/// channel, normals three.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Image {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Values per pixel.
    pub channels: usize,
    /// `[height · width · channels]` values.
    pub data: Vec<f32>,
}

impl Image {
    /// Returns an image of zeros.
    pub fn new(width: u32, height: u32, channels: usize) -> Image {
        Image { width, height, channels, data: vec![0.0; width as usize * height as usize * channels] }
    }

    /// Returns the values of channel `k`, one a pixel.
    pub fn channel(&self, k: usize) -> Vec<f32> {
        self.data.iter().skip(k).step_by(self.channels).copied().collect()
    }

    /// Returns the values of one pixel.
    pub fn pixel(&self, x: u32, y: u32) -> &[f32] {
        let i = (y as usize * self.width as usize + x as usize) * self.channels;
        &self.data[i..i + self.channels]
    }

    /// Returns the values of one pixel, to write.
    pub fn pixel_mut(&mut self, x: u32, y: u32) -> &mut [f32] {
        let i = (y as usize * self.width as usize + x as usize) * self.channels;
        &mut self.data[i..i + self.channels]
    }
}

/// Returns a pixel with straight alpha as it is over black.
pub fn over_black([r, g, b, a]: [u8; 4]) -> [u8; 3] {
    [r, g, b].map(|v| ((u16::from(v) * u16::from(a) + 127) / 255) as u8)
}

/// Value of a soft mask from which on a pixel shows the head alone: matting and lossy masks rarely say 255 everywhere.
pub const OPAQUE_ALPHA: u8 = 250;

/// Coded 0..=1 to 8 bit, rounded to nearest (the published code truncates).
pub fn quantize(c: f32) -> u8 {
    (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

/// Returns where a whole square of half edge `margin` is set, of a picture `w × h`; none at its border is.
pub fn eroded(mut set: Vec<bool>, w: usize, h: usize, margin: usize) -> Vec<bool> {
    for (lines, step, n, stride) in [(h, w, w, 1), (w, 1, h, w)] {
        for first in (0..lines).map(|line| line * step) {
            // length of the run of set values that ends here
            let mut run = 0;
            let runs: Vec<usize> = (0..n)
                .map(|i| {
                    run = if set[first + i * stride] { run + 1 } else { 0 };
                    run
                })
                .collect();
            for i in 0..n {
                set[first + i * stride] = runs.get(i + margin).is_some_and(|&r| r > 2 * margin);
            }
        }
    }
    set
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_goes_there_and_back_for_every_byte() {
        for i in 0..=255u8 {
            let s = i as f32 / 255.0;
            assert_eq!(quantize(srgb_from_linear(linear_from_srgb(s))), i);
        }
    }

    #[test]
    fn eroding_leaves_pixels_whose_whole_square_is_set() {
        // 7 × 5, one hole at (1, 2): with a margin of 1 columns 3 to 5 of rows 1 to 3 are left
        let mut set = vec![true; 35];
        set[2 * 7 + 1] = false;
        let left = eroded(set, 7, 5, 1);
        let expected = |i: usize| (3..=5).contains(&(i % 7)) && (1..=3).contains(&(i / 7));
        assert!((0..35).all(|i| left[i] == expected(i)), "{left:?}");
        assert!(eroded(vec![true; 6], 3, 2, 2).iter().all(|set| !set));
    }
}
