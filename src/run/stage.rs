//! One stage of a run: skipped, refused, or executed under its lock.

use super::progress::Progress;
use super::record::TIMED;
use super::status::{host, now};
use super::stop::RunningStage;
use super::{Event, Record, Run, State, Status, has_record, read_record, read_status};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use tiface_base::{Error, Fingerprint, Monitor, Result, io};

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
    /// use tiface::Fingerprint;
    /// use tiface::run::{Plan, Run};
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
        let (saves, [working, ending]) = (plan.saves, [progress.clone(), progress.clone()]);
        let _at_work = self.stop.at_work(RunningStage {
            name: name.into(),
            saves: Box::new(move || saves && working.has_stepped()),
            stopped: Box::new(move || ending.stopped()),
        });
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
            cleaned: BTreeMap::new(),
            finished: now(),
            version: env!("CARGO_PKG_VERSION").into(),
        };
        record.write(&stage.folder)?;
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
pub(super) fn sweep(folder: &Path) -> Result<usize> {
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
mod tests;
