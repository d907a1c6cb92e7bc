//! Mask files before anything says which of their values is the head.

use super::limits::Limits;
use super::pictures::{PictureFile, photo_of};
use super::read::read_bytes;
use super::read_error::ReadError;
use crate::image::Gray;
use image::DynamicImage;
use std::path::Path;

/// The pixels of a mask file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MaskPicture {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[height · width]` colors; gray ones of a gray picture.
    pub rgb: Vec<[u8; 3]>,
    /// `[height · width]` alpha; `None` without, and if it is opaque everywhere.
    pub alpha: Option<Vec<u8>>,
    /// Colors by index, if the file is indexed and at least one of them is not gray; else empty.
    /// Those of a gray palette are values themselves: programs that only compress files make such
    /// palettes, in any order.
    pub palette: Vec<[u8; 3]>,
}

impl MaskPicture {
    /// Returns what a pixel is drawn in: its color, or its alpha as a gray if the file has any.
    pub fn drawn(&self, i: usize) -> [u8; 3] {
        self.alpha.as_ref().map_or(self.rgb[i], |alpha| [alpha[i]; 3])
    }

    /// Returns the mask whose head is white: the alpha, if there is any, else the luma (Rec. 601).
    pub fn gray(self) -> Gray {
        let luma = |[r, g, b]: [u8; 3]| (299 * r as u32 + 587 * g as u32 + 114 * b as u32 + 500) / 1000;
        let MaskPicture { width, height, rgb, alpha, .. } = self;
        let values = alpha.unwrap_or_else(|| rgb.into_iter().map(|c| luma(c) as u8).collect());
        Gray { width, height, values }
    }
}

/// Reads a mask file: PNG or JPEG. 16 bits are rounded to 8, except in a gray picture whose values
/// all are below 256: these are labels, and are kept as they are.
///
/// `expected` is the size of its photograph, as for [`read_photo`](super::read_photo).
pub fn read_mask(
    path: &Path,
    expected: Option<(u32, u32)>,
    limits: &Limits,
) -> Result<MaskPicture, ReadError> {
    let bytes = read_bytes(path, limits)?;
    let file = PictureFile { path, bytes: &bytes, limits };
    let picture = match file.decode(expected)? {
        DynamicImage::ImageLuma16(labels) if labels.iter().all(|&v| v < 256) => {
            let (width, height) = labels.dimensions();
            let values = labels.into_raw().into_iter().map(|v| v as u8).collect();
            image::GrayImage::from_raw(width, height, values).unwrap_or_default().into()
        }
        other => other,
    };
    let photo = photo_of(picture);
    let alpha = photo.alpha.filter(|alpha| alpha.iter().any(|&a| a != 255));
    let palette = file.palette();
    let is_gray = palette.iter().all(|[r, g, b]| r == g && g == b);
    let palette = if is_gray { Vec::new() } else { palette };
    Ok(MaskPicture { width: photo.width, height: photo.height, rgb: photo.rgb, alpha, palette })
}

/// Reads a mask whose head is white: [`MaskPicture::gray`].
pub fn read_gray(path: &Path, expected: Option<(u32, u32)>, limits: &Limits) -> Result<Gray, ReadError> {
    read_mask(path, expected, limits).map(MaskPicture::gray)
}

#[cfg(test)]
mod tests {
    use super::super::{write_png_gray16, write_png_rgba};
    use super::*;

    #[test]
    fn sixteen_bits_are_rounded_to_eight_but_for_labels() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let read = |values: &[u16]| {
            write_png_gray16(&path, values.len() as u32, 1, values).unwrap();
            read_gray(&path, None, &Limits::default()).unwrap().values
        };
        // 257 · 7 = 1799 is exactly 7; 1799 + 128 = 1927 is 7.498 → 7; 1928 is 7.502 → 8
        assert_eq!(read(&[1799, 1927, 1928, 65_535]), [7, 7, 8, 255]);
        assert_eq!(read(&[0, 1, 17, 255]), [0, 1, 17, 255]);
        assert_eq!(read(&[0, 1, 17, 256]), [0, 0, 0, 1]);
    }

    #[test]
    fn a_mask_with_an_opaque_alpha_channel_is_read_from_its_color() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        write_png_rgba(&path, 2, 1, &[[255, 255, 255, 255], [0, 0, 0, 255]]).unwrap();
        assert_eq!(read_gray(&path, None, &Limits::default()).unwrap().values, [255, 0]);
        write_png_rgba(&path, 2, 1, &[[255, 255, 255, 9], [0, 0, 0, 255]]).unwrap();
        let picture = read_mask(&path, None, &Limits::default()).unwrap();
        assert_eq!((picture.drawn(0), picture.drawn(1)), ([9; 3], [255; 3]));
    }

    #[test]
    fn only_colors_of_a_palette_are_indices() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let read = |palette: &[u8]| {
            let mut encoder = png::Encoder::new(std::fs::File::create(&path).unwrap(), 3, 1);
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_depth(png::BitDepth::Eight);
            encoder.set_palette(palette);
            encoder.write_header().unwrap().write_image_data(&[0, 1, 2]).unwrap();
            read_mask(&path, None, &Limits::default()).unwrap()
        };
        let labels = read(&[0, 0, 0, 128, 0, 0, 0, 128, 0]);
        assert_eq!(labels.palette, [[0, 0, 0], [128, 0, 0], [0, 128, 0]]);
        assert_eq!(labels.rgb, labels.palette);
        let gray = read(&[0, 0, 0, 7, 7, 7, 1, 1, 1]);
        assert_eq!((gray.palette, gray.rgb), (vec![], vec![[0; 3], [7; 3], [1; 3]]));
    }
}
