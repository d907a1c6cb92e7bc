//! A run directory: one folder per stage, with its status and its record.
//!
//! ```text
//! runs/002_00/iface/.lock        held while a process works on the stage; says whose the folder is
//!                   status.json  live: state, step, rate, time left, error
//!                   log.jsonl    one object per logged step
//!                   …            the stage's own files
//!                   done.json    last: what shaped the result, and its figures
//! runs/002_00/estimate.json      estimated cost of the stages, written before they run
//!             failed.json        the error of a command that ended before its first stage
//! ```
//!
//! A stage whose `done.json` has the same fingerprint is skipped without touching a file; one with
//! another fingerprint is an error that prints the difference: nothing is retrained or reused
//! silently.
//!
//! Repeating a command after an interruption gives the same bytes in the stage's own files (on one
//! device and for one seed). `status.json`, `log.jsonl` and `done.json` contain times and rates,
//! and so differ from run to run.

use tiface_base::{Error, ErrorKind, Quiet, Result};
mod clean;
mod estimate;
mod failure;
mod folder;
mod progress;
mod record;
mod run_status;
mod stage;
mod status;
mod stop;
mod verify;

#[cfg(test)]
pub(crate) use clean::tests::finish;
pub use clean::{HeldStages, Surplus, SurplusKind};
pub use estimate::{Cost, ESTIMATE, Estimate, read_estimate};
pub use failure::{FAILED, Failure, read_failure};
pub use folder::{is_run, taken_for_capture};
pub use progress::{Event, Observer};
pub use record::{Fault, ProductState, Record, read_record};
pub use run_status::{Phase, RunStatus, StageStatus};
pub use stage::{Done, Plan, StageDir};
pub use status::{State, Status, read_status};
pub use stop::Stop;
pub use verify::{Verification, VerifiedFile, verify};

use record::TIMED;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tiface_base::io::{self, Lock, LockError};

impl Observer for Quiet {
    fn event(&self, _: &Event) {}
}

/// A run directory.
pub struct Run {
    dir: PathBuf,
    stop: Stop,
    observer: Arc<dyn Observer>,
}

const LOCK: &str = ".lock";

/// Content of a stage's lock, which is written before anything else in the folder: other programs
/// have files called `.lock`, too.
const LOCK_MARK: &str = "tiface holds this lock while it works on this stage\n";

/// Returns whether this is the folder of a stage, or of a separate product inside one. The content
/// of a file proves it, not its name: a lock that names us, or, as a copy may have lost it, a
/// record or a status.
fn has_record(folder: &Path) -> bool {
    io::begins(&folder.join(LOCK), LOCK_MARK) == Some(true)
        || matches!(read_record(folder), Ok(Some(_)))
        || matches!(read_status(folder), Ok(Some(_)))
}

/// Returns whether this is an empty lock, or a record that a crash left empty, whoever made it:
/// alone in a folder it is nothing that could be lost.
fn is_bare(path: &Path) -> bool {
    let is_bare_lock = path.ends_with(LOCK) && io::begins(path, LOCK_MARK) == Some(false);
    is_bare_lock || TIMED.iter().any(|name| path.ends_with(name)) && io::file_size(path) == Some(0)
}

impl Run {
    /// Opens the run in `dir`; the folder is created with the first file. Events go to `observer`;
    /// `stop` stops every stage.
    pub fn open(dir: &Path, stop: Stop, observer: Arc<dyn Observer>) -> Run {
        Run { dir: dir.into(), stop, observer }
    }

    /// Opens the run in `dir` without an observer or a stop request.
    pub fn quiet(dir: &Path) -> Run {
        Run::open(dir, Stop::new(), Arc::new(Quiet))
    }

    /// Returns the folder of the run.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Returns the path of a file or folder of the run.
    pub fn path(&self, name: impl AsRef<Path>) -> PathBuf {
        self.dir.join(name)
    }

    /// Writes a file of the run itself (`config.toml`, `cameras.json`, `report.html`); a file with
    /// the same bytes is not rewritten, so that its modification time stays meaningful.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let path = self.path(name);
        if io::is_file(&path) && io::read_bytes(&path, &io::Limits::default()).is_ok_and(|old| old == bytes) {
            return Ok(());
        }
        io::create_folder(&self.dir)?;
        // one process at a time: other temporary files of this name were left by a process that has
        // ended
        let lock = Lock::wait(&self.path(LOCK));
        if lock.is_ok() {
            let _ = io::remove_leftovers(&self.dir, |of, _| of == name); // the next one tries again
        }
        Ok(io::write_atomic(&path, bytes)?)
    }

    /// Removes the results of stages, so that they are computed again; `names` in pipeline order.
    /// All their locks are held meanwhile. Subfolders with a lock or a record of their own stay.
    ///
    /// # Errors
    ///
    /// Fails if a folder is a link or contains files of another origin; then nothing is removed.
    pub fn fresh(&self, names: &[String]) -> Result<()> {
        // the last stage first: stopped halfway, no stage is left without its input
        for folder in self.hold(names)?.folders().rev() {
            io::remove(&folder.join("done.json"))?;
            io::clear_folder(folder, LOCK, &has_record)?;
        }
        Ok(())
    }

    /// Fails if a stage's folder contains files but no proof of a stage.
    fn is_ours(&self, name: &str) -> Result<()> {
        let folder = self.path(name);
        if has_record(&folder) {
            return Ok(());
        }
        match io::any_file(&folder, &|path| has_record(path) || is_bare(path))? {
            // another process began the stage between the two checks
            Some(_) if has_record(&folder) => Ok(()),
            Some(file) => Err(Error::cannot(
                format!("`{}` is not a folder of a run, and contains `{}`", folder.display(), file.display()),
                "choose another folder for the run with `--run DIR`, or move its files elsewhere",
            )),
            None => Ok(()),
        }
    }

    /// Returns the first link on the path from the run's folder to that of a stage.
    fn link(&self, name: &str) -> Option<PathBuf> {
        let below = self.path(name);
        let inside = below.ancestors().take_while(|path| *path != self.dir);
        inside.filter(|path| io::is_link(path)).last().map(Path::to_path_buf)
    }

    /// Sends a warning to the observer.
    pub fn warn(&self, stage: &str, text: &str) {
        self.observer.event(&Event::Warning { stage, text });
    }

    /// Returns the stop request of this run.
    pub fn stop(&self) -> &Stop {
        &self.stop
    }

    /// Records the error of a command that ended before its first stage; a failure to write it is
    /// ignored. Nothing is written into a folder that contains files but no run.
    pub fn failed(&self, error: &Error) {
        let is_run = ["config.toml", FAILED].iter().any(|name| io::is_file(&self.path(name)));
        if !is_run && !matches!(io::any_file(&self.dir, &|_| false), Ok(None)) {
            return;
        }
        let failure =
            Failure { error: error.to_string(), hint: error.hint().into(), exit: error.kind().code() };
        let _ = self.write(FAILED, format!("{}\n", serde_json::json!(failure)).as_bytes());
    }

    /// Removes the record of [`Run::failed`].
    pub fn not_failed(&self) {
        let _ = io::remove(&self.path(FAILED));
    }

    fn lock(&self, stage: &str) -> Result<Lock> {
        Lock::take_marked(&self.path(stage).join(LOCK), LOCK_MARK).map_err(|e| match e {
            LockError::Held { .. } => {
                let run = self.dir.display();
                let problem = format!("stage `{stage}` of `{run}` is locked by another process");
                Error::new(ErrorKind::NotNow, problem)
                    .with_hint("wait for it, or stop it, then repeat the command")
            }
            other => Error::cannot(other, "check that you may write in the run folder"),
        })
    }
}
