//! `tiface convert`: a capture with its cameras in another format.

use super::invocation::Invocation;
use super::stdout::print;
use crate::capture;
use crate::capture::convert::{CameraFormat, convert};
use crate::pipeline::capture_options;
use crate::{Error, Result};
use std::path::{Path, PathBuf};

pub(super) fn run(invocation: &Invocation, from: &Path, to: &str) -> Result<()> {
    let common = invocation.common;
    let format = CameraFormat::named(to).ok_or_else(|| {
        Error::usage(format_args!("`--to {to}` is no format of cameras"), "choose transforms or colmap")
    })?;
    let options = capture_options(&common.resolve(None, None, &[])?);
    let capture = capture::open(from, &options)?;
    capture.warnings.iter().for_each(|text| invocation.screen.note("convert: warning", text));
    let default = || PathBuf::from(format!("{}_{to}", capture.name));
    let folder = common.out.clone().unwrap_or_else(default);
    if common.dry_run {
        let views = capture.views.len();
        invocation.screen.note("convert", &format!("would write {views} views into `{}`", folder.display()));
        return Ok(());
    }
    let done = convert(&capture, format, &folder)?;
    done.warnings.iter().for_each(|text| invocation.screen.note("convert: warning", text));
    if common.json {
        return print(&format!("{}\n", serde_json::to_string(&done).unwrap_or_default()));
    }
    let (views, masks, shown) = (done.views, done.masks, folder.display());
    invocation
        .screen
        .note("convert", &format!("{views} views and {masks} masks from {} into `{shown}`", capture.format));
    print(&format!("{shown}\n"))
}
