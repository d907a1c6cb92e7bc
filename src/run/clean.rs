//! Removal of files that the finished stages of a run do not need any more.

use super::Run;
use super::record::{Record, read_record};
use super::stage::sweep;
use serde::Serialize;
use std::path::{Path, PathBuf};
use tiface_base::io::{self, Lock};
use tiface_base::{Error, Fingerprint, Result};

/// Kind of a file that a finished stage does not need, whole or in part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SurplusKind {
    /// The optimizer's moments in a checkpoint, which stays.
    Moments,
    /// A checkpoint that a newer one has replaced.
    OldCheckpoint,
    /// A view in float, beside the picture of the same view.
    FloatView,
}

/// A file of a finished stage that is not needed, whole or in part.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Surplus {
    /// Folder of the stage, relative to the run.
    pub stage: String,
    /// Path of the file in that folder.
    pub file: String,
    /// Bytes that are not needed.
    pub bytes: u64,
    /// Kind of the file.
    pub kind: SurplusKind,
}

/// Stages of a run that no other process works on while this exists.
pub struct HeldStages(Vec<(PathBuf, Lock)>);

impl HeldStages {
    /// Returns the folders of the stages.
    pub(super) fn folders(&self) -> impl DoubleEndedIterator<Item = &Path> {
        self.0.iter().map(|(folder, _)| folder.as_path())
    }
}

impl Run {
    /// Takes the locks of those of these stages that have a folder.
    ///
    /// # Errors
    ///
    /// Fails if another process works on one of them, or if a folder is a link or contains files of
    /// another origin.
    pub fn hold(&self, names: &[String]) -> Result<HeldStages> {
        let folders: Vec<&String> = names.iter().filter(|n| io::is_folder(&self.path(n))).collect();
        for name in &folders {
            if let Some(link) = self.link(name) {
                return Err(Error::cannot(
                    format!("`{}` is a link, and links are not followed to remove files", link.display()),
                    "remove the link, then repeat the command",
                ));
            }
            self.is_ours(name)?;
        }
        let mut locks = Vec::new();
        for name in folders {
            locks.push((self.path(name), self.lock(name)?));
        }
        Ok(HeldStages(locks))
    }

    /// Removes what finished stages do not need from their folders and their records, and what
    /// interrupted processes left half-written there. Moments go by rewriting their file as
    /// `without_moments` returns it.
    ///
    /// At every instant each stage is finished and agrees with its record, which does not list a
    /// file while that changes. A call that was interrupted is completed by the next one.
    pub fn clean(
        &self,
        held: &HeldStages,
        surplus: &[Surplus],
        without_moments: impl Fn(&Path) -> Result<Option<Vec<u8>>>,
    ) -> Result<()> {
        for folder in held.folders() {
            let Some(mut record) = read_record(folder)? else { continue };
            sweep(folder)?;
            let of_stage: Vec<&Surplus> = surplus.iter().filter(|s| self.path(&s.stage) == folder).collect();
            for Surplus { file, bytes, .. } in &of_stage {
                record.products.remove(file);
                record.sha256.remove(file);
                record.cleaned.insert(file.clone(), *bytes);
            }
            if !of_stage.is_empty() {
                record.replace(folder)?;
            }
            for Surplus { file, kind, .. } in of_stage {
                let path = folder.join(file);
                if *kind != SurplusKind::Moments {
                    io::remove(&path)?;
                    path.parent().map_or(Ok(()), io::remove_empty_folder)?;
                } else if let Some(bytes) = without_moments(&path)? {
                    io::write_atomic(&path, &bytes)?;
                }
            }
            record.list_again(folder)?;
        }
        Ok(())
    }
}

impl Record {
    /// Lists the files that were made smaller with their new size and digest.
    fn list_again(&mut self, folder: &Path) -> Result<()> {
        let is_unlisted = |name: &&String| !self.products.contains_key(*name);
        let unlisted: Vec<String> = self.cleaned.keys().filter(is_unlisted).cloned().collect();
        let before = self.products.len();
        for name in unlisted {
            let file = folder.join(&name);
            if let Some(bytes) = io::file_size(&file) {
                self.sha256.insert(name.clone(), Fingerprint::of_file(&file)?);
                self.products.insert(name, bytes);
            }
        }
        if self.products.len() > before { self.replace(folder) } else { Ok(()) }
    }

    /// Writes the record, and keeps its modification time: workflow engines take a newer one for a
    /// stage that was made again.
    fn replace(&self, folder: &Path) -> Result<()> {
        let file = folder.join("done.json");
        let time = io::modified(&file);
        self.write(folder)?;
        Ok(time.map_or(Ok(()), |time| io::set_modified(&file, time))?)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::run::{Plan, verify};
    use serde_json::Value;
    use std::fs;
    use tiface_base::ErrorKind;

    /// Finishes a stage with these files, each of four bytes.
    pub(crate) fn finish(run: &Run, stage: &str, files: &[&str]) {
        run.stage(plan(stage), |stage| {
            for name in files {
                let file = stage.folder().join(name);
                io::create_folder(file.parent().unwrap())?;
                io::write_atomic(&file, b"abcd")?;
            }
            Ok(Value::Null)
        })
        .unwrap();
    }

    /// Returns a run whose stage `render` has left these files.
    fn finished(dir: &Path, files: &[&str]) -> Run {
        let run = Run::quiet(dir);
        finish(&run, "render", files);
        run
    }

    fn plan(name: &str) -> Plan<'_> {
        let fingerprint = Fingerprint::default();
        Plan { name, fingerprint, device: "cpu", needs_bytes: 0, saves: false }
    }

    fn surplus(file: &str, kind: SurplusKind, bytes: u64) -> Surplus {
        Surplus { stage: "render".into(), file: file.into(), bytes, kind }
    }

    #[test]
    fn a_cleaned_stage_is_finished_and_verified() {
        let dir = tempfile::tempdir().unwrap();
        let run = finished(dir.path(), &["tface/a.png", "tface/float/a.exr", "weights"]);
        let done = dir.path().join("render/done.json");
        let time = std::time::UNIX_EPOCH + std::time::Duration::from_secs(1_000_000);
        io::set_modified(&done, time).unwrap();
        let names = ["mask".to_string(), "render".into()];
        let held = run.hold(&names).unwrap();
        let goes = [
            surplus("tface/float/a.exr", SurplusKind::FloatView, 4),
            surplus("weights", SurplusKind::Moments, 3),
        ];
        run.clean(&held, &goes, |_| Ok(Some(b"a".to_vec()))).unwrap();
        drop(held);
        // the folder of float views is empty, and gone; the file without moments is shorter
        assert!(!dir.path().join("render/tface/float").exists());
        assert_eq!(fs::read(dir.path().join("render/weights")).unwrap(), b"a");
        let record = read_record(&dir.path().join("render")).unwrap().unwrap();
        let listed: Vec<_> = record.products.iter().map(|(name, bytes)| (name.as_str(), *bytes)).collect();
        assert_eq!(listed, [("tface/a.png", 4), ("weights", 1)]);
        assert_eq!(record.cleaned.values().sum::<u64>(), 7);
        assert_eq!(io::modified(&done), Some(time));
        assert!(verify(dir.path()).unwrap().differing().next().is_none());
        assert!(run.stage(plan("render"), |_| panic!("the stage should have been skipped")).unwrap().skipped);
    }

    #[test]
    fn an_interrupted_removal_leaves_a_finished_stage_and_is_completed() {
        let dir = tempfile::tempdir().unwrap();
        let run = finished(dir.path(), &["a", "weights"]);
        let (folder, names) = (dir.path().join("render"), ["render".to_string()]);
        let goes = [surplus("weights", SurplusKind::Moments, 3)];
        let held = run.hold(&names).unwrap();
        let stop = |_: &Path| Err(Error::cannot("stopped", ""));
        assert!(run.clean(&held, &goes, stop).is_err());
        drop(held);
        assert!(run.stage(plan("render"), |_| panic!("the stage should have been skipped")).unwrap().skipped);
        // killed after the file was written, and before it was listed again
        fs::write(folder.join("weights"), "a").unwrap();
        assert!(run.stage(plan("render"), |_| panic!("the stage should have been skipped")).unwrap().skipped);
        run.clean(&run.hold(&names).unwrap(), &[], |_| Ok(None)).unwrap();
        assert_eq!(read_record(&folder).unwrap().unwrap().products["weights"], 1);
    }

    #[test]
    fn stages_in_use_are_not_held() {
        let dir = tempfile::tempdir().unwrap();
        let run = finished(dir.path(), &["a"]);
        let names = ["render".to_string()];
        let _held = run.hold(&names).unwrap();
        let refused = run.hold(&names).map(drop).unwrap_err();
        assert_eq!(refused.kind(), ErrorKind::NotNow);
    }
}
