//! A request to stop, and what is at work meanwhile.

use super::progress::Progress;
use crate::error::COMPLETE_IS_KEPT;
use crate::{Error, ErrorKind};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// A request to stop, shared between whoever hears signals and everything that computes.
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
    /// The stage at work, and whether it saves what it has when asked to stop.
    stage: Option<(Arc<Progress>, bool)>,
    /// When a stage began or ended last.
    since: Option<Instant>,
}

/// A stage is at work as long as this lives.
pub(super) struct AtWork<'a>(&'a Stop);

impl Stop {
    /// Not requested.
    pub fn new() -> Stop {
        Stop::default()
    }

    /// Asks to stop, to end with `exit`.
    pub fn request(&self, exit: ErrorKind) {
        self.0.code.store(exit.code(), Ordering::SeqCst);
    }

    /// The exit code to end with, if a stop was requested.
    pub fn requested(&self) -> Option<ErrorKind> {
        match self.0.code.load(Ordering::SeqCst) {
            0 => None,
            143 => Some(ErrorKind::Terminated),
            _ => Some(ErrorKind::Interrupted),
        }
    }

    /// The error to end with, which says what is kept.
    pub fn error(&self, kept: impl std::fmt::Display) -> Error {
        Error::stopped(kept).with_kind(self.requested().unwrap_or(ErrorKind::Interrupted))
    }

    /// What to end the process with now, though nothing has come to its end. `None` while a stage that saves has
    /// something to save, and within `patience` of a stage's beginning or end. The status of the stage then says that
    /// it was stopped.
    ///
    /// Nothing is lost by it that a stop would have kept: files are written aside and renamed, and only learning can
    /// go on in the middle of a stage.
    pub fn abandon(&self, patience: Duration) -> Option<Error> {
        let current = self.current();
        if current.since.is_some_and(|t| t.elapsed() < patience) {
            return None;
        }
        match &current.stage {
            Some((progress, saves)) if *saves && progress.has_stepped() => None,
            Some((progress, _)) => {
                progress.stopped();
                let stage = format!("stage `{}`", progress.stage());
                Some(self.error(COMPLETE_IS_KEPT).within(stage))
            }
            None => Some(self.error("before its end").with_hint("")),
        }
    }

    pub(super) fn at_work(&self, progress: &Arc<Progress>, saves: bool) -> AtWork<'_> {
        *self.current() =
            CurrentStage { stage: Some((progress.clone(), saves)), since: Some(Instant::now()) };
        AtWork(self)
    }

    fn current(&self) -> std::sync::MutexGuard<'_, CurrentStage> {
        self.0.current.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for AtWork<'_> {
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
