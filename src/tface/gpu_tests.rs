use super::super::cpu::CpuVm;
use super::super::train::{VmModel, train_one};
use super::*;
use crate::Monitor;
use crate::Quiet;
use crate::config::Preset;
use crate::config::{MaskLoss, VmBackground};
use crate::field;
use crate::field::ball::{self, StopAfter, hull, session, temporary};
use crate::field::checkpoint::TrainingProgress;
use crate::field::ops::ArrayDevice;
use crate::field::pixels::TrainView;
use crate::field::training::{self, Model, StepReport, TrainingSession};
use crate::kernel::gpu::tests::{device, lose_after};
use crate::tface::{FieldMean, TFace};
use glam::Vec2;
use std::path::Path;

const BOUNDS: [[f32; 3]; 2] = [[-0.8; 3], [0.8; 3]];

fn config() -> VmConfig {
    VmConfig {
        steps: 100,
        rays: 128,
        voxels_start: 16 * 16 * 16,
        voxels_final: 24 * 24 * 24,
        upsample_at: vec![0.3, 0.6],
        mask_at: vec![0.3, 0.7],
        density_rank: vec![8, 8, 8],
        color_rank: vec![8, 4, 9],
        hidden: 32,
        ..VmConfig::preset(Preset::Draft)
    }
}

fn pixels<'a>(views: &'a [TrainView], config: &VmConfig) -> Pixels<'a> {
    Pixels::new(views, 0.25, 1.0, config.foreground, config.whole_frame)
}

fn start(config: &VmConfig) -> VmState {
    VmState::new(config, 3, BOUNDS, Some(&hull()))
}

/// A training before its first step.
fn begun<'a, O: VmOps>(ops: O, config: &'a VmConfig, session: &TrainingSession<'a>) -> VmModel<'a, O> {
    let mut model = VmModel::new(ops, start(config), config, session);
    model.restore(None).ok().unwrap();
    model
}

/// Operations on a device whose memory holds the photographs, if the device can draw from them.
fn on_gpu<'a>(config: &'a VmConfig, pixels: &'a Pixels<'a>, device: Device) -> GpuVm<'a> {
    let resident = GpuVm::fits("tface", config, pixels, &start(config), &device).unwrap();
    GpuVm::new(config, pixels, device, resident)
}

#[test]
fn losses_follow_those_of_the_cpu_and_nobody_waits() {
    let Some(device) = device() else { return };
    let (dir, views) = (temporary(), ball::views());
    // after a grid has grown, Adam's first steps go by the sign of what is zero but for rounding: that is another story
    let config = VmConfig { steps: 200, upsample_at: vec![], mask_at: vec![], ..config() };
    let pixels = pixels(&views, &config);
    let session = session("tface", dir.path(), "ball", &Quiet);
    let mut on_cpu = begun(CpuVm::new(&config, &pixels), &config, &session);
    let mut on_gpu = begun(on_gpu(&config, &pixels, device), &config, &session);
    let mut want = 0f64;
    for step in 0..config.steps {
        let progress = TrainingProgress { step, ..TrainingProgress::default() };
        let rgb = |report: Option<StepReport>| report.map(|report| report.figures[0].1);
        let on_cpu = training::step(&mut on_cpu, session.seed, &progress, true).ok().unwrap();
        want += rgb(on_cpu).unwrap() / Device::READ_EVERY as f64;
        let before = on_gpu.ops.device.counts();
        let read = (step + 1).is_multiple_of(Device::READ_EVERY);
        let got = rgb(training::step(&mut on_gpu, session.seed, &progress, read).ok().unwrap());
        let after = on_gpu.ops.device.counts();
        let (launches, readbacks) = (after.0 - before.0, after.1 - before.1);
        assert!(launches <= 40, "{launches} launches");
        if let Some(got) = got {
            println!("{launches} launches, {readbacks} readbacks; rgb {got:.6} {want:.6}");
            assert!((got - want).abs() < 0.01 * want, "{got} {want} at step {step}");
            want = 0.0;
        } else {
            assert_eq!(readbacks, 0, "a step reads nothing back");
        }
    }
}

/// PSNR of two photographs; a device sees the same.
fn psnr(views: &[TrainView], dir: &Path) -> f64 {
    let face = TFace::load("tface", dir).unwrap();
    let on_gpu =
        FieldMean::load("tface", dir, 1)
            .unwrap()
            .on(field::compute_device("wgpu:0", &crate::tface::VM_TEST).unwrap());
    let mut sum = 0f64;
    for view in &views[..2] {
        let rays: Vec<_> = (0..1600)
            .map(|p| view.camera.ray(Vec2::new((p % 40) as f32 + 0.5, (p / 40) as f32 + 0.5)).unwrap())
            .collect();
        let mask = &view.mask.as_ref().unwrap().values;
        let forward = view.camera.forward();
        for (p, (seen, on_gpu)) in
            face.render(&rays, forward).iter().zip(on_gpu.render(&rays, forward)).enumerate()
        {
            let close = |a: f32, b: f32| (a - b).abs() < 1e-4;
            assert!((0..3).all(|c| close(seen.color[c], on_gpu.color[c])), "{seen:?} {on_gpu:?}");
            assert!(close(seen.opacity, on_gpu.opacity) && close(seen.depth, on_gpu.depth));
            let a = mask[p] as f64 / 255.0;
            let want = view.photo.rgb[p].map(|c| a * c as f64 / 255.0);
            sum += (0..3).map(|c| (seen.color[c] as f64 - want[c]).powi(2)).sum::<f64>();
        }
    }
    -10.0 * (sum / (2.0 * 1600.0 * 3.0)).log10()
}

#[test]
fn a_checkpoint_goes_from_the_cpu_to_a_device_and_back() {
    if device().is_none() {
        return;
    }
    let (views, config) = (ball::views(), config());
    let pixels = pixels(&views, &config);
    // where parts of a training are made, and how many steps each
    let train = |parts: &[(bool, u64)]| {
        let dir = temporary();
        for &(on_device, steps) in parts {
            let stop = StopAfter::new(steps);
            let session = session("tface", dir.path(), "ball", &stop as &dyn Monitor);
            let session = TrainingSession { device: if on_device { "wgpu:0" } else { "cpu" }, ..session };
            let done = train_one(&pixels, BOUNDS, Some(&hull()), &config, &session);
            assert!(done.is_ok() || steps < config.steps);
        }
        psnr(&views, dir.path())
    };
    let whole = train(&[(false, 1000)]);
    for parts in [&[(false, 40), (true, 40), (false, 1000)][..], &[(true, 1000)]] {
        let other = train(parts);
        println!("{parts:?}: {other:.2} dB, on the CPU {whole:.2} dB");
        assert!((other - whole).abs() < 0.2, "{parts:?}: {other} {whole}");
    }
}

#[test]
fn what_steps_before_a_finer_grid_came_to_is_counted() {
    if device().is_none() {
        return;
    }
    let (views, config) = (ball::views(), config());
    let pixels = pixels(&views, &config);
    // grids grow at steps between two reads
    let upsampled = (0..config.steps).filter(|&step| config.due(&config.upsample_at, step).is_some());
    assert!(
        upsampled.clone().count() == 2
            && upsampled.into_iter().all(|s| !(s + 1).is_multiple_of(Device::READ_EVERY))
    );
    let [on_cpu, on_gpu] = ["cpu", "wgpu:0"].map(|device| {
        let dir = temporary();
        let session = TrainingSession { device, ..session("tface", dir.path(), "ball", &Quiet) };
        train_one(&pixels, BOUNDS, Some(&hull()), &config, &session).unwrap()
    });
    assert_eq!(
        (on_gpu.rays, on_gpu.rays),
        (on_cpu.rays, (0..config.steps).map(|s| config.rays_at(s) as u64).sum())
    );
    assert!(
        (on_gpu.train_psnr - on_cpu.train_psnr).abs() < 0.5,
        "{} {}",
        on_gpu.train_psnr,
        on_cpu.train_psnr
    );
}

#[test]
fn a_training_reserves_the_memory_that_was_planned() {
    if device().is_some() {
        crate::kernel::gpu::tests::alone("tface::gpu::tests::memory_of_a_training");
    }
}

#[test]
#[ignore = "run by the test above, in a process of its own"]
fn memory_of_a_training() {
    let (dir, views) = (temporary(), ball::views());
    let config = VmConfig {
        rays: 4096,
        voxels_start: 40 * 40 * 40,
        voxels_final: 40 * 40 * 40,
        upsample_at: vec![],
        mask_at: vec![],
        ..config()
    };
    let pixels = pixels(&views, &config);
    let with = |mib: u64| device().unwrap().with_memory((512 + mib) << 20);
    let fits =
        |mib: &u64| GpuVm::fits("tface", &config, &pixels, &start(&config), &with(*mib)).is_ok_and(|r| r);
    let planned = (8..4096).step_by(4).find(fits).unwrap();
    let session = session("tface", dir.path(), "ball", &Quiet);
    let before = with(planned).reserved_memory();
    let mut model = begun(on_gpu(&config, &pixels, with(planned)), &config, &session);
    for step in 0..2 {
        let progress = TrainingProgress { step, ..TrainingProgress::default() };
        training::step(&mut model, session.seed, &progress, true).ok().unwrap();
    }
    let share = (model.ops.device.reserved_memory() - before) as f64 / (planned << 20) as f64;
    println!("{share:.3} of {planned} MiB are reserved");
    assert!((0.9..=1.05).contains(&share), "{share}");
}

#[test]
fn rays_that_the_host_draws_in_order_give_the_losses_of_the_cpu() {
    let Some(device) = device() else { return };
    let (dir, views) = (temporary(), ball::views());
    let config = VmConfig {
        whole_frame: true,
        mask_loss: MaskLoss::Ce,
        background: VmBackground::Reference,
        ..config()
    };
    let pixels = Pixels::permuted(&views, config.foreground, BOUNDS, true);
    let session = session("tface", dir.path(), "ball", &Quiet);
    let mut on_cpu = begun(CpuVm::new(&config, &pixels), &config, &session);
    let mut on_gpu = begun(on_gpu(&config, &pixels, device), &config, &session);
    for step in 0..6 {
        let progress = TrainingProgress { step, ..TrainingProgress::default() };
        let want = training::step(&mut on_cpu, session.seed, &progress, true).ok().flatten().unwrap().figures;
        let before = on_gpu.ops.device.counts();
        training::step(&mut on_gpu, session.seed, &progress, false).ok().unwrap();
        let after = on_gpu.ops.device.counts();
        // The host's draws are uploaded, and the step does not wait for the device.
        assert!(after.0 - before.0 <= 40 && after.1 == before.1);
        let got = on_gpu.report(step).ok().unwrap().figures;
        for ((name, got), (_, want)) in got.iter().zip(&want).take(2) {
            assert!((got - want).abs() < 1e-3 * want, "{name} at step {step}: {got} {want}");
        }
    }
    // rays, their lattice points and colors are counted as on the CPU
    let (counts, want) = (on_gpu.counts, on_cpu.counts);
    assert_eq!((counts.rays, counts.lattice), (want.rays, want.lattice));
    assert!(counts.color.abs_diff(want.color) < 10 && counts.density >= want.density);
}

#[test]
fn a_device_that_is_lost_leaves_the_last_checkpoint_and_the_training_goes_on() {
    if device().is_none() {
        return;
    }
    let (views, config, dir) = (ball::views(), config(), temporary());
    let pixels = pixels(&views, &config);
    let train = |answers: usize, steps: u64| {
        let stop = StopAfter::new(steps);
        let session = session("tface", dir.path(), "ball", &stop as &dyn Monitor);
        let session = TrainingSession { device: "wgpu:0", ..session };
        lose_after(answers);
        let done = train_one(&pixels, BOUNDS, Some(&hull()), &config, &session);
        lose_after(usize::MAX);
        done
    };
    assert!(train(usize::MAX, 25).err().unwrap().kind().is_stop());
    let file = dir.path().join("checkpoint.safetensors");
    let before = std::fs::read(&file).unwrap();
    // where the grids grow at step 30, at the losses of step 50, and while the end is saved
    for answers in [2, 10, 33] {
        let e = train(answers, 1000).err().unwrap();
        assert!(e.to_string().contains("failed: device lost") && e.kind() as i32 == 75, "{e}");
        assert!(std::fs::read(&file).unwrap() == before, "the last checkpoint is touched after {answers}");
    }
    assert!(train(usize::MAX, 1000).is_ok());
    // alone it comes to 19.27 dB
    let got = psnr(&views, dir.path());
    println!("{got:.2} dB after a device was lost");
    assert!((got - 19.27).abs() < 0.2, "{got}");
}

#[test]
fn a_device_with_too_little_memory_is_refused_before_the_first_step_and_told_what_fits() {
    let Some(device) = device() else { return };
    let views = ball::views();
    let refused = |config: &VmConfig, mib: u64| {
        let pixels = pixels(&views, config);
        let device = self::device().unwrap().with_memory(mib << 20);
        GpuVm::fits("tface", config, &pixels, &start(config), &device)
    };
    assert!(refused(&config(), 1024).unwrap(), "photographs lie there");
    let e = refused(&config(), 512).err().unwrap();
    assert!(e.to_string().contains("has memory for 0 rays") && e.hint().contains("voxels_final"), "{e:?}");
    // The reported number of rays fits, and one more does not.
    let many = VmConfig { rays: 1_000_000, ..config() };
    let e = refused(&many, 2048).err().unwrap();
    let most = e.hint().split(' ').find_map(|w| w.trim_end_matches(',').parse::<usize>().ok()).unwrap();
    assert!(e.hint().starts_with("lower tface.rays to") && most > 1000, "{e:?}");
    assert!(refused(&VmConfig { rays: most, ..config() }, 2048).is_ok());
    assert!(refused(&VmConfig { rays: most + 1, ..config() }, 2048).is_err());
    // what is counted is what is made, but for what is a matter of kilobytes
    let field = start(&config()).field(&config(), true);
    let [fixed, ray] = Vm::bytes(&device, &field, config().rays);
    println!("{} KiB of grids and gradients, {ray} bytes a ray", fixed >> 10);
    // ‖(16, 16, 16)‖ = 27.7: 27 samples, of which the last is none, of 17 words each, and 34 words of the ray
    assert_eq!((ray, Vm::widest(&field)), (4 * (26 * 17 + 34), 12 * 26));
}
