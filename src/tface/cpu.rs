//! A training step of the vector-matrix field on the CPU.

use super::ops::{BACKGROUND_STREAM, VmGroups, VmOps, mask_term, random_background};
use crate::config::VmConfig;
use crate::field::ops::{Cpu, Ops, slice, slice_mut};
use crate::field::parameters::{HostGroup, ParameterGroup};
use crate::field::pixels::{HostBatch, RaySampler, ray_backgrounds};
use crate::field::training::StepAt;
use std::sync::Arc;
use tiface_base::Result;
use tiface_kernels::cpu::vm::losses::{self, BackgroundMode, Targets, VmFigures};
use tiface_kernels::cpu::vm::{self, DecoderWeights, Rendered, VmField};

/// The operations of [`VmOps`] on the CPU.
pub struct CpuVm<'a> {
    config: &'a VmConfig,
    sampler: &'a RaySampler<'a>,
    field: Option<Arc<VmField>>,
    batch: HostBatch,
    background: Vec<[f32; 3]>,
    rendered: Option<(DecoderWeights, Rendered)>,
    g_composed: Vec<f32>,
    figures: VmFigures,
}

impl<'a> CpuVm<'a> {
    /// Creates the operations of a training with these settings and photographs.
    pub fn new(config: &'a VmConfig, sampler: &'a RaySampler<'a>) -> CpuVm<'a> {
        CpuVm {
            config,
            sampler,
            field: None,
            batch: HostBatch::default(),
            background: Vec::new(),
            rendered: None,
            g_composed: Vec::new(),
            figures: VmFigures::default(),
        }
    }

    fn field(&self) -> &VmField {
        self.field.as_ref().expect("a field is loaded before the first step")
    }
}

impl Ops for CpuVm<'_> {
    type Device = Cpu;

    fn device(&self) -> &Cpu {
        &Cpu
    }

    fn gate(&self) -> bool {
        !self.batch.rays.is_empty() && !self.figures.non_finite
    }
}

impl VmOps for CpuVm<'_> {
    fn load(&mut self, field: &Arc<VmField>, groups: [HostGroup; 3]) -> VmGroups<Self> {
        self.field = Some(field.clone());
        self.figures.non_finite = false;
        groups.map(|group| ParameterGroup::upload(&Cpu, group))
    }

    fn unload(&mut self, _: Option<VmGroups<Self>>) {
        self.field = None;
    }

    fn read(&self, groups: &VmGroups<Self>) -> Result<[HostGroup; 3]> {
        let [density, color, network] = groups.each_ref().map(|group| group.download(&Cpu));
        Ok([density?, color?, network?])
    }

    fn is_non_finite(&self) -> Result<bool> {
        Ok(self.figures.non_finite)
    }

    fn draw(&mut self, at: StepAt, rays: usize, detail: f32) {
        self.batch = self.sampler.draw(at.seed, at.step, rays, true, detail);
        let stream = random_background(self.config).then_some(BACKGROUND_STREAM);
        self.background = ray_backgrounds(at, stream, self.batch.rays.len());
        let lattice = &self.field().lattice;
        let points = self.batch.rays.iter().map(|ray| lattice.points(ray)).sum::<u64>();
        self.figures.lattice += points;
        self.figures.rays += self.batch.rays.len() as u64;
    }

    fn vm_render(&mut self, [density, color, network]: &VmGroups<Self>) {
        let field = self.field();
        let weights = DecoderWeights::new(field.decoder, slice(network.value()));
        let [density, color] = [density, color].map(|group| slice(group.value()));
        let HostBatch { rays, jitter, .. } = &self.batch;
        let rendered = vm::render(field, density, color, &weights, rays, jitter);
        self.figures.density += rendered.density_samples;
        self.figures.color += rendered.color_samples;
        self.rendered = Some((weights, rendered));
    }

    fn losses(&mut self, mode: BackgroundMode) {
        let composed = self.rendered.as_ref().map_or(&[][..], |(_, rendered)| &rendered.out);
        let HostBatch { color, alpha, .. } = &self.batch;
        let targets = Targets { color, alpha, background: &self.background };
        let (terms, gradient) =
            losses::of_rays(composed, targets, mode, mask_term(self.config, self.sampler));
        self.g_composed = gradient;
        self.figures.terms.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
    }

    fn backward(&mut self, [density, color, network]: &mut VmGroups<Self>) {
        let Some((weights, rendered)) = self.rendered.take() else { return };
        let (values, g_density) = density.value_and_gradient();
        let flat = vm::backward(
            self.field(),
            slice(values),
            &weights,
            rendered,
            &self.g_composed,
            slice_mut(g_density),
            slice_mut(&mut color.gradient),
        );
        self.figures.non_finite |= !flat.iter().chain(&self.figures.terms).all(|g| g.is_finite());
        slice_mut(&mut network.gradient).copy_from_slice(&flat);
    }

    fn penalize(&mut self, groups: &mut VmGroups<Self>, weights: [f32; 2]) {
        if !self.gate() {
            return;
        }
        let field = self.field();
        for ((grid, weight), group) in [field.density, field.color].iter().zip(weights).zip(groups) {
            if weight != 0.0 {
                let (values, gradient) = group.value_and_gradient();
                vm::penalize(grid, weight, slice(values), slice_mut(gradient));
            }
        }
    }

    fn reset_totals(&mut self) {
        self.figures = VmFigures { non_finite: self.figures.non_finite, ..VmFigures::default() };
    }

    fn figures(&self) -> Result<VmFigures> {
        Ok(self.figures)
    }
}
