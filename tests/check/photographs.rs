//! Photographs without cameras: `tiface cameras` with COLMAP itself on real photographs, and with
//! programs in its place that fail in every way. Without COLMAP or the shared captures, which lie
//! beside the repository or where `TIFACE_SHARED` says, the first skips aloud.

use crate::clicked;
use crate::command::{code, command, err};
use crate::kept::photographed;
use glam::{DMat3, DVec3};
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use tempfile::TempDir;
use tiface::capture::convert::{CameraFormat, convert};
use tiface::capture::synthetic::SyntheticOptions;
use tiface::capture::{self, Capture, CaptureOptions, View};
use tiface::geom::Camera;
use tiface::io::find_program;

/// Runs `tiface` in a folder, with these programs before or instead of those of the system.
fn tiface(folder: &Path, path: OsString, words: &[&str]) -> Output {
    command(folder, words).env("PATH", path).output().unwrap()
}

/// Nine photographs without cameras in `photographs/`.
pub fn photographs() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let small = SyntheticOptions { width: 24, height: 30, train: 7, test: 2, seed: 1 };
    photographed(&dir.path().join("head"), &small);
    fs::rename(dir.path().join("head/images"), dir.path().join("photographs")).unwrap();
    fs::create_dir(dir.path().join("programs")).unwrap();
    dir
}

/// Runs `tiface cameras` with only the programs of this folder.
pub fn cameras(dir: &TempDir, words: &[&str]) -> (i32, String) {
    let output = tiface(dir.path(), dir.path().join("programs").into(), &[&["cameras"], words].concat());
    (code(&output), err(&output))
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
    // and a dry run ends as the command would
    for (words, code, text) in rows {
        for words in [words.to_vec(), [*words, &["--dry-run"]].concat()] {
            let (exit, said) = cameras(&dir, &words);
            assert!(exit == *code && said.contains(text), "{words:?}: {exit}, {said}");
        }
    }
    let (exit, said) = cameras(&dir, &["photographs", "--dry-run"]);
    assert!(exit == 1 && said.contains("`colmap` is not installed"), "{said}");
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
pub fn script(dir: &TempDir, program: &str, text: &str) {
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

/// Returns the number that a script in the place of a program wrote to `started`: of a process.
/// Waits five minutes at most.
#[cfg(unix)]
fn started(dir: &TempDir) -> Option<u32> {
    (0..6000).find_map(|_| {
        std::thread::sleep(std::time::Duration::from_millis(50));
        fs::read_to_string(dir.path().join("started")).ok()?.trim().parse().ok()
    })
}

#[test]
#[cfg(unix)]
fn a_stop_ends_colmap_as_well() {
    let dir = photographs();
    script(&dir, "colmap", "echo $$ > started; exec /bin/sleep 600");
    let mut command = command(dir.path(), &["cameras", "photographs"]);
    let mut running = command.env("PATH", dir.path().join("programs")).spawn().unwrap();
    let pid = started(&dir);
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

/// Nine photographs without cameras in `photographs/`, and their model in `model/`, which a script
/// in the place of COLMAP finds; then its mapper does what `then` says, with the folder of models
/// in `$out`.
#[cfg(unix)]
pub fn found_by_script(then: &str) -> TempDir {
    let dir = photographs();
    let small = SyntheticOptions { width: 24, height: 30, train: 7, test: 2, seed: 1 };
    photographed(&dir.path().join("whole"), &small);
    let whole = capture::open(&dir.path().join("whole"), &CaptureOptions::default()).unwrap();
    convert(&whole, CameraFormat::Colmap, &dir.path().join("converted")).unwrap();
    fs::rename(dir.path().join("converted/sparse/0"), dir.path().join("model")).unwrap();
    mapper(&dir, &format!("/bin/mkdir -p $out/0; /bin/cp model/*.bin $out/0; {then}"));
    dir
}

/// Puts a script in the place of COLMAP, of which only the mapper does anything.
#[cfg(unix)]
fn mapper(dir: &TempDir, text: &str) {
    let words = "command=$1; while [ $# -gt 0 ]; do [ \"$1\" = --output_path ] && out=$2; shift; done";
    script(dir, "colmap", &format!("{words}\n[ $command = mapper ] || exit 0\n{text}\nexit 0"));
}

#[cfg(unix)]
fn files_in(folder: &Path) -> usize {
    fs::read_dir(folder).unwrap().count()
}

#[test]
#[cfg(unix)]
fn folders_of_photographs_of_one_name_give_captures_of_two_names_and_none_takes_the_others() {
    let dir = found_by_script("");
    let at = |name: &str| dir.path().join(name);
    fs::create_dir_all(at("heads/a")).unwrap();
    fs::create_dir_all(at("heads/b/images")).unwrap();
    fs::rename(at("photographs"), at("heads/a/images")).unwrap();
    for entry in fs::read_dir(at("heads/a/images")).unwrap().map(|e| e.unwrap()) {
        if entry.file_name() != "008.png" {
            fs::copy(entry.path(), at("heads/b/images").join(entry.file_name())).unwrap();
        }
    }
    for (name, photographs) in [("a", 9), ("b", 8)] {
        let (exit, said) = cameras(&dir, &[&format!("heads/{name}/images")]);
        assert!(exit == 0, "{name}: {said}");
        assert_eq!(files_in(&at(&format!("{name}_cameras/images"))), photographs);
    }
    for dry in [&[][..], &["--dry-run"]] {
        let words = [&["heads/b/images", "--out", "a_cameras"][..], dry].concat();
        let (exit, said) = cameras(&dir, &words);
        assert!(exit == 1 && said.contains("`a_cameras` already exists"), "{exit}, {said}");
        assert!(
            said.contains("of other photographs") && said.contains("another folder with `--out`"),
            "{said}"
        );
    }
    assert_eq!(files_in(&at("a_cameras/images")), 9);
}

#[test]
#[cfg(unix)]
fn a_folder_that_another_search_works_in_is_not_cleared() {
    let dir = photographs();
    mapper(&dir, "exit 1");
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("found cameras for 0 of 9"), "{said}");
    let lock = tiface::io::Lock::take(&dir.path().join("photographs_cameras/.lock")).unwrap();
    for words in [&["photographs"][..], &["photographs", "--dry-run"]] {
        let (exit, said) = cameras(&dir, words);
        assert!(exit == 75 && said.contains("`photographs_cameras` is locked by another"), "{exit}, {said}");
    }
    assert_eq!(files_in(&dir.path().join("photographs_cameras/images")), 9);
    // as is a folder in which a search has only begun
    fs::create_dir(dir.path().join("begun")).unwrap();
    let begun = tiface::io::Lock::take(&dir.path().join("begun/.lock")).unwrap();
    let (exit, said) = cameras(&dir, &["photographs", "--out", "begun"]);
    assert!(exit == 75 && said.contains("`begun` is locked by another"), "{exit}, {said}");
    drop((lock, begun));
}

/// Repeats `tiface cameras photographs` until it is not refused by a lock, for a minute at most.
#[cfg(unix)]
fn until_unlocked(dir: &TempDir) -> (i32, String) {
    let tries = (0..600).map(|_| {
        std::thread::sleep(std::time::Duration::from_millis(100));
        cameras(dir, &["photographs"])
    });
    tries.take_while(|(exit, _)| *exit == 75).count();
    cameras(dir, &["photographs"])
}

#[test]
#[cfg(unix)]
fn what_outlives_a_killed_search_keeps_the_next_one_from_its_folder() {
    let dir = photographs();
    // what the shell started remains when it is killed, and has its input
    script(&dir, "colmap", "exec 3<&0; /bin/sleep 600 & echo $! > started; wait");
    let mut command = command(dir.path(), &["cameras", "photographs"]);
    let mut running = command.env("PATH", dir.path().join("programs")).spawn().unwrap();
    let pid = started(&dir);
    running.kill().unwrap();
    running.wait().unwrap();
    script(&dir, "colmap", "exit 1");
    let (exit, said) = cameras(&dir, &["photographs"]);
    let pid = pid.expect("the script began").to_string();
    assert!(Command::new("/bin/kill").args(["-KILL", &pid]).status().unwrap().success());
    assert!(exit == 75 && said.contains("or by its COLMAP"), "{exit}, {said}");
    let (exit, said) = until_unlocked(&dir);
    assert!(exit == 1 && said.contains("`colmap feature_extractor` failed"), "{exit}, {said}");
}

#[test]
#[cfg(unix)]
fn what_colmap_started_ends_with_it() {
    let dir = photographs();
    script(&dir, "colmap", "exec 3<&0; /bin/sleep 600 & exit 1");
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("`colmap feature_extractor` failed"), "{exit}, {said}");
    let (exit, said) = until_unlocked(&dir);
    assert!(exit == 1, "{exit}, {said}");
}

#[test]
#[cfg(unix)]
fn what_a_user_puts_beside_an_unfinished_search_stays_and_a_finished_one_is_done() {
    let dir = found_by_script("");
    let at = |name: &str| dir.path().join("photographs_cameras").join(name);
    let found = fs::read_to_string(dir.path().join("programs/colmap")).unwrap();
    mapper(&dir, "exit 1");
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("found cameras for 0 of 9"), "{said}");
    fs::rename(dir.path().join("head/masks"), at("masks")).unwrap();
    fs::copy(dir.path().join("photographs/000.png"), at("images/other.png")).unwrap();
    for name in ["notes.txt", "colmap/notes.txt"] {
        fs::write(at(name), "mine").unwrap();
    }
    fs::write(dir.path().join("programs/colmap"), found).unwrap();
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 0, "{said}");
    // COLMAP is told which pictures are the photographs
    assert!(said.contains("--image_list_path photographs_cameras/colmap/images.txt"), "{said}");
    for name in ["masks/000.png", "images/other.png", "images/000.png", "notes.txt", "colmap/notes.txt"] {
        assert!(at(name).is_file(), "{name}");
    }
    assert!(!at("colmap/1").exists() && !at("colmap/images.txt").exists());
    assert_eq!(capture::open(&at(""), &CaptureOptions::default()).unwrap().views.len(), 9);
    // asked for again, nothing is needed and nothing is done
    script(&dir, "colmap", "exit 1");
    for (words, text) in
        [(&["photographs"][..], "done: 9 of 9"), (&["photographs", "--dry-run"][..], "is done")]
    {
        let (exit, said) = cameras(&dir, words);
        assert!(exit == 0 && said.contains(text) && !said.contains("feature_extractor"), "{exit}, {said}");
    }
    let (exit, said) = cameras(&dir, &["photographs", "--lens-each"]);
    assert!(exit == 1 && said.contains("with other cameras: lens_each: was false, is true"), "{said}");
}

#[test]
#[cfg(unix)]
fn a_file_that_no_search_wrote_is_neither_replaced_nor_cleared_by_the_next() {
    let dir = photographs();
    let at = |name: &str| dir.path().join(name);
    mapper(&dir, "exit 1");
    fs::create_dir(at("scan")).unwrap();
    fs::rename(at("photographs"), at("scan/images")).unwrap();
    assert_eq!(cameras(&dir, &["scan"]).0, 1);
    fs::create_dir(at("scan_cameras/masks")).unwrap();
    fs::write(at("scan_cameras/masks/000.png.png"), "mine").unwrap();
    fs::rename(at("head/masks"), at("scan/masks")).unwrap();
    for _ in 0..2 {
        let (exit, said) = cameras(&dir, &["scan"]);
        assert!(exit == 1 && said.contains("masks/000.png.png` already exists"), "{exit}, {said}");
        assert_eq!(fs::read(at("scan_cameras/masks/000.png.png")).unwrap(), b"mine");
    }
}

#[test]
#[cfg(unix)]
fn a_mapper_that_the_system_kills_is_named_and_no_photographs_are_asked_for() {
    let dir = photographs();
    mapper(&dir, "kill -KILL $$");
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 1 && said.contains("`colmap mapper` failed (signal: 9"), "{exit}, {said}");
    assert!(said.contains("if memory ran out") && !said.contains("photograph the head again"), "{said}");
    assert_eq!(said.matches("colmap mapper --database_path").count(), 1, "{said}");
}

#[test]
#[cfg(unix)]
fn a_second_model_that_is_half_written_leaves_the_first() {
    let dir = found_by_script("/bin/mkdir $out/1; /bin/cp model/cameras.bin $out/1");
    let (exit, said) = cameras(&dir, &["photographs"]);
    assert!(exit == 0 && said.contains("9 of 9 photographs"), "{exit}, {said}");
    assert!(said.contains("a piece is left out") && said.contains("models/1/images.bin"), "{said}");
}

#[test]
#[cfg(unix)]
fn a_model_that_cannot_be_opened_is_no_result() {
    let dir = found_by_script("");
    let read = |name: &str| fs::read(dir.path().join("model").join(name)).unwrap();
    let (images, cameras_file) = (read("images.bin"), read("cameras.bin"));
    // a count, then for each image: number, pose of seven numbers, camera, `000.png` and 0, no
    // points
    let (first, length, pose) = (8, 4 + 56 + 4 + 8 + 8, 4..60);
    let edited = |edit: &dyn Fn(usize, &mut [u8])| {
        let mut bytes = images.clone();
        bytes[first..].chunks_exact_mut(length).enumerate().for_each(|(i, image)| edit(i, image));
        bytes
    };
    let nan: Vec<u8> = (0..7).flat_map(|_| f64::NAN.to_le_bytes()).collect();
    let rows = [
        ("images.bin", edited(&|_, image| image[64] = b'z'), "found cameras for 0 of 9"),
        (
            "images.bin",
            edited(&|i, image| {
                if i == 3 {
                    image[pose.clone()].copy_from_slice(&nan)
                }
            }),
            "not finite",
        ),
        (
            "images.bin",
            edited(&|_, image| image[pose.clone()].copy_from_slice(&images[first..][pose.clone()])),
            "in one place",
        ),
        ("cameras.bin", 0u64.to_le_bytes().to_vec(), "is not in the cameras file"),
    ];
    for (name, bytes, text) in rows {
        fs::write(dir.path().join("model/images.bin"), &images).unwrap();
        fs::write(dir.path().join("model/cameras.bin"), &cameras_file).unwrap();
        fs::write(dir.path().join("model").join(name), bytes).unwrap();
        let (exit, said) = cameras(&dir, &["photographs"]);
        assert!(exit == 1 && said.contains(text), "{text}: {exit}, {said}");
        assert!(!dir.path().join("photographs_cameras/sparse/0").exists(), "{text}");
    }
}

#[test]
#[cfg(unix)]
fn a_video_named_like_an_address_is_a_file_to_ffmpeg() {
    let dir = photographs();
    let at = |name: &str| dir.path().join(name);
    fs::write(at("20260101-12:30.mp4"), "x").unwrap();
    script(&dir, "colmap", "exit 1");
    script(&dir, "ffmpeg", "echo \"$@\" > typed; printf 'P6\\n1 1\\n255\\nabc'");
    let (exit, said) = cameras(&dir, &["--video", "20260101-12:30.mp4"]);
    assert!(exit == 1 && said.contains("has 1 photographs, and at least 8"), "{exit}, {said}");
    let typed = fs::read_to_string(at("typed")).unwrap();
    assert!(typed.contains("-protocol_whitelist file -i file:20260101-12:30.mp4 "), "{typed}");
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
    // the brightness of a checkerboard rises and falls: frames 3, 11, 19, ... are the sharpest of
    // each eight
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

/// Returns how far cameras are from those that they should be after the best similarity: positions
/// as a share of their extent, rotations in degrees.
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
    clicked::folder(name).filter(|_| installed("colmap"))
}

/// Finds the cameras of the first photographs of a capture, and returns how far they are from its
/// own, root mean square, and the capture that was found.
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
    assert!(err(&run).contains("find them with COLMAP: `tiface cameras /"), "{}", err(&run));
    let found = tiface(dir, path.clone(), &["cameras", "bare"]);
    assert!(found.status.success(), "{}", err(&found));
    let again = tiface(dir, path, &["cameras", "bare"]);
    assert!(again.status.success() && err(&again).contains("done: "), "{}", err(&again));
    let capture = capture::open(&dir.join("bare_cameras"), &CaptureOptions::default()).unwrap();
    assert_eq!(capture.views.len(), photographs, "{}", err(&found));
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
fn a_dozen_real_photographs_get_cameras_near_those_that_they_came_with() {
    let dir = tempfile::tempdir().unwrap();
    let Some((position, rotation, capture)) = found_again("fox", 12, false, dir.path()) else { return };
    // few photographs of one side; what more of them give is the claim of the long tests
    assert!(position < 0.03 && rotation < 3.0, "{position} {rotation}");
    assert!(capture.focus.is_some(), "points bound the scene without masks");
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; a minute of COLMAP"]
fn twenty_real_photographs_get_the_cameras_that_they_came_with() {
    let dir = tempfile::tempdir().unwrap();
    let Some((position, rotation, capture)) = found_again("fox", 20, false, dir.path()) else { return };
    assert!(position < 0.006 && rotation < 0.4, "{position} {rotation}");
    // its own focal length is 343.9 pixels
    let focal = capture.views[0].camera.fx;
    assert!((focal / 343.9 - 1.0).abs() < 0.02, "{focal}");
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; four minutes of COLMAP: the table of docs/captures.md"]
fn whole_captures_get_their_cameras_and_smooth_skin_by_weak_features() {
    let rows = [("fox", 50, false, 0.003, 0.2), ("lps", 24, true, 0.01, 1.5), ("lps", 24, false, 0.02, 3.0)];
    for (name, photographs, with_masks, position, rotation) in rows {
        let dir = tempfile::tempdir().unwrap();
        let Some(found) = found_again(name, photographs, with_masks, dir.path()) else { continue };
        assert!(found.0 < position && found.1 < rotation, "{name}: {} {}", found.0, found.1);
    }
}
