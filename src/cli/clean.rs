//! `tiface clean`: removes what finished runs do not need any more.

use super::Invocation;
use super::screen::print;
use super::status::run_name;
use crate::config::{Config, SETTINGS_FILE};
use crate::pipeline::{cost_of_removal, remove_surplus, stage_folders, surplus};
use crate::run::{Run, Surplus, SurplusKind, is_run};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::{Error, Result, io};

/// Lists what each run does not need, and removes it if `yes`.
pub(super) fn run(invocation: &Invocation, runs: &[PathBuf], yes: bool) -> Result<()> {
    let removes = yes && !invocation.common.dry_run;
    let (mut rest, mut failed) = (0, None);
    for run in runs {
        match clean(invocation, run, removes) {
            Ok(bytes) => rest += bytes,
            Err(e) if runs.len() == 1 => return Err(e),
            Err(e) => {
                invocation.screen.note(&run_name(run), &e.to_string());
                failed.get_or_insert(e);
            }
        }
    }
    if !removes && rest > 0 {
        invocation.screen.note("clean", "nothing is removed; with `--yes` it is");
    }
    failed.map_or(Ok(()), Err)
}

/// Lists what a run does not need, then removes it if `removes`. Returns its bytes.
fn clean(invocation: &Invocation, folder: &Path, removes: bool) -> Result<u64> {
    if !is_run(folder) {
        let what = format!("`{}` is not a run", folder.display());
        return Err(Error::usage(what, "name the folder of a run"));
    }
    let config = Config::read(&folder.join(SETTINGS_FILE))?;
    let run = Run::open(folder, invocation.stop.clone(), invocation.screen.clone());
    // held before it is looked at: what is listed is what goes
    let held = removes.then(|| run.hold(&stage_folders())).transpose()?;
    let (found, kept) = surplus(&run, &config)?;
    let bytes = found.iter().map(|s| s.bytes).sum();
    let all: u64 = io::file_sizes(folder, &|_| false)?.values().sum();
    let cost = cost_of_removal(&run, &found)?;
    if invocation.common.json {
        print(&format!("{}\n", as_json(folder, &found, bytes, all, &kept, removes)))?;
    } else if !invocation.common.quiet {
        print(&listed(folder, &found, bytes, all))?;
        let name = run_name(folder);
        kept.iter().chain(&cost).for_each(|text| invocation.screen.note(&name, text));
    }
    if let Some(held) = held {
        remove_surplus(&run, &held, &found)?;
    }
    Ok(bytes)
}

/// Returns a line for each kind of surplus in each stage, and one for the run.
fn listed(folder: &Path, found: &[Surplus], bytes: u64, all: u64) -> String {
    let shown = folder.display();
    let mut text = String::new();
    let alike = |a: &Surplus, b: &Surplus| (&a.stage, a.kind) == (&b.stage, b.kind);
    for group in found.chunk_by(alike) {
        let size = megabytes(group.iter().map(|s| s.bytes).sum());
        let Surplus { stage, file, kind, .. } = &group[0];
        text += &match kind {
            SurplusKind::Moments => format!("{shown}/{stage}/{file}: {size}, the optimizer's moments\n"),
            SurplusKind::OldCheckpoint => {
                format!("{shown}/{stage}: {size}, {}\n", counted(group.len(), "old checkpoint"))
            }
            SurplusKind::FloatView => {
                format!("{shown}/{stage}: {size}, {}\n", counted(group.len(), "float view"))
            }
        };
    }
    match found.is_empty() {
        true => format!("{shown}: nothing to remove, {} in all\n", megabytes(all)),
        false => text + &format!("{shown}: {} of {}\n", megabytes(bytes), megabytes(all)),
    }
}

fn as_json(folder: &Path, found: &[Surplus], bytes: u64, all: u64, kept: &[String], removed: bool) -> Value {
    let file =
        |s: &Surplus| json!({"file": format!("{}/{}", s.stage, s.file), "bytes": s.bytes, "kind": s.kind});
    let files: Vec<Value> = found.iter().map(file).collect();
    json!({"run": folder, "files": files, "bytes": bytes, "of": all, "kept": kept, "removed": removed})
}

fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn surplus_is_listed_by_stage_and_kind_with_its_size() {
        let of = |stage: &str, file: &str, bytes, kind| Surplus {
            stage: stage.into(),
            file: file.into(),
            bytes,
            kind,
        };
        let found = [
            of("iface", "checkpoint.safetensors", 43_800_000, SurplusKind::Moments),
            of("render", "tface/float/a.exr", 1_500_000, SurplusKind::FloatView),
            of("render", "tface/float/b.exr", 500_000, SurplusKind::FloatView),
        ];
        let text = listed(Path::new("runs/a"), &found, 45_800_000, 100_000_000);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines,
            [
                "runs/a/iface/checkpoint.safetensors: 43.8 MB, the optimizer's moments",
                "runs/a/render: 2.0 MB, 2 float views",
                "runs/a: 45.8 MB of 100.0 MB",
            ]
        );
        assert_eq!(listed(Path::new("a"), &[], 0, 2_000_000), "a: nothing to remove, 2.0 MB in all\n");
        let value = as_json(Path::new("runs/a"), &found[..1], 43_800_000, 9, &[], true);
        assert_eq!(value["files"][0]["kind"], "moments");
    }
}
