//! `tiface preview --page` and `--watch`: a head to turn in a browser, and the page of a run while it works.

use super::invocation::Invocation;
use super::out::Out;
use super::run::is_demo;
use super::stdout::print;
use super::target::RunTarget;
use crate::io;
use crate::pipeline::{Line, Stage, field_view, head_page, viewer_of_file};
use crate::report::live_html;
use crate::run::Run;
use crate::{Error, Result};
use glam::Vec3;
use serde_json::json;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// Writes the page of a mesh file whose up is `up`, or of the head of a run with its photographs.
pub(super) fn page(
    invocation: &Invocation,
    path: Option<&Path>,
    up: Option<Vec3>,
    asked: Option<&Out>,
) -> Result<()> {
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
                    let line = Line::open(&config, &run)?;
                    head_page(&if is_demo(&config, &run) { line.of_demo() } else { line })
                };
                (name, Box::new(html))
            }
        };
    let file = format!("{name}_preview.html");
    let file = asked.map_or_else(|| PathBuf::from(&file), |out| out.file(&file));
    if common.dry_run {
        screen.note("preview", &format!("would write a page to `{}`", file.display()));
        return Ok(());
    }
    let html = html()?;
    asked.into_iter().try_for_each(Out::prepare)?;
    io::write_atomic(&file, html.as_bytes())?;
    if common.json {
        print(&format!("{}\n", json!({"event": "result", "preview": [file]})))?;
    } else if !common.quiet {
        print(&format!("preview   {} (open it in a browser)\n", file.display()))?;
    }
    Ok(())
}

/// Refuses an axis for a run, which knows where up is.
pub(super) fn no_up(up: Option<Vec3>) -> Result<()> {
    match up {
        Some(_) => Err(Error::usage("`--up` is of files: a run knows where up is", "leave it out")),
        None => Ok(()),
    }
}

/// The page of a run at work, in its folder.
const WATCHED: &str = "watch.html";

/// How often that is written.
const EVERY: Duration = Duration::from_secs(2);

/// Writes the page of a run again and again until somebody stops it.
pub(super) fn watch(invocation: &Invocation, path: Option<&Path>) -> Result<()> {
    let (common, stop) = (invocation.common, &invocation.stop);
    let (target, config) = target(invocation, path)?;
    let page = target.run.join(WATCHED);
    if common.dry_run {
        invocation.screen.note("preview", &format!("would keep a page up to date in `{}`", page.display()));
        return Ok(());
    }
    // each view is made once for a checkpoint, whether or not that can be read
    let mut made: HashMap<Stage, (SystemTime, Option<Vec<u8>>)> = HashMap::new();
    let mut view = |stage: Stage, saved: SystemTime| -> Option<Vec<u8>> {
        if let Some((_, picture)) = made.get(&stage).filter(|(time, _)| *time == saved) {
            return picture.clone();
        }
        let picture = field_view(&target.run, &config, stage);
        if let Err(e) = &picture {
            invocation.screen.note("watch", &format!("no view of `{stage}`: {e}"));
        }
        let picture = picture.ok();
        made.insert(stage, (saved, picture.clone()));
        picture
    };
    let mut write = |renewed| {
        io::write_atomic(&page, live_html(&target.run, &mut view, renewed)?.as_bytes()).map_err(Error::from)
    };
    write(true)?;
    if common.json {
        print(&format!("{}\n", json!({"event": "watching", "run": target.run, "page": page})))?;
    } else {
        print(&format!("watch     {} (open it in a browser), until Ctrl-C\n", page.display()))?;
    }
    while stop.requested().is_none() {
        std::thread::park_timeout(EVERY);
        write(stop.requested().is_none())?;
    }
    Err(stop.error("the page stays as it is"))
}

/// The run that is meant, and its configuration.
fn target(invocation: &Invocation, path: Option<&Path>) -> Result<(RunTarget, crate::config::Config)> {
    let target = RunTarget::find(invocation.common, path)?;
    let Some(saved) = &target.saved else {
        let what = format!("`{}` is no run", path.unwrap_or(Path::new(".")).display());
        return Err(Error::usage(what, "name the folder of a run, or a .glb, .obj or .ply file"));
    };
    if target.guessed {
        invocation.screen.note("run", &format!("using `{}`", target.run.display()));
    }
    let config = invocation.common.resolve(Some(saved), None, &[])?;
    Ok((target, config))
}
