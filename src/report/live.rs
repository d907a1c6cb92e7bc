//! A run while it works: its stages, curves and newest views, as a file beside them that loads
//! itself again and again.

use super::{LEARNED, STYLE, charts, duration, fill, link, picture_url, views};
use crate::config::{NAMES, Stage};
use crate::run::{State, read_record, read_status};
use minijinja::context;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::SystemTime;
use tiface_base::Result;
use tiface_base::io::{self, Limits};

/// Views on the page.
const MAX_VIEWS: usize = 12;

/// A stage as the page shows it.
#[derive(Serialize)]
struct StageRow {
    name: &'static str,
    words: String,
    /// Percent done.
    share: u64,
}

/// Returns the page of a run in its current state, for a file in its folder: pictures are named by
/// their paths. `view` gives the JPEG file of what a stage that is learning has learned so far,
/// from its checkpoint of that time. The page loads itself again while `renewed`.
///
/// # Errors
///
/// The page cannot be filled in: an error of the program.
pub fn live_html(
    run: &Path,
    mut view: impl FnMut(Stage, SystemTime) -> Option<Vec<u8>>,
    renewed: bool,
) -> Result<String> {
    let name = io::real_path(run).unwrap_or(PathBuf::from(run));
    let title = name.file_name().unwrap_or_default().to_string_lossy();
    let stages: Vec<StageRow> = Stage::ALL.into_iter().filter_map(|stage| row(run, stage)).collect();
    let mut drawn = Vec::new();
    for (stage, names) in LEARNED {
        let log = io::read_bytes(&run.join(stage).join("log.jsonl"), &Limits::default()).unwrap_or_default();
        let found = charts(stage.as_str(), &String::from_utf8_lossy(&log), names);
        drawn.extend(found.iter().map(super::Chart::html));
    }
    let time = |name: &String| io::modified(&run.join(name)).unwrap_or(SystemTime::UNIX_EPOCH);
    let mut newest: Vec<(SystemTime, String)> = pictures(run).into_iter().map(|p| (time(&p), p)).collect();
    newest.sort_by(|a, b| b.cmp(a));
    newest.truncate(MAX_VIEWS);
    // with the time, so that no browser shows an older picture of the same name
    let stamp =
        |time: SystemTime| time.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |t| t.as_millis() as u64);
    let fields = learning(run).filter_map(|(stage, time)| {
        Some((picture_url(&view(stage, time)?), format!("{stage}, as learned so far")))
    });
    let views = newest.into_iter().map(|(time, name)| (format!("{}?{}", link(&name), stamp(time)), name));
    let newest: Vec<(String, String)> = fields.chain(views).collect();
    let (report, now) = (io::is_file(&run.join("report.html")), stamp(SystemTime::now()));
    let script = if renewed { include_str!("live.js") } else { "" };
    fill(
        include_str!("live.html"),
        script,
        context! {
            style => STYLE, title, stages, charts => drawn, newest, report, now, renewed, beside => true,
        },
    )
}

/// Returns the fields that are being learned and have a checkpoint: the stage, and when that was
/// saved.
fn learning(run: &Path) -> impl Iterator<Item = (Stage, SystemTime)> {
    LEARNED.into_iter().filter_map(move |(stage, _)| {
        let folder = run.join(stage);
        let file = folder.join("checkpoint.safetensors");
        let at_work = matches!(read_record(&folder), Ok(None)) && io::is_file(&file) && !io::is_link(&file);
        at_work.then(|| io::modified(&file)).flatten().map(|time| (stage, time))
    })
}

/// Returns the pictures of a run, relative to it.
fn pictures(run: &Path) -> Vec<String> {
    // browsers show no EXR
    NAMES.iter().flat_map(|(word, _)| views(run, word)).filter(|name| !name.ends_with(".exr")).collect()
}

/// Describes the state of a stage; empty before it begins.
fn row(run: &Path, stage: Stage) -> Option<StageRow> {
    let folder = run.join(stage);
    if let Ok(Some(record)) = read_record(&folder) {
        let faults = record.faults(&folder);
        let gone = faults.iter().map(|fault| format!("; {fault}")).collect::<String>();
        let words = format!("done in {}{gone}", duration(record.elapsed_s));
        return Some(StageRow { name: stage.as_str(), words, share: 100 });
    }
    let s = read_status(&folder).ok()??;
    let mut words = match s.state {
        State::Running | State::Done => format!("step {} of {}", s.step, s.steps),
        State::Stopped => format!("stopped at step {} of {}", s.step, s.steps),
        State::Failed => format!("failed: {}", s.error.unwrap_or_default()),
    };
    if let (State::Running, Some(eta)) = (s.state, s.eta_s) {
        words += &format!(", {} left", duration(eta));
    }
    Some(StageRow { name: stage.as_str(), words, share: 100 * s.step.min(s.steps) / s.steps.max(1) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_curves_pictures_and_fields_while_they_are_learned() {
        let dir = tempfile::tempdir().unwrap();
        let (run, name) = (dir.path().join("run"), "<img src=x onerror=alert(1)>");
        std::fs::create_dir_all(run.join("render/tface")).unwrap();
        std::fs::create_dir_all(run.join("iface")).unwrap();
        std::fs::write(run.join(format!("render/tface/{name}.png")), "p").unwrap();
        std::fs::write(run.join("report.html"), "r").unwrap();
        std::fs::write(run.join("iface/log.jsonl"), "{\"step\":1,\"psnr\":9}\n{\"step\":2,\"psnr\":10}\n")
            .unwrap();
        let page = |renewed| live_html(&run, |_, _| Some(vec![0xFF, 0xD8, 1]), renewed).unwrap();
        let first = page(true);
        let address = link(&format!("render/tface/{name}.png")).replace('/', "&#x2f;");
        assert!(first.contains("iface psnr") && first.contains(&address) && !first.contains("<img src=x"));
        assert!(first.contains("href=\"report.html\"") && first.contains("location.reload()"));
        assert_eq!(first.matches("<polyline").count(), 1);
        // only stages that train have a picture, from their checkpoint
        assert!(!first.contains("as learned so far"));
        std::fs::write(run.join("iface/checkpoint.safetensors"), "c").unwrap();
        let last = page(false);
        assert!(
            last.contains("iface, as learned so far") && last.contains("image&#x2f;jpeg;base64,&#x2f;9gB"),
            "{last}"
        );
        assert!(!last.contains("tface, as learned so far") && !last.contains("location.reload()"));
    }
}
