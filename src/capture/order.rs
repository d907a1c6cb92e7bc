//! The order of pictures that a camera file does not name: by the bytes of their names, or by number.

use std::cmp::Ordering;

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

/// Returns names in their order by number, `view2` before `view10`, which are the other way round by their bytes.
pub fn by_number(names: &[String]) -> Vec<String> {
    let mut sorted = names.to_vec();
    sorted.sort_by(|a, b| compare(a, b));
    sorted
}

/// Returns the last number in the name of a file without its ending; leading zeros do not count.
pub(super) fn last_number(path: &str) -> Option<&str> {
    let numbers = stem(path).split(|c: char| !c.is_ascii_digit()).filter(|number| !number.is_empty());
    Some(numbers.last()?.trim_start_matches('0'))
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
    fn the_last_number_of_a_name_is_read_without_zeros_and_ending() {
        assert_eq!(last_number("image/cam2_0010.jp2"), Some("10"));
        assert_eq!((last_number("mask/000.png"), last_number("mask/a.png")), (Some(""), None));
    }
}
