//! `status.json` and `done.json`: progress and record of a stage; `estimate.json`: estimated cost of the stages of a run;
//! [`RunStatus`]: the state of a whole run, from the files of its stages.

use super::{Fingerprint, LOCK};
use crate::config::{Config, Stage, key};
use crate::io::{self, Limits, ReadError};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt::{self, Display};
use std::ops::Add;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// The state of a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// A process is computing it, or was killed meanwhile.
    Running,
    /// Complete.
    Done,
    /// Stopped on request after saving.
    Stopped,
    /// Ended by an error.
    Failed,
}

/// `status.json`, replaced as a whole about once a second.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// Its state.
    pub state: State,
    /// Steps done.
    pub step: u64,
    /// Total number of steps; 0 while unknown.
    pub steps: u64,
    /// Recent steps per second.
    pub rate: Option<f64>,
    /// Seconds left at this rate.
    pub eta_s: Option<f64>,
    /// Seconds of work so far, including earlier, stopped processes.
    pub elapsed_s: f64,
    /// The requested device.
    pub device: String,
    /// The process.
    pub pid: u32,
    /// The machine.
    pub host: String,
    /// The error that ended it.
    pub error: Option<String>,
    /// When this was written, in seconds since 1970; for users, nothing depends on it.
    pub updated: u64,
    /// Fingerprint of the result, so that a stage begun with other settings is detected.
    pub fingerprint: Fingerprint,
}

impl Status {
    /// Returns the steps done, in whole per cent; `None` while the total is unknown.
    pub fn percent(&self) -> Option<u64> {
        let share = self.step as f64 / self.steps as f64;
        (self.steps > 0).then_some((100.0 * share.min(1.0)) as u64)
    }
}

/// `done.json`: the stage is complete.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// The stage.
    pub stage: String,
    /// Everything that affected the result.
    pub fingerprint: Fingerprint,
    /// Digest of the fingerprint, an input of the stages that depend on this one.
    pub digest: String,
    /// Figures of the result.
    pub summary: Value,
    /// Seconds of work.
    pub elapsed_s: f64,
    /// CPU seconds of the process that finished it; `None` in older records.
    #[serde(default)]
    pub cpu_s: Option<f64>,
    /// Peak memory of the process, bytes; `None` if the system does not report it.
    #[serde(default)]
    pub peak_bytes: Option<u64>,
    /// Warnings.
    #[serde(default)]
    pub warnings: Vec<String>,
    /// Size of each file of the stage, bytes, by its path in the stage's folder; empty in older records.
    #[serde(default)]
    pub products: BTreeMap<String, u64>,
    /// SHA-256 of the same files, hexadecimal; empty in older records.
    #[serde(default)]
    pub sha256: BTreeMap<String, String>,
    /// Seconds since 1970.
    pub finished: u64,
    /// Version of `tiface`.
    pub version: String,
}

/// Files that record times, and are no products of a stage.
pub(super) const TIMED: [&str; 3] = ["done.json", "status.json", "log.jsonl"];

/// Files that no stage reads; a run is complete without them. `tiface export` writes the head again from the stage's
/// folder `parts`.
const EXPORTS: [&str; 10] = [
    "head.glb",
    "head.obj",
    "head.mtl",
    "head.ply",
    "head.png",
    "head.jpg",
    "head.exr",
    "surface.ply",
    "sheet.html",
    "inputs.json",
];

/// The state of a product, compared with its record.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ProductState {
    /// As its stage left it, as far as was compared.
    Recorded,
    /// It has other contents, or more bytes.
    Changed,
    /// It has fewer bytes.
    Cut,
    /// It is not there.
    Gone,
}

/// A product of a finished stage that is not as the stage left it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// Its state.
    pub state: ProductState,
    /// Whether no stage reads the file.
    pub is_export: bool,
    /// A sentence that names the file.
    pub problem: String,
    /// The command that makes the file again.
    pub again: String,
}

impl Fault {
    /// Returns whether the run is complete all the same: the file may have been moved by its user.
    pub fn is_harmless(&self) -> bool {
        self.is_export && self.state == ProductState::Gone
    }
}

/// Shows the problem and the command that mends it.
impl Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}; `{}` makes it again", self.problem, self.again)
    }
}

impl Record {
    /// Returns the fault of one of the stage's files, if it is missing from the stage's folder or has another size.
    pub fn fault(&self, folder: &Path, name: &str) -> Option<Fault> {
        let (file, bytes) = (folder.join(name), *self.products.get(name)?);
        let (state, problem) = match io::file_size(&file) {
            Some(found) if found == bytes => return None,
            Some(found) => (
                if found < bytes { ProductState::Cut } else { ProductState::Changed },
                format!("has {found} bytes, but the stage `{}` left {bytes}", self.stage),
            ),
            None => (ProductState::Gone, format!("is missing, though the stage `{}` is done", self.stage)),
        };
        Some(self.faulty(folder, name, state, &problem))
    }

    /// Returns the files of the stage that are missing from its folder or have another size.
    pub fn faults(&self, folder: &Path) -> Vec<Fault> {
        self.products.keys().filter_map(|name| self.fault(folder, name)).collect()
    }

    /// Returns a fault of a file of the stage; `problem` is what comes after its name.
    pub(super) fn faulty(&self, folder: &Path, name: &str, state: ProductState, problem: &str) -> Fault {
        let problem = format!("`{}` {problem}", folder.join(name).display());
        Fault { state, is_export: EXPORTS.contains(&name), problem, again: self.again(folder, name) }
    }

    /// Returns the command that makes a file of the stage again.
    fn again(&self, folder: &Path, name: &str) -> String {
        let run = folder.ancestors().nth(self.stage.split('/').count()).unwrap_or(folder).display();
        let exported = match name {
            "head.glb" | "head.ply" => Some(name),
            // an OBJ refers to the other files
            "head.obj" | "head.mtl" | "head.png" | "head.jpg" => Some("head.obj"),
            _ => None,
        };
        match (exported, self.stage.split_once('/')) {
            (Some(name), None) => format!("tiface export {run} --out {}", folder.join(name).display()),
            (_, Some((owner, _))) => {
                let cameras = self.fingerprint.settings.get(key!(render.cameras));
                let cameras = cameras.map_or("FILE", |word| word.trim_matches('"'));
                format!("tiface {owner} {run} --cameras {cameras} --fresh {owner}")
            }
            (None, None) => format!("tiface run {run} --fresh {}", self.stage),
        }
    }

    /// Compares the files in the stage's folder with those that the stage left. Returns the exported files that were moved
    /// away.
    ///
    /// # Errors
    ///
    /// Fails if another file is missing from the folder, or has another size.
    pub fn require_products(&self, folder: &Path) -> Result<Vec<Fault>> {
        let faults = self.faults(folder);
        match faults.iter().find(|fault| !fault.is_harmless()) {
            Some(fault) => Err(self.error(fault)),
            None => Ok(faults),
        }
    }

    /// Returns a fault of one of the stage's files as an error.
    pub fn error(&self, fault: &Fault) -> Error {
        let stage = self.stage.split('/').next().unwrap_or_default();
        let put_back = match fault.is_export {
            true if fault.again.starts_with("tiface export") => format!("`{}` puts it back", fault.again),
            true if fault.state != ProductState::Gone => {
                "put the file back, remove it, for no stage reads it".into()
            }
            _ => "put the file back".into(),
        };
        let hint = format!("{put_back}, or recompute the stage and what follows with `--fresh {stage}`");
        Error::cannot(&fault.problem, hint)
    }
}

/// Returns the `status.json` of a stage folder; `None` if it does not exist.
pub fn read_status(folder: &Path) -> Result<Option<Status>, ReadError> {
    let path = folder.join("status.json");
    let status: Option<Status> = read(&path)?;
    if let Some(s) = &status {
        let seconds = [("elapsed_s", Some(s.elapsed_s)), ("eta_s", s.eta_s), ("rate", s.rate)];
        seconds.into_iter().try_for_each(|(key, value)| not_negative(&path, key, value))?;
    }
    Ok(status)
}

/// Returns the `done.json` of a stage folder; `None` if it does not exist.
pub fn read_record(folder: &Path) -> Result<Option<Record>, ReadError> {
    let path = folder.join("done.json");
    let record: Option<Record> = read(&path)?;
    if let Some(r) = &record {
        not_negative(&path, "elapsed_s", Some(r.elapsed_s))?;
        not_negative(&path, "cpu_s", r.cpu_s)?;
        let digest = r.fingerprint.digest();
        if r.digest != digest {
            return Err(ReadError::value(&path, "digest", &r.digest, format!("{digest}, its fingerprint's")));
        }
        if !folder.ends_with(&r.stage) {
            return Err(ReadError::value(&path, "stage", &r.stage, "the name of its folder"));
        }
    }
    Ok(record)
}

/// Serializes times and rates; JSON has no number that is not finite.
fn not_negative(path: &Path, key: &str, value: Option<f64>) -> Result<(), ReadError> {
    match value.filter(|v| !(0.0..=1e15).contains(v)) {
        Some(v) => Err(ReadError::value(path, key, v, "a number from 0 to 1e15")),
        None => Ok(()),
    }
}

fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Result<Option<T>, ReadError> {
    if !io::is_file(path) {
        return Ok(None);
    }
    io::read_typed(path, &Limits::default()).map(Some)
}

/// Seconds since 1970; 0 if the clock is before that.
pub(super) fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// Returns the machine's name, as far as it is known without asking the network.
pub(super) fn host() -> String {
    let kernel = io::read_bytes(Path::new("/proc/sys/kernel/hostname"), &Limits::default());
    match kernel.map(|b| String::from_utf8_lossy(&b).trim().to_string()) {
        Ok(name) if !name.is_empty() => name,
        _ => std::env::var("HOSTNAME").or_else(|_| std::env::var("COMPUTERNAME")).unwrap_or_default(),
    }
}

/// Its file name in a run.
pub const ESTIMATE: &str = "estimate.json";

/// Estimated cost of a stage; displays correct it by measured times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// CPU seconds.
    pub cpu_s: f64,
    /// Peak memory of the process, bytes.
    pub memory_bytes: u64,
    /// Disk space of the files that it leaves, bytes.
    pub disk_bytes: u64,
}

impl Cost {
    /// Returns the seconds by the clock on this machine, with nothing else at work on it.
    pub fn seconds(&self) -> f64 {
        self.cpu_s / rayon::current_num_threads().max(1) as f64
    }
}

/// Sums costs of stages that run one after the other: times and files add up, memory is the maximum.
impl Add for Cost {
    type Output = Cost;

    fn add(self, other: Cost) -> Cost {
        Cost {
            cpu_s: self.cpu_s + other.cpu_s,
            memory_bytes: self.memory_bytes.max(other.memory_bytes),
            disk_bytes: self.disk_bytes.saturating_add(other.disk_bytes),
        }
    }
}

/// The planned stages of a run, by name, with the estimated cost of each.
pub type Estimate = BTreeMap<String, Cost>;

/// Returns the `estimate.json` of a run; `None` if it does not exist.
pub fn read_estimate(run: &Path) -> Result<Option<Estimate>, ReadError> {
    let path = run.join(ESTIMATE);
    if !io::is_file(&path) {
        return Ok(None);
    }
    let estimate: Estimate = io::read_typed(&path, &Limits::default())?;
    match estimate.iter().find(|(_, cost)| !(0.0..=1e12).contains(&cost.cpu_s)) {
        Some((stage, c)) => {
            Err(ReadError::value(&path, format!("{stage}.cpu_s"), c.cpu_s, "a number from 0 to 1e12"))
        }
        None => Ok(Some(estimate)),
    }
}

/// The state of a stage or a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// Not begun.
    Waiting,
    /// A process is computing it; on another machine: no end was recorded.
    Running,
    /// Its process has ended without recording a reason.
    Killed,
    /// Stopped on request after saving.
    Stopped,
    /// Ended by an error.
    Failed,
    /// Its files cannot be read.
    Unreadable,
    /// Complete, but a file that was left is missing or has another size.
    Damaged,
    /// For a run: some stages are done, none is running.
    Begun,
    /// Complete.
    Done,
}

/// A stage of a run.
#[derive(Clone, Debug)]
pub struct StageStatus {
    /// The stage.
    pub stage: Stage,
    /// Its state.
    pub phase: Phase,
    /// Its `status.json`.
    pub status: Option<Status>,
    /// Its `done.json`.
    pub record: Option<Record>,
    /// Its error, or why it cannot be read.
    pub error: Option<String>,
    /// Files that are not as it left them, by their sizes.
    pub faults: Vec<Fault>,
    /// Estimated seconds left (wall clock).
    pub left_s: f64,
}

/// The state of a run.
#[derive(Clone, Debug)]
pub struct RunStatus {
    /// The planned stages, in order; all stages if the run has no plan.
    pub stages: Vec<StageStatus>,
    /// Its state.
    pub phase: Phase,
    /// The running stage, else the last one that ended unfinished.
    pub at: Option<Stage>,
    /// The error of a command on it, or of one of its stages.
    pub error: Option<String>,
    /// Estimated seconds left of all stages (wall clock), at the measured speed of those that are done; `None` without
    /// an estimate.
    pub left_s: Option<f64>,
    /// Seconds of work so far.
    pub elapsed_s: f64,
}

/// `failed.json`: the error of a command that ended before its first stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// The problem.
    pub error: String,
    /// The suggested fix.
    pub hint: String,
    /// The exit code.
    pub exit: u8,
}

/// Its name in a run.
pub const FAILED: &str = "failed.json";

impl RunStatus {
    /// Reads the state of the run in a folder; missing and damaged files are part of the state.
    pub fn read(run: &Path) -> RunStatus {
        let estimate = read_estimate(run).unwrap_or_default();
        let is_part = |stage: &Stage| estimate.as_ref().is_none_or(|e| e.contains_key(stage.as_str()));
        let mut stages: Vec<StageStatus> =
            Stage::ALL.into_iter().filter(is_part).map(|s| StageStatus::read(&run.join(s), s)).collect();
        let cost = |s: &StageStatus| estimate.as_ref()?.get(s.stage.as_str()).map(|c| c.seconds());
        // the machine that works on it may be faster or slower, and do other things besides; what networks do for masks
        // says nothing about that
        let done = stages.iter().filter(|s| s.stage != Stage::Mask);
        let done = done.filter_map(|s| Some((s.record.as_ref()?.elapsed_s, cost(s)?)));
        let (took, estimated) = done.fold((0.0, 0.0), |(a, b), (took, cost)| (a + took, b + cost));
        let pace = if estimated > 1.0 { (took / estimated).clamp(0.02, 50.0) } else { 1.0 };
        for s in &mut stages {
            s.left_s = match (s.phase, &s.status) {
                (Phase::Done | Phase::Damaged, _) => 0.0,
                (Phase::Running, Some(Status { eta_s: Some(eta), .. })) => *eta,
                (phase, status) => {
                    let all = cost(s).unwrap_or(0.0) * pace;
                    let kept = phase != Phase::Waiting && s.stage.learns();
                    let share = status.as_ref().filter(|s| kept && s.steps > 0);
                    all * (1.0 - share.map_or(0.0, |s| (s.step as f64 / s.steps as f64).min(1.0)))
                }
            };
        }
        let failure = read_failure(run);
        let settings = Some(run.join("config.toml")).filter(|file| io::is_file(file));
        let settings = settings.and_then(|file| Config::read(&file).err());
        let has = |phase: Phase| stages.iter().rev().find(|s| s.phase == phase);
        let is_done = match &estimate {
            Some(_) => stages.iter().all(|s| s.phase == Phase::Done),
            None => {
                let is_last = |s: &StageStatus| s.stage == Stage::Metrics && s.phase == Phase::Done;
                stages.iter().any(is_last) && has(Phase::Damaged).is_none()
            }
        };
        let worst =
            [Phase::Running, Phase::Unreadable, Phase::Failed, Phase::Damaged, Phase::Killed, Phase::Stopped];
        let found = worst.into_iter().find_map(has).map(|s| (s.phase, Some(s.stage)));
        let (phase, at) = match found {
            _ if is_done && settings.is_none() => (Phase::Done, None),
            Some((Phase::Running, at)) => (Phase::Running, at),
            _ if settings.is_some() => (Phase::Unreadable, None),
            _ if failure.is_some() => (Phase::Failed, None),
            Some(found) => found,
            None if has(Phase::Done).is_some() => (Phase::Begun, None),
            None => (Phase::Waiting, None),
        };
        let of_stage = at.and_then(|at| stages.iter().find(|s| s.stage == at)?.error.clone());
        let of_run = match phase {
            Phase::Failed => failure.map(|f| f.error),
            Phase::Unreadable => settings.map(|e| e.to_string()),
            _ => None,
        };
        let error = of_stage.or(of_run);
        let elapsed = |s: &StageStatus| {
            let kept = s.status.as_ref().map_or(0.0, |s| s.elapsed_s);
            s.record.as_ref().map_or(kept, |r| r.elapsed_s)
        };
        RunStatus {
            elapsed_s: stages.iter().map(elapsed).sum(),
            left_s: estimate.is_some().then(|| stages.iter().map(|s| s.left_s).sum()),
            stages,
            phase,
            at,
            error,
        }
    }
}

impl StageStatus {
    /// Reads the state of a stage from the files in its folder.
    pub fn read(folder: &Path, stage: Stage) -> StageStatus {
        let (record, status) = (read_record(folder), read_status(folder));
        let unreadable = record.as_ref().err().or(status.as_ref().err()).map(|e| e.to_string());
        let (record, status) = (record.unwrap_or_default(), status.unwrap_or_default());
        let faults = record.as_ref().map_or(Vec::new(), |record| record.faults(folder));
        let damage = faults.iter().find(|fault| !fault.is_harmless());
        // the record is the truth: it is written after the status that says "done"
        let phase = match (&record, &unreadable, &status) {
            (Some(_), _, _) if damage.is_some() => Phase::Damaged,
            (Some(_), _, _) => Phase::Done,
            (None, Some(_), _) => Phase::Unreadable,
            (None, None, None) => Phase::Waiting,
            (None, None, Some(s)) => match s.state {
                State::Running | State::Done if is_alive(s, folder) => Phase::Running,
                State::Running | State::Done => Phase::Killed,
                State::Stopped => Phase::Stopped,
                State::Failed => Phase::Failed,
            },
        };
        let error = match phase {
            Phase::Unreadable => unreadable,
            Phase::Damaged => damage.map(Fault::to_string),
            Phase::Failed => Some(status.as_ref().and_then(|s| s.error.clone()).unwrap_or_default()),
            _ => None,
        };
        StageStatus { stage, phase, status, record, error, faults, left_s: 0.0 }
    }
}

/// Returns whether the process of a status still runs; unknown, so assumed, for one on another machine.
fn is_alive(status: &Status, folder: &Path) -> bool {
    status.host != host() || io::has_open(status.pid, &folder.join(LOCK))
}

/// Returns the `failed.json` of a run; nothing if it cannot be read, for it only tells of others.
pub fn read_failure(run: &Path) -> Option<Failure> {
    let path = run.join(FAILED);
    io::is_file(&path).then(|| io::read_typed(&path, &Limits::default()).ok()).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// Returns what reading `name` says after `change`.
    fn after(name: &str, change: &dyn Fn(&mut Value)) -> Option<ReadError> {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("iface");
        std::fs::create_dir(&folder).unwrap();
        let fingerprint = Fingerprint::default().setting("iface.steps", 5);
        let digest = fingerprint.digest();
        let mut value = match name {
            "done.json" => json!({
                "stage": "iface", "fingerprint": fingerprint, "digest": digest, "summary": {}, "elapsed_s": 2.0,
                "finished": 1, "version": "0",
            }),
            _ => json!({
                "state": "running", "step": 1, "steps": 5, "rate": 2.0, "eta_s": 2.0, "elapsed_s": 0.5,
                "device": "cpu", "pid": 1, "host": "h", "error": null, "updated": 1, "fingerprint": fingerprint,
            }),
        };
        change(&mut value);
        std::fs::write(folder.join(name), value.to_string()).unwrap();
        match name {
            "done.json" => read_record(&folder).err(),
            _ => read_status(&folder).err(),
        }
    }

    #[test]
    fn hostile_records_and_statuses_are_refused_with_their_key() {
        assert!(after("done.json", &|_| {}).is_none() && after("status.json", &|_| {}).is_none());
        let rows: [(&str, &str, Value); 8] = [
            ("done.json", "elapsed_s", json!(-1.0)),
            ("done.json", "elapsed_s", json!(1e300)),
            ("done.json", "digest", json!("0")),
            ("done.json", "stage", json!("tface")),
            ("status.json", "elapsed_s", json!(-0.5)),
            ("status.json", "eta_s", json!(-3)),
            ("status.json", "eta_s", json!(1e300)),
            ("status.json", "rate", json!(-1e-9)),
        ];
        for (name, key, value) in rows {
            match after(name, &|v| v[key] = value.clone()) {
                Some(ReadError::Value { path, key: named, .. }) => {
                    assert!(named == key && path.ends_with(name), "{name}, {key}: {named}");
                }
                other => panic!("{name}, {key}: {other:?}"),
            }
        }
        // of another type, and another setting than the digest was made of
        assert!(
            after("status.json", &|v| v["step"] = json!(-1)).unwrap().to_string().contains("status.json")
        );
        let other = |v: &mut Value| v["fingerprint"]["settings"]["iface.steps"] = json!("6");
        assert!(after("done.json", &other).unwrap().to_string().contains("`digest`"));
    }

    #[test]
    fn stages_one_after_the_other_need_the_memory_of_the_greediest() {
        let [a, b] = [(2.0, 7, 10), (3.0, 5, 20)].map(|(cpu_s, memory_bytes, disk_bytes)| Cost {
            cpu_s,
            memory_bytes,
            disk_bytes,
        });
        assert_eq!(a + b, Cost { cpu_s: 5.0, memory_bytes: 7, disk_bytes: 30 });
    }

    #[test]
    fn a_foreign_estimate_is_read_or_refused_by_its_key() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(read_estimate(dir.path()).unwrap(), None);
        let read = |text: &str| {
            std::fs::write(dir.path().join(ESTIMATE), text).unwrap();
            read_estimate(dir.path())
        };
        let one = r#"{"mask": {"cpu_s": 2.5, "memory_bytes": 3, "disk_bytes": 4}}"#;
        assert_eq!(read(one).unwrap().unwrap()["mask"].cpu_s, 2.5);
        assert!(read(&one.replace("2.5", "-1")).unwrap_err().to_string().contains("mask.cpu_s"));
        assert!(read(&one.replace("3", "-3")).unwrap_err().to_string().contains("mask.memory_bytes"));
    }
}

#[cfg(test)]
mod run_tests {
    use super::*;
    use crate::run::{ESTIMATE, Plan, Run};
    use crate::run::{Fingerprint, StageDir};
    use crate::{Error, Result};
    use serde_json::{Value, json};

    fn plan(stage: &str) -> Plan<'_> {
        Plan {
            name: stage,
            fingerprint: Fingerprint::default(),
            device: "cpu",
            needs_bytes: 0,
            saves: stage == "iface",
        }
    }

    fn expect(run: &Path) {
        let cost = |s: f64| json!({"cpu_s": s * rayon::current_num_threads() as f64, "memory_bytes": 0, "disk_bytes": 0});
        let text = json!({"mask": cost(10.0), "iface": cost(100.0), "metrics": cost(20.0)}).to_string();
        std::fs::write(run.join(ESTIMATE), text).unwrap();
    }

    #[test]
    fn a_run_stands_where_its_stages_do_and_the_rest_takes_as_much_longer_as_what_is_done() {
        let dir = tempfile::tempdir().unwrap();
        let run = Run::quiet(dir.path());
        let read = || RunStatus::read(dir.path());
        assert_eq!((read().phase, read().left_s, read().stages.len()), (Phase::Waiting, None, 8));
        expect(dir.path());
        assert_eq!((read().left_s, read().stages.len()), (Some(130.0), 3));

        run.stage(plan("mask"), |_| Ok(Value::Null)).unwrap();
        assert_eq!((read().phase, read().left_s), (Phase::Begun, Some(120.0)));
        run.stage(plan("metrics"), |_| Ok(Value::Null)).unwrap();
        // as if it had taken twice what was estimated
        let record = dir.path().join("metrics/done.json");
        let mut value: Value = serde_json::from_slice(&std::fs::read(&record).unwrap()).unwrap();
        assert!(value["cpu_s"].as_f64().is_some());
        value["elapsed_s"] = json!(40.0);
        std::fs::write(&record, value.to_string()).unwrap();
        assert_eq!((read().phase, read().left_s), (Phase::Begun, Some(200.0)));
        assert!((40.0..41.0).contains(&read().elapsed_s));

        // at work, this very process holds the lock; a quarter is done
        let work = |stage: &StageDir| -> Result<Value> {
            stage.monitor().step(1, 4, &[]);
            let now = read();
            assert_eq!((now.phase, now.at), (Phase::Running, Some(Stage::Iface)));
            Err(Error::cannot("no light", "lamp"))
        };
        run.stage(plan("iface"), work).unwrap_err();
        let now = read();
        assert_eq!(
            (now.phase, now.at, now.error.as_deref()),
            (Phase::Failed, Some(Stage::Iface), Some("no light"))
        );
        assert_eq!(now.left_s, Some(0.75 * 200.0));
    }

    #[test]
    fn a_process_that_is_gone_was_killed_and_one_elsewhere_may_be_at_work() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("iface");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join(LOCK), "").unwrap();
        let phase = |pid: u32, host: &str| {
            let status = json!({"state": "running", "step": 0, "steps": 0, "rate": null, "eta_s": null,
                "elapsed_s": 1.0, "device": "cpu", "pid": pid, "host": host, "error": null, "updated": 0,
                "fingerprint": Fingerprint::default()});
            std::fs::write(folder.join("status.json"), status.to_string()).unwrap();
            RunStatus::read(dir.path()).phase
        };
        let here = crate::run::status::host();
        // no process has this number, and ours, another one's before, has not opened the lock
        assert_eq!(phase(u32::MAX, &here), Phase::Killed);
        #[cfg(target_os = "linux")]
        assert_eq!(phase(std::process::id(), &here), Phase::Killed);
        let _held = std::fs::File::open(folder.join(LOCK)).unwrap();
        assert_eq!(phase(std::process::id(), &here), Phase::Running);
        assert_eq!(phase(u32::MAX, "another machine"), Phase::Running);
    }

    #[test]
    fn what_a_command_ended_with_before_any_stage_is_told_until_the_run_is_done() {
        let dir = tempfile::tempdir().unwrap();
        let failure = Failure { error: "no cameras".into(), hint: "add them".into(), exit: 1 };
        std::fs::write(dir.path().join(FAILED), serde_json::to_string(&failure).unwrap()).unwrap();
        let now = RunStatus::read(dir.path());
        assert_eq!((now.phase, now.error.as_deref()), (Phase::Failed, Some("no cameras")));
        Run::quiet(dir.path()).stage(plan("metrics"), |_| Ok(Value::Null)).unwrap();
        let now = RunStatus::read(dir.path());
        assert_eq!((now.phase, now.error), (Phase::Done, None));
    }

    #[test]
    fn a_file_that_is_gone_is_not_to_be_removed() {
        let dir = tempfile::tempdir().unwrap();
        let (folder, file) = (dir.path().join("mesh"), dir.path().join("mesh/surface.ply"));
        let made = Run::quiet(dir.path()).stage(plan("mesh"), |_| {
            io::write_atomic(&file, b"triangles")?;
            Ok(Value::Null)
        });
        assert!(!made.unwrap().skipped);
        let record = read_record(&folder).unwrap().unwrap();
        let hint = || record.error(&record.faults(&folder)[0]).hint().to_string();
        std::fs::write(&file, b"tri").unwrap();
        assert!(hint().starts_with("put the file back, remove it, for no stage reads it, or"), "{}", hint());
        std::fs::remove_file(&file).unwrap();
        assert!(hint().starts_with("put the file back, or recompute"), "{}", hint());
    }

    #[test]
    fn a_stage_with_a_file_that_was_cut_or_lost_is_not_done() {
        let dir = tempfile::tempdir().unwrap();
        let run = Run::quiet(dir.path());
        let names = ["head.glb", "parts"];
        run.stage(plan("mesh"), |stage| {
            for name in names {
                io::write_atomic(&stage.folder().join(name), b"triangles")?;
            }
            Ok(Value::Null)
        })
        .unwrap();
        run.stage(plan("metrics"), |_| Ok(Value::Null)).unwrap();
        assert_eq!(RunStatus::read(dir.path()).phase, Phase::Done);
        let [head, parts] = names.map(|name| dir.path().join("mesh").join(name));
        // a file that no stage reads may be moved, which is told
        std::fs::remove_file(&head).unwrap();
        let mesh = StageStatus::read(&dir.path().join("mesh"), Stage::Mesh);
        assert_eq!((mesh.phase, mesh.faults.len()), (Phase::Done, 1));
        assert_eq!(mesh.faults[0].state, ProductState::Gone);
        let export = format!("tiface export {} --out {}", dir.path().display(), head.display());
        assert_eq!(mesh.faults[0].again, export);
        assert_eq!(RunStatus::read(dir.path()).phase, Phase::Done);
        // but not cut
        std::fs::write(&head, b"tri").unwrap();
        let now = RunStatus::read(dir.path());
        assert_eq!((now.phase, now.at), (Phase::Damaged, Some(Stage::Mesh)));
        let error = now.error.unwrap_or_default();
        assert!(error.contains("has 3 bytes") && error.contains(&export), "{error}");
        std::fs::write(&head, b"triangles").unwrap();
        std::fs::remove_file(&parts).unwrap();
        let error = RunStatus::read(dir.path()).error.unwrap_or_default();
        let again = format!("`tiface run {} --fresh mesh`", dir.path().display());
        assert!(error.contains("is missing") && error.contains(&again), "{error}");
    }
}
