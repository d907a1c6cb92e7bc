//! The folder that a search for cameras writes: whose it is, who works in it, and what may be
//! cleared.
//!
//! ```text
//! OUT/.lock                        held while a search works here, by COLMAP, too
//! OUT/colmap/tiface_cameras.json   the photographs and options, and at the end the result
//!            tiface_cameras.files  files that are not COLMAP's, listed before they are written
//!            tiface_cameras.log    messages of COLMAP and FFmpeg
//! OUT/sparse/0                     last: the model
//! ```
//!
//! A search that is repeated clears what is listed and COLMAP's own files: whatever else is in the
//! folder is a user's.

use super::super::folder::is_hidden;
use super::{SfmOptions, Solution};
use serde::{Deserialize, Serialize};
use std::path::{Component, Path, PathBuf};
use tiface_base::io::{self, Limits, Lock, LockError};
use tiface_base::{Error, Fingerprint, Result};

/// File of the programs' messages.
pub(super) const LOG: &str = "tiface_cameras.log";

/// File that proves by its content that the folder is one of ours, and says of which photographs.
const RECORD: &str = "tiface_cameras.json";

/// File that lists files, a JSON string a line.
const LISTING: &str = "tiface_cameras.files";

const LOCK: &str = ".lock";

/// The input that tells photographs from others.
pub(super) const PHOTOGRAPHS: &str = "photographs";

/// COLMAP's own folders below `colmap/`: attempts, the refined model, and the model that is about
/// to be the result.
const WORK_FOLDERS: [&str; 5] = ["1", "2", "3", "refined", "model"];

/// File that COLMAP writes its options to.
pub(super) const OPTIONS: &str = "options.txt";

/// File that names the photographs to COLMAP, a line each.
pub(super) const NAMES: &str = "images.txt";

/// Folders of listed files.
const LISTED: [&str; 5] = ["images", "masks", "valid", "face_masks", "colmap"];

const NEW_FOLDER: &str = "name a new folder with `--out`: nothing is overwritten";

/// What a search is asked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Request {
    /// The folder of photographs, or the video, without links.
    pub source: PathBuf,
    /// Options, and digests of what is read.
    pub fingerprint: Fingerprint,
}

impl Request {
    /// Returns whether a request is for the same photographs: in the same place, whatever has been
    /// changed there, or moved.
    fn is_of_same(&self, other: &Request) -> bool {
        let digest = |request: &Request| request.fingerprint.inputs.get(PHOTOGRAPHS).cloned();
        self.source == other.source || digest(self).is_some_and(|own| digest(other) == Some(own))
    }
}

#[derive(Serialize, Deserialize)]
struct Record {
    request: Request,
    solution: Option<Solution>,
}

/// The output folder.
pub(super) struct Output<'a> {
    out: &'a Path,
    limits: &'a Limits,
}

impl<'a> Output<'a> {
    pub fn new(sfm: &'a SfmOptions) -> Output<'a> {
        Output { out: &sfm.out, limits: &sfm.limits }
    }

    /// Returns the path of a file or folder that COLMAP works with.
    pub fn work(&self, name: &str) -> PathBuf {
        self.out.join("colmap").join(name)
    }

    /// Returns the result if the folder has that of this request. Nothing is written.
    ///
    /// # Errors
    ///
    /// Fails if the folder has something else, and with
    /// [`ErrorKind::NotNow`](tiface_base::ErrorKind::NotNow) if a search works in it, unless this
    /// process holds its lock.
    pub fn result_of(&self, request: &Request, lock: Option<&Lock>) -> Result<Option<Solution>> {
        let exists = |what: String, hint: &str| {
            Error::cannot(format!("`{}` already exists{what}", self.out.display()), hint)
        };
        if !io::exists(self.out) {
            return Ok(None);
        } else if request.source.starts_with(io::real_path(self.out)?) {
            return Err(exists(String::new(), NEW_FOLDER));
        }
        let record = self.work(RECORD);
        let is_ours = io::is_file(&record) && !io::is_link(&record) && !io::is_link(&self.out.join("colmap"));
        // folders alone are what a search leaves that was killed when it began
        let is_empty = || -> Result<bool> {
            Ok(io::is_folder(self.out) && io::any_file(self.out, &is_hidden)?.is_none())
        };
        if !is_ours && !is_empty()? {
            return Err(exists(String::new(), NEW_FOLDER));
        }
        if lock.is_none() && io::is_file(&self.out.join(LOCK)) {
            self.take_lock()?;
        }
        if !is_ours {
            return Ok(None);
        }
        let Record { request: before, solution } = io::read_typed(&record, self.limits)?;
        if !request.is_of_same(&before) {
            let source = before.source.display();
            let hint = "name another folder with `--out`, or remove that one if it is no longer needed";
            return Err(exists(format!(", and is of other photographs: `{source}`"), hint));
        } else if !io::exists(&self.out.join("sparse/0")) {
            return Ok(None);
        }
        let differences = request.fingerprint.differences(&before.fingerprint);
        match solution.filter(|_| differences.is_empty()) {
            Some(solution) => Ok(Some(Solution { folder: self.out.into(), ..solution })),
            None => Err(exists(format!(", with other cameras: {}", differences.join(", ")), NEW_FOLDER)),
        }
    }

    fn take_lock(&self) -> Result<Lock> {
        Lock::take(&self.out.join(LOCK)).map_err(|e| match e {
            LockError::Held { .. } => Error::not_now(
                format!("`{}` is locked by another `tiface cameras`, or by its COLMAP", self.out.display()),
                "wait for it, or stop it, then repeat the command",
            ),
            other => Error::cannot(other, "check that you may write in that folder"),
        })
    }

    /// Locks the folder for a request, and clears what an earlier search left, before anything is
    /// written. The result is that of another process which has just found it.
    pub fn begin(&self, request: &Request) -> Result<(Lock, Option<Solution>)> {
        io::create_folder(self.out)?;
        let lock = self.take_lock()?;
        let found = self.result_of(request, Some(&lock))?;
        if found.is_none() {
            io::create_folder(&self.out.join("colmap"))?;
            // first, so that the next search knows the folder
            self.write_record(request, None)?;
            self.clear_listed(|_| true)?;
            self.clear_work()?;
            io::write_atomic(&self.work(LISTING), b"")?;
            io::write_atomic(&self.work(LOG), b"")?;
        }
        Ok((lock, found))
    }

    fn write_record(&self, request: &Request, solution: Option<&Solution>) -> Result<()> {
        let record = Record { request: request.clone(), solution: solution.cloned() };
        let text = serde_json::to_string_pretty(&record)
            .map_err(|e| Error::cannot(format!("the record of the search cannot be written: {e}"), ""))?;
        Ok(io::write_atomic(&self.work(RECORD), text.as_bytes())?)
    }

    /// Lists files that are about to be written.
    ///
    /// # Errors
    ///
    /// Fails if one of them is there: it is none of this search's.
    pub fn list(&self, names: &[String]) -> Result<()> {
        let taken = names.iter().map(|name| self.out.join(name)).find(|path| io::exists(path));
        if let Some(path) = taken {
            let text = format!("`{}` already exists, and no search for cameras wrote it", path.display());
            return Err(Error::cannot(text, "move it elsewhere, or name another folder with `--out`"));
        }
        let lines: Vec<String> = names.iter().map(|name| serde_json::json!(name).to_string()).collect();
        Ok(io::append(&self.work(LISTING), &lines.join("\n"))?)
    }

    /// Removes the listed files of these names.
    fn clear_listed(&self, is_cleared: impl Fn(&str) -> bool) -> Result<()> {
        let listing = self.work(LISTING);
        if !io::is_file(&listing) {
            return Ok(());
        }
        let bytes = io::read_maybe_empty(&listing, self.limits)?;
        let text = String::from_utf8_lossy(&bytes);
        // a line that was not written to its end names nothing that was written
        let names = text.lines().filter_map(|line| serde_json::from_str::<String>(line).ok());
        let files = names.filter(|name| is_cleared(name)).filter_map(|name| self.listed(&name));
        files.into_iter().try_for_each(|file| io::remove(&file))?;
        Ok(())
    }

    /// Returns the path of a listed file; `None` for what no search writes, and behind links.
    fn listed(&self, name: &str) -> Option<PathBuf> {
        let mut path = self.out.to_path_buf();
        for (i, part) in Path::new(name).components().enumerate() {
            let Component::Normal(part) = part else { return None };
            if i == 0 && !LISTED.iter().any(|folder| part == *folder) || i > 0 && io::is_link(&path) {
                return None;
            }
            path.push(part);
        }
        Some(path).filter(|path| io::is_link(path) || !io::is_folder(path))
    }

    fn clear_work(&self) -> Result<()> {
        for folder in WORK_FOLDERS.map(|name| self.work(name)) {
            io::clear_folder(&folder, "", &|_| false)?;
            io::remove_empty_folder(&folder)?;
        }
        [OPTIONS, NAMES].iter().try_for_each(|name| io::remove(&self.work(name)))?;
        Ok(())
    }

    /// Records the result, gives the model in `colmap/model` its place, and clears what COLMAP
    /// needed.
    pub fn finish(&self, request: &Request, solution: &Solution) -> Result<()> {
        self.write_record(request, Some(solution))?;
        io::create_folder(&self.out.join("sparse"))?;
        io::rename(&self.work("model"), &self.out.join("sparse/0"))?;
        self.clear_listed(|name| name.starts_with("colmap/"))?;
        io::remove_empty_folder(&self.work("masks"))?;
        self.clear_work()
    }

    /// Fails if the folder cannot be written, or if its disk has less room than is needed.
    pub fn require_room(&self, needed: u64) -> Result<()> {
        let existing = self.out.ancestors().find(|folder| io::exists(folder)).unwrap_or(Path::new("."));
        if !io::is_writable(existing) {
            let text = format!("the folder `{}` is not writable", existing.display());
            return Err(Error::cannot(text, "name a folder with write permission with `--out`"));
        }
        has_room(self.out, needed, io::free_bytes(existing))
    }
}

fn has_room(out: &Path, needed: u64, free: Option<u64>) -> Result<()> {
    let Some(free) = free.filter(|free| *free < needed) else { return Ok(()) };
    Err(Error::cannot(
        format!("`{}` needs about {needed} bytes, but only {free} are free on its disk", out.display()),
        "free space, or name a folder on another disk with `--out`",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_with_too_little_room_is_refused() {
        let out = Path::new("new");
        assert!(has_room(out, 100, Some(100)).is_ok() && has_room(out, 100, None).is_ok());
        let error = has_room(out, 100, Some(99)).unwrap_err();
        assert!(error.to_string().contains("about 100 bytes, but only 99 are free"), "{error}");
    }

    #[test]
    fn a_search_killed_right_after_its_folder_was_made_goes_on() {
        let dir = tempfile::tempdir().unwrap();
        let limits = Limits::default();
        let output = Output { out: dir.path(), limits: &limits };
        let request = Request { source: "photographs".into(), fingerprint: Fingerprint::default() };
        io::create_folder(&dir.path().join("colmap")).unwrap();
        std::fs::write(dir.path().join(LOCK), "").unwrap();
        assert!(output.begin(&request).unwrap().1.is_none());
        // killed later, when it has written its record alone
        for name in [LISTING, LOG] {
            std::fs::remove_file(output.work(name)).unwrap();
        }
        assert!(output.begin(&request).unwrap().1.is_none());
        // the files of another program prove nothing
        std::fs::remove_file(output.work(RECORD)).unwrap();
        let error = output.begin(&request).map(drop).unwrap_err();
        assert!(error.to_string().contains("already exists"), "{error}");
    }

    #[test]
    fn a_listing_names_nothing_outside_its_folders_and_nothing_behind_a_link() {
        let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let limits = Limits::default();
        let output = Output { out: dir.path(), limits: &limits };
        assert_eq!(output.listed("images/a/b.png"), Some(dir.path().join("images/a/b.png")));
        for name in ["../a", "images/../../a", "/etc/passwd", "notes.txt", "images/./../notes.txt", ""] {
            assert_eq!(output.listed(name), None, "{name}");
        }
        std::fs::write(other.path().join("a.png"), "mine").unwrap();
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(other.path(), dir.path().join("masks")).unwrap();
            assert_eq!(output.listed("masks/a.png"), None);
        }
        io::create_folder(&dir.path().join("colmap")).unwrap();
        io::append(&output.work(LISTING), "\"../a.png\"\n\"masks/a.png\"\n\"notes.t").unwrap();
        output.clear_listed(|_| true).unwrap();
        assert_eq!(std::fs::read(other.path().join("a.png")).unwrap(), b"mine");
    }
}
