//! What was found: format, cameras, masks, splits, and every problem there is, not only the first.

use super::llff::Agreement;
use super::scene::{self, SceneOptions};
use super::{Capture, CaptureError, CaptureOptions, MaskSource, Split, View, gather, masks};
use crate::geom::Aabb;
use crate::image::Gray;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::path::{Path, PathBuf};

/// A problem and the way out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// What is wrong, and where.
    pub what: String,
    /// What to do about it.
    pub hint: String,
    /// How many frames or files have it; `what` names the first.
    pub count: usize,
}

/// One entry for all that have the same problem but for the frame or file, and the numbers in it.
fn grouped<'a>(all: impl IntoIterator<Item = &'a CaptureError>) -> Vec<Problem> {
    let mut problems: Vec<Problem> = Vec::new();
    let mut first: HashMap<(String, String), usize> = HashMap::new();
    for problem in all {
        let (what, hint) = (problem.to_string(), problem.hint());
        let subject = problem.subject().filter(|s| !s.is_empty());
        let bare = subject.map_or(what.clone(), |s| what.replace(&s, ""));
        let no_digits = |text: &str| text.replace(|c: char| c.is_ascii_digit(), "");
        match first.get(&(no_digits(&bare), no_digits(&hint))) {
            Some(&i) => problems[i].count += 1,
            None => {
                first.insert((no_digits(&bare), no_digits(&hint)), problems.len());
                problems.push(Problem { what, hint, count: 1 });
            }
        }
    }
    problems
}

/// Least, middle and greatest of some numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Range {
    /// Least.
    pub min: f64,
    /// Middle one.
    pub median: f64,
    /// Greatest.
    pub max: f64,
}

impl Range {
    fn of(values: impl Iterator<Item = f64>) -> Option<Range> {
        let mut v: Vec<f64> = values.collect();
        v.sort_by(f64::total_cmp);
        Some(Range { min: *v.first()?, median: v[v.len() / 2], max: *v.last()? })
    }
}

/// Everything [`inspect`] found.
#[derive(Clone, Debug, Serialize)]
pub struct Inspection {
    /// The folder.
    pub root: PathBuf,
    /// The format, if one was recognised and something can be used.
    pub format: Option<String>,
    /// Why, and what else lies there.
    pub reasons: Vec<String>,
    /// Views to learn from.
    pub train: usize,
    /// Views to watch.
    pub val: usize,
    /// Views held out.
    pub test: usize,
    /// Camera sizes after downscaling, and how many views have each.
    pub sizes: Vec<((u32, u32), usize)>,
    /// Focal length in pixels.
    pub focal_px: Option<Range>,
    /// Distance from the cameras to the middle of the head's box, dataset units.
    pub distance: Option<Range>,
    /// Views with lens distortion.
    pub distorted: usize,
    /// Up in the world.
    pub up: Option<Vec3>,
    /// Views with a head mask.
    pub masks: usize,
    /// Share of the picture the masks cover.
    pub coverage: Option<Range>,
    /// Views with a valid mask.
    pub valid: usize,
    /// Share of usable pixels.
    pub valid_share: Option<Range>,
    /// Views with a region for the metrics.
    pub regions: usize,
    /// How well two pose files agree.
    pub poses: Vec<Agreement>,
    /// The head's box in the world.
    pub scene: Option<Aabb>,
    /// The same in words.
    pub scene_text: Option<String>,
    /// What stops the work.
    pub problems: Vec<Problem>,
    /// What a person should know.
    pub warnings: Vec<String>,
}

impl Inspection {
    /// Can the capture be used?
    pub fn is_sound(&self) -> bool {
        self.problems.is_empty() && self.format.is_some()
    }
}

/// Reads everything in a capture, every photograph to its last pixel, and reports; never fails itself.
pub fn inspect(root: &Path, options: &CaptureOptions) -> Inspection {
    let found = gather(root, options);
    let mut out = Inspection {
        root: root.into(),
        format: None,
        reasons: Vec::new(),
        train: 0,
        val: 0,
        test: 0,
        sizes: Vec::new(),
        focal_px: None,
        distance: None,
        distorted: 0,
        up: None,
        masks: 0,
        coverage: None,
        valid: 0,
        valid_share: None,
        regions: 0,
        poses: found.agreements,
        scene: None,
        scene_text: None,
        problems: grouped(&found.problems),
        warnings: Vec::new(),
    };
    let Some(capture) = found.capture else { return out };
    out.format = Some(capture.format.clone());
    out.reasons = capture.reasons.clone();
    out.warnings = capture.warnings.clone();
    out.up = Some(capture.up);
    cameras(&capture, &mut out);
    let masks = pixels(&capture, options, &mut out);
    place(&capture, masks, &mut out);
    out.problems.extend(grouped(&masks::require_masks(&capture, options).err()));
    out
}

fn cameras(capture: &Capture, out: &mut Inspection) {
    let count = |s: Split| capture.split(s).count();
    (out.train, out.val, out.test) = (count(Split::Train), count(Split::Val), count(Split::Test));
    let mut sizes: BTreeMap<(u32, u32), usize> = BTreeMap::new();
    for v in &capture.views {
        *sizes.entry((v.camera.width, v.camera.height)).or_default() += 1;
    }
    if sizes.len() > 1 {
        out.warnings.push(format!("photographs have {} different sizes", sizes.len()));
    }
    out.sizes = sizes.into_iter().collect();
    let focal = |v: &View| (v.camera.fx * v.camera.fy).sqrt();
    out.focal_px = Range::of(capture.views.iter().map(focal));
    out.distorted = capture.views.iter().filter(|v| !v.camera.distortion.is_none()).count();
    let folds = |v: &&View| {
        let (w, h) = (v.camera.width as f32, v.camera.height as f32);
        [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)]
            .iter()
            .any(|&(x, y)| v.camera.ray(glam::Vec2::new(x, y)).is_none())
    };
    let folded: Vec<&str> = capture.views.iter().filter(folds).map(|v| v.name.as_str()).collect();
    if !folded.is_empty() {
        out.warnings.push(format!(
            "the lens distortion folds over in the corners of {} views, whose pixels there are not used: {}",
            folded.len(),
            masks::few(folded.into_iter())
        ));
    }
}

/// Loads every view; returns the masks at a size that is enough to place the head.
fn pixels(capture: &Capture, options: &CaptureOptions, out: &mut Inspection) -> Vec<Option<Gray>> {
    struct Seen {
        mask: Option<Gray>,
        valid: Option<f64>,
        findings: Vec<&'static str>,
        coverage: Option<f64>,
    }
    let seen: Vec<Result<Seen, _>> = capture
        .views
        .par_iter()
        .map(|view| {
            let loaded = view.load(&options.limits)?;
            let valid = loaded.valid.as_ref().map(masks::coverage);
            let mask = match (loaded.mask, &view.mask) {
                (None, MaskSource::None) => None,
                (None, _) => view.load_mask(&options.limits)?, // "not looked at": judged all the same
                (mask, _) => mask,
            };
            Ok(Seen {
                valid,
                findings: mask.as_ref().map(masks::findings).unwrap_or_default(),
                coverage: mask.as_ref().map(masks::coverage),
                mask,
            })
        })
        .collect::<Vec<Result<Seen, CaptureError>>>();
    let mut kinds: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    let mut unreadable = Vec::new();
    let (mut all, mut covered, mut usable) = (Vec::new(), Vec::new(), Vec::new());
    for (view, seen) in capture.views.iter().zip(seen) {
        match seen {
            Ok(s) => {
                for f in s.findings {
                    kinds.entry(f).or_default().push(&view.name);
                }
                covered.extend(s.coverage);
                usable.extend(s.valid);
                all.push(s.mask);
            }
            Err(e) => {
                unreadable.push(e);
                all.push(None);
            }
        }
    }
    out.problems.extend(grouped(&unreadable));
    for (finding, views) in kinds {
        let (n, list) = (views.len(), masks::few(views.into_iter()));
        out.warnings.push(format!("the mask {finding} in {n} views: {list}"));
    }
    out.masks = covered.len();
    out.coverage = Range::of(covered.into_iter());
    out.valid = usable.len();
    out.valid_share = Range::of(usable.into_iter());
    out.regions = capture.views.iter().filter(|v| v.region.is_some()).count();
    all
}

/// Places the head from the views that are learned from.
fn place(capture: &Capture, masks: Vec<Option<Gray>>, out: &mut Inspection) {
    let (mut cameras, mut some, mut names) = (Vec::new(), Vec::new(), Vec::new());
    for (view, mask) in capture.views.iter().zip(masks) {
        if view.split == Split::Train {
            cameras.push(view.camera.clone());
            names.push(view.name.clone());
            some.push(mask);
        }
    }
    let options = SceneOptions { names, ..SceneOptions::default() };
    match scene::fit(&cameras, &some, &options) {
        Ok((scene, warnings)) => {
            let b = scene::world_box(&scene);
            let middle = b.center().as_dvec3();
            let distance = |c: DVec3| c.distance(middle);
            out.distance = Range::of(capture.views.iter().map(|v| distance(v.camera.position)));
            out.scene_text = Some(scene::describe(&scene));
            out.scene = Some(b);
            out.warnings.extend(warnings);
        }
        Err(e) => out.problems.push(Problem { what: e.to_string(), hint: e.hint().into(), count: 1 }),
    }
}

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{}", self.root.display())?;
        writeln!(f, "  format    {}", self.format.as_deref().unwrap_or("not recognised"))?;
        for reason in &self.reasons {
            writeln!(f, "            {reason}")?;
        }
        if self.format.is_some() {
            writeln!(f, "  views     {} train, {} val, {} test", self.train, self.val, self.test)?;
            for ((w, h), n) in &self.sizes {
                writeln!(f, "            {n} of {w} × {h} pixels")?;
            }
        }
        if let Some(r) = self.focal_px {
            writeln!(f, "  cameras   focal length {:.1} to {:.1} pixels", r.min, r.max)?;
            writeln!(f, "            lens distortion in {} views", self.distorted)?;
        }
        if let Some(r) = self.distance {
            writeln!(f, "            {:.3} to {:.3} units from the head", r.min, r.max)?;
        }
        if let Some(up) = self.up {
            writeln!(f, "            up is ({:.3}, {:.3}, {:.3})", up.x, up.y, up.z)?;
        }
        if let Some(r) = self.coverage {
            writeln!(
                f,
                "  masks     {} views; they cover {:.1} % to {:.1} % of the picture, in the middle {:.1} %",
                self.masks,
                100.0 * r.min,
                100.0 * r.max,
                100.0 * r.median
            )?;
        }
        if self.masks == 0 && self.format.is_some() {
            writeln!(f, "  masks     none")?;
        }
        if let Some(r) = self.valid_share {
            writeln!(
                f,
                "  valid     {} views; {:.1} % to {:.1} % of the pixels are usable",
                self.valid,
                100.0 * r.min,
                100.0 * r.max
            )?;
        }
        if let Some(text) = &self.scene_text {
            writeln!(f, "  head      {text}")?;
        }
        for warning in &self.warnings {
            writeln!(f, "  warning   {warning}")?;
        }
        for Problem { what, hint, count } in &self.problems {
            let times = if *count > 1 { format!("{count} times, the first: ") } else { String::new() };
            writeln!(f, "  problem   {times}{what}\n            hint: {hint}")?;
        }
        if self.is_sound() {
            writeln!(f, "  sound     nothing stands in the way")?;
        }
        Ok(())
    }
}
