//! Commands on a capture: `tiface inspect` checks it, `tiface convert` rewrites its cameras in another format,
//! `tiface mask --page` writes a page to click on in a browser.

use super::Invocation;
use super::options::Common;
use super::out::Out;
use super::screen::print;
use crate::capture::convert::CameraFormat;
use crate::pipeline::{capture_options, click_page, inspect_capture};
use crate::{Error, ErrorKind, Result, capture, io};
use serde_json::json;
use std::path::{Path, PathBuf};

pub(super) fn inspect(common: &Common, capture: &Path) -> Result<()> {
    let config = common.resolve(None, None, &[])?;
    let options = capture_options(&config);
    let found = inspect_capture(capture, &options);
    let text = if common.json {
        format!("{}\n", serde_json::to_string(&found).unwrap_or_default())
    } else {
        format!("{found}\n")
    };
    print(&text)?;
    if found.is_usable() { Ok(()) } else { Err(Error::already_printed(ErrorKind::Cannot)) }
}

pub(super) fn convert(invocation: &Invocation, from: &Path, to: &str) -> Result<()> {
    let common = invocation.common;
    let format = CameraFormat::named(to).ok_or_else(|| {
        Error::usage(format_args!("`--to {to}` is not a camera format"), "choose transforms or colmap")
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
    let done = capture::convert::convert(&capture, format, &folder)?;
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

/// Writes the page for a capture, with existing clicks from `prompts` or the capture's own `prompts.json`.
pub(super) fn page(invocation: &Invocation, path: Option<&Path>, prompts: Option<&Path>) -> Result<()> {
    let (common, screen) = (invocation.common, &invocation.screen);
    let destination = Out::find(common.out.as_deref(), "page")?;
    let Some(path) = path else {
        return Err(Error::usage("no capture is named", "name one: `tiface mask CAPTURE --page`"));
    };
    // a run's configuration has its capture and the size of its photographs
    let saved = capture::is_run(path).then(|| path.join("config.toml"));
    let config = common.resolve(saved.as_deref(), None, &[])?;
    let root = match config.capture.path.as_str() {
        "" => path,
        _ if saved.is_none() => path,
        known => Path::new(known),
    };
    // masks are not needed to click
    let options = capture::CaptureOptions { masks: capture::MaskSource::None, ..capture_options(&config) };
    let capture = capture::open(root, &options)?;
    // invalid clicks of the capture are a warning only
    let own = capture.root.join("prompts.json");
    let inside =
        io::real_path(&own).is_ok_and(|p| io::real_path(&capture.root).is_ok_and(|r| p.starts_with(r)));
    let html = match prompts {
        None if inside && io::is_file(&own) => click_page(&capture, Some(&own)).or_else(|e| {
            screen.note("page: warning", &format!("{e}; the page starts without those clicks"));
            click_page(&capture, None)
        })?,
        prompts => click_page(&capture, prompts)?,
    };
    let name = format!("{}_clicks.html", capture.name);
    let out = destination.as_ref().map_or_else(|| PathBuf::from(&name), |out| out.file(&name));
    if common.dry_run {
        screen.note("page", &format!("would write an annotation page to `{}`", out.display()));
        return Ok(());
    }
    destination.iter().try_for_each(Out::prepare)?;
    io::write_atomic(&out, html.as_bytes())?;
    if common.json {
        print(&format!("{}\n", json!({"event": "result", "page": out})))?;
    } else if !common.quiet {
        print(&format!(
            "page      {} (open it, click, save prompts.json; then `--prompts prompts.json`)\n",
            out.display()
        ))?;
    }
    Ok(())
}
