//! `tiface check`: validates a mesh, and measures its distance to another.

use super::options::Common;
use super::screen::{one_line, print};
use crate::config::{SETTINGS_FILE, Stage};
use crate::metrics::distance::{Distances, kinds_one_way, one_way, seen_one_way};
use crate::metrics::{Masks, Tones};
use crate::pipeline::open_capture;
use crate::run::{Fault, ProductState, is_run, read_record};
use glam::DVec3;
use serde::Serialize;
use std::fmt::{self, Display};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use tiface_base::geom::{Bvh, Camera, Mesh};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, ErrorKind, Result};
use tiface_capture::{CaptureOptions, Split, View};
use tiface_surface::files::{
    CheckReport, OpenedMesh, ReadMesh, check_around, open_mesh, open_surface, uv_check, weld,
};

/// Points sampled on each surface.
const SURFACE_SAMPLES: usize = 200_000;

/// Distances between the mesh and another surface, millimeters.
#[derive(Serialize)]
struct Against {
    /// From every part of the mesh, caps included.
    whole: Millimeters,
    /// From the part that three or more training cameras see, and its share of the area.
    #[serde(skip_serializing_if = "Option::is_none")]
    seen: Option<(Millimeters, f64)>,
    /// From the parts seen by each number of training cameras, and their shares of the area.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    by_views: Vec<ByViews>,
    /// From the other surface to the mesh: what the mesh misses.
    back: Millimeters,
    /// ... and back from its skin and its hair where three or more training cameras look, with the
    /// signed median (negative where the mesh is inside); only for photographs that separate the
    /// two.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    parts: Vec<PartDistance>,
}

#[derive(Serialize)]
struct PartDistance {
    part: &'static str,
    signed_median: f64,
    #[serde(flatten)]
    distance: Millimeters,
}

/// The parts of a surface by how many cameras see them.
const VIEW_COUNTS: [(&str, RangeInclusive<u32>); 5] =
    [("0", 0..=0), ("1", 1..=1), ("2", 2..=2), ("3 or 4", 3..=4), ("5 or more", 5..=u32::MAX)];

#[derive(Serialize)]
struct ByViews {
    views: &'static str,
    share: f64,
    #[serde(flatten)]
    distance: Millimeters,
}

#[derive(Serialize)]
struct Millimeters {
    mean: f64,
    median: f64,
    p90: f64,
    max: f64,
}

impl Millimeters {
    fn new(d: Distances, unit_m: f64) -> Millimeters {
        let mm = |v: f64| 1e3 * unit_m * v;
        Millimeters { mean: mm(d.mean), median: mm(d.median), p90: mm(d.p90), max: mm(d.max) }
    }
}

impl Display for Millimeters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Millimeters { mean, median, p90, max } = self;
        write!(f, "mean {mean:.3}, median {median:.3}, 90 % below {p90:.3}, worst {max:.2} mm")
    }
}

impl Display for Against {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "distance to the other   {}", self.whole)?;
        if let Some((seen, share)) = &self.seen {
            writeln!(f, "  where 3 cameras look  {seen} ({:.0} % of the area)", 100.0 * share)?;
        }
        for ByViews { views, share, distance } in &self.by_views {
            writeln!(f, "  seen by {views:<9}     {distance} ({:.0} %)", 100.0 * share)?;
        }
        writeln!(f, "distance back           {}", self.back)?;
        for PartDistance { part, signed_median, distance } in &self.parts {
            writeln!(f, "  {part}, 3 cameras look  {distance}, signed median {signed_median:+.3} mm")?;
        }
        Ok(())
    }
}

#[derive(Serialize)]
struct CheckJson<'a> {
    #[serde(flatten)]
    report: &'a CheckReport,
    /// Why the texture that the file names is not shown.
    #[serde(skip_serializing_if = "Option::is_none")]
    texture_problem: Option<&'a str>,
    /// Values that were read otherwise than they are written, or left out.
    #[serde(skip_serializing_if = "<[String]>::is_empty")]
    notes: &'a [String],
    #[serde(skip_serializing_if = "Option::is_none")]
    against: Option<&'a Against>,
}

/// Returns the file itself, or the mesh of a run: the extracted surface, which lies in the
/// dataset's world, if it is compared with another, and else the exported head; and the error if it
/// is not the one that the run recorded.
fn mesh_of(path: &Path, is_compared: bool) -> Result<(PathBuf, Option<Error>)> {
    if !is_run(path) && io::is_folder(path) {
        let text = format!("`{}` is a folder, but not that of a run", path.display());
        return Err(Error::cannot(
            text,
            "name a .glb, .gltf, .obj, .ply or .stl file, or the folder of a run",
        ));
    }
    if !is_run(path) {
        return Ok((path.into(), None));
    }
    let folder = path.join(Stage::Mesh);
    let heads = ["head.glb", "head.obj", "head.ply"];
    let names: Vec<&str> = is_compared.then_some("surface.ply").into_iter().chain(heads).collect();
    if let Some(record) = read_record(&folder)?
        && let Some(name) = names.iter().find(|name| record.products.contains_key(**name))
    {
        let fault = record.verify(&folder, name)?;
        let error = |fault: &Fault| record.error(fault).with_kind(ErrorKind::BelowBar);
        return match fault {
            Some(gone) if gone.state == ProductState::Gone => Err(record.error(&gone)),
            other => Ok((folder.join(name), other.as_ref().map(error))),
        };
    }
    let file =
        names.iter().map(|name| folder.join(name)).find(|file| io::is_file(file)).ok_or_else(|| {
            let run = path.display();
            if io::is_file(&folder.join("head.usdz")) {
                let what = format!("`{run}` has its mesh as .usdz alone, which is not read");
                return Error::cannot(what, format!("write a GLB: `tiface export {run} --out head.glb`"));
            }
            Error::cannot(format!("`{run}` has no exported mesh"), format!("`tiface run {run}` makes it"))
        })?;
    Ok((file, None))
}

/// Side assumed for a texture of unknown size, texels.
const DEFAULT_TEXTURE_PX: u32 = 1024;

pub(super) fn run(
    common: &Common,
    path: &Path,
    require: &[String],
    against: Option<&Path>,
    seen_by: Option<&Path>,
) -> Result<()> {
    let config = common.resolve(None, None, &[])?;
    let (path, fault) = mesh_of(path, against.is_some())?;
    let path = &path;
    // a file that is not the run's is not mended as other files are
    let opened = match (open_mesh(path), &fault) {
        (Err(_), Some(fault)) => return Err(fault.clone()),
        (opened, _) => opened?,
    };
    let OpenedMesh { head, bare_atlas, texture_problem: problem, notes, .. } = opened;
    let (mesh, origin, unit_m) = (head.mesh, head.world_from_scene.translation, config.capture.unit_m);
    let mut report = check_around(&mesh, origin, unit_m);
    report.has_texture = Some(head.texture.is_some());
    report.uv = head.texture.map(|texture| texture.atlas).or(bare_atlas).map(|mut atlas| {
        if atlas.width == 0 || atlas.height == 0 {
            (atlas.width, atlas.height) = (DEFAULT_TEXTURE_PX, DEFAULT_TEXTURE_PX);
        }
        uv_check(&weld(&mesh), &atlas)
    });
    let requirements: Vec<&str> = require.iter().map(String::as_str).collect();
    let passed = report.require(&requirements).map_err(|e| match e.kind() {
        ErrorKind::BelowBar => e.with_hint("`tiface check` without `--require` prints the whole report"),
        _ => e,
    });
    if let Err(e) = &passed
        && e.kind() == ErrorKind::Usage
    {
        return passed;
    }
    let against = against.map(|other| compare(&mesh, origin, other, seen_by, unit_m)).transpose()?;
    let text = if common.json {
        let whole = CheckJson {
            report: &report,
            texture_problem: problem.as_deref(),
            notes: &notes,
            against: against.as_ref(),
        };
        format!("{}\n", serde_json::to_string(&whole).unwrap_or_default())
    } else {
        let problem = problem.map(|e| format!("texture              NOT SHOWN: {}\n", one_line(&e)));
        let notes = notes.iter().map(|note| format!("note                 {}\n", one_line(note)));
        let said: String = problem.into_iter().chain(notes).collect();
        let uv = report.uv.as_ref().map_or(String::new(), |uv| format!("\ntexture\n{uv}"));
        format!("{report}{said}{uv}\n{}", against.map(|a| a.to_string()).unwrap_or_default())
    };
    print(&text)?;
    passed.and(fault.map_or(Ok(()), Err))
}

fn compare(mesh: &Mesh, origin: DVec3, other: &Path, seen_by: Option<&Path>, unit_m: f64) -> Result<Against> {
    let ReadMesh { mesh: mut truth, origin: elsewhere, .. } = open_surface(other)?;
    // both around one origin
    let way = elsewhere - origin;
    truth.positions.iter_mut().for_each(|p| *p = (p.as_dvec3() + way).as_vec3());
    let empty = |e: &Path| Error::cannot(format!("`{}` has no surface to measure", e.display()), "");
    let bvh = Bvh::new(&truth);
    let mm = |d| Millimeters::new(d, unit_m);
    let whole = one_way(mesh, &bvh, SURFACE_SAMPLES).ok_or_else(|| empty(other))?;
    let back = one_way(&truth, &Bvh::new(mesh), SURFACE_SAMPLES).ok_or_else(|| empty(other))?;
    let (mut seen, mut by_views, mut parts) = (None, Vec::new(), Vec::new());
    if let Some(root) = seen_by {
        let capture =
            open_capture(root, &CaptureOptions { result_file: SETTINGS_FILE, ..CaptureOptions::default() })?;
        let moved = |c: &Camera| Camera { position: c.position - origin, ..c.clone() };
        let views: Vec<&View> = capture.split(Split::Train).collect();
        let cameras: Vec<Camera> = views.iter().map(|v| moved(&v.camera)).collect();
        let ranges: Vec<_> = [3..=u32::MAX].into_iter().chain(VIEW_COUNTS.map(|(_, range)| range)).collect();
        let mut found = seen_one_way(mesh, &bvh, SURFACE_SAMPLES, &cameras, &ranges).into_iter();
        seen = found.next().flatten().map(|(d, share)| (mm(d), share));
        let named = found.zip(VIEW_COUNTS).filter_map(|(part, (views, _))| Some((part?, views)));
        by_views = named.map(|((d, share), views)| ByViews { views, share, distance: mm(d) }).collect();
        let kinds = skin_and_hair(&views)?;
        if !kinds.is_empty() {
            let kind = |i: usize, [x, y]: [u32; 2]| {
                kinds[i].get(y as usize * cameras[i].width as usize + x as usize).copied().flatten()
            };
            let found = kinds_one_way(&truth, &Bvh::new(mesh), SURFACE_SAMPLES, &cameras, kind);
            let named = found.into_iter().zip(["skin", "hair"]).filter_map(|(d, part)| Some((d?, part)));
            let part = |((d, signed), part)| PartDistance {
                part,
                signed_median: 1e3 * unit_m * signed,
                distance: mm(d),
            };
            parts = named.map(part).collect();
        }
    }
    Ok(Against { whole: mm(whole), seen, by_views, back: mm(back), parts })
}

/// Returns skin (0) and hair (1) of each photograph's pixels, row by row. Empty if the capture does
/// not separate them.
fn skin_and_hair(views: &[&View]) -> Result<Vec<Vec<Option<usize>>>> {
    // only photographs with region masks are read
    let able = views.iter().any(|v| v.region.is_some());
    let Some(tones) = able.then(|| Tones::learn(views)).transpose()?.flatten() else { return Ok(Vec::new()) };
    let kinds = |view: &&View| -> Result<Vec<Option<usize>>> {
        let loaded = view.load(&Limits::default())?;
        let split = Masks::of(&loaded).and_then(|masks| tones.split(&loaded.photo, masks));
        let kind = |(skin, hair): (&bool, &bool)| skin.then_some(0).or(hair.then_some(1));
        Ok(split.map_or(Vec::new(), |(skin, hair)| skin.iter().zip(&hair).map(kind).collect()))
    };
    views.iter().map(kinds).collect()
}
