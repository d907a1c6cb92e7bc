//! Presets: how much effort a run is worth.

use serde::{Deserialize, Serialize};
use std::str::FromStr;
use tiface_base::{Error, Result};

/// How much effort: the starting values of every table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// A look in two minutes on two cores: [`Preset::Draft`] with fewer steps.
    Quick,
    /// A first result in minutes.
    Draft,
    /// What to use.
    #[default]
    Standard,
    /// The published recipe; changes only to be corrected.
    Paper,
}

impl Preset {
    /// All presets, from the least effort to the most.
    pub const ALL: [Preset; 4] = [Preset::Quick, Preset::Draft, Preset::Standard, Preset::Paper];

    /// Its word in the configuration.
    pub fn as_str(self) -> &'static str {
        match self {
            Preset::Quick => "quick",
            Preset::Draft => "draft",
            Preset::Standard => "standard",
            Preset::Paper => "paper",
        }
    }
}

impl FromStr for Preset {
    type Err = Error;

    fn from_str(word: &str) -> Result<Preset> {
        let found = Preset::ALL.into_iter().find(|preset| preset.as_str() == word);
        found.ok_or_else(|| {
            Error::usage(format!("there is no preset `{word}`"), "use quick, draft, standard or paper")
        })
    }
}
