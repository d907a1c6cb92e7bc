use super::*;
use crate::run::{Observer, Stop};
use serde_json::json;
use std::fs;
use std::sync::Mutex;
use std::time::Duration;
use tiface_base::{ErrorKind, Quiet};

fn plan(steps: u32) -> Plan<'static> {
    let fingerprint = Fingerprint::default().setting("iface.steps", steps);
    Plan { name: "iface", fingerprint, device: "cpu", needs_bytes: 1, saves: true }
}

fn open(dir: &Path) -> Run {
    Run::open(dir, Stop::new(), Arc::new(Quiet))
}

fn work(stage: &StageDir) -> Result<Value> {
    io::write_atomic(&stage.folder().join("checkpoint"), b"weights")?;
    stage.monitor().step(5, 5, &[("loss", 0.5), ("bad", f64::NAN)]);
    Ok(json!({"loss": 0.5}))
}

fn fresh(run: &Run, names: &[&str]) -> Result<()> {
    run.fresh(&names.iter().map(|n| n.to_string()).collect::<Vec<_>>())
}

fn never(_: &StageDir) -> Result<Value> {
    panic!("the stage should have been skipped")
}

#[test]
fn a_stage_of_another_format_is_refused_with_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    run.stage(plan(5), work).unwrap();
    let mut other = plan(6);
    other.fingerprint.format = 3;
    let told = "stage `iface` was done by another version of tiface: its format is 0, not 3";
    for error in [run.agrees(&other).unwrap_err(), run.stage(other.clone(), never).unwrap_err()] {
        assert_eq!((error.to_string().as_str(), error.kind()), (told, ErrorKind::Cannot));
        assert!(
            error.hint().contains("`--run DIR`") && error.hint().ends_with("`--fresh iface`"),
            "{error:?}"
        );
    }
}

#[test]
fn a_finished_stage_is_skipped_and_no_file_is_touched() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    let first = run.stage(plan(5), work).unwrap();
    assert!(!first.skipped);
    let times = || -> Vec<_> {
        fs::read_dir(dir.path().join("iface"))
            .unwrap()
            .map(|e| e.unwrap())
            .map(|e| (e.file_name(), e.metadata().unwrap().modified().unwrap()))
            .collect()
    };
    let before = times();
    let second = open(dir.path()).stage(plan(5), never).unwrap();
    assert_eq!((second.skipped, &second.summary), (true, &json!({"loss": 0.5})));
    assert_eq!(second.digest, first.digest);
    assert_eq!(times(), before);
    let status = read_status(&dir.path().join("iface")).unwrap().unwrap();
    assert_eq!((status.state, status.step), (State::Done, 5));
    let log = fs::read_to_string(dir.path().join("iface/log.jsonl")).unwrap();
    let line: Value = serde_json::from_str(log.trim()).unwrap();
    assert_eq!((&line["step"], &line["bad"]), (&json!(5), &Value::Null));
}

#[test]
fn a_product_that_was_cut_or_lost_is_no_finished_stage() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    let mesh = Plan { name: "mesh", ..plan(5) };
    run.stage(mesh.clone(), |stage| {
        fs::create_dir(stage.folder().join("parts")).unwrap();
        for name in ["head.glb", "parts/head"] {
            io::write_atomic(&stage.folder().join(name), b"triangles")?;
        }
        Ok(Value::Null)
    })
    .unwrap();
    let record = read_record(&dir.path().join("mesh")).unwrap().unwrap();
    let products: Vec<_> = record.products.iter().map(|(name, bytes)| (name.as_str(), *bytes)).collect();
    assert_eq!(products, [("head.glb", 9), ("parts/head", 9)]);
    let head = dir.path().join("mesh/head.glb");
    let refused = |what: &str| {
        for error in [run.agrees(&mesh).unwrap_err(), run.stage(mesh.clone(), never).unwrap_err()] {
            assert!(error.to_string().contains(what), "{error}");
            assert!(error.hint().contains("`--fresh mesh`"), "{}", error.hint());
        }
    };
    fs::write(&head, b"tri").unwrap();
    refused("mesh/head.glb` has 3 bytes, but the stage `mesh` left 9");
    // what is made from the parts may be moved away
    fs::remove_file(&head).unwrap();
    assert!(run.stage(mesh.clone(), never).unwrap().skipped);
    fs::remove_file(dir.path().join("mesh/parts/head")).unwrap();
    refused("mesh/parts/head` is missing");
    // Records of older versions have no sizes.
    let mut record = serde_json::to_value(record).unwrap();
    record.as_object_mut().unwrap().remove("products");
    fs::write(dir.path().join("mesh/done.json"), record.to_string()).unwrap();
    assert!(run.stage(mesh.clone(), never).unwrap().skipped);
}

#[test]
fn somebodys_own_folder_gets_no_word_of_what_was_refused() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    fs::write(dir.path().join("thesis.tex"), b"mine").unwrap();
    run.failed(&Error::cannot("no cameras", "add them"));
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    // a run's own folder, and one that the command would have made, get it
    fs::write(dir.path().join("config.toml"), b"").unwrap();
    for dir in [dir.path().to_path_buf(), dir.path().join("new")] {
        open(&dir).failed(&Error::cannot("no cameras", "add them"));
        assert!(dir.join("failed.json").is_file());
    }
}

#[test]
fn other_settings_stop_with_the_difference_and_fresh_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    run.stage(plan(5), work).unwrap();
    let error = run.stage(plan(7), never).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Cannot);
    assert!(error.to_string().contains("iface.steps: was 5, is 7"), "{error}");
    assert_eq!(run.agrees(&plan(7)).unwrap_err().to_string(), error.to_string());
    assert!(run.agrees(&plan(5)).is_ok());
    assert!(error.hint().contains("--fresh iface"));
    run.stage(Plan { name: "mesh", ..plan(5) }, work).unwrap();
    run.stage(Plan { name: "mask", ..plan(5) }, work).unwrap();
    fresh(&run, &["iface", "mesh"]).unwrap();
    assert!(dir.path().join("mask/checkpoint").is_file());
    assert!(!dir.path().join("mesh/checkpoint").exists() && !dir.path().join("iface/checkpoint").exists());
    assert!(!run.stage(plan(7), work).unwrap().skipped);
}

#[test]
fn a_stage_begun_with_other_settings_is_not_continued_in_silence() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    let fails = |_: &StageDir| Err(Error::cannot("no surface", "more steps"));
    let error = run.stage(plan(5), fails).unwrap_err();
    assert_eq!(error.to_string(), "stage `iface`: no surface");
    let status = read_status(&dir.path().join("iface")).unwrap().unwrap();
    assert_eq!((status.state, status.error.as_deref()), (State::Failed, Some("no surface")));
    let error = run.stage(plan(6), never).unwrap_err();
    assert!(error.to_string().contains("was begun with other settings"), "{error}");
    assert!(run.stage(plan(5), work).is_ok());
}

#[test]
fn a_stage_that_another_holds_is_refused_with_75() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    let inner = open(dir.path());
    run.stage(plan(5), |stage| {
        let error = inner.stage(plan(5), never).unwrap_err();
        assert_eq!(error.kind().code(), 75);
        assert_eq!(fresh(&inner, &["iface"]).unwrap_err().kind().code(), 75);
        // other stages are free meanwhile
        inner.stage(Plan { name: "tface", ..plan(5) }, work).unwrap();
        work(stage)
    })
    .unwrap();
}

#[test]
fn a_stop_request_ends_the_stage_as_stopped_and_begins_no_other() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    let stop = run.stop().clone();
    let error = run
        .stage(plan(5), |stage| {
            assert!(!stage.monitor().stop());
            stop.request(ErrorKind::Terminated);
            assert!(stage.monitor().stop());
            Err(stop.error("what is complete is kept"))
        })
        .unwrap_err();
    assert_eq!(error.kind().code(), 143);
    let status = read_status(&dir.path().join("iface")).unwrap().unwrap();
    assert_eq!((status.state, status.error), (State::Stopped, None));
    assert!(run.stage(plan(5), never).unwrap_err().to_string().contains("before stage"));
}

#[test]
fn only_a_stage_that_has_steps_to_save_is_waited_for() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    let now = |patience| run.stop().abandon(patience).is_some();
    assert!(now(Duration::from_secs(99)), "nothing is at work");
    let state = |stage| read_status(&dir.path().join(stage)).unwrap().unwrap().state;
    run.stage(plan(5), |stage| {
        assert!(!now(Duration::from_secs(99)), "it has only just begun");
        assert!(now(Duration::ZERO), "it has nothing to save yet");
        assert_eq!(state("iface"), State::Stopped);
        let done = work(stage);
        assert!(!now(Duration::ZERO), "its steps would be lost");
        done
    })
    .unwrap();
    assert!(!now(Duration::from_secs(99)) && now(Duration::ZERO), "what comes next has time to tell");
    run.stage(Plan { name: "mesh", saves: false, ..plan(5) }, |stage| {
        let done = work(stage);
        assert!(now(Duration::ZERO), "it begins again in any case");
        assert_eq!(state("mesh"), State::Stopped);
        done
    })
    .unwrap();
    assert_eq!((state("iface"), state("mesh")), (State::Done, State::Done));
}

#[test]
fn leftovers_are_removed_under_the_lock_and_reported() {
    struct Warnings(Mutex<Vec<String>>);
    impl Observer for Warnings {
        fn event(&self, event: &Event) {
            if let Event::Warning { text, .. } = event {
                self.0.lock().unwrap().push(text.to_string());
            }
        }
    }
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir_all(dir.path().join("iface/views")).unwrap();
    fs::write(dir.path().join("iface/views/.a.png.99.tmp"), b"half").unwrap();
    fs::write(dir.path().join("iface/.lock"), crate::run::LOCK_MARK).unwrap();
    fs::write(dir.path().join("iface/done.json"), b"").unwrap(); // a crash before any sync
    let seen = Arc::new(Warnings(Mutex::new(Vec::new())));
    let run = Run::open(dir.path(), Stop::new(), seen.clone());
    run.stage(plan(5), work).unwrap();
    assert!(!dir.path().join("iface/views/.a.png.99.tmp").exists());
    let warnings = seen.0.lock().unwrap();
    assert!(warnings.iter().any(|t| t.contains("1 half-written")), "{warnings:?}");
    assert!(warnings.iter().any(|t| t.contains("done.json")), "{warnings:?}");
}

#[test]
fn somebodys_own_folder_beside_the_run_is_neither_cleared_nor_written_to() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    run.stage(Plan { name: "mask", ..plan(5) }, work).unwrap();
    let own = dir.path().join("iface/scans");
    fs::create_dir_all(&own).unwrap();
    fs::write(own.join("a.png"), b"mine").unwrap();
    for error in [
        fresh(&run, &["mask", "iface"]).unwrap_err(),
        run.agrees(&plan(5)).unwrap_err(),
        run.stage(plan(5), never).unwrap_err(),
    ] {
        assert!(error.to_string().contains("scans/a.png") && error.kind() == ErrorKind::Cannot, "{error}");
        assert!(error.hint().contains("--run DIR"), "{}", error.hint());
    }
    assert_eq!(fs::read(own.join("a.png")).unwrap(), b"mine");
    assert_eq!(fs::read_dir(dir.path().join("iface")).unwrap().count(), 1);
    // refused as a whole: the stage that could have been cleared still exists
    assert!(dir.path().join("mask/done.json").is_file());
    fs::remove_dir_all(&own).unwrap();
    assert!(run.stage(plan(5), work).is_ok());
}

#[test]
fn somebodys_own_folder_with_an_empty_lock_is_not_cleared() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    run.stage(Plan { name: "mask", ..plan(5) }, work).unwrap();
    fs::create_dir_all(dir.path().join("iface/keep")).unwrap();
    for lock in [&b""[..], b"4711", b"tiface"] {
        fs::write(dir.path().join("iface/.lock"), lock).unwrap();
        fs::write(dir.path().join("iface/keep/scan.ply"), b"mine").unwrap();
        for error in [
            fresh(&run, &["mask", "iface"]).unwrap_err(),
            run.agrees(&plan(5)).unwrap_err(),
            run.stage(plan(5), never).unwrap_err(),
        ] {
            assert!(error.to_string().contains("is not a folder of a run"), "{error}");
        }
        assert_eq!(fs::read(dir.path().join("iface/keep/scan.ply")).unwrap(), b"mine");
        assert_eq!(fs::read(dir.path().join("iface/.lock")).unwrap(), lock);
        assert!(dir.path().join("mask/done.json").is_file());
    }
}

#[test]
fn a_run_killed_right_after_its_folder_was_made_goes_on() {
    for lock in [None, Some(0), Some(20), Some(crate::run::LOCK_MARK.len())] {
        let dir = tempfile::tempdir().unwrap();
        let run = open(dir.path());
        let folder = dir.path().join("iface");
        fs::create_dir(&folder).unwrap();
        if let Some(bytes) = lock {
            fs::write(folder.join(".lock"), &crate::run::LOCK_MARK[..bytes]).unwrap();
        }
        fresh(&run, &["iface"]).unwrap();
        run.agrees(&plan(5)).unwrap();
        assert!(!run.stage(plan(5), work).unwrap().skipped);
        // killed later, before any other proof was written
        for file in ["done.json", "status.json"] {
            fs::remove_file(folder.join(file)).unwrap();
        }
        fresh(&run, &["iface"]).unwrap();
        assert!(!folder.join("checkpoint").exists());
        assert!(!run.stage(plan(5), work).unwrap().skipped);
    }
}

#[test]
#[cfg(unix)]
fn a_stage_folder_that_is_a_link_keeps_what_lies_behind_it() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    let elsewhere = dir.path().join("scratch");
    open(&elsewhere).stage(plan(5), work).unwrap();
    fs::write(elsewhere.join("iface/.a.png.99.tmp"), b"half").unwrap();
    std::os::unix::fs::symlink(elsewhere.join("iface"), dir.path().join("iface")).unwrap();
    // it may lie elsewhere
    assert!(run.stage(plan(5), never).unwrap().skipped);
    let error = fresh(&run, &["iface"]).unwrap_err();
    assert!(error.to_string().contains("iface` is a link"), "{error}");
    assert!(elsewhere.join("iface/checkpoint").is_file());
    fs::remove_file(elsewhere.join("iface/done.json")).unwrap();
    assert!(!run.stage(plan(5), work).unwrap().skipped);
    assert!(elsewhere.join("iface/.a.png.99.tmp").is_file());
}

#[test]
fn a_product_with_a_record_of_its_own_outlives_its_stage_and_is_made_again_alone() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    let (stage, own) = (Plan { name: "render", ..plan(5) }, Plan { name: "render/paths/a", ..plan(5) });
    run.stage(own.clone(), work).unwrap();
    fs::write(dir.path().join("render/paths/a/.b.png.99.tmp"), b"in progress").unwrap();
    run.stage(stage.clone(), work).unwrap();
    assert!(dir.path().join("render/paths/a/.b.png.99.tmp").is_file());
    fresh(&run, &["render"]).unwrap();
    assert!(!dir.path().join("render/checkpoint").exists());
    assert!(run.stage(own.clone(), never).unwrap().skipped);
    run.stage(stage.clone(), work).unwrap();
    let error = run.stage(Plan { name: own.name, ..plan(7) }, never).unwrap_err();
    assert!(error.hint().contains("`--fresh render` to make `render/paths/a` again"), "{}", error.hint());
    fresh(&run, &["render/paths/a"]).unwrap();
    assert!(!run.stage(Plan { name: own.name, ..plan(7) }, work).unwrap().skipped);
    assert!(run.stage(stage, never).unwrap().skipped);
}

#[test]
fn a_disk_without_room_is_refused_before_the_work() {
    let dir = tempfile::tempdir().unwrap();
    let run = open(dir.path());
    if io::free_bytes(dir.path()).is_none() {
        eprintln!("skipped: this system does not tell how much room is left");
        return;
    }
    let error = run.stage(Plan { needs_bytes: u64::MAX, ..plan(5) }, never).unwrap_err();
    assert!(error.to_string().contains("are free") && error.kind() == ErrorKind::Cannot, "{error}");
}
