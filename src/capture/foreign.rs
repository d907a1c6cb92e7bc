//! Formats that are recognized but not read, each by its telltale files, and the way from there to `transforms.json`.

use crate::Error;
use crate::io::{self, Limits};
use std::fmt::Display;
use std::path::{Path, PathBuf};

/// What a capture needs, one of them.
const READ: [&str; 4] =
    ["transforms.json", "transforms_train.json", "poses_bounds.npy", "poses_bounds_train.npy"];

const VIDEOS: [&str; 6] = ["mp4", "mov", "m4v", "avi", "mkv", "webm"];
const PHOTOGRAPHS: [&str; 8] = ["jpg", "jpeg", "png", "tif", "tiff", "heic", "webp", "bmp"];

/// For datasets with cameras that no common tool converts.
const BY_HAND: &str = "no common tool converts it: write `transforms.json` with `file_path`, `w`, `h`, `fl_x`, `fl_y`, \
                       `cx`, `cy` and `transform_matrix` for each photograph (camera to world, +Y up and looking along \
                       -Z: the second and third column of an OpenCV pose, negated)";

/// What lies directly in a folder.
struct FolderEntries {
    root: PathBuf,
    files: Vec<String>,
    folders: Vec<String>,
}

impl FolderEntries {
    /// Names that are not UTF-8 tell nothing, nor do those that cannot be listed.
    fn of(root: &Path) -> FolderEntries {
        let name = |p: &PathBuf| Some(p.file_name()?.to_str()?.to_owned());
        let folders = io::list_folders(root).unwrap_or_default();
        FolderEntries {
            root: root.into(),
            files: io::list_files(root).unwrap_or_default(),
            folders: folders.iter().filter_map(name).collect(),
        }
    }

    /// The first of these files or folders that is there.
    fn any<'a>(&self, names: &[&'a str]) -> Option<&'a str> {
        names.iter().copied().find(|n| self.files.iter().chain(&self.folders).any(|f| f == n))
    }

    /// The first file with one of these endings.
    fn ending(&self, endings: &[&str]) -> Option<&String> {
        self.files.iter().find(|f| has_ending(f, endings))
    }

    /// The first file with this ending whose beginning holds `words`.
    fn holding(&self, ending: &str, words: &str) -> Option<&String> {
        let limits = Limits { file_bytes: 64 << 20, ..Limits::default() };
        let holds = |name: &&String| {
            let bytes = io::read_bytes(&self.root.join(name), &limits).unwrap_or_default();
            String::from_utf8_lossy(&bytes[..bytes.len().min(1 << 16)]).contains(words)
        };
        self.files.iter().filter(|f| has_ending(f, &[ending])).take(16).find(holds)
    }

    fn at(&self, name: &str) -> String {
        self.root.join(name).display().to_string()
    }

    /// The folder of photographs, as far as one can tell.
    fn photographs(&self) -> Option<PathBuf> {
        let inside = ["images", "image", "input", "rgb", "photos"].into_iter();
        let folders = inside.filter(|n| self.any(&[n]).is_some()).map(|n| self.root.join(n));
        [self.root.clone()]
            .into_iter()
            .chain(folders)
            .find(|f| FolderEntries::of(f).ending(&PHOTOGRAPHS).is_some())
    }
}

fn has_ending(name: &str, endings: &[&str]) -> bool {
    let found = Path::new(name).extension().and_then(|e| e.to_str()).unwrap_or_default();
    endings.iter().any(|e| e.eq_ignore_ascii_case(found))
}

/// A command of nerfstudio, and what to do with what it writes.
fn nerfstudio(kind: &str, data: impl Display, more: &str) -> String {
    format!(
        "nerfstudio converts it: `ns-process-data {kind} --data {data}{more} --output-dir NEW`, then `tiface inspect NEW`"
    )
}

fn not_a_capture(root: &Path, found: impl Display, hint: impl Into<String>) -> Error {
    Error::cannot(format_args!("`{}` is not a capture: {found}", root.display()), hint)
}

/// Why a folder is no capture: what it looks like instead, and the way from there.
pub(super) fn explain(root: &Path) -> Error {
    let found = FolderEntries::of(root);
    if let Some((inner, file)) = nested(&found) {
        let what = format!("`{file}` lies in its folder `{inner}`");
        return not_a_capture(root, what, format!("give that folder: `{}`", found.at(inner)));
    }
    match recognized(&found) {
        Some((what, telltale, hint)) => {
            not_a_capture(root, format!("it looks like {what} (`{telltale}`); that is not read"), hint)
        }
        None => not_a_capture(
            root,
            "it holds neither `transforms.json`, `transforms_train.json` nor `poses_bounds*.npy`",
            "give the folder that holds one of them; given data of COLMAP, Metashape, RealityCapture, Polycam, NeuS, DTU, \
             H3DS, NeRSemble, Multiface, FaceScape, photographs alone or a video, this command says how to convert it",
        ),
    }
}

/// Why a file is no capture.
pub(super) fn explain_file(file: &Path) -> Error {
    let name = file.file_name().and_then(|n| n.to_str()).unwrap_or_default();
    let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if has_ending(name, &VIDEOS) {
        not_a_capture(file, "it is a video", from_video(file))
    } else if READ.contains(&name) || name.starts_with("transforms_") || name.starts_with("poses_bounds") {
        not_a_capture(file, "it is a file", format!("give the folder it lies in: `{}`", folder.display()))
    } else {
        not_a_capture(file, "it is a file", "give the folder that holds the photographs and cameras")
    }
}

fn from_video(file: &Path) -> String {
    nerfstudio("video", file.display(), "")
        + " (it needs COLMAP; a head must hold still while the camera moves)"
}

/// A folder inside that is a capture, with its camera file.
fn nested(found: &FolderEntries) -> Option<(&str, &'static str)> {
    let of = |name: &String| READ.into_iter().find(|file| io::is_file(&found.root.join(name).join(file)));
    found.folders.iter().take(1000).find_map(|name| Some((name.as_str(), of(name)?)))
}

/// What it looks like, by which file, and the way to `transforms.json`.
fn recognized(found: &FolderEntries) -> Option<(&'static str, String, String)> {
    let photographs = found.photographs();
    let images = photographs.clone().unwrap_or_else(|| found.root.join("images")).display().to_string();
    let one = |what, telltale: &str, way| Some((what, telltale.to_owned(), way));
    let by_hand = |what, telltale, more: &str| one(what, telltale, format!("{BY_HAND}; {more}"));
    let projections =
        "its `world_mat_I` is the projection K [R|t] of photograph I, `mask/` can be named as `mask_path`";

    if let Some(t) = found.any(&["cameras_sphere.npz"]) {
        return by_hand("a NeuS or DTU scene", t, projections);
    }
    if let Some(t) = found.any(&["cameras.npz"]) {
        let h3ds = found.any(&["full_head.obj", "regions", "landmarks.txt"]).is_some();
        return by_hand(if h3ds { "an H3DS scene" } else { "an IDR scene" }, t, projections);
    }
    if let Some(t) = found.any(&["KRT"]) {
        let moment =
            "it holds K, distortion and [R|t] of each camera; take one frame of one expression of `images/`";
        return by_hand("a Multiface recording", t, moment);
    }
    let calibration = ["calibration/camera_params.json", "camera_params.json"];
    if let Some(t) = calibration.into_iter().find(|t| io::is_file(&found.root.join(t))) {
        let moment = "it holds `world_2_cam` of each camera and one `intrinsics`; take one moment of one sequence, \
                      its `alpha_maps` are masks";
        return by_hand("a NeRSemble participant", t, moment);
    }
    if let Some(t) = found.any(&["params.json"]).filter(|_| photographs.is_some()) {
        let keys = "it holds `I_K`, `I_Rt` (world to camera), `I_distortion` and `I_valid` of photograph I.jpg: \
                    leave out what is not valid";
        return by_hand("a FaceScape tuple", t, keys);
    }
    if let Some(t) = found.any(&["keyframes"]) {
        return one("a Polycam raw export", t, nerfstudio("polycam", found.root.display(), ""));
    }
    if let Some(t) = found.holding("xml", "<chunk") {
        let way = nerfstudio("metashape", images, &format!(" --xml {}", found.at(t)));
        return one("a Metashape export", t, way);
    }
    if let Some(t) = found.ending(&["psx", "psz"]) {
        let way = nerfstudio("metashape", images, " --xml cameras.xml");
        let export = "export its cameras as XML (File, Export, Export Cameras)";
        return one("a Metashape project", t, format!("{export}; {way}"));
    }
    if let Some(t) = found.holding("csv", "#name,x,y,alt") {
        let way = nerfstudio("realitycapture", images, &format!(" --csv {}", found.at(t)));
        return one("a RealityCapture export", t, way);
    }
    if let Some(t) = found.ending(&["rcproj", "rsproj"]) {
        let way = nerfstudio("realitycapture", images, " --csv cameras.csv");
        let export = "export its registration as CSV, `Internal/External camera parameters`";
        return one("a RealityCapture project", t, format!("{export}; {way}"));
    }
    let colmap = ["sparse", "colmap", "cameras.bin", "cameras.txt", "images.bin", "database.db"];
    if let Some(t) = found.any(&colmap) {
        let inside = ["sparse/0", "colmap/sparse/0", "sparse", "colmap"].map(|n| found.root.join(n));
        let model = inside.into_iter().find(|p| io::is_folder(p)).unwrap_or_else(|| found.root.clone());
        let model = io::real_path(&model).unwrap_or(model);
        let way =
            nerfstudio("images", images, &format!(" --skip-colmap --colmap-model-path {}", model.display()));
        return one("a COLMAP model", t, way + "; so does instant-ngp's `colmap2nerf.py`");
    }
    if let Some(folder) = photographs {
        let first = FolderEntries::of(&folder).ending(&PHOTOGRAPHS).cloned().unwrap_or_default();
        let way = nerfstudio("images", folder.display(), "");
        return one("photographs without cameras", &first, format!("{way} (it needs COLMAP)"));
    }
    let video = found.ending(&VIDEOS)?;
    one("a video", video, from_video(&found.root.join(video)))
}
