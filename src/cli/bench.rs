//! `tiface bench`: speed against error of settings, measured on this machine.

use super::Invocation;
use super::options::{Common, RunTarget};
use super::out::Out;
use super::screen::print;
use crate::config::{Config, Preset};
use crate::io;
use crate::pipeline::{Bench, SWEEPS, Session, check_feasible, require_device};
use crate::report::duration;
use crate::run::{Event, Observer, Run};
use crate::{Error, Result};
use clap::Args;
use clap::builder::PossibleValuesParser;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

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
const BENCH_SETTINGS: &str = "iface.steps = 1500\n";

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
    let Invocation { common, screen, stop } = invocation;
    let out = Out::find(common.out.as_deref(), "bench")?;
    let target = RunTarget::find(common, Some(&options.path))?;
    let config = configure(common, &target)?;
    check_feasible(&config)?;
    require_device(&config)?;
    let name = target.run.file_name().map_or("run".into(), |n| n.to_string_lossy().into_owned());
    let folder = out.map_or_else(|| Path::new("bench").join(name), |out| out.file(""));
    let results = folder.join("bench.json");
    if io::exists(&results) {
        let what = format!("`{}` holds the results of another bench", folder.display());
        return Err(Error::cannot(what, "name another folder: `--out bench/NAME/`"));
    }
    let chosen: Vec<&str> = SWEEPS
        .into_iter()
        .filter(|s| options.sweep.is_empty() || options.sweep.iter().any(|o| o == s))
        .collect();
    if common.dry_run {
        screen.note("bench", &format!("would measure {} into `{}`", chosen.join(", "), folder.display()));
        return Ok(());
    }
    io::create_folder(&folder)?;
    // in the system's folder for temporary files, which is cleaned after a killed process
    let scratch = tempfile::tempdir().map_err(|e| {
        Error::cannot(format!("temporary files cannot be created: {e}"), "set TMPDIR to another folder")
    })?;
    let quiet = |dir: &Path| Run::open(dir, stop.clone(), Arc::new(Warnings(screen.clone())));
    let run = quiet(&scratch.path().join("run"));
    io::create_folder(run.dir())?;
    let saved = target.saved.as_ref().map(|_| quiet(&target.run));
    let open = |run| Session::open(&config, run);
    let (session, finished) = (open(&run)?, saved.as_ref().map(open).transpose()?);
    let bench = Bench::new(&session, finished.as_ref())?;
    let mut result = bench.begin();
    let start = Instant::now();
    for (i, sweep) in chosen.iter().enumerate() {
        screen.note("bench", &format!("{sweep} ({} of {})", i + 1, chosen.len()));
        let measured = bench.measure(sweep).map_err(|e| match stop.requested() {
            Some(kind) if e.kind().is_stop() => {
                Error::stopped("what was measured before is kept").with_kind(kind)
            }
            _ => e,
        });
        result.sweeps.push(measured?);
        // the results are written last: a program may wait for them
        let page = folder.join("bench.html");
        io::write_atomic(&page, result.html()?.as_bytes())?;
        io::write_atomic(&results, result.json().as_bytes())?;
    }
    if common.json {
        print(&format!("{}\n", json!({"event": "result", "bench": results})))?;
    } else if !common.quiet {
        let (page, took) = (folder.join("bench.html"), duration(start.elapsed().as_secs_f64()));
        print(&format!("{}\nbench     {} in {took}\n", result.text(), page.display()))?;
    }
    Ok(())
}

/// Returns a run's own configuration, or that of a bench on a capture.
fn configure(common: &Common, target: &RunTarget) -> Result<Config> {
    let mut config = common.resolve(target.saved.as_deref(), Some((Preset::Draft, BENCH_SETTINGS)), &[])?;
    if let Some(capture) = &target.capture {
        config.capture.path = capture.to_str().map(String::from).ok_or_else(|| {
            let shown = capture.display();
            Error::cannot(format!("the path of the capture is not UTF-8: `{shown}`"), "rename the folder")
        })?;
    }
    Ok(config)
}
