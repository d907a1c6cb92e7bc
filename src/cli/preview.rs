//! `tiface preview`: pictures of a mesh to look at.

use super::invocation::Invocation;
use super::out::Out;
use super::stdout::print;
use super::target::RunTarget;
use crate::config::ViewBackground;
use crate::io;
use crate::pipeline::{Preview, PreviewPicture};
use crate::render::Look;
use crate::{Error, Result};
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use glam::Vec3;
use serde_json::json;
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
    /// Pixels along each side of a picture
    #[arg(long, value_name = "PX", default_value_t = 1024, value_parser = clap::value_parser!(u32).range(16..=8192))]
    size: u32,
    /// black, white or none
    #[arg(long, value_name = "COLOR", default_value = "none")]
    #[arg(value_parser = PossibleValuesParser::new(["black", "white", "none"]).map(|word| background(&word)))]
    background: ViewBackground,
    /// Where up is in a file: x, -x, y, -y, z or -z
    #[arg(long, value_name = "AXIS", default_value = "y", allow_hyphen_values = true)]
    #[arg(value_parser = PossibleValuesParser::new(["x", "-x", "y", "-y", "z", "-z"]).map(|word| axis(&word)))]
    up: Vec3,
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

pub(super) fn run(invocation: &Invocation, options: &PreviewOptions) -> Result<()> {
    let (common, screen) = (invocation.common, &invocation.screen);
    let asked = Out::find(common.out.as_deref(), "preview")?;
    let (preview, name) = open(invocation, options)?;
    preview.warnings.iter().for_each(|w| screen.note("preview: warning", w));
    let look = options.light.unwrap_or(preview.look());
    if look == Look::Uv && !preview.has_uvs() {
        let what = format!("`{name}` has no texture coordinates to show");
        return Err(Error::cannot(what, "choose another --light, or unwrap it"));
    }
    let file = format!("{name}_preview.png");
    let file = asked.as_ref().map_or_else(|| PathBuf::from(&file), |out| out.file(&file));
    if common.dry_run {
        screen.note("preview", &format!("would write a picture to `{}`", file.display()));
        return Ok(());
    }
    if let Some(Out::Folder(folder)) = &asked {
        io::create_folder(folder)?;
    }
    let cameras = preview.around(THREE_QUARTERS.0, THREE_QUARTERS.1, options.size, 1)?;
    let picture = preview.renderer().picture(&cameras[0].camera, look, options.background);
    let PreviewPicture { width, height, rgba } = &picture;
    io::write_png_rgba(&file, *width, *height, rgba)?;
    if common.json {
        print(&format!("{}\n", json!({"event": "result", "preview": [file]})))?;
    } else if !common.quiet {
        print(&format!("preview   {}\n", file.display()))?;
    }
    Ok(())
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
