//! How a run ends: exit codes, and errors that know theirs.

use super::Stop;
use crate::io::{LockError, ReadError, WriteError};
use std::error::Error;
use std::path::PathBuf;

/// The exit codes of `tiface`, and what they tell a scheduler.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// Done, or already done.
    Done = 0,
    /// Cannot be done as asked: data missing or unsuitable, no space. Do not retry.
    Cannot = 1,
    /// Wrong command line or configuration. Do not retry.
    Usage = 2,
    /// Done, but below a bar that was set.
    BelowBar = 3,
    /// Not now: locked, out of device memory, device lost. Retry.
    NotNow = 75,
    /// A bug.
    Bug = 101,
    /// Stopped by Ctrl-C after saving. Repeat to continue.
    Interrupted = 130,
    /// Stopped by SIGTERM after saving. Repeat to continue.
    Terminated = 143,
}

impl Exit {
    /// The number a shell sees.
    pub fn code(self) -> u8 {
        self as u8
    }

    /// Did somebody ask for this end? Then it is no error.
    pub fn is_asked_for(self) -> bool {
        matches!(self, Exit::Interrupted | Exit::Terminated)
    }
}

/// What a stage ended with instead of a result: an error of any module, its exit code, and the
/// way out.
#[derive(Debug)]
pub struct Failure {
    /// How the process should end.
    pub exit: Exit,
    /// What happened.
    pub error: Box<dyn Error + Send + Sync>,
    /// The way out; may be empty.
    pub hint: String,
}

impl Failure {
    /// Exit code 1 with this error.
    pub fn cannot(error: impl Into<Box<dyn Error + Send + Sync>>, hint: impl Into<String>) -> Failure {
        Failure { exit: Exit::Cannot, error: error.into(), hint: hint.into() }
    }

    /// Stopped on request; what was done is kept as far as it is whole.
    pub fn stopped(stop: &Stop) -> Failure {
        Failure::stopped_at(stop, "what is complete is kept")
    }

    /// Stopped on request, with what became of the work.
    pub fn stopped_at(stop: &Stop, kept: impl Into<Box<dyn Error + Send + Sync>>) -> Failure {
        let exit = stop.requested().unwrap_or(Exit::Interrupted);
        Failure { exit, error: kept.into(), hint: "repeat the command to continue".into() }
    }
}

impl From<WriteError> for Failure {
    fn from(e: WriteError) -> Failure {
        let hint = e.hint();
        Failure::cannot(e, hint)
    }
}

impl From<ReadError> for Failure {
    fn from(e: ReadError) -> Failure {
        let hint = e.hint();
        Failure::cannot(e, hint)
    }
}

/// Why a run did not go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// Another process works on the stage.
    #[error("stage `{stage}` of `{}` is locked: another process works on it", run.display())]
    Held {
        /// Which stage.
        stage: String,
        /// The run folder.
        run: PathBuf,
    },
    /// The stage was made, or begun, with other settings or inputs.
    #[error("stage `{stage}` was {} with other settings:\n  {}", if *done { "done" } else { "begun" }, differences.join("\n  "))]
    Changed {
        /// Which stage.
        stage: String,
        /// Finished, or only begun.
        done: bool,
        /// One line per difference.
        differences: Vec<String>,
    },
    /// A stage's folder holds something that no stage has made.
    #[error("`{}` is in the way: it is no folder of a run, and holds `{}`", folder.display(), file.display())]
    NotOurs {
        /// The folder.
        folder: PathBuf,
        /// A file in it.
        file: PathBuf,
    },
    /// A link where a folder is to be cleared.
    #[error("`{}` is a link, and what lies behind a link is not removed", path.display())]
    Linked {
        /// The link.
        path: PathBuf,
    },
    /// Too little room on the disk.
    #[error("stage `{stage}` needs about {needed} bytes, but only {free} are free on the disk of `{}`", run.display())]
    NoSpace {
        /// Which stage.
        stage: String,
        /// Bytes.
        needed: u64,
        /// Bytes.
        free: u64,
        /// The run folder.
        run: PathBuf,
    },
    /// Stopped before this stage began.
    #[error("before stage `{stage}`")]
    Stopped {
        /// Which stage.
        stage: String,
        /// By which signal.
        exit: Exit,
    },
    /// The stage itself failed.
    #[error("stage `{stage}`: {}", failure.error)]
    Stage {
        /// Which stage.
        stage: String,
        /// How.
        failure: Failure,
    },
    /// A lock file could not be used.
    #[error(transparent)]
    Lock(LockError),
    /// A file could not be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A file could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

impl RunError {
    /// How the process should end.
    pub fn exit(&self) -> Exit {
        match self {
            RunError::Held { .. } => Exit::NotNow,
            RunError::Stopped { exit, .. } => *exit,
            RunError::Stage { failure, .. } => failure.exit,
            _ => Exit::Cannot,
        }
    }

    /// The way out; may be empty.
    pub fn hint(&self) -> String {
        match self {
            RunError::Held { .. } => "wait for it, or stop it, then repeat the command".into(),
            RunError::Changed { stage, .. } => match stage.split_once('/') {
                // a product of its own: nothing follows it
                Some((owner, _)) => format!(
                    "repeat with the old settings, or add `--fresh {owner}` to make `{stage}` anew, and nothing else"
                ),
                None => format!(
                    "repeat with the old settings, choose another folder with `--run DIR`, or recompute this stage and what follows with `--fresh {stage}`"
                ),
            },
            RunError::NotOurs { .. } => {
                "choose another folder for the run with `--run DIR`, or move what lies there somewhere else"
                    .into()
            }
            RunError::Linked { .. } => "remove the link, then repeat the command".into(),
            RunError::NoSpace { .. } => {
                "free space, or place the run on another disk with `--run DIR`".into()
            }
            RunError::Stopped { .. } => "repeat the command to continue".into(),
            RunError::Stage { failure, .. } => failure.hint.clone(),
            RunError::Lock(_) => "check that you may write in the run folder".into(),
            RunError::Read(e) => e.hint(),
            RunError::Write(e) => e.hint(),
        }
    }
}
