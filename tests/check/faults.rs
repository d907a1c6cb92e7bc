//! Whatever goes wrong with whichever write, a run is never worse than before the command, no file
//! is half there, and the repeated command ends with the bytes of an undisturbed one.
//!
//! The program is the real one; a library in front of the C library (`fault/fault.c`) lets the n-th
//! change of a file fail. Of every command some n are tried, spread evenly.

use crate::command::err;
use crate::kept::copy;
use crate::tiny::{Files, capture, files, is_timed, name, same, shim, tiface};
use std::path::{Path, PathBuf};
use std::process::Output;
use tiface::io::{Limits, parse_tensors};
use tiface::pipeline::Stage;

/// `full` stays full; `short` is no fault of the disk but must be heard all the same.
const KINDS: [&str; 5] = ["eio", "full", "torn", "kill", "short"];

struct Bench {
    folder: PathBuf,
    shim: PathBuf,
    /// So many changes of files fail at every command.
    most: usize,
}

/// A fault: which change, and what happens to it.
type Fault<'a> = (usize, &'a str);

impl Bench {
    /// Runs the program in a folder, with a fault below it.
    fn run(&self, place: &Path, words: &[&str], fault: Fault) -> Output {
        // the library knows files by their whole path
        let words: Vec<String> = words.iter().map(|w| w.replace("HERE", place.to_str().unwrap())).collect();
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        let mut command = tiface(place, &words);
        command.env("RAYON_NUM_THREADS", "1").env("LD_PRELOAD", &self.shim).env("FAULT_UNDER", place);
        command.env("FAULT_LOG", self.folder.join("log"));
        command.env("FAULT_AT", fault.0.to_string()).env("FAULT_KIND", fault.1).output().unwrap()
    }

    /// Tries a command with faults on copies of a folder, after so many faults of other commands;
    /// returns the folder after an undisturbed one and how many faults were tried.
    fn try_faults(&self, before: &Path, words: &[&str], earlier: usize) -> (PathBuf, usize) {
        let command = words.join(" ");
        let calm = copy(before, &self.folder.join(format!("after {}", words[0])));
        let _ = std::fs::remove_file(self.folder.join("log"));
        let output = self.run(&calm, words, (0, ""));
        assert!(output.status.success(), "{command}: {}", err(&output));
        let log = std::fs::read_to_string(self.folder.join("log")).unwrap();
        let changes = log.lines().count();
        let (old, new) = (files(before), files(&calm));
        let all = self.most == usize::MAX;
        let every = changes.div_ceil(self.most);
        let mut tried = 0;
        for n in (1..=changes).step_by(every) {
            // kinds take turns
            let kinds = if all { &KINDS[..] } else { &KINDS[(earlier + tried) % KINDS.len()..][..1] };
            tried += kinds.len();
            for kind in kinds {
                let what = format!("{command}, {kind} at change {}", log.lines().nth(n - 1).unwrap());
                let place = copy(before, &self.folder.join("place"));
                let output = self.run(&place, words, (n, kind));
                ends_well(&output, kind, &what);
                never_worse(&old, &new, &files(&place), *kind == "kill", &what);
                if !output.status.success() {
                    let again = self.run(&place, words, (0, ""));
                    assert!(again.status.success(), "{what}, repeated: {}", err(&again));
                }
                same(&new, &files(&place), &what);
            }
        }
        eprintln!("{command}: {changes} changes of files, {tried} faults");
        (calm, tried)
    }
}

/// A fault ends in success, where nothing was lost by it, or in a sentence; never in a crash.
fn ends_well(output: &Output, kind: &str, what: &str) {
    let text = err(output);
    match (kind, output.status.code()) {
        ("kill", None) | (_, Some(0)) => {}
        ("short", code) => panic!("{what}: {code:?} {text}"),
        (_, Some(1)) => {
            let place = text.contains("cannot be") && text.contains('`');
            assert!(text.contains("error: ") && place, "{what}: {text}");
        }
        (_, code) => panic!("{what}: {code:?} {text}"),
    }
}

/// Is a file whose bytes nobody can know whole?
fn is_whole(file: &Path, bytes: &[u8]) -> bool {
    let json = |bytes: &[u8]| serde_json::from_slice::<serde_json::Value>(bytes).is_ok();
    match file.extension().unwrap().to_str().unwrap() {
        "json" => json(bytes),
        // the last line of a log may be torn: it spoils only itself
        "jsonl" => true,
        "html" => bytes.trim_ascii_end().ends_with(b"</html>"),
        "safetensors" => parse_tensors(file, bytes, &Limits::default()).is_ok(),
        _ => false,
    }
}

/// What was there is there, and every file is the old one, the new one, or whole.
fn never_worse(old: &Files, new: &Files, found: &Files, killed: bool, what: &str) {
    for file in old.keys() {
        // what was asked to be made again goes first
        let afresh =
            ["mesh", "render", "ensemble", "metrics"].iter().any(|s| file.starts_with(format!("run/{s}")));
        let goes = !new.contains_key(file) || what.contains("--fresh mesh") && afresh;
        assert!(goes || found.contains_key(file), "{what}: {} is lost", file.display());
    }
    for (file, bytes) in found {
        let known = [old, new].iter().any(|files| files.get(file) == Some(bytes));
        let may_differ = is_timed(file) || name(file).starts_with("checkpoint");
        let left = name(file).ends_with(".tmp");
        assert!(
            known || may_differ && is_whole(file, bytes) || left && killed,
            "{what}: {} is half there",
            file.display()
        );
    }
}

/// Lets so many writes of every command fail, fewer where there is little to write, but at least so
/// many of all.
fn faults_lose_nothing(most: usize, least: usize) {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().canonicalize().unwrap();
    let Some(shim) = shim(&folder) else { return };
    let bench = Bench { folder, shim, most };
    let capture = capture(&bench.folder);
    let mut place = bench.folder.join("empty");
    std::fs::create_dir(&place).unwrap();
    let mut tried = 0;
    for stage in Stage::ALL {
        let capture = capture.to_str().unwrap();
        let (after, count) = bench.try_faults(&place, &[stage.as_str(), capture, "--run", "HERE/run"], tried);
        (place, tried) = (after, tried + count);
    }
    let words: [&[&str]; 7] = [
        &["report", "HERE/run", "--out", "HERE/page.html"],
        &["export", "HERE/run", "--triangles", "200", "--out", "HERE/small.obj"],
        &["mesh", "HERE/run", "--out", "HERE/head.obj"],
        &["render", "HERE/run", "--out", "HERE/views/"],
        &["preview", "HERE/run", "--size", "64", "--out", "HERE/turn.png"],
        &["run", "HERE/run", "--fresh", "mesh"],
        &["clean", "HERE/run", "--yes"],
    ];
    for words in words {
        tried += bench.try_faults(&place, words, tried).1;
    }
    // what is there already is replaced whole
    for file in
        ["page.html", "head.obj", "head.mtl", "head.png", "small.obj", "small.mtl", "small.png", "turn.png"]
    {
        std::fs::write(place.join(file), "old").unwrap();
    }
    for words in &words[..5] {
        tried += bench.try_faults(&place, words, tried).1;
    }
    eprintln!("{tried} faults, nothing lost");
    assert!(tried >= least, "{tried}");
}

#[test]
fn a_fault_in_some_write_of_every_command_loses_nothing_and_the_repeated_command_completes() {
    faults_lose_nothing(3, 28);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; a dozen faults at every command, or every fault at every write with \
            TIFACE_FAULTS=all"]
fn a_fault_in_any_write_of_any_stage_loses_nothing_and_the_repeated_command_completes() {
    let all = std::env::var("TIFACE_FAULTS").is_ok_and(|v| v == "all");
    faults_lose_nothing(if all { usize::MAX } else { 12 }, 50);
}
