//! A row of the table of a stage: a key with its meaning, range, effects and option.

use super::{Config, Effect, Product};

/// A key of the configuration: what it means and what a number may be.
#[derive(Clone, Copy, Debug)]
pub struct Key {
    /// Name inside its table.
    pub name: &'static str,
    /// What it means, with its unit.
    pub doc: &'static str,
    /// Minimum; `f64::NEG_INFINITY` if unbounded or not numeric.
    pub min: f64,
    /// Maximum; `f64::INFINITY` if unbounded or not numeric.
    pub max: f64,
    /// What its value changes; empty: no result.
    pub affects: &'static [Effect],
    /// The option of commands that sets it.
    pub flag: Option<Flag>,
}

/// An option of commands that sets a key.
#[derive(Clone, Copy, Debug)]
pub struct Flag {
    /// Its name, without `--`.
    pub long: &'static str,
    /// The values that it takes.
    pub takes: Takes,
    /// The commands that have it.
    pub commands: &'static [&'static str],
    /// What it does; empty: the documentation of the key.
    pub help: &'static str,
}

/// The values of a [`Flag`], with their name in help.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Takes {
    /// One value.
    Text(&'static str),
    /// A file, which is stored by its absolute path.
    File,
    /// The option is repeatable: a list.
    Each(&'static str),
    /// None: the option stands for this value.
    Switch(&'static str),
}

impl Key {
    /// Returns whether the value of this key affects a product directly, with these settings.
    pub fn affects(&self, product: Product, config: &Config) -> bool {
        self.affects.iter().any(|effect| effect.reaches(product, config))
    }

    /// `1 to 64`, `at least 1`; empty where every value is allowed.
    pub fn range(&self) -> String {
        match (self.min.is_finite(), self.max.is_finite()) {
            (true, true) => format!("{} to {}", self.min, self.max),
            (true, false) => format!("at least {}", self.min),
            (false, true) => format!("at most {}", self.max),
            (false, false) => String::new(),
        }
    }
}
