//! A training step of the density on a GPU. The host never waits within a step.

use super::shape;
use super::{DensityGroups, DensityOps, OCCUPIED};
use crate::config::iface::IfaceConfig;
use crate::field::drawing::DeviceSampler;
use crate::field::ops::Ops;
use crate::field::pixels::RaySampler;
use crate::field::training::StepAt;
use crate::iface::gpu::{samples_that_fit, wanted_samples};
use crate::iface::occupancy::Occupancy;
use crate::iface::schedule;
use tiface_base::{Error, Result};
use tiface_kernels::cpu::schedule::Figures;
use tiface_kernels::gpu::{
    self, Buffer, Density, Device, DeviceBatch, Gate, Nerfacc, Samples, SamplingOptions, Schedule, Words,
};

/// The operations of [`DensityOps`] on a GPU, with their device memory.
pub struct GpuDensity<'a> {
    config: &'a IfaceConfig,
    sampler: &'a RaySampler<'a>,
    device: Device,
    photographs: DeviceSampler,
    batch: DeviceBatch,
    /// Samples in all occupied cells; `samples` has those up to where the transmittance has
    /// vanished.
    marched: Samples,
    samples: Samples,
    density: Density,
    /// `[1]`: a density has no sharpness.
    no_sharpness: Buffer,
    /// `[1]`: not 0 once a gradient was not finite.
    non_finite: Buffer,
    schedule: Schedule,
    occupancy: gpu::Occupancy,
    cells: Nerfacc,
    /// Whether a step was made since the state was loaded.
    stepped: bool,
}

impl<'a> GpuDensity<'a> {
    /// Checks that a device supports the field and has enough memory for the training.
    pub fn fits(config: &IfaceConfig, sampler: &RaySampler, device: &Device) -> Result<()> {
        if !Density::supports(&shape(config)) {
            let problem = format!("a tile on a GPU cannot hold {} levels", config.levels);
            return Err(Error::usage(problem, "lower iface.levels, or train with `--device cpu`"));
        }
        max_samples(config, sampler, device).map(drop)
    }

    /// Creates the operations of a training that [`fits`](GpuDensity::fits) a device.
    ///
    /// # Errors
    ///
    /// If the device has too little memory.
    pub fn new(
        config: &'a IfaceConfig,
        sampler: &'a RaySampler<'a>,
        device: Device,
    ) -> Result<GpuDensity<'a>> {
        let rays = config.rays.max(config.max_rays);
        let (capacity, resident) = max_samples(config, sampler, &device)?;
        let drawing = SamplingOptions { jitter: config.jitter, background: false, background_stream: 0 };
        let (occupancy, cells) = cells(&device, config, &Occupancy::new(config, None), capacity);
        let (length, budget) = (schedule::step_length(config), schedule::ray_budget(config));
        Ok(GpuDensity {
            config,
            sampler,
            photographs: DeviceSampler::new(sampler, &device, drawing, resident),
            batch: DeviceBatch::new(&device, rays),
            marched: Samples::new(&device, rays, capacity),
            samples: Samples::new(&device, rays, capacity),
            density: Density::new(&device, &shape(config), length.at(0.0), rays, capacity),
            no_sharpness: device.zeros::<f32>(1),
            non_finite: device.zeros::<u32>(1),
            schedule: Schedule::new(&device, length, budget, config.rays),
            occupancy,
            cells,
            stepped: false,
            device,
        })
    }
}

/// Returns the sample capacity of a step, and whether the photographs fit on the device as well.
fn max_samples(config: &IfaceConfig, sampler: &RaySampler, device: &Device) -> Result<(usize, bool)> {
    let shape = shape(config);
    let sums = Density::words_of_sums(&shape, wanted_samples(config, 0));
    samples_that_fit(config, Density::words_per_sample(&shape), sums, 0, sampler, device)
}

/// Creates the cells to march through, and the rule that updates them.
fn cells(
    device: &Device,
    config: &IfaceConfig,
    start: &Occupancy,
    capacity: usize,
) -> (gpu::Occupancy, Nerfacc) {
    let cells = gpu::Occupancy::new(device, &start.occupied, None, config.radius);
    let rule = Nerfacc::new(device, &cells, &start.history, OCCUPIED, capacity);
    (cells, rule)
}

impl Ops for GpuDensity<'_> {
    type Device = Device;

    fn device(&self) -> &Device {
        &self.device
    }

    fn gate(&self) -> Gate<'_> {
        Gate { count: &self.samples.count, non_finite: &self.non_finite }
    }
}

impl DensityOps for GpuDensity<'_> {
    fn load(&mut self, occupancy: &Occupancy, rays: usize) {
        let (device, config) = (&self.device, self.config);
        (self.occupancy, self.cells) = cells(device, config, occupancy, self.samples.t.word_count());
        let (length, budget) = (schedule::step_length(config), schedule::ray_budget(config));
        self.schedule = Schedule::new(device, length, budget, rays);
        self.non_finite = device.zeros::<u32>(1);
        self.density.reset_sums(device);
        self.stepped = false;
    }

    fn read(&self, occupancy: &mut Occupancy) -> Result<usize> {
        let [occupied, _] = self.occupancy.read(&self.device)?;
        occupancy.replace([occupied, occupancy.solid.clone()]);
        occupancy.history = self.cells.read(&self.device)?;
        self.schedule.next_rays(&self.device, self.stepped.then_some(&self.samples.count))
    }

    fn is_non_finite(&self) -> Result<bool> {
        Ok(self.device.fetch::<u32>(&self.non_finite)?[0] != 0)
    }

    fn update_occupancy(&mut self, [table, network]: &DensityGroups<Self>, at: StepAt) {
        let (device, x) = (&self.device, &self.samples.x);
        let dt = schedule::step_length(self.config).at(0.0);
        self.density.prepare(device, network.value());
        self.cells.update(device, (at.seed, at.step), &self.occupancy, x, |count| {
            // The first plane of the output holds the densities.
            (self.density.evaluate(device, table.value(), x, None, count), dt)
        });
    }

    fn draw(&mut self, at: StepAt) {
        let (device, at) = (&self.device, (at.seed, at.step));
        self.schedule.advance(device, &self.no_sharpness, &self.samples.count, !self.stepped);
        self.stepped = true;
        self.photographs.draw(device, self.sampler, at, &self.schedule.rays, &mut self.batch, 0.0);
    }

    fn march(&mut self, [table, network]: &DensityGroups<Self>) {
        let (device, all, step) = (&self.device, &self.marched, &self.schedule.step_length);
        all.march(device, &self.occupancy, &self.batch, step, usize::MAX, 0);
        self.density.prepare(device, network.value());
        self.density.evaluate(device, table.value(), &all.x, None, &all.count);
        self.density.cut(device, all, &self.samples);
    }

    fn density_field(&mut self, [table, _]: &DensityGroups<Self>) {
        let Samples { x, direction, count, .. } = &self.samples;
        self.density.evaluate(&self.device, table.value(), x, Some(direction), count);
    }

    fn losses(&mut self) {
        self.density.losses(&self.device, &self.samples, &self.batch);
    }

    fn backward(&mut self, [table, network]: &mut DensityGroups<Self>) {
        let into = [&table.gradient, &network.gradient];
        self.density.backward(&self.device, &self.samples, into, &self.non_finite);
    }

    fn figures(&mut self) -> Result<Figures> {
        let (device, count) = (&self.device, &self.samples.count);
        let sums = self.density.sums();
        let figures = self.schedule.figures(device, sums, &self.no_sharpness, count, &self.non_finite);
        self.density.reset_sums(device);
        figures
    }
}
