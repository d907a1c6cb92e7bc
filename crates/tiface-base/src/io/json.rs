//! JSON as untrusted input: bounded in bytes, depth and values, every key once, every number
//! finite.

use super::limits::Limits;
use super::read::read_capped;
use super::read_error::ReadError;
use serde::de::{Deserialize, DeserializeOwned, DeserializeSeed, Error, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};
use std::cell::Cell;
use std::fmt;
use std::path::Path;

const SIZE: &str = "the JSON text's size in bytes";

/// As [`super::read_bytes`], under [`Limits::json_bytes`], parsed by [`parse_json`].
pub fn read_json(path: &Path, limits: &Limits) -> Result<Value, ReadError> {
    parse_json(path, &read_capped(path, limits.json_bytes, SIZE)?, limits)
}

/// As [`read_json`], as a value of a type. What does not fit is named with its key
/// ([`ReadError::Value`]).
pub fn read_typed<T: DeserializeOwned>(path: &Path, limits: &Limits) -> Result<T, ReadError> {
    typed(&read_json(path, limits)?)
        .map_err(|[key, found, expected]| ReadError::value(path, key, found, expected))
}

/// Converts a JSON value to a type, or returns the key that does not fit, its value and what was
/// expected, in plain words.
pub fn typed<'v, T: Deserialize<'v>>(value: &'v Value) -> Result<T, [String; 3]> {
    serde_path_to_error::deserialize(value).map_err(|e| {
        let (key, text) = (e.path().to_string(), e.inner().to_string());
        if let Some(field) = text.strip_prefix("missing field `").and_then(|t| t.strip_suffix('`')) {
            let key = if key == "." { field.to_string() } else { format!("{key}.{field}") };
            return [key, "missing".into(), "a value".into()];
        }
        let (found, expected) = text.split_once(", expected ").unwrap_or((&text, "another value"));
        let found = found.trim_start_matches("invalid type: ").trim_start_matches("invalid value: ");
        [key, in_plain_words(found), in_plain_words(expected)]
    })
}

/// Translates serde's names of values and types for readers without knowledge of Rust.
fn in_plain_words(serde: &str) -> String {
    let value = |kind: &str| serde.strip_prefix(kind)?.strip_prefix(" `")?.strip_suffix('`');
    if let Some(value) = ["integer", "floating point", "boolean"].into_iter().find_map(value) {
        return value.into();
    }
    if let Some(text) = serde.strip_prefix("string \"") {
        return format!("\"{text}");
    }
    let count = ["an array of length ", "invalid length "].into_iter().find_map(|p| serde.strip_prefix(p));
    if let Some(count) = count {
        return format!("a list of {count}");
    }
    match serde {
        "f32" | "f64" => "a number",
        "u8" | "u16" | "u32" | "u64" | "usize" | "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
        "a boolean" => "true or false",
        "a string" => "text",
        "sequence" | "a sequence" => "a list",
        "map" | "a map" => "an object",
        other if other.starts_with("struct ") => "an object",
        other => other,
    }
    .into()
}

/// Returns the value in `bytes`; `path` is only for messages.
///
/// A byte order mark and CRLF are accepted. Refused with line and column: duplicate keys (a second
/// `frames` would silently hide the first), `NaN` and `Infinity` literals, numbers that overflow
/// f64, nesting or counts over the limits, anything after the value.
pub fn parse_json(path: &Path, bytes: &[u8], limits: &Limits) -> Result<Value, ReadError> {
    if bytes.len() as u64 > limits.json_bytes {
        return Err(ReadError::too_large(path, SIZE, bytes.len() as u64, limits.json_bytes));
    }
    if bytes.starts_with(&[0xFF, 0xFE]) || bytes.starts_with(&[0xFE, 0xFF]) {
        return Err(ReadError::unsupported(path, "JSON in UTF-16", "save the file as UTF-8"));
    }
    let bytes = bytes.strip_prefix(&[0xEF, 0xBB, 0xBF]).unwrap_or(bytes);
    let left = Cell::new(limits.json_values);
    let mut reader = serde_json::Deserializer::from_slice(bytes);
    let seed = BoundedValue { depth: limits.json_depth, left: &left };
    seed.deserialize(&mut reader).and_then(|value| reader.end().map(|()| value)).map_err(|e| {
        let problem = literal_at(bytes, e.line(), e.column()).unwrap_or_else(|| {
            let text = e.to_string();
            text.rsplit_once(" at line ").map_or(text.clone(), |(problem, _)| problem.into())
        });
        ReadError::Json { path: path.into(), line: e.line(), column: e.column(), problem }
    })
}

/// Returns the message for a Python-style literal near the place where parsing stopped.
fn literal_at(bytes: &[u8], line: usize, column: usize) -> Option<String> {
    let text = bytes.split(|&b| b == b'\n').nth(line.checked_sub(1)?)?;
    let near = &text[column.saturating_sub(2).min(text.len())..];
    for literal in ["NaN", "Infinity"] {
        if near.windows(literal.len()).take(3).any(|w| w == literal.as_bytes()) {
            return Some(format!("`{literal}` is not a number in JSON, and not one that can be used"));
        }
    }
    None
}

#[derive(Clone, Copy)]
struct BoundedValue<'a> {
    depth: usize,
    left: &'a Cell<usize>,
}

impl BoundedValue<'_> {
    fn inner<E: Error>(self) -> Result<Self, E> {
        match self.depth.checked_sub(1) {
            Some(depth) => Ok(BoundedValue { depth, ..self }),
            None => Err(E::custom("nested too deeply")),
        }
    }
}

impl<'de> DeserializeSeed<'de> for BoundedValue<'_> {
    type Value = Value;

    fn deserialize<D: serde::Deserializer<'de>>(self, reader: D) -> Result<Value, D::Error> {
        match self.left.get().checked_sub(1) {
            Some(left) => self.left.set(left),
            None => return Err(D::Error::custom("too many values in one file")),
        }
        reader.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for BoundedValue<'_> {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a JSON value")
    }

    fn visit_bool<E: Error>(self, v: bool) -> Result<Value, E> {
        Ok(v.into())
    }

    fn visit_i64<E: Error>(self, v: i64) -> Result<Value, E> {
        Ok(v.into())
    }

    fn visit_u64<E: Error>(self, v: u64) -> Result<Value, E> {
        Ok(v.into())
    }

    fn visit_f64<E: Error>(self, v: f64) -> Result<Value, E> {
        serde_json::Number::from_f64(v).map(Value::Number).ok_or_else(|| E::custom("number out of range"))
    }

    fn visit_str<E: Error>(self, v: &str) -> Result<Value, E> {
        Ok(v.into())
    }

    fn visit_unit<E: Error>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
        let inner = self.inner()?;
        let mut list = Vec::new();
        while let Some(item) = items.next_element_seed(inner)? {
            list.push(item);
        }
        Ok(list.into())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Value, A::Error> {
        let inner = self.inner()?;
        let mut map = Map::new();
        while let Some(key) = entries.next_key::<String>()? {
            if map.contains_key(&key) {
                return Err(A::Error::custom(format!("the key `{key}` appears twice")));
            }
            let value = entries.next_value_seed(inner)?;
            map.insert(key, value);
        }
        Ok(map.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Value, ReadError> {
        parse_json(Path::new("t.json"), text.as_bytes(), &Limits::default())
    }

    #[test]
    fn a_byte_order_mark_and_crlf_change_nothing() {
        let plain = parse("{\"a\": [1, 2.5, null],\n \"b\": \"x\"}").unwrap();
        let other = parse("\u{FEFF}{\"a\": [1, 2.5, null],\r\n \"b\": \"x\"}").unwrap();
        assert_eq!(plain, other);
    }

    #[test]
    fn a_duplicate_key_is_named_with_its_place() {
        let error = parse("{\n  \"w\": 1,\n  \"w\": 2}").unwrap_err();
        assert!(matches!(error, ReadError::Json { line: 3, .. }), "{error}");
        assert!(error.to_string().contains("`w` appears twice"), "{error}");
    }

    #[test]
    fn literals_that_are_no_numbers_are_named_with_their_place() {
        for (text, literal) in [("[1,\n NaN]", "NaN"), ("[1,\n -Infinity]", "Infinity")] {
            let error = parse(text).unwrap_err();
            assert!(matches!(error, ReadError::Json { line: 2, .. }), "{error}");
            assert!(error.to_string().contains(literal), "{error}");
        }
        assert!(parse("[1e999]").is_err());
    }

    #[test]
    fn nesting_is_allowed_to_the_limit_and_no_further() {
        let nested = |n: usize| "[".repeat(n) + &"]".repeat(n);
        assert!(parse(&nested(64)).is_ok());
        let error = parse(&nested(65)).unwrap_err();
        assert!(error.to_string().contains("nested too deeply"), "{error}");
        assert!(parse(&nested(1_000_000)).is_err());
    }

    #[test]
    fn a_value_of_another_type_is_named_in_plain_words() {
        fn refused<T: DeserializeOwned>(text: &str) -> String {
            let Err([key, found, expected]) = typed::<T>(&parse(text).unwrap()) else {
                panic!("{text} fits")
            };
            format!("{key}: {found}, not {expected}")
        }
        type Named<T> = std::collections::BTreeMap<String, T>;
        assert_eq!(refused::<Named<f32>>(r#"{"a": "wide"}"#), r#"a: "wide", not a number"#);
        assert_eq!(refused::<Named<u32>>(r#"{"a": -1}"#), "a: -1, not a whole number");
        assert_eq!(refused::<Named<usize>>(r#"{"a": 2.5}"#), "a: 2.5, not a whole number");
        assert_eq!(refused::<Named<bool>>(r#"{"a": {}}"#), "a: an object, not true or false");
        assert_eq!(refused::<Vec<String>>("[[]]"), "[0]: a list, not text");
        assert_eq!(refused::<Named<Vec<f64>>>(r#"{"a": true}"#), "a: true, not a list");
        assert_eq!(refused::<Named<[f64; 3]>>(r#"{"a": [1]}"#), "a: a list of 1, not a list of 3");
    }

    #[test]
    fn the_number_of_values_is_bounded() {
        let limits = Limits { json_values: 4, ..Limits::default() };
        // the array itself is the fourth
        assert!(parse_json(Path::new("t"), b"[1,2,3]", &limits).is_ok());
        assert!(parse_json(Path::new("t"), b"[1,2,3,4]", &limits).is_err());
    }
}
