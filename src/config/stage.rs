//! The stages. The name of a stage is also its table in `config.toml`, its folder in the run and
//! its command.

use super::Config;
use std::fmt::{self, Display};
use std::path::Path;
use std::str::FromStr;
use tiface_base::{Error, Result};

/// A stage of the pipeline.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Stage {
    /// Which pixels are the head, and where that puts it in space.
    Mask,
    /// A radiance field learned from whole photographs.
    Baseline,
    /// A radiance field learned from masked photographs.
    Tface,
    /// A signed distance learned from masked photographs.
    Iface,
    /// The zero level set of that distance, closed.
    Mesh,
    /// Views of the fields and of the mesh.
    Render,
    /// Those views become one.
    Ensemble,
    /// All of them against the photographs.
    Metrics,
}

use Stage::{Baseline, Ensemble, Iface, Mask, Mesh, Metrics, Render, Tface};

impl Stage {
    /// All stages in order.
    pub const ALL: [Stage; 8] = [Mask, Baseline, Tface, Iface, Mesh, Render, Ensemble, Metrics];

    /// Its word.
    pub fn as_str(self) -> &'static str {
        ["mask", "baseline", "tface", "iface", "mesh", "render", "ensemble", "metrics"][self as usize]
    }

    /// Returns whether the stage trains a field.
    pub fn learns(self) -> bool {
        matches!(self, Baseline | Tface | Iface)
    }

    /// Returns whether the stage computes on the configured device.
    pub fn uses_device(self) -> bool {
        self.learns() || matches!(self, Mesh | Render)
    }

    /// Returns the stages that it reads from. What views are made of decides what `render` needs.
    pub fn needs(self, config: &Config) -> Vec<Stage> {
        match self {
            Mask => Vec::new(),
            Baseline | Tface | Iface => vec![Mask],
            Mesh if config.mesh.uses_tface() => vec![Tface, Iface],
            Mesh => vec![Iface],
            Render => config.render.shows(),
            Ensemble => vec![Render],
            Metrics if config.ensemble.members.is_empty() => vec![Render],
            Metrics => vec![Render, Ensemble],
        }
    }

    /// Returns the stages and all that they need, in order.
    pub fn with_needs(mut wanted: Vec<Stage>, config: &Config) -> Vec<Stage> {
        let mut next = 0;
        while next < wanted.len() {
            let needs = wanted[next].needs(config);
            wanted.extend(needs);
            next += 1;
        }
        Stage::ALL.into_iter().filter(|stage| wanted.contains(stage)).collect()
    }

    /// Returns the stage and all that build on it, in order: what is out of date when it is made
    /// again.
    pub fn followers(self, config: &Config) -> Vec<Stage> {
        Stage::ALL.into_iter().filter(|s| Stage::with_needs(vec![*s], config).contains(&self)).collect()
    }
}

impl Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for Stage {
    type Err = Error;

    fn from_str(word: &str) -> Result<Stage> {
        Stage::ALL.into_iter().find(|s| s.as_str() == word).ok_or_else(|| {
            let known = Stage::ALL.map(Stage::as_str).join(", ");
            Error::usage(format!("there is no stage `{word}`"), format!("stages are {known}"))
        })
    }
}

/// Its folder in a run.
impl AsRef<Path> for Stage {
    fn as_ref(&self) -> &Path {
        Path::new(self.as_str())
    }
}
