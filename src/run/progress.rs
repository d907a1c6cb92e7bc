//! Reports a stage's progress to status, log and screen at different rates.
//!
//! All intervals use the monotonic clock, so that a change of the system time has no effect.

use super::status::now;
use super::stop::Stop;
use super::{State, Status};
use serde::{Serialize, Serializer};
use serde_json::{Map, Value};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tiface_base::{Monitor, Result, io};

/// Receives the events of a run.
#[derive(Clone, Copy, Debug, Serialize)]
#[serde(tag = "event", rename_all = "lowercase")]
pub enum Event<'a> {
    /// A stage begins, or continues after an interruption.
    Started {
        /// Which.
        stage: &'a str,
    },
    /// Progress of a stage.
    Progress {
        /// Which.
        stage: &'a str,
        /// Steps done.
        step: u64,
        /// Total number of steps.
        steps: u64,
        /// Recent steps per second.
        rate: Option<f64>,
        /// Seconds left.
        eta_s: Option<f64>,
        /// Named figures of this step; an object in JSON.
        #[serde(serialize_with = "as_object")]
        values: &'a [(&'a str, f64)],
    },
    /// A stage is complete.
    Done {
        /// Which.
        stage: &'a str,
        /// Seconds of work.
        elapsed_s: f64,
        /// Figures of the result.
        summary: &'a Value,
    },
    /// A stage was already complete.
    Skipped {
        /// Which.
        stage: &'a str,
    },
    /// A note.
    Note {
        /// The stage.
        stage: &'a str,
        /// The text, one sentence.
        text: &'a str,
    },
    /// A warning.
    Warning {
        /// The stage, or the part of the run.
        stage: &'a str,
        /// The text.
        text: &'a str,
    },
}

fn as_object<S: Serializer>(values: &[(&str, f64)], to: S) -> Result<S::Ok, S::Error> {
    to.collect_map(values.iter().copied())
}

/// Receives events. Called from computing threads, so it must return quickly.
pub trait Observer: Send + Sync {
    /// Handles an event.
    fn event(&self, event: &Event);
}

/// A stage's [`Monitor`].
pub(super) struct Progress {
    stage: String,
    folder: PathBuf,
    stop: Stop,
    observer: Arc<dyn Observer>,
    start: Instant,
    /// Seconds of work in earlier processes.
    before_s: f64,
    state: Mutex<(Status, Pace)>,
}

#[derive(Default)]
struct Pace {
    /// Step and time at the start of the current rate window.
    mark: Option<(u64, Instant)>,
    shown: Option<Instant>,
    logged: Option<Instant>,
    saved: Option<Instant>,
    /// Whether a failure to write the status was reported; it is reported once.
    complained: bool,
    /// Warnings so far.
    warnings: Vec<String>,
    /// Whether this process has completed a step.
    stepped: bool,
}

impl Pace {
    fn remember(&mut self, warning: &str) {
        // each text once, up to a limit
        if self.warnings.len() < MAX_WARNINGS && !self.warnings.iter().any(|w| w == warning) {
            self.warnings.push(warning.to_owned());
        }
    }
}

const MAX_WARNINGS: usize = 50;
const SHOW_INTERVAL: Duration = Duration::from_millis(100);
const LOG_INTERVAL: Duration = Duration::from_secs(1);
const SAVE_INTERVAL: Duration = Duration::from_secs(2);
/// Length of the window over which the rate is measured.
const RATE_WINDOW: Duration = Duration::from_secs(3);

fn due(last: Option<Instant>, every: Duration) -> bool {
    last.is_none_or(|t| t.elapsed() >= every)
}

impl Progress {
    pub fn new(
        stage: &str,
        folder: PathBuf,
        stop: Stop,
        observer: Arc<dyn Observer>,
        status: Status,
    ) -> Progress {
        let (before_s, start) = (status.elapsed_s, Instant::now());
        let state = Mutex::new((status, Pace::default()));
        Progress { stage: stage.into(), folder, stop, observer, start, before_s, state }
    }

    fn state(&self) -> MutexGuard<'_, (Status, Pace)> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn elapsed_s(&self) -> f64 {
        self.before_s + self.start.elapsed().as_secs_f64()
    }

    /// Changes the status and writes it now.
    pub fn save(&self, change: impl FnOnce(&mut Status)) -> Result<(), io::WriteError> {
        let (status, pace) = &mut *self.state();
        change(status);
        self.write(status, pace)
    }

    /// Writes the status of a stopped stage; a failure to write is ignored.
    pub fn stopped(&self) {
        let _ = self.save(|s| {
            s.state = State::Stopped;
            s.eta_s = None;
        });
    }

    /// Returns whether this process has completed a step of the stage.
    pub fn has_stepped(&self) -> bool {
        self.state().1.stepped
    }

    /// Returns the warnings, each once.
    pub fn warnings(&self) -> Vec<String> {
        self.state().1.warnings.clone()
    }

    pub fn note(&self, text: &str) {
        self.observer.event(&Event::Note { stage: &self.stage, text });
    }

    /// Keeps a warning for the record that the observer has had already.
    pub fn keep_warning(&self, text: &str) {
        self.state().1.remember(text);
    }

    pub fn warn(&self, text: &str) {
        self.keep_warning(text);
        self.observer.event(&Event::Warning { stage: &self.stage, text });
    }

    fn write(&self, status: &mut Status, pace: &mut Pace) -> Result<(), io::WriteError> {
        pace.saved = Some(Instant::now());
        status.elapsed_s = self.elapsed_s();
        status.updated = now();
        let text = serde_json::to_string_pretty(status).unwrap_or_default();
        io::write_atomic(&self.folder.join("status.json"), format!("{text}\n").as_bytes())
    }

    fn log(&self, step: u64, steps: u64, values: &[(&str, f64)]) -> Result<(), io::WriteError> {
        let mut line = Map::new();
        line.insert("step".into(), step.into());
        line.insert("steps".into(), steps.into());
        let elapsed = (self.elapsed_s() * 1e3).round() / 1e3;
        line.insert("elapsed_s".into(), elapsed.into());
        for (name, value) in values {
            line.insert((*name).into(), Value::from(*value)); // NaN and Inf become null
        }
        io::append(&self.folder.join("log.jsonl"), &Value::Object(line).to_string())
    }
}

impl Monitor for Progress {
    fn step(&self, step: u64, steps: u64, values: &[(&str, f64)]) {
        let (status, pace) = &mut *self.state();
        let now = Instant::now();
        let (from, since) = *pace.mark.get_or_insert((step, now));
        let seconds = now.duration_since(since).as_secs_f64();
        if seconds > 0.2 && step > from {
            let fresh = (step - from) as f64 / seconds;
            if status.rate.is_none() || now.duration_since(since) >= RATE_WINDOW {
                status.rate = Some(status.rate.map_or(fresh, |old| 0.5 * old + 0.5 * fresh));
                pace.mark = Some((step, now));
            }
        }
        pace.stepped = true;
        status.step = step;
        status.steps = steps;
        status.eta_s = status.rate.filter(|r| *r > 0.0).map(|r| steps.saturating_sub(step) as f64 / r);

        let last = step >= steps;
        let mut trouble = None;
        if last || due(pace.logged, LOG_INTERVAL) {
            pace.logged = Some(now);
            trouble = self.log(step, steps, values).err();
        }
        if due(pace.saved, SAVE_INTERVAL) {
            trouble = self.write(status, pace).err().or(trouble);
        }
        if let Some(e) = trouble
            && !pace.complained
        {
            pace.complained = true;
            let text = e.to_string();
            pace.remember(&text);
            self.observer.event(&Event::Warning { stage: &self.stage, text: &text });
        }
        if last || due(pace.shown, SHOW_INTERVAL) {
            pace.shown = Some(now);
            let (rate, eta_s) = (status.rate, status.eta_s);
            let stage = self.stage.as_str();
            self.observer.event(&Event::Progress { stage, step, steps, rate, eta_s, values });
        }
    }

    fn stop(&self) -> bool {
        self.stop.requested().is_some()
    }
}
