//! NumPy's `.npz`: a zip archive with one `.npy` file for each array, read whole or not at all.
//!
//! `numpy.savez` stores without compression; archives that a zip tool packed again are deflated.
//! Names that stand twice and bytes that entries share, the two tricks that make small files unpack
//! to large ones, are refused before anything is unpacked.

use super::limits::Limits;
use super::npy::{Npy, parse_npy};
use super::read::read_bytes;
use super::read_error::ReadError;
use std::collections::BTreeMap;
use std::io::{Cursor, Read};
use std::path::Path;
use zip::ZipArchive;
use zip::result::ZipError;

/// Two arrays for each photograph, and more for those of other programs.
const MAX_ENTRIES: usize = 65_536;

/// Matrices shrink little; deflate itself ends at 1032.
const MAX_RATIO: u64 = 64;

/// Reads every array of a `.npz` file, by its name without `.npy`. Entries that are no arrays are
/// left out.
pub fn read_npz(path: &Path, limits: &Limits) -> Result<BTreeMap<String, Npy>, ReadError> {
    let mut arrays = BTreeMap::new();
    for (name, bytes) in unpack(path, &read_bytes(path, limits)?, limits)? {
        let Some(stem) = name.strip_suffix(".npy") else { continue };
        let inside = path.join(&name);
        arrays.insert(stem.to_string(), parse_npy(&inside, &bytes, limits)?);
    }
    Ok(arrays)
}

/// Returns every entry by its full name: inside the file, apart from the others, named once, of the
/// sum it was stored with.
fn unpack(path: &Path, bytes: &[u8], limits: &Limits) -> Result<BTreeMap<String, Vec<u8>>, ReadError> {
    let bad = |problem: String| ReadError::damaged(path, "npz", None, problem);
    let too_large = |what, found, limit| Err(ReadError::TooLarge { path: path.into(), what, found, limit });
    let mut zip = ZipArchive::new(Cursor::new(bytes)).map_err(|e| bad(e.to_string()))?;
    if zip.len() > MAX_ENTRIES {
        let what = "the number of entries in the archive";
        return too_large(what, zip.len() as u64, MAX_ENTRIES as u64);
    }
    zip.validate_header_consistency().map_err(|e| bad(e.to_string()))?;
    let mut total = 0u64;
    for i in 0..zip.len() {
        let entry = zip.by_index_raw(i).map_err(|e| bad(e.to_string()))?;
        total = total.saturating_add(entry.size());
    }
    let limit = limits.decoded_bytes.min((bytes.len() as u64).saturating_mul(MAX_RATIO));
    if total > limit {
        return too_large("the unpacked size in bytes", total, limit);
    }
    let mut entries = BTreeMap::new();
    for i in 0..zip.len() {
        let name = zip.name_for_index(i).unwrap_or(Err(ZipError::FileNotFound));
        let name = name.map_err(|e| bad(e.to_string()))?.into_owned();
        let seen = shown(&name);
        let mut entry = zip.by_index(i).map_err(|e| match e {
            ZipError::UnsupportedArchive(_) | ZipError::CompressionMethodNotSupported(_) => {
                ReadError::Unsupported {
                    path: path.into(),
                    what: format!("`{seen}` ({e})"),
                    hint: "save it again with `numpy.savez`".into(),
                }
            }
            e => bad(format!("`{seen}`: {e}")),
        })?;
        // the declared sizes were counted against the limit, and `zip` unpacks no more than that
        let (size, mut content) = (entry.size(), Vec::new());
        entry.read_to_end(&mut content).map_err(|e| bad(format!("`{seen}` cannot be unpacked: {e}")))?;
        if content.len() as u64 != size {
            let found = content.len();
            return Err(bad(format!("`{seen}` has {found} bytes, its entry says {size}")));
        }
        entries.insert(name, content);
    }
    Ok(entries)
}

/// Returns a name from a file as it may stand in a message: short, and without control characters.
fn shown(name: &str) -> String {
    let text: String = name.chars().take(80).flat_map(char::escape_debug).collect();
    if name.chars().nth(80).is_some() { text + "…" } else { text }
}
