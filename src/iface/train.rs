//! Training of the `iface` stage, on any device.

use super::cpu::CpuSdf;
#[cfg(feature = "wgpu")]
use super::gpu::GpuSdf;
use super::hull_start::fit_hull;
use super::infer::IFace;
use super::model::{initial, parts, shape};
use super::occupancy::Occupancy;
use super::ops::{SdfGroups, SdfOps, VARIANCE};
use super::schedule;
use super::state::{FORMAT, SdfState};
use super::stereo::{self, HostField, SurfacePoint};
use crate::config::iface::{IfaceConfig, OccupancyRule, Start};
use crate::field::checkpoint::{Checkpoint, TrainingProgress};
use crate::field::ops::ArrayDevice;
use crate::field::parameters::ParameterGroup;
use crate::field::pixels::{LARGE, RaySampler};
use crate::field::training::{self, Model, StepAt, StepError, StepReport, TrainingSession};
use crate::field::{self, ComputeDevice};
use serde::Serialize;
use std::time::Instant;
use tiface_base::geom::BitGrid;
use tiface_base::{Error, Result};
use tiface_capture::LoadedView;
use tiface_kernels::cpu::schedule::Figures;

/// Report of a training.
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
    /// Device of the training, and the reason for choosing it.
    pub device: String,
    /// Warnings, such as a damaged checkpoint or a restored step.
    pub warnings: Vec<String>,
}

/// Number of consecutive steps without a sample after which the surface cannot recover.
const LOST_AFTER: u64 = 20;

/// Names of the losses.
pub(super) const TERMS: [&str; 5] = ["rgb", "mask", "eikonal", "sparsity", "stereo"];

/// A signed-distance field in training on a device.
pub(super) struct SdfModel<'a, O: SdfOps> {
    pub config: &'a IfaceConfig,
    session: TrainingSession<'a>,
    hull: Option<&'a BitGrid>,
    pub sampler: &'a RaySampler<'a>,
    pub ops: O,
    pub groups: SdfGroups<O>,
    /// Cells at the time of loading; those on the device are newer.
    occupancy: Occupancy,
    /// Stereo points that several photographs agree on, once they are found.
    stereo: Vec<SurfacePoint>,
}

/// Collects the pixels that training rays are drawn from.
pub(super) fn sampler<'a>(
    views: &'a [LoadedView],
    hull: Option<&BitGrid>,
    config: &IfaceConfig,
) -> Result<RaySampler<'a>> {
    // Without a hull every ray may meet a sample; with one, occupied cells reach about four cells
    // beyond the outline.
    let reach = match hull {
        Some(_) => 4.0 * 2.0 / config.occupancy_resolution.min(128) as f32,
        None => f32::INFINITY,
    };
    let published = config.occupancy == OccupancyRule::Nerfacc;
    let mut sampler = RaySampler::new(views, reach, config.radius, config.foreground, published);
    if !published {
        sampler = sampler.with_large(LARGE.min(schedule::cell(config, config.levels)));
    }
    if sampler.count() == 0 {
        return Err(training::no_pixels());
    }
    Ok(sampler)
}

/// Trains until `config.steps`, saving checkpoints and continuing from the one that lies in the
/// session's folder.
///
/// `views` have their cameras in scene coordinates; `hull` is the masks' visual hull over the
/// scene's box.
pub fn train(
    views: &[LoadedView],
    hull: Option<&BitGrid>,
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(IFace, IfaceReport)> {
    let began = Instant::now();
    let sampler = sampler(views, hull, config)?;
    let device =
        field::compute_device(session.device, &super::SDF_TEST)?.fallback_to_cpu(|device| match device {
            ComputeDevice::Cpu(_) => Ok(()),
            #[cfg(feature = "wgpu")]
            ComputeDevice::Gpu(gpu) => GpuSdf::fits(config, &sampler, &gpu.device),
        })?;
    let (description, refused) = (device.description(), device.warning());
    let (state, progress, warnings) = match device {
        ComputeDevice::Cpu(_) => train_on(CpuSdf::new(config, &sampler), &sampler, hull, config, session)?,
        #[cfg(feature = "wgpu")]
        ComputeDevice::Gpu(gpu) => {
            train_on(GpuSdf::new(config, &sampler, gpu.device)?, &sampler, hull, config, session)?
        }
    };
    let report = IfaceReport {
        steps: config.steps,
        seconds: began.elapsed().as_secs_f64(),
        inv_s: state.inv_s(),
        train_psnr: progress.psnr(),
        occupied: state.occupancy.share(),
        device: description,
        warnings: refused.into_iter().chain(warnings).collect(),
    };
    Ok((IFace::new(config, state), report))
}

fn train_on<O: SdfOps>(
    ops: O,
    sampler: &RaySampler,
    hull: Option<&BitGrid>,
    config: &IfaceConfig,
    session: &TrainingSession,
) -> Result<(SdfState, TrainingProgress, Vec<String>)> {
    let mut model = SdfModel::new(ops, sampler, hull, config, session);
    let (progress, warnings) = training::train(&mut model, session, config.steps, config.checkpoint_s)?;
    Ok((model.state()?, progress, warnings))
}

impl<'a, O: SdfOps> SdfModel<'a, O> {
    /// Creates the model in its initial state, without looking for a checkpoint.
    pub fn new(
        ops: O,
        sampler: &'a RaySampler<'a>,
        hull: Option<&'a BitGrid>,
        config: &'a IfaceConfig,
        session: &TrainingSession<'a>,
    ) -> SdfModel<'a, O> {
        let SdfState { groups, occupancy, stereo, .. } =
            SdfState::start(initial(config, session.seed), config, hull);
        let groups = groups.map(|group| ParameterGroup::upload(ops.device(), group));
        SdfModel { config, session: *session, hull, sampler, ops, groups, occupancy, stereo }
    }

    /// Waits for the device and returns the current state.
    pub fn state(&self) -> Result<SdfState> {
        let [table, network, variance] =
            self.groups.each_ref().map(|group| group.download(self.ops.device()));
        let mut variance = variance?;
        variance.state[0][0] = variance.state[0][0].clamp(VARIANCE[0], VARIANCE[1]);
        let mut occupancy = self.occupancy.clone();
        let rays = self.ops.read(&mut occupancy)?;
        Ok(SdfState { groups: [table?, network?, variance], occupancy, rays, stereo: self.stereo.clone() })
    }

    /// Copies a state to the device.
    pub fn load(&mut self, state: SdfState) {
        self.ops.load(&state.occupancy, state.rays, &state.stereo);
        self.groups = state.groups.map(|group| ParameterGroup::upload(self.ops.device(), group));
        (self.occupancy, self.stereo) = (state.occupancy, state.stereo);
    }

    /// Searches stereo points around the current surface.
    fn find_stereo(&mut self, levels: usize) -> Result<()> {
        let state = self.state()?;
        let mut shape = shape(self.config);
        shape.active = levels;
        let (_, weights) = state.weights(&shape);
        let field = HostField { shape: &shape, table: state.table(), weights: &weights };
        self.stereo = stereo::points(self.sampler.views(), self.config, &field, &state.occupancy);
        self.ops.set_points(&self.stereo);
        Ok(())
    }
}

impl<O: SdfOps> Model for SdfModel<'_, O> {
    const FORMAT: &'static str = FORMAT;
    const RATES: [&'static str; 2] = ["lr_network", "lr_table"];
    const READ_EVERY: u64 = <O::Device as ArrayDevice>::READ_EVERY;

    fn learning_rate(&self, step: u64) -> f64 {
        self.config.lr_network * schedule::learning_rate(self.config, step)
    }

    fn prepare(&mut self, at: StepAt) -> Result<(), StepError> {
        let config = self.config;
        self.ops.weights(&mut self.groups);
        let levels = schedule::active_levels(config, at.step);
        if schedule::updates_occupancy(config, at.step) {
            self.ops.update_occupancy(&self.groups, levels, at);
        }
        if schedule::stereo_step(config) == Some(at.step) {
            self.find_stereo(levels)?;
        }
        Ok(())
    }

    fn backward(&mut self, at: StepAt) {
        let (config, ops) = (self.config, &mut self.ops);
        let anneal = schedule::anneal(config, at.step);
        ops.advance();
        ops.draw(at, schedule::detail(config, at.step));
        ops.march();
        ops.append_points(at);
        ops.sdf_field(&self.groups, schedule::active_levels(config, at.step));
        ops.neus(anneal);
        ops.losses(anneal);
        ops.backward(&mut self.groups);
    }

    fn optimize(&mut self, step: u64) {
        let steps = schedule::adam_steps(self.config, schedule::learning_rate(self.config, step), step + 1);
        for (group, step) in self.groups.iter_mut().zip(&steps) {
            group.step(self.ops.device(), step, self.ops.gate());
        }
    }

    fn report(&mut self, step: u64) -> Result<StepReport, StepError> {
        let Figures { losses, mean_square, variance, samples, rays, empty_steps, non_finite } =
            self.ops.figures(&self.groups)?;
        let [rgb, _, mask, eikonal, sparsity, stereo] = losses;
        if empty_steps >= LOST_AFTER {
            return Err(StepError::Failed(Error::cannot(
                format!("the surface is lost at step {step}: no ray of {LOST_AFTER} steps met a sample"),
                "look at the masks and poses with `tiface inspect`; lower iface.lr_network",
            )));
        }
        // Terms without weight are shown as 0.
        let config = self.config;
        let weighted = |weight: f64, value: f32| if weight > 0.0 { value } else { 0.0 };
        let masked = if self.sampler.has_masks { config.mask } else { 0.0 };
        let terms = [
            rgb,
            weighted(masked, mask),
            eikonal,
            weighted(config.sparsity, sparsity),
            weighted(config.stereo, stereo),
        ];
        let terms: [_; 5] = std::array::from_fn(|k| (TERMS[k], if samples > 0 { terms[k] } else { 0.0 }));
        let others = [
            ("inv_s", (10.0 * f64::from(variance)).exp()),
            ("rays", rays as f64),
            ("samples", samples as f64),
        ];
        StepReport::checked(terms, non_finite, mean_square, others)
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
            Some((from, ..)) => SdfState::restore(parts(self.config), self.config, self.hull, from)?,
            None => {
                let groups = initial(self.config, self.session.seed);
                let mut state = SdfState::start(groups, self.config, self.hull);
                if let (Start::Hull, Some(hull)) = (self.config.start, self.hull) {
                    fit_hull(&mut state, hull, self.config, &self.session)?;
                }
                state
            }
        };
        self.load(state);
        Ok(())
    }
}

#[cfg(test)]
#[path = "step_tests.rs"]
mod step_tests;
#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;
