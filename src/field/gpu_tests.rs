//! Tests of trainings on a GPU, with a field's training as a parameter: each field calls them.

use super::checkpoint::TrainingProgress;
use super::testing::{StopAfter, bytes, copied, temporary};
use super::training::{self, Model, StepReport};
use glam::Vec2;
use std::path::Path;
use tiface_base::geom::{Ray, RayResult};
use tiface_base::{Monitor, Quiet, Result};
use tiface_capture::LoadedView;
use tiface_kernels::gpu::testing::{devices, lose_after};
use tiface_kernels::gpu::{Atomics, Device};

/// Returns the error of the colors that a field shows of every third pixel of a view over black,
/// dB.
pub fn psnr(view: &LoadedView, render: impl FnOnce(&[Ray]) -> Vec<RayResult>) -> f64 {
    let width = view.camera.width as usize;
    let pixels: Vec<usize> = (0..view.photo.rgb.len()).step_by(3).collect();
    let center = |p: usize| Vec2::new((p % width) as f32 + 0.5, (p / width) as f32 + 0.5);
    let rays: Vec<Ray> = pixels.iter().map(|&p| view.camera.ray(center(p)).unwrap()).collect();
    let alpha = &view.mask.as_ref().unwrap().values;
    let error = |(&p, seen): (&usize, RayResult)| -> f64 {
        let want = view.photo.rgb[p].map(|c| f64::from(alpha[p]) / 255.0 * f64::from(c) / 255.0);
        (0..3).map(|c| (f64::from(seen.color[c]) - want[c]).powi(2)).sum()
    };
    let all: f64 = pixels.iter().zip(render(&rays)).map(error).sum();
    -10.0 * (all / (3 * pixels.len()) as f64).log10()
}

/// A function that trains in a folder on a device.
pub type RunOn<'a, T> = &'a dyn Fn(&Path, &str, &dyn Monitor) -> Result<T>;

/// Result of a training.
#[derive(Clone, Copy, Debug)]
pub struct Outcome {
    /// Error of the colors of a view, dB.
    pub db: f64,
    /// Share of the cells that are marched through.
    pub share: f64,
}

/// Asserts that trainings come to the same, within `near` dB and a share of the cells, and returns
/// what the first one comes to.
pub fn alike(ways: &[Outcome], near: [f64; 2]) -> Outcome {
    println!("{ways:.3?}");
    let first = ways[0];
    for way in ways {
        let apart = [way.db - first.db, way.share - first.share].map(f64::abs);
        assert!(apart[0] < near[0] && apart[1] < near[1], "{apart:?} apart, {near:?} allowed");
    }
    first
}

/// Trains for so many steps, after which a stop is asked for.
fn stops<T>(run: RunOn<T>, dir: &Path, device: &str, steps: u64) {
    let stopped = run(dir, device, &StopAfter::new(steps)).err().unwrap();
    assert!(stopped.to_string().contains("saved at step"), "{stopped}");
}

/// Trains for so many steps on the CPU, and from there in two ways: on the CPU to the end; and in
/// parts, each on a device for so many steps, before the CPU goes on to the end.
pub fn alone_and_in_turn<T>(run: RunOn<T>, first: u64, parts: &[(&str, u64)]) -> [T; 2] {
    let alone = temporary();
    stops(run, alone.path(), "cpu", first);
    let moved = copied(alone.path());
    parts.iter().for_each(|&(device, steps)| stops(run, moved.path(), device, steps));
    [alone, moved].map(|dir| run(dir.path(), "cpu", &Quiet).unwrap())
}

/// Trains in two ways: on the CPU; and on the device for so many steps, on the CPU for so many, and
/// on the device to the end.
pub fn cpu_and_both<T>(run: RunOn<T>, [on_device, on_cpu]: [u64; 2]) -> [T; 2] {
    let alone = run(temporary().path(), "cpu", &Quiet).unwrap();
    let both = temporary();
    stops(run, both.path(), "wgpu:0", on_device);
    stops(run, both.path(), "cpu", on_cpu);
    [alone, run(both.path(), "wgpu:0", &Quiet).unwrap()]
}

/// Asserts that a training is not harmed when its device fails after any of these numbers of
/// readbacks: the checkpoint that lies in `begun` stays as it is, and the training goes on from
/// there to the bytes of one whose device was not lost.
pub fn outlives_lost_devices<T>(run: RunOn<T>, begun: &Path, answers: &[usize]) {
    // sums in fixed point, which come to the same bytes twice
    let run = |dir: &Path| run(dir, "wgpu:0+deterministic", &Quiet);
    let undisturbed = copied(begun);
    run(undisturbed.path()).unwrap();
    let before = bytes(begun);
    for &answers in answers {
        lose_after(answers);
        let lost = run(begun);
        lose_after(usize::MAX);
        let e = lost.err().unwrap_or_else(|| panic!("a training reads no more than {answers} times"));
        assert!(e.to_string().contains("failed: device lost") && e.hint().contains("repeat"), "{e}");
        assert_eq!(e.kind() as i32, 75);
        assert!(bytes(begun) == before, "the last checkpoint is touched after {answers}");
    }
    run(begun).unwrap();
    assert!(bytes(begun) == bytes(undisturbed.path()));
}

/// A step on a device, with the number of launches and of readbacks that it made.
pub struct CountedStep {
    pub report: Option<StepReport>,
    pub launches: usize,
    pub readbacks: usize,
}

/// Makes a step of a model, and reads its losses if `read`.
pub fn counted_step<M: Model>(
    model: &mut M,
    device: impl Fn(&M) -> &Device,
    seed: u64,
    step: u64,
    read: bool,
) -> CountedStep {
    let before = device(model).counts();
    let progress = TrainingProgress { step, ..TrainingProgress::default() };
    let report = training::step(model, seed, &progress, read).ok().expect("a finite step");
    let after = device(model).counts();
    CountedStep { report, launches: after.0 - before.0, readbacks: after.1 - before.1 }
}

/// Asserts that steps whose sums are in fixed point give the same values twice; skipped without a
/// GPU.
pub fn fixed_sums_repeat<T: PartialEq>(trained: impl Fn(Device) -> T) {
    let fixed = || devices().pop().inspect(|device| assert_eq!(device.atomics(), Atomics::Fixed));
    let (Some(a), Some(b)) = (fixed(), fixed()) else { return };
    assert!(trained(a) == trained(b), "the same steps give the same values");
}
