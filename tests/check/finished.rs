//! A finished run in its user's hands: turntables, single stages, a capture that has moved.

use crate::command::{said, tiface, worked};
use crate::kept::{copy, copy_run, once};
use crate::tiny::capture;
use std::path::{Path, PathBuf};

/// A checkpoint of T-Face that was learned elsewhere.
fn checkpoint() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference/vm_g5.safetensors")
}

/// A run with an imported T-Face: nothing has to be learned.
fn finished(folder: &Path) {
    let kept = once("imported", |folder| {
        capture(folder);
        let import = format!("tface.import={}", checkpoint().display());
        let mut words = vec!["run", "head", "--run", "run", "--preset", "draft"];
        let settings = [
            &import,
            "render.method=tface",
            "ensemble.members=tface",
            "ensemble.weights=1",
            "render.orbit_views=3",
            "device=cpu",
        ];
        settings.iter().for_each(|s| words.extend(["--set", s]));
        worked(&tiface(folder, &words));
    });
    copy_run(&kept, folder, "runs/head");
    // the report names the folder that it lies in
    worked(&tiface(folder, &["run", "runs/head"]));
}

/// The files of a run with their bytes, those of camera paths left out.
fn files(run: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(run).unwrap() {
        let path = entry.unwrap().path();
        if !path.is_dir() {
            found.push((path.clone(), std::fs::read(&path).unwrap()));
        } else if !path.ends_with("render/paths") {
            found.extend(files(&path));
        }
    }
    found.sort();
    found
}

#[test]
fn a_turntable_leaves_the_finished_run_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    finished(dir.path());
    let run = dir.path().join("runs/head");
    let before = files(&run);
    let words = [
        "render",
        "runs/head",
        "--with",
        "tface",
        "--cameras",
        "orbit",
        "--background",
        "white",
        "--out",
        "turn/",
    ];
    let text = worked(&tiface(dir.path(), &words));
    assert!(text.contains("render/paths/orbit"), "{text}");
    for view in ["0001", "0002", "0003"] {
        assert!(dir.path().join(format!("turn/tface/{view}.png")).is_file());
    }
    assert!(!dir.path().join("turn/paths").exists());
    assert!(worked(&tiface(dir.path(), &words)).contains("render/paths/orbit: already done"));
    let other = tiface(dir.path(), &["render", "runs/head", "--cameras", "orbit", "--format", "exr"]);
    assert_eq!(other.status.code(), Some(1));
    assert!(said(&other).contains("`--fresh render` to make `render/paths/orbit` again"), "{}", said(&other));
    assert!(before == files(&run), "the turntable has changed the run");
    assert!(worked(&tiface(dir.path(), &["run", "runs/head"])).contains("metrics: already done"));
    assert!(before == files(&run));
    // and what has been made of other cameras is reported
    assert!(worked(&tiface(dir.path(), &["status", "runs/head"])).contains("render/paths/orbit done in"));
    let anew = ["render", "runs/head", "--cameras", "orbit", "--format", "exr", "--fresh", "render"];
    assert!(worked(&tiface(dir.path(), &[&anew[..], &["--dry-run"]].concat())).contains("orbit to do again"));
    worked(&tiface(dir.path(), &anew));
    assert!(run.join("render/paths/orbit/tface/0001.exr").is_file());
    assert!(!run.join("render/paths/orbit/tface/0001.png").exists() && before == files(&run));
}

#[test]
fn a_finished_run_outlives_its_capture_and_single_stages() {
    let dir = tempfile::tempdir().unwrap();
    finished(dir.path());
    let run = dir.path().join("runs/head");
    let before = files(&run);
    worked(&tiface(dir.path(), &["tface", "runs/head"]));
    worked(&tiface(dir.path(), &["render", "runs/head", "--cameras", "test"]));
    assert!(before == files(&run), "a command on one stage has changed the run");
    std::fs::rename(dir.path().join("head"), dir.path().join("moved")).unwrap();
    assert!(worked(&tiface(dir.path(), &["run", "runs/head"])).contains("metrics: already done"));
    let o = tiface(dir.path(), &["mesh", "runs/head"]);
    assert_eq!(o.status.code(), Some(1));
    assert!(said(&o).contains("--set capture.path="), "{}", said(&o));
    assert!(before == files(&run));
}

#[test]
fn a_finished_run_needs_its_imported_checkpoint_no_more() {
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path());
    let import = dir.path().join("official.safetensors");
    std::fs::copy(checkpoint(), &import).unwrap();
    let import = format!("tface.import={}", import.display());
    // the evaluation of a new run is as `--set` has it, whatever the first command renders
    let words = ["render", "head", "--preset", "draft", "--cameras", "train", "--with", "tface"];
    let settings = ["--set", &import, "--set", "render.background=white", "--set", "render.method=tface"];
    worked(&tiface(dir.path(), &[&words[..], &settings].concat()));
    let run = dir.path().join("runs/head");
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
    assert!(config.contains("background = \"white\"") && config.contains("cameras = \"test\""), "{config}");

    std::fs::rename(dir.path().join("official.safetensors"), dir.path().join("moved.safetensors")).unwrap();
    let again = worked(&tiface(dir.path(), &["tface", "runs/head"]));
    assert!(again.contains("tface: already done"), "{again}");
    let before = files(&run);
    // another file that does not exist is not what the stage took
    let typo = tiface(dir.path(), &["tface", "runs/head", "--set", "tface.import=typo.safetensors"]);
    assert!(typo.status.code() == Some(1) && said(&typo).contains("typo.safetensors"), "{}", said(&typo));
    assert!(before == files(&run), "the wrong path was written");
    let anew = tiface(dir.path(), &["tface", "runs/head", "--fresh", "tface"]);
    assert!(anew.status.code() == Some(1) && said(&anew).contains("official.safetensors"), "{}", said(&anew));
    assert!(before == files(&run), "something was removed");
}

#[test]
fn a_product_that_was_cut_is_not_passed_over_as_done() {
    let dir = tempfile::tempdir().unwrap();
    finished(dir.path());
    let run = dir.path().join("runs/head");
    let picture = std::fs::read_dir(run.join("ensemble")).unwrap().map(|entry| entry.unwrap().path());
    let picture = picture.filter(|path| path.extension().is_some_and(|e| e == "png")).min().unwrap();
    let whole = std::fs::read(&picture).unwrap();
    std::fs::write(&picture, &whole[..whole.len() / 2]).unwrap();
    let before = files(&run);
    let name = picture.strip_prefix(dir.path()).unwrap().display().to_string();
    for words in [&["run", "runs/head"][..], &["run", "runs/head", "--dry-run"]] {
        let o = tiface(dir.path(), words);
        assert_eq!(o.status.code(), Some(1), "{}", said(&o));
        assert!(said(&o).contains(&format!("`{name}` has {} bytes", whole.len() / 2)), "{}", said(&o));
        assert!(said(&o).contains("`--fresh ensemble`"), "{}", said(&o));
    }
    assert!(before == files(&run), "a refused command has changed the run");
    worked(&tiface(dir.path(), &["run", "runs/head", "--fresh", "ensemble"]));
    assert!(std::fs::read(&picture).unwrap() == whole);
}

#[test]
fn verify_names_each_file_that_is_not_as_recorded() {
    let dir = tempfile::tempdir().unwrap();
    finished(dir.path());
    let run = dir.path().join("runs/head");
    assert!(worked(&tiface(dir.path(), &["verify"])).contains(", as recorded\n"));
    let before = files(&run);
    let manifest = tiface(dir.path(), &["verify", "runs/head", "--json"]);
    assert_eq!(manifest.status.code(), Some(0), "{}", said(&manifest));
    let manifest: serde_json::Value = serde_json::from_slice(&manifest.stdout).unwrap();
    let listed = manifest["files"].as_array().unwrap();
    let mut paths = listed.iter().map(|file| file["file"].as_str().unwrap());
    let path = paths.find(|path| path.starts_with("ensemble/") && path.ends_with(".png")).unwrap();
    let is_whole = |file: &serde_json::Value| {
        let size = std::fs::metadata(run.join(file["file"].as_str().unwrap())).unwrap().len();
        file["sha256"].as_str().unwrap().len() == 64 && file["bytes"] == size && file["state"] == "recorded"
    };
    assert!(listed.iter().all(is_whole), "{manifest}");
    assert!(before == files(&run), "verify has changed the run");

    // one bit, so that the size stays
    let mut bytes = std::fs::read(run.join(path)).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    std::fs::write(run.join(path), &bytes).unwrap();
    let o = tiface(dir.path(), &["verify", "runs/head"]);
    assert_eq!(o.status.code(), Some(3), "{}", said(&o));
    let changed = format!("/{path}` has other contents than the stage `ensemble` left");
    assert!(said(&o).contains(&changed), "{}", said(&o));
    assert!(said(&o).contains("`tiface run runs/head --fresh ensemble` makes it again"), "{}", said(&o));
    let o = tiface(dir.path(), &["verify", "runs/head", "--json"]);
    assert!(said(&o).contains("\"state\":\"changed\""), "{}", said(&o));
    std::fs::remove_file(run.join(path)).unwrap();
    let o = tiface(dir.path(), &["verify", "runs/head"]);
    assert!(o.status.code() == Some(3) && said(&o).contains(&format!("/{path}` is missing")), "{}", said(&o));
    // which its size shows to other commands
    let o = tiface(dir.path(), &["status", "runs/head"]);
    assert!(o.status.code() == Some(3) && said(&o).contains("ensemble DAMAGED: "), "{}", said(&o));
    // a folder that is no run fails, and does not hide what was found in another
    std::fs::create_dir(dir.path().join("empty")).unwrap();
    let o = tiface(dir.path(), &["verify", "empty", "runs/head"]);
    assert_eq!(o.status.code(), Some(1), "{}", said(&o));
    assert!(said(&o).contains("no finished stage") && said(&o).contains("is missing"), "{}", said(&o));
    // and the command that was printed makes it again
    worked(&tiface(dir.path(), &["run", "runs/head", "--fresh", "ensemble"]));
    worked(&tiface(dir.path(), &["verify", "runs/head"]));
    worked(&tiface(dir.path(), &["status", "runs/head"]));
}

#[test]
fn pictures_and_meshes_of_other_programs_are_judged_by_the_held_out_photographs() {
    let dir = tempfile::tempdir().unwrap();
    finished(dir.path());
    let run = dir.path().join("runs/head");
    let before = files(&run);
    // the run's own pictures have the run's own figures
    let words = ["metrics", "head", "--views", "runs/head/render/tface", "--views", "runs/head/ensemble"];
    let shown = worked(&tiface(dir.path(), &words));
    assert!(shown.contains("tface ") && shown.contains("head_judged/report.html"), "{shown}");
    assert!(before == files(&run), "the run was changed");
    let read = |file: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(dir.path().join(file)).unwrap()).unwrap()
    };
    let (judged, own) = (read("head_judged/metrics.json"), read("runs/head/metrics/metrics.json"));
    for set in ["tface", "ensemble"] {
        assert_eq!(judged[set]["head"], own[set]["head"], "{set}");
        assert_eq!(judged[set]["parts"]["mean"]["psnr_edge"], own[set]["parts"]["mean"]["psnr_edge"]);
    }
    let page = std::fs::read_to_string(dir.path().join("head_judged/report.html")).unwrap();
    // the template escapes the slashes of addresses
    let page = page.replace("&#x2f;", "/");
    assert!(page.contains("href=\"../runs/head/render/tface/"), "no link to the picture");
    assert!(!page.contains("This run again"), "the page has the settings of a run");

    // a mesh far from every camera covers no pixel of the head: its pictures are black
    let triangle = "v 90 90 90\nv 91 90 90\nv 90 91 90\nf 1 2 3\n";
    std::fs::write(dir.path().join("far.obj"), triangle).unwrap();
    let shown = worked(&tiface(dir.path(), &["metrics", "head", "--mesh", "far.obj", "--out", "judged/"]));
    assert!(shown.contains("far: the mesh has no colors"), "{shown}");
    let judged = read("judged/metrics.json");
    assert_eq!(judged["far"]["mesh"]["triangles"], 1);
    assert!(judged["far"]["parts"]["mean"]["missing"].as_f64().unwrap() > 20.0, "{judged}");

    // never into a run, whose report it would replace
    let o = tiface(dir.path(), &["metrics", "head", "--mesh", "far.obj", "--out", "runs/head/"]);
    assert!(o.status.code() == Some(2) && said(&o).contains("would replace"), "{}", said(&o));
    assert!(before == files(&run), "the run was changed");

    // one picture is lacking, then all
    let few = dir.path().join("few");
    std::fs::create_dir(&few).unwrap();
    let o = tiface(dir.path(), &["metrics", "head", "--views", "few"]);
    assert!(o.status.code() == Some(1) && said(&o).contains("no picture of a held-out view"), "{}", said(&o));
    let all = std::fs::read_dir(run.join("ensemble")).unwrap().map(|entry| entry.unwrap().path());
    let one = all.filter(|path| path.extension().is_some_and(|e| e == "png")).min().unwrap();
    std::fs::copy(&one, few.join(one.file_name().unwrap())).unwrap();
    let shown = worked(&tiface(dir.path(), &["metrics", "head", "--views", "few"]));
    assert!(shown.contains("few: no picture of 1 held-out view of 2"), "{shown}");
}

#[test]
fn two_runs_of_a_capture_are_compared_on_one_page() {
    let dir = tempfile::tempdir().unwrap();
    finished(dir.path());
    let white = copy(&dir.path().join("runs/head"), &dir.path().join("runs/white"));
    let words =
        ["render", "runs/white", "--fresh", "render", "--set", "render.samples=1", "--cameras", "test"];
    worked(&tiface(dir.path(), &words));
    worked(&tiface(dir.path(), &["run", "runs/white"]));
    let before = (files(&dir.path().join("runs/head")), files(&white));
    let shown = worked(&tiface(dir.path(), &["report", "runs/head", "runs/white"]));
    assert!(shown.contains("compare.html"), "{shown}");
    assert!(before == (files(&dir.path().join("runs/head")), files(&white)), "a run was changed");
    let page = std::fs::read_to_string(dir.path().join("compare.html")).unwrap();
    for part in [
        "head: T-Face",
        "white: T-Face",
        "<code>render.samples</code>",
        "value=\"a-tface\"",
        "value=\"b-tface\"",
    ] {
        assert!(page.contains(part), "{part} is missing");
    }
    // with a run that has no metrics yet, or for the asking, it is a table
    let part = copy(&white, &dir.path().join("runs/part"));
    std::fs::remove_dir_all(part.join("metrics")).unwrap();
    for words in
        [&["report", "runs/head", "runs/part"][..], &["report", "runs/head", "runs/white", "--table"]]
    {
        assert!(worked(&tiface(dir.path(), words)).contains("runs.html"));
    }
}
