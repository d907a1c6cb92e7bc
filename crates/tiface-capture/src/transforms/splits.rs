//! nerfstudio's lists of photographs by split, `train_filenames`, `val_filenames` and
//! `test_filenames`.
//!
//! nerfstudio compares whole paths, refuses entries that are no photograph's, and leaves out
//! photographs that no list has. Here an entry may be spelled otherwise than `file_path`: with
//! `./`, backslashes, another ending or none, or with fewer or more folders in front, where only
//! one photograph fits.

use super::Object;
use crate::folder::{PHOTOGRAPHS, has_ending, in_file, shortened};
use crate::frame::Listing;
use crate::masks::few;
use crate::view::Split;
use std::collections::HashMap;
use tiface_base::Error;
use tiface_base::io;

const LISTS: [(&str, Split); 3] =
    [("train_filenames", Split::Train), ("val_filenames", Split::Val), ("test_filenames", Split::Test)];

/// Maximum number of folders in front of a name that are compared.
const MAX_FOLDERS: usize = 8;

/// Entry of one frame in the lists.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Listed {
    /// Its split, if any.
    In(Option<Split>),
    /// It is in no list, and to be left out.
    Nowhere,
}

/// Returns what the lists at the top of a file say about its frames, given by their `file_path`.
/// Those that are `settled` name their split themselves, and need no list.
pub(super) fn assign(
    file: &str,
    top: &Object,
    names: &[Option<&str>],
    settled: &[bool],
    listing: &mut Listing,
) -> Result<Vec<Listed>, Error> {
    let lists = lists(file, top)?;
    if lists.is_empty() {
        return Ok(vec![Listed::In(None); names.len()]);
    }
    let found = found_in(file, &lists, names, listing)?;
    let names: Vec<Option<&str>> = names.iter().zip(settled).map(|(name, is)| name.filter(|_| !is)).collect();
    Ok(rest(file, &lists, &names, &found, listing))
}

/// A list of a split: its key and its entries.
type SplitList = (&'static str, Split, Vec<String>);

/// Reads the lists at the top of a file.
fn lists(file: &str, top: &Object) -> Result<Vec<SplitList>, Error> {
    let mut lists = Vec::new();
    for (key, split) in LISTS {
        let Some(value) = top.get(key).filter(|value| !value.is_null()) else { continue };
        let entries = io::typed(value).map_err(|[place, found, expected]| {
            let place = place.trim_start_matches('.');
            let what = format!("`{key}{place}` is {found}, expected {expected}");
            in_file(file, what, "it must be a list of file names")
        })?;
        lists.push((key, split, entries));
    }
    Ok(lists)
}

/// Returns the key and the split of the first list that names each frame, with what is to be said
/// of frames in two lists and of entries that name none.
fn found_in(
    file: &str,
    lists: &[SplitList],
    names: &[Option<&str>],
    listing: &mut Listing,
) -> Result<Vec<Option<(&'static str, Split)>>, Error> {
    let mut found: Vec<Option<(&str, Split)>> = vec![None; names.len()];
    let index = Index::new(names);
    let (mut respelled, mut twice) = (None, Vec::new());
    for (key, split, entries) in lists {
        let mut without = Vec::new();
        for entry in entries {
            let (frames, is_same) = index.find(entry);
            if frames.is_empty() {
                without.push(shortened(entry));
            }
            for &i in frames {
                match found[i] {
                    Some((first, other)) if other == Split::Train && *split != other => {
                        twice.push((names[i].unwrap_or_default(), first, *key));
                    }
                    Some(_) => {}
                    None => found[i] = Some((*key, *split)),
                }
                if !is_same {
                    respelled.get_or_insert((shortened(entry), names[i].unwrap_or_default()));
                }
            }
        }
        if !entries.is_empty() && without.len() == entries.len() {
            let first = names.iter().flatten().next().copied().unwrap_or_default();
            return Err(in_file(
                file,
                format_args!(
                    "`{key}` names no photograph of the file: {}, where `file_path` is `{first}`",
                    few(without)
                ),
                "write the names as `file_path` has them, or remove the list",
            ));
        }
        if !without.is_empty() {
            let (n, without) = (without.len(), few(&without));
            listing.warnings.push(format!("`{file}`: {n} names in `{key}` are no photograph's: {without}"));
        }
    }
    if let Some((entry, name)) = respelled {
        listing.reasons.push(format!(
            "`{file}` spells names otherwise in its lists of splits: `{entry}` is taken for `{name}`"
        ));
    }
    if let Some((_, first, second)) = twice.first() {
        let (names, count) = (few(twice.iter().map(|(name, ..)| name)), twice.len());
        let are = if count == 1 { "a photograph is".into() } else { format!("{count} photographs are") };
        listing
            .warnings
            .push(format!("`{file}`: {are} in both `{first}` and `{second}`, and learned from: {names}"));
    }
    Ok(found)
}

/// Returns the splits, with what becomes of frames with a name that are in no list.
fn rest(
    file: &str,
    lists: &[SplitList],
    names: &[Option<&str>],
    found: &[Option<(&str, Split)>],
    listing: &mut Listing,
) -> Vec<Listed> {
    let is_rest = |i: &usize| names[*i].is_some() && found[*i].is_none();
    let others: Vec<&str> = (0..names.len()).filter(is_rest).filter_map(|i| names[i]).collect();
    let keys: Vec<String> = lists.iter().map(|(key, ..)| format!("`{key}`")).collect();
    let (keys, n) = (keys.join(", "), others.len());
    let otherwise = match lists {
        [(_, Split::Train, _)] => Listed::In(Some(Split::Test)),
        [(_, Split::Train, _), ..] => Listed::Nowhere,
        _ => Listed::In(Some(Split::Train)),
    };
    if n > 0 {
        let fate = match otherwise {
            Listed::Nowhere => "left out, as nerfstudio does",
            Listed::In(Some(Split::Train)) => "learned from",
            Listed::In(_) => "held out for testing",
        };
        let (are, named) = (if n == 1 { "photograph is" } else { "photographs are" }, few(&others));
        listing.warnings.push(format!("`{file}`: {n} {are} not in {keys}, and {fate}: {named}"));
    }
    let of = |i: usize| match found[i] {
        Some((_, split)) => Listed::In(Some(split)),
        None if names[i].is_none() => Listed::In(None),
        None => otherwise,
    };
    (0..names.len()).map(of).collect()
}

/// Photographs by all that an entry may call them.
struct Index {
    /// By path: the frames, as numbers of `frames`.
    paths: HashMap<String, usize>,
    frames: Vec<Vec<usize>>,
    /// By path without ending, in small letters; `None` where several fit.
    stems: HashMap<String, Option<usize>>,
    /// The same, by the ends of these.
    ends: HashMap<String, Option<usize>>,
}

impl Index {
    fn new(names: &[Option<&str>]) -> Index {
        let mut index =
            Index { paths: HashMap::new(), frames: Vec::new(), stems: HashMap::new(), ends: HashMap::new() };
        for (i, name) in names.iter().enumerate().filter_map(|(i, name)| Some((i, (*name)?))) {
            let path = normal(name);
            let stem = stem(&path);
            let next = index.frames.len();
            let n = *index.paths.entry(path).or_insert(next);
            if n < next {
                index.frames[n].push(i);
                continue;
            }
            index.frames.push(vec![i]);
            let parts: Vec<&str> = stem.split('/').collect();
            for k in 1..=parts.len().min(MAX_FOLDERS) {
                let end = parts[parts.len() - k..].join("/");
                index.ends.entry(end).and_modify(|n| *n = None).or_insert(Some(n));
            }
            index.stems.entry(stem).and_modify(|n| *n = None).or_insert(Some(n));
        }
        index
    }

    /// Returns the frames that an entry names, and whether it spells them as they are.
    fn find(&self, entry: &str) -> (&[usize], bool) {
        let path = normal(entry);
        if let Some(&n) = self.paths.get(&path) {
            return (&self.frames[n], path == entry);
        }
        let stem = stem(&path);
        let parts: Vec<&str> = stem.split('/').collect();
        let longer = |k: usize| Some(*self.stems.get(&parts[k..].join("/"))?);
        let first = parts.len().saturating_sub(MAX_FOLDERS).max(1);
        let fits = self.stems.get(&stem).or_else(|| self.ends.get(&stem)).copied();
        let fits = fits.or_else(|| (first..parts.len()).find_map(longer));
        fits.flatten().map_or((&[][..], false), |n| (&self.frames[n][..], false))
    }
}

/// Returns a path with `/` between its parts, without `.` and `..`.
fn normal(name: &str) -> String {
    let name = name.replace('\\', "/");
    let mut parts: Vec<&str> = Vec::new();
    for part in name.split('/').filter(|part| !["", "."].contains(part)) {
        match part {
            ".." if parts.last().is_some_and(|last| *last != "..") => _ = parts.pop(),
            part => parts.push(part),
        }
    }
    parts.join("/")
}

/// Returns a path without the ending of a photograph, in small letters.
fn stem(path: &str) -> String {
    let stem = match path.rsplit_once('.') {
        Some((stem, _)) if has_ending(path, &PHOTOGRAPHS) => stem,
        _ => path,
    };
    stem.to_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn assigned(top: serde_json::Value, names: &[&str]) -> (Result<Vec<Listed>, Error>, Listing) {
        let mut listing = Listing::default();
        let names: Vec<Option<&str>> = names.iter().map(|name| Some(*name)).collect();
        let settled = vec![false; names.len()];
        (assign("t.json", top.as_object().unwrap(), &names, &settled, &mut listing), listing)
    }

    const TRAIN: Listed = Listed::In(Some(Split::Train));
    const TEST: Listed = Listed::In(Some(Split::Test));

    #[test]
    fn names_are_found_however_the_lists_spell_them() {
        let names = ["images/a.png", "images/b.png", "images/sub/c"];
        for (train, test) in [
            (json!(["images/a.png", "images/b.png"]), "images/sub/c"),
            (json!(["./images/a.png", "images//b.png"]), "./images/sub/c.png"),
            (json!(["images\\a.png", "images\\b.png"]), "images\\sub\\c"),
            (json!(["a.png", "b.png"]), "sub/c"),
            (json!(["images/a.jpg", "images/b.JPG"]), "c.jpg"),
            (json!(["/data/head/images/a.png", "C:\\head\\images\\b.png"]), "/x/images/sub/c"),
            (json!(["Images/A", "Images/B"]), "images/x/../sub/c.png"),
        ] {
            let (found, listing) =
                assigned(json!({ "train_filenames": train, "test_filenames": [test] }), &names);
            assert_eq!(found.unwrap(), [TRAIN, TRAIN, TEST], "{train}");
            assert!(listing.warnings.is_empty(), "{:?}", listing.warnings);
        }
    }

    #[test]
    fn a_name_that_fits_two_photographs_is_no_name() {
        let names = ["left/0.png", "right/0.png", "left/1.png"];
        let top = json!({ "train_filenames": ["left/0", "right/0.jpg", "0.png", "middle/1.png"] });
        let (found, listing) = assigned(top, &names);
        assert_eq!(found.unwrap(), [TRAIN, TRAIN, TEST]);
        assert!(listing.warnings[0].contains("`0.png`, `middle/1.png`"), "{:?}", listing.warnings);
    }

    #[test]
    fn photographs_in_no_list_are_named_with_what_becomes_of_them() {
        let names = ["a.png", "b.png", "c.png"];
        let says = |top, words: &[&str]| {
            let (found, listing) = assigned(top, &names);
            let is_said = |word: &&str| listing.warnings.iter().any(|w| w.contains(*word));
            assert!(words.iter().all(is_said), "{words:?}: {:?}", listing.warnings);
            found.unwrap()
        };
        let both = json!({ "train_filenames": ["a.png"], "test_filenames": ["b.png"] });
        assert_eq!(says(both, &["left out", "`c.png`"]), [TRAIN, TEST, Listed::Nowhere]);
        let train = json!({ "train_filenames": ["a.png", "b.png"], "val_filenames": null });
        assert_eq!(says(train, &["held out", "`c.png`"]), [TRAIN, TRAIN, TEST]);
        let test = json!({ "test_filenames": ["c.png"] });
        assert_eq!(says(test, &["learned from", "`a.png`"]), [TRAIN, TRAIN, TEST]);
        let twice = json!({ "train_filenames": ["a.png", "b.png", "c.png"], "test_filenames": ["b.png"] });
        assert_eq!(says(twice, &["a photograph is in both", "`b.png`"]), [TRAIN; 3]);
    }

    #[test]
    fn lists_that_name_nothing_are_refused() {
        let (found, _) = assigned(json!({ "train_filenames": ["x.png", "y.png"] }), &["images/a.png"]);
        let error = found.unwrap_err().to_string();
        for word in ["train_filenames", "`x.png`", "`images/a.png`"] {
            assert!(error.contains(word), "{error}");
        }
        let (found, _) = assigned(json!({ "train_filenames": [3] }), &["a"]);
        assert_eq!(found.unwrap_err().to_string(), "`t.json`: `train_filenames[0]` is 3, expected text");
        assert_eq!(assigned(json!({}), &["a"]).0.unwrap(), [Listed::In(None)]);
    }
}
