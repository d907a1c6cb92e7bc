//! The capture and the run that a command works on.

use super::options::{Common, KeyOption};
use crate::config::{Config, Fallback, SETTINGS_FILE};
use crate::run::is_run;
use std::path::{Path, PathBuf};
use tiface_base::{Error, Result, io};

/// The run, and the capture, of a command.
#[derive(Debug, PartialEq)]
pub(super) struct RunTarget {
    /// The run folder; need not exist.
    pub run: PathBuf,
    /// The capture, absolute; `None` if the run's configuration has it.
    pub capture: Option<PathBuf>,
    /// The run's own configuration, if the command uses it.
    pub saved: Option<PathBuf>,
    /// Whether the run was selected without being named.
    pub guessed: bool,
}

impl RunTarget {
    /// Returns the target of the path on the command line and `--run`.
    pub fn find(common: &Common, path: Option<&Path>) -> Result<RunTarget> {
        match path {
            Some(path) if is_run(path) => Ok(RunTarget::run(path.into(), false)),
            Some(path) => {
                let capture = io::real_path(path)?;
                let run = match &common.run {
                    Some(run) => run.clone(),
                    None => {
                        let name = capture.file_name().ok_or_else(|| {
                            Error::usage(
                                "the folder of this capture has no name",
                                "name the run folder with `--run DIR`",
                            )
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

    /// Returns the configuration for this target: the capture's path absolute, so that the run
    /// finds it from any working directory.
    ///
    /// # Errors
    ///
    /// Fails if no source names a capture, or if its path is not UTF-8.
    pub fn configure(
        &self,
        common: &Common,
        fallback: Option<Fallback>,
        options: &[KeyOption],
    ) -> Result<Config> {
        let config = common.resolve(self.saved.as_deref(), fallback, options)?;
        let folder = match &self.capture {
            Some(capture) => capture.clone(),
            None if config.capture.path.as_os_str().is_empty() => {
                return Err(Error::usage("no capture is named", "name one: `tiface run CAPTURE`"));
            }
            // one that was moved is as it is recorded
            None => io::real_path(&config.capture.path).unwrap_or_else(|_| config.capture.path.clone()),
        };
        config.with_capture(folder)
    }

    fn run(run: PathBuf, guessed: bool) -> RunTarget {
        RunTarget { saved: Some(run.join(SETTINGS_FILE)), run, capture: None, guessed }
    }
}

/// Returns the run in `here`, else the most recently configured one under `here/runs`.
fn guess(here: &Path) -> Result<RunTarget> {
    if is_run(here) {
        return Ok(RunTarget::run(here.into(), true));
    }
    let runs = io::list_folders(&here.join("runs"))?;
    let newest =
        runs.into_iter().filter(|run| is_run(run)).max_by_key(|run| io::modified(&run.join(SETTINGS_FILE)));
    match newest {
        Some(run) => Ok(RunTarget::run(run, true)),
        None => Err(Error::usage(
            "no capture or run is named, this folder is not a run, and `runs/` contains none",
            "name a capture: `tiface run CAPTURE`, or try `tiface demo`",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use std::fs;

    #[test]
    fn another_preset_starts_a_run_over_on_the_same_photographs() {
        let dir = tempfile::tempdir().unwrap();
        let saved = dir.path().join("config.toml");
        let mut config = Config::preset(Preset::Standard);
        (config.mesh.resolution, config.capture.path) = (77, "/photos/a \"b\"".into());
        std::fs::write(&saved, config.to_toml()).unwrap();
        let mut common = Common { preset: Some(Preset::Draft), ..Common::default() };
        let found = common.resolve(Some(&saved), None, &[]).unwrap();
        let draft = Config::preset(Preset::Draft);
        assert_eq!((found.preset, found.mesh.resolution), (Preset::Draft, draft.mesh.resolution));
        assert_eq!(found.capture.path, config.capture.path);
        // they may have been moved
        common.set = vec!["capture.path=/elsewhere".into()];
        assert_eq!(common.resolve(Some(&saved), None, &[]).unwrap().capture.path, Path::new("/elsewhere"));
    }

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
        // the last ones cannot be opened, and must be refused as captures
        let formats: [&[&str]; 9] = [
            &["transforms.json"],
            &["cameras_sphere.npz"],
            &["cameras.npz"],
            &["sparse/0/cameras.bin", "sparse/0/images.bin"],
            &["image/000.png"],
            &["000.jpg"],
            &["database.db", "images/000.jpg"],
            &["project.psx"],
            &["head.mp4"],
        ];
        for files in formats {
            let dir = tempfile::tempdir().unwrap();
            fs::write(dir.path().join("config.toml"), "").unwrap();
            assert!(is_run(dir.path()));
            ["sparse/0", "image", "images"]
                .iter()
                .for_each(|d| fs::create_dir_all(dir.path().join(d)).unwrap());
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
        // beside the settings it is a capture, until one of its stages is begun
        put("transforms.json");
        assert!(!is_run(dir.path()));
        put("mask/status.json");
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
