//! Photographs and masks: PNG and JPEG, in and out.
//!
//! The content decides the format. Sizes are checked before anything is decoded, and the frame of
//! the file (PNG chunks, JPEG segments) is walked to its end first: decoders forgive a missing tail
//! and fill it with gray, which would then be learned as a face. One damage passes: a baseline JPEG
//! whose scan was cut and closed again with a proper end marker, since only decoding each code
//! could tell.

use super::limits::Limits;
use super::read::{open, read_bytes};
use super::read_error::ReadError;
use super::write::{WriteError, write_atomic};
use crate::image::{Gray, Photo};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngDecoder, PngEncoder};
use image::metadata::Orientation;
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder};
use std::io::{Cursor, Read};
use std::path::Path;
use zune_jpeg::zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions};

/// The header of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureInfo {
    /// Stored pixels per row.
    pub width: u32,
    /// Stored rows.
    pub height: u32,
    /// Whether it has an alpha channel.
    pub alpha: bool,
    /// EXIF orientation, 1 (upright) to 8.
    pub exif: u8,
    /// EXIF focal length as stored, a fraction of millimeters.
    pub focal: Option<(u32, u32)>,
}

impl PictureInfo {
    /// Returns the size after the turn that `expected` calls for, as [`read_photo`] would return
    /// it.
    pub fn size(&self, expected: Option<(u32, u32)>) -> (u32, u32) {
        let stored = (self.width, self.height);
        if is_turned(self.exif, stored, expected) { (stored.1, stored.0) } else { stored }
    }

    /// Returns whether EXIF asks for a turn that leaves the size as it is, so that no size says
    /// whether it is expected.
    pub fn is_turn_open(&self) -> bool {
        (2..=4).contains(&self.exif) || ((5..=8).contains(&self.exif) && self.width == self.height)
    }
}

/// Returns whether the EXIF rotation is applied. A quarter turn is, only when it is what makes the
/// declared size true: else cameras were found for the stored pixels. Half turns, mirrors and turns
/// of squares fit any size, which therefore does not say whether the cameras were found before or
/// after them: [`turned_photo`] applies these.
fn is_turned(exif: u8, stored: (u32, u32), expected: Option<(u32, u32)>) -> bool {
    let turned = (stored.1, stored.0);
    (5..=8).contains(&exif) && expected == Some(turned) && stored != turned
}

/// Returns the focal length in EXIF data, whose layout is that of a TIFF file (EXIF 2.3, 4.6).
fn focal_length(exif: &[u8]) -> Option<(u32, u32)> {
    let little = exif.starts_with(b"II");
    let bytes = |at: usize, n: usize| exif.get(at..at.checked_add(n)?);
    let number = |at: usize, n: usize| -> Option<u32> {
        let digit = |sum: u32, byte: &u8| sum << 8 | u32::from(*byte);
        let bytes = bytes(at, n)?;
        Some(if little { bytes.iter().rev().fold(0, digit) } else { bytes.iter().fold(0, digit) })
    };
    // an entry: tag, type, count, value or where it is
    let value = |directory: usize, tag: u32| -> Option<u32> {
        let entries = (0..number(directory, 2)? as usize).map(|k| directory + 2 + 12 * k);
        let mut found =
            entries.take_while(|&at| bytes(at, 12).is_some()).filter(|&at| number(at, 2) == Some(tag));
        number(found.next()? + 8, 4)
    };
    let camera = value(number(4, 4)? as usize, 0x8769)?;
    let at = value(camera as usize, 0x920a)? as usize;
    Some((number(at, 4)?, number(at.checked_add(4)?, 4)?)).filter(|(above, below)| *above > 0 && *below > 0)
}

/// Returns the size, alpha, orientation and focal length of a PNG or JPEG file, from its header
/// only.
pub fn picture_info(path: &Path, limits: &Limits) -> Result<PictureInfo, ReadError> {
    let (file, length) = open(path)?;
    if length == 0 {
        return Err(ReadError::Empty { path: path.into() });
    }
    // a header with EXIF, color profile and thumbnail stays below this; else the whole file is read
    let mut head = Vec::new();
    file.take(1 << 18).read_to_end(&mut head).map_err(|e| ReadError::io(path, e))?;
    match parse_picture_info(&head, path, limits) {
        Err(_) if (head.len() as u64) < length => {
            parse_picture_info(&read_bytes(path, limits)?, path, limits)
        }
        other => other,
    }
}

/// [`picture_info`] of a picture that lies inside another file. `path` is for messages only.
pub fn parse_picture_info(bytes: &[u8], path: &Path, limits: &Limits) -> Result<PictureInfo, ReadError> {
    let file = PictureFile { path, bytes, limits };
    if file.is_png()? { Ok(file.png_decoder()?.1) } else { Ok(file.jpeg_decoder()?.1) }
}

/// Suggested fix for pictures of other formats.
const NOT_READ: &str = "convert it to PNG or JPEG (ImageMagick: `magick mogrify -format png FILES`); where another file \
                        names it with its ending, correct the name as well";

/// The bytes of a picture that is being read.
#[derive(Clone, Copy)]
pub(super) struct PictureFile<'a> {
    pub path: &'a Path,
    pub bytes: &'a [u8],
    pub limits: &'a Limits,
}

type Png<'a> = PngDecoder<Cursor<&'a [u8]>>;
type Jpeg<'a> = zune_jpeg::JpegDecoder<ZCursor<&'a [u8]>>;

impl<'a> PictureFile<'a> {
    fn png(self, at: impl Into<Option<u64>>, problem: impl ToString) -> ReadError {
        ReadError::damaged(self.path, "PNG", at, problem.to_string())
    }

    fn jpeg(self, at: impl Into<Option<u64>>, problem: impl Into<String>) -> ReadError {
        ReadError::damaged(self.path, "JPEG", at, problem)
    }

    fn is_png(self) -> Result<bool, ReadError> {
        let other = match self.bytes {
            [0x89, b'P', b'N', b'G', 0x0D, 0x0A, 0x1A, 0x0A, ..] => return Ok(true),
            [0xFF, 0xD8, 0xFF, ..] => return Ok(false),
            [b'G', b'I', b'F', b'8', ..] => "a GIF picture",
            [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => "a WebP picture",
            [b'I', b'I', 42, 0, ..] | [b'M', b'M', 0, 42, ..] => "a TIFF or camera raw picture",
            [_, _, _, _, b'f', b't', b'y', b'p', ..] => "a HEIF or AVIF picture or a film",
            [0x76, 0x2F, 0x31, 0x01, ..] => "an OpenEXR picture",
            [b'B', b'M', ..] => "a BMP picture",
            _ => {
                let problem = "its first bytes are those of neither";
                return Err(ReadError::damaged(self.path, "PNG or JPEG", Some(0), problem));
            }
        };
        Err(ReadError::unsupported(self.path, other, NOT_READ))
    }

    fn check_size(self, width: u32, height: u32, bytes_px: u64) -> Result<(), ReadError> {
        self.limits.check_side(self.path, width.max(height).into())?;
        self.limits.check_decoded(self.path, (width as u64 * height as u64).saturating_mul(bytes_px))
    }

    fn png_decoder(self) -> Result<(Png<'a>, PictureInfo), ReadError> {
        let be = |at: usize| self.bytes.get(at..)?.first_chunk().map(|b| u32::from_be_bytes(*b));
        // width and height of IHDR, which must come first: checked before the decoder reserves a
        // row, for the 8 bytes that a pixel takes at most
        if let (Some(width), Some(height)) = (be(16), be(20)) {
            self.check_size(width, height, 8)?;
        }
        let mut allowed = image::Limits::no_limits();
        allowed.max_image_width = Some(self.limits.side_px);
        allowed.max_image_height = Some(self.limits.side_px);
        allowed.max_alloc = Some(self.limits.decoded_bytes);
        let decoder = PngDecoder::with_limits(Cursor::new(self.bytes), allowed);
        let mut decoder = decoder.map_err(|e| self.png(None, e))?;
        let (width, height) = decoder.dimensions();
        let exif = decoder.orientation().map_or(1, Orientation::to_exif);
        let alpha = decoder.color_type().has_alpha();
        let focal = decoder.exif_metadata().ok().flatten().and_then(|chunk| focal_length(&chunk));
        Ok((decoder, PictureInfo { width, height, alpha, exif, focal }))
    }

    fn jpeg_decoder(self) -> Result<(Jpeg<'a>, PictureInfo), ReadError> {
        // strict: a photograph with damaged data is an error, not a picture with gray blocks
        let options = DecoderOptions::default()
            .set_strict_mode(true)
            .set_max_width(usize::from(u16::MAX))
            .set_max_height(usize::from(u16::MAX));
        let mut decoder = Jpeg::new_with_options(ZCursor::new(self.bytes), options);
        decoder.decode_headers().map_err(|e| self.jpeg(None, format!("{e:?}")))?;
        let (Some((width, height)), Some(space)) = (decoder.dimensions(), decoder.input_colorspace()) else {
            return Err(self.jpeg(None, "it has no frame header"));
        };
        let (width, height) = (width as u32, height as u32);
        self.check_size(width, height, 3)?;
        let out = match space {
            ColorSpace::Luma => ColorSpace::Luma,
            ColorSpace::RGB | ColorSpace::YCbCr => ColorSpace::RGB,
            other => {
                let hint = "export the photograph in sRGB; print colors (CMYK) have no single meaning here";
                return Err(ReadError::unsupported(self.path, format!("a JPEG in {other:?} colors"), hint));
            }
        };
        decoder.set_options(options.jpeg_set_out_colorspace(out));
        let turn = decoder.exif().and_then(|chunk| Orientation::from_exif_chunk(chunk));
        let exif = turn.map_or(1, Orientation::to_exif);
        let focal = decoder.exif().and_then(|chunk| focal_length(chunk));
        Ok((decoder, PictureInfo { width, height, alpha: false, exif, focal }))
    }

    /// Walks the chunks of a PNG to `IEND` and returns the bytes of picture data.
    fn walk_png(self) -> Result<u64, ReadError> {
        let bytes = self.bytes;
        let (mut at, mut data) = (8, 0u64);
        loop {
            let Some(head) = bytes.get(at..at + 8) else {
                return Err(self.png(bytes.len() as u64, "it ends before its last chunk (`IEND`)"));
            };
            let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]) as usize;
            if bytes.len() - at - 8 < length.saturating_add(4) {
                return Err(self.png(at as u64, "a chunk reaches beyond the end of the file"));
            }
            match &head[4..] {
                b"IDAT" => data += length as u64,
                b"IEND" => return Ok(data),
                _ => {}
            }
            at += 12 + length;
        }
    }

    /// Walks the segments of a JPEG to the end-of-image marker and returns the maximum number of
    /// pixels in its picture data: a block of 64 takes a bit at least, and without progression a
    /// second one for its end.
    fn walk_jpeg(self) -> Result<u64, ReadError> {
        let bytes = self.bytes;
        let end = |problem: &str| self.jpeg(bytes.len() as u64, problem);
        let mut at = 2;
        let (mut scanned, mut data, mut progressive) = (false, 0, false);
        loop {
            // between segments and inside a scan: forward to the next 0xFF that begins a marker
            let Some(step) = bytes[at.min(bytes.len())..]
                .windows(2)
                .position(|w| w[0] == 0xFF && !matches!(w[1], 0x00 | 0xFF | 0xD0..=0xD7))
            else {
                return Err(end("it ends before the end-of-image marker: cut short"));
            };
            at += step;
            data += if scanned { step as u64 } else { 0 };
            let marker = bytes[at + 1];
            match marker {
                0xD9 if scanned => return Ok(data * if progressive { 8 * 64 } else { 4 * 64 }),
                0xD9 => return Err(self.jpeg(at as u64, "it holds no picture data")),
                0x01 | 0xD8 => at += 2,
                _ => {
                    let Some(l) = bytes.get(at + 2..at + 4) else {
                        return Err(end("it ends inside a segment: cut short"));
                    };
                    scanned |= marker == 0xDA;
                    progressive |= marker == 0xC2;
                    at += 2 + u16::from_be_bytes([l[0], l[1]]) as usize;
                }
            }
        }
    }

    fn decode_png(self) -> Result<(DynamicImage, PictureInfo), ReadError> {
        let data = self.walk_png()?;
        let (decoder, info) = self.png_decoder()?;
        // deflate cannot shrink by more than 1032: a small file that claims more is lying
        let (width, height, bits) = (info.width, info.height, decoder.original_color_type().bits_per_pixel());
        if width as u64 * height as u64 * bits as u64 / 8 / 1032 > data {
            let problem = format!("{width} × {height} pixels cannot come from its {data} bytes of data");
            return Err(self.png(None, problem));
        }
        Ok((DynamicImage::from_decoder(decoder).map_err(|e| self.png(None, e))?, info))
    }

    fn decode_jpeg(self) -> Result<(DynamicImage, PictureInfo), ReadError> {
        let max_pixels = self.walk_jpeg()?;
        let (mut decoder, info) = self.jpeg_decoder()?;
        let (width, height) = (info.width, info.height);
        let claimed = u64::from(width) * u64::from(height);
        if claimed > max_pixels {
            let problem = format!(
                "{width} × {height} pixels cannot come from its picture data, enough for {max_pixels}"
            );
            return Err(self.jpeg(None, problem));
        }
        let pixels = decoder.decode().map_err(|e| self.jpeg(None, format!("{e:?}")))?;
        let picture = match pixels.len() as u64 / claimed.max(1) {
            1 => image::GrayImage::from_raw(width, height, pixels).map(DynamicImage::from),
            _ => image::RgbImage::from_raw(width, height, pixels).map(DynamicImage::from),
        };
        let problem = "the decoder returned another number of pixels than the header names";
        Ok((picture.ok_or_else(|| self.jpeg(None, problem))?, info))
    }

    /// Returns the decoded picture, turned as [`is_turned`] says.
    pub(super) fn decode(self, expected: Option<(u32, u32)>) -> Result<DynamicImage, ReadError> {
        let (mut picture, info) = if self.is_png()? { self.decode_png()? } else { self.decode_jpeg()? };
        if is_turned(info.exif, (info.width, info.height), expected) {
            picture = oriented(picture, info.exif);
        }
        Ok(picture)
    }

    /// Returns the palette of an indexed PNG; empty for every other file.
    pub(super) fn palette(self) -> Vec<[u8; 3]> {
        /// Place of the color type in `IHDR`, and its value for indexed colors.
        const COLOR_TYPE: (usize, u8) = (25, 3);
        if self.is_png().ok() != Some(true) || self.bytes.get(COLOR_TYPE.0) != Some(&COLOR_TYPE.1) {
            return Vec::new();
        }
        let mut at = 8;
        while let Some([a, b, c, d, kind @ ..]) = self.bytes.get(at..at + 8) {
            let length = u32::from_be_bytes([*a, *b, *c, *d]) as usize;
            let Some(data) = self.bytes.get(at + 8..).and_then(|rest| rest.get(..length)) else { break };
            match kind {
                b"PLTE" => return data.as_chunks::<3>().0.iter().take(256).copied().collect(),
                b"IDAT" => break,
                _ => at += 12 + length,
            }
        }
        Vec::new()
    }
}

/// Returns a decoded picture as a photograph, 16 bits rounded to 8.
pub(super) fn photo_of(picture: DynamicImage) -> Photo {
    let (width, height, color) = (picture.width(), picture.height(), picture.color());
    let pixels: Vec<[u8; 4]> = if color.has_color() {
        picture.into_rgba8().pixels().map(|p| p.0).collect()
    } else {
        picture.into_luma_alpha8().pixels().map(|p| [p[0], p[0], p[0], p[1]]).collect()
    };
    let alpha = color.has_alpha().then(|| pixels.iter().map(|p| p[3]).collect());
    let rgb = pixels.into_iter().map(|[r, g, b, _]| [r, g, b]).collect();
    Photo { width, height, rgb, alpha }
}

/// Reads a photograph: PNG (gray, palette, color, 8 or 16 bit, with or without alpha) or JPEG (gray
/// or color; CMYK is refused). Color profiles are not applied: bytes are taken as sRGB, 16 bits are
/// rounded to 8.
///
/// `expected` is the size its cameras were calibrated for, if declared: a quarter turn that EXIF
/// asks for is applied only if it leads to that size. Another size is not an error here.
pub fn read_photo(path: &Path, expected: Option<(u32, u32)>, limits: &Limits) -> Result<Photo, ReadError> {
    PictureFile { path, bytes: &read_bytes(path, limits)?, limits }.decode(expected).map(photo_of)
}

/// Returns a photograph turned, or mirrored, as an EXIF orientation asks.
pub fn turned_photo(photo: Photo, exif: u8) -> Photo {
    let Photo { width, height, rgb, alpha } = photo;
    let alpha = alpha.map(|values| turned_gray(Gray { width, height, values }, exif).values);
    let picture = image::RgbImage::from_raw(width, height, rgb.into_flattened());
    let turned = oriented(picture.unwrap_or_default().into(), exif).into_rgb8();
    let (width, height) = turned.dimensions();
    Photo { width, height, rgb: turned.pixels().map(|pixel| pixel.0).collect(), alpha }
}

/// Returns a mask turned, or mirrored, as an EXIF orientation asks.
pub fn turned_gray(gray: Gray, exif: u8) -> Gray {
    let picture = image::GrayImage::from_raw(gray.width, gray.height, gray.values);
    let turned = oriented(picture.unwrap_or_default().into(), exif).into_luma8();
    let (width, height) = turned.dimensions();
    Gray { width, height, values: turned.into_raw() }
}

fn oriented(mut picture: DynamicImage, exif: u8) -> DynamicImage {
    if let Some(orientation) = Orientation::from_exif(exif) {
        picture.apply_orientation(orientation);
    }
    picture
}

/// Returns a picture that lies inside another file, as [`read_photo`] would read it from one of its
/// own. `path` is for messages only.
pub fn parse_photo(bytes: &[u8], path: &Path, limits: &Limits) -> Result<Photo, ReadError> {
    PictureFile { path, bytes, limits }.decode(None).map(photo_of)
}

fn png(
    path: &Path,
    width: u32,
    height: u32,
    bytes: &[u8],
    color: ExtendedColorType,
) -> Result<Vec<u8>, WriteError> {
    let content = |problem: String| WriteError::content(path, problem);
    let needed = width as u64 * height as u64 * color.bits_per_pixel() as u64 / 8;
    if needed != bytes.len() as u64 || needed == 0 {
        let problem = format!("{width} × {height} pixels need {needed} bytes, {} were given", bytes.len());
        return Err(content(problem));
    }
    let mut out = Vec::new();
    PngEncoder::new_with_quality(&mut out, CompressionType::Default, FilterType::Adaptive)
        .write_image(bytes, width, height, color)
        .map_err(|e| content(e.to_string()))?;
    Ok(out)
}

fn write_png(
    path: &Path,
    width: u32,
    height: u32,
    bytes: &[u8],
    color: ExtendedColorType,
) -> Result<(), WriteError> {
    write_atomic(path, &png(path, width, height, bytes, color)?)
}

/// Returns a photograph as the bytes of a PNG file, without its alpha. `path` is for messages only.
pub fn png_bytes(photo: &Photo, path: &Path) -> Result<Vec<u8>, WriteError> {
    png(path, photo.width, photo.height, photo.rgb.as_flattened(), ExtendedColorType::Rgb8)
}

/// Writes an 8-bit RGB PNG, sRGB-coded.
pub fn write_png_rgb(path: &Path, width: u32, height: u32, rgb: &[[u8; 3]]) -> Result<(), WriteError> {
    write_png(path, width, height, rgb.as_flattened(), ExtendedColorType::Rgb8)
}

/// Writes an 8-bit RGBA PNG, sRGB-coded with straight alpha.
pub fn write_png_rgba(path: &Path, width: u32, height: u32, rgba: &[[u8; 4]]) -> Result<(), WriteError> {
    write_png(path, width, height, rgba.as_flattened(), ExtendedColorType::Rgba8)
}

/// Returns a gray picture as the bytes of an 8-bit PNG file. `path` is for messages only.
pub fn png_gray_bytes(gray: &Gray, path: &Path) -> Result<Vec<u8>, WriteError> {
    png(path, gray.width, gray.height, &gray.values, ExtendedColorType::L8)
}

/// Writes an 8-bit gray PNG.
pub fn write_png_gray(path: &Path, gray: &Gray) -> Result<(), WriteError> {
    write_atomic(path, &png_gray_bytes(gray, path)?)
}

/// Writes a 16-bit gray PNG (depth in millimeters).
pub fn write_png_gray16(path: &Path, width: u32, height: u32, values: &[u16]) -> Result<(), WriteError> {
    // the encoder takes native byte order and swaps itself
    write_png(path, width, height, bytemuck::cast_slice(values), ExtendedColorType::L16)
}

/// Returns a photograph as the bytes of a JPEG file of `quality` 1 to 100, without its alpha.
/// `path` is for messages only.
pub fn jpeg_bytes(photo: &Photo, quality: u8, path: &Path) -> Result<Vec<u8>, WriteError> {
    let content = |problem: String| WriteError::content(path, problem);
    let (width, height) = (photo.width, photo.height);
    let pixels = width as u64 * height as u64;
    if pixels == 0 || pixels != photo.rgb.len() as u64 || width.max(height) > u16::MAX as u32 {
        return Err(content(format!("{width} × {height} with {} pixels is no JPEG", photo.rgb.len())));
    }
    let mut out = Vec::new();
    JpegEncoder::new_with_quality(&mut out, quality.clamp(1, 100))
        .write_image(photo.rgb.as_flattened(), width, height, ExtendedColorType::Rgb8)
        .map_err(|e| content(e.to_string()))?;
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let limits = Limits::default();
        write_png_rgb(&path, 2, 1, &[[1, 2, 3], [250, 251, 252]]).unwrap();
        let p = read_photo(&path, None, &limits).unwrap();
        assert_eq!((p.width, p.height, p.alpha), (2, 1, None));
        assert_eq!(p.rgb, [[1, 2, 3], [250, 251, 252]]);
        write_png_rgba(&path, 1, 2, &[[1, 2, 3, 4], [5, 6, 7, 8]]).unwrap();
        assert_eq!(read_photo(&path, None, &limits).unwrap().alpha, Some(vec![4, 8]));
        let info = picture_info(&path, &limits).unwrap();
        assert_eq!((info.width, info.height, info.alpha, info.exif), (1, 2, true, 1));
        let bytes = std::fs::read(&path).unwrap();
        assert_eq!(parse_picture_info(&bytes, &path, &limits).unwrap(), info);
        assert_eq!(parse_photo(&bytes, &path, &limits).unwrap().rgb, [[1, 2, 3], [5, 6, 7]]);
        let small = Limits { side_px: 1, ..limits };
        assert!(parse_photo(&bytes, &path, &small).is_err());
        assert!(parse_picture_info(&bytes, &path, &small).is_err());
    }

    #[test]
    fn a_quarter_turn_is_applied_only_when_the_declared_size_agrees() {
        assert!(is_turned(6, (40, 30), Some((30, 40))));
        for (exif, stored, expected) in [
            (6, (40, 30), Some((40, 30))),
            (6, (40, 30), None),
            (6, (40, 40), Some((40, 40))),
            (3, (40, 30), Some((40, 30))),
            (3, (40, 30), Some((30, 40))),
            (1, (40, 30), Some((40, 30))),
        ] {
            assert!(!is_turned(exif, stored, expected), "{exif} {expected:?}");
        }
    }

    #[test]
    fn a_picture_is_turned_and_mirrored_as_exif_asks() {
        // rows 1 2 3 and 4 5 6
        let gray = |width, values: &[u8]| Gray { width, height: 6 / width, values: values.to_vec() };
        let stored = gray(3, &[1, 2, 3, 4, 5, 6]);
        for (exif, turned) in [
            (1, gray(3, &[1, 2, 3, 4, 5, 6])),
            (2, gray(3, &[3, 2, 1, 6, 5, 4])),
            (3, gray(3, &[6, 5, 4, 3, 2, 1])),
            (4, gray(3, &[4, 5, 6, 1, 2, 3])),
            (6, gray(2, &[4, 1, 5, 2, 6, 3])),
            (8, gray(2, &[3, 6, 2, 5, 1, 4])),
            (99, gray(3, &[1, 2, 3, 4, 5, 6])),
        ] {
            assert_eq!(turned_gray(stored.clone(), exif), turned, "{exif}");
            let rgb = stored.values.iter().map(|&v| [v, 0, 9]).collect();
            let photo = Photo { width: 3, height: 2, rgb, alpha: Some(stored.values.clone()) };
            let photo = turned_photo(photo, exif);
            assert_eq!(photo.alpha.as_ref(), Some(&turned.values));
            assert_eq!(photo.rgb.iter().map(|c| c[0]).collect::<Vec<u8>>(), turned.values);
            assert_eq!((photo.width, photo.height), (turned.width, turned.height));
        }
    }

    #[test]
    fn a_focal_length_is_read_in_both_byte_orders_and_from_no_cut_exif() {
        for little in [true, false] {
            let u16s = |v: u16| if little { v.to_le_bytes() } else { v.to_be_bytes() };
            let u32s = |v: u32| if little { v.to_le_bytes() } else { v.to_be_bytes() };
            let mut exif = if little { b"II*\0".to_vec() } else { b"MM\0*".to_vec() };
            exif.extend(u32s(8));
            // directories at 8 and 26, of one entry each; the fraction at 44
            for (tag, kind, value) in [(0x8769, 4, 26), (0x920a, 5, 44)] {
                exif.extend([u16s(1), u16s(tag), u16s(kind)].as_flattened());
                exif.extend([u32s(1), u32s(value), u32s(0)].as_flattened());
            }
            exif.extend([u32s(85), u32s(10)].as_flattened());
            assert_eq!(focal_length(&exif), Some((85, 10)), "8.5 mm");
            assert!((0..exif.len()).all(|n| focal_length(&exif[..n]).is_none()));
        }
    }

    #[test]
    fn too_few_values_are_an_error_not_a_crash() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        assert!(matches!(write_png_rgb(&path, 2, 2, &[[0; 3]]), Err(WriteError::Content { .. })));
        assert!(!path.exists());
    }

    #[test]
    fn a_jpeg_of_a_photograph_looks_like_it() {
        let rgb: Vec<[u8; 3]> = (0..256).map(|i| [i as u8, 128, 255 - i as u8]).collect();
        let photo = Photo { width: 16, height: 16, rgb, alpha: Some(vec![9; 256]) };
        let bytes = jpeg_bytes(&photo, 95, Path::new("a.jpg")).unwrap();
        let back = parse_photo(&bytes, Path::new("a.jpg"), &Limits::default()).unwrap();
        let apart =
            back.rgb.iter().zip(&photo.rgb).map(|(a, b)| a[0].abs_diff(b[0]).max(a[2].abs_diff(b[2])));
        assert!(apart.max() < Some(24) && back.alpha.is_none());
        let wrong = Photo { width: 3, ..photo };
        assert!(matches!(jpeg_bytes(&wrong, 95, Path::new("a.jpg")), Err(WriteError::Content { .. })));
    }
}
