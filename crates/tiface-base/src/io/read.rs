//! The bytes of a file: only regular ones, and no more than the limit; what readers refuse for its
//! size; and why a file could not be read: the file, the place in it, and a suggested fix.

use super::limits::Limits;
use super::read_error::ReadError;
use std::fs::{self, File};
use std::io::Read;
use std::path::Path;

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
