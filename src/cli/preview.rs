//! `tiface preview`: pictures of a mesh to look at.

mod terminal;

use super::invocation::Invocation;
use super::out::Out;
use super::stdout::{print, print_as_is};
use super::target::RunTarget;
use super::viewer;
use crate::config::ViewBackground;
use crate::geom::Camera;
use crate::io::{self, Animation};
use crate::pipeline::{Preview, PreviewPicture};
use crate::render::Look;
use crate::{Error, Result};
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use glam::Vec3;
use rayon::prelude::*;
use serde_json::json;
use std::f64::consts::{FRAC_PI_2, PI};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

/// How a preview is made.
#[derive(Args, Debug)]
pub(super) struct PreviewOptions {
    /// A run, or a .glb, .obj or .ply file; without one, the run in this folder, else the newest under runs/
    #[arg(value_name = "RUN|FILE")]
    path: Option<PathBuf>,
    /// studio (lamps), unlit (colors as stored), normals, matcap (clay), uv (a chequer) or wire [default: unlit where
    /// there are colors, else studio]
    #[arg(long, value_name = "LOOK")]
    #[arg(value_parser = PossibleValuesParser::new(Look::ALL.map(Look::word)).map(|word| look(&word)))]
    light: Option<Look>,
    /// Frames all around instead: --out ends in .png (animated), .gif, .mp4 or / (a folder of pictures)
    #[arg(long, conflicts_with_all = ["sheet", "cameras"])]
    turntable: bool,
    /// Frames of a turntable
    #[arg(long, value_name = "N", default_value_t = 36, value_parser = clap::value_parser!(u32).range(2..=3600))]
    frames: u32,
    /// Front, both sides, back, top, wireframe, normals and texture coordinates, on one sheet
    #[arg(long, conflicts_with = "cameras")]
    sheet: bool,
    /// Seen by the cameras of a file (a nerfstudio camera path or a transforms.json), or those of a run's photographs:
    /// train or test
    #[arg(long, value_name = "WHICH")]
    cameras: Option<String>,
    /// Pixels along each side of a picture [default: 1024; 512 of a turntable's or a sheet's; of --cameras their own]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..=8192))]
    size: Option<u32>,
    /// black, white or none
    #[arg(long, value_name = "COLOR", default_value = "none")]
    #[arg(value_parser = PossibleValuesParser::new(["black", "white", "none"]).map(|word| background(&word)))]
    background: ViewBackground,
    /// Where up is in a file: x, -x, y, -y, z or -z
    #[arg(long, value_name = "AXIS", default_value = "y", allow_hyphen_values = true)]
    #[arg(value_parser = PossibleValuesParser::new(["x", "-x", "y", "-y", "z", "-z"]).map(|word| axis(&word)))]
    up: Vec3,
    /// Write a page to turn it in a browser: one file, no program or network needed
    #[arg(long, conflicts_with_all = ["turntable", "sheet", "cameras"])]
    page: bool,
    /// Serve a run on this machine while it works: stages, curves, newest views; until Ctrl-C
    #[arg(long, conflicts_with_all = ["page", "turntable", "sheet", "cameras"])]
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

fn axis(word: &str) -> Vec3 {
    let axis = match word.trim_start_matches('-') {
        "x" => Vec3::X,
        "z" => Vec3::Z,
        _ => Vec3::Y,
    };
    if word.starts_with('-') { -axis } else { axis }
}

/// Where the camera of a single picture stands: so far to the side of the front, and so far above. Radians.
const THREE_QUARTERS: (f64, f64) = (0.6, 0.15);

/// How far a turntable's camera stands above, radians.
const ABOVE: f64 = 0.1;

/// Frames of an animation a second.
const RATE: u16 = 12;

/// The sheet: so far to the side of the front, so far above, and as what; `None` is as the colors are.
const SHEET: [(f64, f64, Option<Look>); 8] = [
    (0.0, 0.0, None),
    (FRAC_PI_2, 0.0, None),
    (-FRAC_PI_2, 0.0, None),
    (PI, 0.0, None),
    (0.0, FRAC_PI_2, None),
    (THREE_QUARTERS.0, THREE_QUARTERS.1, Some(Look::Wire)),
    (THREE_QUARTERS.0, THREE_QUARTERS.1, Some(Look::Normals)),
    (THREE_QUARTERS.0, THREE_QUARTERS.1, Some(Look::Uv)),
];

/// Columns of the sheet.
const COLUMNS: usize = 4;

/// What is made, and its name in `--out`, in the name of a file of its own and in messages.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Picture,
    Sheet,
    Turntable,
    Cameras,
}

impl Kind {
    fn of(options: &PreviewOptions) -> Kind {
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

    /// Where it goes: as asked for, else beside whoever asks.
    fn place(self, asked: Option<Out>, name: &str) -> Out {
        let file = match self {
            Kind::Picture => format!("{name}_preview.png"),
            Kind::Sheet => format!("{name}_sheet.png"),
            Kind::Turntable => format!("{name}_turntable.png"),
            Kind::Cameras => format!("{name}_views/"),
        };
        match asked {
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
        return viewer::watch(invocation, options.path.as_deref());
    }
    if options.page {
        let asked = Out::find(common.out.as_deref(), "page")?;
        return viewer::page(invocation, options.path.as_deref(), options.up, asked.as_ref());
    }
    let kind = Kind::of(options);
    let asked = Out::find(common.out.as_deref(), if kind.is_moving() { "turntable" } else { "preview" })?;
    let (preview, name) = open(invocation, options)?;
    preview.warnings.iter().for_each(|w| screen.note("preview: warning", w));
    let look = options.light.unwrap_or(preview.look());
    if look == Look::Uv && !preview.has_uvs() {
        let what = format!("`{name}` has no texture coordinates to show");
        return Err(Error::cannot(what, "choose another --light, or unwrap it"));
    }
    let (names, shots) = shots(&preview, options, kind, look)?;
    let place = kind.place(asked, &name);
    let (Out::File(shown, _) | Out::Folder(shown)) = &place;
    if common.dry_run {
        let count = shots.len();
        screen.note("preview", &format!("would make pictures, {count} in all, for `{}`", shown.display()));
        return Ok(());
    }
    if let Some(folder) = shown.parent().filter(|f| !f.as_os_str().is_empty()) {
        io::create_folder(folder)?;
    }
    let pictures =
        preview.renderer().pictures(&shots, options.background, || invocation.stop.requested().is_some());
    if invocation.stop.requested().is_some() {
        return Err(invocation.stop.error("nothing was written"));
    }
    let pictures =
        if kind == Kind::Sheet { vec![PreviewPicture::sheet(&pictures, COLUMNS)] } else { pictures };
    write(&place, &names, &pictures)?;
    if common.json {
        print(&format!("{}\n", json!({"event": "result", "preview": shown, "pictures": pictures.len()})))?;
    } else if !common.quiet {
        if std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty()) {
            print_as_is(&terminal::shown(&pictures[0])?)?;
        }
        print(&format!("preview   {}\n", shown.display()))?;
    }
    Ok(())
}

/// What is photographed, by name.
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
        Kind::Turntable => around(0.0, ABOVE, size.unwrap_or(512), options.frames as usize)?,
        Kind::Cameras => {
            preview.cameras(options.cameras.as_deref().unwrap_or_default(), size.unwrap_or(1024))?
        }
        Kind::Sheet => {
            let mut shots = Vec::new();
            for (turn, tilt, own) in SHEET {
                // what has no texture coordinates shows its shape there
                let own = own.map(|l| if l == Look::Uv && !preview.has_uvs() { Look::Matcap } else { l });
                shots.push((
                    around(turn, tilt, size.unwrap_or(512), 1)?.remove(0).camera,
                    own.unwrap_or(look),
                ));
            }
            return Ok((Vec::new(), shots));
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

/// Writes one picture, an animation, or a folder of pictures of these names.
fn write(place: &Out, names: &[String], pictures: &[PreviewPicture]) -> Result<()> {
    let PreviewPicture { width, height, .. } = pictures[0];
    match place {
        Out::File(file, ending) if pictures.len() > 1 || ending != "png" => {
            if pictures.iter().any(|p| (p.width, p.height) != (width, height)) {
                let what = "the pictures of these cameras have several sizes, and an animation has one";
                return Err(Error::cannot(what, "end --out in `/` for a folder of pictures"));
            }
            let frames: Vec<Vec<[u8; 4]>> = pictures.iter().map(|p| p.rgba.clone()).collect();
            io::write_animation(file, ending, &Animation { width, height, frames: &frames, rate: RATE })
        }
        Out::File(file, _) => Ok(io::write_png_rgba(file, width, height, &pictures[0].rgba)?),
        Out::Folder(folder) => names.par_iter().zip(pictures).try_for_each(|(name, picture)| {
            let file = folder.join(format!("{name}.png"));
            io::create_folder(file.parent().unwrap_or(folder))?;
            Ok(io::write_png_rgba(&file, picture.width, picture.height, &picture.rgba)?)
        }),
    }
}

/// What is shown, and what it is called.
fn open(invocation: &Invocation, options: &PreviewOptions) -> Result<(Preview, String)> {
    let named = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    match options.path.as_deref().filter(|path| !io::is_folder(path)) {
        Some(file) => Ok((Preview::of_file(file, options.up)?, named(file))),
        None => {
            let target = RunTarget::find(invocation.common, options.path.as_deref())?;
            if target.guessed {
                invocation.screen.note("run", &format!("using `{}`", target.run.display()));
            }
            let name = io::real_path(&target.run).map_or_else(|_| "run".into(), |run| named(&run));
            Ok((Preview::of_run(&target.run)?, name))
        }
    }
}
