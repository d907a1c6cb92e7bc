//! Instant-NeRF, the row that the paper's I-Face is compared with: a density where I-Face has a distance.
//!
//! instant-nsr-pl's `nerf-blender` configuration for these captures: hash grid of base 16, smooth-L1 on the colors of
//! rays that met something, the distortion loss, no mask loss, masked photographs over black; AdamW at 0.01, which three
//! milestones take to a third each. Meshed where the density is 5. On the CPU alone.

use super::occupancy::Occupancy;
use super::schedule::step_length;
use super::train::IfaceReport;
use crate::config::DeviceChoice;
use crate::config::iface::{Foreground, IfaceConfig, OccupancyRule};
use crate::field::checkpoint::{self, Checkpoint, TrainingProgress};
use crate::field::ops::{ArrayDevice, Cpu, Ops, slice, slice_mut};
use crate::field::parameters::{HostGroup, ParameterGroup};
use crate::field::pixels::{Batch, Pixels, TrainView};
use crate::field::training::{self, Model, StepAt, StepError, StepReport, TrainingSession};
use crate::geom::{Ray, RayResult};
use crate::kernel::cpu::adam::AdamStep;
use crate::kernel::cpu::density::{self, DensitySamples, DensityShape, DensityWeights};
use crate::kernel::cpu::march::{Bitmask, MarchRay, Samples};
use crate::kernel::cpu::schedule::RayBudget;
use crate::kernel::cpu::{hash, rng};
use crate::{Error, Result};
use glam::Vec3;
use std::path::Path;
use std::time::Instant;

/// Version of the checkpoints' layout.
const FORMAT: &str = "tiface-density-1";

/// Weight of the distortion.
const DISTORTION: f64 = 0.001;

/// Milestones of the learning rate, as shares of the steps (10, 15 and 18 of 20 thousand), and what each leaves of it.
const MILESTONES: ([f64; 3], f64) = ([0.5, 0.75, 0.9], 0.33);

/// The density that the surface has.
const LEVEL: f32 = 5.0;

/// Cells above so much opacity of a march step are marched through.
const OCCUPIED: f32 = 0.01;

/// A ray ends where less of its light is left.
const DARK: f32 = 1e-4;

/// Training between two steps.
struct DensityState {
    /// Hash table and networks.
    groups: [HostGroup; 2],
    occupancy: Occupancy,
    /// Rays of the next step.
    rays: usize,
}

const NAMES: [&str; 2] = ["table", "network"];

fn shape(config: &IfaceConfig) -> DensityShape {
    let levels = hash::levels(config.levels, config.base_resolution, config.growth, config.log2_table);
    DensityShape { levels, radius: config.radius }
}

/// How the rays of a step follow the samples of the one before it.
fn ray_budget(config: &IfaceConfig) -> RayBudget {
    RayBudget { samples: config.samples, min: 1, max: config.max_rays }
}

impl DensityState {
    /// U(±1e-4) for the table, Xavier's bounds for the networks, the last layer's as if it had 16 outputs: tiny-cuda-nn.
    fn new(config: &IfaceConfig, seed: u64) -> DensityState {
        let shape = shape(config);
        let entries = hash::entries(&shape.levels) as u64;
        let table: Vec<f32> = (0..2 * entries).map(|i| 2e-4 * rng::uniform(seed, 121, i) - 1e-4).collect();
        let mut network = Vec::new();
        for (k, (rows, columns)) in shape.shapes().into_iter().enumerate() {
            let bound = (6.0 / (rows.max(16) + columns) as f32).sqrt();
            let uniform = |i| bound * (2.0 * rng::uniform(seed, 122 + k as u64, i) - 1.0);
            network.extend((0..(rows * columns) as u64).map(uniform));
        }
        let groups = [HostGroup::flat(NAMES[0], table), HostGroup::flat(NAMES[1], network)];
        DensityState { groups, occupancy: Occupancy::new(config, None), rays: config.rays }
    }

    fn save(&self, into: &mut Checkpoint) {
        self.groups.iter().for_each(|group| group.save(into, true));
        into.put_words("occupancy.occupied", self.occupancy.occupied.bits.clone());
        into.put_floats("occupancy.history", &[self.occupancy.history.len()], self.occupancy.history.clone());
        into.set("rays", self.rays);
    }

    fn restore(config: &IfaceConfig, from: &mut Checkpoint) -> Result<DensityState> {
        let mut state = DensityState::new(config, 0);
        for group in &mut state.groups {
            *group = HostGroup::restore(group.parts.clone(), from, true)?;
        }
        let o = &mut state.occupancy;
        o.history = from.floats("occupancy.history", &[o.history.len()])?;
        let bits = from.words("occupancy.occupied")?;
        o.occupied = Bitmask::of(o.occupied.resolution, bits)
            .ok_or_else(|| from.wrong("tensor `occupancy.occupied` has another size".into()))?;
        let most = config.rays.max(config.max_rays) as u64;
        state.rays = from.number("rays", 1..=most)? as usize;
        Ok(state)
    }
}

/// Samples along rays in marked cells, up to where the light is gone.
fn march(
    config: &IfaceConfig,
    occupancy: &Occupancy,
    (shape, table, weights): (&DensityShape, &[[f32; 2]], &DensityWeights),
    rays: &[MarchRay],
) -> Samples {
    let dt = step_length(config).at(0.0);
    let all = occupancy.march(config, dt, rays);
    let (x, _) = all.points(rays, 0);
    let found = density::evaluate(shape, table, weights, &x, None).density;
    let mut kept = Samples { offsets: vec![0], t: Vec::new() };
    for own in all.offsets.windows(2) {
        let mut thickness = 0f32;
        for s in own[0] as usize..own[1] as usize {
            if (-thickness).exp() < DARK {
                break;
            }
            kept.t.push(all.t[s]);
            thickness += found[s] * dt;
        }
        kept.offsets.push(kept.t.len() as i32);
    }
    kept
}

/// Hash table and networks.
type DensityGroups<O> = [ParameterGroup<<O as Ops>::Device>; 2];

/// The operations of a training step on one device, in the order of the step.
trait DensityOps: Ops {
    /// Begins a training, or goes on with one: the cells to march through, and the rays of the next step.
    fn load(&mut self, occupancy: &Occupancy, rays: usize);

    /// Waits for the device; the cells to march through, and the rays of the next step.
    fn read(&self, occupancy: &mut Occupancy) -> Result<usize>;

    /// Waits for the device: was a gradient not finite since the state was loaded?
    fn is_broken(&self) -> Result<bool>;

    /// Evaluates the field again to find the cells that may hold something.
    fn update_occupancy(&mut self, groups: &DensityGroups<Self>, at: StepAt);

    /// Draws as many rays as the samples of the last step leave for this one.
    fn draw(&mut self, at: StepAt);

    /// Marches them up to where the light is gone.
    fn march(&mut self, groups: &DensityGroups<Self>);

    /// Evaluates the field at the samples, composites them, and leaves the gradients of the losses by its output.
    fn losses(&mut self, groups: &DensityGroups<Self>);

    /// Gradients of the parameters; closes the [gate](Ops::gate) where one is not finite.
    fn backward(&mut self, groups: &mut DensityGroups<Self>);

    /// Waits for the device and returns what the last step came to.
    fn figures(&mut self) -> Result<DensityFigures>;
}

/// What a step came to.
struct DensityFigures {
    /// Squared and smooth-L1 error of the colors, distortion.
    terms: [f32; 3],
    samples: usize,
    /// Rays of the next step.
    rays: usize,
    /// Was a gradient not finite?
    broken: bool,
}

/// The operations on the processor.
struct CpuDensity<'a> {
    config: &'a IfaceConfig,
    pixels: &'a Pixels<'a>,
    shape: DensityShape,
    occupancy: Occupancy,
    rays: usize,
    /// Samples of the last step; none before the first one.
    last_samples: Option<usize>,
    batch: Batch,
    samples: Samples,
    found: Option<(DensityWeights, DensitySamples)>,
    terms: [f32; 3],
    /// By densities and colors of the samples.
    gradients: (Vec<f32>, Vec<[f32; 3]>),
    broken: bool,
}

impl<'a> CpuDensity<'a> {
    fn new(config: &'a IfaceConfig, pixels: &'a Pixels<'a>) -> CpuDensity<'a> {
        CpuDensity {
            config,
            pixels,
            shape: shape(config),
            occupancy: Occupancy::new(config, None),
            rays: config.rays,
            last_samples: None,
            batch: Batch::default(),
            samples: Samples::default(),
            found: None,
            terms: [0.0; 3],
            gradients: Default::default(),
            broken: false,
        }
    }

    fn next_rays(&self) -> usize {
        self.last_samples.map_or(self.rays, |n| ray_budget(self.config).next(self.rays, n))
    }

    fn field<'g>(&self, [table, network]: &'g DensityGroups<Self>) -> (&'g [[f32; 2]], DensityWeights) {
        let table = bytemuck::cast_slice(slice(table.value()));
        (table, DensityWeights::new(&self.shape, slice(network.value())))
    }
}

impl Ops for CpuDensity<'_> {
    type Device = Cpu;

    fn device(&self) -> &Cpu {
        &Cpu
    }

    fn gate(&self) -> bool {
        !self.samples.t.is_empty() && !self.broken
    }
}

impl DensityOps for CpuDensity<'_> {
    fn load(&mut self, occupancy: &Occupancy, rays: usize) {
        self.occupancy = occupancy.clone();
        (self.rays, self.last_samples, self.broken) = (rays, None, false);
    }

    fn read(&self, occupancy: &mut Occupancy) -> Result<usize> {
        *occupancy = self.occupancy.clone();
        Ok(self.next_rays())
    }

    fn is_broken(&self) -> Result<bool> {
        Ok(self.broken)
    }

    fn update_occupancy(&mut self, groups: &DensityGroups<Self>, at: StepAt) {
        let (table, weights) = self.field(groups);
        let (shape, dt) = (&self.shape, step_length(self.config).at(0.0));
        let opacity = |x: &[[f32; 3]]| {
            let found = density::evaluate(shape, table, &weights, x, None);
            found.density.into_iter().map(|s| s * dt).collect()
        };
        self.occupancy.look((at.seed, at.step), self.config.radius, OCCUPIED, opacity);
    }

    fn draw(&mut self, at: StepAt) {
        self.rays = self.next_rays();
        self.batch = self.pixels.draw(at.seed, at.step, self.rays, self.config.jitter, 0.0);
    }

    fn march(&mut self, groups: &DensityGroups<Self>) {
        let (table, weights) = self.field(groups);
        let field = (&self.shape, table, &weights);
        self.samples = march(self.config, &self.occupancy, field, &self.batch.rays);
        self.last_samples = Some(self.samples.t.len());
        self.found = None;
        if !self.samples.t.is_empty() {
            let (x, d) = self.samples.points(&self.batch.rays, 0);
            let found = density::evaluate(&self.shape, table, &weights, &x, Some(&d));
            self.found = Some((weights, found));
        }
    }

    fn losses(&mut self, _: &DensityGroups<Self>) {
        let Some((_, found)) = &self.found else { return };
        let dt = step_length(self.config).at(0.0);
        let (terms, g_density, g_color) = losses(&self.batch, &self.samples, found, dt);
        (self.terms, self.gradients) = (terms, (g_density, g_color));
    }

    fn backward(&mut self, [table, network]: &mut DensityGroups<Self>) {
        let Some((weights, found)) = self.found.take() else { return };
        let g_table = bytemuck::cast_slice_mut(slice_mut(&mut table.gradient));
        let by = (&self.gradients.0[..], &self.gradients.1[..]);
        let g_network = density::backward(&self.shape, &weights, &found, by, g_table);
        self.broken |= !g_network.iter().chain(&self.terms).all(|g| g.is_finite());
        slice_mut(&mut network.gradient).copy_from_slice(&g_network);
    }

    fn figures(&mut self) -> Result<DensityFigures> {
        let (samples, rays) = (self.samples.t.len(), self.next_rays());
        Ok(DensityFigures { terms: self.terms, samples, rays, broken: self.broken })
    }
}

/// A density in training on a device.
struct DensityModel<'a, O: DensityOps> {
    config: &'a IfaceConfig,
    session: TrainingSession<'a>,
    ops: O,
    groups: DensityGroups<O>,
    occupancy: Occupancy,
}

/// Trains until `config.steps`, saving checkpoints and continuing from the one that lies in the session's folder.
/// `views` have their cameras in scene coordinates.
pub fn train_density(
    views: &[TrainView],
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(DensityField, IfaceReport)> {
    check(config, session.device)?;
    let began = Instant::now();
    let pixels = Pixels::new(views, f32::INFINITY, config.radius, Foreground::Photo, true);
    if pixels.count() == 0 {
        return Err(training::no_pixels());
    }
    let mut model = DensityModel::new(CpuDensity::new(config, &pixels), config, session);
    let (progress, warnings) = training::train(&mut model, session, config.steps, config.checkpoint_s)?;
    let state = model.state()?;
    let report = IfaceReport {
        steps: config.steps,
        seconds: began.elapsed().as_secs_f64(),
        inv_s: 0.0,
        train_psnr: progress.psnr(),
        occupied: state.occupancy.share(),
        device: crate::field::ComputeDevice::Cpu(String::new()).description(),
        warnings,
    };
    Ok((DensityField::new(config, state), report))
}

/// What ranges of single keys cannot say.
fn check(config: &IfaceConfig, device: &str) -> Result<()> {
    if DeviceChoice::parse(device).is_none_or(|choice| !["cpu", "auto"].contains(&choice.name.as_str())) {
        let problem = format!("device `{device}` has no kernels for `iface.field = \"density\"`");
        return Err(Error::usage(
            problem,
            "use `--device cpu`, or learn a distance: `iface.field = \"sdf\"`",
        ));
    }
    let wrong = |key: &str, why: &str, hint: &str| Err(Error::usage(format!("`iface.{key}` {why}"), hint));
    if !config.levels.is_multiple_of(4) {
        return wrong("levels", "must be a multiple of 4 for a density", "published are 16");
    }
    if config.occupancy != OccupancyRule::Nerfacc {
        return wrong("field", "is a density, which only preset `paper` learns", "add `--preset paper`");
    }
    Ok(())
}

/// Learning rate of a step, as a share of the first.
fn learning_rate(config: &IfaceConfig, step: u64) -> f64 {
    let (milestones, factor) = MILESTONES;
    let passed = milestones.iter().filter(|m| step as f64 >= **m * config.steps as f64).count();
    factor.powi(passed as i32)
}

/// Color and distortion losses of a batch, and their gradients by densities and colors of the samples.
fn losses(
    batch: &Batch,
    samples: &Samples,
    found: &density::DensitySamples,
    dt: f32,
) -> ([f32; 3], Vec<f32>, Vec<[f32; 3]>) {
    let rays = || samples.offsets.windows(2).map(|o| o[0] as usize..o[1] as usize).enumerate();
    let met = rays().filter(|(_, own)| !own.is_empty()).count().max(1) as f32;
    // nerfacc's mean is over the rays up to the last one that met something
    let last = samples.offsets.windows(2).rposition(|o| o[1] > o[0]).map_or(1, |r| r + 1) as f32;
    let (mut g_density, mut g_color) = (vec![0f32; samples.t.len()], vec![[0f32; 3]; samples.t.len()]);
    let (mut smooth, mut square, mut spread) = (0f64, 0f64, 0f64);
    for (r, own) in rays().filter(|(_, own)| !own.is_empty()) {
        let weight = density::weights(&found.density[own.clone()], dt);
        let color = &found.color[own.clone()];
        let mut seen = [0f32; 3];
        for (w, c) in weight.iter().zip(color) {
            (0..3).for_each(|k| seen[k] += w * c[k]);
        }
        let error: [f32; 3] = std::array::from_fn(|k| seen[k] - batch.color[r][k]);
        for e in error.map(f64::from) {
            square += e * e;
            smooth += if e.abs() < 1.0 { 0.5 * e * e } else { e.abs() - 0.5 };
        }
        let g = error.map(|e| e.clamp(-1.0, 1.0) / (3.0 * met));
        let (value, g_spread) = density::distortion(&weight, &samples.t[own.clone()], dt);
        spread += f64::from(value / last);
        let g_weight: Vec<f32> = g_spread
            .iter()
            .zip(color)
            .map(|(s, c)| DISTORTION as f32 / last * s + g[0] * c[0] + g[1] * c[1] + g[2] * c[2])
            .collect();
        for (g_color, w) in g_color[own.clone()].iter_mut().zip(&weight) {
            *g_color = g.map(|g| w * g);
        }
        let by_density = density::weights_backward(&found.density[own.clone()], &weight, &g_weight, dt);
        g_density[own].copy_from_slice(&by_density);
    }
    let n = f64::from(3.0 * met);
    ([(square / n) as f32, (smooth / n) as f32, spread as f32], g_density, g_color)
}

impl<'a, O: DensityOps> DensityModel<'a, O> {
    /// Before the first step; a checkpoint is not looked for yet.
    fn new(ops: O, config: &'a IfaceConfig, session: &TrainingSession<'a>) -> DensityModel<'a, O> {
        let DensityState { groups, occupancy, .. } = DensityState::new(config, session.seed);
        let groups = groups.map(|group| ParameterGroup::upload(ops.device(), group));
        DensityModel { config, session: *session, ops, groups, occupancy }
    }

    /// Waits for the device; the state as it is there.
    fn state(&self) -> Result<DensityState> {
        let [table, network] = self.groups.each_ref().map(|group| group.download(self.ops.device()));
        let mut occupancy = self.occupancy.clone();
        let rays = self.ops.read(&mut occupancy)?;
        Ok(DensityState { groups: [table?, network?], occupancy, rays })
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
        if at.step.is_multiple_of(self.config.occupancy_every) {
            self.ops.update_occupancy(&self.groups, at);
        }
        Ok(())
    }

    fn backward(&mut self, at: StepAt) {
        self.ops.draw(at);
        self.ops.march(&self.groups);
        self.ops.losses(&self.groups);
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
        let DensityFigures { terms, samples, rays, broken } = self.ops.figures()?;
        let terms = if samples > 0 { terms } else { [0.0; 3] };
        let terms = ["rgb", "smooth", "distortion"].into_iter().zip(terms);
        StepError::check(terms.clone())?;
        if broken {
            return Err(StepError::gradient());
        }
        let mut figures: Vec<_> = terms.map(|(name, value)| (name, f64::from(value))).collect();
        figures.extend([("rays", rays as f64), ("samples", samples as f64)]);
        let square_error = (samples > 0).then_some(figures[0].1 as f32);
        Ok(StepReport { square_error, figures })
    }

    fn save(&self, into: &mut Checkpoint, _: bool) -> Result<(), StepError> {
        if self.ops.is_broken()? {
            return Err(StepError::gradient());
        }
        self.state()?.save(into);
        Ok(())
    }

    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError> {
        let state = match from {
            Some((from, ..)) => DensityState::restore(self.config, from)?,
            None => DensityState::new(self.config, self.session.seed),
        };
        self.ops.load(&state.occupancy, state.rays);
        self.groups = state.groups.map(|group| ParameterGroup::upload(self.ops.device(), group));
        self.occupancy = state.occupancy;
        Ok(())
    }
}

/// The trained field. Positions are in scene units, the box is [-1, 1]³.
pub struct DensityField {
    config: IfaceConfig,
    shape: DensityShape,
    table: Vec<f32>,
    weights: DensityWeights,
    occupancy: Occupancy,
}

impl DensityField {
    fn new(config: &IfaceConfig, state: DensityState) -> DensityField {
        let shape = shape(config);
        let DensityState { groups: [table, network], occupancy, .. } = state;
        let [table, ..] = table.state;
        let weights = DensityWeights::new(&shape, network.values());
        DensityField { config: config.clone(), shape, table, weights, occupancy }
    }

    /// Loads the field from the checkpoint in a stage folder. `config` is what it was trained with.
    pub fn load(dir: &Path, config: &IfaceConfig) -> Result<DensityField> {
        let mut file = Checkpoint::read(&checkpoint::newest(dir), "iface", FORMAT)?;
        TrainingProgress::restore(&file, config.steps)?;
        Ok(DensityField::new(config, DensityState::restore(config, &mut file)?))
    }

    fn table(&self) -> &[[f32; 2]] {
        bytemuck::cast_slice(&self.table)
    }

    fn scaled(&self, points: &[Vec3]) -> Vec<[f32; 3]> {
        points.iter().map(|p| (*p * self.config.radius).to_array()).collect()
    }

    fn density(&self, points: &[Vec3]) -> Vec<f32> {
        let look = |points: &[Vec3]| {
            density::evaluate(&self.shape, self.table(), &self.weights, &self.scaled(points), None).density
        };
        points.chunks(1 << 16).flat_map(look).collect()
    }

    /// What is left to the surface's density: negative inside. `[n]` points → `[n]`.
    pub fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        self.density(points).into_iter().map(|s| LEVEL - s).collect()
    }

    /// The same and its gradient, by differences over a thousandth of the box.
    pub fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        const STEP: f32 = 2e-3;
        let along = |axis: Vec3| -> Vec<f32> {
            let moved =
                |sign: f32| self.density(&points.iter().map(|p| *p + sign * STEP * axis).collect::<Vec<_>>());
            let difference = |(a, b): (f32, f32)| (a - b) / (2.0 * STEP);
            moved(-1.0).into_iter().zip(moved(1.0)).map(difference).collect()
        };
        let [x, y, z] = [Vec3::X, Vec3::Y, Vec3::Z].map(along);
        (self.sdf(points), (0..points.len()).map(|i| Vec3::new(x[i], y[i], z[i])).collect())
    }

    /// sRGB-coded colors of points, point `i` seen along `counts[i]` unit `directions`, all in one list.
    pub fn colors(&self, points: &[Vec3], counts: &[u32], directions: &[Vec3]) -> Vec<[f32; 3]> {
        let places = self.scaled(points).into_iter().zip(counts);
        let x: Vec<[f32; 3]> = places.flat_map(|(p, n)| std::iter::repeat_n(p, *n as usize)).collect();
        let d: Vec<[f32; 3]> = directions.iter().map(|d| d.to_array()).collect();
        let look = |(x, d): (&[[f32; 3]], &[[f32; 3]])| {
            density::evaluate(&self.shape, self.table(), &self.weights, x, Some(d)).color
        };
        x.chunks(1 << 16).zip(d.chunks(1 << 16)).flat_map(look).collect()
    }

    /// Volume render of rays in scene coordinates.
    pub fn render(&self, rays: &[Ray]) -> Vec<RayResult> {
        const PASS: usize = 1 << 10;
        rays.chunks(PASS).flat_map(|rays| self.pass(rays)).collect()
    }

    fn pass(&self, rays: &[Ray]) -> Vec<RayResult> {
        let radius = self.config.radius;
        let marched = |r: &Ray| MarchRay {
            origin: (r.origin * radius).to_array(),
            direction: r.direction.to_array(),
            jitter: 0.0,
        };
        let rays: Vec<MarchRay> = rays.iter().map(marched).collect();
        let field = (&self.shape, self.table(), &self.weights);
        let samples = march(&self.config, &self.occupancy, field, &rays);
        let (x, d) = samples.points(&rays, 0);
        let found = density::evaluate(&self.shape, self.table(), &self.weights, &x, Some(&d));
        let dt = step_length(&self.config).at(0.0);
        let seen = |own: &[i32]| {
            let own = own[0] as usize..own[1] as usize;
            let weight = density::weights(&found.density[own.clone()], dt);
            let (mut color, mut opacity, mut depth) = ([0f32; 3], 0f32, 0f32);
            for ((w, c), t) in weight.iter().zip(&found.color[own.clone()]).zip(&samples.t[own]) {
                (0..3).for_each(|k| color[k] += w * c[k]);
                (opacity, depth) = (opacity + w, depth + w * t);
            }
            let depth = if opacity > 0.0 { depth / opacity / radius } else { 0.0 };
            RayResult { color, opacity: opacity.min(1.0), depth, normal: Vec3::ZERO }
        };
        samples.offsets.windows(2).map(seen).collect()
    }
}

#[cfg(test)]
#[path = "density_tests.rs"]
mod tests;
