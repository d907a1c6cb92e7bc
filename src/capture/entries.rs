//! What lies directly in a folder.

use crate::io::{self, Limits, ReadError};
use std::path::{Path, PathBuf};

/// Endings of photographs, those that are not read among them.
pub(super) const PHOTOGRAPHS: [&str; 8] = ["png", "jpg", "jpeg", "tif", "tiff", "heic", "webp", "bmp"];

/// How many of them, from the first, are those of files that are read.
const READ: usize = 3;

/// Where photographs lie, if not beside the cameras.
pub(super) const IMAGE_FOLDERS: [&str; 5] = ["images", "image", "input", "rgb", "photos"];

/// Names of what lies directly in a folder.
pub(super) struct FolderEntries {
    pub root: PathBuf,
    pub files: Vec<String>,
    pub folders: Vec<String>,
}

impl FolderEntries {
    /// Names that are not UTF-8 tell nothing, nor do those that cannot be listed.
    pub fn of(root: &Path) -> FolderEntries {
        let name = |p: &PathBuf| Some(p.file_name()?.to_str()?.to_owned());
        let folders = io::list_folders(root).unwrap_or_default();
        FolderEntries {
            root: root.into(),
            files: io::list_files(root).unwrap_or_default(),
            folders: folders.iter().filter_map(name).collect(),
        }
    }

    /// The first of these files or folders that exists, `/` between a folder and what it holds.
    pub fn any<'a>(&self, names: &[&'a str]) -> Option<&'a str> {
        names.iter().copied().find(|n| io::exists(&self.root.join(n)))
    }

    /// The first file with one of these endings.
    pub fn ending(&self, endings: &[&str]) -> Option<&String> {
        self.files.iter().find(|f| has_ending(f, endings))
    }

    /// The first file with this ending whose beginning holds `words`.
    pub fn holding(&self, ending: &str, words: &str) -> Option<&String> {
        let limits = Limits { file_bytes: 64 << 20, ..Limits::default() };
        let holds = |name: &&String| {
            let bytes = io::read_bytes(&self.root.join(name), &limits).unwrap_or_default();
            String::from_utf8_lossy(&bytes[..bytes.len().min(1 << 16)]).contains(words)
        };
        self.files.iter().filter(|f| has_ending(f, &[ending])).take(16).find(holds)
    }

    pub fn at(&self, name: &str) -> String {
        self.root.join(name).display().to_string()
    }

    /// The folder of photographs, as far as one can tell.
    pub fn photographs(&self) -> Option<PathBuf> {
        let folders = IMAGE_FOLDERS.into_iter().filter(|n| self.any(&[n]).is_some());
        let folders = folders.map(|n| self.root.join(n));
        [self.root.clone()]
            .into_iter()
            .chain(folders)
            .find(|f| FolderEntries::of(f).ending(&PHOTOGRAPHS).is_some())
    }
}

/// The photographs in a folder, in name order; only where none can be read those of other formats, to be refused by
/// name.
pub(super) fn photographs(folder: &Path) -> Result<Vec<String>, ReadError> {
    let mut files = io::list_files(folder)?;
    let can_be_read = files.iter().any(|f| has_ending(f, &PHOTOGRAPHS[..READ]));
    let endings = if can_be_read { &PHOTOGRAPHS[..READ] } else { &PHOTOGRAPHS };
    files.retain(|f| has_ending(f, endings));
    Ok(files)
}

/// Does a name end so, in any case?
pub(super) fn has_ending(name: &str, endings: &[&str]) -> bool {
    let found = Path::new(name).extension().and_then(|e| e.to_str()).unwrap_or_default();
    endings.iter().any(|e| e.eq_ignore_ascii_case(found))
}
