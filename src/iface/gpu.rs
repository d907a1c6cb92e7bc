//! A training step of the signed-distance field on a GPU. Sampling, marching, evaluation, losses
//! and optimizer all run on the device, so the host never waits within a step.

use super::infer::DeviceField;
use super::model::shape;
use super::occupancy::{Occupancy, band};
use super::ops::{
    BACKGROUND_STREAM, MAX_BUDGETS, STEREO_POINTS, SdfGroups, SdfOps, VARIANCE, color_rule, loss_weights,
    random_background,
};
use super::schedule;
use super::stereo::SurfacePoint;
use crate::config::iface::{IfaceConfig, OccupancyRule};
use crate::field::drawing::DeviceSampler;
use crate::field::memory::MemoryNeed;
use crate::field::ops::Ops;
use crate::field::pixels::RaySampler;
use crate::field::training::StepAt;
use std::ops::Range;
use tiface_base::geom::Ray;
use tiface_base::{Error, Result};
use tiface_kernels::cpu::hash;
use tiface_kernels::cpu::mlp::TILE;
use tiface_kernels::cpu::neus::{ColorRule, RAY_WIDTH};
use tiface_kernels::cpu::occupancy::OPAQUE;
use tiface_kernels::cpu::schedule::Figures;
use tiface_kernels::cpu::sdf::FieldShape;
use tiface_kernels::gpu::{
    self, BandUpdate, Buffer, Device, DeviceBatch, Gate, Losses, Nerfacc, Neus, Samples, SamplingOptions,
    Schedule, Sdf, SurfacePoints, WeightNorm, Words,
};

/// Rule that updates the cells to march through.
enum CellRule {
    Band(Box<BandUpdate>),
    Nerfacc(Box<Nerfacc>),
}

/// The operations of [`SdfOps`] on a GPU, with their device memory.
pub struct GpuSdf<'a> {
    config: &'a IfaceConfig,
    sampler: &'a RaySampler<'a>,
    pub(super) device: Device,
    photographs: DeviceSampler,
    batch: DeviceBatch,
    samples: Samples,
    points: SurfacePoints,
    /// `[1]`: samples and points of the step.
    total_count: Buffer,
    norm: WeightNorm,
    sdf: Sdf,
    neus: Neus,
    losses: Losses,
    flat: Buffer,
    g_flat: Buffer,
    inv_s: Buffer,
    g_inv_s: Buffer,
    /// `[1]`: not 0 once a gradient was not finite.
    non_finite: Buffer,
    schedule: Schedule,
    occupancy: gpu::Occupancy,
    cells: CellRule,
    /// Whether a step was made since the state was loaded.
    stepped: bool,
}

impl<'a> GpuSdf<'a> {
    /// Checks that a device supports the field and has enough memory for the training.
    pub fn fits(config: &IfaceConfig, sampler: &RaySampler, device: &Device) -> Result<()> {
        let shape = shape(config);
        if !Sdf::supports(&shape) {
            let problem = format!("a tile on a GPU cannot hold {} levels", config.levels);
            return Err(Error::usage(problem, "lower iface.levels, or train with `--device cpu`"));
        }
        max_samples(config, &shape, sampler, device).map(drop)
    }

    /// Creates the operations of a training that [`fits`](GpuSdf::fits) a device.
    ///
    /// # Errors
    ///
    /// If the device has too little memory.
    pub fn new(config: &'a IfaceConfig, sampler: &'a RaySampler<'a>, device: Device) -> Result<GpuSdf<'a>> {
        let shape = shape(config);
        let rays = config.rays.max(config.max_rays);
        let (capacity, resident) = max_samples(config, &shape, sampler, &device)?;
        let weights = loss_weights(config, sampler.has_masks);
        let drawing = SamplingOptions {
            jitter: config.jitter,
            background: random_background(config),
            background_stream: BACKGROUND_STREAM,
        };
        let flat = shape.layout().len();
        let start = Occupancy::new(config, None);
        let (occupancy, cells) = cells(&device, config, &start, capacity);
        Ok(GpuSdf {
            config,
            sampler,
            photographs: DeviceSampler::new(sampler, &device, drawing, resident),
            batch: DeviceBatch::new(&device, rays),
            samples: Samples::new(&device, rays, capacity),
            points: SurfacePoints::new(&device, stereo_points(config), &weights),
            total_count: device.zeros::<u32>(1),
            norm: WeightNorm::new(&device, shape.layout()),
            sdf: Sdf::new(&device, &shape, capacity),
            neus: Neus::new(&device, rays, capacity, color_rule(config)),
            losses: Losses::new(&device, weights, rays, capacity),
            flat: device.zeros::<f32>(flat),
            g_flat: device.zeros::<f32>(flat),
            inv_s: device.zeros::<f32>(1),
            g_inv_s: device.zeros::<f32>(1),
            non_finite: device.zeros::<u32>(1),
            schedule: Schedule::new(
                &device,
                schedule::step_length(config),
                schedule::ray_budget(config),
                config.rays,
            ),
            occupancy,
            cells,
            stepped: false,
            device,
        })
    }

    /// Evaluates the colors of points that are given their normals, planes `[3, points]`.
    pub(super) fn colors(
        &self,
        [table, ..]: &SdfGroups<Self>,
        points: &[[f32; 3]],
        directions: &[[f32; 3]],
        normals: &[[f32; 3]],
    ) -> Result<Vec<f32>> {
        let (device, capacity) = (&self.device, self.samples.t.word_count());
        let [x, direction, normal] = [points, directions, normals]
            .map(|rows| device.upload(&gpu::planes(&rows[..points.len()], capacity)));
        let count = device.upload(&[points.len() as u32]);
        let field = [table.value(), &self.flat];
        let out: Vec<f32> =
            device.fetch(self.sdf.shade(device, field, &x, &direction, Some(&normal), &count))?;
        Ok((4..7).flat_map(|k| &out[k * capacity..][..points.len()]).copied().collect())
    }
}

/// Returns the capacity for stereo points of a step.
fn stereo_points(config: &IfaceConfig) -> usize {
    if config.stereo > 0.0 { STEREO_POINTS as usize } else { 1 }
}

/// Returns the sample capacity of a step, which equals the CPU's if the device's memory and buffers
/// are large enough, and whether the photographs fit on the device as well.
pub(super) fn max_samples(
    config: &IfaceConfig,
    shape: &FieldShape,
    sampler: &RaySampler,
    device: &Device,
) -> Result<(usize, bool)> {
    /// Words per sample outside the field: positions, directions, steps, compositing, losses, and
    /// the index of the cell that takes the sample's place during an occupancy update.
    const EXTRA_WORDS: usize = 3 + 3 + 2 + 10 + 2 + 1;
    let [words, widest] = Sdf::words_per_sample(shape);
    let points = stereo_points(config);
    let sums = Sdf::words_of_sums(shape, wanted_samples(config, points));
    samples_that_fit(config, [words + EXTRA_WORDS, widest], sums, points, sampler, device)
}

/// Returns the sample capacity of a step that the CPU has, with `points` besides its samples.
pub(super) fn wanted_samples(config: &IfaceConfig, points: usize) -> usize {
    MAX_BUDGETS * config.samples + points
}

/// Computes [`max_samples`] for any field on a hash grid, from its words per sample in all buffers
/// and in the largest one, its words for sums, and the number of points it evaluates besides the
/// samples of a step.
pub(super) fn samples_that_fit(
    config: &IfaceConfig,
    [words, widest]: [usize; 2],
    sums: usize,
    points: usize,
    sampler: &RaySampler,
    device: &Device,
) -> Result<(usize, bool)> {
    let bytes = 4 * words as u64;
    // The tables hold values, two moments and the gradient. A cell has its index, two words of its
    // rule (distance and reach, or history and last draw), and bits.
    let cells = config.occupancy_resolution.pow(3) as u64;
    let fixed = |log2_table: u32| {
        let levels = hash::levels(config.levels, config.base_resolution, config.growth, log2_table);
        32 * hash::entries(&levels) as u64 + 13 * cells + 4 * sums as u64
    };
    let minimum = (config.samples + points) as u64;
    let wanted = wanted_samples(config, points) as u64;
    let need = MemoryNeed {
        fixed: (fixed(config.log2_table), "hash tables, cells and sums"),
        unit: "samples",
        each: [bytes, 4 * widest as u64],
        wanted,
        minimum,
    };
    let (capacity, resident) = need.plan(sampler, device, |fits| {
        let by_buffer = device.limits().largest_buffer / (4 * widest as u64);
        let left = device.available_memory().checked_sub(minimum * bytes).filter(|_| by_buffer >= minimum);
        let smaller = left.and_then(|left| (4..config.log2_table).rev().find(|&log2| fixed(log2) <= left));
        match (fits.saturating_sub(points as u64), smaller) {
            (fits @ 64.., _) => format!("iface.samples to {fits}"),
            (_, Some(log2)) => format!("iface.log2_table to {log2}"),
            _ => "iface.samples, then iface.log2_table".into(),
        }
    })?;
    // The capacity is a whole number of tiles.
    let whole =
        if capacity as u64 == wanted { capacity.next_multiple_of(TILE) } else { capacity / TILE * TILE };
    Ok((whole, resident))
}

/// Creates the cells to march through, and the rule that updates them.
fn cells(
    device: &Device,
    config: &IfaceConfig,
    start: &Occupancy,
    capacity: usize,
) -> (gpu::Occupancy, CellRule) {
    let solid = (config.occupancy == OccupancyRule::Band).then_some(&start.solid);
    let cells = gpu::Occupancy::new(device, &start.occupied, solid, config.radius);
    let rule = match config.occupancy {
        OccupancyRule::Band => {
            CellRule::Band(Box::new(BandUpdate::new(device, start.allowed(), band(config))))
        }
        OccupancyRule::Nerfacc => {
            let rule = Nerfacc::new(device, &cells, &start.history, OPAQUE, capacity);
            CellRule::Nerfacc(Box::new(rule))
        }
    };
    (cells, rule)
}

impl Ops for GpuSdf<'_> {
    type Device = Device;

    fn device(&self) -> &Device {
        &self.device
    }

    fn gate(&self) -> Gate<'_> {
        Gate { count: &self.samples.count, non_finite: &self.non_finite }
    }
}

impl SdfOps for GpuSdf<'_> {
    fn load(&mut self, occupancy: &Occupancy, rays: usize, points: &[SurfacePoint]) {
        let (device, config) = (&self.device, self.config);
        (self.occupancy, self.cells) = cells(device, config, occupancy, self.samples.t.word_count());
        let budget = schedule::ray_budget(config);
        self.schedule = Schedule::new(device, schedule::step_length(config), budget, rays);
        self.non_finite = device.zeros::<u32>(1);
        self.losses.reset_sums(device);
        self.stepped = false;
        self.set_points(points);
    }

    fn set_points(&mut self, points: &[SurfacePoint]) {
        self.points.set(&self.device, bytemuck::cast_slice(points));
    }

    fn read(&self, occupancy: &mut Occupancy) -> Result<usize> {
        occupancy.replace(self.occupancy.read(&self.device)?);
        if let CellRule::Nerfacc(rule) = &self.cells {
            occupancy.history = rule.read(&self.device)?;
        }
        self.schedule.next_rays(&self.device, self.stepped.then_some(&self.samples.count))
    }

    fn is_non_finite(&self) -> Result<bool> {
        Ok(self.device.fetch::<u32>(&self.non_finite)?[0] != 0)
    }

    fn weights(&mut self, [_, network, variance]: &mut SdfGroups<Self>) {
        let (flat, inv_s) = (&self.flat, &self.inv_s);
        self.norm.forward(&self.device, network.value(), variance.value(), VARIANCE, flat, inv_s);
    }

    fn update_occupancy(&mut self, [table, ..]: &SdfGroups<Self>, levels: usize, at: StepAt) {
        self.sdf.activate(levels);
        let device = &self.device;
        let Samples { x, direction, .. } = &self.samples;
        match &self.cells {
            CellRule::Band(rule) => {
                let field = [table.value(), &self.flat, &self.inv_s];
                rule.update(device, &self.occupancy, &self.sdf, field, [x, direction]);
            }
            CellRule::Nerfacc(rule) => {
                let step = schedule::step_length(self.config).at(1.0);
                rule.update(device, (at.seed, at.step), &self.occupancy, x, |count| {
                    let out = self.sdf.forward(device, table.value(), &self.flat, x, direction, count);
                    (self.neus.opacities(device, out, &self.inv_s, count, step), 1.0)
                });
            }
        }
    }

    fn advance(&mut self) {
        self.schedule.advance(&self.device, &self.inv_s, &self.samples.count, !self.stepped);
        self.stepped = true;
    }

    fn draw(&mut self, at: StepAt, detail: f32) {
        let (device, at) = (&self.device, (at.seed, at.step));
        self.photographs.draw(device, self.sampler, at, &self.schedule.rays, &mut self.batch, detail);
    }

    fn march(&mut self) {
        let apart = self.points.max_per_step();
        let (device, step) = (&self.device, &self.schedule.step_length);
        self.samples.march(device, &self.occupancy, &self.batch, step, usize::MAX, apart);
    }

    fn append_points(&mut self, at: StepAt) {
        self.total_count = self.points.append(&self.device, (at.seed, at.step), &self.samples).clone();
    }

    fn sdf_field(&mut self, [table, ..]: &SdfGroups<Self>, levels: usize) {
        self.sdf.activate(levels);
        let Samples { x, direction, .. } = &self.samples;
        self.sdf.forward(&self.device, table.value(), &self.flat, x, direction, &self.total_count);
    }

    fn neus(&mut self, anneal: f32) {
        let (batch, samples) = (&self.batch, &self.samples);
        self.neus.forward(&self.device, batch, samples, self.sdf.output(), &self.inv_s, anneal);
    }

    fn losses(&mut self, anneal: f32) {
        let (device, field, count) = (&self.device, self.sdf.output(), &self.samples.count);
        let (batch, samples) = (&self.batch, &self.samples);
        let g_out = self.losses.of_rays(device, self.neus.output(), batch, &samples.offsets);
        let (inv_s, g_inv_s) = (&self.inv_s, &self.g_inv_s);
        let g_field = self.neus.backward(device, batch, samples, field, inv_s, anneal, g_out, g_inv_s);
        self.losses.of_samples(device, field, count, g_field);
        self.points.losses(device, field, count, g_field);
        self.losses.add(device, count, self.points.terms());
    }

    fn backward(&mut self, [table, network, variance]: &mut SdfGroups<Self>) {
        let device = &self.device;
        let Samples { x, direction, .. } = &self.samples;
        let (count, g_field) = (&self.total_count, self.neus.gradient());
        self.sdf.backward(device, x, direction, count, g_field, &table.gradient, &self.g_flat);
        let from = [&self.g_flat, &self.g_inv_s];
        let into = [&network.gradient, &variance.gradient];
        self.norm.backward(device, network.value(), &self.inv_s, from, into, &self.non_finite);
    }

    fn figures(&mut self, [.., variance]: &SdfGroups<Self>) -> Result<Figures> {
        let (device, count) = (&self.device, &self.samples.count);
        let sums = self.losses.sums();
        let figures = self.schedule.figures(device, sums, variance.value(), count, &self.non_finite);
        self.losses.reset_sums(device);
        figures
    }
}

impl DeviceField for gpu::Evaluator {
    fn evaluate(
        &self,
        points: &[[f32; 3]],
        directions: Option<&[[f32; 3]]>,
        normals: Option<&[[f32; 3]]>,
        channels: Range<usize>,
    ) -> Result<Vec<Vec<f32>>> {
        gpu::Evaluator::evaluate(self, points, directions, normals, channels)
    }

    fn render(&mut self, rays: &[Ray], dt: f32, colors: ColorRule) -> Result<Vec<[f32; RAY_WIDTH]>> {
        gpu::Evaluator::render(self, rays, dt, colors)
    }
}

#[cfg(test)]
#[path = "gpu_tests.rs"]
mod tests;
