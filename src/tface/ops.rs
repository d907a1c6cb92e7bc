//! The operations of a training step of the vector-matrix field, in the order of the step.

use crate::config::{MaskLoss, VmBackground, VmConfig};
use crate::field::ops::Ops;
use crate::field::parameters::{HostGroup, ParameterGroup};
use crate::field::pixels::RaySampler;
use crate::field::training::StepAt;
use std::sync::Arc;
use tiface_base::Result;
use tiface_base::math::rng;
use tiface_kernels::cpu::vm::VmField;
use tiface_kernels::cpu::vm::losses::{BackgroundMode, MaskTerm, VmFigures};

/// Random stream of a step's background colors.
pub const BACKGROUND_STREAM: u64 = 8;

/// Returns the loss term that compares opacity with the mask.
pub fn mask_term(config: &VmConfig, sampler: &RaySampler) -> MaskTerm {
    let weight = config.mask_weight as f32;
    match config.mask_loss {
        _ if !sampler.has_masks => MaskTerm::None,
        MaskLoss::None => MaskTerm::None,
        MaskLoss::L2 => MaskTerm::L2(weight),
        MaskLoss::Ce => MaskTerm::Ce(weight),
    }
}

/// Returns the background of a step's rays. As published, half of the batches are composited over
/// white while their targets stay over black.
pub fn background_mode(config: &VmConfig, at: StepAt) -> BackgroundMode {
    let white =
        config.background == VmBackground::Reference && rng::uniform(at.seed, at.step << 4 | 9, 0) < 0.5;
    BackgroundMode { lift: f32::from(white), target: random_background(config) }
}

/// Returns whether rays are composited over random colors.
pub fn random_background(config: &VmConfig) -> bool {
    config.background == VmBackground::Random
}

/// Planes and lines of the density, those of the appearance, the decoder's weights.
pub type VmGroups<O> = [ParameterGroup<<O as Ops>::Device>; 3];

/// The operations of a training step on one device. Intermediate results of a step stay on the
/// device, in the value that implements this trait.
pub trait VmOps: Ops {
    /// Starts or resumes a training, or continues it with refined grids. Returns the parameters in
    /// the device's layout.
    fn load(&mut self, field: &Arc<VmField>, groups: [HostGroup; 3]) -> VmGroups<Self>;

    /// Frees the memory of a field before another one is loaded.
    fn unload(&mut self, groups: Option<VmGroups<Self>>);

    /// Waits for the device and copies parameters to the host.
    fn read(&self, groups: &VmGroups<Self>) -> Result<[HostGroup; 3]>;

    /// Waits for the device and returns whether any gradient was not finite since the state was
    /// loaded.
    fn is_non_finite(&self) -> Result<bool>;

    /// Draws `rays` rays. A ray of a large photograph stands for a square of pixels at most
    /// `detail` wide.
    fn draw(&mut self, at: StepAt, rays: usize, detail: f32);

    /// Marches the rays, evaluates and decodes the field at their samples, and composites them.
    fn vm_render(&mut self, groups: &VmGroups<Self>);

    /// Computes the losses of the rays and their gradients with respect to the composited values.
    fn losses(&mut self, mode: BackgroundMode);

    /// Computes the gradients of the parameters, and closes the [gate](Ops::gate) if one of the
    /// decoder is not finite.
    fn backward(&mut self, groups: &mut VmGroups<Self>);

    /// Adds the gradients of the regularizers of both grids.
    fn penalize(&mut self, groups: &mut VmGroups<Self>, weights: [f32; 2]);

    /// Resets the accumulated figures.
    fn reset_totals(&mut self);

    /// Waits for the device and returns the figures accumulated since they were reset.
    fn figures(&self) -> Result<VmFigures>;
}
