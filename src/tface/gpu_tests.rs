use super::super::cpu::CpuVm;
use super::super::state::VmState;
use super::super::train::{VmModel, train_one};
use super::*;
use crate::config::{MaskLoss, Preset, VmBackground};
use crate::field;
use crate::field::ball::{self, hull};
use crate::field::checkpoint::TrainingProgress;
use crate::field::gpu_tests::{
    CountedStep, Outcome, alike, counted_step, cpu_and_both, outlives_lost_devices, psnr,
};
use crate::field::ops::ArrayDevice;
use crate::field::testing::{StopAfter, session, temporary};
use crate::field::training::{self, Model, StepReport, TrainingSession};
use crate::tface::{FieldMean, TFace};
use std::path::Path;
use tiface_base::{Monitor, Quiet};
use tiface_capture::LoadedView;
use tiface_kernels::gpu::testing::device;

const BOUNDS: [[f32; 3]; 2] = [[-0.8; 3], [0.8; 3]];

/// As small as a driver in software needs it, for which a step takes as long as it has samples.
/// Color ranks and decoder are those of the preset, for which the kernels are compiled anyway; the
/// density's channels are padded on a device.
fn config() -> VmConfig {
    VmConfig {
        steps: 40,
        rays: 64,
        voxels_start: 16 * 16 * 16,
        voxels_final: 24 * 24 * 24,
        upsample_at: vec![0.2, 0.4],
        mask_at: vec![0.2, 0.5],
        density_rank: vec![8, 7, 5],
        ..VmConfig::preset(Preset::Draft)
    }
}

fn sampler<'a>(views: &'a [LoadedView], config: &VmConfig) -> RaySampler<'a> {
    RaySampler::new(views, 0.25, 1.0, config.foreground, config.whole_frame)
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
fn on_gpu<'a>(config: &'a VmConfig, sampler: &'a RaySampler<'a>, device: Device) -> GpuVm<'a> {
    let resident = GpuVm::fits("tface", config, sampler, BOUNDS, &device).unwrap();
    GpuVm::new(config, sampler, device, resident)
}

fn step_on_gpu(model: &mut VmModel<GpuVm>, step: u64, read: bool) -> CountedStep {
    counted_step(model, |model| &model.ops.device, 3, step, read)
}

fn step_on_cpu(model: &mut VmModel<CpuVm>, step: u64) -> StepReport {
    let progress = TrainingProgress { step, ..TrainingProgress::default() };
    training::step(model, 3, &progress, true).ok().flatten().unwrap()
}

/// Compares the color loss of steps that go on from the start on the CPU and on the device, which
/// is read after every `every`.
fn losses_follow_those_of_the_cpu(config: &VmConfig, steps: u64, every: u64) {
    let Some(device) = device() else { return };
    let (dir, views) = (temporary(), ball::views());
    // after a grid has grown, Adam's first steps go by the sign of what is zero but for rounding:
    // that is another story
    let config = &VmConfig { steps: 200, upsample_at: vec![], mask_at: vec![], ..config.clone() };
    let sampler = sampler(&views, config);
    let session = session("tface", dir.path(), "ball", &Quiet);
    let mut on_cpu = begun(CpuVm::new(config, &sampler), config, &session);
    let mut on_gpu = begun(on_gpu(config, &sampler, device), config, &session);
    let mut want = 0f64;
    for step in 0..steps {
        let rgb = |report: StepReport| report.figures[0].1;
        want += rgb(step_on_cpu(&mut on_cpu, step)) / every as f64;
        let read = (step + 1).is_multiple_of(every);
        let CountedStep { report, launches, readbacks } = step_on_gpu(&mut on_gpu, step, read);
        assert!(launches <= 40, "{launches} launches");
        if let Some(got) = report.map(rgb) {
            println!("{launches} launches, {readbacks} readbacks; rgb {got:.6} {want:.6}");
            assert!((got - want).abs() < 0.01 * want, "{got} {want} at step {step}");
            want = 0.0;
        } else {
            assert_eq!(readbacks, 0, "a step reads nothing back");
        }
    }
}

#[test]
fn losses_are_those_of_the_cpu_and_nobody_waits() {
    losses_follow_those_of_the_cpu(&config(), 10, 5);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; over two hundred steps rounding adds up"]
fn losses_stay_those_of_the_cpu() {
    losses_follow_those_of_the_cpu(&VmConfig { rays: 128, ..config() }, 200, Device::READ_EVERY);
}

/// A device sees in a field what the CPU does.
fn a_device_sees_the_same(view: &LoadedView, dir: &Path) {
    let face = TFace::load("tface", dir).unwrap();
    let device = field::compute_device("wgpu:0", &crate::tface::VM_TEST).unwrap();
    let on_gpu = FieldMean::load("tface", dir, 1).unwrap().on(device);
    let forward = view.camera.forward();
    psnr(view, |rays| {
        let seen = face.render(rays, forward);
        for (seen, on_gpu) in seen.iter().zip(on_gpu.render(rays, forward)) {
            let close = |a: f32, b: f32| (a - b).abs() < 1e-4;
            assert!((0..3).all(|c| close(seen.color[c], on_gpu.color[c])), "{seen:?} {on_gpu:?}");
            assert!(close(seen.opacity, on_gpu.opacity) && close(seen.depth, on_gpu.depth));
        }
        seen
    });
}

/// Compares a training on the device, with some steps on the CPU in between, with one on the CPU
/// alone: what is seen, and the rays of all steps.
fn trainings_follow_the_cpu(config: &VmConfig, in_turn: [u64; 2]) {
    if device().is_none() {
        return;
    }
    let views = ball::views();
    let sampler = sampler(&views, config);
    // grids grow at steps between two reads
    let upsampled = (0..config.steps).filter(|&step| config.due(&config.upsample_at, step).is_some());
    assert!(
        upsampled.clone().count() == 2
            && upsampled.into_iter().all(|s| !(s + 1).is_multiple_of(Device::READ_EVERY))
    );
    let run = |dir: &Path, device: &str, monitor: &dyn Monitor| {
        let session = TrainingSession { device, ..session("tface", dir, "ball", monitor) };
        let report = train_one(&sampler, BOUNDS, Some(&hull()), config, &session)?;
        if device != "cpu" {
            a_device_sees_the_same(&views[0], dir);
        }
        let face = TFace::load("tface", dir)?;
        let all = views[..2].iter().map(|view| psnr(view, |rays| face.render(rays, view.camera.forward())));
        Ok((Outcome { db: all.sum::<f64>() / 2.0, share: report.occupied }, report))
    };
    let [(cpu, on_cpu), (both, on_both)] = cpu_and_both(&run, in_turn);
    alike(&[cpu, both], [0.2, 0.05]);
    // what steps before a finer grid, and before a stop, came to is counted
    let rays = (0..config.steps).map(|s| config.rays_at(s) as u64).sum::<u64>();
    assert_eq!((on_both.rays, on_cpu.rays), (rays, rays));
    // the error of steps that a device made since its last report is lost where it stops
    let [got, want] = [on_both.train_psnr, on_cpu.train_psnr];
    assert!((got - want).abs() < 1.0, "{got} {want}");
}

#[test]
fn a_device_trains_as_the_cpu_does_and_a_checkpoint_goes_there_and_back() {
    // on the device past the second finer grid, after step 16, and the second mask, after step 20
    trainings_follow_the_cpu(&config(), [22, 4]);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; a device makes a hundred steps with another decoder, and reads before its grids have all grown"]
fn a_device_trains_as_the_cpu_does_for_many_steps() {
    let config = VmConfig {
        steps: 100,
        rays: 128,
        upsample_at: vec![0.3, 0.6],
        mask_at: vec![0.3, 0.7],
        color_rank: vec![8, 4, 9],
        hidden: 32,
        ..config()
    };
    trainings_follow_the_cpu(&config, [75, 10]);
}

#[test]
fn a_training_reserves_the_memory_that_was_planned() {
    if device().is_some() {
        tiface_kernels::gpu::testing::alone("tface::gpu::tests::memory_of_a_training");
    }
}

#[test]
#[ignore = "run by the test above, in a process of its own"]
fn memory_of_a_training() {
    let (dir, views) = (temporary(), ball::views());
    let config = VmConfig {
        rays: 2048,
        voxels_start: 40 * 40 * 40,
        voxels_final: 40 * 40 * 40,
        upsample_at: vec![],
        mask_at: vec![],
        ..config()
    };
    let sampler = sampler(&views, &config);
    // The memory is for all points of the lattices, of which few lie in these cells.
    let start = VmState::new(&config, 3, BOUNDS, Some(&ball::cells_within(0.15)));
    let with = |mib: u64| device().unwrap().with_memory((512 + mib) << 20);
    let fits = |mib: u64| GpuVm::fits("tface", &config, &sampler, BOUNDS, &with(mib)).is_ok_and(|r| r);
    let sizes: Vec<u64> = (8..4096).step_by(4).collect();
    let planned = sizes[sizes.partition_point(|&mib| !fits(mib))];
    let session = session("tface", dir.path(), "ball", &Quiet);
    let before = with(planned).reserved_memory();
    let mut model = VmModel::new(on_gpu(&config, &sampler, with(planned)), start, &config, &session);
    model.load();
    for step in 0..2 {
        step_on_gpu(&mut model, step, true);
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
    let sampler = RaySampler::permuted(&views, config.foreground, BOUNDS, true);
    let session = session("tface", dir.path(), "ball", &Quiet);
    let mut on_cpu = begun(CpuVm::new(&config, &sampler), &config, &session);
    let mut on_gpu = begun(on_gpu(&config, &sampler, device), &config, &session);
    for step in 0..6 {
        let want = step_on_cpu(&mut on_cpu, step).figures;
        let counted = step_on_gpu(&mut on_gpu, step, false);
        // The host's draws are uploaded, and the step does not wait for the device.
        assert!(counted.launches <= 40 && counted.readbacks == 0);
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
    // a finer grid and a mask after step 48
    let again = vec![0.2, 0.923];
    let config = VmConfig { steps: 52, upsample_at: again.clone(), mask_at: again, ..config() };
    let views = ball::views();
    let sampler = sampler(&views, &config);
    let run = |dir: &Path, device: &str, monitor: &dyn Monitor| {
        let session = TrainingSession { device, ..session("tface", dir, "ball", monitor) };
        train_one(&sampler, BOUNDS, Some(&hull()), &config, &session)
    };
    let begun = temporary();
    assert!(run(begun.path(), "cpu", &StopAfter::new(47)).err().unwrap().kind().is_stop());
    // To grow the grids, the host reads whether a gradient was not finite, and nine arrays of
    // parameters; then come the losses of step 49, those of step 51, the last one, and the first of
    // those ten again, to save the end.
    outlives_lost_devices(&run, begun.path(), &[2, 10, 10 + 1 + 1 + 1]);
}

#[test]
fn a_device_with_too_little_memory_is_refused_before_the_first_step_and_told_what_fits() {
    let Some(device) = device() else { return };
    let views = ball::views();
    let refused = |config: &VmConfig, mib: u64| {
        let sampler = sampler(&views, config);
        let device = self::device().unwrap().with_memory(mib << 20);
        GpuVm::fits("tface", config, &sampler, BOUNDS, &device)
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
    // ‖(16, 16, 16)‖ / 1.3 = 21.3: 21 samples, of which the last is none, of 17 words each, and 34
    // words of the ray
    assert_eq!((ray, Vm::widest(&field)), (4 * (20 * 17 + 34), 12 * 20));
}

#[test]
fn what_fits_in_some_box_is_not_refused_before_the_box_is_known() {
    let Some(device) = device() else { return };
    let needed = |config: &VmConfig, bounds: [[f32; 3]; 2]| {
        let rays = config.rays as u64;
        let of = |field: &VmField| Vm::bytes(&device, field, config.rays);
        first_and_last(config, bounds).iter().map(of).map(|[fixed, ray]| fixed + rays * ray).max().unwrap()
    };
    let cube = [[-1.0; 3], [1.0; 3]];
    for ranks in [[8, 8, 8], [16, 4, 4], [4, 16, 7], [5, 0, 9]] {
        let config = VmConfig {
            voxels_final: 96 * 96 * 96,
            density_rank: ranks.to_vec(),
            color_rank: ranks.map(|rank| 3 * rank).to_vec(),
            ..config()
        };
        let least = needed(&with_fewest_voxels(&config), cube);
        for size in [[1.0, 1.0, 1.0], [0.7, 1.0, 0.8], [0.25, 0.25, 1.0], [1.0, 0.5, 0.3]] {
            let found = needed(&config, [size.map(|s: f32| -s), size]);
            let share = least as f64 / found as f64;
            println!("{ranks:?} in {size:?}: {share:.3} of {found} bytes");
            // sizes are whole numbers
            assert!(share <= 1.03, "{share}");
            assert!(ranks != [8; 3] || size != [1.0; 3] || least == found);
        }
    }
}
