//! All settings: defaults, presets, files, `--set`; checked before anything is computed.
//!
//! Later wins: defaults, then the preset, then each file, then `--set`. A key that is not known, of
//! the wrong type or out of range is an error that names the line, the key and a suggested fix. The
//! complete result ([`Config::to_toml`]) passed back as a file gives the same configuration.
//!
//! Each stage owns its table, declared by `table!`: a key, its documentation, range, the products
//! that it affects, its command-line option and the values of the presets stand once, on its field.
//! Everything here works on what serde says about them; what makes a stage again is a filter over
//! the rows ([`Config::settings_of`]), and code that names a key writes `key!(mesh.lobes)`. A value
//! that no user has a reason to change is a constant of the preset instead of a key, in the same
//! place.

mod affects;
mod capture;
mod device;
mod ensemble;
mod explain;
pub mod iface;
mod mask;
mod mesh;
mod metrics;
mod preset;
mod render;
mod row;
mod source;
mod stage;
mod table;
mod vm;

pub use affects::{Effect, Product};
pub use capture::CaptureConfig;
pub use device::DeviceChoice;
pub use ensemble::EnsembleConfig;
pub use explain::{Explained, explain, explained};
pub use iface::IfaceConfig;
pub use mask::{CutMethod, MaskConfig, MattingMethod, VitmatteColors};
pub use mesh::{ColorSource, Genus, Hair, HairViews, MeshConfig, MeshFormat};
pub use metrics::{MetricsConfig, TruthPhoto};
pub use preset::Preset;
pub use render::{Method, NAMES, PictureFormat, RenderConfig, ViewBackground, display_name};
pub use row::{Flag, Key, Takes};
pub use source::{Fallback, Sources, known_words};
pub use stage::Stage;
pub use tiface_capture::{CameraPoses, Exposures, Glares, HeadValue, MaskHead, MaskMeaning, MaskSource};
pub use vm::{BaselineConfig, DensityActivation, MaskLoss, MaskUse, VmBackground, VmConfig, VmStart};

use affects::affects;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};
use toml::{Table, Value};

/// Name of the file in a run that has all of its settings.
pub const SETTINGS_FILE: &str = "config.toml";

/// The whole configuration, complete and valid.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The preset it started from.
    pub preset: Preset,
    /// Random seed.
    pub seed: u64,
    /// A [`DeviceChoice`] as a word.
    pub device: String,
    /// The capture.
    pub capture: CaptureConfig,
    /// Head masks.
    pub mask: MaskConfig,
    /// The radiance field without masks that T-Face is compared with.
    pub baseline: BaselineConfig,
    /// T-Face.
    pub tface: VmConfig,
    /// The learned signed-distance field.
    pub iface: IfaceConfig,
    /// The extracted surface.
    pub mesh: MeshConfig,
    /// Rendered views.
    pub render: RenderConfig,
    /// The blend of views.
    pub ensemble: EnsembleConfig,
    /// Metrics of views and surface.
    pub metrics: MetricsConfig,
}

const ROOT_KEYS: &[Key] = &[
    Key {
        name: "preset",
        doc: "Preset that all other keys default to: quick (a look in minutes), draft (a first result), standard, paper \
              (the published recipe).",
        min: f64::NEG_INFINITY,
        max: f64::INFINITY,
        affects: affects!(Baseline, Tface, Iface),
        flag: None,
    },
    Key {
        name: "seed",
        doc: "Random seed; the same seed on the same device gives the same result.",
        min: 0.0,
        max: i64::MAX as f64,
        affects: affects!(Baseline, Tface, Iface),
        flag: None,
    },
    Key {
        name: "device",
        doc: "Device that fields are trained on: auto, cpu, wgpu, vulkan, metal or dx12, :N for an adapter by number; \
              +deterministic accumulates in fixed point, +8GiB limits the memory.",
        min: f64::NEG_INFINITY,
        max: f64::INFINITY,
        affects: affects!(nothing),
        flag: None,
    },
];

/// Every table with its keys, in pipeline order; the first has no name.
const TABLES: &[(&str, &[Key])] = &[
    ("", ROOT_KEYS),
    ("capture", CaptureConfig::KEYS),
    ("mask", MaskConfig::KEYS),
    ("baseline", BaselineConfig::KEYS),
    ("tface", VmConfig::KEYS),
    ("iface", IfaceConfig::KEYS),
    ("mesh", MeshConfig::KEYS),
    ("render", RenderConfig::KEYS),
    ("ensemble", EnsembleConfig::KEYS),
    ("metrics", MetricsConfig::KEYS),
];

/// Returns every key by its full, dotted name, with its documentation.
pub fn keys() -> impl Iterator<Item = (String, &'static str)> {
    all_keys().map(|(name, key)| (name, key.doc))
}

/// Returns whether a table has a key; the first table has no name.
pub(crate) const fn is_key(table: &str, name: &str) -> bool {
    let mut t = 0;
    while t < TABLES.len() {
        let (known, keys) = TABLES[t];
        let mut k = 0;
        while same(known, table) && k < keys.len() {
            if same(keys[k].name, name) {
                return true;
            }
            k += 1;
        }
        t += 1;
    }
    false
}

const fn same(a: &str, b: &str) -> bool {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    let mut i = 0;
    while i < a.len() && i < b.len() && a[i] == b[i] {
        i += 1;
    }
    i == a.len() && i == b.len()
}

/// Returns the full name of a key, as in `key!(mesh.lobes)` or `key!(seed)`. A key that no table
/// has does not compile.
macro_rules! key {
    ($table:ident . $name:ident) => {{
        const _: () = assert!($crate::config::is_key(stringify!($table), stringify!($name)));
        concat!(stringify!($table), ".", stringify!($name))
    }};
    ($name:ident) => {{
        const _: () = assert!($crate::config::is_key("", stringify!($name)));
        stringify!($name)
    }};
}
pub(crate) use key;

/// Returns every key with its full, dotted name.
pub(crate) fn all_keys() -> impl Iterator<Item = (String, &'static Key)> {
    TABLES.iter().flat_map(|(table, keys)| keys.iter().map(|k| (dotted(table, k.name), k)))
}

fn dotted(table: &str, name: &str) -> String {
    if table.is_empty() { name.into() } else { format!("{table}.{name}") }
}

impl Config {
    /// Returns the values of a preset.
    pub fn preset(preset: Preset) -> Config {
        Config {
            preset,
            seed: 42,
            device: "auto".into(),
            capture: CaptureConfig::preset(preset),
            mask: MaskConfig::preset(preset),
            baseline: BaselineConfig::preset(preset),
            tface: VmConfig::preset(preset),
            iface: IfaceConfig::preset(preset),
            mesh: MeshConfig::preset(preset),
            render: RenderConfig::preset(preset),
            ensemble: EnsembleConfig::preset(preset),
            metrics: MetricsConfig::preset(preset),
        }
    }

    /// Returns the configuration that the run in `folder` was last worked on with; none where it
    /// has no `config.toml`, or one that is not understood any more.
    pub fn of_run(folder: &Path) -> Option<Config> {
        Config::read(&folder.join(SETTINGS_FILE)).ok()
    }

    /// Reads a configuration from the text of a complete file.
    ///
    /// # Errors
    ///
    /// The first thing wrong with it, with its line.
    pub fn read(file: &Path) -> Result<Config> {
        let text = String::from_utf8_lossy(&io::read_bytes(file, &Limits::default())?).into_owned();
        Config::resolve(&Sources { files: vec![(file.display().to_string(), text)], ..Sources::default() })
    }

    /// Settings of the radiance field that the stage `baseline` or `tface` learns.
    pub fn radiance(&self, stage: Stage) -> VmConfig {
        if stage == Stage::Baseline { self.baseline.field(&self.tface) } else { self.tface.clone() }
    }

    /// Returns the configuration for the capture in a folder.
    ///
    /// # Errors
    ///
    /// Fails if the path is not UTF-8, which a configuration file has to be.
    pub fn with_capture(mut self, folder: PathBuf) -> Result<Config> {
        if folder.to_str().is_none() {
            let problem = format!("the path of the capture is not UTF-8: `{}`", folder.display());
            return Err(Error::cannot(problem, "rename the folder"));
        }
        self.capture.path = folder;
        Ok(self)
    }

    /// With the constants of its preset, which are not read from text.
    fn keep_constants(self) -> Config {
        Config {
            tface: self.tface.keep_constants(self.preset),
            iface: self.iface.keep_constants(self.preset),
            mesh: self.mesh.keep_constants(self.preset),
            ..self
        }
    }

    /// Returns the configuration that `sources` describe, or the first thing wrong with them.
    ///
    /// ```
    /// use tiface::config::{Config, Preset, Sources};
    ///
    /// let set = |text: &str| Sources { set: vec![text.into()], ..Sources::default() };
    /// let config = Config::resolve(&set("mesh.resolution=300"))?;
    /// assert_eq!((config.preset, config.mesh.resolution), (Preset::Standard, 300));
    ///
    /// let error = Config::resolve(&set("mesh.resolutoin=300")).unwrap_err();
    /// let expected = "`--set mesh.resolutoin=300`: there is no key `mesh.resolutoin`";
    /// assert_eq!(error.to_string(), expected);
    /// assert!(error.hint().starts_with("did you mean `mesh.resolution`?"));
    /// # Ok::<(), tiface::Error>(())
    /// ```
    pub fn resolve(sources: &Sources) -> Result<Config> {
        source::resolve(sources)
    }

    /// As TOML, complete, every key with its documentation above it.
    pub fn to_toml(&self) -> String {
        let root = self.to_table();
        let mut out =
            String::from("# tiface configuration: `tiface run CAPTURE --config THIS` repeats the run\n");
        for (table, keys) in TABLES {
            if !table.is_empty() {
                let _ = writeln!(out, "\n[{table}]");
            }
            for key in *keys {
                if let Some(value) = lookup(&root, &dotted(table, key.name)) {
                    let _ = writeln!(out, "# {}\n{} = {}", key.doc, key.name, show(value));
                }
            }
        }
        out
    }

    /// Returns the keys that affect a product directly, by full name (`iface.steps`), with their
    /// values as they are written in TOML: the settings in its fingerprint.
    pub fn settings_of(&self, product: Product) -> BTreeMap<String, String> {
        let root = match product {
            // what the baseline takes from T-Face's table, with its differences from that
            Product::Baseline => Config { tface: self.radiance(Stage::Baseline), ..self.clone() }.to_table(),
            _ => self.to_table(),
        };
        all_keys()
            .filter(|(_, key)| key.affects(product, self))
            .filter_map(|(name, _)| lookup(&root, &name).map(|v| (name, show(v))))
            .collect()
    }

    /// Returns the keys whose values are not those of the preset: full name, value, the preset's
    /// value, as in TOML.
    pub fn changes(&self) -> Vec<[String; 3]> {
        self.differences(&Config::preset(self.preset))
    }

    /// Returns the keys whose values differ from those of another configuration: full name, value,
    /// the other's value, as in TOML.
    pub fn differences(&self, other: &Config) -> Vec<[String; 3]> {
        let (own, other) = (self.to_table(), other.to_table());
        let change = |(name, _): (String, &Key)| {
            let [own, other] = [&own, &other].map(|t| lookup(t, &name).map(show).unwrap_or_default());
            (own != other).then_some([name, own, other])
        };
        all_keys().filter_map(change).collect()
    }

    fn to_table(&self) -> Table {
        match Value::try_from(self) {
            Ok(Value::Table(table)) => table,
            // a struct of numbers, words and lists always is a table; a test serializes every
            // preset
            _ => Table::new(),
        }
    }
}

fn lookup<'a>(root: &'a Table, dotted: &str) -> Option<&'a Value> {
    let mut parts = dotted.split('.');
    let mut value = root.get(parts.next()?)?;
    for part in parts {
        value = value.as_table()?.get(part)?;
    }
    Some(value)
}

/// Returns a value as it is written in TOML. A number that came from an f32 is written with an
/// f32's digits (0.1, not 0.10000000149011612): read back, it is the same f32.
fn show(value: &Value) -> String {
    match value {
        Value::Float(f) if f.is_finite() && (*f as f32) as f64 == *f => {
            format!("{:?}", *f as f32) // `1e-5` and `2.0` are TOML as they stand
        }
        other => other.to_string(),
    }
}

#[cfg(test)]
mod source_tests;
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_differs_from_the_preset_is_listed() {
        let mut config = Config::preset(Preset::Draft);
        assert!(config.changes().is_empty());
        (config.seed, config.iface.lr_table) = (7, 0.1);
        let expected = [["seed", "7", "42"], ["iface.lr_table", "0.1", "0.01"]].map(|c| c.map(String::from));
        assert_eq!(config.changes(), expected);
    }

    #[test]
    fn every_field_has_a_documented_key_and_every_key_a_field() {
        for preset in Preset::ALL {
            let root = Config::preset(preset).to_table();
            let mut fields = Vec::new();
            for (name, value) in &root {
                match value {
                    Value::Table(t) => fields.extend(t.keys().map(|k| format!("{name}.{k}"))),
                    _ => fields.push(name.clone()),
                }
            }
            let mut keys: Vec<String> = all_keys().map(|(name, _)| name).collect();
            keys.sort();
            fields.sort();
            assert_eq!(fields, keys);
        }
        for (name, key) in all_keys() {
            assert!(key.doc.ends_with('.') && key.min <= key.max, "{name}");
        }
    }

    #[test]
    fn every_preset_lies_in_its_own_ranges_and_comes_back_from_its_own_file() {
        for preset in Preset::ALL {
            let config = Config::preset(preset);
            let text = config.to_toml();
            let sources = Sources { files: vec![("saved.toml".into(), text.clone())], ..Sources::default() };
            let back = Config::resolve(&sources).unwrap_or_else(|e| panic!("{e}\n{text}"));
            assert_eq!(back, config);
        }
    }

    #[test]
    fn a_number_from_an_f32_is_written_with_the_digits_of_an_f32() {
        assert_eq!(show(&Value::Float(0.1f32 as f64)), "0.1");
        assert_eq!(show(&Value::Float(0.1)), "0.1");
        assert_eq!(show(&Value::Float(2.0)), "2.0");
        let tiny = show(&Value::Float(1e-12f32 as f64));
        assert_eq!(tiny.parse::<f32>().unwrap(), 1e-12f32);
    }
}
