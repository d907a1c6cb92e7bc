//! `tiface preview`: pictures of a mesh, one by one or on a sheet whose rows are named in the
//! answer; `--page`: a viewer for the browser.

mod watch;

use super::Invocation;
use super::out::Out;
use super::screen::print;
use super::target::RunTarget;
use crate::config::ViewBackground;
use crate::pipeline::{Preview, PreviewPicture, Session, head_page, viewer_of_file};
use crate::run::Run;
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use glam::Vec3;
use rayon::prelude::*;
use serde_json::json;
use std::f64::consts::{FRAC_PI_2, PI};
use std::path::{Path, PathBuf};
use tiface_base::geom::Camera;
use tiface_base::io::{self, Animation};
use tiface_base::{Error, Result};
use tiface_surface::render::Look;
use watch::{target, watch};

/// Options of `tiface preview`.
#[derive(Args, Debug)]
pub(super) struct PreviewOptions {
    /// Run, or .glb, .gltf, .obj, .ply or .stl file [default: the run in this folder, else the
    /// newest under runs/]
    #[arg(value_name = "RUN|FILE")]
    path: Option<PathBuf>,
    /// Shading: studio (lamps), unlit (colors as stored), normals, matcap (clay), uv
    /// (checkerboard), wire or seen (number of cameras) [default: unlit if the mesh has colors,
    /// else studio]
    #[arg(long, value_name = "LOOK")]
    #[arg(value_parser = PossibleValuesParser::new(Look::ALL.map(Look::word)).map(|word| look(&word)))]
    light: Option<Look>,
    /// Render a turntable: --out ends in .png (animated), .gif or / (a folder of pictures)
    #[arg(long, conflicts_with_all = ["sheet", "cameras"])]
    turntable: bool,
    /// Number of frames of a turntable
    #[arg(long, value_name = "N", default_value_t = 36, value_parser = clap::value_parser!(u32).range(2..=3600))]
    #[arg(requires = "turntable")]
    frames: u32,
    /// Render front, sides, back, top, wireframe, normals and texture coordinates on one sheet; for
    /// a run also a held-out photograph and the error against it
    #[arg(long, conflicts_with = "cameras")]
    sheet: bool,
    /// Render from the cameras of a file (a nerfstudio camera path or a transforms.json), or from
    /// those of a run's photographs: train or test
    #[arg(long, value_name = "WHICH")]
    cameras: Option<String>,
    /// Side of each picture, pixels [default: 1024; turntable and sheet: 512; --cameras: their own
    /// size]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..=8192))]
    size: Option<u32>,
    /// Background: black, white or none
    #[arg(long, value_name = "COLOR", default_value = "none")]
    #[arg(value_parser = PossibleValuesParser::new(["black", "white", "none"]).map(|word| background(&word)))]
    background: ViewBackground,
    /// Up axis of a mesh file: x, -x, y, -y, z or -z [default: y]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    #[arg(value_parser = PossibleValuesParser::new(AXES).map(|word| axis(&word)))]
    up: Option<Vec3>,
    /// Write a self-contained page that shows the mesh in a browser
    #[arg(long, conflicts_with_all = ["turntable", "sheet", "cameras", "light", "size", "background", "frames"])]
    page: bool,
    /// Update RUN/watch.html while the run works, until Ctrl-C: stages, curves, newest views
    #[arg(long, conflicts_with_all = ["turntable", "sheet", "cameras", "light", "size", "background", "frames"])]
    #[arg(conflicts_with_all = ["page", "up"])]
    watch: bool,
}

fn look(word: &str) -> Look {
    Look::ALL.into_iter().find(|l| l.word() == word).unwrap_or(Look::Unlit)
}

fn background(word: &str) -> ViewBackground {
    match word {
        "black" => ViewBackground::Black,
        "white" => ViewBackground::White,
        _ => ViewBackground::None,
    }
}

/// The words of `--up`.
pub(super) const AXES: [&str; 6] = ["x", "-x", "y", "-y", "z", "-z"];

/// Returns the direction that a word of [`AXES`] names.
pub(super) fn axis(word: &str) -> Vec3 {
    let axis = match word.trim_start_matches('-') {
        "x" => Vec3::X,
        "z" => Vec3::Z,
        _ => Vec3::Y,
    };
    if word.starts_with('-') { -axis } else { axis }
}

/// Azimuth from the front and elevation of the camera of a single picture, radians.
const THREE_QUARTERS: (f64, f64) = (0.6, 0.15);

/// Elevation of a turntable's camera, radians.
const TURNTABLE_ELEVATION: f64 = 0.1;

/// Frame rate of animations.
const FRAMES_PER_SECOND: u16 = 12;

/// Pictures of the sheet: name, azimuth from the front, elevation, shading; `None` is the default
/// shading.
const SHEET_VIEWS: [(&str, f64, f64, Option<Look>); 8] = [
    ("front", 0.0, 0.0, None),
    ("left", FRAC_PI_2, 0.0, None),
    ("right", -FRAC_PI_2, 0.0, None),
    ("back", PI, 0.0, None),
    ("top", 0.0, FRAC_PI_2, None),
    ("wireframe", THREE_QUARTERS.0, THREE_QUARTERS.1, Some(Look::Wire)),
    ("normals", THREE_QUARTERS.0, THREE_QUARTERS.1, Some(Look::Normals)),
    ("texture coordinates", THREE_QUARTERS.0, THREE_QUARTERS.1, Some(Look::Uv)),
];

/// Maximum side of a picture on a sheet, pixels: all of them are in memory at once.
const MAX_SHEET_PX: u32 = 2048;

/// Columns of the sheet; one more with a photograph and the errors against it.
const SHEET_COLUMNS: usize = 4;

/// Pixels of the pictures rendered at a time: 1 GiB as floats.
const BATCH_PX: u64 = 1 << 25;

/// The kind of output, and its name in `--out`, in file names and in messages.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Picture,
    Sheet,
    Turntable,
    Cameras,
}

impl Kind {
    fn from_options(options: &PreviewOptions) -> Kind {
        match (options.turntable, options.sheet, &options.cameras) {
            (true, ..) => Kind::Turntable,
            (_, true, _) => Kind::Sheet,
            (.., Some(_)) => Kind::Cameras,
            _ => Kind::Picture,
        }
    }

    fn is_moving(self) -> bool {
        matches!(self, Kind::Turntable | Kind::Cameras)
    }

    /// Returns the output file: from `--out`, or else in the working directory.
    fn destination(self, out: Option<Out>, name: &str) -> Out {
        let file = match self {
            Kind::Picture => format!("{name}_preview.png"),
            Kind::Sheet => format!("{name}_sheet.png"),
            Kind::Turntable => format!("{name}_turntable.png"),
            Kind::Cameras => format!("{name}_views/"),
        };
        match out {
            Some(Out::Folder(folder)) if !self.is_moving() => Out::File(folder.join(file), "png".into()),
            Some(out) => out,
            None if self == Kind::Cameras => Out::Folder(file.into()),
            None => Out::File(file.into(), "png".into()),
        }
    }
}

pub(super) fn run(invocation: &Invocation, options: &PreviewOptions) -> Result<()> {
    let (common, screen) = (invocation.common, &invocation.screen);
    if options.watch {
        Out::none(common.out.as_deref(), "preview --watch")?;
        return watch(invocation, options.path.as_deref());
    }
    if options.page {
        let out = Out::find(common.out.as_deref(), "page")?;
        return page(invocation, options.path.as_deref(), options.up, out.as_ref());
    }
    let kind = Kind::from_options(options);
    if kind == Kind::Sheet && options.size.is_some_and(|size| size > MAX_SHEET_PX) {
        let what = format!("`--size` of a picture on a sheet is at most {MAX_SHEET_PX}");
        return Err(Error::usage(what, "render larger pictures one by one"));
    }
    let out = Out::find(common.out.as_deref(), if kind.is_moving() { "turntable" } else { "preview" })?;
    let (preview, name) = open(invocation, options)?;
    preview.warnings.iter().for_each(|w| screen.note("preview: warning", w));
    let look = options.light.unwrap_or(preview.look());
    if look == Look::Uv && !preview.has_uvs() {
        let what = format!("`{name}` has no texture coordinates to show");
        return Err(Error::cannot(what, "choose another --light, or add texture coordinates"));
    }
    if look == Look::Seen && !preview.knows_cameras() {
        let what = format!("`{name}` does not say how many cameras see it");
        return Err(Error::cannot(what, "choose another --light; `tiface mesh` writes it into a run's mesh"));
    }
    let (names, shots) = shots(&preview, options, kind, look)?;
    let destination = kind.destination(out, &name);
    let (Out::File(shown, _) | Out::Folder(shown)) = &destination;
    if common.dry_run {
        let count = shots.len();
        screen.note("preview", &format!("would render {count} pictures for `{}`", shown.display()));
        return Ok(());
    }
    destination.prepare()?;
    let made = make(&preview, &destination, kind, &names, &shots, options.background, invocation)?;
    if common.json {
        let mut result = json!({"event": "result", "preview": made.files, "warnings": preview.warnings});
        if !made.rows.is_empty() {
            result["rows"] = json!(made.rows);
        }
        print(&format!("{result}\n"))?;
    } else if !common.quiet {
        print(&format!("preview   {}\n", shown.display()))?;
        for (number, row) in (1..).zip(&made.rows) {
            print(&format!("row {number}     {}\n", row.join(", ")))?;
        }
    }
    Ok(())
}

/// What was written.
struct Made {
    files: Vec<PathBuf>,
    /// Names of the pictures of a sheet, row by row; empty for other pictures.
    rows: Vec<Vec<String>>,
}

/// Renders the pictures in batches and writes one picture, a sheet, an animation, or a folder of
/// pictures of these names.
fn make(
    preview: &Preview,
    place: &Out,
    kind: Kind,
    names: &[String],
    shots: &[(Camera, Look)],
    background: ViewBackground,
    invocation: &Invocation,
) -> Result<Made> {
    let is_stopped = || invocation.stop.requested().is_some();
    let renderer = preview.renderer();
    let size = |(camera, _): &(Camera, Look)| (camera.width, camera.height);
    let (width, height) = size(&shots[0]);
    let largest = shots.iter().map(size).map(|(w, h)| u64::from(w) * u64::from(h)).max().unwrap_or(1);
    let some = |shots: &[(Camera, Look)]| {
        let pictures = renderer.pictures(shots, background, is_stopped);
        if is_stopped() {
            return Err(invocation.stop.error("nothing was finished"));
        }
        Ok(pictures)
    };
    let at_once = (BATCH_PX / largest.max(1)).clamp(1, 32) as usize;
    match place {
        Out::File(file, _) if kind == Kind::Sheet => {
            let (mut pictures, mut names, mut columns) = (some(shots)?, names.to_vec(), SHEET_COLUMNS);
            match renderer.against_photograph(width) {
                Ok(Some(more)) => {
                    pictures.extend(more);
                    names.extend(["photograph", "error"].map(String::from));
                    columns += 1;
                }
                Ok(None) => {}
                Err(e) => invocation.screen.note("preview", &format!("no errors against a photograph: {e}")),
            }
            let sheet = PreviewPicture::sheet(&pictures, columns);
            io::write_png_rgba(file, sheet.width, sheet.height, &sheet.rgba)?;
            let rows = names.chunks(columns).map(<[String]>::to_vec).collect();
            Ok(Made { files: vec![file.clone()], rows })
        }
        Out::File(file, ending) if shots.len() > 1 || ending != "png" => {
            if shots.iter().any(|shot| size(shot) != (width, height)) {
                let what = "the pictures of these cameras have several sizes, and an animation has one";
                return Err(Error::cannot(what, "end --out in `/` for a folder of pictures"));
            }
            let mut frames = shots.chunks(at_once).flat_map(|shots| match some(shots) {
                Ok(pictures) => pictures.into_iter().map(|p| Ok(p.rgba)).collect(),
                Err(e) => vec![Err(e)],
            });
            let animation = Animation { width, height, count: shots.len() as u32, rate: FRAMES_PER_SECOND };
            io::write_animation(file, ending, &animation, &mut frames)?;
            Ok(Made { files: vec![file.clone()], rows: Vec::new() })
        }
        Out::File(file, _) => {
            let picture = some(shots)?.swap_remove(0);
            io::write_png_rgba(file, width, height, &picture.rgba)?;
            Ok(Made { files: vec![file.clone()], rows: Vec::new() })
        }
        Out::Folder(folder) => {
            let files: Vec<PathBuf> = names.iter().map(|name| folder.join(format!("{name}.png"))).collect();
            for (files, shots) in files.chunks(at_once).zip(shots.chunks(at_once)) {
                let pictures = some(shots)?;
                files.par_iter().zip(&pictures).try_for_each(|(file, picture)| {
                    io::create_folder(file.parent().unwrap_or(folder))?;
                    io::write_png_rgba(file, picture.width, picture.height, &picture.rgba)
                })?;
            }
            Ok(Made { files, rows: Vec::new() })
        }
    }
}

/// Views to render, by name.
fn shots(
    preview: &Preview,
    options: &PreviewOptions,
    kind: Kind,
    look: Look,
) -> Result<(Vec<String>, Vec<(Camera, Look)>)> {
    let size = options.size;
    let around = |turn, tilt, side: u32, count| preview.around(turn, tilt, side, count);
    let cameras = match kind {
        Kind::Picture => around(THREE_QUARTERS.0, THREE_QUARTERS.1, size.unwrap_or(1024), 1)?,
        Kind::Turntable => around(0.0, TURNTABLE_ELEVATION, size.unwrap_or(512), options.frames as usize)?,
        Kind::Cameras => {
            preview.cameras(options.cameras.as_deref().unwrap_or_default(), size.unwrap_or(1024))?
        }
        Kind::Sheet => {
            let (mut names, mut shots) = (Vec::new(), Vec::new());
            for (name, turn, tilt, own) in SHEET_VIEWS {
                // a mesh without texture coordinates shows its shape instead
                let is_shape = own == Some(Look::Uv) && !preview.has_uvs();
                let own = if is_shape { Look::Matcap } else { own.unwrap_or(look) };
                shots.push((around(turn, tilt, size.unwrap_or(512), 1)?.remove(0).camera, own));
                names.push(if is_shape { "shape" } else { name }.to_string());
            }
            return Ok((names, shots));
        }
    };
    let fitted = |c: &Camera| match size.filter(|_| kind == Kind::Cameras) {
        None => c.clone(),
        Some(size) => {
            let share = f64::from(size) / f64::from(c.width.max(c.height));
            let side = |side: u32| (f64::from(side) * share).round().max(1.0) as u32;
            c.resized(side(c.width), side(c.height))
        }
    };
    let shots = cameras.iter().map(|c| (fitted(&c.camera), look)).collect();
    Ok((cameras.into_iter().map(|c| c.name).collect(), shots))
}

/// Opens the mesh to show; returns it with its name.
fn open(invocation: &Invocation, options: &PreviewOptions) -> Result<(Preview, String)> {
    let named = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    match options.path.as_deref().filter(|path| !io::is_folder(path)) {
        Some(file) => Ok((Preview::of_file(file, options.up.unwrap_or(Vec3::Y))?, named(file))),
        None => {
            no_up(options.up)?;
            let target = RunTarget::find(invocation.common, options.path.as_deref())?;
            if target.guessed {
                invocation.screen.note("run", &format!("using `{}`", target.run.display()));
            }
            let name = io::real_path(&target.run).map_or_else(|_| "run".into(), |run| named(&run));
            Ok((Preview::of_run(&target.run)?, name))
        }
    }
}

/// Writes the page of a mesh file with the up axis `up`, or of a run's head with its photographs.
fn page(invocation: &Invocation, path: Option<&Path>, up: Option<Vec3>, out: Option<&Out>) -> Result<()> {
    let (common, screen) = (invocation.common, &invocation.screen);
    let named = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let (name, html): (String, Box<dyn FnOnce() -> Result<String>>) =
        match path.filter(|path| !io::is_folder(path)) {
            Some(file) => {
                let html = move || {
                    let (html, warnings) = viewer_of_file(file, up.unwrap_or(Vec3::Y))?;
                    warnings.iter().for_each(|w| screen.note("preview: warning", w));
                    Ok(html)
                };
                (named(file), Box::new(html))
            }
            None => {
                no_up(up)?;
                let (target, config) = target(invocation, path)?;
                let name = io::real_path(&target.run).map_or_else(|_| "run".into(), |run| named(&run));
                let html = move || {
                    let run = Run::open(&target.run, invocation.stop.clone(), screen.clone());
                    head_page(&Session::open(&config, &run)?)
                };
                (name, Box::new(html))
            }
        };
    let file = format!("{name}_preview.html");
    let file = out.map_or_else(|| PathBuf::from(&file), |out| out.file(&file));
    if common.dry_run {
        screen.note("preview", &format!("would write a page to `{}`", file.display()));
        return Ok(());
    }
    let html = html()?;
    out.into_iter().try_for_each(Out::prepare)?;
    io::write_atomic(&file, html.as_bytes())?;
    if common.json {
        print(&format!("{}\n", json!({"event": "result", "preview": [file]})))?;
    } else if !common.quiet {
        print(&format!("preview   {} (open it in a browser)\n", file.display()))?;
    }
    Ok(())
}

/// Refuses an up axis for a run, which has its own.
pub(super) fn no_up(up: Option<Vec3>) -> Result<()> {
    match up {
        Some(_) => {
            Err(Error::usage("`--up` applies to mesh files; a run has its own up axis", "leave it out"))
        }
        None => Ok(()),
    }
}
