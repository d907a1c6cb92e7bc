//! What happens around a run: two processes at once, a clock that jumps, a run that may not be
//! written, a capture that changes, moves or comes along to another machine, few open files, little
//! memory.

use crate::command::{command, err, worked};
use crate::kept::copy;
use crate::tiny::{capture, files, finished, kept, same, shim, tiface};
use std::path::Path;
use std::process::{Command, Output, Stdio};

/// The program under a shell's limit, such as `ulimit -n 32`.
fn limited(limit: &str, command: &Command) -> Output {
    let script = format!("{limit} && exec \"$0\" \"$@\"");
    let mut shell = Command::new("sh");
    shell.args(["-c", &script]).arg(command.get_program()).args(command.get_args());
    shell.current_dir(command.get_current_dir().unwrap());
    shell.envs(command.get_envs().filter_map(|(k, v)| Some((k, v?)))).output().unwrap()
}

#[test]
fn two_processes_at_once_make_every_stage_once() {
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path());
    for stage in tiface::pipeline::Stage::ALL {
        let stage = stage.as_str();
        worked(&tiface(dir.path(), &[stage, "head", "--run", "calm"]).output().unwrap());
        let start = || {
            let mut command = tiface(dir.path(), &[stage, "head", "--run", "raced"]);
            command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
        };
        let both = [start(), start()].map(|child| child.wait_with_output().unwrap());
        // one works; the other is told so, or comes when all is done
        assert!(
            both.iter().any(|o| o.status.success()),
            "{stage}: {}",
            both.iter().map(err).collect::<String>()
        );
        let gives_way =
            |o: &Output| o.status.code() == Some(75) || err(o).contains(&format!("{stage}: already done"));
        assert!(
            both.iter().any(gives_way),
            "{stage} was made twice: {}",
            both.iter().map(err).collect::<String>()
        );
        for output in &both {
            assert!([Some(0), Some(75)].contains(&output.status.code()), "{stage}: {}", err(output));
        }
        same(&files(&dir.path().join("calm")), &files(&dir.path().join("raced")), stage);
    }
}

#[test]
fn a_clock_that_jumps_changes_no_product() {
    let dir = tempfile::tempdir().unwrap();
    let Some(shim) = shim(dir.path()) else { return };
    let head = kept().join("head");
    let mut command = tiface(dir.path(), &["run", head.to_str().unwrap(), "--run", "jumped"]);
    worked(&command.env("LD_PRELOAD", shim).env("FAULT_CLOCK", "1").output().unwrap());
    same(&files(&kept().join("run")), &files(&dir.path().join("jumped")), "a jumping clock");
    let status = std::fs::read_to_string(dir.path().join("jumped/mask/status.json")).unwrap();
    let status: serde_json::Value = serde_json::from_str(&status).unwrap();
    let now = std::time::UNIX_EPOCH.elapsed().unwrap().as_secs();
    assert!(
        now.abs_diff(status["updated"].as_u64().unwrap()) > 100_000_000,
        "the clock was not asked: {status}"
    );
}

#[test]
fn a_run_that_may_not_be_written_is_read_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), "run");
    let nobody = |words: &[&str]| {
        let command = tiface(dir.path(), words);
        let mut user = Command::new("setpriv");
        user.args(["--reuid=65534", "--regid=65534", "--clear-groups"]);
        user.arg(command.get_program()).args(command.get_args()).current_dir(dir.path());
        user.envs(command.get_envs().filter_map(|(k, v)| Some((k, v?)))).output()
    };
    let open = Command::new("chmod").args(["-R", "a+rX,go-w"]).arg(dir.path()).status();
    assert!(open.unwrap().success());
    if !nobody(&["inspect", "head"]).is_ok_and(|o| o.status.success()) {
        eprintln!("skipped: the program cannot be run as another user here");
        return;
    }
    let before = files(&run);
    for words in [&["run", "run"][..], &["status", "run"], &["preview", "run", "--size", "32"]] {
        let output = nobody(words).unwrap();
        assert!(output.status.success() || words[0] == "preview", "{words:?}: {}", err(&output));
        assert!([Some(0), Some(1)].contains(&output.status.code()), "{words:?}: {}", err(&output));
    }
    for words in [&["run", "run", "--fresh", "mesh"][..], &["mask", "head", "--run", "new"]] {
        let output = nobody(words).unwrap();
        assert_eq!(output.status.code(), Some(1), "{words:?}: {}", err(&output));
        assert!(err(&output).contains("ermission denied"), "{}", err(&output));
    }
    assert!(before == files(&run) && dir.path().join("head").is_dir());
}

#[test]
fn a_capture_that_changed_or_moved_under_a_run_is_named_with_its_key() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), "run");
    let head = dir.path().join("head");
    // as far as its fields
    for stage in ["mesh", "render", "ensemble", "metrics"] {
        std::fs::remove_dir_all(run.join(stage)).unwrap();
    }
    let mesh = |folder: &Path, more: &[&str]| -> Output {
        command(folder, &[&["mesh", "run"], more].concat()).output().unwrap()
    };
    let refused = |output: Output, what: &str| {
        let text = err(&output);
        assert_eq!(output.status.code(), Some(1), "{text}");
        assert!(text.contains(what) && text.contains("--set capture.path=FOLDER"), "{text}");
    };
    let old = copy(&head, &dir.path().join("old"));
    std::fs::copy(head.join("images/001.png"), head.join("images/000.png")).unwrap();
    refused(mesh(dir.path(), &[]), "other photographs, masks or cameras");
    std::fs::remove_dir_all(&head).unwrap();
    refused(mesh(dir.path(), &[]), "cannot be opened");

    // both on another machine: one key, once, and the run remembers it from anywhere
    let other = dir.path().join("other");
    std::fs::create_dir(&other).unwrap();
    std::fs::rename(old, other.join("photographs")).unwrap();
    std::fs::rename(run, other.join("run")).unwrap();
    refused(mesh(&other, &[]), "cannot be opened");
    worked(&mesh(&other, &["--set", "capture.path=photographs"]));
    let words = ["ensemble", "other/run", "--members", "baseline,tface", "--weights", "0.5,0.5"];
    let set = ["--set", "render.method=baseline,tface"];
    worked(&command(dir.path(), &[&words[..], &set].concat()).output().unwrap());
}

#[test]
fn few_open_files_and_little_memory_end_in_a_product_or_a_sentence() {
    let dir = tempfile::tempdir().unwrap();
    let head = kept().join("head");
    let run = |name: &str| {
        let mut command = tiface(dir.path(), &["run", head.to_str().unwrap(), "--run", name]);
        command.env("RAYON_NUM_THREADS", "2");
        command
    };
    // what a run needs is told for its threads, so that the calm one has as many
    worked(&run("calm").output().unwrap());
    let calm = files(&dir.path().join("calm"));
    worked(&limited("ulimit -n 32", &run("few")));
    same(&calm, &files(&dir.path().join("few")), "with 32 open files");
    let memory = "ulimit -v 524288"; // KiB
    worked(&limited(memory, &run("little")));
    same(&calm, &files(&dir.path().join("little")), "in 512 MiB");
    // a table that is trained in 1 GiB: the sentence, and then all the same a run; its checkpoints
    // would take 2 GiB, which the disk must have
    let large =
        limited(memory, run("large").args(["--set", "iface.levels=16", "--set", "iface.log2_table=21"]));
    let text = err(&large);
    assert_eq!(large.status.code(), Some(75), "{text}");
    assert!(text.contains("error: out of memory: ") && text.contains("raise `capture.downscale`"), "{text}");
    worked(&limited(memory, run("large").args(["--fresh", "iface"])));
}
