//! `tiface run` and the commands of single stages: the line, up to a stage.

use super::bar::Bar;
use super::invocation::Invocation;
use super::options::{Common, KeyOption};
use super::out::Out;
use super::stdout::print;
use super::summary::summary;
use super::target::{DEMO_CAPTURE, RunTarget};
use crate::config::{Config, Preset, RenderConfig};
use crate::io;
use crate::pipeline::{Line, Stage, reconstruct};
use crate::report::duration;
use crate::run::{Cost, Phase, Run, Standing};
use crate::{Error, ErrorKind, Result};
use serde_json::{Map, Value, json};
use std::path::Path;

/// A command that works on the line.
pub(super) struct LineCommand<'a> {
    /// What it makes: `run` (all there is), or the stage.
    pub product: &'static str,
    /// The last stage that it needs.
    pub until: Stage,
    /// What it works on.
    pub target: RunTarget,
    /// Bars that the result must reach.
    pub require: &'a [String],
    /// Its own options that are keys of the configuration.
    pub keys: Vec<KeyOption>,
    /// The preset where nothing names one, and settings on top of it, as TOML.
    pub fallback: Option<(Preset, &'static str)>,
}

/// Completes the stages that a command needs, and puts its product where it was asked for.
pub(super) fn run(invocation: &Invocation, command: &LineCommand) -> Result<()> {
    let Invocation { common, screen, stop } = invocation;
    let LineCommand { product, until, target, require, .. } = command;
    let out = Out::find(common.out.as_deref(), product)?;
    if target.guessed {
        screen.note("run", &format!("using `{}`", target.run.display()));
    }
    let mut config = configure(common, command)?;
    // views of a path are made as asked for here; what the evaluation shows stays as it was
    let path = (*until == Stage::Render && config.render.cameras != "test").then(|| config.render.clone());
    if path.is_some() {
        config.render = evaluation(common, target)?;
    }
    let bars = require.iter().map(|r| Bar::parse(r)).collect::<Result<Vec<_>>>()?;
    let run = Run::open(&target.run, stop.clone(), screen.clone());
    let line = ready(common, command, &config, &run, path, out.as_ref()).inspect_err(|e| {
        // who runs many heads looks for what went wrong in their folders, not in logs; a run that is done stays as it is,
        // what was asked for otherwise than before is no fault of one that has begun, and a wrong command makes no folder
        let is_named = io::is_folder(run.dir()) || common.run.is_some() && e.kind() == ErrorKind::Cannot;
        let tells = match (e.kind(), begun_with(&run)) {
            (ErrorKind::Cannot | ErrorKind::Usage, None) => true,
            (ErrorKind::Cannot, Some(before)) => {
                common.fresh.is_none()
                    && before == but_for_device(&config.to_toml())
                    && Standing::read(run.dir()).phase != Phase::Done
            }
            _ => false,
        };
        if is_named && tells && !common.dry_run {
            run.failed(e);
        }
    })?;
    if common.dry_run {
        print(&outlook(&line, *until, common)?)?;
        return line.require(*until, common.fresh).map(|_| ());
    }
    run.not_failed();
    screen.expect(line.ahead(*until).into_iter().map(|(stage, cost)| (stage, cost.seconds())).collect());
    let done = reconstruct(&line, *until)?;
    let written = out.map(|out| out.write(product, &line, &run)).transpose()?.unwrap_or_default();
    if common.json {
        let stages: Map<String, Value> =
            done.iter().map(|(s, d)| (s.to_string(), d.summary.clone())).collect();
        let result = json!({"event": "result", "run": run.dir(), "out": written, "stages": stages});
        print(&format!("{result}\n"))?;
    } else if !common.quiet {
        print(&summary(&run, line.views(), &done, &written))?;
    }
    bars.iter().try_for_each(|bar| bar.check(&done))
}

/// The settings that a run was last worked on with, as text; none if it has not begun.
fn begun_with(run: &Run) -> Option<String> {
    let bytes = io::read_bytes(&run.path("config.toml"), &io::Limits::default()).ok()?;
    Some(but_for_device(&String::from_utf8_lossy(&bytes)))
}

/// Stages of one run may be made on several devices.
fn but_for_device(settings: &str) -> String {
    settings.lines().filter(|line| !line.starts_with("device = ")).map(|line| format!("{line}\n")).collect()
}

/// The line, opened; all that can be refused before the first stage is refused here.
fn ready<'a>(
    common: &Common,
    command: &LineCommand,
    config: &'a Config,
    run: &'a Run,
    path: Option<RenderConfig>,
    out: Option<&Out>,
) -> Result<Line<'a>> {
    let mut line = Line::open(config, run)?;
    if is_demo(config, run) {
        line = line.of_demo();
    }
    if let Some(path) = path {
        line = line.along(path)?;
    }
    if let Some(out) = out {
        out.check(run.dir(), &line.order(command.until))?;
    }
    if !common.dry_run {
        if let Some(fresh) = common.fresh {
            line.fresh(fresh, command.until)?;
        }
        line.remember(command.until)?;
    }
    Ok(line)
}

/// What would be done for `until`, a row for each stage, with what each may cost, and all together.
fn outlook(line: &Line, until: Stage, common: &Common) -> Result<String> {
    let mut removed = common.fresh.map(|f| line.out_of_date(f)).transpose()?.unwrap_or_default();
    let mut text = String::new();
    let mut sum = Cost::default();
    for (of, (stage, found)) in line.order(until).into_iter().zip(line.outlook(until)?) {
        let anew = removed.contains(&stage);
        removed.retain(|name| *name != stage);
        let (outlook, differences) = match found {
            _ if anew => ("to do, afresh", Vec::new()),
            None => ("to do", Vec::new()),
            Some(d) if d.is_empty() => ("done", d),
            Some(d) => ("would stop: it differs", d),
        };
        let cost = outlook.starts_with("to do").then(|| line.cost(of));
        sum = sum + cost.unwrap_or_default();
        if common.json {
            let found =
                json!({"stage": stage, "outlook": outlook, "differences": differences, "estimate": cost});
            text += &format!("{found}\n");
        } else {
            let about = cost.map_or(String::new(), |cost| format!("  about {}", duration(cost.seconds())));
            text += &format!("{stage:<8} {outlook}{about}\n");
            text.extend(differences.iter().map(|d| format!("           {d}\n")));
        }
    }
    for stage in removed {
        let outlook = "would be removed: out of date";
        text += &match common.json {
            true => format!("{}\n", json!({"stage": stage, "outlook": outlook})),
            false => format!("{stage:<8} {outlook}\n"),
        };
    }
    if !common.json && sum.cpu_s > 0.0 {
        text += &format!("{:<8} {}\n", "all", in_words(sum));
    }
    Ok(text)
}

/// What all of it may cost.
pub(super) fn in_words(cost: Cost) -> String {
    let gib = |bytes: u64| bytes as f64 / (1u64 << 30) as f64;
    let (memory, disk) = (gib(cost.memory_bytes), gib(cost.disk_bytes));
    let time = duration(cost.seconds());
    format!("about {time} on the processor, {memory:.1} GiB of memory, {disk:.1} GiB of disk")
}

/// The configuration that a target and the options amount to; it remembers its capture.
fn configure(common: &Common, command: &LineCommand) -> Result<Config> {
    let LineCommand { target, fallback, keys, .. } = command;
    let mut keys = keys.clone();
    if let Some(capture) = &target.capture {
        let path = capture.to_str().ok_or_else(|| {
            let shown = capture.display();
            Error::cannot(format!("the path of the capture is not UTF-8: `{shown}`"), "rename the folder")
        })?;
        keys.push((format!("CAPTURE {path}"), "capture.path".into(), path.into()));
    }
    let mut config = common.resolve(target.saved.as_deref(), *fallback, &keys)?;
    // the run remembers it from anywhere
    if let Some(path) = io::real_path(Path::new(&config.capture.path)).ok().as_deref().and_then(Path::to_str)
    {
        config.capture.path = path.into();
    }
    if config.capture.path.is_empty() {
        return Err(Error::usage("no capture is named", "name one: `tiface run CAPTURE`"));
    }
    Ok(config)
}

/// How the evaluation's views are made: as the run remembers it, else as it starts out, by `--set` but not by the options
/// of this command.
fn evaluation(common: &Common, target: &RunTarget) -> Result<RenderConfig> {
    let kept = Some(target.run.join("config.toml")).filter(|file| io::is_file(file));
    let config = match kept {
        Some(kept) => Common::default().resolve(Some(&kept), None, &[])?,
        None => common.resolve(None, None, &[])?,
    };
    Ok(RenderConfig { cameras: "test".into(), ..config.render })
}

/// Was this run made by `tiface demo`, also when its stages are run one by one?
pub(super) fn is_demo(config: &Config, run: &Run) -> bool {
    let made = run.path(DEMO_CAPTURE);
    io::real_path(&made).is_ok_and(|made| made == Path::new(&config.capture.path))
}
