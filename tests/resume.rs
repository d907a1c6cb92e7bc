//! Stop and kill at any moment, repeat the command: the result is the one of an undisturbed run.
#![cfg(unix)]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use tiface::capture::synthetic::{SyntheticOptions, write_capture};

/// Small enough for seconds, large enough that every stage can be hit.
const SETTINGS: [&str; 24] = [
    "iface.steps=150",
    "iface.rays=256",
    "iface.max_rays=512",
    "iface.samples=4096",
    "iface.levels=6",
    "iface.log2_table=12",
    "iface.occupancy_resolution=32",
    "iface.checkpoint_s=0.1",
    "tface.steps=60",
    "tface.fields=2",
    "tface.rays=512",
    "tface.voxels_start=4096",
    "tface.voxels_final=13824",
    "tface.checkpoint_s=0.1",
    "baseline.steps=30",
    "baseline.rays=256",
    "mesh.resolution=64",
    "mesh.texture_px=256",
    "mesh.format=glb,obj",
    "render.samples=1",
    "render.method=baseline,tface,volume,raycast,textured",
    "ensemble.members=tface,volume",
    "ensemble.weights=0.8,0.2",
    "device=cpu",
];

/// One test at a time: what one takes from the other's processors would look like slowness.
static ALONE: Mutex<()> = Mutex::new(());

fn capture(folder: &Path) -> PathBuf {
    let path = folder.join("head");
    let options = SyntheticOptions { width: 64, height: 80, train: 8, test: 2, seed: 3 };
    write_capture(&path, &options).unwrap();
    path
}

fn start(capture: &Path, run: &Path) -> Child {
    command_on("run", capture, run, &[])
}

fn command_on(name: &str, capture: &Path, run: &Path, more: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tiface"));
    command.arg(name).arg(capture).arg("--run").arg(run).args(["--preset", "draft"]);
    for setting in SETTINGS.iter().chain(more) {
        command.args(["--set", setting]);
    }
    command.env("XDG_CONFIG_HOME", run).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

fn finish(child: Child) -> (i32, String) {
    let output = child.wait_with_output().unwrap();
    (output.status.code().unwrap_or(-1), String::from_utf8_lossy(&output.stderr).into_owned())
}

/// The stages' own files with their bytes; what tells when things happened is left out.
fn products(run: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    fn walk(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() { walk(&path, found) } else { found.push(path) }
        }
    }
    let mut files = Vec::new();
    for stage in tiface::pipeline::Stage::ALL {
        walk(&run.join(stage), &mut files);
    }
    files.push(run.join("config.toml"));
    files.push(run.join("cameras.json"));
    let timed = ["done.json", "status.json", "log.jsonl", ".lock"];
    files.retain(|f| !timed.contains(&f.file_name().unwrap().to_str().unwrap()));
    files.sort();
    files.into_iter().map(|f| (f.strip_prefix(run).unwrap().into(), std::fs::read(&f).unwrap())).collect()
}

fn assert_same(a: &Path, b: &Path) {
    let (a, b) = (products(a), products(b));
    let names = |p: &[(PathBuf, Vec<u8>)]| p.iter().map(|(n, _)| n.clone()).collect::<Vec<_>>();
    assert_eq!(names(&a), names(&b));
    for ((name, ours), (_, theirs)) in a.iter().zip(&b) {
        assert!(ours == theirs, "{} differs", name.display());
    }
}

/// Kills a run that takes `whole` until it completes and returns how often; moments follow a fixed sequence from `phase`.
fn hunt(capture: &Path, run: &Path, whole: Duration, phase: u32) -> u32 {
    // spread over the first sixth of a run, and a little later each time, so that it ends on a busy machine too
    for attempt in 0..300u32 {
        let mut child = start(capture, run);
        let place = (f64::from(phase + attempt) * 0.618_034).fract();
        let share = 0.04 + 0.12 * place + 0.008 * f64::from(attempt);
        let until = Instant::now() + whole.mul_f64(share).max(Duration::from_millis(20));
        let ended = loop {
            if let Some(status) = child.try_wait().unwrap() {
                break Some(status);
            }
            if Instant::now() >= until {
                child.kill().unwrap(); // SIGKILL: nothing is saved, nothing is cleaned up
                break None;
            }
            std::thread::sleep(Duration::from_millis(5));
        };
        let (_, text) = finish(child);
        match ended {
            None => {}
            Some(status) if status.success() => return attempt,
            Some(status) => panic!("attempt {attempt} ended with {status}: {text}"),
        }
    }
    panic!("the run never ends")
}

#[test]
fn killed_again_and_again_the_run_ends_with_the_same_bytes() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = tempfile::tempdir().unwrap();
    let capture = capture(dir.path());
    let (calm, hunted) = (dir.path().join("calm"), dir.path().join("hunted"));
    let begin = Instant::now();
    let (code, text) = finish(start(&capture, &calm));
    assert_eq!(code, 0, "{text}");
    let whole = begin.elapsed();

    // run after run, until enough were killed
    let wanted = std::env::var("TIFACE_KILLS").map_or(20, |kills| kills.parse().unwrap());
    let (mut runs, mut killed) = (0, 0);
    while killed < wanted {
        if hunted.exists() {
            std::fs::remove_dir_all(&hunted).unwrap();
        }
        killed += hunt(&capture, &hunted, whole, killed);
        runs += 1;
        assert_same(&calm, &hunted);
        let page = std::fs::read_to_string(hunted.join("report.html")).unwrap();
        assert!(page.trim_end().ends_with("</html>"));
    }
    eprintln!("killed {killed} times in {runs} runs of {:.1} s", whole.as_secs_f64());

    // the second field lies where it is looked for
    assert!(calm.join("tface/field_2/checkpoint.safetensors").is_file());

    // done is done: nothing is touched
    let records = || {
        let times = |file: &str| std::fs::metadata(hunted.join(file)).unwrap().modified().unwrap();
        let stages = tiface::pipeline::Stage::ALL.iter();
        let files =
            stages.flat_map(|stage| ["done.json", "status.json"].map(|file| format!("{stage}/{file}")));
        files.chain(["report.html".into()]).map(|file| times(&file)).collect::<Vec<_>>()
    };
    let before = records();
    let (code, text) = finish(start(&capture, &hunted));
    assert_eq!((code, text.matches(": already done").count()), (0, before.len() / 2), "{text}");
    assert!(before == records());
    assert_same(&calm, &hunted);
}

#[test]
fn a_signal_saves_and_names_itself_in_the_exit_code_and_two_processes_do_not_share_a_stage() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = tempfile::tempdir().unwrap();
    let capture = capture(dir.path());
    let run = dir.path().join("run");
    for (signal, expected) in [("TERM", 143), ("INT", 130)] {
        let child = start(&capture, &run);
        // wait until training is under way, by this process
        let status = run.join("iface/status.json");
        let own = format!("\"pid\": {},", child.id());
        let begin = Instant::now();
        while !std::fs::read_to_string(&status).is_ok_and(|text| text.contains(&own)) {
            assert!(begin.elapsed() < Duration::from_secs(120), "training never began");
            std::thread::sleep(Duration::from_millis(5));
        }
        let (second, text) = finish(start(&capture, &run));
        assert_eq!(second, 75, "{text}");
        let pid = child.id().to_string();
        Command::new("kill").args([&format!("-{signal}"), &pid]).status().unwrap();
        let (code, text) = finish(child);
        assert_eq!(code, expected, "{text}");
        let status = std::fs::read_to_string(&status).unwrap();
        assert!(status.contains("\"state\": \"stopped\""), "{status}");
        assert!(!run.join("metrics/done.json").exists());
    }
    assert_eq!(finish(start(&capture, &run)).0, 0);
    assert!(run.join("metrics/done.json").is_file());
}

/// Waits until the stage `iface` of this process has done a step.
fn wait_for_training(run: &Path, child: &Child) {
    let own = format!("\"pid\": {},", child.id());
    let begin = Instant::now();
    let learning = |text: &str| text.contains(&own) && !text.contains("\"step\": 0,");
    while !std::fs::read_to_string(run.join("iface/status.json")).is_ok_and(|text| learning(&text)) {
        assert!(begin.elapsed() < Duration::from_secs(120), "training never began");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_signal_sent_twice_at_once_saves_what_was_learned() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = tempfile::tempdir().unwrap();
    let capture = capture(dir.path());
    let run = dir.path().join("run");
    let child = command_on("iface", &capture, &run, &["iface.steps=100000", "iface.checkpoint_s=3600"]);
    wait_for_training(&run, &child);
    // as GNU `timeout` does: to the process, and to its group
    let twice = format!("kill -TERM {0}; kill -TERM {0}", child.id());
    Command::new("sh").args(["-c", &twice]).status().unwrap();
    let (code, text) = finish(child);
    assert_eq!(code, 143, "{text}");
    assert!(text.contains("stopped: stage `iface`: saved at step ") && !text.contains("error"), "{text}");
    let status = std::fs::read_to_string(run.join("iface/status.json")).unwrap();
    assert!(status.contains("\"state\": \"stopped\""), "{status}");
}

#[test]
fn a_signal_is_heard_where_nothing_can_be_saved() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = tempfile::tempdir().unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_tiface"))
        .args(["demo", "--run"])
        .arg(dir.path().join("run"))
        .env("XDG_CONFIG_HOME", dir.path())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = std::io::BufReader::new(child.stderr.take().unwrap());
    let mut line = String::new();
    std::io::BufRead::read_line(&mut said, &mut line).unwrap();
    assert!(line.contains("rendering"), "{line}");
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    line.clear();
    std::io::BufRead::read_line(&mut said, &mut line).unwrap();
    assert_eq!((line.trim(), child.wait().unwrap().code()), ("stopped: before its end", Some(130)));
}
