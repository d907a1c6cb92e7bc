//! Photographs and masks: PNG and JPEG in, PNG out.
//!
//! The content decides the format. Sizes are checked before anything is decoded, and the frame of the
//! file (PNG chunks, JPEG segments) is walked to its end first: decoders forgive a missing tail and
//! fill it with grey, which would then be learned as a face. One damage passes: a baseline JPEG whose scan was
//! cut and closed again with a proper end marker, since only decoding each code could tell.

use super::{Limits, ReadError, WriteError, open, read_bytes, write_atomic};
use crate::image::{Gray, Photo};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngDecoder, PngEncoder};
use image::metadata::Orientation;
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder};
use std::io::{Cursor, Read};
use std::path::Path;
use zune_jpeg::zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions};

/// What became of the turn that the EXIF orientation of a file asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Turn {
    /// The file asks for none.
    None,
    /// Turned by this EXIF code (2..=8), because only then the declared size agrees.
    Applied(u8),
    /// Left as stored though the file asks for this EXIF code: cameras were found for the stored pixels.
    Ignored(u8),
}

/// A photograph and how it was turned.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// 8-bit pixels; 16-bit files are rounded.
    pub photo: Photo,
    /// What happened to its EXIF orientation.
    pub turn: Turn,
}

/// What the header of a picture says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureInfo {
    /// Stored pixels per row.
    pub width: u32,
    /// Stored rows.
    pub height: u32,
    /// Does it have an alpha channel?
    pub alpha: bool,
    /// EXIF orientation, 1 (upright) to 8.
    pub exif: u8,
}

impl PictureInfo {
    /// The size after the turn that `expected` calls for, as [`read_photo`] would return it.
    pub fn size(&self, expected: Option<(u32, u32)>) -> (u32, u32) {
        match turn(self.exif, (self.width, self.height), expected) {
            Turn::Applied(_) => (self.height, self.width),
            _ => (self.width, self.height),
        }
    }
}

/// A quarter turn is applied only when it is what makes the declared size true. Half turns and mirrors
/// fit any size, so nothing can tell whether the cameras were found before or after them; like COLMAP
/// they are left alone.
fn turn(exif: u8, stored: (u32, u32), expected: Option<(u32, u32)>) -> Turn {
    let turned = (stored.1, stored.0);
    match exif {
        5..=8 if expected == Some(turned) && stored != turned => Turn::Applied(exif),
        2..=8 => Turn::Ignored(exif),
        _ => Turn::None,
    }
}

enum Kind {
    Png,
    Jpeg,
}

fn kind(path: &Path, bytes: &[u8]) -> Result<Kind, ReadError> {
    let other = match bytes {
        [0x89, b'P', b'N', b'G', 0x0D, 0x0A, 0x1A, 0x0A, ..] => return Ok(Kind::Png),
        [0xFF, 0xD8, 0xFF, ..] => return Ok(Kind::Jpeg),
        [b'G', b'I', b'F', b'8', ..] => "a GIF picture",
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => "a WebP picture",
        [b'I', b'I', 42, 0, ..] | [b'M', b'M', 0, 42, ..] => "a TIFF or camera raw picture",
        [_, _, _, _, b'f', b't', b'y', b'p', ..] => "a HEIF or AVIF picture or a film",
        [0x76, 0x2F, 0x31, 0x01, ..] => "an OpenEXR picture",
        [b'B', b'M', ..] => "a BMP picture",
        _ => {
            return Err(ReadError::damaged(
                path,
                "PNG or JPEG",
                Some(0),
                "its first bytes are those of neither",
            ));
        }
    };
    Err(ReadError::Unsupported {
        path: path.into(),
        what: other.into(),
        hint: "convert it to PNG or JPEG".into(),
    })
}

/// The size, alpha and orientation of a PNG or JPEG file, from its header only.
pub fn picture_info(path: &Path, limits: &Limits) -> Result<PictureInfo, ReadError> {
    let (file, length) = open(path)?;
    if length == 0 {
        return Err(ReadError::Empty { path: path.into() });
    }
    // a header with EXIF, colour profile and thumbnail stays below this; else the whole file is read
    let mut head = Vec::new();
    file.take(1 << 18).read_to_end(&mut head).map_err(|e| ReadError::io(path, e))?;
    match header(path, &head, limits) {
        Err(_) if (head.len() as u64) < length => header(path, &read_bytes(path, limits)?, limits),
        other => other,
    }
}

fn header(path: &Path, bytes: &[u8], limits: &Limits) -> Result<PictureInfo, ReadError> {
    match kind(path, bytes)? {
        Kind::Png => {
            let mut decoder = png_decoder(path, bytes, limits)?;
            let (width, height) = decoder.dimensions();
            let exif = decoder.orientation().map_or(1, Orientation::to_exif);
            Ok(PictureInfo { width, height, alpha: decoder.color_type().has_alpha(), exif })
        }
        Kind::Jpeg => jpeg_decoder(path, bytes, limits).map(|(_, info)| info),
    }
}

fn check_size(path: &Path, width: u32, height: u32, bytes_px: u64, limits: &Limits) -> Result<(), ReadError> {
    let side = width.max(height);
    let too_large =
        |what, found: u64, limit: u64| ReadError::TooLarge { path: path.into(), what, found, limit };
    if side > limits.side_px {
        return Err(too_large("the picture's longest side in pixels", side as u64, limits.side_px as u64));
    }
    let decoded = (width as u64 * height as u64).saturating_mul(bytes_px);
    if decoded > limits.decoded_bytes {
        return Err(too_large("the decoded picture's size in bytes", decoded, limits.decoded_bytes));
    }
    Ok(())
}

fn png_decoder<'a>(
    path: &Path,
    bytes: &'a [u8],
    limits: &Limits,
) -> Result<PngDecoder<Cursor<&'a [u8]>>, ReadError> {
    let be = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_be_bytes([b[0], b[1], b[2], b[3]]));
    // width and height of IHDR, which must come first: checked before the decoder reserves a row
    if let (Some(width), Some(height)) = (be(16), be(20)) {
        check_size(path, width, height, 8, limits)?;
    }
    let mut allowed = image::Limits::no_limits();
    allowed.max_image_width = Some(limits.side_px);
    allowed.max_image_height = Some(limits.side_px);
    allowed.max_alloc = Some(limits.decoded_bytes);
    PngDecoder::with_limits(Cursor::new(bytes), allowed)
        .map_err(|e| ReadError::damaged(path, "PNG", None, e.to_string()))
}

type Jpeg<'a> = zune_jpeg::JpegDecoder<ZCursor<&'a [u8]>>;

fn jpeg_decoder<'a>(
    path: &Path,
    bytes: &'a [u8],
    limits: &Limits,
) -> Result<(Jpeg<'a>, PictureInfo), ReadError> {
    let bad = |e: zune_jpeg::errors::DecodeErrors| ReadError::damaged(path, "JPEG", None, format!("{e:?}"));
    // strict: a photograph with damaged data is an error, not a picture with grey blocks
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(usize::from(u16::MAX))
        .set_max_height(usize::from(u16::MAX));
    let mut decoder = Jpeg::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(bad)?;
    let (Some((width, height)), Some(space)) = (decoder.dimensions(), decoder.input_colorspace()) else {
        return Err(ReadError::damaged(path, "JPEG", None, "it has no frame header"));
    };
    check_size(path, width as u32, height as u32, 3, limits)?;
    let out = match space {
        ColorSpace::Luma => ColorSpace::Luma,
        ColorSpace::RGB | ColorSpace::YCbCr => ColorSpace::RGB,
        other => {
            return Err(ReadError::Unsupported {
                path: path.into(),
                what: format!("a JPEG in {other:?} colours"),
                hint: "export the photograph in sRGB; print colours (CMYK) have no single meaning here"
                    .into(),
            });
        }
    };
    decoder.set_options(options.jpeg_set_out_colorspace(out));
    let exif =
        decoder.exif().and_then(|chunk| Orientation::from_exif_chunk(chunk)).map_or(1, Orientation::to_exif);
    let info = PictureInfo { width: width as u32, height: height as u32, alpha: false, exif };
    Ok((decoder, info))
}

/// Walks the chunks of a PNG to `IEND` and returns the bytes of picture data.
fn walk_png(path: &Path, bytes: &[u8]) -> Result<u64, ReadError> {
    let bad = |at: usize, problem: &str| ReadError::damaged(path, "PNG", Some(at as u64), problem);
    let (mut at, mut data) = (8, 0u64);
    loop {
        let Some(head) = bytes.get(at..at + 8) else {
            return Err(bad(bytes.len(), "it ends before its last chunk (`IEND`)"));
        };
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]) as usize;
        if bytes.len() - at - 8 < length.saturating_add(4) {
            return Err(bad(at, "a chunk reaches beyond the end of the file"));
        }
        match &head[4..] {
            b"IDAT" => data += length as u64,
            b"IEND" => return Ok(data),
            _ => {}
        }
        at += 12 + length;
    }
}

/// Walks the segments of a JPEG to the end-of-image marker and returns the most pixels its picture data can hold: a
/// block of 64 takes a bit at least, and without progression a second one for its end.
fn walk_jpeg(path: &Path, bytes: &[u8]) -> Result<u64, ReadError> {
    let bad = |at: usize, problem: &str| ReadError::damaged(path, "JPEG", Some(at as u64), problem);
    let mut at = 2;
    let (mut scanned, mut data, mut progressive) = (false, 0, false);
    loop {
        // between segments and inside a scan: forward to the next 0xFF that begins a marker
        let Some(step) = bytes[at.min(bytes.len())..]
            .windows(2)
            .position(|w| w[0] == 0xFF && !matches!(w[1], 0x00 | 0xFF | 0xD0..=0xD7))
        else {
            return Err(bad(bytes.len(), "it ends before the end-of-image marker: cut short"));
        };
        at += step;
        data += if scanned { step as u64 } else { 0 };
        let marker = bytes[at + 1];
        match marker {
            0xD9 if scanned => return Ok(data * if progressive { 8 * 64 } else { 4 * 64 }),
            0xD9 => return Err(bad(at, "it holds no picture data")),
            0x01 | 0xD8 => at += 2,
            _ => {
                let Some(l) = bytes.get(at + 2..at + 4) else {
                    return Err(bad(bytes.len(), "it ends inside a segment: cut short"));
                };
                scanned |= marker == 0xDA;
                progressive |= marker == 0xC2;
                at += 2 + u16::from_be_bytes([l[0], l[1]]) as usize;
            }
        }
    }
}

fn decode(
    path: &Path,
    expected: Option<(u32, u32)>,
    limits: &Limits,
) -> Result<(DynamicImage, Turn), ReadError> {
    decode_bytes(&read_bytes(path, limits)?, path, expected, limits)
}

fn decode_bytes(
    bytes: &[u8],
    path: &Path,
    expected: Option<(u32, u32)>,
    limits: &Limits,
) -> Result<(DynamicImage, Turn), ReadError> {
    let (mut picture, exif) = match kind(path, bytes)? {
        Kind::Png => {
            let data = walk_png(path, bytes)?;
            let mut decoder = png_decoder(path, bytes, limits)?;
            let (width, height) = decoder.dimensions();
            check_size(path, width, height, decoder.color_type().bytes_per_pixel() as u64, limits)?;
            // deflate cannot shrink by more than 1032: a small file that claims more is lying
            let claimed =
                width as u64 * height as u64 * decoder.original_color_type().bits_per_pixel() as u64 / 8;
            if claimed / 1032 > data {
                let problem = format!("{width} × {height} pixels cannot come from its {data} bytes of data");
                return Err(ReadError::damaged(path, "PNG", None, problem));
            }
            let exif = decoder.orientation().map_or(1, Orientation::to_exif);
            let picture = DynamicImage::from_decoder(decoder)
                .map_err(|e| ReadError::damaged(path, "PNG", None, e.to_string()))?;
            (picture, exif)
        }
        Kind::Jpeg => {
            let most = walk_jpeg(path, bytes)?;
            let (mut decoder, info) = jpeg_decoder(path, bytes, limits)?;
            if u64::from(info.width) * u64::from(info.height) > most {
                let (width, height) = (info.width, info.height);
                let problem =
                    format!("{width} × {height} pixels cannot come from its picture data, enough for {most}");
                return Err(ReadError::damaged(path, "JPEG", None, problem));
            }
            let pixels =
                decoder.decode().map_err(|e| ReadError::damaged(path, "JPEG", None, format!("{e:?}")))?;
            let (w, h) = (info.width, info.height);
            let picture = match pixels.len() as u64 / (w as u64 * h as u64).max(1) {
                1 => image::GrayImage::from_raw(w, h, pixels).map(DynamicImage::from),
                _ => image::RgbImage::from_raw(w, h, pixels).map(DynamicImage::from),
            };
            let problem = "the decoder returned another number of pixels than the header names";
            (picture.ok_or_else(|| ReadError::damaged(path, "JPEG", None, problem))?, info.exif)
        }
    };
    let turn = turn(exif, (picture.width(), picture.height()), expected);
    if let (Turn::Applied(code), Some(orientation)) = (turn, Orientation::from_exif(exif)) {
        debug_assert_eq!(code, exif);
        picture.apply_orientation(orientation);
    }
    Ok((picture, turn))
}

/// The channels of a picture in 8 bit, interleaved; 1 grey, 2 grey + alpha, 3 colour, 4 colour + alpha.
fn eight_bit(picture: DynamicImage) -> (usize, Vec<u8>) {
    fn narrow(wide: Vec<u16>) -> Vec<u8> {
        wide.into_iter().map(|v| ((v as u32 * 255 + 32_767) / 65_535) as u8).collect()
    }
    match picture {
        DynamicImage::ImageLuma8(p) => (1, p.into_raw()),
        DynamicImage::ImageLumaA8(p) => (2, p.into_raw()),
        DynamicImage::ImageRgb8(p) => (3, p.into_raw()),
        DynamicImage::ImageRgba8(p) => (4, p.into_raw()),
        DynamicImage::ImageLuma16(p) => (1, narrow(p.into_raw())),
        DynamicImage::ImageLumaA16(p) => (2, narrow(p.into_raw())),
        DynamicImage::ImageRgb16(p) => (3, narrow(p.into_raw())),
        other => (4, narrow(other.into_rgba16().into_raw())),
    }
}

/// Reads a photograph: PNG (grey, palette, colour, 8 or 16 bit, with or without alpha) or JPEG (grey or
/// colour; CMYK is refused). Colour profiles are not applied: bytes are taken as sRGB.
///
/// `expected` is the size its cameras were calibrated for, if declared; see [`Turn`]. Another size is
/// not an error here.
pub fn read_photo(path: &Path, expected: Option<(u32, u32)>, limits: &Limits) -> Result<Picture, ReadError> {
    let (picture, turn) = decode(path, expected, limits)?;
    Ok(Picture { photo: photo(picture), turn })
}

/// A picture that lies inside another file, as [`read_photo`] would read it from one of its own.
/// `path` is for messages only.
pub fn parse_photo(bytes: &[u8], path: &Path, limits: &Limits) -> Result<Photo, ReadError> {
    decode_bytes(bytes, path, None, limits).map(|(picture, _)| photo(picture))
}

/// [`picture_info`] of a picture that lies inside another file. `path` is for messages only.
pub fn parse_picture_info(bytes: &[u8], path: &Path, limits: &Limits) -> Result<PictureInfo, ReadError> {
    header(path, bytes, limits)
}

fn photo(picture: DynamicImage) -> Photo {
    let (width, height) = (picture.width(), picture.height());
    let (channels, bytes) = eight_bit(picture);
    let rgb = match channels {
        1 | 2 => bytes.chunks_exact(channels).map(|p| [p[0]; 3]).collect(),
        _ => bytes.chunks_exact(channels).map(|p| [p[0], p[1], p[2]]).collect(),
    };
    let alpha = (channels % 2 == 0).then(|| bytes.chunks_exact(channels).map(|p| p[channels - 1]).collect());
    Photo { width, height, rgb, alpha }
}

/// Reads a mask: the grey channel; of a picture with alpha that is not opaque everywhere, the alpha;
/// of a coloured one the luma (Rec. 601).
pub fn read_gray(path: &Path, expected: Option<(u32, u32)>, limits: &Limits) -> Result<Gray, ReadError> {
    let (picture, _) = decode(path, expected, limits)?;
    let (width, height) = (picture.width(), picture.height());
    let (channels, bytes) = eight_bit(picture);
    let pixels = bytes.chunks_exact(channels);
    let translucent = channels % 2 == 0 && pixels.clone().any(|p| p[channels - 1] != 255);
    let values = if translucent {
        pixels.map(|p| p[channels - 1]).collect()
    } else if channels <= 2 {
        pixels.map(|p| p[0]).collect()
    } else {
        let luma = |p: &[u8]| (299 * p[0] as u32 + 587 * p[1] as u32 + 114 * p[2] as u32 + 500) / 1000;
        pixels.map(|p| luma(p) as u8).collect()
    };
    Ok(Gray { width, height, values })
}

fn write_png(
    path: &Path,
    width: u32,
    height: u32,
    bytes: &[u8],
    color: ExtendedColorType,
) -> Result<(), WriteError> {
    let content = |problem: String| WriteError::Content { path: path.into(), problem };
    let needed = width as u64 * height as u64 * color.bits_per_pixel() as u64 / 8;
    if needed != bytes.len() as u64 || needed == 0 {
        let problem = format!("{width} × {height} pixels need {needed} bytes, {} were given", bytes.len());
        return Err(content(problem));
    }
    let mut out = Vec::new();
    PngEncoder::new_with_quality(&mut out, CompressionType::Default, FilterType::Adaptive)
        .write_image(bytes, width, height, color)
        .map_err(|e| content(e.to_string()))?;
    write_atomic(path, &out)
}

/// Writes an 8-bit RGB PNG, sRGB-coded.
pub fn write_png_rgb(path: &Path, width: u32, height: u32, rgb: &[[u8; 3]]) -> Result<(), WriteError> {
    write_png(path, width, height, rgb.as_flattened(), ExtendedColorType::Rgb8)
}

/// Writes an 8-bit RGBA PNG, sRGB-coded with straight alpha.
pub fn write_png_rgba(path: &Path, width: u32, height: u32, rgba: &[[u8; 4]]) -> Result<(), WriteError> {
    write_png(path, width, height, rgba.as_flattened(), ExtendedColorType::Rgba8)
}

/// Writes an 8-bit grey PNG.
pub fn write_png_gray(path: &Path, gray: &Gray) -> Result<(), WriteError> {
    write_png(path, gray.width, gray.height, &gray.values, ExtendedColorType::L8)
}

/// Writes a 16-bit grey PNG (depth in millimetres).
pub fn write_png_gray16(path: &Path, width: u32, height: u32, values: &[u16]) -> Result<(), WriteError> {
    // the encoder takes native byte order and swaps itself
    write_png(path, width, height, bytemuck::cast_slice(values), ExtendedColorType::L16)
}

/// A photograph as the bytes of a JPEG file of `quality` 1 to 100, without its alpha. `path` is for messages only.
pub fn jpeg_bytes(photo: &Photo, quality: u8, path: &Path) -> Result<Vec<u8>, WriteError> {
    let content = |problem: String| WriteError::Content { path: path.into(), problem };
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
        let p = read_photo(&path, None, &limits).unwrap().photo;
        assert_eq!((p.width, p.height, p.alpha), (2, 1, None));
        assert_eq!(p.rgb, [[1, 2, 3], [250, 251, 252]]);
        write_png_rgba(&path, 1, 2, &[[1, 2, 3, 4], [5, 6, 7, 8]]).unwrap();
        assert_eq!(read_photo(&path, None, &limits).unwrap().photo.alpha, Some(vec![4, 8]));
        assert_eq!(read_gray(&path, None, &limits).unwrap().values, [4, 8]); // alpha says what is the head
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
    fn sixteen_bits_are_rounded_to_eight() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        // 257 · 7 = 1799 is exactly 7; 1799 + 128 = 1927 is 7.498 → 7; 1928 is 7.502 → 8
        write_png_gray16(&path, 4, 1, &[1799, 1927, 1928, 65_535]).unwrap();
        let gray = read_gray(&path, None, &Limits::default()).unwrap();
        assert_eq!(gray.values, [7, 7, 8, 255]);
    }

    #[test]
    fn a_mask_with_an_opaque_alpha_channel_is_read_from_its_colour() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        write_png_rgba(&path, 2, 1, &[[255, 255, 255, 255], [0, 0, 0, 255]]).unwrap();
        assert_eq!(read_gray(&path, None, &Limits::default()).unwrap().values, [255, 0]);
    }

    #[test]
    fn a_quarter_turn_is_applied_only_when_the_declared_size_agrees() {
        assert_eq!(turn(6, (40, 30), Some((30, 40))), Turn::Applied(6));
        assert_eq!(turn(6, (40, 30), Some((40, 30))), Turn::Ignored(6));
        assert_eq!(turn(6, (40, 30), None), Turn::Ignored(6));
        assert_eq!(turn(6, (40, 40), Some((40, 40))), Turn::Ignored(6));
        assert_eq!(turn(3, (40, 30), Some((40, 30))), Turn::Ignored(3));
        assert_eq!(turn(1, (40, 30), Some((40, 30))), Turn::None);
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
