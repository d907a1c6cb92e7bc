//! Trainings that are stopped, resumed and refused, for the tests of every learned field.

use super::checkpoint::newest;
use super::training::TrainingSession;
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use tiface_base::io::{Limits, TensorValues, Tensors, read_tensors, write_tensors};
use tiface_base::{Monitor, Quiet, Result};
use tiface_capture::testing::Files;

pub fn temporary() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

/// Returns a session that trains on the CPU from seed 3.
pub fn session<'a>(
    stage: &'static str,
    dir: &'a Path,
    identity: &'a str,
    monitor: &'a dyn Monitor,
) -> TrainingSession<'a> {
    TrainingSession { stage, seed: 3, device: "cpu", dir, identity, monitor }
}

/// A monitor that requests a stop after a number of steps.
pub struct StopAfter(AtomicU64);

impl StopAfter {
    pub fn new(steps: u64) -> StopAfter {
        StopAfter(AtomicU64::new(steps))
    }
}

impl Monitor for StopAfter {
    fn step(&self, _: u64, _: u64, _: &[(&str, f64)]) {
        self.0.fetch_sub(1, Ordering::SeqCst);
    }
    fn stop(&self) -> bool {
        self.0.load(Ordering::SeqCst) == 0
    }
}

/// Rewrites the newest checkpoint of a stage folder with a change applied.
pub fn tampered(dir: &Path, change: impl FnOnce(&mut Tensors)) {
    let path = newest(dir);
    let mut all = read_tensors(&path, &Limits::default()).unwrap();
    change(&mut all);
    let tensors: Vec<_> = all.0.into_iter().map(|(name, (shape, values))| (name, shape, values)).collect();
    write_tensors(&path, &tensors, &all.1).unwrap();
}

/// Returns a change that sets an entry of the header.
pub fn says(key: &str, value: &str) -> impl Fn(&mut Tensors) {
    move |(_, header)| drop(header.insert(key.into(), value.into()))
}

/// Returns a change that makes the first value of a tensor negative.
pub fn negative(name: &str) -> impl Fn(&mut Tensors) {
    move |(tensors, _)| match &mut tensors.get_mut(name).unwrap().1 {
        TensorValues::F32(values) => values[0] = -1.0,
        other => panic!("{name}: {other:?}"),
    }
}

/// Returns a change that overwrites a vector of integers.
pub fn words(name: &str, values: [u64; 3]) -> impl Fn(&mut Tensors) {
    move |(tensors, _)| match &mut tensors.get_mut(name).unwrap().1 {
        TensorValues::U64(words) => words.copy_from_slice(&values),
        other => panic!("{name}: {other:?}"),
    }
}

/// Copies a stage folder, from which a training then goes on in two ways.
pub fn copied(from: &Path) -> tempfile::TempDir {
    let dir = temporary();
    for file in std::fs::read_dir(from).unwrap().map(|f| f.unwrap()) {
        std::fs::copy(file.path(), dir.path().join(file.file_name())).unwrap();
    }
    dir
}

/// A function that trains in a folder and returns the warnings.
pub type Run<'a> = &'a dyn Fn(&Path, &dyn Monitor) -> Result<Vec<String>>;

/// Returns the bytes of the newest checkpoint.
pub fn bytes(dir: &Path) -> Vec<u8> {
    std::fs::read(newest(dir)).unwrap()
}

/// Returns the checkpoint that a training begins with, and what lies in its folder at its end.
pub(crate) fn undisturbed(run: Run) -> [Files; 2] {
    /// Keeps the files that lie in a folder after the first step.
    struct First<'a>(&'a Path, OnceLock<Files>);
    impl Monitor for First<'_> {
        fn step(&self, _: u64, _: u64, _: &[(&str, f64)]) {
            self.1.get_or_init(|| Files::read(self.0));
        }
        fn stop(&self) -> bool {
            false
        }
    }
    let dir = temporary();
    let first = First(dir.path(), OnceLock::new());
    run(dir.path(), &first).unwrap();
    [first.1.into_inner().unwrap(), Files::read(dir.path())]
}

/// Asserts that a training stopped `stops` times after 11 steps, whose newest checkpoint is then
/// truncated as by a crash, ends with the same bytes as an uninterrupted training.
pub fn resumes(run: Run, stops: usize) {
    let [_, ended] = undisturbed(run);
    resumes_from([&Files::default(), &ended], run, stops);
}

/// Asserts what [`resumes`] does of a training that begins with some files, where those of the end
/// of an uninterrupted one are known.
pub(crate) fn resumes_from([begun, ended]: [&Files; 2], run: Run, stops: usize) {
    let (undisturbed, stopped) = (temporary(), temporary());
    ended.write(undisturbed.path());
    begun.write(stopped.path());
    for _ in 0..stops {
        assert!(run(stopped.path(), &StopAfter::new(11)).unwrap_err().kind().is_stop());
    }
    let whole = bytes(stopped.path());
    std::fs::write(newest(stopped.path()), &whole[..whole.len() / 2]).unwrap();
    run(stopped.path(), &Quiet).unwrap();
    assert_eq!(bytes(undisturbed.path()), bytes(stopped.path()));
    assert!(!stopped.path().join("checkpoint.previous.safetensors").exists());
}

/// Asserts that each changed checkpoint of a training that was stopped twice is reported with its
/// defect and that the previous checkpoint is used; without a previous one, the error must say how
/// to restart the stage.
pub fn refuses(run: Run, stop_after: u64, stage: &str, rows: &[(&str, &dyn Fn(&mut Tensors))]) {
    let (begun, undisturbed) = (temporary(), temporary());
    for _ in 0..2 {
        assert!(run(begun.path(), &StopAfter::new(stop_after)).is_err());
    }
    run(undisturbed.path(), &Quiet).unwrap();
    for (i, (key, change)) in rows.iter().enumerate() {
        let dir = copied(begun.path());
        tampered(dir.path(), change);
        if i % 4 == 0 {
            let warnings = run(dir.path(), &Quiet).unwrap();
            assert!(warnings.iter().any(|w| w.contains(key) && w.contains("falling back")), "{warnings:?}");
            assert_eq!(bytes(undisturbed.path()), bytes(dir.path()));
        } else {
            // Without the previous checkpoint there is no fallback.
            std::fs::remove_file(dir.path().join("checkpoint.previous.safetensors")).unwrap();
            let e = run(dir.path(), &Quiet).unwrap_err();
            assert!(e.to_string().contains(key) && e.to_string().contains("checkpoint.safetensors"), "{e}");
            assert_eq!(e.hint(), format!("start the stage again with `--fresh {stage}`"));
        }
    }
}
