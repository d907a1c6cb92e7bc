//! How a capture is read where its files leave open which photograph belongs to which camera, or how photographs lie.
//!
//! Camera files without names pair rows with photographs by order alone, and a half turn that EXIF asks for fits any size. Each
//! way to read the capture is tried by what is measured of poses anyway ([`crate::rig`]), on small photographs and by few
//! points: where photographs and cameras belong together, points of the head are found again in many photographs, near to where
//! its camera expects them. The one that fits clearly better is taken; where none does, turns are left alone with a
//! warning, and an order is refused, since nothing good is learned from the photographs of other cameras.

use super::cameras::grouped;
use super::rig_photos::{NO_SILHOUETTES, RigPhotos};
use crate::capture::scene::{self, SceneOptions};
use crate::capture::{self, Capture, CaptureOptions, Reading, Split, View, by_number};
use crate::config::{CameraPoses, MaskMeaning, MaskSource};
use crate::geom::Camera;
use crate::image::{Gray, resize_gray, working_size};
use crate::rig::{self, Verdict};
use crate::{Error, Result};
use rayon::prelude::*;
use std::path::Path;

/// Longest side of the photographs that are compared, pixels.
const SIDE_PX: u32 = 256;

/// Points that are looked up.
const POINTS: usize = rig::POINTS / 4;

/// Maximum number of training views that are compared.
const MAX_VIEWS: usize = 24;

/// Cells along each axis of the hull.
const HULL_CELLS: usize = 64;

/// The reading that is taken has at least so many times the weight of all others. Photographs in a wrong order reach a fifth of
/// that of the right one, and those of neighbors on a ring, whose own turn explains most of it, a third.
const CLEARLY: f64 = 2.0;

/// The same of a reading that differs in its masks alone: these say where points are looked up, not whether they are there.
const CLEARLY_BY_MASKS: f64 = 1.2;

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
    /// What was decided, and by what; one of the capture's reasons.
    pub reason: Option<String>,
    /// What was not decided although the work goes on; one of the capture's warnings.
    pub doubt: Option<String>,
}

impl Settled {
    /// Returns a capture as it was opened.
    fn left(capture: Capture) -> Settled {
        Settled { capture, reading: None, reason: None, doubt: None }
    }
}

/// Opens a capture as [`capture::open`] does, and decides by its photographs what its files leave open.
pub fn open_capture(root: &Path, options: &CaptureOptions) -> Result<Capture> {
    Ok(settle(capture::open(root, options)?, options)?.capture)
}

/// Decides how a capture is read that was opened with these options.
///
/// # Errors
///
/// Nothing decides which photograph belongs to which camera, and poses are not to be used as given.
pub(super) fn settle(capture: Capture, options: &CaptureOptions) -> Result<Settled> {
    if capture.readings.is_empty() {
        return Ok(Settled::left(capture));
    }
    let tried = Tried::all(&capture, options);
    let Some(reading) = tried.as_ref().ok().and_then(Tried::clearest) else {
        let why = tried.map_or_else(|why| why, |tried| tried.undecided());
        return left_open(capture, options, &why);
    };
    let options = CaptureOptions { reading: Some(reading), ..options.clone() };
    let mut capture = capture::open(&capture.root, &options)?;
    let reason = tried.map(|tried| tried.reason(reading, &capture)).ok();
    capture.reasons.extend(reason.clone());
    Ok(Settled { capture, reading: Some(reading), reason, doubt: None })
}

/// Returns a capture as its files order it, with a doubt that says why nothing was decided, or refuses it.
fn left_open(mut capture: Capture, options: &CaptureOptions, why: &str) -> Result<Settled> {
    let photographs = capture.readings.iter().any(|reading| reading.by_number);
    if !photographs && !capture.readings.iter().any(|reading| reading.masks_by_number) {
        return Ok(Settled::left(capture)); // a warning of the capture says so
    }
    let paired = if photographs { "photographs with cameras" } else { "masks with photographs" };
    if options.cameras == CameraPoses::Given {
        let doubt =
            format!("nothing but name order pairs {paired}, and nothing shows that it is right: {why}");
        capture.warnings.push(doubt.clone());
        return Ok(Settled { doubt: Some(doubt), ..Settled::left(capture) });
    }
    let names: Vec<String> = capture.views.iter().map(|view| view.name.clone()).collect();
    let orders = match photographs {
        true => format!(": {} or, by number, {}", first(&names), first(&by_number(&names))),
        false => ", by name or by number".into(),
    };
    let problem = format!(
        "`{}`: nothing but their order pairs {paired}, and nothing shows which order is meant{orders}; {why}",
        capture.root.display()
    );
    let hint = "rename the photographs, and masks likewise, with leading zeros in the order of the cameras (`000`, `001`, \
                `002`, …), so that both orders are one; where the order of the names is known to be right, \
                `--set capture.cameras=given` keeps it";
    Err(Error::cannot(problem, hint))
}

/// Returns the first names of an order.
fn first(names: &[String]) -> String {
    let shown: Vec<&str> = names.iter().take(SHOWN).map(String::as_str).collect();
    format!("{}{}", shown.join(", "), if names.len() > SHOWN { ", …" } else { "" })
}

/// What is found of a reading.
#[derive(Clone, Copy, Default)]
struct Found {
    /// How often points are found again in other photographs.
    sightings: usize,
    /// Sightings for each pixel by which they miss.
    weight: f64,
    /// Whether these are enough, and fit.
    fits: bool,
}

/// The readings that are possible, each with what is found.
struct Tried(Vec<(Reading, Found)>);

impl Tried {
    /// Tries all readings of a capture that was opened with these options. Returns the reason instead if nothing can be
    /// measured.
    fn all(capture: &Capture, options: &CaptureOptions) -> Result<Tried, String> {
        if options.mask_meaning == MaskMeaning::Ignore {
            return Err(NO_SILHOUETTES.into());
        }
        // masks of the capture decide even where others are used
        let masks = match options.masks {
            MaskSource::None | MaskSource::Clicks => MaskSource::Auto,
            source => source,
        };
        let options = CaptureOptions { masks, ..options.clone() };
        let with_masks = capture::open(&capture.root, &options);
        let readings = with_masks.as_ref().map_or(&capture.readings, |with_masks| &with_masks.readings);
        let open = |&reading: &Reading| {
            let options = CaptureOptions { reading: Some(reading), ..options.clone() };
            // where another order leads to photographs of another size, there is but one
            Some((reading, capture::open(&capture.root, &options).ok()?))
        };
        let opened: Vec<(Reading, Capture)> = readings.iter().filter_map(open).collect();
        if let [(only, _)] = opened[..] {
            return Ok(Tried(vec![(only, Found { fits: true, ..Found::default() })]));
        }
        let found = |(reading, capture): (Reading, Capture)| {
            Ok((reading, Found::of(capture, &options).map_err(|why| format!("it is not measured: {why}"))?))
        };
        Ok(Tried(opened.into_iter().map(found).collect::<Result<_, String>>()?))
    }

    /// Returns the reading that fits, and clearly better than all others.
    fn clearest(&self) -> Option<Reading> {
        let (best, found) = self.0.iter().max_by(|a, b| a.1.weight.total_cmp(&b.1.weight))?;
        let is_worse = |(other, theirs): &(Reading, Found)| {
            let same_photographs = (other.by_number, other.turned) == (best.by_number, best.turned);
            let clearly = if same_photographs { CLEARLY_BY_MASKS } else { CLEARLY };
            other == best || found.weight >= clearly * theirs.weight
        };
        (found.fits && self.0.iter().all(is_worse)).then_some(*best)
    }

    /// Returns how many points are found again by a reading, and by the best one that is like it but for what `differs`.
    fn against(&self, reading: Reading, differs: fn(&Reading) -> bool) -> Option<(String, String)> {
        let others = self.0.iter().filter(|(other, _)| differs(other) != differs(&reading));
        let other = others.max_by(|a, b| a.1.weight.total_cmp(&b.1.weight))?;
        let own = self.0.iter().find(|(own, _)| *own == reading)?;
        Some((grouped(own.1.sightings), grouped(other.1.sightings)))
    }

    /// Returns why a capture is read in this way.
    fn reason(&self, reading: Reading, capture: &Capture) -> String {
        let names: Vec<String> = capture.views.iter().map(|view| view.name.clone()).collect();
        let orders = |is_numbered: bool| match is_numbered {
            true => ["by number", "in name order"],
            false => ["in name order", "by number"],
        };
        let mut parts = Vec::new();
        if let Some((own, other)) = self.against(reading, |r| r.by_number) {
            let [order, other_order] = orders(reading.by_number);
            parts.push(format!(
                "photographs are paired with cameras {order}, {}: so {own} points are found again, {other_order} {other}",
                first(&names)
            ));
        } else if let Some((own, other)) = self.against(reading, |r| r.masks_by_number) {
            let [order, other_order] = orders(reading.masks_by_number);
            parts.push(format!(
                "masks are paired with photographs {order}: so {own} points are found again, {other_order} {other}"
            ));
        }
        if let Some((own, other)) = self.against(reading, |r| r.turned) {
            let count = capture.views.iter().filter(|view| view.turn.is_some()).count();
            parts.push(match reading.turned {
                true => format!(
                    "{count} of {} photographs are turned as EXIF asks{}: so {own} points are found again, as stored \
                     {other}",
                    names.len(),
                    if reading.masks_turned { ", and their masks" } else { "" }
                ),
                false => format!(
                    "photographs are used as stored, not turned as EXIF asks: so {own} points are found again, turned \
                     {other}"
                ),
            });
        }
        match parts.is_empty() {
            true => "photographs fit the sizes of their cameras in one order alone".into(),
            false => parts.join("; "),
        }
    }

    /// Returns why nothing is decided.
    fn undecided(&self) -> String {
        let counts: Vec<String> = self.0.iter().map(|(_, found)| grouped(found.sightings)).collect();
        if counts.is_empty() {
            return "with its masks the capture cannot be opened".into();
        }
        format!("points of the head are found again {} times, which does not decide it", counts.join(" and "))
    }
}

impl Found {
    /// Measures the training views of a capture. Returns the reason instead if that is not possible.
    fn of(mut capture: Capture, options: &CaptureOptions) -> Result<Found, String> {
        let limits = &options.limits;
        let said = |e: Error| e.to_string();
        capture.views.retain(|view| view.split == Split::Train);
        let every = capture.views.len().div_ceil(MAX_VIEWS).max(1);
        capture.views = capture.views.into_iter().step_by(every).collect();
        let small = |mask: Gray| resize_gray(&mask, working_size(mask.width, mask.height, SIDE_PX));
        let mask = |view: &View| Ok(view.load_mask(limits)?.map(small));
        let masks = capture.views.par_iter().map(mask).collect::<Result<Vec<_>>>().map_err(said)?;
        let cameras: Vec<Camera> = capture.views.iter().map(|view| view.camera.clone()).collect();
        let placing = SceneOptions {
            resolution: HULL_CELLS,
            focus: capture.focus,
            up: Some(capture.up),
            ..SceneOptions::default()
        };
        // silhouettes that have nothing in common belong to other cameras
        let Ok((scene, _)) = scene::fit(&cameras, &masks, &placing) else { return Ok(Found::default()) };
        let photos = RigPhotos::load_at(SIDE_PX, &capture, &scene, limits).map_err(said)??;
        let (_, rig) = photos.measure(POINTS, false);
        let sightings = rig.cameras.iter().map(|camera| camera.sightings).sum();
        let fits =
            sightings >= LEAST_SIGHTINGS && rig.adjusted_px <= MOST_PX && rig.verdict != Verdict::Apart;
        Ok(Found { sightings, weight: sightings as f64 / rig.given_px.max(LEAST_PX), fits })
    }
}
