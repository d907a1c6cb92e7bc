//! Training on a device against training on the CPU: an analytic ball.

use super::super::cpu::CpuSdf;
use super::super::train::{SdfModel, pixels};
use super::*;
use crate::config::Preset;
use crate::config::iface::Start;
use crate::field::ball::{StopAfter, hull, temporary, textured_views};
use crate::field::checkpoint::TrainingProgress;
use crate::field::ops::ArrayDevice;
use crate::field::pixels::TrainView;
use crate::field::training::{self, Model, TrainingSession};
use crate::geom::Ray;
use crate::iface::{IFace, IfaceReport, train};
use crate::kernel::cpu::march::Bitmask;
use crate::kernel::gpu::tests::{device, devices, lose_after};
use crate::{Monitor, Quiet};
use glam::Vec2;
use std::path::Path;
use std::sync::Mutex;

fn config() -> IfaceConfig {
    IfaceConfig {
        steps: 200,
        rays: 200,
        max_rays: 512,
        samples: 2048,
        levels: 6,
        log2_table: 12,
        occupancy_resolution: 32,
        anneal_end: 0.25,
        warmup: 0.1,
        min_step: 0.03,
        ..IfaceConfig::preset(Preset::Draft)
    }
}

/// Named figures of every step that has some.
#[derive(Default)]
struct Figures(Mutex<Vec<(u64, Vec<(String, f64)>)>>);

impl Monitor for Figures {
    fn step(&self, step: u64, _: u64, figures: &[(&str, f64)]) {
        let named = figures.iter().map(|(name, value)| (name.to_string(), *value)).collect();
        self.0.lock().unwrap().push((step, named));
    }
    fn stop(&self) -> bool {
        false
    }
}

fn on<'a>(device: &'a str, dir: &'a Path, monitor: &'a dyn Monitor) -> TrainingSession<'a> {
    TrainingSession { stage: "iface", seed: 3, device, dir, identity: "ball", monitor }
}

/// A training before its first step.
fn begun<'a, O: SdfOps>(
    ops: O,
    pixels: &'a Pixels<'a>,
    hull: Option<&'a Bitmask>,
    config: &'a IfaceConfig,
    session: &TrainingSession<'a>,
) -> SdfModel<'a, O> {
    let mut model = SdfModel::new(ops, pixels, hull, config, session);
    model.restore(None).ok().unwrap();
    model
}

fn learned(
    views: &[TrainView],
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(IFace, IfaceReport)> {
    train(views, Some(&hull()), config, session)
}

/// Error of a view, dB.
fn psnr(face: &IFace, view: &TrainView) -> f64 {
    let (w, h) = (view.camera.width, view.camera.height);
    let pixel = |i: u32| Vec2::new((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
    let rays: Vec<Ray> = (0..w * h).map(|i| view.camera.ray(pixel(i)).unwrap()).collect();
    let alpha = &view.mask.as_ref().unwrap().values;
    let error = |(i, seen): (usize, &crate::geom::RayResult)| -> f64 {
        let a = alpha[i] as f64 / 255.0;
        (0..3).map(|c| (seen.color[c] as f64 - a * view.photo.rgb[i][c] as f64 / 255.0).powi(2)).sum()
    };
    let all: f64 = face.render(&rays).iter().enumerate().map(error).sum();
    -10.0 * (all / (3 * w * h) as f64).log10()
}

#[test]
fn losses_and_views_are_those_of_the_cpu() {
    if device().is_none() {
        return;
    }
    let views = textured_views();
    let config = config();
    let both = ["cpu", "wgpu:0"].map(|device| {
        let (dir, figures) = (temporary(), Figures::default());
        let (face, report) = learned(&views, &config, &on(device, dir.path(), &figures)).unwrap();
        assert_eq!(report.warnings, Vec::<String>::new());
        (psnr(&face, &views[4]), figures.0.into_inner().unwrap(), report)
    });
    let [(cpu, want, _), (gpu, got, _)] = both;
    println!("{cpu:.2} dB on the CPU, {gpu:.2} dB on the device");
    assert!((cpu - gpu).abs() < 0.2, "{cpu} {gpu}");
    // what is minimized; single terms of single batches drift apart sooner, as they do between any two orders of sums
    let total = |figures: &[(String, f64)]| -> f64 {
        let weights = [
            ("rgb", config.rgb_mse),
            ("mask", config.mask),
            ("eikonal", config.eikonal),
            ("stereo", config.stereo),
        ];
        let value = |name: &str| figures.iter().find(|(n, _)| n == name).unwrap().1;
        weights.into_iter().map(|(name, weight)| weight * value(name)).sum()
    };
    let mut looked = 0;
    for (step, figures) in got.iter().filter(|(_, figures)| figures.len() > 1) {
        let on_cpu = &want.iter().find(|(s, _)| s == step).unwrap().1;
        println!("step {step}: {figures:.5?}, on the CPU {on_cpu:.5?}");
        let (got, want) = (total(figures), total(on_cpu));
        assert!((got - want).abs() <= 0.01 * want, "step {step}: {got} {want}");
        looked += 1;
    }
    assert_eq!(looked, 4);
}

#[test]
fn a_training_goes_on_there_and_back() {
    if device().is_none() {
        return;
    }
    let views = textured_views();
    let config = IfaceConfig { steps: 90, start: Start::Sphere, ..config() };
    let run =
        |dir: &Path, device: &str, monitor: &dyn Monitor| learned(&views, &config, &on(device, dir, monitor));
    let (alone, moved) = (temporary(), temporary());
    let (want, _) = run(alone.path(), "cpu", &Quiet).unwrap();
    // points are looked for at step 54
    for (device, steps) in [("cpu", 20), ("wgpu:0", 20), ("cpu", 20), ("wgpu:0", 15)] {
        let stopped = run(moved.path(), device, &StopAfter::new(steps)).err().unwrap();
        assert!(stopped.to_string().contains("saved at step"), "{stopped}");
    }
    let (got, report) = run(moved.path(), "cpu", &Quiet).unwrap();
    assert_eq!(report.warnings, Vec::<String>::new());
    let (want, got) = (psnr(&want, &views[4]), psnr(&got, &views[4]));
    println!("{want:.2} dB alone, {got:.2} dB on the CPU and the device in turn");
    assert!((want - got).abs() < 0.2, "{want} {got}");
}

#[test]
fn a_device_that_is_lost_leaves_the_last_checkpoint_and_the_training_goes_on() {
    if device().is_none() {
        return;
    }
    let views = textured_views();
    let config = IfaceConfig { steps: 90, start: Start::Sphere, ..config() };
    let run = |dir: &Path, device: &str, monitor: &dyn Monitor| {
        let result = learned(&views, &config, &on(device, dir, monitor));
        lose_after(usize::MAX);
        result
    };
    let (alone, lost) = (temporary(), temporary());
    let (want, _) = run(alone.path(), "cpu", &Quiet).unwrap();
    run(lost.path(), "cpu", &StopAfter::new(40)).err().unwrap();
    let file = lost.path().join("checkpoint.safetensors");
    let before = std::fs::read(&file).unwrap();
    // at the losses of step 50, where points are looked for at step 54, and while the end is saved
    for answers in [0, 3, 14] {
        lose_after(answers);
        let e = run(lost.path(), "wgpu:0", &Quiet).err().unwrap();
        assert!(e.to_string().contains("failed: device lost") && e.hint().contains("repeat"), "{e}");
        assert_eq!(e.kind() as i32, 75);
        assert!(std::fs::read(&file).unwrap() == before, "the last checkpoint is touched after {answers}");
    }
    let (got, _) = run(lost.path(), "wgpu:0", &Quiet).unwrap();
    let (want, got) = (psnr(&want, &views[4]), psnr(&got, &views[4]));
    println!("{want:.2} dB alone, {got:.2} dB after a device was lost");
    assert!((want - got).abs() < 0.2, "{want} {got}");
}

#[test]
fn a_step_waits_for_nothing() {
    if device().is_none() {
        return;
    }
    let views = textured_views();
    let config = IfaceConfig { start: Start::Sphere, stereo: 0.0, occupancy_every: 1.0, ..config() };
    let config = IfaceConfig { all_levels: 0.0, ..config };
    let (hull, dir) = (hull(), temporary());
    let session = on("wgpu:0", dir.path(), &Quiet);
    let pixels = pixels(&views, Some(&hull), &config).unwrap();
    let ops = GpuSdf::new(&config, &pixels, device().unwrap()).unwrap();
    let mut model = begun(ops, &pixels, Some(&hull), &config, &session);
    let mut progress = TrainingProgress { step: 1, ..TrainingProgress::default() };
    let step = |model: &mut SdfModel<GpuSdf>, progress: &TrainingProgress| {
        let read = (progress.step + 1).is_multiple_of(Device::READ_EVERY);
        training::step(model, session.seed, progress, read).ok().unwrap();
    };
    let before = model.ops.device.counts();
    for _ in 0..Device::READ_EVERY {
        step(&mut model, &progress);
        progress.step += 1;
    }
    let after = model.ops.device.counts();
    let (launches, readbacks) = (after.0 - before.0, after.1 - before.1);
    println!("{launches} launches and {readbacks} readbacks in {} steps", Device::READ_EVERY);
    assert!(launches as u64 <= 40 * Device::READ_EVERY && readbacks <= 1, "{launches} {readbacks}");
    // a look at the cells: more launches, but nothing is read
    progress.step = 0;
    step(&mut model, &progress);
    assert_eq!(model.ops.device.counts().1, after.1);
}

/// Updates the cells by the weights as they are, and returns the cells to march through.
fn updated<O: SdfOps>(model: &mut SdfModel<O>, at: StepAt) -> Occupancy {
    model.ops.weights(&mut model.groups);
    model.ops.update_occupancy(&model.groups, schedule::active_levels(model.config, at.step), at);
    model.state().unwrap().occupancy
}

#[test]
fn cells_are_those_that_the_cpu_keeps() {
    let Some(device) = device() else { return };
    let views = textured_views();
    let config = IfaceConfig { occupancy_resolution: 40, soften: 8.0, band: 0.3, ..config() };
    let (hull, dir) = (hull(), temporary());
    let session = on("wgpu:0", dir.path(), &Quiet);
    let pixels = pixels(&views, Some(&hull), &config).unwrap();
    let gpu = GpuSdf::new(&config, &pixels, device).unwrap();
    let mut on_gpu = begun(gpu, &pixels, Some(&hull), &config, &session);
    let mut on_cpu = begun(CpuSdf::new(&config, &pixels), &pixels, Some(&hull), &config, &session);
    let at = StepAt { seed: 3, step: 7 };
    let want = updated(&mut on_cpu, at);
    let before = on_gpu.ops.device.counts().1;
    on_gpu.ops.weights(&mut on_gpu.groups);
    on_gpu.ops.update_occupancy(&on_gpu.groups, schedule::active_levels(&config, 7), at);
    assert_eq!(on_gpu.ops.device.counts().1, before, "something was read back");
    let Occupancy { occupied, solid, .. } = on_gpu.state().unwrap().occupancy;
    let differ = |a: &Bitmask, b: &Bitmask| (0..64_000).filter(|&i| a.get(i) != b.get(i)).count();
    println!("{} cells to march, {} solid", want.occupied.count(), want.solid.count());
    assert!(want.occupied.count() > 1000 && want.solid.count() > 100);
    // those whose distance is the band's but for rounding
    assert!(differ(&occupied, &want.occupied) <= 3 && differ(&solid, &want.solid) <= 3);
}

#[test]
fn cells_of_the_published_rule_are_those_that_the_cpu_keeps() {
    let Some(device) = device() else { return };
    let views = textured_views();
    // A step's capacity is below the number of cells: the cells are evaluated in pieces; the last word of the
    // mask is partial.
    const SIDE: usize = 35;
    let config = IfaceConfig {
        occupancy: OccupancyRule::Nerfacc,
        occupancy_resolution: SIDE,
        samples_per_ray: 64,
        samples: 1024,
        ..config()
    };
    let dir = temporary();
    let session = on("wgpu:0", dir.path(), &Quiet);
    let pixels = pixels(&views, None, &config).unwrap();
    let gpu = GpuSdf::new(&config, &pixels, device).unwrap();
    let mut on_gpu = begun(gpu, &pixels, None, &config, &session);
    let mut on_cpu = begun(CpuSdf::new(&config, &pixels), &pixels, None, &config, &session);
    let total = SIDE.pow(3);
    assert!(on_gpu.ops.samples.t.words() < total / 2);
    // all cells; a quarter anywhere with some of all, of many and of few that are kept; of those that the device kept itself
    for (step, kept) in
        [(16, None), (272, Some(total)), (288, Some(total / 2)), (304, Some(500)), (320, None)]
    {
        if let Some(kept) = kept {
            let mut state = on_cpu.state().unwrap();
            (0..total).for_each(|i| state.occupancy.occupied.set(i, i % (total / kept) == 0));
            // whatever is drawn changes
            state.occupancy.history.fill(1e-4);
            on_gpu.ops.load(&state.occupancy, state.rays, &[]);
        }
        // rounding apart, both have the same cells: go on from the device's
        let start = on_gpu.state().unwrap().occupancy;
        on_cpu.ops.load(&start, config.rays, &[]);
        let before = start.history;
        let at = StepAt { seed: 3, step };
        let (want, got) = (&updated(&mut on_cpu, at), updated(&mut on_gpu, at));
        // the same cells are drawn, and of several draws of a cell the same one counts
        let changed =
            |history: &[f32]| -> Vec<usize> { (0..total).filter(|&i| history[i] != before[i]).collect() };
        let [here, drawn] = [&got.history, &want.history].map(|h| changed(h));
        assert!(here == drawn, "step {step}: {} and {} cells are drawn", here.len(), drawn.len());
        // an opacity is a difference of two numbers up to one: small ones have few digits
        let apart = |(a, b): (&f32, &f32)| (a - b).abs() / (1e-4 * b + 1e-6);
        let worst = got.history.iter().zip(&want.history).map(apart).fold(0f32, f32::max);
        let large = drawn.iter().filter(|&&i| want.history[i] > 1e-3).count();
        let differ = (0..total).filter(|&i| got.occupied.get(i) != want.occupied.get(i)).count();
        println!(
            "step {step}: {} cells drawn, {large} opaque, {} kept, {worst:.2} of the tolerance apart, {differ} otherwise",
            drawn.len(),
            want.occupied.count()
        );
        assert!(worst < 1.0 && large > 100 && (drawn.len() == total) == (step == 16), "{worst}");
        assert!(want.occupied.count() > 300 && want.occupied.count() < total && differ <= 3, "{differ}");
    }
}

#[test]
fn the_paper_waits_for_nothing_either_and_learns_what_the_cpu_does() {
    if device().is_none() {
        return;
    }
    let views = textured_views();
    let config = IfaceConfig {
        steps: 300,
        rays: 64,
        samples: 2048,
        levels: 6,
        log2_table: 12,
        occupancy_resolution: 24,
        samples_per_ray: 128,
        ..IfaceConfig::preset(Preset::Paper)
    };
    let run = |dir: &Path, device: &str, monitor: &dyn Monitor| {
        train(&views, None, &config, &on(device, dir, monitor))
    };
    let mut all = Vec::new();
    for device in ["cpu", "wgpu:0"] {
        let (face, report) = run(temporary().path(), device, &Quiet).unwrap();
        all.push((psnr(&face, &views[4]), report.occupied));
    }
    // on both in turn, past the step from which cells are drawn
    let moved = temporary();
    for (device, steps) in [("cpu", 250), ("wgpu:0", 20)] {
        run(moved.path(), device, &StopAfter::new(steps)).err().unwrap();
    }
    let (face, report) = run(moved.path(), "cpu", &Quiet).unwrap();
    all.push((psnr(&face, &views[4]), report.occupied));
    println!("dB and share of the cells, on the CPU, on the device, on both in turn: {all:.3?}");
    assert!(all[0].0 > 17.0 && all[0].1 < 0.9, "{all:?}");
    assert!(all.iter().all(|way| (all[0].0 - way.0).abs() < 0.2 && (all[0].1 - way.1).abs() < 0.02));
    // 50 steps with three looks at cells that are drawn: one readback
    let dir = temporary();
    let session = on("wgpu:0", dir.path(), &Quiet);
    let pixels = pixels(&views, None, &config).unwrap();
    let ops = GpuSdf::new(&config, &pixels, device().unwrap()).unwrap();
    let mut model = begun(ops, &pixels, None, &config, &session);
    let before = model.ops.device.counts().1;
    for step in 250..250 + Device::READ_EVERY {
        let progress = TrainingProgress { step, ..TrainingProgress::default() };
        training::step(&mut model, session.seed, &progress, (step + 1).is_multiple_of(Device::READ_EVERY))
            .ok()
            .unwrap();
    }
    assert_eq!(model.ops.device.counts().1 - before, 1);
}

#[test]
fn all_ways_to_add_learn_alike_and_whole_numbers_the_same_bytes() {
    let views = textured_views();
    let config = IfaceConfig { start: Start::Sphere, stereo: 0.0, ..config() };
    let (hull, dir) = (hull(), temporary());
    let session = on("wgpu:0", dir.path(), &Quiet);
    let pixels = pixels(&views, Some(&hull), &config).unwrap();
    // losses of the third step, and the table after it
    let trained = |device: Device| {
        let ops = GpuSdf::new(&config, &pixels, device).unwrap();
        let mut model = begun(ops, &pixels, Some(&hull), &config, &session);
        let step = |step: u64| {
            let progress = TrainingProgress { step, ..TrainingProgress::default() };
            training::step(&mut model, session.seed, &progress, true).ok().flatten().unwrap().figures
        };
        let figures: Vec<f64> = (0..3).map(step).last().unwrap().iter().map(|(_, value)| *value).collect();
        (figures, model.state().unwrap().groups[0].state[0].clone())
    };
    let found: Vec<_> = devices().into_iter().map(|device| (device.atomics(), trained(device))).collect();
    for (way, (figures, _)) in &found {
        let alike = figures.iter().zip(&found[0].1.0).all(|(a, b)| (a - b).abs() <= 0.01 * b.abs() + 1e-6);
        assert!(alike, "{way:?}: {figures:?}");
    }
    let Some((device, (way, (_, before)))) = devices().pop().zip(found.last()) else { return };
    assert_eq!(*way, gpu::Atomics::Fixed);
    assert!(trained(device).1 == *before, "the same steps give the same bytes");
}

#[test]
fn a_device_with_too_little_room_is_refused_before_the_first_step() {
    let Some(device) = device() else { return };
    let views = textured_views();
    let hull = hull();
    let room = |config: &IfaceConfig, device: &Device| {
        let pixels = pixels(&views, Some(&hull), config).unwrap();
        max_samples(config, &shape(config), &pixels, device)
    };
    let config = IfaceConfig { stereo: 0.0, ..config() };
    let e = room(&IfaceConfig { samples: 100_000_000, ..config.clone() }, &device).err().unwrap();
    assert!(e.to_string().contains("has memory for") && e.hint().contains("iface.samples to"), "{e}");
    // what fits beside 512 MiB that are not to be had: nothing at all, or samples, or samples and photographs
    let of = |mib: u64| self::device().unwrap().with_memory(mib << 20);
    let some = IfaceConfig { samples: 4096, ..config.clone() };
    let e = room(&some, &of(512)).err().unwrap();
    assert!(e.hint().contains("lower iface.samples, then iface.log2_table, or give"), "{e:?}");
    // where the tables alone are too large, the largest that fit are named, and they do fit
    let large = IfaceConfig { samples: 512, levels: 16, log2_table: 20, ..config };
    let e = room(&large, &of(640)).err().unwrap();
    let log2 = e.hint().strip_prefix("lower iface.log2_table to ").and_then(|h| h.split(',').next());
    let log2: u32 = log2.unwrap_or_else(|| panic!("{}", e.hint())).parse().unwrap();
    for (log2_table, fits) in [(log2, true), (log2 + 1, false)] {
        let config = IfaceConfig { log2_table, ..large.clone() };
        assert_eq!(room(&config, &of(640)).is_ok(), fits, "{log2_table}");
    }
    let [whole, few] = [900, 536].map(|mib| room(&some, &of(mib)).unwrap());
    println!("samples, and do photographs lie there: {whole:?} {few:?}");
    assert!(whole.1 && whole.0 > MAX_BUDGETS * 4096 && !few.1 && few.0 < whole.0 && few.0 > 4096);
}

/// `cargo test --release --features wgpu --lib exchange_costs -- --ignored --nocapture`
#[test]
#[ignore = "measures times"]
fn exchange_costs_at_most_half_more_than_native_sums() {
    use crate::kernel::gpu::Atomics;
    let Some(native) = device().filter(|d| d.atomics() == Atomics::Native) else {
        println!("skipped: no adapter here adds floats by itself");
        return;
    };
    const STEPS: u64 = 5;
    let views = textured_views();
    let config = IfaceConfig { start: Start::Sphere, stereo: 0.0, ..IfaceConfig::preset(Preset::Draft) };
    let (hull, dir) = (hull(), temporary());
    let session = on("wgpu:0", dir.path(), &Quiet);
    let ways = [native, device().unwrap().with_atomics(Atomics::Exchange)];
    let pixels = pixels(&views, Some(&hull), &config).unwrap();
    let mut both = ways.map(|device| {
        let ops = GpuSdf::new(&config, &pixels, device).unwrap();
        begun(ops, &pixels, Some(&hull), &config, &session)
    });
    let mut best = [f64::INFINITY; 2];
    let mut step = 1;
    // in turn, so that what else the machine does is the same to both; the first round compiles
    for round in 0..12 {
        for (model, best) in both.iter_mut().zip(&mut best) {
            let began = std::time::Instant::now();
            for step in step..step + STEPS {
                let progress = TrainingProgress { step, ..TrainingProgress::default() };
                training::step(model, session.seed, &progress, false).ok().unwrap();
            }
            model.ops.device.fetch::<u32>(&model.ops.samples.count).unwrap();
            let ms = 1e3 * began.elapsed().as_secs_f64() / STEPS as f64;
            *best = if round > 2 { best.min(ms) } else { *best };
        }
        step += STEPS;
    }
    let count = both.each_ref().map(|model| model.ops.device.read::<u32>(&model.ops.samples.count)[0]);
    let [native, exchange] = best;
    println!(
        "{native:.1} ms a step with native sums, {exchange:.1} ms with exchanged words: {:.2} x ({count:?} samples)",
        exchange / native
    );
    assert!(exchange <= 1.5 * native);
}

#[test]
fn a_training_takes_the_memory_that_it_is_given() {
    if device().is_some() {
        crate::kernel::gpu::tests::alone("iface::gpu::tests::memory_of_a_training");
    }
}

/// The number of samples equals the capacity, a tenth of the requested number.
#[test]
#[ignore = "run by the test above, in a process of its own"]
fn memory_of_a_training() {
    let views = textured_views();
    let config = IfaceConfig { samples: 1 << 16, start: Start::Sphere, ..config() };
    let (hull, dir) = (hull(), temporary());
    let session = on("wgpu:0", dir.path(), &Quiet);
    let pixels = pixels(&views, Some(&hull), &config).unwrap();
    let given = device().unwrap().with_memory(700 << 20);
    let most = given.available_memory();
    let before = given.reserved_memory();
    let ops = GpuSdf::new(&config, &pixels, given).unwrap();
    let model = begun(ops, &pixels, Some(&hull), &config, &session);
    assert!(!model.ops.is_broken().unwrap());
    let taken = model.ops.device.reserved_memory() - before;
    println!("{taken} bytes of {most} are taken");
    assert!(taken as f64 <= 1.05 * most as f64 && taken as f64 > 0.8 * most as f64, "{taken} of {most}");
}
