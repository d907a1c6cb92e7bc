//! `tiface experiment`: the paper's tables on captures, next to the published figures.

use super::Invocation;
use super::demo::photograph;
use super::options::Common;
use super::out::Out;
use super::run::in_words;
use super::screen::{Screen, print};
use crate::config::{Config, key};
use crate::pipeline::Session;
use crate::pipeline::experiment::{
    ORDERINGS, ROWS, TABLES, ahead, config, measured, runs, without_masks, work,
};
use crate::report::duration;
use crate::report::experiment::{Experiment, ExperimentRow, Measured, Published, read_published};
use crate::run::{Cost, Run, is_run};
use clap::Args;
use clap::builder::PossibleValuesParser;
use serde_json::json;
use std::path::{Path, PathBuf};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};
use tiface_capture::synthetic::SyntheticOptions;

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

/// The captures, tables and runs of an experiment.
struct Plan {
    folder: PathBuf,
    /// The name and heading of each table.
    tables: Vec<(&'static str, &'static str)>,
    published: Vec<Published>,
    captures: Vec<String>,
    /// Every capture has the same runs in the same order.
    tasks: Vec<Task>,
}

/// A run of a capture.
struct Task {
    /// `capture/run`, also its folder below the experiment's.
    name: String,
    run: &'static str,
    config: Config,
    /// Whether it is to be made, or planned with `--dry-run`.
    is_chosen: bool,
}

pub(super) fn run(invocation: &Invocation, options: &ExperimentOptions) -> Result<()> {
    let Invocation { common, screen, stop } = invocation;
    refuse(common, options)?;
    let plan = Plan::new(invocation, options)?;
    let open = |task: &Task| Run::open(&plan.folder.join(&task.name), stop.clone(), screen.clone());
    let runs: Vec<Run> = plan.tasks.iter().map(open).collect();
    if common.dry_run {
        return print_costs(&plan, &runs, common.json);
    }
    let (sessions, failed) = make(&plan, &runs, screen)?;
    // with --only, no tables: every task of a cluster would read all captures
    if options.only.is_empty() {
        tell(&plan.folder, &collect(&plan, &sessions, options.scale), common)?;
    }
    failed.map_or(Ok(()), Err)
}

/// Refuses options that have no meaning for an experiment.
fn refuse(common: &Common, options: &ExperimentOptions) -> Result<()> {
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
    Ok(())
}

impl Plan {
    fn new(invocation: &Invocation, options: &ExperimentOptions) -> Result<Plan> {
        let folder = match Out::find(invocation.common.out.as_deref(), "experiment")? {
            Some(out) => out.file(""),
            None => PathBuf::from("experiment"),
        };
        let is_asked =
            |table: &&(&str, &str)| options.tables.is_empty() || options.tables.iter().any(|t| t == table.0);
        let tables = TABLES.iter().filter(is_asked).copied().collect();
        let published = match &options.published {
            Some(file) => {
                let limits = Limits { file_bytes: 1 << 20, ..Limits::default() };
                let bytes = io::read_maybe_empty(file, &limits)?;
                read_published(&String::from_utf8_lossy(&bytes), &ROWS, &file.display().to_string())?
            }
            None => Vec::new(),
        };
        let mut plan = Plan { folder, tables, published, captures: Vec::new(), tasks: Vec::new() };
        for path in &options.captures {
            plan.add_capture(path, invocation, options)?;
        }
        let is_unknown = |name: &&String| !plan.tasks.iter().any(|task| task.name == **name);
        if let Some(wrong) = options.only.iter().find(is_unknown) {
            let known: Vec<&str> = plan.tasks.iter().map(|t| t.name.as_str()).collect();
            let hint = format!("runs are {}", known.join(", "));
            return Err(Error::usage(format!("unknown run `{wrong}`"), hint));
        }
        Ok(plan)
    }

    /// Adds the runs of a capture.
    fn add_capture(
        &mut self,
        path: &Path,
        invocation: &Invocation,
        options: &ExperimentOptions,
    ) -> Result<()> {
        let common = invocation.common;
        let real = io::real_path(&demo(path, &self.folder, invocation)?)?;
        let capture = real.file_name().map_or("capture".into(), |n| n.to_string_lossy().into_owned());
        if self.captures.contains(&capture) {
            return Err(Error::usage(
                format!("two captures are called `{capture}`"),
                "rename one of the folders",
            ));
        }
        let mut set = common.set.clone();
        set.extend(common.device_word().iter().map(|d| format!("{}={d}", key!(device))));
        set.extend(common.seed.iter().map(|s| format!("{}={s}", key!(seed))));
        for run in runs(&self.table_names()) {
            let mut config = config(run, options.scale, &set)?.with_capture(real.clone())?;
            without_masks(run, &mut config);
            let name = format!("{capture}/{run}");
            let is_named = options.only.is_empty() || options.only.contains(&name);
            self.tasks.push(Task { name, run, config, is_chosen: is_named && !options.collect });
        }
        self.captures.push(capture);
        Ok(())
    }

    fn table_names(&self) -> Vec<&'static str> {
        self.tables.iter().map(|table| table.0).collect()
    }

    /// Returns the chosen tasks, each with its run.
    fn chosen<'r>(&'r self, runs: &'r [Run]) -> impl Iterator<Item = (&'r Task, &'r Run)> {
        self.tasks.iter().zip(runs).filter(|(task, _)| task.is_chosen)
    }
}

/// Prints the state of the chosen runs and the estimated cost of those that are not done.
fn print_costs(plan: &Plan, runs: &[Run], json: bool) -> Result<()> {
    let mut sum = Cost::default();
    for (task, run) in plan.chosen(runs) {
        let cost = match Session::open(&task.config, run).and_then(|session| ahead(&session, task.run)) {
            Ok(cost) => cost,
            // a capture may lack the inputs of one row (masks) and have those of others
            Err(e) => {
                match json {
                    true => print(&format!("{}\n", json!({"run": task.name, "error": e.to_string()})))?,
                    false => print(&format!("{:<32} cannot be made: {e}\n", task.name))?,
                }
                continue;
            }
        };
        sum = sum + cost.unwrap_or_default();
        if json {
            let done = cost.is_none();
            print(&format!("{}\n", json!({"run": task.name, "done": done, "estimate": cost})))?;
        } else {
            let state = cost.map_or("done".into(), |c| format!("to do  about {}", duration(c.seconds())));
            print(&format!("{:<32} {state}\n", task.name))?;
        }
    }
    if sum.cpu_s > 0.0 && !json {
        print(&format!("{:<32} {}\n", "all", in_words(sum)))?;
    }
    Ok(())
}

/// Completes the chosen runs. Returns the sessions of all tasks, `None` for one that was not
/// opened, and the first error.
fn make<'r>(
    plan: &'r Plan,
    runs: &'r [Run],
    screen: &Screen,
) -> Result<(Vec<Option<Session<'r>>>, Option<Error>)> {
    let mut sessions: Vec<Option<Session>> = plan.tasks.iter().map(|_| None).collect();
    let mut failed = None;
    let chosen = plan.tasks.iter().zip(runs).zip(&mut sessions).filter(|((task, _), _)| task.is_chosen);
    for ((task, run), session) in chosen {
        let done = match Session::open(&task.config, run) {
            Ok(opened) => {
                io::create_folder(run.dir())?;
                screen.note("experiment", &task.name);
                work(session.insert(opened), task.run)
            }
            Err(e) => Err(e),
        };
        let Err(e) = done else { continue };
        if e.kind().is_stop() {
            failed = Some(e);
            break;
        }
        // a failed row is a result, and does not stop the others
        screen.note("experiment", &format!("{}: {e}", task.name));
        failed.get_or_insert(e.within(&task.name));
    }
    Ok((sessions, failed))
}

/// Returns the tables with the figures of all runs, of which those without a session are only read.
fn collect(plan: &Plan, sessions: &[Option<Session>], scale: f64) -> Experiment {
    let names = plan.table_names();
    let rows: Vec<_> = ROWS.into_iter().filter(|row| names.contains(&row.table)).collect();
    let mut measured: Vec<Vec<Measured>> = vec![Vec::new(); rows.len()];
    // every capture has the same runs in the same order, so each row has one of each capture
    for (task, session) in plan.tasks.iter().zip(sessions) {
        let (own, places): (Vec<&ExperimentRow>, Vec<&mut Vec<Measured>>) =
            rows.iter().zip(&mut measured).filter(|(row, _)| row.run == task.run).unzip();
        let figures = found(&plan.folder, task, session.as_ref(), &own);
        places.into_iter().zip(figures).for_each(|(to, m)| to.push(m));
    }
    let orderings = ORDERINGS.into_iter().filter(|o| names.contains(&o.table)).collect();
    let (tables, captures, published) = (plan.tables.clone(), plan.captures.clone(), plan.published.clone());
    Experiment { scale, tables, rows, orderings, captures, measured, published }
}

/// Writes the tables, and prints them.
fn tell(folder: &Path, experiment: &Experiment, common: &Common) -> Result<()> {
    write(folder, experiment)?;
    if common.json {
        let result = json!({"event": "result", "out": folder.join("experiment.json")});
        print(&format!("{result}\n"))?;
    } else if !common.quiet {
        let (table, file) = (experiment.markdown(), folder.join("experiment.md"));
        print(&format!("{table}\nexperiment {}\n", file.display()))?;
    }
    Ok(())
}

/// Returns the folder of a capture; `demo`, if no capture has this name, is the demo head, rendered
/// into the experiment.
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
