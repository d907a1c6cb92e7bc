//! `tiface inspect`: what was found in a capture.

use super::options::Common;
use super::stdout::print;
use crate::pipeline::{capture_options, inspect_capture};
use crate::{Error, ErrorKind, Result};
use std::path::Path;

pub(super) fn run(common: &Common, capture: &Path) -> Result<()> {
    let config = common.resolve(None, None, &[])?;
    let options = capture_options(&config);
    let found = inspect_capture(capture, &options);
    let text = if common.json {
        format!("{}\n", serde_json::to_string(&found).unwrap_or_default())
    } else {
        format!("{found}\n")
    };
    print(&text)?;
    if found.is_sound() { Ok(()) } else { Err(Error::already_printed(ErrorKind::Cannot)) }
}
