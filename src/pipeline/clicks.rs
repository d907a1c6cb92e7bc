//! Masks from clicks: cut where somebody clicked, propagated to every other view, made soft.
//!
//! ```text
//! clicks → cut (GrabCut, or SAM) → propagated through the cameras → band → matting (closed form, ViTMatte) → alpha
//! ```

use super::networks::Networks;
use crate::capture::{Capture, Split};
use crate::config::MaskConfig;
use crate::image::{Gray, Photo};
use crate::io::{self, Limits};
use crate::mask::grabcut::{GrabcutOptions, grabcut};
use crate::mask::matting::closed_form::ClosedFormOptions;
use crate::mask::matting::trimap::Band;
use crate::mask::matting::{SoftenOptions, Working, soften};
use crate::mask::prompts;
use crate::mask::propagate::{Masks, PropagateOptions, PropagateView, ViewMask, propagate};
use crate::mask::{Click, CutError, distance, scale};
use crate::run::{Fingerprint, StageDir};
use crate::{Error, Result};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;

/// The clicks that masks are made from.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Clicks {
    /// Of each view, in pixels of its camera.
    pub of: Vec<Vec<Click>>,
    /// The file they came from, byte for byte; empty without one.
    pub file: Vec<u8>,
    /// What shapes the masks beside the settings: clicks and network files.
    pub inputs: Vec<(&'static str, String)>,
}

/// What of the clicks comes from files, as `inputs` names them.
const INPUTS: [&str; 4] = ["clicks", "sam", "sam_decoder", "vitmatte"];

impl Clicks {
    /// What a stage's record holds of clicks that are no longer there: their digests.
    pub fn remembered(inputs: &BTreeMap<String, String>) -> Clicks {
        let input = |name: &'static str| Some((name, inputs.get(name)?.clone()));
        Clicks { of: Vec::new(), file: Vec::new(), inputs: INPUTS.into_iter().filter_map(input).collect() }
    }
}

/// A mask that was made.
pub(super) struct Made {
    /// Soft alpha at the size of the camera.
    pub alpha: Gray,
    /// Where it is unknown, at the size that was worked on.
    pub trimap: Gray,
    /// Share of the picture that is unknown.
    pub unknown: f64,
}

/// The clicks that a configuration means, checked against the capture; `None` if masks are not made from clicks.
///
/// `kept` is the copy of the clicks that the run keeps, for when the file is gone.
pub(super) fn clicks(config: &MaskConfig, capture: &Capture, kept: &Path) -> Result<Option<Clicks>> {
    if !config.clicked() {
        return Ok(None);
    }
    let mut file = Vec::new();
    let of = if config.prompts.is_empty() {
        let clicks = config.point.iter().map(|p| prompts::parse_point(p)).collect::<Result<Vec<_>, _>>();
        let view = match config.view.as_str() {
            "" => capture.views.iter().find(|v| v.split == Split::Train).or(capture.views.first()),
            name => capture.views.iter().find(|v| v.name == name),
        };
        let Some(view) = view else {
            return Err(Error::cannot(
                format!("there is no view `{}`", config.view),
                "`tiface inspect CAPTURE --json` lists them; names have no ending",
            ));
        };
        let frame = prompts::Frame { file_path: prompts::file_path(capture, view), points: clicks? };
        prompts::Prompts { frames: vec![frame] }.clicks("mask.point", capture)
    } else {
        let named = Path::new(&config.prompts);
        let path = if !io::is_file(named) && io::is_file(kept) { kept } else { named };
        file = io::read_bytes(path, &Limits::default())?;
        let read = prompts::parse_prompts(path, &file, &Limits::default());
        read.and_then(|prompts| prompts.clicks(&path.to_string_lossy(), capture))
    }?;
    if of.iter().all(Vec::is_empty) {
        return Err(Error::cannot(
            format!("`{}` holds no click on a photograph of this capture", config.prompts),
            "click on a few photographs: `tiface mask CAPTURE --page`",
        ));
    }
    let mut inputs = vec![("clicks", Fingerprint::of_bytes(format!("{of:?}").as_bytes()))];
    for (name, path) in files(config) {
        let mut digest = Networks::digest(path)?;
        // what says how a picture is prepared for the network lies beside it
        for sidecar in ["preprocessor_config.json", "../preprocessor_config.json"] {
            let sidecar = path.with_file_name(sidecar);
            if io::is_file(&sidecar) {
                digest += &Networks::digest(&sidecar)?;
            }
        }
        inputs.push((name, digest));
    }
    Ok(Some(Clicks { of, file, inputs }))
}

/// The network files that will be used, by their key in `[mask]`.
pub(super) fn files(config: &MaskConfig) -> Vec<(&'static str, &Path)> {
    let mut files = Vec::new();
    if config.with_sam() {
        files.extend([("sam", config.sam.as_str()), ("sam_decoder", config.sam_decoder.as_str())]);
    }
    if config.with_vitmatte() {
        files.push(("vitmatte", config.vitmatte.as_str()));
    }
    files.into_iter().map(|(name, path)| (name, Path::new(path))).collect()
}

fn grabcut_options(c: &MaskConfig) -> GrabcutOptions {
    GrabcutOptions {
        rows: c.cut_px,
        seed_radius: c.seed_radius,
        border_margin: c.border_margin,
        border_sides: c.border_sides,
        gaussians: c.gaussians,
        smoothness: c.smoothness,
        certainty: c.certainty,
        rounds: c.cut_rounds,
        band: c.band,
        ..GrabcutOptions::default()
    }
}

fn propagate_options(c: &MaskConfig) -> PropagateOptions {
    PropagateOptions {
        cut: grabcut_options(c),
        cells: c.carve_cells,
        outside: c.carve_outside,
        core: c.carve_core,
        most_negative: c.carve_most_negative,
        least_positive: c.carve_least_positive,
        rounds: c.carve_rounds,
        ..PropagateOptions::default()
    }
}

fn soften_options(c: &MaskConfig) -> SoftenOptions {
    let defaults = SoftenOptions::default();
    SoftenOptions {
        side: c.side_px,
        band: match c.kernel {
            0 => Band::Discs { share: c.band },
            kernel => Band::Squares { kernel, iterations: c.iterations },
        },
        closed_form: ClosedFormOptions {
            epsilon: c.epsilon,
            constraint_weight: c.constraint_weight,
            prior_weight: c.prior_weight,
            ..defaults.closed_form
        },
        lowest: c.lowest,
        highest: c.highest,
        ..defaults
    }
}

fn photo(capture: &Capture, view: usize, dir: &StageDir) -> Result<Photo> {
    dir.check_stop()?;
    Ok(capture.views[view].load_photo(&Limits::default())?)
}

/// Masks of all views from clicks on some.
pub(super) fn make_masks(
    capture: &Capture,
    clicks: &Clicks,
    config: &MaskConfig,
    dir: &StageDir,
    keep: &mut dyn FnMut(usize, &Photo, Made) -> Result<()>,
) -> Result<Networks> {
    let networks = Networks::open(config)?;
    // a file that the engine cannot run is refused before the work
    let sizes: std::collections::BTreeSet<_> =
        capture.views.iter().map(|v| (v.camera.width, v.camera.height)).collect();
    let largest = sizes.into_iter().max_by_key(|&(w, h)| u64::from(w) * u64::from(h)).unwrap_or((1, 1));
    networks.prepare(scale::working_size(largest.0, largest.1, config.side_px))?;
    for file in networks.files() {
        dir.note(&file);
    }
    let hard = hard(capture, clicks, config, dir)?;
    let soft = soften_options(config);
    let total = hard.len();
    let at_once = networks.at_once(largest, &soft, config);
    for start in (0..total).step_by(at_once) {
        let made: Vec<Result<(Photo, Made, Vec<String>)>> = (start..(start + at_once).min(total))
            .into_par_iter()
            .map(|i| {
                let photo = photo(capture, i, dir)?;
                let (made, warnings) = alpha(&networks, &photo, &hard[i], &clicks.of[i], &soft)?;
                Ok((photo, made, warnings))
            })
            .collect();
        for (i, made) in (start..).zip(made) {
            let (photo, made, warnings) = made?;
            let name = &capture.views[i].name;
            warnings.iter().for_each(|w| dir.warn(&format!("view `{name}`: {w}")));
            keep(i, &photo, made)?;
        }
        dir.step((start + at_once).min(total), total)?;
    }
    Ok(networks)
}

/// Hard masks of all views.
fn hard(capture: &Capture, clicks: &Clicks, config: &MaskConfig, dir: &StageDir) -> Result<Vec<ViewMask>> {
    let views = &capture.views;
    let masks = if let [view] = &views[..] {
        let found = grabcut(&view.name, &photo(capture, 0, dir)?, &clicks.of[0], &grabcut_options(config));
        let found = found?;
        Masks {
            views: vec![ViewMask { mask: found.mask, ambiguous: found.ambiguous }],
            warnings: found.warnings,
        }
    } else {
        let views: Vec<PropagateView> = views
            .iter()
            .zip(&clicks.of)
            .map(|(v, clicks)| PropagateView {
                name: &v.name,
                camera: &v.camera,
                clicks,
                // held-out photographs shape nothing but their own masks
                votes: v.split == Split::Train,
            })
            .collect();
        let load = |i| photo(capture, i, dir).map_err(Unpropagated::Load);
        propagate(&views, load, &propagate_options(config)).map_err(|e| match e {
            Unpropagated::Load(e) => e,
            Unpropagated::Cut(e) => e.into(),
        })?
    };
    masks.warnings.iter().for_each(|w| dir.warn(w));
    Ok(masks.views)
}

/// One view's alpha.
fn alpha(
    networks: &Networks,
    photo: &Photo,
    hard: &ViewMask,
    clicks: &[Click],
    soft: &SoftenOptions,
) -> Result<(Made, Vec<String>)> {
    let mut warnings = Vec::new();
    let segmented = match networks.has_sam() {
        true => {
            let size = scale::working_size(photo.width, photo.height, soft.side);
            let small = scale::reduce_photo(photo, size);
            let chosen = if clicks.is_empty() {
                propagated_clicks(&hard.mask, size)
            } else {
                clicks.iter().map(|c| c.moved((photo.width, photo.height), size)).collect()
            };
            let (mask, score) = networks.segment(&small, &chosen)?;
            if !mask.values.contains(&255) {
                warnings.push("SAM found nothing of the head; the built-in cut stands in".into());
                None
            } else {
                if score < 0.7 {
                    warnings.push(format!("SAM gives its mask only {score:.2} of 1; look at it"));
                }
                Some(mask)
            }
        }
        false => None,
    };
    let mask = segmented.as_ref().unwrap_or(&hard.mask);
    let failed = |e: crate::mask::matting::AlphaError| {
        let hint = e.hint();
        Error::cannot(e, hint)
    };
    let made = if networks.has_vitmatte() {
        let working = Working::new(photo, mask, soft).map_err(failed)?;
        warnings.extend(working.warnings(soft));
        let mut alpha = networks.alpha(&working.photo, &working.trimap)?;
        // the network takes the trimap for a hint; what is definite stays
        for (a, t) in alpha.iter_mut().zip(&working.trimap.values) {
            match t {
                0 => *a = 0.0,
                255 => *a = 1.0,
                _ => {}
            }
        }
        let share = crate::mask::matting::trimap::unknown_share(&working.trimap);
        Made { alpha: working.finish(&alpha, soft), trimap: working.trimap, unknown: share }
    } else {
        let done = soften(photo, mask, soft).map_err(failed)?;
        warnings.extend(done.warnings);
        Made { alpha: done.alpha, trimap: done.trimap, unknown: done.band_share }
    };
    Ok((made, warnings))
}

/// Why clicks could not be propagated.
enum Unpropagated {
    Load(Error),
    Cut(CutError),
}

impl From<CutError> for Unpropagated {
    fn from(e: CutError) -> Unpropagated {
        Unpropagated::Cut(e)
    }
}

/// Clicks for a view that nobody clicked: the deepest places of the mask that was propagated to it, each outside the
/// disc of those before, and the two places farthest from it.
pub(super) fn propagated_clicks(mask: &Gray, size: (u32, u32)) -> Vec<Click> {
    let (w, h) = (mask.width as usize, mask.height as usize);
    let mut out = Vec::new();
    for (head, count) in [(true, 3), (false, 2)] {
        let outside: Vec<bool> = mask.values.iter().map(|&v| (v >= 128) != head).collect();
        let mut deep = distance::squared_distance(&outside, w, h);
        for _ in 0..count {
            let Some((best, &d)) = deep.iter().enumerate().rev().max_by(|a, b| a.1.total_cmp(b.1)) else {
                break;
            };
            if d <= 1.0 || outside[best] {
                break;
            }
            let (x, y) = (best % w, best / w);
            out.push(Click { x: x as f32, y: y as f32, head }.moved((mask.width, mask.height), size));
            let reach = if d.is_finite() { d } else { (w * w + h * h) as f32 / 16.0 };
            for (i, v) in deep.iter_mut().enumerate() {
                let (dx, dy) = ((i % w).abs_diff(x) as f32, (i / w).abs_diff(y) as f32);
                if dx * dx + dy * dy < reach {
                    *v = 0.0;
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    #[test]
    fn defaults_are_those_of_the_modules() {
        let c = MaskConfig::preset(Preset::Standard);
        let propagate = PropagateOptions::default();
        let cut = &propagate.cut;
        assert_eq!((c.cut_px, c.gaussians, c.smoothness), (cut.rows, cut.gaussians, cut.smoothness));
        assert_eq!((c.certainty, c.cut_rounds, c.seed_radius), (cut.certainty, cut.rounds, cut.seed_radius));
        assert_eq!((c.border_margin, c.border_sides), (cut.border_margin, cut.border_sides));
        assert_eq!((c.carve_cells, c.carve_rounds), (propagate.cells, propagate.rounds));
        assert_eq!((c.carve_outside, c.carve_core), (propagate.outside, propagate.core));
        assert_eq!(
            (c.carve_most_negative, c.carve_least_positive),
            (propagate.most_negative, propagate.least_positive)
        );
        let soften = SoftenOptions::default();
        assert_eq!((c.side_px, c.lowest, c.highest), (soften.side, soften.lowest, soften.highest));
        let closed = &soften.closed_form;
        assert_eq!(
            (c.epsilon, c.constraint_weight, c.prior_weight),
            (closed.epsilon, closed.constraint_weight, closed.prior_weight)
        );
    }

    #[test]
    fn propagated_clicks_lie_deep_inside_and_far_outside() {
        // a disc of radius 20 around (40, 50) in 100 × 80, seen at twice the size
        let inside = |x: u32, y: u32| (x as i32 - 40).pow(2) + (y as i32 - 50).pow(2) <= 400;
        let values = (0..8000).map(|i| if inside(i % 100, i / 100) { 255 } else { 0 }).collect();
        let mask = Gray { width: 100, height: 80, values };
        let clicks = propagated_clicks(&mask, (200, 160));
        assert!(clicks.len() >= 3, "{clicks:?}");
        for click in &clicks {
            let (x, y) = (((click.x + 0.5) / 2.0 - 0.5) as u32, ((click.y + 0.5) / 2.0 - 0.5) as u32);
            assert_eq!(inside(x, y), click.head, "{click:?}");
        }
        assert!((clicks[0].x - 80.5).abs() <= 2.0 && (clicks[0].y - 100.5).abs() <= 2.0, "{clicks:?}");
        assert_eq!(clicks.iter().filter(|c| !c.head).count(), 2);
    }

    #[test]
    fn an_empty_mask_carries_no_click_on_the_head() {
        let mask = Gray { width: 10, height: 10, values: vec![0; 100] };
        assert!(propagated_clicks(&mask, (10, 10)).iter().all(|c| !c.head));
    }
}
