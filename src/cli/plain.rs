//! Text of others on a terminal: names and messages out of files do what text does, and nothing else.

use std::borrow::Cow;
use std::fmt::Write;

/// The text without what moves cursors, colors or turns lines around, as JSON would write it, so that JSON stays the
/// same. Lines and tabs stay.
pub(super) fn plain(text: &str) -> Cow<'_, str> {
    escaped(text, |c| acts(c) && c != '\n' && c != '\t')
}

/// The same as one line, for what stands among others.
pub(super) fn one_line(text: &str) -> Cow<'_, str> {
    escaped(text, acts)
}

/// The same, each line after the first indented: none looks like a line of our own.
pub(super) fn indented(text: &str) -> String {
    let mut lines = String::with_capacity(text.len());
    for (i, line) in plain(text).split('\n').enumerate() {
        if i > 0 {
            lines += if line.is_empty() || line.starts_with("  ") { "\n" } else { "\n  " };
        }
        lines += line;
    }
    lines
}

/// Controls, line separators, and what changes the direction of writing.
fn acts(c: char) -> bool {
    c.is_control() || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

fn escaped(text: &str, out: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&out) {
        return Cow::Borrowed(text);
    }
    let mut clean = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        match c {
            '\n' if out(c) => clean += "\\n",
            _ if out(c) => {
                let _ = write!(clean, "\\u{:04x}", u32::from(c));
            }
            _ => clean.push(c),
        }
    }
    Cow::Owned(clean)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_would_act_on_a_terminal_is_written_out() {
        let foul = "head\x1b[2J\u{9b}31m\r\u{202e}a\tb\nhint: no";
        assert_eq!(plain(foul), "head\\u001b[2J\\u009b31m\\u000d\\u202ea\tb\nhint: no");
        assert_eq!(one_line(foul), "head\\u001b[2J\\u009b31m\\u000d\\u202ea\\u0009b\\nhint: no");
        assert_eq!(indented("a\nhint: no\n  b"), "a\n  hint: no\n  b");
        assert!(matches!(plain("Größe × 3\n"), Cow::Borrowed(_)));
    }

    #[test]
    fn json_means_the_same_afterwards() {
        let value = serde_json::json!({"name": "a\x1b\u{9b}\u{2028}\n"});
        let clean = plain(&value.to_string()).into_owned();
        assert!(!clean.contains('\u{9b}'));
        assert_eq!(serde_json::from_str::<serde_json::Value>(&clean).unwrap(), value);
    }
}
