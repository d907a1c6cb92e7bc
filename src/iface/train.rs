//! One training step of the `iface` stage; the loop around it is [`crate::field::training`]'s.

use super::hull_start::HullDistance;
use super::infer::IFace;
use super::losses::{Marched, losses};
use super::model::{GEOMETRY, shape};
#[cfg(feature = "wgpu")]
use super::on_device::OnDevice;
use super::schedule::{self, march_step};
use super::state::{FORMAT, SdfState};
use super::stereo::{self, HostField, SurfacePoint};
use crate::config::iface::{IfaceConfig, OccupancyRule, Start};
use crate::field::checkpoint::{Checkpoint, TrainingProgress};
use crate::field::pixels::{Batch, LARGE, Pixels, TrainView};
use crate::field::training::{self, Learner, StepError, StepReport, TrainingSession};
use crate::field::{self, Place};
use crate::kernel::adam::AdamStep;
use crate::kernel::march::{self, Bitmask};
use crate::kernel::rng;
use crate::kernel::sdf::{self, FieldShape};
use crate::{Error, Result};
use burn::tensor::{Device, Tensor};
use serde::Serialize;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Instant;

/// What training did.
#[derive(Clone, Debug, Serialize)]
pub struct IfaceReport {
    /// Optimizer steps.
    pub steps: u64,
    /// Seconds in this process (less than the whole when resumed).
    pub seconds: f64,
    /// Final sharpness.
    pub inv_s: f32,
    /// PSNR of the last training batches, dB.
    pub train_psnr: f64,
    /// Share of the occupancy grid that was marched at the end.
    pub occupied: f64,
    /// What learned it, and why that.
    pub device: String,
    /// Oddities on the way: a damaged checkpoint, a restored step.
    pub warnings: Vec<String>,
}

/// Steps in a row without a single sample after which nothing can bring the surface back.
pub(super) const LOST_AFTER: u64 = 20;

/// A batch keeps at most so many times the sample budget: the ray count lags behind when cells come back.
pub(super) const MOST_BUDGETS: usize = 4;

/// Stereo points of a step: some percent of its samples.
pub(super) const STEREO_POINTS: u64 = 1024;

/// Drops the last rays of a batch until at most `most` samples are left (one ray always stays).
fn shorten(batch: &mut Batch, samples: &mut march::Samples, most: usize) {
    if samples.t.len() <= most {
        return;
    }
    let kept = samples.offsets.iter().rposition(|&o| o as usize <= most).unwrap_or(0).max(1);
    samples.offsets.truncate(kept + 1);
    samples.t.truncate(samples.offsets[kept] as usize);
    batch.rays.truncate(kept);
    batch.color.truncate(kept);
    batch.alpha.truncate(kept);
}

/// A training on the CPU, and what one on a GPU begins and ends with.
pub(super) struct SdfTraining<'a> {
    pub config: &'a IfaceConfig,
    session: TrainingSession<'a>,
    hull: Option<&'a Bitmask>,
    pub device: Device,
    pub shape: FieldShape,
    pub pixels: Pixels<'a>,
    pub state: SdfState,
    /// Steps in a row that met no sample.
    blind: u64,
}

/// The error that rays meet nothing any more.
pub(super) fn lost(step: u64) -> Error {
    Error::cannot(
        format!("the surface is lost at step {step}: no ray of {LOST_AFTER} steps met a sample"),
        "look at the masks and poses with `tiface inspect`; lower iface.lr_network",
    )
}

/// The optimizer's step of each group.
pub(super) struct AdamSteps {
    pub table: AdamStep,
    pub network: AdamStep,
    pub variance: AdamStep,
}

/// The optimizer's step number `step`, from 1, where learning rates are `factor` of their peak.
pub(super) fn adam_steps(config: &IfaceConfig, factor: f64, step: u64) -> AdamSteps {
    let network = AdamStep {
        lr: (config.lr_network * factor) as f32,
        beta1: 0.9,
        beta2: 0.99,
        epsilon: 1e-15,
        weight_decay: config.weight_decay as f32,
        step,
        skip_zero: false,
    };
    let table = AdamStep {
        lr: (config.lr_table * factor) as f32,
        weight_decay: config.table_decay as f32,
        skip_zero: config.touched_rows,
        ..network
    };
    let variance = AdamStep { lr: (config.lr_variance * factor) as f32, ..network };
    AdamSteps { table, network, variance }
}

/// Trains until `config.steps`, saving checkpoints and continuing from the one that lies in the session's folder.
///
/// `views` have their cameras in scene coordinates; `hull` is the masks' visual hull over the scene's box.
pub fn train(
    views: &[TrainView],
    hull: Option<&Bitmask>,
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(IFace, IfaceReport)> {
    let began = Instant::now();
    let mut learner = SdfTraining::new(views, hull, config, session)?;
    let place = field::place(session.device)?.or_processor(|place| match place {
        Place::Cpu(_) => Ok(()),
        #[cfg(feature = "wgpu")]
        Place::Gpu(gpu) => OnDevice::fits(&learner, &gpu.device),
    })?;
    let device = place.told();
    let (progress, warnings) = match place {
        Place::Cpu(_) => training::train(&mut learner, session, config.steps, config.checkpoint_s)?,
        #[cfg(feature = "wgpu")]
        Place::Gpu(gpu) => {
            let mut there = OnDevice::new(learner, gpu.device)?;
            let done = training::train(&mut there, session, config.steps, config.checkpoint_s)?;
            learner = there.finish()?;
            done
        }
    };
    let report = IfaceReport {
        steps: config.steps,
        seconds: began.elapsed().as_secs_f64(),
        inv_s: learner.state.model.sharpness(),
        train_psnr: progress.psnr(),
        occupied: learner.state.occupancy.share(),
        device,
        warnings,
    };
    Ok((IFace::new(config, learner.state), report))
}

impl<'a> SdfTraining<'a> {
    /// Before the first step.
    pub fn new(
        views: &'a [TrainView],
        hull: Option<&'a Bitmask>,
        config: &'a IfaceConfig,
        session: &TrainingSession<'a>,
    ) -> Result<SdfTraining<'a>> {
        let device = field::processor();
        // without a hull every ray may meet a sample; with one, cells reach some four beyond the outline
        let reach = match hull {
            Some(_) => 4.0 * 2.0 / config.occupancy_resolution.min(128) as f32,
            None => f32::INFINITY,
        };
        let published = config.occupancy == OccupancyRule::Nerfacc;
        let mut pixels = Pixels::new(views, reach, config.radius, config.foreground, published);
        if !published {
            pixels = pixels.with_large(LARGE.min(schedule::cell(config, config.levels)));
        }
        if pixels.count() == 0 {
            return Err(training::no_pixels());
        }
        let state = SdfState::new(config, session.seed, hull, &device);
        let shape = shape(config);
        Ok(SdfTraining { config, session: *session, hull, device, shape, pixels, state, blind: 0 })
    }
}

impl Learner for SdfTraining<'_> {
    const FORMAT: &'static str = FORMAT;
    const RATES: [&'static str; 2] = ["lr_network", "lr_table"];

    fn step(&mut self, progress: &TrainingProgress) -> Result<StepReport, StepError> {
        let config = self.config;
        let step = progress.step;
        let seed = self.seed(progress);
        let shape = self.shape_at(step);
        let inv_s = self.state.model.sharpness();
        let dt = march_step(config, inv_s);
        if self.looks_again(step) {
            self.update_occupancy(&shape, (seed, step), inv_s, dt);
        }
        if schedule::stereo_step(config) == Some(step) {
            self.find_stereo(&shape);
        }
        let detail = schedule::detail(config, step);
        let mut batch = self.pixels.draw(seed, step, self.state.rays, config.jitter, detail);
        let mut samples = self.state.occupancy.march(config, dt, &batch.rays);
        let n = samples.t.len();
        self.state.rays = self.next_rays(self.state.rays, n);
        shorten(&mut batch, &mut samples, MOST_BUDGETS * config.samples);
        let n = samples.t.len();
        self.blind = if n == 0 { self.blind + 1 } else { 0 };
        if self.blind == LOST_AFTER {
            return Err(StepError::Failed(lost(step)));
        }
        let (mut square_error, mut terms) = (None, [0f32; 5]);
        // nothing in sight of these rays: no gradient, but the schedule goes on
        if n > 0 {
            let stereo = self.draw_stereo(seed, step);
            let marched = Marched { batch: &batch, samples, stereo, dt, masked: self.pixels.masked };
            let losses = losses(config, &self.state.model, &shape, marched, (seed, step), &self.device);
            let read = |t: &Tensor<1>| field::values(t.clone().inner())[0];
            terms = [
                Some(&losses.rgb),
                losses.mask.as_ref(),
                Some(&losses.eikonal),
                losses.sparsity.as_ref(),
                losses.stereo.as_ref(),
            ]
            .map(|term| term.map_or(0.0, read));
            square_error = Some(terms[0]);
            let factor = schedule::learning_rate(config, step);
            for (term, value) in TERMS.into_iter().zip(terms) {
                if !value.is_finite() {
                    return Err(StepError::NotFinite { term, value, lr: config.lr_network * factor });
                }
            }
            self.descend(losses.total, factor, step + 1, ("gradient of the", 11))?;
        }
        let mut figures: Vec<_> = TERMS.into_iter().zip(terms.map(|v| v as f64)).collect();
        figures.extend([
            ("inv_s", self.state.model.sharpness() as f64),
            ("rays", self.state.rays as f64),
            ("samples", n as f64),
        ]);
        Ok(StepReport { square_error, figures })
    }

    fn save(&self, _: &TrainingProgress, into: &mut Checkpoint, _: bool) -> Result<(), StepError> {
        self.state.save(into);
        Ok(())
    }

    fn restore(&mut self, from: Option<(&mut Checkpoint, &TrainingProgress, bool)>) -> Result<(), StepError> {
        if let Some((from, ..)) = from {
            self.state = SdfState::restore(self.config, self.hull, from, &self.device)?;
        } else if let (Start::Hull, Some(hull)) = (self.config.start, self.hull) {
            self.fit_hull(hull)?;
        }
        Ok(())
    }
}

/// Names of the losses.
pub(super) const TERMS: [&str; 5] = ["rgb", "mask", "eikonal", "sparsity", "stereo"];

/// Where the variance stays: `inv_s = exp(10 v)` within what the kernels compute with, 1e-6..=1e6. Beyond, its gradient
/// would be zero, or infinite, and the surface would stay as sharp for ever.
pub(super) const VARIANCE: RangeInclusive<f32> = -1.38..=1.38;

impl SdfTraining<'_> {
    /// The seed of a step: another one after a step that diverged.
    pub fn seed(&self, progress: &TrainingProgress) -> u64 {
        self.session.seed ^ progress.salt << 32
    }

    /// Are the cells to march through looked at before this step? A new level, and the end of the hull's fit, move the
    /// surface: look again at once.
    pub fn looks_again(&self, step: u64) -> bool {
        let config = self.config;
        let level_came = config.level_every > 0 && step.is_multiple_of(config.level_every);
        step.is_multiple_of(config.occupancy_every) || (config.occupancy == OccupancyRule::Band && level_came)
    }

    /// The fewest rays of a step.
    pub fn fewest_rays(&self) -> usize {
        if self.config.occupancy == OccupancyRule::Band { 64 } else { 1 }
    }

    /// Rays of the next step, where this one's met so many samples.
    pub fn next_rays(&self, rays: usize, samples: usize) -> usize {
        schedule::next_rays(rays, samples, self.config.samples, self.fewest_rays(), self.config.max_rays)
    }

    /// Returns the field's shape at a step (levels come in one by one).
    pub fn shape_at(&self, step: u64) -> Arc<FieldShape> {
        Arc::new(FieldShape { active: schedule::active_levels(self.config, step), ..self.shape.clone() })
    }

    /// Looks again at which cells may hold surface.
    pub fn update_occupancy(&mut self, shape: &FieldShape, at: (u64, u64), inv_s: f32, dt: f32) {
        let (table, weights) = self.state.model.on_host(shape);
        let table: &[[f32; 2]] = bytemuck::cast_slice(&table);
        let distances = |x: &[[f32; 3]]| sdf::values(shape, table, &weights, x);
        let soft = |x: &[[f32; 3]]| sdf::softness(shape, table, &weights, x);
        self.state.occupancy.update(self.config, at, inv_s, dt, distances, soft);
    }

    /// Looks for points that photographs agree on, around the surface as it is.
    pub fn find_stereo(&mut self, shape: &FieldShape) {
        let (table, weights) = self.state.model.on_host(shape);
        let field = HostField { shape, table: bytemuck::cast_slice(&table), weights: &weights };
        self.state.stereo = stereo::points(self.pixels.views(), self.config, &field, &self.state.occupancy);
    }

    /// Some of the points, a function of seed and step alone.
    fn draw_stereo(&self, seed: u64, step: u64) -> Vec<SurfacePoint> {
        let all = &self.state.stereo;
        let count = if all.is_empty() { 0 } else { STEREO_POINTS };
        (0..count).map(|i| all[rng::below(seed, step << 4 | 12, i, all.len() as u64) as usize]).collect()
    }

    /// Backward and AdamW of the first `count` parameters, each group at its own rate. Nothing is updated where a
    /// gradient is not finite: a finite loss does not promise one.
    fn descend(
        &mut self,
        loss: Tensor<1>,
        factor: f64,
        adam_step: u64,
        (term, count): (&'static str, usize),
    ) -> Result<(), StepError> {
        let config = self.config;
        let mut gradients = loss.backward();
        drop(loss);
        let parameters = &mut self.state.model.0[..count];
        // what breaks the table's gradient passes through the layers above it
        if !parameters[1..].iter().all(|p| p.has_finite_gradient(&gradients)) {
            return Err(StepError::NotFinite { term, value: f32::NAN, lr: config.lr_network * factor });
        }
        let steps = adam_steps(config, factor, adam_step);
        for p in parameters {
            let step = match p.name {
                "table" => steps.table,
                "variance" => steps.variance,
                _ => steps.network,
            };
            p.update(&mut gradients, step);
            if p.name == "variance" {
                p.keep_within(VARIANCE);
            }
        }
        Ok(())
    }

    /// Fits the field to the hull's distance: half of the points in a band around its boundary.
    fn fit_hull(&mut self, hull: &Bitmask) -> Result<(), StepError> {
        /// Enough for errors well below a cell of the hull with the coarse levels.
        const STEPS: u64 = 250;
        const POINTS: usize = 8192;
        let distance = HullDistance::new(hull);
        let config = self.config;
        let shape = self.shape_at(0);
        for step in 0..STEPS {
            let mut x = Vec::with_capacity(3 * POINTS);
            let mut target = Vec::with_capacity(POINTS);
            let mut k = 0;
            while target.len() < POINTS {
                let u = |a: u64| 2.0 * rng::uniform(self.session.seed, 201 + (step << 10), 4 * k + a) - 1.0;
                let p = [u(0), u(1), u(2)];
                k += 1;
                let f = distance.at(p);
                // every second point anywhere, the others near the boundary
                if k % 2 == 0 && f.abs() > 0.1 {
                    continue;
                }
                x.extend(p.map(|c| c * config.radius));
                target.push(f * config.radius);
            }
            let n = target.len();
            let device = &self.device;
            let directions = field::tensor([0.0, 0.0, 1.0].repeat(n), [n, 3], device);
            let out = self.state.model.field(&shape, field::tensor(x, [n, 3], device), directions);
            let target: Tensor<2> = field::tensor(target, [n, 1], device).autodiff();
            let error = (out.clone().narrow(1, 0, 1) - target).abs().mean();
            let length = (out.narrow(1, 1, 3).square().sum_dim(1) + 1e-12).sqrt();
            let loss = error * 10.0 + (length - 1.0).square().mean() * 0.1;
            let factor = 0.1f64.powf(step as f64 / STEPS as f64) * ((step + 1) as f64 / 20.0).min(1.0);
            self.descend(loss, factor, step + 1, ("hull", GEOMETRY))?;
            if self.session.monitor.stop() {
                let kept = "before the first step: the fit to the hull starts again";
                return Err(StepError::Failed(Error::stopped(kept)));
            }
        }
        // training starts with its own moments
        self.state.model.0.iter_mut().for_each(|p| p.forget_moments());
        Ok(())
    }
}

#[cfg(test)]
#[path = "step_tests.rs"]
mod step_tests;
#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;
