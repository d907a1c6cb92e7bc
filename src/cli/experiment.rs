//! `tiface experiment`: the paper's tables on captures, next to the published figures.

use super::Invocation;
use super::demo::photograph;
use super::out::Out;
use super::run::in_words;
use super::screen::print;
use crate::capture::is_run;
use crate::capture::synthetic::SyntheticOptions;
use crate::config::{Config, key};
use crate::io::{self, Limits};
use crate::pipeline::Session;
use crate::pipeline::experiment::{
    ORDERINGS, ROWS, TABLES, ahead, config, measured, runs, without_masks, work,
};
use crate::report::duration;
use crate::report::experiment::{Experiment, ExperimentRow, Measured, read_published};
use crate::run::{Cost, Run};
use crate::{Error, Result};
use clap::Args;
use clap::builder::PossibleValuesParser;
use serde_json::json;
use std::path::{Path, PathBuf};

/// Options of `tiface experiment`.
#[derive(Args, Debug)]
pub(super) struct ExperimentOptions {
    /// Captures; `demo` is the synthetic head
    #[arg(value_name = "CAPTURE", required = true)]
    captures: Vec<PathBuf>,
    /// Tables to make, separated by commas [default: all]
    #[arg(long, value_name = "LIST", value_delimiter = ',', value_parser = PossibleValuesParser::new(TABLES.map(|t| t.0)))]
    tables: Vec<String>,
    /// Share of the published number of steps, 0.001 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 1.0)]
    scale: f64,
    /// Make only this run, as named by --dry-run, and no tables; repeatable
    #[arg(long, value_name = "CAPTURE/RUN")]
    only: Vec<String>,
    /// Make only the tables, from existing runs
    #[arg(long, conflicts_with = "only")]
    collect: bool,
    /// Published figures to compare with, as lines of table,row,measure,value
    #[arg(long, value_name = "FILE")]
    published: Option<PathBuf>,
}

/// A run of a capture.
struct Task {
    /// `capture/run`, also its folder below the experiment's.
    name: String,
    run: &'static str,
    config: Config,
}

pub(super) fn run(invocation: &Invocation, options: &ExperimentOptions) -> Result<()> {
    let Invocation { common, screen, stop } = invocation;
    if !(0.001..=1.0).contains(&options.scale) {
        let found = format!("`--scale {}` is not between 0.001 and 1", options.scale);
        return Err(Error::usage(
            found,
            "0.1 makes all tables of two captures in some 70 minutes on two cores",
        ));
    }
    let ignored = [
        ("--preset", common.preset.is_some()),
        ("--config", !common.config.is_empty()),
        ("--fresh", common.fresh.is_some()),
        ("--run", common.run.is_some()),
    ];
    if let Some((word, _)) = ignored.iter().find(|(_, given)| *given) {
        let problem = format!("`{word}` cannot be used with `experiment`, whose rows set it");
        return Err(Error::usage(
            problem,
            "change a setting of all rows with `--set KEY=VALUE`; `--out FOLDER` sets the folder",
        ));
    }
    let folder = match Out::find(common.out.as_deref(), "experiment")? {
        Some(out) => out.file(""),
        None => PathBuf::from("experiment"),
    };
    let is_asked =
        |table: &&(&str, &str)| options.tables.is_empty() || options.tables.iter().any(|t| t == table.0);
    let tables: Vec<(&str, &str)> = TABLES.iter().filter(is_asked).copied().collect();
    let words: Vec<&str> = tables.iter().map(|t| t.0).collect();
    let published = match &options.published {
        Some(file) => {
            let bytes = io::read_maybe_empty(file, &Limits { file_bytes: 1 << 20, ..Limits::default() })?;
            read_published(&String::from_utf8_lossy(&bytes), &ROWS, &file.display().to_string())?
        }
        None => Vec::new(),
    };
    let mut set = common.set.clone();
    set.extend(common.device_word().iter().map(|d| format!("{}={d}", key!(device))));
    set.extend(common.seed.iter().map(|s| format!("{}={s}", key!(seed))));
    let mut captures: Vec<String> = Vec::new();
    let mut tasks = Vec::new();
    for path in &options.captures {
        let real = io::real_path(&demo(path, &folder, invocation)?)?;
        let name = real.file_name().map_or("capture".into(), |n| n.to_string_lossy().into_owned());
        if captures.contains(&name) {
            return Err(Error::usage(
                format!("two captures are called `{name}`"),
                "rename one of the folders",
            ));
        }
        for run in runs(&words) {
            let mut config = config(run, options.scale, &set)?.with_capture(real.clone())?;
            without_masks(run, &mut config);
            tasks.push(Task { name: format!("{name}/{run}"), run, config });
        }
        captures.push(name);
    }
    if let Some(wrong) = options.only.iter().find(|o| !tasks.iter().any(|t| t.name == **o)) {
        let known: Vec<&str> = tasks.iter().map(|t| t.name.as_str()).collect();
        return Err(Error::usage(format!("unknown run `{wrong}`"), format!("runs are {}", known.join(", "))));
    }
    let all = options.only.is_empty();
    let chosen = |task: &&Task| !options.collect && (all || options.only.contains(&task.name));
    let open = |task: &Task| Run::open(&folder.join(&task.name), stop.clone(), screen.clone());
    let opened: Vec<Run> = tasks.iter().map(open).collect();
    let mut sessions: Vec<Option<Session>> = tasks.iter().map(|_| None).collect();
    let (mut failed, mut sum) = (None, Cost::default());
    for ((task, run), session) in
        tasks.iter().zip(&opened).zip(&mut sessions).filter(|((task, _), _)| chosen(task))
    {
        let planned = Session::open(&task.config, run).and_then(|opened| {
            let cost = if common.dry_run { ahead(&opened, task.run)? } else { None };
            Ok((opened, cost))
        });
        let (opened, cost) = match planned {
            Ok(planned) => planned,
            // a capture may lack the inputs of one row (masks) and have those of others
            Err(e) if common.dry_run => {
                match common.json {
                    true => print(&format!("{}\n", json!({"run": task.name, "error": e.to_string()})))?,
                    false => print(&format!("{:<32} cannot be made: {e}\n", task.name))?,
                }
                continue;
            }
            Err(e) => {
                screen.note("experiment", &format!("{}: {e}", task.name));
                failed.get_or_insert(e.within(&task.name));
                continue;
            }
        };
        let session = &*session.insert(opened);
        if common.dry_run {
            sum = sum + cost.unwrap_or_default();
            if common.json {
                let done = cost.is_none();
                print(&format!("{}\n", json!({"run": task.name, "done": done, "estimate": cost})))?;
                continue;
            }
            let state = cost.map_or("done".into(), |c| format!("to do  about {}", duration(c.seconds())));
            print(&format!("{:<32} {state}\n", task.name))?;
            continue;
        }
        io::create_folder(run.dir())?;
        screen.note("experiment", &task.name);
        match work(session, task.run) {
            Err(e) if e.kind().is_stop() => {
                failed = Some(e);
                break;
            }
            // a failed row is a result, and does not stop the others
            Err(e) => {
                screen.note("experiment", &format!("{}: {e}", task.name));
                failed.get_or_insert(e.within(&task.name));
            }
            Ok(()) => {}
        }
    }
    if common.dry_run {
        if sum.cpu_s > 0.0 && !common.json {
            print(&format!("{:<32} {}\n", "all", in_words(sum)))?;
        }
        return Ok(());
    }
    // with --only, no tables: every task of a cluster would read all captures
    if !all {
        return failed.map_or(Ok(()), Err);
    }
    let rows: Vec<_> = ROWS.into_iter().filter(|row| words.contains(&row.table)).collect();
    let mut measured: Vec<Vec<Measured>> = vec![Vec::new(); rows.len()];
    // every capture has the same runs in the same order, so each row has one of each capture
    for (task, session) in tasks.iter().zip(&sessions) {
        let (own, places): (Vec<&ExperimentRow>, Vec<&mut Vec<Measured>>) =
            rows.iter().zip(&mut measured).filter(|(row, _)| row.run == task.run).unzip();
        places.into_iter().zip(found(&folder, task, session.as_ref(), &own)).for_each(|(to, m)| to.push(m));
    }
    let orderings = ORDERINGS.into_iter().filter(|o| words.contains(&o.table)).collect();
    let experiment =
        Experiment { scale: options.scale, tables, rows, orderings, captures, measured, published };
    write(&folder, &experiment)?;
    if common.json {
        let result = json!({"event": "result", "out": folder.join("experiment.json")});
        print(&format!("{result}\n"))?;
    } else if !common.quiet {
        print(&format!(
            "{}\nexperiment {}\n",
            experiment.markdown(),
            folder.join("experiment.md").display()
        ))?;
    }
    failed.map_or(Ok(()), Err)
}

/// Returns the folder of a capture; `demo`, if no capture has this name, is the demo head, rendered into the experiment.
fn demo(path: &Path, folder: &Path, invocation: &Invocation) -> Result<PathBuf> {
    let is_capture = io::is_folder(path) && !is_run(path);
    if path != Path::new("demo") || is_capture {
        return Ok(path.into());
    }
    let capture = folder.join("captures/demo");
    if !io::is_file(&capture.join("transforms.json")) {
        if invocation.common.dry_run {
            return Err(Error::usage(
                "the photographs of the demo head are not rendered yet, so its runs cannot be planned",
                "repeat without --dry-run, or render them: `tiface demo --run FOLDER`",
            ));
        }
        photograph(&capture, &SyntheticOptions::default(), None, invocation)?;
    }
    Ok(capture)
}

/// Returns the figures of some rows from their run, which is only read.
fn found(folder: &Path, task: &Task, session: Option<&Session>, rows: &[&ExperimentRow]) -> Vec<Measured> {
    let of = |session: &Session| rows.iter().map(|row| measured(session, row)).collect();
    if let Some(session) = session {
        return of(session);
    }
    let run = Run::quiet(&folder.join(&task.name));
    let problem = if io::is_folder(run.dir()) {
        match Session::open(&task.config, &run) {
            Ok(session) => return of(&session),
            Err(e) => e.to_string(),
        }
    } else {
        "not made yet".to_owned() // without reading the capture
    };
    vec![Measured { problem: Some(problem), ..Measured::default() }; rows.len()]
}

/// Writes the tables as Markdown and JSON, the JSON last: a program may wait for it.
fn write(folder: &Path, experiment: &Experiment) -> Result<()> {
    io::create_folder(folder)?;
    io::write_atomic(&folder.join("experiment.md"), experiment.markdown().as_bytes())?;
    Ok(io::write_atomic(&folder.join("experiment.json"), experiment.json().as_bytes())?)
}
