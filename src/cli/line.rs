//! `tiface run` and the stage commands: the line, up to a stage.

use super::demo::CAPTURE;
use super::options::Common;
use super::out::Out;
use super::screen::{Screen, figure};
use super::stdout::print;
use super::target::Target;
use crate::config::{Config, MeshFormat, NAMES, Preset, RenderConfig, called};
use crate::io;
use crate::pipeline::{Line, Stage, reconstruct};
use crate::run::{Done, Run, Stop};
use crate::{Error, Result};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Works on the run that `path` and the options mean, up to the stage `until`, for a command's `product`.
pub(super) fn go(
    common: &Common,
    path: Option<&Path>,
    product: &str,
    until: Stage,
    require: &[String],
    extra: &[(String, String, String)],
    screen: &Screen,
    stop: &Stop,
) -> Result<()> {
    let out = Out::find(common.out.as_deref(), product)?;
    let target = Target::find(common, path)?;
    if target.guessed {
        screen.note("run", &format!("using `{}`", target.run.display()));
    }
    let work = Work { common, product, until, out, require, synthetic: false, fallback: None, screen, stop };
    work.on(&target, extra)
}

/// A command on the line.
pub(super) struct Work<'a> {
    pub common: &'a Common,
    /// What the command makes: `run` (all there is), or the stage.
    pub product: &'a str,
    /// The last stage that it needs.
    pub until: Stage,
    /// Where the product goes as well.
    pub out: Option<Out>,
    pub require: &'a [String],
    /// Is it the demo head, whose surface is known?
    pub synthetic: bool,
    /// The preset where nothing names one, and settings on top of it, as TOML.
    pub fallback: Option<(Preset, &'static str)>,
    pub screen: &'a Screen,
    pub stop: &'a Stop,
}

impl Work<'_> {
    pub fn on(&self, target: &Target, extra: &[(String, String, String)]) -> Result<()> {
        let mut config = configure(self.common, target, self.fallback, extra)?;
        // views of a path are made as asked for here; what the evaluation shows stays as it was
        let path =
            (self.until == Stage::Render && config.render.cameras != "test").then(|| config.render.clone());
        if path.is_some() {
            config.render = evaluation(self.common, target)?;
        }
        let bars = self.require.iter().map(|r| Bar::parse(r)).collect::<Result<Vec<_>, _>>()?;
        let run = Run::open(&target.run, self.stop.clone(), self.screen.observer());
        // the demo's own runs are recognised when their stages are run one by one, too
        let synthetic = self.synthetic || is_demo(&config, &run);
        let mut line = Line::open(&config, &run, synthetic)?;
        if let Some(path) = path {
            line = line.along(path)?;
        }
        if let Some(out) = &self.out {
            out.is_outside(run.dir())?;
            let mesh = matches!(out, Out::File(_, ending) if mesh_format(ending).is_some());
            if mesh && !line.order(self.until).contains(&Stage::Mesh) {
                return Err(Error::usage(
                    "no mesh is made with these settings, so `--out` has none to write",
                    "use `tiface mesh --out head.glb`",
                ));
            }
        }
        if self.common.dry_run {
            return self.outlook(&line);
        }
        if let Some(fresh) = self.common.fresh {
            line.fresh(fresh, self.until)?;
        }
        line.remember(self.until)?;
        self.screen.expect(line.ahead(self.until));
        let done = reconstruct(&line, self.until)?;
        let written = match &self.out {
            Some(out) => self.copy(&line, &run, out)?,
            None => Vec::new(),
        };
        self.closing(&run, line.views(), &done, &written)?;
        bars.iter().try_for_each(|bar| bar.check(&done))?;
        Ok(())
    }

    fn outlook(&self, line: &Line) -> Result<()> {
        let fresh = self.common.fresh.map(|f| line.out_of_date(f)).transpose()?.unwrap_or_default();
        let mut text = String::new();
        for (stage, found) in line.outlook(self.until)? {
            let anew = fresh.contains(&stage);
            let (word, differences) = match found {
                _ if anew => ("to do, afresh", Vec::new()),
                None => ("to do", Vec::new()),
                Some(d) if d.is_empty() => ("done", d),
                Some(d) => ("would stop: done with other settings", d),
            };
            if self.common.json {
                text +=
                    &format!("{}\n", json!({"stage": stage, "outlook": word, "differences": differences}));
            } else {
                text += &format!("{stage:<8} {word}\n");
                text.extend(differences.iter().map(|d| format!("           {d}\n")));
            }
        }
        print(&text)?;
        Ok(())
    }

    /// Puts the command's product where `--out` says, and says what was written.
    fn copy(&self, line: &Line, run: &Run, out: &Out) -> Result<Vec<PathBuf>> {
        match out {
            Out::File(file, ending) if let Some(format) = mesh_format(ending) => {
                let stem = file.file_stem().and_then(|s| s.to_str()).unwrap_or("head");
                let exported =
                    line.read_product()?.files(format, &line.export(), line.mesh_config(), stem)?;
                exported.warnings.iter().for_each(|w| run.warn("mesh", w));
                let files = exported.files;
                // the mesh names its pictures: it comes last, and under the name that was asked for
                let mut written = vec![file.clone()];
                for (name, bytes) in files.iter().skip(1).rev() {
                    written.push(file.with_file_name(name));
                    io::write_atomic(&written[written.len() - 1], bytes)?;
                }
                io::write_atomic(file, &files[0].1)?;
                Ok(written)
            }
            Out::File(file, ending) if ending == "json" => {
                copy_file(&run.path("metrics/metrics.json"), file)?;
                Ok(vec![file.clone()])
            }
            // no stage makes another file: `Out::find` has refused it
            Out::File(file, _) => Ok(vec![file.clone()]),
            Out::Folder(folder) => {
                io::create_folder(folder)?;
                // fields, and pictures that only another stage can read, stay where they are
                match self.product {
                    "run" => copy_folder(run.dir(), folder, &["baseline", "tface", "iface", CAPTURE])?,
                    "render" => copy_folder(&run.path(line.views()), folder, &["float", "paths"])?,
                    stage => copy_folder(&run.path(stage), folder, &["float", "parts"])?,
                }
                if self.product == "metrics" {
                    copy_file(&run.path("report.html"), &folder.join("report.html"))?;
                }
                Ok(vec![folder.clone()])
            }
        }
    }

    /// Where everything is, and how good it is.
    fn closing(&self, run: &Run, views: &str, done: &[(Stage, Done)], written: &[PathBuf]) -> Result<()> {
        let of = |stage| done.iter().find(|(s, _)| *s == stage).map(|(_, d)| &d.summary);
        if self.common.json {
            let stages: serde_json::Map<String, Value> =
                done.iter().map(|(n, d)| (n.to_string(), d.summary.clone())).collect();
            let result = json!({"event": "result", "run": run.dir(), "out": written, "stages": stages});
            return print(&format!("{result}\n"));
        }
        if self.common.quiet {
            return Ok(());
        }
        let mut text = String::new();
        let mut row = |name: &str, value: String| text += &format!("{name:<9} {value}\n");
        if let Some(mesh) = of(Stage::Mesh) {
            let state = if mesh["closed"] == true { "watertight" } else { "NOT closed" };
            let files = ["glb", "obj", "ply"].map(|e| run.path(format!("mesh/head.{e}")));
            let first = files.iter().find(|f| io::is_file(f)).unwrap_or(&files[0]);
            let loops = handles(&mesh["handles"]);
            row("mesh", format!("{} ({} triangles, {state}{loops})", first.display(), mesh["triangles"]));
        }
        let folders = [(Stage::Render, views), (Stage::Ensemble, Stage::Ensemble.word())];
        for (_, folder) in folders.into_iter().filter(|(s, _)| of(*s).is_some()) {
            row("pictures", format!("{}", run.path(folder).display()));
        }
        if let Some(metrics) = of(Stage::Metrics) {
            row("report", format!("{}", run.path("report.html").display()));
            for line in judgement(metrics) {
                row("quality", line);
            }
        } else if of(Stage::Mesh).is_none() && of(Stage::Render).is_none() {
            row("run", format!("{}", run.dir().display()));
        }
        for path in written {
            row("out", format!("{}", path.display()));
        }
        print(&text)
    }
}

/// What became of handles, after a comma; nothing where there were none.
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

/// How good the result is, one sentence per thing known.
fn judgement(metrics: &Value) -> Vec<String> {
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
                called(set)
            ));
        }
    }
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

/// The configuration a target and the options amount to; it remembers its capture.
pub(super) fn configure(
    common: &Common,
    target: &Target,
    fallback: Option<(Preset, &str)>,
    extra: &[(String, String, String)],
) -> Result<Config> {
    let mut extra = extra.to_vec();
    let mut remember = |path: &str| {
        extra.push((format!("CAPTURE {path}"), "capture.path".into(), path.into()));
    };
    if let Some(capture) = &target.capture {
        let path = capture.to_str().ok_or_else(|| {
            let shown = capture.display();
            Error::cannot(format!("the path of the capture is not UTF-8: `{shown}`"), "rename the folder")
        })?;
        remember(path);
    } else if let Some(saved) = target.saved.as_deref().filter(|_| common.preset.is_some()) {
        // a new preset starts over, but on the same photographs
        let bare = Common { color: common.color, ..Common::default() };
        remember(&bare.resolve(Some(saved), None, &[])?.capture.path);
    }
    let config = common.resolve(target.saved.as_deref(), fallback, &extra)?;
    if config.capture.path.is_empty() {
        return Err(Error::usage("no capture is named", "name one: `tiface run CAPTURE`"));
    }
    Ok(config)
}

/// How the evaluation's views are made: as the run remembers it, else as it starts out.
fn evaluation(common: &Common, target: &Target) -> Result<RenderConfig> {
    let kept = Some(target.run.join("config.toml")).filter(|file| io::is_file(file));
    let bare = match kept {
        Some(_) => Common { color: common.color, ..Common::default() },
        None => Common { preset: common.preset, config: common.config.clone(), ..Common::default() },
    };
    let render = bare.resolve(kept.as_deref(), None, &[])?.render;
    Ok(RenderConfig { cameras: "test".into(), ..render })
}

/// Was this run made by `tiface demo`?
fn is_demo(config: &Config, run: &Run) -> bool {
    let made = run.path(CAPTURE);
    io::real_path(&made).is_ok_and(|made| made == Path::new(&config.capture.path))
}

/// The format that an ending means.
fn mesh_format(ending: &str) -> Option<MeshFormat> {
    match ending {
        "glb" => Some(MeshFormat::Glb),
        "obj" => Some(MeshFormat::Obj),
        "ply" => Some(MeshFormat::Ply),
        _ => None,
    }
}

fn copy_file(from: &Path, to: &Path) -> Result<()> {
    Ok(io::write_atomic(to, &io::read_bytes(from, &io::Limits::default())?)?)
}

/// All files but those that tell of the work, and all folders but those named; deeper down none but
/// the views kept in float is left out.
fn copy_folder(from: &Path, to: &Path, left: &[&str]) -> Result<()> {
    io::create_folder(to)?;
    for name in io::list_files(from)? {
        if !["done.json", "status.json", "log.jsonl"].contains(&name.as_str()) {
            copy_file(&from.join(&name), &to.join(&name))?;
        }
    }
    for folder in io::list_folders(from)? {
        if let Some(name) = folder.file_name().filter(|n| !left.iter().any(|k| n == k)) {
            copy_folder(&folder, &to.join(name), &["float", "parts"])?;
        }
    }
    Ok(())
}

/// A bar set by `--require`.
#[derive(Debug, PartialEq)]
enum Bar {
    Watertight,
    Psnr(f64),
}

impl Bar {
    fn parse(text: &str) -> Result<Bar> {
        let bar = match text.split_once('=') {
            Some(("psnr", db)) => db.parse().ok().filter(|v: &f64| v.is_finite()).map(Bar::Psnr),
            None if text == "watertight" => Some(Bar::Watertight),
            _ => None,
        };
        bar.ok_or_else(|| {
            Error::usage(format!("there is no requirement `{text}`"), "known are watertight and psnr=DB")
        })
    }

    fn check(&self, done: &[(Stage, Done)]) -> Result<()> {
        let of = |stage| done.iter().find(|(s, _)| *s == stage).map(|(_, d)| &d.summary);
        match self {
            Bar::Watertight if of(Stage::Mesh).is_some_and(|m| m["closed"] == true) => Ok(()),
            Bar::Watertight => Err(Error::below("the mesh is not watertight", "`tiface check` says where")),
            Bar::Psnr(bar) => {
                let metrics = of(Stage::Metrics).unwrap_or(&Value::Null);
                let sets = metrics.as_object().into_iter().flat_map(|m| m.values());
                let best = sets
                    .filter_map(|set| set["head"]["mean"]["psnr_masked"].as_f64())
                    .fold(f64::NEG_INFINITY, f64::max);
                if best >= *bar {
                    return Ok(());
                }
                let found = if best.is_finite() { format!("{best:.2} dB") } else { "unknown".into() };
                Err(Error::below(
                    format!("PSNR is {found}, required are {bar} dB"),
                    "train longer, or lower the bar",
                ))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn done(summary: Value) -> Done {
        Done { digest: String::new(), summary, skipped: false }
    }

    #[test]
    fn bars_are_parsed_and_missed_with_exit_code_3() {
        assert_eq!(Bar::parse("psnr=28").unwrap(), Bar::Psnr(28.0));
        assert_eq!(Bar::parse("psnr=nan").unwrap_err().kind().code(), 2);
        assert_eq!(Bar::parse("beauty").unwrap_err().kind().code(), 2);
        let metrics = json!({
            "tface": {"head": {"mean": {"psnr_masked": 25.0}}},
            "ensemble": {"head": {"mean": {"psnr_masked": 27.5}}},
            "truth_percent_of_head": {"accuracy_mean": 99.0},
        });
        let stages = [(Stage::Mesh, done(json!({"closed": true}))), (Stage::Metrics, done(metrics))];
        assert!(Bar::Watertight.check(&stages).is_ok() && Bar::Psnr(27.0).check(&stages).is_ok());
        assert_eq!(Bar::Psnr(28.0).check(&stages).unwrap_err().kind().code(), 3);
        assert_eq!(Bar::Psnr(1.0).check(&[]).unwrap_err().kind().code(), 3);
    }

    #[test]
    fn the_judgement_names_what_was_measured() {
        let lines = judgement(&json!({
            "raycast": {"head": {"mean": {"psnr_masked": 28.123, "ssim_masked": 0.91}}},
            "ensemble": {"head": {"mean": {"psnr_masked": 30.0}}},
            "truth_percent_of_head": {"accuracy_mean": 0.312, "accuracy_p90": 0.7},
        }));
        assert_eq!(lines.len(), 3);
        assert!(lines[0].starts_with("I-Face's mesh (raycast) against"), "{}", lines[0]);
        assert!(lines[0].contains("PSNR 28.12 dB, SSIM 0.9100"), "{}", lines[0]);
        assert!(lines[1].starts_with("blend (ensemble)") && lines[1].contains("30.00 dB"), "{}", lines[1]);
        assert!(lines[2].contains("0.312 % of head height"), "{}", lines[2]);
    }
}
