//! `tiface demo`: renders photographs of a synthetic head, and runs the pipeline on them.

use super::Invocation;
use super::out::Out;
use super::run::{StageCommand, run as run_stages};
use super::target::RunTarget;
use crate::config::{Fallback, Preset, SETTINGS_FILE};
use crate::pipeline::{DEMO_CAPTURE, Stage, check_feasible, require_device};
use crate::report::duration;
use std::path::{Path, PathBuf};
use std::time::Instant;
use tiface_base::{Error, Result, io};
use tiface_capture::synthetic::{MadeCapture, SyntheticOptions, check, write_borders, write_capture};

/// Settings of the demo: few steps, because its pictures are small.
pub(super) const DEMO: Fallback = (Preset::Draft, |config| {
    config.iface.steps = 1800;
    (config.tface.steps, config.tface.rays) = (800, 2048);
    (config.baseline.steps, config.baseline.rays) = (600, 2048);
});

pub(super) fn run(
    invocation: &Invocation,
    size: Option<&str>,
    views: Option<usize>,
    border: Option<u32>,
) -> Result<()> {
    let common = invocation.common;
    let options = photographs(size, views)?;
    let run = common.run.clone().unwrap_or_else(|| PathBuf::from("runs/demo"));
    let capture = run.join(DEMO_CAPTURE);
    let made = MadeCapture::read(&capture)?;
    match &made {
        Some(made) => agree(made, &capture, &options, [size.is_some(), views.is_some()], border)?,
        None => {
            check(&options)?;
            check_border(&options, border)?;
        }
    }
    // repeated, the demo continues with its saved settings
    let saved = Some(run.join(SETTINGS_FILE)).filter(|f| io::is_file(f));
    let fallback = Some(DEMO);
    // command-line errors are reported before any photograph is rendered
    Out::find(common.out.as_deref(), "run")?;
    let config = common.resolve(saved.as_deref(), fallback, &[])?;
    check_feasible(&config)?;
    if made.is_none() {
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

/// Refuses options that the finished photographs were not made with; `given` says whether size and
/// number are.
fn agree(
    made: &MadeCapture,
    capture: &Path,
    asked: &SyntheticOptions,
    given: [bool; 2],
    border: Option<u32>,
) -> Result<()> {
    let MadeCapture { width, height, views, .. } = made;
    let [size, number] = given;
    let differs = if size && (asked.width, asked.height) != (*width, *height) {
        Some(("--size", format!("photographs of {width} × {height} pixels")))
    } else if number && asked.train + asked.test != *views {
        Some(("--views", format!("{views} photographs")))
    } else if border.is_some_and(|border| !made.has_border(border)) {
        Some(("--border", "photographs of another border".into()))
    } else {
        None
    };
    let Some((option, found)) = differs else { return Ok(()) };
    let message = format!("`{}` contains {found} of the head already", capture.display());
    Err(Error::usage(message, format!("leave out {option} to continue with them, or name another --run")))
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
