//! One page of many runs, one row each, that is searched, filtered and sorted by any column.

use super::text::csv_text;
use super::{STYLE, fill, glb_megabytes, picture_url, relative, small_view, views, warnings};
use crate::config::{Config, NAMES, Stage, display_name};
use crate::run::{Phase, Record, RunStatus};
use glam::Vec3;
use minijinja::context;
use serde::{Deserialize, Serialize};
use std::path::Path;
use tiface_base::Result;
use tiface_base::error::counted;
use tiface_base::geom::Camera;
use tiface_base::io::{self, Limits};
use tiface_base::math::rank::mean_of_middle;

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
    /// Its state.
    pub state: String,
    /// Whether all stages are done.
    pub done: bool,
    /// Whether it ended with an error, or has lost a file.
    pub failed: bool,
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
    /// Whether the mesh is watertight; unknown where its files are not those that were written.
    pub watertight: Option<bool>,
    /// Number of triangles of the mesh, if its files are there.
    pub triangles: Option<u64>,
    /// Size of `head.glb`.
    pub megabytes: Option<f64>,
    /// Mean distance of the mesh from the true surface in per cent of the head's height; where that
    /// is known, of the demo head.
    pub truth_percent: Option<f64>,
    /// Work of all stages by the clock.
    pub seconds: f64,
    /// CPU time of all stages.
    pub cpu_s: Option<f64>,
    /// The most memory of any stage, bytes.
    pub peak_bytes: Option<u64>,
    /// Warnings of the stages.
    pub warnings: Vec<String>,
    /// When its last stage ended, in seconds since 1970.
    pub finished: u64,
}

impl RunRow {
    /// Reads the state and figures of the run in a folder; its page is linked from one in `beside`.
    /// A file that is missing or damaged leaves its figures out: one run must not hide the others.
    pub fn read(run: &Path, beside: &Path) -> RunRow {
        let status = RunStatus::read(run);
        let records: Vec<(Stage, &Record)> =
            status.stages.iter().filter_map(|s| Some((s.stage, s.record.as_ref()?))).collect();
        let of = |stage| records.iter().find(|(s, _)| *s == stage).map(|(_, r)| &r.summary);
        let name = io::real_path(run).unwrap_or(run.into());
        let has_mesh = status.stages.iter().all(|s| s.stage != Stage::Mesh || s.faults.is_empty());
        let mut row = RunRow {
            name: name.file_name().unwrap_or(run.as_os_str()).to_string_lossy().into_owned(),
            state: state(&status),
            done: status.phase == Phase::Done,
            failed: matches!(status.phase, Phase::Failed | Phase::Damaged),
            picture: picture(run).unwrap_or_default(),
            preset: Config::of_run(run).map_or(String::new(), |config| config.preset.as_str().into()),
            seconds: status.elapsed_s,
            cpu_s: records.iter().map(|(_, r)| r.cpu_s).sum::<Option<f64>>().filter(|s| *s > 0.0),
            peak_bytes: records.iter().filter_map(|(_, r)| r.peak_bytes).max(),
            warnings: warnings(run, records.iter().copied()),
            finished: records.iter().map(|(_, r)| r.finished).max().unwrap_or(0),
            megabytes: glb_megabytes(run).filter(|_| has_mesh),
            ..RunRow::default()
        };
        let page = run.join("report.html");
        if io::is_file(&page) {
            row.link = relative(&page, beside);
        }
        // figures of files that are gone or cut say nothing about what is there
        if let Some(mesh) = of(Stage::Mesh).filter(|_| has_mesh) {
            (row.watertight, row.triangles) = (mesh["closed"].as_bool(), mesh["triangles"].as_u64());
        }
        if let Some(metrics) = of(Stage::Metrics) {
            let mean = |word: &str, key: &str| metrics[word]["head"]["mean"][key].as_f64();
            let judged = NAMES.iter().filter_map(|(word, _)| Some((mean(word, "psnr_masked")?, *word)));
            if let Some((psnr, word)) = judged.max_by(|a, b| a.0.total_cmp(&b.0)) {
                (row.psnr, row.ssim, row.method) =
                    (Some(psnr), mean(word, "ssim_masked"), display_name(word));
            }
            let meshes = ["raycast", "textured", "raster"].into_iter();
            row.truth_percent = metrics["truth_percent_of_head"]["accuracy_mean"].as_f64();
            row.mesh_psnr = meshes.filter_map(|word| mean(word, "psnr_masked")).max_by(f64::total_cmp);
        }
        row
    }
}

/// Describes the state of a run.
fn state(run: &RunStatus) -> String {
    let stage = run.stages.iter().find(|s| Some(s.stage) == run.at);
    let place = stage.map_or(String::new(), |s| format!("{} ", s.stage));
    let percent = stage.and_then(|s| s.status.as_ref()?.percent());
    let share = percent.map_or(String::new(), |p| format!(", {p} %"));
    match run.phase {
        Phase::Done => "done".into(),
        Phase::Failed => format!("{place}failed: {}", run.error.as_deref().unwrap_or_default()),
        Phase::Unreadable => format!("{place}cannot be read: {}", run.error.as_deref().unwrap_or_default()),
        Phase::Damaged => format!("{place}damaged: {}", run.error.as_deref().unwrap_or_default()),
        Phase::Running => format!("{place}at work{share}"),
        Phase::Killed => format!("{place}killed{share}"),
        Phase::Stopped => format!("{place}stopped{share}"),
        Phase::Begun => {
            let last = run.stages.iter().rev().find(|s| s.phase == Phase::Done);
            last.map_or("begun".into(), |s| format!("{} done", s.stage))
        }
        Phase::Waiting => "empty".into(),
    }
}

/// Returns the most frontal view of the best method that a run shows, over black.
fn picture(run: &Path) -> Option<String> {
    let files = NAMES.iter().rev().map(|(word, _)| views(run, word)).find(|files| !files.is_empty())?;
    let names = frontal_views(run);
    let rank = |file: &&String| {
        let stem = file.rsplit_once('.').map_or(file.as_str(), |(stem, _)| stem);
        names.iter().position(|name| stem.ends_with(&format!("/{name}"))).unwrap_or(names.len())
    };
    Some(picture_url(&small_view(&run.join(files.iter().min_by_key(rank)?), PICTURE_PX, 78)?))
}

/// Returns the names of a run's views, first those that look as all cameras do in the mean; none if
/// they cannot be read.
fn frontal_views(run: &Path) -> Vec<String> {
    #[derive(Deserialize)]
    struct Cameras {
        views: Vec<NamedCamera>,
    }
    #[derive(Deserialize)]
    struct NamedCamera {
        name: String,
        camera: Camera,
    }
    let cameras = io::read_typed(&run.join("cameras.json"), &Limits::default());
    let mut views = cameras.map_or(Vec::new(), |Cameras { views }| views);
    let mean: Vec3 = views.iter().map(|view| view.camera.forward()).sum();
    let alike = |view: &NamedCamera| view.camera.forward().dot(mean);
    views.sort_by(|a, b| alike(b).total_cmp(&alike(a)));
    views.into_iter().map(|view| view.name).collect()
}

/// Figures that are compared over runs: heading, also in the CSV, and value.
const FIGURES: [(&str, fn(&RunRow) -> Option<f64>); 10] = [
    ("PSNR", |r| r.psnr),
    ("SSIM", |r| r.ssim),
    ("mesh PSNR", |r| r.mesh_psnr),
    ("% of head", |r| r.truth_percent),
    ("triangles", |r| r.triangles.map(|n| n as f64)),
    ("GLB MB", |r| r.megabytes),
    ("minutes", |r| Some(r.seconds / 60.0)),
    ("CPU minutes", |r| r.cpu_s.map(|s| s / 60.0)),
    ("GiB", |r| r.peak_bytes.map(|b| b as f64 / (1u64 << 30) as f64)),
    ("warnings", |r| Some(r.warnings.len() as f64)),
];
const DIGITS: [usize; FIGURES.len()] = [2, 4, 2, 2, 0, 1, 1, 1, 2, 0];

/// Distance from the median, in robust standard deviations, from which a value is an outlier
/// (Iglewicz and Hoaglin 1993).
const OUTLIER: f64 = 3.5;

/// Returns which of some values are far from the others, by the modified z-score: the distance from
/// the median over 1.4826 times the median of all distances. None of fewer than five.
fn outliers(values: &[Option<f64>]) -> Vec<bool> {
    let median = |mut v: Vec<f64>| mean_of_middle(&mut v).unwrap_or(0.0);
    let known: Vec<f64> = values.iter().flatten().copied().collect();
    if known.len() < 5 {
        return vec![false; values.len()];
    }
    let middle = median(known.clone());
    let spread = 1.4826 * median(known.iter().map(|v| (v - middle).abs()).collect());
    // most may be alike to the last digit: then any difference of more than a thousandth is an
    // outlier
    let spread = spread.max(1e-3 * middle.abs() / OUTLIER);
    values.iter().map(|v| v.is_some_and(|v| (v - middle).abs() > OUTLIER * spread)).collect()
}

/// Returns the page of many runs, those that failed first.
pub fn runs_html(rows: &[RunRow]) -> Result<String> {
    let mut rows: Vec<&RunRow> = rows.iter().collect();
    rows.sort_by_key(|row| !row.failed);
    // unfinished runs have incomplete figures
    let value = |row: &RunRow, of: fn(&RunRow) -> Option<f64>| of(row).filter(|_| row.done);
    let far: Vec<Vec<bool>> = FIGURES
        .iter()
        .map(|(_, of)| outliers(&rows.iter().map(|&r| value(r, *of)).collect::<Vec<_>>()))
        .collect();
    let cells = |(i, row): (usize, &&RunRow)| -> Vec<(String, bool)> {
        let figure = |k: usize| {
            let (_, of) = FIGURES[k];
            (of(row).map_or("–".into(), |v| format!("{v:.*}", DIGITS[k])), far[k][i])
        };
        (0..FIGURES.len()).map(figure).collect()
    };
    let cells: Vec<_> = rows.iter().enumerate().map(cells).collect();
    let done = rows.iter().filter(|row| row.done).count();
    let failed = rows.iter().filter(|row| row.failed).count();
    let headings: Vec<&str> = FIGURES.iter().map(|(heading, _)| *heading).collect();
    fill(
        include_str!("runs.html"),
        include_str!("runs.js"),
        context! { style => STYLE, title => counted(rows.len(), "run"), rows, cells, headings, done, failed },
    )
}

/// Returns the figures of many runs as comma-separated values (RFC 4180), a heading first.
pub fn runs_csv(rows: &[RunRow]) -> String {
    let mut csv = "run,state,best,watertight,preset".to_owned();
    FIGURES.iter().for_each(|(heading, _)| csv += &format!(",{heading}"));
    for row in rows {
        let closed = row.watertight.map_or("", |closed| if closed { "yes" } else { "no" });
        csv += "\n";
        csv += &[&row.name, &row.state, &row.method].map(|text| csv_text(text)).join(",");
        csv += &format!(",{closed},{}", row.preset);
        FIGURES.iter().for_each(|(_, of)| csv += &of(row).map_or(",".into(), |v| format!(",{v}")));
    }
    csv + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;
    use serde_json::json;

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
        assert_eq!((row.name.as_str(), row.done, row.failed), (name, false, false));
        assert!(row.state.starts_with("iface cannot be read: "), "{}", row.state);
        assert_eq!(row.link, "%3Cimg%20src%3Dx%20onerror%3Dalert%281%29%3E/report.html");
        assert!(row.picture.starts_with("data:image/jpeg;base64,") && row.psnr.is_none());
        // so have runs whose views are EXR files in folders of their own
        std::fs::remove_file(run.join("ensemble/a.png")).unwrap();
        std::fs::create_dir_all(run.join("render/raster/left")).unwrap();
        let channels: Vec<(&str, &[f32])> = ["B", "G", "R"].map(|c| (c, &[0.5][..])).into();
        io::write_exr(&run.join("render/raster/left/a.exr"), 1, 1, &channels).unwrap();
        assert!(RunRow::read(&run, dir.path()).picture.starts_with("data:image/jpeg;base64,"));
        let warned = RunRow { warnings: vec!["mesh: <b>holes".into()], ..row.clone() };
        let page = runs_html(&[warned]).unwrap();
        // readable without a pointer, and sorted by their number
        assert!(page.contains("<li>mesh: &lt;b&gt;holes</li>"), "{page}");
        assert!(page.contains("data-value=\"1\"") && !page.contains("title=\"mesh"), "{page}");
        let page = runs_html(&[row.clone(), RunRow { psnr: Some(31.25), ..row }]).unwrap();
        assert!(!page.contains("<img src=x") && page.contains("&lt;img src=x") && page.contains("31.25"));
        assert_eq!(page.matches("<tr").count(), 3);
    }

    #[test]
    fn a_mesh_that_was_cut_is_not_shown_as_watertight() {
        let dir = tempfile::tempdir().unwrap();
        let fingerprint = tiface_base::Fingerprint::default();
        let plan =
            crate::run::Plan { name: "mesh", fingerprint, device: "cpu", needs_bytes: 0, saves: false };
        let done = crate::run::Run::quiet(dir.path()).stage(plan, |stage| {
            io::write_atomic(&stage.folder().join("head.glb"), b"triangles")?;
            Ok(json!({"closed": true, "triangles": 12}))
        });
        assert!(!done.unwrap().skipped);
        let row = RunRow::read(dir.path(), dir.path());
        assert_eq!((row.watertight, row.triangles, row.failed), (Some(true), Some(12), false));
        std::fs::write(dir.path().join("mesh/head.glb"), "tri").unwrap();
        let row = RunRow::read(dir.path(), dir.path());
        assert_eq!((row.watertight, row.triangles, row.megabytes, row.failed), (None, None, None, true));
        assert!(
            row.state.starts_with("mesh damaged: ") && row.state.contains("has 3 bytes"),
            "{}",
            row.state
        );
        assert!(row.warnings.len() == 1 && row.warnings[0].contains("tiface export"), "{:?}", row.warnings);
        // a file that was moved away is told, but is no failure
        std::fs::remove_file(dir.path().join("mesh/head.glb")).unwrap();
        let row = RunRow::read(dir.path(), dir.path());
        assert_eq!((row.watertight, row.failed, row.warnings.len()), (None, false, 1));
    }

    #[test]
    fn the_picture_of_a_run_is_its_most_frontal_view() {
        let dir = tempfile::tempdir().unwrap();
        let turned = |degrees: f64| Camera {
            rotation: DMat3::from_rotation_y(degrees.to_radians()),
            ..Camera::above(4, 4, 4.0, 2.0)
        };
        let views = [("a", 80.0), ("b", -10.0), ("c", -60.0)]
            .map(|(name, degrees)| json!({"name": name, "camera": turned(degrees), "split": "test"}));
        std::fs::write(dir.path().join("cameras.json"), json!({"views": views}).to_string()).unwrap();
        // the mean looks 2 degrees to the side
        assert_eq!(frontal_views(dir.path()), ["b", "c", "a"]);
        std::fs::create_dir_all(dir.path().join("ensemble")).unwrap();
        for (name, red) in [("a", 0), ("b", 255), ("c", 0)] {
            let file = dir.path().join(format!("ensemble/{name}.png"));
            io::write_png_rgba(&file, 1, 1, &[[red, 0, 0, 255]]).unwrap();
        }
        let shown = picture(dir.path());
        std::fs::remove_file(dir.path().join("cameras.json")).unwrap();
        // without cameras the first
        assert!(shown.is_some() && shown != picture(dir.path()));
    }

    #[test]
    fn what_stands_out_is_marked_and_what_all_share_is_not() {
        // median 31, distances 1, 0, 1, 0, 9: their median is 1
        let psnr = [30.0, 31.0, 32.0, 31.0, 22.0];
        assert_eq!(outliers(&psnr.map(Some)), [false, false, false, false, true]);
        assert_eq!(outliers(&[Some(1.0), None, Some(900.0)]), [false; 3]);
        assert!(outliers(&[Some(7.0), Some(7.0), Some(7.0), Some(7.0), None, Some(7.1)])[5]);
        let row = |psnr| RunRow { psnr: Some(psnr), done: true, seconds: 60.0, ..RunRow::default() };
        let page = runs_html(&psnr.map(row)).unwrap();
        assert_eq!(page.matches("<td class=\"far\"").count(), 1, "{page}");
        assert!(page.contains("<td class=\"far\">22.00</td>"));
    }

    #[test]
    fn a_table_for_spreadsheets_quotes_names_and_keeps_all_digits() {
        let row = RunRow {
            name: "=cmd|\"x\"".into(),
            state: "a, b".into(),
            watertight: Some(false),
            psnr: Some(31.25),
            warnings: vec!["w".into()],
            ..RunRow::default()
        };
        let csv = runs_csv(&[row]);
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(
            lines[0],
            "run,state,best,watertight,preset,PSNR,SSIM,mesh PSNR,% of head,triangles,GLB MB,minutes,CPU minutes,GiB,warnings"
        );
        assert_eq!(lines[1], "\"'=cmd|\"\"x\"\"\",\"a, b\",\"\",no,,31.25,,,,,,0,,,1");
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
        assert_eq!(relative(&file, &dir.path().join("pages")), "../runs/a/report.html");
        assert_eq!(relative(&file, &dir.path().join("runs")), "a/report.html");
    }
}
