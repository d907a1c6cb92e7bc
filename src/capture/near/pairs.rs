//! Pairs of names and files: which file of a folder belongs to which view.

use super::names::{bare, fold, has_ending, plain, without_ending};
use std::collections::HashMap;

/// The file of each name.
pub struct Pairs {
    /// Where exactly one file fits, its place in the list of files.
    pub files: Vec<Option<usize>>,
    /// Names that several files fit, or whose file fits another name as well.
    pub doubtful: Vec<usize>,
}

impl Pairs {
    /// Returns how many names have a file.
    pub fn count(&self) -> usize {
        self.files.iter().flatten().count()
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
const KEYS: [fn(&str) -> String; 3] = [
    |stem| stem.into(),
    |stem| bare(&stem.replace('/', "_")).0.into(),
    |stem| plain(stem.rsplit('/').next().unwrap_or_default()).into(),
];

/// Pairs names without ending, such as `left/07`, with files below a folder, such as
/// `left/07_mask.png`. Each name takes the strictest way in which any file fits; a PNG is preferred
/// to other formats.
pub fn pair(names: &[String], files: &[String]) -> Pairs {
    let stems: Vec<String> = files.iter().map(|file| fold(without_ending(file).0)).collect();
    let by_key = KEYS.map(|key| {
        let mut found: HashMap<String, Vec<usize>> = HashMap::new();
        for (i, stem) in stems.iter().enumerate() {
            found.entry(key(stem)).or_default().push(i);
        }
        found
    });
    let fitting = |name: &String| -> Vec<usize> {
        let name = fold(name);
        let all = KEYS.iter().zip(&by_key).find_map(|(key, found)| found.get(&key(&name)));
        let all = all.map(Vec::as_slice).unwrap_or_default();
        let pngs: Vec<usize> = all.iter().copied().filter(|&i| has_ending(&files[i], &["png"])).collect();
        if pngs.len() == 1 { pngs } else { all.to_vec() }
    };
    let fits: Vec<Vec<usize>> = names.iter().map(fitting).collect();
    let mut users: HashMap<usize, usize> = HashMap::new();
    fits.iter().flatten().for_each(|&file| *users.entry(file).or_default() += 1);
    let only = |fits: &Vec<usize>| match fits[..] {
        [file] if users[&file] == 1 => Some(file),
        _ => None,
    };
    let paired: Vec<Option<usize>> = fits.iter().map(only).collect();
    let doubtful = (0..names.len()).filter(|&i| paired[i].is_none() && !fits[i].is_empty()).collect();
    Pairs { files: paired, doubtful }
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
