//! One page of many runs: a row each, sorted by whatever one likes.

use super::{STYLE, duration, fill, link, picture_url};
use crate::Result;
use crate::config::{Config, NAMES, Sources, Stage, called};
use crate::image::{over_black, reduce_photo, working_size};
use crate::io::{self, Limits};
use crate::run::{Record, State, read_record, read_status};
use minijinja::context;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Longest side of a picture: about 4 kB each, so that two hundred are light.
const PICTURE_PX: u32 = 120;

/// A run as a row.
#[derive(Clone, Debug, Default, Serialize)]
pub struct RunRow {
    /// The folder's name.
    pub name: String,
    /// The run's own page, relative to this one; empty where it has none.
    pub link: String,
    /// A picture of the head: a `data:` address, or nothing.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub picture: String,
    /// Where it stands.
    pub state: String,
    /// Is there nothing left to do?
    pub done: bool,
    /// The preset, if it can be read.
    pub preset: String,
    /// Masked PSNR in dB of the best method.
    pub psnr: Option<f64>,
    /// Its masked SSIM.
    pub ssim: Option<f64>,
    /// The best method.
    pub method: String,
    /// Masked PSNR of the mesh, as the best viewer of it shows.
    pub mesh_psnr: Option<f64>,
    /// Is the mesh watertight?
    pub watertight: Option<bool>,
    /// Of the mesh.
    pub triangles: Option<u64>,
    /// Of `head.glb`.
    pub megabytes: Option<f64>,
    /// Work of all stages.
    pub seconds: f64,
    /// When its last stage ended, in seconds since 1970.
    pub finished: u64,
}

impl RunRow {
    /// Reads what the run in a folder says of itself; its page is linked from one in `beside`. A file that is missing or
    /// damaged leaves its figures out: one run must not hide the others.
    pub fn read(run: &Path, beside: &Path) -> RunRow {
        let records: Vec<(Stage, Record)> = Stage::ALL
            .into_iter()
            .filter_map(|stage| Some((stage, read_record(&run.join(stage)).ok()??)))
            .collect();
        let of = |stage| records.iter().find(|(s, _)| *s == stage).map(|(_, r)| &r.summary);
        let name = io::real_path(run).unwrap_or(run.into());
        let (state, done) = standing(run, of(Stage::Metrics).is_some(), records.last().map(|(s, _)| *s));
        let mut row = RunRow {
            name: name.file_name().unwrap_or(run.as_os_str()).to_string_lossy().into_owned(),
            state,
            done,
            picture: picture(run).unwrap_or_default(),
            preset: preset(run).unwrap_or_default(),
            seconds: records.iter().map(|(_, r)| r.elapsed_s).sum(),
            finished: records.iter().map(|(_, r)| r.finished).max().unwrap_or(0),
            megabytes: io::file_size(&run.join("mesh/head.glb")).map(|bytes| bytes as f64 / 1e6),
            ..RunRow::default()
        };
        let page = run.join("report.html");
        if io::is_file(&page) {
            row.link = link(&relative(&page, beside).to_string_lossy());
        }
        if let Some(mesh) = of(Stage::Mesh) {
            (row.watertight, row.triangles) = (mesh["closed"].as_bool(), mesh["triangles"].as_u64());
        }
        if let Some(metrics) = of(Stage::Metrics) {
            let mean = |word: &str, key: &str| metrics[word]["head"]["mean"][key].as_f64();
            let judged = NAMES.iter().filter_map(|(word, _)| Some((mean(word, "psnr_masked")?, *word)));
            if let Some((psnr, word)) = judged.max_by(|a, b| a.0.total_cmp(&b.0)) {
                (row.psnr, row.ssim, row.method) = (Some(psnr), mean(word, "ssim_masked"), called(word));
            }
            let meshes = ["raycast", "textured", "raster"].into_iter();
            row.mesh_psnr = meshes.filter_map(|word| mean(word, "psnr_masked")).max_by(f64::total_cmp);
        }
        row
    }
}

/// Where a run stands, in words, and whether it is done.
fn standing(run: &Path, is_judged: bool, last: Option<Stage>) -> (String, bool) {
    if is_judged {
        return ("done".into(), true);
    }
    let open =
        Stage::ALL.into_iter().rev().filter(|stage| read_record(&run.join(stage)).ok().flatten().is_none());
    let mut begun = open.filter_map(|stage| Some((stage, read_status(&run.join(stage)).ok()??)));
    let words = match begun.next() {
        Some((stage, s)) if s.state == State::Failed => {
            format!("{stage} failed: {}", s.error.unwrap_or_default())
        }
        Some((stage, s)) if s.state == State::Stopped => format!("{stage} stopped"),
        Some((stage, s)) if s.steps > 0 => format!("{stage}, {} %", 100 * s.step / s.steps.max(1)),
        Some((stage, _)) => stage.to_string(),
        None => last.map_or("empty".into(), |stage| format!("{stage} done")),
    };
    (words, false)
}

fn preset(run: &Path) -> Option<String> {
    let bytes = io::read_bytes(&run.join("config.toml"), &Limits::default()).ok()?;
    let file = ("config.toml".to_owned(), String::from_utf8(bytes).ok()?);
    let config = Config::resolve(&Sources { files: vec![file], ..Sources::default() }).ok()?;
    Some(config.preset.name().into())
}

/// The first view of the best that a run shows, over black.
fn picture(run: &Path) -> Option<String> {
    let folders = NAMES.iter().rev().map(|(word, _)| match *word {
        "ensemble" => run.join("ensemble"),
        word => run.join("render").join(word),
    });
    let first = |folder: PathBuf| {
        let names = io::list_files(&folder).ok()?;
        Some(folder.join(names.into_iter().find(|name| name.ends_with(".png"))?))
    };
    let file = folders.filter_map(first).next()?;
    let photo = io::read_photo(&file, None, &Limits::default()).ok()?;
    let mut small = reduce_photo(&photo, working_size(photo.width, photo.height, PICTURE_PX));
    for (c, a) in small.rgb.iter_mut().zip(small.alpha.take().unwrap_or_default()) {
        *c = over_black([c[0], c[1], c[2], a]);
    }
    Some(picture_url(&io::jpeg_bytes(&small, 78, &file).ok()?))
}

/// The way from a folder to a file; the file itself where one of them is not there.
fn relative(file: &Path, folder: &Path) -> PathBuf {
    let (Ok(file), Ok(folder)) = (io::real_path(file), io::real_path(folder)) else { return file.into() };
    let shared = file.components().zip(folder.components()).take_while(|(a, b)| a == b).count();
    let up = folder.components().skip(shared).map(|_| Path::new(".."));
    up.collect::<PathBuf>().join(file.components().skip(shared).collect::<PathBuf>())
}

/// Returns the page of many runs.
pub fn runs_html(rows: &[RunRow]) -> Result<String> {
    let figure = |value: Option<f64>, digits| value.map_or("–".into(), |v| format!("{v:.digits$}"));
    let cells = |row: &RunRow| -> [String; 7] {
        [
            figure(row.psnr, 2),
            figure(row.ssim, 4),
            figure(row.mesh_psnr, 2),
            row.watertight.map_or("–", |closed| if closed { "yes" } else { "NO" }).into(),
            row.triangles.map_or("–".into(), |n| n.to_string()),
            figure(row.megabytes, 1),
            duration(row.seconds),
        ]
    };
    let cells: Vec<_> = rows.iter().map(cells).collect();
    let done = rows.iter().filter(|row| row.done).count();
    let script = include_str!("runs.js");
    fill(
        include_str!("runs.html"),
        context! { style => STYLE, script, title => format!("{} runs", rows.len()), rows, cells, done },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_says_what_is_known_and_hostile_names_stay_text() {
        let dir = tempfile::tempdir().unwrap();
        let name = "<img src=x onerror=alert(1)>";
        let run = dir.path().join(name);
        std::fs::create_dir_all(run.join("iface")).unwrap();
        std::fs::create_dir_all(run.join("ensemble")).unwrap();
        std::fs::write(run.join("report.html"), "").unwrap();
        std::fs::write(run.join("iface/done.json"), "{").unwrap();
        io::write_png_rgba(&run.join("ensemble/a.png"), 1, 1, &[[200, 100, 50, 51]]).unwrap();
        let row = RunRow::read(&run, dir.path());
        assert_eq!((row.name.as_str(), row.state.as_str(), row.done), (name, "empty", false));
        assert_eq!(row.link, "%3Cimg%20src%3Dx%20onerror%3Dalert%281%29%3E/report.html");
        assert!(row.picture.starts_with("data:image/jpeg;base64,") && row.psnr.is_none());
        let page = runs_html(&[row.clone(), RunRow { psnr: Some(31.25), ..row }]).unwrap();
        assert!(!page.contains("<img src=x") && page.contains("&lt;img src=x") && page.contains("31.25"));
        assert_eq!(page.matches("<tr>").count(), 3);
    }

    #[test]
    fn two_hundred_runs_are_one_light_page() {
        let row = RunRow { picture: "x".repeat(5400), seconds: 70.0, ..RunRow::default() };
        let page = runs_html(&vec![row; 200]).unwrap();
        assert!(page.len() < 1_500_000, "{}", page.len());
    }

    #[test]
    fn the_way_between_two_folders_is_short() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(dir.path().join("runs/a")).unwrap();
        std::fs::create_dir_all(dir.path().join("pages")).unwrap();
        std::fs::write(dir.path().join("runs/a/report.html"), "").unwrap();
        let file = dir.path().join("runs/a/report.html");
        assert_eq!(relative(&file, &dir.path().join("pages")), Path::new("../runs/a/report.html"));
        assert_eq!(relative(&file, &dir.path().join("runs")), Path::new("a/report.html"));
    }
}
