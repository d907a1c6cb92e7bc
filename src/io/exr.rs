//! OpenEXR: depth and normals in and out, scene-linear renders out.
//!
//! The data window is placed inside the display window; what lies outside it is dropped and what it
//! leaves open is 0. Only the first layer that holds all channels asked for is used.

use super::{Limits, ReadError, WriteError, read_bytes, write_atomic};
use crate::image::Image;
use ::exr::meta::MetaData;
use ::exr::prelude as ex;
use ::exr::prelude::{ReadChannels, ReadLayers, WritableImage};
use std::io::Cursor;
use std::path::Path;

/// Channels of an OpenEXR file.
#[derive(Clone, Debug, PartialEq)]
pub struct ExrImage {
    /// The channels in the order asked for, at the size of the display window.
    pub image: Image,
    /// How many values were NaN or infinite and became 0.
    pub replaced: usize,
}

/// Depth along the viewing axis: the channel `Z`, in the file's units, 0 = nothing there.
pub fn read_exr_depth(path: &Path, limits: &Limits) -> Result<ExrImage, ReadError> {
    read_exr_channels(path, &[&["Z"], &["depth.Z"], &["Y"]], limits)
}

/// Unit normals: `N.X N.Y N.Z`, `X Y Z` or `R G B`; all 0 = nothing there.
pub fn read_exr_normals(path: &Path, limits: &Limits) -> Result<ExrImage, ReadError> {
    let names: [&[&str]; 4] =
        [&["N.X", "N.Y", "N.Z"], &["normal.X", "normal.Y", "normal.Z"], &["X", "Y", "Z"], &["R", "G", "B"]];
    read_exr_channels(path, &names, limits)
}

/// The first of several sets of channel names that some layer holds completely.
pub fn read_exr_channels(path: &Path, sets: &[&[&str]], limits: &Limits) -> Result<ExrImage, ReadError> {
    let bytes = read_bytes(path, limits)?;
    let bad = |problem: String| ReadError::damaged(path, "OpenEXR", None, problem);
    if !bytes.starts_with(&[0x76, 0x2F, 0x31, 0x01]) {
        return Err(ReadError::damaged(path, "OpenEXR", Some(0), "its first bytes are not those of OpenEXR"));
    }
    let deep = || ReadError::Unsupported {
        path: path.into(),
        what: "a deep OpenEXR picture".into(),
        hint: "flatten it: one value per pixel and channel".into(),
    };
    if bytes.get(5).is_some_and(|flags| flags & 0x08 != 0) {
        return Err(deep()); // bit 11 of the version field: non-image parts
    }
    let meta = MetaData::read_from_buffered(Cursor::new(&bytes), false).map_err(|e| bad(e.to_string()))?;
    if meta.headers.iter().any(|h| h.deep) {
        return Err(deep());
    }
    let display = meta.headers.first().map(|h| h.shared_attributes.display_window);
    let (width, height) = display.map_or((0, 0), |d| (d.size.0, d.size.1));
    let too_large =
        |what, found: u64, limit: u64| ReadError::TooLarge { path: path.into(), what, found, limit };
    let mut decoded = (width as u64).saturating_mul(height as u64).saturating_mul(12);
    for h in &meta.headers {
        let side = h.layer_size.0.max(h.layer_size.1).max(width).max(height) as u64;
        if side > limits.side_px as u64 {
            return Err(too_large("the picture's longest side in pixels", side, limits.side_px as u64));
        }
        let pixels = h.layer_size.0 as u64 * h.layer_size.1 as u64;
        decoded = decoded.saturating_add(pixels.saturating_mul(h.channels.bytes_per_pixel as u64));
        if h.channels.list.iter().any(|c| c.sampling != ex::Vec2(1, 1)) {
            return Err(ReadError::Unsupported {
                path: path.into(),
                what: "an OpenEXR picture with subsampled channels".into(),
                hint: "store every channel at full size".into(),
            });
        }
    }
    if decoded > limits.decoded_bytes {
        return Err(too_large("the decoded picture's size in bytes", decoded, limits.decoded_bytes));
    }
    let Some(display) = display.filter(|_| width > 0 && height > 0) else {
        return Err(bad("its display window is empty".into()));
    };

    let read = ex::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .from_buffered(Cursor::new(&bytes))
        .map_err(|e| bad(e.to_string()))?;
    for names in sets {
        for layer in &read.layer_data {
            let list = &layer.channel_data.list;
            let found: Option<Vec<_>> =
                names.iter().map(|name| list.iter().find(|c| c.name == **name)).collect();
            if let Some(channels) = found {
                let left = layer.attributes.layer_position.0 as i64 - display.position.0 as i64;
                let top = layer.attributes.layer_position.1 as i64 - display.position.1 as i64;
                let mut image = Image::new(width as u32, height as u32, names.len());
                let mut replaced = 0;
                for (k, channel) in channels.iter().enumerate() {
                    for (i, value) in channel.sample_data.values_as_f32().enumerate() {
                        let x = left + (i % layer.size.0) as i64;
                        let y = top + (i / layer.size.0) as i64;
                        if x < 0 || y < 0 || x >= width as i64 || y >= height as i64 {
                            continue;
                        }
                        let value = if value.is_finite() {
                            value
                        } else {
                            replaced += 1;
                            0.0
                        };
                        image.pixel_mut(x as u32, y as u32)[k] = value;
                    }
                }
                return Ok(ExrImage { image, replaced });
            }
        }
    }
    let there: Vec<String> =
        read.layer_data.iter().flat_map(|l| l.channel_data.list.iter().map(|c| c.name.to_string())).collect();
    let wanted: Vec<String> = sets.iter().map(|s| format!("`{}`", s.join(" "))).collect();
    Err(ReadError::Unsupported {
        path: path.into(),
        what: format!("an OpenEXR picture with the channels `{}`", there.join(" ")),
        hint: format!("it must hold {}", wanted.join(" or ")),
    })
}

/// Writes float32 channels, ZIP compressed (16 rows a block); each slice is row-major, top row first.
pub fn write_exr(
    path: &Path,
    width: u32,
    height: u32,
    channels: &[(&str, &[f32])],
) -> Result<(), WriteError> {
    let content = |problem: String| WriteError::Content { path: path.into(), problem };
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
            compression: ex::Compression::ZIP16,
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
        let read = read_exr_normals(&path, &Limits::default()).unwrap();
        assert_eq!(read.image.data, [1.0, 3.0, 5.0, 2.0, 4.0, 0.0]); // NaN became 0, and was counted
        assert_eq!(read.replaced, 1);
        let error = read_exr_depth(&path, &Limits::default()).unwrap_err();
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
}
