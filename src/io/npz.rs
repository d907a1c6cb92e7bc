//! NumPy's `.npz`: a zip archive with one `.npy` file for each array.

use super::archive::unpack;
use super::error::ReadError;
use super::limits::Limits;
use super::npy::{Npy, parse_npy};
use super::read::read_bytes;
use std::collections::BTreeMap;
use std::path::Path;

/// Reads every array of a `.npz` file, by its name without `.npy`. Entries that are no arrays are left out.
pub fn read_npz(path: &Path, limits: &Limits) -> Result<BTreeMap<String, Npy>, ReadError> {
    let hint = "save it again with `numpy.savez`";
    let entries = unpack(path, &read_bytes(path, limits)?, "npz", hint, limits)?;
    let mut arrays = BTreeMap::new();
    for (name, bytes) in entries {
        let Some(stem) = name.strip_suffix(".npy") else { continue };
        let inside = path.join(&name);
        arrays.insert(stem.to_string(), parse_npy(&inside, &bytes, limits)?);
    }
    Ok(arrays)
}
