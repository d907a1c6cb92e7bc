//! `tiface report`: rewrites the page of a run, or writes one page of many runs.

use super::Invocation;
use super::options::RunTarget;
use super::out::Out;
use super::screen::print;
use crate::io;
use crate::pipeline::{Session, renew_report};
use crate::report::{RunRow, runs_csv, runs_html};
use crate::run::Run;
use crate::{Error, Result};
use rayon::prelude::*;
use serde_json::json;
use std::path::{Path, PathBuf};

pub(super) fn run(invocation: &Invocation, runs: &[PathBuf], table: bool) -> Result<()> {
    let common = invocation.common;
    let out = Out::find(common.out.as_deref(), "report")?;
    let all = match (runs, &common.run) {
        ([], Some(run)) => vec![run.clone()],
        ([], None) => io::list_folders(Path::new("runs"))?,
        _ => runs.to_vec(),
    };
    match &all[..] {
        [] => Err(Error::cannot("there are no runs under `runs/`", "name a run folder")),
        [one] if !table => renew(invocation, one, out.as_ref()),
        all => many(invocation, all, out.as_ref()),
    }
}

/// Writes the page of one run, and a copy to `--out`.
fn renew(invocation: &Invocation, path: &Path, out: Option<&Out>) -> Result<()> {
    let common = invocation.common;
    let target = RunTarget::find(common, Some(path))?;
    let Some(saved) = &target.saved else {
        return Err(Error::usage(format!("`{}` is not a run", path.display()), "name the folder of a run"));
    };
    let config = common.resolve(Some(saved), None, &[])?;
    let run = Run::open(&target.run, invocation.stop.clone(), invocation.screen.clone());
    let session = Session::open(&config, &run)?;
    let mut page = run.path("report.html");
    if common.dry_run {
        invocation.screen.note("report", &format!("would write `{}`", page.display()));
        return Ok(());
    }
    renew_report(&session)?;
    if let Some(out) = out {
        let copy = out.file("report.html");
        out.prepare()?;
        io::write_atomic(&copy, &io::read_bytes(&page, &io::Limits::default())?)?;
        page = copy;
    }
    print_page_path(invocation, &page)
}

/// Writes the page of many runs, and their figures beside it as CSV.
fn many(invocation: &Invocation, runs: &[PathBuf], out: Option<&Out>) -> Result<()> {
    let page = out.map_or_else(|| PathBuf::from("runs.html"), |out| out.file("runs.html"));
    if let Some(wrong) = runs.iter().find(|run| !io::is_folder(run)) {
        return Err(Error::cannot(format!("`{}` is not a folder", wrong.display()), "name run folders"));
    }
    if invocation.common.dry_run {
        invocation.screen.note("report", &format!("would write `{}`", page.display()));
        return Ok(());
    }
    let folder = page.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
    io::create_folder(folder)?;
    let rows: Vec<RunRow> = runs.par_iter().map(|run| RunRow::read(run, folder)).collect();
    io::write_atomic(&page.with_extension("csv"), runs_csv(&rows).as_bytes())?;
    io::write_atomic(&page, runs_html(&rows)?.as_bytes())?;
    if invocation.common.json {
        let line = |row: RunRow| format!("{}\n", json!(RunRow { picture: String::new(), ..row }));
        print(&rows.into_iter().map(line).collect::<String>())?;
    }
    print_page_path(invocation, &page)
}

/// Prints the path of the page.
fn print_page_path(invocation: &Invocation, page: &Path) -> Result<()> {
    let common = invocation.common;
    match (common.json, common.quiet) {
        (true, _) => print(&format!("{}\n", json!({"event": "result", "report": page}))),
        (false, true) => Ok(()),
        (false, false) => print(&format!("report    {}\n", page.display())),
    }
}
