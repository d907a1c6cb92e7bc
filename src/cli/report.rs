//! `tiface report`: rewrites the page of a run, compares two runs, or writes one page of many runs.

use super::Invocation;
use super::out::Out;
use super::screen::print;
use super::target::RunTarget;
use crate::config::{Config, Stage};
use crate::pipeline::{Session, compare_runs, curves, renew_report};
use crate::report::{RunRow, curves_csv, runs_csv, runs_html};
use crate::run::{Run, read_record};
use rayon::prelude::*;
use serde_json::json;
use std::path::{Path, PathBuf};
use tiface_base::{Error, Result, io};

pub(super) fn run(invocation: &Invocation, runs: &[PathBuf], table: bool) -> Result<()> {
    let common = invocation.common;
    let out = Out::find(common.out.as_deref(), "report")?;
    match &super::status::named_runs(invocation, runs)?[..] {
        [one] if !table => renew(invocation, one, out.as_ref()),
        [a, b] if !table && are_comparable(a, b) => compare(invocation, [a, b], out.as_ref()),
        all => many(invocation, all, out.as_ref()),
    }
}

/// Writes the page of one run and its curves as CSV into the run, and a copy of the page to
/// `--out`.
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
    let curves = curves_csv(&curves(&[(&session, "")])?);
    run.write("report.csv", curves.as_bytes())?;
    if let Some(out) = out {
        let copy = out.file("report.html");
        out.prepare()?;
        io::write_atomic(&copy, &io::read_bytes(&page, &io::Limits::default())?)?;
        page = copy;
    }
    print_page_path(invocation, &page)
}

/// Returns whether two runs have metrics of the same capture.
fn are_comparable(a: &Path, b: &Path) -> bool {
    let capture = |run: &Path| {
        let is_judged = read_record(&run.join(Stage::Metrics)).is_ok_and(|record| record.is_some());
        let path = Config::of_run(run).filter(|_| is_judged)?.capture.path;
        Some(io::real_path(&path).unwrap_or(path))
    };
    capture(a).is_some_and(|a| Some(a) == capture(b))
}

/// Writes a page that compares two runs, and their curves beside it as CSV.
fn compare(invocation: &Invocation, paths: [&PathBuf; 2], out: Option<&Out>) -> Result<()> {
    let common = invocation.common;
    let name = |path: &Path| {
        let own =
            io::real_path(path).ok().and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
        own.unwrap_or_else(|| path.display().to_string())
    };
    let mut names = paths.map(|path| name(path));
    if names[0] == names[1] {
        names = paths.map(|path| path.display().to_string());
    }
    let target = |path: &Path| {
        let target = RunTarget::find(common, Some(path))?;
        match &target.saved {
            Some(saved) => Ok((common.resolve(Some(saved), None, &[])?, target.run)),
            None => Err(Error::usage(format!("`{}` is not a run", path.display()), "name two run folders")),
        }
    };
    let [(config_a, run_a), (config_b, run_b)] = [target(paths[0])?, target(paths[1])?];
    let open = |run: &Path| Run::open(run, invocation.stop.clone(), invocation.screen.clone());
    let (run_a, run_b) = (open(&run_a), open(&run_b));
    let sessions = [Session::open(&config_a, &run_a)?, Session::open(&config_b, &run_b)?];
    let page = out.map_or_else(|| PathBuf::from("compare.html"), |out| out.file("compare.html"));
    if common.dry_run {
        invocation.screen.note("report", &format!("would write `{}`", page.display()));
        return Ok(());
    }
    out.into_iter().try_for_each(Out::prepare)?;
    let folder = page.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let html = compare_runs([&sessions[0], &sessions[1]], [&names[0], &names[1]], folder)?;
    let curves = curves(&[(&sessions[0], &names[0]), (&sessions[1], &names[1])])?;
    io::write_atomic(&page.with_extension("csv"), curves_csv(&curves).as_bytes())?;
    io::write_atomic(&page, html.as_bytes())?;
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
