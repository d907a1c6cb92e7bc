//! `tiface export`: writes the finished mesh of a run again.

use super::Invocation;
use super::flags::KeyFlags;
use super::options::RunTarget;
use super::out::{Out, require_outside, write_head};
use super::screen::print;
use crate::config::{Config, MeshFormat, Stage, key};
use crate::pipeline::KeptHead;
use serde_json::json;
use std::path::{Path, PathBuf};
use tiface_base::{Error, Quiet, Result, io};

/// Writes the mesh of a run with the settings of these options.
pub(super) fn run(invocation: &Invocation, path: Option<&Path>, flags: &KeyFlags) -> Result<()> {
    let (common, screen) = (invocation.common, &invocation.screen);
    let out = Out::find(common.out.as_deref(), "export")?;
    let target = RunTarget::find(common, path)?;
    let Some(saved) = &target.saved else {
        let what = format!("`{}` is not a run", path.unwrap_or(&target.run).display());
        return Err(Error::usage(what, "name the folder of a run"));
    };
    if target.guessed {
        screen.note("run", &format!("using `{}`", target.run.display()));
    }
    let asked = common.resolve(Some(saved), None, &flags.options()?)?;
    let lists_formats = flags.typed(key!(mesh.format)).is_some();
    let files = destinations(out.as_ref(), &target.run, lists_formats, &asked)?;
    // a file of the run may be put back, but not replaced by another
    let (own, others): (Vec<_>, Vec<_>) = files.iter().partition(|file| is_own(file, &target.run));
    others.iter().try_for_each(|(file, _)| require_outside(file, &target.run))?;
    let formats: Vec<MeshFormat> = files.iter().map(|(_, format)| *format).collect();
    let mut head = KeptHead::read(&target.run, &Config::read(saved)?)?.changed(&asked, &formats, &Quiet)?;
    own.iter().try_for_each(|(_, format)| head.require_recorded(*format))?;
    let mut warn = |warning: &str| screen.note("export: warning", warning);
    std::mem::take(&mut head.warnings).iter().for_each(|w| warn(w));
    for (file, _) in &files {
        let (shown, triangles) = (file.display(), head.triangles());
        match (common.dry_run, io::exists(file)) {
            (true, false) => screen.note("export", &format!("would write `{shown}`, {triangles} triangles")),
            (true, true) => screen.note("export", &format!("would replace `{shown}`, {triangles} triangles")),
            (false, true) => screen.note("export", &format!("replaces `{shown}`")),
            (false, false) => {}
        }
    }
    if common.dry_run {
        return Ok(());
    }
    out.iter().try_for_each(Out::prepare)?;
    let mut written = Vec::new();
    for (file, format) in &files {
        written.extend(write_head(file, &head, *format, &mut warn)?);
    }
    if common.json {
        let result =
            json!({"event": "result", "run": target.run, "out": written, "triangles": head.triangles()});
        print(&format!("{result}\n"))?;
    } else if !common.quiet {
        print(&written.iter().map(|file| format!("export    {}\n", file.display())).collect::<String>())?;
    }
    Ok(())
}

/// Returns whether a file is one that the stage `mesh` of the run writes in this format.
fn is_own((file, format): &(PathBuf, MeshFormat), run: &Path) -> bool {
    let folder = file.parent().and_then(|folder| io::real_path(folder).ok());
    let is_there =
        folder.is_some_and(|folder| io::real_path(&run.join(Stage::Mesh)).is_ok_and(|own| own == folder));
    is_there && file.file_name().is_some_and(|name| name == format!("head.{}", format.as_str()).as_str())
}

/// Returns the files to write with their formats: `--out`, files in its folder, or else files in
/// the working directory with the run's name.
fn destinations(
    out: Option<&Out>,
    run: &Path,
    lists_formats: bool,
    asked: &Config,
) -> Result<Vec<(PathBuf, MeshFormat)>> {
    let formats = &asked.mesh.format;
    let named = |folder: &Path, stem: &str| {
        let file = |format: &MeshFormat| (folder.join(format!("{stem}.{}", format.as_str())), *format);
        formats.iter().map(file).collect()
    };
    match out {
        Some(Out::File(file, ending)) => {
            let format =
                ending.parse().ok().filter(|format: &MeshFormat| !lists_formats || formats == &[*format]);
            let format = format.ok_or_else(|| {
                let what =
                    format!("`--out {}` is one .{ending}, and `--format` lists others", file.display());
                Error::usage(what, "leave out `--format`, or end `--out` in `/` for a folder")
            })?;
            Ok(vec![(file.clone(), format)])
        }
        Some(Out::Folder(folder)) => Ok(named(folder, "head")),
        None => {
            let name =
                io::real_path(run).ok().and_then(|run| Some(run.file_name()?.to_string_lossy().into_owned()));
            Ok(named(Path::new(""), &name.unwrap_or_else(|| "head".into())))
        }
    }
}
