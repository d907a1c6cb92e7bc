//! Training on a device against training on the CPU: an analytic ball.

use super::super::cpu::CpuSdf;
use super::super::model::parts;
use super::super::state::{FORMAT, SdfState};
use super::super::train::{SdfModel, sampler};
use super::*;
use crate::config::Preset;
use crate::config::iface::Start;
use crate::field::ball::{hull, textured_views};
use crate::field::checkpoint::{self, Checkpoint};
use crate::field::gpu_tests::{
    CountedStep, Outcome, RunOn, alike, alone_and_in_turn, counted_step, cpu_and_both, fixed_sums_repeat,
    outlives_lost_devices, psnr,
};
use crate::field::ops::ArrayDevice;
use crate::field::testing::{StopAfter, session, temporary};
use crate::field::training::{Model, TrainingSession};
use crate::iface::{IFace, IfaceReport, train};
use std::path::Path;
use std::sync::Mutex;
use tiface_base::geom::BitGrid;
use tiface_base::{Monitor, Quiet};
use tiface_capture::LoadedView;
use tiface_kernels::gpu::testing::{device, devices};

/// As small as a driver in software needs it, for which a step takes as long as it has samples.
fn config() -> IfaceConfig {
    IfaceConfig {
        steps: 56,
        rays: 24,
        max_rays: 32,
        samples: 384,
        levels: 5,
        log2_table: 12,
        occupancy_resolution: 24,
        start: Start::Sphere,
        anneal_end: 0.25,
        warmup: 0.1,
        min_step: 0.03,
        ..IfaceConfig::preset(Preset::Draft)
    }
}

/// By the paper, as small, and past step 256, from which cells are drawn.
fn paper() -> IfaceConfig {
    IfaceConfig {
        steps: 264,
        rays: 32,
        samples: 512,
        levels: 5,
        log2_table: 12,
        occupancy_resolution: 16,
        samples_per_ray: 48,
        ..IfaceConfig::preset(Preset::Paper)
    }
}

/// Named figures of a step.
type Figures = Vec<(String, f64)>;

/// A monitor that records the figures of steps, and passes everything on to another one.
struct Recorder<'a> {
    /// Device, step and figures.
    steps: &'a Mutex<Vec<(String, u64, Figures)>>,
    device: &'a str,
    monitor: &'a dyn Monitor,
}

impl Monitor for Recorder<'_> {
    fn step(&self, step: u64, steps: u64, figures: &[(&str, f64)]) {
        let named = figures.iter().map(|(name, value)| (name.to_string(), *value)).collect();
        self.steps.lock().unwrap().push((self.device.into(), step, named));
        self.monitor.step(step, steps, figures);
    }
    fn stop(&self) -> bool {
        self.monitor.stop()
    }
}

fn on<'a>(device: &'a str, dir: &'a Path, monitor: &'a dyn Monitor) -> TrainingSession<'a> {
    TrainingSession { device, ..session("iface", dir, "ball", monitor) }
}

/// A training before its first step.
fn begun<'a, O: SdfOps>(
    ops: O,
    sampler: &'a RaySampler<'a>,
    hull: Option<&'a BitGrid>,
    config: &'a IfaceConfig,
    session: &TrainingSession<'a>,
) -> SdfModel<'a, O> {
    let mut model = SdfModel::new(ops, sampler, hull, config, session);
    model.restore(None).ok().unwrap();
    model
}

/// Makes a step of a training on a device, and reads its losses as often as a training does.
fn stepped(model: &mut SdfModel<GpuSdf>, step: u64) -> CountedStep {
    let read = (step + 1).is_multiple_of(Device::READ_EVERY);
    counted_step(model, |model| &model.ops.device, 3, step, read)
}

fn learned(
    views: &[LoadedView],
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(IFace, IfaceReport)> {
    train(views, Some(&hull()), config, session)
}

/// Trains on the CPU alone, and on the device with some steps on the CPU in between; compares the
/// losses of the device's steps that are read, and a view within `near` dB.
fn losses_and_views_follow_the_cpu(config: &IfaceConfig, in_turn: [u64; 2], near: f64) {
    if device().is_none() {
        return;
    }
    let (views, steps) = (textured_views(), Mutex::default());
    let run = |dir: &Path, device: &str, monitor: &dyn Monitor| {
        let monitor = Recorder { steps: &steps, device, monitor };
        let (face, report) = learned(&views, config, &on(device, dir, &monitor))?;
        assert_eq!(report.warnings, Vec::<String>::new());
        let mut file = Checkpoint::read(&checkpoint::newest(dir), "iface", FORMAT)?;
        let points = SdfState::restore(parts(config), config, Some(&hull()), &mut file)?.stereo.len();
        let db = psnr(&views[4], |rays| face.render(rays));
        Ok((Outcome { db, share: report.occupied }, points))
    };
    let [(cpu, _), (both, points)] = cpu_and_both(&run, in_turn);
    alike(&[cpu, both], [near, 0.03]);
    assert!(points > 0, "the device looks for points, and goes on with those of a checkpoint");
    // what is minimized; single terms of single batches drift apart sooner, as they do between any
    // two orders of sums
    let total = |figures: &Figures| -> f64 {
        let weights = [
            ("rgb", config.rgb_mse),
            ("mask", config.mask),
            ("eikonal", config.eikonal),
            ("stereo", config.stereo),
        ];
        let value = |name: &str| figures.iter().find(|(n, _)| n == name).unwrap().1;
        weights.into_iter().map(|(name, weight)| weight * value(name)).sum()
    };
    let (mut looked, steps) = (0, steps.into_inner().unwrap());
    for (_, step, figures) in steps.iter().filter(|(on, _, figures)| on != "cpu" && figures.len() > 1) {
        // the training on the CPU alone came first
        let (.., on_cpu) = steps.iter().find(|(on, s, _)| on == "cpu" && s == step).unwrap();
        println!("step {step}: {figures:.5?}, on the CPU {on_cpu:.5?}");
        let (got, want) = (total(figures), total(on_cpu));
        assert!((got - want).abs() <= 0.01 * want, "step {step}: {got} {want}");
        looked += 1;
    }
    // every fiftieth step, and the last one
    assert_eq!(looked, config.steps.div_ceil(Device::READ_EVERY));
}

#[test]
fn losses_and_views_are_those_of_the_cpu_on_the_device_and_in_turn() {
    // points, whose number does not shrink with the settings, are looked for at step 47, on the
    // device
    let config = IfaceConfig { stereo_at: 0.85, ..config() };
    assert_eq!(schedule::stereo_step(&config), Some(47));
    losses_and_views_follow_the_cpu(&config, [51, 2], 0.1);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; rounding adds up over two hundred steps, of which eighty are with points"]
fn losses_and_views_stay_those_of_the_cpu() {
    let config = IfaceConfig {
        steps: 200,
        rays: 200,
        max_rays: 512,
        samples: 2048,
        levels: 6,
        occupancy_resolution: 32,
        start: Start::Hull,
        ..config()
    };
    losses_and_views_follow_the_cpu(&config, [151, 9], 0.2);
}

#[test]
fn a_device_that_is_lost_leaves_the_last_checkpoint_and_the_training_goes_on() {
    if device().is_none() {
        return;
    }
    // two photographs, which are searched for points five times
    let views = &textured_views()[..2];
    let config = IfaceConfig { steps: 53, stereo_at: 0.97, ..config() };
    let run =
        |dir: &Path, device: &str, monitor: &dyn Monitor| learned(views, &config, &on(device, dir, monitor));
    let begun = temporary();
    assert!(run(begun.path(), "cpu", &StopAfter::new(49)).err().unwrap().kind().is_stop());
    // One readback has the losses of step 49. The search for points before step 51 reads the state:
    // nine arrays of parameters, two of cells, the number of rays and that of samples. One more has
    // the losses of step 52, the last one, and the checkpoint of the end begins with whether a
    // gradient was not finite: 1 + 13 + 1 + 1.
    outlives_lost_devices(&run, begun.path(), &[0, 3, 16]);
}

#[test]
fn a_step_waits_for_nothing() {
    if device().is_none() {
        return;
    }
    const STEPS: u64 = 3;
    let views = textured_views();
    let config = IfaceConfig { stereo: 0.0, occupancy_every: 1.0, all_levels: 0.0, ..config() };
    let (hull, dir) = (hull(), temporary());
    let session = on("wgpu:0", dir.path(), &Quiet);
    let sampler = sampler(&views, Some(&hull), &config).unwrap();
    let ops = GpuSdf::new(&config, &sampler, device().unwrap()).unwrap();
    let mut model = begun(ops, &sampler, Some(&hull), &config, &session);
    // up to the one whose losses are read
    let all: Vec<CountedStep> =
        (Device::READ_EVERY - STEPS..Device::READ_EVERY).map(|at| stepped(&mut model, at)).collect();
    let launches: usize = all.iter().map(|step| step.launches).sum();
    let readbacks: usize = all.iter().map(|step| step.readbacks).sum();
    println!("{launches} launches and {readbacks} readbacks in {STEPS} steps");
    assert!(launches as u64 <= 40 * STEPS && readbacks == 1, "{launches} {readbacks}");
    // a look at the cells: more launches, but nothing is read
    assert_eq!(stepped(&mut model, 0).readbacks, 0);
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
    let sampler = sampler(&views, Some(&hull), &config).unwrap();
    let gpu = GpuSdf::new(&config, &sampler, device).unwrap();
    let mut on_gpu = begun(gpu, &sampler, Some(&hull), &config, &session);
    let mut on_cpu = begun(CpuSdf::new(&config, &sampler), &sampler, Some(&hull), &config, &session);
    let at = StepAt { seed: 3, step: 7 };
    let want = updated(&mut on_cpu, at);
    let before = on_gpu.ops.device.counts().1;
    on_gpu.ops.weights(&mut on_gpu.groups);
    on_gpu.ops.update_occupancy(&on_gpu.groups, schedule::active_levels(&config, 7), at);
    assert_eq!(on_gpu.ops.device.counts().1, before, "something was read back");
    let Occupancy { occupied, solid, .. } = on_gpu.state().unwrap().occupancy;
    let differ = |a: &BitGrid, b: &BitGrid| (0..64_000).filter(|&i| a.get(i) != b.get(i)).count();
    println!("{} cells to march, {} solid", want.occupied.count(), want.solid.count());
    assert!(want.occupied.count() > 1000 && want.solid.count() > 100);
    // those whose distance is the band's but for rounding
    assert!(differ(&occupied, &want.occupied) <= 3 && differ(&solid, &want.solid) <= 3);
}

#[test]
fn cells_of_the_published_rule_are_those_that_the_cpu_keeps() {
    let Some(device) = device() else { return };
    let views = textured_views();
    // A step's capacity is below the number of cells: the cells are evaluated in pieces; the last
    // word of the mask is partial.
    const SIDE: usize = 21;
    let config = IfaceConfig {
        occupancy: OccupancyRule::Nerfacc,
        occupancy_resolution: SIDE,
        samples_per_ray: 64,
        samples: 512,
        ..config()
    };
    let dir = temporary();
    let session = on("wgpu:0", dir.path(), &Quiet);
    let sampler = sampler(&views, None, &config).unwrap();
    let gpu = GpuSdf::new(&config, &sampler, device).unwrap();
    let mut on_gpu = begun(gpu, &sampler, None, &config, &session);
    let mut on_cpu = begun(CpuSdf::new(&config, &sampler), &sampler, None, &config, &session);
    let total = SIDE.pow(3);
    assert!(on_gpu.ops.samples.t.word_count() < total / 2);
    // all cells; a quarter anywhere with some of all, of many and of few that are kept; of those
    // that the device kept itself
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

/// A training by the paper, and what it comes to.
fn by_the_paper(
    views: &[LoadedView],
    config: &IfaceConfig,
    dir: &Path,
    device: &str,
    monitor: &dyn Monitor,
) -> Result<Outcome> {
    let (face, report) = train(views, None, config, &on(device, dir, monitor))?;
    Ok(Outcome { db: psnr(&views[4], |rays| face.render(rays)), share: report.occupied })
}

#[test]
fn the_paper_goes_on_where_the_cpu_stopped_and_waits_for_nothing_either() {
    let Some(device) = device() else { return };
    let (views, config) = (textured_views(), paper());
    let run: RunOn<Outcome> = &|dir, device, monitor| by_the_paper(&views, &config, dir, device, monitor);
    // past the step from which cells are drawn
    let learned = alike(&alone_and_in_turn(run, 254, &[("wgpu:0", 5)]), [0.1, 0.02]);
    let one = IfaceConfig { steps: 1, ..config.clone() };
    let start = by_the_paper(&views, &one, temporary().path(), "cpu", &Quiet).unwrap();
    assert!(learned.db > start.db + 0.5 && learned.share < 0.9, "{start:?} {learned:?}");
    // with three looks at cells that are drawn: one readback
    let dir = temporary();
    let session = on("wgpu:0", dir.path(), &Quiet);
    let sampler = sampler(&views, None, &config).unwrap();
    let ops = GpuSdf::new(&config, &sampler, device).unwrap();
    let mut model = begun(ops, &sampler, None, &config, &session);
    let steps = [256, 257, 272, 288, 299].map(|step| stepped(&mut model, step));
    assert_eq!(steps.iter().map(|step| step.readbacks).sum::<usize>(), 1);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; a training by the paper on the device, of three hundred steps"]
fn the_paper_learns_on_a_device_what_the_cpu_does() {
    if device().is_none() {
        return;
    }
    let config = IfaceConfig {
        steps: 300,
        rays: 64,
        samples: 2048,
        levels: 6,
        occupancy_resolution: 24,
        samples_per_ray: 128,
        ..paper()
    };
    let views = textured_views();
    let run: RunOn<Outcome> = &|dir, device, monitor| by_the_paper(&views, &config, dir, device, monitor);
    let mut all = alone_and_in_turn(run, 254, &[("wgpu:0", 20)]).to_vec();
    all.push(run(temporary().path(), "wgpu:0", &Quiet).unwrap());
    let learned = alike(&all, [0.2, 0.02]);
    assert!(learned.db > 17.0 && learned.share < 0.9, "{learned:?}");
}

#[test]
fn all_ways_to_add_learn_alike_and_whole_numbers_the_same_bytes() {
    let views = textured_views();
    let config = IfaceConfig { stereo: 0.0, ..config() };
    let (hull, dir) = (hull(), temporary());
    let session = on("wgpu:0", dir.path(), &Quiet);
    let sampler = sampler(&views, Some(&hull), &config).unwrap();
    // losses of the third step, and the table after it
    let trained = |device: Device| {
        let ops = GpuSdf::new(&config, &sampler, device).unwrap();
        let mut model = begun(ops, &sampler, Some(&hull), &config, &session);
        let step = |step: u64| {
            let counted = counted_step(&mut model, |model| &model.ops.device, session.seed, step, true);
            counted.report.unwrap().figures
        };
        let figures: Vec<f64> = (0..3).map(step).last().unwrap().iter().map(|(_, value)| *value).collect();
        (figures, model.state().unwrap().groups[0].state[0].clone())
    };
    let found: Vec<_> = devices().into_iter().map(|device| (device.atomics(), trained(device))).collect();
    for (way, (figures, _)) in &found {
        let alike = figures.iter().zip(&found[0].1.0).all(|(a, b)| (a - b).abs() <= 0.01 * b.abs() + 1e-6);
        assert!(alike, "{way:?}: {figures:?}");
    }
    fixed_sums_repeat(|device| trained(device).1);
}

#[test]
fn a_device_with_too_little_room_is_refused_before_the_first_step() {
    let Some(device) = device() else { return };
    let views = textured_views();
    let hull = hull();
    let room = |config: &IfaceConfig, device: &Device| {
        let sampler = sampler(&views, Some(&hull), config).unwrap();
        max_samples(config, &shape(config), &sampler, device)
    };
    let config = IfaceConfig { stereo: 0.0, levels: 6, occupancy_resolution: 32, ..config() };
    let e = room(&IfaceConfig { samples: 100_000_000, ..config.clone() }, &device).err().unwrap();
    assert!(e.to_string().contains("has memory for") && e.hint().contains("iface.samples to"), "{e}");
    // what fits beside 512 MiB that are not to be had: nothing at all, or samples, or samples and
    // photographs
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
    use tiface_kernels::gpu::Atomics;
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
    let sampler = sampler(&views, Some(&hull), &config).unwrap();
    let mut both = ways.map(|device| {
        let ops = GpuSdf::new(&config, &sampler, device).unwrap();
        begun(ops, &sampler, Some(&hull), &config, &session)
    });
    let mut best = [f64::INFINITY; 2];
    let mut step = 1;
    // in turn, so that what else the machine does is the same to both; the first round compiles
    for round in 0..12 {
        for (model, best) in both.iter_mut().zip(&mut best) {
            let began = std::time::Instant::now();
            for step in step..step + STEPS {
                counted_step(model, |model| &model.ops.device, session.seed, step, false);
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
        tiface_kernels::gpu::testing::alone("iface::gpu::tests::memory_of_a_training");
    }
}

/// The number of samples equals the capacity, a tenth of the requested number.
#[test]
#[ignore = "run by the test above, in a process of its own"]
fn memory_of_a_training() {
    let views = textured_views();
    let config = IfaceConfig { samples: 1 << 16, ..config() };
    let (hull, dir) = (hull(), temporary());
    let session = on("wgpu:0", dir.path(), &Quiet);
    let sampler = sampler(&views, Some(&hull), &config).unwrap();
    let given = device().unwrap().with_memory(700 << 20);
    let most = given.available_memory();
    let before = given.reserved_memory();
    let ops = GpuSdf::new(&config, &sampler, given).unwrap();
    let model = begun(ops, &sampler, Some(&hull), &config, &session);
    assert!(!model.ops.is_non_finite().unwrap());
    let taken = model.ops.device.reserved_memory() - before;
    println!("{taken} bytes of {most} are taken");
    assert!(taken as f64 <= 1.05 * most as f64 && taken as f64 > 0.8 * most as f64, "{taken} of {most}");
}
