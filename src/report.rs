//! Self-contained HTML pages, one file each: `report.html` of a run, a page of many runs, the head
//! to turn, a run while it works. Their markup is in `report/*.html`.
//!
//! Everything that comes from outside is escaped by the templates; only what this module made
//! itself (drawings, pictures, JSON) goes in as it is.

pub mod bench;
mod chart;
pub mod experiment;
mod live;
mod runs;
mod text;
mod verdicts;

pub use chart::{Chart, Curve, charts, curves_csv};
pub use live::live_html;
pub use runs::{RunRow, runs_csv, runs_html};
pub(crate) use text::{base64, escape};
pub use text::{duration, leaves, link, picture_url, relative};
pub use verdicts::{blend_verdict, glb_megabytes, height, judged_by, warnings};

use crate::config::Stage;
use minijinja::{Environment, context};
use serde::Serialize;
use serde_json::json;
use sha2::{Digest, Sha256};
use std::path::Path;
use tiface_base::image::{Photo, over_black, quantize, reduce_photo, srgb_from_linear, working_size};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, ErrorKind, Result};

/// Style that all pages share.
const STYLE: &str = include_str!("report/style.css");

/// The stages that learn, and what of their `log.jsonl` is drawn.
pub const LEARNED: [(Stage, &[&str]); 3] = [
    (Stage::Baseline, &["psnr", "samples"]),
    (Stage::Tface, &["psnr", "mask"]),
    (Stage::Iface, &["psnr", "eikonal", "inv_s"]),
];

/// The error that is drawn brightest: a fifth of the range of a color.
pub const MAX_ERROR: f32 = 0.2;

/// Colors of errors from none to [`MAX_ERROR`], even steps: dark to bright, also in gray.
pub const HEAT: [[u8; 3]; 6] =
    [[0, 0, 4], [66, 10, 104], [147, 38, 103], [221, 81, 58], [252, 165, 10], [252, 255, 164]];

/// Returns the files of a run's views of one kind, a word of [`NAMES`](crate::config::NAMES),
/// relative to the run and in name order; not the depth and the float views beside them.
fn views(run: &Path, word: &str) -> Vec<String> {
    let folder = if word == "ensemble" { word.to_owned() } else { format!("render/{word}") };
    let root = run.join(&folder);
    let is_beside = |path: &Path| ["depth", "float"].iter().any(|name| path == root.join(name));
    let files = io::file_sizes(&root, &is_beside).unwrap_or_default().into_keys();
    files.filter(|f| f.ends_with(".png") || f.ends_with(".exr")).map(|f| format!("{folder}/{f}")).collect()
}

/// Returns a view over black as a JPEG file of at most `side` pixels; `None` where it cannot be
/// read.
fn small_view(file: &Path, side: u32, quality: u8) -> Option<Vec<u8>> {
    let limits = Limits::default();
    let photo = if file.extension().is_some_and(|ending| ending == "exr") {
        let image = io::read_exr(file, &[&["R", "G", "B"]], &limits).ok()?.image;
        let coded = |p: &[f32; 3]| p.map(|v| quantize(srgb_from_linear(v)));
        let rgb = image.data.as_chunks::<3>().0.iter().map(coded).collect();
        Photo { width: image.width, height: image.height, rgb, alpha: None }
    } else {
        io::read_photo(file, None, &limits).ok()?
    };
    let mut small = reduce_photo(&photo, working_size(photo.width, photo.height, side));
    for (c, a) in small.rgb.iter_mut().zip(small.alpha.take().unwrap_or_default()) {
        *c = over_black([c[0], c[1], c[2], a]);
    }
    io::jpeg_bytes(&small, quality, file).ok()
}

/// The content of a report.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Report {
    /// Title of the page: the capture's name.
    pub title: String,
    /// The run in a line: preset, seed, time, version.
    pub facts: Vec<String>,
    /// The head to turn.
    pub viewer: Option<Viewer>,
    /// Quality and cost of each rendering method.
    pub table: MethodTable,
    /// Errors of each kind of picture by part of the head: the heading, then a row each; may be
    /// empty.
    pub quality: Vec<Vec<String>>,
    /// Photographs with what was rendered for them.
    pub views: Vec<ViewRow>,
    /// Files of the views that did not fit, relative to the page.
    pub left_out: Vec<String>,
    /// The masks over their photographs: a part of a page, already escaped.
    pub masks: String,
    /// Figures over training steps, each a part of a page.
    pub charts: Vec<String>,
    /// Durations: stage, words, share of the longest in percent.
    pub times: Vec<(String, String, f64)>,
    /// Settings that are not the preset's: key, value, the preset's; of two runs, those that
    /// differ.
    pub changes: Vec<[String; 3]>,
    /// Names of the two runs that the page compares; else empty.
    pub compared: Vec<String>,
    /// Warnings.
    pub warnings: Vec<String>,
    /// The command that repeats the run.
    pub repeat: String,
    /// Stage and the rows of its figures ([`leaves`]).
    pub summaries: Vec<(String, Vec<(String, String)>)>,
    /// The configuration as TOML.
    pub settings: String,
}

/// A table of ways to make a picture, the best of each column marked.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct MethodTable {
    /// Of the columns.
    pub headings: Vec<String>,
    /// Name, and a cell for each column: words, and whether it is the best.
    pub rows: Vec<(String, Vec<(String, bool)>)>,
}

impl MethodTable {
    /// Of columns (heading, digits, and whether more is better, less is, or neither) and rows of
    /// figures.
    pub fn new(
        columns: &[(&str, usize, Option<bool>)],
        rows: Vec<(String, Vec<Option<f64>>)>,
    ) -> MethodTable {
        let best = |k: usize, more: bool| {
            let all = rows.iter().filter_map(|(_, row)| row[k]);
            all.reduce(|a, b| if (b > a) == more { b } else { a })
        };
        let best: Vec<Option<f64>> =
            columns.iter().enumerate().map(|(k, (_, _, more))| more.and_then(|m| best(k, m))).collect();
        let cell = |(k, value): (usize, &Option<f64>)| match value {
            Some(v) => (format!("{v:.*}", columns[k].1), rows.len() > 1 && best[k] == Some(*v)),
            None => ("–".into(), false),
        };
        let row = |(name, row): &(String, Vec<Option<f64>>)| {
            (name.clone(), row.iter().enumerate().map(cell).collect())
        };
        let headings = columns.iter().map(|(name, ..)| name.to_string()).collect();
        MethodTable { headings, rows: rows.iter().map(row).collect() }
    }
}

/// A head to turn.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Viewer {
    /// Its name.
    pub name: String,
    /// Differences from the file: a sentence, or empty.
    pub note: String,
    /// Cameras of the photographs.
    pub cameras: Vec<ViewerCamera>,
    /// Its USDZ, relative to the page; empty without.
    pub usdz: String,
    /// Direction that the face looks in, in the file's coordinates; any length.
    pub front: [f32; 3],
    /// The bytes of a GLB.
    #[serde(skip)]
    pub glb: Vec<u8>,
}

/// Camera of a photograph, in the coordinates of the file; without distortion.
#[derive(Clone, Debug, Serialize)]
pub struct ViewerCamera {
    /// The view's name.
    pub name: String,
    /// Pixels in a row and rows, and the intrinsics in such pixels.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point from the left edge.
    pub cx: f64,
    /// Principal point from the top edge.
    pub cy: f64,
    /// Its position.
    pub position: [f64; 3],
    /// Right, up and backwards.
    pub axes: [[f64; 3]; 3],
    /// The `id` of its photograph in the page; empty without.
    pub picture: String,
}

impl Viewer {
    /// Returns the part of a page that shows it; [`VIEWER_SCRIPT`] makes it work.
    fn html(&self) -> Result<String> {
        let data = json!({"cameras": self.cameras, "front": self.front, "most": MAX_ERROR, "heat": HEAT});
        // no name can end the script that holds it
        let data = data.to_string().replace('<', "\\u003c");
        let glb = base64(&self.glb);
        fill(include_str!("report/viewer.html"), "", context! { viewer => self, data, glb })
    }
}

const VIEWER_SCRIPT: &str = include_str!("report/viewer.js");

/// The pictures of one view.
#[derive(Clone, Debug, Serialize)]
pub struct ViewRow {
    /// The view's name.
    pub name: String,
    /// Pixels in a row of the pictures.
    pub width: u32,
    /// Their rows.
    pub height: u32,
    /// The photograph: a `data:` address.
    pub photo: String,
    /// Pictures of the view.
    pub pictures: Vec<ViewPicture>,
}

/// A picture of a view.
#[derive(Clone, Debug, Serialize)]
pub struct ViewPicture {
    /// The name of the method that made it.
    pub method: String,
    /// Display name.
    pub title: String,
    /// The picture: a `data:` address.
    pub picture: String,
    /// Error relative to the photograph, in the colors of [`HEAT`].
    pub error: String,
    /// Masked PSNR, words.
    pub psnr: String,
    /// The full picture, relative to the page.
    pub file: String,
}

/// Returns the page of a run.
pub fn html(report: &Report) -> Result<String> {
    let viewer = report.viewer.as_ref().map(Viewer::html).transpose()?;
    let mut methods: Vec<(&str, &str)> = Vec::new();
    for picture in report.views.iter().flat_map(|v| &v.pictures) {
        if methods.iter().all(|(word, _)| *word != picture.method) {
            methods.push((&picture.method, &picture.title));
        }
    }
    let viewer_script = if viewer.is_some() { VIEWER_SCRIPT } else { "" };
    fill(
        include_str!("report/page.html"),
        &format!("{}\n{viewer_script}", include_str!("report/page.js")),
        context! {
            style => STYLE, viewer, methods, heat => heat(), most => (MAX_ERROR * 255.0).round(),
            ..minijinja::Value::from_serialize(report)
        },
    )
}

/// Returns the page of a head alone.
pub fn viewer_html(viewer: &Viewer, views: &[ViewRow]) -> Result<String> {
    fill(
        include_str!("report/head.html"),
        VIEWER_SCRIPT,
        context! {
            style => STYLE, title => viewer.name, viewer => viewer.html()?, views
        },
    )
}

/// Returns the colors of errors as CSS.
fn heat() -> String {
    let colors: Vec<String> = HEAT.iter().map(|[r, g, b]| format!("rgb({r} {g} {b})")).collect();
    format!("linear-gradient(to right, {})", colors.join(", "))
}

/// Fills in a template. The policy of a page (`top.html`) lets a browser run `script` alone, by its
/// digest, and load nothing but pictures inside the page, and, with `beside` in the context,
/// pictures that lie beside it: so that what is not escaped by mistake still does nothing.
fn fill(template: &str, script: &str, context: minijinja::Value) -> Result<String> {
    let context = context! { script, digest => base64(&Sha256::digest(script)), ..context };
    let mut pages = Environment::new();
    pages.set_trim_blocks(true);
    let parts =
        [("top.html", include_str!("report/top.html")), ("charts.html", include_str!("report/charts.html"))];
    let parts = parts.into_iter().try_for_each(|(name, part)| pages.add_template(name, part));
    // the name says that it is HTML, so that everything is escaped
    let page = pages.template_from_named_str("page.html", template);
    parts.and(page).and_then(|page| page.render(context)).map_err(|e| Error::new(ErrorKind::Bug, e))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    const HOSTILE: &str = "<img src=x onerror=alert(1)>\"'</script>";

    fn camera() -> ViewerCamera {
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let (name, picture) = (HOSTILE.into(), "photo-0".into());
        let (fx, fy, cx, cy) = (9.0, 9.0, 2.0, 3.0);
        ViewerCamera { name, width: 4, height: 6, fx, fy, cx, cy, position: [0.0; 3], axes, picture }
    }

    fn report() -> Report {
        let viewer = Viewer {
            name: HOSTILE.into(),
            cameras: vec![camera()],
            front: [0.0, 0.0, 1.0],
            glb: vec![1],
            ..Viewer::default()
        };
        let picture = ViewPicture {
            method: "tface".into(),
            title: "T-Face".into(),
            picture: picture_url(&[0xFF, 0xD8, 1]),
            error: picture_url(&[2]),
            psnr: "33.1".into(),
            file: format!("render/tface/{HOSTILE}.png"),
        };
        let photo = picture_url(&[1]);
        Report {
            title: HOSTILE.into(),
            viewer: Some(viewer),
            table: MethodTable::new(
                &[("PSNR", 2, Some(true)), ("s", 1, Some(false)), ("triangles", 0, None)],
                vec![
                    ("a".into(), vec![Some(30.0), Some(2.0), None]),
                    ("b".into(), vec![Some(31.0), None, Some(9.0)]),
                ],
            ),
            quality: [["", "edge"], ["head & neck", "21.02"]].map(|r| r.map(String::from).to_vec()).to_vec(),
            views: vec![ViewRow {
                name: HOSTILE.into(),
                width: 4,
                height: 6,
                photo,
                pictures: vec![picture],
            }],
            left_out: vec![HOSTILE.into()],
            masks: "<figure>mask</figure>".into(),
            charts: vec!["<figure>chart</figure>".into()],
            times: vec![("iface".into(), "8.0 s".into(), 100.0)],
            changes: vec![[HOSTILE.into(), "1".into(), "2".into()]],
            warnings: vec![HOSTILE.into()],
            repeat: HOSTILE.into(),
            summaries: vec![(
                "mesh".into(),
                leaves(&json!({"closed": true, "report": {"volume": 0.25}, "p": null})),
            )],
            settings: HOSTILE.into(),
            ..Report::default()
        }
    }

    #[test]
    fn the_page_holds_everything_and_escapes_whatever_comes_from_outside() {
        let page = html(&report()).unwrap();
        assert!(!page.contains("<img src=x") && !page.contains("//cdn") && !page.contains("http:"), "{page}");
        assert_eq!(page.matches("</script>").count(), page.matches("<script").count());
        assert!(page.contains("<td>report.volume</td><td>0.2500</td>") && page.contains("<td>–</td>"));
        assert!(page.contains("<tr><td>head &amp; neck</td><td>21.02</td></tr>"));
        assert!(page.contains("<figure>mask</figure>") && page.contains("<figure>chart</figure>"));
        assert!(page.contains("data:image/jpeg;base64,/9gB") && page.contains("data:image/png;base64,AQ=="));
        assert!(page.contains("<h1>&lt;img src=x onerror=alert(1)&gt;"));
    }

    /// Returns the scripts of a page that a browser would run, and their digests in its policy.
    fn scripts(page: &str) -> (Vec<String>, Vec<String>) {
        let run = page.split("<script>").skip(1).map(|rest| rest.split_once("</script>").unwrap().0);
        let run = run.map(|script| base64(&Sha256::digest(script))).collect();
        let policy = page.split_once("http-equiv=\"Content-Security-Policy\" content=\"").unwrap().1;
        let policy = policy.split_once('"').unwrap().0;
        assert!(policy.starts_with("default-src 'none'; img-src data:"), "{policy}");
        assert!(!policy.contains("script-src 'unsafe") && !policy.contains("http"), "{policy}");
        let digests = policy.split("'sha256-").skip(1).map(|rest| rest.split_once('\'').unwrap().0.into());
        (run, digests.collect())
    }

    #[test]
    fn every_page_runs_its_own_script_alone_and_loads_only_pictures() {
        let report = report();
        let dir = tempfile::tempdir().unwrap();
        let live = |renewed| live_html(dir.path(), |_, _| None, renewed).unwrap();
        let viewer = report.viewer.as_ref().unwrap();
        for (page, count) in [
            (html(&report).unwrap(), 1),
            (html(&Report::default()).unwrap(), 1),
            (viewer_html(viewer, &report.views).unwrap(), 1),
            (runs_html(&[]).unwrap(), 1),
            (live(true), 1),
            (live(false), 0),
            (bench::BenchResult::default().html().unwrap(), 0),
        ] {
            let (run, allowed) = scripts(&page);
            assert_eq!(run, allowed);
            assert_eq!(run.len(), count);
            assert!(!page.contains(" onerror=\"") && !page.contains(" onclick=\""));
        }
        // pictures beside the page are those of the live page alone
        assert!(live(true).contains("img-src data: 'self' file:;"));
        assert!(!html(&report).unwrap().contains("file:;"));
    }

    #[test]
    fn every_template_of_a_page_states_a_policy() {
        fn walk(folder: &Path, pages: &mut Vec<PathBuf>) {
            for path in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
                match path.extension().and_then(|ending| ending.to_str()) {
                    _ if path.is_dir() => walk(&path, pages),
                    Some("html") => pages.push(path),
                    _ => {}
                }
            }
        }
        let mut pages = Vec::new();
        walk(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut pages);
        let mut whole = 0;
        for path in pages {
            let text = std::fs::read_to_string(&path).unwrap();
            let (head, includes) = (text.contains("<head>"), text.contains("{% include \"top.html\" %}"));
            whole += usize::from(head || includes);
            let policy = "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none';";
            assert!(!head || text.contains(policy), "{}", path.display());
            // fragments are parts of such a page
            assert!(head || includes || !text.contains("<body"), "{}", path.display());
        }
        assert!(whole >= 7, "{whole}");
    }

    #[test]
    fn a_head_alone_has_its_page() {
        let report = report();
        let page = viewer_html(report.viewer.as_ref().unwrap(), &report.views).unwrap();
        assert!(!page.contains("<img src=x") && page.contains("id=\"photo-0\"") && page.contains("AQ=="));
    }

    #[test]
    fn the_best_of_a_column_is_marked_by_what_is_better_there() {
        let MethodTable { headings, rows } = report().table;
        assert_eq!(headings, ["PSNR", "s", "triangles"]);
        let cells = |k: usize| rows.iter().map(|(_, r)| (r[k].0.as_str(), r[k].1)).collect::<Vec<_>>();
        assert_eq!(cells(0), [("30.00", false), ("31.00", true)]);
        assert_eq!(cells(1), [("2.0", true), ("–", false)]);
        assert_eq!(cells(2), [("–", false), ("9", false)]);
    }
}
