//! A training step of the signed-distance field on the CPU.

use super::model::shape;
use super::occupancy::Occupancy;
use super::ops::{
    BACKGROUND_STREAM, MAX_BUDGETS, STEREO_POINTS, SdfGroups, SdfOps, VARIANCE, color_rule, loss_weights,
    random_background,
};
use super::schedule;
use super::stereo::SurfacePoint;
use crate::config::iface::IfaceConfig;
use crate::field::ops::{Cpu, Ops, slice, slice_mut};
use crate::field::pixels::{HostBatch, RaySampler, ray_backgrounds};
use crate::field::training::StepAt;
use tiface_base::Result;
use tiface_base::math::rng;
use tiface_kernels::cpu::losses::{self, RAY_TERMS, STEREO_STREAM, TERMS, Targets};
use tiface_kernels::cpu::march::Samples;
use tiface_kernels::cpu::mlp::Weights;
use tiface_kernels::cpu::neus::{self, ColorRule, Segments};
use tiface_kernels::cpu::pool::Buffer;
use tiface_kernels::cpu::schedule::Figures;
use tiface_kernels::cpu::sdf::{self, Activations, FieldShape, WIDTH};
use tiface_kernels::cpu::weight_norm;

/// The operations of [`SdfOps`] on the CPU.
pub struct CpuSdf<'a> {
    config: &'a IfaceConfig,
    sampler: &'a RaySampler<'a>,
    shape: FieldShape,
    occupancy: Occupancy,
    all_points: Vec<SurfacePoint>,
    rays: usize,
    /// Number of consecutive steps without a sample.
    empty_steps: u64,
    /// Samples of the last step before truncation to the budget; `None` before the first step.
    samples_wanted: Option<usize>,
    weights: Option<Weights>,
    inv_s: f32,
    step: CpuStep,
}

/// Intermediate results that the operations of a step pass to the next ones.
#[derive(Default)]
struct CpuStep {
    dt: f32,
    batch: HostBatch,
    background: Vec<[f32; 3]>,
    samples: Samples,
    direction: Vec<[f32; 3]>,
    dts: Vec<f32>,
    /// `[samples + points, 3]`.
    position: Vec<[f32; 3]>,
    /// `[samples, 3]` directions of the samples' rays.
    along: Vec<[f32; 3]>,
    points: Vec<SurfacePoint>,
    activations: Option<Activations>,
    /// `[samples]`: the samples that colors are taken from.
    sources: Vec<u32>,
    composed: Vec<f32>,
    terms: [f32; TERMS],
    /// `[samples + points, 8]`.
    g_field: Buffer,
    g_inv_s: f32,
    non_finite: bool,
}

impl CpuStep {
    fn segments(&self, colors: ColorRule) -> Segments<'_> {
        let Samples { offsets, t } = &self.samples;
        Segments { offsets, direction: &self.direction, t, dt: &self.dts, colors }
    }

    fn is_empty(&self) -> bool {
        self.samples.t.is_empty()
    }
}

/// Returns the output of the field, empty before it is evaluated.
fn output(activations: &Option<Activations>) -> &[f32] {
    activations.as_ref().map_or(&[], |a| a.output())
}

/// Drops the last rays of a batch until at most `max_samples` are left (one ray always stays).
fn truncate(batch: &mut HostBatch, samples: &mut Samples, max_samples: usize) {
    if samples.t.len() <= max_samples {
        return;
    }
    let kept = samples.offsets.iter().rposition(|&o| o as usize <= max_samples).unwrap_or(0).max(1);
    samples.offsets.truncate(kept + 1);
    samples.t.truncate(samples.offsets[kept] as usize);
    batch.truncate(kept);
}

impl<'a> CpuSdf<'a> {
    /// Creates the operations of a training with these settings and photographs.
    pub fn new(config: &'a IfaceConfig, sampler: &'a RaySampler<'a>) -> CpuSdf<'a> {
        CpuSdf {
            config,
            sampler,
            shape: shape(config),
            occupancy: Occupancy::new(config, None),
            all_points: Vec::new(),
            rays: config.rays,
            empty_steps: 0,
            samples_wanted: None,
            weights: None,
            inv_s: 0.0,
            step: CpuStep::default(),
        }
    }

    fn prepared(&self) -> &Weights {
        self.weights.as_ref().expect("weights are computed before the field is evaluated")
    }

    fn next_rays(&self) -> usize {
        self.samples_wanted.map_or(self.rays, |n| schedule::ray_budget(self.config).next(self.rays, n))
    }
}

impl Ops for CpuSdf<'_> {
    type Device = Cpu;

    fn device(&self) -> &Cpu {
        &Cpu
    }

    fn gate(&self) -> bool {
        !self.step.is_empty() && !self.step.non_finite
    }
}

impl SdfOps for CpuSdf<'_> {
    fn load(&mut self, occupancy: &Occupancy, rays: usize, points: &[SurfacePoint]) {
        self.occupancy = occupancy.clone();
        (self.rays, self.samples_wanted, self.empty_steps) = (rays, None, 0);
        self.step = CpuStep::default();
        self.set_points(points);
    }

    fn set_points(&mut self, points: &[SurfacePoint]) {
        self.all_points = points.to_vec();
    }

    fn read(&self, occupancy: &mut Occupancy) -> Result<usize> {
        *occupancy = self.occupancy.clone();
        Ok(self.next_rays())
    }

    fn is_non_finite(&self) -> Result<bool> {
        Ok(self.step.non_finite)
    }

    fn weights(&mut self, groups: &mut SdfGroups<Self>) {
        let [_, network, variance] = groups;
        let layout = self.shape.layout();
        self.weights = Some(Weights::new(layout, &weight_norm::forward(layout, slice(network.value()))));
        let v = &mut slice_mut(variance.value_mut())[0];
        *v = v.clamp(VARIANCE[0], VARIANCE[1]);
        self.inv_s = (10.0 * *v).exp();
    }

    fn update_occupancy(&mut self, [table, ..]: &SdfGroups<Self>, levels: usize, at: StepAt) {
        self.shape.active = levels;
        let (shape, table) = (&self.shape, bytemuck::cast_slice(slice(table.value())));
        let weights = self.weights.as_ref().expect("weights are computed before the field is evaluated");
        let field = |x: &[[f32; 3]]| sdf::values_and_softness(shape, table, weights, x);
        let dt = schedule::step_length(self.config).at(self.inv_s);
        self.occupancy.update(self.config, (at.seed, at.step), self.inv_s, dt, field);
    }

    fn advance(&mut self) {
        self.rays = self.next_rays();
        self.step.dt = schedule::step_length(self.config).at(self.inv_s);
    }

    fn draw(&mut self, at: StepAt, detail: f32) {
        self.step.batch = self.sampler.draw(at.seed, at.step, self.rays, self.config.jitter, detail);
        let stream = random_background(self.config).then_some(BACKGROUND_STREAM);
        self.step.background = ray_backgrounds(at, stream, self.step.batch.rays.len());
    }

    fn march(&mut self) {
        let (config, step) = (self.config, &mut self.step);
        step.samples = self.occupancy.march(config, step.dt, &step.batch.rays, &step.batch.jitter);
        let wanted = step.samples.t.len();
        truncate(&mut step.batch, &mut step.samples, MAX_BUDGETS * config.samples);
        step.background.truncate(step.batch.rays.len());
        step.direction = step.batch.rays.iter().map(|r| r.direction.to_array()).collect();
        step.dts = vec![step.dt; step.samples.t.len()];
        self.samples_wanted = Some(wanted);
        self.empty_steps = if wanted == 0 { self.empty_steps + 1 } else { 0 };
    }

    fn append_points(&mut self, at: StepAt) {
        let all = &self.all_points;
        let count = if all.is_empty() || self.step.is_empty() { 0 } else { STEREO_POINTS };
        let drawn = |i| rng::below(at.seed, at.step << 4 | STEREO_STREAM, i, all.len() as u64) as usize;
        self.step.points = (0..count).map(|i| all[drawn(i)]).collect();
    }

    fn sdf_field(&mut self, [table, ..]: &SdfGroups<Self>, levels: usize) {
        self.shape.active = levels;
        if self.step.is_empty() {
            return;
        }
        let CpuStep { samples, batch, points, position, along, .. } = &mut self.step;
        samples.points_into(&batch.rays, position, along);
        position.extend(points.iter().map(|p| p.position));
        let table = bytemuck::cast_slice(slice(table.value()));
        let activations = sdf::geometry(&self.shape, table, self.prepared(), &self.step.position);
        self.step.activations = Some(activations);
    }

    fn neus(&mut self, anneal: f32) {
        let mut activations = self.step.activations.take();
        let segments = self.step.segments(color_rule(self.config));
        let weights = neus::weights(segments, output(&activations), self.inv_s, anneal);
        let sources = neus::color_sources(segments, &weights);
        if let Some(activations) = &mut activations {
            // points have no color: no loss asks for one
            activations.shade(self.prepared(), neus::shown(&sources), &self.step.along);
        }
        let composed = neus::composite(segments, output(&activations), &weights, &sources);
        (self.step.composed, self.step.activations, self.step.sources) = (composed, activations, sources);
    }

    fn losses(&mut self, anneal: f32) {
        let step = &mut self.step;
        let w = loss_weights(self.config, self.sampler.has_masks);
        let HostBatch { color, alpha, .. } = &step.batch;
        let targets = Targets { offsets: &step.samples.offsets, color, alpha, background: &step.background };
        let (of_rays, g_composed) = losses::of_rays(&step.composed, targets, &w);
        let field = output(&step.activations);
        let n = step.samples.t.len();
        let segments = step.segments(color_rule(self.config));
        let (mut g_field, g_inv_s) =
            neus::composite_backward(segments, field, &step.sources, self.inv_s, anneal, &g_composed);
        let (of_samples, of_points) = g_field.split_at_mut(n * WIDTH);
        let of_samples = losses::of_samples(&field[..n * WIDTH], &w, of_samples);
        let points: Vec<[f32; 2]> = step.points.iter().map(|p| [p.footprint, p.weight]).collect();
        let of_points = losses::of_points(&field[n * WIDTH..], &points, &w, of_points);
        step.terms[..RAY_TERMS].copy_from_slice(&of_rays);
        step.terms[RAY_TERMS..TERMS - 1].copy_from_slice(&of_samples);
        step.terms[TERMS - 1] = of_points;
        (step.g_field, step.g_inv_s) = (g_field, g_inv_s);
    }

    fn backward(&mut self, [table, network, variance]: &mut SdfGroups<Self>) {
        let Some(activations) = self.step.activations.take().filter(|_| !self.step.is_empty()) else {
            return;
        };
        let weights = self.weights.as_ref().expect("the field was evaluated with them");
        let g_table = bytemuck::cast_slice_mut(slice_mut(&mut table.gradient));
        // back in the pool before the next step asks for as much
        let g_field = std::mem::take(&mut self.step.g_field);
        let g_flat = sdf::backward(&activations, weights, &g_field, g_table);
        let (parameters, gradient) = network.value_and_gradient();
        let g_network = slice_mut(gradient);
        weight_norm::backward(self.shape.layout(), slice(parameters), &g_flat, g_network);
        let g_variance = 10.0 * self.inv_s * self.step.g_inv_s;
        slice_mut(&mut variance.gradient)[0] = g_variance;
        // A non-finite gradient of the table passes through the layers above it, so checking those
        // suffices. The loss terms are checked too, so that no step follows a loss that is not
        // finite.
        let all = g_network.iter().chain(&self.step.terms).chain([&g_variance]);
        self.step.non_finite |= !all.into_iter().all(|g| g.is_finite());
    }

    fn figures(&mut self, [.., variance]: &SdfGroups<Self>) -> Result<Figures> {
        Ok(Figures {
            losses: self.step.terms,
            mean_square: self.samples_wanted.is_some_and(|n| n > 0).then_some(self.step.terms[0]),
            variance: slice(variance.value())[0],
            samples: self.samples_wanted.unwrap_or(0),
            rays: self.next_rays(),
            empty_steps: self.empty_steps,
            non_finite: self.step.non_finite,
        })
    }
}
