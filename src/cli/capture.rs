//! Commands on a capture: `tiface inspect` checks it, `tiface convert` rewrites its cameras in
//! another format, `tiface mask --page` writes a page to click on in a browser.

use super::Invocation;
use super::options::Common;
use super::out::Out;
use super::screen::{one_line, print};
use crate::config::{CameraPoses, Config, SETTINGS_FILE};
use crate::pipeline::{self, capture_options, click_page, inspect_capture, open_capture};
use crate::run::is_run;
use serde_json::json;
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::io::Limits;
use tiface_base::{Error, ErrorKind, Result, io};
use tiface_capture as capture;
use tiface_capture::convert::CameraFormat;

pub(super) fn inspect(common: &Common, capture: &Path) -> Result<()> {
    let (config, root) = capture_of(common, capture)?;
    let found = inspect_capture(&root, &capture_options(&config));
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
    let capture = open_capture(from, &options)?;
    capture.warnings.iter().for_each(|text| invocation.screen.note("convert: warning", text));
    let default = || PathBuf::from(format!("{}_{to}", capture.name));
    let folder = common.out.clone().unwrap_or_else(default);
    if common.dry_run {
        let views = counted(capture.views.len(), "view");
        invocation.screen.note("convert", &format!("would write {views} into `{}`", folder.display()));
        return Ok(());
    }
    let done = capture::convert::convert(&capture, format, &folder)?;
    done.warnings.iter().for_each(|text| invocation.screen.note("convert: warning", text));
    if common.json {
        return print(&format!("{}\n", serde_json::to_string(&done).unwrap_or_default()));
    }
    let (views, masks) = (counted(done.views, "view"), counted(done.masks, "mask"));
    let shown = folder.display();
    invocation.screen.note("convert", &format!("{views} and {masks} from {} into `{shown}`", capture.format));
    print(&format!("{shown}\n"))
}

/// Returns the settings for a capture and its folder; a run's configuration has its capture and the
/// size of its photographs.
fn capture_of(common: &Common, path: &Path) -> Result<(Config, PathBuf)> {
    let saved = is_run(path).then(|| path.join(SETTINGS_FILE));
    let config = common.resolve(saved.as_deref(), None, &[])?;
    let known = &config.capture.path;
    let root = if saved.is_some() && !known.as_os_str().is_empty() { known.clone() } else { path.into() };
    Ok((config, root))
}

/// Judges pictures and meshes of other programs by a capture's held-out photographs.
pub(super) fn judge(
    invocation: &Invocation,
    path: Option<&Path>,
    views: &[PathBuf],
    meshes: &[PathBuf],
) -> Result<()> {
    let (common, screen) = (invocation.common, &invocation.screen);
    let out = Out::find(common.out.as_deref(), "metrics of other programs")?;
    let Some(path) = path else {
        return Err(Error::usage("no capture is named", "name one: `tiface metrics CAPTURE --views FOLDER`"));
    };
    let (config, root) = capture_of(common, path)?;
    let mut capture = open_capture(&root, &capture_options(&config))?;
    capture.settle_masks(&config.mask.head, &Limits::default())?;
    capture.warnings.iter().for_each(|text| screen.note("metrics: warning", text));
    if let Some(wrong) = views.iter().find(|folder| !io::is_folder(folder)) {
        let hint = "name a folder of pictures that are named like the photographs";
        return Err(Error::cannot(format!("`{}` is not a folder", wrong.display()), hint));
    }
    let out = out.unwrap_or_else(|| Out::Folder(format!("{}_judged", capture.name).into()));
    let page = out.file("report.html");
    let folder = page.parent().unwrap_or(Path::new("."));
    if is_run(folder) || capture::has_cameras(folder) {
        let problem =
            format!("`--out {}` is a run or a capture, whose files it would replace", folder.display());
        return Err(Error::usage(problem, "name a folder of its own, with `/` at its end"));
    }
    if common.dry_run {
        screen.note("metrics", &format!("would write `{}`", page.display()));
        return Ok(());
    }
    out.prepare()?;
    let judged = pipeline::judge(&capture, &config, views, meshes, folder)?;
    judged.warnings.iter().for_each(|text| screen.note("metrics: warning", text));
    io::write_atomic(&out.file("metrics.json"), format!("{:#}\n", judged.metrics).as_bytes())?;
    io::write_atomic(&page, judged.page.as_bytes())?;
    if common.json {
        let result = json!({"event": "result", "report": page, "metrics": judged.metrics});
        return print(&format!("{result}\n"));
    }
    let decimal = |value: Option<f64>, digits: usize| value.map_or("–".into(), |v| format!("{v:.digits$}"));
    let mut text = String::new();
    for (title, psnr, ssim, count) in &judged.rows {
        let (psnr, ssim) = (decimal(*psnr, 2), decimal(*ssim, 4));
        text +=
            &format!("{:<24} PSNR {psnr} dB, SSIM {ssim}, {}\n", one_line(title), counted(*count, "view"));
    }
    print(&format!("{text}report    {}\n", page.display()))
}

/// Writes the page for a capture, with existing clicks from `prompts` or the capture's own
/// `prompts.json`.
pub(super) fn page(invocation: &Invocation, path: Option<&Path>, prompts: Option<&Path>) -> Result<()> {
    let (common, screen) = (invocation.common, &invocation.screen);
    let destination = Out::find(common.out.as_deref(), "page")?;
    let Some(path) = path else {
        return Err(Error::usage("no capture is named", "name one: `tiface mask CAPTURE --page`"));
    };
    let (config, root) = capture_of(common, path)?;
    // masks are not needed to click
    let masks = capture::MaskSource::None;
    // nor poses: which way a photograph is turned matters, and not which camera took it
    let cameras = CameraPoses::Given;
    let options = capture::CaptureOptions { masks, cameras, ..capture_options(&config) };
    let capture = open_capture(&root, &options)?;
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
