//! `tiface config`: the effective configuration, or what a key means.

use super::options::Common;
use super::stdout::print;
use super::target::RunTarget;
use crate::Result;
use crate::config::explain;
use std::path::Path;

pub(super) fn run(common: &Common, path: Option<&Path>, key: Option<&str>) -> Result<()> {
    if let Some(key) = key {
        print(&explain(key)?)?;
        return Ok(());
    }
    // without a capture or run it is the configuration of a run that is yet to be
    let saved = match path.or(common.run.as_deref()) {
        Some(path) => RunTarget::find(common, Some(path))?.saved,
        None => None,
    };
    print(&common.resolve(saved.as_deref(), None, &[])?.to_toml())?;
    Ok(())
}
