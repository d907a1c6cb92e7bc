//! Masks by near names: in folders that are called like masks, and beside the photographs.

use super::folder::{CaptureFolder, PHOTOGRAPHS, has_ending};
use super::near::names::{
    fold, is_aside, is_common_name, is_like_masks, is_mask_folder, is_measured, reduced, without_ending,
    without_valid,
};
use super::near::pairs::{Pairs, pair, pair_below};
use super::view::View;
use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::io;

/// Folders in the order in which they are taken; others follow by name.
const STANDING: [&str; 3] = ["vit_mask", "masks", "mask"];

/// Maximum number of folders that are compared with the views.
const MAX_FOLDERS: usize = 16;

/// Folders of valid masks, and whether these may be pictures: `valid/` may as well have photographs
/// to validate with.
const VALID_FOLDERS: [(&str, bool); 3] = [("valid", false), ("valid_mask", true), ("valid_masks", true)];

/// Pictures that may be masks, paired with the views.
pub(super) struct Group {
    /// Their folder below the capture.
    pub place: String,
    /// Their paths below that folder.
    files: Vec<String>,
    pairs: Pairs,
}

impl Group {
    /// Pairs files below a folder with views of these names, and of these paths below the capture.
    fn new(place: &str, mut files: Vec<String>, names: &[String], paths: &[String]) -> Group {
        files.sort();
        let pairs = pair_below(names, paths, &files);
        Group { place: place.into(), files, pairs }
    }

    /// Returns whether these are the masks: no view has two, at least half of the views or of the
    /// pictures have the other, and their names are more than numbers that some happen to share.
    pub fn is_usable(&self) -> bool {
        let (n, all) = (self.pairs.count(), self.pairs.files.len().min(self.files.len()));
        n > 0 && self.pairs.is_sure() && 2 * n >= all
    }

    /// Returns whether there is no picture.
    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    fn path(&self, file: usize) -> String {
        if self.place.is_empty() {
            self.files[file].clone()
        } else {
            format!("{}/{}", self.place, self.files[file])
        }
    }

    /// Returns the mask of each view.
    pub fn masks(&self, root: &Path) -> Vec<Option<PathBuf>> {
        self.pairs.files.iter().map(|file| file.map(|file| root.join(self.path(file)))).collect()
    }

    /// Returns one pair, for a message: the mask's path, and the number of the view.
    pub fn example(&self) -> Option<(String, usize)> {
        self.pairs.files.iter().enumerate().find_map(|(view, file)| Some((self.path((*file)?), view)))
    }

    /// Returns why these are not the masks, in a sentence.
    fn refusal(&self, views: &[View]) -> String {
        let (place, count) = (&self.place, counted(self.files.len(), "picture"));
        let way = format!("name each mask as its view, `{place}/{}.png`", views[0].name);
        if let Some(&view) = self.pairs.doubtful.first() {
            let name = &views[view].name;
            return format!(
                "`{place}/` has {count}, of which several fit the view `{name}`, or one fits several: {way}"
            );
        }
        match self.pairs.count() {
            0 => {
                let example = self.path(0);
                format!("`{place}/` has {count} that no view is named after, such as `{example}`: {way}")
            }
            n if self.pairs.by_number.is_some() => format!(
                "`{place}/` has {count} for {}, but only {n} have the same number, which may be chance: {way}",
                counted(views.len(), "view")
            ),
            n => format!(
                "`{place}/` has {count}, but only {n} of {} views are named alike: {way}",
                views.len()
            ),
        }
    }
}

/// The photographs of views, which are no masks.
fn photographs(views: &[View]) -> HashSet<&Path> {
    views.iter().map(|view| view.photo.as_path()).collect()
}

fn names(views: &[View]) -> Vec<String> {
    views.iter().map(|view| view.name.clone()).collect()
}

/// Returns the paths of photographs below the capture, without ending and separated by `/`.
fn paths(folder: &CaptureFolder, views: &[View]) -> Vec<String> {
    let path = |view: &View| without_ending(&folder.shown(&view.photo)).0.replace('\\', "/");
    views.iter().map(path).collect()
}

/// Returns the groups of pictures that may be masks in the order in which they are to be taken:
/// those of folders that are called like masks, then those beside the photographs with a word of
/// masks in their names.
pub(super) fn groups(folder: &CaptureFolder, views: &[View]) -> Vec<Group> {
    let photos = photographs(views);
    let mut found: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut beside = Vec::new();
    let folders: HashSet<&Path> = photos.iter().filter_map(|photo| photo.parent()).collect();
    for picture in folder.search.pictures(folder.root) {
        let path = folder.root.join(&picture.path);
        if photos.contains(path.as_path()) {
            continue;
        }
        let parts: Vec<&str> = picture.folder().split('/').collect();
        if let Some(at) = parts.iter().position(|part| is_mask_folder(&fold(part))) {
            let place = parts[..=at].join("/");
            let inside = picture.path[place.len() + 1..].to_string();
            found.entry(place).or_default().push(inside);
        } else if picture.is_named_mask() && path.parent().is_some_and(|parent| folders.contains(parent)) {
            beside.push(picture.path.clone());
        }
    }
    let order = |(place, _): &(String, Vec<String>)| {
        let last = fold(place.rsplit('/').next().unwrap_or_default());
        let rank = STANDING.iter().position(|name| *name == last).unwrap_or(STANDING.len());
        (rank, place.matches('/').count(), place.clone())
    };
    let mut found: Vec<(String, Vec<String>)> = found.into_iter().collect();
    found.sort_by_cached_key(order);
    let (view_names, paths) = (names(views), paths(folder, views));
    let found = found.into_iter().take(MAX_FOLDERS);
    let group = |(place, files): (String, Vec<String>)| Group::new(&place, files, &view_names, &paths);
    let mut groups: Vec<Group> = found.map(group).collect();
    if !beside.is_empty() {
        groups.push(Group::new("", beside, &paths, &paths));
    }
    groups
}

/// Returns the pictures in one folder, without photographs of views; where those lie there as well,
/// only pictures with a word of masks in their names count.
pub(super) fn within(folder: &CaptureFolder, place: &str, views: &[View]) -> Group {
    let photos = photographs(views);
    let has_photos = holds_photographs(folder, place, views);
    let below = if place.is_empty() { String::new() } else { format!("{place}/") };
    let pictures = folder.search.pictures(folder.root).iter();
    let pictures = pictures.filter(|picture| picture.path.starts_with(&below));
    let pictures = pictures.filter(|picture| !has_photos || picture.is_named_mask());
    let pictures = pictures.filter(|picture| !photos.contains(folder.root.join(&picture.path).as_path()));
    let files = pictures.map(|picture| picture.path[below.len()..].into()).collect();
    Group::new(place, files, &names(views), &paths(folder, views))
}

/// Returns whether a folder has photographs of views.
pub(super) fn holds_photographs(folder: &CaptureFolder, place: &str, views: &[View]) -> bool {
    let place = folder.root.join(place);
    views.iter().any(|view| view.photo.parent() == Some(place.as_path()))
}

/// Returns the folder that `capture.mask_dir` means: the one of that name, else the only one that
/// is called so in other letters, or whose path is the end of that name, such as `masks` of
/// `head/masks`.
pub(super) fn folder_named(folder: &CaptureFolder, name: &str) -> Option<String> {
    let exact =
        folder.relative("mask folder", name).ok().filter(|path| io::is_folder(&folder.root.join(path)));
    if let Some(path) = exact {
        return Some(path.to_string_lossy().replace('\\', "/"));
    }
    let wanted: Vec<String> = name.split(['/', '\\']).filter(|p| !["", "."].contains(p)).map(fold).collect();
    let mut known: HashSet<&str> = HashSet::new();
    for picture in folder.search.pictures(folder.root) {
        let path = picture.path.as_str();
        known.extend(path.match_indices('/').map(|(at, _)| &path[..at]));
    }
    let parts = |path: &str| path.split('/').map(fold).collect::<Vec<_>>();
    let mut near: Vec<(usize, &str)> = known
        .into_iter()
        .map(|path| (parts(path), path))
        .filter(|(p, _)| wanted.ends_with(p))
        .map(|(p, path)| (p.len(), path))
        .collect();
    near.sort();
    let (longest, path) = near.pop()?;
    (near.last().is_none_or(|(length, _)| *length < longest)).then(|| path.into())
}

/// Returns what is said where no mask is used: the pictures that may be masks, and why they are not
/// taken for such.
pub(super) fn stray(folder: &CaptureFolder, groups: &[Group], views: &[View]) -> Option<String> {
    let in_folder = groups.iter().find(|group| !group.place.is_empty());
    if let Some(group) = in_folder {
        return Some(group.refusal(views));
    }
    if let Some(group) = groups.first() {
        let (file, n) = (group.path(0), group.pairs.count());
        return Some(match n {
            0 => {
                format!("`{file}` is called as a mask, but no view is called so: name masks `NAME_mask.png`")
            }
            n => format!("{n} of {} views have a mask beside the photograph, such as `{file}`", views.len()),
        });
    }
    other_folder(folder, views).or_else(|| beside_photographs(folder, views))
}

/// Returns what is said of a folder that is not called like masks of heads and has a picture of
/// each view.
fn other_folder(folder: &CaptureFolder, views: &[View]) -> Option<String> {
    let is_other = |name: &str| {
        name.split('/')
            .map(fold)
            .all(|part| !is_measured(&part) && !is_common_name(&part) && reduced(&part).is_none())
    };
    let folders = folder.search.folders(folder.root).into_keys();
    let mut folders: Vec<&str> = folders.filter(|name| !name.is_empty() && is_other(name)).collect();
    folders.sort_by_key(|name| name.split('/').any(|part| is_aside(&fold(part))));
    let place = folders.into_iter().take(MAX_FOLDERS).find(|place| {
        let group = within(folder, place, views);
        !holds_photographs(folder, place, views) && group.pairs.count() == views.len()
    })?;
    let but = match place.split('/').any(|part| is_like_masks(&fold(part))) {
        true => ", but its name says of something else than the whole head",
        false => "",
    };
    Some(format!(
        "`{place}/` has pictures named as the views{but}: if they are masks, `--set capture.mask_dir={place}`"
    ))
}

/// Returns what is said of pictures beside the photographs whose names begin with those of at least
/// half of the views.
fn beside_photographs(folder: &CaptureFolder, views: &[View]) -> Option<String> {
    let photos = photographs(views);
    let known: HashSet<String> = paths(folder, views).iter().map(|path| fold(path)).collect();
    let mut found: BTreeMap<String, &str> = BTreeMap::new();
    for picture in folder.search.pictures(folder.root) {
        if photos.contains(folder.root.join(&picture.path).as_path()) {
            continue;
        }
        let stem = fold(without_ending(&picture.path).0);
        let ends = stem.match_indices(|c: char| !c.is_alphanumeric()).map(|(at, _)| at);
        let mut begins = ends.chain([stem.len()]).rev().map(|end| &stem[..end]);
        if let Some(name) = begins.find(|name| known.contains(*name)) {
            found.entry(name.into()).or_insert(&picture.path);
        }
    }
    let example = found.values().next().filter(|_| 2 * found.len() >= views.len())?;
    Some(format!(
        "`{example}` and others lie beside the photographs and are not used: if they are masks, name them \
         `NAME_mask.png`, or put them into `masks/`"
    ))
}

/// Returns masks of views that have none, in the folder of the others, under the view's own name in
/// other letters, Unicode form or format.
pub(super) fn others_there(
    folder: &CaptureFolder,
    views: &[View],
    found: &[PathBuf],
) -> Vec<Option<PathBuf>> {
    let is_there = |group: &Group| {
        let place = folder.root.join(&group.place);
        !group.place.is_empty() && found.iter().all(|mask| mask.starts_with(&place))
    };
    let Some(group) = groups(folder, views).into_iter().find(is_there) else {
        return vec![None; views.len()];
    };
    let is_same = |(view, file): (&View, &Option<usize>)| {
        let file = (*file)?;
        let is_same = fold(without_ending(&group.files[file]).0) == fold(&view.name);
        is_same.then(|| folder.root.join(group.path(file)))
    };
    views.iter().zip(&group.pairs.files).map(is_same).collect()
}

/// Returns the valid masks of the first folder for such that has any by near names, and that
/// folder.
pub(super) fn valid(
    folder: &CaptureFolder,
    bases: &[&Path],
    views: &[View],
) -> Option<(String, Vec<Option<PathBuf>>)> {
    let folders = bases.iter().flat_map(|base| io::list_folders(&folder.root.join(base)).unwrap_or_default());
    let kind = |path: PathBuf| {
        let name = path.file_name().map(|name| fold(&name.to_string_lossy()))?;
        let (_, has_pictures) = VALID_FOLDERS.iter().find(|(known, _)| *known == name)?;
        Some((path, *has_pictures))
    };
    folders.filter_map(kind).find_map(|(place, has_pictures)| {
        let mut files = io::list_files(&place).unwrap_or_default();
        files.retain(|file| has_ending(file, &["npy"]) || has_pictures && has_ending(file, &PHOTOGRAPHS));
        let stems: Vec<String> = files.iter().map(|file| without_valid(&fold(file)).to_string()).collect();
        let pairs = pair(&names(views), &stems);
        let all = pairs.files.iter().map(|file| file.map(|file| place.join(&files[file]))).collect();
        (pairs.count() > 0 && pairs.is_sure()).then(|| (folder.shown(&place), all))
    })
}
