//! The bytes of a file: only regular ones, and no more than the limit; what readers refuse for its
//! size; and why a file could not be read: the file, the place in it, and a suggested fix.

use crate::error::error_from;
use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Opens a regular file; checks the type before opening, since opening a pipe would wait for its
/// writer.
pub(super) fn open(path: &Path) -> Result<(File, u64), ReadError> {
    let about = fs::metadata(path).map_err(|e| ReadError::io(path, e))?;
    regular(path, &about)?;
    let file = File::open(path).map_err(|e| ReadError::io(path, e))?;
    // once more on what was really opened: the name may have been given to something else meanwhile
    let about = file.metadata().map_err(|e| ReadError::io(path, e))?;
    regular(path, &about)?;
    Ok((file, about.len()))
}

fn regular(path: &Path, about: &fs::Metadata) -> Result<(), ReadError> {
    if about.is_file() {
        return Ok(());
    }
    let kind = if about.is_dir() { "a folder" } else { kind_of_special(about) };
    Err(ReadError::NotAFile { path: path.into(), kind })
}

#[cfg(unix)]
fn kind_of_special(about: &fs::Metadata) -> &'static str {
    use std::os::unix::fs::FileTypeExt;
    let t = about.file_type();
    if t.is_fifo() {
        "a named pipe"
    } else if t.is_socket() {
        "a socket"
    } else {
        "a device"
    }
}

#[cfg(not(unix))]
fn kind_of_special(_: &fs::Metadata) -> &'static str {
    "a special file"
}

/// Returns all bytes of a regular file that is not empty and not over [`Limits::file_bytes`].
pub fn read_bytes(path: &Path, limits: &Limits) -> Result<Vec<u8>, ReadError> {
    read_capped(path, limits.file_bytes, "the file's size in bytes")
}

/// [`read_bytes`] for formats in which an empty file is valid.
pub fn read_maybe_empty(path: &Path, limits: &Limits) -> Result<Vec<u8>, ReadError> {
    match read_bytes(path, limits) {
        Err(ReadError::Empty { .. }) => Ok(Vec::new()),
        read => read,
    }
}

/// Returns the first bytes of a regular file, at most `count`; an empty file has none.
pub fn read_beginning(path: &Path, count: u64) -> Result<Vec<u8>, ReadError> {
    let (file, _) = open(path)?;
    let mut bytes = Vec::new();
    file.take(count).read_to_end(&mut bytes).map_err(|e| ReadError::io(path, e))?;
    Ok(bytes)
}

/// Passes the bytes of a regular file on in pieces, whatever its size; an empty file has none.
pub fn read_pieces(path: &Path, mut each: impl FnMut(&[u8])) -> Result<(), ReadError> {
    let (mut file, _) = open(path)?;
    let mut piece = vec![0; 1 << 16];
    loop {
        match file.read(&mut piece).map_err(|e| ReadError::io(path, e))? {
            0 => return Ok(()),
            n => each(&piece[..n]),
        }
    }
}

pub(super) fn read_capped(path: &Path, limit: u64, what: &'static str) -> Result<Vec<u8>, ReadError> {
    let (file, length) = open(path)?;
    let too_large = |found| ReadError::too_large(path, what, found, limit);
    if length > limit {
        return Err(too_large(length));
    }
    // the length may be wrong (a growing file, /proc), so it sizes the buffer but does not end the
    // read
    let mut bytes = Vec::with_capacity(length as usize);
    let read = file.take(limit + 1).read_to_end(&mut bytes).map_err(|e| ReadError::io(path, e))?;
    if read as u64 > limit {
        return Err(too_large(read as u64));
    }
    if read == 0 {
        return Err(ReadError::Empty { path: path.into() });
    }
    Ok(bytes)
}

/// Limits of readers, independent of what a file claims.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Longest side of a picture, pixels.
    pub side_px: u32,
    /// Bytes of one decoded picture or array.
    pub decoded_bytes: u64,
    /// Bytes of any file.
    pub file_bytes: u64,
    /// Bytes of a JSON file.
    pub json_bytes: u64,
    /// Nesting of arrays and objects in JSON.
    pub json_depth: usize,
    /// Numbers, strings, arrays and objects in one JSON file; bounds the memory of the parsed tree.
    pub json_values: usize,
    /// Views of one capture; votes of views are counted in 16 bits.
    pub views: usize,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits {
            side_px: 16_384,
            decoded_bytes: 4 << 30,
            file_bytes: 4 << 30,
            json_bytes: 64 << 20,
            json_depth: 64,
            json_values: 8 << 20,
            views: u16::MAX as usize,
        }
    }
}

impl Limits {
    /// Fails if a capture has more views than allowed.
    pub fn check_views(&self, path: &Path, views: usize) -> Result<(), ReadError> {
        let too_large = || ReadError::too_large(path, "the number of views", views as u64, self.views as u64);
        if views > self.views { Err(too_large()) } else { Ok(()) }
    }

    pub(super) fn check_side(&self, path: &Path, side: u64) -> Result<(), ReadError> {
        let (what, limit) = ("the picture's longest side in pixels", self.side_px.into());
        if side > limit { Err(ReadError::too_large(path, what, side, limit)) } else { Ok(()) }
    }

    pub(super) fn check_decoded(&self, path: &Path, bytes: u64) -> Result<(), ReadError> {
        let (what, limit) = ("the decoded picture's size in bytes", self.decoded_bytes);
        if bytes > limit { Err(ReadError::too_large(path, what, bytes, limit)) } else { Ok(()) }
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_a_missing_file_and_an_empty_file_are_told_apart() {
        let dir = tempfile::tempdir().unwrap();
        let limits = Limits::default();
        let at = |name: &str| dir.path().join(name);
        assert!(matches!(read_bytes(dir.path(), &limits), Err(ReadError::NotAFile { kind: "a folder", .. })));
        assert!(matches!(read_bytes(&at("none"), &limits), Err(ReadError::Io { .. })));
        fs::write(at("empty"), b"").unwrap();
        assert!(matches!(read_bytes(&at("empty"), &limits), Err(ReadError::Empty { .. })));
    }

    #[test]
    fn a_file_over_the_limit_is_refused_before_it_is_read() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("five");
        fs::write(&path, b"12345").unwrap();
        let limits = Limits { file_bytes: 4, ..Limits::default() };
        let error = read_bytes(&path, &limits).unwrap_err();
        assert!(matches!(error, ReadError::TooLarge { found: 5, limit: 4, .. }), "{error}");
        assert_eq!(read_bytes(&path, &Limits { file_bytes: 5, ..Limits::default() }).unwrap(), b"12345");
        assert_eq!(read_beginning(&path, 3).unwrap(), b"123");
        assert_eq!(read_beginning(&path, 9).unwrap(), b"12345");
    }
}
