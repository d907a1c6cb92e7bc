//! `done.json`: the record of a complete stage, and comparison of its files with it.

use crate::config::key;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt::{self, Display};
use std::path::Path;
use tiface_base::io::{self, Limits, ReadError};
use tiface_base::{Error, Fingerprint, Result};

/// `done.json`: the stage is complete.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// The stage.
    pub stage: String,
    /// Everything that affected the result.
    pub fingerprint: Fingerprint,
    /// Digest of the fingerprint, an input of the stages that depend on this one.
    pub digest: String,
    /// Figures of the result.
    pub summary: Value,
    /// Seconds of work.
    pub elapsed_s: f64,
    /// CPU seconds of the process that finished it; `None` in older records.
    pub cpu_s: Option<f64>,
    /// Peak memory of the process, bytes; `None` if the system does not report it.
    pub peak_bytes: Option<u64>,
    /// Warnings.
    #[serde(default)]
    pub warnings: Vec<String>,
    /// Size of each file of the stage, bytes, by its path in the stage's folder; empty in older
    /// records.
    #[serde(default)]
    pub products: BTreeMap<String, u64>,
    /// SHA-256 of the same files, hexadecimal; empty in older records.
    #[serde(default)]
    pub sha256: BTreeMap<String, String>,
    /// Bytes that [`Run::clean`](super::Run::clean) removed, by the path of the file.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub cleaned: BTreeMap<String, u64>,
    /// Seconds since 1970.
    pub finished: u64,
    /// Version of `tiface`.
    pub version: String,
}

/// Files that record times, and are no products of a stage.
pub(super) const TIMED: [&str; 3] = ["done.json", "status.json", "log.jsonl"];

/// Files that no stage reads; a run is complete without them. `tiface export` writes the head again
/// from the stage's folder `parts`.
const EXPORTS: [&str; 12] = [
    "head.glb",
    "head.obj",
    "head.mtl",
    "head.ply",
    "head.usdz",
    "head.png",
    "head.jpg",
    "head.exr",
    "surface.ply",
    "seen_by.png",
    "sheet.html",
    "inputs.json",
];

/// The state of a product, compared with its record.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ProductState {
    /// As its stage left it, as far as was compared.
    Recorded,
    /// It has other contents, or more bytes.
    Changed,
    /// It has fewer bytes.
    Cut,
    /// It is not there.
    Gone,
}

/// A product of a finished stage that is not as the stage left it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// Its state.
    pub state: ProductState,
    /// Whether no stage reads the file.
    pub is_export: bool,
    /// A sentence that names the file.
    pub problem: String,
    /// The command that makes the file again.
    pub again: String,
}

impl Fault {
    /// Returns whether the run is complete all the same: the file may have been moved by its user.
    pub fn is_harmless(&self) -> bool {
        self.is_export && self.state == ProductState::Gone
    }
}

/// Shows the problem and the command that mends it.
impl Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}; `{}` makes it again", self.problem, self.again)
    }
}

impl Record {
    /// Writes the record into the stage's folder.
    pub(super) fn write(&self, folder: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).unwrap_or_default();
        Ok(io::write_atomic(&folder.join("done.json"), format!("{text}\n").as_bytes())?)
    }

    /// Returns the fault of one of the stage's files, if it is missing from the stage's folder or
    /// has another size.
    pub fn fault(&self, folder: &Path, name: &str) -> Option<Fault> {
        let (file, bytes) = (folder.join(name), *self.products.get(name)?);
        let (state, problem) = match io::file_size(&file) {
            Some(found) if found == bytes => return None,
            Some(found) => (
                if found < bytes { ProductState::Cut } else { ProductState::Changed },
                format!("has {found} bytes, but the stage `{}` left {bytes}", self.stage),
            ),
            None => (ProductState::Gone, format!("is missing, though the stage `{}` is done", self.stage)),
        };
        Some(self.faulty(folder, name, state, &problem))
    }

    /// Returns the files of the stage that are missing from its folder or have another size.
    pub fn faults(&self, folder: &Path) -> Vec<Fault> {
        self.products.keys().filter_map(|name| self.fault(folder, name)).collect()
    }

    /// Returns a fault of a file of the stage; `problem` is what comes after its name.
    pub(super) fn faulty(&self, folder: &Path, name: &str, state: ProductState, problem: &str) -> Fault {
        let problem = format!("`{}` {problem}", folder.join(name).display());
        Fault { state, is_export: EXPORTS.contains(&name), problem, again: self.again(folder, name) }
    }

    /// Returns the command that makes a file of the stage again.
    fn again(&self, folder: &Path, name: &str) -> String {
        let run = folder.ancestors().nth(self.stage.split('/').count()).unwrap_or(folder).display();
        let exported = match name {
            "head.glb" | "head.ply" | "head.usdz" => Some(name),
            // an OBJ refers to the other files
            "head.obj" | "head.mtl" | "head.png" | "head.jpg" => Some("head.obj"),
            _ => None,
        };
        match (exported, self.stage.split_once('/')) {
            (Some(name), None) => format!("tiface export {run} --out {}", folder.join(name).display()),
            (_, Some((owner, _))) => {
                let cameras = self.fingerprint.settings.get(key!(render.cameras));
                let cameras = cameras.map_or("FILE", |word| word.trim_matches('"'));
                format!("tiface {owner} {run} --cameras {cameras} --fresh {owner}")
            }
            (None, None) => format!("tiface run {run} --fresh {}", self.stage),
        }
    }

    /// Compares the files in the stage's folder with those that the stage left. Returns the
    /// exported files that were moved away.
    ///
    /// # Errors
    ///
    /// Fails if another file is missing from the folder, or has another size.
    pub fn require_products(&self, folder: &Path) -> Result<Vec<Fault>> {
        let faults = self.faults(folder);
        match faults.iter().find(|fault| !fault.is_harmless()) {
            Some(fault) => Err(self.error(fault)),
            None => Ok(faults),
        }
    }

    /// Returns a fault of one of the stage's files as an error.
    pub fn error(&self, fault: &Fault) -> Error {
        let stage = self.stage.split('/').next().unwrap_or_default();
        let put_back = match fault.is_export {
            true if fault.again.starts_with("tiface export") => format!("`{}` puts it back", fault.again),
            true if fault.state != ProductState::Gone => {
                "put the file back, remove it, for no stage reads it".into()
            }
            _ => "put the file back".into(),
        };
        let hint = format!("{put_back}, or recompute the stage and what follows with `--fresh {stage}`");
        Error::cannot(&fault.problem, hint)
    }
}

/// Returns the `done.json` of a stage folder; `None` if it does not exist.
pub fn read_record(folder: &Path) -> Result<Option<Record>, ReadError> {
    let path = folder.join("done.json");
    let record: Option<Record> = read_if_present(&path)?;
    if let Some(r) = &record {
        not_negative(&path, "elapsed_s", Some(r.elapsed_s))?;
        not_negative(&path, "cpu_s", r.cpu_s)?;
        let digest = r.fingerprint.digest();
        if r.digest != digest {
            return Err(ReadError::value(&path, "digest", &r.digest, format!("{digest}, its fingerprint's")));
        }
        if !folder.ends_with(&r.stage) {
            return Err(ReadError::value(&path, "stage", &r.stage, "the name of its folder"));
        }
    }
    Ok(record)
}

/// Refuses a value that is negative, not finite or implausibly large.
pub(super) fn not_negative(path: &Path, key: &str, value: Option<f64>) -> Result<(), ReadError> {
    match value.filter(|v| !(0.0..=1e15).contains(v)) {
        Some(v) => Err(ReadError::value(path, key, v, "a number from 0 to 1e15")),
        None => Ok(()),
    }
}

/// Reads a JSON file; `None` if it does not exist.
pub(super) fn read_if_present<T: serde::de::DeserializeOwned>(path: &Path) -> Result<Option<T>, ReadError> {
    if !io::is_file(path) {
        return Ok(None);
    }
    io::read_typed(path, &Limits::default()).map(Some)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::{Plan, Run, read_status};
    use serde_json::json;

    /// Returns what reading `name` says after `change`.
    fn after(name: &str, change: &dyn Fn(&mut Value)) -> Option<ReadError> {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("iface");
        std::fs::create_dir(&folder).unwrap();
        let fingerprint = Fingerprint::default().setting("iface.steps", 5);
        let digest = fingerprint.digest();
        let mut value = match name {
            "done.json" => json!({
                "stage": "iface", "fingerprint": fingerprint, "digest": digest, "summary": {}, "elapsed_s": 2.0,
                "finished": 1, "version": "0",
            }),
            _ => json!({
                "state": "running", "step": 1, "steps": 5, "rate": 2.0, "eta_s": 2.0, "elapsed_s": 0.5,
                "device": "cpu", "pid": 1, "host": "h", "error": null, "updated": 1, "fingerprint": fingerprint,
            }),
        };
        change(&mut value);
        std::fs::write(folder.join(name), value.to_string()).unwrap();
        match name {
            "done.json" => read_record(&folder).err(),
            _ => read_status(&folder).err(),
        }
    }

    #[test]
    fn hostile_records_and_statuses_are_refused_with_their_key() {
        assert!(after("done.json", &|_| {}).is_none() && after("status.json", &|_| {}).is_none());
        let rows: [(&str, &str, Value); 8] = [
            ("done.json", "elapsed_s", json!(-1.0)),
            ("done.json", "elapsed_s", json!(1e300)),
            ("done.json", "digest", json!("0")),
            ("done.json", "stage", json!("tface")),
            ("status.json", "elapsed_s", json!(-0.5)),
            ("status.json", "eta_s", json!(-3)),
            ("status.json", "eta_s", json!(1e300)),
            ("status.json", "rate", json!(-1e-9)),
        ];
        for (name, key, value) in rows {
            match after(name, &|v| v[key] = value.clone()) {
                Some(ReadError::Value { path, key: named, .. }) => {
                    assert!(named == key && path.ends_with(name), "{name}, {key}: {named}");
                }
                other => panic!("{name}, {key}: {other:?}"),
            }
        }
        // of another type, and another setting than the digest was made of
        assert!(
            after("status.json", &|v| v["step"] = json!(-1)).unwrap().to_string().contains("status.json")
        );
        let other = |v: &mut Value| v["fingerprint"]["settings"]["iface.steps"] = json!("6");
        assert!(after("done.json", &other).unwrap().to_string().contains("`digest`"));
    }

    fn plan(stage: &str) -> Plan<'_> {
        Plan {
            name: stage,
            fingerprint: Fingerprint::default(),
            device: "cpu",
            needs_bytes: 0,
            saves: stage == "iface",
        }
    }

    #[test]
    fn a_file_that_is_gone_is_not_to_be_removed() {
        let dir = tempfile::tempdir().unwrap();
        let (folder, file) = (dir.path().join("mesh"), dir.path().join("mesh/surface.ply"));
        let made = Run::quiet(dir.path()).stage(plan("mesh"), |_| {
            io::write_atomic(&file, b"triangles")?;
            Ok(Value::Null)
        });
        assert!(!made.unwrap().skipped);
        let record = read_record(&folder).unwrap().unwrap();
        let hint = || record.error(&record.faults(&folder)[0]).hint().to_string();
        std::fs::write(&file, b"tri").unwrap();
        assert!(hint().starts_with("put the file back, remove it, for no stage reads it, or"), "{}", hint());
        std::fs::remove_file(&file).unwrap();
        assert!(hint().starts_with("put the file back, or recompute"), "{}", hint());
    }
}
