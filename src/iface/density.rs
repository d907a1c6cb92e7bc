//! Instant-NeRF, the paper's baseline for I-Face: a density field in place of the signed distance.
//!
//! It follows instant-nsr-pl's `nerf-blender` configuration, adapted to these captures: a hash grid
//! of base 16, smooth-L1 on the colors of rays with samples, the distortion loss, no mask loss, and
//! masked photographs over black. AdamW starts at a rate of 0.01, which each of three milestones
//! reduces to a third. The mesh is the level set of density 5.

mod cpu;
mod field;
#[cfg(feature = "wgpu")]
mod gpu;

pub use field::DensityField;

use super::occupancy::Occupancy;
use super::schedule;
use super::state::FieldState;
use super::train::IfaceReport;
use crate::config::iface::{Foreground, IfaceConfig, OccupancyRule};
use crate::field::checkpoint::{Checkpoint, TrainingProgress};
use crate::field::ops::{ArrayDevice, Ops};
use crate::field::parameters::{HostGroup, ParameterGroup, ParameterPart};
use crate::field::pixels::RaySampler;
use crate::field::training::{self, Model, StepAt, StepError, StepReport, TrainingSession};
use crate::field::{self as fields, ComputeDevice};
#[cfg(feature = "wgpu")]
use crate::field::{Check, self_test::TestedModel};
use cpu::CpuDensity;
#[cfg(feature = "wgpu")]
pub(super) use gpu::GpuDensity;
use std::time::Instant;
use tiface_base::math::rng;
use tiface_base::{Error, Result};
use tiface_capture::LoadedView;
use tiface_kernels::cpu::adam::AdamStep;
use tiface_kernels::cpu::density::DensityShape;
use tiface_kernels::cpu::hash;
use tiface_kernels::cpu::losses::TERMS;
use tiface_kernels::cpu::schedule::Figures;
#[cfg(feature = "wgpu")]
use tiface_kernels::gpu::Adapter;

/// Version of the checkpoints' layout.
pub(super) const FORMAT: &str = "tiface-density-1";

/// Milestones of the learning rate, as shares of the steps (10, 15 and 18 of 20 thousand), and its
/// factor at each.
const MILESTONES: ([f64; 3], f64) = ([0.5, 0.75, 0.9], 0.33);

/// State of a training between two steps, with the groups hash table and networks.
type DensityState = FieldState<2>;

const NAMES: [&str; 2] = ["table", "network"];

fn shape(config: &IfaceConfig) -> DensityShape {
    let levels = hash::levels(config.levels, config.base_resolution, config.growth, config.log2_table);
    DensityShape { levels, radius: config.radius }
}

/// Returns the initial parameters as in tiny-cuda-nn: U(±1e-4) for the table, Xavier's bounds for
/// the networks, with the last layer padded to 16 outputs.
fn initial(config: &IfaceConfig, seed: u64) -> [HostGroup; 2] {
    let shape = shape(config);
    let entries = hash::entries(&shape.levels) as u64;
    let table: Vec<f32> = (0..2 * entries).map(|i| 2e-4 * rng::uniform(seed, 121, i) - 1e-4).collect();
    let mut network = Vec::new();
    for (k, (rows, columns)) in shape.shapes().into_iter().enumerate() {
        let bound = (6.0 / (rows.max(16) + columns) as f32).sqrt();
        let uniform = |i| bound * (2.0 * rng::uniform(seed, 122 + k as u64, i) - 1.0);
        network.extend((0..(rows * columns) as u64).map(uniform));
    }
    [HostGroup::flat(NAMES[0], table), HostGroup::flat(NAMES[1], network)]
}

/// Returns the parts of both groups, as checkpoints store them.
fn parts(config: &IfaceConfig) -> [Vec<ParameterPart>; 2] {
    let shape = shape(config);
    let lengths = [2 * hash::entries(&shape.levels), shape.len()];
    std::array::from_fn(|k| vec![ParameterPart { name: NAMES[k], shape: vec![lengths[k]] }])
}

/// A density in training on a device.
struct DensityModel<'a, O: DensityOps> {
    config: &'a IfaceConfig,
    session: TrainingSession<'a>,
    ops: O,
    groups: DensityGroups<O>,
    occupancy: Occupancy,
}

/// Trains until `config.steps`, saving checkpoints and continuing from the one that lies in the
/// session's folder. `views` have their cameras in scene coordinates.
pub fn train_density(
    views: &[LoadedView],
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(DensityField, IfaceReport)> {
    check(config)?;
    let began = Instant::now();
    let sampler = RaySampler::new(views, f32::INFINITY, config.radius, Foreground::Photo, true);
    if sampler.count() == 0 {
        return Err(training::no_pixels());
    }
    let device =
        fields::compute_device(session.device, &super::DENSITY_TEST)?.fallback_to_cpu(
            |device| match device {
                ComputeDevice::Cpu(_) => Ok(()),
                #[cfg(feature = "wgpu")]
                ComputeDevice::Gpu(gpu) => GpuDensity::fits(config, &sampler, &gpu.device),
            },
        )?;
    let (description, refused) = (device.description(), device.warning());
    let (state, progress, warnings) = match device {
        ComputeDevice::Cpu(_) => train_on(CpuDensity::new(config, &sampler), config, session)?,
        #[cfg(feature = "wgpu")]
        ComputeDevice::Gpu(gpu) => train_on(GpuDensity::new(config, &sampler, gpu.device)?, config, session)?,
    };
    let report = IfaceReport {
        steps: config.steps,
        seconds: began.elapsed().as_secs_f64(),
        inv_s: 0.0,
        train_psnr: progress.psnr(),
        occupied: state.occupancy.share(),
        device: description,
        warnings: refused.into_iter().chain(warnings).collect(),
    };
    Ok((DensityField::new(config, state), report))
}

fn train_on<O: DensityOps>(
    ops: O,
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(DensityState, TrainingProgress, Vec<String>)> {
    let mut model = DensityModel::new(ops, config, session);
    let (progress, warnings) = training::train(&mut model, session, config.steps, config.checkpoint_s)?;
    Ok((model.state()?, progress, warnings))
}

/// Checks the constraints between settings that ranges of single keys cannot express.
fn check(config: &IfaceConfig) -> Result<()> {
    let wrong = |key: &str, why: &str, hint: &str| Err(Error::usage(format!("`iface.{key}` {why}"), hint));
    if !config.levels.is_multiple_of(4) {
        return wrong("levels", "must be a multiple of 4 for a density", "published are 16");
    }
    if config.occupancy != OccupancyRule::Nerfacc {
        return wrong("field", "is a density, which only preset `paper` learns", "add `--preset paper`");
    }
    Ok(())
}

/// Returns the learning rate of a step relative to the first step's.
fn learning_rate(config: &IfaceConfig, step: u64) -> f64 {
    let (milestones, factor) = MILESTONES;
    let passed = milestones.iter().filter(|m| step as f64 >= **m * config.steps as f64).count();
    factor.powi(passed as i32)
}

impl<'a, O: DensityOps> DensityModel<'a, O> {
    /// Creates the model in its initial state, without looking for a checkpoint.
    fn new(ops: O, config: &'a IfaceConfig, session: &TrainingSession<'a>) -> DensityModel<'a, O> {
        let state = DensityState::start(initial(config, session.seed), config, None);
        let groups = state.groups.map(|group| ParameterGroup::upload(ops.device(), group));
        DensityModel { config, session: *session, ops, groups, occupancy: state.occupancy }
    }

    /// Copies a state to the device.
    fn load(&mut self, state: DensityState) {
        self.ops.load(&state.occupancy, state.rays);
        self.groups = state.groups.map(|group| ParameterGroup::upload(self.ops.device(), group));
        self.occupancy = state.occupancy;
    }

    /// Waits for the device and returns the current state.
    fn state(&self) -> Result<DensityState> {
        let [table, network] = self.groups.each_ref().map(|group| group.download(self.ops.device()));
        let mut occupancy = self.occupancy.clone();
        let rays = self.ops.read(&mut occupancy)?;
        Ok(DensityState { groups: [table?, network?], occupancy, rays, stereo: Vec::new() })
    }
}

impl<O: DensityOps> Model for DensityModel<'_, O> {
    const FORMAT: &'static str = FORMAT;
    const RATES: [&'static str; 2] = ["lr_network", "lr_table"];
    const READ_EVERY: u64 = <O::Device as ArrayDevice>::READ_EVERY;

    fn learning_rate(&self, step: u64) -> f64 {
        self.config.lr_network * learning_rate(self.config, step)
    }

    fn prepare(&mut self, at: StepAt) -> Result<(), StepError> {
        if schedule::updates_occupancy(self.config, at.step) {
            self.ops.update_occupancy(&self.groups, at);
        }
        Ok(())
    }

    fn backward(&mut self, at: StepAt) {
        self.ops.draw(at);
        self.ops.march(&self.groups);
        self.ops.density_field(&self.groups);
        self.ops.losses();
        self.ops.backward(&mut self.groups);
    }

    fn optimize(&mut self, step: u64) {
        let adam_step = AdamStep {
            lr: self.learning_rate(step) as f32,
            beta1: 0.9,
            beta2: 0.99,
            epsilon: 1e-15,
            weight_decay: self.config.weight_decay as f32,
            step: step + 1,
            skip_zero: false,
        };
        self.groups.iter_mut().for_each(|group| group.step(self.ops.device(), &adam_step, self.ops.gate()));
    }

    fn report(&mut self, _: u64) -> Result<StepReport, StepError> {
        let Figures { losses, mean_square, samples, rays, non_finite, .. } = self.ops.figures()?;
        let [square, smooth, distortion, ..] = if samples > 0 { losses } else { [0.0; TERMS] };
        let terms = [("rgb", square), ("smooth", smooth), ("distortion", distortion)];
        let counts = [("rays", rays as f64), ("samples", samples as f64)];
        StepReport::checked(terms, non_finite, mean_square, counts)
    }

    fn save(&self, into: &mut Checkpoint, _: bool) -> Result<(), StepError> {
        if self.ops.is_non_finite()? {
            return Err(StepError::gradient());
        }
        self.state()?.save(into);
        Ok(())
    }

    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError> {
        let state = match from {
            Some((from, ..)) => DensityState::restore(parts(self.config), self.config, None, from)?,
            None => DensityState::start(initial(self.config, self.session.seed), self.config, None),
        };
        self.load(state);
        Ok(())
    }
}

#[cfg(feature = "wgpu")]
impl<O: DensityOps> TestedModel for DensityModel<'_, O> {
    fn host_groups(&self) -> Result<Vec<HostGroup>> {
        Ok(self.state()?.groups.into())
    }
}

/// Compares a training step on a GPU with one on the CPU.
#[cfg(feature = "wgpu")]
pub(super) fn self_test(adapter: &Adapter, config: &IfaceConfig) -> Result<Vec<Check>> {
    use crate::field::self_test::{CELLS_AT, SEED, compare, compare_cells, run_step, session};
    const FIELD: &str = "density";
    let (views, session) = (fields::ball::views(), session("iface"));
    let sampler = RaySampler::new(&views, f32::INFINITY, config.radius, Foreground::Photo, true);
    // Larger values imitate a partly trained field: it is visible, and varies in space.
    let start = || {
        let mut state = DensityState::start(initial(config, SEED), config, None);
        let [table, network] = &mut state.groups;
        table.state[0].iter_mut().enumerate().for_each(|(i, v)| *v = rng::normal(SEED, 1, i as u64));
        network.state[0].iter_mut().for_each(|v| *v *= 1.5);
        state
    };
    fn cells<O: DensityOps>(model: &mut DensityModel<O>, start: DensityState) -> Result<Occupancy> {
        model.load(start);
        model.ops.update_occupancy(&model.groups, StepAt { seed: SEED, step: CELLS_AT });
        Ok(model.state()?.occupancy)
    }
    let mut on_cpu = DensityModel::new(CpuDensity::new(config, &sampler), config, &session);
    let device = tiface_kernels::gpu::Device::open(adapter)?;
    let mut on_gpu = DensityModel::new(GpuDensity::new(config, &sampler, device)?, config, &session);
    let [want, got] = [cells(&mut on_cpu, start())?, cells(&mut on_gpu, start())?];
    let mut checks = vec![compare_cells(FIELD, &got.occupied.bits, &want.occupied.bits)];
    on_cpu.load(DensityState { occupancy: want.clone(), ..start() });
    on_gpu.load(DensityState { occupancy: want, ..start() });
    checks.extend(compare(FIELD, &run_step(&mut on_gpu)?, &run_step(&mut on_cpu)?));
    Ok(checks)
}

/// Opacity of a march step above which a cell is marched through.
pub const OCCUPIED: f32 = 0.01;

/// Hash table and networks.
pub type DensityGroups<O> = [ParameterGroup<<O as Ops>::Device>; 2];

/// The operations of a training step on one device. Intermediate results of a step stay on the
/// device, in the value that implements this trait.
pub trait DensityOps: Ops {
    /// Starts or resumes a training with the given cells to march through and number of rays of the
    /// next step.
    fn load(&mut self, occupancy: &Occupancy, rays: usize);

    /// Waits for the device, reads the cells to march through, and returns the number of rays of
    /// the next step.
    fn read(&self, occupancy: &mut Occupancy) -> Result<usize>;

    /// Waits for the device and returns whether any gradient was not finite since the state was
    /// loaded.
    fn is_non_finite(&self) -> Result<bool>;

    /// Evaluates the field to update the cells that are marched through.
    fn update_occupancy(&mut self, groups: &DensityGroups<Self>, at: StepAt);

    /// Draws rays; their number follows from the samples of the last step.
    fn draw(&mut self, at: StepAt);

    /// Marches the rays up to where the transmittance has vanished.
    fn march(&mut self, groups: &DensityGroups<Self>);

    /// Evaluates the field at the samples.
    fn density_field(&mut self, groups: &DensityGroups<Self>);

    /// Composites the samples of each ray, and computes losses and their gradients with respect to
    /// the field's output.
    fn losses(&mut self);

    /// Computes the gradients of the parameters, and closes the [gate](Ops::gate) if one is not
    /// finite.
    fn backward(&mut self, groups: &mut DensityGroups<Self>);

    /// Waits for the device and returns the figures of the last step, whose first losses are
    /// squared error, smooth-L1 and distortion.
    fn figures(&mut self) -> Result<Figures>;
}

#[cfg(test)]
#[path = "density_tests.rs"]
mod tests;
