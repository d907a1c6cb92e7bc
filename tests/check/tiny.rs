//! The smallest run, its files, and the library that gets in the way of its writes.

use crate::command::{command, worked};
use crate::kept::{copy_run, once, photographed};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use tiface::capture::synthetic::SyntheticOptions;

/// A distance field that is learned in a few steps, and a coarse mesh of it.
pub const FIELD: &str = "device=cpu iface.steps=4 iface.rays=64 iface.max_rays=128 iface.samples=1024 iface.levels=4 \
    iface.log2_table=10 iface.occupancy_resolution=16 iface.stereo=0 mesh.resolution=32 mesh.hair=none render.samples=1";

/// All other stages of the smallest run.
const OTHERS: &str = "mask.source=none tface.steps=4 tface.fields=2 tface.rays=64 tface.voxels_start=512 \
    tface.voxels_final=1728 baseline.steps=2 baseline.rays=64 mesh.triangles=300 mesh.texture_px=64 mesh.format=glb,obj \
    render.method=baseline,tface,volume,textured ensemble.members=tface,volume ensemble.weights=0.8,0.2";

pub type Files = BTreeMap<PathBuf, Vec<u8>>;

/// Six photographs in `folder/head`.
pub fn capture(folder: &Path) -> PathBuf {
    let options = SyntheticOptions { width: 24, height: 30, train: 4, test: 2, seed: 1 };
    photographed(&folder.join("head"), &options);
    folder.join("head")
}

/// The program with these words in a folder, and the settings of the smallest run.
pub fn tiface(folder: &Path, words: &[&str]) -> Command {
    let mut command = command(folder, words);
    if !["report", "convert", "preview", "export", "status", "clean"].contains(&words[0]) {
        command.args(["--preset", "draft"]);
        for setting in FIELD.split_whitespace().chain(OTHERS.split_whitespace()) {
            command.args(["--set", setting]);
        }
    }
    command
}

/// The smallest capture and a finished run of it, `head` and `run` in a folder. They are made once
/// a program, to be read.
pub fn kept() -> PathBuf {
    once("tiny", |folder| {
        capture(folder);
        worked(&tiface(folder, &["run", "head", "--run", "run"]).output().unwrap());
    })
}

/// Copies the smallest capture to `folder/head` and its finished run to a folder of this name
/// beside it.
pub fn finished(folder: &Path, run: &str) -> PathBuf {
    copy_run(&kept(), folder, run)
}

/// Compiles `fault/fault.c`; `None`, said aloud, without a compiler.
pub fn shim(folder: &Path) -> Option<PathBuf> {
    let shim = folder.join("fault.so");
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fault/fault.c");
    match Command::new("cc").args(["-shared", "-fPIC", "-o"]).args([&shim, &source]).arg("-ldl").status() {
        Ok(status) => {
            assert!(status.success(), "the library does not compile");
            Some(shim)
        }
        Err(_) => {
            eprintln!("skipped: no `cc` to compile a library that lets writes fail");
            None
        }
    }
}

/// All files with their bytes; what tells when things happened without it.
pub fn files(folder: &Path) -> Files {
    fn walk(folder: &Path, root: &Path, found: &mut Files) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                walk(&path, root, found);
            } else if path.file_name().is_some_and(|n| n != ".lock") {
                found.insert(path.strip_prefix(root).unwrap().into(), std::fs::read(&path).unwrap());
            }
        }
    }
    let mut found = Files::new();
    walk(folder, folder, &mut found);
    found
}

pub fn name(file: &Path) -> &str {
    file.file_name().unwrap().to_str().unwrap()
}

/// Do the bytes tell times, which are others in every run?
pub fn is_timed(file: &Path) -> bool {
    let names = ["done.json", "status.json", "log.jsonl", "failed.json", "report.html", "page.html"];
    names.contains(&name(file))
}

/// Files of two folders with the same names and, but for times, the same bytes.
pub fn same(new: &Files, found: &Files, what: &str) {
    // a temporary file beside a run may belong to another process; and no work ends because its log
    // cannot be written
    let counts =
        |f: &&PathBuf| (f.starts_with("run") || !name(f).ends_with(".tmp")) && name(f) != "log.jsonl";
    let names = |files: &Files| files.keys().filter(counts).cloned().collect::<Vec<_>>();
    assert_eq!(names(new), names(found), "{what}, repeated");
    for (file, bytes) in new.iter().filter(|(file, _)| !is_timed(file)) {
        assert!(found[file] == *bytes, "{what}, repeated: {} differs", file.display());
    }
}
