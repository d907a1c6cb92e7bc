//! `status.json` and `done.json`: what a stage says of itself.

use super::Fingerprint;
use crate::io::{self, Limits, ReadError};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// Where a stage stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// A process works on it, or was killed while it did.
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
    /// Where it stands.
    pub state: State,
    /// Steps done.
    pub step: u64,
    /// Steps in all; 0 while unknown.
    pub steps: u64,
    /// Steps per second, of late.
    pub rate: Option<f64>,
    /// Seconds left at this rate.
    pub eta_s: Option<f64>,
    /// Seconds of work so far, those of earlier, stopped processes included.
    pub elapsed_s: f64,
    /// The device asked for.
    pub device: String,
    /// The process.
    pub pid: u32,
    /// The machine.
    pub host: String,
    /// What ended it.
    pub error: Option<String>,
    /// Seconds since 1970 when this was written; for people, nothing is computed from it.
    pub updated: u64,
    /// What shapes the result, so that a stage begun with other settings is noticed.
    pub fingerprint: Fingerprint,
}

/// `done.json`: the stage is complete.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Which stage.
    pub stage: String,
    /// Everything that shaped the result.
    pub fingerprint: Fingerprint,
    /// The same as one hexadecimal number, for stages that build on this one.
    pub digest: String,
    /// Figures of the result.
    pub summary: Value,
    /// Seconds of work.
    pub elapsed_s: f64,
    /// Seconds since 1970.
    pub finished: u64,
    /// The version of `tiface`.
    pub version: String,
}

/// The `status.json` of a stage folder; `None` if there is none.
pub fn read_status(folder: &Path) -> Result<Option<Status>, ReadError> {
    read(&folder.join("status.json"))
}

/// The `done.json` of a stage folder; `None` if there is none.
pub fn read_record(folder: &Path) -> Result<Option<Record>, ReadError> {
    read(&folder.join("done.json"))
}

fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Result<Option<T>, ReadError> {
    if !io::is_file(path) {
        return Ok(None);
    }
    let value = io::read_json(path, &Limits::default())?;
    serde_json::from_value(value).map(Some).map_err(|e| ReadError::Json {
        path: path.into(),
        line: 1,
        column: 1,
        problem: e.to_string(),
    })
}

/// Seconds since 1970; 0 if the clock stands before that.
pub(super) fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// The machine's name, as far as it is known without asking the network.
pub(super) fn host() -> String {
    let kernel = io::read_bytes(Path::new("/proc/sys/kernel/hostname"), &Limits::default());
    match kernel.map(|b| String::from_utf8_lossy(&b).trim().to_string()) {
        Ok(name) if !name.is_empty() => name,
        _ => std::env::var("HOSTNAME").or_else(|_| std::env::var("COMPUTERNAME")).unwrap_or_default(),
    }
}
