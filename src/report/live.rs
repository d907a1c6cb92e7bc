//! A run while it works: its stages, curves and newest views, as a page that renews itself.

use super::serve::{Answer, Server};
use super::{LEARNED, STYLE, charts, duration, fill, link, small_view, views};
use crate::Result;
use crate::config::{NAMES, Stage};
use crate::io::{self, Limits};
use crate::run::{State, read_record, read_status};
use minijinja::context;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Views on the page.
const NEWEST: usize = 12;
/// Longest side of a picture that is made of an EXR file.
const EXR_PX: u32 = 1024;
/// The files of a run that may be looked at, beside its pictures.
const PAGES: [&str; 2] = ["report.html", "mask/sheet.html"];

/// A stage as the page shows it.
#[derive(Serialize)]
struct StageRow {
    name: &'static str,
    words: String,
    /// Percent done.
    share: u64,
}

/// Makes a picture, a JPEG file, of the field that a stage of a run is learning; `None` where it cannot.
pub type FieldView<'a> = &'a (dyn Fn(Stage) -> Option<Vec<u8>> + Sync);

/// Serves a run until `stop`: `""` is the page, `live` the part of it that changes, `field/STAGE` a view of what a stage
/// has learned so far, and all else files of this run.
pub fn serve_run(server: &Server, run: &Path, view: FieldView, stop: &(dyn Fn() -> bool + Sync)) {
    server.run(stop, &|path| answer(run, view, path));
}

/// The fields that are being learned and have a checkpoint: the stage, and when that was saved.
fn learning(run: &Path) -> impl Iterator<Item = (Stage, SystemTime)> {
    LEARNED.into_iter().filter_map(move |(stage, _)| {
        let folder = run.join(stage);
        let file = folder.join("checkpoint.safetensors");
        let at_work = matches!(read_record(&folder), Ok(None)) && io::is_file(&file) && !io::is_link(&file);
        at_work.then(|| io::modified(&file)).flatten().map(|time| (stage, time))
    })
}

fn answer(run: &Path, view: FieldView, path: &str) -> Option<Answer> {
    let html = |page: Result<String>| {
        let text = page.unwrap_or_else(|e| format!("<p>{}</p>", super::escape(&e.to_string())));
        Some(Answer { kind: "text/html; charset=utf-8", body: text.into_bytes() })
    };
    match path {
        "" => html(page(run)),
        "live" => html(changing(run)),
        path if path.starts_with("field/") => {
            let (stage, _) = learning(run).find(|(stage, _)| path == format!("field/{stage}"))?;
            Some(Answer { kind: "image/jpeg", body: view(stage)? })
        }
        path => {
            let named =
                pictures(run).into_iter().chain(PAGES.map(String::from)).find(|name| link(name) == path)?;
            let file = run.join(&named);
            // a link may lead out of the run
            let linked = file.ancestors().take_while(|a| *a != run).any(io::is_link);
            if linked || !io::is_file(&file) {
                return None;
            }
            if named.ends_with(".exr") {
                // browsers show none
                return Some(Answer { kind: "image/jpeg", body: small_view(&file, EXR_PX, 85)? });
            }
            let kind = if named.ends_with(".png") { "image/png" } else { "text/html; charset=utf-8" };
            Some(Answer { kind, body: io::read_bytes(&file, &Limits::default()).ok()? })
        }
    }
}

/// The pictures of a run, relative to it.
fn pictures(run: &Path) -> Vec<String> {
    NAMES.iter().flat_map(|(word, _)| views(run, word)).collect()
}

fn page(run: &Path) -> Result<String> {
    let name = io::real_path(run).unwrap_or(PathBuf::from(run));
    let title = name.file_name().unwrap_or_default().to_string_lossy();
    let script = include_str!("live.js");
    fill(include_str!("live.html"), context! { style => STYLE, script, title, live => changing(run)? })
}

fn changing(run: &Path) -> Result<String> {
    let stages: Vec<StageRow> = Stage::ALL.into_iter().filter_map(|stage| row(run, stage)).collect();
    let mut drawn = Vec::new();
    for (stage, names) in LEARNED {
        let log = io::read_bytes(&run.join(stage).join("log.jsonl"), &Limits::default()).unwrap_or_default();
        let found = charts(stage.word(), &String::from_utf8_lossy(&log), names);
        drawn.extend(found.iter().map(super::Chart::html));
    }
    let time = |name: &String| io::modified(&run.join(name)).unwrap_or(SystemTime::UNIX_EPOCH);
    let mut newest: Vec<(SystemTime, String)> = pictures(run).into_iter().map(|p| (time(&p), p)).collect();
    newest.sort_by(|a, b| b.cmp(a));
    newest.truncate(NEWEST);
    // with the time, so that no browser shows an older picture of the same name
    let stamp = |time: SystemTime| time.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |t| t.as_millis());
    let fields = learning(run).map(|(stage, time)| {
        (format!("field/{stage}?{}", stamp(time)), format!("{stage}, as learned so far"))
    });
    let views = newest.into_iter().map(|(time, name)| (format!("{}?{}", link(&name), stamp(time)), name));
    let newest: Vec<(String, String)> = fields.chain(views).collect();
    let report = io::is_file(&run.join("report.html"));
    fill(include_str!("live_part.html"), context! { stages, charts => drawn, newest, report })
}

/// Where a stage stands; nothing before it began.
fn row(run: &Path, stage: Stage) -> Option<StageRow> {
    let folder = run.join(stage);
    if let Ok(Some(record)) = read_record(&folder) {
        let words = format!("done in {}", duration(record.elapsed_s));
        return Some(StageRow { name: stage.word(), words, share: 100 });
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
    Some(StageRow { name: stage.word(), words, share: 100 * s.step.min(s.steps) / s.steps.max(1) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_files_of_the_run_are_given_and_no_links_followed() {
        let dir = tempfile::tempdir().unwrap();
        let (run, name) = (dir.path().join("run"), "<img src=x onerror=alert(1)>");
        std::fs::create_dir_all(run.join("render/tface")).unwrap();
        std::fs::create_dir_all(run.join("iface")).unwrap();
        std::fs::write(run.join(format!("render/tface/{name}.png")), "p").unwrap();
        std::fs::write(run.join("config.toml"), "secret").unwrap();
        std::fs::write(run.join("report.html"), "r").unwrap();
        std::fs::write(run.join("iface/log.jsonl"), "{\"step\":1,\"psnr\":9}\n{\"step\":2,\"psnr\":10}\n")
            .unwrap();
        let get = |path: &str| {
            answer(&run, &|stage| Some(stage.word().into()), path)
                .map(|a| (a.kind, String::from_utf8(a.body).unwrap()))
        };
        let address = link(&format!("render/tface/{name}.png"));
        assert_eq!(get(&address), Some(("image/png", "p".into())));
        assert_eq!(get("report.html").unwrap().1, "r");
        // views in folders of their own, and EXR as what browsers show; not the depth beside them
        let exr = |name: &str| {
            std::fs::create_dir_all(run.join(name).parent().unwrap()).unwrap();
            let half = [0.5; 2];
            let channels: Vec<(&str, &[f32])> = ["A", "B", "G", "R", "Z"].map(|c| (c, &half[..])).into();
            io::write_exr(&run.join(name), 2, 1, &channels).unwrap();
        };
        exr("render/tface/left/a.exr");
        exr("render/tface/float/left/a.exr");
        let shown = answer(&run, &|_| None, "render/tface/left/a.exr").unwrap();
        assert!(shown.kind == "image/jpeg" && shown.body.starts_with(&[0xff, 0xd8]));
        assert!(get("live").unwrap().1.contains("left&#x2f;a.exr"));
        assert_eq!(get("render/tface/float/left/a.exr"), None);
        for path in
            ["config.toml", "iface/log.jsonl", "render/tface/", "render/../report.html", "mask/sheet.html"]
        {
            assert_eq!(get(path), None, "{path}");
        }
        let page = get("").unwrap().1;
        assert!(
            page.contains("iface psnr")
                && page.contains(&address.replace('/', "&#x2f;"))
                && !page.contains("<img src=x")
        );
        assert_eq!(get("live").unwrap().1.matches("<polyline").count(), 1);
        // a field is looked at while it is learned, and no other stage is asked for
        assert!(get("field/iface").is_none() && !page.contains("field/iface"));
        std::fs::write(run.join("iface/checkpoint.safetensors"), "c").unwrap();
        assert_eq!(get("field/iface"), Some(("image/jpeg", "iface".into())));
        assert!(get("live").unwrap().1.contains("field&#x2f;iface?"));
        assert_eq!((get("field/mesh"), get("field/tface"), get("field/../config.toml")), (None, None, None));
        #[cfg(unix)]
        {
            std::fs::write(dir.path().join("outside.png"), "o").unwrap();
            std::os::unix::fs::symlink(dir.path().join("outside.png"), run.join("render/tface/l.png"))
                .unwrap();
            std::fs::create_dir(dir.path().join("other")).unwrap();
            std::fs::write(dir.path().join("other/o.png"), "o").unwrap();
            std::os::unix::fs::symlink(dir.path().join("other"), run.join("ensemble")).unwrap();
            assert_eq!((get("render/tface/l.png"), get("ensemble/o.png")), (None, None));
        }
    }
}
