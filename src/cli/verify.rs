//! `tiface verify`: the products of runs, compared with their records.

use super::Invocation;
use super::screen::{one_line, print};
use super::status::{named_runs, read_status, run_name};
use crate::run::{Verification, VerifiedFile};
use rayon::prelude::*;
use serde_json::json;
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::{Error, Result};

/// Compares the products of runs with their records.
pub(super) fn run(invocation: &Invocation, runs: &[PathBuf]) -> Result<()> {
    let runs = named_runs(invocation, runs)?;
    let all: Vec<_> =
        runs.par_iter().map(|run| read_status(run).and_then(|_| crate::run::verify(run))).collect();
    let mut text = String::new();
    let (mut changed, mut unreadable) = (0, None);
    for (run, found) in runs.iter().zip(all) {
        match found {
            Ok(found) => {
                changed += usize::from(found.differing().next().is_some());
                text += &verification(invocation, run, &found);
            }
            Err(e) => {
                invocation.screen.note(&run_name(run), &e.to_string());
                unreadable.get_or_insert(e);
            }
        }
    }
    print(&text)?;
    match unreadable {
        Some(e) => Err(e),
        None if changed > 0 => Err(Error::below(
            format!("{changed} of {} differ from what was written", counted(runs.len(), "run")),
            "put the files back, or make each again with the command beside it; a stage made again removes what follows",
        )),
        None => Ok(()),
    }
}

/// Returns what was found in a run: an object, or a line and one for each difference.
fn verification(invocation: &Invocation, run: &Path, found: &Verification) -> String {
    if invocation.common.json {
        let mut value = json!(found);
        value["run"] = json!(run);
        return format!("{value}\n");
    }
    let by_size = found.files.iter().filter(|file| file.sha256.is_none()).count();
    let mut text = format!("{}: {}", run.display(), counted(found.files.len(), "file"));
    if by_size > 0 {
        text += &format!(", {by_size} compared by size only, as an older version recorded no digests");
    }
    if !found.unlisted.is_empty() {
        let stages = found.unlisted.join(", ");
        text += &format!(", and none of {stages}, as an older version recorded neither sizes nor digests");
    }
    text += match found.differing().next() {
        None => ", as recorded\n",
        Some(_) => "\n",
    };
    for VerifiedFile { problem, again, .. } in found.differing() {
        let line = format!(
            "{}; `{}` makes it again",
            problem.as_deref().unwrap_or_default(),
            again.as_deref().unwrap_or_default()
        );
        text += &format!("  {}\n", one_line(&line));
    }
    text
}
