//! A whole run on a device, killed on the way and finished on the CPU; on a software driver where
//! nothing better is here.

use crate::command::{code, command, err, worked};
use crate::kept::photographed;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};
use tiface::capture::synthetic::SyntheticOptions;
use tiface::kernel::gpu::Adapter;

/// No more than what a driver in software does in seconds; it compiles the kernels for the most
/// part of them. Weights of a blend are given: fitting them renders more than all else.
const SMALL: &str = "iface.steps=20 iface.rays=32 iface.max_rays=64 iface.samples=256 iface.levels=4 iface.log2_table=10 \
    iface.occupancy_resolution=16 iface.stereo=0 iface.checkpoint_s=0.05 tface.steps=8 tface.rays=64 \
    tface.voxels_start=512 tface.voxels_final=512 mesh.resolution=24 mesh.triangles=300 mesh.texture_px=64 \
    mesh.format=glb mesh.hair=none render.samples=1 render.method=tface,volume,raycast ensemble.weights=0.5,0.5 \
    capture.cameras=given capture.exposure=given capture.glare=given";

/// The program whose locks of devices are in its own folder: other tests use the devices of this
/// machine, too.
fn alone(folder: &Path, words: &[&str]) -> Command {
    let mut command = command(folder, words);
    command.env("TMPDIR", folder);
    command
}

fn words<'a>(device: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let mut words = vec!["run", "capture", "--run", "run", "--device", device];
    SMALL.split_whitespace().for_each(|setting| words.extend(["--set", setting]));
    words.extend_from_slice(more);
    words
}

fn psnr(folder: &Path, method: &str) -> f64 {
    let text = std::fs::read_to_string(folder.join("run/metrics/metrics.json")).unwrap();
    let all: serde_json::Value = serde_json::from_str(&text).unwrap();
    let found = &all[method]["head"]["mean"]["psnr_masked"];
    found.as_f64().unwrap_or_else(|| panic!("no PSNR of {method}: {text}"))
}

#[test]
fn a_run_is_killed_on_the_device_goes_on_there_and_ends_on_the_cpu() {
    if Adapter::all().is_empty() {
        println!("skipped: a run on a device, for no adapter is here (Mesa's lavapipe would do)");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 24, height: 30, train: 6, test: 1, seed: 3 };
    photographed(&dir.path().join("capture"), &options);
    let checkpoint = dir.path().join("run/iface/checkpoint.safetensors");
    let mut child =
        alone(dir.path(), &words("wgpu:0", &[])).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    // killed as soon as there is something to lose
    let patience = Instant::now() + Duration::from_secs(900);
    while !checkpoint.is_file() && child.try_wait().unwrap().is_none() {
        assert!(Instant::now() < patience, "no checkpoint comes");
        std::thread::sleep(Duration::from_millis(20));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let run = |words: &[&str]| -> Output { alone(dir.path(), words).output().unwrap() };
    worked(&run(&words("wgpu:0", &[])));
    let (field, mesh) = (psnr(dir.path(), "volume"), psnr(dir.path(), "raycast"));
    // the same fields, meshed, rendered and judged by the CPU
    let text = worked(&run(&words("cpu", &["--fresh", "mesh"])));
    let (by_cpu, mesh_by_cpu) = (psnr(dir.path(), "volume"), psnr(dir.path(), "raycast"));
    println!("volume {field:.2} dB on the device, {by_cpu:.2} on the CPU; mesh {mesh:.2}, {mesh_by_cpu:.2}");
    assert!((field - by_cpu).abs() < 0.01, "{field} {by_cpu}: {text}");
    assert!((mesh - mesh_by_cpu).abs() < 0.2, "{mesh} {mesh_by_cpu}: {text}");
}

#[test]
fn a_device_that_is_not_here_is_refused_before_anything_is_made() {
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 24, height: 24, train: 4, test: 1, seed: 3 };
    photographed(&dir.path().join("capture"), &options);
    let refused = alone(dir.path(), &words("vulkan:77", &[])).output().unwrap();
    let said = err(&refused);
    assert_eq!(code(&refused), 2, "{said}");
    assert!(said.contains("vulkan:77") && said.contains("doctor") && !dir.path().join("run/tface").exists());
}

#[test]
fn a_dry_run_refuses_a_gpu_with_too_little_memory_as_the_command_would() {
    if Adapter::all().is_empty() {
        println!(
            "skipped: memory of a device in a dry run, for no adapter is here (Mesa's lavapipe would do)"
        );
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 24, height: 30, train: 6, test: 1, seed: 3 };
    photographed(&dir.path().join("capture"), &options);
    let rows = [("0.5", &["--dry-run"][..], 1), ("0.5", &[], 1), ("64", &["--dry-run"], 0)];
    for (memory, more, expected) in rows {
        let words = words("wgpu:0", &[&["--memory", memory][..], more].concat());
        let o = alone(dir.path(), &words).output().unwrap();
        let said = err(&o);
        assert_eq!(code(&o), expected, "{memory} {more:?}: {said}");
        assert!(expected == 0 || said.contains("with `--memory`"), "{said}");
    }
    assert!(!dir.path().join("run/mask").exists());
}

#[test]
fn a_dry_run_refuses_a_gpu_that_cannot_hold_a_radiance_field_with_and_without_masks() {
    if Adapter::all().is_empty() {
        println!("skipped: memory of a radiance field, for no adapter is here (Mesa's lavapipe would do)");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 24, height: 30, train: 6, test: 1, seed: 3 };
    photographed(&dir.path().join("capture"), &options);
    let words = |stage: &'static str, more: &[&'static str]| -> Vec<&'static str> {
        let start = [stage, "capture", "--run", "run", "--set", "tface.rays=64"];
        [&start[..], &["--set", "tface.voxels_start=512", "--set", "tface.voxels_final=512"], more].concat()
    };
    // where 512 MiB are kept for other programs, half a GiB leaves nothing
    let little = |more: &[&'static str]| {
        words("tface", &[&["--device", "wgpu:0", "--memory", "0.5"][..], more].concat())
    };
    let is_refused = |words: &[&str]| {
        let o = alone(dir.path(), words).output().unwrap();
        let said = err(&o);
        assert_eq!(code(&o), 1, "{words:?}: {said}");
        assert!(said.contains("rays of a step") && said.contains("lower tface.voxels_final (512)"), "{said}");
        assert!(said.contains("with `--memory`") && !dir.path().join("run/tface").exists(), "{said}");
    };
    is_refused(&little(&["--dry-run"]));
    is_refused(&little(&[]));
    assert!(!dir.path().join("run/mask").exists());
    worked(&alone(dir.path(), &words("mask", &[])).output().unwrap());
    is_refused(&little(&["--dry-run"]));
    is_refused(&little(&[]));
    let enough = words("tface", &["--device", "wgpu:0", "--memory", "64", "--dry-run"]);
    worked(&alone(dir.path(), &enough).output().unwrap());
}

/// In place of the program: lists a card that passes its self-test and a software driver that does
/// not, and fails to train after its first kernels.
const FAKE: &str = r#"#!/bin/sh
device() {
  printf '{"name":"%s","adapter":"of a test","kind":"%s","driver":"1","card":null,"atomics":"native","memory":8,' "$1" "$2"
  printf '"largest_buffer":8,"shared":8,"in_use":false,"checks":[{"name":"density: rgb","error":1e-6,"allowed":0.002,'
  printf '"passed":true},{"name":"density: optimizer","error":null,"allowed":0.002,"passed":%s}],' "$3"
  printf '"error":null,"seconds":%s}' "$4"
}
case $1 in
  doctor)
    printf '{"version":"0.1.0","devices":[%s,' "$(device vulkan:0 discrete true 2.5)"
    printf '%s],"auto":"of a test"}\n' "$(device vulkan:1 software false 40.5)"
    exit 1 ;;
  iface)
    echo '| 61.6µs | Forward' > "$(sed -n 's/.*file = "\([^"]*\)".*/\1/p' cubecl.toml)"
    exit 1 ;;
esac
"#;

#[test]
fn a_first_look_judges_its_own_device_and_forgets_no_failure() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let fake = dir.path().join("tiface");
    std::fs::write(&fake, FAKE).unwrap();
    std::fs::set_permissions(&fake, std::fs::Permissions::from_mode(0o755)).unwrap();
    std::fs::create_dir(dir.path().join("capture")).unwrap();
    let look = |device: &str, part: &str| {
        let out = dir.path().join(format!("{}-{part}", device.replace(':', "-")));
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/gpu/first_look.sh");
        let mut command = Command::new("bash");
        command.arg(script).args([device, out.to_str().unwrap(), part]).current_dir(dir.path());
        let envs = [("TIFACE", fake.as_path()), ("CAPTURE", Path::new("capture")), ("SHARE", Path::new("1"))];
        let done = command.envs(envs).output().unwrap();
        (done.status.code(), std::fs::read_to_string(out.join("figures.txt")).unwrap())
    };
    for (device, code, line) in [
        ("wgpu", 0, "doctor_warm of vulkan:0: 2.5 s, passed\n"),
        ("vulkan:0", 0, "doctor_cold of vulkan:0: 2.5 s, passed\n"),
        ("vulkan:1", 1, "doctor_warm of vulkan:1: 40.5 s, FAILED\n"),
        ("metal", 1, "doctor_warm of metal: no s, not listed\n"),
    ] {
        let (status, figures) = look(device, "doctor");
        assert_eq!(status, Some(code), "{figures}");
        assert!(figures.contains(line) && figures.contains("WRONG") == (code == 1), "{figures}");
        assert!(
            cfg!(not(target_os = "linux")) || figures.contains("loader: ") && figures.contains("ICD: "),
            "{figures}"
        );
    }
    let (status, figures) = look("vulkan:0", "kernels");
    assert!(
        figures.contains("launches") && figures.contains("WRONG: kernels_24576 did not train"),
        "{figures}"
    );
    assert_eq!(status, Some(1), "{figures}");
}
