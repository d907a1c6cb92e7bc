use super::*;
use crate::Monitor;
use crate::Quiet;
use crate::config::Preset;
use crate::field;
use crate::field::ball::{self, StopAfter, hull, session, temporary};
use crate::field::pixels::TrainView;
use crate::field::training::TrainingSession;
use crate::kernel::gpu::tests::device;
use crate::tface::train::train_one;
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
        upsample_steps: vec![30, 60],
        mask_steps: vec![30, 70],
        density_rank: vec![8, 8, 8],
        color_rank: vec![8, 4, 9],
        hidden: 32,
        ..VmConfig::preset(Preset::Draft)
    }
}

fn pixels<'a>(views: &'a [TrainView], config: &VmConfig) -> Pixels<'a> {
    Pixels::new(views, 0.25, 1.0, config.foreground, config.whole_frame)
}

fn training<'a>(
    pixels: &'a Pixels<'a>,
    config: &'a VmConfig,
    session: &TrainingSession<'a>,
) -> VmTraining<'a> {
    VmTraining::new(pixels, BOUNDS, Some(&hull()), config, session, burn::tensor::Device::flex())
}

#[test]
fn losses_follow_those_of_the_cpu_and_nobody_waits() {
    let Some(device) = device() else { return };
    let (dir, views) = (temporary(), ball::views());
    // after a grid has grown, Adam's first steps go by the sign of what is zero but for rounding: that is another story
    let config = VmConfig { steps: 200, upsample_steps: vec![], mask_steps: vec![], ..config() };
    let pixels = pixels(&views, &config);
    let session = session("tface", dir.path(), "ball", &Quiet);
    let mut on_cpu = training(&pixels, &config, &session);
    let mut there = OnDevice::new(training(&pixels, &config, &session), device).ok().unwrap();
    let mut want = 0f64;
    for step in 0..config.steps {
        let progress = TrainingProgress { step, ..TrainingProgress::default() };
        let rgb = |report: StepReport| report.figures.first().map(|(_, v)| *v);
        want += rgb(on_cpu.step(&progress).ok().unwrap()).unwrap() / READ_EVERY as f64;
        let before = there.device.counts();
        let got = rgb(there.step(&progress).ok().unwrap());
        let after = there.device.counts();
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
    let there = FieldMean::load("tface", dir, 1).unwrap().on(field::place("wgpu:0").unwrap());
    let mut sum = 0f64;
    for view in &views[..2] {
        let rays: Vec<_> = (0..1600)
            .map(|p| view.camera.ray(Vec2::new((p % 40) as f32 + 0.5, (p / 40) as f32 + 0.5)).unwrap())
            .collect();
        let mask = &view.mask.as_ref().unwrap().values;
        let forward = view.camera.forward();
        for (p, (seen, there)) in
            face.render(&rays, forward).iter().zip(there.render(&rays, forward)).enumerate()
        {
            let close = |a: f32, b: f32| (a - b).abs() < 1e-4;
            assert!((0..3).all(|c| close(seen.color[c], there.color[c])), "{seen:?} {there:?}");
            assert!(close(seen.opacity, there.opacity) && close(seen.depth, there.depth));
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
    let mut on_cpu = training(&pixels, &config, &session);
    let mut there = OnDevice::new(training(&pixels, &config, &session), device).ok().unwrap();
    for step in 0..6 {
        let progress = TrainingProgress { step, ..TrainingProgress::default() };
        let want = on_cpu.step(&progress).ok().unwrap().figures;
        there.launch(there.host.seed(&progress), step);
        there.unread += 1;
        let got = there.report(step).ok().unwrap().figures;
        for ((name, got), (_, want)) in got.iter().zip(&want).take(2) {
            assert!((got - want).abs() < 1e-3 * want, "{name} at step {step}: {got} {want}");
        }
    }
    // rays, their lattice points and colors are counted as on the CPU
    let (counts, want) = (there.host.counts, on_cpu.counts);
    assert_eq!((counts.rays, counts.lattice), (want.rays, want.lattice));
    assert!(counts.color.abs_diff(want.color) < 10 && counts.density >= want.density);
}
