//! Photographs and masks that are not where a capture's files say they are: which near ones are
//! read in their place, and what is said of the others.

use super::folder::{CaptureFolder, in_frame};
use super::frame::{CameraFrame, Listing};
use super::near::names::{fold, is_aside, is_common_name, is_number, reduced};
use super::near::{Answer, Kind, NearMatch};
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::io;

/// Number of examples in a sentence.
const EXAMPLES: usize = 2;

/// Results of the search for photographs that were left out.
#[derive(Debug, Default)]
pub(super) struct Missing {
    /// Photographs that several files fit, by name.
    several: Vec<(String, Vec<String>)>,
    /// Photographs that are there in a reduced size: factor and path.
    reduced: Vec<(u32, String)>,
    /// Files that several frames would share.
    shared: Vec<String>,
    /// Photographs whose file lies elsewhere, by name, while others lie where they should.
    elsewhere: Vec<(String, String)>,
}

/// Confirms the near files of a listing, and says so once. A frame loses its file if another one
/// has it as well, and a file in another folder if the folder that is named has photographs of
/// other frames: then it is missing, whatever lies elsewhere.
pub(super) fn confirm_near(folder: &CaptureFolder, listing: &mut Listing) -> Missing {
    let (answers, notes) = folder.search.taken();
    listing.reasons.extend(notes);
    if answers.is_empty() {
        return Missing::default();
    }
    let mut missing = Missing::default();
    let (photos, masks): (Vec<Answer>, Vec<Answer>) =
        answers.into_iter().partition(|answer| answer.kind == Kind::Photograph);
    let is_near = confirm_photographs(folder, listing, &photos, &mut missing);
    confirm_masks(folder, listing, &masks);
    let near = listing.frames.iter().zip(is_near).filter(|(frame, near)| *near && frame.photo.is_some());
    let found = by_path(&photos);
    let (foreign, usual): (Vec<&CameraFrame>, Vec<&CameraFrame>) = near
        .map(|(frame, _)| frame)
        .partition(|frame| is_foreign(&frame.relative, found[frame.relative.as_path()].0));
    let pairs = |frames: Vec<&CameraFrame>| {
        frames.into_iter().map(|frame| (frame.name.clone(), folder.shown(&frame.relative))).collect()
    };
    let (foreign, usual) = (said(pairs(foreign), "photograph"), said(pairs(usual), "photograph"));
    listing.reasons.extend(usual);
    listing.warnings.extend(foreign.map(|text| text + ": these must be the very photographs of the cameras"));
    for answer in photos {
        match answer.found {
            NearMatch::Several(files) => missing.several.push((answer.name, files)),
            NearMatch::Reduced { factor, path } => missing.reduced.push((factor, path)),
            _ => {}
        }
    }
    missing
}

/// Returns for each frame whether its photograph has a near name.
fn confirm_photographs(
    folder: &CaptureFolder,
    listing: &mut Listing,
    answers: &[Answer],
    missing: &mut Missing,
) -> Vec<bool> {
    let found = by_path(answers);
    let mut sought: HashMap<&Path, Vec<&str>> = HashMap::new();
    for answer in answers {
        if let NearMatch::One { path, .. } = &answer.found {
            sought.entry(Path::new(path)).or_default().push(&answer.name);
        }
    }
    // formats look for a frame's photograph by its name alone, or in a folder of photographs
    let is_of = |sought: &str, frame: &CameraFrame| {
        sought.strip_suffix(&frame.name).is_some_and(|base| base.is_empty() || base.ends_with('/'))
    };
    let is_near: Vec<bool> = listing
        .frames
        .iter()
        .map(|f| {
            sought.get(f.relative.as_path()).is_some_and(|names| names.iter().any(|name| is_of(name, f)))
        })
        .collect();
    let mut users: HashMap<PathBuf, HashSet<String>> = HashMap::new();
    let mut homes: HashSet<String> = HashSet::new();
    for (frame, near) in listing.frames.iter().zip(&is_near).filter(|(frame, _)| frame.photo.is_some()) {
        users.entry(frame.relative.clone()).or_default().insert(frame.name.clone());
        let is_elsewhere = *near && found[frame.relative.as_path()].1;
        if !is_elsewhere {
            let parent = frame.relative.parent().unwrap_or(Path::new(""));
            homes.insert(fold(&folder.shown(parent).replace('\\', "/")));
        }
    }
    // where one name fits several files, no other name of its folder is sure
    let doubtful = answers.iter().filter(|answer| matches!(answer.found, NearMatch::Several(_)));
    homes.extend(doubtful.map(|answer| answer.folder.clone()));
    for (frame, _) in listing.frames.iter_mut().zip(&is_near).filter(|(_, near)| **near) {
        let (answer, is_elsewhere) = found[frame.relative.as_path()];
        if users.get(&frame.relative).is_some_and(|users| users.len() > 1) {
            missing.shared.push(folder.shown(&frame.relative));
            frame.photo = None;
        } else if is_elsewhere && homes.contains(&answer.folder) {
            missing.elsewhere.push((answer.name.clone(), folder.shown(&frame.relative)));
            frame.photo = None;
        }
    }
    is_near
}

/// Returns whether a file lies in a folder whose name says something that the name it was sought by
/// does not: not a usual name of photographs, nor a number.
fn is_foreign(file: &Path, answer: &Answer) -> bool {
    let last = file.parent().and_then(Path::file_name).map(|name| fold(&name.to_string_lossy()));
    last.is_some_and(|last| {
        !is_common_name(&last) && !is_number(&last) && answer.folder.split('/').all(|part| part != last)
    })
}

fn confirm_masks(folder: &CaptureFolder, listing: &mut Listing, answers: &[Answer]) {
    let found = by_path(answers);
    let mut users: HashMap<&Path, HashSet<&str>> = HashMap::new();
    for answer in answers {
        if let NearMatch::One { path, .. } = &answer.found {
            users.entry(Path::new(path)).or_default().insert(&answer.name);
        }
    }
    let photos: HashSet<PathBuf> = listing.frames.iter().filter_map(|frame| frame.photo.clone()).collect();
    let mut pairs = Vec::new();
    for frame in &mut listing.frames {
        let Some(mask) = &frame.mask else { continue };
        let relative = mask.strip_prefix(folder.root).unwrap_or(mask);
        let Some((answer, _)) = found.get(relative) else { continue };
        if users.get(relative).is_some_and(|users| users.len() > 1) || photos.contains(mask) {
            let problem = format!("the mask it names, `{}`, is missing", answer.name);
            listing.problems.push(in_frame(&frame.file, &frame.name, problem));
            frame.mask = None;
        } else {
            pairs.push((answer.name.clone(), folder.shown(relative)));
        }
    }
    listing.reasons.extend(said(pairs, "mask"));
}

/// Files that were found, with one name that led there and whether they lie elsewhere.
fn by_path(answers: &[Answer]) -> HashMap<&Path, (&Answer, bool)> {
    let mut found = HashMap::new();
    for answer in answers {
        if let NearMatch::One { path, is_elsewhere } = &answer.found {
            found.insert(Path::new(path), (answer, *is_elsewhere));
        }
    }
    found
}

/// Returns a sentence on files that were read in the place of others.
fn said(pairs: Vec<(String, String)>, noun: &str) -> Option<String> {
    let (name, file) = pairs.first()?;
    let others = match pairs.len() - 1 {
        0 => String::new(),
        n => format!(", and {n} more in the same way"),
    };
    let verb = if pairs.len() == 1 { "is" } else { "are" };
    let what = counted(pairs.len(), noun);
    Some(format!("{what} {verb} found under near names: `{file}` is read for `{name}`{others}"))
}

impl Missing {
    /// Returns what is there in the place of these missing photographs, as the end of a sentence,
    /// and what to do about it where that is known.
    pub fn explain(
        &self,
        folder: &CaptureFolder,
        missing: &[CameraFrame],
        is_all: bool,
    ) -> (String, Option<String>) {
        if let Some((factor, path)) = self.reduced.iter().min() {
            let (text, hint) = reduced_instead(folder, missing, *factor, path);
            return (text, Some(hint));
        }
        if let Some((name, files)) = self.several.first() {
            let shown: Vec<String> = files.iter().map(|file| format!("`{file}`")).collect();
            let text = format!("; `{name}` fits {}", shown.join(" as well as "));
            return (text, Some("keep one photograph of each name, where the camera file says it is".into()));
        }
        if let Some(file) = self.shared.first() {
            let text = format!("; `{file}` is there, but several frames would share it");
            return (text, Some("give each photograph the name that the camera file says".into()));
        }
        if let Some((name, file)) = self.elsewhere.first() {
            let text = format!("; `{file}` is there, but `{name}` is looked for where others are");
            let hint = "move such files beside the others if they are the photographs of these cameras";
            return (text, Some(hint.into()));
        }
        if let Some(limit) = folder.search.limit(folder.root) {
            return (
                format!(
                    "; the capture has more than {limit} files, so none was looked for under a near name"
                ),
                None,
            );
        }
        if is_all { (pictures_there(folder), None) } else { (String::new(), None) }
    }
}

/// Returns which folders have pictures that could be photographs, as the end of a sentence.
pub(super) fn pictures_there(folder: &CaptureFolder) -> String {
    let mut folders: Vec<_> = folder.search.folders(folder.root).into_iter().collect();
    let is_shown = |name: &str| !name.split('/').any(|part| is_aside(&fold(part)));
    if folders.iter().any(|(name, _)| is_shown(name)) {
        folders.retain(|(name, _)| is_shown(name)); // else better those than none
    }
    folders.sort_by_key(|(_, pictures)| std::cmp::Reverse(pictures.len()));
    let shown = folders.iter().take(EXAMPLES).map(|(name, pictures)| {
        let place = if name.is_empty() { "the capture itself".into() } else { format!("`{name}/`") };
        format!("{place} has {}, such as `{}`", counted(pictures.len(), "picture"), pictures[0].path)
    });
    let shown: Vec<String> = shown.collect();
    if shown.is_empty() { "; there are no other pictures".into() } else { format!("; {}", shown.join(", ")) }
}

/// Returns what to say of photographs that are there in a reduced size only.
fn reduced_instead(
    folder: &CaptureFolder,
    missing: &[CameraFrame],
    factor: u32,
    path: &str,
) -> (String, String) {
    let place = path.split('/').take_while(|part| reduced(&fold(part)).is_none());
    let place: Vec<&str> = path.split('/').take(place.count() + 1).collect();
    let (place, whole) = (place.join("/"), place.join("/"));
    let whole = whole.rsplit_once('_').map_or("", |(whole, _)| whole);
    let text = format!("; `{path}` is there, reduced by {factor}");
    let size =
        io::picture_info(&folder.root.join(path), &folder.options.limits).ok().map(|i| (i.width, i.height));
    let lens = missing.first().map(|frame| frame.intrinsics).unwrap_or_default();
    // an opening angle fits pictures of any size
    let is_free = lens.size.is_none() && lens.focal == [None; 2];
    let hint = if is_free || size.is_some() && size == lens.size {
        format!("rename `{place}/` to `{whole}/`: the cameras fit pictures of that size")
    } else if lens.size.is_none() {
        format!("add the whole photographs as `{whole}/`: the camera file does not say which size it is for")
    } else {
        format!(
            "use the photographs in `{place}/`: `--set capture.downscale={factor}`; or add the whole ones"
        )
    };
    (text, hint)
}

/// Returns what to say where a list of cameras without names has no photographs: which folders have
/// pictures, and a hint where they are reduced.
pub(super) fn no_folder(folder: &CaptureFolder, name: &str) -> (String, Option<String>) {
    let folders = folder.search.folders(folder.root);
    let factor = |folder: &str| reduced(&fold(folder)).filter(|(_, whole)| *whole == name).map(|(f, _)| f);
    match folders.keys().filter_map(|folder| Some((factor(folder)?, *folder))).min() {
        Some((factor, place)) => {
            let hint = format!("use the photographs in `{place}/`: `--set capture.downscale={factor}`");
            (format!("; `{place}/` is there, reduced by {factor}"), Some(hint))
        }
        None => (pictures_there(folder), None),
    }
}
