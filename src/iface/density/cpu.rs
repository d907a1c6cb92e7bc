//! A training step of the density on the CPU.

use super::shape;
use super::{DensityGroups, DensityOps, OCCUPIED};
use crate::config::iface::IfaceConfig;
use crate::field::ops::{Cpu, Ops, slice, slice_mut};
use crate::field::pixels::{HostBatch, RaySampler};
use crate::field::training::StepAt;
use crate::iface::occupancy::Occupancy;
use crate::iface::schedule;
use tiface_base::Result;
use tiface_base::geom::Ray;
use tiface_kernels::cpu::density::{self, DensitySamples, DensityShape, DensityWeights};
use tiface_kernels::cpu::losses::TERMS;
use tiface_kernels::cpu::march::Samples;
use tiface_kernels::cpu::schedule::Figures;

/// Returns the samples along rays in occupied cells, up to where the transmittance has vanished.
pub fn march(
    config: &IfaceConfig,
    occupancy: &Occupancy,
    (shape, table, weights): (&DensityShape, &[[f32; 2]], &DensityWeights),
    rays: &[Ray],
    jitter: &[f32],
) -> Samples {
    let dt = schedule::step_length(config).at(0.0);
    let all = occupancy.march(config, dt, rays, jitter);
    let (x, _) = all.points(rays);
    density::cut(&all, &density::evaluate(shape, table, weights, &x, None).density, dt)
}

/// The operations of [`DensityOps`] on the CPU.
pub struct CpuDensity<'a> {
    config: &'a IfaceConfig,
    sampler: &'a RaySampler<'a>,
    shape: DensityShape,
    occupancy: Occupancy,
    rays: usize,
    /// Samples of the last step; `None` before the first step.
    last_samples: Option<usize>,
    batch: HostBatch,
    samples: Samples,
    weights: Option<DensityWeights>,
    found: Option<DensitySamples>,
    terms: [f32; 3],
    /// Gradients with respect to densities and colors of the samples.
    gradients: (Vec<f32>, Vec<[f32; 3]>),
    non_finite: bool,
}

impl<'a> CpuDensity<'a> {
    /// Creates the operations of a training with these settings and photographs.
    pub fn new(config: &'a IfaceConfig, sampler: &'a RaySampler<'a>) -> CpuDensity<'a> {
        CpuDensity {
            config,
            sampler,
            shape: shape(config),
            occupancy: Occupancy::new(config, None),
            rays: config.rays,
            last_samples: None,
            batch: HostBatch::default(),
            samples: Samples::default(),
            weights: None,
            found: None,
            terms: [0.0; 3],
            gradients: Default::default(),
            non_finite: false,
        }
    }

    fn next_rays(&self) -> usize {
        self.last_samples.map_or(self.rays, |n| schedule::ray_budget(self.config).next(self.rays, n))
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
        !self.samples.t.is_empty() && !self.non_finite
    }
}

impl DensityOps for CpuDensity<'_> {
    fn load(&mut self, occupancy: &Occupancy, rays: usize) {
        self.occupancy = occupancy.clone();
        (self.rays, self.last_samples, self.non_finite) = (rays, None, false);
    }

    fn read(&self, occupancy: &mut Occupancy) -> Result<usize> {
        *occupancy = self.occupancy.clone();
        Ok(self.next_rays())
    }

    fn is_non_finite(&self) -> Result<bool> {
        Ok(self.non_finite)
    }

    fn update_occupancy(&mut self, groups: &DensityGroups<Self>, at: StepAt) {
        let (table, weights) = self.field(groups);
        let (shape, dt) = (&self.shape, schedule::step_length(self.config).at(0.0));
        let opacity = |x: &[[f32; 3]]| {
            let found = density::evaluate(shape, table, &weights, x, None);
            found.density.into_iter().map(|s| s * dt).collect()
        };
        self.occupancy.update_nerfacc((at.seed, at.step), self.config.radius, OCCUPIED, opacity);
    }

    fn draw(&mut self, at: StepAt) {
        self.rays = self.next_rays();
        self.batch = self.sampler.draw(at.seed, at.step, self.rays, self.config.jitter, 0.0);
    }

    fn march(&mut self, groups: &DensityGroups<Self>) {
        let (table, weights) = self.field(groups);
        let field = (&self.shape, table, &weights);
        let HostBatch { rays, jitter, .. } = &self.batch;
        self.samples = march(self.config, &self.occupancy, field, rays, jitter);
        self.last_samples = Some(self.samples.t.len());
        self.weights = Some(weights);
    }

    fn density_field(&mut self, [table, _]: &DensityGroups<Self>) {
        let Some(weights) = self.weights.as_ref().filter(|_| !self.samples.t.is_empty()) else { return };
        let (x, d) = self.samples.points(&self.batch.rays);
        let table = bytemuck::cast_slice(slice(table.value()));
        self.found = Some(density::evaluate(&self.shape, table, weights, &x, Some(&d)));
    }

    fn losses(&mut self) {
        let Some(found) = &self.found else { return };
        let dt = schedule::step_length(self.config).at(0.0);
        let (terms, g_density, g_color) = density::losses(&self.samples, &self.batch.color, found, dt);
        (self.terms, self.gradients) = (terms, (g_density, g_color));
    }

    fn backward(&mut self, [table, network]: &mut DensityGroups<Self>) {
        let (Some(weights), Some(found)) = (self.weights.take(), self.found.take()) else { return };
        let g_table = bytemuck::cast_slice_mut(slice_mut(&mut table.gradient));
        let by = (&self.gradients.0[..], &self.gradients.1[..]);
        let g_network = density::backward(&self.shape, &weights, &found, by, g_table);
        self.non_finite |= !g_network.iter().chain(&self.terms).all(|g| g.is_finite());
        slice_mut(&mut network.gradient).copy_from_slice(&g_network);
    }

    fn figures(&mut self) -> Result<Figures> {
        let mut losses = [0.0; TERMS];
        losses[..3].copy_from_slice(&self.terms);
        let (samples, rays) = (self.samples.t.len(), self.next_rays());
        let mean_square = (samples > 0).then_some(losses[0]);
        Ok(Figures {
            losses,
            mean_square,
            variance: 0.0,
            samples,
            rays,
            empty_steps: 0,
            non_finite: self.non_finite,
        })
    }
}
