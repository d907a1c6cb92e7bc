//! Locks: files that one process holds at a time, until it ends.

use super::folder::{is_file, is_link, linked};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::Stdio;

/// An exclusive lock on a folder, freed when dropped, and by the kernel when the process dies.
#[derive(Debug)]
pub struct Lock {
    file: File,
}

/// Why a lock was not taken.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LockError {
    /// Another process holds it.
    #[error("`{}` is locked by another process", path.display())]
    Held {
        /// The lock file.
        path: PathBuf,
    },
    /// The lock file could not be made or locked.
    #[error("`{}` cannot be locked: {source}", path.display())]
    Io {
        /// The lock file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

impl Lock {
    /// Takes the lock `path` without waiting. The file stays when the lock is freed: removing it
    /// would let two processes lock two files of the same name. A link is an error.
    pub fn take(path: &Path) -> Result<Lock, LockError> {
        let file = lock_file(path)?;
        match file.try_lock() {
            Ok(()) => Ok(Lock { file }),
            Err(TryLockError::WouldBlock) => Err(LockError::Held { path: path.into() }),
            Err(TryLockError::Error(source)) => Err(LockError::Io { path: path.into(), source }),
        }
    }

    /// [`Lock::take`] that waits for the holder, for locks that are held for moments.
    pub fn wait(path: &Path) -> Result<Lock, LockError> {
        let file = lock_file(path)?;
        file.lock().map_err(|source| LockError::Io { path: path.into(), source })?;
        Ok(Lock { file })
    }

    /// Returns the lock file, which is empty without a mark, as the input of a program. The lock is
    /// then held until that program and those that it starts have ended, too, even if this process
    /// is killed before them; on Windows, until this process ends.
    pub fn as_input(&self) -> std::io::Result<Stdio> {
        // on Unix a lock belongs to what was opened, which its copies share
        if cfg!(unix) { Ok(self.file.try_clone()?.into()) } else { Ok(Stdio::null()) }
    }

    /// [`Lock::take`], after which the file of the lock begins with `mark`, so that its content
    /// tells whose it is. The mark is on the disk when this returns. A file with other content
    /// keeps it, and so does another user's.
    pub fn take_marked(path: &Path, mark: &str) -> Result<Lock, LockError> {
        let lock = Lock::take(path)?;
        let is_ours_to_write = || OpenOptions::new().write(true).open(path).is_ok();
        if begins(path, mark) == Some(false) && is_ours_to_write() {
            let written = (&lock.file).write_all(mark.as_bytes()).and_then(|()| lock.file.sync_all());
            written.map_err(|source| LockError::Io { path: path.into(), source })?;
        }
        Ok(lock)
    }
}

/// Compares the first bytes of a file with `mark`: whether all of it is there, as opposed to some
/// or none of it, which is what a process leaves that was killed before or while it wrote. `None`
/// for other content, for a link, and if the file cannot be read.
pub fn begins(path: &Path, mark: &str) -> Option<bool> {
    if is_link(path) || !is_file(path) {
        return None;
    }
    let mut found = Vec::new();
    File::open(path).ok()?.take(mark.len() as u64).read_to_end(&mut found).ok()?;
    mark.as_bytes().starts_with(&found).then_some(found.len() == mark.len())
}

fn lock_file(path: &Path) -> Result<File, LockError> {
    let fail = |source| LockError::Io { path: path.into(), source };
    if is_link(path) {
        return Err(fail(linked()));
    }
    let open = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path);
    // another user's: it can be locked all the same
    let readable = open.or_else(|e| match e.kind() {
        std::io::ErrorKind::PermissionDenied => File::open(path),
        _ => Err(e),
    });
    readable.map_err(fail)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn a_lock_is_exclusive_until_dropped() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(".lock");
        let first = Lock::take(&path).unwrap();
        assert!(matches!(Lock::take(&path), Err(LockError::Held { .. })));
        drop(first);
        assert!(Lock::take(&path).is_ok());
    }

    #[test]
    fn a_marked_lock_tells_whose_it_is_even_if_a_kill_cut_its_mark() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(".lock");
        assert_eq!(begins(&path, "ours\n"), None);
        for before in ["", "ou", "ours\n"] {
            fs::write(&path, before).unwrap();
            assert_eq!(begins(&path, "ours\n"), Some(before.len() == 5), "{before:?}");
            drop(Lock::take_marked(&path, "ours\n").unwrap());
            assert_eq!(fs::read(&path).unwrap(), b"ours\n", "{before:?}");
        }
        fs::write(&path, "theirs").unwrap();
        drop(Lock::take_marked(&path, "ours\n").unwrap());
        assert_eq!((begins(&path, "ours\n"), fs::read(&path).unwrap()), (None, b"theirs".to_vec()));
    }
}
