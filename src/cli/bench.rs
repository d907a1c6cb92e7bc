//! `tiface bench`: speed against error of settings, measured on this machine.

use super::Invocation;
use super::out::Out;
use super::screen::print;
use super::target::RunTarget;
use crate::config::{Config, Fallback, Preset};
use crate::pipeline::{Bench, SWEEPS, Session, check_feasible, require_device};
use crate::report::bench::BenchResult;
use crate::report::duration;
use crate::run::{Event, Observer, Run};
use clap::Args;
use clap::builder::PossibleValuesParser;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};

/// Options of `tiface bench`.
#[derive(Args, Debug)]
pub(super) struct BenchOptions {
    /// Capture, or run whose finished fields are reused by sweeps that do not measure training
    #[arg(value_name = "CAPTURE|RUN")]
    path: PathBuf,
    /// Settings to sweep, separated by commas [default: all]
    #[arg(long, value_name = "LIST", value_delimiter = ',', value_parser = PossibleValuesParser::new(SWEEPS))]
    sweep: Vec<String>,
}

/// Half the steps of the preset `draft`, so that all sweeps end within minutes.
const START: Fallback = (Preset::Draft, |config| config.iface.steps = 1500);

/// Files in the folder of a bench.
const RESULTS: &str = "bench.json";
const PAGE: &str = "bench.html";

/// Passes on warnings only: a bench prints its own progress.
struct Warnings(Arc<super::screen::Screen>);

impl Observer for Warnings {
    fn event(&self, event: &Event) {
        if let Event::Warning { .. } = event {
            self.0.event(event);
        }
    }
}

pub(super) fn run(invocation: &Invocation, options: &BenchOptions) -> Result<()> {
    let Invocation { common, screen, .. } = invocation;
    let out = Out::find(common.out.as_deref(), "bench")?;
    let target = RunTarget::find(common, Some(&options.path))?;
    let config = target.configure(common, Some(START), &[])?;
    check_feasible(&config)?;
    require_device(&config)?;
    let name = target.run.file_name().map_or("run".into(), |n| n.to_string_lossy().into_owned());
    let folder = out.map_or_else(|| Path::new("bench").join(name), |out| out.file(""));
    let results = folder.join(RESULTS);
    let chosen: Vec<&str> = SWEEPS
        .into_iter()
        .filter(|s| options.sweep.is_empty() || options.sweep.iter().any(|o| o == s))
        .collect();
    let mut result = Bench::begin(&config, &chosen);
    if io::exists(&results) {
        // what was measured before a stop is kept, if this is the same bench
        match io::read_typed::<BenchResult>(&results, &Limits::default()) {
            Ok(found) if found.is_part_of(&result) => result = found,
            _ => {
                let what = format!("`{}` holds the results of another bench", folder.display());
                return Err(Error::cannot(what, "name another folder: `--out bench/NAME/`"));
            }
        }
    }
    let is_measured = |sweep: &str| result.sweeps.iter().any(|measured| measured.name == sweep);
    let left: Vec<&str> = chosen.iter().copied().filter(|sweep| !is_measured(sweep)).collect();
    if common.dry_run {
        screen.note("bench", &format!("would measure {} into `{}`", left.join(", "), folder.display()));
        return Ok(());
    }
    let start = Instant::now();
    if !left.is_empty() {
        io::create_folder(&folder)?;
        measure(invocation, &config, &target, &left, &mut result, &folder)?;
    }
    if common.json {
        print(&format!("{}\n", json!({"event": "result", "bench": results})))?;
    } else if !common.quiet {
        let (page, took) = (folder.join(PAGE), duration(start.elapsed().as_secs_f64()));
        print(&format!("{}\nbench     {} in {took}\n", result.text(), page.display()))?;
    }
    Ok(())
}

/// Adds these sweeps to a result, and writes it into the folder after each.
fn measure(
    invocation: &Invocation,
    config: &Config,
    target: &RunTarget,
    sweeps: &[&str],
    result: &mut BenchResult,
    folder: &Path,
) -> Result<()> {
    let Invocation { screen, stop, .. } = invocation;
    // in the system's folder for temporary files, which is cleaned after a killed process
    let scratch = tempfile::tempdir().map_err(|e| {
        Error::cannot(format!("temporary files cannot be created: {e}"), "set TMPDIR to another folder")
    })?;
    let quiet = |dir: &Path| Run::open(dir, stop.clone(), Arc::new(Warnings(screen.clone())));
    let run = quiet(&scratch.path().join("run"));
    io::create_folder(run.dir())?;
    let saved = target.saved.as_ref().map(|_| quiet(&target.run));
    let open = |run| Session::open(config, run);
    let (session, finished) = (open(&run)?, saved.as_ref().map(open).transpose()?);
    let bench = Bench::new(&session, finished.as_ref())?;
    result.capture = session.capture().name.clone();
    for (i, sweep) in sweeps.iter().enumerate() {
        screen.note("bench", &format!("{sweep} ({} of {})", i + 1, sweeps.len()));
        let measured = bench.measure(sweep).map_err(|e| match stop.requested() {
            Some(kind) if e.kind().is_stop() => {
                Error::stopped("what was measured before is kept").with_kind(kind)
            }
            _ => e,
        });
        result.sweeps.push(measured?);
        // the results are written last: a program may wait for them
        io::write_atomic(&folder.join(PAGE), result.html()?.as_bytes())?;
        io::write_atomic(&folder.join(RESULTS), result.json().as_bytes())?;
    }
    Ok(())
}
