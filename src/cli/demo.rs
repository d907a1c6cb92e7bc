//! `tiface demo`: the line on a synthetic head made on the spot.

use super::line::Work;
use super::options::Common;
use super::out::Out;
use super::screen::{Screen, duration};
use super::target::Target;
use crate::Result;
use crate::capture::synthetic::{SyntheticOptions, write_capture};
use crate::config::Preset;
use crate::io;
use crate::pipeline::{Stage, feasible};
use crate::run::Stop;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Where in its run the demo keeps its photographs.
pub(super) const CAPTURE: &str = "capture";

/// The demo's pictures are small, and it should end while its user still looks.
const SHORTER: &str = "\
tface.steps = 800
tface.rays = 2048
baseline.steps = 600
baseline.rays = 2048
";

pub(super) fn go(common: &Common, screen: &Screen, stop: &Stop) -> Result<()> {
    let run = common.run.clone().unwrap_or_else(|| PathBuf::from("runs/demo"));
    let capture = run.join(CAPTURE);
    let saved = Some(run.join("config.toml")).filter(|f| io::is_file(f));
    let fallback = Some((Preset::Draft, SHORTER));
    // what is wrong with the command line is told before the head is photographed
    let out = Out::find(common.out.as_deref(), "run")?;
    feasible(&common.resolve(saved.as_deref(), fallback, &[])?)?;
    // the cameras are written last: where they are, everything is
    if !io::is_file(&capture.join("transforms.json")) {
        if common.dry_run {
            screen
                .note("capture", &format!("would photograph a synthetic head into `{}`", capture.display()));
            return Ok(());
        }
        make(&capture, screen)?;
    }
    // repeated without options, the demo goes on as it was begun
    let target = Target { capture: Some(io::real_path(&capture)?), saved, run, guessed: false };
    let (product, until) = ("run", Stage::Metrics);
    let work = Work { common, product, until, out, require: &[], synthetic: true, fallback, screen, stop };
    work.on(&target, &[])
}

fn make(capture: &Path, screen: &Screen) -> Result<()> {
    let options = SyntheticOptions::default();
    let views = options.train + options.test;
    screen.note("capture", &format!("photographing a synthetic head from {views} sides"));
    let start = Instant::now();
    io::create_folder(capture)?;
    write_capture(capture, &options)?;
    screen.note("capture", &format!("done in {}", duration(start.elapsed().as_secs_f64())));
    Ok(())
}
