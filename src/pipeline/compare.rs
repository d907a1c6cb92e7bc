//! Comparisons on one page: two runs of a capture, and what other programs made of it, against the
//! same held-out photographs.

use super::metrics::{Comparable, Judge, means};
use super::page::views::{ShownSet, rows, shown_sets};
use super::page::{COLUMNS, MAX_BYTES, curves, judged, methods, quality};
use super::pictures;
use super::renderer::VisibleHead;
use super::session::Session;
use crate::config::{Config, PictureFormat, Stage};
use crate::metrics::distance::one_way;
use crate::pipeline::mesh::{finished_mesh, read_finished, surface_in_world};
use crate::report::{self, Chart, MethodTable, Report, duration, leaves, relative};
use crate::run::read_record;
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::geom::Bvh;
use tiface_base::io;
use tiface_base::{Error, Result};
use tiface_capture::{Capture, Split, View, ViewMask};
use tiface_surface::files::{HeadMesh, OpenedMesh, check, open_mesh, weld};
use tiface_surface::render::RaycastOptions;

/// Points sampled on each of two surfaces.
const SURFACE_SAMPLES: usize = 100_000;

/// Folder of the pictures of meshes, beside the page.
const DRAWN: &str = "pictures";

/// Returns a page, to lie in `folder`, that compares two runs of one capture: their pictures of the
/// same photographs, tables, curves laid over each other, the distance between their surfaces, and
/// the settings that differ.
///
/// # Errors
///
/// Fails if the photographs have been moved, or if the runs have no pictures of the same photograph
/// over the same background.
pub fn compare_runs(runs: [&Session; 2], names: [&str; 2], folder: &Path) -> Result<String> {
    runs.iter().try_for_each(|session| session.require_inputs(&[Stage::Metrics]))?;
    let of = |name: &str, what: &str| format!("{name}: {what}");
    let [a, b] = runs;
    let (own, others) = (shown_sets(a), shown_sets(b));
    let shows = |sets: &[ShownSet], view: &View| {
        let is_same = |p: &Comparable| {
            p.view.name == view.name
                && p.view.camera.width == view.camera.width
                && p.view.camera.height == view.camera.height
        };
        sets.iter().flat_map(|set| &set.pictures).any(is_same)
    };
    let same = a.capture.views.iter().filter(|view| shows(&own, view) && shows(&others, view));
    let same: Vec<View> = same.cloned().collect();
    if same.is_empty() || a.config.render.background != b.config.render.background {
        return Err(Error::cannot(
            format!(
                "`{}` and `{}` show no photograph alike: of one name and size, over one background",
                names[0], names[1]
            ),
            "compare two runs of one capture with the same `capture.downscale` and `render.background`, or add `--table`",
        ));
    }
    let mut sets = Vec::new();
    for ((all, name), side) in [own, others].into_iter().zip(names).zip(["a", "b"]) {
        sets.extend(all.into_iter().map(|set| ShownSet {
            key: format!("{side}-{}", set.key),
            title: of(name, &set.title),
            ..set
        }));
    }
    let (views, left_out) = rows(&same, a.config.render.background, &sets, folder, MAX_BYTES)?;
    let (mut table, mut figures) = (Vec::new(), Vec::new());
    for (session, name) in runs.iter().zip(names) {
        table.extend(methods(session).into_iter().map(|(title, row)| (of(name, &title), row)));
        figures.extend(judged(session).into_iter().map(|(title, set)| (of(name, &title), set)));
    }
    report::html(&Report {
        title: format!("{} and {}", names[0], names[1]),
        facts: runs.iter().zip(names).map(|(run, name)| facts(run, name)).collect(),
        table: MethodTable::new(&COLUMNS, table),
        quality: quality(&figures),
        views,
        left_out,
        charts: curves(&[(a, names[0]), (b, names[1])])?.iter().map(Chart::html).collect(),
        summaries: surfaces(runs, names)?
            .map(|found| ("Distance between the surfaces".to_string(), leaves(&found)))
            .into_iter()
            .collect(),
        changes: a.config.differences(b.config),
        compared: names.map(String::from).to_vec(),
        ..Report::default()
    })
}

/// Returns a run's preset, seed and time in words.
fn facts(run: &Session, name: &str) -> String {
    let times = Stage::ALL.iter().filter_map(|&stage| read_record(&run.run.path(stage)).ok()?);
    let seconds = times.map(|record| record.elapsed_s).sum();
    format!("{name}: preset {}, seed {}, {}", run.config.preset.as_str(), run.config.seed, duration(seconds))
}

/// Returns the distances between the extracted surfaces in dataset units, both ways; `None` if a
/// run has no mesh.
fn surfaces(runs: [&Session; 2], names: [&str; 2]) -> Result<Option<Value>> {
    if runs.iter().any(|session| finished_mesh(session.run.dir()).is_err()) {
        return Ok(None);
    }
    let surface = |session: &Session| read_finished(session.run.dir(), |_| surface_in_world(session.run));
    let [a, b] = [surface(runs[0])?, surface(runs[1])?];
    let forward = one_way(&a, &Bvh::new(&b), SURFACE_SAMPLES);
    let back = one_way(&b, &Bvh::new(&a), SURFACE_SAMPLES);
    let [from_a, from_b] = names.map(|name| format!("from {name}, dataset units"));
    Ok(Some(json!({from_a: forward, from_b: back})))
}

/// Results of other programs for a capture, judged like a run.
pub struct Judged {
    /// `metrics.json`, with an entry for each folder and mesh.
    pub metrics: Value,
    /// Title, masked PSNR and SSIM (of the whole frame without masks), and the number of views, of
    /// each.
    pub rows: Vec<(String, Option<f64>, Option<f64>, usize)>,
    /// The page.
    pub page: String,
    /// Views without a picture, and features of the meshes that cannot be shown.
    pub warnings: Vec<String>,
}

/// Compares pictures and meshes of other programs with the held-out photographs of a capture. Each
/// folder of `views` has pictures named like the photographs (`NAME.png`, `.jpg` or `.exr`); meshes
/// are in the capture's world, and their pictures are written to folders in `out/pictures`; the
/// page is to lie in `out`.
///
/// # Errors
///
/// Fails if the capture holds out no photograph, if a folder has a picture of none of them or one
/// of another size, or if a file cannot be read.
pub fn judge(
    capture: &Capture,
    config: &Config,
    views: &[PathBuf],
    meshes: &[PathBuf],
    out: &Path,
) -> Result<Judged> {
    let held_out: Vec<&View> = capture.views.iter().filter(|view| view.split != Split::Train).collect();
    if held_out.is_empty() {
        return Err(Error::cannot(
            "the capture holds out no photograph to judge by",
            "say in the capture which ones to hold out, as `test_filenames` of a transforms.json does",
        ));
    }
    let Entries { names, sets, mut shapes, warnings } =
        Entries::read(&held_out, config, views, meshes, &out.join(DRAWN))?;
    let judge = Judge::new(config, sets.iter().flatten(), None)?;
    let (mut metrics, mut shown) = (Map::new(), Vec::new());
    for (k, (name, pictures)) in names.into_iter().zip(sets).enumerate() {
        let mut figures = judge.figures(&pictures)?.unwrap_or_default();
        figures.as_object_mut().zip(shapes.remove(&name)).map(|(f, shape)| f.insert("mesh".into(), shape));
        metrics.insert(name.clone(), figures.clone());
        shown.push(ShownSet { key: format!("set-{k}"), title: name, pictures, figures });
    }
    let masks = if held_out.iter().any(|view| view.mask != ViewMask::None) { "capture" } else { "none" };
    let truth = json!({"photographs": config.metrics.truth, "masks": masks});
    let facts = [Some(counted(held_out.len(), "held-out photograph")), report::judged_by(&truth)];
    let (views, left_out) = rows(&capture.views, config.render.background, &shown, out, MAX_BYTES)?;
    let page = report::html(&Report {
        title: format!("{}: views of other programs", capture.name),
        facts: facts.into_iter().flatten().collect(),
        views,
        left_out,
        warnings: warnings.clone(),
        ..tables(&shown)
    })?;
    let row = |set: &ShownSet| {
        let one =
            |masked: &str, frame: &str| mean(&set.figures, masked).or_else(|| mean(&set.figures, frame));
        let (psnr, ssim) = (one("psnr_masked", "psnr"), one("ssim_masked", "ssim"));
        (set.title.clone(), psnr, ssim, set.pictures.len())
    };
    let rows = shown.iter().map(row).collect();
    metrics.insert("truth".into(), truth);
    Ok(Judged { metrics: Value::Object(metrics), rows, page, warnings })
}

/// Folders and meshes of other programs, with pictures of the held-out views.
struct Entries<'c> {
    names: Vec<String>,
    /// The pictures of each name.
    sets: Vec<Vec<Comparable<'c>>>,
    /// Figures of the meshes, by name.
    shapes: Map<String, Value>,
    warnings: Vec<String>,
}

impl<'c> Entries<'c> {
    /// Reads the folders, and draws the meshes into folders in `drawn`.
    fn read(
        held_out: &[&'c View],
        config: &Config,
        views: &[PathBuf],
        meshes: &[PathBuf],
        drawn: &Path,
    ) -> Result<Entries<'c>> {
        // the entry of the whole file
        let mut names = vec!["truth".to_string()];
        for path in views.iter().chain(meshes) {
            let name = unique(path, &names);
            names.push(name);
        }
        names.remove(0);
        let (mut sets, mut shapes, mut warnings) = (Vec::new(), Map::new(), Vec::new());
        for (folder, name) in views.iter().zip(&names) {
            let set = pictures_of(held_out, folder)?;
            if set.len() < held_out.len() {
                let lacking = counted(held_out.len() - set.len(), "held-out view");
                warnings.push(format!("{name}: no picture of {lacking} of {}", held_out.len()));
            }
            sets.push(set);
        }
        for (mesh, name) in meshes.iter().zip(&names[views.len()..]) {
            let (shape, found) = draw(held_out, config, mesh, &drawn.join(name))?;
            shapes.insert(name.clone(), shape);
            warnings.extend(found.into_iter().map(|warning| format!("{name}: {warning}")));
            sets.push(pictures_of(held_out, &drawn.join(name))?);
        }
        Ok(Entries { names, sets, shapes, warnings })
    }
}

/// Returns a figure of the whole head, the mean of its views.
fn mean(figures: &Value, key: &str) -> Option<f64> {
    figures["head"]["mean"][key].as_f64()
}

/// Returns a report with the tables of these sets alone.
fn tables(shown: &[ShownSet]) -> Report {
    let all: Vec<(String, Value)> =
        shown.iter().map(|set| (set.title.clone(), means(&set.figures))).collect();
    let columns = [COLUMNS[0], COLUMNS[1], COLUMNS[2], COLUMNS[3], COLUMNS[7]];
    let cells = |(title, figures): &(String, Value)| {
        let head = ["psnr_masked", "ssim_masked", "psnr", "ssim"].map(|key| mean(figures, key));
        (title.clone(), [&head[..], &[figures["mesh"]["triangles"].as_f64()]].concat())
    };
    let meshes = all.iter().filter(|(_, figures)| figures["mesh"].is_object());
    Report {
        table: MethodTable::new(&columns, all.iter().map(cells).collect()),
        quality: quality(&all),
        summaries: meshes.map(|(title, figures)| (title.clone(), leaves(&figures["mesh"]))).collect(),
        ..Report::default()
    }
}

/// Returns the name of a folder or file that none of the others has.
fn unique(path: &Path, names: &[String]) -> String {
    let full = io::real_path(path).unwrap_or(path.into());
    let own = if io::is_folder(path) { full.file_name() } else { full.file_stem() };
    let own = own.unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    let numbered = (2..).map(|n| format!("{own} {n}"));
    [own.clone()].into_iter().chain(numbered).find(|name| !names.contains(name)).unwrap_or(own)
}

/// Returns the pictures in a folder that are named like these views.
fn pictures_of<'c>(views: &[&'c View], folder: &Path) -> Result<Vec<Comparable<'c>>> {
    let picture = |view: &&'c View| {
        let files = ["png", "jpg", "jpeg", "exr"].map(|end| folder.join(format!("{}.{end}", view.name)));
        let file = files.into_iter().find(|file| io::is_file(file))?;
        Some(Comparable { view, file, float: None, own_pose: None })
    };
    let found: Vec<_> = views.iter().filter_map(picture).collect();
    if found.is_empty() {
        let names: Vec<String> = views.iter().take(3).map(|view| format!("`{}.png`", view.name)).collect();
        return Err(Error::cannot(
            format!("`{}` has no picture of a held-out view", folder.display()),
            format!("name them like the photographs: {}", names.join(", ")),
        ));
    }
    Ok(found)
}

/// Writes pictures of a mesh from the cameras of views into a folder, and returns figures of the
/// mesh and its warnings.
fn draw(views: &[&View], config: &Config, mesh: &Path, folder: &Path) -> Result<(Value, Vec<String>)> {
    let opened = open_mesh(mesh)?;
    let mut warnings = opened.warnings();
    let OpenedMesh { head, .. } = opened;
    if head.texture.is_none() && head.mesh.colors.is_empty() {
        warnings.push("the mesh has no colors, so only its missing and extra pixels can be compared".into());
    }
    let HeadMesh { world_from_scene, .. } = head;
    let report = check(&weld(&head.mesh), world_from_scene.scale * config.capture.unit_m);
    let options = RaycastOptions { samples: config.render.samples, world_from_scene };
    let visible = VisibleHead::new(&head);
    let scene_from_world = world_from_scene.inverse();
    for view in views {
        let mut drawn = visible.as_in_viewer(&view.camera.transformed(&scene_from_world), &options);
        if let Some(color) = pictures::background_color(config.render.background) {
            pictures::over(&mut drawn, color);
        }
        pictures::write(folder, &view.name, &drawn, PictureFormat::Png, config.capture.unit_m)?;
    }
    let shape = json!({
        "file": relative(mesh, folder), "triangles": report.triangles, "closed": report.closed, "pieces": report.pieces,
        "boundary_edges": report.boundary_edges, "genus": report.genus,
    });
    Ok((shape, warnings))
}
