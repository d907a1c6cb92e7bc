//! `tiface bench` as a user sees it, on a capture of a few small photographs.
#![cfg(feature = "cpu")]

mod command;

use command::tiface;
use serde_json::Value;
use std::path::Path;
use std::process::Output;
use tiface::capture::synthetic::{SyntheticOptions, write_capture};

/// Sizes that end in seconds.
const SMALL: [&str; 18] = [
    "--set",
    "iface.steps=40",
    "--set",
    "iface.rays=128",
    "--set",
    "iface.samples=2048",
    "--set",
    "iface.levels=8",
    "--set",
    "iface.log2_table=12",
    "--set",
    "tface.steps=20",
    "--set",
    "tface.rays=256",
    "--set",
    "tface.voxels_final=8000",
    "--set",
    "tface.voxels_start=8000",
];

const SMALL_MESH: [&str; 8] = [
    "--set",
    "mesh.resolution=48",
    "--set",
    "mesh.triangles=2000",
    "--set",
    "mesh.texture_px=128",
    "--set",
    "tface.upsample_steps=[]",
];

fn capture(folder: &Path) {
    let options = SyntheticOptions { width: 48, height: 60, train: 10, test: 2, seed: 1 };
    std::fs::create_dir(folder.join("capture")).unwrap();
    write_capture(&folder.join("capture"), &options).unwrap();
}

fn bench(folder: &Path, words: &[&str]) -> Output {
    tiface(folder, &[&["bench", "capture"], &SMALL[..], &SMALL_MESH, words].concat())
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

fn results(folder: &Path, name: &str) -> Value {
    serde_json::from_slice(&std::fs::read(folder.join(name)).unwrap()).unwrap()
}

#[test]
fn sweeps_leave_tables_drawings_and_results_that_compare() {
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path());
    let made = bench(dir.path(), &["--sweep", "steps,extraction,masks,render", "--out", "first/"]);
    let text = said(&made);
    assert!(made.status.success(), "{text}");
    for word in ["Training steps", "sparse (ours)", "isosurface", "closed form", "raycast", "raster"] {
        assert!(text.contains(word), "{word}: {text}");
    }
    let mut files: Vec<String> = std::fs::read_dir(dir.path().join("first"))
        .unwrap()
        .map(|f| f.unwrap().file_name().into_string().unwrap())
        .collect();
    files.sort();
    let expected =
        ["bench.html", "bench.json", "bench.md", "extraction.svg", "masks.svg", "render.svg", "steps.svg"];
    assert_eq!(files, expected, "and no scratch folder");
    let found = results(dir.path(), "first/bench.json");
    let sweeps = found["sweeps"].as_array().unwrap();
    assert_eq!(
        sweeps.iter().map(|s| s["rows"].as_array().unwrap().len()).collect::<Vec<_>>(),
        [10, 11, 5, 3]
    );
    for row in sweeps.iter().flat_map(|s| s["rows"].as_array().unwrap()) {
        for round in row["rounds"].as_array().unwrap() {
            assert!(
                round["work"]["cpu"].as_f64().unwrap() > 0.0
                    && round["reference"]["cpu"].as_f64().unwrap() > 0.0
            );
        }
    }
    // a share of the training's rounds for each share of its steps
    let steps = sweeps[0]["rows"].as_array().unwrap();
    assert_eq!(steps[0]["choice"], "5 steps");
    assert_eq!(
        (steps[0]["rounds"].as_array().unwrap().len(), steps[4]["rounds"].as_array().unwrap().len()),
        (1, 5)
    );

    // same figures again, whatever the times; a figure made better by hand is worse now
    let again = bench(dir.path(), &["--sweep", "masks", "--out", "again/", "--compare", "first/bench.json"]);
    let (first, second) = (&sweeps[3], &results(dir.path(), "again/bench.json")["sweeps"][0]);
    for (a, b) in first["rows"].as_array().unwrap().iter().zip(second["rows"].as_array().unwrap()) {
        assert_eq!(a["figures"], b["figures"]);
    }
    assert!(said(&again).contains("the same within noise"), "{}", said(&again));
    let mut better = found.clone();
    better["sweeps"][3]["rows"][0]["figures"][0] = 1.5.into();
    std::fs::write(dir.path().join("better.json"), better.to_string()).unwrap();
    let worse = bench(dir.path(), &["--sweep", "masks", "--out", "worse/", "--compare", "better.json"]);
    assert_eq!(worse.status.code(), Some(3), "{}", said(&worse));
    assert!(said(&worse).contains("worse: masks, hard: mean IoU 1.5000"), "{}", said(&worse));

    // results are not written over, nor compared with those of other settings
    let full = bench(dir.path(), &["--sweep", "masks", "--out", "first/"]);
    assert!(full.status.code() == Some(1) && said(&full).contains("holds the results of another bench"));
    let other = ["--sweep", "masks", "--out", "other/", "--compare", "first/bench.json", "--seed", "7"];
    let other = bench(dir.path(), &other);
    assert!(
        other.status.code() == Some(1) && said(&other).contains("with other settings"),
        "{}",
        said(&other)
    );
    assert!(!dir.path().join("other/bench.json").exists());
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
    wrong(&["--out", "results.json"], 2, "makes no such file");
    wrong(&["--truth", "none.ply"], 1, "none.ply");
    std::fs::write(dir.path().join("text.json"), "no").unwrap();
    wrong(&["--compare", "text.json"], 1, "`text.json` is no result of a bench");
    wrong(&["--dry-run", "--sweep", "masks,hash"], 0, "would measure hash, masks");
    let none = tiface(dir.path(), &["bench", "absent"]);
    assert!(none.status.code() == Some(1) && said(&none).contains("absent"));
}
