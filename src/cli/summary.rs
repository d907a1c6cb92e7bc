//! What a command prints at its end: where everything is, and how good it is.

use super::screen::figure;
use crate::config::{NAMES, called};
use crate::io;
use crate::pipeline::Stage;
use crate::report::{blend_verdict, judged_by};
use crate::run::{Done, Run};
use serde_json::Value;
use std::path::PathBuf;

/// Where the result is, how good it is, and what was `written` for `--out`; `views` is the folder of the views below the
/// run.
pub(super) fn summary(run: &Run, views: &str, done: &[(Stage, Done)], written: &[PathBuf]) -> String {
    let of = |stage| done.iter().find(|(s, _)| *s == stage).map(|(_, d)| &d.summary);
    let mut text = String::new();
    let mut row = |name: &str, value: &dyn std::fmt::Display| text += &format!("{name:<9} {value}\n");
    if let Some(height) = of(Stage::Mask).and_then(|mask| mask["height_m"].as_f64()) {
        row("head", &format!("{height:.3} m high"));
    }
    if let Some(mesh) = of(Stage::Mesh) {
        let state = if mesh["closed"] == true { "watertight" } else { "NOT closed" };
        let files = ["glb", "obj", "ply"].map(|e| run.path(format!("mesh/head.{e}")));
        let first = files.iter().find(|f| io::is_file(f)).unwrap_or(&files[0]).display();
        let handles = handles(&mesh["handles"]);
        row("mesh", &format!("{first} ({} triangles, {state}{handles})", mesh["triangles"]));
    }
    for (stage, folder) in [(Stage::Render, views), (Stage::Ensemble, Stage::Ensemble.word())] {
        if of(stage).is_some() {
            row("pictures", &run.path(folder).display());
        }
    }
    if let Some(metrics) = of(Stage::Metrics) {
        row("report", &run.path("report.html").display());
        judgement(metrics).iter().for_each(|line| row("quality", line));
    } else if of(Stage::Mesh).is_none() && of(Stage::Render).is_none() {
        row("run", &run.dir().display());
    }
    written.iter().for_each(|path| row("out", &path.display()));
    text
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

/// Where a set is right: one line of what is known.
fn in_parts(mean: &Value) -> Option<String> {
    let of = |key: &str| mean[key].as_f64();
    let db = [("opaque", "psnr_opaque"), ("edge", "psnr_edge"), ("skin", "psnr_skin"), ("hair", "psnr_hair")];
    let known = db.into_iter().filter_map(|(word, key)| Some(format!("{word} {:.2}", of(key)?)));
    let mut parts: Vec<String> = known.collect();
    if let (Some(missing), Some(extra)) = (of("missing"), of("extra")) {
        let cap = of("psnr_cap").map(|db| format!(" (at most {db:.1} dB)")).unwrap_or_default();
        parts.push(format!("{missing:.0} pixels missing and {extra:.0} too many a view{cap}"));
    }
    (!parts.is_empty()).then(|| format!("  {}", parts.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_judgement_names_what_was_measured() {
        let lines = judgement(&json!({
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
        assert_eq!(lines[1], "  edge 21.02, 1416 pixels missing and 257 too many a view (at most 32.1 dB)");
        assert!(lines[2].starts_with("blend (ensemble)") && lines[2].contains("30.00 dB"), "{}", lines[2]);
        assert!(lines[3].ends_with("1.88 dB below I-Face's mesh (raycast)"), "{}", lines[3]);
        assert_eq!(
            lines[4],
            "judged against photographs as they were taken, inside masks that this run made: others may judge otherwise"
        );
        assert!(lines[5].contains("0.312 % of head height"), "{}", lines[5]);
    }
}
