//! `estimate.json`: estimated cost of the stages of a run.

use super::record::read_if_present;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Add;
use std::path::Path;
use tiface_base::io::ReadError;

/// File name of the estimate in a run.
pub const ESTIMATE: &str = "estimate.json";

/// Estimated cost of a stage; displays correct it by measured times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// CPU seconds.
    pub cpu_s: f64,
    /// Peak memory of the process, bytes.
    pub memory_bytes: u64,
    /// Disk space of the files that it leaves, bytes.
    pub disk_bytes: u64,
}

impl Cost {
    /// Returns the seconds by the clock on this machine, with nothing else at work on it.
    pub fn seconds(&self) -> f64 {
        self.cpu_s / rayon::current_num_threads().max(1) as f64
    }
}

/// Sums costs of stages that run one after the other: times and files add up, memory is the
/// maximum.
impl Add for Cost {
    type Output = Cost;

    fn add(self, other: Cost) -> Cost {
        Cost {
            cpu_s: self.cpu_s + other.cpu_s,
            memory_bytes: self.memory_bytes.max(other.memory_bytes),
            disk_bytes: self.disk_bytes.saturating_add(other.disk_bytes),
        }
    }
}

/// The planned stages of a run, by name, with the estimated cost of each.
pub type Estimate = BTreeMap<String, Cost>;

/// Returns the `estimate.json` of a run; `None` if it does not exist.
pub fn read_estimate(run: &Path) -> Result<Option<Estimate>, ReadError> {
    let path = run.join(ESTIMATE);
    let Some(estimate) = read_if_present::<Estimate>(&path)? else { return Ok(None) };
    match estimate.iter().find(|(_, cost)| !(0.0..=1e12).contains(&cost.cpu_s)) {
        Some((stage, c)) => {
            Err(ReadError::value(&path, format!("{stage}.cpu_s"), c.cpu_s, "a number from 0 to 1e12"))
        }
        None => Ok(Some(estimate)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_one_after_the_other_need_the_memory_of_the_greediest() {
        let [a, b] = [(2.0, 7, 10), (3.0, 5, 20)].map(|(cpu_s, memory_bytes, disk_bytes)| Cost {
            cpu_s,
            memory_bytes,
            disk_bytes,
        });
        assert_eq!(a + b, Cost { cpu_s: 5.0, memory_bytes: 7, disk_bytes: 30 });
    }

    #[test]
    fn a_foreign_estimate_is_read_or_refused_by_its_key() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(read_estimate(dir.path()).unwrap(), None);
        let read = |text: &str| {
            std::fs::write(dir.path().join(ESTIMATE), text).unwrap();
            read_estimate(dir.path())
        };
        let one = r#"{"mask": {"cpu_s": 2.5, "memory_bytes": 3, "disk_bytes": 4}}"#;
        assert_eq!(read(one).unwrap().unwrap()["mask"].cpu_s, 2.5);
        assert!(read(&one.replace("2.5", "-1")).unwrap_err().to_string().contains("mask.cpu_s"));
        assert!(read(&one.replace("3", "-3")).unwrap_err().to_string().contains("mask.memory_bytes"));
    }
}
