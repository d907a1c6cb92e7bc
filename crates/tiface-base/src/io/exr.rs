//! OpenEXR: float channels by name, in and out: colors, depth, normals.
//!
//! The data window is placed inside the display window: pixels outside are dropped, uncovered ones
//! are 0. The first layer with all requested channels is used.

use super::limits::Limits;
use super::read::read_bytes;
use super::read_error::ReadError;
use super::write::{WriteError, write_atomic};
use crate::image::Image;
use ::exr::meta::MetaData;
use ::exr::prelude as ex;
use ::exr::prelude::{ReadChannels, ReadLayers, WritableImage};
use std::io::Cursor;
use std::path::Path;

/// Channels of an OpenEXR file.
#[derive(Clone, Debug, PartialEq)]
pub struct ExrImage {
    /// The channels in the requested order, at the size of the display window.
    pub image: Image,
    /// Number of values that were NaN or infinite and became 0.
    pub replaced: usize,
}

/// Returns the first of several sets of channel names that some layer holds completely.
pub fn read_exr(path: &Path, sets: &[&[&str]], limits: &Limits) -> Result<ExrImage, ReadError> {
    let bytes = read_bytes(path, limits)?;
    let display = checked_window(path, &bytes, limits)?;
    let read = ex::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .from_buffered(Cursor::new(&bytes))
        .map_err(|e| damaged(path, e))?;
    for names in sets {
        for layer in &read.layer_data {
            let list = &layer.channel_data.list;
            let found = names.iter().map(|name| list.iter().find(|c| c.name == **name));
            if let Some(channels) = found.collect::<Option<Vec<_>>>() {
                let corner = layer.attributes.layer_position - display.position;
                return Ok(placed(&channels, layer.size.0, corner, display.size));
            }
        }
    }
    let present: Vec<String> =
        read.layer_data.iter().flat_map(|l| l.channel_data.list.iter().map(|c| c.name.to_string())).collect();
    let wanted: Vec<String> = sets.iter().map(|s| format!("`{}`", s.join(" "))).collect();
    let what = format!("an OpenEXR picture with the channels `{}`", present.join(" "));
    Err(ReadError::unsupported(path, what, format!("it must hold {}", wanted.join(" or "))))
}

fn damaged(path: &Path, problem: impl ToString) -> ReadError {
    ReadError::damaged(path, "OpenEXR", None, problem.to_string())
}

/// Returns the display window of a file whose header promises nothing that is over the limits or
/// not read.
fn checked_window(path: &Path, bytes: &[u8], limits: &Limits) -> Result<ex::IntegerBounds, ReadError> {
    if !bytes.starts_with(&[0x76, 0x2F, 0x31, 0x01]) {
        return Err(ReadError::damaged(path, "OpenEXR", Some(0), "its first bytes are not those of OpenEXR"));
    }
    let deep = || {
        let hint = "flatten it: one value per pixel and channel";
        ReadError::unsupported(path, "a deep OpenEXR picture", hint)
    };
    if bytes.get(5).is_some_and(|flags| flags & 0x08 != 0) {
        return Err(deep()); // bit 11 of the version field: non-image parts
    }
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(|e| damaged(path, e))?;
    if meta.headers.iter().any(|h| h.deep) {
        return Err(deep());
    }
    let display = meta.headers.first().map(|h| h.shared_attributes.display_window);
    let (width, height) = display.map_or((0, 0), |d| (d.size.0, d.size.1));
    let mut decoded = (width as u64).saturating_mul(height as u64).saturating_mul(12);
    for h in &meta.headers {
        let side = h.layer_size.0.max(h.layer_size.1).max(width).max(height) as u64;
        limits.check_side(path, side)?;
        let pixels = h.layer_size.0 as u64 * h.layer_size.1 as u64;
        decoded = decoded.saturating_add(pixels.saturating_mul(h.channels.bytes_per_pixel as u64));
        if h.channels.list.iter().any(|c| c.sampling != ex::Vec2(1, 1)) {
            let what = "an OpenEXR picture with subsampled channels";
            return Err(ReadError::unsupported(path, what, "store every channel at full size"));
        }
    }
    limits.check_decoded(path, decoded)?;
    display.filter(|_| width > 0 && height > 0).ok_or_else(|| damaged(path, "its display window is empty"))
}

/// Channels of a layer whose rows have `row` values and whose first one lies at `corner`, cut to a
/// picture of `size`.
fn placed(
    channels: &[&ex::AnyChannel<ex::FlatSamples>],
    row: usize,
    corner: ex::Vec2<i32>,
    size: ex::Vec2<usize>,
) -> ExrImage {
    let mut image = Image::new(size.0 as u32, size.1 as u32, channels.len());
    let mut replaced = 0;
    for (k, channel) in channels.iter().enumerate() {
        for (i, value) in channel.sample_data.values_as_f32().enumerate() {
            let (x, y) = (corner.0 as i64 + (i % row) as i64, corner.1 as i64 + (i / row) as i64);
            if (0..size.0 as i64).contains(&x) && (0..size.1 as i64).contains(&y) {
                replaced += !value.is_finite() as usize;
                image.pixel_mut(x as u32, y as u32)[k] = if value.is_finite() { value } else { 0.0 };
            }
        }
    }
    ExrImage { image, replaced }
}

/// Writes float32 channels, ZIP compressed (16 rows a block); each slice is row-major, top row
/// first.
pub fn write_exr(
    path: &Path,
    width: u32,
    height: u32,
    channels: &[(&str, &[f32])],
) -> Result<(), WriteError> {
    write_compressed(path, [width, height], channels, ex::Compression::ZIP16)
}

/// As [`write_exr`], but run-length encoded: written sooner; files of views of heads are a fifth
/// larger.
pub fn write_exr_rle(
    path: &Path,
    width: u32,
    height: u32,
    channels: &[(&str, &[f32])],
) -> Result<(), WriteError> {
    write_compressed(path, [width, height], channels, ex::Compression::RLE)
}

fn write_compressed(
    path: &Path,
    [width, height]: [u32; 2],
    channels: &[(&str, &[f32])],
    compression: ex::Compression,
) -> Result<(), WriteError> {
    let content = |problem: String| WriteError::content(path, problem);
    let pixels = width as usize * height as usize;
    if pixels == 0 || channels.is_empty() {
        return Err(content("it would have no pixels".into()));
    }
    if let Some((name, values)) = channels.iter().find(|(_, values)| values.len() != pixels) {
        let problem = format!("channel `{name}` has {} values, the picture {pixels}", values.len());
        return Err(content(problem));
    }
    let list = channels
        .iter()
        .map(|(name, values)| ex::AnyChannel::new(*name, ex::FlatSamples::F32(values.to_vec())))
        .collect();
    let layer = ex::Layer::new(
        (width as usize, height as usize),
        ex::LayerAttributes::default(),
        ex::Encoding {
            compression,
            blocks: ex::Blocks::ScanLines,
            line_order: ex::LineOrder::Increasing, // one order of blocks: the same bytes every time
        },
        ex::AnyChannels::sort(list),
    );
    let mut out = Cursor::new(Vec::new());
    ex::Image::from_layer(layer).write().to_buffered(&mut out).map_err(|e| content(e.to_string()))?;
    write_atomic(path, &out.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_are_written_and_read_back_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("n.exr");
        let (x, y, z) = ([1.0, 2.0], [3.0, 4.0], [5.0, f32::NAN]);
        write_exr(&path, 2, 1, &[("N.Z", &z), ("N.X", &x), ("N.Y", &y)]).unwrap();
        let read = read_exr(&path, &[&["N.X", "N.Y", "N.Z"]], &Limits::default()).unwrap();
        // NaN became 0, and was counted
        assert_eq!(read.image.data, [1.0, 3.0, 5.0, 2.0, 4.0, 0.0]);
        assert_eq!(read.replaced, 1);
        let error = read_exr(&path, &[&["Z"]], &Limits::default()).unwrap_err();
        assert!(error.to_string().contains("N.X") && error.hint().contains("`Z`"), "{error}");
    }

    #[test]
    fn the_same_picture_gives_the_same_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let (a, b) = (dir.path().join("a.exr"), dir.path().join("b.exr"));
        let values: Vec<f32> = (0..64 * 200).map(|i| (i % 97) as f32).collect();
        write_exr(&a, 64, 200, &[("Z", &values)]).unwrap();
        write_exr(&b, 64, 200, &[("Z", &values)]).unwrap();
        assert_eq!(std::fs::read(a).unwrap(), std::fs::read(b).unwrap());
    }

    #[test]
    fn either_compression_gives_the_same_values() {
        let dir = tempfile::tempdir().unwrap();
        let (zip, rle) = (dir.path().join("zip.exr"), dir.path().join("rle.exr"));
        let values: Vec<f32> = (0..64 * 200).map(|i| (i / 97) as f32).collect();
        write_exr(&zip, 64, 200, &[("Z", &values)]).unwrap();
        write_exr_rle(&rle, 64, 200, &[("Z", &values)]).unwrap();
        assert_ne!(std::fs::read(&zip).unwrap(), std::fs::read(&rle).unwrap());
        let read = |path| read_exr(path, &[&["Z"]], &Limits::default()).unwrap();
        assert_eq!(read(&zip).image.data, values);
        assert_eq!(read(&zip), read(&rle));
    }
}
