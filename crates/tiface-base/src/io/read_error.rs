//! Why a file could not be read: the file, the place in it, and a suggested fix.

use crate::error::error_from;
use std::path::{Path, PathBuf};

/// Why a file could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// The operating system refused.
    #[error("`{}` cannot be read: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A folder, a pipe or a device instead of a regular file.
    #[error("`{}` is {kind}, not a regular file", path.display())]
    NotAFile {
        /// The file.
        path: PathBuf,
        /// What it is, with its article.
        kind: &'static str,
    },
    /// No bytes at all.
    #[error("`{}` is empty (0 bytes)", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// A size over a limit.
    #[error("`{}`: {what} is {found}, the limit is {limit}", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// What was measured, with its unit.
        what: &'static str,
        /// Its size.
        found: u64,
        /// The limit.
        limit: u64,
    },
    /// The bytes violate the format.
    #[error("`{}` is not a valid {format} file: {problem}{}", path.display(), at(*offset))]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The format found or expected.
        format: &'static str,
        /// Byte offset of the damage, where known.
        offset: Option<u64>,
        /// What is wrong.
        problem: String,
    },
    /// A valid file of a kind that is not read.
    #[error("`{}`: {what} cannot be used", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What was found.
        what: String,
        /// The suggested fix.
        hint: String,
    },
    /// JSON text that does not hold.
    #[error("`{}`, line {line}, column {column}: {problem}", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// What is wrong.
        problem: String,
    },
    /// A value that the program's own writer cannot have written.
    #[error("`{}`: `{key}` is {found}, expected {expected}", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Where in it.
        key: String,
        /// The value found.
        found: String,
        /// What was expected.
        expected: String,
    },
}

fn at(offset: Option<u64>) -> String {
    offset.map(|o| format!(" (at byte {o})")).unwrap_or_default()
}

error_from!(ReadError, Cannot);

impl ReadError {
    /// Returns the suggested fix.
    pub fn hint(&self) -> String {
        match self {
            ReadError::Io { source, .. } => match source.kind() {
                std::io::ErrorKind::NotFound => "check the path; was the file moved or renamed?".into(),
                std::io::ErrorKind::PermissionDenied => "allow reading it: `chmod u+r FILE`".into(),
                _ => "check the disk and the links on the way to the file".into(),
            },
            ReadError::NotAFile { .. } => "give the path of a file".into(),
            ReadError::Empty { .. } => "copy it again; an interrupted copy leaves such a file".into(),
            ReadError::TooLarge { .. } => "make it smaller, or check that it is the file you meant".into(),
            ReadError::Damaged { .. } => "copy or export it again from its source".into(),
            ReadError::Unsupported { hint, .. } => hint.clone(),
            ReadError::Json { .. } => "correct the file at that place".into(),
            ReadError::Value { .. } => "the file was damaged, or changed by hand: make it again".into(),
        }
    }

    /// Returns the error for a value at `key` that is not as expected.
    pub fn value(
        path: &Path,
        key: impl Into<String>,
        found: impl ToString,
        expected: impl Into<String>,
    ) -> ReadError {
        ReadError::Value {
            path: path.into(),
            key: key.into(),
            found: found.to_string(),
            expected: expected.into(),
        }
    }

    /// Returns the error for a file that the system does not let us read.
    pub fn io(path: &Path, source: std::io::Error) -> ReadError {
        ReadError::Io { path: path.into(), source }
    }

    /// Returns the error for a file that breaks the rules of its format, at a byte if one is known.
    pub fn damaged(
        path: &Path,
        format: &'static str,
        offset: impl Into<Option<u64>>,
        problem: impl Into<String>,
    ) -> ReadError {
        ReadError::Damaged { path: path.into(), format, offset: offset.into(), problem: problem.into() }
    }

    /// Returns the error for a quantity above its limit.
    pub fn too_large(path: &Path, what: &'static str, found: u64, limit: u64) -> ReadError {
        ReadError::TooLarge { path: path.into(), what, found, limit }
    }

    /// Returns the error for a valid file that this reader does not support.
    pub fn unsupported(path: &Path, what: impl Into<String>, hint: impl Into<String>) -> ReadError {
        ReadError::Unsupported { path: path.into(), what: what.into(), hint: hint.into() }
    }
}
