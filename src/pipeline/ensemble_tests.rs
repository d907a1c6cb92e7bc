//! The stage `ensemble` on pictures made by hand.

use super::tests::{NoFields, masked, tiny_run, words};
use super::*;
use crate::config::{Config, Method, Preset, ViewBackground};
use crate::run::Run;
use glam::Vec3;
use serde_json::json;
use std::path::PathBuf;
use tiface_base::geom::{Camera, Ray};
use tiface_base::image::{Image, quantize};
use tiface_base::io;
use tiface_base::{ErrorKind, Result};
use tiface_capture::{Split, View};
use tiface_surface::render::RenderedView;

/// Size of the photographs of [`tiny_run`].
const SIZE: (u32, u32) = (32, 40);

fn flat(color: [f32; 4]) -> Image {
    let mut image = Image::new(SIZE.0, SIZE.1, 4);
    image.data.as_chunks_mut::<4>().0.fill(color);
    image
}

/// As `render` would have left it, one meter before the camera.
fn put(run: &Run, member: &str, name: &str, color: Image) -> PathBuf {
    let mut depth = Image::new(SIZE.0, SIZE.1, 1);
    depth.data.fill(1.0);
    let view = RenderedView { color, depth, normal: Image::new(0, 0, 3) };
    let folder = run.path(format!("render/{member}/float"));
    pictures::write_float(&folder, name, &view).unwrap();
    pictures::float_path(&folder, name)
}

fn pixel(run: &Run, file: &str, at: usize) -> [u8; 3] {
    let read = io::read_photo(&run.path(file), None, &io::Limits::default()).unwrap();
    read.rgb[at]
}

#[test]
fn float_members_are_blended_and_rounded_once_and_a_missing_one_is_named() {
    let (_dir, mut config, run) = tiny_run();
    let paper = Config::preset(Preset::Paper);
    (config.ensemble, config.render.method) = (paper.ensemble, paper.render.method);
    let session = Session::open(&config, &run).unwrap();
    masked(&session);
    let names: Vec<String> = session.capture().split(Split::Test).map(|v| v.name.clone()).collect();
    for name in &names {
        put(&run, "baseline", name, flat([0.2, 0.2, 0.2, 1.0]));
        put(&run, "tface", name, flat([0.402, 0.402, 0.402, 1.0]));
    }
    let e = complete(&session, Stage::Ensemble, &NoFields).unwrap_err();
    let missing = format!("render/volume/float/{}.exr", names[0]);
    assert_eq!(
        e.to_string(),
        format!("stage `ensemble`: member `volume` is missing: there is no `{missing}`")
    );
    assert!(
        e.hint().contains("--with baseline,tface,volume") && e.hint().contains("`iface`"),
        "{}",
        e.hint()
    );
    for name in &names {
        put(&run, "volume", name, flat([0.601, 0.601, 0.601, 1.0]));
    }
    let done = complete(&session, Stage::Ensemble, &NoFields).unwrap();
    assert_eq!(done.summary["views"], 2);
    // 0.1 · 0.2 + 0.6 · 0.402 + 0.3 · 0.601 = 0.4415 → 112.58 → 113; bytes blended would give
    // 0.1 · 51 + 0.6 · 103 + 0.3 · 153 = 112.8, and truncated 112
    assert_eq!(quantize(0.4415), 113);
    assert_eq!(pixel(&run, &format!("ensemble/{}.png", names[1]), 77), [113; 3]);
    let weights = io::read_json(&run.path("ensemble/weights.json"), &io::Limits::default()).unwrap();
    assert_eq!((&weights["weights"], &weights["fitted"]), (&json!([0.1f32, 0.6f32, 0.3f32]), &json!(null)));
    assert!(complete(&session, Stage::Ensemble, &NoFields).unwrap().skipped);
}

/// A field that has learned every photograph by heart, each pixel `off` from what it should be.
struct ByHeart {
    views: Vec<(Camera, Image)>,
    asked: std::sync::atomic::AtomicUsize,
}

impl ByHeart {
    fn new(session: &Session, off: f32) -> ByHeart {
        let scene = session.scene().unwrap();
        let learned = |view: &View| {
            let loaded = view.load(&io::Limits::default()).unwrap();
            let photo = pictures::expected(&loaded.photo, loaded.mask.as_ref(), ViewBackground::None);
            let mut image = flat([0.0, 0.0, 0.0, 1.0]);
            for (p, rgb) in image.data.as_chunks_mut::<4>().0.iter_mut().zip(&photo.rgb) {
                (0..3).for_each(|k| p[k] = rgb[k] as f32 / 255.0 + off);
            }
            (view.camera.transformed(&scene.scene_from_world), image)
        };
        ByHeart { views: session.capture().views.iter().map(learned).collect(), asked: 0.into() }
    }
}

impl Radiance for ByHeart {
    fn render_rays(&self, rays: &[Ray], _: Vec3) -> Vec<RayResult> {
        self.asked.fetch_add(rays.len(), std::sync::atomic::Ordering::Relaxed);
        let see = |ray: &Ray| {
            let own = |(camera, _): &&(Camera, Image)| camera.position.as_vec3().distance(ray.origin) < 1e-5;
            let (camera, image) = self.views.iter().find(own).unwrap();
            let (at, _) = camera.project(ray.origin + ray.direction).unwrap();
            let p = image.pixel(at.x as u32, at.y as u32);
            RayResult { color: [p[0], p[1], p[2]], opacity: 1.0, ..RayResult::default() }
        };
        rays.iter().map(see).collect()
    }
}

/// T-Face and the baseline, of known errors.
struct Two(ByHeart, ByHeart);

impl Fields for Two {
    fn surface(&self) -> Result<&dyn Surface> {
        panic!("no distance is asked for")
    }

    fn radiance(&self, stage: Stage) -> Result<&dyn Radiance> {
        Ok(if stage == Stage::Tface { &self.0 } else { &self.1 })
    }
}

#[test]
fn the_blend_is_no_worse_than_its_best_member_whichever_that_is() {
    // errors of one sign cannot be blended away: the better member takes all; of two signs, they
    // cancel
    for (tface, baseline, expected) in
        [(0.02, 0.1, 1.0), (0.1, 0.02, 0.0), (0.05, -0.05, 0.5), (0.02, -0.06, 0.75)]
    {
        let (_dir, mut config, run) = tiny_run();
        config.render.method = vec![Method::Tface, Method::Baseline];
        config.ensemble.members = vec![Method::Tface, Method::Baseline];
        config.metrics.surface_points = 100;
        let session = Session::open(&config, &run).unwrap();
        masked(&session);
        // what is rendered of test views says the opposite: had they a say, the worse member would
        // win
        let names: Vec<String> = session.capture().split(Split::Test).map(|v| v.name.clone()).collect();
        for name in &names {
            put(&run, "tface", name, flat([1.0; 4]));
            put(&run, "baseline", name, flat([0.0, 0.0, 0.0, 1.0]));
        }
        let fields = Two(ByHeart::new(&session, tface), ByHeart::new(&session, baseline));
        let done = complete(&session, Stage::Ensemble, &fields).unwrap().summary;
        let first = done["weights"][0].as_f64().unwrap();
        assert!((first - expected).abs() < 0.05, "{tface} {baseline}: {done}");
        let found = &done["fitted"];
        for member in ["tface", "baseline"] {
            assert!(
                found["psnr"].as_f64().unwrap() + 1e-6 > found["psnr_alone"][member].as_f64().unwrap(),
                "{done}"
            );
        }
        // white at the weight of T-Face
        let shown = pixel(&run, &format!("ensemble/{}.png", names[0]), 700)[0] as f64;
        assert!((shown - 255.0 * first).abs() < 1.0, "{shown} {first}");
        // only squares are marched: 8 views of 32 × 40 pixels, one tile of 8 × 8 in each
        assert!(fields.0.asked.into_inner() <= 8 * 64, "of 8 · 1280");
        let sets: Vec<String> = metrics::picture_sets(&config, &run).into_iter().map(|s| s.name).collect();
        assert_eq!(sets, ["tface", "baseline", "ensemble"]);
    }
}

#[test]
fn no_field_learns_from_the_pixels_that_weights_are_fitted_on() {
    let (_dir, mut config, run) = tiny_run();
    let blind = |config: &Config| -> Vec<usize> {
        let session = Session::open(config, &run).unwrap();
        if !run.path("mask/scene.json").exists() {
            masked(&session);
        }
        let views = learn::train_views(&session.capture, &session.scene().unwrap(), config, true).unwrap();
        let tiles = learn::held_out_tiles(&session.capture, config);
        for (view, (_, tiles)) in views.iter().zip(&tiles) {
            let Some(valid) = &view.valid else { continue };
            assert!(tiles.iter().flat_map(|t| t.pixels(SIZE.0)).all(|i| valid.values[i] == 0));
        }
        views
            .iter()
            .map(|v| v.valid.as_ref().map_or(0, |g| g.values.iter().filter(|x| **x == 0).count()))
            .collect()
    };
    // one tile of 8 × 8 in each photograph, whose masks and cameras stay whole
    assert_eq!(blind(&config), [64; 8]);
    config.capture.tiles = 0.0;
    assert_eq!(blind(&config), [0; 8]);
}

#[test]
fn what_cannot_be_blended_is_said_before_anything_is_learned() {
    let (_dir, base, run) = tiny_run();
    let error = |change: &dyn Fn(&mut Config)| {
        let mut config = base.clone();
        change(&mut config);
        let session = Session::open(&config, &run).unwrap();
        let e = session.remember(Stage::Metrics).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::Usage);
        assert!(!run.path("config.toml").exists());
        (e.to_string(), e.hint().to_owned())
    };
    let (text, hint) = error(&|c| c.render.method = vec![Method::Volume]);
    assert_eq!(text, "`ensemble.members` names tface, which render.method does not make");
    assert!(hint.contains("tiface render RUN --fresh render --with volume,tface,raycast"), "{hint}");
    let (text, hint) = error(&|c| c.capture.tiles = 0.0);
    assert_eq!(text, "`ensemble.weights` is empty, but there is nothing to fit them on: capture.tiles is 0");
    assert!(hint.contains("capture.tiles=0.04"), "{hint}");
    let (text, _) = error(&|c| c.ensemble.weights = vec![0.3, 0.3, 0.4]);
    assert_eq!(text, "`ensemble.weights` has 3 weights for 2 members");
    let (text, hint) = error(&|c| c.ensemble.weights = vec![1.0, 3.0]);
    assert_eq!(text, "`ensemble.weights` sum to 4, expected 1");
    assert!(hint.contains("0.2500, 0.7500"), "{hint}");
    let (text, _) = error(&|c| c.render.float = false);
    assert!(text.starts_with("`render.float` is false"), "{text}");
    // no members: no blend, and nothing to complain about
    let mut config = base.clone();
    config.render.method = vec![Method::Volume];
    config.ensemble.members.clear();
    let session = Session::open(&config, &run).unwrap();
    assert_eq!(words(&session.order(Stage::Metrics)), "mask iface render metrics");
    session.remember(Stage::Metrics).unwrap();
}
