//! What other programs leave in a folder: how it is recognized, and the way from there to a
//! capture.

use super::folder::{FolderEntries, has_ending, join};
use tiface_base::io;

/// Signs that a folder is a program's.
enum Sign {
    /// A file or folder, whose path may contain `/`.
    Entry(&'static str),
    /// A file with this ending.
    Ending(&'static str),
    /// A file of this name whose beginning contains these words.
    Words(&'static str, &'static str),
    /// The same of the first files with this ending.
    AnyWords(&'static str, &'static str),
    /// The same of those in the folder or in one directly below.
    WordsBelow(&'static str, &'static str),
    /// In this folder, a file whose name ends like this.
    Inside(&'static str, &'static str),
}
use Sign::{AnyWords, Ending, Entry, Inside, Words, WordsBelow};

impl Sign {
    /// Returns the file or folder that shows it.
    fn find_in(&self, found: &FolderEntries) -> Option<String> {
        match *self {
            Entry(name) => found.any(&[name]).map(str::to_owned),
            Ending(ending) => found.ending(&[ending]).cloned(),
            Words(name, words) => {
                let only =
                    FolderEntries { files: vec![name.into()], root: found.root.clone(), folders: Vec::new() };
                let ending = name.rsplit('.').next().unwrap_or_default();
                only.holding(ending, words).cloned()
            }
            AnyWords(ending, words) => found.holding(ending, words).cloned(),
            WordsBelow(ending, words) => below(found, ending, |text| text.contains(words)),
            Inside(folder, end) => {
                let files = io::list_files(&found.root.join(folder)).unwrap_or_default();
                files.iter().find(|f| f.ends_with(end)).map(|f| join(folder, f))
            }
        }
    }
}

/// Returns the first file with this ending, in the folder or in one directly below, whose beginning
/// is as asked for.
fn below(found: &FolderEntries, ending: &str, is_wanted: impl Fn(&str) -> bool) -> Option<String> {
    let inside = |folder: &String| {
        let inner = FolderEntries::list(&found.root.join(folder));
        inner.beginning(ending, &is_wanted).map(|file| join(folder, file))
    };
    let here = found.beginning(ending, &is_wanted).cloned();
    here.or_else(|| found.folders.iter().take(16).find_map(inside))
}

/// A kind of folder, and the way from there: `{root}` stands for the folder, `{file}` for what
/// shows the kind.
struct Program {
    what: &'static str,
    signs: &'static [Sign],
    way: &'static str,
}

impl Program {
    /// Returns what a folder is, the file or folder that shows it, and the way from there.
    fn recognize(&self, found: &FolderEntries) -> Option<(&'static str, String, String)> {
        let file = self.signs.iter().find_map(|sign| sign.find_in(found))?;
        let way = self.way_from(&found.root.display().to_string(), &found.at(&file));
        Some((self.what, file, way))
    }

    fn way_from(&self, root: &str, file: &str) -> String {
        let texts = [
            ("{BY_HAND}", BY_HAND),
            ("{TO_COLMAP}", TO_COLMAP),
            ("{WITH_LENS}", WITH_LENS),
            ("{RESULT}", RESULT),
        ];
        let way = texts.iter().fold(self.way.to_string(), |way, (key, text)| way.replace(key, text));
        way.replace("{file}", file).replace("{root}", root)
    }
}

const fn program(what: &'static str, signs: &'static [Sign], way: &'static str) -> Program {
    Program { what, signs, way }
}

/// Advice for datasets with cameras that no common tool converts.
const BY_HAND: &str = "no common tool converts it: write `transforms.json` with `file_path`, `w`, `h`, `fl_x`, `fl_y`, \
                       `cx`, `cy` and `transform_matrix` for each photograph (camera to world, +Y up and looking along \
                       -Z: the second and third column of an OpenCV pose, negated)";

/// Advice for cameras that another program exports to COLMAP.
const TO_COLMAP: &str = "writes its cameras as COLMAP's: put `cameras`, `images` and `points3D` (`.bin` or `.txt`) into \
                         `sparse/0`, the photographs beside it into `images/`";

/// Advice for files with positions that lack the rest.
const WITH_LENS: &str = "it has no lens: export cameras with their lens instead, from Metashape as XML (File, Export, \
                         Export Cameras), from RealityCapture as CSV (`Internal/External camera parameters`)";

/// Advice for what was made from photographs and cameras.
const RESULT: &str = "give the folder that it was made from, with the photographs and their cameras";

/// Kinds of folders; the first one counts.
#[rustfmt::skip]
const PROGRAMS: &[Program] = &[
    program("a Record3D recording",
        &[Words("metadata.json", "\"initPose\""), Words("metadata.json", "\"poses\""),
          Words("metadata.json", "\"perFrameIntrinsicCoeffs\""), Ending("r3d")],
        "nerfstudio converts it: unpack `.r3d` (a ZIP archive), let the folder of its photographs be called \
         `rgb`, not `rgbd`, and that of its poses `metadata.json`; then `ns-process-data record3d --data \
         {root} --output-dir NEW` and `tiface inspect NEW`"),
    program("a scan of 3D Scanner App (ARKit)", &[WordsBelow("json", "\"cameraPoseARFrame\"")],
        "{BY_HAND}; of each photograph's JSON, `cameraPoseARFrame` is `transform_matrix` by rows as it is, \
         and `intrinsics` is K by rows"),
    program("an sdfstudio scene",
        &[Words("meta_data.json", "\"camtoworld\""), Words("meta_data.json", "\"worldtogt\"")],
        "{BY_HAND}; it holds `camtoworld` (OpenCV axes) and `intrinsics` (K) of each frame"),
    program("an EyefulTower scene", &[Words("cameras.json", "\"KRT\"")],
        "put its `cameras.xml` (Metashape's, for photographs of full size) beside the photographs; or \
         `ns-download-data eyefultower` of nerfstudio fetches it with a `transforms.json`"),
    program("a Multiface recording", &[Entry("KRT")],
        "{BY_HAND}; it holds K, distortion and [R|t] of each camera; take one frame of one expression of \
         `images/`"),
    program("a NeRSemble participant", &[Entry("calibration/camera_params.json"), Entry("camera_params.json")],
        "{BY_HAND}; it holds `world_2_cam` of each camera and one `intrinsics`; take one moment of one \
         sequence, its `alpha_maps` are masks"),
    program("a FaceScape tuple", &[Entry("params.json")],
        "{BY_HAND}; it holds `I_K`, `I_Rt` (world to camera), `I_distortion` and `I_valid` of photograph \
         I.jpg: leave out what is not valid"),
    program("a Nerfies or HyperNeRF capture",
        &[Inside("camera", ".json"), Words("dataset.json", "\"train_ids\"")],
        "{BY_HAND}; `camera/NAME.json` holds `orientation` (from the world to an OpenCV camera, by rows), \
         `position`, `focal_length` and `principal_point` of `rgb/1x/NAME.png`; a head that moves does not \
         fit one shape: take one moment"),
    program("an EasyMocap recording", &[Entry("intri.yml"), Entry("extri.yml")],
        "{BY_HAND}; `intri.yml` holds `K_NAME` and `dist_NAME`, `extri.yml` holds `Rot_NAME` and `T_NAME` \
         (from the world to an OpenCV camera); take one moment"),
    program("a Polycam raw export", &[Entry("keyframes")],
        "nerfstudio converts it: `ns-process-data polycam --data {root} --output-dir NEW`, then `tiface \
         inspect NEW`"),
    program("a trained scene of 3D Gaussian splatting",
        &[Entry("cfg_args"), Words("cameras.json", "\"img_name\""), Entry("point_cloud/iteration_30000")],
        "{RESULT}: `source_path` in `cfg_args`"),
    program("a trained scene of nerfstudio", &[Entry("dataparser_transforms.json"), Entry("nerfstudio_models")],
        "{RESULT}: `data` in `config.yml`"),
    program("a Metashape project", &[Ending("psx"), Ending("psz")],
        "export its cameras as XML into this folder: File, Export, Export Cameras"),
    program("a RealityCapture project", &[Ending("rcproj"), Ending("rsproj")],
        "export its registration as CSV (`Internal/External camera parameters`) into this folder, or its \
         metadata as XMP beside the photographs"),
    program("a Meshroom project", &[Entry("MeshroomCache"), Ending("mg"), Ending("sfm")],
        "its node `ExportColmap` (or `aliceVision_exportColmap --input cameras.sfm --output NEW`) {TO_COLMAP}"),
    program("an OpenSfM project", &[Entry("reconstruction.json")], "`opensfm export_colmap {root}` {TO_COLMAP}"),
    program("an OpenMVG scene", &[Entry("sfm_data.json"), Entry("sfm_data.bin")],
        "`openMVG_main_openMVG2Colmap -i {file} -o NEW` {TO_COLMAP}"),
    program("a VisualSFM scene", &[Ending("nvm")],
        "OpenMVS (`InterfaceVisualSFM -i {file} -o scene.mvs`, then `InterfaceCOLMAP -i scene.mvs -o NEW`) \
         {TO_COLMAP}"),
    program("a Bundler scene",
        &[Entry("bundle.out"), Entry("bundle/bundle.out"), AnyWords("out", "# Bundle file")],
        "OpenMVS (`InterfaceVisualSFM -i {file} -o scene.mvs`, then `InterfaceCOLMAP -i scene.mvs -o NEW`) \
         {TO_COLMAP}"),
    program("an MVSNet scene", &[Inside("cams", "_cam.txt"), Inside("Cameras", "_cam.txt"), Entry("pair.txt"),
          Inside("cams_1", "_cam.txt"), Entry("blended_images")],
        "OpenMVS (`InterfaceMVSNet -i {root} -o scene.mvs`, then `InterfaceCOLMAP -i scene.mvs -o NEW`) \
         {TO_COLMAP}; photographs of BlendedMVS must be in `images/`, not `blended_images/`"),
    program("an OpenMVS scene", &[Ending("mvs")], "`InterfaceCOLMAP -i {file} -o NEW` {TO_COLMAP}"),
    program("a MeshLab project", &[Ending("mlp")],
        "MeshLab's filter `Export active rasters cameras to file`, as Agisoft xml into this folder, writes \
         them as Metashape does"),
    program("a ContextCapture export", &[AnyWords("xml", "<BlocksExchange")],
        "import it in Metashape (File, Import, Import Cameras), and export it from there as Agisoft XML"),
    program("an ARKitScenes recording",
        &[Ending("traj"), Entry("lowres_wide.traj"), Entry("lowres_wide_intrinsics")],
        "{BY_HAND}; `.traj` holds rotation and translation from the world to an OpenCV camera, `.pincam` \
         size, focal lengths and principal point"),
    program("a DTU or Middlebury scene", &[Inside("", "_par.txt"), Inside("Calibration/cal18", "pos_001.txt"),
          Inside("calib", "pos_001.txt")],
        "{BY_HAND}; it holds K [R | t], from the world to an OpenCV camera"),
    program("a table of positions and angles",
        &[AnyWords("txt", "Omega, Phi, Kappa"), AnyWords("txt", "Omega Phi Kappa"),
          AnyWords("txt", "Omega\tPhi\tKappa"), AnyWords("csv", "Omega,Phi,Kappa"),
          AnyWords("csv", "Omega;Phi;Kappa"), AnyWords("csv", "omega,phi,kappa"),
          AnyWords("csv", "Yaw,Pitch,Roll"), AnyWords("csv", "yaw,pitch,roll"),
          AnyWords("csv", "#name,x,y,z")],
        "{WITH_LENS}"),
];

/// Scenes that were made of photographs or from none; photographs beside them are more.
#[rustfmt::skip]
const SCENES: &[Program] = &[
    program("a snapshot of instant-ngp", &[Ending("ingp"), Ending("msgpack")],
        "it is a trained scene: {RESULT}, with its `transforms.json`"),
    program("a PostShot project", &[Ending("psht")],
        "{RESULT}; if PostShot found the cameras, find them again with `tiface cameras PHOTOGRAPHS`"),
    program("a scene of Gaussian splats", &[Ending("splat"), Ending("spz"), Ending("ksplat"), Ending("sog")],
        "it is a result without photographs: {RESULT}"),
    program("a Blender scene", &[Ending("blend")],
        "render its views, and export their cameras with the add-on BlenderNeRF, which writes \
         `transforms_train.json`"),
];

/// Signs that are tried last, since other programs leave the same files.
#[rustfmt::skip]
const UNFINISHED: Program = program("an incomplete COLMAP project",
    &[Entry("sparse"), Entry("colmap"), Entry("cameras.bin"), Entry("cameras.txt"), Entry("images.bin"),
      Entry("images.txt"), Entry("database.db"), Entry("distorted"), Entry("dense")],
    "its cameras and images files are missing: run `colmap mapper`, or copy `cameras.bin` and `images.bin` \
     (or `.txt`) into `sparse/0`");

/// Returns which program's a folder is, the file or folder that shows it, and the way from there.
pub(super) fn recognized(found: &FolderEntries) -> Option<(&'static str, String, String)> {
    let has_photographs = found.photographs().is_some();
    // `params.json` is too common a name to identify anything without photographs
    let is_candidate = |p: &&Program| has_photographs || !matches!(p.signs, [Entry("params.json")]);
    PROGRAMS.iter().chain([&UNFINISHED]).filter(is_candidate).find_map(|program| program.recognize(found))
}

/// Returns the same of a folder without photographs.
pub(super) fn scene(found: &FolderEntries) -> Option<(&'static str, String, String)> {
    SCENES.iter().find_map(|program| program.recognize(found))
}

/// Returns which program's a file is by its ending, and the way from there; `root` is its folder.
pub(super) fn of_file(name: &str, root: &str, file: &str) -> Option<(&'static str, String)> {
    let is_its = |sign: &Sign| matches!(sign, Ending(ending) if has_ending(name, &[ending]));
    let program = PROGRAMS.iter().chain(SCENES).find(|program| program.signs.iter().any(is_its))?;
    Some((program.what, program.way_from(root, file)))
}

/// Endings of what may hold cameras.
const ENDINGS: [&str; 16] = [
    "json", "txt", "npy", "npz", "csv", "tsv", "xml", "yml", "yaml", "log", "pkl", "mat", "cam", "tum",
    "pose", "pt",
];

/// Words in the names of files and folders of cameras.
const NAMES: [&str; 15] = [
    "pose",
    "camera",
    "cams",
    "extrinsic",
    "intrinsic",
    "traj",
    "calib",
    "c2w",
    "w2c",
    "cam2world",
    "krt",
    "groundtruth",
    "odometry",
    "transforms",
    "metadata",
];

/// Words in JSON files of cameras.
const KEYS: [&str; 12] = [
    "ntrinsic",
    "xtrinsic",
    "camera_to_world",
    "world_to_camera",
    "cam2world",
    "world2cam",
    "c2w",
    "\"transform",
    "ransformMatrix",
    "ransform_matrix",
    "\"pose",
    "iewMatrix",
];

/// Returns a file that may hold the cameras of photographs, by its name or by words in it.
pub(super) fn cameras_of_unknown_kind(found: &FolderEntries) -> Option<String> {
    let is_one = |name: &str| NAMES.iter().any(|word| name.to_lowercase().contains(word));
    let here = || found.files.iter().find(|name| is_one(name) && has_ending(name, &ENDINGS)).cloned();
    let inside = |folder: &String| {
        FolderEntries::list(&found.root.join(folder)).ending(&ENDINGS).map(|file| join(folder, file))
    };
    let in_folder = || found.folders.iter().filter(|name| is_one(name)).take(16).find_map(inside);
    let by_words = || below(found, "json", |text| KEYS.iter().any(|key| text.contains(key)));
    here().or_else(in_folder).or_else(by_words)
}

/// Returns the advice for cameras whose axes and units are not known.
pub(super) fn by_hand() -> &'static str {
    BY_HAND.split_once(": ").map_or(BY_HAND, |(_, way)| way)
}
