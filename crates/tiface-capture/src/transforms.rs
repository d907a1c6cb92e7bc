//! `transforms.json` and its split forms: the dialects of NeRF-Blender, instant-ngp, nerfstudio and
//! their descendants.
//!
//! Poses are camera-to-world with OpenGL axes in all of them. Intrinsics may stand at the top or in
//! each frame; a frame's own win. Every key is read, known to change nothing, or named ([`keys`]);
//! `null` counts as absent. Keys of the wrong type are errors, but for some that count as absent as
//! well, as `up` does.

mod agreement;
mod keys;
mod lens;
mod moments;
mod pose;
mod spellings;
mod splits;

pub(super) use lens::camera_like;

use super::folder::{CaptureFolder, in_file, in_frame};
use super::frame::{self, CameraFrame, Listing};
use super::masks::few;
use super::view::Split;
use glam::DVec3;
use keys::KeyLog;
use lens::FrameKeys;
use moments::Moments;
use serde_json::{Map, Value};
use spellings::LensNotes;
use splits::Listed;
use std::path::PathBuf;
use tiface_base::io;
use tiface_base::{Error, Result};

type Object = Map<String, Value>;

/// A mistake of a frame.
#[derive(Debug)]
enum Fault {
    /// Of this frame alone.
    Frame(String),
    /// Of the program that wrote the file: reported once, with the number of frames and a way out.
    File { text: String, hint: String },
    /// An error that names its place.
    Error(Error),
}

impl Fault {
    /// Returns its words, without a way out.
    fn into_text(self) -> String {
        match self {
            Fault::Frame(text) | Fault::File { text, .. } => text,
            Fault::Error(error) => error.to_string(),
        }
    }
}

impl From<String> for Fault {
    fn from(text: String) -> Fault {
        Fault::Frame(text)
    }
}

impl From<Error> for Fault {
    fn from(error: Error) -> Fault {
        Fault::Error(error)
    }
}

/// Keys of a frame's mask, the first of which counts. VHAP's `fg_mask_path` shows the person with
/// shoulders; INSTA's `seg_mask_path` may show labels, which the values tell.
const MASK_KEYS: [&str; 3] = ["mask_path", "fg_mask_path", "seg_mask_path"];

/// What is known only once all files are read.
#[derive(Default)]
struct Together {
    moments: Moments,
    /// Which of [`MASK_KEYS`] named a mask.
    masks: [bool; 3],
}

/// Lists the frames of `files`, in order; everything wrong goes to the listing's problems.
pub(super) fn list(folder: &CaptureFolder, files: &[String], listing: &mut Listing) {
    let files: Vec<&str> = files.iter().map(String::as_str).collect();
    let mut together = Together::default();
    for file in &files {
        if let Err(problem) = list_file(folder, file, &mut together, listing) {
            listing.problems.push(problem);
        }
    }
    together.moments.report(&files, listing);
    listing.masks_named = match together.masks {
        [_, false, false] => listing.masks_named,
        [false, true, false] => "`fg_mask_path` of each frame",
        [false, false, true] => "`seg_mask_path` of each frame",
        _ => "`mask_path`, `fg_mask_path` or `seg_mask_path` of each frame",
    };
}

fn list_file(
    folder: &CaptureFolder,
    file: &str,
    together: &mut Together,
    listing: &mut Listing,
) -> Result<()> {
    let before = listing.problems.len();
    let value = io::read_json(&folder.root.join(file), &folder.options.limits)?;
    let nothing = Object::new();
    let (top, entries) = parts(folder, file, &value, &nothing, listing)?;
    read_top(folder, file, top, entries.len(), listing);
    let mut reading = Reading::new(folder, file, top)?;
    let read: Vec<Result<FrameKeys, Fault>> = entries.iter().map(|entry| reading.keys(entry)).collect();
    let splits = match file.to_ascii_lowercase().as_str() {
        "transforms_train.json" => vec![Listed::In(Some(Split::Train)); entries.len()],
        "transforms_val.json" => vec![Listed::In(Some(Split::Val)); entries.len()],
        "transforms_test.json" => vec![Listed::In(Some(Split::Test)); entries.len()],
        _ => {
            let names: Vec<Option<&str>> =
                entries.iter().zip(&read).map(|(entry, keys)| entry.photograph(keys.as_ref().ok())).collect();
            let has_split = |keys: &Result<FrameKeys, _>| keys.as_ref().is_ok_and(|k| k.split.is_some());
            let settled: Vec<bool> = read.iter().map(has_split).collect();
            splits::assign(file, top, &names, &settled, listing)?
        }
    };
    let mut faults = Faults { file, total: entries.len(), kinds: Vec::new() };
    for ((entry, keys), listed) in entries.iter().zip(read).zip(splits) {
        let Listed::In(split) = listed else { continue };
        match keys.and_then(|keys| reading.frame(entry, &keys, split, listing)) {
            Ok((frame, mask_key)) => {
                if let Some(own) = entry.value.as_object() {
                    together.moments.add(own, (frame.rotation, frame.position));
                }
                mask_key.into_iter().for_each(|k| together.masks[k] = true);
                listing.frames.push(frame);
            }
            Err(fault) => faults.add(&entry.label, fault, listing),
        }
    }
    faults.report(listing);
    let has_failed = listing.problems.len() > before;
    reading.report(has_failed, listing);
    Ok(())
}

/// A frame in its file.
struct Entry<'v> {
    /// Its key, where `frames` is an object.
    key: Option<&'v str>,
    value: &'v Value,
    /// What messages call it.
    label: String,
}

impl<'v> Entry<'v> {
    fn new(i: usize, key: Option<&'v str>, value: &'v Value) -> Entry<'v> {
        let name = value.get("file_path").and_then(Value::as_str).or(key);
        Entry { key, value, label: name.map_or_else(|| format!("#{i}"), str::to_owned) }
    }

    /// Returns the name of its photograph, as far as it is known.
    fn photograph<'a>(&'a self, keys: Option<&'a FrameKeys>) -> Option<&'a str> {
        let written = || self.value.get("file_path").and_then(Value::as_str).or(self.key);
        keys.map(|keys| keys.file_path.as_str()).or_else(written)
    }
}

/// Returns the top of a file and its frames, which may be an object of named ones, or stand alone
/// or with the whole file in a list.
fn parts<'v>(
    folder: &CaptureFolder,
    file: &str,
    value: &'v Value,
    nothing: &'v Object,
    listing: &mut Listing,
) -> Result<(&'v Object, Vec<Entry<'v>>)> {
    let mut say = |text: &str| listing.reasons.push(format!("`{file}` {text}"));
    let is_frame =
        |value: &Value| ["file_path", "transform_matrix"].iter().all(|key| value.get(key).is_some());
    let (top, frames) = match value {
        Value::Object(top) => (top, top.get("frames")),
        Value::Array(list) => match &list[..] {
            [Value::Object(top)] if top.contains_key("frames") => {
                say("has a list around its object, which is read all the same");
                (top, top.get("frames"))
            }
            [first, ..] if is_frame(first) => {
                say("is a list, which is read as its `frames`");
                (nothing, Some(value))
            }
            _ => return Err(in_file(file, "it is not a JSON object", "it must begin with `{`")),
        },
        _ => return Err(in_file(file, "it is not a JSON object", "it must begin with `{`")),
    };
    let count = match frames {
        Some(Value::Array(list)) => list.len(),
        Some(Value::Object(named)) => named.len(),
        _ => {
            let hint = "each entry of `frames` describes one photograph";
            return Err(in_file(file, "it has no list `frames`", hint));
        }
    };
    if count == 0 {
        let hint = "it must describe at least one photograph";
        return Err(in_file(file, "its list `frames` is empty", hint));
    }
    folder.options.limits.check_views(&folder.root.join(file), count)?;
    let entries = match frames {
        Some(Value::Object(named)) => {
            say("has an object of `frames`: its keys are photographs where there is no `file_path`");
            named.iter().enumerate().map(|(i, (key, v))| Entry::new(i, Some(key), v)).collect()
        }
        frames => {
            let list = frames.and_then(Value::as_array).map(Vec::as_slice).unwrap_or_default();
            list.iter().enumerate().map(|(i, v)| Entry::new(i, None, v)).collect()
        }
    };
    Ok((top, entries))
}

/// Reads what the top of a file says besides lenses and splits.
fn read_top(folder: &CaptureFolder, file: &str, top: &Object, frames: usize, listing: &mut Listing) {
    if top.contains_key("applied_transform") || top.contains_key("applied_scale") {
        listing.reasons.push(format!(
            "`{file}` says its world was moved (`applied_transform`): results come out in the moved world"
        ));
    }
    let up = top.get("up").and_then(|up| match io::typed::<Vec<f64>>(up).ok()?.as_slice() {
        &[x, y, z, ..] => DVec3::new(x, y, z).try_normalize(),
        _ => None,
    });
    if up.is_none() && top.get("up").is_some_and(|up| !up.is_null()) {
        listing
            .warnings
            .push(format!("`{file}`: `up` is not a direction of three numbers, and not looked at"));
    }
    listing.up = listing.up.or(up);
    if let Some((name, meters)) = keys::unit_m(top)
        && (folder.options.unit_m / meters - 1.0).abs() > 0.01
    {
        listing.warnings.push(format!(
            "`{file}` counts in {name}, and `capture.unit_m` is {}: set `capture.unit_m = {meters}`",
            folder.options.unit_m
        ));
    }
    if let Some(n) = top.get("n_frames").and_then(Value::as_u64).filter(|n| *n < frames as u64) {
        listing.warnings.push(format!(
            "`{file}` asks instant-ngp to take the first {n} of its {frames} frames (`n_frames`); all are \
             used here"
        ));
    }
}

/// A file that is being read.
struct Reading<'a> {
    folder: &'a CaptureFolder<'a>,
    file: &'a str,
    /// The top as written, and what is read of it for each frame.
    written: &'a Object,
    shared: Object,
    notes: LensNotes,
    log: KeyLog,
    /// Masks by other keys that are missing: the key, and the name.
    missing: Vec<(&'static str, String)>,
}

impl<'a> Reading<'a> {
    fn new(folder: &'a CaptureFolder, file: &'a str, written: &'a Object) -> Result<Reading<'a>> {
        let (mut notes, mut log) = (LensNotes::default(), KeyLog::new());
        log.look(written, "");
        let refused = |text: String| in_file(file, text, lens::OF_ALL);
        let shared = spellings::canonical(written, None, &mut notes).map_err(refused)?;
        Ok(Reading { folder, file, written, shared, notes, log, missing: Vec::new() })
    }

    /// Returns what is read of a frame, its pose and photograph not looked at.
    fn keys(&mut self, entry: &Entry) -> Result<FrameKeys, Fault> {
        let own = entry.value.as_object().ok_or_else(|| "it is not a JSON object".to_string())?;
        self.log.look(own, &entry.label);
        let mut read = spellings::canonical(own, Some(&self.shared), &mut self.notes)?;
        if !read.contains_key("file_path") {
            let key = entry.key.ok_or_else(|| "it has no `file_path`".to_string())?;
            read.insert("file_path".into(), key.into());
        }
        FrameKeys::merged(&self.shared, read)
    }

    /// Returns a frame, and which of [`MASK_KEYS`] named its mask.
    fn frame(
        &mut self,
        entry: &Entry,
        keys: &FrameKeys,
        split: Option<Split>,
        listing: &mut Listing,
    ) -> Result<(CameraFrame, Option<usize>), Fault> {
        let (folder, file) = (self.folder, self.file);
        let own = entry.value.as_object().unwrap_or(self.written);
        let pose = frame::pose(&pose::rows(own)?)?;
        let split = named_split(keys.split.as_deref(), split)?;
        let intrinsics = lens::intrinsics(keys, &mut self.notes).map_err(|text| keys.fault(text))?;
        let photo = folder.photo(file, &keys.file_path)?;
        let is_there = photo.1.is_some();
        if is_there && !intrinsics.has_focal() {
            return Err(lens::no_focal(self.written, own));
        }
        if let Some(size) = intrinsics.size.filter(|_| is_there) {
            intrinsics.camera(size, pose.0, pose.1).map_err(|text| keys.fault(text))?;
        }
        let beside = |name: &String| Ok::<_, Error>(folder.file(&folder.relative(file, name)?));
        let region = keys.face_mask_path.as_ref().map(beside).transpose()?.flatten();
        let mut mask: Option<(usize, PathBuf)> = None;
        if let Some(name) = &keys.mask_path {
            mask = folder.mask(file, name)?.map(|path| (0, path));
            if mask.is_none() && is_there {
                let text = "the mask it names is missing";
                listing.problems.push(in_frame(file, &entry.label, text));
            }
        } else {
            for (k, name) in [(1, &keys.fg_mask_path), (2, &keys.seg_mask_path)] {
                let Some(name) = name.as_ref().filter(|_| mask.is_none()) else { continue };
                match folder.mask(file, name).ok().flatten() {
                    Some(path) => mask = Some((k, path)),
                    None => self.missing.push((MASK_KEYS[k], name.clone())),
                }
            }
        }
        let (mask_key, mask) = mask.unzip();
        let frame = CameraFrame::new(file, &keys.file_path, photo, intrinsics, pose);
        Ok((CameraFrame { split, mask, region, ..frame }, mask_key))
    }

    /// Says how the file was read; what was not, only if all else was.
    fn report(self, has_failed: bool, listing: &mut Listing) {
        let (file, LensNotes { ignored, taken, skipped, doubts, misread }) = (self.file, self.notes);
        let spelled = |(key, of): &(&str, &str)| match spellings::ALIASES.contains(&(key, of)) {
            true => format!("`{key}` as `{of}`"),
            false => format!("`{key}` as {of}"),
        };
        if !taken.is_empty() {
            let all: Vec<String> = taken.iter().map(spelled).collect();
            listing.reasons.push(format!("`{file}` is read with {}", all.join(", ")));
        }
        if !misread.is_empty() {
            let names = few(&misread);
            listing
                .warnings
                .push(format!("`{file}`: of another type than they must be, and not looked at: {names}"));
        }
        listing.warnings.extend(doubts.iter().map(|text| format!("`{file}`: {text}")));
        for model in ignored {
            listing.warnings.push(format!(
                "`{file}` gives distortion for the camera model `{model}`, which has none; it is not used"
            ));
        }
        for key in MASK_KEYS {
            let names: Vec<&str> = self.missing.iter().filter(|m| m.0 == key).map(|m| m.1.as_str()).collect();
            if !names.is_empty() {
                let (n, names) = (names.len(), few(names));
                listing.warnings.push(format!("`{file}`: {n} masks that `{key}` names are missing: {names}"));
            }
        }
        self.log.report(file, skipped, has_failed, listing);
    }
}

/// Mistakes of all frames of a file, one of each kind.
struct Faults<'a> {
    file: &'a str,
    total: usize,
    kinds: Vec<Kind>,
}

/// A [`Fault::File`], with the first frame that has it and how many do.
struct Kind {
    text: String,
    hint: String,
    first: String,
    count: usize,
}

impl Faults<'_> {
    fn add(&mut self, frame: &str, fault: Fault, listing: &mut Listing) {
        match fault {
            Fault::Frame(text) => listing.problems.push(in_frame(self.file, frame, text)),
            Fault::Error(error) => listing.problems.push(error),
            Fault::File { text, hint } => match self.kinds.iter_mut().find(|kind| kind.hint == hint) {
                Some(kind) => kind.count += 1,
                None => self.kinds.push(Kind { text, hint, first: frame.into(), count: 1 }),
            },
        }
    }

    fn report(self, listing: &mut Listing) {
        for Kind { text, hint, first, count } in self.kinds {
            let place = match count {
                1 => format!("`{}`, frame `{first}`", self.file),
                n => format!("`{}`, in {n} of {} frames, the first `{first}`", self.file, self.total),
            };
            listing.problems.push(Error::cannot(text, hint).within(place));
        }
    }
}

/// Returns the split a frame names, else the one it is in otherwise.
fn named_split(name: Option<&str>, otherwise: Option<Split>) -> Result<Option<Split>, String> {
    match name {
        None => Ok(otherwise),
        Some("train") => Ok(Some(Split::Train)),
        Some("val" | "eval" | "validation") => Ok(Some(Split::Val)),
        Some("test") => Ok(Some(Split::Test)),
        Some(other) => Err(format!("its split is `{other}`; known are train, val, test")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_model_without_distortion_is_warned_of_once() {
        use crate::synthetic::SyntheticOptions;
        use crate::testing::write_capture;
        let dir = tempfile::tempdir().unwrap();
        let options = SyntheticOptions { width: 16, height: 20, train: 4, test: 2, seed: 1 };
        write_capture(dir.path(), &options);
        std::fs::remove_file(dir.path().join("transforms_train.json")).unwrap();
        let file = dir.path().join("transforms.json");
        let mut json: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        for (i, frame) in json["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
            frame["k1"] = 0.1.into();
            frame["camera_model"] = ["PINHOLE", "PERSPECTIVE"][i % 2].into();
        }
        std::fs::write(&file, json.to_string()).unwrap();
        let capture = crate::open(dir.path(), &Default::default()).unwrap();
        let warned = capture.warnings.iter().filter(|w| w.contains("it is not used"));
        assert_eq!(warned.count(), 2, "{:?}", capture.warnings);
    }
}
