//! The commands that find cameras, in the words of the installed version.
//!
//! | COLMAP | options of features and matches | `--glomap` |
//! |---|---|---|
//! | 3.8 to 3.12 | `SiftExtraction.use_gpu`, `SiftMatching.guided_matching` | `glomap mapper` |
//! | 3.13 | `FeatureExtraction.use_gpu`, `FeatureMatching.guided_matching` | the same |
//! | 4.0 to 4.2 | the same | `colmap view_graph_calibrator`, then `colmap global_mapper` |
//!
//! The others have one name in all versions: `ImageReader`, `SiftExtraction.peak_threshold` and its
//! kin, `Mapper.num_threads`, `BundleAdjustment.refine_principal_point`. The program's help says
//! which it knows.

use super::output::{NAMES, OPTIONS};
use super::{Attempt, MAX_EXHAUSTIVE, SfmOptions, Work};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use tiface_base::io;
use tiface_base::{Error, Result};

const INSTALL_COLMAP: &str = "install COLMAP: `apt-get install colmap` on Debian and Ubuntu, `brew install colmap` on macOS; on \
                              Windows, unpack the release from https://github.com/colmap/colmap/releases and add its folder \
                              to PATH";

const INSTALL_GLOMAP: &str = "leave out `--glomap`, or install COLMAP 4, which has that mapper \
                              (https://github.com/colmap/colmap/releases), or GLOMAP beside an older one: \
                              https://github.com/colmap/glomap";

/// Options of the global mapper, where it has them, and their values; threads stand for themselves.
const GLOBAL_OPTIONS: [(&str, &str); 3] = [
    ("--GlobalMapper.num_threads", "threads"),
    ("--GlobalMapper.gp_use_gpu", "0"),
    ("--GlobalMapper.ba_ceres_use_gpu", "0"),
];

/// The programs that find cameras.
pub(super) struct Programs {
    pub colmap: PathBuf,
    pub mapper: Mapper,
}

/// What finds poses from matches.
pub(super) enum Mapper {
    /// COLMAP's `mapper`, which adds one photograph after the other.
    Incremental,
    /// COLMAP's `global_mapper`, which GLOMAP became; the focal lengths are calibrated before where
    /// COLMAP can.
    Global { calibrates: bool },
    /// `glomap mapper`, which calibrates by itself.
    Glomap(PathBuf),
}

impl Programs {
    /// Returns the installed programs.
    pub fn find(sfm: &SfmOptions) -> Result<Programs> {
        let missing = || Error::cannot("`colmap` is not installed", INSTALL_COLMAP);
        let colmap = io::find_program("colmap").ok_or_else(missing)?;
        if !sfm.glomap {
            return Ok(Programs { colmap, mapper: Mapper::Incremental });
        }
        let help = io::help_of(&colmap, &["help"], sfm.stop);
        if (sfm.stop)() {
            return Err(Error::stopped("before its end").with_hint(""));
        }
        let help = help.unwrap_or_default();
        let has = |command: &str| help.split_whitespace().any(|word| word == command);
        let mapper = match io::find_program("glomap") {
            _ if has("global_mapper") => Mapper::Global { calibrates: has("view_graph_calibrator") },
            Some(glomap) => Mapper::Glomap(glomap),
            None => {
                let problem = "`glomap` is not installed, and the installed COLMAP has no `global_mapper`";
                return Err(Error::cannot(problem, INSTALL_GLOMAP));
            }
        };
        Ok(Programs { colmap, mapper })
    }

    /// Returns the program that maps, and its name.
    pub fn mapper(&self) -> (&Path, &'static str) {
        match &self.mapper {
            Mapper::Glomap(glomap) => (glomap, "glomap"),
            _ => (&self.colmap, "colmap"),
        }
    }
}

/// How the installed version spells its options.
#[derive(Clone, Debug, Default)]
pub(super) struct Spelling {
    /// Whether it is 3.13 or later, which moved some options from `Sift…` to `Feature…`.
    pub has_new_names: bool,
    /// Those of [`GLOBAL_OPTIONS`] that it has.
    pub global: Vec<(&'static str, &'static str)>,
}

/// Arguments of the commands of an attempt.
pub(super) struct Commands {
    pub extractor: Vec<OsString>,
    pub matcher: Vec<OsString>,
    pub calibrator: Option<Vec<OsString>>,
    pub mapper: Vec<OsString>,
}

impl Work<'_> {
    /// Asks COLMAP how it spells its options.
    pub(super) fn spelling(&self) -> Result<Spelling> {
        let has_new_names = self.help("feature_extractor")?.contains("FeatureExtraction.use_gpu");
        let mut global = Vec::new();
        if matches!(self.programs.mapper, Mapper::Global { .. }) {
            let help = self.help("global_mapper")?;
            let has = |(name, _): &(&str, &str)| help.split_whitespace().any(|word| word == *name);
            global.extend(GLOBAL_OPTIONS.into_iter().filter(has));
        }
        Ok(Spelling { has_new_names, global })
    }

    /// Returns the help of a command of COLMAP, behind what it said of others before.
    fn help(&self, command: &str) -> Result<String> {
        let said = self.output.work(OPTIONS);
        self.require(&[command.into(), "-h".into()], &said)?;
        let text = io::read_maybe_empty(&said, &self.sfm.limits)?;
        Ok(String::from_utf8_lossy(&text).into_owned())
    }

    /// Returns the commands of an attempt in a folder.
    pub(super) fn commands(&self, attempt: Attempt, folder: &Path, spelling: &Spelling) -> Commands {
        let Attempt { masked, weak } = attempt;
        let threads = rayon::current_num_threads().to_string();
        let kind = if spelling.has_new_names { "Feature" } else { "Sift" };
        let on_cpu = |task: &str| format!("--{kind}{task}.use_gpu 0 --{kind}{task}.num_threads {threads}");
        let [database, models] = ["database.db", "models"].map(|name| folder.join(name));
        let (images, masks) = (self.sfm.out.join("images"), self.output.work("masks"));
        let listed = self.output.work(NAMES);
        let command = |name: &str, paths: &[(&str, &Path)], words: String| -> Vec<OsString> {
            let paths = paths.iter().flat_map(|(option, path)| [OsString::from(option), path.into()]);
            let words = words.split_whitespace().map(OsString::from);
            [name.into()].into_iter().chain(paths).chain(words).collect()
        };
        let database: (&str, &Path) = ("--database_path", &database);
        let paths = [database, ("--image_path", &images)];
        let read = [
            (masked, ("--ImageReader.mask_path", masks.as_path())),
            (io::is_file(&listed), ("--image_list_path", listed.as_path())),
        ];
        let read = read.into_iter().filter_map(|(is_given, path)| is_given.then_some(path));
        let read: Vec<(&str, &Path)> = paths.into_iter().chain(read).collect();
        let mut words = on_cpu("Extraction") + " --ImageReader.camera_model SIMPLE_RADIAL";
        words += if self.shared { " --ImageReader.single_camera 1" } else { "" };
        if weak {
            words += " --SiftExtraction.peak_threshold 0.002 --SiftExtraction.estimate_affine_shape 1 \
                      --SiftExtraction.domain_size_pooling 1";
        }
        let extractor = command("feature_extractor", &read, words);
        let is_long = self.is_video && self.names.len() > MAX_EXHAUSTIVE;
        let matcher = if is_long { "sequential_matcher" } else { "exhaustive_matcher" };
        let guided = if weak { format!(" --{kind}Matching.guided_matching 1") } else { String::new() };
        let matcher = command(matcher, &[database], on_cpu("Matching") + &guided);
        let calibrates = matches!(self.programs.mapper, Mapper::Global { calibrates: true });
        let calibrator = calibrates.then(|| command("view_graph_calibrator", &[database], String::new()));
        let value =
            |value: &&'static str| if *value == "threads" { threads.clone() } else { value.to_string() };
        let (mapper, words) = match self.programs.mapper {
            Mapper::Incremental => ("mapper", format!("--Mapper.num_threads {threads}")),
            Mapper::Global { .. } => {
                let options = spelling.global.iter().map(|(name, given)| format!("{name} {}", value(given)));
                ("global_mapper", options.collect::<Vec<_>>().join(" "))
            }
            Mapper::Glomap(_) => ("mapper", String::new()),
        };
        let mapper = command(mapper, &[paths[0], paths[1], ("--output_path", &models)], words);
        Commands { extractor, matcher, calibrator, mapper }
    }
}
