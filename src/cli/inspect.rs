//! `tiface inspect`: what was found in a capture.

use super::ending::{Ending, say};
use super::options::Common;
use crate::capture::inspect::inspect;
use crate::pipeline::{capture_options, disagreements};
use crate::run::Exit;
use std::path::Path;

pub(super) fn go(common: &Common, capture: &Path) -> Result<Exit, Ending> {
    let config = common.resolve(None, None, &[])?;
    let options = capture_options(&config);
    let mut found = inspect(capture, &options);
    found.warnings.extend(disagreements(capture, &options));
    let text = if common.json {
        format!("{}\n", serde_json::to_string(&found).unwrap_or_default())
    } else {
        format!("{found}\n")
    };
    say(&text)?;
    Ok(if found.is_sound() { Exit::Done } else { Exit::Cannot })
}
