//! Training of the stages `baseline` and `tface`, on any device.

use super::cpu::CpuVm;
#[cfg(feature = "wgpu")]
use super::gpu::GpuVm;
use super::ops::{VmGroups, VmOps, background_mode};
use super::record::FORMAT;
use super::refine::{update_mask, upsample};
use super::state::VmState;
use crate::config::{MaskUse, VmConfig};
use crate::field::checkpoint::{Checkpoint, TrainingProgress};
use crate::field::ops::ArrayDevice;
use crate::field::pixels::RaySampler;
use crate::field::training::{self, Model, StepAt, StepError, StepReport, TrainingSession};
use crate::field::{self, ComputeDevice};
use serde::Serialize;
use std::time::Instant;
use tiface_base::geom::BitGrid;
use tiface_base::{Error, Result};
use tiface_capture::LoadedView;
use tiface_kernels::cpu::adam::AdamStep;
use tiface_kernels::cpu::vm::losses::VmFigures;

/// Report of a training.
#[derive(Clone, Debug, Serialize)]
pub struct TfaceReport {
    /// Fields learned.
    pub fields: usize,
    /// Optimizer steps of each field.
    pub steps: u64,
    /// Seconds in this process (less than the whole when resumed).
    pub seconds: f64,
    /// PSNR of the last training batches, dB; mean over the fields.
    pub train_psnr: f64,
    /// Share of the box's cells that are marched at the end; mean over the fields.
    pub occupied: f64,
    /// Vertices of the first field's final grid along x, y, z.
    pub size: [usize; 3],
    /// Rays of all steps, whichever process made them.
    pub rays: u64,
    /// Points of their lattices inside the box, were nothing skipped.
    pub lattice_samples: u64,
    /// Number of samples whose density was looked up.
    pub density_samples: u64,
    /// Those whose color was decoded.
    pub color_samples: u64,
    /// Device of the first field's training, and the reason for choosing it.
    pub device: String,
    /// Warnings of all fields.
    pub warnings: Vec<String>,
}

impl TfaceReport {
    /// Adds the counts of another field's training.
    pub(super) fn add(&mut self, one: TfaceReport) {
        let fields = self.fields as f64;
        let mean = |all: f64, one: f64| (all * fields + one) / (fields + 1.0);
        self.train_psnr = mean(self.train_psnr, one.train_psnr);
        self.occupied = mean(self.occupied, one.occupied);
        self.fields += 1;
        self.seconds += one.seconds;
        self.rays += one.rays;
        self.lattice_samples += one.lattice_samples;
        self.density_samples += one.density_samples;
        self.color_samples += one.color_samples;
        self.warnings.extend(one.warnings);
    }

    /// Returns the counts: rays, lattice points, densities and colors.
    #[cfg(test)]
    pub(super) fn counts(&self) -> [u64; 4] {
        [self.rays, self.lattice_samples, self.density_samples, self.color_samples]
    }
}

/// Entries of a checkpoint's header with the counts of all steps so far: rays, lattice points,
/// densities and colors.
const COUNTS: [&str; 4] = ["rays", "lattice_samples", "density_samples", "color_samples"];

/// Largest count that is read: larger numbers are not exact in JSON.
const MAX_COUNT: u64 = 1 << 53;

/// A vector-matrix field in training on a device.
pub(super) struct VmModel<'a, O: VmOps> {
    pub config: &'a VmConfig,
    session: TrainingSession<'a>,
    pub ops: O,
    /// Parameters on the device, once they are loaded.
    groups: Option<VmGroups<O>>,
    /// The host's part of the state; its groups lie on the device.
    pub state: VmState,
    /// Steps since losses were read.
    unread: u64,
    /// Rays and samples of all steps that losses were read of.
    pub counts: VmFigures,
}

/// Trains one field in `bounds` until `config.steps`, saving checkpoints into the session's folder
/// and continuing from the last one; a finished training is left as it is.
pub(super) fn train_one(
    sampler: &RaySampler,
    bounds: [[f32; 3]; 2],
    hull: Option<&BitGrid>,
    config: &VmConfig,
    session: &TrainingSession,
) -> Result<TfaceReport> {
    let began = Instant::now();
    let state = VmState::new(config, session.seed, bounds, hull);
    let device =
        field::compute_device(session.device, &super::VM_TEST)?.fallback_to_cpu(|device| match device {
            ComputeDevice::Cpu(_) => Ok(()),
            #[cfg(feature = "wgpu")]
            ComputeDevice::Gpu(gpu) => {
                GpuVm::fits(session.stage, config, sampler, bounds, &gpu.device).map(drop)
            }
        })?;
    let (description, refused) = (device.description(), device.warning());
    let (state, progress, counts, warnings) = match device {
        ComputeDevice::Cpu(_) => train_on(CpuVm::new(config, sampler), state, config, session)?,
        #[cfg(feature = "wgpu")]
        ComputeDevice::Gpu(gpu) => {
            let resident = GpuVm::fits(session.stage, config, sampler, bounds, &gpu.device)?;
            train_on(GpuVm::new(config, sampler, gpu.device, resident), state, config, session)?
        }
    };
    Ok(TfaceReport {
        fields: 1,
        steps: config.steps,
        seconds: began.elapsed().as_secs_f64(),
        train_psnr: progress.psnr(),
        occupied: state.mask.as_ref().map_or(1.0, |m| m.share()),
        size: state.size,
        rays: counts.rays,
        lattice_samples: counts.lattice,
        density_samples: counts.density,
        color_samples: counts.color,
        device: description,
        warnings: refused.into_iter().chain(warnings).collect(),
    })
}

fn train_on<O: VmOps>(
    ops: O,
    state: VmState,
    config: &VmConfig,
    session: &TrainingSession,
) -> Result<(VmState, TrainingProgress, VmFigures, Vec<String>)> {
    let mut model = VmModel::new(ops, state, config, session);
    let (progress, warnings) = training::train(&mut model, session, config.steps, config.checkpoint_s)?;
    Ok((model.state, progress, model.counts, warnings))
}

/// Checks the constraints between settings that ranges of single keys cannot express.
pub(super) fn check(stage: &str, config: &VmConfig) -> Result<()> {
    let wrong = |key: &str, problem: &str| {
        let hint = format!("`tiface config --explain {stage}.{key}` says what it means");
        Err(Error::usage(format!("`{stage}.{key}` {problem}"), hint))
    };
    for (key, rank) in [("density_rank", &config.density_rank), ("color_rank", &config.color_rank)] {
        if rank.len() != 3 || rank.iter().all(|&r| r == 0) {
            return wrong(key, "needs three numbers, not all 0: channels of the planes xy, xz, yz");
        }
    }
    for (key, list) in [("upsample_at", &config.upsample_at), ("mask_at", &config.mask_at)] {
        if list.windows(2).any(|w| w[0] >= w[1]) {
            return wrong(key, "must rise");
        }
    }
    if !config.hidden.is_multiple_of(8) {
        return wrong("hidden", "must be a multiple of 8");
    }
    if config.voxels_final < config.voxels_start {
        return wrong("voxels_final", "is less than voxels_start");
    }
    Ok(())
}

/// Learning rate as a share of its first value, `since` steps after it last started.
fn learning_rate(config: &VmConfig, since: u64) -> f64 {
    config.lr_final.powf(since as f64 / config.steps as f64)
}

/// Returns the factor of the TV weights at a step: they fade by the published 0.1 over the whole
/// training and, unlike the learning rate, never start again.
fn tv_fade(config: &VmConfig, step: u64) -> f64 {
    0.1f64.powf((step + 1) as f64 / config.steps as f64)
}

/// Returns the weights of both grids' total variation at a step; `None` if it has no gradient
/// there.
fn penalties(config: &VmConfig, step: u64) -> Option<[f32; 2]> {
    let every = config.tv_every;
    // the mean stays that of a gradient at every step
    let weight = |weight: f64| (0.01 * weight * tv_fade(config, step) * every as f64) as f32;
    step.is_multiple_of(every).then(|| [config.tv_density, config.tv_color].map(weight))
}

/// Resolvable detail as a share of a cell: interpolation between a cell's corners places outlines
/// anywhere within it.
pub(super) const DETAIL: f32 = 0.25;

/// Returns the views with their masks removed or binarized as configured.
pub(super) fn masked_as_configured(mut views: Vec<LoadedView>, masks: MaskUse) -> Vec<LoadedView> {
    let threshold = match masks {
        MaskUse::None | MaskUse::Soft => None,
        MaskUse::Binary => Some(1),
        MaskUse::Hard => Some(128),
    };
    for view in &mut views {
        view.mask = view.mask.take().filter(|_| masks != MaskUse::None);
        if let (Some(mask), Some(threshold)) = (&mut view.mask, threshold) {
            mask.values.iter_mut().for_each(|a| *a = if *a >= threshold { 255 } else { 0 });
        }
    }
    views
}

impl<'a, O: VmOps> VmModel<'a, O> {
    /// Creates the model in its initial state, without looking for a checkpoint.
    pub fn new(
        ops: O,
        state: VmState,
        config: &'a VmConfig,
        session: &TrainingSession<'a>,
    ) -> VmModel<'a, O> {
        let counts = VmFigures::default();
        VmModel { config, session: *session, ops, groups: None, state, unread: 0, counts }
    }

    /// The parameters on the device.
    pub fn groups(&self) -> &VmGroups<O> {
        self.groups.as_ref().expect("parameters are loaded before the first step")
    }

    /// Copies the state to the device.
    pub fn load(&mut self) {
        // The old field is freed first, so that the device need not hold both.
        self.ops.unload(self.groups.take());
        let groups = std::mem::take(&mut self.state.groups);
        self.groups = Some(self.ops.load(&self.state.field(self.config, true), groups));
    }

    /// Waits for the device and returns the current state.
    fn state(&self) -> Result<VmState, StepError> {
        if self.ops.is_non_finite()? {
            return Err(StepError::gradient());
        }
        let groups = self.ops.read(self.groups())?;
        let state = VmState { groups, mask: self.state.mask.clone(), ..self.state };
        if !state.is_finite() {
            return Err(StepError::NotFinite { term: "grid", value: f32::NAN });
        }
        Ok(state)
    }

    /// Returns the width that a ray of a large photograph stands for at a step, scene units, or a
    /// single pixel (0) in the second half of the training.
    fn detail(&self, step: u64) -> f32 {
        let [low, high] = self.state.bounds;
        let cell =
            (0..3).map(|a| (high[a] - low[a]) / self.state.size[a] as f32).fold(f32::INFINITY, f32::min);
        if 2 * step < self.config.steps { DETAIL * cell } else { 0.0 }
    }
}

impl<O: VmOps> Model for VmModel<'_, O> {
    const FORMAT: &'static str = FORMAT;
    const RATES: [&'static str; 2] = ["lr_grid", "lr_network"];
    const READ_EVERY: u64 = <O::Device as ArrayDevice>::READ_EVERY;

    fn learning_rate(&self, step: u64) -> f64 {
        self.config.lr_network * learning_rate(self.config, step.saturating_sub(self.state.reset))
    }

    fn backward(&mut self, at: StepAt) {
        let (detail, penalties) = (self.detail(at.step), penalties(self.config, at.step));
        let groups = self.groups.as_mut().expect("parameters are loaded before the first step");
        let ops = &mut self.ops;
        ops.draw(at, self.config.rays_at(at.step), detail);
        ops.vm_render(groups);
        ops.losses(background_mode(self.config, at));
        ops.backward(groups);
        if let Some(penalties) = penalties {
            ops.penalize(groups, penalties);
        }
        self.unread += 1;
    }

    fn optimize(&mut self, step: u64) {
        let config = self.config;
        let factor = learning_rate(config, step - self.state.reset);
        let rate = |lr: f64| AdamStep::new(lr * factor, 1e-8, step - self.state.moments_from + 1);
        let (grid, network) = (rate(config.lr_grid), rate(config.lr_network));
        let groups = self.groups.as_mut().expect("parameters are loaded before the first step");
        for (group, step) in groups.iter_mut().zip([grid, grid, network]) {
            group.step(self.ops.device(), &step, self.ops.gate());
        }
    }

    fn report(&mut self, _: u64) -> Result<StepReport, StepError> {
        let found = self.ops.figures()?;
        self.ops.reset_totals();
        let steps = std::mem::take(&mut self.unread).max(1) as f64;
        self.counts.count(&found);
        let [rgb, mask, outside] = found.terms.map(|t| f64::from(t) / steps);
        StepError::check([("rgb", rgb as f32), ("mask", mask as f32)])?;
        if found.non_finite {
            return Err(StepError::gradient());
        }
        let samples = found.density as f64 / steps;
        let figures = vec![("rgb", rgb), ("mask", mask), ("samples", samples), ("outside", outside)];
        Ok(StepReport { square_error: (found.rays > 0).then_some(rgb as f32), figures })
    }

    /// Rebuilds the mask and refines the grids where that is due, on the host.
    fn finish_step(&mut self, step: u64) -> Result<(), StepError> {
        let config = self.config;
        let masking = config.due(&config.mask_at, step).is_some();
        let upsampling = config.due(&config.upsample_at, step);
        if !masking && upsampling.is_none() {
            return Ok(());
        }
        // Non-finite values would spread by interpolation, or count as empty.
        self.state = self.state()?;
        if masking && !update_mask(&mut self.state, config, step + 1) {
            let (stage, threshold) = (self.session.stage, config.mask_threshold);
            return Err(StepError::Failed(Error::cannot(
                format!(
                    "the field is empty at step {step}: no vertex of the alpha mask is above {threshold:e}"
                ),
                format!(
                    "look at the masks and poses with `tiface inspect`; lower {stage}.mask_threshold and \
                     {stage}.mask_weight"
                ),
            )));
        }
        if let Some(which) = upsampling {
            upsample(&mut self.state, config, which, step + 1);
        }
        self.load();
        Ok(())
    }

    fn save(&self, into: &mut Checkpoint, finished: bool) -> Result<(), StepError> {
        self.state()?.save(self.config, into, finished);
        let mut counts = self.counts;
        if self.unread > 0 {
            counts.count(&self.ops.figures()?);
        }
        let counts = [counts.rays, counts.lattice, counts.density, counts.color];
        COUNTS.into_iter().zip(counts).for_each(|(key, count)| into.set(key, count));
        Ok(())
    }

    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError> {
        let mut finished = false;
        self.counts = VmFigures::default();
        if let Some((from, progress, done)) = from {
            self.state.restore(self.config, from, progress.step, done)?;
            finished = done;
            let count = |key: &str| from.number_or(key, 0, 0..=MAX_COUNT);
            let [rays, lattice, density, color] = COUNTS.map(count);
            self.counts = VmFigures {
                rays: rays?,
                lattice: lattice?,
                density: density?,
                color: color?,
                ..VmFigures::default()
            };
        }
        self.ops.reset_totals();
        self.unread = 0;
        // A finished checkpoint has no moments, and no training resumes from it.
        if !finished {
            self.load();
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "step_tests.rs"]
mod step_tests;
#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;
