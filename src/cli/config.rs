//! `tiface config`: the effective configuration, or what a key means.

use super::ending::{Ending, say};
use super::options::Common;
use super::target::Target;
use crate::config::explain;
use crate::run::Exit;
use std::path::Path;

pub(super) fn go(common: &Common, path: Option<&Path>, key: Option<&str>) -> Result<Exit, Ending> {
    if let Some(key) = key {
        say(&explain(key)?)?;
        return Ok(Exit::Done);
    }
    // without a capture or run it is the configuration of a run that is yet to be
    let saved = match path.or(common.run.as_deref()) {
        Some(path) => Target::find(common, Some(path))?.saved,
        None => None,
    };
    say(&common.resolve(saved.as_deref(), None, &[])?.to_toml())?;
    Ok(Exit::Done)
}
