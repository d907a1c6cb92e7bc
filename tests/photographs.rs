//! Photographs without cameras: `tiface cameras` with COLMAP itself on real photographs, and with programs in its place that
//! fail in every way. Without COLMAP or the shared captures, which lie beside the repository or where `TIFACE_SHARED` says,
//! the first skips aloud.

use glam::{DMat3, DVec3};
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use tempfile::TempDir;
use tiface::capture::synthetic::{SyntheticOptions, write_capture};
use tiface::capture::{self, Capture, CaptureOptions, View};
use tiface::geom::Camera;
use tiface::io::find_program;

/// Runs `tiface` in a folder, with these programs before or instead of those of the system.
fn tiface(folder: &Path, path: OsString, words: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tiface"));
    command.args(words).current_dir(folder).env("PATH", path).env("XDG_CONFIG_HOME", folder);
    command.env_remove("RUST_LOG").env("NO_COLOR", "1").output().unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Nine photographs without cameras in `photographs/`.
fn photographs() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let small = SyntheticOptions { width: 24, height: 30, train: 7, test: 2, seed: 1 };
    write_capture(&dir.path().join("head"), &small).unwrap();
    fs::rename(dir.path().join("head/images"), dir.path().join("photographs")).unwrap();
    fs::create_dir(dir.path().join("programs")).unwrap();
    dir
}

/// Runs `tiface cameras` with only the programs of this folder.
fn cameras(dir: &TempDir, words: &[&str]) -> (i32, String) {
    let output = tiface(dir.path(), dir.path().join("programs").into(), &[&["cameras"], words].concat());
    (output.status.code().unwrap(), stderr(&output))
}

#[test]
fn what_is_no_folder_of_photographs_is_refused_before_anything_is_written() {
    let dir = photographs();
    let at = |name: &str| dir.path().join(name);
    let images: Vec<PathBuf> = fs::read_dir(at("photographs")).unwrap().map(|e| e.unwrap().path()).collect();
    let with = |name: &str, n: usize| {
        fs::create_dir(at(name)).unwrap();
        for image in &images[..n] {
            fs::copy(image, at(name).join(image.file_name().unwrap())).unwrap();
        }
    };
    with("empty", 0);
    with("one", 1);
    with("cut", 9);
    let cut = at("cut").join(images[4].file_name().unwrap());
    let bytes = fs::read(&cut).unwrap();
    fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    with("calibrated", 9);
    fs::copy(at("head/transforms.json"), at("calibrated/transforms.json")).unwrap();
    fs::write(at("turn.mp4"), "no video").unwrap();
    let rows: &[(&[&str], i32, &str)] = &[
        (&["empty"], 1, "`empty` has no photographs"),
        (&["absent"], 1, "`absent`"),
        (&["one"], 1, "`one` has 1 photographs, and at least 8 are needed"),
        (&["cut"], 1, images[4].file_name().unwrap().to_str().unwrap()),
        (&["calibrated"], 1, "has cameras: `transforms.json`"),
        (&["turn.mp4"], 1, "`tiface cameras --video turn.mp4`"),
        (&["--video", "absent.mp4"], 1, "there is no video `absent.mp4`"),
        (&["--video", "turn.mp4"], 1, "`ffmpeg` is not installed"),
        (&["photographs", "--video", "turn.mp4"], 2, "cannot be used with"),
        (&["--video", "turn.mp4", "--every", "0"], 2, "--every"),
        (&[], 2, "PHOTOGRAPHS"),
    ];
    for (words, code, text) in rows {
        let (exit, said) = cameras(&dir, words);
        assert!(exit == *code && said.contains(text), "{words:?}: {exit}, {said}");
    }
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("`colmap` is not installed"), "{said}");
    for way in ["apt-get install colmap", "brew install colmap", "github.com/colmap/colmap/releases"] {
        assert!(said.contains(way), "{said}");
    }
    let left: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert!(left.iter().all(|name| !name.to_string_lossy().ends_with("_cameras")), "{left:?}");
}

#[test]
#[cfg(unix)]
fn photographs_that_are_left_out_for_their_names_are_named() {
    let dir = photographs();
    let at = |name: &str| dir.path().join("photographs").join(name);
    let images: Vec<PathBuf> = fs::read_dir(at("")).unwrap().map(|e| e.unwrap().path()).collect();
    for (image, name) in images.iter().zip(["a\\b.png", "..png"]) {
        fs::rename(image, at(name)).unwrap();
    }
    // what macOS leaves beside photographs is none
    fs::write(at("._a.png"), "x").unwrap();
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("has 7 photographs, and at least 8 are needed"), "{said}");
    assert!(said.contains("2 photographs left out, whose name begins with a dot"), "{said}");
    assert!(said.contains("`..png`, `a\\b.png`"), "{said}");
}

/// Puts a shell script in the place of a program.
#[cfg(unix)]
fn script(dir: &TempDir, program: &str, text: &str) {
    use std::os::unix::fs::PermissionsExt;
    let path = dir.path().join("programs").join(program);
    fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
#[cfg(unix)]
fn a_colmap_that_fails_is_named_with_its_command_and_log_and_may_be_tried_again() {
    let dir = photographs();
    let at = |name: &str| dir.path().join(name);
    script(&dir, "colmap", "exit 1");
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("`colmap feature_extractor` failed"), "{said}");
    // an older version, and one that ends in the middle
    script(&dir, "colmap", "echo ran \"$@\"; [ \"$1\" != exhaustive_matcher ]");
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("`colmap exhaustive_matcher` failed"), "{said}");
    assert!(
        said.contains("photographs_cameras/colmap/tiface_cameras.log") && said.contains("RAYON_NUM_THREADS"),
        "{said}"
    );
    let log = fs::read_to_string(at("photographs_cameras/colmap/tiface_cameras.log")).unwrap();
    assert!(log.contains("ran feature_extractor") && log.contains("--SiftExtraction.use_gpu 0"), "{log}");
    // no model: once more with weak features, and both attempts are shown
    script(&dir, "colmap", "echo ran \"$@\"; echo FeatureExtraction.use_gpu; [ \"$1\" != mapper ]");
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("found cameras for 0 of 9 photographs"), "{said}");
    assert_eq!(said.matches("colmap mapper --database_path").count(), 2, "{said}");
    assert_eq!(said.matches("--FeatureMatching.guided_matching 1").count(), 1, "{said}");
    // a model that is none
    script(
        &dir,
        "colmap",
        "[ \"$1\" = mapper ] || exit 0\nmodel=photographs_cameras/colmap/1/models/0\nmkdir -p $model || exit\n\
         for kind in cameras images points3D; do echo x > $model/$kind.bin; done",
    );
    script(&dir, "mkdir", "exec /bin/mkdir \"$@\"");
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("models/0/") && said.contains("is not a valid COLMAP file"), "{said}");
    // GLOMAP takes the mapper's place, and only that
    script(&dir, "colmap", "exit 0");
    let (exit, said) = cameras(&dir, &["photographs", "--glomap"]);
    assert!(exit == 1 && said.contains("`glomap` is not installed"), "{said}");
    script(&dir, "glomap", "exit 0");
    let (exit, said) = cameras(&dir, &["photographs", "--glomap"]);
    assert!(
        exit == 1 && said.contains("glomap mapper --database_path") && !said.contains("Mapper."),
        "{said}"
    );
    // neither the photographs' own folder nor what is no unfinished attempt is cleared
    let (exit, said) = cameras(&dir, &["photographs_cameras/images", "--out", "photographs_cameras"]);
    assert!(exit == 1 && said.contains("`photographs_cameras` already exists"), "{said}");
    assert_eq!(fs::read_dir(at("photographs_cameras/images")).unwrap().count(), 9);
    fs::create_dir_all(at("kept/images")).unwrap();
    fs::write(at("kept/images/mine.png"), "mine").unwrap();
    // as another program may leave it: a log, and no model
    fs::create_dir_all(at("kept/colmap")).unwrap();
    fs::write(at("kept/colmap/log.txt"), "").unwrap();
    let (exit, said) = cameras(&dir, &["photographs", "--out", "kept"]);
    assert!(exit == 1 && said.contains("`kept` already exists"), "{said}");
    assert_eq!(fs::read(at("kept/images/mine.png")).unwrap(), b"mine");
    assert_eq!(fs::read_dir(at("kept")).unwrap().count(), 2);
}

#[test]
#[cfg(unix)]
fn a_stop_ends_colmap_as_well() {
    let dir = photographs();
    script(&dir, "colmap", "echo $$ > started; exec /bin/sleep 60");
    let mut command = Command::new(env!("CARGO_BIN_EXE_tiface"));
    command.args(["cameras", "photographs"]).current_dir(dir.path()).env("PATH", dir.path().join("programs"));
    let mut running = command.env("XDG_CONFIG_HOME", dir.path()).spawn().unwrap();
    let started = || fs::read_to_string(dir.path().join("started")).ok()?.trim().parse::<u32>().ok();
    let pid = (0..600).find_map(|_| {
        std::thread::sleep(std::time::Duration::from_millis(50));
        started()
    });
    let killed = Command::new("/bin/kill").arg(running.id().to_string()).status().unwrap();
    assert!(killed.success() && running.wait().unwrap().code() == Some(143));
    assert!(tiface::io::has_ended(pid.expect("the script began")));
}

#[test]
#[cfg(unix)]
fn masks_are_given_to_colmap_black_and_white_and_by_its_names() {
    let dir = photographs();
    let at = |name: &str| dir.path().join(name);
    fs::create_dir(at("scan")).unwrap();
    fs::rename(at("photographs"), at("scan/images")).unwrap();
    fs::rename(at("head/masks"), at("scan/masks")).unwrap();
    script(&dir, "colmap", "exit 0");
    let (exit, said) = cameras(&dir, &["scan"]);
    // the third attempt searches whole photographs
    assert!(
        exit == 1 && said.matches("--ImageReader.mask_path scan_cameras/colmap/masks").count() == 2,
        "{said}"
    );
    assert_eq!(said.matches("colmap feature_extractor --database_path").count(), 3, "{said}");
    let mask = at("scan_cameras/colmap/masks/000.png.png");
    let mask = tiface::io::read_gray(&mask, None, &Default::default()).unwrap();
    assert!(mask.values.contains(&0) && mask.values.contains(&255));
    assert!(mask.values.iter().all(|v| [0, 255].contains(v)));
    assert!(at("scan_cameras/masks/000.png.png").is_file() && at("scan/images/000.png").is_file());
    let (_, said) = cameras(&dir, &["scan", "--set", "mask.source=none"]);
    assert!(said.contains("colmap mapper") && !said.contains("mask_path"), "{said}");
}

/// The program, if it is installed; otherwise skips aloud.
fn installed(program: &str) -> bool {
    let found = find_program(program).is_some();
    if !found {
        eprintln!("skipped: `{program}` is not installed");
    }
    found
}

#[test]
#[cfg(unix)]
fn the_sharpest_frame_of_each_window_of_a_video_is_kept() {
    if !installed("ffmpeg") {
        return;
    }
    let dir = photographs();
    // the brightness of a checkerboard rises and falls: frames 3, 11, 19, ... are the sharpest of each eight
    let made = Command::new("ffmpeg")
        .args("-loglevel error -f lavfi -i".split(' '))
        .arg("nullsrc=s=64x48:d=2.4:r=30,geq=lum='128+4*(4-abs(mod(N,8)-3))*(2*mod(floor(X/4)+floor(Y/4),2)-1)':cb=128:cr=128")
        .args("-c:v ffv1 turn.mkv".split(' '))
        .current_dir(dir.path())
        .status()
        .unwrap();
    assert!(made.success());
    script(&dir, "colmap", "exit 1");
    let ffmpeg = find_program("ffmpeg").unwrap();
    std::os::unix::fs::symlink(ffmpeg, dir.path().join("programs/ffmpeg")).unwrap();
    let (exit, said) = cameras(&dir, &["--video", "turn.mkv", "--every", "8"]);
    assert!(exit == 1 && said.contains("9 frames, the sharpest of each 8"), "{said}");
    let frames = fs::read_dir(dir.path().join("turn_cameras/images")).unwrap();
    let mut names: Vec<_> = frames.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    let expected: Vec<_> = (0..9).map(|i| format!("{:06}.png", 8 * i + 3)).collect();
    assert_eq!(names, expected);
    let (exit, said) = cameras(&dir, &["--video", "turn.mkv", "--every", "72"]);
    assert!(
        exit == 1 && said.contains("has 1 photographs, and at least 8") && said.contains("`--every`"),
        "{said}"
    );
}

/// The nearest rotation to a sum of rotations, by Newton's iteration for the polar decomposition.
fn nearest_rotation(sum: DMat3) -> DMat3 {
    (0..60).fold(sum, |r, _| (r + r.inverse().transpose()) * 0.5)
}

fn root_mean_square(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

/// Returns how far cameras are from those that they should be after the best similarity: positions as a share of their extent,
/// rotations in degrees.
fn apart(pairs: &[(&Camera, &Camera)]) -> (Vec<f64>, Vec<f64>) {
    let n = pairs.len() as f64;
    // rotation from the rotations, scale and translation from the positions
    let sum = pairs.iter().fold(DMat3::ZERO, |sum, (a, b)| sum + b.rotation * a.rotation.transpose());
    let rotation = nearest_rotation(sum * (1.0 / n));
    let [from, to] = [0, 1].map(|k| pairs.iter().map(|p| [p.0, p.1][k].position).sum::<DVec3>() / n);
    let spread = |k: usize, mean: DVec3| {
        root_mean_square(&pairs.iter().map(|p| [p.0, p.1][k].position.distance(mean)).collect::<Vec<_>>())
    };
    let scale = spread(1, to) / spread(0, from);
    let least = pairs.iter().fold(DVec3::MAX, |least, (_, b)| least.min(b.position));
    let most = pairs.iter().fold(DVec3::MIN, |most, (_, b)| most.max(b.position));
    let moved = |(a, b): &(&Camera, &Camera)| {
        (rotation * (a.position - from) * scale + to).distance(b.position) / least.distance(most)
    };
    let turned = |(a, b): &(&Camera, &Camera)| {
        let r = b.rotation.transpose() * rotation * a.rotation;
        (0.5 * (r.x_axis.x + r.y_axis.y + r.z_axis.z - 1.0)).clamp(-1.0, 1.0).acos().to_degrees()
    };
    (pairs.iter().map(moved).collect(), pairs.iter().map(turned).collect())
}

/// The folder of a shared capture, if it is there and COLMAP is installed; otherwise skips aloud.
fn shared(name: &str) -> Option<PathBuf> {
    let shared = std::env::var("TIFACE_SHARED")
        .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into());
    let folder = PathBuf::from(shared).join("data/captures").join(name);
    if !folder.is_dir() {
        eprintln!("skipped: the capture `{name}` is not at {}", folder.display());
    }
    (folder.is_dir() && installed("colmap")).then_some(folder)
}

/// Finds the cameras of the first photographs of a capture, and returns how far they are from its own, root mean square, and
/// the capture that was found.
fn found_again(name: &str, photographs: usize, with_masks: bool, dir: &Path) -> Option<(f64, f64, Capture)> {
    let folder = shared(name)?;
    let mut own = capture::open(&folder, &CaptureOptions::default()).unwrap().views;
    own.sort_by(|a, b| a.name.cmp(&b.name));
    own.truncate(photographs);
    for part in ["images", "masks"].iter().take(1 + usize::from(with_masks)) {
        fs::create_dir_all(dir.join("bare").join(part)).unwrap();
        for view in &own {
            let file = Path::new(part).join(view.photo.file_name().unwrap());
            fs::copy(folder.join(&file), dir.join("bare").join(&file)).unwrap();
        }
    }
    let path = std::env::var_os("PATH").unwrap();
    let run = tiface(dir, path.clone(), &["run", "bare"]);
    assert!(stderr(&run).contains("find them with COLMAP: `tiface cameras /"), "{}", stderr(&run));
    let found = tiface(dir, path.clone(), &["cameras", "bare"]);
    assert!(found.status.success(), "{}", stderr(&found));
    let again = tiface(dir, path, &["cameras", "bare"]);
    assert!(stderr(&again).contains("`bare_cameras` already exists"), "{}", stderr(&again));
    let capture = capture::open(&dir.join("bare_cameras"), &CaptureOptions::default()).unwrap();
    assert_eq!(capture.views.len(), photographs, "{}", stderr(&found));
    let camera = |view: &View| &own.iter().find(|o| o.name == view.name).unwrap().camera;
    let pairs: Vec<_> = capture.views.iter().map(|view| (&view.camera, camera(view))).collect();
    let (moved, turned) = apart(&pairs);
    let worst = |values: &[f64]| values.iter().fold(0.0f64, |a, b| a.max(*b));
    let (position, rotation) = (root_mean_square(&moved), root_mean_square(&turned));
    eprintln!(
        "{name}, {photographs} photographs, masks {with_masks}: positions {:.3} % of their extent, at most {:.3} %; rotations \
         {rotation:.3}°, at most {:.3}°",
        100.0 * position,
        100.0 * worst(&moved),
        worst(&turned)
    );
    Some((position, rotation, capture))
}

#[test]
fn twenty_real_photographs_get_the_cameras_that_they_came_with() {
    let dir = tempfile::tempdir().unwrap();
    let Some((position, rotation, capture)) = found_again("fox", 20, false, dir.path()) else { return };
    assert!(position < 0.006 && rotation < 0.4, "{position} {rotation}");
    assert!(capture.focus.is_some(), "points bound the scene without masks");
    // its own focal length is 343.9 pixels
    let focal = capture.views[0].camera.fx;
    assert!((focal / 343.9 - 1.0).abs() < 0.02, "{focal}");
}

#[test]
#[ignore = "four minutes of COLMAP: the table of docs/captures.md"]
fn whole_captures_get_their_cameras_and_smooth_skin_by_weak_features() {
    let rows = [("fox", 50, false, 0.003, 0.2), ("lps", 24, true, 0.01, 1.5), ("lps", 24, false, 0.02, 3.0)];
    for (name, photographs, with_masks, position, rotation) in rows {
        let dir = tempfile::tempdir().unwrap();
        let Some(found) = found_again(name, photographs, with_masks, dir.path()) else { continue };
        assert!(found.0 < position && found.1 < rotation, "{name}: {} {}", found.0, found.1);
    }
}
