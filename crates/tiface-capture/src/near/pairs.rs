//! Pairs of names and files: which file of a folder belongs to which view.

use super::names::{
    bare, fold, has_ending, is_common_name, is_mask_folder, is_number, plain, without_ending, without_words,
};
use std::collections::HashMap;

/// The file of each name.
pub struct Pairs {
    /// Where exactly one file fits, its place in the list of files.
    pub files: Vec<Option<usize>>,
    /// Names that several files fit, or whose file fits another name as well.
    pub doubtful: Vec<usize>,
    /// Where a name was found by its number alone, `7` for `007`: how many files have a number.
    pub by_number: Option<usize>,
}

impl Pairs {
    /// Returns how many names have a file.
    pub fn count(&self) -> usize {
        self.files.iter().flatten().count()
    }

    /// Returns whether the files are those of the names. Equal numbers alone show it only if every
    /// name has a file, or every file a name and few are without: pictures that are counted on
    /// their own, from 0 or 1, have some of the numbers of others.
    pub fn is_sure(&self) -> bool {
        let (n, all) = (self.count(), self.files.len());
        let is_sure = |numbered: usize| n == all || n == numbered && 4 * n >= 3 * all;
        self.doubtful.is_empty() && self.by_number.is_none_or(is_sure)
    }

    /// Returns the files that belong to no name.
    pub fn strangers<'f>(&self, files: &'f [String]) -> Vec<&'f str> {
        let mut is_free = vec![true; files.len()];
        self.files.iter().flatten().for_each(|&file| is_free[file] = false);
        files.iter().zip(is_free).filter(|(_, free)| *free).map(|(file, _)| file.as_str()).collect()
    }
}

/// Ways to compare, the strictest first: the folded name, the name without what makes it a mask's
/// with folders written in any way, and the last part alone without words of photographs and zeros
/// before a number.
const KEYS: [fn(&str) -> String; 3] =
    [|stem| stem.into(), |stem| bare(&stem.replace('/', "_")).0.into(), |stem| plain(last(stem)).into()];

/// Folders of views from one side, which those of another are not.
const SIDES: [&str; 8] = ["left", "right", "front", "back", "top", "bottom", "upper", "lower"];

fn last(stem: &str) -> &str {
    stem.rsplit('/').next().unwrap_or_default()
}

/// The folders of a folded path that say what its pictures show.
fn folders(stem: &str) -> Vec<&str> {
    let all = stem.rsplit_once('/').map_or("", |(folders, _)| folders).split('/');
    all.filter(|part| !part.is_empty() && !is_common_name(part) && !is_mask_folder(part)).collect()
}

/// Returns whether folders say that two pictures of the same last name are not of one view.
fn are_apart(a: &str, b: &str) -> bool {
    let [a, b] = [folders(a), folders(b)];
    let is_alike = |a: &&str| b.iter().any(|b| a.contains(*b) || b.contains(*a));
    !a.is_empty() && !b.is_empty() && !a.iter().any(is_alike)
}

/// Returns whether the folders of two pictures are those of two sides.
fn are_of_sides(a: &str, b: &str) -> bool {
    let sides = |stem| folders(stem).into_iter().filter(|part| SIDES.contains(part)).collect::<Vec<_>>();
    let [a, b] = [sides(a), sides(b)];
    !a.is_empty() && !b.is_empty() && a != b
}

/// Pairs names without ending, such as `left/07`, with files below a folder, such as
/// `left/07_mask.png`. Each name takes the strictest way in which any file fits; a PNG is preferred
/// to other formats.
pub fn pair(names: &[String], files: &[String]) -> Pairs {
    pair_below(names, names, files)
}

/// Pairs names with files as [`pair`] does. `paths` are the names with the folders that all of them
/// have in common.
pub fn pair_below(names: &[String], paths: &[String], files: &[String]) -> Pairs {
    let stems: Vec<String> = files.iter().map(|file| fold(without_ending(file).0)).collect();
    let by_key = KEYS.map(|key| {
        let mut found: HashMap<String, Vec<usize>> = HashMap::new();
        for (i, stem) in stems.iter().enumerate() {
            found.entry(key(stem)).or_default().push(i);
        }
        found
    });
    let fitting = |(name, path): (&String, &String)| -> Vec<usize> {
        let [name, path] = [name, path].map(|name| fold(name));
        let all = KEYS.iter().zip(&by_key).find_map(|(key, found)| found.get(&key(&name)));
        let is_same = |i: &usize| !are_apart(&name, &stems[*i]) && !are_of_sides(&path, &stems[*i]);
        let is_strict = |i: &usize| KEYS[..2].iter().any(|key| key(&name) == key(&stems[*i]));
        let all = all.into_iter().flatten().copied().filter(|i| is_strict(i) || is_same(i));
        let all: Vec<usize> = all.collect();
        let pngs: Vec<usize> = all.iter().copied().filter(|&i| has_ending(&files[i], &["png"])).collect();
        if pngs.len() == 1 { pngs } else { all }
    };
    let fits: Vec<Vec<usize>> = names.iter().zip(paths).map(fitting).collect();
    let mut users: HashMap<usize, usize> = HashMap::new();
    fits.iter().flatten().for_each(|&file| *users.entry(file).or_default() += 1);
    let only = |fits: &Vec<usize>| match fits[..] {
        [file] if users[&file] == 1 => Some(file),
        _ => None,
    };
    let paired: Vec<Option<usize>> = fits.iter().map(only).collect();
    let doubtful = (0..names.len()).filter(|&i| paired[i].is_none() && !fits[i].is_empty()).collect();
    let numbered = stems.iter().filter(|stem| is_number(plain(last(stem)))).count();
    let is_by_number = |(name, file): (&String, &Option<usize>)| {
        let name = fold(name);
        let (a, b) = (last(&name), file.map_or("", |file| last(&stems[file])));
        is_number(plain(a)) && plain(a) == plain(b) && without_words(a) != without_words(b)
    };
    let by_number = names.iter().zip(&paired).any(is_by_number).then_some(numbered);
    Pairs { files: paired, doubtful, by_number }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paired(names: &[&str], files: &[&str]) -> (Vec<Option<usize>>, Vec<usize>) {
        let owned = |all: &[&str]| all.iter().map(|s| s.to_string()).collect::<Vec<_>>();
        let pairs = pair(&owned(names), &owned(files));
        (pairs.files, pairs.doubtful)
    }

    #[test]
    fn numbers_alone_pair_all_names_or_all_files_and_never_two_sides() {
        let owned = |all: &[&str]| all.iter().map(|s| s.to_string()).collect::<Vec<_>>();
        let sure = |names: &[&str], files: &[&str]| pair(&owned(names), &owned(files)).is_sure();
        assert!(sure(&["000", "001"], &["0.png", "1.png"]));
        assert!(sure(&["000", "001"], &["0.png", "1.png", "2.png", "all.png"]));
        assert!(sure(&["000", "001", "002", "003"], &["0.png", "1.png", "3.png", "all.png"]));
        assert!(!sure(&["000", "002", "004", "006"], &["0000.png", "0001.png", "0002.png", "0003.png"]));
        assert!(!sure(&["000", "001", "002"], &["1.png", "2.png", "3.png"]));
        // with a word and the same zeros it is the name
        assert!(sure(&["rgb_000", "rgb_002"], &["mask_000.png", "mask_001.png"]));
        assert_eq!(paired(&["left/07", "right/07"], &["left/07_mask.png"]), (vec![Some(0), None], vec![]));
        let below =
            |path: &str| pair_below(&owned(&["07"]), &owned(&[path]), &owned(&["left/07.png"])).count();
        assert_eq!((below("images/left/07"), below("images/right/07"), below("images/07")), (1, 0, 1));
    }

    #[test]
    fn each_name_takes_the_file_that_fits_it_best_and_no_two_the_same() {
        assert_eq!(
            paired(&["000", "001"], &["001_mask.png", "000_mask.PNG"]),
            (vec![Some(1), Some(0)], vec![])
        );
        // the name itself before the name with a word, PNG before JPEG
        assert_eq!(paired(&["a"], &["a_mask.png", "a.jpg", "a.png"]), (vec![Some(2)], vec![]));
        assert_eq!(
            paired(&["left/07", "right/07"], &["right_07.png", "left/07.jpg"]),
            (vec![Some(1), Some(0)], vec![])
        );
        assert_eq!(paired(&["rgb_010", "rgb_011"], &["mask_10.png"]), (vec![Some(0), None], vec![]));
        // two files for a name, and a file for two names
        assert_eq!(paired(&["a"], &["a_mask.png", "a_alpha.png"]), (vec![None], vec![0]));
        assert_eq!(paired(&["left/07", "right/07"], &["07.png"]), (vec![None, None], vec![0, 1]));
    }
}
