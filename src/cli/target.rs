//! Which capture and which run a command means.

use super::options::Common;
use crate::capture;
use crate::io;
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// What a command works on.
#[derive(Debug, PartialEq)]
pub(super) struct RunTarget {
    /// The run folder; need not exist.
    pub run: PathBuf,
    /// The capture, absolute; `None` if the run remembers it.
    pub capture: Option<PathBuf>,
    /// The run's own configuration, if the command takes it from there.
    pub saved: Option<PathBuf>,
    /// Was the run chosen without being named?
    pub guessed: bool,
}

/// Where in its run the demo keeps its photographs.
pub(super) const DEMO_CAPTURE: &str = "capture";

impl RunTarget {
    /// From the path on the command line and `--run`.
    pub fn find(common: &Common, path: Option<&Path>) -> Result<RunTarget> {
        match path {
            Some(path) if is_run(path) => Ok(RunTarget::run(path.into(), false)),
            Some(path) => {
                let capture = io::real_path(path)?;
                let run = match &common.run {
                    Some(run) => run.clone(),
                    None => {
                        let name = capture.file_name().ok_or_else(|| {
                            Error::usage("this capture has no name", "place the run with `--run DIR`")
                        })?;
                        Path::new("runs").join(name)
                    }
                };
                Ok(RunTarget { run, capture: Some(capture), saved: None, guessed: false })
            }
            None => match &common.run {
                Some(run) if is_run(run) => Ok(RunTarget::run(run.clone(), false)),
                Some(run) => Err(Error::usage(
                    format!("`{}` is not a run yet, and no capture is named", run.display()),
                    "name the capture: `tiface run CAPTURE --run DIR`",
                )),
                None => guess(Path::new(".")),
            },
        }
    }

    fn run(run: PathBuf, guessed: bool) -> RunTarget {
        RunTarget { saved: Some(run.join("config.toml")), run, capture: None, guessed }
    }
}

/// A run has its configuration; a capture has cameras. A folder with both is a run only if a stage was done in it.
pub(super) fn is_run(path: &Path) -> bool {
    let is_done = || io::is_file(&path.join("mask/done.json"));
    io::is_file(&path.join("config.toml")) && (!capture::has_cameras(path) || is_done())
}

/// The run in `here`, else the one under `here/runs` that was configured last.
fn guess(here: &Path) -> Result<RunTarget> {
    if is_run(here) {
        return Ok(RunTarget::run(here.into(), true));
    }
    let runs = io::list_folders(&here.join("runs"))?;
    let newest =
        runs.into_iter().filter(|run| is_run(run)).max_by_key(|run| io::modified(&run.join("config.toml")));
    match newest {
        Some(run) => Ok(RunTarget::run(run, true)),
        None => Err(Error::usage(
            "no capture or run is named, this folder is no run, and there is none under `runs/`",
            "name a capture: `tiface run CAPTURE`, or try `tiface demo`",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn a_capture_gets_its_run_under_runs_and_a_run_remembers_its_capture() {
        let dir = tempfile::tempdir().unwrap();
        let capture = dir.path().join("002_00");
        fs::create_dir(&capture).unwrap();
        let t = RunTarget::find(&Common::default(), Some(&capture)).unwrap();
        assert_eq!((t.run, t.saved), (PathBuf::from("runs/002_00"), None));
        assert_eq!(t.capture, Some(fs::canonicalize(&capture).unwrap()));
        fs::write(capture.join("config.toml"), "").unwrap();
        let t = RunTarget::find(&Common::default(), Some(&capture)).unwrap();
        assert_eq!((t.run.clone(), t.capture), (capture.clone(), None));
        assert!(t.saved.is_some());
    }

    #[test]
    fn a_capture_of_any_format_that_holds_a_config_toml_is_not_taken_for_a_run() {
        let formats: [&[&str]; 4] = [
            &["transforms.json"],
            &["cameras_sphere.npz"],
            &["cameras.npz"],
            &["sparse/0/cameras.bin", "sparse/0/images.bin"],
        ];
        for files in formats {
            let dir = tempfile::tempdir().unwrap();
            fs::write(dir.path().join("config.toml"), "").unwrap();
            assert!(is_run(dir.path()));
            fs::create_dir_all(dir.path().join("sparse/0")).unwrap();
            files.iter().for_each(|file| fs::write(dir.path().join(file), "x").unwrap());
            let target = RunTarget::find(&Common::default(), Some(dir.path())).unwrap();
            assert_eq!((target.capture.is_some(), target.saved), (true, None), "{files:?}");
        }
    }

    #[test]
    fn a_run_that_holds_a_transforms_json_stays_a_run() {
        let dir = tempfile::tempdir().unwrap();
        let put = |file: &str| {
            let path = dir.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "x").unwrap();
        };
        // the demo's own photographs lie in its run
        ["config.toml", "capture/transforms.json", "capture/images/000.png"].into_iter().for_each(put);
        assert!(is_run(dir.path()));
        // beside the settings it is a capture, until a stage was done there
        put("transforms.json");
        assert!(!is_run(dir.path()));
        put("mask/done.json");
        assert!(is_run(dir.path()));
    }

    #[test]
    fn the_newest_run_is_guessed_and_none_is_a_usage_error() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(guess(dir.path()).unwrap_err().kind().code(), 2);
        for name in ["a", "b"] {
            let run = dir.path().join("runs").join(name);
            fs::create_dir_all(&run).unwrap();
            fs::write(run.join("config.toml"), "").unwrap();
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        fs::write(dir.path().join("runs/a/config.toml"), "x").unwrap();
        let t = guess(dir.path()).unwrap();
        assert_eq!((t.run, t.guessed), (dir.path().join("runs/a"), true));
    }

    #[test]
    fn a_missing_capture_is_named() {
        let e = RunTarget::find(&Common::default(), Some(Path::new("no/such/capture"))).unwrap_err();
        assert!(e.to_string().contains("no/such/capture") && e.kind().code() == 1, "{e:?}");
    }
}
