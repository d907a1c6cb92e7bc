//! Tells the folder of a run from that of a capture.

use crate::config::{Config, SETTINGS_FILE, Stage};
use std::path::{Path, PathBuf};
use tiface_base::{Error, io};
use tiface_capture::{has_cameras, not_a_capture, resembles_capture};

/// Returns whether a folder is a run: it has a run's configuration, and either a stage was begun in
/// it or nothing else in it is a capture's, even an unreadable one (photographs without cameras, a
/// project of another program).
pub fn is_run(folder: &Path) -> bool {
    let has_record = |stage: &Stage| {
        ["done.json", "status.json"].iter().any(|f| io::is_file(&folder.join(stage.as_str()).join(f)))
    };
    let is_begun = || Stage::ALL.iter().any(has_record);
    io::is_file(&folder.join(SETTINGS_FILE)) && (is_begun() || !resembles_capture(folder))
}

/// Returns the error for the folder of a run that is given as a capture, which names the capture of
/// the run; `None` for any other folder.
pub fn taken_for_capture(folder: &Path) -> Option<Error> {
    if !is_run(folder) || has_cameras(folder) {
        return None;
    }
    let capture = Config::of_run(folder)?.capture.path;
    if capture.as_os_str().is_empty() {
        return None;
    }
    // as messages on captures name it: no `/` at its end
    let folder: PathBuf = folder.components().collect();
    let capture = capture.display();
    let hint = format!("inspect its capture, `{capture}`; `tiface status` shows the state of the run");
    Some(not_a_capture(&folder, "it is the folder of a run", hint))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn a_run_that_is_given_as_a_capture_is_said_to_be_one_by_its_own_capture() {
        let dir = tempfile::tempdir().unwrap();
        let put = |name: &str, text: &str| fs::write(dir.path().join(name), text).unwrap();
        put("config.toml", "");
        assert_eq!(taken_for_capture(dir.path()), None, "it names no capture");
        put("config.toml", "[capture]\npath = \"heads/002\"\n");
        let error = taken_for_capture(&dir.path().join("")).unwrap();
        let said = format!("`{}` is not a capture: it is the folder of a run", dir.path().display());
        assert_eq!(error.to_string(), said);
        assert!(error.hint().starts_with("inspect its capture, `heads/002`; "), "{}", error.hint());
        // cameras beside the settings make it a capture
        put("transforms.json", "{}");
        assert_eq!(taken_for_capture(dir.path()), None);
    }
}
