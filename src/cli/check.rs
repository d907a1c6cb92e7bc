//! `tiface check`: is a mesh sound?

use super::ending::{Ending, say};
use super::options::Common;
use crate::io::{self, Limits};
use crate::mesh::check::{RequireError, check};
use crate::mesh::read::read;
use crate::run::Exit;
use std::path::Path;

pub(super) fn go(common: &Common, path: &Path, require: &[String]) -> Result<Exit, Ending> {
    let config = common.resolve(None, None, &[])?;
    let bytes = io::read_bytes(path, &Limits::default())?;
    let mesh = read(&bytes, path).map_err(|e| Ending::cannot(e.to_string(), e.hint()))?;
    let report = check(&mesh, config.capture.unit_m);
    let bars: Vec<&str> = require.iter().map(String::as_str).collect();
    let passed = report.require(&bars);
    if let Err(e @ RequireError::Unknown { .. }) = &passed {
        return Err(Ending::usage(e.to_string(), e.hint()));
    }
    let text = if common.json {
        format!("{}\n", serde_json::to_string(&report).unwrap_or_default())
    } else {
        format!("{report}\n")
    };
    say(&text)?;
    passed.map_err(|e| Ending::below(e.to_string(), e.hint()))?;
    Ok(Exit::Done)
}
