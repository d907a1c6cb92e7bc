//! Pictures in memory: 8-bit photographs and float renders.
//!
//! The fields learn and render **sRGB-coded** color, as the published system does, so a render
//! here is coded too and meets linear light only at the edge (EXR, glTF vertex colors, filtering).

mod blur;
mod exposure;
mod glare;
mod morphology;
mod resize;

pub use blur::blurred;
pub use exposure::Exposure;
pub use glare::Glare;
pub use morphology::{dilated, eroded, grow, shrink};
pub use resize::{
    bilinear, enlarge, reduce_photo, reduce_to_rows, resize_gray, resize_hard, size_at_rows, working_size,
};

/// sRGB-coded from linear (IEC 61966-2-1), any value clamped to 0..=1.
#[inline]
pub fn srgb_from_linear(c: f32) -> f32 {
    let c = c.clamp(0.0, 1.0);
    if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }
}

/// Linear from sRGB-coded, any value clamped to 0..=1.
#[inline]
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

/// Value of a mask from which on a pixel is inside: half.
pub const INSIDE: u8 = 128;

impl Gray {
    /// Returns which pixels are inside the mask, from [`INSIDE`] on.
    pub fn inside(&self) -> Vec<bool> {
        self.values.iter().map(|&v| v >= INSIDE).collect()
    }
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

    /// Returns linear color, three channels a pixel, as an sRGB-coded picture, rounded to nearest.
    pub fn encoded(&self) -> Photo {
        let pixel = |c: &[f32; 3]| c.map(|v| quantize(srgb_from_linear(v)));
        let rgb = self.data.as_chunks::<3>().0.iter().map(pixel).collect();
        Photo { width: self.width, height: self.height, rgb, alpha: None }
    }

    /// Returns the values of one pixel.
    #[inline]
    pub fn pixel(&self, x: u32, y: u32) -> &[f32] {
        let i = (y as usize * self.width as usize + x as usize) * self.channels;
        &self.data[i..i + self.channels]
    }

    /// Returns the values of one pixel, to write.
    #[inline]
    pub fn pixel_mut(&mut self, x: u32, y: u32) -> &mut [f32] {
        let i = (y as usize * self.width as usize + x as usize) * self.channels;
        &mut self.data[i..i + self.channels]
    }
}

/// Returns a pixel with straight alpha as it is over black.
#[inline]
pub fn over_black([r, g, b, a]: [u8; 4]) -> [u8; 3] {
    [r, g, b].map(|v| ((u16::from(v) * u16::from(a) + 127) / 255) as u8)
}

/// Value of a soft mask from which on a pixel shows the head alone: matting and lossy masks rarely
/// say 255 everywhere.
pub const OPAQUE_ALPHA: u8 = 250;

/// Coded 0..=1 to 8 bit, rounded to nearest (the published code truncates).
#[inline]
pub fn quantize(c: f32) -> u8 {
    (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
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
}
