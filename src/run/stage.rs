//! One stage of a run: skipped, refused, or executed under its lock.

use super::progress::Progress;
use super::record::TIMED;
use super::status::{host, now};
use super::{Event, Fingerprint, Record, Run, State, Status};
use super::{has_record, read_record, read_status};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use tiface_base::io;
use tiface_base::{Error, Monitor, Result};

/// Plan of a stage.
#[derive(Clone, Debug)]
pub struct Plan<'a> {
    /// Name of the stage.
    pub name: &'a str,
    /// Everything that affects the result.
    pub fingerprint: Fingerprint,
    /// The requested device, for `status.json`.
    pub device: &'a str,
    /// Estimated disk space, bytes.
    pub needs_bytes: u64,
    /// Whether the stage saves its progress on a stop request. The process does not wait for a
    /// stage that does not.
    pub saves: bool,
}

/// The folder of a running stage, and its progress reports.
pub struct StageDir {
    folder: std::path::PathBuf,
    identity: String,
    progress: Arc<Progress>,
}

impl StageDir {
    /// Returns the folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Digest of everything that affects the stage's result.
    pub fn identity(&self) -> &str {
        &self.identity
    }

    /// Returns the monitor: progress out, stop request in.
    pub fn monitor(&self) -> &dyn Monitor {
        self.progress.as_ref()
    }

    /// Reports that `step` of `steps` is done.
    ///
    /// # Errors
    ///
    /// Fails after a stop request.
    pub fn step(&self, step: usize, steps: usize) -> Result<()> {
        self.progress.step(step as u64, steps as u64, &[]);
        self.check_stop()
    }

    /// Fails after a stop request.
    pub fn check_stop(&self) -> Result<()> {
        self.progress.check_stop()
    }

    /// Reports a note.
    pub fn note(&self, text: &str) {
        self.progress.note(text);
    }

    /// Keeps a warning for the record of the stage that was reported before it began.
    pub fn keep_warning(&self, text: &str) {
        self.progress.keep_warning(text);
    }

    /// Reports a warning.
    pub fn warn(&self, text: &str) {
        self.progress.warn(text);
    }
}

/// A complete stage.
#[derive(Clone, Debug, PartialEq)]
pub struct Done {
    /// Digest of its fingerprint: an input of the stages that depend on it.
    pub digest: String,
    /// Figures of the result.
    pub summary: Value,
    /// Whether it was already complete.
    pub skipped: bool,
}

impl Run {
    /// Completes a stage: skips it if it is complete, else calls `work` and records the returned
    /// figures.
    ///
    /// ```
    /// use tiface::run::{Fingerprint, Plan, Run};
    ///
    /// let folder = tempfile::tempdir()?;
    /// let run = Run::quiet(folder.path());
    /// let plan = |steps: u32| {
    ///     let fingerprint = Fingerprint::default().setting("iface.steps", steps);
    ///     Plan { name: "iface", fingerprint, device: "cpu", needs_bytes: 0, saves: true }
    /// };
    /// let done = run.stage(plan(5), |_| Ok(29.5.into()))?;
    /// assert_eq!((done.summary.as_f64(), done.skipped), (Some(29.5), false));
    /// assert!(run.stage(plan(5), |_| unreachable!())?.skipped);
    /// // other settings are an error, neither computed nor ignored
    /// let error = run.stage(plan(6), |_| unreachable!()).unwrap_err();
    /// assert!(error.to_string().contains("iface.steps: was 5, is 6"));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// Exit code 75 if another process holds the stage's lock, 1 if it was done or begun with
    /// another fingerprint or if the disk has too little space. `work` leaves the stage's files in
    /// [`StageDir::folder`], complete and durable, before it returns.
    pub fn stage(&self, plan: Plan, work: impl FnOnce(&StageDir) -> Result<Value>) -> Result<Done> {
        let name = plan.name;
        if let Some(exit) = self.stop.requested() {
            return Err(Error::stopped(format!("before stage `{name}`")).with_kind(exit));
        }
        let folder = self.path(name);
        if let Some(done) = self.complete(&plan)? {
            return Ok(done);
        }
        self.is_ours(name)?;
        io::create_folder(&folder)?;
        let _lock = self.lock(name)?;
        // another process may have finished between the check and the lock
        if let Some(done) = self.complete(&plan)? {
            return Ok(done);
        }
        let before_s = self.begun(&plan)?;
        let removed = sweep(&folder)?;
        if removed > 0 {
            self.warn(name, &format!("removed {removed} half-written files of an interrupted process"));
        }
        self.require_room(&plan, 0)?;

        let status = Status {
            state: State::Running,
            step: 0,
            steps: 0,
            rate: None,
            eta_s: None,
            elapsed_s: before_s,
            device: plan.device.into(),
            pid: std::process::id(),
            host: host(),
            error: None,
            updated: now(),
            fingerprint: plan.fingerprint.clone(),
        };
        let (stop, observer) = (self.stop.clone(), self.observer.clone());
        let progress = Arc::new(Progress::new(name, folder.clone(), stop, observer, status));
        let cpu_before_s = io::cpu_seconds();
        io::forget_peak_memory();
        let _at_work = self.stop.at_work(&progress, plan.saves);
        progress.save(|_| {})?;
        self.observer.event(&Event::Started { stage: name });
        let stage = StageDir { folder, identity: plan.fingerprint.digest(), progress };
        match work(&stage) {
            Ok(summary) => self.record(&plan, &stage, summary, io::cpu_seconds() - cpu_before_s),
            Err(failure) => {
                let signal = self.stop.requested().filter(|_| failure.kind().is_stop());
                let failure = signal.map_or(failure.clone(), |kind| failure.with_kind(kind));
                if signal.is_some() {
                    stage.progress.stopped();
                } else {
                    // the failure is the thing to tell, whether or not it can be written down
                    let _ = stage.progress.save(|s| {
                        s.state = State::Failed;
                        s.error = Some(failure.to_string());
                        s.eta_s = None;
                    });
                }
                Err(failure.within(format!("stage `{name}`")))
            }
        }
    }

    /// Checks that the content of the stage's folder was made, or begun, with this plan. Fails with
    /// the differences if not, and if the files were made by no stage; an empty folder is accepted.
    pub fn agrees(&self, plan: &Plan) -> Result<()> {
        // a record that cannot be read counts as none, and is reported when the stage is worked on
        if let Ok(Some(record)) = read_record(&self.path(plan.name)) {
            same(plan, &record.fingerprint, true)?;
            return record.require_products(&self.path(plan.name)).map(|_| ());
        }
        self.is_ours(plan.name)?;
        self.begun(plan).map(|_| ())
    }

    /// Fails if a stage needs more space than its disk has after `removed` bytes are freed.
    pub fn require_room(&self, plan: &Plan, removed: u64) -> Result<()> {
        // a stage's folder may be a link to another disk
        let free = io::free_bytes(&self.path(plan.name)).or_else(|| io::free_bytes(&self.dir));
        let free = free.map(|free| free.saturating_add(removed)).filter(|free| *free < plan.needs_bytes);
        let Some(free) = free else { return Ok(()) };
        let (stage, needed, run) = (plan.name, plan.needs_bytes, self.dir.display());
        Err(Error::cannot(
            format!(
                "stage `{stage}` needs about {needed} bytes, but only {free} are free on the disk of `{run}`"
            ),
            "free space, or place the run on another disk with `--run DIR`",
        ))
    }

    /// Returns the bytes of the files of a stage, by their path in its folder; of what has a record
    /// of its own below it none.
    pub fn files(&self, stage: &str) -> Result<BTreeMap<String, u64>> {
        Ok(io::file_sizes(&self.path(stage), &has_record)?)
    }

    /// Returns whether the stage is complete, as planned.
    pub fn is_done(&self, plan: &Plan) -> bool {
        let record = read_record(&self.path(plan.name));
        record.is_ok_and(|r| r.is_some_and(|r| r.fingerprint == plan.fingerprint))
    }

    /// Returns the finished stage, if its record exists and fits.
    fn complete(&self, plan: &Plan) -> Result<Option<Done>> {
        let record = match read_record(&self.path(plan.name)) {
            Ok(record) => record,
            Err(e) => {
                self.warn(plan.name, &format!("{e}; the stage counts as not done"));
                None
            }
        };
        let Some(record) = record else { return Ok(None) };
        same(plan, &record.fingerprint, true)?;
        for fault in record.require_products(&self.path(plan.name))? {
            self.warn(plan.name, &fault.to_string());
        }
        let Record { digest, summary, .. } = record;
        self.observer.event(&Event::Skipped { stage: plan.name });
        Ok(Some(Done { digest, summary, skipped: true }))
    }

    /// Returns the seconds of work of earlier processes in the folder; fails if they had other
    /// settings.
    fn begun(&self, plan: &Plan) -> Result<f64> {
        let Ok(Some(status)) = read_status(&self.path(plan.name)) else { return Ok(0.0) };
        same(plan, &status.fingerprint, false)?;
        Ok(status.elapsed_s)
    }

    fn record(&self, plan: &Plan, stage: &StageDir, summary: Value, cpu_s: f64) -> Result<Done> {
        let elapsed_s = stage.progress.elapsed_s();
        stage.progress.save(|s| {
            s.state = State::Done;
            s.eta_s = None;
        })?;
        let digest = plan.fingerprint.digest();
        let mut products = self.files(plan.name)?;
        products.retain(|file, _| !TIMED.contains(&file.as_str()));
        let digest_of = |file: &String| Ok((file.clone(), Fingerprint::of_file(&stage.folder.join(file))?));
        let sha256 = products.keys().map(digest_of).collect::<Result<_>>()?;
        let record = Record {
            stage: plan.name.into(),
            fingerprint: plan.fingerprint.clone(),
            digest: digest.clone(),
            summary: summary.clone(),
            elapsed_s,
            cpu_s: Some((cpu_s.max(0.0) * 1e3).round() / 1e3),
            peak_bytes: io::peak_memory(),
            warnings: stage.progress.warnings(),
            products,
            sha256,
            finished: now(),
            version: env!("CARGO_PKG_VERSION").into(),
        };
        let text = serde_json::to_string_pretty(&record).unwrap_or_default();
        io::write_atomic(&stage.folder.join("done.json"), format!("{text}\n").as_bytes())?;
        self.observer.event(&Event::Done { stage: plan.name, elapsed_s, summary: &summary });
        Ok(Done { digest, summary, skipped: false })
    }
}

fn same(plan: &Plan, found: &Fingerprint, done: bool) -> Result<()> {
    let differences = plan.fingerprint.differences(found);
    if differences.is_empty() {
        return Ok(());
    }
    let (stage, state) = (plan.name, if done { "done" } else { "begun" });
    let (was, is) = (found.format, plan.fingerprint.format);
    if was != is {
        let what = format!(
            "stage `{stage}` was {state} by another version of tiface: its format is {was}, not {is}"
        );
        let first = stage.split('/').next().unwrap_or_default();
        let hint = format!(
            "choose another folder with `--run DIR`, continue with that version, or recompute this stage and \
             what follows with `--fresh {first}`"
        );
        return Err(Error::cannot(what, hint));
    }
    if let [difference] = &differences[..]
        && difference.starts_with("capture: ")
    {
        let changed = plan.fingerprint.changed.iter().map(|changed| format!(": {changed}"));
        let changed = changed.collect::<String>();
        let what = format!("stage `{stage}` was {state} with other photographs, masks or cameras{changed}");
        let hint = format!(
            "say where those lie with `--set capture.path=FOLDER`, choose another folder with `--run DIR`, or recompute \
             this stage and what follows with `--fresh {stage}`"
        );
        return Err(Error::cannot(what, hint));
    }
    let problem = format!("stage `{stage}` was {state} with other settings:\n  {}", differences.join("\n  "));
    Err(Error::cannot(
        problem,
        match stage.split_once('/') {
            // a product of its own: nothing follows it
            Some((owner, _)) => format!(
                "repeat with the old settings, or add `--fresh {owner}` to make `{stage}` again, and nothing else"
            ),
            None => format!(
                "repeat with the old settings, choose another folder with `--run DIR`, or recompute this stage and what follows with `--fresh {stage}`"
            ),
        },
    ))
}

/// Removes temporary files in a stage's folder and its subfolders, except behind links and in
/// folders that another process may be writing.
fn sweep(folder: &Path) -> Result<usize> {
    if io::is_link(folder) {
        return Ok(0);
    }
    let mut removed = io::remove_leftovers(folder, |_, _| true)?;
    for inner in io::list_folders(folder)?.iter().filter(|f| !has_record(f)) {
        removed += sweep(inner)?;
    }
    Ok(removed)
}

#[cfg(test)]
mod tests {
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
        assert!(
            !dir.path().join("mesh/checkpoint").exists() && !dir.path().join("iface/checkpoint").exists()
        );
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
            assert!(
                error.to_string().contains("scans/a.png") && error.kind() == ErrorKind::Cannot,
                "{error}"
            );
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
}
