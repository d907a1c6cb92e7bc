//! How good and how costly each way to make a picture is.

use crate::config::{NAMES, Stage, called};
use crate::io;
use crate::pipeline::line::Line;
use crate::report::MethodTable;
use crate::run::read_record;
use serde_json::Value;
use std::path::Path;

/// Columns of the table: heading, digits, and whether more is better, less is, or neither.
const COLUMNS: [(&str, usize, Option<bool>); 8] = [
    ("PSNR, head", 2, Some(true)),
    ("SSIM, head", 4, Some(true)),
    ("PSNR, frame", 2, Some(true)),
    ("SSIM, frame", 4, Some(true)),
    ("s a view", 3, Some(false)),
    ("training s", 0, Some(false)),
    ("MB", 1, Some(false)),
    ("triangles", 0, None),
];

/// What the second table of pictures shows: a heading, where it stands in `metrics.json`, and how many digits.
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

/// The table of methods, in the order of the line; empty before the stage `metrics`.
pub(super) fn table(line: &Line) -> MethodTable {
    let summary = |stage: Stage| read_record(&line.run.path(stage)).ok().flatten();
    let Some(metrics) = summary(Stage::Metrics).map(|r| r.summary) else { return MethodTable::default() };
    let seconds = summary(Stage::Render).map_or(Value::Null, |r| r.summary["seconds_per_view"].clone());
    let triangles = summary(Stage::Mesh).and_then(|r| r.summary["triangles"].as_f64());
    let row = |(word, _): &(&str, &str)| {
        let mean = metrics.get(*word)?.pointer("/head/mean")?;
        let figure = |key: &str| mean[key].as_f64();
        let stages = stages_of(line, word);
        let spent = stages.iter().map(|&stage| summary(stage).map(|r| r.elapsed_s)).sum::<Option<f64>>();
        let bytes: u64 = files_of(line, word).iter().filter_map(|file| io::file_size(file)).sum();
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
        Some((called(word), figures))
    };
    MethodTable::new(&COLUMNS, NAMES.iter().filter_map(row).collect())
}

/// The stages that must have run before a picture of this word can be made, the last one last.
fn stages_of(line: &Line, word: &str) -> Vec<Stage> {
    let members = &line.config.ensemble.members;
    match line.config.render.method.iter().find(|m| m.folder() == word) {
        Some(method) if method.stage() == Stage::Mesh => vec![Stage::Iface, Stage::Mesh],
        Some(method) => vec![method.stage()],
        None => {
            let needed: Vec<Stage> = members.iter().flat_map(|m| stages_of(line, m.folder())).collect();
            let is_needed = |stage: &Stage| needed.contains(stage) || *stage == Stage::Ensemble;
            Stage::ALL.into_iter().filter(is_needed).collect()
        }
    }
}

/// The files that hold what it shows.
fn files_of(line: &Line, word: &str) -> Vec<std::path::PathBuf> {
    let Some(method) = line.config.render.method.iter().find(|m| m.folder() == word) else {
        let members = line.config.ensemble.members.iter();
        let mut all: Vec<_> = members.flat_map(|m| files_of(line, m.folder())).collect();
        all.sort();
        all.dedup();
        return all;
    };
    let folder = line.run.path(method.stage());
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

/// A row for every kind of picture that was judged, below the heading; nothing where none was.
pub(super) fn quality(line: &Line) -> Vec<Vec<String>> {
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
