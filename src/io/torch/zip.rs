//! The zip archive around a checkpoint.

use super::super::archive::unpack;
use super::super::{Limits, ReadError};
use super::FORMAT;
use std::collections::BTreeMap;
use std::path::Path;

/// Entries by their full name.
pub(super) struct Archive {
    entries: BTreeMap<String, Vec<u8>>,
    /// What stands before `data.pkl`, with its slash.
    root: String,
}

impl Archive {
    /// Checks every entry: inside the file, apart from the others, named once, of the sum it was stored with.
    pub(super) fn open(path: &Path, bytes: &[u8], limits: &Limits) -> Result<Archive, ReadError> {
        let bad = |problem: String| ReadError::damaged(path, FORMAT, None, problem);
        let hint = "pack it with `zip -0` and without a password, or save it again with torch";
        let entries = unpack(path, bytes, FORMAT, hint, limits)?;
        let mut roots = entries.keys().filter_map(|n| n.strip_suffix("data.pkl"));
        let mut roots = roots.by_ref().filter(|r| r.is_empty() || r.ends_with('/'));
        let root = match (roots.next(), roots.next()) {
            (Some(root), None) => root.to_string(),
            (None, _) => return Err(bad("the archive holds no `data.pkl`".into())),
            _ => return Err(bad("the archive holds more than one `data.pkl`".into())),
        };
        Ok(Archive { entries, root })
    }

    /// The content of `name` below the archive's own folder.
    pub(super) fn get(&self, name: &str) -> Option<&[u8]> {
        self.entries.get(&format!("{}{name}", self.root)).map(|c| &c[..])
    }

    /// Bytes of all entries together, unpacked.
    pub(super) fn unpacked(&self) -> u64 {
        self.entries.values().map(|c| c.len() as u64).sum()
    }
}
