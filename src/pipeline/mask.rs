//! Stage `mask`: which pixels are the head, and where the head is in space.

use super::cameras::{CameraCheck, check_cameras};
use super::clicks::{MaskPrompts, make_masks};
use super::exposure::ExposureCheck;
use super::glare;
use super::readings::{Settled, decide_reading};
use super::rig_photos::{NO_SILHOUETTES, RigPhotos};
use super::scene_file;
use crate::config::{CameraPoses, Config, Exposures, Glares, MaskConfig, MaskMeaning, Preset};
use crate::mask::consistency::{ConsistencyView, check_consistency};
use crate::mask::matting::unknown_share;
use crate::mask::pages::{SheetView, page_of, sheet};
use crate::mask::prompts::read_prompts;
use crate::run::{StageDir, taken_for_capture};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use tiface_base::image::{Glare, Gray, Photo, resize_gray, working_size};
use tiface_base::io::{self, Limits, ReadError};
use tiface_base::{Error, Result};
use tiface_capture::inspect::{Inspection, Problem, grouped, inspect};
use tiface_capture::scene::{self, Scene, SceneBox, SceneOptions, in_box};
use tiface_capture::{
    self as capture, Capture, CaptureOptions, MASK_HINT, MaskReading, MaskSurvey, Split, View,
};

/// File name of the contact sheet, in the stage's folder.
pub(super) const SHEET: &str = "sheet.html";

/// File name of the clicks, in the stage's folder: the run keeps a copy because it may outlive the
/// original file.
pub(super) const CLICKS: &str = "prompts.json";

/// File name of how the mask files of the capture are read, in the stage's folder; none where white
/// is the head.
const READING: &str = "reading.json";

/// Longest side of the masks that the head is located with; a hull is coarser still.
const SCENE_MASK_PX: u32 = 1024;

/// Share of a mask that must contradict the other masks before it counts as wrong. Outlines that
/// are off by six of 512 pixels contradict nothing; half a mask, the mask of another view or an
/// empty one reach 0.1 to 1.
const MIN_CONFLICT_SHARE: f64 = 0.1;

/// Maximum number of masks compared with each other.
const MAX_COMPARED: usize = 256;

/// The masks, whether read or made.
#[derive(Default)]
struct CaptureMasks {
    /// One for each view, at a size sufficient to compare them.
    masks: Vec<Option<Gray>>,
    /// The views that have masks, each with its index, for the contact sheet.
    sheet: Vec<(usize, SheetView)>,
    /// How they were made, for the stage's record.
    record: Value,
    /// Contradictions in masks read from the capture.
    refused: Vec<Error>,
    /// How the files of masks read from the capture are read.
    reading: MaskReading,
}

/// Reads the masks beside the photographs, or makes them from clicks. Writes the masks as pictures,
/// a contact sheet, and the box and hull derived from them (`scene.json`).
pub(super) fn mask(
    capture: &Capture,
    prompts: Option<&MaskPrompts>,
    whole: &Config,
    dir: &StageDir,
) -> Result<Value> {
    let config = &whole.mask;
    let wanted = SceneBox::parse(&whole.capture.r#box)?;
    let networks = config.with_sam() && config.with_vitmatte();
    if whole.preset == Preset::Paper && prompts.is_some() && !networks {
        dir.warn(
            "the published masks are SAM's, made soft by ViTMatte; without `mask.sam`, `mask.sam_decoder` and \
             `mask.vitmatte` they are cut and softened by built-in methods",
        );
    }
    let CaptureMasks { masks, sheet, record, refused, reading } = match prompts {
        Some(prompts) => masks_from_clicks(capture, prompts, config, dir)?,
        None => masks_of_capture(capture, config, dir)?,
    };
    write_reading(dir.folder(), &reading)?;
    let mut capture = Cow::Borrowed(capture);
    apply_reading(dir.folder(), &mut capture)?;
    let capture = &*capture;
    let coverage: Vec<f64> = masks.iter().flatten().map(capture::coverage).collect();
    if coverage.is_empty() {
        dir.warn(
            "no head masks (`mask.source`): background is unknown, so everything inside the box is reconstructed; \
             `tiface mask CAPTURE --page` makes masks from clicks",
        );
    }
    let silhouettes = config.meaning == MaskMeaning::Empty;
    let wrong = if silhouettes { refused } else { Vec::new() };
    let compared = silhouettes.then_some(&masks[..]);
    // masks that the stage made only cause warnings: the user reviews them before training
    let refuses = prompts.is_none() && !config.trust;
    let suspicious = review(capture, compared, wrong, sheet, refuses, dir)?;
    // pixels that a mask marks as unknown may still show the head
    let scene = locate_head(capture, masks.into_iter().map(|m| m.filter(|_| silhouettes)), wanted, dir)?;
    scene_file::write_scene(&dir.folder().join("scene.json"), &scene)?;
    let wanted = RigWanted {
        poses: whole.capture.cameras,
        exposures: whole.capture.exposure,
        glare: whole.capture.glare,
    };
    let found = match silhouettes {
        true => RigCheck::measure(capture, &scene, wanted, &Limits::default())?,
        false => RigCheck::left_out(wanted, NO_SILHOUETTES),
    };
    found.require(dir)?;
    let height = scene::height(&scene, capture.up);
    let doubt = height.and_then(|h| scene::doubtful_height(h, capture.unit_m));
    doubt.iter().for_each(|text| dir.warn(text));
    let covered = coverage.iter().sum::<f64>() / coverage.len().max(1) as f64;
    let mut summary = json!({
        "views": capture.views.len(),
        "masks": coverage.len(),
        "coverage": covered,
        "suspicious": suspicious,
        "made": record,
        "box": scene::world_box(&scene),
        "height_units": height,
        "height_m": height.map(|h| h * capture.unit_m),
    });
    if let Some(check) = &found.cameras {
        summary["cameras"] = check.summary();
    }
    if let Some(check) = &found.exposure {
        summary["exposure"] = check.summary();
    }
    if let Some(glare) = &found.glare {
        summary["glare"] = json!(glare);
    }
    Ok(summary)
}

/// Writes the contact sheet, and compares masks with each other if they are given; `wrong` are
/// contradictions within masks. Returns the names of suspicious views.
///
/// # Errors
///
/// Fails at a contradiction if `refuses`; it is a warning otherwise.
fn review(
    capture: &Capture,
    masks: Option<&[Option<Gray>]>,
    mut wrong: Vec<Error>,
    mut views: Vec<(usize, SheetView)>,
    refuses: bool,
    dir: &StageDir,
) -> Result<Vec<String>> {
    let (conflicts, compared) = masks.map_or((Vec::new(), 0), |masks| conflicts(capture, masks));
    let (contradicting, warnings) = classify_conflicts(&conflicts, compared);
    wrong.extend(contradicting);
    for (_, view) in views.iter_mut().filter(|(i, _)| conflicts.iter().any(|(view, ..)| view == i)) {
        view.suspicions.push("disagrees with the others".into());
    }
    let views: Vec<SheetView> = views.into_iter().map(|(_, view)| view).collect();
    if !views.is_empty() {
        io::write_atomic(&dir.folder().join(SHEET), sheet(&views)?.as_bytes())?;
    }
    let wrong = grouped(&wrong);
    if let Some(problem) = wrong.first().filter(|_| refuses) {
        return Err(problem.into());
    }
    let told = |problem: &Problem| format!("{problem}; {}", problem.hint);
    wrong.iter().map(told).chain(warnings).for_each(|text| dir.warn(&text));
    Ok(views.into_iter().filter(|v| !v.suspicions.is_empty()).map(|v| v.name).collect())
}

/// What is to be measured of cameras and photographs.
#[derive(Clone, Copy)]
struct RigWanted {
    poses: CameraPoses,
    exposures: Exposures,
    glare: Glares,
}

/// Results of the checks of cameras, exposures and glare.
#[derive(Default)]
struct RigCheck {
    cameras: Option<CameraCheck>,
    exposure: Option<ExposureCheck>,
    glare: Option<Glare>,
    /// Corrections of poses, and of exposures, that were asked for and not made.
    poses_left: Option<String>,
    exposures_left: Option<String>,
}

impl RigCheck {
    /// Returns what is said where nothing can be measured, for this reason.
    fn left_out(wanted: RigWanted, why: &str) -> RigCheck {
        let poses_left = match wanted.poses {
            CameraPoses::Given => None,
            CameraPoses::Auto => Some(format!("poses are not checked: {why}; they are used as given")),
            CameraPoses::Refine => {
                Some(format!("`capture.cameras=refine` refines nothing: {why}; poses are used as given"))
            }
        };
        let exposures_left = (wanted.exposures != Exposures::Given).then(|| not_compared(why));
        RigCheck { poses_left, exposures_left, ..RigCheck::default() }
    }

    /// Measures what is not to be used as given, where it can be measured.
    fn measure(capture: &Capture, scene: &Scene, wanted: RigWanted, limits: &Limits) -> Result<RigCheck> {
        let (cameras, exposure) = (wanted.poses != CameraPoses::Given, wanted.exposures != Exposures::Given);
        let glare = wanted.glare != Glares::Given;
        if !cameras && !exposure && !glare {
            return Ok(RigCheck::default());
        }
        let mut photos = match RigPhotos::load(capture, scene, limits)? {
            Ok(photos) => photos,
            Err(why) => return Ok(RigCheck::left_out(wanted, &why)),
        };
        let glare = if glare { glare::measure(&mut photos) } else { None };
        let cameras = cameras.then(|| check_cameras(&photos, wanted.poses));
        let asked = cameras.as_ref().filter(|_| wanted.poses == CameraPoses::Refine);
        let poses_left = asked.and_then(CameraCheck::not_refined);
        let (exposure, exposures_left) = match exposure.then(|| ExposureCheck::measure(&photos)) {
            None => (None, None),
            Some(Ok(check)) => {
                let left = check.not_measured();
                (Some(check), left)
            }
            Some(Err(why)) => (None, Some(not_compared(&why))),
        };
        Ok(RigCheck { cameras, exposure, glare, poses_left, exposures_left })
    }

    /// Returns the findings about poses, exposures and glare in words, with what a run does about
    /// them and what it does not.
    fn announcements(&self) -> [Option<String>; 3] {
        let both = |found: Option<String>, left: &Option<String>| {
            let parts: Vec<String> = found.into_iter().chain(left.clone()).collect();
            (!parts.is_empty()).then(|| parts.join("; "))
        };
        let (cameras, exposure) = (self.cameras.as_ref(), self.exposure.as_ref());
        [
            both(cameras.map(CameraCheck::announcement), &self.poses_left),
            both(exposure.map(ExposureCheck::announcement), &self.exposures_left),
            self.glare.map(|_| format!("{}; a run takes it out", glare::FOUND)),
        ]
    }

    /// Refuses cameras that can be neither used nor refined, and keeps what was measured.
    fn require(&self, dir: &StageDir) -> Result<()> {
        if let Some(check) = &self.cameras {
            if let Some(problem) = grouped(&check.problems()).first() {
                return Err(problem.into());
            }
            if check.refines() {
                let kept = "`capture.cameras=given` keeps them as they are";
                dir.warn(&format!("{}: refined; {kept}", check.sentence()));
            }
            check.not_fitted().iter().for_each(|text| dir.warn(text));
            check.write(dir.folder())?;
        }
        if let Some(check) = &self.exposure {
            if check.evens_out() {
                let kept = "`capture.exposure=given` keeps them as they are";
                dir.warn(&format!("{}: evened out; {kept}", check.sentence()));
            }
            check.write(dir.folder())?;
        }
        if let Some(glare) = &self.glare {
            let kept = "`capture.glare=given` leaves it";
            dir.warn(&format!("{}: taken out of the training photographs; {kept}", glare::FOUND));
            glare::write(glare, dir.folder())?;
        }
        self.poses_left.iter().chain(&self.exposures_left).for_each(|text| dir.warn(text));
        Ok(())
    }
}

fn not_compared(why: &str) -> String {
    format!("exposures are not compared: {why}; photographs are used as they are")
}

/// Returns the path of a view's mask in the stage's folder.
pub(super) fn mask_file(folder: &Path, view: &str) -> PathBuf {
    folder.join(format!("{view}.png"))
}

fn write_mask(folder: &Path, view: &str, mask: &Gray) -> Result<()> {
    let file = mask_file(folder, view);
    if let Some(folder) = file.parent() {
        io::create_folder(folder)?;
    }
    Ok(io::write_png_gray(&file, mask)?)
}

/// Writes how mask files are read, where it is not as they always were.
fn write_reading(folder: &Path, reading: &MaskReading) -> Result<()> {
    let file = folder.join(READING);
    if *reading == MaskReading::White {
        return Ok(io::remove(&file)?);
    }
    let text = serde_json::to_string_pretty(reading).unwrap_or_default();
    Ok(io::write_atomic(&file, format!("{text}\n").as_bytes())?)
}

/// Lets a capture read its mask files as the stage `mask` found that they are to be read; `folder`
/// is the stage's.
pub(super) fn apply_reading(folder: &Path, capture: &mut Cow<Capture>) -> Result<(), ReadError> {
    let file = folder.join(READING);
    if io::is_file(&file) {
        let reading = io::read_typed(&file, &Limits::default())?;
        capture.to_mut().read_masks_as(&reading);
    }
    Ok(())
}

/// Reads the masks beside the photographs. Their values are known only when all have been read: if
/// these ask for another reading than that of white masks, they are read once more.
fn masks_of_capture(capture: &Capture, config: &MaskConfig, dir: &StageDir) -> Result<CaptureMasks> {
    let (mut out, survey) = read_masks(capture, dir)?;
    out.reading = survey.reading(&config.head, &capture.root)?;
    if capture.views.iter().any(|view| view.mask_reading != out.reading) {
        let mut capture = capture.clone();
        capture.read_masks_as(&out.reading);
        out = CaptureMasks { reading: out.reading, ..read_masks(&capture, dir)?.0 };
    }
    if out.reading != MaskReading::White {
        survey.reasons(&out.reading).iter().for_each(|text| dir.warn(text));
    }
    survey.warnings(&out.reading).iter().for_each(|text| dir.warn(text));
    Ok(out)
}

fn read_masks(capture: &Capture, dir: &StageDir) -> Result<(CaptureMasks, MaskSurvey)> {
    let limits = Limits::default();
    let total = capture.views.len();
    let (mut out, mut survey) = (CaptureMasks::default(), MaskSurvey::default());
    // a few at a time: decoding dominates, and photographs are large
    for (i, views) in capture.views.chunks(8).enumerate() {
        let loaded: Vec<Result<_>> = views
            .par_iter()
            .map(|v| {
                let mut values = None;
                let Some(mask) = v.load_mask_examined(&limits, Some(&mut values))? else { return Ok(None) };
                let photo = v.load_photo(&limits)?;
                let refused = capture::refuse(&v.name, &photo, &mask).err();
                Ok(Some((SheetView::new(&v.name, &photo, &mask, None)?, mask, refused, values)))
            })
            .collect();
        for (k, found) in loaded.into_iter().enumerate() {
            let Some((view, mask, refused, values)) = found? else {
                out.masks.push(None);
                continue;
            };
            views[k].survey(values, Some(&mask), &mut survey);
            out.refused.extend(refused);
            write_mask(dir.folder(), &view.name, &mask)?;
            out.sheet.push((8 * i + k, view));
            out.masks.push(Some(for_placing(&mask)));
        }
        dir.step((8 * (i + 1)).min(total), total)?;
    }
    Ok((out, survey))
}

/// Makes masks from clicks.
fn masks_from_clicks(
    capture: &Capture,
    prompts: &MaskPrompts,
    config: &MaskConfig,
    dir: &StageDir,
) -> Result<CaptureMasks> {
    let mut out = CaptureMasks::default();
    let mut unknown = 0.0;
    let networks = make_masks(capture, prompts, config, dir, &mut |i, photo: &Photo, soft| {
        let name = &capture.views[i].name;
        write_mask(dir.folder(), name, &soft.alpha)?;
        out.sheet.push((i, SheetView::new(name, photo, &soft.alpha, Some(&soft.trimap))?));
        out.masks.push(Some(for_placing(&soft.alpha)));
        unknown += unknown_share(&soft.trimap);
        Ok(())
    })?;
    if !config.prompts.is_empty() {
        io::write_atomic(&dir.folder().join(CLICKS), &prompts.file)?;
    }
    let clicked = prompts.clicks.iter().filter(|c| !c.is_empty()).count();
    out.record = json!({
        "clicked_views": clicked,
        "clicks": prompts.clicks.iter().map(Vec::len).sum::<usize>(),
        "unknown": unknown / out.masks.len().max(1) as f64,
        "networks": networks,
    });
    Ok(out)
}

/// Locates the head from the training views; held-out views do not take part.
fn locate_head(
    capture: &Capture,
    silhouettes: impl Iterator<Item = Option<Gray>>,
    wanted: SceneBox,
    dir: &StageDir,
) -> Result<Scene> {
    let (mut cameras, mut carving, mut names) = (Vec::new(), Vec::new(), Vec::new());
    for (view, mask) in capture.views.iter().zip(silhouettes) {
        if view.split == Split::Train {
            cameras.push(view.camera.clone());
            carving.push(mask);
            names.push(view.name.clone());
        }
    }
    let options =
        SceneOptions { names, focus: capture.focus, up: Some(capture.up), ..SceneOptions::default() };
    let (scene, warnings) = in_box(|| scene::fit(&cameras, &carving, &options), wanted)?;
    warnings.iter().for_each(|w| dir.warn(w));
    Ok(scene)
}

/// A view whose mask contradicts the others: its index, the largest contradicting share, and a
/// message.
type MaskConflict = (usize, f64, String);

/// Returns the views whose masks contradict the others (none if the cameras cannot decide), and how
/// many masks were compared.
fn conflicts(capture: &Capture, masks: &[Option<Gray>]) -> (Vec<MaskConflict>, usize) {
    // if there are very many views, evenly spread ones: the check keeps bits of every cell for each
    let every = capture.views.len().div_ceil(MAX_COMPARED);
    let views: Vec<ConsistencyView> = (capture.views.iter().zip(masks).enumerate())
        .map(|(i, (v, mask))| ConsistencyView {
            name: &v.name,
            camera: &v.camera,
            mask: mask.as_ref().filter(|_| i.is_multiple_of(every)),
        })
        .collect();
    let found = check_consistency(&views).unwrap_or_default();
    let conflicts = found.conflicts.into_iter().map(|d| (d.view, d.too_much.max(d.too_little), d.text));
    // smaller shares are within the accuracy of pixels
    (conflicts.filter(|(_, share, _)| *share >= 0.005).collect(), found.masks)
}

/// Returns the conflicts as messages: errors for wrong masks and warnings for doubtful ones. When
/// most masks conflict, the cause is not a single mask, and one message says so.
fn classify_conflicts(conflicts: &[MaskConflict], compared: usize) -> (Vec<Error>, Vec<String>) {
    let mut found: Vec<(bool, String)> =
        conflicts.iter().map(|(_, share, text)| (*share >= MIN_CONFLICT_SHARE, text.clone())).collect();
    let n = found.len();
    if n > 3 && 2 * n > compared {
        let text = format!(
            "{n} of {compared} masks contradict each other: they, or the cameras, belong to other photographs ({}, and so \
             on)",
            found[0].1
        );
        found = vec![(found.iter().any(|(is_wrong, _)| *is_wrong), text)];
    }
    let (wrong, doubted): (Vec<_>, Vec<_>) = found.into_iter().partition(|(is_wrong, _)| *is_wrong);
    let refused = wrong.into_iter().map(|(_, text)| Error::cannot(text, MASK_HINT));
    (refused.collect(), doubted.into_iter().map(|(_, text)| text).collect())
}

/// Shrinks a mask to a size that is sufficient to locate the head and to compare masks.
fn for_placing(mask: &Gray) -> Gray {
    resize_gray(mask, working_size(mask.width, mask.height, SCENE_MASK_PX))
}

/// Returns the findings of [`inspect`] for a capture, and which of its masks contradict each other.
pub fn inspect_capture(root: &Path, options: &CaptureOptions) -> Inspection {
    // what cannot be opened is inspected all the same
    let settled = capture::open(root, options).ok().map(|capture| decide_reading(capture, options));
    let (settled, refused) = settled.transpose().map_or_else(|e| (None, Some(e)), |settled| (settled, None));
    let reading = settled.as_ref().and_then(|settled| settled.reading);
    let options = &CaptureOptions { reading, ..options.clone() };
    let mut found = inspect(root, options);
    if let Some(e) = taken_for_capture(root) {
        found.problems = grouped(&[e]);
    }
    if let Some(Settled { reason, doubt, .. }) = settled {
        found.reasons.extend(reason);
        found.warnings.extend(doubt);
    }
    found.problems.extend(grouped(refused.as_slice()));
    let rig = RigWanted { poses: options.cameras, exposures: options.exposure, glare: options.glare };
    if options.mask_meaning == MaskMeaning::Ignore {
        let left = RigCheck::left_out(rig, NO_SILHOUETTES);
        [found.fit, found.exposure, found.glare] = left.announcements();
        return found;
    }
    // inputs that cannot be opened or read are already among the problems
    let Ok(mut capture) = capture::open(root, options) else { return found };
    let Some(reading) = &found.mask_reading else { return found };
    capture.read_masks_as(reading);
    let load = |v: &View| Some(for_placing(&v.load_mask(&options.limits).ok().flatten()?));
    let masks: Vec<Option<Gray>> = capture.views.par_iter().map(load).collect();
    let (conflicts, compared) = conflicts(&capture, &masks);
    let (wrong, warnings) = classify_conflicts(&conflicts, compared);
    found.add_refused_masks(&wrong, options);
    found.warnings.extend(warnings);
    // a measurement says something only of cameras whose masks fit together
    if let Some(scene) = found.placed.take().filter(|_| found.is_usable()) {
        match RigCheck::measure(&capture, &scene, rig, &options.limits) {
            Ok(check) => {
                [found.fit, found.exposure, found.glare] = check.announcements();
                found.problems.extend(check.cameras.iter().flat_map(|check| grouped(&check.problems())));
            }
            Err(e) => found.problems.extend(grouped(&[e])),
        }
    }
    found
}

/// Returns an annotation page that shows the existing clicks `prompts`.
pub fn click_page(capture: &Capture, prompts: Option<&Path>) -> Result<String> {
    let limits = Limits::default();
    let prompts = prompts.map(|file| read_prompts(file, &limits)).transpose()?;
    page_of(capture, &prompts.unwrap_or_default(), &limits)
}
