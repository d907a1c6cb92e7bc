//! Names in glTF: URIs of data, and names of files with `%20` for a blank.

use base64::prelude::{BASE64_STANDARD, Engine};

/// Returns the bytes of a data URI in Base64: `None` if it is the name of a file, `Some(None)` if
/// it is damaged.
pub(super) fn data_of_uri(uri: &str) -> Option<Option<Vec<u8>>> {
    let (kind, data) = uri.strip_prefix("data:")?.split_once(',').unwrap_or_default();
    Some(kind.ends_with("base64").then(|| BASE64_STANDARD.decode(data.trim()).ok()).flatten())
}

/// Returns the name of a file in a URI, its `%XX` decoded.
pub(super) fn name_of_uri(uri: &str) -> String {
    let (bytes, mut at, mut out) = (uri.as_bytes(), 0, Vec::with_capacity(uri.len()));
    while at < bytes.len() {
        let code = bytes.get(at + 1..at + 3).filter(|_| bytes[at] == b'%');
        let code = code.filter(|code| code.iter().all(u8::is_ascii_hexdigit));
        let code = code.and_then(|code| u8::from_str_radix(std::str::from_utf8(code).ok()?, 16).ok());
        out.push(code.unwrap_or(bytes[at]));
        at += if code.is_some() { 3 } else { 1 };
    }
    String::from_utf8_lossy(&out).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blank_in_a_uri_is_a_blank_in_the_name() {
        assert_eq!(name_of_uri("my%20head.png"), "my head.png");
        assert_eq!(name_of_uri("100%.png"), "100%.png");
        assert_eq!(name_of_uri("a%2"), "a%2");
        assert_eq!(name_of_uri("%C3%A4.png"), "ä.png");
    }

    #[test]
    fn data_is_told_from_names() {
        assert_eq!(data_of_uri("data:image/png;base64,AAEC"), Some(Some(vec![0, 1, 2])));
        assert_eq!(data_of_uri("data:image/png;base64,?"), Some(None));
        assert_eq!(data_of_uri("data:text/plain,a"), Some(None));
        assert_eq!(data_of_uri("data.bin"), None);
    }
}
