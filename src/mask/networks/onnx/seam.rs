//! What both engines are given and give, and how they are called.

use super::contract::Port;
use sha2::{Digest, Sha256};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// An array a network takes or gives, row-major.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::mask::networks) struct Array {
    /// Extents.
    pub shape: Vec<usize>,
    /// As many values as the extents' product; whole numbers where the network takes integers.
    pub values: Vec<f32>,
}

impl Array {
    pub(in crate::mask::networks) fn new(shape: &[usize], values: Vec<f32>) -> Array {
        debug_assert_eq!(shape.iter().product::<usize>(), values.len());
        Array { shape: shape.to_vec(), values }
    }

    pub(super) fn integers(&self) -> Vec<i64> {
        self.values.iter().map(|&v| v as i64).collect()
    }
}

/// Every input of a network, in the file's order, with what it is fed.
pub(super) type Fed<'a> = [(&'a Port, &'a Array)];

/// SHA-256 in hexadecimal.
pub(super) fn hexadecimal(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

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
