//! The arrays that the engine takes and returns, and how it is called.

use super::network::Port;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use tiface_base::Error;

/// An array a network takes or gives, row-major.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct NetworkArray {
    /// Extents.
    pub shape: Vec<usize>,
    /// Values, one for each element of the shape; whole numbers where the network takes integers.
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

/// Every input of a network, in the file's order, with its array.
pub(super) type NetworkInputs<'a> = [(&'a Port, &'a NetworkArray)];

/// Runs a piece of an engine; a panic inside becomes its message.
///
/// `AssertUnwindSafe`: what an engine shares between runs is a map of finished plans behind a lock,
/// changed by one insertion, so a run that panics leaves nothing half made that a later run would
/// see.
pub(super) fn guarded<T>(piece: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(piece)).unwrap_or_else(|panic| {
        let said = panic.downcast_ref::<String>().map(String::as_str);
        let said = said.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("it gave no reason");
        Err(format!("inference failed: {said}"))
    })
}

/// Returns what an engine or a file says: one line, no control characters, not endless.
pub(super) fn one_line(said: &str) -> String {
    let line = said.split_whitespace().collect::<Vec<_>>().join(" ");
    let line: String = line.chars().filter(|c| !c.is_control()).collect();
    match line.char_indices().nth(300) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line,
    }
}

/// Returns the error for a file that is not what it was named for.
pub(crate) fn file_error(path: &Path, problem: &str, hint: impl Into<String>) -> Error {
    Error::cannot(format!("`{}` {problem}", path.display()), hint)
}
