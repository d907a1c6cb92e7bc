//! Where the files of a model lie, and the photographs that it is of.
//!
//! `sparse/0` is COLMAP's own place; `dense/0` is that of its undistorted photographs, `distorted`
//! that of 3D Gaussian splatting's `convert.py`, whose photographs are in `input/`. RealityCapture
//! has written the files with capitals.

use super::super::folder::{CaptureFolder, join};
use std::path::Path;
use tiface_base::io;

/// The files that are read.
const KINDS: [&str; 4] = ["cameras", "images", "points3D", "test"];

/// Where models lie.
const PLACES: [&str; 5] = ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ""];

/// Where they may lie as well, or in a numbered folder below.
const OTHER_PLACES: [&str; 17] = [
    "sparse",
    "colmap/sparse",
    "dense/0/sparse",
    "dense/sparse",
    "dense",
    "undistorted/sparse",
    "undistorted",
    "colmap_sparse",
    "colmap_text",
    "colmap",
    "hloc/sparse",
    "hloc",
    "known/sparse",
    "triangulated",
    "sfm",
    "model",
    "distorted/sparse",
];

/// A model's folder below the capture, and how its files end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in super::super) struct ModelFiles {
    pub folder: String,
    pub ending: &'static str,
    /// Its files as they are spelled, if not as COLMAP does.
    pub spelled: Vec<String>,
}

impl ModelFiles {
    pub fn new(folder: &str, ending: &'static str) -> ModelFiles {
        ModelFiles { folder: folder.into(), ending, spelled: Vec::new() }
    }

    /// Returns the first model of a folder.
    pub fn find(root: &Path) -> Option<ModelFiles> {
        places(root).iter().find_map(|place| ModelFiles::inside(root, place))
    }

    /// Returns the model in a folder below the capture; binary files are preferred to text.
    pub fn inside(root: &Path, place: &str) -> Option<ModelFiles> {
        let is_complete =
            |m: &ModelFiles| ["cameras", "images"].iter().all(|kind| io::is_file(&root.join(m.name(kind))));
        let plain = ["bin", "txt"].map(|ending| ModelFiles::new(place, ending));
        plain.iter().find(|m| is_complete(m)).cloned().or_else(|| {
            let files = io::list_files(&root.join(place)).ok()?;
            let spelled: Vec<String> = files.into_iter().filter(|f| kind_of(f).is_some()).collect();
            let mut all = plain.iter().map(|m| ModelFiles { spelled: spelled.clone(), ..m.clone() });
            all.find(is_complete)
        })
    }

    /// Returns the path of one of its files below the capture.
    pub fn name(&self, kind: &str) -> String {
        let plain = format!("{kind}.{}", self.ending);
        let name = self.spelled.iter().find(|s| s.eq_ignore_ascii_case(&plain)).unwrap_or(&plain);
        join(&self.folder, name)
    }

    /// Returns the folder that the photographs' names are relative to: of a model in a folder of
    /// its own, the one beside it that contains most of the first names; else as for any capture.
    pub fn image_folder<'n>(&self, folder: &CaptureFolder, names: impl Iterator<Item = &'n str>) -> String {
        let names: Vec<&str> = names.take(64).collect();
        let is_in = |base: &str, name: &&&str| {
            folder.photo("", &join(base, name)).is_ok_and(|(_, photo)| photo.is_some())
        };
        let is_own = !["", "sparse"].contains(&self.folder.split('/').next().unwrap_or_default());
        let owners = Path::new(&self.folder).ancestors().filter_map(Path::to_str).filter(|o| !o.is_empty());
        let inside = |owner: &str| ["images", "input", "rgb"].map(|name| format!("{owner}/{name}"));
        let mut bases: Vec<String> = owners.filter(|_| is_own).flat_map(inside).collect();
        let is_distorted = self.folder.starts_with("distorted/");
        // `images/` has the undistorted photographs
        bases.extend(is_distorted.then(|| "input".to_string()));
        bases.retain(|base| io::is_folder(&folder.root.join(base)));
        let counted = bases.into_iter().map(|base| (names.iter().filter(|n| is_in(&base, n)).count(), base));
        let best = counted.fold((0, String::new()), |best, next| if next.0 > best.0 { next } else { best });
        match best {
            (1.., base) => base,
            _ if is_distorted => "input".into(),
            _ => folder.image_folder(names.into_iter()).into(),
        }
    }
}

/// Returns which file of a model a name is, in any spelling.
fn kind_of(file: &str) -> Option<&'static str> {
    let (stem, ending) = file.rsplit_once('.')?;
    let is_model = ["bin", "txt"].iter().any(|e| e.eq_ignore_ascii_case(ending));
    KINDS.into_iter().find(|kind| is_model && kind.eq_ignore_ascii_case(stem))
}

/// Returns the folders below a capture that models are looked for in, in order.
fn places(root: &Path) -> Vec<String> {
    let mut all: Vec<String> = PLACES.map(str::to_owned).into();
    for place in OTHER_PLACES.into_iter().filter(|place| io::is_folder(&root.join(place))) {
        all.extend([format!("{place}/0"), place.to_string()]);
        let folders = io::list_folders(&root.join(place)).unwrap_or_default();
        let names = folders.iter().filter_map(|path| path.file_name()?.to_str());
        let numbers = names.filter(|name| name.len() < 6 && name.bytes().all(|b| b.is_ascii_digit()));
        all.extend(numbers.take(64).map(|number| format!("{place}/{number}")));
    }
    all
}

/// Returns a model that [`ModelFiles::find`] does not find, up to four folders deep: in a folder of
/// another name.
pub(in super::super) fn model_elsewhere(root: &Path) -> Option<ModelFiles> {
    let mut level = vec![String::new()];
    for _ in 0..4 {
        let below = |place: &String| -> Vec<String> {
            let folders = io::list_folders(&root.join(place)).unwrap_or_default();
            let names = folders.iter().filter_map(|path| path.file_name()?.to_str());
            // what `tiface cameras` works in is no capture's
            names.take(64).map(|name| join(place, name)).filter(|name| name != "colmap").collect()
        };
        level = level.iter().flat_map(below).take(512).collect();
        if let Some(found) = level.iter().find_map(|place| ModelFiles::inside(root, place)) {
            return Some(found);
        }
    }
    None
}

/// Returns a model of which one file is binary and the other text.
pub(in super::super) fn mixed_model(root: &Path) -> Option<[String; 2]> {
    places(root).into_iter().find_map(|place| {
        let files = io::list_files(&root.join(&place)).ok()?;
        let one = |kind: &str| files.iter().find(|f| kind_of(f) == Some(kind));
        Some([join(&place, one("cameras")?), join(&place, one("images")?)])
    })
}
