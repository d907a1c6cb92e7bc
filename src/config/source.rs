//! From files and `--set` to a [`Config`]: which value wins, and what is wrong with one.

use super::{Config, Key, Preset, all_keys, lookup, show};
use serde::Deserialize;
use std::fmt;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// Where values come from, weakest first.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    /// `--preset`; beats the `preset` of any file.
    pub preset: Option<Preset>,
    /// Configuration files: name for messages, text.
    pub files: Vec<(String, String)>,
    /// `--set`: each `key=value`.
    pub set: Vec<String>,
    /// Options with a name of their own: as typed, the key they set, its value. Strongest.
    pub options: Vec<(String, String, String)>,
}

/// Where a value was given.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// In a file, at a line counted from 1.
    File {
        /// As it was named.
        name: String,
        /// Counted from 1.
        line: usize,
    },
    /// By an option of the command line.
    Option(String),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Place::File { name, line } => write!(f, "`{name}`, line {line}"),
            Place::Option(option) => write!(f, "`{option}`"),
        }
    }
}

/// What is wrong with a configuration.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// Not TOML, or not `key=value`.
    #[error("{place}: {problem}")]
    Syntax {
        /// Where.
        place: Place,
        /// What the parser says.
        problem: String,
    },
    /// No such key.
    #[error("{place}: there is no key `{key}`")]
    Unknown {
        /// Where.
        place: Place,
        /// As written.
        key: String,
        /// The known key most like it.
        nearest: Option<String>,
    },
    /// A key of another type.
    #[error("{place}: `{key}` is {expected}, found {found}")]
    Type {
        /// Where.
        place: Place,
        /// The key.
        key: String,
        /// Expected type, with its article.
        expected: &'static str,
        /// The value as written.
        found: String,
    },
    /// A number out of range.
    #[error("{place}: `{key}` is {found}, allowed is {range}")]
    Range {
        /// Where.
        place: Place,
        /// The key.
        key: String,
        /// The value.
        found: String,
        /// `1 to 64`.
        range: String,
    },
    /// A word that means nothing here.
    #[error("{place}: `{key}`: {problem}")]
    Word {
        /// Where.
        place: Place,
        /// The key.
        key: String,
        /// What was found and what is known.
        problem: String,
    },
}

crate::error::error_from!(ConfigError, Usage);

impl ConfigError {
    pub(super) fn unknown(place: Place, key: &str) -> ConfigError {
        ConfigError::Unknown { place, key: key.into(), nearest: nearest(key) }
    }

    /// The way out.
    pub fn hint(&self) -> String {
        match self {
            ConfigError::Syntax { .. } => "write `table.key = value`; words in double quotes".into(),
            ConfigError::Unknown { nearest: Some(name), .. } => {
                format!("did you mean `{name}`? `tiface config` lists all keys")
            }
            ConfigError::Unknown { .. } => "`tiface config` lists all keys".into(),
            ConfigError::Type { key, .. }
            | ConfigError::Range { key, .. }
            | ConfigError::Word { key, .. } => {
                format!("`tiface config --explain {key}` says what it means")
            }
        }
    }
}

/// A value as given, before its type is known to fit.
enum Given {
    Toml(Value),
    /// From `--set`, where words need no quotes and lists no brackets.
    Text(String),
}

type Assignment = (String, Given, Place);

pub(super) fn resolve(sources: &Sources) -> Result<Config, ConfigError> {
    let mut given: Vec<Assignment> = Vec::new();
    for (name, text) in &sources.files {
        read_file(name, text, &mut given)?;
    }
    for set in &sources.set {
        let place = Place::Option(format!("--set {set}"));
        let Some((key, value)) = set.split_once('=') else {
            return Err(ConfigError::Syntax { place, problem: "expected KEY=VALUE".into() });
        };
        given.push((key.trim().into(), Given::Text(value.trim().into()), place));
    }
    for (typed, key, value) in &sources.options {
        given.push((key.clone(), Given::Text(value.clone()), Place::Option(typed.clone())));
    }

    // the preset comes first whatever line it stands on; what it means is checked by `assign` below
    let named = given.iter().rfind(|(key, ..)| key == "preset").and_then(|(_, value, _)| {
        let word = match value {
            Given::Toml(value) => value.as_str()?,
            Given::Text(text) => text.trim_matches('"'),
        };
        Preset::deserialize(Value::String(word.into())).ok()
    });
    let preset = sources.preset.or(named).unwrap_or_default();
    let mut config = Config::preset(preset);
    for (key, value, place) in given {
        config = assign(&config, &key, value, place)?;
    }
    Ok(Config { preset, ..config }.keep_constants())
}

fn read_file(name: &str, text: &str, given: &mut Vec<Assignment>) -> Result<(), ConfigError> {
    let text = text.strip_prefix('\u{FEFF}').unwrap_or(text);
    let line_at =
        |offset: usize| text.as_bytes()[..offset.min(text.len())].iter().filter(|&&b| b == b'\n').count() + 1;
    let place = |offset| Place::File { name: name.into(), line: line_at(offset) };
    let root = DeTable::parse(text).map_err(|e| ConfigError::Syntax {
        place: place(e.span().map_or(0, |s| s.start)),
        problem: e.message().to_string(),
    })?;
    // plain values once more, where a date or an odd integer has already become what it is
    let plain: Table = toml::from_str(text).map_err(|e| ConfigError::Syntax {
        place: place(e.span().map_or(0, |s| s.start)),
        problem: e.message().to_string(),
    })?;
    let mut found: Vec<(usize, String)> = Vec::new();
    walk(root.get_ref(), "", &mut found);
    found.sort(); // as they stand in the file
    for (offset, key) in found {
        if let Some(value) = lookup(&plain, &key) {
            given.push((key, Given::Toml(value.clone()), place(offset)));
        } else {
            // a key with a dot inside quotes: no key of ours
            return Err(ConfigError::unknown(place(offset), &key));
        }
    }
    Ok(())
}

/// Leaves of a table with the offset of their key; a table that is itself a leaf's name stays whole.
fn walk(table: &DeTable, prefix: &str, found: &mut Vec<(usize, String)>) {
    for (key, value) in table {
        let full = super::dotted(prefix, key.get_ref());
        match value.get_ref() {
            DeValue::Table(inner) if !inner.is_empty() => walk(inner, &full, found),
            DeValue::Table(_) if is_table(&full) => {}
            _ => found.push((key.span().start, full)),
        }
    }
}

fn is_table(name: &str) -> bool {
    super::TABLES.iter().any(|(table, _)| *table == name)
}

/// `config` with one key changed.
fn assign(config: &Config, key: &str, given: Given, place: Place) -> Result<Config, ConfigError> {
    let mut root = config.to_table();
    let known = all_keys().find(|(name, _)| name == key);
    let (Some((_, about)), Some(old)) = (known, lookup(&root, key)) else {
        return Err(ConfigError::unknown(place, key));
    };
    let found = match &given {
        Given::Toml(value) => show(value),
        Given::Text(text) => format!("`{text}`"),
    };
    let Some(value) = fit(old, given) else {
        return Err(ConfigError::Type { place, key: key.into(), expected: kind(old), found });
    };
    check_range(about, &value).map_err(|found| ConfigError::Range {
        place: place.clone(),
        key: key.into(),
        found,
        range: about.range(),
    })?;
    if let Some(word) = value.as_str().filter(|w| w.starts_with('~')) {
        let problem = format!("`{word}`: `~` is a word of the shell; write the whole path");
        return Err(ConfigError::Word { place, key: key.into(), problem });
    }
    if key == "device"
        && let Some(word) = value.as_str().filter(|w| !is_device(w))
    {
        let problem = format!("unknown device `{word}`, expected auto, cpu, wgpu:N or cuda:N");
        return Err(ConfigError::Word { place, key: key.into(), problem });
    }
    put(&mut root, key, value);
    Config::deserialize(Value::Table(root)).map_err(|e| {
        let problem = e.message().lines().next().unwrap_or_default().to_string();
        ConfigError::Word { place, key: key.into(), problem }
    })
}

/// `given` as a value of the same type as `old`, if it can be one.
fn fit(old: &Value, given: Given) -> Option<Value> {
    let parsed = match (&given, old) {
        (Given::Toml(value), _) => value.clone(),
        (Given::Text(text), Value::String(_)) => {
            let quoted = text.len() >= 2 && text.starts_with('"') && text.ends_with('"');
            return Some(Value::String(if quoted { text[1..text.len() - 1].into() } else { text.clone() }));
        }
        (Given::Text(text), Value::Array(_)) if !text.starts_with('[') => {
            let items = text.split(',').map(str::trim).filter(|t| !t.is_empty());
            return Some(Value::Array(items.map(|t| scalar(t).unwrap_or(Value::String(t.into()))).collect()));
        }
        (Given::Text(text), _) => scalar(text)?,
    };
    match (old, parsed) {
        (Value::Float(_), Value::Integer(i)) => Some(Value::Float(i as f64)),
        // 2e4 is how people write twenty thousand
        (Value::Integer(_), Value::Float(f)) if f.fract() == 0.0 && f.abs() < 9e15 => {
            Some(Value::Integer(f as i64))
        }
        (old, parsed) if std::mem::discriminant(old) == std::mem::discriminant(&parsed) => Some(parsed),
        _ => None,
    }
}

/// A TOML value given alone.
fn scalar(text: &str) -> Option<Value> {
    toml::from_str::<Table>(&format!("v = {text}")).ok()?.remove("v")
}

fn check_range(key: &Key, value: &Value) -> Result<(), String> {
    let number = match value {
        Value::Integer(i) => *i as f64,
        Value::Float(f) => *f,
        Value::Array(items) => {
            return items.iter().try_for_each(|item| check_range(key, item));
        }
        _ => return Ok(()),
    };
    // NaN is in no range; a number without a range must still be finite
    let inside = number >= key.min && number <= key.max && number.is_finite();
    if inside { Ok(()) } else { Err(show(value)) }
}

fn is_device(word: &str) -> bool {
    match word.split_once(':') {
        Some(("wgpu" | "cuda", n)) => n.parse::<u32>().is_ok(),
        _ => matches!(word, "auto" | "cpu" | "wgpu" | "cuda"),
    }
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a word in quotes",
        Value::Integer(_) => "an integer",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Array(_) => "a list",
        Value::Table(_) => "a table",
        Value::Datetime(_) => "a date",
    }
}

fn put(root: &mut Table, dotted: &str, value: Value) {
    match dotted.split_once('.') {
        None => {
            root.insert(dotted.into(), value);
        }
        Some((table, rest)) => {
            if let Some(Value::Table(inner)) = root.get_mut(table) {
                put(inner, rest, value);
            }
        }
    }
}

/// The known key most like `key`, by its full name or by its last word, if any is like it at all.
fn nearest(key: &str) -> Option<String> {
    let last = |name: &str| name.rsplit('.').next().unwrap_or_default().to_string();
    all_keys()
        .map(|(name, _)| {
            let whole = strsim::levenshtein(key, &name);
            let word = strsim::levenshtein(&last(key), &last(&name)) + usize::from(!name.ends_with(key));
            (whole.min(word), name)
        })
        .min()
        .filter(|(distance, _)| *distance <= 2 + key.len() / 4)
        .map(|(_, name)| name)
}
