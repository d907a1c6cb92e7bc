//! The order of pictures that a camera file does not name: by the bytes of their names, or by
//! number.

use std::cmp::Ordering;
use std::collections::BTreeMap;

/// Splits the digits off that a text begins with.
fn digits(text: &str) -> (&str, &str) {
    text.split_at(text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len()))
}

/// Compares names by their bytes, but where both have a number by its value.
pub(super) fn compare(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (a, b);
    loop {
        let ((m, behind_m), (n, behind_n)) = (digits(left), digits(right));
        if !m.is_empty() && !n.is_empty() {
            let [m, n] = [m, n].map(|digits| digits.trim_start_matches('0'));
            match m.len().cmp(&n.len()).then(m.cmp(n)) {
                Ordering::Equal => (left, right) = (behind_m, behind_n),
                differs => return differs,
            }
            continue;
        }
        let (mut c, mut d) = (left.chars(), right.chars());
        match (c.next(), d.next()) {
            (None, None) => return a.cmp(b), // one number may be written in several ways
            (c, d) if c != d => return c.cmp(&d),
            _ => (left, right) = (c.as_str(), d.as_str()),
        }
    }
}

/// Returns names in their order by number, `view2` before `view10`, which are the other way round
/// by their bytes.
pub fn by_number(names: &[String]) -> Vec<String> {
    let mut sorted = names.to_vec();
    sorted.sort_by(|a, b| compare(a, b));
    sorted
}

/// Returns whether files in the order of their names have another one by number, which takes names
/// that differ in their numbers alone: those of a quarter of the files at least, such as one of
/// four rings. Random names have no order by number.
pub(super) fn is_open(sorted: &[String]) -> bool {
    let mut alike: BTreeMap<String, Vec<&str>> = BTreeMap::new();
    for name in sorted {
        alike.entry(without_numbers(stem(name))).or_default().push(name);
    }
    let differs = |names: &Vec<&str>| !names.is_sorted_by(|a, b| compare(a, b).is_le());
    alike.values().any(|names| 4 * names.len() >= sorted.len() && differs(names))
}

/// Returns a name with `#` for each number.
fn without_numbers(name: &str) -> String {
    let mut text = String::new();
    for c in name.chars() {
        match c {
            '0'..='9' if text.ends_with('#') => {}
            '0'..='9' => text.push('#'),
            c => text.push(c),
        }
    }
    text
}

/// Returns the last number in the name of a file without its ending; leading zeros do not count.
pub(super) fn last_number(path: &str) -> Option<&str> {
    let mut numbers = stem(path).split(|c: char| !c.is_ascii_digit()).filter(|number| !number.is_empty());
    Some(numbers.next_back()?.trim_start_matches('0'))
}

/// Returns the name of a file without its folder and its ending.
pub(super) fn stem(path: &str) -> &str {
    let name = path.rsplit('/').next().unwrap_or(path);
    name.rsplit_once('.').map_or(name, |(stem, _)| stem)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(text: &str) -> Vec<String> {
        text.split(' ').map(str::to_string).collect()
    }

    #[test]
    fn names_follow_by_number_wherever_the_number_stands() {
        for (bytes, number) in [
            ("0.jpg 1.jpg 10.jpg 2.jpg", "0.jpg 1.jpg 2.jpg 10.jpg"),
            ("view10.png view2.png", "view2.png view10.png"),
            ("a10b2 a10b10 a9b1", "a9b1 a10b2 a10b10"),
            ("000.png 001.png 010.png", "000.png 001.png 010.png"),
            // more digits than any integer has
            (
                "99999999999999999999999 100000000000000000000000",
                "99999999999999999999999 100000000000000000000000",
            ),
            // one number written twice keeps the order of bytes
            ("1 01 x", "01 1 x"),
            // what has no number stays where its bytes have it
            ("a.png a1.png a b", "a a.png a1.png b"),
        ] {
            assert_eq!(by_number(&names(bytes)), names(number));
        }
    }

    #[test]
    fn an_order_by_number_is_another_one_only_where_names_differ_by_numbers() {
        for (sorted, open) in [
            ("0.jpg 1.jpg 10.jpg 2.jpg", true),
            ("cover.jpg view1.png view10.png view2.png", true),
            ("l1 l10 l2 r1 r10 r2", true),
            ("00.jpg 01.jpg 02.jpg 10.jpg", false),
            ("8.png 9.png", false),
            ("1a2f 1b3 10c 2d", false),
            ("", false),
        ] {
            assert_eq!(is_open(&names(sorted)), open, "{sorted}");
        }
    }

    #[test]
    fn the_last_number_of_a_name_is_read_without_zeros_and_ending() {
        assert_eq!(last_number("image/cam2_0010.jp2"), Some("10"));
        assert_eq!((last_number("mask/000.png"), last_number("mask/a.png")), (Some(""), None));
    }
}
