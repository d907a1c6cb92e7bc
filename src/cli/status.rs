//! `tiface status`: where runs stand; reads only `status.json` and `done.json`.

use super::ending::{Ending, say};
use super::options::Common;
use super::screen::{duration, figure};
use crate::io;
use crate::pipeline::STAGES;
use crate::run::{Exit, State, read_record, read_status};
use serde_json::json;
use std::path::{Path, PathBuf};

pub(super) fn go(common: &Common, runs: &[PathBuf]) -> Result<Exit, Ending> {
    let all = match (runs.is_empty(), &common.run) {
        (false, _) => runs.to_vec(),
        (true, Some(run)) => vec![run.clone()],
        (true, None) => io::list_folders(Path::new("runs"))?,
    };
    if all.is_empty() {
        return Err(Ending::cannot("there are no runs under `runs/`", "name a run folder"));
    }
    let mut text = String::new();
    for run in &all {
        if !io::is_folder(run) {
            return Err(Ending::cannot(format!("`{}` is not a folder", run.display()), "name a run folder"));
        }
        for stage in STAGES {
            text += &line(common, run, stage)?;
        }
    }
    say(&text)?;
    Ok(Exit::Done)
}

fn line(common: &Common, run: &Path, stage: &str) -> Result<String, Ending> {
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
                words += &format!(", {} left", duration(eta));
            }
            words + &format!(" (process {} on {})", s.pid, s.host)
        }
    };
    Ok(format!("{:<24} {stage:<8} {words}\n", run.display().to_string()))
}
