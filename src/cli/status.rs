//! `tiface status`: where runs stand; reads only `status.json` and `done.json`.

use super::options::Common;
use super::plain::one_line;
use super::screen::figure;
use super::stdout::print;
use crate::io;
use crate::pipeline::Stage;
use crate::report::duration;
use crate::run::{Record, State, Status, read_record, read_status};
use crate::{Error, Result};
use serde_json::json;
use std::path::{Path, PathBuf};

pub(super) fn run(common: &Common, runs: &[PathBuf]) -> Result<()> {
    let all = match (runs.is_empty(), &common.run) {
        (false, _) => runs.to_vec(),
        (true, Some(run)) => vec![run.clone()],
        (true, None) => io::list_folders(Path::new("runs"))?,
    };
    if all.is_empty() {
        return Err(Error::cannot("there are no runs under `runs/`", "name a run folder"));
    }
    let mut text = String::new();
    let mut damaged = 0;
    for run in &all {
        let mut stages = vec!["–".to_string()];
        if io::is_folder(run) {
            stages = Stage::ALL.map(|stage| stage.to_string()).to_vec();
            let paths = io::list_folders(&run.join("render/paths")).unwrap_or_default();
            let names = paths.iter().map(|path| path.file_name().unwrap_or_default().to_string_lossy());
            stages.extend(names.map(|name| format!("render/paths/{name}")));
        }
        for stage in stages {
            let found = read(run, &stage);
            damaged += usize::from(found.is_err());
            text += &match found {
                Ok((status, record)) if common.json => format!(
                    "{}\n",
                    json!({"run": run, "stage": stage, "done": record.is_some(), "status": status,
                        "summary": record.map(|r| r.summary)})
                ),
                Err(e) if common.json => {
                    format!("{}\n", json!({"run": run, "stage": stage, "error": e.to_string()}))
                }
                Ok((status, record)) => row(run, &stage, &words(status.as_ref(), record.as_ref())),
                Err(e) => row(run, &stage, &format!("UNREADABLE: {e}")),
            };
        }
    }
    print(&text)?;
    if damaged > 0 {
        return Err(Error::cannot(
            format!("{damaged} of these lines could not be read"),
            "name run folders; `tiface run RUN --fresh STAGE` makes a stage anew",
        ));
    }
    Ok(())
}

fn row(run: &Path, stage: &str, words: &str) -> String {
    format!("{:<24} {stage:<8} {}\n", one_line(&run.display().to_string()), one_line(words))
}

/// What a stage left in a run.
fn read(run: &Path, stage: &str) -> Result<(Option<Status>, Option<Record>)> {
    if !io::is_folder(run) {
        return Err(Error::cannot(format!("`{}` is not a folder", run.display()), ""));
    }
    let folder = run.join(stage);
    Ok((read_status(&folder)?, read_record(&folder)?))
}

/// Where a stage stands. The record is the truth: it is written after the status that says "done".
fn words(status: Option<&Status>, record: Option<&Record>) -> String {
    let s = match (record, status) {
        (Some(record), _) => return format!("done in {}", duration(record.elapsed_s)),
        (None, None) => return "–".into(),
        (None, Some(status)) => status,
    };
    let state = match s.state {
        State::Running | State::Done => "running, or killed".to_string(),
        State::Stopped => "stopped".into(),
        State::Failed => format!("failed: {}", s.error.as_deref().unwrap_or("no reason given")),
    };
    let step = if s.steps > 0 { format!(", step {} of {}", s.step, s.steps) } else { String::new() };
    let rate = s.rate.map(|rate| format!(", {}/s", figure(rate))).unwrap_or_default();
    let left = s.eta_s.map(|eta| format!(", {} left of this stage", duration(eta))).unwrap_or_default();
    format!("{state}{step}{rate}{left} (process {} on {})", s.pid, s.host)
}
