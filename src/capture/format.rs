//! Recognizes the camera files of a folder. If it has several kinds, the first of [`CameraFiles`] is read.
//!
//! A folder of another program is recognized by its files, and the error explains how to convert it.

use super::colmap::ModelFiles;
use super::folder::{FolderEntries, PHOTOGRAPHS, has_ending};
use super::{neus, realitycapture};
use crate::Error;
use crate::config::{Config, Stage};
use crate::io;
use std::fmt::Display;
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
        let found_of = |names: &[&'static str]| -> Vec<&'static str> {
            names.iter().copied().filter(|n| io::is_file(&root.join(n))).collect()
        };
        let mut json = found_of(&["transforms_train.json", "transforms_val.json", "transforms_test.json"]);
        if !json.contains(&"transforms_train.json") {
            json = found_of(&["transforms.json"]);
        }
        let mut poses = found_of(&["poses_bounds_train.npy", "poses_bounds_test.npy"]);
        if poses.is_empty() {
            poses = found_of(&["poses_bounds.npy"]);
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
        if let Some(file) = found_of(&neus::FILES).first() {
            return Some(CameraFiles::Neus(file));
        }
        let found = FolderEntries::of(root);
        let metashape = || found.holding("xml", "<chunk").cloned().map(CameraFiles::Metashape);
        let csv = || found.holding("csv", realitycapture::HEADER).cloned().map(CameraFiles::RealityCapture);
        metashape().or_else(csv).or_else(|| realitycapture::xmp_folder(root).map(CameraFiles::Xmp))
    }

    /// Returns the name of one of the files, for messages.
    pub fn first(&self) -> String {
        match self {
            CameraFiles::Transforms { json: files, .. } | CameraFiles::Llff(files) => files[0].into(),
            CameraFiles::Colmap(files) => files.name("cameras"),
            CameraFiles::Neus(file) => file.to_string(),
            CameraFiles::Metashape(file) | CameraFiles::RealityCapture(file) => file.clone(),
            CameraFiles::Xmp(folder) => folder.join("*.xmp").to_string_lossy().into_owned(),
        }
    }

    /// Returns the format's name and the files that it was recognized by.
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
                ("NeuS", format!("cameras from `{file}`, one for each photograph in order"))
            }
            CameraFiles::Metashape(file) => ("Metashape", format!("cameras from `{file}`")),
            CameraFiles::RealityCapture(file) => ("RealityCapture", format!("cameras from `{file}`")),
            CameraFiles::Xmp(_) => ("RealityCapture", format!("cameras from `{}`", self.first())),
        }
    }
}

/// Names of camera files; a path to one of them is answered with its folder.
const CAMERA_FILES: [&str; 4] =
    ["transforms.json", "transforms_train.json", "poses_bounds.npy", "poses_bounds_train.npy"];

const VIDEOS: [&str; 6] = ["mp4", "mov", "m4v", "avi", "mkv", "webm"];

/// Advice for datasets with cameras that no common tool converts.
const BY_HAND: &str = "no common tool converts it: write `transforms.json` with `file_path`, `w`, `h`, `fl_x`, `fl_y`, \
                       `cx`, `cy` and `transform_matrix` for each photograph (camera to world, +Y up and looking along \
                       -Z: the second and third column of an OpenCV pose, negated)";

/// Advice for cameras that another program exports to COLMAP.
const TO_COLMAP: &str = "writes its cameras as COLMAP's: put `cameras`, `images` and `points3D` (`.bin` or `.txt`) into \
                         `sparse/0`, the photographs beside it into `images/`";

/// Folders of other programs: description; the files or folders, else the endings, that identify them; how to convert
/// them, where `{root}` is the folder and `{file}` the file that was found.
#[rustfmt::skip]
const OTHER_PROGRAMS: &[(&str, &[&str], &[&str], &str)] = &[
    ("a Multiface recording", &["KRT"], &[],
        "{BY_HAND}; it holds K, distortion and [R|t] of each camera; take one frame of one expression of `images/`"),
    ("a NeRSemble participant", &["calibration/camera_params.json", "camera_params.json"], &[],
        "{BY_HAND}; it holds `world_2_cam` of each camera and one `intrinsics`; take one moment of one sequence, its \
         `alpha_maps` are masks"),
    ("a FaceScape tuple", &["params.json"], &[],
        "{BY_HAND}; it holds `I_K`, `I_Rt` (world to camera), `I_distortion` and `I_valid` of photograph I.jpg: leave \
         out what is not valid"),
    ("a Polycam raw export", &["keyframes"], &[],
        "nerfstudio converts it: `ns-process-data polycam --data {root} --output-dir NEW`, then `tiface inspect NEW`"),
    ("a Metashape project", &[], &["psx", "psz"],
        "export its cameras as XML into this folder: File, Export, Export Cameras"),
    ("a RealityCapture project", &[], &["rcproj", "rsproj"],
        "export its registration as CSV (`Internal/External camera parameters`) into this folder, or its metadata as \
         XMP beside the photographs"),
    ("a Meshroom project", &["MeshroomCache"], &["mg", "sfm"],
        "its node `ExportColmap` (or `aliceVision_exportColmap --input cameras.sfm --output NEW`) {TO_COLMAP}"),
    ("an OpenSfM project", &["reconstruction.json"], &[], "`opensfm export_colmap {root}` {TO_COLMAP}"),
    ("an OpenMVG scene", &["sfm_data.json", "sfm_data.bin"], &[],
        "`openMVG_main_openMVG2Colmap -i {file} -o NEW` {TO_COLMAP}"),
    ("a VisualSFM scene", &[], &["nvm"],
        "OpenMVS (`InterfaceVisualSFM -i {file} -o scene.mvs`, then `InterfaceCOLMAP -i scene.mvs -o NEW`) {TO_COLMAP}"),
    ("a Bundler scene", &["bundle.out", "bundle/bundle.out"], &[],
        "OpenMVS (`InterfaceVisualSFM -i {file} -o scene.mvs`, then `InterfaceCOLMAP -i scene.mvs -o NEW`) {TO_COLMAP}"),
    ("an MVSNet scene", &["cams/00000000_cam.txt", "Cameras/00000000_cam.txt", "pair.txt"], &[],
        "OpenMVS (`InterfaceMVSNet -i {root} -o scene.mvs`, then `InterfaceCOLMAP -i scene.mvs -o NEW`) {TO_COLMAP}"),
    ("an incomplete COLMAP project",
        &["sparse", "colmap", "cameras.bin", "cameras.txt", "images.bin", "images.txt", "database.db"], &[],
        "its cameras and images files are missing: run `colmap mapper`, or copy `cameras.bin` and `images.bin` (or \
         `.txt`) into `sparse/0`"),
];

/// Returns whether a folder is a run: it has a run's configuration, and either a stage was begun in it or nothing else in it
/// is a capture's, be it one that cannot be read (photographs without cameras, a project of another program).
pub fn is_run(folder: &Path) -> bool {
    let has_record = |stage: &Stage| {
        ["done.json", "status.json"].iter().any(|f| io::is_file(&folder.join(stage.word()).join(f)))
    };
    let is_begun = || Stage::ALL.iter().any(has_record);
    let is_capture =
        || CameraFiles::find(folder).is_some() || recognized(&FolderEntries::of(folder)).is_some();
    io::is_file(&folder.join("config.toml")) && (is_begun() || !is_capture())
}

fn not_a_capture(root: &Path, found: impl Display, hint: impl Into<String>) -> Error {
    Error::cannot(format_args!("`{}` is not a capture: {found}", root.display()), hint)
}

/// Returns the error for a folder that is no capture: what it looks like, and how to convert it.
pub(super) fn explain(root: &Path) -> Error {
    let found = FolderEntries::of(root);
    if is_run(root)
        && let Some(path) = Config::of_run(root).map(|run| run.capture.path).filter(|path| !path.is_empty())
    {
        let hint = format!("inspect its capture, `{path}`; `tiface status` shows the state of the run");
        return not_a_capture(root, "it is the folder of a run", hint);
    }
    if let Some((inner, file)) = nested(&found) {
        let what = format!("its subfolder `{inner}` contains `{file}`");
        return not_a_capture(root, what, format!("give that folder: `{}`", found.at(inner)));
    }
    match recognized(&found) {
        Some((what, telltale, hint)) => {
            not_a_capture(root, format!("it looks like {what} (`{telltale}`), which is not supported"), hint)
        }
        None => {
            let nearest = nearest(&found).map_or(String::new(), |n| format!("; nearest is {n}"));
            let others = "Meshroom, OpenSfM, OpenMVG, Bundler, NVM, MVSNet, Polycam, NeRSemble, Multiface, FaceScape, \
                          photographs alone or a video are recognized, with advice on how to convert them";
            not_a_capture(
                root,
                format!("it contains none of the supported camera files: {CAMERA_FILES_TEXT}{nearest}"),
                format!("give the folder that contains one of them; {others}"),
            )
        }
    }
}

/// The supported camera files, for messages.
const CAMERA_FILES_TEXT: &str = "`transforms.json`, `transforms_train.json`, `poses_bounds*.npy` (LLFF), `cameras` and `images` as \
                          `.bin` or `.txt` in `sparse/0`, `sparse` or here (COLMAP), `cameras_sphere.npz` or `cameras.npz` \
                          (NeuS, IDR, H3DS), an `.xml` with `<chunk` (Metashape), a `.csv` that begins with `#name,x,y,alt` \
                          or `.xmp` files with a pose (RealityCapture)";

/// Returns the file most similar to a supported camera file, and what it lacks.
fn nearest(found: &FolderEntries) -> Option<String> {
    let like = |ending: &str, word: &str| {
        found.files.iter().find(|f| has_ending(f, &[ending]) && f.to_lowercase().contains(word))
    };
    let rename = |file: &String, to: &str| format!("`{file}`: if it is such a file, rename it to `{to}`");
    like("json", "transform")
        .or_else(|| found.holding("json", "transform_matrix"))
        .map(|f| rename(f, "transforms.json"))
        .or_else(|| like("npy", "poses").map(|f| rename(f, "poses_bounds.npy")))
        .or_else(|| like("npz", "").map(|f| rename(f, "cameras_sphere.npz")))
        .or_else(|| {
            like("xml", "").map(|f| format!("`{f}`, which has no `<chunk` as Metashape's cameras have"))
        })
        .or_else(|| {
            like("csv", "").map(|f| format!("`{f}`, which does not begin with `{}`", realitycapture::HEADER))
        })
        .or_else(|| like("xmp", "").map(|f| format!("`{f}`, which has no fields of RealityCapture")))
}

/// Returns the error for a file given as a capture.
pub(super) fn explain_file(file: &Path) -> Error {
    let name = file.file_name().and_then(|n| n.to_str()).unwrap_or_default();
    let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if has_ending(name, &VIDEOS) {
        not_a_capture(file, "it is a video", from_video(file))
    } else if CAMERA_FILES.contains(&name)
        || name.starts_with("transforms_")
        || name.starts_with("poses_bounds")
    {
        not_a_capture(file, "it is a file", format!("give its folder: `{}`", folder.display()))
    } else {
        not_a_capture(file, "it is a file", "give the folder that contains the photographs and cameras")
    }
}

fn from_video(file: &Path) -> String {
    format!(
        "find the cameras of its frames with COLMAP: `tiface cameras --video {}`; the head must hold still in it",
        file.display()
    )
}

/// Returns a subfolder that is a capture, with its first camera file.
fn nested(found: &FolderEntries) -> Option<(&str, String)> {
    let of = |name: &String| CameraFiles::find(&found.root.join(name)).map(|files| files.first());
    found.folders.iter().take(1000).find_map(|name| Some((name.as_str(), of(name)?)))
}

/// Returns what the folder looks like, the file that shows it, and how to get to `transforms.json`.
fn recognized(found: &FolderEntries) -> Option<(&'static str, String, String)> {
    let photographs = found.photographs();
    // `params.json` is too common a name to identify anything without photographs
    let is_candidate = |files: &[&str]| photographs.is_some() || files != ["params.json"];
    for (what, files, endings, way) in OTHER_PROGRAMS.iter().filter(|(_, files, ..)| is_candidate(files)) {
        let file = found.any(files).or_else(|| found.ending(endings).map(String::as_str));
        if let Some(file) = file {
            let root = found.root.display().to_string();
            let values = [("{BY_HAND}", BY_HAND), ("{TO_COLMAP}", TO_COLMAP), ("{root}", &root)];
            let way = way.replace("{file}", &found.at(file));
            let way = values.iter().fold(way, |way, (key, value)| way.replace(key, value));
            return Some((what, file.into(), way));
        }
    }
    if let Some(folder) = photographs {
        let first = FolderEntries::of(&folder).ending(&PHOTOGRAPHS).cloned().unwrap_or_default();
        let way = format!("find them with COLMAP: `tiface cameras {}`", found.root.display());
        return Some(("photographs without cameras", first, way));
    }
    let video = found.ending(&VIDEOS)?;
    Some(("a video", video.clone(), from_video(&found.root.join(video))))
}
