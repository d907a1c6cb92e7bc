//! `report.html`, from what lies in the run: the head to turn, views beside their photographs, figures, times, settings.
//!
//! The page stays below eight megabytes, so that it opens at once and can be sent: pictures are small copies, with links to
//! those beside the page; of many views and masks some are shown.

mod methods;
mod viewer;
pub(super) mod views;

pub use viewer::{head_page, viewer_of_file};

use super::line::Line;
use crate::Result;
use crate::config::Stage;
use crate::io::{self, Limits};
use crate::report::{self, LEARNED, Report, Viewer, duration};
use crate::run::{Record, read_record};
use serde_json::Value;
use std::path::Path;

/// Bytes of a page without its fixed parts.
const MOST_BYTES: usize = 7_600_000;
/// Of them, for the masks.
const MASK_BYTES: usize = 800_000;

/// Writes `report.html`, of every stage that is done; without the photographs it stays as it is.
pub(super) fn write_report(line: &Line, idle: bool) -> Result<()> {
    if line.gone.is_some() || idle && is_current(line) {
        return Ok(());
    }
    line.write("report.html", page(line)?.as_bytes(), idle)
}

/// Is the report newer than every stage and the settings? Making it opens all pictures.
fn is_current(line: &Line) -> bool {
    let time = |name: &str| io::modified(&line.run.path(name));
    let report = time("report.html").filter(|_| io::is_file(&line.run.path("report.html")));
    let records = Stage::ALL.map(|stage| time(&format!("{stage}/done.json")));
    report.is_some_and(|report| records.into_iter().flatten().chain(time("config.toml")).all(|t| t < report))
}

/// Writes the report of a run anew, from what lies in it.
///
/// # Errors
///
/// The photographs are no longer there, or a file of the run is damaged.
pub fn renew_report(line: &Line) -> Result<()> {
    line.require_inputs(&[Stage::Metrics])?;
    line.run.write("report.html", page(line)?.as_bytes())
}

fn page(line: &Line) -> Result<String> {
    let sheet = text(&line.run.path(Stage::Mask).join(super::mask::SHEET))?;
    let masks = crate::mask::pages::part(&sheet, MASK_BYTES).unwrap_or_default();
    let found = viewer::viewer(line)?;
    let glb = found.as_ref().map_or(0, |(v, _)| v.glb.len().div_ceil(3) * 4);
    let (views, left_out) = views::rows(line, MOST_BYTES.saturating_sub(masks.len() + glb))?;
    let viewer = found.map(|(viewer, file_from_world)| Viewer {
        cameras: viewer::cameras(line, &views, &file_from_world),
        ..viewer
    });
    let mut charts = Vec::new();
    for (stage, names) in LEARNED {
        let log = text(&line.run.path(stage).join("log.jsonl"))?;
        charts.extend(report::charts(stage.word(), &log, names).iter().map(report::Chart::html));
    }
    let records: Vec<(Stage, Record)> = Stage::ALL
        .into_iter()
        .filter_map(|stage| Some((stage, read_record(&line.run.path(stage)).ok()??)))
        .collect();
    let longest = records.iter().map(|(_, r)| r.elapsed_s).fold(1e-3, f64::max);
    let time = |(stage, r): &(Stage, Record)| {
        (stage.to_string(), duration(r.elapsed_s), (100.0 * r.elapsed_s / longest * 10.0).round() / 10.0)
    };
    report::html(&Report {
        title: line.capture.name.clone(),
        facts: facts(line, &records),
        viewer,
        table: methods::table(line),
        quality: methods::quality(line),
        views,
        left_out,
        masks,
        charts,
        times: records.iter().map(time).collect(),
        changes: line.config.changes(),
        warnings: warnings(line, &records),
        repeat: format!("tiface run {} --config config.toml --run again", quoted(&line.config.capture.path)),
        summaries: records.iter().filter_map(summary).collect(),
        settings: line.config.to_toml(),
    })
}

/// A file as text; empty if it is not there.
fn text(file: &Path) -> Result<String> {
    if !io::is_file(file) {
        return Ok(String::new());
    }
    Ok(String::from_utf8_lossy(&io::read_maybe_empty(file, &Limits::default())?).into_owned())
}

fn facts(line: &Line, records: &[(Stage, Record)]) -> Vec<String> {
    use crate::capture::Split::{Test, Train};
    let [train, test] = [Train, Test].map(|split| line.capture.split(split).count());
    let mut facts = vec![
        format!("{train} photographs to learn from, {test} held out"),
        format!("preset {}", line.config.preset.name()),
        format!("seed {}", line.config.seed),
    ];
    let of = |stage: Stage| records.iter().find(|(s, _)| *s == stage).map(|(_, record)| &record.summary);
    if let Some(height) = of(Stage::Mask).and_then(|mask| mask["height_m"].as_f64()) {
        facts.push(format!("head {height:.3} m high"));
    }
    if let Some(summary) = of(Stage::Metrics) {
        facts.extend(report::judged_by(&summary["truth"]));
    }
    if let Some((_, last)) = records.last() {
        facts.push(duration(records.iter().map(|(_, r)| r.elapsed_s).sum()));
        facts.push(format!("tiface {}", last.version));
    }
    facts
}

/// What stages and the capture say that a person should know.
fn warnings(line: &Line, records: &[(Stage, Record)]) -> Vec<String> {
    let mut all = line.capture.warnings.clone();
    for (stage, record) in records {
        let said = record.summary["warnings"].as_array().into_iter().flatten().filter_map(Value::as_str);
        all.extend(said.map(|w| format!("{stage}: {w}")));
        all.extend(report::blend_verdict(&record.summary["blend"]));
        if record.summary["closed"] == false {
            all.push(format!("{stage}: the surface is not watertight"));
        }
    }
    all
}

/// The figures of a stage that is done; those of pictures have a table of their own.
fn summary((stage, record): &(Stage, Record)) -> Option<(String, Vec<(String, String)>)> {
    let mut figures = record.summary.clone();
    if let (Stage::Metrics, Value::Object(sets)) = (stage, &mut figures) {
        sets.retain(|_, set| set.get("head").is_none());
    }
    let rows = report::leaves(&figures);
    (!rows.is_empty()).then(|| (stage.to_string(), rows))
}

/// A word as a shell takes it.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "/._-+=:@,".contains(c);
    match !word.is_empty() && word.chars().all(plain) && !word.starts_with('-') {
        true => word.into(),
        false => format!("'{}'", word.replace('\'', r"'\''")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shell_takes_a_quoted_path_as_one_word() {
        assert_eq!(quoted("/data/002_00"), "/data/002_00");
        assert_eq!(quoted("a b; rm -rf 'x'"), r"'a b; rm -rf '\''x'\'''");
        assert_eq!((quoted("-x"), quoted("")), ("'-x'".into(), "''".into()));
    }
}
