//! Masks from clicks: the clicked views are cut, propagated to every other view, and matted.
//! Without clicks, a network's proposals for each view replace them, as far as the views agree.
//!
//! ```text
//! clicks → cut (GrabCut, or SAM) ─┬─ propagated through the cameras
//! proposals → those that agree ───┘    → band → matting (closed form, ViTMatte) → alpha
//! ```

use crate::config::{MaskConfig, key};
use crate::mask::Click;
use crate::mask::distance::squared_distance;
use crate::mask::grabcut::grabcut;
use crate::mask::matting::{SoftMask, SoftenOptions, UnknownBand, soften_with};
use crate::mask::networks::Networks;
use crate::mask::prompts::{self, PhotoPrompts, Prompts};
use crate::mask::propagate::{PropagateView, propagate, propagate_proposals, rows_size};
use crate::run::StageDir;
use rayon::prelude::*;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;
use tiface_base::image::{Gray, Photo, reduce_photo, working_size};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Fingerprint, Result};
use tiface_capture::{Capture, Split};

/// Memory that photographs processed in parallel may take without networks, bytes.
const MAX_BYTES: u64 = 3 << 29;

/// The input of mask making: clicks, or none if a network proposes masks.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct MaskPrompts {
    /// Clicks of each view, in pixels of its camera.
    pub clicks: Vec<Vec<Click>>,
    /// The file that they were read from, byte for byte; empty without one.
    pub file: Vec<u8>,
    /// Inputs of the masks beside the settings: digests of clicks and network files.
    pub inputs: Vec<(&'static str, String)>,
}

/// Keys of `inputs` whose values are digests of files.
const INPUTS: [&str; 5] = ["clicks", "sam", "sam_decoder", "vitmatte", "alpha_net"];

impl MaskPrompts {
    /// Reads the prompts of a configuration and checks them against the capture; `None` if no masks
    /// are made.
    ///
    /// `kept` is the run's copy of the clicks, which is used if the original file was removed.
    pub fn open(config: &MaskConfig, capture: &Capture, kept: &Path) -> Result<Option<MaskPrompts>> {
        if !config.makes_masks() {
            return Ok(None);
        }
        let mut file = Vec::new();
        let clicks = if config.with_alpha_net() {
            vec![Vec::new(); capture.views.len()]
        } else if config.prompts.is_empty() {
            let points = config.point.iter().map(|p| prompts::parse_point(p)).collect::<Result<_>>()?;
            let view = match config.view.as_str() {
                "" => capture.views.iter().find(|v| v.split == Split::Train).or(capture.views.first()),
                name => capture.views.iter().find(|v| v.name == name),
            };
            let view = view.ok_or_else(|| {
                Error::cannot(
                    format!("there is no view `{}`", config.view),
                    "`tiface inspect CAPTURE --json` lists them; names have no ending",
                )
            })?;
            let frame = PhotoPrompts { file_path: prompts::file_path(capture, view), points };
            Prompts { frames: vec![frame] }.clicks(key!(mask.point), capture)?
        } else {
            let named = Path::new(&config.prompts);
            let path = if !io::is_file(named) && io::is_file(kept) { kept } else { named };
            file = io::read_bytes(path, &Limits::default())?;
            let prompts = prompts::parse_prompts(path, &file, &Limits::default())?;
            prompts.clicks(&path.to_string_lossy(), capture)?
        };
        if config.clicked() && clicks.iter().all(Vec::is_empty) {
            return Err(Error::cannot(
                format!("`{}` holds no click on a photograph of this capture", config.prompts),
                "click on a few photographs: `tiface mask CAPTURE --page`",
            ));
        }
        let mut inputs = Vec::new();
        if config.clicked() {
            inputs.push(("clicks", Fingerprint::of_bytes(format!("{clicks:?}").as_bytes())));
        }
        for (name, path) in network_files(config) {
            let mut digest = digest(path)?;
            // the settings that prepare a picture for the network lie beside it
            for sidecar in ["preprocessor_config.json", "../preprocessor_config.json"] {
                let sidecar = path.with_file_name(sidecar);
                if io::is_file(&sidecar) {
                    digest += &self::digest(&sidecar)?;
                }
            }
            inputs.push((name, digest));
        }
        Ok(Some(MaskPrompts { clicks, file, inputs }))
    }

    /// Restores the digests of removed clicks from the stage's record.
    pub fn from_inputs(inputs: &BTreeMap<String, String>) -> MaskPrompts {
        let input = |name: &'static str| Some((name, inputs.get(name)?.clone()));
        let inputs = INPUTS.into_iter().filter_map(input).collect();
        MaskPrompts { clicks: Vec::new(), file: Vec::new(), inputs }
    }
}

/// Returns the network files that will be used, by their key in `[mask]`.
fn network_files(config: &MaskConfig) -> impl Iterator<Item = (&'static str, &Path)> {
    let sam = [("sam", &config.sam), ("sam_decoder", &config.sam_decoder)];
    let files = sam.map(|file| config.with_sam().then_some(file)).into_iter();
    let files = files.chain([config.with_vitmatte().then_some(("vitmatte", &config.vitmatte))]);
    let files = files.chain([config.with_alpha_net().then_some(("alpha_net", &config.alpha_net))]);
    files.flatten().map(|(name, path)| (name, Path::new(path)))
}

fn digest(path: &Path) -> Result<String> {
    let limits = Limits { file_bytes: 2 << 30, ..Limits::default() };
    Ok(Fingerprint::of_bytes(&io::read_bytes(path, &limits)?))
}

fn soften_options(config: &MaskConfig) -> SoftenOptions {
    let band = match config.kernel {
        0 => UnknownBand::Discs { share: config.band },
        kernel => UnknownBand::Squares { kernel, iterations: config.iterations },
    };
    SoftenOptions { side: config.side_px, band }
}

/// Returns how many photographs of a size may be processed in parallel.
fn photos_at_once(
    networks: Option<&Networks>,
    (width, height): (u32, u32),
    soft: &SoftenOptions,
    config: &MaskConfig,
) -> usize {
    let threads = rayon::current_num_threads();
    let memory = (config.memory_gib * (1u64 << 30) as f64) as u64;
    // photograph, alpha and equations
    let bytes = soft.memory_bytes(width, height) + 8 * u64::from(width) * u64::from(height);
    let built_in = (memory.min(MAX_BYTES) / bytes.max(1)).clamp(1, threads as u64) as usize;
    let (w, h) = working_size(width, height, soft.side);
    networks.map_or(built_in, |n| n.photos_at_once(w, h, threads).min(built_in))
}

fn photo(capture: &Capture, view: usize, dir: &StageDir) -> Result<Photo> {
    dir.check_stop()?;
    capture.views[view].load_photo(&Limits::default())
}

/// Makes masks of all views from clicks on some, passes them to `keep` in order, and returns a
/// record of the networks that were used.
pub(super) fn make_masks(
    capture: &Capture,
    prompts: &MaskPrompts,
    config: &MaskConfig,
    dir: &StageDir,
    keep: &mut dyn FnMut(usize, &Photo, SoftMask) -> Result<()>,
) -> Result<Value> {
    let networks = Networks::open(config)?;
    let networks = networks.as_ref();
    let sizes = capture.views.iter().map(|v| (v.camera.width, v.camera.height));
    let largest = sizes.max_by_key(|&(w, h)| (u64::from(w) * u64::from(h), w)).unwrap_or((1, 1));
    if let Some(networks) = networks {
        // refuse a file that the engine cannot run before any work
        let (w, h) = working_size(largest.0, largest.1, config.side_px);
        networks.prepare(w, h)?;
        networks.files().iter().for_each(|file| dir.note(&file.to_string()));
    }
    let soft = soften_options(config);
    let at_once = photos_at_once(networks, largest, &soft, config);
    let proposals = match networks.filter(|_| config.with_alpha_net()) {
        Some(networks) => proposals(networks, capture, at_once, dir)?,
        None => Vec::new(),
    };
    let hard = hard_masks(capture, &prompts.clicks, &proposals, dir)?;
    let total = hard.len();
    for start in (0..total).step_by(at_once) {
        let some = start..(start + at_once).min(total);
        let masks: Vec<Result<(Photo, SoftMask)>> = some
            .into_par_iter()
            .map(|i| {
                let photo = photo(capture, i, dir)?;
                let mask = soft_mask(networks, &photo, &hard[i], &prompts.clicks[i], &soft);
                let mask = mask.map_err(|e| e.within(format!("view `{}`", capture.views[i].name)))?;
                Ok((photo, mask))
            })
            .collect();
        for (i, found) in (start..).zip(masks) {
            let (photo, mask) = found?;
            let name = &capture.views[i].name;
            mask.warnings.iter().for_each(|w| dir.warn(&format!("view `{name}`: {w}")));
            keep(i, &photo, mask)?;
        }
        dir.step((start + at_once).min(total), total)?;
    }
    Ok(networks.map_or(json!([]), |n| json!(n.files())))
}

/// Returns the alpha network's proposal for each view, at the size that masks are cut at.
fn proposals(networks: &Networks, capture: &Capture, at_once: usize, dir: &StageDir) -> Result<Vec<Gray>> {
    let mut out = Vec::new();
    while out.len() < capture.views.len() {
        let some = out.len()..(out.len() + at_once).min(capture.views.len());
        let found: Vec<Result<Option<Gray>>> = some
            .into_par_iter()
            .map(|i| {
                let photo = photo(capture, i, dir)?;
                let found = networks.propose(&photo, rows_size(&photo));
                found.map_err(|e| e.within(format!("view `{}`", capture.views[i].name)))
            })
            .collect();
        for found in found {
            out.extend(found?);
        }
        dir.step(out.len() / 2, capture.views.len())?;
    }
    Ok(out)
}

/// Returns hard masks of all views, from clicks or from the proposals for each view.
fn hard_masks(
    capture: &Capture,
    clicks: &[Vec<Click>],
    proposals: &[Gray],
    dir: &StageDir,
) -> Result<Vec<Gray>> {
    let views = &capture.views;
    let (masks, warnings) = if let ([_], [mask]) = (&views[..], proposals) {
        (vec![mask.clone()], vec!["there is one view: nothing says whether the network is right".into()])
    } else if let [view] = &views[..] {
        let found = grabcut(&view.name, &photo(capture, 0, dir)?, &clicks[0])?;
        (vec![found.mask], found.warnings)
    } else {
        let view = |(v, clicks)| {
            let v: &tiface_capture::View = v;
            // held-out photographs affect only their own masks
            PropagateView { name: &v.name, camera: &v.camera, clicks, votes: v.split == Split::Train }
        };
        let views: Vec<PropagateView> =
            views.iter().zip(clicks.iter().map(Vec::as_slice)).map(view).collect();
        let load = |i| photo(capture, i, dir);
        let found = match proposals {
            [] => propagate(&views, load)?,
            some => propagate_proposals(&views, some, load)?,
        };
        found.notes.iter().for_each(|note| dir.note(note));
        (found.masks, found.warnings)
    };
    warnings.iter().for_each(|w| dir.warn(w));
    Ok(masks)
}

/// Computes one view's alpha.
fn soft_mask(
    networks: Option<&Networks>,
    photo: &Photo,
    hard: &Gray,
    clicks: &[Click],
    soft: &SoftenOptions,
) -> Result<SoftMask> {
    let Some(networks) = networks else { return soften_with(photo, hard, soft, |_, _| Ok(None)) };
    let mut warnings = Vec::new();
    let size = working_size(photo.width, photo.height, soft.side);
    let chosen = match clicks {
        [] => propagated_clicks(hard, size),
        own => own.iter().map(|c| c.moved((photo.width, photo.height), size)).collect(),
    };
    let mut mask = hard;
    let segmented = networks.segment(&reduce_photo(photo, size), &chosen)?;
    if let Some((found, score)) = &segmented {
        if !found.values.contains(&255) {
            warnings.push(
                "SAM found nothing of the head; the built-in cut stands in; click more on the head".into(),
            );
        } else {
            mask = found;
            if *score < 0.7 {
                warnings.push(format!(
                    "SAM gives its mask only {score:.2} of 1; look at it in `mask/sheet.html`, and click more"
                ));
            }
        }
    }
    let mut found = soften_with(photo, mask, soft, |photo, trimap| networks.alpha(photo, trimap))?;
    warnings.append(&mut found.warnings);
    Ok(SoftMask { warnings, ..found })
}

/// Places clicks on a view without any: the deepest points of its propagated mask, each outside the
/// disc of those before, and the two points farthest from the mask.
pub(super) fn propagated_clicks(mask: &Gray, size: (u32, u32)) -> Vec<Click> {
    let (w, h) = (mask.width as usize, mask.height as usize);
    let mut out = Vec::new();
    for (head, count) in [(true, 3), (false, 2)] {
        let outside: Vec<bool> = mask.values.iter().map(|&v| (v >= 128) != head).collect();
        let mut deep = squared_distance(&outside, w, h);
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
