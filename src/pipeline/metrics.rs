//! Stage `metrics`: compares every view of every member and of the blends with its photograph.

use super::exposure::ExposureCheck;
use super::pictures;
use super::truth::against_truth;
use crate::config::{Config, Method, TruthPhoto, ViewBackground};
use crate::metrics::{Lpips, Masks, Metrics, PartMetrics, Tones, ViewMetrics, compare, compare_in, parts};
use crate::run::{Run, StageDir};
use rayon::prelude::*;
use serde_json::{Map, Value, json};
use std::path::PathBuf;
use tiface_base::geom::Mesh;
use tiface_base::image::{Gray, Image, Photo};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};
use tiface_capture::{Capture, LoadedView, View};

/// Largest mask value that counts as empty.
const MAX_EMPTY: u8 = 0;

/// Rendered pictures of one method, one for each view.
pub(super) struct PictureSet {
    /// The name in `metrics.json`: a member, or `ensemble`.
    pub name: String,
    /// The folder of its pictures.
    folder: PathBuf,
}

/// A rendered picture with its photograph.
pub(super) struct Comparable<'a> {
    /// Its view.
    pub view: &'a View,
    /// The picture.
    pub file: PathBuf,
    /// The float version of the picture.
    pub float: Option<PathBuf>,
    /// The picture from the pose fitted to the view alone, if there are such pictures; the same one
    /// where it has none.
    pub own_pose: Option<PathBuf>,
}

/// Metrics of one picture.
struct ViewFigures {
    head: ViewMetrics,
    /// The same where the photograph's own exposure is divided out.
    own_exposure: Option<ViewMetrics>,
    /// The same from the pose fitted to the view alone, and where the photograph's own exposure is
    /// divided out.
    own_pose: Option<ViewMetrics>,
    region: Option<ViewMetrics>,
    parts: PartMetrics,
    /// Sum of opacity² over the pixels without any head, and the number of these pixels.
    outside: Option<(f64, u64)>,
}

/// Returns all sets that are evaluated, in pipeline order.
pub(super) fn picture_sets(config: &Config, run: &Run) -> Vec<PictureSet> {
    let set = |name: &str, folder: &str| PictureSet { name: name.into(), folder: run.path(folder) };
    let methods = config.render.method.iter().map(|m| m.as_str());
    let mut sets: Vec<PictureSet> = methods.map(|m| set(m, &format!("render/{m}"))).collect();
    if !config.ensemble.members.is_empty() {
        sets.push(set("ensemble", "ensemble"));
    }
    sets
}

/// Returns the pictures of a set that have a photograph.
pub(super) fn comparable<'c>(capture: &'c Capture, config: &Config, set: &PictureSet) -> Vec<Comparable<'c>> {
    let [floats, own] = [pictures::FLOAT, pictures::OWN_POSE].map(|below| set.folder.join(below));
    let picture = |view: &'c View| {
        let [file, own_pose] =
            [&set.folder, &own].map(|f| pictures::path(f, &view.name, config.render.format));
        let own_pose = if io::is_file(&own_pose) { own_pose } else { file.clone() };
        let own_pose = io::is_folder(&own).then_some(own_pose);
        let float = Some(pictures::float_path(&floats, &view.name)).filter(|float| io::is_file(float));
        Comparable { view, file, float, own_pose }
    };
    capture.views.iter().map(picture).filter(|c| io::is_file(&c.file)).collect()
}

/// Writes `metrics.json`. Every rendered or blended view is compared with its photograph, inside
/// the mask and inside the capture's region of interest, and part by part (opaque pixels, outline,
/// skin, hair, coverage); opacity outside the head is measured. `capture` has the masks that the
/// metrics use, from the source `masks`; `surface` is the demo's mesh, which is compared with the
/// true surface. Where `exposure` was evened out, views have the mean exposure and photographs
/// their own, so a second set of figures, `own_exposure`, divides that out of the photographs.
/// Where poses were refined, `own_pose` compares pictures from the poses that were fitted to each
/// view alone, at its own exposure.
pub(super) fn metrics(
    capture: &Capture,
    config: &Config,
    run: &Run,
    masks: &str,
    surface: Option<&Mesh>,
    exposure: Option<&ExposureCheck>,
    dir: &StageDir,
) -> Result<Value> {
    let mut out = Map::new();
    let sets = picture_sets(config, run);
    let comparables: Vec<Vec<Comparable>> = sets.iter().map(|set| comparable(capture, config, set)).collect();
    let judge = Judge::new(config, comparables.iter().flatten(), exposure)?;
    judge.lpips.iter().for_each(|network| dir.note(&network.file().to_string()));
    for (i, (set, pictures)) in sets.iter().zip(&comparables).enumerate() {
        out.extend(judge.figures(pictures)?.map(|figures| (set.name.clone(), figures)));
        dir.step(i + 1, sets.len())?;
    }
    if out.is_empty() {
        return Err(Error::cannot(
            "no rendered views to compare",
            "name methods in `render.method`, and make their views with `--fresh render`",
        ));
    }
    if let Some(surface) = surface {
        let truth = against_truth(surface, config.metrics.surface_points as usize);
        out.insert("truth_percent_of_head".into(), json!(truth));
    }
    out.extend(blend_gain(&out, &config.ensemble.members).map(|gain| ("blend".into(), gain)));
    out.insert("truth".into(), json!({"photographs": config.metrics.truth, "masks": masks}));
    let value = Value::Object(out);
    io::write_atomic(&dir.folder().join("metrics.json"), format!("{value:#}\n").as_bytes())?;
    Ok(means(&value))
}

/// Returns how much better a blend of several members is than the best of them, dB.
fn blend_gain(sets: &Map<String, Value>, members: &[Method]) -> Option<Value> {
    let psnr = |set: &str| {
        let mean = sets.get(set)?.pointer("/head/mean")?;
        mean["psnr_masked"].as_f64().or(mean["psnr"].as_f64())
    };
    let each = members.iter().filter_map(|member| Some((member.as_str(), psnr(member.as_str())?)));
    let (best, alone) = each.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|_| members.len() > 1)?;
    Some(json!({"best_member": best, "gain_db": psnr("ensemble")? - alone}))
}

/// Photograph, masks and networks that all pictures of some views are judged by.
pub(super) struct Judge<'a> {
    config: &'a Config,
    tones: Option<Tones>,
    lpips: Option<Lpips>,
    exposure: Option<&'a ExposureCheck>,
}

impl<'a> Judge<'a> {
    /// Returns the judge of these pictures, with the networks that `config` names; the photographs
    /// tell skin from hair.
    pub fn new<'c>(
        config: &'a Config,
        pictures: impl Iterator<Item = &'c Comparable<'c>>,
        exposure: Option<&'a ExposureCheck>,
    ) -> Result<Judge<'a>> {
        let mut views: Vec<&View> = pictures.map(|picture| picture.view).collect();
        views.sort_by(|a, b| a.name.cmp(&b.name));
        views.dedup_by(|a, b| a.name == b.name);
        let lpips = Lpips::open(config.metrics.lpips.as_ref(), config.mask.memory_gib)?;
        Ok(Judge { config, tones: Tones::learn(&views)?, lpips, exposure })
    }

    /// Returns the figures of a set of pictures as in `metrics.json`; `None` without pictures.
    pub fn figures(&self, pictures: &[Comparable]) -> Result<Option<Value>> {
        let Judge { config, tones, lpips, exposure } = self;
        let figures = |picture| figures(config, picture, tones.as_ref(), lpips.as_ref(), *exposure);
        let all = pictures.par_iter().map(figures).collect::<Result<Vec<_>>>()?;
        Ok((!all.is_empty()).then(|| entry(all)))
    }
}

fn figures(
    config: &Config,
    picture: &Comparable,
    tones: Option<&Tones>,
    lpips: Option<&Lpips>,
    exposure: Option<&ExposureCheck>,
) -> Result<ViewFigures> {
    let background = config.render.background;
    let loaded = picture.view.load(&Limits::default())?;
    let render = pictures::read_like(&picture.file, &loaded.photo)?;
    let expected = |photo: &Photo| match config.metrics.truth {
        TruthPhoto::Photo => photo.clone(),
        TruthPhoto::Masked => pictures::expected(photo, loaded.mask.as_ref(), background),
    };
    let photo = expected(&loaded.photo);
    let evened = exposure.and_then(|check| check.used(&picture.view.name));
    let evened = evened.map(|own| expected(&own.divided_out(loaded.photo.clone())));
    let against = |render: &Image, photo: &Photo, mask: Option<&Gray>| {
        compare(&picture.view.name, render, photo, mask, loaded.valid.as_ref())
    };
    let own_exposure =
        evened.as_ref().map(|photo| against(&render, photo, loaded.mask.as_ref())).transpose()?;
    let own_pose = picture.own_pose.as_ref().map(|file| {
        let render = pictures::read_like(file, &loaded.photo)?;
        against(&render, evened.as_ref().unwrap_or(&photo), loaded.mask.as_ref())
    });
    let own_pose = own_pose.transpose()?;
    let masks = [loaded.mask.as_ref(), loaded.region.as_ref()];
    let [mut head, region] = compare_in(&picture.view.name, &render, &photo, masks, loaded.valid.as_ref())?;
    let region = loaded.region.is_some().then_some(region);
    head.lpips = lpips.map(|network| network.distance(&render, &photo)).transpose()?;
    // a picture over a background is opaque; its original alpha is in the float view
    let before = picture.float.as_ref().map(|float| pictures::read_float(float)).transpose()?;
    let open = before.as_ref().or((background == ViewBackground::None).then_some(&render));
    let opacity = open.map(|image| image.channel(3));
    let behind = pictures::background_color(background).unwrap_or([0.0; 3]);
    let parts = Masks::of(&loaded).map(|m| parts(&render, &photo, m, opacity.as_deref(), behind, tones));
    let parts = parts.unwrap_or_default();
    let outside = opacity.and_then(|opacity| square_opacity_outside(&opacity, &loaded));
    Ok(ViewFigures { head, own_exposure, own_pose, region, parts, outside })
}

/// Returns one set's part of the file.
fn entry(figures: Vec<ViewFigures>) -> Value {
    let (mut heads, mut regions, mut parts, mut outside) = (Vec::new(), Vec::new(), Vec::new(), (0.0, 0));
    let (mut own_exposure, mut own_pose) = (Vec::new(), Vec::new());
    for f in figures {
        parts.push(f.parts);
        heads.push(f.head);
        regions.extend(f.region);
        own_exposure.extend(f.own_exposure);
        own_pose.extend(f.own_pose);
        let (sum, pixels) = f.outside.unwrap_or_default();
        outside = (outside.0 + sum, outside.1 + pixels);
    }
    let mut entry = Map::new();
    entry.insert("head".into(), json!(Metrics::new(heads)));
    for (key, views) in [("own_exposure", own_exposure), ("own_pose", own_pose), ("region", regions)] {
        if !views.is_empty() {
            entry.insert(key.into(), json!(Metrics::new(views)));
        }
    }
    if parts.iter().any(|p| *p != PartMetrics::default()) {
        // in the order of the head's views, which name them
        entry.insert("parts".into(), json!({"mean": PartMetrics::mean(&parts), "views": parts}));
    }
    if outside.1 > 0 {
        entry.insert("mean_square_opacity_outside".into(), (outside.0 / outside.1 as f64).into());
    }
    Value::Object(entry)
}

/// Returns the sum of opacity² over the valid pixels where the mask shows no head, and the number
/// of these pixels; `None` without a mask. This measures floaters in front of the background.
fn square_opacity_outside(opacity: &[f32], loaded: &LoadedView) -> Option<(f64, u64)> {
    let mask = loaded.mask.as_ref()?;
    let valid = |i: usize| loaded.valid.as_ref().is_none_or(|v| v.values[i] > 0);
    let counted =
        opacity.iter().zip(&mask.values).enumerate().filter(|(i, (_, m))| **m == MAX_EMPTY && valid(*i));
    Some(counted.fold((0.0, 0), |(sum, n), (_, (a, _))| (sum + (*a as f64).powi(2), n + 1)))
}

/// Returns the summary of a metrics file: means without the single views.
pub(super) fn means(metrics: &Value) -> Value {
    match metrics {
        Value::Object(map) => {
            let kept = map.iter().filter(|(key, _)| *key != "views");
            Value::Object(kept.map(|(key, value)| (key.clone(), means(value))).collect())
        }
        other => other.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::exposure_tests;
    use super::super::tests::measured_head;
    use super::*;
    use tiface_base::geom::Camera;

    #[test]
    fn a_blend_that_is_below_its_best_member_is_told_by_how_much() {
        let set = |psnr: f64| json!({"head": {"mean": {"psnr_masked": psnr, "psnr": 40.0}}});
        let sets =
            json!({"tface": set(30.5), "volume": set(28.0), "textured": set(33.0), "ensemble": set(30.25)});
        let gain = |members: &[Method]| blend_gain(sets.as_object().unwrap(), members);
        let below = gain(&[Method::Tface, Method::Volume]).unwrap();
        assert_eq!(below, json!({"best_member": "tface", "gain_db": -0.25}));
        let said = crate::report::blend_verdict(&below).unwrap();
        assert!(said.contains("not better") && said.contains("0.25 dB below T-Face"), "{said}");
        let above = gain(&[Method::Volume, Method::Baseline]).unwrap();
        assert_eq!((&above["gain_db"], crate::report::blend_verdict(&above)), (&json!(2.25), None));
        // one member alone is no blend
        assert_eq!(gain(&[Method::Tface]), None);
    }

    #[test]
    fn a_view_at_the_mean_exposure_is_compared_with_the_photograph_and_with_its_own_exposure_divided_out() {
        let (dir, clean) = measured_head();
        let mut exposed = clean.clone();
        exposure_tests::expose(&mut exposed, &exposure_tests::gains());
        let check = exposure_tests::found_gains();
        // the photograph at the mean exposure is the picture of a perfect renderer
        let photo = clean.views[14].load_photo(&Limits::default()).unwrap();
        let file = dir.path().join("view.png");
        io::write_png_rgb(&file, photo.width, photo.height, &photo.rgb).unwrap();
        let picture = Comparable { view: &exposed.views[14], file, float: None, own_pose: None };
        let black = dir.path().join("black.png");
        io::write_png_rgb(&black, photo.width, photo.height, &vec![[0; 3]; photo.rgb.len()]).unwrap();
        let config = Config::preset(crate::config::Preset::Draft);
        let plain = figures(&config, &picture, None, None, None).unwrap();
        let found = figures(&config, &picture, None, None, Some(check)).unwrap();
        assert!(plain.own_exposure.is_none() && plain.own_pose.is_none());
        assert_eq!(found.head.psnr_masked, plain.head.psnr_masked);
        let own = found.own_exposure.unwrap().psnr_masked.unwrap();
        assert!(
            own > plain.head.psnr_masked.unwrap() + 6.0,
            "{own} dB, {:?} as it is",
            plain.head.psnr_masked
        );
        // from its own pose: at its own exposure, too, if that is known
        let fitted = Comparable { file: black, own_pose: Some(picture.file), ..picture };
        let psnr = |exposure| {
            let figures = figures(&config, &fitted, None, None, exposure).unwrap();
            (figures.head.psnr_masked.unwrap(), figures.own_pose.unwrap().psnr_masked)
        };
        let ((given, alone), (_, both)) = (psnr(None), psnr(Some(check)));
        assert!(
            alone == plain.head.psnr_masked && both == Some(own) && given < own - 6.0,
            "{given} {alone:?} {both:?}"
        );
    }

    #[test]
    fn opacity_before_the_background_counts_squared_and_only_where_no_head_is() {
        let render = [0.5, 1.0, 0.1, 0.9];
        let gray = |values: [u8; 4]| Some(Gray { width: 4, height: 1, values: values.to_vec() });
        let photo = Photo { width: 4, height: 1, rgb: vec![[0; 3]; 4], alpha: None };
        // a hair of head in pixel 1, pixel 3 not valid: 0.5² + 0.1² = 0.26 over two pixels
        let loaded = LoadedView {
            camera: Camera::above(4, 1, 4.0, 1.0),
            photo,
            mask: gray([0, 1, 0, 0]),
            valid: gray([255, 255, 255, 0]),
            region: None,
        };
        let (sum, pixels) = square_opacity_outside(&render, &loaded).unwrap();
        assert!((sum - 0.26).abs() < 1e-6 && pixels == 2, "{sum} over {pixels}");
        assert_eq!(square_opacity_outside(&render, &LoadedView { mask: None, ..loaded }), None);
    }
}
