//! Options that all commands share, the configuration that they result in, and the capture and run
//! of a command.

use super::complete::complete_setting;
use crate::config::{Config, Fallback, Preset, Sources, Stage, key};
use crate::run::is_run;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, ColorChoice};
use clap_complete::ArgValueCompleter;
use std::path::{Path, PathBuf};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};

/// An option of one command that sets a key of the configuration: as typed, the key, its value.
pub(super) type KeyOption = (String, String, String);

#[derive(Args, Debug, Default)]
#[command(next_help_heading = "Options of all commands")]
pub(super) struct Common {
    /// Run folder [default: runs/<capture name>]
    #[arg(short, long, global = true, value_name = "DIR", env = "TIFACE_RUN", hide_env = true)]
    pub run: Option<PathBuf>,
    /// Also write the result to PATH, a file or a folder
    ///
    /// A file has the ending of its format: .glb, .obj, .ply or .usdz, .json for metrics. A folder
    /// exists or ends with /.
    #[arg(short, long, global = true, value_name = "PATH")]
    pub out: Option<PathBuf>,
    /// Read a configuration file; repeatable, later files win
    #[arg(short, long, global = true, value_name = "FILE", env = "TIFACE_CONFIG", hide_env = true)]
    pub config: Vec<PathBuf>,
    /// Configuration preset
    #[arg(long, global = true)]
    #[arg(value_parser = PossibleValuesParser::new(Preset::ALL.map(Preset::as_str))
        .try_map(|word| word.parse::<Preset>()))]
    pub preset: Option<Preset>,
    /// Set a configuration key; repeatable
    #[arg(long, global = true, value_name = "KEY=VALUE", add = ArgValueCompleter::new(complete_setting))]
    pub set: Vec<String>,
    /// Device: auto, cpu, wgpu, vulkan, metal or dx12; :N selects an adapter
    ///
    /// It trains and renders. `vulkan:1` is the second adapter of that kind, as `tiface doctor`
    /// numbers them.
    #[arg(long, global = true, env = "TIFACE_DEVICE", hide_env = true)]
    pub device: Option<String>,
    /// Make training on a GPU bitwise reproducible, by fixed-point accumulation; on the CPU it
    /// always is
    #[arg(long, global = true, hide_short_help = true)]
    pub deterministic: bool,
    /// GPU memory that a training may take, GiB [default: what the driver states]
    #[arg(long, global = true, value_name = "GIB", hide_short_help = true)]
    pub memory: Option<f64>,
    /// Random seed
    #[arg(long, global = true, env = "TIFACE_SEED", hide_env = true)]
    pub seed: Option<u64>,
    /// Recompute a stage and all stages that depend on it
    #[arg(long, global = true, value_name = "STAGE")]
    #[arg(value_parser = PossibleValuesParser::new(Stage::ALL.map(Stage::as_str))
        .try_map(|word| word.parse::<Stage>()))]
    pub fresh: Option<Stage>,
    /// Print the plan without running it
    #[arg(long, global = true)]
    pub dry_run: bool,
    /// Print one JSON object per event to stdout
    #[arg(long, global = true)]
    pub json: bool,
    /// Print only errors
    #[arg(short, long, global = true)]
    pub quiet: bool,
    /// Increase verbosity; repeatable
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
    /// Color messages
    #[arg(long, global = true, value_enum, default_value_t, value_name = "WHEN", hide_short_help = true)]
    pub color: ColorChoice,
}

impl Common {
    /// Sends the library's log to stderr: by `RUST_LOG`, else by `-v`.
    pub fn log(&self) {
        use tracing_subscriber::EnvFilter;
        let level = match (self.quiet, self.verbose) {
            (true, _) => "error",
            (_, 0) => "warn",
            (_, 1) => "info",
            _ => "debug",
        };
        let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
        // a second subscriber cannot be set, as in tests; the first one stays
        let _ = tracing_subscriber::fmt()
            .with_env_filter(filter)
            .with_writer(std::io::stderr)
            .with_ansi(self.colored())
            .try_init();
    }

    /// Returns whether messages on stderr are colored.
    pub fn colored(&self) -> bool {
        use std::io::IsTerminal;
        match self.color {
            ColorChoice::Always => true,
            ColorChoice::Never => false,
            ColorChoice::Auto => {
                std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty()) && std::io::stderr().is_terminal()
            }
        }
    }

    /// Returns the configuration from, in rising priority: the user's file, `TIFACE_PRESET`, the
    /// run's (`saved`), `--config`, `--set`, options.
    ///
    /// `fallback` is the start if no source names a preset.
    pub fn resolve(
        &self,
        saved: Option<&Path>,
        fallback: Option<Fallback>,
        options: &[KeyOption],
    ) -> Result<Config> {
        let mut sources =
            Sources { preset: self.preset, fallback, set: self.set.clone(), ..Sources::default() };
        let own = own_file().filter(|f| io::is_file(f));
        let has_own = usize::from(own.is_some());
        let mut files = Vec::from_iter(own);
        let mut photographed = PathBuf::new();
        match saved {
            Some(saved) if self.preset.is_some() => {
                // another preset starts over on the same photographs: the saved values would
                // override all of it
                photographed = Common::default().resolve(Some(saved), None, &[])?.capture.path;
            }
            saved => files.extend(saved.map(Path::to_path_buf)),
        }
        for file in files.into_iter().chain(self.config.iter().cloned()) {
            let limits = Limits { file_bytes: 1 << 20, ..Limits::default() };
            let bytes = io::read_maybe_empty(&file, &limits).map_err(|e| Error::usage(&e, e.hint()))?;
            let name = file.display().to_string();
            let text = String::from_utf8(bytes)
                .map_err(|_| Error::usage(format!("`{name}` is not UTF-8"), "save it as UTF-8"))?;
            sources.files.push((name, text));
        }
        if let Some(word) = std::env::var("TIFACE_PRESET").ok().filter(|word| !word.is_empty()) {
            // only `--preset` starts a run over: the variable is weaker than the run's saved preset
            sources.files.insert(has_own, ("TIFACE_PRESET".into(), format!("preset = {word:?}")));
        }
        if let Some(word) = self.device_word() {
            sources.options.push((format!("--device {word}"), key!(device).into(), word));
        }
        if let Some(seed) = self.seed {
            sources.options.push((format!("--seed {seed}"), key!(seed).into(), seed.to_string()));
        }
        sources.options.extend_from_slice(options);
        let config = Config::resolve(&sources)?;
        if config.capture.path.as_os_str().is_empty() {
            config.with_capture(photographed)
        } else {
            Ok(config)
        }
    }

    /// Returns the device option with its modifiers, or `None` if no option of the device is given.
    pub(super) fn device_word(&self) -> Option<String> {
        if self.device.is_none() && !self.deterministic && self.memory.is_none() {
            return None;
        }
        let mut word = self.device.clone().unwrap_or_else(|| "auto".into());
        if self.deterministic {
            word += "+deterministic";
        }
        if let Some(gib) = self.memory {
            word += &format!("+{gib}GiB");
        }
        Some(word)
    }
}

/// `$XDG_CONFIG_HOME/tiface/config.toml`.
fn own_file() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let base = set("XDG_CONFIG_HOME").or_else(|| set("HOME").map(|h| h.join(".config")))?;
    Some(base.join("tiface/config.toml"))
}

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
        RunTarget { saved: Some(run.join("config.toml")), run, capture: None, guessed }
    }
}

/// Returns the run in `here`, else the most recently configured one under `here/runs`.
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
            "no capture or run is named, this folder is not a run, and `runs/` contains none",
            "name a capture: `tiface run CAPTURE`, or try `tiface demo`",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
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
