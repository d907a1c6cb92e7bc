//! The state of a whole run, from the files of its stages.

use super::LOCK;
use super::estimate::read_estimate;
use super::failure::read_failure;
use super::record::{Fault, Record, read_record};
use super::status::{State, Status, host, read_status};
use crate::config::{Config, SETTINGS_FILE, Stage};
use serde::Serialize;
use std::path::Path;
use tiface_base::io;

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
    /// Estimated seconds left of all stages (wall clock), at the measured speed of those that are
    /// done; `None` without an estimate.
    pub left_s: Option<f64>,
    /// Seconds of work so far.
    pub elapsed_s: f64,
}

impl RunStatus {
    /// Reads the state of the run in a folder; missing and damaged files are part of the state.
    pub fn read(run: &Path) -> RunStatus {
        let estimate = read_estimate(run).unwrap_or_default();
        let is_part = |stage: &Stage| estimate.as_ref().is_none_or(|e| e.contains_key(stage.as_str()));
        let mut stages: Vec<StageStatus> =
            Stage::ALL.into_iter().filter(is_part).map(|s| StageStatus::read(&run.join(s), s)).collect();
        let cost = |s: &StageStatus| estimate.as_ref()?.get(s.stage.as_str()).map(|c| c.seconds());
        // the machine that works on it may be faster or slower, and do other things besides; what
        // networks do for masks says nothing about that
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
        let settings = Some(run.join(SETTINGS_FILE)).filter(|file| io::is_file(file));
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

/// Returns whether the process of a status still runs; unknown, so assumed, for one on another
/// machine.
fn is_alive(status: &Status, folder: &Path) -> bool {
    status.host != host() || io::has_open(status.pid, &folder.join(LOCK))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::{ESTIMATE, FAILED, Failure, Plan, ProductState, Run, StageDir};
    use serde_json::{Value, json};
    use tiface_base::{Error, Fingerprint, Result};

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
