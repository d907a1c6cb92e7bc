//! Stop and kill at any moment, repeat the command: the result is the one of an undisturbed run.

use crate::command::command;
use crate::kept::photographed;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tiface::capture::synthetic::SyntheticOptions;
use tiface::pipeline::Stage;

/// How large a run is: photographs and settings.
struct Size {
    photographs: SyntheticOptions,
    settings: &'static str,
}

/// Every stage takes long enough to be hit.
const SMALL: Size = Size {
    photographs: SyntheticOptions { width: 32, height: 40, train: 6, test: 1, seed: 3 },
    settings: "iface.steps=80 iface.rays=128 iface.max_rays=256 iface.samples=2048 iface.levels=6 iface.log2_table=11 \
        iface.occupancy_resolution=16 iface.stereo=0 iface.checkpoint_s=0.05 tface.steps=40 tface.fields=2 \
        tface.rays=256 tface.voxels_start=1728 tface.voxels_final=4096 tface.checkpoint_s=0.05 baseline.steps=20 \
        baseline.rays=256 mesh.resolution=32 mesh.triangles=600 mesh.texture_px=64 mesh.format=glb,obj \
        render.samples=1 render.method=baseline,tface,volume,raycast,textured ensemble.members=tface,volume \
        ensemble.weights=0.8,0.2 device=cpu",
};

/// Kills fall into every part of every stage.
const LARGE: Size = Size {
    photographs: SyntheticOptions { width: 64, height: 80, train: 8, test: 2, seed: 3 },
    settings: "iface.steps=150 iface.rays=256 iface.max_rays=512 iface.samples=4096 iface.levels=6 iface.log2_table=12 \
        iface.occupancy_resolution=32 iface.checkpoint_s=0.1 tface.steps=60 tface.fields=2 tface.rays=512 \
        tface.voxels_start=4096 tface.voxels_final=13824 tface.checkpoint_s=0.1 baseline.steps=30 baseline.rays=256 \
        mesh.resolution=64 mesh.texture_px=256 mesh.format=glb,obj render.samples=1 \
        render.method=baseline,tface,volume,raycast,textured ensemble.members=tface,volume \
        ensemble.weights=0.8,0.2 device=cpu",
};

/// Something that happens in the end, on however busy a machine.
const PATIENCE: Duration = Duration::from_secs(900);

/// A capture of a size, and commands on it.
struct Runs<'a> {
    size: &'a Size,
    folder: tempfile::TempDir,
}

impl Runs<'_> {
    fn of(size: &Size) -> Runs<'_> {
        let folder = tempfile::tempdir().unwrap();
        photographed(&folder.path().join("head"), &size.photographs);
        Runs { size, folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Begins the whole pipeline.
    fn start(&self, run: &str) -> Child {
        self.begin("run", run, &[])
    }

    fn begin(&self, name: &str, run: &str, more: &[&str]) -> Child {
        let mut command = command(self.folder.path(), &[name, "head", "--run", run, "--preset", "draft"]);
        for setting in self.size.settings.split_whitespace().chain(more.iter().copied()) {
            command.args(["--set", setting]);
        }
        command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
    }
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
    for stage in Stage::ALL {
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

/// Waits until this process works on a stage, or has ended.
fn wait_for_stage(run: &Path, stage: Stage, child: &mut Child) {
    let own = format!("\"pid\": {},", child.id());
    let status = run.join(stage).join("status.json");
    let begin = Instant::now();
    while !std::fs::read_to_string(&status).is_ok_and(|text| text.contains(&own)) {
        if child.try_wait().unwrap().is_some() {
            return;
        }
        assert!(begin.elapsed() < PATIENCE, "{stage} never began");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// SIGKILL: nothing is saved, nothing is cleaned up. Returns whether it came before the end, which
/// must be a good one.
fn killed(mut child: Child, what: &str) -> bool {
    let ended = child.try_wait().unwrap();
    child.kill().unwrap();
    let (_, text) = finish(child);
    assert!(ended.is_none_or(|status| status.success()), "{what}: {ended:?} {text}");
    ended.is_none()
}

/// A run that was completed after all has the bytes of the calm one, and the next command has
/// nothing to do.
fn assert_done(runs: &Runs, calm: &Path, name: &str) {
    let run = runs.path(name);
    assert_same(calm, &run);
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    assert!(page.trim_end().ends_with("</html>"));
    // the second field lies where it is looked for
    assert!(calm.join("tface/field_2/checkpoint.safetensors").is_file());
    // done is done: nothing is touched
    let records = || {
        let times = |file: &str| std::fs::metadata(run.join(file)).unwrap().modified().unwrap();
        let stages = Stage::ALL.iter();
        let files =
            stages.flat_map(|stage| ["done.json", "status.json"].map(|file| format!("{stage}/{file}")));
        files.chain(["report.html".into()]).map(|file| times(&file)).collect::<Vec<_>>()
    };
    let before = records();
    let (code, text) = finish(runs.start(name));
    assert_eq!((code, text.matches(": already done").count()), (0, before.len() / 2), "{text}");
    assert!(before == records());
    assert_same(calm, &run);
}

#[test]
fn killed_once_in_every_stage_the_run_ends_with_the_same_bytes() {
    let runs = Runs::of(&SMALL);
    let (code, text) = finish(runs.start("calm"));
    assert_eq!(code, 0, "{text}");
    let run = runs.path("hunted");
    let mut kills = 0;
    for stage in Stage::ALL {
        let mut child = runs.start("hunted");
        wait_for_stage(&run, stage, &mut child);
        kills += u32::from(killed(child, stage.as_str()));
        if stage == Stage::Iface {
            kills += (0..2).map(|_| killed_after_checkpoint(&runs, "hunted")).sum::<u32>();
        }
    }
    eprintln!("killed {kills} times");
    let (code, text) = finish(runs.start("hunted"));
    assert_eq!(code, 0, "{text}");
    assert_done(&runs, &runs.path("calm"), "hunted");
}

/// Kills the command `iface` where it has left something to go on from. Returns 1, or 0 if it ended
/// before.
fn killed_after_checkpoint(runs: &Runs, name: &str) -> u32 {
    let mut child = runs.begin("iface", name, &[]);
    wait_for_stage(&runs.path(name), Stage::Iface, &mut child);
    let checkpoint = runs.path(name).join("iface/checkpoint.safetensors");
    let begin = Instant::now();
    while !checkpoint.is_file() && child.try_wait().unwrap().is_none() {
        assert!(begin.elapsed() < PATIENCE, "no checkpoint comes");
        std::thread::sleep(Duration::from_millis(2));
    }
    u32::from(killed(child, "a checkpoint"))
}

/// Kills a run that takes `whole` until it completes and returns how often; moments follow a fixed
/// sequence from `phase`.
fn hunt(runs: &Runs, name: &str, whole: Duration, phase: u32) -> u32 {
    // spread over the first sixth of a run, and a little later each time, so that it ends on a busy
    // machine too
    for attempt in 0..300u32 {
        let mut child = runs.start(name);
        let place = (f64::from(phase + attempt) * 0.618_034).fract();
        let share = 0.04 + 0.12 * place + 0.008 * f64::from(attempt);
        let until = Instant::now() + whole.mul_f64(share).max(Duration::from_millis(20));
        while Instant::now() < until && child.try_wait().unwrap().is_none() {
            std::thread::sleep(Duration::from_millis(5));
        }
        if !killed(child, &format!("attempt {attempt}")) {
            return attempt;
        }
    }
    panic!("the run never ends")
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; run after run until TIFACE_KILLS, or 20, were killed, at any moment"]
fn killed_again_and_again_the_run_ends_with_the_same_bytes() {
    let runs = Runs::of(&LARGE);
    let begin = Instant::now();
    let (code, text) = finish(runs.start("calm"));
    assert_eq!(code, 0, "{text}");
    let whole = begin.elapsed();
    let wanted = std::env::var("TIFACE_KILLS").map_or(20, |kills| kills.parse().unwrap());
    let (mut count, mut kills) = (0, 0);
    while kills < wanted {
        if count > 0 {
            std::fs::remove_dir_all(runs.path("hunted")).unwrap();
        }
        kills += hunt(&runs, "hunted", whole, kills);
        count += 1;
        assert_done(&runs, &runs.path("calm"), "hunted");
    }
    eprintln!("killed {kills} times in {count} runs of {:.1} s", whole.as_secs_f64());
}

#[test]
fn a_signal_saves_and_names_itself_in_the_exit_code_and_two_processes_do_not_share_a_stage() {
    let runs = Runs::of(&SMALL);
    let run = runs.path("run");
    // so many steps that the process is halted before the last one, however slow the machine is
    let long = ["iface.steps=100000", "iface.samples=512", "iface.rays=32", "iface.max_rays=64"];
    for (signal, expected) in [("TERM", 143), ("INT", 130)] {
        let mut child = runs.begin("iface", "run", &long);
        wait_for_stage(&run, Stage::Iface, &mut child);
        let send = |signal: &str| {
            let sent = Command::new("kill").args([&format!("-{signal}"), &child.id().to_string()]).status();
            assert!(sent.unwrap().success(), "{signal}");
        };
        send("STOP");
        let (second, text) = finish(runs.begin("iface", "run", &long));
        assert_eq!(second, 75, "{text}");
        // it is halted with the signal, and has it when it goes on
        send(signal);
        send("CONT");
        let (code, text) = finish(child);
        assert_eq!(code, expected, "{text}");
        let status = std::fs::read_to_string(run.join("iface/status.json")).unwrap();
        assert!(status.contains("\"state\": \"stopped\""), "{status}");
        assert!(!run.join("iface/done.json").exists());
    }
}

/// Waits until the stage `iface` of this process has done a step.
fn wait_for_training(run: &Path, child: &Child) {
    let own = format!("\"pid\": {},", child.id());
    let begin = Instant::now();
    let learning = |text: &str| text.contains(&own) && !text.contains("\"step\": 0,");
    while !std::fs::read_to_string(run.join("iface/status.json")).is_ok_and(|text| learning(&text)) {
        assert!(begin.elapsed() < PATIENCE, "training never began");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_signal_sent_twice_at_once_saves_what_was_learned() {
    let runs = Runs::of(&SMALL);
    let run = runs.path("run");
    let child = runs.begin("iface", "run", &["iface.steps=100000", "iface.checkpoint_s=3600"]);
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
    let dir = tempfile::tempdir().unwrap();
    let mut child = command(dir.path(), &["demo", "--run", "run"]).stderr(Stdio::piped()).spawn().unwrap();
    let mut said = std::io::BufReader::new(child.stderr.take().unwrap());
    let mut line = String::new();
    std::io::BufRead::read_line(&mut said, &mut line).unwrap();
    assert!(line.contains("rendering"), "{line}");
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    line.clear();
    std::io::BufRead::read_line(&mut said, &mut line).unwrap();
    assert_eq!((line.trim(), child.wait().unwrap().code()), ("stopped: before its end", Some(130)));
}
