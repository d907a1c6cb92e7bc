//! Resolves files and `--set` to a [`Config`]: precedence and validation of values.

use super::{Config, DeviceChoice, Key, Preset, all_keys, key, lookup, show};
use serde::Deserialize;
use tiface_base::{Error, Result};
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// A preset, and changes on top of it.
pub type Fallback = (Preset, fn(&mut Config));

/// Sources of values, weakest first.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    /// `--preset`; beats the `preset` of any file.
    pub preset: Option<Preset>,
    /// The start if no other source names a preset.
    pub fallback: Option<Fallback>,
    /// Configuration files: name for messages, text.
    pub files: Vec<(String, String)>,
    /// `--set`: each `key=value`.
    pub set: Vec<String>,
    /// Options of commands: as typed, the key they set, its value. Strongest.
    pub options: Vec<(String, String, String)>,
}

/// A value as written, before its type is known to fit.
enum RawValue {
    Toml(Value),
    /// From `--set`, where words need no quotes and lists no brackets.
    Text(String),
}

/// A key, its value, and its source, as the start of a message.
type Assignment = (String, RawValue, String);

pub(super) fn resolve(sources: &Sources) -> Result<Config> {
    let mut given: Vec<Assignment> = Vec::new();
    for (name, text) in &sources.files {
        read_file(name, text, &mut given)?;
    }
    for set in &sources.set {
        let place = format!("`--set {set}`");
        let Some((key, value)) = set.split_once('=') else {
            return Err(not_toml(&place, "expected KEY=VALUE"));
        };
        given.push((key.trim().into(), RawValue::Text(value.trim().into()), place));
    }
    for (typed, key, value) in &sources.options {
        given.push((key.clone(), RawValue::Text(value.clone()), format!("`{typed}`")));
    }

    // the preset comes first, on whatever line it is; `assign` checks its value below
    let named = given.iter().rfind(|(key, ..)| key == key!(preset)).and_then(|(_, value, _)| {
        let word = match value {
            RawValue::Toml(value) => value.as_str()?,
            RawValue::Text(text) => text.trim_matches('"'),
        };
        word.parse().ok()
    });
    let named = sources.preset.or(named);
    let (preset, change) = match sources.fallback {
        Some((preset, change)) if named.is_none() => (preset, Some(change)),
        _ => (named.unwrap_or_default(), None),
    };
    let mut config = Config::preset(preset);
    change.iter().for_each(|change| change(&mut config));
    for (key, value, place) in given {
        config = assign(&config, &key, value).map_err(|e| e.within(place))?;
    }
    Ok(Config { preset, ..config }.keep_constants())
}

fn not_toml(place: &str, problem: &str) -> Error {
    Error::usage(problem, "write `table.key = value`; words in double quotes").within(place)
}

/// Keys of the mesh that have become options of `tiface export`.
const EXPORT_OPTIONS: [(&str, &str); 4] = [
    ("material", "--material"),
    ("frame", "--frame"),
    ("height_m", "--height"),
    ("texture_format", "--jpeg"),
];

/// Returns the error for an unknown key, which suggests the most similar known one.
pub(super) fn unknown(key: &str) -> Error {
    let of_mesh = key.split_once('.').filter(|(table, _)| *table == "mesh");
    if let Some((_, option)) =
        of_mesh.and_then(|(_, name)| EXPORT_OPTIONS.iter().find(|(old, _)| *old == name))
    {
        let hint = format!("leave it out: it is the option `{option}` of `tiface export`");
        return Error::usage(format!("there is no key `{key}`"), hint);
    }
    let meant = nearest(key).map(|name| format!("did you mean `{name}`? ")).unwrap_or_default();
    Error::usage(format!("there is no key `{key}`"), format!("{meant}`tiface config` lists all keys"))
}

/// Returns the error for an invalid value of a key.
fn wrong(key: &str, problem: &str) -> Error {
    Error::usage(format!("`{key}`{problem}"), format!("`tiface config --explain {key}` says what it means"))
}

fn read_file(name: &str, text: &str, given: &mut Vec<Assignment>) -> Result<()> {
    let text = text.strip_prefix('\u{FEFF}').unwrap_or(text);
    let line_at =
        |offset: usize| text.as_bytes()[..offset.min(text.len())].iter().filter(|&&b| b == b'\n').count() + 1;
    let place = |offset| format!("`{name}`, line {}", line_at(offset));
    let failed = |e: toml::de::Error| not_toml(&place(e.span().map_or(0, |s| s.start)), e.message());
    let root = DeTable::parse(text).map_err(failed)?;
    // plain values once more, where a date or an odd integer has already become what it is
    let plain: Table = toml::from_str(text).map_err(failed)?;
    let mut found: Vec<(usize, String)> = Vec::new();
    walk(root.get_ref(), "", &mut found);
    found.sort(); // as they stand in the file
    for (offset, key) in found {
        // a key with a dot inside quotes is no key of ours
        let value = lookup(&plain, &key).ok_or_else(|| unknown(&key).within(place(offset)))?;
        given.push((key, RawValue::Toml(value.clone()), place(offset)));
    }
    Ok(())
}

/// Leaves of a table with the offset of their key; a table that is itself a leaf's name stays
/// whole.
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
fn assign(config: &Config, key: &str, given: RawValue) -> Result<Config> {
    let mut root = config.to_table();
    let known = all_keys().find(|(name, _)| name == key);
    let (Some((_, about)), Some(old)) = (known, lookup(&root, key)) else { return Err(unknown(key)) };
    let found = match &given {
        RawValue::Toml(value) => show(value),
        RawValue::Text(text) => format!("`{text}`"),
    };
    let Some(value) = fit(old, given) else {
        return Err(wrong(key, &format!(" is {}, found {found}", kind(old))));
    };
    check_range(about, &value)
        .map_err(|found| wrong(key, &format!(" is {found}, allowed is {}", about.range())))?;
    match value.as_str() {
        Some(word) if word.starts_with('~') => {
            let problem = format!(": `{word}`: `~` is a word of the shell; write the whole path");
            return Err(wrong(key, &problem));
        }
        Some(word) if key == key!(device) && DeviceChoice::parse(word).is_none() => {
            let problem = format!(
                ": unknown device `{word}`, expected auto, cpu, wgpu, vulkan, metal or dx12, with :N a numbered one"
            );
            return Err(wrong(key, &problem));
        }
        _ => put(&mut root, key, value),
    }
    Config::deserialize(Value::Table(root))
        .map_err(|e| wrong(key, &format!(": {}", e.message().lines().next().unwrap_or_default())))
}

/// Returns the words that a key takes, alone or in a list; none if it takes numbers or any text.
pub fn known_words(key: &str) -> Vec<String> {
    let config = Config::preset(Preset::Standard);
    match lookup(&config.to_table(), key) {
        Some(Value::Boolean(_)) => vec!["true".into(), "false".into()],
        Some(Value::String(_) | Value::Array(_)) => {
            // the error about an unknown word lists the known ones
            let refused = assign(&config, key, RawValue::Text("?".into())).err().map(|e| e.to_string());
            let known =
                refused.as_deref().and_then(|text| text.split_once("expected ")).map(|(_, known)| known);
            known
                .into_iter()
                .flat_map(|known| known.split('`').skip(1).step_by(2))
                .map(str::to_string)
                .collect()
        }
        _ => Vec::new(),
    }
}

/// `given` as a value of the same type as `old`, if it can be one.
fn fit(old: &Value, given: RawValue) -> Option<Value> {
    let parsed = match (&given, old) {
        (RawValue::Toml(value), _) => value.clone(),
        (RawValue::Text(text), Value::String(_)) => {
            let quoted = text.len() >= 2 && text.starts_with('"') && text.ends_with('"');
            return Some(Value::String(if quoted { text[1..text.len() - 1].into() } else { text.clone() }));
        }
        (RawValue::Text(text), Value::Array(_)) if !text.starts_with('[') => {
            let items = text.split(',').map(str::trim).filter(|t| !t.is_empty());
            return Some(Value::Array(items.map(|t| scalar(t).unwrap_or(Value::String(t.into()))).collect()));
        }
        (RawValue::Text(text), _) => scalar(text)?,
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

/// Returns a TOML value given alone.
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

/// Returns the known key most like `key`, by its full name or by its last word, if any is like it
/// at all.
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
