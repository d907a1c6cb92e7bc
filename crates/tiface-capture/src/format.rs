//! Recognizes the camera files of a folder. If it has several kinds, the first of [`CameraFiles`]
//! is read.
//!
//! A folder of another program is recognized by its files, and the error explains how to convert
//! it.

use super::colmap::{ModelFiles, mixed_model, model_elsewhere};
use super::folder::{FolderEntries, PHOTOGRAPHS, has_ending, is_common_name};
use super::pose_folder::PoseFolder;
use super::{neus, programs, realitycapture};
use std::cell::OnceCell;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use tiface_base::Error;
use tiface_base::io;

/// The files that describe the cameras.
pub(super) enum CameraFiles {
    /// `transforms*.json`, and `poses_bounds*.npy` to check them against.
    Transforms { json: Vec<String>, poses: Vec<&'static str> },
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
    /// `pose/*.txt`.
    Poses(PoseFolder),
}

impl CameraFiles {
    pub fn find(root: &Path) -> Option<CameraFiles> {
        let found_of = |names: &[&'static str]| -> Vec<&'static str> {
            names.iter().copied().filter(|n| io::is_file(&root.join(n))).collect()
        };
        let json = transforms(root);
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
        let found = FolderEntries::list(root);
        let metashape = || found.holding("xml", "<chunk").cloned().map(CameraFiles::Metashape);
        let table = |ending| found.beginning(ending, realitycapture::is_table).cloned();
        let csv = || ["csv", "tsv", "txt"].into_iter().find_map(table).map(CameraFiles::RealityCapture);
        let xmp = || realitycapture::xmp_folder(root).map(CameraFiles::Xmp);
        metashape().or_else(csv).or_else(xmp).or_else(|| PoseFolder::find(root).map(CameraFiles::Poses))
    }

    /// Returns the name of one of the files, for messages.
    pub fn first(&self) -> String {
        match self {
            CameraFiles::Transforms { json: files, .. } => files[0].clone(),
            CameraFiles::Llff(files) => files[0].into(),
            CameraFiles::Colmap(files) => files.name("cameras"),
            CameraFiles::Neus(file) => file.to_string(),
            CameraFiles::Metashape(file) | CameraFiles::RealityCapture(file) => file.clone(),
            CameraFiles::Xmp(folder) => folder.join("*.xmp").to_string_lossy().into_owned(),
            CameraFiles::Poses(files) => files.poses(),
        }
    }

    /// Returns the format's name and the files that it was recognized by.
    pub fn describe(&self) -> (&'static str, String) {
        let quote = |names: &[&str]| names.iter().map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ");
        match self {
            CameraFiles::Llff(poses) => {
                ("LLFF poses", format!("cameras from {}, no JSON beside", quote(poses)))
            }
            CameraFiles::Transforms { json, poses } => {
                let json: Vec<&str> = json.iter().map(String::as_str).collect();
                let text = format!("cameras from {}", quote(&json));
                match poses.is_empty() {
                    true => ("transforms.json", text),
                    false => (
                        "transforms.json with LLFF poses",
                        format!("{text}, checked against {}", quote(poses)),
                    ),
                }
            }
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
            CameraFiles::Poses(files) => {
                ("NSVF", format!("cameras from `{}` and `{}`", self.first(), files.intrinsics))
            }
        }
    }
}

/// Returns the split files, if there are some to learn from, else `transforms.json`, as they are
/// spelled. Other capitals count only where none of both is spelled as usual.
fn transforms(root: &Path) -> Vec<String> {
    let [train, plain] = ["transforms_train.json", "transforms.json"];
    let files = OnceCell::new();
    let usual = |name: &str| io::is_file(&root.join(name)).then(|| name.to_string());
    let spelled = |name: &str| {
        let files: &Vec<String> = files.get_or_init(|| io::list_files(root).unwrap_or_default());
        usual(name).or_else(|| files.iter().find(|file| file.eq_ignore_ascii_case(name)).cloned())
    };
    let first = usual(train).or_else(|| usual(plain)).or_else(|| spelled(train)).or_else(|| spelled(plain));
    let is_split = first.as_ref().is_some_and(|file| file.eq_ignore_ascii_case(train));
    let others = ["transforms_val.json", "transforms_test.json"].into_iter().filter(|_| is_split);
    let others: Vec<String> = others.filter_map(spelled).collect();
    first.into_iter().chain(others).collect()
}

/// How files of cameras end; a path to one of them is answered with its folder.
const CAMERA_ENDINGS: [&str; 7] = ["json", "npy", "npz", "xml", "csv", "bin", "txt"];

/// How archives end.
const ARCHIVES: [&str; 9] = ["zip", "tar", "tgz", "gz", "bz2", "xz", "zst", "7z", "rar"];

/// How meshes and clouds of points end.
const MESHES: [&str; 11] = ["glb", "gltf", "obj", "ply", "stl", "fbx", "usdz", "dae", "las", "laz", "e57"];

const VIDEOS: [&str; 6] = ["mp4", "mov", "m4v", "avi", "mkv", "webm"];

/// Returns whether anything in a folder is a capture's, even of one that cannot be read: cameras,
/// photographs without them, a video, a project of another program.
pub fn resembles_capture(folder: &Path) -> bool {
    let found = FolderEntries::list(folder);
    let is_recognized = programs::recognized(&found).is_some() || found.photographs().is_some();
    CameraFiles::find(folder).is_some() || is_recognized || found.ending(&VIDEOS).is_some()
}

/// Returns the error for a folder that is no capture, by what it is instead.
pub fn not_a_capture(root: &Path, found: impl Display, hint: impl Into<String>) -> Error {
    Error::cannot(format_args!("`{}` is not a capture: {found}", root.display()), hint)
}

/// Returns the error for a folder that is no capture: what it looks like, and how to convert it.
pub(super) fn explain(root: &Path) -> Error {
    let found = FolderEntries::list(root);
    let near = above(root).or_else(|| nested(&found)).or_else(|| misplaced_model(&found));
    if let Some(error) = near {
        return error;
    }
    match recognized(&found).or_else(|| packed(&found)) {
        Some((what, telltale, hint)) => {
            not_a_capture(root, format!("it looks like {what} (`{telltale}`), which is not supported"), hint)
        }
        None => {
            let nearest = nearest(&found).map_or(String::new(), |n| format!("; nearest is {n}"));
            let others = "Record3D, 3D Scanner App, Polycam, sdfstudio, EyefulTower, Nerfies, Meshroom, OpenSfM, OpenMVG, \
                          OpenMVS, Bundler, NVM, MVSNet, NeRSemble, Multiface, FaceScape, EasyMocap, trained scenes, \
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
                          (NeuS, IDR, H3DS), an `.xml` with `<chunk` (Metashape), `pose/*.txt` with `intrinsics.txt` (NSVF), \
                          a `.csv` with the columns `name`, `x`, `y`, `alt` or `.xmp` files with a pose (RealityCapture)";

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
    let (root, shown) = (folder.display().to_string(), file.display().to_string());
    if has_ending(name, &VIDEOS) {
        not_a_capture(file, "it is a video", from_video(file))
    } else if let Some((what, way)) = programs::of_file(name, &root, &shown) {
        not_a_capture(file, format!("it is a file of {what}"), way)
    } else if has_ending(name, &ARCHIVES) {
        not_a_capture(file, "it is an archive", from_archive(file))
    } else if has_ending(name, &MESHES) {
        let hint = format!(
            "`tiface check {shown}` looks at GLB, glTF, OBJ, PLY and STL; a capture is a folder of photographs and cameras"
        );
        not_a_capture(file, "it is a mesh or a cloud of points", hint)
    } else if has_ending(name, &CAMERA_ENDINGS) {
        let hint = match above(folder) {
            Some(error) => error.hint().to_string(),
            None => format!("give its folder: `{root}`"),
        };
        not_a_capture(file, "it is a file", hint)
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

fn from_archive(file: &Path) -> String {
    let name = file.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let shown = file.display();
    let command = if name.ends_with(".zip") {
        format!(": `unzip {shown} -d NEW`")
    } else if name.contains(".tar") || name.ends_with(".tgz") {
        format!(": `mkdir NEW && tar -xf {shown} -C NEW`")
    } else {
        " into a folder NEW".into()
    };
    format!("unpack it{command}, then `tiface inspect NEW`")
}

/// Returns the error for a folder of which a subfolder is a capture, or has its cameras.
fn nested(found: &FolderEntries) -> Option<Error> {
    let of = |name: &String| CameraFiles::find(&found.root.join(name)).map(|files| files.first());
    let (inner, file) = found.folders.iter().take(1000).find_map(|name| Some((name, of(name)?)))?;
    let (root, folder) = (found.root.display(), found.at(inner));
    let what = format!("its subfolder `{inner}` contains `{file}`");
    Some(if has_pictures(Path::new(&folder)) {
        not_a_capture(&found.root, what, format!("give that folder: `{folder}`"))
    } else if found.photographs().is_some() {
        let hint =
            format!("move what is in `{folder}` to `{root}`, beside the photographs, and give `{root}`");
        not_a_capture(&found.root, what + ", but no photographs", hint)
    } else {
        let hint =
            format!("put the photographs there, as the cameras name them, and give that folder: `{folder}`");
        not_a_capture(&found.root, what + ", but no photographs", hint)
    })
}

/// Returns whether a folder or one below has a picture.
fn has_pictures(root: &Path) -> bool {
    let is_other = |path: &Path| {
        io::is_file(path)
            && !path.file_name().and_then(|n| n.to_str()).is_some_and(|n| has_ending(n, &PHOTOGRAPHS))
    };
    io::any_file(root, &is_other).is_ok_and(|found| found.is_some())
}

/// Returns the error for a folder inside a capture: that of its photographs, or, up to three levels
/// deep, that of its model or poses.
fn above(root: &Path) -> Option<Error> {
    let real = io::real_path(root).ok()?;
    let is_photographs = real.file_name().and_then(|n| n.to_str()).is_some_and(is_common_name)
        && FolderEntries::list(root).ending(&PHOTOGRAPHS).is_some();
    real.ancestors().enumerate().skip(1).take(3).find_map(|(level, folder)| {
        let is_inside = |place: &str| folder.join(place).starts_with(&real);
        let model =
            || ModelFiles::find(folder).filter(|files| is_inside(&files.folder)).map(CameraFiles::Colmap);
        let poses =
            || PoseFolder::find(folder).filter(|files| is_inside(files.folder)).map(CameraFiles::Poses);
        let files =
            if level == 1 && is_photographs { CameraFiles::find(folder) } else { model().or_else(poses) }?;
        let given = root.ancestors().nth(level).filter(|_| !root.ends_with("..") && !root.ends_with("."));
        let shown = given.filter(|path| !path.as_os_str().is_empty()).unwrap_or(folder).display();
        let what = format!("it is a part of one: `{shown}` has the cameras `{}`", files.first());
        Some(not_a_capture(root, what, format!("give the folder above: `{shown}`")))
    })
}

/// Returns the error for the folder of a model whose photographs are above.
pub(super) fn without_photographs(root: &Path, files: &CameraFiles) -> Option<Error> {
    let is_model = matches!(files, CameraFiles::Colmap(files) if files.folder.is_empty());
    if is_model && !has_pictures(root) { above(root) } else { None }
}

/// Returns the error for a model of COLMAP's in a place or of a kind that is not read.
fn misplaced_model(found: &FolderEntries) -> Option<Error> {
    let root = found.root.display();
    if let Some([cameras, images]) = mixed_model(&found.root) {
        let what = format!("of its COLMAP model, `{cameras}` and `{images}` are not of one kind");
        let hint = "export both the same way: `colmap model_converter --input_path MODEL --output_path NEW \
                    --output_type BIN`";
        return Some(not_a_capture(&found.root, what, hint));
    }
    let model = model_elsewhere(&found.root)?;
    let what = format!("its COLMAP model is in `{}`, where none is looked for", model.folder);
    let owners = Path::new(&model.folder).ancestors().map(|inner| found.root.join(inner));
    let is_capture = |owner: &PathBuf| ModelFiles::find(owner).is_some() && has_pictures(owner);
    if let Some(owner) = owners.filter(|owner| *owner != found.root).find(is_capture) {
        let hint = format!("give the folder of that capture: `{}`", owner.display());
        return Some(not_a_capture(&found.root, what, hint));
    }
    let from = found.at(&model.folder);
    let hint = format!(
        "copy it beside its photographs: `mkdir -p {root}/sparse && cp -r {from} {root}/sparse/0`, with the \
         photographs in `{root}/images`"
    );
    Some(not_a_capture(&found.root, what, hint))
}

/// Returns what the folder looks like, the file that shows it, and how to get to `transforms.json`.
fn recognized(found: &FolderEntries) -> Option<(&'static str, String, String)> {
    if let Some(program) = programs::recognized(found) {
        return Some(program);
    }
    let is_transforms = |text: &str| text.contains("\"frames\"") && text.contains("\"transform_matrix\"");
    if let Some(file) = found.beginning("json", is_transforms) {
        let way = format!(
            "rename it to `transforms.json`: `mv {} {}`",
            found.at(file),
            found.at("transforms.json")
        );
        return Some(("cameras in the form of `transforms.json` by another name", file.clone(), way));
    }
    let cameras = format!("`tiface cameras {}`", found.root.display());
    let is_folder_of_pictures =
        |name: &String| FolderEntries::list(&found.root.join(name)).ending(&PHOTOGRAPHS).is_some();
    let photographs = found.photographs();
    if (photographs.is_some() || found.folders.iter().take(64).any(is_folder_of_pictures))
        && let Some(file) = programs::cameras_of_unknown_kind(found)
    {
        let nearest = nearest(found).map_or(String::new(), |n| format!("; nearest to what is read is {n}"));
        let way = format!(
            "if it holds cameras, {}{nearest}; if it does not, find them with COLMAP: {cameras}",
            programs::by_hand()
        );
        return Some(("photographs with cameras in a form whose axes are not known", file, way));
    }
    if let Some(folder) = photographs {
        let first = FolderEntries::list(&folder).ending(&PHOTOGRAPHS).cloned().unwrap_or_default();
        let nearest =
            nearest(found).map_or(String::new(), |n| format!("; nearest to a file of cameras is {n}"));
        let way = format!("find them with COLMAP: {cameras}{nearest}");
        return Some(("photographs without cameras", first, way));
    }
    let video = found.ending(&VIDEOS);
    let video = video.map(|video| ("a video", video.clone(), from_video(&found.root.join(video))));
    video.or_else(|| programs::scene(found))
}

/// Returns the same of a folder with nothing but an archive.
fn packed(found: &FolderEntries) -> Option<(&'static str, String, String)> {
    let archive = found.ending(&ARCHIVES)?;
    Some(("a packed capture", archive.clone(), from_archive(&found.root.join(archive))))
}
