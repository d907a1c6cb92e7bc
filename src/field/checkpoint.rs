//! Checkpoints of a training on disk: two files take turns, so that the newest complete one is never
//! replaced before its successor is there, and one that fails its checks falls back to the other.

use crate::io::{ReadError, TensorValues, WriteError, is_file, remove, rename, write_tensors};
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// Where the newest checkpoint of a stage folder lies.
pub fn newest(dir: &Path) -> PathBuf {
    dir.join("checkpoint.safetensors")
}

fn previous(dir: &Path) -> PathBuf {
    dir.join("checkpoint.previous.safetensors")
}

/// Writes the next checkpoint; the newest becomes the previous one.
pub fn save(
    dir: &Path,
    tensors: &[(String, Vec<usize>, TensorValues)],
    metadata: &BTreeMap<String, String>,
) -> Result<(), WriteError> {
    let path = newest(dir);
    let next = dir.join("checkpoint.next.safetensors");
    write_tensors(&next, tensors, metadata)?;
    if is_file(&path) {
        rename(&path, &previous(dir))?;
    }
    rename(&next, &path)
}

/// Removes the older checkpoint: training is complete, the newest is all anyone needs.
pub fn finish(dir: &Path) -> Result<(), WriteError> {
    remove(&previous(dir))
}

/// A whole number of a checkpoint's metadata. One that no training can have written counts as damage: the
/// checkpoint before it is taken.
pub fn number(
    path: &Path,
    metadata: &BTreeMap<String, String>,
    key: &str,
    range: RangeInclusive<u64>,
) -> Result<u64, ReadError> {
    let expected = || format!("a whole number from {} to {}", range.start(), range.end());
    let Some(text) = metadata.get(key) else {
        return Err(ReadError::value(path, key, "missing", expected()));
    };
    match text.parse().ok().filter(|n| range.contains(n)) {
        Some(n) => Ok(n),
        None => Err(ReadError::value(path, key, format!("`{text}`"), expected())),
    }
}

/// The running mean of the squared colour error, kept bit by bit.
pub fn mean_square(path: &Path, metadata: &BTreeMap<String, String>) -> Result<f64, ReadError> {
    let key = "mean_square";
    let value = f64::from_bits(number(path, metadata, key, 0..=u64::MAX)?);
    if value.is_finite() && value >= 0.0 {
        return Ok(value);
    }
    Err(ReadError::value(path, key, value, "the bits of a finite number, 0 or more"))
}

/// Mean squares of gradients, of which roots are taken.
pub fn second_moments(path: &Path, name: &str, values: Vec<f32>) -> Result<Vec<f32>, ReadError> {
    match values.iter().position(|v| *v < 0.0) {
        None => Ok(values),
        Some(i) => {
            let found = format!("{} at index {i}", values[i]);
            Err(ReadError::value(path, format!("tensor {name}"), found, "numbers, 0 or more"))
        }
    }
}

/// The way out where neither checkpoint of a stage can be read.
pub fn way_out(e: &ReadError, stage: &str) -> String {
    match e {
        ReadError::Io { .. } => e.hint(),
        _ => format!("start the stage afresh with `--fresh {stage}`"),
    }
}

/// The newest readable checkpoint of a stage folder, with what was wrong with a newer one; `None` where
/// there is none at all.
///
/// `read` reads one file; `read_error` is the [`ReadError`] in one of its errors, if that is what it is.
pub fn restore<S, E: std::fmt::Display + From<WriteError>>(
    dir: &Path,
    read: impl Fn(&Path) -> Result<S, E>,
    read_error: impl Fn(&E) -> Option<&ReadError>,
) -> Result<Option<(S, Vec<String>)>, E> {
    let mut warnings = Vec::new();
    let mut failure = None;
    for path in [newest(dir), previous(dir)] {
        if !is_file(&path) {
            continue;
        }
        match read(&path) {
            Ok(state) => {
                // a damaged newest one must not take this one's place at the next save
                if path != newest(dir) && failure.as_ref().and_then(&read_error).is_some() {
                    remove(&newest(dir))?;
                }
                return Ok(Some((state, warnings)));
            }
            Err(e) => {
                // a disk that does not answer is no damaged file: nothing may be lost over it
                if matches!(read_error(&e), Some(ReadError::Io { .. } | ReadError::TooLarge { .. })) {
                    return Err(e);
                }
                warnings.push(format!("{e}; falling back to the checkpoint before it"));
                failure.get_or_insert(e);
            }
        }
    }
    match failure {
        Some(e) => Err(e),
        None => Ok(None),
    }
}
