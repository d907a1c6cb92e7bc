//! `tiface bench` as a user sees it, on a capture of a few small photographs.

use crate::command::{said, tiface};
use crate::kept::photographed;
use serde_json::Value;
use std::path::Path;
use std::process::Output;
use tiface::capture::synthetic::SyntheticOptions;

/// Sizes that end in seconds. Masks that rule nothing out leave no hull, to which the field would
/// be fitted before its first step: that takes longer than all else.
const SMALL: &str = "mask.meaning=ignore iface.steps=40 iface.rays=64 iface.max_rays=128 iface.samples=1024 \
    iface.levels=8 iface.log2_table=12 iface.occupancy_resolution=32 tface.steps=20 tface.rays=128 \
    tface.voxels_start=4096 tface.voxels_final=4096 tface.upsample_at=[] mesh.resolution=48 mesh.triangles=1000 \
    mesh.texture_px=64";

fn capture(folder: &Path) {
    let options = SyntheticOptions { width: 24, height: 30, train: 8, test: 1, seed: 1 };
    photographed(&folder.join("capture"), &options);
}

fn bench(folder: &Path, words: &[&str]) -> Output {
    let settings: Vec<&str> = SMALL.split_whitespace().flat_map(|set| ["--set", set]).collect();
    tiface(folder, &[&["bench", "capture"], &settings[..], words].concat())
}

fn results(folder: &Path, name: &str) -> Value {
    serde_json::from_slice(&std::fs::read(folder.join(name)).unwrap()).unwrap()
}

/// Returns the results of these sweeps of a capture, whose titles are said.
fn swept(folder: &Path, sweeps: &str, titles: &[&str]) -> Value {
    capture(folder);
    let made = bench(folder, &["--sweep", sweeps, "--out", "first/"]);
    let text = said(&made);
    assert!(made.status.success(), "{text}");
    for word in titles {
        assert!(text.contains(word), "{word}: {text}");
    }
    let mut files: Vec<String> = std::fs::read_dir(folder.join("first"))
        .unwrap()
        .map(|f| f.unwrap().file_name().into_string().unwrap())
        .collect();
    files.sort();
    assert_eq!(files, ["bench.html", "bench.json"], "and no scratch folder");
    let found = results(folder, "first/bench.json");
    for row in found["sweeps"].as_array().unwrap().iter().flat_map(|s| s["rows"].as_array().unwrap()) {
        assert!(row["cpu_s"].as_f64().unwrap() > 0.0 && row["figures"][0].is_number(), "{row}");
    }
    found
}

fn rows(found: &Value, sweep: usize) -> &[Value] {
    found["sweeps"][sweep]["rows"].as_array().unwrap()
}

#[test]
fn sweeps_leave_a_page_and_results() {
    let dir = tempfile::tempdir().unwrap();
    let found = swept(dir.path(), "steps", &["Training steps", "T-Face"]);
    let steps = rows(&found, 0);
    assert_eq!(steps.len(), 10);
    // a time is that of all steps so far
    let seconds: Vec<f64> = steps[..5].iter().map(|row| row["wall_s"].as_f64().unwrap()).collect();
    assert!(steps[0]["choice"] == "5 steps" && seconds.is_sorted(), "{seconds:?}");
    // as if two sweeps had been asked for and the second killed: the same command measures only it
    let mut stopped = found.clone();
    stopped["asked"] = serde_json::json!(["steps", "triangles"]);
    std::fs::write(dir.path().join("first/bench.json"), stopped.to_string()).unwrap();
    let whole =
        swept(dir.path(), "steps,triangles", &["triangles (1 of 1)", "Triangles after", "off the surface"]);
    assert_eq!(whole["sweeps"][0], found["sweeps"][0]);
    assert!(whole["sweeps"][1]["name"] == "triangles" && !rows(&whole, 1).is_empty(), "{whole}");
    // results are not written over
    let full = bench(dir.path(), &["--sweep", "hash", "--out", "first/"]);
    assert!(full.status.code() == Some(1) && said(&full).contains("holds the results of another bench"));
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; trains five fields with large tables"]
fn a_sweep_of_hash_grids_has_a_row_for_each() {
    let dir = tempfile::tempdir().unwrap();
    let found = swept(dir.path(), "hash", &["Hash grid", "PSNR"]);
    assert_eq!(rows(&found, 0).len(), 5);
}

#[test]
fn what_cannot_be_measured_is_said_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path());
    let wrong = |words: &[&str], code: i32, word: &str| {
        let found = bench(dir.path(), words);
        assert!(
            found.status.code() == Some(code) && said(&found).contains(word),
            "{words:?}: {}",
            said(&found)
        );
        assert!(!dir.path().join("bench").exists());
    };
    wrong(&["--sweep", "speed"], 2, "speed");
    wrong(&["--out", "results.json"], 2, "writes no such file");
    wrong(&["--dry-run", "--sweep", "texture,hash"], 0, "would measure hash, texture");
    let none = tiface(dir.path(), &["bench", "absent"]);
    assert!(none.status.code() == Some(1) && said(&none).contains("absent"));
}
