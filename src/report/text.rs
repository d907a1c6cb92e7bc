//! Values as text of reports: durations, figures, addresses, and what other formats want escaped.

use base64::prelude::{BASE64_STANDARD, Engine};
use serde_json::Value;
use std::path::{Path, PathBuf};
use tiface_base::io;

/// Returns a text as a quoted field of comma-separated values.
pub(super) fn csv_text(text: &str) -> String {
    // spreadsheets take text that begins like a formula for one
    let text = if text.starts_with(['=', '+', '-', '@']) { format!("'{text}") } else { text.to_owned() };
    format!("\"{}\"", text.replace('"', "\"\""))
}

/// Returns a picture file, PNG, JPEG or SVG, as a `data:` address.
pub fn picture_url(file: &[u8]) -> String {
    let kind = match file {
        [0xFF, 0xD8, ..] => "jpeg",
        [b'<', ..] => "svg+xml",
        _ => "png",
    };
    format!("data:image/{kind};base64,{}", base64(file))
}

/// Returns a path as an address relative to the page: reserved characters are percent-encoded (RFC
/// 3986).
pub fn link(path: &str) -> String {
    let byte = |b: u8| match b {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' | b'/' => (b as char).to_string(),
        other => format!("%{other:02X}"),
    };
    path.bytes().map(byte).collect()
}

/// Returns the address of a file, relative to the folder of a page; of the file itself if one of
/// them does not exist.
pub fn relative(file: &Path, folder: &Path) -> String {
    let (Ok(file), Ok(folder)) = (io::real_path(file), io::real_path(folder)) else {
        return link(&file.to_string_lossy());
    };
    let shared = file.components().zip(folder.components()).take_while(|(a, b)| a == b).count();
    let up = folder.components().skip(shared).map(|_| Path::new(".."));
    let path: PathBuf = up.chain(file.components().skip(shared).map(|c| Path::new(c.as_os_str()))).collect();
    link(&path.to_string_lossy())
}

/// Leaves of a JSON value with dotted names, as a person reads them; lists in one row.
pub fn leaves(value: &Value) -> Vec<(String, String)> {
    let Value::Object(map) = value else {
        let text = match value {
            Value::Number(n) if n.is_f64() => format!("{:.4}", n.as_f64().unwrap_or(f64::NAN)),
            Value::Null => "–".into(),
            Value::String(s) => s.clone(),
            other => other.to_string(),
        };
        return vec![(String::new(), text)];
    };
    let inner = |(key, value): (&String, &Value)| {
        let name = |inner: String| if inner.is_empty() { key.clone() } else { format!("{key}.{inner}") };
        leaves(value).into_iter().map(|(inner, text)| (name(inner), text)).collect::<Vec<_>>()
    };
    map.iter().flat_map(inner).collect()
}

/// `8.2 s`, `2 min 25 s`, `3 h 07 min`.
pub fn duration(seconds: f64) -> String {
    let s = seconds.max(0.0);
    let whole = s.round() as u64;
    match whole {
        0..10 => format!("{s:.1} s"),
        10..60 => format!("{whole} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

/// Text for between and inside the tags of a page.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// RFC 4648, with padding.
pub(crate) fn base64(bytes: &[u8]) -> String {
    BASE64_STANDARD.encode(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_a_path_and_nothing_else() {
        assert_eq!(link("render/tface/a b.png"), "render/tface/a%20b.png");
        assert_eq!(link("javascript:x#?%ü"), "javascript%3Ax%23%3F%25%C3%BC");
    }

    #[test]
    fn times_are_short() {
        assert_eq!(
            [8.24, 59.6, 145.0, 11_220.0].map(duration),
            ["8.2 s", "1 min 00 s", "2 min 25 s", "3 h 07 min"]
        );
    }
}
