//! The report on a capture: format, cameras, masks, splits, and all problems, not only the first.

use super::frame::Agreement;
use super::mask_values::{MaskReading, MaskSurvey};
use super::masks::{self, few};
use super::options::{CaptureOptions, MaskMeaning};
use super::photo_checks::{self, PhotoCheck};
use super::scene::{self, Scene, SceneOptions};
use super::view::{Capture, Split, View, ViewMask};
use super::{gather, mask_checks};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::path::{Path, PathBuf};
use tiface_base::Error;
use tiface_base::geom::Aabb;
use tiface_base::image::Gray;
use tiface_base::math::rank::median;

/// A problem and its suggested fix.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// The problem and its place.
    pub what: String,
    /// Suggested fix.
    pub hint: String,
    /// How many frames or files have it; `what` names the first.
    pub count: usize,
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        if self.count > 1 {
            write!(f, "{} times, the first: ", self.count)?;
        }
        f.write_str(&self.what)
    }
}

impl From<&Problem> for Error {
    fn from(problem: &Problem) -> Error {
        Error::cannot(problem, &problem.hint)
    }
}

/// Groups errors that differ only in the frame, the picture or the numbers that they name.
pub fn grouped(all: &[Error]) -> Vec<Problem> {
    let mut problems: Vec<Problem> = Vec::new();
    let mut first: HashMap<(String, String), usize> = HashMap::new();
    for error in all {
        let (what, hint) = (error.to_string(), error.hint().to_string());
        let same = *first.entry((without_names(&what), without_names(&hint))).or_insert(problems.len());
        match problems.get_mut(same) {
            Some(problem) => problem.count += 1,
            None => problems.push(Problem { what, hint, count: 1 }),
        }
    }
    problems
}

/// Returns a message without its digits and what it quotes as the name of a frame, a view or a file
/// that is no camera file.
fn without_names(message: &str) -> String {
    let mut before = "";
    let mut rest = String::new();
    for (i, part) in message.split('`').enumerate() {
        let is_file = part.contains(['.', '/', '\\']) && !part.ends_with(".json") && !part.ends_with(".npy");
        let is_name = i % 2 == 1 && (before.ends_with("frame ") || before.ends_with("view ") || is_file);
        if !is_name {
            rest.extend(part.chars().filter(|c| !c.is_ascii_digit()));
        }
        before = part;
    }
    rest
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
        let median = median(&mut v, f64::total_cmp)?;
        v.sort_by(f64::total_cmp);
        Some(Range { min: *v.first()?, median, max: *v.last()? })
    }
}

/// Everything [`inspect`] found.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Inspection {
    /// The folder.
    pub root: PathBuf,
    /// The format, if one was recognized.
    pub format: Option<String>,
    /// What the format was recognized by, and what else was found.
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
    /// How high the head is, in dataset units and in meters, where masks say it.
    pub height: Option<[f64; 2]>,
    /// The head's box in the world.
    pub scene: Option<Aabb>,
    /// The same in words.
    pub scene_text: Option<String>,
    /// How well the cameras fit each other, measured on the photographs, and what a run does about
    /// it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fit: Option<String>,
    /// How exposure and white balance differ, and what a run does about it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure: Option<String>,
    /// Whether lamps shed glare on the head, and what a run does about it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub glare: Option<String>,
    /// The head's box and hull.
    #[serde(skip)]
    pub placed: Option<Scene>,
    /// How the mask files are read; `None` if they do not say what is head, or nothing was read.
    #[serde(skip)]
    pub mask_reading: Option<MaskReading>,
    /// What stops the work.
    pub problems: Vec<Problem>,
    /// Warnings, which do not stop the work.
    pub warnings: Vec<String>,
}

impl Inspection {
    /// Returns whether the capture can be used.
    pub fn is_usable(&self) -> bool {
        self.problems.is_empty() && self.format.is_some()
    }

    /// Adds masks that cannot be right: problems, or warnings where masks are trusted all the same.
    pub fn add_refused_masks(&mut self, refused: &[Error], options: &CaptureOptions) {
        let found = grouped(refused);
        if options.trust_masks {
            self.warnings.extend(found.iter().map(Problem::to_string));
        } else {
            self.problems.extend(found);
        }
    }
}

/// Reads everything in a capture, every photograph to its last pixel, and reports; never fails
/// itself.
pub fn inspect(root: &Path, options: &CaptureOptions) -> Inspection {
    let (capture, listing) = gather(root, options);
    let mut out = Inspection {
        root: root.into(),
        format: listing.format.map(str::to_owned),
        reasons: listing.reasons,
        poses: listing.agreements,
        problems: grouped(&listing.problems),
        ..Inspection::default()
    };
    let Some(mut capture) = capture else { return out };
    out.reasons = capture.reasons.clone();
    out.warnings = capture.warnings.clone();
    out.up = Some(capture.up);
    cameras(&capture, &mut out);
    let mut masks = pixels(&mut capture, options, &mut out);
    if options.mask_meaning == MaskMeaning::Ignore {
        masks.fill(None); // what a mask calls "not looked at" may still hold head
    }
    locate_head(&capture, masks, &mut out);
    out.problems.extend(grouped(masks::require_masks(&capture, options).err().as_slice()));
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
            "the lens distortion folds over in the corners of {} views; those pixels are not used: {}",
            folded.len(),
            few(folded)
        ));
    }
}

/// What one view shows.
struct ViewPixels {
    mask: Option<Gray>,
    /// Why the mask is refused, what is suspicious of it, and its coverage.
    judged: Option<(Option<Error>, Vec<&'static str>, f64)>,
    valid_share: Option<f64>,
    photo: PhotoCheck,
}

/// Loads every view, and counts the values of their masks.
fn load_all(capture: &Capture, options: &CaptureOptions) -> (Vec<Result<ViewPixels, Error>>, MaskSurvey) {
    let limits = &options.limits;
    let load = |view: &View| {
        let mut values = None;
        let loaded = view.load_examined(limits, Some(&mut values))?;
        let refused =
            loaded.mask.as_ref().and_then(|m| mask_checks::refuse(&view.name, &loaded.photo, m).err());
        let mask = match (loaded.mask, &view.mask) {
            (None, ViewMask::None) => None,
            (None, _) => view.load_mask(limits)?, // "not looked at": judged all the same
            (mask, _) => mask,
        };
        let judged = mask.as_ref().map(|m| (refused, mask_checks::findings(m), mask_checks::coverage(m)));
        let photo = PhotoCheck::new(&loaded.photo, mask.as_ref());
        let valid_share = loaded.valid.as_ref().map(mask_checks::coverage);
        Ok((ViewPixels { mask, judged, valid_share, photo }, values))
    };
    let (mut all, mut survey) = (Vec::new(), MaskSurvey::default());
    // the values of a few masks at a time: those of noise are many
    for views in capture.views.chunks(64) {
        let loaded: Vec<Result<_, Error>> = views.par_iter().map(load).collect();
        all.extend(views.iter().zip(loaded).map(|(view, loaded)| {
            let (pixels, values) = loaded?;
            view.survey(values, pixels.mask.as_ref(), &mut survey);
            Ok(pixels)
        }));
    }
    (all, survey)
}

/// Loads every view as its mask is to be read; returns the masks at a size that is enough to place
/// the head.
fn pixels(capture: &mut Capture, options: &CaptureOptions, out: &mut Inspection) -> Vec<Option<Gray>> {
    let (mut loaded, survey) = load_all(capture, options);
    match survey.reading(&options.head, &capture.root) {
        Ok(reading) => {
            if capture.views.iter().any(|view| view.mask_reading != reading) {
                capture.read_masks_as(&reading);
                loaded = load_all(capture, options).0;
            }
            out.reasons.extend(survey.reasons(&reading));
            out.warnings.extend(survey.warnings(&reading));
            out.mask_reading = Some(reading);
        }
        // whatever else they look like is no news
        Err(problem) => out.problems.extend(grouped(&[problem])),
    }
    let is_read = out.mask_reading.is_some();
    let mut kinds: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    let (mut unreadable, mut all_refused) = (Vec::new(), Vec::new());
    let (mut all, mut covered, mut usable, mut photos) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for (view, loaded) in capture.views.iter().zip(loaded) {
        match loaded {
            Ok(ViewPixels { mask, judged, valid_share, photo }) => {
                photos.push((view.name.as_str(), photo));
                if let Some((refused, findings, coverage)) = judged {
                    let findings = findings.into_iter().filter(|_| refused.is_none() && is_read);
                    findings.for_each(|f| kinds.entry(f).or_default().push(&view.name));
                    all_refused.extend(refused.filter(|_| is_read));
                    covered.push(coverage);
                }
                usable.extend(valid_share);
                all.push(mask.filter(|_| is_read));
            }
            Err(e) => {
                unreadable.push(e);
                all.push(None);
            }
        }
    }
    out.problems.extend(grouped(&unreadable));
    out.add_refused_masks(&all_refused, options);
    for (finding, views) in kinds {
        let (n, list) = (views.len(), few(views));
        out.warnings.push(format!("the mask {finding} in {n} views: {list}"));
    }
    out.warnings.extend(photo_checks::findings(&photos));
    out.masks = covered.len();
    out.coverage = Range::of(covered.into_iter());
    out.valid = usable.len();
    out.valid_share = Range::of(usable.into_iter());
    out.regions = capture.views.iter().filter(|v| v.region.is_some()).count();
    all
}

/// Places the head from the views that are learned from.
fn locate_head(capture: &Capture, masks: Vec<Option<Gray>>, out: &mut Inspection) {
    let train = capture.views.iter().zip(masks).filter(|(view, _)| view.split == Split::Train);
    let (views, masks): (Vec<&View>, Vec<Option<Gray>>) = train.unzip();
    let cameras: Vec<_> = views.iter().map(|v| v.camera.clone()).collect();
    let names = views.iter().map(|v| v.name.clone()).collect();
    let options =
        SceneOptions { names, focus: capture.focus, up: Some(capture.up), ..SceneOptions::default() };
    match scene::fit(&cameras, &masks, &options) {
        Ok((scene, warnings)) => {
            let b = scene::world_box(&scene);
            let middle = b.center().as_dvec3();
            let distance = |c: DVec3| c.distance(middle);
            out.distance = Range::of(capture.views.iter().map(|v| distance(v.camera.position)));
            if let Some(height) = scene::height(&scene, capture.up) {
                out.height = Some([height, height * capture.unit_m]);
                out.warnings.extend(scene::doubtful_height(height, capture.unit_m));
            }
            out.scene_text = Some(scene::describe(&scene));
            out.scene = Some(b);
            out.placed = Some(scene);
            out.warnings.extend(warnings);
        }
        Err(e) => out.problems.extend(grouped(&[e])),
    }
}

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{}", self.root.display())?;
        if let Some(format) = &self.format {
            writeln!(f, "  format    {format}")?;
        }
        for reason in &self.reasons {
            writeln!(f, "            {reason}")?;
        }
        if !self.sizes.is_empty() {
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
        if let Some(text) = &self.fit {
            writeln!(f, "            {text}")?;
        }
        if let Some(up) = self.up {
            writeln!(f, "            up is ({:.3}, {:.3}, {:.3})", up.x, up.y, up.z)?;
        }
        if let Some(text) = &self.exposure {
            writeln!(f, "  exposure  {text}")?;
        }
        if let Some(text) = &self.glare {
            writeln!(f, "  glare     {text}")?;
        }
        let percent = |r: Range| [r.min, r.max, r.median].map(|v| 100.0 * v);
        if let Some([min, max, median]) = self.coverage.map(percent) {
            let n = self.masks;
            write!(f, "  masks     {n} views; they cover {min:.1} % to {max:.1} % of the picture, ")?;
            writeln!(f, "in the middle {median:.1} %")?;
        } else if !self.sizes.is_empty() {
            writeln!(f, "  masks     none")?;
        }
        if let Some([min, max, _]) = self.valid_share.map(percent) {
            let n = self.valid;
            writeln!(f, "  valid     {n} views; {min:.1} % to {max:.1} % of the pixels are usable")?;
        }
        if let Some(text) = &self.scene_text {
            writeln!(f, "  head      {text}")?;
        }
        if let Some([units, meters]) = self.height {
            writeln!(f, "            by the masks {units:.3} units high: {meters:.3} m")?;
        }
        for warning in &self.warnings {
            writeln!(f, "  warning   {warning}")?;
        }
        for problem in &self.problems {
            writeln!(f, "  problem   {problem}\n            hint: {}", problem.hint)?;
        }
        if self.is_usable() {
            writeln!(f, "  result    no problems found")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::options::MaskSource;
    use crate::synthetic::SyntheticOptions;
    use crate::testing::write_capture;

    #[test]
    fn masks_that_say_what_was_not_looked_at_carve_no_head() {
        let dir = tempfile::tempdir().unwrap();
        let options = SyntheticOptions { width: 32, height: 40, train: 8, test: 2, seed: 1 };
        write_capture(dir.path(), &options);
        let scene = |options: CaptureOptions| inspect(dir.path(), &options).scene.unwrap();
        let bare = scene(CaptureOptions { masks: MaskSource::None, ..CaptureOptions::default() });
        let ignore = CaptureOptions { mask_meaning: MaskMeaning::Ignore, ..CaptureOptions::default() };
        assert_eq!(scene(ignore), bare);
        assert_ne!(scene(CaptureOptions::default()), bare);
    }
}
