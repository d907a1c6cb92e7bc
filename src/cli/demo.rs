//! `tiface demo`: the pipeline on a synthetic head that it photographs first.

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

/// The demo's pictures are small, and it should end while its user still looks.
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
    // repeated without options, the demo goes on as it was begun
    let saved = Some(run.join("config.toml")).filter(|f| io::is_file(f));
    let fallback = Some((Preset::Draft, DEMO_SETTINGS));
    // what is wrong with the command line is reported before the head is photographed
    Out::find(common.out.as_deref(), "run")?;
    let config = common.resolve(saved.as_deref(), fallback, &[])?;
    check_feasible(&config)?;
    // the cameras are written last: where they are, everything is
    if io::is_file(&capture.join("transforms.json")) {
        if size.is_some() || views.is_some() || border.is_some() {
            let message = format!("the head in `{}` is photographed already", capture.display());
            return Err(Error::usage(
                message,
                "leave out --size, --views and --border, or name another --run",
            ));
        }
    } else {
        require_device(&config)?;
        if common.dry_run {
            let text = format!("would photograph a synthetic head into `{}`", capture.display());
            invocation.screen.note("capture", &text);
            return Ok(());
        }
        photograph(&capture, &options, border, invocation)?;
    }
    let target = RunTarget { capture: Some(io::real_path(&capture)?), saved, run, guessed: false };
    let (product, until) = ("run", Stage::Metrics);
    run_stages(invocation, &StageCommand { product, until, target, require: &[], keys: Vec::new(), fallback })
}

/// The default photographs, of another size or number.
fn photographs(size: Option<&str>, views: Option<usize>) -> Result<SyntheticOptions> {
    let mut options = SyntheticOptions::default();
    if let Some(size) = size {
        let sides = size.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
        (options.width, options.height) = sides.ok_or_else(|| {
            Error::usage(format_args!("`--size {size}` is no size in pixels"), "write it as 3000x4096")
        })?;
    }
    if let Some(views) = views {
        options.test = (views / 4).max(1);
        options.train = views.saturating_sub(options.test);
        if options.train < 2 {
            return Err(Error::usage(
                format!("`--views {views}` leaves {} to learn from, and one is held out", options.train),
                "name three at least: two cameras place a head",
            ));
        }
    }
    Ok(options)
}

fn check_border(options: &SyntheticOptions, border: Option<u32>) -> Result<()> {
    let narrow = options.width.min(options.height);
    match border.filter(|b| b.saturating_mul(2) >= narrow) {
        Some(border) => Err(Error::usage(
            format!("`--border {border}` leaves nothing of a side of {narrow} pixels"),
            "name less than half of it",
        )),
        None => Ok(()),
    }
}

/// Photographs the demo head into a folder.
pub(super) fn photograph(
    capture: &Path,
    options: &SyntheticOptions,
    border: Option<u32>,
    invocation: &Invocation,
) -> Result<()> {
    let views = options.train + options.test;
    invocation.screen.note("capture", &format!("photographing a synthetic head from {views} sides"));
    let start = Instant::now();
    io::create_folder(capture)?;
    if let Some(border) = border {
        write_borders(capture, options, border)?;
    }
    write_capture(capture, options)?;
    invocation.screen.note("capture", &format!("done in {}", duration(start.elapsed().as_secs_f64())));
    Ok(())
}
