//! The command line as a user sees it: exit codes, messages, streams.
#![cfg(feature = "cpu")]

use std::path::Path;
use std::process::{Command, Output};

fn tiface(folder: &Path, words: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tiface"))
        .args(words)
        .current_dir(folder)
        .env("XDG_CONFIG_HOME", folder) // nobody's own configuration
        .env_remove("RUST_LOG")
        .env("NO_COLOR", "1")
        .output()
        .unwrap()
}

fn code(output: &Output) -> i32 {
    output.status.code().unwrap()
}

fn err(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn out(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn help_and_version_end_with_0_and_nonsense_with_2() {
    let dir = tempfile::tempdir().unwrap();
    for words in [&["--help"][..], &["-h"], &["--version"], &["help", "mesh"], &["mesh", "--help"]] {
        assert_eq!(code(&tiface(dir.path(), words)), 0, "{words:?}");
    }
    for words in [&["frobnicate"][..], &["run", "--no-such-option"], &[]] {
        assert_eq!(code(&tiface(dir.path(), words)), 2, "{words:?}");
    }
    assert!(out(&tiface(dir.path(), &["--help"])).contains("Exit codes"));
}

#[test]
fn a_wrong_key_is_refused_with_2_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("my.toml"), "[iface]\nstep = 5\n").unwrap();
    let o = tiface(dir.path(), &["config", "-c", "my.toml"]);
    assert_eq!(code(&o), 2);
    assert_eq!(
        err(&o),
        "error: `my.toml`, line 2: there is no key `iface.step`\n\nhint: did you mean `iface.steps`? `tiface config` lists all keys\n"
    );
    let o = tiface(dir.path(), &["config", "--device", "toaster"]);
    assert_eq!(code(&o), 2);
    assert!(err(&o).contains("`--device toaster`: `device`: unknown device `toaster`"), "{}", err(&o));
}

#[test]
fn the_effective_configuration_is_printed_and_accepted_again() {
    let dir = tempfile::tempdir().unwrap();
    let first = tiface(dir.path(), &["config", "--preset", "draft", "--set", "mesh.resolution=77"]);
    assert_eq!(code(&first), 0);
    std::fs::write(dir.path().join("a.toml"), &first.stdout).unwrap();
    let again = tiface(dir.path(), &["config", "-c", "a.toml"]);
    assert_eq!(out(&first), out(&again));
    assert!(out(&again).contains("resolution = 77"));
    let explained = tiface(dir.path(), &["config", "--explain", "iface.steps"]);
    assert!(out(&explained).contains("allowed: 1 to"), "{}", out(&explained));
}

#[test]
fn a_folder_that_is_no_capture_ends_with_1_and_a_way_out() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("empty")).unwrap();
    for words in [["run", "empty"], ["inspect", "empty"], ["run", "absent"]] {
        let o = tiface(dir.path(), &words);
        assert_eq!(code(&o), 1, "{words:?}: {}", err(&o));
        assert!(!dir.path().join("runs").exists());
    }
    assert!(err(&tiface(dir.path(), &["run", "empty"])).contains("hint: "));
    let o = tiface(dir.path(), &["mesh"]);
    assert_eq!(code(&o), 2, "{}", err(&o));
}

#[test]
fn an_open_mesh_is_below_the_bar() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("t.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    assert_eq!(code(&tiface(dir.path(), &["check", "t.obj"])), 0);
    let o = tiface(dir.path(), &["check", "t.obj", "--require", "watertight"]);
    assert_eq!(code(&o), 3, "{}", err(&o));
    assert_eq!(code(&tiface(dir.path(), &["check", "t.obj", "--require", "beauty"])), 2);
}

#[test]
#[cfg(unix)]
fn a_closed_stdout_is_not_an_error() {
    use std::process::Stdio;
    let mut child = Command::new(env!("CARGO_BIN_EXE_tiface"))
        .args(["completions", "bash"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!((code(&output), err(&output)), (0, String::new()));
}

#[test]
fn shells_get_their_completions() {
    let dir = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let o = tiface(dir.path(), &["completions", shell]);
        assert!(code(&o) == 0 && out(&o).contains("tiface"), "{shell}");
    }
}
