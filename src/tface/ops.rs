//! What a training step of the vector-matrix field is made of, in the order of the step.

use crate::Result;
use crate::config::{MaskLoss, VmBackground, VmConfig};
use crate::field::ops::Ops;
use crate::field::parameters::{HostGroup, ParameterGroup};
use crate::field::pixels::Pixels;
use crate::field::training::StepAt;
use crate::kernel::cpu::rng;
use crate::kernel::cpu::vm::VmField;
use crate::kernel::cpu::vm::losses::{BackgroundMode, MaskTerm, VmFigures};
use std::sync::Arc;

/// Random numbers of a step's backgrounds.
pub const BACKGROUND_STREAM: u64 = 8;

/// How opacity is held to the mask.
pub fn mask_term(config: &VmConfig, pixels: &Pixels) -> MaskTerm {
    let weight = config.mask_weight as f32;
    match config.mask_loss {
        _ if !pixels.has_masks => MaskTerm::None,
        MaskLoss::None => MaskTerm::None,
        MaskLoss::L2 => MaskTerm::L2(weight),
        MaskLoss::Ce => MaskTerm::Ce(weight),
    }
}

/// What the rays of a step are seen over. The published batch is seen over white, half of them are, where the target stays
/// over black.
pub fn background_mode(config: &VmConfig, at: StepAt) -> BackgroundMode {
    let white =
        config.background == VmBackground::Reference && rng::uniform(at.seed, at.step << 4 | 9, 0) < 0.5;
    BackgroundMode { lift: f32::from(white), target: random_background(config) }
}

/// Are rays seen over random colors?
pub fn random_background(config: &VmConfig) -> bool {
    config.background == VmBackground::Random
}

/// Planes and lines of the density, those of the appearance, the decoder's weights.
pub type VmGroups<O> = [ParameterGroup<<O as Ops>::Device>; 3];

/// The operations of a training step on one device. What a step leaves for its next operation stays on the device, in
/// the value that implements this.
pub trait VmOps: Ops {
    /// Begins a training, goes on with one, or with finer grids: the field, and its parameters as the device lays them.
    fn load(&mut self, field: &Arc<VmField>, groups: [HostGroup; 3]) -> VmGroups<Self>;

    /// Gives up the memory of a field before another one is loaded.
    fn unload(&mut self, groups: Option<VmGroups<Self>>);

    /// Waits for the device and copies parameters to the host.
    fn read(&self, groups: &VmGroups<Self>) -> Result<[HostGroup; 3]>;

    /// Waits for the device: was a gradient not finite since the state was loaded?
    fn is_broken(&self) -> Result<bool>;

    /// Draws rays; of large photographs each stands for a square of pixels as wide as `detail`.
    fn draw(&mut self, at: StepAt, detail: f32);

    /// Marches, looks up, decodes and composites.
    fn vm_render(&mut self, groups: &VmGroups<Self>);

    /// Losses of the rays and their gradients by what was composited.
    fn losses(&mut self, mode: BackgroundMode);

    /// Gradients of the parameters; closes the [gate](Ops::gate) where one of the decoder is not finite.
    fn backward(&mut self, groups: &mut VmGroups<Self>);

    /// Adds the gradients of the regularizers of both grids.
    fn penalize(&mut self, groups: &mut VmGroups<Self>, weights: [f32; 2]);

    /// Forgets what steps came to since the last time.
    fn forget(&mut self);

    /// Waits for the device and returns what the steps since the last time came to.
    fn figures(&mut self) -> Result<VmFigures>;
}
