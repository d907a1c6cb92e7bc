//! How a capture is read where its files leave open which photograph belongs to which camera, or
//! how photographs lie.
//!
//! Camera files without names pair rows with photographs by order alone, and a half turn that EXIF
//! asks for fits any size. Each way to read the capture is tried by what is measured of poses
//! anyway ([`tiface_capture::rig`]), on small photographs and by few points: where photographs and
//! cameras belong together, points of the head are found again in many photographs, near to where
//! its camera expects them. The one that fits clearly better is taken; where none does, turns are
//! left alone with a warning, and an order is refused, since nothing good is learned from the
//! photographs of other cameras.

use super::cameras::grouped;
use super::rig_photos::{NO_SILHOUETTES, RigPhotos};
use crate::config::{CameraPoses, MaskMeaning, MaskSource};
use crate::mask::consistency::{ConsistencyView, check_consistency};
use crate::run::taken_for_capture;
use rayon::prelude::*;
use std::path::Path;
use tiface_base::geom::Camera;
use tiface_base::image::{Gray, resize_gray, working_size};
use tiface_base::io::Limits;
use tiface_base::{Error, Result};
use tiface_capture::rig::{self, PoseDecision};
use tiface_capture::scene::{self, SceneOptions};
use tiface_capture::{self as capture, Capture, CaptureOptions, Reading, Split, View, ViewMask, by_number};

/// Longest side of the photographs that are compared, pixels.
const SIDE_PX: u32 = 256;

/// Points that are looked up.
const POINTS: usize = rig::POINTS / 4;

/// Maximum number of training views that are compared.
const MAX_VIEWS: usize = 24;

/// Cells along each axis of the hull.
const HULL_CELLS: usize = 64;

/// The reading that is taken has at least this many times the weight of all others. Photographs in
/// a wrong order reach a fifth of that of the right one, and those of neighbors on a ring, whose
/// own turn explains most of it, a third.
const CLEARLY: f64 = 2.0;

/// Masks that contradict each other less than this, in whole masks, cannot be told to be wrong;
/// right ones do by nothing.
const LEAST_CONFLICT: f64 = 0.01;

/// Where masks alone say which photograph belongs to which camera, those of the other order
/// contradict each other by so much at least, a third of what is usual …
const SURE_CONFLICT: f64 = 0.05;

/// … and this many times as much.
const SURELY: f64 = 4.0;

/// Sightings that a reading needs to be taken.
const LEAST_SIGHTINGS: usize = 150;

/// Largest distance of sightings from their points, once poses are adjusted, pixels.
const MOST_PX: f64 = 1.0;

/// Distances below this are alike, pixels.
const LEAST_PX: f64 = 0.5;

/// Names that show an order.
const SHOWN: usize = 4;

/// A capture whose open questions are decided, as far as they can be.
pub(super) struct Settled {
    pub capture: Capture,
    /// The reading that was decided on.
    pub reading: Option<Reading>,
    /// The decision and its reason; one of the capture's reasons.
    pub reason: Option<String>,
    /// The open question, if the work goes on without an answer; one of the capture's warnings.
    pub doubt: Option<String>,
}

impl Settled {
    /// Returns a capture as it was opened.
    fn left(capture: Capture) -> Settled {
        Settled { capture, reading: None, reason: None, doubt: None }
    }
}

/// Opens a capture as [`capture::open`] does, and decides by its photographs what its files leave
/// open.
pub fn open_capture(root: &Path, options: &CaptureOptions) -> Result<Capture> {
    let opened = capture::open(root, options).map_err(|e| taken_for_capture(root).unwrap_or(e));
    Ok(decide_reading(opened?, options)?.capture)
}

/// Decides how a capture is read that was opened with these options.
///
/// # Errors
///
/// Nothing decides which photograph belongs to which camera, and poses are not to be used as given.
pub(super) fn decide_reading(capture: Capture, options: &CaptureOptions) -> Result<Settled> {
    if capture.readings.is_empty() {
        return Ok(Settled::left(capture));
    }
    let (reading, reason) = match decide(&capture, options) {
        Ok(decided) => decided,
        Err(why) => return left_open(capture, options, &why),
    };
    let options = CaptureOptions { reading: Some(reading), ..options.clone() };
    let mut capture = capture::open(&capture.root, &options)?;
    capture.reasons.push(reason.clone());
    Ok(Settled { capture, reading: Some(reading), reason: Some(reason), doubt: None })
}

/// Returns a capture as its files order it, with a doubt that says why nothing was decided, or
/// refuses it.
fn left_open(mut capture: Capture, options: &CaptureOptions, why: &str) -> Result<Settled> {
    let photographs = capture.readings.iter().any(|reading| reading.by_number);
    if !photographs && !capture.readings.iter().any(|reading| reading.masks_by_number) {
        return Ok(Settled::left(capture)); // a warning of the capture says so
    }
    let paired = if photographs { "photographs with cameras" } else { "masks with photographs" };
    let names: Vec<String> = capture.views.iter().map(|view| view.name.clone()).collect();
    let [named, numbered] = [first(&names), first(&by_number(&names))];
    if options.cameras == CameraPoses::Given || is_without_masks(&capture, options) {
        let orders =
            if photographs { format!(": {named}, not by number: {numbered}") } else { String::new() };
        let doubt = format!(
            "nothing but name order pairs {paired}{orders}; nothing shows that it is right ({why}): if they follow each \
             other by number, give their names leading zeros"
        );
        capture.warnings.push(doubt.clone());
        return Ok(Settled { doubt: Some(doubt), ..Settled::left(capture) });
    }
    let orders = match photographs {
        true => format!(": {named} or, by number, {numbered}"),
        false => ", by name or by number".into(),
    };
    let problem = format!(
        "`{}`: nothing but their order pairs {paired}, and nothing shows which order is meant{orders}; {why}",
        capture.root.display()
    );
    let hint = "rename the photographs, and masks likewise, with leading zeros in the order of the cameras (`000`, `001`, \
                `002`, …), so that both orders are one; as long as nothing shows another order, \
                `--set capture.cameras=given` keeps that of the names";
    Err(Error::cannot(problem, hint))
}

/// Returns whether a capture has no masks that an order could be measured with, and none are
/// wanted.
fn is_without_masks(capture: &Capture, options: &CaptureOptions) -> bool {
    let with_masks = CaptureOptions { masks: MaskSource::Auto, ..options.clone() };
    let has_masks = |capture: Capture| capture.views.iter().any(|view| view.mask != ViewMask::None);
    options.masks == MaskSource::None && !capture::open(&capture.root, &with_masks).is_ok_and(has_masks)
}

/// Returns the first names of an order.
fn first(names: &[String]) -> String {
    let shown: Vec<&str> = names.iter().take(SHOWN).map(String::as_str).collect();
    format!("{}{}", shown.join(", "), if names.len() > SHOWN { ", …" } else { "" })
}

/// Measurements of a reading.
#[derive(Clone, Copy, Default)]
struct ReadingFit {
    /// How often points are found again in other photographs.
    sightings: usize,
    /// Sightings for each pixel by which they miss.
    weight: f64,
    /// Whether these are enough, and fit.
    fits: bool,
}

/// Decides on the reading of a capture that was opened with these options. Returns it with what was
/// decided and by what, or the reason for which nothing is.
fn decide(capture: &Capture, options: &CaptureOptions) -> Result<(Reading, String), String> {
    if options.mask_meaning == MaskMeaning::Ignore {
        return Err(NO_SILHOUETTES.into());
    }
    // masks of the capture decide even where others are used
    let masks = match options.masks {
        MaskSource::None | MaskSource::Clicks => MaskSource::Auto,
        source => source,
    };
    let options = CaptureOptions { masks, ..options.clone() };
    let with_masks = capture::open(&capture.root, &options).map_err(|e| e.to_string())?;
    let (readings, names) = (&with_masks.readings, &with_masks.views);
    let names: Vec<String> = names.iter().map(|view| view.name.clone()).collect();
    let open = |&reading: &Reading| {
        let options = CaptureOptions { reading: Some(reading), ..options.clone() };
        // where another order leads to photographs of another size, there is but one
        Some((reading, capture::open(&capture.root, &options).ok()?))
    };
    let photographs = readings.iter().filter(|r| !r.masks_by_number && !r.masks_turned).filter_map(open);
    let photographs: Vec<(Reading, Capture)> = photographs.collect();
    let (mut reading, mut parts) = match &photographs[..] {
        [(only, _)] => (*only, Vec::new()),
        all => {
            let found = |(reading, capture): &(Reading, Capture)| {
                Ok((*reading, ReadingFit::measure(capture.clone(), &options.limits)?))
            };
            let found = all.iter().map(found).collect::<Result<Vec<_>, String>>()?;
            match clearest(&found) {
                Ok(best) => (best, reasons(best, &found, &names)),
                Err(why) => by_silhouettes(all, &options.limits, &names).ok_or(why)?,
            }
        }
    };
    let same = |r: &&Reading| (r.by_number, r.turned) == (reading.by_number, reading.turned);
    let masks: Vec<(Reading, Capture)> = readings.iter().filter(same).filter_map(open).collect();
    if masks.len() > 1 {
        let conflicts = conflicts(&masks, &options.limits).map_err(|e| e.to_string())?;
        let part;
        (reading, part) = masks_that_agree(reading, &conflicts)?;
        parts.extend(part);
    }
    if parts.is_empty() {
        parts.push("the sizes of photographs fit their cameras in one order alone".into());
    }
    Ok((reading, parts.join("; ")))
}

/// Returns the reading that fits, and clearly better than all others.
fn clearest(all: &[(Reading, ReadingFit)]) -> Result<Reading, String> {
    let best = all.iter().max_by(|a, b| a.1.weight.total_cmp(&b.1.weight));
    let is_clear = |(best, found): &&(Reading, ReadingFit)| {
        let is_worse = |(other, theirs): &(Reading, ReadingFit)| {
            found.weight >= CLEARLY * theirs.weight || other == best
        };
        found.fits && all.iter().all(is_worse)
    };
    best.filter(is_clear).map(|(reading, _)| *reading).ok_or_else(|| {
        let counts: Vec<String> = all.iter().map(|(_, found)| grouped(found.sightings)).collect();
        format!("points of the head are found again {} times, which does not decide it", counts.join(" and "))
    })
}

/// Returns what is said of the reading of photographs that was decided on.
fn reasons(best: Reading, all: &[(Reading, ReadingFit)], names: &[String]) -> Vec<String> {
    // how often points are found again by a reading, and by the best one that differs in this
    let against = |differs: fn(&Reading) -> bool| {
        let others = all.iter().filter(|(other, _)| differs(other) != differs(&best));
        let (_, other) = others.max_by(|a, b| a.1.weight.total_cmp(&b.1.weight))?;
        let (_, own) = all.iter().find(|(own, _)| *own == best)?;
        Some((grouped(own.sightings), grouped(other.sightings)))
    };
    let order = against(|r| r.by_number).map(|(own, other)| match best.by_number {
        true => format!(
            "photographs are paired with cameras by number, {}: so {own} points are found again, in name order {other}",
            first(&by_number(names))
        ),
        false => format!(
            "photographs are paired with cameras in name order, {}: so {own} points are found again, by number {other}",
            first(names)
        ),
    });
    let turn = against(|r| r.turned).map(|(own, other)| match best.turned {
        true => format!(
            "photographs are turned as EXIF asks: so {own} points are found again, as stored {other}"
        ),
        false => format!(
            "photographs are used as stored, not turned as EXIF asks: so {own} points are found again, turned {other}"
        ),
    });
    order.into_iter().chain(turn).collect()
}

/// Returns the reading whose masks contradict each other clearly less than by all others, and what
/// is said of it. Where none does, masks that need not be paired stay as they are stored:
/// `photographs` is the reading without turned masks.
fn masks_that_agree(
    photographs: Reading,
    all: &[(Reading, f64)],
) -> Result<(Reading, Option<String>), String> {
    let Some((best, least, others)) = agreeing(all, LEAST_CONFLICT, CLEARLY) else {
        let is_paired = all.iter().any(|(reading, _)| reading.masks_by_number);
        return match is_paired {
            true => Err("masks contradict each other about as much in both orders".into()),
            false => Ok((photographs, None)),
        };
    };
    let mut parts = Vec::new();
    if all.iter().any(|(other, _)| other.masks_by_number != best.masks_by_number) {
        let order = if best.masks_by_number { "by number" } else { "in name order" };
        parts.push(format!("masks are paired with photographs {order}"));
    }
    if all.iter().any(|(other, _)| other.masks_turned != best.masks_turned) {
        let turned =
            if best.masks_turned { "turned as EXIF asks of their photographs" } else { "used as stored" };
        parts.push(format!("masks are {turned}"));
    }
    let parts = parts.join(" and ");
    Ok((best, Some(format!("{parts}: so they contradict each other by {least} of a mask, else by {others}"))))
}

/// Returns the reading whose masks contradict each other the least, if those of all others do at
/// least so much and so many times as much, and how much both do, in words.
fn agreeing(all: &[(Reading, f64)], least: f64, times: f64) -> Option<(Reading, String, String)> {
    let mut sorted = all.to_vec();
    sorted.sort_by(|a, b| a.1.total_cmp(&b.1));
    let &[(best, own), (_, other), ..] = &sorted[..] else { return None };
    let percent = |conflict: f64| format!("{:.1} %", 100.0 * conflict);
    (other >= least.max(times * own)).then(|| (best, percent(own), percent(other)))
}

/// Decides on the order of photographs whose heads are too smooth for points to be found again, if
/// only that is open: masks move along with their photographs, and those of other cameras
/// contradict each other. Returns what is said of it as well.
fn by_silhouettes(
    all: &[(Reading, Capture)],
    limits: &Limits,
    names: &[String],
) -> Option<(Reading, Vec<String>)> {
    if all.iter().any(|(reading, _)| reading.turned) {
        return None;
    }
    let conflicts = conflicts(all, limits).ok()?;
    let (best, own, other) = agreeing(&conflicts, SURE_CONFLICT, SURELY)?;
    let (order, shown) = match best.by_number {
        true => ("by number", first(&by_number(names))),
        false => ("in name order", first(names)),
    };
    let reason = format!(
        "photographs are paired with cameras {order}, {shown}: so their masks contradict each other by {own} of a mask, \
         in the other order by {other}"
    );
    Some((best, vec![reason]))
}

/// Returns how much the masks of each reading contradict each other.
fn conflicts(all: &[(Reading, Capture)], limits: &Limits) -> Result<Vec<(Reading, f64)>> {
    all.iter().map(|(reading, capture)| Ok((*reading, conflict(capture, limits)?))).collect()
}

/// Returns how much the masks of a capture contradict each other, in whole masks.
fn conflict(capture: &Capture, limits: &Limits) -> Result<f64> {
    let every = capture.views.len().div_ceil(MAX_VIEWS).max(1);
    let views: Vec<View> = capture.views.iter().step_by(every).cloned().collect();
    let masks = small_masks(&views, limits)?;
    let shown = views.iter().zip(&masks).map(|(view, mask)| ConsistencyView {
        name: &view.name,
        camera: &view.camera,
        mask: mask.as_ref(),
    });
    let found = check_consistency(&shown.collect::<Vec<_>>())?;
    let named: f64 = found.conflicts.iter().map(|c| c.too_much.max(c.too_little)).sum();
    Ok(named + found.left)
}

/// Reads masks, reduced as the photographs are.
fn small_masks(views: &[View], limits: &Limits) -> Result<Vec<Option<Gray>>> {
    let small = |mask: Gray| resize_gray(&mask, working_size(mask.width, mask.height, SIDE_PX));
    views.par_iter().map(|view| Ok(view.load_mask(limits)?.map(small))).collect()
}

impl ReadingFit {
    /// Measures the training views of a capture. Returns the reason instead if that is not
    /// possible.
    fn measure(mut capture: Capture, limits: &Limits) -> Result<ReadingFit, String> {
        let said = |e: Error| e.to_string();
        capture.views.retain(|view| view.split == Split::Train);
        let every = capture.views.len().div_ceil(MAX_VIEWS).max(1);
        capture.views = capture.views.into_iter().step_by(every).collect();
        let masks = small_masks(&capture.views, limits).map_err(said)?;
        let cameras: Vec<Camera> = capture.views.iter().map(|view| view.camera.clone()).collect();
        let placing = SceneOptions {
            resolution: HULL_CELLS,
            focus: capture.focus,
            up: Some(capture.up),
            ..SceneOptions::default()
        };
        // silhouettes that have nothing in common belong to other cameras
        let Ok((scene, _)) = scene::fit(&cameras, &masks, &placing) else { return Ok(ReadingFit::default()) };
        let photos = RigPhotos::load_at(SIDE_PX, &capture, &scene, limits).map_err(said)??;
        let (_, rig) = photos.measure(POINTS, false);
        let sightings: usize = rig.cameras.iter().map(|camera| camera.sightings).sum();
        let fits =
            sightings >= LEAST_SIGHTINGS && rig.adjusted_px <= MOST_PX && rig.verdict != PoseDecision::Apart;
        Ok(ReadingFit { sightings, weight: sightings as f64 / rig.given_px.max(LEAST_PX), fits })
    }
}
