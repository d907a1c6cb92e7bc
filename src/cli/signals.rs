//! Ctrl-C and SIGTERM: a command ends within a second, a training stage as soon as it has saved a
//! checkpoint.
//!
//! The first signal requests a stop. A signal within a second of it repeats the same request, as
//! GNU `timeout` sends it; a later one ends the process at once.

use super::Invocation;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::{flag, low_level};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use tiface_base::{Error, ErrorKind, Result};

/// How often received signals are polled.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// How long running work may take to react to the request and to report its state.
const STOP_TIMEOUT: Duration = Duration::from_millis(500);

/// Signals this close to the first one repeat it.
const REPEAT_WINDOW: Duration = Duration::from_secs(1);

/// Handles signals in a thread until the process ends; requests go to the invocation's `stop`.
pub(super) fn listen(invocation: &Invocation) -> Result<()> {
    let cannot = |e: std::io::Error| Error::cannot(format!("signals cannot be handled: {e}"), "");
    let last = Arc::new(AtomicUsize::new(0));
    for (signal, exit) in [(SIGINT, ErrorKind::Interrupted), (SIGTERM, ErrorKind::Terminated)] {
        flag::register_usize(signal, last.clone(), exit.code().into()).map_err(cannot)?;
    }
    let (stop, screen) = (invocation.stop.clone(), invocation.screen.clone());
    let poll = move || {
        let mut first_signal = FirstSignal::default();
        loop {
            std::thread::sleep(POLL_INTERVAL);
            let signal = match last.swap(0, Ordering::SeqCst) {
                0 => None,
                143 => Some(ErrorKind::Terminated),
                _ => Some(ErrorKind::Interrupted),
            };
            match first_signal.at(Instant::now(), signal) {
                Some(SignalAction::RequestStop(exit)) => stop.request(exit),
                Some(SignalAction::ExitIfIdle) => {
                    if let Some(failure) = stop.abandon(STOP_TIMEOUT) {
                        let exit = failure.kind();
                        screen.error(&failure);
                        low_level::exit(exit.code().into());
                    }
                }
                Some(SignalAction::Exit(exit)) => low_level::exit(exit.code().into()),
                None => {}
            }
        }
    };
    std::thread::Builder::new().name("signals".into()).spawn(poll).map(|_| ()).map_err(cannot)
}

/// The reaction to a signal, or to the time since it.
#[derive(Debug, PartialEq)]
enum SignalAction {
    /// Ask the running stages to stop.
    RequestStop(ErrorKind),
    /// Exit, unless a stage has something to save.
    ExitIfIdle,
    /// Exit at once.
    Exit(ErrorKind),
}

/// The time of the first signal.
#[derive(Default)]
struct FirstSignal(Option<Instant>);

impl FirstSignal {
    fn at(&mut self, now: Instant, signal: Option<ErrorKind>) -> Option<SignalAction> {
        let Some(first) = self.0 else {
            self.0 = signal.map(|_| now);
            return signal.map(SignalAction::RequestStop);
        };
        let since = now.duration_since(first);
        match signal {
            Some(exit) if since >= REPEAT_WINDOW => Some(SignalAction::Exit(exit)),
            _ if since >= STOP_TIMEOUT => Some(SignalAction::ExitIfIdle),
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
        let mut first_signal = FirstSignal::default();
        let mut at = |ms, signal| first_signal.at(start + Duration::from_millis(ms), signal);
        let (term, int) = (Some(ErrorKind::Terminated), Some(ErrorKind::Interrupted));
        assert_eq!(at(0, None), None);
        assert_eq!(at(100, term), Some(SignalAction::RequestStop(ErrorKind::Terminated)));
        assert_eq!(at(150, term), None);
        assert_eq!(at(400, int), None);
        assert_eq!(at(600, None), Some(SignalAction::ExitIfIdle));
        assert_eq!(at(1090, term), Some(SignalAction::ExitIfIdle));
        assert_eq!(at(1100, int), Some(SignalAction::Exit(ErrorKind::Interrupted)));
    }
}
