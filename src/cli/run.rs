//! `tiface run` and the commands of single stages: the pipeline up to a stage.

use super::Invocation;
use super::options::{Common, KeyOption};
use super::out::Out;
use super::requirement::Requirement;
use super::screen::print;
use super::summary::summary;
use super::target::RunTarget;
use crate::config::{Config, Fallback, HairViews, RenderConfig, SETTINGS_FILE, key};
use crate::pipeline::{Session, Stage, reconstruct};
use crate::report::duration;
use crate::run::{Cost, Phase, Run, RunStatus, read_record, read_status};
use serde_json::{Map, Value, json};
use tiface_base::{ErrorKind, Fingerprint, Result, io};

/// A command that runs stages.
pub(super) struct StageCommand<'a> {
    /// Content of `--out`: the whole run, or the product of a stage.
    pub product: &'static str,
    /// The last stage that it needs.
    pub until: Stage,
    /// Capture or run to work on.
    pub target: RunTarget,
    /// Requirements on the result (`--require`).
    pub require: &'a [String],
    /// Options of this command that set keys of the configuration.
    pub keys: Vec<KeyOption>,
    /// The start if no other source names a preset.
    pub fallback: Option<Fallback>,
}

/// Completes the stages that a command needs, and writes its product to `--out`.
pub(super) fn run(invocation: &Invocation, command: &StageCommand) -> Result<()> {
    let Invocation { common, screen, stop } = invocation;
    let StageCommand { product, until, target, require, keys, fallback } = command;
    let out = Out::find(common.out.as_deref(), product)?;
    if target.guessed {
        screen.note("run", &format!("using `{}`", target.run.display()));
    }
    let mut config = target.configure(common, *fallback, keys)?;
    // these options set how the views of a path are rendered; the evaluation's views keep their
    // settings
    let path = (*until == Stage::Render && config.render.cameras != "test").then(|| config.render.clone());
    if path.is_some() {
        config.render = evaluation(common, target)?;
    }
    let requirements = require.iter().map(|r| Requirement::parse(r)).collect::<Result<Vec<_>>>()?;
    let run = Run::open(&target.run, stop.clone(), screen.clone());
    let wanted = path.as_ref().map_or(vec![*until], RenderConfig::shows);
    config.mesh.hair_views = hair_views(&config, &run, wanted, common.fresh);
    // everything that can be refused is refused here, before the first stage
    let open = || -> Result<Session> {
        let mut session = Session::open(&config, &run)?;
        if let Some(path) = path {
            session = session.with_camera_path(path)?;
        }
        if let Some(out) = &out {
            out.check(run.dir(), &session.order(*until))?;
        }
        if !common.dry_run {
            if let Some(fresh) = common.fresh {
                session.fresh(fresh, *until)?;
            }
            session.remember(*until)?;
        }
        Ok(session)
    };
    let session = open().inspect_err(|e| {
        // failures of a batch are found in the run folders, not in logs; a finished run keeps its
        // state, other settings are no failure of a run that has begun, and a wrong command creates
        // no folder
        let is_named = io::is_folder(run.dir()) || common.run.is_some() && e.kind() == ErrorKind::Cannot;
        let is_recorded = match (e.kind(), saved_config(&run)) {
            (ErrorKind::Cannot | ErrorKind::Usage, None) => true,
            (ErrorKind::Cannot, Some(before)) => {
                common.fresh.is_none()
                    && before == without_device(&config.to_toml())
                    && ![Phase::Done, Phase::Damaged].contains(&RunStatus::read(run.dir()).phase)
            }
            _ => false,
        };
        if is_named && is_recorded && !common.dry_run {
            run.failed(e);
        }
    })?;
    if common.dry_run {
        print(&plan_summary(&session, *until, common)?)?;
        if common.fresh == Some(Stage::Mesh) && session.differs_in_formats() {
            let (run, formats) = (run.dir().display(), session.formats());
            let export =
                format!("`tiface export {run} --format {formats}` writes these files beside the run");
            screen.note("mesh", &format!("{export}, removes nothing and takes seconds"));
        }
        return session.require(*until, common.fresh).map(|_| ());
    }
    run.not_failed();
    screen.expect(session.ahead(*until).into_iter().map(|(stage, cost)| (stage, cost.seconds())).collect());
    let done = reconstruct(&session, *until)?;
    let written = out.map(|out| out.write(product, &session, &run)).transpose()?.unwrap_or_default();
    if common.json {
        let stages: Map<String, Value> =
            done.iter().map(|(s, d)| (s.to_string(), d.summary.clone())).collect();
        let result = json!({"event": "result", "run": run.dir(), "out": written, "stages": stages});
        print(&format!("{result}\n"))?;
    } else if !common.quiet {
        print(&summary(&run, session.views(), &done, &written))?;
    }
    requirements.iter().try_for_each(|requirement| requirement.check(&done))
}

/// Returns which views hair is fitted to on the way to some stages, where this is left open: those
/// of T-Face if that stage is among them. A mesh that was begun, and is not made again, keeps its
/// own.
fn hair_views(config: &Config, run: &Run, wanted: Vec<Stage>, fresh: Option<Stage>) -> HairViews {
    let HairViews::Auto = config.mesh.hair_views else { return config.mesh.hair_views };
    let folder = run.path(Stage::Mesh);
    let record = read_record(&folder).ok().flatten().map(|record| record.fingerprint);
    let begun = record.or_else(|| Some(read_status(&folder).ok()??.fingerprint));
    let is_fitted = |begun: &Fingerprint| begun.settings.contains_key(key!(mesh.hair_views));
    let is_cleared = fresh.is_some_and(|stage| stage.followers(config).contains(&Stage::Mesh));
    let order = Stage::with_needs(wanted, config);
    match begun {
        Some(begun) if is_fitted(&begun) => HairViews::Tface,
        Some(_) if !is_cleared => HairViews::None,
        _ if !order.contains(&Stage::Mesh) => HairViews::Auto,
        _ if order.contains(&Stage::Tface) => HairViews::Tface,
        _ => HairViews::None,
    }
}

/// Returns the settings that a run was last worked on with, as text; `None` if it has not begun.
fn saved_config(run: &Run) -> Option<String> {
    let bytes = io::read_bytes(&run.path(SETTINGS_FILE), &io::Limits::default()).ok()?;
    Some(without_device(&String::from_utf8_lossy(&bytes)))
}

/// Returns settings without the device: stages of one run may be computed on several devices.
fn without_device(settings: &str) -> String {
    let device = format!("{} = ", key!(device));
    settings.lines().filter(|line| !line.starts_with(&device)).map(|line| format!("{line}\n")).collect()
}

/// Returns the plan up to `until`: a row for each stage with its estimated cost, and the total.
fn plan_summary(session: &Session, until: Stage, common: &Common) -> Result<String> {
    let mut removed = common.fresh.map(|f| session.out_of_date(f)).transpose()?.unwrap_or_default();
    let mut text = String::new();
    let mut sum = Cost::default();
    for (of, (stage, found)) in session.order(until).into_iter().zip(session.stage_states(until)?) {
        let goes = removed.contains(&stage).then(|| session.contents(&stage)).transpose()?;
        removed.retain(|name| *name != stage);
        let (outlook, differences) = match found {
            _ if goes.is_some() => ("to do again", Vec::new()),
            None => ("to do", Vec::new()),
            Some(d) if d.is_empty() => ("done", d),
            Some(d) => ("would stop: it differs", d),
        };
        let cost = outlook.starts_with("to do").then(|| session.cost(of));
        sum = sum + cost.unwrap_or_default();
        if common.json {
            let mut found =
                json!({"stage": stage, "outlook": outlook, "differences": differences, "estimate": cost});
            if let Some(goes) = goes {
                found["removes"] = goes.into();
            }
            text += &format!("{found}\n");
        } else {
            let goes = goes.map_or(String::new(), |goes| format!(": removes {goes}"));
            let about = cost.map_or(String::new(), |cost| format!("  about {}", duration(cost.seconds())));
            text += &format!("{stage:<8} {outlook}{goes}{about}\n");
            text.extend(differences.iter().map(|d| format!("           {d}\n")));
        }
    }
    for stage in removed {
        let (outlook, goes) = ("would be removed: out of date", session.contents(&stage)?);
        text += &match common.json {
            true => format!("{}\n", json!({"stage": stage, "outlook": outlook, "removes": goes})),
            false => format!("{stage:<8} {outlook}: {goes}\n"),
        };
    }
    if !common.json && sum.cpu_s > 0.0 {
        text += &format!("{:<8} {}\n", "all", in_words(sum));
    }
    Ok(text)
}

/// Returns an estimated cost as a phrase.
pub(super) fn in_words(cost: Cost) -> String {
    let gib = |bytes: u64| bytes as f64 / (1u64 << 30) as f64;
    let (memory, disk) = (gib(cost.memory_bytes), gib(cost.disk_bytes));
    let time = duration(cost.seconds());
    format!("about {time} on the CPU, {memory:.1} GiB of memory, {disk:.1} GiB of disk")
}

/// Returns how the evaluation's views are rendered: by the run's saved settings, else by the
/// defaults and `--set`, but not by the options of this command.
fn evaluation(common: &Common, target: &RunTarget) -> Result<RenderConfig> {
    let kept = Some(target.run.join(SETTINGS_FILE)).filter(|file| io::is_file(file));
    let config = match kept {
        Some(kept) => Common::default().resolve(Some(&kept), None, &[])?,
        None => common.resolve(None, None, &[])?,
    };
    Ok(RenderConfig { cameras: "test".into(), ..config.render })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Preset, Product};
    use crate::run::Plan;
    use tiface_base::Error;

    /// Makes the stage `mesh` with these settings, or begins with it and fails.
    fn make(run: &Run, config: &Config, is_done: bool) {
        let settings = config.settings_of(Product::of(Stage::Mesh));
        let fingerprint = Fingerprint::new(1, settings);
        let plan = Plan { name: "mesh", fingerprint, device: "cpu", needs_bytes: 0, saves: false };
        let made = run.stage(plan, |_| match is_done {
            true => Ok(Value::Null),
            false => Err(Error::cannot("stopped", "")),
        });
        assert_eq!(made.is_ok(), is_done);
    }

    #[test]
    fn hair_is_fitted_to_views_of_tface_where_it_is_made_anyway() {
        let dir = tempfile::tempdir().unwrap();
        let run = Run::quiet(dir.path());
        let config = Config::preset(Preset::Draft);
        let of = |config: &Config, until: Stage| hair_views(config, &run, vec![until], None);
        assert_eq!(of(&config, Stage::Mask), HairViews::Auto);
        assert_eq!(of(&config, Stage::Tface), HairViews::Auto);
        assert_eq!(of(&config, Stage::Mesh), HairViews::None);
        assert_eq!(of(&config, Stage::Metrics), HairViews::Tface);
        let quick = Config::preset(Preset::Quick);
        assert_eq!(of(&quick, Stage::Metrics), HairViews::None);
    }

    #[test]
    fn a_mesh_that_was_begun_keeps_the_views_that_its_hair_is_fitted_to() {
        let config = Config::preset(Preset::Draft);
        let with = |hair_views: HairViews| {
            let mut config = config.clone();
            config.mesh.hair_views = hair_views;
            config
        };
        for is_done in [true, false] {
            for begun in [HairViews::None, HairViews::Tface] {
                let dir = tempfile::tempdir().unwrap();
                let run = Run::quiet(dir.path());
                make(&run, &with(begun), is_done);
                let of = |until: Stage, fresh| hair_views(&config, &run, vec![until], fresh);
                for until in [Stage::Iface, Stage::Mesh, Stage::Metrics] {
                    assert_eq!(of(until, None), begun, "{until}");
                }
                assert_eq!(of(Stage::Metrics, Some(Stage::Render)), begun);
                // made again, it has what a new one has
                assert_eq!(of(Stage::Metrics, Some(Stage::Mesh)), HairViews::Tface);
                assert_eq!(of(Stage::Mesh, Some(Stage::Iface)), begun);
            }
        }
    }
}
