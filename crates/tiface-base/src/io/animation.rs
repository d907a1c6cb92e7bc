//! Animated PNG and GIF.

use super::write::{WriteError, write_atomic};
use crate::Result;
use rayon::prelude::*;
use std::path::Path;

/// Frames of one size, shown over and over.
#[derive(Clone, Copy, Debug)]
pub struct Animation {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Number of frames.
    pub count: u32,
    /// Frames a second, 1 to 100.
    pub rate: u16,
}

/// Frames one after the other, so that few of them are in memory: `[height · width]` pixels each,
/// sRGB-coded with straight alpha.
pub type Frames<'a> = &'a mut dyn Iterator<Item = Result<Vec<[u8; 4]>>>;

/// Number of frames of a GIF whose palettes are computed in parallel.
const PALETTE_FRAMES: usize = 8;

/// The endings of [`write_animation`].
pub const ANIMATIONS: [&str; 2] = ["png", "gif"];

/// Writes an animated PNG, or a GIF (of 256 colors a frame, without half transparency) if `ending`
/// is `gif`.
///
/// # Errors
///
/// The file cannot be written, the frames cannot be stored so, or a frame is an error, which is
/// handed on. Nothing is written then.
pub fn write_animation(path: &Path, ending: &str, animation: &Animation, frames: Frames) -> Result<()> {
    let mut failed = None;
    // up to the first that fails
    let mut good = frames.map_while(|frame| frame.map_err(|e| failed = Some(e)).ok());
    let content = |problem: String| WriteError::content(path, problem);
    let bytes = match ending {
        "gif" => gif_bytes(animation, &mut good).map_err(|e| content(e.to_string())),
        _ => png_bytes(animation, &mut good).map_err(|e| content(e.to_string())),
    };
    match failed {
        Some(e) => Err(e),
        None => Ok(write_atomic(path, &bytes?)?),
    }
}

type Good<'a> = &'a mut dyn Iterator<Item = Vec<[u8; 4]>>;

fn png_bytes(animation: &Animation, frames: Good) -> Result<Vec<u8>, png::EncodingError> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, animation.width, animation.height);
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    // a third larger than the default in a tenth of the time
    encoder.set_compression(png::Compression::Fast);
    encoder.set_animated(animation.count, 0)?;
    encoder.set_frame_delay(1, animation.rate)?;
    let mut writer = encoder.write_header()?;
    for frame in frames {
        writer.write_image_data(frame.as_flattened())?;
    }
    writer.finish()?;
    Ok(out)
}

fn gif_bytes(animation: &Animation, frames: Good) -> Result<Vec<u8>, gif::EncodingError> {
    let (width, height) = (animation.width as u16, animation.height as u16);
    let frame = |pixels: &Vec<[u8; 4]>| {
        let solid = |&[r, g, b, a]: &[u8; 4]| if a < 128 { [0; 4] } else { [r, g, b, 255] };
        let mut pixels: Vec<u8> = pixels.iter().flat_map(solid).collect();
        // 1 is the best and 30 the fastest choice of colors
        let mut frame = gif::Frame::from_rgba_speed(width, height, &mut pixels, 20);
        frame.delay = 100 / animation.rate.clamp(1, 100);
        frame.dispose = gif::DisposalMethod::Background;
        frame
    };
    let mut out = Vec::new();
    let mut encoder = gif::Encoder::new(&mut out, width, height, &[])?;
    encoder.set_repeat(gif::Repeat::Infinite)?;
    loop {
        let some: Vec<Vec<[u8; 4]>> = frames.take(PALETTE_FRAMES).collect();
        if some.is_empty() {
            break;
        }
        let some: Vec<gif::Frame> = some.par_iter().map(frame).collect();
        some.iter().try_for_each(|frame| encoder.write_frame(frame))?;
    }
    drop(encoder);
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Error;
    use image::AnimationDecoder;
    use image::codecs::png::PngDecoder;
    use std::io::Cursor;

    #[test]
    fn frames_come_back_in_their_order() {
        let frames = [[255, 0, 0, 255], [0, 255, 0, 128], [0, 0, 0, 0]].map(|p| vec![p; 12]);
        let animation = Animation { width: 4, height: 3, count: 3, rate: 10 };
        let bytes = png_bytes(&animation, &mut frames.iter().cloned()).unwrap();
        let decoder = PngDecoder::new(Cursor::new(&bytes)).unwrap().apng().unwrap();
        let found = decoder.into_frames().collect_frames().unwrap();
        assert_eq!(found.len(), 3);
        for (frame, expected) in found.iter().zip(&frames) {
            assert_eq!(frame.buffer().get_pixel(3, 2).0, expected[0]);
            assert_eq!(frame.delay().numer_denom_ms(), (100, 1));
        }
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let bytes = gif_bytes(&animation, &mut frames.iter().cloned()).unwrap();
        let mut decoder = options.read_info(&bytes[..]).unwrap();
        let mut colors = Vec::new();
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            assert_eq!(frame.delay, 10);
            colors.push(frame.buffer[..4].to_vec());
        }
        assert_eq!(colors, [vec![255, 0, 0, 255], vec![0, 255, 0, 255], vec![0, 0, 0, 0]]);
    }

    #[test]
    fn a_frame_that_fails_leaves_no_file() {
        let dir = tempfile::tempdir().unwrap();
        let animation = Animation { width: 2, height: 1, count: 3, rate: 10 };
        for ending in ["png", "gif"] {
            let file = dir.path().join(ending);
            let mut frames = [Ok(vec![[9; 4]; 2]), Err(Error::cannot("stopped", "go on"))].into_iter();
            let error = write_animation(&file, ending, &animation, &mut frames).unwrap_err();
            assert!(error.to_string().contains("stopped") && !file.exists(), "{ending}: {error}");
        }
    }
}
