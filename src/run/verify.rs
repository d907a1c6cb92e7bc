//! Comparison of a run's products with the records of its stages, byte for byte.

use super::record::{Fault, ProductState, Record, read_record};
use serde::Serialize;
use std::path::Path;
use tiface_base::io;
use tiface_base::{Error, Fingerprint, Result};

/// What [`verify`] found in a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Verification {
    /// Every product that a record lists.
    pub files: Vec<VerifiedFile>,
    /// Finished stages whose records list no products: an older version wrote them.
    pub unlisted: Vec<String>,
}

/// A product.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct VerifiedFile {
    /// Its path in the run.
    pub file: String,
    /// Its recorded size.
    pub bytes: u64,
    /// Its recorded SHA-256, hexadecimal; `None` in older records, by which only the size is
    /// compared.
    pub sha256: Option<String>,
    /// Its state.
    pub state: ProductState,
    /// The command that makes it again, if it is not as recorded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub again: Option<String>,
    /// The difference, in a sentence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
}

impl Verification {
    /// Returns the products that are not as recorded.
    pub fn differing(&self) -> impl Iterator<Item = &VerifiedFile> {
        self.files.iter().filter(|file| file.state != ProductState::Recorded)
    }
}

impl Record {
    /// Returns the fault of one of the stage's files, by its size and then by its SHA-256, as far
    /// as they are recorded.
    pub fn verify(&self, folder: &Path, name: &str) -> Result<Option<Fault>> {
        if let Some(fault) = self.fault(folder, name) {
            return Ok(Some(fault));
        }
        match self.sha256.get(name) {
            Some(digest) if Fingerprint::of_file(&folder.join(name))? != *digest => {
                let problem = format!("has other contents than the stage `{}` left", self.stage);
                Ok(Some(self.faulty(folder, name, ProductState::Changed, &problem)))
            }
            _ => Ok(None),
        }
    }
}

/// Compares the products in a run's folder with the records of their stages, byte for byte.
/// Products of older records are compared by size, as far as it is known.
///
/// # Errors
///
/// Fails if a record or a product cannot be read, or if no stage is finished.
pub fn verify(run: &Path) -> Result<Verification> {
    let mut found = Verification::default();
    verify_folder(run, run, &mut found)?;
    if found.files.is_empty() && found.unlisted.is_empty() {
        let problem = format!("`{}` has no finished stage", run.display());
        return Err(Error::cannot(
            problem,
            "name the folder of a run; `tiface status` shows what is finished",
        ));
    }
    Ok(found)
}

fn verify_folder(run: &Path, folder: &Path, found: &mut Verification) -> Result<()> {
    for inner in io::list_folders(folder)?.into_iter().filter(|inner| !io::is_link(inner)) {
        if let Some(record) = read_record(&inner)? {
            if record.products.is_empty() {
                found.unlisted.push(record.stage.clone());
            }
            for (name, &bytes) in &record.products {
                let file = inner.join(name);
                let fault = record.verify(&inner, name)?;
                found.files.push(VerifiedFile {
                    file: file.strip_prefix(run).unwrap_or(&file).to_string_lossy().into_owned(),
                    bytes,
                    sha256: record.sha256.get(name).cloned(),
                    state: fault.as_ref().map_or(ProductState::Recorded, |fault| fault.state),
                    again: fault.as_ref().map(|fault| fault.again.clone()),
                    problem: fault.map(|fault| fault.problem),
                });
            }
        }
        verify_folder(run, &inner, found)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    #[test]
    fn verify_compares_by_digest_and_products_of_older_records_by_size() {
        let dir = tempfile::tempdir().unwrap();
        let stage = dir.path().join("mesh");
        std::fs::create_dir(&stage).unwrap();
        let fingerprint = Fingerprint::default();
        let write = |name: &str, text: &str| std::fs::write(stage.join(name), text).unwrap();
        ["atlas.png", "head.glb", "mesh.ply"].iter().for_each(|name| write(name, "abcd"));
        let digests: serde_json::Map<String, Value> = ["atlas.png", "head.glb"]
            .map(|name| (name.to_string(), json!(Fingerprint::of_bytes(b"abcd"))))
            .into_iter()
            .collect();
        let mut record = json!({
            "stage": "mesh", "digest": fingerprint.digest(), "fingerprint": fingerprint, "summary": {}, "elapsed_s": 2.0,
            "finished": 1, "version": "0", "products": {"atlas.png": 4, "head.glb": 4, "mesh.ply": 4}, "sha256": digests,
        });
        write("done.json", &record.to_string());
        let states = || -> Vec<(String, ProductState)> {
            verify(dir.path()).unwrap().differing().map(|f| (f.file.clone(), f.state)).collect()
        };
        let found = verify(dir.path()).unwrap();
        assert!(states().is_empty() && found.unlisted.is_empty(), "{found:?}");
        // the record states no digest of the third: an older version wrote it
        let digests: Vec<Option<usize>> =
            found.files.iter().map(|f| f.sha256.as_ref().map(String::len)).collect();
        assert_eq!(digests, [Some(64), Some(64), None]);

        write("atlas.png", "abce");
        write("mesh.ply", "abce");
        std::fs::remove_file(stage.join("head.glb")).unwrap();
        let [atlas, head] = ["mesh/atlas.png", "mesh/head.glb"].map(String::from);
        assert_eq!(states(), [(atlas, ProductState::Changed), (head, ProductState::Gone)]);
        write("mesh.ply", "abc");
        assert_eq!(states()[2], ("mesh/mesh.ply".into(), ProductState::Cut));
        let found = verify(dir.path()).unwrap();
        let again: Vec<&str> = found.differing().filter_map(|f| f.again.as_deref()).collect();
        let run = dir.path().display();
        let made = format!("tiface run {run} --fresh mesh");
        assert_eq!(again, [made.clone(), format!("tiface export {run} --out {run}/mesh/head.glb"), made]);

        // the oldest records list nothing, and so nothing differs
        for key in ["products", "sha256"] {
            record.as_object_mut().unwrap().remove(key);
        }
        write("done.json", &record.to_string());
        let found = verify(dir.path()).unwrap();
        assert!(found.files.is_empty() && found.unlisted == ["mesh"], "{found:?}");
        assert!(verify(&stage.join("none")).is_err());
    }
}
