//! Options that all commands share, and the configuration that they result in.

use super::complete::complete_setting;
use crate::config::{Config, Fallback, Preset, Sources, Stage, key};
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
pub(super) fn own_file() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let base = set("XDG_CONFIG_HOME").or_else(|| set("HOME").map(|h| h.join(".config")))?;
    Some(base.join("tiface/config.toml"))
}
