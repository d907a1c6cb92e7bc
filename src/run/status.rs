//! `status.json`: the progress of a stage.

use super::record::{not_negative, read_if_present};
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};
use tiface_base::Fingerprint;
use tiface_base::io::{self, Limits, ReadError};

/// The state of a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// A process is computing it, or was killed meanwhile.
    Running,
    /// Complete.
    Done,
    /// Stopped on request after saving.
    Stopped,
    /// Ended by an error.
    Failed,
}

/// `status.json`, replaced as a whole about once a second.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// Its state.
    pub state: State,
    /// Steps done.
    pub step: u64,
    /// Total number of steps; 0 while unknown.
    pub steps: u64,
    /// Recent steps per second.
    pub rate: Option<f64>,
    /// Seconds left at this rate.
    pub eta_s: Option<f64>,
    /// Seconds of work so far, including earlier, stopped processes.
    pub elapsed_s: f64,
    /// The requested device.
    pub device: String,
    /// The process.
    pub pid: u32,
    /// The machine.
    pub host: String,
    /// The error that ended it.
    pub error: Option<String>,
    /// When this was written, in seconds since 1970; for users, nothing depends on it.
    pub updated: u64,
    /// Fingerprint of the result, so that a stage begun with other settings is detected.
    pub fingerprint: Fingerprint,
}

impl Status {
    /// Returns the steps done, in whole per cent; `None` while the total is unknown.
    pub fn percent(&self) -> Option<u64> {
        let share = self.step as f64 / self.steps as f64;
        (self.steps > 0).then_some((100.0 * share.min(1.0)) as u64)
    }
}

/// Returns the `status.json` of a stage folder; `None` if it does not exist.
pub fn read_status(folder: &Path) -> Result<Option<Status>, ReadError> {
    let path = folder.join("status.json");
    let status: Option<Status> = read_if_present(&path)?;
    if let Some(s) = &status {
        let seconds = [("elapsed_s", Some(s.elapsed_s)), ("eta_s", s.eta_s), ("rate", s.rate)];
        seconds.into_iter().try_for_each(|(key, value)| not_negative(&path, key, value))?;
    }
    Ok(status)
}

/// Seconds since 1970; 0 if the clock is before that.
pub(super) fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// Returns the machine's name, as far as it is known without asking the network.
pub(super) fn host() -> String {
    let kernel = io::read_bytes(Path::new("/proc/sys/kernel/hostname"), &Limits::default());
    match kernel.map(|b| String::from_utf8_lossy(&b).trim().to_string()) {
        Ok(name) if !name.is_empty() => name,
        _ => std::env::var("HOSTNAME").or_else(|_| std::env::var("COMPUTERNAME")).unwrap_or_default(),
    }
}
