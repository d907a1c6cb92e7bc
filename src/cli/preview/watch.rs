//! `tiface preview --watch`: a live page of a running run.

use super::super::Invocation;
use super::super::screen::print;
use super::super::target::RunTarget;
use crate::pipeline::{Stage, field_view};
use crate::report::live_html;
use crate::run::is_run;
use serde_json::json;
use std::collections::HashMap;
use std::path::Path;
use std::time::{Duration, Instant, SystemTime};
use tiface_base::{Error, Result, io};

/// The live page in the run's folder.
const WATCH_FILE: &str = "watch.html";

/// Interval between checks for a stop request: the signal handler ends an idle command after half a
/// second.
const STOP_CHECK: Duration = Duration::from_millis(50);

/// Interval between updates of the live page.
const REFRESH_INTERVAL: Duration = Duration::from_secs(2);

/// Writes the page of a run repeatedly until the process is stopped.
pub(super) fn watch(invocation: &Invocation, path: Option<&Path>) -> Result<()> {
    let (common, stop) = (invocation.common, &invocation.stop);
    let (target, config) = target(invocation, path)?;
    let page = target.run.join(WATCH_FILE);
    if common.dry_run {
        invocation.screen.note("preview", &format!("would keep a page up to date in `{}`", page.display()));
        return Ok(());
    }
    // each view is rendered once per checkpoint, whether or not that can be read
    let mut made: HashMap<Stage, (SystemTime, Option<Vec<u8>>)> = HashMap::new();
    let mut write = |renewed: bool| {
        let mut view = |stage: Stage, saved: SystemTime| -> Option<Vec<u8>> {
            // the last page has to be written before the handler of signals ends the process: it
            // shows what there is
            let known = |(time, _): &&(SystemTime, _)| !renewed || *time == saved;
            if let Some((_, picture)) = made.get(&stage).filter(known) {
                return picture.clone();
            }
            let picture = renewed.then(|| field_view(&target.run, &config, stage))?;
            if let Err(e) = &picture {
                invocation.screen.note("watch", &format!("no view of `{stage}`: {e}"));
            }
            let picture = picture.ok();
            made.insert(stage, (saved, picture.clone()));
            picture
        };
        io::write_atomic(&page, live_html(&target.run, &mut view, renewed)?.as_bytes()).map_err(Error::from)
    };
    write(true)?;
    if common.json {
        print(&format!("{}\n", json!({"event": "watching", "run": target.run, "page": page})))?;
    } else {
        print(&format!("watch     {} (open it in a browser), until Ctrl-C\n", page.display()))?;
    }
    let mut written = Instant::now();
    while stop.requested().is_none() {
        std::thread::sleep(STOP_CHECK);
        if written.elapsed() >= REFRESH_INTERVAL {
            write(true)?;
            written = Instant::now();
        }
    }
    // a stop may come while the page is written, so the last page is written after the loop
    write(false)?;
    Err(stop.error("the page stays as it is"))
}

/// Returns the run to show, and its configuration.
pub(super) fn target(
    invocation: &Invocation,
    path: Option<&Path>,
) -> Result<(RunTarget, crate::config::Config)> {
    let target = RunTarget::find(invocation.common, path)?;
    let Some(saved) = &target.saved else {
        let path = path.unwrap_or(Path::new("."));
        let hint = match is_run(&target.run) {
            true => format!("name its run, `{}`", target.run.display()),
            false if io::is_folder(path) => {
                format!("begin one, `tiface run {}`, then name it", path.display())
            }
            false => {
                "name the folder of a run, or, without `--watch`, a .glb, .gltf, .obj, .ply or .stl file"
                    .into()
            }
        };
        return Err(Error::usage(format!("`{}` is not a run", path.display()), hint));
    };
    if target.guessed {
        invocation.screen.note("run", &format!("using `{}`", target.run.display()));
    }
    let config = invocation.common.resolve(Some(saved), None, &[])?;
    Ok((target, config))
}
