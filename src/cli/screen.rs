//! Output: events on stderr while stages run, and data on stdout.
//!
//! Text from files cannot control the terminal: control characters are escaped ([`plain`]).

use super::options::Common;
use crate::pipeline::Stage;
use crate::report::duration;
use crate::run::{Event, Observer};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::{Value, json};
use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::{self, IsTerminal, Write};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tiface_base::{Error, Result};

/// Shows events: a progress line on a terminal, else a plain line every 30 s; with `--json` one
/// object per event on stdout.
pub(super) struct Screen {
    json: bool,
    quiet: bool,
    colored: bool,
    terminal: bool,
    moving: Mutex<MovingLine>,
}

/// The progress line and its figures.
#[derive(Default)]
struct MovingLine {
    bar: Option<ProgressBar>,
    /// When a plain line or object was last printed.
    last: Option<Instant>,
    /// The remaining stages of the command, in order, with the estimated seconds of each.
    ahead: Vec<(String, f64)>,
}

const PLAIN_INTERVAL: Duration = Duration::from_secs(30);
const JSON_INTERVAL: Duration = Duration::from_secs(1);

impl Screen {
    pub fn new(common: &Common) -> Arc<Screen> {
        Arc::new(Screen {
            json: common.json,
            quiet: common.quiet,
            colored: common.colored(),
            terminal: std::io::stderr().is_terminal(),
            moving: Mutex::default(),
        })
    }

    fn moving(&self) -> MutexGuard<'_, MovingLine> {
        self.moving.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the stages ahead with the estimated seconds of each, for the time left of the whole
    /// command.
    pub fn expect(&self, ahead: Vec<(String, f64)>) {
        self.moving().ahead = ahead;
    }

    /// Prints a note: its subject and its text.
    pub fn note(&self, head: &str, text: &str) {
        if !self.quiet {
            self.line(head, text);
        }
    }

    /// Prints the error and the suggested fix; a requested stop is not an error.
    pub fn error(&self, error: &Error) {
        self.end();
        if error.is_printed() {
            return;
        }
        let (message, hint) = (error.to_string(), error.hint());
        let is_stop = error.kind().is_stop();
        if self.json {
            let event = if is_stop { "stopped" } else { "error" };
            self.object(
                &json!({"event": event, "exit": error.kind().code(), "message": message, "hint": hint}),
            );
        }
        if is_stop {
            let hint = if hint.is_empty() { String::new() } else { format!("; {hint}") };
            return self.note("stopped", &format!("{message}{hint}"));
        }
        let paint = |code: &str, word: &str| {
            if self.colored { format!("\x1b[{code}m{word}\x1b[0m") } else { word.to_string() }
        };
        self.line(&paint("1;31", "error"), &message);
        if !hint.is_empty() {
            self.line(&format!("\n{}", paint("1;36", "hint")), hint);
        }
    }

    /// Prints a label and a text, which may quote files, above the progress line. A closed stderr
    /// is ignored.
    fn line(&self, head: &str, text: &str) {
        let text = indented(text);
        let bar = self.moving().bar.clone();
        let print = || {
            let _ = writeln!(std::io::stderr(), "{head}: {text}");
        };
        match bar {
            Some(bar) => bar.suspend(print),
            None => print(),
        }
    }

    fn object(&self, value: &Value) {
        // a closed pipe does not stop the work
        let _ = print(&format!("{value}\n"));
    }

    fn begin(&self, stage: &str) {
        let mut moving = self.moving();
        moving.last = None;
        if self.terminal && !self.quiet {
            let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
            let style = ProgressStyle::with_template("{prefix:>8} {spinner} {wide_msg}");
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_spinner()));
            bar.set_prefix(stage.to_string());
            bar.enable_steady_tick(Duration::from_millis(200));
            moving.bar = Some(bar);
        }
    }

    fn end(&self) {
        if let Some(bar) = self.moving().bar.take() {
            bar.finish_and_clear();
        }
    }

    /// Returns the number of stages after this one, and the seconds left of the command, given
    /// `eta_s` left of the `all_s` of this one: estimates of the others are scaled by this stage's
    /// ratio of time to estimate.
    fn after(&self, stage: &str, eta_s: Option<f64>, all_s: Option<f64>) -> (usize, Option<f64>) {
        let moving = self.moving();
        let Some(at) = moving.ahead.iter().position(|(s, _)| s == stage) else { return (0, eta_s) };
        let later = &moving.ahead[at + 1..];
        // other stages count several things in turn
        let learns = stage.parse().is_ok_and(Stage::learns);
        let pace =
            all_s.filter(|_| learns).map_or(1.0, |s| s / moving.ahead[at].1.max(1.0)).clamp(0.02, 50.0);
        (later.len(), eta_s.map(|eta| eta + pace * later.iter().map(|(_, seconds)| seconds).sum::<f64>()))
    }

    /// Returns whether the next plain line or object is due.
    fn due(&self, every: Duration, last_step: bool) -> bool {
        let mut moving = self.moving();
        let due = last_step || moving.last.is_none_or(|t| t.elapsed() >= every);
        if due {
            moving.last = Some(Instant::now());
        }
        due
    }
}

impl Observer for Screen {
    fn event(&self, event: &Event) {
        let (head, text) = match *event {
            Event::Started { stage } => {
                self.begin(stage);
                (stage.to_string(), String::new())
            }
            Event::Progress { stage, step, steps, rate, eta_s, values } => {
                let all_s = rate.filter(|r| *r > 0.0).map(|r| steps as f64 / r);
                let (after, run_eta_s) = self.after(stage, eta_s, all_s);
                if self.json && self.due(JSON_INTERVAL, step >= steps) {
                    let mut object = json!(event);
                    object["stages_after"] = json!(after);
                    object["run_eta_s"] = json!(run_eta_s);
                    self.object(&object);
                }
                let text = progress(step, steps, rate, eta_s, run_eta_s.filter(|_| after > 0), values);
                let bar = self.moving().bar.clone();
                match bar {
                    Some(bar) => bar.set_message(text),
                    None if !self.quiet && !self.json && self.due(PLAIN_INTERVAL, false) => {
                        self.line(stage, &text)
                    }
                    None => {}
                }
                return;
            }
            Event::Done { stage, elapsed_s, .. } => {
                self.end();
                (stage.to_string(), format!("done in {}", duration(elapsed_s)))
            }
            Event::Skipped { stage } => (stage.to_string(), "already done".into()),
            Event::Note { stage, text } => (stage.to_string(), text.into()),
            Event::Warning { stage, text } => (format!("{stage}: warning"), text.into()),
        };
        if self.json {
            self.object(&json!(event));
        }
        // warnings are also printed on stderr, even with --json
        if !text.is_empty() && (!self.json || matches!(event, Event::Warning { .. })) {
            self.note(&head, &text);
        }
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        self.end();
    }
}

/// `1200/3000  12.4/s  2 min 25 s left, about 9 min 10 s of the run  psnr 27.31`
fn progress(
    step: u64,
    steps: u64,
    rate: Option<f64>,
    eta_s: Option<f64>,
    run_eta_s: Option<f64>,
    values: &[(&str, f64)],
) -> String {
    let mut text = format!("{step}/{steps}");
    if let Some(rate) = rate {
        text += &format!("  {}/s", figure(rate));
    }
    if let Some(eta) = eta_s.filter(|_| step < steps) {
        text += &format!("  {} left", duration(eta));
        if let Some(all) = run_eta_s {
            text += &format!(", about {} of the run", duration(all));
        }
    }
    for (name, value) in values {
        text += &format!("  {name} {}", figure(*value));
    }
    text
}

/// Returns a figure with four significant digits; integers in full.
pub(super) fn figure(value: f64) -> String {
    let size = value.abs();
    if value.fract() == 0.0 {
        format!("{value:.0}")
    } else if size < 1e-3 {
        format!("{value:.2e}")
    } else if size < 10.0 {
        format!("{value:.3}")
    } else if size < 1000.0 {
        format!("{value:.1}")
    } else {
        format!("{value:.0}")
    }
}

/// Prints data to stdout, as [`plain`] text. A closed pipe (`| head`) is not an error.
pub(super) fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    let written = out.write_all(plain(text).as_bytes()).and_then(|()| out.flush());
    match written {
        Err(e) if e.kind() != io::ErrorKind::BrokenPipe => {
            Err(Error::cannot(format!("stdout cannot be written: {e}"), "check the redirection"))
        }
        _ => Ok(()),
    }
}

/// Returns text with control and bidirectional characters escaped as in JSON, so that JSON is
/// unchanged. Line breaks and tabs stay.
fn plain(text: &str) -> Cow<'_, str> {
    escaped(text, |c| acts(c) && c != '\n' && c != '\t')
}

/// Returns the same as one line, for a row among others.
pub(super) fn one_line(text: &str) -> Cow<'_, str> {
    escaped(text, acts)
}

/// Returns the same with lines after the first indented, so that none can pass for a line of this
/// program.
fn indented(text: &str) -> String {
    let mut lines = String::with_capacity(text.len());
    for (i, line) in plain(text).split('\n').enumerate() {
        if i > 0 {
            lines += if line.is_empty() || line.starts_with("  ") { "\n" } else { "\n  " };
        }
        lines += line;
    }
    lines
}

/// Returns whether a character is a control, a line separator or a bidirectional mark.
fn acts(c: char) -> bool {
    c.is_control() || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

fn escaped(text: &str, out: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&out) {
        return Cow::Borrowed(text);
    }
    let mut clean = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        match c {
            '\n' if out(c) => clean += "\\n",
            _ if out(c) => {
                let _ = write!(clean, "\\u{:04x}", u32::from(c));
            }
            _ => clean.push(c),
        }
    }
    Cow::Owned(clean)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_short() {
        let figures = [0.000123, 0.5, 27.31, 41234.4, 2.0, 0.0].map(figure);
        assert_eq!(figures, ["1.23e-4", "0.500", "27.3", "41234", "2", "0"]);
        let line = |all| progress(1200, 3000, Some(12.4), Some(145.0), all, &[("psnr", 27.31)]);
        assert_eq!(line(None), "1200/3000  12.4/s  2 min 25 s left  psnr 27.3");
    }

    #[test]
    fn time_left_of_a_stage_is_not_told_as_that_of_the_run() {
        let screen = Screen::new(&Common::default());
        screen
            .expect([("mask", 10.0), ("tface", 100.0), ("render", 30.0)].map(|(s, t)| (s.into(), t)).into());
        // T-Face takes twice the estimate, and so may what comes after it: 50 + 2 * 30
        assert_eq!(screen.after("tface", Some(50.0), Some(200.0)), (1, Some(110.0)));
        assert_eq!(screen.after("mask", Some(5.0), None), (2, Some(135.0)));
        assert_eq!(screen.after("render", None, None), (0, None));
        assert_eq!(screen.after("other", Some(1.0), None), (0, Some(1.0)));
        let line = progress(1, 3, None, Some(145.0), Some(550.0), &[]);
        assert_eq!(line, "1/3  2 min 25 s left, about 9 min 10 s of the run");
    }

    #[test]
    fn what_would_act_on_a_terminal_is_written_out() {
        let foul = "head\x1b[2J\u{9b}31m\r\u{202e}a\tb\nhint: no";
        assert_eq!(plain(foul), "head\\u001b[2J\\u009b31m\\u000d\\u202ea\tb\nhint: no");
        assert_eq!(one_line(foul), "head\\u001b[2J\\u009b31m\\u000d\\u202ea\\u0009b\\nhint: no");
        assert_eq!(indented("a\nhint: no\n  b"), "a\n  hint: no\n  b");
        assert!(matches!(plain("Größe × 3\n"), Cow::Borrowed(_)));
    }

    #[test]
    fn json_means_the_same_afterwards() {
        let value = serde_json::json!({"name": "a\x1b\u{9b}\u{2028}\n"});
        let clean = plain(&value.to_string()).into_owned();
        assert!(!clean.contains('\u{9b}'));
        assert_eq!(serde_json::from_str::<serde_json::Value>(&clean).unwrap(), value);
    }
}
