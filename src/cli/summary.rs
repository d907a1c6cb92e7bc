//! The printed summary of a run: its files and its quality.

use super::screen::{figure, one_line};
use crate::config::{MeshFormat, NAMES, display_name};
use crate::pipeline::Stage;
use crate::report::{blend_verdict, height, judged_by};
use crate::run::{Done, Run, read_record};
use serde_json::Value;
use std::path::PathBuf;
use tiface_base::io;

/// Returns a summary of the result: its files, its quality and what was `written` to `--out`.
/// `views` is the folder of the views, relative to the run.
pub(super) fn summary(run: &Run, views: &str, done: &[(Stage, Done)], written: &[PathBuf]) -> String {
    let summary = |stage| done.iter().find(|(s, _)| *s == stage).map(|(_, d)| &d.summary);
    let mut text = String::new();
    let mut row = |name: &str, value: &dyn std::fmt::Display| text += &format!("{name:<9} {value}\n");
    if let Some(height) = height(summary(Stage::Mask), summary(Stage::Mesh)) {
        row("height", &height);
    }
    if let Some(mesh) = summary(Stage::Mesh) {
        let state = if mesh["closed"] == true { "watertight" } else { "NOT closed" };
        let files = MeshFormat::ALL.map(|f| run.path(format!("mesh/head.{}", f.as_str())));
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
pub(super) fn handles(figures: &Value) -> String {
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
pub(super) fn judgment(metrics: &Value) -> Vec<String> {
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
