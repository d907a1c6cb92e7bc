//! A whole run on a device, killed on the way and finished on the processor; on a software driver where nothing better
//! is here.

use crate::command::{code, command, err, worked};
use crate::kept::photographed;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};
use tiface::capture::synthetic::SyntheticOptions;
use tiface::kernel::gpu::Adapter;

/// No more than what a driver in software does in seconds; it compiles the kernels for the most part of them.
const SMALL: &str = "iface.steps=20 iface.rays=32 iface.max_rays=64 iface.samples=256 iface.levels=4 iface.log2_table=10 \
    iface.occupancy_resolution=16 iface.stereo=0 iface.checkpoint_s=0.05 tface.steps=8 tface.rays=64 \
    tface.voxels_start=512 tface.voxels_final=512 mesh.resolution=24 mesh.triangles=300 mesh.texture_px=64 \
    mesh.format=glb mesh.hair=none render.samples=1 render.method=tface,volume,raycast";

/// The program whose locks of devices are in its own folder: other tests use the devices of this machine, too.
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
fn a_run_is_killed_on_the_device_goes_on_there_and_ends_on_the_processor() {
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
    // the same fields, meshed, rendered and judged by the processor
    let text = worked(&run(&words("cpu", &["--fresh", "mesh"])));
    let (by_cpu, mesh_by_cpu) = (psnr(dir.path(), "volume"), psnr(dir.path(), "raycast"));
    println!(
        "volume {field:.2} dB on the device, {by_cpu:.2} on the processor; mesh {mesh:.2}, {mesh_by_cpu:.2}"
    );
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
