//! Which camera files a folder has. Where there are several kinds, the first of this list is read.

use super::colmap::{self, ModelFiles};
use super::frame::Listing;
use super::names::CaptureFolder;
use super::{entries::FolderEntries, llff, metashape, neus, realitycapture, transforms};
use crate::io::{self, ReadError};
use std::path::{Path, PathBuf};

/// The files that describe the cameras.
pub(super) enum CameraFiles {
    /// `transforms*.json`, and `poses_bounds*.npy` to check them against.
    Transforms { json: Vec<&'static str>, poses: Vec<&'static str> },
    /// `poses_bounds*.npy` alone.
    Llff(Vec<&'static str>),
    /// A sparse model.
    Colmap(ModelFiles),
    /// `cameras_sphere.npz`.
    Neus(&'static str),
    /// An exported `.xml`.
    Metashape(String),
    /// An exported `.csv`.
    RealityCapture(String),
    /// `.xmp` files beside the photographs in this folder.
    Xmp(PathBuf),
}

impl CameraFiles {
    pub fn find(root: &Path) -> Option<CameraFiles> {
        let there = |names: &[&'static str]| -> Vec<&'static str> {
            names.iter().copied().filter(|n| io::is_file(&root.join(n))).collect()
        };
        let mut json = there(&["transforms_train.json", "transforms_val.json", "transforms_test.json"]);
        if !json.contains(&"transforms_train.json") {
            json = there(&["transforms.json"]);
        }
        let mut poses = there(&["poses_bounds_train.npy", "poses_bounds_test.npy"]);
        if poses.is_empty() {
            poses = there(&["poses_bounds.npy"]);
        }
        if !json.is_empty() {
            return Some(CameraFiles::Transforms { json, poses });
        }
        if !poses.is_empty() {
            return Some(CameraFiles::Llff(poses));
        }
        if let Some(files) = ModelFiles::find(root) {
            return Some(CameraFiles::Colmap(files));
        }
        if let Some(file) = there(&neus::FILES).first() {
            return Some(CameraFiles::Neus(file));
        }
        let found = FolderEntries::of(root);
        let metashape = || found.holding("xml", "<chunk").cloned().map(CameraFiles::Metashape);
        let csv = || found.holding("csv", realitycapture::HEADER).cloned().map(CameraFiles::RealityCapture);
        metashape().or_else(csv).or_else(|| realitycapture::xmp_folder(root).map(CameraFiles::Xmp))
    }

    /// One of them, for messages.
    pub fn first(&self) -> String {
        match self {
            CameraFiles::Transforms { json: files, .. } | CameraFiles::Llff(files) => files[0].into(),
            CameraFiles::Colmap(files) => files.name("cameras"),
            CameraFiles::Neus(file) => file.to_string(),
            CameraFiles::Metashape(file) | CameraFiles::RealityCapture(file) => file.clone(),
            CameraFiles::Xmp(folder) => folder.join("*.xmp").to_string_lossy().into_owned(),
        }
    }

    /// The format, and which files say so.
    pub fn describe(&self) -> (&'static str, String) {
        let quote = |names: &[&str]| names.iter().map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ");
        match self {
            CameraFiles::Llff(poses) => {
                ("LLFF poses", format!("cameras from {}, no JSON beside", quote(poses)))
            }
            CameraFiles::Transforms { json, poses } if poses.is_empty() => {
                ("transforms.json", format!("cameras from {}", quote(json)))
            }
            CameraFiles::Transforms { json, poses } => (
                "transforms.json with LLFF poses",
                format!("cameras from {}, checked against {}", quote(json), quote(poses)),
            ),
            CameraFiles::Colmap(files) => {
                let names = [files.name("cameras"), files.name("images")];
                ("COLMAP", format!("cameras from {}", quote(&[&names[0], &names[1]])))
            }
            CameraFiles::Neus(file) => {
                ("NeuS", format!("cameras from `{file}`, one for each photograph in name order"))
            }
            CameraFiles::Metashape(file) => ("Metashape", format!("cameras from `{file}`")),
            CameraFiles::RealityCapture(file) => ("RealityCapture", format!("cameras from `{file}`")),
            CameraFiles::Xmp(_) => ("RealityCapture", format!("cameras from `{}`", self.first())),
        }
    }

    /// Lists the frames; everything wrong goes to the listing's problems.
    pub fn list(&self, folder: &CaptureFolder, listing: &mut Listing) {
        let listed = match self {
            CameraFiles::Transforms { json, poses } => {
                transforms::list(folder, json, listing);
                if listing.problems.is_empty() {
                    llff::check(folder, poses, listing);
                }
                Ok(())
            }
            CameraFiles::Llff(poses) => llff::list(folder, poses, listing),
            CameraFiles::Colmap(files) => colmap::list(folder, files, listing),
            CameraFiles::Neus(file) => neus::list(folder, file, listing),
            CameraFiles::Metashape(file) => metashape::list(folder, file, listing),
            CameraFiles::RealityCapture(file) => realitycapture::list_csv(folder, file, listing),
            CameraFiles::Xmp(inside) => realitycapture::list_xmp(folder, inside, listing),
        };
        listing.problems.extend(listed.err());
        let (found, limit) = (listing.frames.len() as u64, folder.options.limits.views as u64);
        if found > limit {
            let problem = ReadError::too_large(folder.root, "the number of views", found, limit);
            listing.problems.push(problem.into());
            listing.frames.clear();
        }
    }
}
