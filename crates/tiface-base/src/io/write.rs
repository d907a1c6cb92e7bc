//! Files that are never half-written: beside the target, flushed, synced, renamed, folder synced.
//!
//! At every instant the target is absent, the old version, or the new one. What an interrupted
//! write leaves is `.NAME.PID.tmp`, named for its owner, and removed by [`remove_leftovers`].

use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

/// Why a file could not be written. The target is then what it was before.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WriteError {
    /// No space left.
    #[error("`{}` cannot be written: no space left for its {needed} bytes", path.display())]
    Full {
        /// The target.
        path: PathBuf,
        /// Bytes the whole file needs.
        needed: u64,
    },
    /// The operating system refused.
    #[error("`{}` cannot be written: {source}", path.display())]
    Io {
        /// The target.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The content cannot be put into this format.
    #[error("`{}` cannot be written: {problem}", path.display())]
    Content {
        /// The target.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
}

crate::error::error_from!(WriteError, Cannot);

impl WriteError {
    /// Returns the suggested fix.
    pub fn hint(&self) -> String {
        match self {
            WriteError::Full { needed, .. } => format!("free at least {needed} bytes on that disk"),
            WriteError::Io { source, .. } => match source.kind() {
                ErrorKind::NotFound => "create the folder first".into(),
                ErrorKind::PermissionDenied => "choose a folder you may write to".into(),
                ErrorKind::AlreadyExists => "name another file, or remove that one".into(),
                _ => "check the disk".into(),
            },
            WriteError::Content { .. } => "check the values that should be stored".into(),
        }
    }

    /// Returns the error for contents that the format cannot hold.
    pub fn content(path: &Path, problem: impl Into<String>) -> WriteError {
        WriteError::Content { path: path.into(), problem: problem.into() }
    }

    fn from_io(path: &Path, needed: usize, source: std::io::Error) -> WriteError {
        match source.kind() {
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
                WriteError::Full { path: path.into(), needed: needed as u64 }
            }
            _ => WriteError::Io { path: path.into(), source },
        }
    }
}

/// Replaces `path` by `bytes` in one step; an existing file keeps its permissions.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    write_with(path, bytes.len(), |file| file.write_all(bytes))
}

/// Copies a file to a new name in one step; `from` may be a link.
pub fn copy(from: &Path, to: &Path) -> Result<(), WriteError> {
    if fs::symlink_metadata(to).is_ok() {
        let source = std::io::Error::new(ErrorKind::AlreadyExists, "it already exists");
        return Err(WriteError::Io { path: to.into(), source });
    }
    let bytes = fs::metadata(from).map_or(0, |m| m.len() as usize);
    // where the disk can, the bytes are shared instead of copied
    write_with(to, bytes, |file| std::io::copy(&mut File::open(from)?, file).map(drop))
}

/// Gives a file another name in the same folder, replacing what had it, and syncs the folder.
pub fn rename(from: &Path, to: &Path) -> Result<(), WriteError> {
    let fail = |source| WriteError::Io { path: from.into(), source };
    fs::rename(from, to).map_err(fail)?;
    match to.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => sync_folder(folder).map_err(fail),
        _ => Ok(()),
    }
}

/// Removes a file, if it exists.
pub fn remove(path: &Path) -> Result<(), WriteError> {
    match fs::remove_file(path) {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(WriteError::Io { path: path.into(), source: e }),
        _ => Ok(()),
    }
}

/// Replaces `path` in one step by what `put` writes, about `bytes` bytes.
fn write_with(
    path: &Path,
    bytes: usize,
    put: impl FnOnce(&mut File) -> std::io::Result<()>,
) -> Result<(), WriteError> {
    let fail = |e| WriteError::from_io(path, bytes, e);
    let Some(name) = path.file_name() else {
        return Err(fail(std::io::Error::new(ErrorKind::InvalidInput, "the path names no file")));
    };
    let folder = match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    let aside = folder.join(aside_name(&name.to_string_lossy()));
    let result = (|| {
        let mut file = create(&aside)?;
        put(&mut file)?;
        if let Ok(old) = fs::metadata(path) {
            file.set_permissions(old.permissions())?;
        }
        file.sync_all()?;
        drop(file);
        fs::rename(&aside, path)
    })();
    if let Err(e) = result {
        let _ = fs::remove_file(&aside); // the first error is reported
        return Err(fail(e));
    }
    sync_folder(folder).map_err(fail)
}

fn create(aside: &Path) -> std::io::Result<File> {
    let open = || OpenOptions::new().write(true).create_new(true).open(aside);
    match open() {
        // left by a crashed process with our number: no other process can own that name now
        Err(e) if e.kind() == ErrorKind::AlreadyExists => {
            fs::remove_file(aside)?;
            open()
        }
        other => other,
    }
}

/// `.NAME.PID.tmp`, shortened so that it fits the 255 bytes a name may have.
fn aside_name(name: &str) -> String {
    let mut end = name.len().min(200);
    while !name.is_char_boundary(end) {
        end -= 1;
    }
    format!(".{}.{}.tmp", &name[..end], std::process::id())
}

#[cfg(unix)]
fn sync_folder(folder: &Path) -> std::io::Result<()> {
    match File::open(folder)?.sync_all() {
        // some network file systems cannot sync a folder; the rename stands nevertheless
        Err(e) if matches!(e.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        other => other,
    }
}

#[cfg(not(unix))]
fn sync_folder(_: &Path) -> std::io::Result<()> {
    Ok(()) // a folder cannot be opened as a file here
}

/// Removes what interrupted writes left directly in `folder`, as far as `is_over` says so of the
/// file's name and the process, and says how many files that were. The holder of a file's lock
/// decides; for others see [`has_ended`](super::has_ended).
pub fn remove_leftovers(folder: &Path, is_over: impl Fn(&str, u32) -> bool) -> Result<usize, WriteError> {
    let fail = |source| WriteError::Io { path: folder.into(), source };
    let mut removed = 0;
    for entry in fs::read_dir(folder).map_err(fail)? {
        let entry = entry.map_err(fail)?;
        let name = entry.file_name();
        let written = name.to_str().and_then(leftover_of);
        if written.is_some_and(|(name, pid)| is_over(name, pid))
            && entry.file_type().is_ok_and(|t| t.is_file())
        {
            fs::remove_file(entry.path()).map_err(fail)?;
            removed += 1;
        }
    }
    Ok(removed)
}

/// Returns the file that was being written and by which process, if a name is that of a file in
/// progress.
fn leftover_of(name: &str) -> Option<(&str, u32)> {
    let (rest, pid) = name.strip_prefix('.')?.strip_suffix(".tmp")?.rsplit_once('.')?;
    Some((rest, pid.parse().ok()?)).filter(|_| !rest.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn the_new_version_replaces_the_old_and_nothing_is_left_beside() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        write_atomic(&path, b"old").unwrap();
        write_atomic(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(names(dir.path()), ["a.txt"]);
    }

    #[test]
    fn a_full_disk_keeps_the_old_version_and_says_how_many_bytes_are_needed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        write_atomic(&path, b"old").unwrap();
        let error = write_with(&path, 8, |file| {
            file.write_all(b"123")?;
            Err(ErrorKind::StorageFull.into())
        })
        .unwrap_err();
        assert!(matches!(error, WriteError::Full { needed: 8, .. }), "{error}");
        assert!(error.to_string().contains("a.txt") && error.hint().contains("8 bytes"));
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(names(dir.path()), ["a.txt"]);
    }

    #[test]
    fn a_copy_never_replace_what_is_there() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        fs::write(at("a"), b"old").unwrap();
        copy(&at("a"), &at("b")).unwrap();
        assert_eq!(fs::read(at("b")).unwrap(), b"old");
        assert!(copy(&at("a"), &at("b")).unwrap_err().hint().contains("another file"));
        assert!(copy(&at("none"), &at("d")).is_err());
        assert_eq!(names(dir.path()), ["a", "b"]);
    }

    #[test]
    #[cfg(unix)]
    fn a_link_by_the_name_of_a_file_in_progress_is_replaced_not_followed() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        fs::write(at("a"), b"new").unwrap();
        fs::write(at("other"), b"old").unwrap();
        std::os::unix::fs::symlink(at("other"), at(&aside_name("b"))).unwrap();
        copy(&at("a"), &at("b")).unwrap();
        assert_eq!(
            (fs::read(at("other")).unwrap(), fs::read(at("b")).unwrap()),
            (b"old".into(), b"new".into())
        );
        assert!(!fs::symlink_metadata(at("b")).unwrap().is_symlink());
    }

    #[test]
    fn a_name_of_255_bytes_can_be_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("ü".repeat(127) + "x");
        write_atomic(&path, b"1").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"1");
    }

    #[test]
    fn a_missing_folder_is_an_error_that_names_the_target() {
        let error = write_atomic(Path::new("/nonexistent-folder/x.bin"), b"1").unwrap_err();
        assert!(error.to_string().contains("x.bin"), "{error}");
    }

    #[test]
    fn only_leftovers_are_removed() {
        let dir = tempfile::tempdir().unwrap();
        for name in [".a.png.123.tmp", ".b.tmp", "c.123.tmp", ".gitignore"] {
            fs::write(dir.path().join(name), b"x").unwrap();
        }
        assert_eq!(remove_leftovers(dir.path(), |name, _| name == "b.png").unwrap(), 0);
        assert_eq!(remove_leftovers(dir.path(), |name, pid| (name, pid) == ("a.png", 123)).unwrap(), 1);
        assert_eq!(remove_leftovers(dir.path(), |_, _| true).unwrap(), 0);
        assert_eq!(names(dir.path()), [".b.tmp", ".gitignore", "c.123.tmp"]);
    }

    #[test]
    #[cfg(unix)]
    fn permissions_of_a_replaced_file_are_kept() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        write_atomic(&path, b"1").unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).unwrap();
        write_atomic(&path, b"2").unwrap();
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o640);
    }
}
