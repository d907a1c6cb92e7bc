//! Names that are nearly those of files: the one search behind every file that a capture names and
//! does not have.
//!
//! Names are compared folded, in small letters and in one Unicode form (macOS writes `é` as two
//! characters). A file in the folder that is named comes first, then the one that has the most
//! folders in common with the name, counted from its end, which finds absolute names of other
//! computers. A file is read only if no other fits as well. The files of a capture are listed once,
//! when the first of them is missing.

pub(super) mod names;
pub(super) mod pairs;

use names::{
    PHOTOGRAPHS, READABLE_FORMATS, bare, fold, has_ending, is_aside, is_common_name, is_mask_folder,
    is_same_format, reduced, without_ending,
};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use tiface_base::io;

/// Maximum number of entries that are looked at; where a capture has more, none is near.
const MAX_ENTRIES: usize = 100_000;
/// Maximum depth of folders.
const MAX_DEPTH: usize = 5;
/// Maximum number of files of one name that are compared.
const MAX_ALIKE: usize = 1000;
/// Number of files that fit a name that are remembered.
const MAX_SHOWN: usize = 3;

/// Kind of the file that is looked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Photograph,
    Mask,
}

/// A name as it was given, taken apart and folded.
struct Wanted {
    folders: Vec<String>,
    stem: String,
    ending: String,
    /// Least number of folders that a file elsewhere must have in common with it: a name that
    /// climbs out of the capture may mean any file there.
    least: usize,
    is_absolute: bool,
}

impl Wanted {
    fn parse(name: &str) -> Option<Wanted> {
        let text = name.replace('\\', "/");
        let has_drive = text.as_bytes().get(1) == Some(&b':');
        let is_absolute = text.starts_with('/') || has_drive;
        let (mut parts, mut climbs): (Vec<String>, bool) = (Vec::new(), false);
        for part in text.split('/').skip(has_drive as usize).filter(|part| !["", "."].contains(part)) {
            match part {
                ".." => climbs |= parts.pop().is_none(),
                part => parts.push(fold(part)),
            }
        }
        let last = parts.pop().filter(|_| !name.contains('\0') && !text.ends_with('/'))?;
        let (stem, ending) = without_ending(&last);
        let (stem, ending) = (stem.to_string(), ending.to_string());
        Some(Wanted { folders: parts, stem, ending, least: climbs as usize, is_absolute })
    }

    /// Folders, joined, whose files have the name that was given, all but for their own names: that
    /// folder, and the one of pictures that are reduced as it is asked for.
    fn homes(&self, downscale: u32) -> Vec<String> {
        if self.is_absolute || self.least > 0 {
            return Vec::new();
        }
        let mut homes = vec![self.folders.join("/")];
        if let [first, rest @ ..] = &self.folders[..]
            && downscale > 1
        {
            let with = |tail: &str| [&[format!("{first}_{downscale}{tail}")][..], rest].concat().join("/");
            homes.extend([with(""), with("x")]);
        }
        homes
    }

    /// Returns how many folders of a file are those of the name, counted from the last.
    fn in_common(&self, folder: &str) -> usize {
        parts(folder).rev().zip(self.folders.iter().rev()).take_while(|(a, b)| a == b).count()
    }

    /// Returns the factor of a folder that has reduced pictures, unless that is what is asked for.
    fn reduced(&self, folder: &str) -> Option<u32> {
        let is_whole = |whole: &str| is_common_name(whole) || self.folders.iter().any(|f| f == whole);
        let others = parts(folder).filter(|part| !self.folders.iter().any(|f| f == part));
        others.filter_map(reduced).find(|(_, whole)| is_whole(whole)).map(|(factor, _)| factor)
    }
}

fn parts(folder: &str) -> impl DoubleEndedIterator<Item = &str> {
    folder.split('/').filter(|part| !part.is_empty())
}

/// A picture in the capture.
#[derive(Debug)]
pub(super) struct Picture {
    /// Its path below the capture, separated by `/`.
    pub path: String,
    /// Its folder, folded.
    folder: String,
    /// Its name without ending, folded.
    stem: String,
    ending: String,
}

impl Picture {
    fn new(path: String) -> Picture {
        let (folder, name) = path.rsplit_once('/').unwrap_or(("", &path));
        let (stem, ending) = without_ending(name);
        let [folder, stem, ending] = [folder, stem, ending].map(fold);
        Picture { path, folder, stem, ending }
    }

    /// Returns the folder as it is written.
    pub fn folder(&self) -> &str {
        self.path.rsplit_once('/').map_or("", |(folder, _)| folder)
    }

    /// Returns whether the name has a word of masks.
    pub fn is_named_mask(&self) -> bool {
        bare(&self.stem).1
    }
}

/// The pictures of a capture by their names.
#[derive(Debug, Default)]
struct Index {
    pictures: Vec<Picture>,
    /// By the name without what makes it a mask's.
    by_name: HashMap<String, Vec<usize>>,
    is_whole: bool,
}

impl Index {
    fn build(root: &Path, result_file: &str) -> Index {
        // results have views and masks under the photographs' names
        let is_result = |folder: &Path| !result_file.is_empty() && io::is_file(&folder.join(result_file));
        let Some(files) = io::files_below(root, MAX_DEPTH, MAX_ENTRIES, &is_result) else {
            return Index::default();
        };
        let pictures: Vec<Picture> =
            files.into_iter().filter(|f| has_ending(f, &PHOTOGRAPHS)).map(Picture::new).collect();
        let mut by_name: HashMap<String, Vec<usize>> = HashMap::new();
        for (i, picture) in pictures.iter().enumerate() {
            by_name.entry(bare(&picture.stem).0.into()).or_default().push(i);
        }
        Index { pictures, by_name, is_whole: true }
    }

    fn nearest(&self, wanted: &Wanted, kind: Kind, downscale: u32) -> NearMatch {
        let homes = wanted.homes(downscale);
        let (mut best, mut reduced): (Vec<usize>, Option<(u32, usize)>) = (Vec::new(), None);
        let mut best_rank = None;
        let alike = self.by_name.get(bare(&wanted.stem).0).filter(|alike| alike.len() <= MAX_ALIKE);
        for &i in alike.into_iter().flatten() {
            let picture = &self.pictures[i];
            let is_same = picture.stem == wanted.stem;
            let is_home = homes.contains(&picture.folder);
            let in_common = wanted.in_common(&picture.folder);
            let last = parts(&picture.folder).next_back().unwrap_or_default();
            let fits = match kind {
                Kind::Photograph => is_same,
                Kind::Mask => {
                    let is_mask = picture.is_named_mask() || parts(&picture.folder).any(is_mask_folder);
                    is_mask || is_home && is_same
                }
            };
            if !fits || !is_home && in_common < wanted.least {
                continue;
            }
            if kind == Kind::Photograph && !is_home {
                if let Some(factor) = wanted.reduced(&picture.folder) {
                    let least = reduced.is_none_or(|(least, _)| factor < least);
                    reduced = if least { Some((factor, i)) } else { reduced };
                    continue;
                }
                let is_other = |part: &str| is_aside(part) && !wanted.folders.iter().any(|f| f == part);
                if parts(&picture.folder).any(is_other) {
                    continue;
                }
            }
            let is_usual = match kind {
                Kind::Photograph => last.is_empty() || is_common_name(last),
                Kind::Mask => is_mask_folder(last),
            };
            let is_readable = PHOTOGRAPHS[..READABLE_FORMATS].contains(&picture.ending.as_str());
            let format = is_same_format(&picture.ending, &wanted.ending);
            let rank = Some((is_home, in_common, is_usual, is_same, is_readable, format));
            if rank > best_rank {
                best.clear();
                best_rank = rank;
            }
            if rank == best_rank {
                best.push(i);
            }
        }
        let path = |i: usize| self.pictures[i].path.clone();
        match (&best[..], reduced) {
            (&[i], _) => {
                NearMatch::One { path: path(i), is_elsewhere: !homes.contains(&self.pictures[i].folder) }
            }
            ([], Some((factor, i))) => NearMatch::Reduced { factor, path: path(i) },
            ([], None) => NearMatch::Nothing,
            (several, _) => NearMatch::Several(several.iter().take(MAX_SHOWN).map(|&i| path(i)).collect()),
        }
    }
}

/// Files near a name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum NearMatch {
    Nothing,
    /// The only file that fits, and whether it lies in another folder than the name says.
    One {
        path: String,
        is_elsewhere: bool,
    },
    Several(Vec<String>),
    /// A photograph reduced by a factor.
    Reduced {
        factor: u32,
        path: String,
    },
}

/// A name that was looked for, and the files found.
#[derive(Clone, Debug)]
pub(super) struct Answer {
    pub kind: Kind,
    /// The name as it was given.
    pub name: String,
    /// Its folder, folded.
    pub folder: String,
    pub found: NearMatch,
}

/// The search in one capture, and its answers.
#[derive(Debug)]
pub(super) struct Search {
    /// See [`CaptureOptions::result_file`](super::CaptureOptions::result_file).
    result_file: &'static str,
    index: OnceLock<Index>,
    answers: Mutex<Vec<Answer>>,
    notes: Mutex<Vec<String>>,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Search {
    /// Returns a search that passes over folders with a `result_file`.
    pub fn new(result_file: &'static str) -> Search {
        Search { result_file, index: OnceLock::new(), answers: Mutex::default(), notes: Mutex::default() }
    }

    fn index(&self, root: &Path) -> &Index {
        self.index.get_or_init(|| Index::build(root, self.result_file))
    }

    /// Returns the only file near a name, as its path below the capture, and remembers the answer.
    pub fn nearest(&self, root: &Path, kind: Kind, name: &str, downscale: u32) -> Option<String> {
        let wanted = Wanted::parse(name)?;
        let found = self.index(root).nearest(&wanted, kind, downscale);
        let path = match &found {
            NearMatch::One { path, .. } => Some(path.clone()),
            _ => None,
        };
        let (name, folder) = (name.to_string(), wanted.folders.join("/"));
        locked(&self.answers).push(Answer { kind, name, folder, found });
        path
    }

    /// Adds a sentence on what was read in the place of something else.
    pub fn note(&self, text: String) {
        locked(&self.notes).push(text);
    }

    /// Returns the answers and sentences since the last time.
    pub fn taken(&self) -> (Vec<Answer>, Vec<String>) {
        (std::mem::take(&mut *locked(&self.answers)), std::mem::take(&mut *locked(&self.notes)))
    }

    /// Returns the pictures of a capture, sorted by path; none where it has too many files.
    pub fn pictures(&self, root: &Path) -> &[Picture] {
        &self.index(root).pictures
    }

    /// Returns the number of files above which none is near, if the capture has more.
    pub fn limit(&self, root: &Path) -> Option<usize> {
        (!self.index(root).is_whole).then_some(MAX_ENTRIES)
    }

    /// Returns the pictures of a capture by their folder, as it is written.
    pub fn folders(&self, root: &Path) -> BTreeMap<&str, Vec<&Picture>> {
        let mut folders: BTreeMap<&str, Vec<&Picture>> = BTreeMap::new();
        for picture in self.pictures(root) {
            folders.entry(picture.folder()).or_default().push(picture);
        }
        folders
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the files near a name in a capture of these files.
    fn near(files: &[&str], kind: Kind, name: &str) -> NearMatch {
        let dir = tempfile::tempdir().unwrap();
        for file in files {
            let path = dir.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"x").unwrap();
        }
        let search = Search::new("result.toml");
        search.nearest(dir.path(), kind, name, 1);
        search.taken().0.pop().map_or(NearMatch::Nothing, |answer| answer.found)
    }

    fn photo(files: &[&str], name: &str) -> Option<String> {
        match near(files, Kind::Photograph, name) {
            NearMatch::One { path, .. } => Some(path),
            _ => None,
        }
    }

    #[test]
    fn a_photograph_is_found_by_case_ending_unicode_form_and_folder() {
        let one = |file: &str, name: &str| assert_eq!(photo(&[file], name).as_deref(), Some(file), "{name}");
        one("images/000.JPG", "images/000.jpg");
        one("Images/000.jpg", "images/000.jpg");
        one("images/000.png", "./images/000.jpg");
        one("images/zoe\u{308}.jpg", "images/zo\u{eb}.jpg");
        one("images/000.jpg", "images/01/000.jpg");
        one("images/01/000.jpg", "images/000.jpg");
        one("images/000.jpg", "/home/me/data/head/images/000.jpg");
        one("images/000.jpg", "C:\\head\\images\\000.jpg");
        one("images/000.jpg", "../images/000.jpg");
        one("images/000.jpg", "D:\\shots\\000.jpg");
    }

    #[test]
    fn what_fits_twice_or_shows_something_else_is_no_photograph() {
        let none = |files: &[&str], name: &str| assert_eq!(photo(files, name), None, "{name}");
        none(&["left/000.jpg", "right/000.jpg"], "images/000.jpg");
        none(&["masks/000.png", "depth/000.png", "images/000_mask.png"], "images/000.jpg");
        none(&["run/result.toml", "run/render/000.png", ".hidden/000.png"], "images/000.jpg");
        none(&["images/000.jpg"], "../000.jpg");
        none(&["images/000.jpg"], "images/");
        none(&["images/000.jpg"], "");
        none(&["passwd"], "/etc/passwd");
        let reduced = near(&["images_8/000.jpg", "images_4/000.jpg"], Kind::Photograph, "images/000.jpg");
        assert_eq!(reduced, NearMatch::Reduced { factor: 4, path: "images_4/000.jpg".into() });
        // the named folder comes first, then the named format
        let files = ["images/000.JPG", "images/000.png", "other/000.jpg"];
        assert_eq!(photo(&files, "images/000.jpg").as_deref(), Some("images/000.JPG"));
    }

    #[test]
    fn a_mask_is_found_by_its_word_and_is_never_a_photograph() {
        let mask = |files: &[&str], name: &str| match near(files, Kind::Mask, name) {
            NearMatch::One { path, .. } => Some(path),
            _ => None,
        };
        let photo = "images/000.png";
        assert_eq!(mask(&[photo, "masks/000.PNG"], "masks/000.png").as_deref(), Some("masks/000.PNG"));
        assert_eq!(mask(&[photo, "mask/000.png"], "masks/000.png").as_deref(), Some("mask/000.png"));
        assert_eq!(
            mask(&[photo, "masks/000_mask.png"], "masks/000.png").as_deref(),
            Some("masks/000_mask.png")
        );
        assert_eq!(mask(&[photo], "masks/000.png"), None);
    }
}
