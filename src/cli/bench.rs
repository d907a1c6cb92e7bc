//! `tiface bench`: speed against error of each decision, measured on this machine.

use super::demo::SHORTER;
use super::invocation::Invocation;
use super::options::Common;
use super::out::Out;
use super::run::is_demo;
use super::stdout::print;
use super::target::RunTarget;
use crate::capture::synthetic::{SyntheticOptions, write_capture};
use crate::config::{Config, Preset};
use crate::io::{self, Limits};
use crate::mesh::files::read;
use crate::pipeline::{Bench, Line, SWEEPS, feasible, require_device};
use crate::report::bench::BenchResult;
use crate::report::duration;
use crate::run::{Event, Observer, Run};
use crate::{Error, Result};
use clap::Args;
use clap::builder::PossibleValuesParser;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// What is measured.
#[derive(Args, Debug)]
pub(super) struct BenchOptions {
    /// A capture; or a run, whose finished fields are taken where training is not what is measured; without either, the
    /// demo head
    #[arg(value_name = "CAPTURE|RUN")]
    path: Option<PathBuf>,
    /// Of these decisions, with commas [default: all]
    #[arg(long, value_name = "LIST", value_delimiter = ',', value_parser = PossibleValuesParser::new(SWEEPS))]
    sweep: Vec<String>,
    /// The true surface, a mesh in the dataset's world (.ply or .obj)
    #[arg(long, value_name = "MESH")]
    truth: Option<PathBuf>,
    /// Name what got slower or worse, beyond noise, since this bench.json; exit with 3 if anything did
    #[arg(long, value_name = "FILE")]
    compare: Option<PathBuf>,
}

/// Half the steps of a first look: all sweeps are to end within a quarter of an hour.
const HALF: &str = "iface.steps = 1500\n";

/// Tells warnings, and nothing of the rest: a bench has its own lines.
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
    let asked = Out::find(common.out.as_deref(), "bench")?;
    let old = options.compare.as_deref().map(result_of).transpose()?;
    let target = options.path.as_deref().map(|path| RunTarget::find(common, Some(path))).transpose()?;
    let mut config = configure(common, target.as_ref())?;
    feasible(&config)?;
    require_device(&config)?;
    let truth = options.truth.as_deref().map(|path| read(&io::read_bytes(path, &Limits::default())?, path));
    let truth = truth.transpose()?;
    let name = match &target {
        None => "demo".into(),
        Some(target) => target.run.file_name().map_or("run".into(), |n| n.to_string_lossy().into_owned()),
    };
    let folder = asked.map_or_else(|| Path::new("bench").join(name), |out| out.file(""));
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
    // where the system removes what a killed program leaves
    let scratch = tempfile::tempdir().map_err(|e| {
        Error::cannot(format!("there is no room for scratch files: {e}"), "name another place in TMPDIR")
    })?;
    if config.capture.path.is_empty() {
        screen.note("bench", "photographing a synthetic head");
        let capture = scratch.path().join("demo");
        io::create_folder(&capture)?;
        write_capture(&capture, &SyntheticOptions::default())?;
        config.capture.path = io::real_path(&capture)?.display().to_string();
    }
    let quiet = |dir: &Path| Run::open(dir, stop.clone(), Arc::new(Warnings(screen.clone())));
    let run = quiet(&scratch.path().join("run"));
    io::create_folder(run.dir())?;
    let saved = target.as_ref().filter(|t| t.saved.is_some()).map(|t| quiet(&t.run));
    let demo = target.is_none() || saved.as_ref().is_some_and(|run| is_demo(&config, run));
    let open = |run| Line::open(&config, run).map(|line| if demo { line.of_demo() } else { line });
    let (line, finished) = (open(&run)?, saved.as_ref().map(open).transpose()?);
    let bench = Bench::new(&line, finished.as_ref(), truth.as_ref())?;
    let mut result = bench.begin();
    if let Some(old) = &old {
        old.comparable_with(&result)?;
    }
    let start = Instant::now();
    for (i, sweep) in chosen.iter().enumerate() {
        screen.note("bench", &format!("{sweep} ({} of {})", i + 1, chosen.len()));
        let measured = bench.measure(sweep, &mut result).map_err(|e| match stop.requested() {
            Some(kind) if e.kind().is_stop() => {
                Error::stopped("what was measured before is kept").with_kind(kind)
            }
            _ => e,
        });
        if let Some(reason) = measured? {
            screen.note("bench", &format!("{sweep} is left out: {reason}"));
        }
        write(&folder, &result, None)?;
    }
    let comparison = old.as_ref().map(|old| result.against(old));
    write(&folder, &result, comparison.as_ref())?;
    if common.json {
        let event = json!({"event": "result", "bench": results, "comparison": comparison});
        print(&format!("{event}\n"))?;
    } else if !common.quiet {
        let compared = comparison.as_ref().map_or(String::new(), |c| c.text());
        let took = duration(start.elapsed().as_secs_f64());
        print(&format!(
            "{}{compared}\nbench     {} in {took}\n",
            result.text(),
            folder.join("bench.html").display()
        ))?;
    }
    match comparison.map_or(0, |c| c.worse().count()) {
        0 => Ok(()),
        n => Err(Error::below(
            format!(
                "{n} figures are worse than in `{}`",
                options.compare.clone().unwrap_or_default().display()
            ),
            "they are named above; measure once more before you believe it",
        )),
    }
}

/// Results, drawings and page; the results last, for whoever waits for them.
fn write(
    folder: &Path,
    result: &BenchResult,
    comparison: Option<&crate::report::bench::Comparison>,
) -> Result<()> {
    for (name, svg) in result.plots()? {
        io::write_atomic(&folder.join(format!("{name}.svg")), svg.as_bytes())?;
    }
    io::write_atomic(&folder.join("bench.md"), result.markdown().as_bytes())?;
    io::write_atomic(&folder.join("bench.html"), result.html(comparison)?.as_bytes())?;
    Ok(io::write_atomic(&folder.join("bench.json"), result.json().as_bytes())?)
}

fn result_of(file: &Path) -> Result<BenchResult> {
    let bytes = io::read_bytes(file, &Limits { file_bytes: 64 << 20, ..Limits::default() })?;
    BenchResult::parse(&String::from_utf8_lossy(&bytes), &file.display().to_string())
}

/// A run's own configuration; else that of a first look.
fn configure(common: &Common, target: Option<&RunTarget>) -> Result<Config> {
    let Some(target) = target else {
        return common.resolve(None, Some((Preset::Draft, &format!("{SHORTER}{HALF}"))), &[]);
    };
    let mut config = common.resolve(target.saved.as_deref(), Some((Preset::Draft, HALF)), &[])?;
    if let Some(capture) = &target.capture {
        config.capture.path = capture.to_str().map(String::from).ok_or_else(|| {
            let shown = capture.display();
            Error::cannot(format!("the path of the capture is not UTF-8: `{shown}`"), "rename the folder")
        })?;
    }
    Ok(config)
}
