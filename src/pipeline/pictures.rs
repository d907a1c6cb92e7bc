//! Writing and reading rendered views.

use crate::config::{PictureFormat, ViewBackground};
use std::path::{Path, PathBuf};
use tiface_base::Result;
use tiface_base::image::{Gray, INSIDE, Image, Photo, linear_from_srgb, quantize, srgb_from_linear};
use tiface_base::io::{self, Limits, ReadError, WriteError};
use tiface_capture::LoadedView;
use tiface_surface::render::RenderedView;

/// Returns the color behind the head, sRGB-coded; `None` leaves alpha.
pub(super) fn background_color(background: ViewBackground) -> Option<[f32; 3]> {
    match background {
        ViewBackground::Black => Some([0.0; 3]),
        ViewBackground::White => Some([1.0; 3]),
        ViewBackground::None => None,
    }
}

/// Folder of the float views that `ensemble` reads, below a method's folder.
pub(super) const FLOAT: &str = "float";

/// Folder of the held-out views as seen from their own fitted poses, below a method's folder.
pub(super) const OWN_POSE: &str = "own_pose";

/// Returns the file of a view: `folder/NAME.png` or `.exr`.
pub(super) fn path(folder: &Path, name: &str, format: PictureFormat) -> PathBuf {
    let ending = match format {
        PictureFormat::Png => "png",
        PictureFormat::Exr => "exr",
    };
    folder.join(format!("{name}.{ending}"))
}

/// Returns all files of a view: the pictures as shown, and the float one below `float`.
pub(super) fn files(folder: &Path, name: &str, float: Option<&Path>, format: PictureFormat) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = float.map(|f| float_path(f, name)).into_iter().collect();
    files.push(path(folder, name, format));
    files.extend((format == PictureFormat::Png).then(|| path(&folder.join("depth"), name, format)));
    files
}

/// Puts coded color over a background: the result is opaque.
pub(super) fn over(view: &mut RenderedView, background: [f32; 3]) {
    for p in view.color.data.as_chunks_mut::<4>().0 {
        let open = 1.0 - p[3];
        *p = [p[0] + open * background[0], p[1] + open * background[1], p[2] + open * background[2], 1.0];
    }
}

/// Writes a view. PNG: 8-bit sRGB with straight alpha, and depth beside it in `depth/`, 16-bit
/// millimeters, 0 = nothing. EXR: scene-linear, premultiplied, with `Z` and `N.X N.Y N.Z`. Depth
/// and normals only where the view has them.
pub(super) fn write(
    folder: &Path,
    name: &str,
    view: &RenderedView,
    format: PictureFormat,
    unit_m: f64,
) -> Result<(), WriteError> {
    let file = path(folder, name, format);
    io::create_folder(file.parent().unwrap_or(folder))?;
    let (w, h) = (view.color.width, view.color.height);
    let pixels = view.color.data.as_chunks::<4>().0;
    match format {
        PictureFormat::Png => {
            let rgba: Vec<[u8; 4]> = pixels.iter().map(|&p| straight(p).map(quantize)).collect();
            io::write_png_rgba(&file, w, h, &rgba)?;
            if view.depth.data.is_empty() {
                return Ok(());
            }
            let depth = path(&folder.join("depth"), name, format);
            io::create_folder(depth.parent().unwrap_or(folder))?;
            let mm = |z: &f32| (*z as f64 * unit_m * 1000.0).round().clamp(0.0, 65_535.0) as u16;
            let mm: Vec<u16> = view.depth.data.iter().map(mm).collect();
            io::write_png_gray16(&depth, w, h, &mm)
        }
        PictureFormat::Exr => {
            let mut linear = view.color.clone();
            for p in linear.data.as_chunks_mut::<4>().0 {
                let [r, g, b, a] = straight(*p);
                *p = [linear_from_srgb(r) * a, linear_from_srgb(g) * a, linear_from_srgb(b) * a, a];
            }
            let [r, g, b, a] = [0, 1, 2, 3].map(|k| linear.channel(k));
            let [x, y, z] = [0, 1, 2].map(|k| view.normal.channel(k));
            let mut channels: Vec<(&str, &[f32])> = vec![("R", &r), ("G", &g), ("B", &b), ("A", &a)];
            if !view.depth.data.is_empty() {
                channels.push(("Z", &view.depth.data));
            }
            if !view.normal.data.is_empty() {
                channels.extend([("N.X", &x[..]), ("N.Y", &y[..]), ("N.Z", &z[..])]);
            }
            io::write_exr(&file, w, h, &channels)
        }
    }
}

/// The channels of a float view. Not R, G and B: those are scene-linear in an EXR, these are coded.
const CODED: [&str; 5] = ["coded.R", "coded.G", "coded.B", "A", "Z"];

/// Returns the float file of a view: `folder/NAME.exr`.
pub(super) fn float_path(folder: &Path, name: &str) -> PathBuf {
    path(folder, name, PictureFormat::Exr)
}

/// Writes a view unchanged: 32-bit coded color over black, opacity, and depth in world units.
pub(super) fn write_float(folder: &Path, name: &str, view: &RenderedView) -> Result<(), WriteError> {
    let file = float_path(folder, name);
    io::create_folder(file.parent().unwrap_or(folder))?;
    let color = [0, 1, 2, 3].map(|k| view.color.channel(k));
    let all = CODED.iter().copied().zip(color.iter().chain([&view.depth.data]).map(Vec::as_slice));
    let channels: Vec<(&str, &[f32])> = all.filter(|(_, values)| !values.is_empty()).collect();
    io::write_exr_rle(&file, view.color.width, view.color.height, &channels)
}

/// Reads the color (RGBA over black) that [`write_float`] wrote, bit by bit.
pub(super) fn read_float(file: &Path) -> Result<Image, ReadError> {
    let read = io::read_exr(file, &[&CODED[..4]], &Limits::default())?;
    if read.replaced > 0 {
        let hint =
            "its field has diverged: train it again with another --seed, or leave it out of ensemble.members";
        let what = format!("a view with {} values that are not finite", read.replaced);
        return Err(ReadError::unsupported(file, what, hint));
    }
    Ok(read.image)
}

/// Divides coded color by alpha.
pub(super) fn straight([r, g, b, a]: [f32; 4]) -> [f32; 4] {
    let k = if a > 0.0 { 1.0 / a } else { 0.0 };
    [r * k, g * k, b * k, a]
}

/// Reads a view as RGBA, coded color premultiplied over black: scene-linear if its name ends in
/// `.exr`, else coded.
pub(super) fn read(file: &Path) -> Result<Image, ReadError> {
    let limits = Limits::default();
    if file.extension().is_some_and(|ending| ending == "exr") {
        let mut image = io::read_exr(file, &[&["R", "G", "B", "A"]], &limits)?.image;
        for p in image.data.as_chunks_mut::<4>().0 {
            let [r, g, b, a] = straight(*p);
            let coded = [r, g, b].map(|v| srgb_from_linear(v) * a);
            *p = [coded[0], coded[1], coded[2], a];
        }
        return Ok(image);
    }
    let photo = io::read_photo(file, None, &limits)?;
    let mut image = Image::new(photo.width, photo.height, 4);
    for (i, p) in image.data.as_chunks_mut::<4>().0.iter_mut().enumerate() {
        let a = photo.alpha.as_ref().map_or(1.0, |a| a[i] as f32 / 255.0);
        let [r, g, b] = photo.rgb[i].map(|v| v as f32 / 255.0 * a);
        *p = [r, g, b, a];
    }
    Ok(image)
}

/// [`read`] of a picture that must have the size of its photograph.
pub(super) fn read_like(file: &Path, photo: &Photo) -> Result<Image, ReadError> {
    let found = read(file)?;
    if (found.width, found.height) != (photo.width, photo.height) {
        let size = format!("{} × {} pixels", found.width, found.height);
        let expected = format!("that of its photograph, {} × {}", photo.width, photo.height);
        return Err(ReadError::value(file, "size", size, &expected));
    }
    Ok(found)
}

/// Returns the photograph as the render should look: cut out by its mask and composited over the
/// same background. Without a mask it is returned unchanged.
pub(super) fn expected(photo: &Photo, mask: Option<&Gray>, background: ViewBackground) -> Photo {
    let Some(mask) = mask else { return photo.clone() };
    let behind = background_color(background).unwrap_or([0.0; 3]);
    let mix = |c: u8, b: f32, m: u8| {
        let a = m as f32 / 255.0;
        quantize(a * c as f32 / 255.0 + (1.0 - a) * b)
    };
    let rgb = photo
        .rgb
        .iter()
        .zip(&mask.values)
        .map(|(p, &m)| [mix(p[0], behind[0], m), mix(p[1], behind[1], m), mix(p[2], behind[2], m)])
        .collect();
    Photo { rgb, alpha: None, ..photo.clone() }
}

/// Returns the photograph that a render over black is compared with, and a weight that is 0 where
/// it does not count: outside the head or not valid.
pub(super) fn target(loaded: &LoadedView) -> (Photo, Gray) {
    let photo = expected(&loaded.photo, loaded.mask.as_ref(), ViewBackground::None);
    let (width, height) = (photo.width, photo.height);
    let inside = |of: &Option<Gray>, i: usize| of.as_ref().is_none_or(|m| m.values[i] >= INSIDE);
    let counts = |i: usize| if inside(&loaded.mask, i) && inside(&loaded.valid, i) { 255 } else { 0 };
    let values = (0..photo.rgb.len()).map(counts).collect();
    (photo, Gray { width, height, values })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_comes_back_from_png_and_exr_to_within_a_byte() {
        let dir = tempfile::tempdir().unwrap();
        let mut view = RenderedView {
            color: Image::new(2, 1, 4),
            depth: Image::new(2, 1, 1),
            normal: Image::new(2, 1, 3),
        };
        // half covered, straight color (0.8, 0.4, 0.2); the other pixel empty
        view.color.pixel_mut(0, 0).copy_from_slice(&[0.4, 0.2, 0.1, 0.5]);
        view.depth.pixel_mut(0, 0)[0] = 1.234;
        for format in [PictureFormat::Png, PictureFormat::Exr] {
            write(dir.path(), "left/a", &view, format, 1.0).unwrap();
            let back = read(&path(dir.path(), "left/a", format)).unwrap();
            for (a, b) in back.data.iter().zip(&view.color.data) {
                assert!((a - b).abs() < 1.0 / 255.0, "{:?}", back.data);
            }
        }
        // EXR: linear and premultiplied, 0.5 · linear(0.8) = 0.5 · 0.6038
        let file = path(dir.path(), "left/a", PictureFormat::Exr);
        let red = io::read_exr(&file, &[&["R", "Z"]], &Limits::default()).unwrap().image;
        assert!((red.data[0] - 0.3019).abs() < 1e-3 && (red.data[1] - 1.234).abs() < 1e-6);
        assert!(dir.path().join("depth/left/a.png").is_file());
    }

    #[test]
    fn a_float_view_comes_back_bit_by_bit() {
        let dir = tempfile::tempdir().unwrap();
        let mut view = RenderedView {
            color: Image::new(2, 1, 4),
            depth: Image::new(2, 1, 1),
            normal: Image::new(0, 0, 3),
        };
        view.color.data.copy_from_slice(&[0.1, 1e-7, 0.333_333_34, 0.9, 0.0, 1.0, 0.2, 1.0]);
        view.depth.data[1] = 2.5;
        write_float(dir.path(), "left/a", &view).unwrap();
        let file = float_path(dir.path(), "left/a");
        assert_eq!(read_float(&file).unwrap(), view.color);
        let depth = io::read_exr(&file, &[&["Z"]], &Limits::default()).unwrap().image;
        assert_eq!(depth, view.depth);
        // and views without depth or normals are pictures, too
        view.depth = Image::new(0, 0, 1);
        for format in [PictureFormat::Png, PictureFormat::Exr] {
            write(dir.path(), "b", &view, format, 1.0).unwrap();
            assert!(read(&path(dir.path(), "b", format)).is_ok());
        }
        assert!(!dir.path().join("depth/b.png").exists());
    }

    #[test]
    fn a_photograph_is_laid_over_the_background_by_its_mask() {
        let photo = Photo { width: 2, height: 1, rgb: vec![[200; 3], [200; 3]], alpha: None };
        let mask = Gray { width: 2, height: 1, values: vec![255, 51] };
        // 51/255 = 0.2: 0.2 · 200 = 40 over black, 40 + 0.8 · 255 = 244 over white
        assert_eq!(expected(&photo, Some(&mask), ViewBackground::None).rgb, [[200; 3], [40; 3]]);
        assert_eq!(expected(&photo, Some(&mask), ViewBackground::White).rgb, [[200; 3], [244; 3]]);
    }
}
