//! `tiface run` and the commands of single stages: the pipeline up to a stage, requirements on its
//! result (`--require`), and the printed summary of files and quality.

use super::Invocation;
use super::options::{Common, KeyOption, RunTarget};
use super::out::Out;
use super::screen::{figure, one_line, print};
use crate::config::{Fallback, NAMES, RenderConfig, display_name, key};
use crate::pipeline::{Session, Stage, reconstruct};
use crate::report::{blend_verdict, duration, height, judged_by};
use crate::run::{Cost, Done, Phase, Run, RunStatus, read_record};
use serde_json::{Map, Value, json};
use std::path::PathBuf;
use tiface_base::{Error, ErrorKind, Result, io};

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

/// Returns the settings that a run was last worked on with, as text; `None` if it has not begun.
fn saved_config(run: &Run) -> Option<String> {
    let bytes = io::read_bytes(&run.path("config.toml"), &io::Limits::default()).ok()?;
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
    let kept = Some(target.run.join("config.toml")).filter(|file| io::is_file(file));
    let config = match kept {
        Some(kept) => Common::default().resolve(Some(&kept), None, &[])?,
        None => common.resolve(None, None, &[])?,
    };
    Ok(RenderConfig { cameras: "test".into(), ..config.render })
}

/// A requirement of `--require`.
#[derive(Debug, PartialEq)]
enum Requirement {
    Watertight,
    Psnr(f64),
}

impl Requirement {
    pub fn parse(text: &str) -> Result<Requirement> {
        let requirement = match text.split_once('=') {
            Some(("psnr", db)) => db.parse().ok().filter(|v: &f64| v.is_finite()).map(Requirement::Psnr),
            None if text == "watertight" => Some(Requirement::Watertight),
            _ => None,
        };
        requirement.ok_or_else(|| {
            Error::usage(format!("there is no requirement `{text}`"), "use watertight or psnr=DB")
        })
    }

    pub fn check(&self, done: &[(Stage, Done)]) -> Result<()> {
        let summary = |stage| done.iter().find(|(s, _)| *s == stage).map(|(_, d)| &d.summary);
        match self {
            Requirement::Watertight if summary(Stage::Mesh).is_some_and(|m| m["closed"] == true) => Ok(()),
            Requirement::Watertight => {
                Err(Error::below("the mesh is not watertight", "`tiface check RUN` says why"))
            }
            Requirement::Psnr(least) => {
                let metrics = summary(Stage::Metrics).unwrap_or(&Value::Null);
                let sets = metrics.as_object().into_iter().flat_map(|m| m.values());
                let best = sets
                    .filter_map(|set| set["head"]["mean"]["psnr_masked"].as_f64())
                    .fold(f64::NEG_INFINITY, f64::max);
                if best >= *least {
                    return Ok(());
                }
                let found = if best.is_finite() { format!("{best:.2} dB") } else { "unknown".into() };
                Err(Error::below(
                    format!("PSNR is {found}, required is {least} dB"),
                    "train longer, or lower the requirement",
                ))
            }
        }
    }
}

/// Returns a summary of the result: its files, its quality and what was `written` to `--out`.
/// `views` is the folder of the views, relative to the run.
fn summary(run: &Run, views: &str, done: &[(Stage, Done)], written: &[PathBuf]) -> String {
    let summary = |stage| done.iter().find(|(s, _)| *s == stage).map(|(_, d)| &d.summary);
    let mut text = String::new();
    let mut row = |name: &str, value: &dyn std::fmt::Display| text += &format!("{name:<9} {value}\n");
    if let Some(height) = height(summary(Stage::Mask), summary(Stage::Mesh)) {
        row("height", &height);
    }
    if let Some(mesh) = summary(Stage::Mesh) {
        let state = if mesh["closed"] == true { "watertight" } else { "NOT closed" };
        let files = ["glb", "obj", "ply", "usdz"].map(|e| run.path(format!("mesh/head.{e}")));
        let found = files.iter().find(|f| io::is_file(f));
        let first = found.map_or_else(|| "in no file".into(), |file| file.display().to_string());
        let handles = handles(&mesh["handles"]);
        row("mesh", &format!("{first} ({} triangles, {state}{handles})", mesh["triangles"]));
        // exported files may be moved
        let record = read_record(&run.path(Stage::Mesh)).ok().flatten();
        let faults = record.map_or(Vec::new(), |record| record.faults(&run.path(Stage::Mesh)));
        faults.iter().for_each(|fault| row("", &one_line(&fault.to_string())));
    }
    for (stage, folder) in [(Stage::Render, views), (Stage::Ensemble, Stage::Ensemble.as_str())] {
        if summary(stage).is_some() {
            row("pictures", &run.path(folder).display());
        }
    }
    if let Some(metrics) = summary(Stage::Metrics) {
        row("report", &run.path("report.html").display());
        judgment(metrics).iter().for_each(|line| row("quality", line));
    } else if summary(Stage::Mesh).is_none() && summary(Stage::Render).is_none() {
        row("run", &run.dir().display());
    }
    written.iter().for_each(|path| row("out", &path.display()));
    text
}

/// Returns how many handles were cut, filled and left, after a comma; empty if the surface had
/// none.
fn handles(figures: &Value) -> String {
    let count = |key: &str| figures[key].as_array().map_or(0, Vec::len) as u64;
    let all = [
        (count("cut_mm"), "cut"),
        (count("filled_mm"), "filled"),
        (figures["left"].as_u64().unwrap_or(0), "left"),
    ];
    let parts: Vec<String> =
        all.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}")).collect();
    if parts.is_empty() { String::new() } else { format!(", handles: {}", parts.join(", ")) }
}

/// Returns a sentence for each figure of the result's quality.
fn judgment(metrics: &Value) -> Vec<String> {
    let mut lines = Vec::new();
    for (set, _) in NAMES {
        let mean = &metrics[set]["head"]["mean"];
        if let Some(psnr) = mean["psnr_masked"].as_f64().or(mean["psnr"].as_f64()) {
            let ssim = mean["ssim_masked"].as_f64().or(mean["ssim"].as_f64());
            let ssim = ssim.map(|s| format!(", SSIM {s:.4}")).unwrap_or_default();
            let masked = mean["psnr_masked"].is_f64();
            let region = if masked { "inside the mask" } else { "whole frame (no masks)" };
            lines.push(format!(
                "{} against held-out photographs: PSNR {psnr:.2} dB{ssim}, {region}",
                display_name(set)
            ));
            if let Some(own) = metrics[set]["own_exposure"]["mean"]["psnr_masked"].as_f64() {
                lines.push(format!("  with each photograph's own exposure divided out: PSNR {own:.2} dB"));
            }
            if let Some(own) = metrics[set]["own_pose"]["mean"]["psnr_masked"].as_f64() {
                let exposure = metrics[set]["own_exposure"].is_object();
                let exposure = if exposure { ", its exposure divided out" } else { "" };
                lines.push(format!(
                    "  from the pose fitted to each photograph alone{exposure}: PSNR {own:.2} dB"
                ));
            }
            lines.extend(in_parts(&metrics[set]["parts"]["mean"]));
        }
    }
    lines.extend(blend_verdict(&metrics["blend"]));
    lines.extend(judged_by(&metrics["truth"]));
    let truth = &metrics["truth_percent_of_head"];
    if let (Some(mean), Some(p90)) = (truth["accuracy_mean"].as_f64(), truth["accuracy_p90"].as_f64()) {
        lines.push(format!(
            "mesh against the exact surface: {} % of head height off on average, 90 % within {} %",
            figure(mean),
            figure(p90)
        ));
    }
    lines
}

/// Returns a line of PSNR by part of the picture, as far as known.
fn in_parts(mean: &Value) -> Option<String> {
    let of = |key: &str| mean[key].as_f64();
    let db = [("opaque", "psnr_opaque"), ("edge", "psnr_edge"), ("skin", "psnr_skin"), ("hair", "psnr_hair")];
    let known = db.into_iter().filter_map(|(word, key)| Some(format!("{word} {:.2}", of(key)?)));
    let mut parts: Vec<String> = known.collect();
    if let (Some(missing), Some(extra)) = (of("missing"), of("extra")) {
        let cap = of("psnr_cap")
            .map(|db| format!(", which alone limit the PSNR to {db:.1} dB"))
            .unwrap_or_default();
        parts.push(format!("{missing:.0} pixels missing and {extra:.0} too many a view{cap}"));
    }
    (!parts.is_empty()).then(|| format!("  {}", parts.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn done(summary: Value) -> Done {
        Done { digest: String::new(), summary, skipped: false }
    }

    #[test]
    fn bars_are_parsed_and_missed_with_exit_code_3() {
        assert_eq!(Requirement::parse("psnr=28").unwrap(), Requirement::Psnr(28.0));
        assert_eq!(Requirement::parse("psnr=nan").unwrap_err().kind().code(), 2);
        assert_eq!(Requirement::parse("beauty").unwrap_err().kind().code(), 2);
        let metrics = json!({
            "tface": {"head": {"mean": {"psnr_masked": 25.0}}},
            "ensemble": {"head": {"mean": {"psnr_masked": 27.5}}},
            "truth_percent_of_head": {"accuracy_mean": 99.0},
        });
        let stages = [(Stage::Mesh, done(json!({"closed": true}))), (Stage::Metrics, done(metrics))];
        assert!(
            Requirement::Watertight.check(&stages).is_ok() && Requirement::Psnr(27.0).check(&stages).is_ok()
        );
        assert_eq!(Requirement::Psnr(28.0).check(&stages).unwrap_err().kind().code(), 3);
        assert_eq!(Requirement::Psnr(1.0).check(&[]).unwrap_err().kind().code(), 3);
    }

    #[test]
    fn the_judgment_names_what_was_measured() {
        let lines = judgment(&json!({
            "raycast": {
                "head": {"mean": {"psnr_masked": 28.123, "ssim_masked": 0.91}},
                "parts": {"mean": {"psnr_edge": 21.016, "missing": 1416.4, "extra": 257.0, "psnr_cap": 32.1}},
            },
            "ensemble": {"head": {"mean": {"psnr_masked": 30.0}}},
            "blend": {"best_member": "raycast", "gain_db": -1.877},
            "truth_percent_of_head": {"accuracy_mean": 0.312, "accuracy_p90": 0.7},
            "truth": {"photographs": "photo", "masks": "run"},
        }));
        assert_eq!(lines.len(), 6);
        assert!(lines[0].starts_with("I-Face's mesh (raycast) against"), "{}", lines[0]);
        assert!(lines[0].contains("PSNR 28.12 dB, SSIM 0.9100"), "{}", lines[0]);
        assert_eq!(
            lines[1],
            "  edge 21.02, 1416 pixels missing and 257 too many a view, which alone limit the PSNR to 32.1 dB"
        );
        assert!(lines[2].starts_with("blend (ensemble)") && lines[2].contains("30.00 dB"), "{}", lines[2]);
        assert!(lines[3].ends_with("1.88 dB below I-Face's mesh (raycast)"), "{}", lines[3]);
        assert_eq!(
            lines[4],
            "judged against photographs as they were taken, inside masks that this run made: others may judge otherwise"
        );
        assert!(lines[5].contains("0.312 % of head height"), "{}", lines[5]);
    }
}
