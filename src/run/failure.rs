//! `failed.json`: the error of a command that ended before its first stage.

use serde::{Deserialize, Serialize};
use std::path::Path;
use tiface_base::io::{self, Limits};

/// `failed.json`: the error of a command that ended before its first stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// The problem.
    pub error: String,
    /// The suggested fix.
    pub hint: String,
    /// The exit code.
    pub exit: u8,
}

/// File name of the failure in a run.
pub const FAILED: &str = "failed.json";

/// Returns the `failed.json` of a run; `None` if it is absent or unreadable: it is informative
/// only.
pub fn read_failure(run: &Path) -> Option<Failure> {
    let path = run.join(FAILED);
    io::is_file(&path).then(|| io::read_typed(&path, &Limits::default()).ok()).flatten()
}
