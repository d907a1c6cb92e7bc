//! Captures that tests share.

use super::synthetic::{self, SyntheticOptions};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock};

/// The files of a folder with their bytes, in memory: nothing is left in the folder for
/// temporary files.
#[derive(Default)]
pub struct Files(Vec<(PathBuf, Vec<u8>)>);

impl Files {
    /// Reads all files of a folder and of the folders in it.
    pub fn read(root: &Path) -> Files {
        let (mut files, mut folders) = (Vec::new(), vec![root.to_path_buf()]);
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else {
                    let name = path.strip_prefix(root).unwrap().to_path_buf();
                    files.push((name, fs::read(&path).unwrap()));
                }
            }
        }
        Files(files)
    }

    /// Writes them into another folder.
    pub fn write(&self, root: &Path) {
        for (name, bytes) in &self.0 {
            let path = root.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, bytes).unwrap();
        }
    }
}

/// Does what [`synthetic::write_capture`] does. Photographs of the same options are taken once a
/// test program; every test gets files of its own.
pub fn write_capture(dir: &Path, options: &SyntheticOptions) {
    type Taken = Arc<OnceLock<Files>>;
    static CAPTURES: Mutex<Vec<(SyntheticOptions, Taken)>> = Mutex::new(Vec::new());
    let taken = {
        let mut captures = CAPTURES.lock().unwrap();
        let known = captures.iter().find(|(of, _)| of == options).map(|(_, taken)| taken.clone());
        known.unwrap_or_else(|| {
            captures.push((options.clone(), Taken::default()));
            captures[captures.len() - 1].1.clone()
        })
    };
    let take = || {
        let folder = tempfile::tempdir().unwrap();
        synthetic::write_capture(folder.path(), options).unwrap();
        Files::read(folder.path())
    };
    taken.get_or_init(take).write(dir);
}
