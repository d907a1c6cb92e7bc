//! Ctrl-C and SIGTERM: every command ends within a second, a stage that learns as soon as it has saved.
//!
//! The first signal asks to stop. What comes within a second of it is the same request, made twice as GNU `timeout`
//! does; a later one ends the process at once.

use super::Invocation;
use crate::{Error, ErrorKind, Result};
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::{flag, low_level};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// How often the signals are looked at.
const LOOK: Duration = Duration::from_millis(50);

/// Who computes gets so long to hear the request and to tell what became of the work.
const PATIENCE: Duration = Duration::from_millis(500);

/// Signals so close to the first are one with it.
const ONE: Duration = Duration::from_secs(1);

/// Listens until the process ends; requests go to the invocation's `stop`.
pub(super) fn listen(invocation: &Invocation) -> Result<()> {
    let cannot = |e: std::io::Error| Error::cannot(format!("signals cannot be handled: {e}"), "");
    let last = Arc::new(AtomicUsize::new(0));
    for (signal, exit) in [(SIGINT, ErrorKind::Interrupted), (SIGTERM, ErrorKind::Terminated)] {
        flag::register_usize(signal, last.clone(), exit.code().into()).map_err(cannot)?;
    }
    let (stop, screen) = (invocation.stop.clone(), invocation.screen.clone());
    let heed = move || {
        let mut heard = FirstSignal::default();
        loop {
            std::thread::sleep(LOOK);
            let signal = match last.swap(0, Ordering::SeqCst) {
                0 => None,
                143 => Some(ErrorKind::Terminated),
                _ => Some(ErrorKind::Interrupted),
            };
            match heard.at(Instant::now(), signal) {
                Some(Answer::Ask(exit)) => stop.request(exit),
                Some(Answer::EndIfIdle) => {
                    if let Some(failure) = stop.abandon(PATIENCE) {
                        let exit = failure.kind();
                        screen.error(&failure);
                        low_level::exit(exit.code().into());
                    }
                }
                Some(Answer::End(exit)) => low_level::exit(exit.code().into()),
                None => {}
            }
        }
    };
    std::thread::Builder::new().name("signals".into()).spawn(heed).map(|_| ()).map_err(cannot)
}

/// What a signal, or the time since it, asks for.
#[derive(Debug, PartialEq)]
enum Answer {
    /// Ask everybody to stop.
    Ask(ErrorKind),
    /// End, unless a stage has something to save.
    EndIfIdle,
    /// End at once.
    End(ErrorKind),
}

/// When the first signal came.
#[derive(Default)]
struct FirstSignal(Option<Instant>);

impl FirstSignal {
    fn at(&mut self, now: Instant, signal: Option<ErrorKind>) -> Option<Answer> {
        let Some(first) = self.0 else {
            self.0 = signal.map(|_| now);
            return signal.map(Answer::Ask);
        };
        let since = now.duration_since(first);
        match signal {
            Some(exit) if since >= ONE => Some(Answer::End(exit)),
            _ if since >= PATIENCE => Some(Answer::EndIfIdle),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_signal_repeated_within_a_second_is_one_and_a_later_one_ends_at_once() {
        let start = Instant::now();
        let mut heard = FirstSignal::default();
        let mut at = |ms, signal| heard.at(start + Duration::from_millis(ms), signal);
        let (term, int) = (Some(ErrorKind::Terminated), Some(ErrorKind::Interrupted));
        assert_eq!(at(0, None), None);
        assert_eq!(at(100, term), Some(Answer::Ask(ErrorKind::Terminated)));
        assert_eq!(at(150, term), None);
        assert_eq!(at(400, int), None);
        assert_eq!(at(600, None), Some(Answer::EndIfIdle));
        assert_eq!(at(1090, term), Some(Answer::EndIfIdle));
        assert_eq!(at(1100, int), Some(Answer::End(ErrorKind::Interrupted)));
    }
}
