//! What is made once a test program, and copied from then on: photographs of the synthetic head,
//! and trained heads.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use tiface::capture::synthetic::{SyntheticOptions, write_capture};

/// Returns the folder of what this program keeps. No test ends the program, so what other programs
/// left goes first.
fn kept() -> &'static Path {
    static KEPT: OnceLock<PathBuf> = OnceLock::new();
    KEPT.get_or_init(|| {
        let root = Path::new(env!("CARGO_TARGET_TMPDIR"));
        std::fs::create_dir_all(root).unwrap();
        for entry in std::fs::read_dir(root).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().and_then(|name| name.to_str());
            let process = name.and_then(|name| name.strip_prefix("check-")?.parse().ok());
            if process.is_some_and(tiface::io::has_ended) {
                // another program that begins right now may have been first
                let _ = std::fs::remove_dir_all(&path);
            }
        }
        let folder = root.join(format!("check-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        // the program names captures by their real paths
        folder.canonicalize().unwrap()
    })
}

/// Returns the folder of this name, which the first caller makes while the others wait. It is to be
/// read, not changed.
pub fn once(name: &str, make: impl FnOnce(&Path)) -> PathBuf {
    static MADE: Mutex<BTreeMap<String, Arc<OnceLock<PathBuf>>>> = Mutex::new(BTreeMap::new());
    let made = MADE.lock().unwrap_or_else(PoisonError::into_inner).entry(name.into()).or_default().clone();
    let folder = made.get_or_init(|| {
        let folder = kept().join(name);
        // what a maker that failed has left
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir(&folder).unwrap();
        make(&folder);
        folder
    });
    folder.clone()
}

/// Copies a folder to the place of whatever is there.
pub fn copy(from: &Path, to: &Path) -> PathBuf {
    if to.exists() {
        std::fs::remove_dir_all(to).unwrap();
    }
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let place = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &place);
        } else {
            std::fs::copy(&path, &place).unwrap();
        }
    }
    to.into()
}

/// Makes the capture `to` of the synthetic head, which is photographed once for each of these
/// options.
pub fn photographed(to: &Path, options: &SyntheticOptions) {
    let SyntheticOptions { width, height, train, test, seed } = *options;
    let name = format!("photographs {width} {height} {train} {test} {seed}");
    copy(&once(&name, |folder| write_capture(folder, options).unwrap()), to);
}

/// Copies the capture `head` and the run `run` of a kept folder into another, the run under another
/// name. The copy of the run is one of the copy of the capture.
pub fn copy_run(kept: &Path, folder: &Path, name: &str) -> PathBuf {
    let head = copy(&kept.join("head"), &folder.join("head"));
    let run = copy(&kept.join("run"), &folder.join(name));
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
    let own = format!("{:?}", kept.join("head"));
    assert_eq!(config.matches(&own).count(), 1, "{config}");
    let real = head.canonicalize().unwrap();
    std::fs::write(run.join("config.toml"), config.replace(&own, &format!("{real:?}"))).unwrap();
    run
}
