//! `tiface config`: the effective configuration, or the documentation of a key.

use super::options::Common;
use super::screen::print;
use super::target::RunTarget;
use crate::config::{explain, explained};
use serde_json::json;
use std::path::Path;
use tiface_base::Result;

pub(super) fn run(common: &Common, path: Option<&Path>, key: Option<&str>) -> Result<()> {
    if let Some(key) = key {
        return match common.json {
            true => print(&format!("{}\n", json!(explained(key)?))),
            false => print(&explain(key)?),
        };
    }
    // without a capture or run, this is the configuration of a new run
    let saved = match path.or(common.run.as_deref()) {
        Some(path) => RunTarget::find(common, Some(path))?.saved,
        None => None,
    };
    let config = common.resolve(saved.as_deref(), None, &[])?;
    match common.json {
        // not by a `Value`, which would write an f32 with the digits of an f64
        true => print(&format!("{}\n", serde_json::to_string(&config).unwrap_or_default())),
        false => print(&config.to_toml()),
    }
}
