//! What the records of a run say of its result, in sentences.

use crate::config::{Stage, display_name};
use crate::run::Record;
use serde_json::Value;
use std::path::Path;
use tiface_base::io;

/// Returns what the figures of `metrics.json` were taken against, from its `truth`: a few words, or
/// nothing where it says nothing.
pub fn judged_by(truth: &Value) -> Option<String> {
    let photographs = match truth["photographs"].as_str()? {
        "photo" => "against photographs as they were taken",
        _ => "against photographs cut out by their masks",
    };
    let masks = match truth["masks"].as_str()? {
        "capture" => "inside the capture's masks",
        "run" => "inside masks that this run made: others may judge otherwise",
        _ => "without masks",
    };
    Some(format!("judged {photographs}, {masks}"))
}

/// Returns the statement that a blend is no better than the best of its members, from the `blend`
/// of `metrics.json`; `None` if the blend is better.
pub fn blend_verdict(blend: &Value) -> Option<String> {
    let gain = blend["gain_db"].as_f64().filter(|gain| *gain <= 0.0)?;
    let member = display_name(blend["best_member"].as_str()?);
    Some(format!(
        "the blend is not better than its best member on the views that are judged: {:.2} dB below {member}",
        -gain
    ))
}

/// Returns the height of what a run shows, from the figures of its stages: the mesh's own, else
/// that of the masks' hull.
pub fn height(mask: Option<&Value>, mesh: Option<&Value>) -> Option<String> {
    let of = |figures: &Value| Some((figures["height_units"].as_f64()?, figures["height_m"].as_f64()?));
    let told = |what: &str, (units, meters): (f64, f64)| {
        format!("{what} {meters:.3} m high ({units:.3} units of the dataset)")
    };
    let shown = mesh.and_then(|mesh| Some(told(mesh["shows"].as_str().unwrap_or("head"), of(mesh)?)));
    shown.or_else(|| Some(told("by the masks", of(mask?)?)))
}

/// Returns the size of a run's `head.glb` in megabytes of 10⁶ bytes.
pub fn glb_megabytes(run: &Path) -> Option<f64> {
    io::file_size(&run.join("mesh/head.glb")).map(|bytes| bytes as f64 / 1e6)
}

/// Returns the warnings of a run by its records: what its stages warned of, what is wrong with
/// their results, and which files are no longer as a stage left them, each with what to do. The
/// reports of one run and of many have the same.
pub fn warnings<'r>(run: &Path, records: impl IntoIterator<Item = (Stage, &'r Record)>) -> Vec<String> {
    let mut all = Vec::new();
    for (stage, record) in records {
        all.extend(record.warnings.iter().map(|w| format!("{stage}: {w}")));
        let verdict = blend_verdict(&record.summary["blend"]);
        all.extend(verdict.map(|v| format!("{stage}: {v}; use its views, or give `ensemble.weights`")));
        if record.summary["closed"] == false {
            all.push(format!("{stage}: the surface is not watertight; `tiface check RUN` says why"));
        }
        all.extend(record.faults(&run.join(stage)).iter().map(|fault| format!("{stage}: {fault}")));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_height_told_is_that_of_the_mesh_where_there_is_one() {
        let mask = json!({"height_units": 1.5, "height_m": 0.3});
        let mesh = json!({"shows": "head and shoulders", "height_units": 1.4, "height_m": 0.28});
        let said = |mask, mesh| height(mask, mesh).unwrap_or_default();
        assert_eq!(
            said(Some(&mask), Some(&mesh)),
            "head and shoulders 0.280 m high (1.400 units of the dataset)"
        );
        assert_eq!(said(Some(&mask), None), "by the masks 0.300 m high (1.500 units of the dataset)");
        // a mesh of a run from before tells none
        assert!(said(Some(&mask), Some(&json!({}))).starts_with("by the masks"));
        assert_eq!(height(Some(&json!({"height_units": null})), None), None);
    }

    #[test]
    fn a_report_has_the_warnings_of_all_stages_with_what_to_do() {
        let record = |summary: Value, warned: &[&str]| -> Record {
            serde_json::from_value(json!({
                "stage": "", "fingerprint": tiface_base::Fingerprint::default(), "digest": "", "summary": summary,
                "elapsed_s": 1.0, "warnings": warned, "finished": 0, "version": "",
            }))
            .unwrap()
        };
        let blend = json!({"blend": {"best_member": "tface", "gain_db": -0.5}});
        let records = [
            (Stage::Mask, record(json!({}), &["one mask is white"])),
            (Stage::Mesh, record(json!({"closed": false}), &["the GPU failed"])),
            (Stage::Metrics, record(blend, &[])),
        ];
        let run = Path::new("run");
        let all = warnings(run, records.iter().map(|(stage, record)| (*stage, record)));
        assert_eq!(all[..2], ["mask: one mask is white", "mesh: the GPU failed"]);
        assert!(all[2].starts_with("mesh: the surface is not watertight; `tiface check"), "{all:?}");
        assert!(all[3].starts_with("metrics: the blend") && all[3].contains("`ensemble.weights`"), "{all:?}");
    }
}
