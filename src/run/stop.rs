//! The request to stop, shared between the signal handler and all computation.

use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tiface_base::error::COMPLETE_IS_KEPT;
use tiface_base::{Error, ErrorKind};

/// A request to stop, shared between the signal handler and all computation.
#[derive(Clone, Default)]
pub struct Stop(Arc<StopState>);

#[derive(Default)]
struct StopState {
    /// 0 or the exit code.
    code: AtomicU8,
    current: Mutex<CurrentStage>,
}

#[derive(Default)]
struct CurrentStage {
    stage: Option<RunningStage>,
    /// When a stage last began or ended.
    since: Option<Instant>,
}

/// A stage at work, as far as a stop needs to know it.
pub(super) struct RunningStage {
    /// Its name.
    pub name: String,
    /// Returns whether it has something to save on a stop request, so that it is waited for.
    pub saves: Box<dyn Fn() -> bool + Send>,
    /// Records that it was stopped.
    pub stopped: Box<dyn Fn() + Send>,
}

/// Marks a stage as running until it is dropped.
pub(super) struct ActiveGuard<'a>(&'a Stop);

impl Stop {
    /// Not requested.
    pub fn new() -> Stop {
        Stop::default()
    }

    /// Asks to stop, to end with `exit`.
    pub fn request(&self, exit: ErrorKind) {
        self.0.code.store(exit.code(), Ordering::SeqCst);
    }

    /// Returns the exit code to end with, if a stop was requested.
    pub fn requested(&self) -> Option<ErrorKind> {
        match self.0.code.load(Ordering::SeqCst) {
            0 => None,
            143 => Some(ErrorKind::Terminated),
            _ => Some(ErrorKind::Interrupted),
        }
    }

    /// Returns the error to end with, which says which files are kept.
    pub fn error(&self, kept: impl std::fmt::Display) -> Error {
        Error::stopped(kept).with_kind(self.requested().unwrap_or(ErrorKind::Interrupted))
    }

    /// Returns the error to end the process with before its stages end. `None` while a stage that
    /// saves has something to save, and within `patience` of a stage's beginning or end. The status
    /// of the stage then says that it was stopped.
    ///
    /// Nothing is lost by it that a stop would have kept: files are written aside and renamed, and
    /// only learning can go on in the middle of a stage.
    pub fn abandon(&self, patience: Duration) -> Option<Error> {
        let current = self.current();
        if current.since.is_some_and(|t| t.elapsed() < patience) {
            return None;
        }
        match &current.stage {
            Some(stage) if (stage.saves)() => None,
            Some(stage) => {
                (stage.stopped)();
                Some(self.error(COMPLETE_IS_KEPT).within(format!("stage `{}`", stage.name)))
            }
            None => Some(self.error("before its end").with_hint("")),
        }
    }

    pub(super) fn at_work(&self, stage: RunningStage) -> ActiveGuard<'_> {
        *self.current() = CurrentStage { stage: Some(stage), since: Some(Instant::now()) };
        ActiveGuard(self)
    }

    fn current(&self) -> std::sync::MutexGuard<'_, CurrentStage> {
        self.0.current.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for ActiveGuard<'_> {
    fn drop(&mut self) {
        *self.0.current() = CurrentStage { stage: None, since: Some(Instant::now()) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_request_keeps_the_signal_that_made_it() {
        let stop = Stop::new();
        assert_eq!(stop.requested(), None);
        stop.clone().request(ErrorKind::Terminated); // clones share
        assert_eq!(stop.requested(), Some(ErrorKind::Terminated));
        assert_eq!(stop.error("x").kind().code(), 143);
    }
}
