//! `tiface status`: the states of runs, read from the status files of their stages.

use super::Invocation;
use super::screen::{figure, one_line, print};
use crate::config::Stage;
use crate::report::duration;
use crate::run::{Phase, Record, RunStatus, StageStatus, Status};
use clap::Args;
use rayon::prelude::*;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tiface_base::error::counted;
use tiface_base::io;
use tiface_base::{Error, Result};

/// Options of `tiface status`.
#[derive(Args, Debug)]
pub(super) struct StatusOptions {
    /// Run folders [default: all under runs/]
    runs: Vec<PathBuf>,
    /// Show only runs that failed, are damaged, were killed or cannot be read
    #[arg(long)]
    failed: bool,
    /// Repeat every two seconds, until all runs are done or failed, or until Ctrl-C
    #[arg(long, conflicts_with = "json")]
    watch: bool,
}

const REFRESH_INTERVAL: Duration = Duration::from_secs(2);
/// From more runs than this, those that are done or have not begun share lines.
const MAX_LINES: usize = 40;
/// Maximum length of a shared line, characters.
const LINE_WIDTH: usize = 100;

pub(super) fn run(invocation: &Invocation, options: &StatusOptions) -> Result<()> {
    let common = invocation.common;
    loop {
        // listed each time: runs may be added meanwhile
        let all = named_runs(invocation, &options.runs)?;
        let found: Vec<(&Path, Result<RunStatus>)> =
            all.par_iter().map(|run| (run.as_path(), read_status(run))).collect();
        let text = match &found[..] {
            found if common.json => objects(found, options.failed),
            [(run, Ok(status))] if !options.failed => stages(run, status),
            found => heads(found, options.failed, common.verbose > 0),
        };
        let clear = if options.watch && std::io::stdout().is_terminal() { "\x1b[H\x1b[2J" } else { "" };
        print(&format!("{clear}{text}"))?;
        let may_change = [Phase::Waiting, Phase::Running, Phase::Begun, Phase::Killed, Phase::Stopped];
        let changes = found.iter().any(|(_, run)| may_change.contains(&phase(run)));
        if options.watch && changes && invocation.stop.requested().is_none() {
            std::thread::park_timeout(REFRESH_INTERVAL);
            if invocation.stop.requested().is_none() {
                continue;
            }
        }
        let states = found.iter().map(|(_, run)| phase(run));
        return worst(&states.collect::<Vec<_>>());
    }
}

/// The states that need a user's attention, the worst first: of one run and of several, and what to
/// do about it.
const WRONG: [(Phase, [&str; 2], &str); 4] = [
    (
        Phase::Failed,
        ["failed", "failed"],
        "`tiface status --failed` shows why; remove the cause, then repeat the command for them",
    ),
    (
        Phase::Damaged,
        ["is damaged", "are damaged"],
        "`tiface verify` names the files, and the command that makes each again",
    ),
    (
        Phase::Killed,
        ["was killed", "were killed"],
        "`tiface status --failed` shows which; repeat the command for them: it continues",
    ),
    (
        Phase::Unreadable,
        ["could not be read", "could not be read"],
        "name run folders, and correct their config.toml; `tiface run RUN --fresh STAGE` repeats a stage",
    ),
];

/// Fails with what is wrong with runs of these states. The worst decides about the exit code: 1 if
/// runs could only not be read, else 3.
fn worst(states: &[Phase]) -> Result<()> {
    let count = |wrong: Phase| states.iter().filter(|state| **state == wrong).count();
    let found: Vec<_> = WRONG.iter().map(|row| (count(row.0), row)).filter(|(n, _)| *n > 0).collect();
    let Some((_, (phase, _, hint))) = found.first() else { return Ok(()) };
    let total = states.len();
    let mut of = format!(" of {}", counted(total, "run"));
    let all = found.iter().map(|(n, (_, [one, many], _))| {
        let verb = if *n == 1 { one } else { many };
        format!("{n}{} {verb}", std::mem::take(&mut of))
    });
    let what = all.collect::<Vec<_>>().join(", ");
    match phase {
        Phase::Unreadable => Err(Error::cannot(what, *hint)),
        _ => Err(Error::below(what, *hint)),
    }
}

fn phase(run: &Result<RunStatus>) -> Phase {
    run.as_ref().map_or(Phase::Unreadable, |s| s.phase)
}

/// Returns the named runs, or all under `runs/`; an error if there are none.
pub(super) fn named_runs(invocation: &Invocation, named: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let all = match (named, &invocation.common.run) {
        ([], Some(run)) => vec![run.clone()],
        ([], None) => io::list_folders(Path::new("runs"))?,
        _ => named.to_vec(),
    };
    match all.is_empty() {
        true => Err(Error::cannot("there are no runs under `runs/`", "name a run folder")),
        false => Ok(all),
    }
}

/// Returns the state of a run, if it is a folder.
pub(super) fn read_status(run: &Path) -> Result<RunStatus> {
    if !io::is_folder(run) {
        return Err(Error::cannot(format!("`{}` is not a folder", run.display()), ""));
    }
    Ok(RunStatus::read(run))
}

/// Returns whether the run needs a user's attention.
fn has_failed(run: &Result<RunStatus>) -> bool {
    WRONG.iter().any(|(wrong, ..)| *wrong == phase(run))
}

pub(super) fn run_name(run: &Path) -> String {
    one_line(&run.file_name().unwrap_or(run.as_os_str()).to_string_lossy()).into_owned()
}

/// Returns a line for each run, and one for all.
fn heads(runs: &[(&Path, Result<RunStatus>)], failed: bool, each: bool) -> String {
    let mut text = String::new();
    let shown: Vec<_> = runs.iter().filter(|(_, run)| !failed || has_failed(run)).collect();
    let width = shown.iter().map(|(run, _)| run_name(run).chars().count()).max().unwrap_or(0).clamp(8, 32);
    let mut shared: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    let mut left_s = 0.0;
    let mut counts: BTreeMap<usize, (&str, usize)> = BTreeMap::new();
    for (_, run) in runs {
        let phase = phase(run);
        counts.entry(phase as usize).or_insert((word(phase), 0)).1 += 1;
        left_s += run.as_ref().ok().and_then(|s| s.left_s).unwrap_or(0.0);
    }
    for (run, status) in shown {
        let status = match status {
            Ok(status) => status,
            Err(e) => {
                let _ = writeln!(text, "{:<width$}  UNREADABLE: {}", run_name(run), one_line(&e.to_string()));
                continue;
            }
        };
        let settled = [Phase::Done, Phase::Waiting].contains(&status.phase);
        if settled && !each && runs.len() > MAX_LINES {
            shared.entry(word(status.phase)).or_default().push(run_name(run));
            continue;
        }
        let bar: String = status.stages.iter().map(|s| sign(s.phase)).collect();
        let _ = writeln!(text, "{:<width$}  {bar}  {}", run_name(run), one_line(&described(status)));
    }
    for (word, names) in shared {
        let mut line = format!("{word}:");
        for name in names {
            if line.len() + 1 + name.len() > LINE_WIDTH {
                text += &format!("{line}\n");
                line = "  ".into();
            }
            line += &format!(" {name}");
        }
        text += &format!("{line}\n");
    }
    let counts: Vec<String> = counts.values().map(|(word, n)| format!("{n} {word}")).collect();
    let left = if left_s > 0.0 {
        format!("; about {} left, one after the other", duration(left_s))
    } else {
        String::new()
    };
    text + &format!("{} runs: {}{left}\n", runs.len(), counts.join(", "))
}

fn word(phase: Phase) -> &'static str {
    match phase {
        Phase::Waiting => "not begun",
        Phase::Running => "running",
        Phase::Killed => "killed",
        Phase::Stopped => "stopped",
        Phase::Failed => "failed",
        Phase::Unreadable => "UNREADABLE",
        Phase::Damaged => "DAMAGED",
        Phase::Begun => "begun",
        Phase::Done => "done",
    }
}

fn sign(phase: Phase) -> char {
    match phase {
        Phase::Waiting | Phase::Begun => '.',
        Phase::Running => '>',
        Phase::Killed => '!',
        Phase::Stopped => '=',
        Phase::Failed => 'x',
        Phase::Unreadable => '?',
        Phase::Damaged => '%',
        Phase::Done => '#',
    }
}

/// Describes the state of a run, after its bar.
fn described(run: &RunStatus) -> String {
    let at = run.stages.iter().find(|s| Some(s.stage) == run.at);
    let percent = at.and_then(|s| s.status.as_ref()?.percent());
    let share = percent.map_or(String::new(), |p| format!(" {p} %"));
    let place = at.map_or(String::new(), |s| format!("{}{share} ", s.stage));
    let left = run.left_s.filter(|s| *s > 0.0 && run.phase != Phase::Failed);
    let left = left.map_or(String::new(), |s| format!(", about {} left", duration(s)));
    match (&run.error, run.phase) {
        (Some(error), Phase::Failed) => format!("{place}failed: {error}"),
        (Some(error), _) => format!("{place}{}: {error}", word(run.phase)),
        (None, Phase::Done) => format!("done in {}", duration(run.elapsed_s)),
        (None, phase) => format!("{place}{}{left}", word(phase)),
    }
}

/// Returns a JSON object for each run, without settings.
fn objects(runs: &[(&Path, Result<RunStatus>)], failed: bool) -> String {
    let object = |(run, status): &&(&Path, Result<RunStatus>)| {
        let value = match status {
            Err(e) => json!({"run": run, "state": Phase::Unreadable, "error": e.to_string()}),
            Ok(s) => {
                let stages: Vec<Value> = s.stages.iter().map(stage_object).collect();
                json!({"run": run, "state": s.phase, "stage": s.at.map(|s| s.as_str()), "error": s.error,
                    "elapsed_s": s.elapsed_s, "left_s": s.left_s, "stages": stages})
            }
        };
        format!("{value}\n")
    };
    runs.iter().filter(|(_, run)| !failed || has_failed(run)).collect::<Vec<_>>().iter().map(object).collect()
}

fn stage_object(s: &crate::run::StageStatus) -> Value {
    let mut value =
        json!({"stage": s.stage.as_str(), "state": s.phase, "left_s": s.left_s, "error": s.error});
    if let Some(status) = &s.status {
        value["step"] = json!(status.step);
        value["steps"] = json!(status.steps);
        value["rate"] = json!(status.rate);
        value["pid"] = json!(status.pid);
        value["host"] = json!(status.host);
        value["device"] = json!(status.device);
        value["updated"] = json!(status.updated);
        value["elapsed_s"] = json!(status.elapsed_s);
    }
    if let Some(record) = &s.record {
        value["elapsed_s"] = json!(record.elapsed_s);
        value["cpu_s"] = json!(record.cpu_s);
        value["peak_bytes"] = json!(record.peak_bytes);
        value["warnings"] = json!(record.warnings);
        value["summary"] = record.summary.clone();
        value["faults"] = s.faults.iter().map(|fault| json!(fault.to_string())).collect();
    }
    value
}

/// Returns a row for each stage of one run, camera paths included, and the time left in total.
fn stages(run: &Path, status: &RunStatus) -> String {
    let mut text = String::new();
    let mut row = |stage: &str, words: &str| {
        let _ = writeln!(text, "{:<24} {stage:<8} {}", one_line(&run.display().to_string()), one_line(words));
    };
    for s in &status.stages {
        row(s.stage.as_str(), &of_stage(s));
    }
    for path in io::list_folders(&run.join("render/paths")).unwrap_or_default() {
        let name = format!("render/paths/{}", path.file_name().unwrap_or_default().to_string_lossy());
        row(&name, &of_stage(&StageStatus::read(&path, Stage::Render)));
    }
    if status.at.is_none() && status.error.is_some() {
        row("–", &described(status));
    }
    if let Some(left) = status.left_s.filter(|s| *s > 0.0) {
        row("all", &format!("about {} left", duration(left)));
    }
    text
}

/// Describes the state of a stage.
fn of_stage(s: &StageStatus) -> String {
    match &s.error {
        Some(error) if matches!(s.phase, Phase::Unreadable | Phase::Damaged) => {
            format!("{}: {error}", word(s.phase))
        }
        _ => {
            let gone = s.faults.iter().map(|fault| format!("; {fault}"));
            state_text(s.phase, s.status.as_ref(), s.record.as_ref()) + &gone.collect::<String>()
        }
    }
}

fn state_text(phase: Phase, status: Option<&Status>, record: Option<&Record>) -> String {
    let Some(s) = status.filter(|_| phase != Phase::Done) else {
        return record.map_or("–".into(), |r| format!("done in {}", duration(r.elapsed_s)));
    };
    let state = match phase {
        Phase::Failed => format!("failed: {}", s.error.as_deref().unwrap_or("no reason given")),
        phase => word(phase).into(),
    };
    let step = if s.steps > 0 { format!(", step {} of {}", s.step, s.steps) } else { String::new() };
    let rate = s.rate.map(|rate| format!(", {}/s", figure(rate))).unwrap_or_default();
    let left = s.eta_s.map(|eta| format!(", {} left of this stage", duration(eta))).unwrap_or_default();
    format!("{state}{step}{rate}{left} (process {} on {})", s.pid, s.host)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_state_decides_and_hides_no_other() {
        use Phase::{Begun, Damaged, Done, Failed, Killed, Running, Stopped, Unreadable, Waiting};
        assert_eq!(worst(&[Done, Running, Waiting, Begun, Stopped]), Ok(()));
        let ended = |states: &[Phase]| {
            let error = worst(states).unwrap_err();
            (error.kind().code(), error.to_string())
        };
        assert_eq!(ended(&[Killed, Done]), (3, "1 of 2 runs was killed".into()));
        assert_eq!(ended(&[Unreadable]), (1, "1 of 1 run could not be read".into()));
        let all = [Unreadable, Failed, Killed, Failed, Damaged, Done, Failed, Killed];
        let expected = "3 of 8 runs failed, 1 is damaged, 2 were killed, 1 could not be read";
        assert_eq!(ended(&all), (3, expected.into()));
    }
}
