//! `report.html`, from the contents of a run: a 3D viewer of the head, views beside their
//! photographs, metrics, times, settings.
//!
//! The page stays below eight megabytes, so that it opens at once and can be sent: pictures are
//! small copies that link to the originals; if there are many views and masks, only some are shown.

pub(super) mod viewer;
pub(super) mod views;

use crate::config::{NAMES, SETTINGS_FILE, Stage, display_name};
pub use viewer::{head_page, viewer_of_file};

use super::session::Session;
use crate::report::{self, Chart, LEARNED, MethodTable, Report, Viewer, duration};
use crate::run::{Record, read_record};
use serde_json::Value;
use std::path::Path;
use tiface_base::Result;
use tiface_base::error::counted;
use tiface_base::io::{self, Limits};

/// Maximum size of a page without its fixed parts, bytes.
pub(super) const MAX_BYTES: usize = 7_600_000;
/// The part of it that masks may take.
const MASK_BYTES: usize = 800_000;

/// Writes `report.html` with every finished stage; without the photographs an existing report is
/// kept.
pub(super) fn write_report(session: &Session, idle: bool) -> Result<()> {
    if session.inputs.missing_capture.is_some() || idle && is_current(session) {
        return Ok(());
    }
    session.write("report.html", page(session)?.as_bytes(), idle)
}

/// Returns whether the report is newer than every stage and the settings. Writing it again would
/// open all pictures.
fn is_current(session: &Session) -> bool {
    let time = |name: &str| io::modified(&session.run.path(name));
    let report = time("report.html").filter(|_| io::is_file(&session.run.path("report.html")));
    let records = Stage::ALL.map(|stage| time(&format!("{stage}/done.json")));
    report.is_some_and(|report| records.into_iter().flatten().chain(time(SETTINGS_FILE)).all(|t| t < report))
}

/// Writes the report of a run again, from the run's contents.
///
/// # Errors
///
/// Fails if the photographs have been moved, or if a file of the run is damaged.
pub fn renew_report(session: &Session) -> Result<()> {
    session.require_inputs(&[Stage::Metrics])?;
    session.run.write("report.html", page(session)?.as_bytes())
}

/// Returns the learning curves of runs, those of one figure in one chart; the name of a run is a
/// part of its curves' names.
pub fn curves(runs: &[(&Session, &str)]) -> Result<Vec<Chart>> {
    let mut all: Vec<Chart> = Vec::new();
    for (stage, figures) in LEARNED {
        for (session, name) in runs {
            let log = text(&session.run.path(stage).join("log.jsonl"))?;
            for mut chart in report::charts(stage.as_str(), &log, figures) {
                for curve in &mut chart.curves {
                    curve.name = format!("{name} {}", curve.name).trim().to_string();
                }
                match all.iter_mut().find(|known| known.title == chart.title) {
                    Some(known) => known.curves.append(&mut chart.curves),
                    None => all.push(chart),
                }
            }
        }
    }
    Ok(all)
}

fn page(session: &Session) -> Result<String> {
    let sheet = text(&session.run.path(Stage::Mask).join(super::mask::SHEET))?;
    let masks = crate::mask::pages::part(&sheet, MASK_BYTES).unwrap_or_default();
    let found = viewer::viewer(session)?;
    let glb = found.as_ref().map_or(0, |(v, _)| v.glb.len().div_ceil(3) * 4);
    let (views, left_out) = views::rows_of_run(session, MAX_BYTES.saturating_sub(masks.len() + glb))?;
    let viewer = found.map(|(viewer, file_from_world)| Viewer {
        cameras: viewer::cameras(session, &views, &file_from_world),
        usdz: Some("mesh/head.usdz")
            .filter(|file| io::is_file(&session.run.path(file)))
            .unwrap_or_default()
            .into(),
        ..viewer
    });
    let records: Vec<(Stage, Record)> = Stage::ALL
        .into_iter()
        .filter_map(|stage| Some((stage, read_record(&session.run.path(stage)).ok()??)))
        .collect();
    let longest = records.iter().map(|(_, r)| r.elapsed_s).fold(1e-3, f64::max);
    let time = |(stage, r): &(Stage, Record)| {
        (stage.to_string(), duration(r.elapsed_s), (100.0 * r.elapsed_s / longest * 10.0).round() / 10.0)
    };
    report::html(&Report {
        title: session.capture.name.clone(),
        facts: facts(session, &records),
        viewer,
        table: MethodTable::new(&COLUMNS, methods(session)),
        quality: quality(&judged(session)),
        views,
        left_out,
        masks,
        charts: curves(&[(session, "")])?.iter().map(Chart::html).collect(),
        times: records.iter().map(time).collect(),
        changes: session.config.changes(),
        warnings: report::warnings(session.run.dir(), records.iter().map(|(stage, record)| (*stage, record))),
        repeat: format!(
            "tiface run {} --config config.toml --run again",
            quoted(&session.config.capture.path.to_string_lossy())
        ),
        summaries: records.iter().filter_map(summary).collect(),
        settings: session.config.to_toml(),
        compared: Vec::new(),
    })
}

/// Reads a file as text; empty if the file does not exist.
fn text(file: &Path) -> Result<String> {
    if !io::is_file(file) {
        return Ok(String::new());
    }
    Ok(String::from_utf8_lossy(&io::read_maybe_empty(file, &Limits::default())?).into_owned())
}

fn facts(session: &Session, records: &[(Stage, Record)]) -> Vec<String> {
    use tiface_capture::Split::{Test, Train};
    let [train, test] = [Train, Test].map(|split| session.capture.split(split).count());
    let mut facts = vec![
        format!("{} to learn from, {test} held out", counted(train, "photograph")),
        format!("preset {}", session.config.preset.as_str()),
        format!("seed {}", session.config.seed),
    ];
    let of = |stage: Stage| records.iter().find(|(s, _)| *s == stage).map(|(_, record)| &record.summary);
    facts.extend(report::height(of(Stage::Mask), of(Stage::Mesh)));
    let unseen = of(Stage::Mesh).and_then(|mesh| mesh["seen_by"][0].as_f64());
    facts.extend(unseen.map(|share| format!("{:.0} % of the surface seen by no camera", 100.0 * share)));
    if let Some(megabytes) = report::glb_megabytes(session.run.dir()) {
        facts.push(format!("head.glb {megabytes:.1} MB"));
    }
    if let Some(summary) = of(Stage::Metrics) {
        facts.extend(report::judged_by(&summary["truth"]));
    }
    if let Some((_, last)) = records.last() {
        facts.push(duration(records.iter().map(|(_, r)| r.elapsed_s).sum()));
        let peak = records.iter().filter_map(|(_, r)| r.peak_bytes).max();
        facts.extend(peak.map(|bytes| format!("{:.2} GiB of memory", bytes as f64 / (1u64 << 30) as f64)));
        facts.push(format!("tiface {}", last.version));
    }
    facts
}

/// Returns the metrics of a finished stage; those of pictures have a table of their own.
fn summary((stage, record): &(Stage, Record)) -> Option<(String, Vec<(String, String)>)> {
    let mut figures = record.summary.clone();
    if let (Stage::Metrics, Value::Object(sets)) = (stage, &mut figures) {
        sets.retain(|_, set| set.get("head").is_none());
    }
    let rows = report::leaves(&figures);
    (!rows.is_empty()).then(|| (stage.to_string(), rows))
}

/// Quotes a word for the shell.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "/._-+=:@,".contains(c);
    match !word.is_empty() && word.chars().all(plain) && !word.starts_with('-') {
        true => word.into(),
        false => format!("'{}'", word.replace('\'', r"'\''")),
    }
}

/// Columns of the table: heading, number of digits, and whether more is better, less is, or
/// neither.
pub(super) const COLUMNS: [(&str, usize, Option<bool>); 8] = [
    ("PSNR, head", 2, Some(true)),
    ("SSIM, head", 4, Some(true)),
    ("PSNR, frame", 2, Some(true)),
    ("SSIM, frame", 4, Some(true)),
    ("s a view", 3, Some(false)),
    ("training s", 0, Some(false)),
    ("MB of data read", 1, Some(false)),
    ("triangles", 0, None),
];

/// Rows of the second table of pictures: heading, key in `metrics.json`, and number of digits.
const QUALITY: [(&str, &str, usize); 14] = [
    ("PSNR", "/head/mean/psnr_masked", 2),
    ("SSIM", "/head/mean/ssim_masked", 4),
    ("whole frame", "/head/mean/psnr", 2),
    ("own exposure", "/own_exposure/mean/psnr_masked", 2),
    ("own pose", "/own_pose/mean/psnr_masked", 2),
    ("region", "/region/mean/psnr_masked", 2),
    ("opaque", "/parts/mean/psnr_opaque", 2),
    ("edge", "/parts/mean/psnr_edge", 2),
    ("skin", "/parts/mean/psnr_skin", 2),
    ("hair", "/parts/mean/psnr_hair", 2),
    ("missing", "/parts/mean/missing", 0),
    ("extra", "/parts/mean/extra", 0),
    ("limit by outline", "/parts/mean/psnr_cap", 2),
    ("opacity² outside", "/mean_square_opacity_outside", 4),
];

/// Returns the rows of the table of methods, in pipeline order; empty before the stage `metrics`.
pub(super) fn methods(session: &Session) -> Vec<(String, Vec<Option<f64>>)> {
    let summary = |stage: Stage| read_record(&session.run.path(stage)).ok().flatten();
    let Some(metrics) = summary(Stage::Metrics).map(|r| r.summary) else { return Vec::new() };
    let seconds = summary(Stage::Render).map_or(Value::Null, |r| r.summary["seconds_per_view"].clone());
    let triangles = summary(Stage::Mesh).and_then(|r| r.summary["triangles"].as_f64());
    let row = |(word, _): &(&str, &str)| {
        let mean = metrics.get(*word)?.pointer("/head/mean")?;
        let figure = |key: &str| mean[key].as_f64();
        let stages = stages_of(session, word);
        let spent = stages.iter().map(|&stage| summary(stage).map(|r| r.elapsed_s)).sum::<Option<f64>>();
        let bytes: u64 = files_of(session, word).iter().filter_map(|file| io::file_size(file)).sum();
        let figures = vec![
            figure("psnr_masked"),
            figure("ssim_masked"),
            figure("psnr"),
            figure("ssim"),
            seconds[word].as_f64(),
            spent,
            (bytes > 0).then_some(bytes as f64 / 1e6),
            triangles.filter(|_| stages.last() == Some(&Stage::Mesh)),
        ];
        Some((display_name(word), figures))
    };
    NAMES.iter().filter_map(row).collect()
}

/// Returns the stages that must have run before a picture of this method can be made, in order.
fn stages_of(session: &Session, word: &str) -> Vec<Stage> {
    let members = &session.config.ensemble.members;
    match session.config.render.method.iter().find(|m| m.as_str() == word) {
        Some(method) if method.stage() == Stage::Mesh => vec![Stage::Iface, Stage::Mesh],
        Some(method) => vec![method.stage()],
        None => {
            let needed: Vec<Stage> = members.iter().flat_map(|m| stages_of(session, m.as_str())).collect();
            let is_needed = |stage: &Stage| needed.contains(stage) || *stage == Stage::Ensemble;
            Stage::ALL.into_iter().filter(is_needed).collect()
        }
    }
}

/// Returns the files that hold the data a method shows.
fn files_of(session: &Session, word: &str) -> Vec<std::path::PathBuf> {
    let Some(method) = session.config.render.method.iter().find(|m| m.as_str() == word) else {
        let members = session.config.ensemble.members.iter();
        let mut all: Vec<_> = members.flat_map(|m| files_of(session, m.as_str())).collect();
        all.sort();
        all.dedup();
        return all;
    };
    let folder = session.run.path(method.stage());
    let inside = |folder: &Path| -> Vec<_> {
        io::list_files(folder).unwrap_or_default().iter().map(|name| folder.join(name)).collect()
    };
    match (method.stage(), word) {
        (Stage::Mesh, "raycast") => inside(&folder.join("parts")),
        (Stage::Mesh, _) => vec![folder.join("head.glb")],
        _ => {
            let fields = io::list_folders(&folder).unwrap_or_default();
            [folder].into_iter().chain(fields).map(|f| f.join("checkpoint.safetensors")).collect()
        }
    }
}

/// Returns the figures of every evaluated kind of picture, with its title.
pub(super) fn judged(session: &Session) -> Vec<(String, Value)> {
    let record = read_record(&session.run.path(Stage::Metrics)).ok().flatten();
    let Some(Value::Object(sets)) = record.map(|done| done.summary) else { return Vec::new() };
    sets.into_iter().map(|(set, figures)| (display_name(&set), figures)).collect()
}

/// Returns a row for every set of pictures below the heading; empty if there is none.
pub(super) fn quality(sets: &[(String, Value)]) -> Vec<Vec<String>> {
    let row = |(title, figures): &(String, Value)| {
        figures.get("head")?;
        let figure = |(_, path, digits): (&str, &str, usize)| {
            let value = figures.pointer(path).and_then(Value::as_f64);
            value.map_or("–".into(), |v| format!("{v:.digits$}"))
        };
        Some([title.clone()].into_iter().chain(QUALITY.map(figure)).collect())
    };
    let rows: Vec<Vec<String>> = sets.iter().filter_map(row).collect();
    if rows.is_empty() {
        return rows;
    }
    let heading = [""].into_iter().chain(QUALITY.map(|(name, ..)| name)).map(String::from).collect();
    [heading].into_iter().chain(rows).collect()
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
