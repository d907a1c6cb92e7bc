//! `tiface demo`: renders photographs of a synthetic head, and runs the pipeline on them.

use super::Invocation;
use super::options::RunTarget;
use super::out::Out;
use super::run::{StageCommand, run as run_stages};
use crate::capture::synthetic::{SyntheticOptions, check, write_borders, write_capture};
use crate::config::Preset;
use crate::io;
use crate::pipeline::{DEMO_CAPTURE, Stage, check_feasible, require_device};
use crate::report::duration;
use crate::{Error, Result};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Settings of the demo: few steps, because its pictures are small.
pub(super) const DEMO_SETTINGS: &str = "\
tface.steps = 800
tface.rays = 2048
baseline.steps = 600
baseline.rays = 2048
";

pub(super) fn run(
    invocation: &Invocation,
    size: Option<&str>,
    views: Option<usize>,
    border: Option<u32>,
) -> Result<()> {
    let common = invocation.common;
    let options = photographs(size, views)?;
    check(&options)?;
    check_border(&options, border)?;
    let run = common.run.clone().unwrap_or_else(|| PathBuf::from("runs/demo"));
    let capture = run.join(DEMO_CAPTURE);
    // repeated without options, the demo continues with its saved settings
    let saved = Some(run.join("config.toml")).filter(|f| io::is_file(f));
    let fallback = Some((Preset::Draft, DEMO_SETTINGS));
    // command-line errors are reported before any photograph is rendered
    Out::find(common.out.as_deref(), "run")?;
    let config = common.resolve(saved.as_deref(), fallback, &[])?;
    check_feasible(&config)?;
    // the cameras are written last: if they exist, the capture is complete
    if io::is_file(&capture.join("transforms.json")) {
        if size.is_some() || views.is_some() || border.is_some() {
            let message = format!("`{}` already contains photographs of the head", capture.display());
            return Err(Error::usage(
                message,
                "leave out --size, --views and --border, or name another --run",
            ));
        }
    } else {
        require_device(&config)?;
        if common.dry_run {
            let text = format!("would render photographs of a synthetic head into `{}`", capture.display());
            invocation.screen.note("capture", &text);
            return Ok(());
        }
        photograph(&capture, &options, border, invocation)?;
    }
    let target = RunTarget { capture: Some(io::real_path(&capture)?), saved, run, guessed: false };
    let (product, until) = ("run", Stage::Metrics);
    run_stages(invocation, &StageCommand { product, until, target, require: &[], keys: Vec::new(), fallback })
}

/// Returns the options of the photographs, with another size or number.
fn photographs(size: Option<&str>, views: Option<usize>) -> Result<SyntheticOptions> {
    let mut options = SyntheticOptions::default();
    if let Some(size) = size {
        let sides = size.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
        (options.width, options.height) = sides.ok_or_else(|| {
            Error::usage(format_args!("`--size {size}` is not a size in pixels"), "write it as 3000x4096")
        })?;
    }
    if let Some(views) = views {
        options.test = (views / 4).max(1);
        options.train = views.saturating_sub(options.test);
        if options.train < 2 {
            return Err(Error::usage(
                format!("`--views {views}` leaves {} to train on, and one is held out", options.train),
                "choose at least three: two training views are needed",
            ));
        }
    }
    Ok(options)
}

fn check_border(options: &SyntheticOptions, border: Option<u32>) -> Result<()> {
    let narrow = options.width.min(options.height);
    match border.filter(|b| b.saturating_mul(2) >= narrow) {
        Some(border) => Err(Error::usage(
            format!("`--border {border}` leaves no pixels of a side of {narrow}"),
            "choose less than half of it",
        )),
        None => Ok(()),
    }
}

/// Renders the photographs of the demo head into a folder.
pub(super) fn photograph(
    capture: &Path,
    options: &SyntheticOptions,
    border: Option<u32>,
    invocation: &Invocation,
) -> Result<()> {
    let views = options.train + options.test;
    invocation.screen.note("capture", &format!("rendering {views} photographs of a synthetic head"));
    let start = Instant::now();
    io::create_folder(capture)?;
    if let Some(border) = border {
        write_borders(capture, options, border)?;
    }
    write_capture(capture, options)?;
    invocation.screen.note("capture", &format!("done in {}", duration(start.elapsed().as_secs_f64())));
    Ok(())
}
