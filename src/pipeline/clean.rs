//! What the finished stages of a run do not need any more.
//!
//! | stage | files | what reads them |
//! |---|---|---|
//! | `iface` | the optimizer's moments in its checkpoint | its training, which is over |
//! | `baseline`, `tface`, `iface` | checkpoints that a newer one has replaced | the same |
//! | `render` | float views of the held-out photographs | `ensemble` and `metrics`, once |
//!
//! Everything else stays: photographs, masks, weights, meshes, their kept parts, pictures, figures
//! and pages, and all of a stage that is not finished.

use super::pictures::FLOAT;
use crate::config::{Config, Stage};
use crate::field::checkpoint;
use crate::iface;
use crate::report::duration;
use crate::run::{HeldStages, Run, Surplus, SurplusKind, read_record};
use std::path::Path;
use tiface_base::{Error, Result};

/// Returns the folders of all stages, whose locks [`Run::clean`] needs.
pub fn stage_folders() -> Vec<String> {
    Stage::ALL.iter().map(Stage::to_string).collect()
}

/// Returns what the finished stages of a run do not need, and sentences about what is kept for
/// stages that are not finished. `config` is the run's own.
///
/// # Errors
///
/// Fails if a stage is not as its record has it.
pub fn surplus(run: &Run, config: &Config) -> Result<(Vec<Surplus>, Vec<String>)> {
    let mut found = Vec::new();
    for stage in [Stage::Baseline, Stage::Tface, Stage::Iface] {
        if is_finished(run, stage)? {
            found.extend(of_training(run, stage)?);
        }
    }
    let mut kept = Vec::new();
    if is_finished(run, Stage::Render)? {
        let views = float_views(run)?;
        match waiting(run, config)? {
            Some(stage) if !views.is_empty() => {
                kept.push(format!("float views stay until the stage `{stage}` is done, which reads them"));
            }
            _ => found.extend(views),
        }
    }
    Ok((found, kept))
}

/// Removes the surplus of stages that are held.
pub fn remove_surplus(run: &Run, held: &HeldStages, surplus: &[Surplus]) -> Result<()> {
    run.clean(held, surplus, iface::without_moments)
}

/// Returns what it costs to make some stages again without this surplus, as a sentence.
pub fn cost_of_removal(run: &Run, surplus: &[Surplus]) -> Result<Option<String>> {
    if !surplus.iter().any(|s| s.kind == SurplusKind::FloatView) {
        return Ok(None);
    }
    let record = read_record(&run.path(Stage::Render))?;
    let seconds = record.map_or(0.0, |record| record.elapsed_s);
    Ok(Some(format!(
        "after that, `--fresh ensemble` and `--fresh metrics` need `--fresh render` instead, which took {}",
        duration(seconds)
    )))
}

/// Refuses to blend or to compare views again whose float files were removed, unless they are made
/// again, too. `stages` are to be worked on.
pub(super) fn require_float_views(run: &Run, stages: &[Stage]) -> Result<()> {
    let reads = |stage: &&Stage| matches!(stage, Stage::Ensemble | Stage::Metrics);
    let (Some(stage), false) = (stages.iter().find(reads), stages.contains(&Stage::Render)) else {
        return Ok(());
    };
    match read_record(&run.path(Stage::Render)) {
        Ok(Some(record)) if !record.cleaned.is_empty() => {
            let folder = run.dir().display();
            Err(Error::cannot(
                format!(
                    "stage `{stage}` reads float views, which `tiface clean` has removed from `{folder}/render`"
                ),
                format!("make them again, with what follows: `tiface run {folder} --fresh render`"),
            ))
        }
        _ => Ok(()),
    }
}

/// Returns whether a stage is finished.
fn is_finished(run: &Run, stage: Stage) -> Result<bool> {
    let folder = run.path(stage);
    let record = read_record(&folder)?;
    record.map_or(Ok(false), |record| record.require_products(&folder).map(|_| true))
}

/// Returns the first stage that is still to read float views.
fn waiting(run: &Run, config: &Config) -> Result<Option<Stage>> {
    for stage in [Stage::Ensemble, Stage::Metrics] {
        let is_skipped = stage == Stage::Ensemble && config.ensemble.members.is_empty();
        if !is_skipped && !is_finished(run, stage)? {
            return Ok(Some(stage));
        }
    }
    Ok(None)
}

/// Returns the moments and the old checkpoints of a finished training.
fn of_training(run: &Run, stage: Stage) -> Result<Vec<Surplus>> {
    let mut found = Vec::new();
    for (file, size) in run.files(stage.as_str())? {
        let name = Path::new(&file).file_name().unwrap_or_default().to_string_lossy();
        let path = run.path(stage).join(&file);
        let (kind, bytes) = if checkpoint::is_old(&name) {
            (SurplusKind::OldCheckpoint, size)
        } else if stage == Stage::Iface && checkpoint::newest(Path::new("")) == Path::new(&file) {
            let Some(rest) = iface::without_moments(&path)? else { continue };
            (SurplusKind::Moments, size.saturating_sub(rest.len() as u64))
        } else {
            continue;
        };
        found.push(Surplus { stage: stage.to_string(), file, bytes, kind });
    }
    Ok(found)
}

/// Returns the float views beside the pictures of the same views, `METHOD/float/NAME.exr` beside
/// `METHOD/NAME.png`.
fn float_views(run: &Run) -> Result<Vec<Surplus>> {
    let files = run.files(Stage::Render.as_str())?;
    let is_beside = |file: &str| {
        let (method, below) = file.split_once('/')?;
        let name = below.strip_prefix(FLOAT)?.strip_prefix('/')?.strip_suffix(".exr")?;
        let beside = ["png", "exr"].map(|ending| format!("{method}/{name}.{ending}"));
        beside.iter().any(|picture| files.contains_key(picture)).then_some(())
    };
    let float = files.iter().filter(|(file, _)| is_beside(file).is_some());
    let surplus = |(file, bytes): (&String, &u64)| Surplus {
        stage: Stage::Render.to_string(),
        file: file.clone(),
        bytes: *bytes,
        kind: SurplusKind::FloatView,
    };
    Ok(float.map(surplus).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use crate::run::finish;
    use tiface_base::io;

    fn names(found: &[Surplus]) -> Vec<&str> {
        found.iter().map(|s| s.file.as_str()).collect()
    }

    #[test]
    fn float_views_go_once_blend_and_metrics_are_done_and_pictures_stay() {
        let dir = tempfile::tempdir().unwrap();
        let run = Run::quiet(dir.path());
        let mut config = Config::preset(Preset::Draft);
        // `float/b` is the picture of a photograph in a folder of that name, and no float view
        let files = ["tface/a.png", "tface/float/a.exr", "tface/depth/a.png", "tface/float/b.exr"];
        finish(&run, "render", &files);
        let look = |config: &Config| surplus(&run, config).unwrap();
        let (found, kept) = look(&config);
        assert!(found.is_empty() && kept[0].contains("`ensemble`"), "{kept:?}");
        finish(&run, "ensemble", &["a.png"]);
        assert!(look(&config).1[0].contains("`metrics`"));
        finish(&run, "metrics", &["metrics.json"]);
        let (found, kept) = look(&config);
        assert_eq!((names(&found), kept), (vec!["tface/float/a.exr"], Vec::new()));
        // without a blend its stage is not waited for
        io::remove(&dir.path().join("ensemble/done.json")).unwrap();
        assert!(look(&config).0.is_empty());
        config.ensemble.members.clear();
        assert_eq!(names(&look(&config).0), ["tface/float/a.exr"]);
        // a damaged stage is not cleaned
        io::remove(&dir.path().join("render/tface/a.png")).unwrap();
        assert!(surplus(&run, &config).is_err());
    }

    #[test]
    fn checkpoints_of_unfinished_trainings_stay() {
        let dir = tempfile::tempdir().unwrap();
        let run = Run::quiet(dir.path());
        let config = Config::preset(Preset::Draft);
        let old = ["checkpoint.previous.safetensors", "1/checkpoint.next.safetensors"];
        finish(&run, "tface", &[old[0], old[1], "checkpoint.safetensors", "1/checkpoint.safetensors"]);
        let found = surplus(&run, &config).unwrap().0;
        assert_eq!(names(&found), [old[1], old[0]]);
        assert!(found.iter().all(|s| (s.kind, s.bytes) == (SurplusKind::OldCheckpoint, 4)), "{found:?}");
        io::remove(&dir.path().join("tface/done.json")).unwrap();
        assert!(surplus(&run, &config).unwrap().0.is_empty());
    }

    #[test]
    fn what_reads_removed_float_views_is_refused_before_anything_is_removed() {
        let dir = tempfile::tempdir().unwrap();
        let run = Run::quiet(dir.path());
        finish(&run, "render", &["tface/a.png", "tface/float/a.exr"]);
        assert!(require_float_views(&run, &[Stage::Metrics]).is_ok());
        let mut config = Config::preset(Preset::Draft);
        config.ensemble.members.clear();
        finish(&run, "metrics", &["metrics.json"]);
        let found = surplus(&run, &config).unwrap().0;
        remove_surplus(&run, &run.hold(&stage_folders()).unwrap(), &found).unwrap();
        assert!(!dir.path().join("render/tface/float").exists());
        let refused = require_float_views(&run, &[Stage::Ensemble, Stage::Metrics]).unwrap_err();
        assert!(refused.hint().contains("--fresh render"), "{}", refused.hint());
        assert!(require_float_views(&run, &[Stage::Render, Stage::Metrics]).is_ok());
        assert!(require_float_views(&run, &[Stage::Mesh]).is_ok());
    }
}
