//! Fingerprint of a result: settings, inputs, format version; and the difference of two.

use crate::io::{self, ReadError};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Everything that affects a result. Stored in full, not only as a hash, so that a
/// difference can be reported key by key.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fingerprint {
    /// Version of the result's files; raised when their meaning changes.
    pub format: u32,
    /// Full name of a setting to its value as written in TOML.
    pub settings: BTreeMap<String, String>,
    /// Name of an input to its own digest.
    pub inputs: BTreeMap<String, String>,
    /// The changed files of the input `capture`, if known; for messages, not part of the digest.
    #[serde(skip)]
    pub changed: Option<String>,
}

impl Fingerprint {
    /// Returns a fingerprint of settings.
    pub fn new(format: u32, settings: BTreeMap<String, String>) -> Fingerprint {
        Fingerprint { format, settings, ..Fingerprint::default() }
    }

    /// Adds a setting.
    pub fn setting(mut self, name: &str, value: impl ToString) -> Fingerprint {
        self.settings.insert(name.into(), value.to_string());
        self
    }

    /// Adds an input: the digest of another result or of a file.
    pub fn input(mut self, name: &str, digest: impl Into<String>) -> Fingerprint {
        self.inputs.insert(name.into(), digest.into());
        self
    }

    /// Returns the SHA-256 of the fingerprint, hexadecimal.
    pub fn digest(&self) -> String {
        let mut hash = Sha256::new();
        let mut part = |text: &str| {
            // lengths before the texts, so that different lists give different bytes
            hash.update((text.len() as u64).to_le_bytes());
            hash.update(text);
        };
        part(&self.format.to_string());
        for (kind, map) in [("settings", &self.settings), ("inputs", &self.inputs)] {
            part(kind);
            part(&map.len().to_string());
            for (name, value) in map {
                part(name);
                part(value);
            }
        }
        hex(&hash.finalize())
    }

    /// Returns the SHA-256 of bytes, hexadecimal: the digest of a file.
    pub fn of_bytes(bytes: &[u8]) -> String {
        hex(&Sha256::digest(bytes))
    }

    /// Returns the SHA-256 of a file of any size, hexadecimal; it may be empty.
    pub fn of_file(path: &Path) -> Result<String, ReadError> {
        let mut digest = Sha256::new();
        io::read_pieces(path, |piece| digest.update(piece))?;
        Ok(hex(&digest.finalize()))
    }

    /// Returns the differences from an `older` fingerprint, one line each; of another format, that
    /// alone.
    pub fn differences(&self, older: &Fingerprint) -> Vec<String> {
        let mut lines = Vec::new();
        if self.format != older.format {
            // settings and inputs of another format mean something else
            return vec![format!("format version: was {}, is {}", older.format, self.format)];
        }
        let names: BTreeSet<_> = self.settings.keys().chain(older.settings.keys()).collect();
        for name in names {
            let (was, is) = (older.settings.get(name), self.settings.get(name));
            if was != is {
                let show = |v: Option<&String>| v.cloned().unwrap_or_else(|| "not set".into());
                lines.push(format!("{name}: was {}, is {}", show(was), show(is)));
            }
        }
        let names: BTreeSet<_> = self.inputs.keys().chain(older.inputs.keys()).collect();
        for name in names.into_iter().filter(|n| self.inputs.get(*n) != older.inputs.get(*n)) {
            lines.push(match (older.inputs.contains_key(name), self.inputs.contains_key(name)) {
                (true, false) => format!("{name}: was an input, is none now"),
                (false, true) => format!("{name}: is an input, was none before"),
                _ => match &self.changed {
                    Some(changed) if name == "capture" => format!("{name}: {changed}"),
                    _ => format!("{name}: has changed since"),
                },
            });
        }
        lines
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_name_every_setting_and_input() {
        let old = Fingerprint::default().setting("iface.steps", 20000).input("mask", "aa");
        let new =
            Fingerprint::default().setting("iface.steps", 5000).setting("iface.rays", 8).input("mask", "bb");
        assert_eq!(
            new.differences(&old),
            ["iface.rays: was not set, is 8", "iface.steps: was 20000, is 5000", "mask: has changed since"]
        );
        // an input that is no longer used is no changed input
        let other = Fingerprint::default().setting("iface.steps", 20000).input("tface", "cc");
        assert_eq!(
            other.differences(&old),
            ["mask: was an input, is none now", "tface: is an input, was none before"]
        );
        assert_eq!(
            Fingerprint { format: 3, ..new.clone() }.differences(&old),
            ["format version: was 0, is 3"]
        );
        assert_ne!(new.digest(), old.digest());
        assert_eq!(old.digest(), old.clone().digest());
        assert!(old.differences(&old).is_empty());
    }

    #[test]
    fn a_value_that_moves_between_neighbors_changes_the_digest() {
        let a = Fingerprint::default().setting("ab", "c");
        let b = Fingerprint::default().setting("a", "bc");
        assert_ne!(a.digest(), b.digest());
        assert_ne!(
            Fingerprint::default().setting("x", "y").digest(),
            Fingerprint::default().input("x", "y").digest()
        );
    }

    #[test]
    fn the_digest_of_bytes_is_sha_256() {
        // FIPS 180-2, appendix B.1
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(Fingerprint::of_bytes(b"abc"), abc);
    }
}
