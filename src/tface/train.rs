//! One training step of the stages `baseline` and `tface`; the loop around it is [`crate::field::training`]'s.

use super::grow::{update_mask, upsample};
#[cfg(feature = "wgpu")]
use super::on_device::OnDevice;
use super::record::FORMAT;
use super::state::VmState;
use crate::config::{MaskLoss, MaskUse, VmBackground, VmConfig};
use crate::field::checkpoint::{Checkpoint, TrainingProgress};
use crate::field::ops::{self, GridPenalty, VmBatch};
use crate::field::pixels::{Batch, Pixels, TrainView};
use crate::field::training::{self, Learner, StepError, StepReport, TrainingSession};
use crate::field::{self, Place};
use crate::kernel::adam::AdamStep;
use crate::kernel::march::Bitmask;
use crate::kernel::rng;
use crate::kernel::vm::{Penalty, RAY_WIDTH, VmField};
use crate::{Error, Result};
use burn::tensor::{Device, Tensor};
use serde::Serialize;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

/// What training did.
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
    /// Rays of this process.
    pub rays: u64,
    /// Points of their lattices inside the box, were nothing skipped.
    pub lattice_samples: u64,
    /// Those whose density was looked up.
    pub density_samples: u64,
    /// Those whose color was decoded.
    pub color_samples: u64,
    /// What learned the first of them, and why that.
    pub device: String,
    /// Oddities on the way.
    pub warnings: Vec<String>,
}

impl TfaceReport {
    /// With what another field's training did.
    pub(super) fn and(self, other: TfaceReport) -> TfaceReport {
        let fields = self.fields + other.fields;
        let mean = |a: f64, b: f64| (a * self.fields as f64 + b * other.fields as f64) / fields as f64;
        TfaceReport {
            fields,
            steps: self.steps,
            seconds: self.seconds + other.seconds,
            train_psnr: mean(self.train_psnr, other.train_psnr),
            occupied: mean(self.occupied, other.occupied),
            size: self.size,
            rays: self.rays + other.rays,
            lattice_samples: self.lattice_samples + other.lattice_samples,
            density_samples: self.density_samples + other.density_samples,
            color_samples: self.color_samples + other.color_samples,
            device: self.device,
            warnings: [self.warnings, other.warnings].concat(),
        }
    }
}

/// Samples of this process.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Counts {
    pub rays: u64,
    pub lattice: u64,
    pub density: u64,
    pub color: u64,
}

/// A training on the CPU, and what one on a GPU begins and ends with.
pub(super) struct VmTraining<'a> {
    pub config: &'a VmConfig,
    session: TrainingSession<'a>,
    pub device: Device,
    pub pixels: &'a Pixels<'a>,
    pub state: VmState,
    pub counts: Counts,
}

/// Trains one field in `bounds` until `config.steps`, saving checkpoints into the session's folder and continuing
/// from the one that lies there; a finished one is left as it is.
pub(super) fn train_one(
    pixels: &Pixels,
    bounds: [[f32; 3]; 2],
    hull: Option<&Bitmask>,
    config: &VmConfig,
    session: &TrainingSession,
) -> Result<TfaceReport> {
    let began = Instant::now();
    let mut learner = VmTraining::new(pixels, bounds, hull, config, session, field::processor());
    let place = field::place(session.device)?.or_processor(|place| match place {
        Place::Cpu(_) => Ok(()),
        #[cfg(feature = "wgpu")]
        Place::Gpu(gpu) => OnDevice::fits(&learner, &gpu.device).map(|_| ()),
    })?;
    let device = place.told();
    let (progress, warnings) = match place {
        Place::Cpu(_) => training::train(&mut learner, session, config.steps, config.checkpoint_s)?,
        #[cfg(feature = "wgpu")]
        Place::Gpu(gpu) => {
            let mut there = OnDevice::new(learner, gpu.device)?;
            let done = training::train(&mut there, session, config.steps, config.checkpoint_s)?;
            learner = there.finish();
            done
        }
    };
    let VmTraining { state, counts, .. } = learner;
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
        device,
        warnings,
    })
}

/// What ranges of single keys cannot say.
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
    for (key, list) in [("upsample_steps", &config.upsample_steps), ("mask_steps", &config.mask_steps)] {
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

/// What is left of the TV weights at a step: they fade by the published 0.1 over the whole training and,
/// unlike the learning rate, never start again.
fn tv_fade(config: &VmConfig, step: u64) -> f64 {
    0.1f64.powf((step + 1) as f64 / config.steps as f64)
}

/// The share of a cell that is told apart: densities and colors change across a cell as its corners say, and outlines lie
/// anywhere in it.
pub(super) const DETAIL: f32 = 0.25;

/// The views with their masks as the setting wants them.
pub(super) fn masked_as_configured(mut views: Vec<TrainView>, masks: MaskUse) -> Vec<TrainView> {
    let least = match masks {
        MaskUse::None | MaskUse::Soft => None,
        MaskUse::Binary => Some(1),
        MaskUse::Hard => Some(128),
    };
    for view in &mut views {
        view.mask = view.mask.take().filter(|_| masks != MaskUse::None);
        if let (Some(mask), Some(least)) = (&mut view.mask, least) {
            mask.values.iter_mut().for_each(|a| *a = if *a >= least { 255 } else { 0 });
        }
    }
    views
}

impl Learner for VmTraining<'_> {
    const FORMAT: &'static str = FORMAT;
    const RATES: [&'static str; 2] = ["lr_grid", "lr_network"];

    fn step(&mut self, progress: &TrainingProgress) -> Result<StepReport, StepError> {
        let config = self.config;
        let step = progress.step;
        let seed = self.seed(progress);
        let mut batch = self.pixels.draw(seed, step, config.rays, true, self.detail(step));
        let field = self.state.field(config, true);
        let rays = std::mem::take(&mut batch.rays);
        self.counts.rays += rays.len() as u64;
        self.counts.lattice += rays.iter().map(|r| field.lattice.points(r)).sum::<u64>();
        let vm = Arc::new(VmBatch::new(field.clone(), rays));
        let (density, color) = self.penalized(&field, step);
        let out = ops::vm_render(density, color, self.state.parameters[2].flat(), vm.clone());
        let looked_up = vm.density_samples.load(Ordering::Relaxed);
        self.counts.density += looked_up;
        self.counts.color += vm.color_samples.load(Ordering::Relaxed);

        let (total, rgb, mask, outside) = self.losses(out, &batch, step, seed);
        let value = |t: Tensor<1>| field::values(t.inner())[0];
        let (rgb, mask) = (value(rgb), mask.map_or(0.0, value));
        for (term, value) in [("rgb", rgb), ("mask", mask)] {
            if !value.is_finite() {
                return Err(self.not_finite(term, value, step));
            }
        }
        self.descend(total, step)?;
        if self.grows(step) {
            self.grow(step)?;
        }
        let mut figures = vec![("rgb", rgb as f64), ("mask", mask as f64), ("samples", looked_up as f64)];
        figures.extend(outside.map(|outside| ("outside", outside as f64)));
        Ok(StepReport { square_error: Some(rgb), figures })
    }

    fn save(
        &self,
        progress: &TrainingProgress,
        into: &mut Checkpoint,
        finished: bool,
    ) -> Result<(), StepError> {
        if !self.state.is_finite() {
            return Err(self.not_finite("grid", f32::NAN, progress.step));
        }
        self.state.save(self.config, into, finished);
        Ok(())
    }

    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError> {
        if let Some((from, progress, finished)) = from {
            self.state.restore(self.config, from, progress.step, finished)?;
        }
        Ok(())
    }
}

/// Is the batch of a step seen over white, half of them are, where the target stays over black? As published.
pub(super) fn over_white(seed: u64, step: u64) -> bool {
    rng::uniform(seed, step << 4 | 9, 0) < 0.5
}

/// Random numbers of a step's backgrounds.
pub(super) const BEHIND: u64 = 8;

impl<'a> VmTraining<'a> {
    /// Before the first step.
    pub fn new(
        pixels: &'a Pixels<'a>,
        bounds: [[f32; 3]; 2],
        hull: Option<&Bitmask>,
        config: &'a VmConfig,
        session: &TrainingSession<'a>,
        device: Device,
    ) -> VmTraining<'a> {
        let state = VmState::new(config, session.seed, bounds, hull, &device);
        VmTraining { config, session: *session, device, pixels, state, counts: Counts::default() }
    }

    /// The stage, which is the table of its settings.
    #[cfg(feature = "wgpu")]
    pub fn stage(&self) -> &'static str {
        self.session.stage
    }

    /// The seed of a step: another one after a step that diverged.
    pub fn seed(&self, progress: &TrainingProgress) -> u64 {
        self.session.seed ^ progress.salt << 32
    }

    /// What a ray of a large photograph stands for at a step, scene units; a pixel in the second half.
    pub fn detail(&self, step: u64) -> f32 {
        let [low, high] = self.state.bounds;
        let cell =
            (0..3).map(|a| (high[a] - low[a]) / self.state.size[a] as f32).fold(f32::INFINITY, f32::min);
        if 2 * step < self.config.steps { DETAIL * cell } else { 0.0 }
    }

    /// The error that something is not finite.
    pub fn not_finite(&self, term: &'static str, value: f32, step: u64) -> StepError {
        let lr = self.config.lr_network * learning_rate(self.config, step - self.state.reset);
        StepError::NotFinite { term, value, lr }
    }

    /// What is asked of both grids at a step besides the photographs.
    pub fn penalties(&self, step: u64) -> [Penalty; 2] {
        let config = self.config;
        let faded = tv_fade(config, step);
        let tv = |weight: f64| (0.01 * weight * faded) as f32;
        let l1 = if self.state.masked { config.l1_rest } else { config.l1_start } as f32;
        let ortho = config.ortho as f32;
        [
            Penalty { tv: tv(config.tv_density), l1, ortho },
            Penalty { tv: tv(config.tv_color), l1: 0.0, ortho },
        ]
    }

    /// Both grids with their regularizers attached.
    fn penalized(&self, field: &VmField, step: u64) -> (Tensor<1>, Tensor<1>) {
        let [of_density, of_color] = self.penalties(step);
        let attach = |p: Tensor<1>, grid, penalty: Penalty| {
            if penalty.is_zero() { p } else { ops::penalized(p, Arc::new(GridPenalty { grid, penalty })) }
        };
        (
            attach(self.state.parameters[0].flat(), field.density, of_density),
            attach(self.state.parameters[1].flat(), field.color, of_color),
        )
    }

    /// Total, color and mask losses; mean opacity² of the batch's background rays.
    fn losses(
        &self,
        out: Tensor<2>,
        batch: &Batch,
        step: u64,
        seed: u64,
    ) -> (Tensor<1>, Tensor<1>, Option<Tensor<1>>, Option<f32>) {
        let config = self.config;
        let device = &self.device;
        let n = batch.alpha.len();
        let stream = step << 4;
        let opacity = out.clone().narrow(1, 3, 1); // [n, 1]
        let mut color = out.clone().narrow(1, 0, 3); // [n, 3]
        let mut target: Vec<f32> = batch.color.iter().flatten().copied().collect();
        let open = || opacity.clone().neg() + 1.0;
        match config.background {
            VmBackground::Black => {}
            VmBackground::Reference => {
                if over_white(seed, step) {
                    color = color + open();
                }
            }
            VmBackground::Random => {
                let behind: Vec<f32> =
                    (0..3 * n as u64).map(|i| rng::uniform(seed, stream | BEHIND, i)).collect();
                for ((t, b), i) in target.iter_mut().zip(&behind).zip(0..) {
                    let i: usize = i;
                    *t += (1.0 - batch.alpha[i / 3]) * b;
                }
                color = color + open() * field::tensor(behind, [n, 3], device).autodiff();
            }
        }
        let target: Tensor<2> = field::tensor(target, [n, 3], device).autodiff();
        let rgb = (color.clamp(0.0, 1.0) - target).square().mean();
        let mut total = rgb.clone();

        let is_background = |a: &f32| f32::from(*a == 0.0);
        let background: Vec<f32> = batch.alpha.iter().map(is_background).collect();
        let count: f32 = background.iter().sum();
        let collected = field::values(opacity.clone().inner());
        let outside = (count > 0.0).then(|| {
            let sum: f32 = collected.iter().zip(&background).map(|(o, b)| o * o * b).sum();
            sum / count
        });
        let mask = match config.mask_loss {
            _ if !self.pixels.masked => None,
            MaskLoss::None => None,
            // a batch without a background ray has no such loss (the published mean is NaN then)
            MaskLoss::L2 => (count > 0.0).then(|| {
                let background = field::tensor(background, [n, 1], device).autodiff();
                (opacity.clone().square() * background).sum() / count as f64
            }),
            MaskLoss::Ce => Some({
                let head: Vec<f32> = background.iter().map(|b| 1.0 - b).collect();
                let alpha: Tensor<2> = field::tensor(head, [n, 1], device).autodiff();
                let p = opacity.clone().clamp(1e-3, 1.0 - 1e-3);
                let cross = alpha.clone() * p.clone().log() + (alpha.neg() + 1.0) * (p.neg() + 1.0).log();
                cross.mean().neg()
            }),
        };
        if let Some(mask) = &mask {
            total = total + mask.clone() * config.mask_weight;
        }
        debug_assert_eq!(out.dims()[1], RAY_WIDTH);
        (total, rgb, mask, outside)
    }

    /// The optimizer's step of each parameter.
    pub fn adam_steps(&self, step: u64) -> [AdamStep; 3] {
        let config = self.config;
        let factor = learning_rate(config, step - self.state.reset);
        let grid = AdamStep {
            lr: (config.lr_grid * factor) as f32,
            beta1: 0.9,
            beta2: 0.99,
            epsilon: 1e-8,
            weight_decay: 0.0,
            step: step - self.state.moments_from + 1,
            skip_zero: false,
        };
        let network = AdamStep { lr: (config.lr_network * factor) as f32, ..grid };
        [grid, grid, network]
    }

    /// Backward and Adam. Nothing is updated where the decoder's gradient is not finite; the grids are looked
    /// at before every checkpoint.
    fn descend(&mut self, loss: Tensor<1>, step: u64) -> Result<(), StepError> {
        let mut gradients = loss.backward();
        drop(loss);
        if !self.state.parameters[2].has_finite_gradient(&gradients) {
            return Err(self.not_finite("gradient of the", f32::NAN, step));
        }
        let steps = self.adam_steps(step);
        for (p, step) in self.state.parameters.iter_mut().zip(steps) {
            p.update(&mut gradients, step);
        }
        Ok(())
    }

    /// Is a mask or a finer grid due after a step?
    pub fn grows(&self, step: u64) -> bool {
        self.config.mask_steps.contains(&step) || self.config.upsample_steps.contains(&step)
    }

    /// Rebuilds the mask and refines the grids where that is due after step `step`.
    pub fn grow(&mut self, step: u64) -> Result<(), StepError> {
        let config = self.config;
        let masking = config.mask_steps.contains(&step);
        let upsampling = config.upsample_steps.iter().position(|&s| s == step);
        // what is not finite would be spread, or taken for empty
        if !self.state.is_finite() {
            return Err(self.not_finite("grid", f32::NAN, step));
        }
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
        Ok(())
    }
}

#[cfg(test)]
#[path = "step_tests.rs"]
mod step_tests;
#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;
