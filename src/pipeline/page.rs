//! `report.html`, from what lies in the run.

use super::line::Line;
use super::metrics::{Comparable, comparable, picture_sets};
use crate::Result;
use crate::config::{PictureFormat, Stage, called};
use crate::io::{self, Limits};
use crate::report::{self, CaptionedPicture, Curve, Report, ViewRow};
use crate::run::read_record;
use serde_json::Value;
use std::path::Path;

/// The stages that learn, and what of their `log.jsonl` is drawn.
const LEARNED: [(Stage, &[&str]); 3] = [
    (Stage::Baseline, &["psnr", "samples"]),
    (Stage::Tface, &["psnr", "mask", "outside", "samples"]),
    (Stage::Iface, &["psnr", "eikonal", "inv_s"]),
];

/// A page with more bytes of pictures than this is no pleasure in a browser; further views are only
/// counted.
const MOST_BYTES: usize = 48 << 20;

/// Writes `report.html`, of every stage that is done; without the photographs it stays as it is.
pub(super) fn write_report(line: &Line, idle: bool) -> Result<()> {
    if line.gone.is_some() {
        return Ok(());
    }
    let limits = Limits::default();
    let text = |file: &Path| -> Result<String> {
        if !io::is_file(file) {
            return Ok(String::new());
        }
        Ok(String::from_utf8_lossy(&io::read_bytes(file, &limits)?).into_owned())
    };
    let sheet = text(&line.run.path(Stage::Mask).join(super::mask::SHEET))?;
    let (rows, left_out) = rows(line, sheet.len())?;
    let mut curves = Vec::new();
    for (stage, names) in LEARNED {
        let log = text(&line.run.path(stage).join("log.jsonl"))?;
        let found = report::curves(&log, names).into_iter();
        curves.extend(found.map(|c| Curve { name: format!("{stage} {}", c.name), ..c }));
    }
    let page = Report {
        title: line.capture.name.clone(),
        summaries: Stage::ALL.into_iter().filter_map(|stage| summary(line, stage)).collect(),
        quality: quality(line),
        masks: crate::mask::sheet::part(&sheet).unwrap_or_default().into(),
        curves,
        rows,
        left_out,
        settings: line.config.to_toml(),
    };
    line.write("report.html", report::html(&page)?.as_bytes(), idle)
}

/// The views with their pictures, and how many found no room beside as many `bytes` as there are already.
fn rows(line: &Line, mut bytes: usize) -> Result<(Vec<ViewRow>, usize)> {
    let sets = match line.config.render.format {
        PictureFormat::Png => picture_sets(line),
        PictureFormat::Exr => Vec::new(), // browsers show none
    };
    let sets: Vec<_> = sets.iter().map(|set| (set.name.as_str(), comparable(line, set))).collect();
    let (mut rows, mut left_out) = (Vec::new(), 0);
    for view in &line.capture.views {
        let own = |(name, set): &(&'_ str, Vec<Comparable>)| {
            let picture = set.iter().find(|c| c.view.name == view.name)?;
            Some((name.to_string(), picture.file.clone()))
        };
        let files: Vec<_> = sets.iter().filter_map(own).collect();
        if files.is_empty() {
            continue;
        }
        if bytes > MOST_BYTES {
            left_out += 1;
            continue;
        }
        let mut pictures = Vec::new();
        for (word, file) in [("photograph".into(), view.photo.clone())].into_iter().chain(files) {
            let picture = io::read_bytes(&file, &Limits::default())?;
            bytes += picture.len();
            pictures.push(CaptionedPicture::new(called(&word), &picture));
        }
        rows.push(ViewRow { name: view.name.clone(), pictures });
    }
    Ok((rows, left_out))
}

/// The figures of a stage that is done; those of pictures have a table of their own.
fn summary(line: &Line, stage: Stage) -> Option<(String, Vec<(String, String)>)> {
    let mut figures = read_record(&line.run.path(stage)).ok()??.summary;
    if let (Stage::Metrics, Value::Object(sets)) = (stage, &mut figures) {
        sets.retain(|_, set| set.get("head").is_none());
    }
    let rows = report::leaves(&figures);
    (!rows.is_empty()).then(|| (stage.to_string(), rows))
}

/// What the table of pictures shows: a heading, where it stands in `metrics.json`, and how many digits.
const QUALITY: [(&str, &str, usize); 12] = [
    ("PSNR", "/head/mean/psnr_masked", 2),
    ("SSIM", "/head/mean/ssim_masked", 4),
    ("whole frame", "/head/mean/psnr", 2),
    ("region", "/region/mean/psnr_masked", 2),
    ("opaque", "/parts/mean/psnr_opaque", 2),
    ("edge", "/parts/mean/psnr_edge", 2),
    ("skin", "/parts/mean/psnr_skin", 2),
    ("hair", "/parts/mean/psnr_hair", 2),
    ("missing", "/parts/mean/missing", 0),
    ("extra", "/parts/mean/extra", 0),
    ("at most", "/parts/mean/psnr_cap", 2),
    ("opacity² outside", "/mean_square_opacity_outside", 4),
];

/// A row for every kind of picture that was judged, below the heading; nothing where none was.
fn quality(line: &Line) -> Vec<Vec<String>> {
    let record = read_record(&line.run.path(Stage::Metrics)).ok().flatten();
    let Some(Value::Object(sets)) = record.map(|done| done.summary) else { return Vec::new() };
    let row = |(set, figures): (&String, &Value)| {
        figures.get("head")?;
        let figure = |(_, path, digits): (&str, &str, usize)| {
            let value = figures.pointer(path).and_then(Value::as_f64);
            value.map_or("–".into(), |v| format!("{v:.digits$}"))
        };
        Some([called(set)].into_iter().chain(QUALITY.map(figure)).collect())
    };
    let heading = [""].into_iter().chain(QUALITY.map(|(name, ..)| name)).map(String::from).collect();
    [heading].into_iter().chain(sets.iter().filter_map(row)).collect()
}
