//! One place for a setting: its field is its key, its comment the documentation that users read;
//! its row says what it affects, and which option of a command sets it.

/// Declares the settings of a stage.
///
/// ```text
/// table! {
///     /// What the table is about.
///     pub struct NameConfig;
///     keys {
///         /// What it means, with its unit. In brackets, the products that it affects.
///         steps: u64, 1.0..=1e7 [Iface] => 3000, 8000, 20_000;   // draft, standard, paper
///         /// One more value is that of the preset quick, which otherwise is draft's.
///         rays: usize, 1.0..=1e6 [Iface] => 1024, 1024, 256, 512;
///         /// A word, text, switch or list has no range; one value may serve every preset.
///         masks: MaskUse [Iface if has_masks, Surface] => MaskUse::Soft;
///         /// How often it is saved, which is the same result.
///         #[flag("every", Text("SECONDS"), ["mesh"], "Seconds between checkpoints")]
///         checkpoint_s: f64, 0.05..=86_400.0 [nothing] => 60.0;
///     }
///     constants {
///         /// Part of a preset that users have no reason to change: no key, not written to
///         /// `config.toml`.
///         lr_grid: f64 => 0.02;
///     }
/// }
/// ```
///
/// Makes the struct, its list of [`Key`](super::Key)s as `KEYS`, `preset(Preset)`, and
/// `keep_constants(Preset)`, which gives the constants their values again after the keys were read
/// from text. A row without its effects does not compile.
macro_rules! table {
    (
        $(#[$about:meta])*
        pub struct $name:ident;
        keys {
            $($(#[doc = $doc:literal])+ $(#[flag($($flag:tt)+)])?
                $key:ident: $ty:ty $(, $min:literal ..= $max:literal)? [$($affects:tt)+]
                => $draft:expr $(, $standard:expr, $paper:expr $(, $quick:expr)?)?;)+
        }
        $(constants {
            $($(#[doc = $constant_doc:literal])+ $constant:ident: $constant_ty:ty
                => $constant_draft:expr
                $(, $constant_standard:expr, $constant_paper:expr $(, $constant_quick:expr)?)?;)+
        })?
    ) => {
        $(#[$about])*
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[doc = $doc])+ pub $key: $ty,)+
            $($($(#[doc = $constant_doc])+ #[serde(skip)] pub $constant: $constant_ty,)+)?
        }

        impl $name {
            pub(super) const KEYS: &[super::Key] = &[
                $(super::Key {
                    name: $crate::config::table::plain(stringify!($key)),
                    doc: concat!($($doc),+).trim_ascii_start(),
                    min: $crate::config::table::bound!(f64::NEG_INFINITY $(, $min)?),
                    max: $crate::config::table::bound!(f64::INFINITY $(, $max)?),
                    affects: $crate::config::affects::affects!($($affects)+),
                    flag: $crate::config::table::flag!($($($flag)+)?),
                },)+
            ];

            /// Returns the values a preset starts with.
            pub fn preset(preset: super::Preset) -> $name {
                $name {
                    $($key: $crate::config::table::of_preset!(
                        preset, $draft $(, $standard, $paper $(, $quick)?)?
                    ),)+
                    $($($constant: $crate::config::table::of_preset!(
                        preset, $constant_draft
                        $(, $constant_standard, $constant_paper $(, $constant_quick)?)?
                    ),)+)?
                }
            }
        }

        $(impl $name {
            /// These keys with a preset's constants.
            pub(super) fn keep_constants(self, preset: super::Preset) -> $name {
                let _ = preset; // where every preset has the same constants
                $name {
                    $($constant: $crate::config::table::of_preset!(
                        preset, $constant_draft
                        $(, $constant_standard, $constant_paper $(, $constant_quick)?)?
                    ),)+
                    ..self
                }
            }
        })?
    };
}

/// Returns the name of a field as it is written in TOML: without the mark of a word that is Rust's
/// own.
pub(super) const fn plain(field: &'static str) -> &'static str {
    match field.as_bytes() {
        [b'r', b'#', name @ ..] => match std::str::from_utf8(name) {
            Ok(name) => name,
            Err(_) => field,
        },
        _ => field,
    }
}

/// The second value, else the first.
macro_rules! bound {
    ($none:expr) => {
        $none
    };
    ($none:expr, $value:literal) => {
        $value
    };
}

/// The option of a row: its name, its value, the commands that have it, and its help if that is not
/// the key's documentation.
macro_rules! flag {
    () => {
        None
    };
    ($long:literal, $takes:ident $(($value:literal))?, [$($command:literal),+] $(, $help:literal)?) => {
        Some($crate::config::Flag {
            long: $long,
            takes: $crate::config::Takes::$takes $(($value))?,
            commands: &[$($command),+],
            help: concat!($($help)?),
        })
    };
}

/// The value of a preset: one for all, or draft, standard, paper, and quick where it is not
/// draft's.
macro_rules! of_preset {
    ($preset:ident, $all:expr) => {
        $all
    };
    ($preset:ident, $draft:expr, $standard:expr, $paper:expr) => {
        $crate::config::table::of_preset!($preset, $draft, $standard, $paper, $draft)
    };
    ($preset:ident, $draft:expr, $standard:expr, $paper:expr, $quick:expr) => {
        match $preset {
            super::Preset::Quick => $quick,
            super::Preset::Draft => $draft,
            super::Preset::Standard => $standard,
            super::Preset::Paper => $paper,
        }
    };
}

pub(super) use {bound, flag, of_preset, table};
