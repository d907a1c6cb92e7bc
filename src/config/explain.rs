//! What a key means, which numbers it may be, and its value in every preset.

use super::{Config, Key, Preset, all_keys, key, lookup, show, source};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write;
use tiface_base::Result;
use toml::{Table, Value};

/// A key with its meaning, its range and its value in every preset.
#[derive(Clone, Debug, Serialize)]
pub struct Explained {
    /// Its full, dotted name.
    pub key: String,
    /// What it means, with its unit.
    pub meaning: &'static str,
    /// The numbers that are allowed, as text; empty where every value is.
    pub allowed: String,
    /// Its value by preset.
    pub values: BTreeMap<&'static str, Value>,
}

/// Returns a key, or all keys of a table; an unknown name is an error that knows the nearest one.
pub fn explained(name: &str) -> Result<Vec<Explained>> {
    let wanted = all_keys().filter(|(full, _)| full == name || full.starts_with(&format!("{name}.")));
    let tables = Preset::ALL.map(|preset| (preset.as_str(), Config::preset(preset).to_table()));
    let one = |(full, key): (String, &Key)| {
        let value = |(preset, table): &(&'static str, Table)| Some((*preset, lookup(table, &full)?.clone()));
        let values = tables.iter().filter_map(value).collect();
        Explained { key: full, meaning: key.doc, allowed: key.range(), values }
    };
    let found: Vec<Explained> = wanted.map(one).collect();
    if found.is_empty() { Err(source::unknown(name).within("`--explain`")) } else { Ok(found) }
}

/// Returns what a key or a whole table means, its range and its value in every preset; an unknown
/// name is an error that knows the nearest one.
pub fn explain(name: &str) -> Result<String> {
    let mut out = String::new();
    for (i, Explained { key, meaning, allowed, values }) in explained(name)?.into_iter().enumerate() {
        if i > 0 {
            out.push('\n');
        }
        let _ = writeln!(out, "{key}\n  {meaning}");
        if !allowed.is_empty() {
            let _ = writeln!(out, "  allowed: {allowed}");
        }
        let [quick, draft, standard, paper] =
            Preset::ALL.map(|preset| values.get(preset.as_str()).map(show).unwrap_or_default());
        if key == key!(preset) || (quick == draft && draft == standard && standard == paper) {
            let _ = writeln!(out, "  default: {standard}");
        } else {
            let _ =
                writeln!(out, "  quick: {quick}   draft: {draft}   standard: {standard}   paper: {paper}");
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn explaining_a_key_gives_its_range_and_its_value_in_every_preset() {
        let text = explain("mesh.resolution").unwrap();
        assert!(
            text.contains("allowed: 16 to 4096") && text.contains("quick: 256   draft: 256   standard: 512"),
            "{text}"
        );
        let text = explain("iface.steps").unwrap();
        assert!(text.contains("quick: 900   draft: 3000   standard: 8000"), "{text}");
        assert!(explain("mesh").unwrap().matches("mesh.").count() > 3);
        assert!(explain("mesh.resolutoin").unwrap_err().hint().contains("mesh.resolution"));
    }
}
