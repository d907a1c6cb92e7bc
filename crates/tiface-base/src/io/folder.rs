//! Folders: creation, clearing, listing, locks and free space.

use super::read_error::ReadError;
use super::write::WriteError;
use std::collections::BTreeMap;
use std::fs::{self, DirEntry, File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

pub(super) fn failed(path: &Path) -> impl Fn(std::io::Error) -> WriteError + '_ {
    move |source| WriteError::Io { path: path.into(), source }
}

/// Creates a folder and its parents, if they do not exist.
pub fn create_folder(path: &Path) -> Result<(), WriteError> {
    fs::create_dir_all(path).map_err(failed(path))
}

/// Returns the entries of a folder; none if it does not exist.
fn entries(path: &Path) -> std::io::Result<Vec<DirEntry>> {
    match fs::read_dir(path) {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(Vec::new()),
        other => other?.collect(),
    }
}

/// Removes everything inside `path` except files called `keep` and folders that are `apart`, which
/// stay as they are; a folder that does not exist is empty. Links inside are removed, never
/// followed; a link in the place of the folder itself is an error.
pub fn clear_folder(path: &Path, keep: &str, apart: &dyn Fn(&Path) -> bool) -> Result<(), WriteError> {
    if is_link(path) {
        return Err(failed(path)(linked()));
    }
    for entry in entries(path).map_err(failed(path))? {
        let inside = entry.path();
        let is_folder = entry.file_type().map_err(failed(&inside))?.is_dir();
        let removed = if is_folder && !apart(&inside) {
            clear_folder(&inside, keep, apart)?;
            match fs::remove_dir(&inside) {
                // something apart is in it
                Err(e) if e.kind() == ErrorKind::DirectoryNotEmpty => Ok(()),
                other => other,
            }
        } else if is_folder || entry.file_name() == keep {
            Ok(())
        } else {
            fs::remove_file(&inside)
        };
        removed.map_err(failed(&inside))?;
    }
    Ok(())
}

/// Removes a folder if it is there and has nothing in it.
pub fn remove_empty_folder(path: &Path) -> Result<(), WriteError> {
    match fs::remove_dir(path) {
        Err(e) if !matches!(e.kind(), ErrorKind::NotFound | ErrorKind::DirectoryNotEmpty) => {
            Err(failed(path)(e))
        }
        _ => Ok(()),
    }
}

/// Returns a file in a folder or below, but none of those, nor in one of the folders, that are
/// `apart`; `None` without one, or without the folder.
pub fn any_file(path: &Path, apart: &dyn Fn(&Path) -> bool) -> Result<Option<PathBuf>, ReadError> {
    for entry in entries(path).map_err(|e| ReadError::io(path, e))? {
        let inside = entry.path();
        if apart(&inside) {
            continue;
        }
        if !entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            return Ok(Some(inside));
        }
        if let Some(file) = any_file(&inside, apart)? {
            return Ok(Some(file));
        }
    }
    Ok(None)
}

/// Returns the files in a folder and below as sorted paths in it, separated by `/`. Links are
/// followed; hidden entries, names that are not UTF-8, folders that are `apart` or deeper than
/// `depth`, and what cannot be listed are left out. `None` if there are more than `most` entries.
pub fn files_below(
    root: &Path,
    depth: usize,
    most: usize,
    apart: &dyn Fn(&Path) -> bool,
) -> Option<Vec<String>> {
    let (mut files, mut folders, mut left) = (Vec::new(), vec![(String::new(), 0)], most);
    while let Some((folder, level)) = folders.pop() {
        let Ok(listed) = fs::read_dir(root.join(&folder)) else { continue };
        for entry in listed.map_while(Result::ok) {
            left = left.checked_sub(1)?;
            let name = entry.file_name();
            let Some(name) = name.to_str().filter(|name| !name.starts_with('.')) else { continue };
            let path = if folder.is_empty() { name.into() } else { format!("{folder}/{name}") };
            let kind = entry.file_type().ok().filter(|kind| !kind.is_symlink());
            let kind = kind.or_else(|| fs::metadata(entry.path()).ok().map(|m| m.file_type()));
            match kind {
                Some(kind) if kind.is_file() => files.push(path),
                Some(kind) if kind.is_dir() && level < depth && !apart(&entry.path()) => {
                    folders.push((path, level + 1));
                }
                _ => {}
            }
        }
    }
    files.sort();
    Some(files)
}

/// Returns how many bytes the files in a folder and below have, by their path in it; hidden ones
/// and folders that are `apart` left out. No folder has no files.
pub fn file_sizes(path: &Path, apart: &dyn Fn(&Path) -> bool) -> Result<BTreeMap<String, u64>, ReadError> {
    let mut sizes = BTreeMap::new();
    for entry in entries(path).map_err(|e| ReadError::io(path, e))? {
        let (inside, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            let below = if apart(&inside) { BTreeMap::new() } else { file_sizes(&inside, apart)? };
            sizes.extend(below.into_iter().map(|(file, bytes)| (format!("{name}/{file}"), bytes)));
        } else if !name.starts_with('.') {
            sizes.extend(file_size(&inside).map(|bytes| (name, bytes)));
        }
    }
    Ok(sizes)
}

/// Returns whether the path is a regular file (through links).
pub fn is_file(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|m| m.is_file())
}

/// Returns whether the path exists, even as a dangling link.
pub fn exists(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

/// Returns whether the path is a folder (through links).
pub fn is_folder(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|m| m.is_dir())
}

/// Returns the names of the regular files directly in a folder, sorted by bytes; hidden ones left
/// out. A name that is not UTF-8 is an error that shows it as well as it can.
pub fn list_files(folder: &Path) -> Result<Vec<String>, ReadError> {
    listed(folder, |name| !name.starts_with('.'))
}

/// Returns the names of the hidden regular files directly in a folder, as [`list_files`] those of
/// the others.
pub fn list_hidden(folder: &Path) -> Result<Vec<String>, ReadError> {
    listed(folder, |name| name.starts_with('.'))
}

fn listed(folder: &Path, is_wanted: impl Fn(&str) -> bool) -> Result<Vec<String>, ReadError> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(|e| ReadError::io(folder, e))? {
        let entry = entry.map_err(|e| ReadError::io(folder, e))?;
        let path = entry.path();
        if !is_file(&path) {
            continue;
        }
        let Ok(name) = entry.file_name().into_string() else {
            return Err(ReadError::unsupported(&path, "a file name that is not UTF-8", "rename the file"));
        };
        if is_wanted(&name) {
            names.push(name);
        }
    }
    names.sort();
    Ok(names)
}

/// Returns the same path without links, `.` and `..`; the file must exist.
pub fn real_path(path: &Path) -> Result<PathBuf, ReadError> {
    fs::canonicalize(path).map_err(|e| ReadError::io(path, e))
}

/// Returns the path whose name is most like that of a path that does not exist: beside it, in a
/// folder of a similar name, or the same name under `runs/`.
pub fn similar(path: &Path) -> Option<PathBuf> {
    let name = path.file_name()?.to_str()?;
    let in_runs = Path::new("runs").join(path);
    if path.components().count() == 1 && in_runs.exists() {
        return Some(in_runs);
    }
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    if let Some(parent) = parent.filter(|parent| !parent.exists()) {
        return similar(parent).map(|found| found.join(name)).filter(|found| found.exists());
    }
    let entries = fs::read_dir(parent.unwrap_or(Path::new("."))).ok()?;
    let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    let near =
        names.filter(|other| !other.starts_with('.')).map(|other| (strsim::levenshtein(name, &other), other));
    let (_, nearest) =
        near.min().filter(|(distance, _)| *distance <= (name.len() / 2).min(1 + name.len() / 4))?;
    Some(parent.map_or_else(|| PathBuf::from(&nearest), |parent| parent.join(&nearest)))
}

/// Returns whether the path is a link, dangling or not.
pub fn is_link(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|m| m.is_symlink())
}

pub(super) fn linked() -> std::io::Error {
    std::io::Error::other("it is a link, which is not followed here")
}

/// Folders directly inside `path`, sorted by name, hidden ones left out; none if it does not exist.
pub fn list_folders(path: &Path) -> Result<Vec<PathBuf>, ReadError> {
    let entries = entries(path).map_err(|e| ReadError::io(path, e))?;
    let is_hidden = |e: &DirEntry| e.file_name().as_encoded_bytes().starts_with(b".");
    let folders = entries.into_iter().filter(|e| !is_hidden(e)).map(|e| e.path());
    let mut folders: Vec<PathBuf> = folders.filter(|path| path.is_dir()).collect();
    folders.sort();
    Ok(folders)
}

/// Returns how many bytes a file has; `None` if it does not exist.
pub fn file_size(path: &Path) -> Option<u64> {
    fs::metadata(path).ok().filter(|m| m.is_file()).map(|m| m.len())
}

/// When a file was last changed; `None` if it does not exist or the system does not say.
pub fn modified(path: &Path) -> Option<SystemTime> {
    fs::metadata(path).and_then(|m| m.modified()).ok()
}

/// Sets when a file was last changed.
pub fn set_modified(path: &Path, time: SystemTime) -> Result<(), WriteError> {
    let file = OpenOptions::new().write(true).open(path).map_err(failed(path))?;
    file.set_modified(time).map_err(failed(path))
}

/// Appends a line to a log. If the last writer was stopped in the middle of a line, that line is
/// ended first, so that it spoils only itself. A link is an error, because its target may be any
/// file.
pub fn append(path: &Path, line: &str) -> Result<(), WriteError> {
    if is_link(path) {
        return Err(failed(path)(linked()));
    }
    let mut file =
        OpenOptions::new().read(true).append(true).create(true).open(path).map_err(failed(path))?;
    let mut bytes = Vec::with_capacity(line.len() + 2);
    if !ends_with_newline(&mut file).map_err(failed(path))? {
        bytes.push(b'\n');
    }
    bytes.extend_from_slice(line.as_bytes());
    bytes.push(b'\n');
    // one call, so that lines of two processes cannot interleave
    file.write_all(&bytes).map_err(failed(path))
}

fn ends_with_newline(file: &mut File) -> std::io::Result<bool> {
    use std::io::{Seek, SeekFrom};
    if file.metadata()?.len() == 0 {
        return Ok(true);
    }
    file.seek(SeekFrom::End(-1))?;
    let mut last = [0];
    file.read_exact(&mut last)?;
    Ok(last[0] == b'\n')
}

/// Returns whether files can be created in this folder, as far as is known without creating one.
#[cfg(unix)]
pub fn is_writable(folder: &Path) -> bool {
    use rustix::fs::{Access, access};
    access(folder, Access::WRITE_OK | Access::EXEC_OK).is_ok()
}

/// Returns whether files can be created in this folder, as far as is known without creating one.
#[cfg(not(unix))]
pub fn is_writable(folder: &Path) -> bool {
    fs::metadata(folder).is_ok_and(|m| !m.permissions().readonly())
}

/// Returns the bytes an ordinary user may still write on the disk that holds `path`; `None` where
/// the system does not tell.
#[cfg(unix)]
pub fn free_bytes(path: &Path) -> Option<u64> {
    let disk = rustix::fs::statvfs(path).ok()?;
    disk.f_bavail.checked_mul(disk.f_frsize)
}

/// Returns the bytes an ordinary user may still write on the disk that holds `path`; `None` where
/// the system does not tell.
#[cfg(not(unix))]
pub fn free_bytes(_: &Path) -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    use super::super::lock::Lock;
    use super::*;

    #[test]
    fn only_an_empty_folder_is_removed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a/b");
        fs::create_dir_all(&path).unwrap();
        remove_empty_folder(&dir.path().join("a")).unwrap();
        assert!(path.is_dir());
        remove_empty_folder(&path).unwrap();
        assert!(!path.exists());
        remove_empty_folder(&path).unwrap();
    }

    #[test]
    fn clearing_keeps_the_lock_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("views")).unwrap();
        for name in [".lock", "a.png", "views/b.png"] {
            fs::write(dir.path().join(name), b"x").unwrap();
        }
        let apart = |path: &Path| path.ends_with("paths/orbit");
        clear_folder(dir.path(), ".lock", &apart).unwrap();
        let left: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert_eq!(left, [".lock"]);
        clear_folder(&dir.path().join("absent"), ".lock", &apart).unwrap();
        // what is apart stays, and so do the folders on the way to it
        fs::create_dir_all(dir.path().join("paths/orbit/a")).unwrap();
        fs::create_dir_all(dir.path().join("paths/other")).unwrap();
        fs::write(dir.path().join("paths/orbit/a/b.png"), b"x").unwrap();
        assert_eq!(any_file(&dir.path().join("paths"), &apart).unwrap(), None);
        fs::write(dir.path().join("paths/c.png"), b"x").unwrap();
        assert!(any_file(dir.path(), &|_| false).unwrap().is_some());
        clear_folder(dir.path(), ".lock", &apart).unwrap();
        assert!(dir.path().join("paths/orbit/a/b.png").is_file());
        assert!(!dir.path().join("paths/other").exists() && !dir.path().join("paths/c.png").exists());
    }

    #[test]
    #[cfg(unix)]
    fn nothing_behind_a_link_is_removed_locked_or_appended_to() {
        use std::os::unix::fs::symlink;
        let dir = tempfile::tempdir().unwrap();
        let (own, others) = (dir.path().join("own"), dir.path().join("others"));
        fs::create_dir(&own).unwrap();
        fs::create_dir(&others).unwrap();
        fs::write(others.join("mine.txt"), b"x").unwrap();
        symlink(&others, own.join("views")).unwrap();
        symlink(others.join("mine.txt"), own.join("log.jsonl")).unwrap();
        symlink(others.join("new"), own.join(".lock")).unwrap();
        assert!(append(&own.join("log.jsonl"), "{}").unwrap_err().to_string().contains("a link"));
        assert!(Lock::take(&own.join(".lock")).unwrap_err().to_string().contains("a link"));
        clear_folder(&own, "", &|_| false).unwrap();
        assert_eq!(fs::read_dir(&own).unwrap().count(), 0);
        symlink(&others, own.join("views")).unwrap();
        assert!(clear_folder(&own.join("views"), "", &|_| false).is_err());
        assert_eq!(fs::read(others.join("mine.txt")).unwrap(), b"x");
        assert!(!others.join("new").exists());
    }

    #[test]
    fn a_torn_line_spoils_only_itself() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log.jsonl");
        append(&path, "{\"step\":1}").unwrap();
        OpenOptions::new().append(true).open(&path).unwrap().write_all(b"{\"st").unwrap();
        append(&path, "{\"step\":2}").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "{\"step\":1}\n{\"st\n{\"step\":2}\n");
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn the_disk_says_how_much_room_is_left() {
        assert!(free_bytes(Path::new("/")).is_some());
        assert!(free_bytes(Path::new("/no/such/folder")).is_none());
    }

    #[test]
    fn files_are_listed_in_order_without_folders_and_hidden_ones() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["b.png", "a.png", ".a.png.77.tmp"] {
            fs::write(dir.path().join(name), b"x").unwrap();
        }
        fs::create_dir(dir.path().join("c")).unwrap();
        assert_eq!(list_files(dir.path()).unwrap(), ["a.png", "b.png"]);
    }
}
