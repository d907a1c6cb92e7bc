//! A small view of a field while it is learned, from its newest checkpoint. Whoever looks makes it: the training knows
//! nothing of it, and no byte of it changes.

use super::learn::load_field;
use super::pictures;
use super::scene_file::{read_capture, read_scene};
use crate::capture::Split;
use crate::config::{Config, Stage, ViewBackground};
use crate::image::{Photo, quantize};
use crate::io;
use crate::{Error, Result};
use std::path::Path;

/// Pixels along the longest side.
const SIDE: u32 = 240;

/// Returns what the first held-out camera sees of the field that a stage of a run has learned so far, over black, as a
/// JPEG file.
///
/// # Errors
///
/// There is no checkpoint yet, or a file of the run is damaged.
pub fn field_view(run: &Path, config: &Config, stage: Stage) -> Result<Vec<u8>> {
    let scene = read_scene(&run.join("mask/scene.json"))?;
    let capture = read_capture(&run.join("cameras.json"), Path::new(""))?;
    let mut views = [Split::Test, Split::Val, Split::Train].into_iter().flat_map(|s| capture.split(s));
    let camera = views.next().map(|view| view.camera.clone());
    let camera = camera.ok_or_else(|| Error::cannot("the run has no camera", ""))?;
    let share = f64::from(SIDE) / f64::from(camera.width.max(camera.height));
    let side = |pixels: u32| (f64::from(pixels) * share.min(1.0)).round().max(1.0) as u32;
    let camera = camera.resized(side(camera.width), side(camera.height)).transformed(&scene.scene_from_world);
    let mut view = load_field(run, config, &scene, stage)?(&camera);
    if let Some(black) = pictures::behind(ViewBackground::Black) {
        pictures::over(&mut view, black);
    }
    let rgb = view.color.data.as_chunks::<4>().0.iter().map(|p| [p[0], p[1], p[2]].map(quantize)).collect();
    let photo = Photo { width: view.color.width, height: view.color.height, rgb, alpha: None };
    Ok(io::jpeg_bytes(&photo, 85, run)?)
}
