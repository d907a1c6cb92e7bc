//! Stage `ensemble`: blends the members' views into one, in float, rounded once when written.
//!
//! ```text
//! ensemble/NAME.png       over the background
//!          weights.json   the weights, and their gain on the pixels they were fitted to
//! ```
//!
//! The weights are fitted on tiles of the training photographs that were excluded from training,
//! unless the settings give them.

use super::render::held_out;
use super::renderer::{Meshes, Renderer};
use super::surface::Fields;
use super::{learn, pictures};
use crate::config::{Config, EnsembleConfig, MaskUse, Method, display_name, key};
use crate::ensemble::{self, BlendTarget, Fit, Member, Members, Tile, blend, shares_hint};
use crate::run::{Run, StageDir};
use serde_json::{Map, Value, json};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tiface_base::image::{Gray, Image, Photo};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};
use tiface_capture::scene::Scene;
use tiface_capture::{Capture, MaskMeaning, View, ViewMask};
use tiface_surface::render::{RenderedView, Residuals};

/// Blends one picture per camera of `render`. `fields` are evaluated only if weights are to be
/// fitted, with the residuals of the stage `render` if they are known.
pub(super) fn ensemble(
    capture: &Capture,
    config: &Config,
    run: &Run,
    scene: &Scene,
    fields: &dyn Fields,
    residuals: Option<Arc<Residuals>>,
    dir: &StageDir,
) -> Result<Value> {
    let Config { ensemble: c, render, .. } = config;
    let cameras = held_out(capture);
    let (weights, fitted) = match c.weights.is_empty() {
        true => {
            let meshes = Meshes::load(run, config, &c.members)?;
            let renderer = Renderer::new(scene, fields, &meshes, render.samples, dir.monitor());
            let residuals = match (fits_with_residuals(config), residuals) {
                (false, _) => None,
                (true, None) => renderer.residuals(capture, scene, config, true)?,
                (true, known) => known,
            };
            let renderer = renderer.with_residuals(residuals);
            fit(capture, config, scene, &renderer, dir)?
        }
        false => (shares(c), Value::Null),
    };
    let mut spent = Duration::ZERO;
    for (i, camera) in cameras.iter().enumerate() {
        let views = member_views(config, run, &camera.name)?;
        let begin = Instant::now();
        let color = blend(&members(capture, config, &views)?, &weights)?;
        spent += begin.elapsed();
        let mut view = RenderedView { color, depth: Image::new(0, 0, 1), normal: Image::new(0, 0, 3) };
        if let Some(background) = pictures::background_color(render.background) {
            pictures::over(&mut view, background);
        }
        pictures::write(dir.folder(), &camera.name, &view, render.format, config.capture.unit_m)?;
        dir.step(i + 1, cameras.len())?;
    }
    let mut summary = json!({"members": method_names(&c.members), "weights": weights, "fitted": fitted});
    io::write_atomic(&dir.folder().join("weights.json"), format!("{summary:#}\n").as_bytes())?;
    summary["views"] = json!(cameras.len());
    // warnings about the blend alone: its members' warnings are in the stage `render`
    summary["seconds_per_view"] = json!(spent.as_secs_f64() / cameras.len().max(1) as f64);
    Ok(summary)
}

/// Returns whether weights are fitted to members that show residuals.
pub(super) fn fits_with_residuals(config: &Config) -> bool {
    config.ensemble.weights.is_empty() && config.render.shows_residuals(&config.ensemble.members)
}

/// Checks, before any work, that the members of the blend will be available.
pub(super) fn can_blend(config: &Config) -> Result<()> {
    let c = &config.ensemble;
    let wrong = |key: &'static str, problem: String, hint: &str| {
        Err(Error::usage(format!("`{key}` {problem}"), hint))
    };
    if c.members.is_empty() {
        return wrong(key!(ensemble.members), "is empty: there is nothing to blend".into(), "name members");
    }
    for (i, member) in c.members.iter().enumerate() {
        let name = member.as_str();
        if c.members[..i].contains(member) {
            return wrong(key!(ensemble.members), format!("names {name} twice"), "name every member once");
        }
        if !config.render.method.contains(member) {
            let problem = format!("names {name}, which render.method does not make");
            let hint = format!(
                "render it too (`tiface render RUN --fresh render --with {}`), or blend what there is with \
                     ensemble.members and ensemble.weights; `--set ensemble.members=` blends nothing",
                shown_with_members(config)
            );
            return wrong(key!(ensemble.members), problem, &hint);
        }
    }
    let (found, members) = (c.weights.len(), c.members.len());
    let sum: f64 = c.weights.iter().sum();
    if found == 0 && config.capture.tiles <= 0.0 {
        let problem = "is empty, but there is nothing to fit them on: capture.tiles is 0".into();
        return wrong(
            key!(ensemble.weights),
            problem,
            "give one for each of ensemble.members, or set capture.tiles=0.04",
        );
    }
    if found != members && found > 0 {
        let problem = format!("has {found} weights for {members} members");
        let hint = "give one for each of ensemble.members, in that order, or none to have them fitted";
        return wrong(key!(ensemble.weights), problem, hint);
    }
    if found > 0 && (sum - 1.0).abs() > 1e-3 {
        return wrong(key!(ensemble.weights), format!("sum to {sum}, expected 1"), &shares_hint(&shares(c)));
    }
    if !config.render.float {
        let problem = "is false, but members are blended in float".into();
        return wrong(key!(render.float), problem, "set it to true, or blend nothing: ensemble.members=");
    }
    Ok(())
}

/// Returns the names of methods.
fn method_names(methods: &[Method]) -> Vec<&'static str> {
    methods.iter().map(|m| m.as_str()).collect()
}

/// Returns the shown and the blended methods in the syntax of `--with`.
fn shown_with_members(config: &Config) -> String {
    let mut methods = config.render.method.clone();
    methods.extend(config.ensemble.members.iter().filter(|m| !config.render.method.contains(m)));
    method_names(&methods).join(",")
}

/// Returns the weights of the settings, or equal ones if there are none.
fn shares(c: &EnsembleConfig) -> Vec<f32> {
    match c.weights.is_empty() {
        true => vec![1.0 / c.members.len() as f32; c.members.len()],
        false => c.weights.iter().map(|w| *w as f32).collect(),
    }
}

/// Reads the views of all members from one camera, in float.
fn member_views(config: &Config, run: &Run, name: &str) -> Result<Vec<Image>> {
    let view = |member: &Method| {
        let word = member.as_str();
        let below = format!("render/{word}/{}", pictures::FLOAT);
        let file = pictures::float_path(&run.path(&below), name);
        if io::is_file(&file) {
            return Ok(pictures::read_float(&file)?);
        }
        Err(Error::cannot(
            format!("member `{word}` is missing: there is no `{below}/{name}.exr`"),
            format!(
                "`tiface render RUN --fresh render --with {}` makes it from the stage `{}`, or leave it out of \
                 ensemble.members",
                shown_with_members(config),
                member.stage()
            ),
        ))
    };
    config.ensemble.members.iter().map(view).collect()
}

/// Checks the members of one view, and cuts them to the head if the settings say so.
///
/// Fitted weights never affect the cut, so that a fit sees the members as they will be blended.
fn members<'i>(capture: &Capture, config: &Config, views: &'i [Image]) -> Result<Members<'i>> {
    let c = &config.ensemble;
    let member = |(m, image): (&Method, &'i Image)| Member {
        name: m.as_str(),
        image,
        masked: trained_with_masks(capture, config, *m),
    };
    let list: Vec<Member<'i>> = c.members.iter().zip(views).map(member).collect();
    let members = Members::new(&list)?;
    if c.cut { Ok(members.cut(&shares(c))?) } else { Ok(members) }
}

/// Returns whether the field was trained with masks.
fn trained_with_masks(capture: &Capture, config: &Config, method: Method) -> bool {
    let has_mask = |v: &View| v.mask != ViewMask::None && v.mask_meaning == MaskMeaning::Empty;
    let used = match method {
        Method::Baseline | Method::Tface => config.radiance(method.stage()).masks != MaskUse::None,
        Method::Volume | Method::Raycast | Method::Plain | Method::Textured | Method::Raster => true,
    };
    used && capture.views.iter().any(has_mask)
}

/// Returns weights for the members, and a report of the fit; equal weights if no tile shows the
/// head.
///
/// Only the tiles are rendered: a few percent of the pixels of the training views.
fn fit(
    capture: &Capture,
    config: &Config,
    scene: &Scene,
    renderer: &Renderer,
    dir: &StageDir,
) -> Result<(Vec<f32>, Value)> {
    let c = &config.ensemble;
    let imported = |method: &&Method| {
        matches!(method, Method::Baseline | Method::Tface)
            && !config.radiance(method.stage()).import.is_empty()
    };
    for method in c.members.iter().filter(imported) {
        dir.warn(&format!(
            "`{}` was not learned here and may know the pixels that weights are fitted on: its weight may be too \
             large; ensemble.weights gives others",
            method.stage()
        ));
    }
    let mut sums = Vec::new();
    for (view, tiles) in learn::held_out_tiles(capture, config) {
        let (photo, weight) = pictures::target(&view.load(&Limits::default())?);
        let camera = view.camera.transformed(&scene.scene_from_world);
        let mut sum = Fit::new(c.members.len())?;
        for tile in tiles {
            let (photo, weight) = cut_out(&photo, &weight, tile);
            if weight.values.iter().all(|w| *w == 0) {
                continue;
            }
            let part = camera.part(tile.x, tile.y, tile.side, tile.side);
            let mut images: Vec<Image> = Vec::new();
            for method in &c.members {
                let view = renderer.view(*method, &part)?;
                dir.check_stop()?; // what it holds then is not whole
                images.push(view.map_or_else(|| Image::new(tile.side, tile.side, 4), |view| view.color));
            }
            sum.add(&members(capture, config, &images)?, &BlendTarget { photo: &photo, weight: &weight })?;
        }
        sums.push(sum);
    }
    let learned: Vec<bool> =
        c.members.iter().map(|method| matches!(method, Method::Baseline | Method::Tface)).collect();
    let from_new: Vec<Fit> = sums.iter().map(|sum| sum.for_new_cameras(&learned)).collect();
    let Some(weights) = ensemble::fit_weights(&from_new)? else {
        dir.warn(
            "no square of capture.tiles shows the head: the members are blended alike; raise capture.tiles, or give \
             ensemble.weights",
        );
        return Ok((shares(c), Value::Null));
    };
    let mut all = Fit::new(c.members.len())?;
    sums.iter().try_for_each(|sum| all.merge(sum))?;
    let mut alone = Map::new();
    for (k, name) in method_names(&c.members).into_iter().enumerate() {
        let one: Vec<f32> = (0..c.members.len()).map(|l| if l == k { 1.0 } else { 0.0 }).collect();
        alone.insert(name.into(), json!(all.psnr(&one)?));
    }
    let each = method_names(&c.members).into_iter().zip(&weights);
    let shares: Vec<String> = each.map(|(name, w)| format!("{} {w:.3}", display_name(name))).collect();
    dir.note(&format!("fitted weights: {}", shares.join(", ")));
    let record = json!({"pixels": all.pixels(), "psnr": all.psnr(&weights)?, "psnr_alone": alone});
    Ok((weights, record))
}

/// Returns the pixels of the members in a tile.
fn cut_out(photo: &Photo, weight: &Gray, tile: Tile) -> (Photo, Gray) {
    let (width, height) = (tile.side, tile.side);
    let rgb = tile.pixels(photo.width).map(|i| photo.rgb[i]).collect();
    let values = tile.pixels(weight.width).map(|i| weight.values[i]).collect();
    (Photo { width, height, rgb, alpha: None }, Gray { width, height, values })
}
