//! Glare of lamps around the demo head: found, taken out of training photographs, left as given.

use super::glare::{self, GLARE};
use super::tests::{NoFields, measured_head, quiet};
use super::{Session, Stage, complete};
use crate::config::{CameraPoses, Config, Exposures, Glares, Preset};
use serde_json::json;
use tiface_base::image::{Glare, Gray, Photo, blurred, linear_from_srgb, quantize, srgb_from_linear};
use tiface_base::io::{self, Limits};
use tiface_capture::{self as capture, Capture, CaptureOptions};

/// Hangs five lamps behind the head of a photograph, instead of all that is there, at other places
/// in each view, and spreads twice their light with this deviation, in pixels.
fn light(photo: &Photo, mask: &Gray, view: usize, deviation: f32) -> Photo {
    let (w, h) = (photo.width as usize, photo.height as usize);
    let places = [0.0f32, 0.21, 0.38, 0.6, 0.79].map(|turn| {
        let angle = std::f32::consts::TAU * (turn + 0.13 * view as f32);
        [w as f32 * (0.5 + 0.42 * angle.cos()), h as f32 * (0.5 + 0.42 * angle.sin())]
    });
    let is_lamp = |i: usize| {
        let at = [(i % w) as f32 + 0.5, (i / w) as f32 + 0.5];
        mask.values[i] == 0 && places.iter().any(|p| (at[0] - p[0]).hypot(at[1] - p[1]) < 0.05 * h as f32)
    };
    let lamps: Vec<f32> = (0..w * h).map(|i| if is_lamp(i) { 0.8 } else { 0.0 }).collect();
    // on a dark margin, since the blur repeats what is at the border
    let margin = (3.0 * deviation).ceil() as usize;
    let stride = w + 2 * margin;
    let mut wide = vec![0.0; stride * (h + 2 * margin)];
    for (y, row) in lamps.chunks_exact(w).enumerate() {
        wide[(y + margin) * stride + margin..][..w].copy_from_slice(row);
    }
    let wide = blurred(&wide, stride, deviation);
    let halos = |i: usize| wide[(i / w + margin) * stride + margin + i % w];
    let lit = |(i, color): (usize, &[u8; 3])| {
        color.map(|byte| {
            let head = if mask.values[i] > 0 { linear_from_srgb(f32::from(byte) / 255.0) } else { lamps[i] };
            let linear = head + 2.0 * halos(i);
            quantize(srgb_from_linear(linear.min(1.0)))
        })
    };
    Photo { rgb: photo.rgb.iter().enumerate().map(lit).collect(), ..photo.clone() }
}

#[test]
fn training_photographs_lose_the_glare_of_lamps_unless_it_is_kept_as_given() {
    let (dir, clean) = measured_head();
    let loaded = |capture: &Capture| -> Vec<(Photo, Gray)> {
        let views = capture.views.iter().map(|view| view.load(&Limits::default()).unwrap());
        views.map(|loaded| (loaded.photo, loaded.mask.unwrap())).collect()
    };
    let dark = loaded(&clean);
    let run = |wanted: Glares| {
        let folder = tempfile::tempdir().unwrap();
        let run = quiet(folder.path());
        let mut config = Config::preset(Preset::Draft);
        config.capture.path = dir.path().into();
        (config.capture.cameras, config.capture.exposure) = (CameraPoses::Given, Exposures::Given);
        config.capture.glare = wanted;
        let session = Session::open(&config, &run).unwrap();
        complete(&session, Stage::Mask, &NoFields).unwrap();
        (io::is_file(&run.path("mask").join(GLARE)), loaded(session.refined_capture().unwrap()))
    };
    // without lamps, photographs stay as they are, to the byte
    assert!(run(Glares::Auto) == (false, dark.clone()));
    for (i, (view, (photo, mask))) in clean.views.iter().zip(&dark).enumerate() {
        let lit = light(photo, mask, i, 0.053 * photo.width.max(photo.height) as f32);
        io::write_png_rgb(&view.photo, lit.width, lit.height, &lit.rgb).unwrap();
    }
    let (found, given) = run(Glares::Given);
    assert!(!found && given == loaded(&capture::open(dir.path(), &CaptureOptions::default()).unwrap()));
    let (found, cleared) = run(Glares::Auto);
    assert!(found);
    // on the head, where the background shows nowhere through
    let off = |photos: &[(Photo, Gray)], v: usize| {
        let opaque = dark[v].1.values.iter().enumerate().filter(|(_, alpha)| **alpha == 255);
        let square = |a: u8, b: u8| (f64::from(a) - f64::from(b)).powi(2);
        let of_pixel =
            |i: usize| (0..3).map(|c| square(photos[v].0.rgb[i][c], dark[v].0.rgb[i][c])).sum::<f64>();
        opaque.map(|(i, _)| of_pixel(i)).sum::<f64>()
    };
    let train = clean.views.len() - 1;
    let all = |photos| (0..train).map(|v| off(photos, v)).sum::<f64>();
    // photographs are rounded to 8 bits twice
    let (left, shed) = (all(&cleared), all(&given));
    assert!(left < 0.25 * shed, "{left} of {shed}");
    // held-out photographs are never changed
    assert!(cleared[train] == given[train]);
}

#[test]
fn glare_is_read_back_and_what_is_no_weight_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(glare::read(dir.path()).unwrap(), None);
    let found = Glare { weights: [0.5, 0.0, 0.25, 1.5] };
    glare::write(&found, dir.path()).unwrap();
    assert_eq!(glare::read(dir.path()).unwrap(), Some(found));
    for weights in [json!([1, 1, 1, -1]), json!([1, 1, 1, 11]), json!([1, 1, 1]), json!([1, 1, 1, null])] {
        std::fs::write(dir.path().join(GLARE), json!({ "weights": weights }).to_string()).unwrap();
        let error = glare::read(dir.path()).unwrap_err().to_string();
        assert!(error.contains(GLARE), "{error}");
    }
}
