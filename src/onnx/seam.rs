//! What both engines are given and give, and how they are called.

use super::contract::Port;
use crate::Error;
use sha2::{Digest, Sha256};
use std::fmt::{self, Display};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// A file that was loaded, for the record of a run.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct NetworkFile {
    /// "sam", "sam_decoder", "vitmatte", "alpha_net", "lpips" or "onnxruntime": the name of the setting that named it.
    pub role: &'static str,
    /// The file as named.
    pub path: PathBuf,
    /// Its size.
    pub bytes: u64,
    /// Its SHA-256 in hexadecimal.
    pub sha256: String,
    /// What it was recognized as, and how it is fed.
    pub contract: String,
    /// What runs it; of the library, what it says of itself.
    pub engine: String,
}

impl NetworkFile {
    pub(super) fn new(
        role: &'static str,
        path: &Path,
        bytes: &[u8],
        contract: impl Display,
        engine: impl Display,
    ) -> NetworkFile {
        NetworkFile {
            role,
            path: path.into(),
            bytes: bytes.len() as u64,
            sha256: Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect(),
            contract: contract.to_string(),
            engine: engine.to_string(),
        }
    }
}

impl Display for NetworkFile {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let NetworkFile { role, path, bytes, sha256, contract, engine } = self;
        let path = path.display();
        write!(f, "{role}: `{path}`, {bytes} bytes, SHA-256 {sha256}, {contract}; {engine}")
    }
}

/// An array a network takes or gives, row-major.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct NetworkArray {
    /// Extents.
    pub shape: Vec<usize>,
    /// As many values as the extents' product; whole numbers where the network takes integers.
    pub values: Vec<f32>,
}

impl NetworkArray {
    pub(crate) fn new(shape: &[usize], values: Vec<f32>) -> NetworkArray {
        debug_assert_eq!(shape.iter().product::<usize>(), values.len());
        NetworkArray { shape: shape.to_vec(), values }
    }

    pub(super) fn integers(&self) -> Vec<i64> {
        self.values.iter().map(|&v| v as i64).collect()
    }
}

/// Every input of a network, in the file's order, with what it is fed.
pub(super) type Fed<'a> = [(&'a Port, &'a NetworkArray)];

/// Runs a piece of an engine; a panic inside becomes its message.
///
/// `AssertUnwindSafe`: what an engine shares between runs is a map of finished plans behind a lock, changed
/// by one insertion, so a run that panics leaves nothing half made that a later run would see.
pub(super) fn guarded<T>(piece: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(piece)).unwrap_or_else(|panic| {
        let said = panic.downcast_ref::<String>().map(String::as_str);
        let said = said.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("it gave no reason");
        Err(format!("it broke down: {said}"))
    })
}

/// What an engine or a file says: one line, no control characters, not endless.
pub(super) fn one_line(said: &str) -> String {
    let line = said.split_whitespace().collect::<Vec<_>>().join(" ");
    let line: String = line.chars().filter(|c| !c.is_control()).collect();
    match line.char_indices().nth(300) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line,
    }
}

/// The error for a file that is not what it was named for.
pub(crate) fn file_error(path: &Path, problem: &str, hint: impl Into<String>) -> Error {
    Error::cannot(format!("`{}` {problem}", path.display()), hint)
}
