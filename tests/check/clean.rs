//! `tiface clean` as a user runs it: what goes, what stays, and what works afterwards.

use crate::command::{code, out, said, tiface, worked};
use crate::tiny::{files, finished, is_timed};
use std::path::Path;
use tiface::run::Run;

#[test]
fn a_cleaned_run_stays_finished_and_makes_the_same_views_again() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), "run");
    worked(&tiface(dir.path(), &["run", "run"])); // the report names the folder that it lies in
    let before = files(&run);
    let listed = out(&tiface(dir.path(), &["clean", "run"]));
    assert!(listed.contains("run/iface/checkpoint.safetensors: ") && listed.contains(" float views\n"));
    assert_eq!(out(&tiface(dir.path(), &["clean", "run", "--yes", "--dry-run"])), listed);
    assert!(before == files(&run), "a list has changed the run");
    let json = out(&tiface(dir.path(), &["clean", "run", "--yes", "--json"]));
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    let told = |key: &str| json[key].as_u64().unwrap() as usize;
    let untimed = |of: &crate::tiny::Files| -> usize {
        of.iter().filter(|(file, _)| !is_timed(file)).map(|(_, bytes)| bytes.len()).sum()
    };
    let after = files(&run);
    assert_eq!(untimed(&before) - untimed(&after), told("bytes"));
    assert_eq!(told("of"), before.values().map(Vec::len).sum::<usize>());
    let moments = Path::new("iface/checkpoint.safetensors");
    for (file, bytes) in before.iter().filter(|(file, _)| !is_timed(file) && *file != moments) {
        let goes = file.extension().is_some_and(|ending| ending == "exr");
        assert!(goes || after.get(file) == Some(bytes), "{} is not what it was", file.display());
        assert!(goes != after.contains_key(file), "{} is there", file.display());
    }

    // all that a user does with a finished run
    assert!(worked(&tiface(dir.path(), &["run", "run"])).contains("metrics: already done"));
    assert!(worked(&tiface(dir.path(), &["verify", "run"])).contains(", as recorded\n"));
    assert!(worked(&tiface(dir.path(), &["clean", "run", "--yes"])).contains("run: nothing to remove"));
    for words in [
        &["status", "run"][..],
        &["metrics", "run"],
        &["report", "run"],
        &["export", "run", "--out", "a.obj"],
        &["preview", "run", "--size", "64", "--out", "a.png"],
    ] {
        worked(&tiface(dir.path(), words));
    }

    // what needs the float views says so, before it removes anything
    for stage in ["ensemble", "metrics"] {
        let refused = tiface(dir.path(), &["run", "run", "--fresh", stage]);
        let text = said(&refused);
        assert!(code(&refused) == 1 && text.contains("`tiface run run --fresh render`"), "{text}");
        assert!(run.join("metrics/done.json").is_file());
    }
    worked(&tiface(dir.path(), &["run", "run", "--fresh", "render"]));
    let again = files(&run);
    let in_stages = before.iter().filter(|(file, _)| file.components().count() > 1);
    for (file, bytes) in in_stages.filter(|(file, _)| !is_timed(file) && *file != moments) {
        assert!(again.get(file) == Some(bytes), "{} is another one", file.display());
    }
}

#[test]
fn a_run_in_use_is_not_cleaned_and_only_a_run_is() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), "run");
    let before = files(&run);
    let held = Run::quiet(&run).hold(&["ensemble".to_string()]).unwrap();
    let refused = tiface(dir.path(), &["clean", "run", "--yes"]);
    assert!(code(&refused) == 75 && said(&refused).contains("locked by another process"));
    assert!(before == files(&run), "a run in use was changed");
    drop(held);
    assert_eq!(code(&tiface(dir.path(), &["clean", "head", "--yes"])), 2);
    assert_eq!(code(&tiface(dir.path(), &["clean"])), 2);
    assert_eq!(code(&tiface(dir.path(), &["clean", "run", "--fresh", "mesh"])), 2);
    // one run of several is no reason to leave the others as they are
    let two = tiface(dir.path(), &["clean", "head", "run", "--yes"]);
    assert!(code(&two) == 2 && !run.join("render/tface/float").exists(), "{}", said(&two));
}
