//! The folder of a capture that a test writes file by file, and what opening it says.

use std::fs;
use std::path::Path;
use tempfile::TempDir;
use tiface::capture::{self, Capture, CaptureOptions};

/// Writes a file of the folder, and the folders above it.
pub fn put(dir: &TempDir, name: &str, bytes: impl AsRef<[u8]>) {
    let path = dir.path().join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, bytes).unwrap();
}

/// Opens a capture. An error without a hint fails the test.
pub fn open(folder: &(impl AsRef<Path> + ?Sized)) -> tiface::Result<Capture> {
    let opened = capture::open(folder.as_ref(), &CaptureOptions::default());
    if let Err(e) = &opened {
        assert!(!e.hint().is_empty(), "{e}");
    }
    opened
}

/// Asserts that opening fails with an error that has these words.
pub fn refused(dir: &TempDir, words: &[&str]) {
    let e = open(dir).unwrap_err();
    for word in words {
        assert!(e.to_string().contains(word), "`{word}` is missing in: {e}");
    }
}
