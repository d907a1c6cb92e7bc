//! Small copies of photographs and of their renders, and the error between them.

use crate::config::{ViewBackground, display_name};
use crate::pipeline::metrics::{Comparable, PictureSet, comparable, picture_sets};
use crate::pipeline::pictures;
use crate::pipeline::session::Session;
use crate::report::{HEAT, MAX_ERROR, ViewPicture, ViewRow, picture_url, relative};
use glam::DVec2;
use rayon::prelude::*;
use serde_json::Value;
use std::path::Path;
use tiface_base::Result;
use tiface_base::geom::Camera;
use tiface_base::image::{Photo, quantize, reduce_photo, working_size};
use tiface_base::io::{self, Limits};
use tiface_capture::{Split, View};

/// Longest side of a picture on the page: of few views, and of many.
const SIDE_PX: (u32, u32) = (480, 320);
/// Maximum number of views that count as few.
const FEW_VIEWS: usize = 10;
/// JPEG quality: about 25 kB per picture.
const QUALITY: u8 = 84;

/// Pictures of one kind of the views of a capture.
pub(in crate::pipeline) struct ShownSet<'c> {
    /// Its name in the page, unlike the others'.
    pub key: String,
    /// Display name.
    pub title: String,
    /// The pictures.
    pub pictures: Vec<Comparable<'c>>,
    /// Its figures, as in `metrics.json`; null if there are none.
    pub figures: Value,
}

/// Returns the sets of pictures of a run, in pipeline order.
pub(in crate::pipeline) fn shown_sets<'c>(session: &'c Session) -> Vec<ShownSet<'c>> {
    let Session { capture, config, run, .. } = session;
    let figures =
        io::read_json(&session.run.path("metrics/metrics.json"), &Limits::default()).unwrap_or_default();
    let shown = |set: PictureSet| ShownSet {
        title: display_name(&set.name),
        pictures: comparable(capture, config, &set),
        figures: figures[&set.name].clone(),
        key: set.name,
    };
    picture_sets(config, run).into_iter().map(shown).collect()
}

/// Runs [`rows`] for the page in a run's folder.
pub(super) fn rows_of_run(session: &Session, most: usize) -> Result<(Vec<ViewRow>, Vec<String>)> {
    let background = session.config.render.background;
    rows(&session.read_capture()?.views, background, &shown_sets(session), session.run.dir(), most)
}

/// Returns the views that have pictures, or else the held-out ones, in about `most` bytes; and the
/// files of the omitted ones. Files are relative to `folder`, that of the page.
pub(in crate::pipeline) fn rows(
    views: &[View],
    background: ViewBackground,
    sets: &[ShownSet],
    folder: &Path,
    most: usize,
) -> Result<(Vec<ViewRow>, Vec<String>)> {
    let pictures = |view: &View| -> Vec<(&Comparable, &ShownSet)> {
        sets.iter()
            .filter_map(|set| Some((set.pictures.iter().find(|c| c.view.name == view.name)?, set)))
            .collect()
    };
    let all: Vec<(&View, Vec<(&Comparable, &ShownSet)>)> =
        views.iter().map(|view| (view, pictures(view))).collect();
    let evaluated = all.iter().any(|(_, p)| !p.is_empty());
    let shown: Vec<_> = all
        .into_iter()
        .filter(|(v, p)| if evaluated { !p.is_empty() } else { v.split != Split::Train })
        .collect();
    let side = if shown.len() > FEW_VIEWS { SIDE_PX.1 } else { SIDE_PX.0 };
    let (mut rows, mut left_out, mut bytes) = (Vec::new(), Vec::new(), 0);
    // few at a time: large photographs fill the memory
    for part in shown.chunks(4) {
        if bytes >= most {
            left_out.extend(
                part.iter().flat_map(|(_, pictures)| pictures).map(|(c, _)| relative(&c.file, folder)),
            );
            continue;
        }
        let made = part.par_iter().map(|(view, pictures)| row(view, background, pictures, side, folder));
        for row in made.collect::<Result<Vec<_>>>()? {
            bytes += row.photo.len();
            bytes += row.pictures.iter().map(|p| p.picture.len() + p.error.len()).sum::<usize>();
            rows.push(row);
        }
    }
    while bytes > most
        && let Some(row) = rows.pop()
    {
        bytes -= row.photo.len();
        bytes -= row.pictures.iter().map(|p| p.picture.len() + p.error.len()).sum::<usize>();
        left_out.extend(row.pictures.into_iter().map(|p| p.file));
    }
    Ok((rows, left_out))
}

fn row(
    view: &View,
    background: ViewBackground,
    files: &[(&Comparable, &ShownSet)],
    side: u32,
    folder: &Path,
) -> Result<ViewRow> {
    let loaded = view.load(&Limits::default())?;
    let photo = pictures::expected(&loaded.photo, loaded.mask.as_ref(), background);
    let size = working_size(photo.width, photo.height, side);
    let url = |picture: &Photo| -> Result<String> {
        let picture = straightened(reduce_photo(picture, size), &view.camera);
        Ok(picture_url(&io::jpeg_bytes(&picture, QUALITY, Path::new(&view.name))?))
    };
    let mut pictures = Vec::new();
    for (file, set) in files {
        let found = pictures::read_like(&file.file, &photo)?;
        let shown = |p: &[f32; 4]| [p[0], p[1], p[2]].map(quantize);
        let rgb: Vec<[u8; 3]> = found.data.as_chunks::<4>().0.iter().map(shown).collect();
        let apart: Vec<[u8; 3]> = rgb.iter().zip(&photo.rgb).map(|(a, b)| error(*a, *b)).collect();
        let like = |rgb| Photo { rgb, alpha: None, ..photo };
        let mut error = reduce_photo(&like(apart), size);
        error.rgb.iter_mut().for_each(|p| *p = heat(p[0] as f32 / 255.0));
        let views = set.figures.pointer("/head/views").and_then(Value::as_array);
        let own = views.and_then(|views| views.iter().find(|v| v["name"] == view.name.as_str()));
        let psnr = own.and_then(|v| v["psnr_masked"].as_f64().or(v["psnr"].as_f64()));
        pictures.push(ViewPicture {
            method: set.key.clone(),
            title: set.title.clone(),
            picture: url(&like(rgb))?,
            error: url(&error)?,
            psnr: psnr.map(|p| format!("{p:.1}")).unwrap_or_default(),
            file: relative(&file.file, folder),
        });
    }
    Ok(ViewRow { name: view.name.clone(), width: size.0, height: size.1, photo: url(&photo)?, pictures })
}

/// Returns the mean difference of the channels as a share of [`MAX_ERROR`], in all three channels.
pub(in crate::pipeline) fn error(a: [u8; 3], b: [u8; 3]) -> [u8; 3] {
    let sum: u32 = (0..3).map(|k| a[k].abs_diff(b[k]) as u32).sum();
    [quantize(sum as f32 / 3.0 / 255.0 / MAX_ERROR); 3]
}

/// Returns the color of an error, 0..=1.
pub(in crate::pipeline) fn heat(t: f32) -> [u8; 3] {
    let at = t.clamp(0.0, 1.0) * (HEAT.len() - 1) as f32;
    let k = (at as usize).min(HEAT.len() - 2);
    let mix = |c: usize| HEAT[k][c] as f32 + (at - k as f32) * (HEAT[k + 1][c] as f32 - HEAT[k][c] as f32);
    [0, 1, 2].map(|c| mix(c).round() as u8)
}

/// Resamples a picture to a pinhole camera of the same intrinsics, so that a viewer can overlay it
/// on a mesh.
fn straightened(picture: Photo, camera: &Camera) -> Photo {
    if camera.distortion.is_none() {
        return picture;
    }
    let (w, h) = (picture.width, picture.height);
    let c = camera.resized(w, h);
    let from = |i: u32| {
        let (x, y) = ((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
        let DVec2 { x, y } = c.pixel(DVec2::new((x - c.cx) / c.fx, (y - c.cy) / c.fy)) - 0.5;
        if !(x > -1.0 && y > -1.0 && x < w as f64 && y < h as f64) {
            return [0; 3];
        }
        let pixel = |x: f64, y: f64| {
            let [x, y] = [(x, w), (y, h)].map(|(v, n)| v.clamp(0.0, (n - 1) as f64) as usize);
            picture.rgb[y * w as usize + x]
        };
        let (u, v) = (x - x.floor(), y - y.floor());
        let [a, b] = [y.floor(), y.floor() + 1.0].map(|y| [pixel(x.floor(), y), pixel(x.floor() + 1.0, y)]);
        let mix = |k: usize| {
            let across = |[l, r]: [[u8; 3]; 2]| l[k] as f64 + u * (r[k] as f64 - l[k] as f64);
            (across(a) + v * (across(b) - across(a))).round() as u8
        };
        [0, 1, 2].map(mix)
    };
    Photo { rgb: (0..w * h).map(from).collect(), alpha: None, ..picture }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3, Vec3};
    use tiface_base::geom::Distortion;

    #[test]
    fn errors_are_colored_from_dark_to_bright() {
        assert_eq!((heat(0.0), heat(1.0), heat(7.0)), (HEAT[0], HEAT[5], HEAT[5]));
        // halfway between the first two: (0 + 66) / 2, (0 + 10) / 2, (4 + 104) / 2
        assert_eq!(heat(0.1), [33, 5, 54]);
        // 30, 0 and 21 apart: 17 of 255, a third of the most
        assert_eq!(error([30, 9, 0], [0, 9, 21]), [85; 3]);
        assert_eq!(error([255; 3], [0; 3]), [255; 3]);
    }

    #[test]
    fn a_distorted_photograph_becomes_that_of_a_pinhole() {
        let distortion = Distortion { k1: -0.2, ..Distortion::default() };
        let (rotation, position) = (DMat3::IDENTITY, DVec3::ZERO);
        let camera = Camera {
            width: 40,
            height: 40,
            fx: 30.0,
            fy: 30.0,
            cx: 20.0,
            cy: 20.0,
            distortion,
            rotation,
            position,
        };
        // a point at (0.5, 0) falls on 20 + 30 · 0.5 (1 − 0.2 · 0.25) = 34.25; a pinhole sees it at
        // 35
        let (at, _) = camera.project(Vec3::new(0.5, 0.0, -1.0)).unwrap();
        assert!((at.x - 34.25).abs() < 1e-4);
        let bright = |i: u32| if i % 40 == 34 { [255; 3] } else { [0; 3] };
        let taken = Photo { width: 40, height: 40, rgb: (0..1600).map(bright).collect(), alpha: None };
        let straight = straightened(taken.clone(), &camera);
        let row = &straight.rgb[20 * 40..21 * 40];
        // column 34 holds 34 to 35: its middle, 34.5, was at 20 + 30 · 0.508 = 35.25 without
        // distortion
        assert!(row[35][0] > 150 && row[33][0] < 100, "{row:?}");
        let pinhole = Camera { distortion: Distortion::default(), ..camera };
        assert_eq!(straightened(taken.clone(), &pinhole), taken);
    }
}
