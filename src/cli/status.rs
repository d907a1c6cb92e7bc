//! `tiface status`: where runs stand; reads only `status.json` and `done.json`.

use super::options::Common;
use super::plain::one_line;
use super::screen::{duration, figure};
use super::stdout::print;
use crate::io;
use crate::pipeline::Stage;
use crate::run::{State, read_record, read_status};
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
        let mut told = |stage: &str| {
            text += &line(common, run, stage).unwrap_or_else(|e| {
                damaged += 1;
                if common.json {
                    format!("{}\n", json!({"run": run, "stage": stage, "error": e.to_string()}))
                } else {
                    row(run, stage, &format!("UNREADABLE: {}", e.to_string()))
                }
            });
        };
        if !io::is_folder(run) {
            told("–");
            continue;
        }
        Stage::ALL.iter().for_each(|stage| told(stage.word()));
        for path in io::list_folders(&run.join("render/paths")).unwrap_or_default() {
            told(&format!("render/paths/{}", path.file_name().unwrap_or_default().to_string_lossy()));
        }
    }
    print(&text)?;
    if damaged > 0 {
        return Err(Error::cannot(
            format!("{damaged} of these lines could not be told"),
            "name run folders; `tiface run RUN --fresh STAGE` makes a stage anew",
        ));
    }
    Ok(())
}

fn row(run: &Path, stage: &str, words: &str) -> String {
    format!("{:<24} {stage:<8} {}\n", one_line(&run.display().to_string()), one_line(words))
}

fn line(common: &Common, run: &Path, stage: &str) -> Result<String> {
    if !io::is_folder(run) {
        return Err(Error::cannot(format!("`{}` is not a folder", run.display()), ""));
    }
    let folder = run.join(stage);
    let status = read_status(&folder)?;
    // the record is the truth: it is written after the status that says "done"
    let record = read_record(&folder)?;
    if common.json {
        let value = json!({
            "run": run,
            "stage": stage,
            "done": record.is_some(),
            "status": status,
            "summary": record.map(|r| r.summary),
        });
        return Ok(format!("{value}\n"));
    }
    let words = match (&record, &status) {
        (Some(record), _) => format!("done in {}", duration(record.elapsed_s)),
        (None, None) => "–".into(),
        (None, Some(s)) => {
            let mut words = match s.state {
                State::Running | State::Done => "running, or killed".to_string(),
                State::Stopped => "stopped".into(),
                State::Failed => format!("failed: {}", s.error.as_deref().unwrap_or("no reason given")),
            };
            if s.steps > 0 {
                words += &format!(", step {} of {}", s.step, s.steps);
            }
            if let Some(rate) = s.rate {
                words += &format!(", {}/s", figure(rate));
            }
            if let Some(eta) = s.eta_s {
                words += &format!(", {} left of this stage", duration(eta));
            }
            words + &format!(" (process {} on {})", s.pid, s.host)
        }
    };
    Ok(row(run, stage, &words))
}
