//! What a training step of the signed-distance field is made of, in the order of the step.

use super::occupancy::Occupancy;
use super::stereo::SurfacePoint;
use crate::Result;
use crate::config::iface::{Background, IfaceConfig};
use crate::field::ops::Ops;
use crate::field::parameters::ParameterGroup;
use crate::field::training::StepAt;
use crate::kernel::cpu::losses::LossWeights;
use crate::kernel::cpu::schedule::Figures;

/// Distance from a stereo point, in pixels, up to which the loss is square and beyond which it is linear: about the
/// error of such points.
const KNEE: f32 = 0.15;

/// Stereo points of a step: some percent of its samples.
pub const STEREO_POINTS: u64 = 1024;

/// A batch keeps at most so many times the sample budget: the ray count lags behind when cells come back.
pub const MOST_BUDGETS: usize = 4;

/// Random numbers of a step's backgrounds.
pub const BACKGROUND_STREAM: u64 = 3;

/// Where the variance stays: `inv_s = exp(10 v)` within what the kernels compute with, 1e-6..=1e6. Beyond, its gradient
/// would be zero, or infinite, and the surface would stay as sharp for ever.
pub const VARIANCE: [f32; 2] = [-1.38, 1.38];

/// Weights of the losses of photographs with or without masks.
pub fn loss_weights(config: &IfaceConfig, masked: bool) -> LossWeights {
    LossWeights {
        rgb_mse: config.rgb_mse as f32,
        rgb_sample: config.rgb_sample as f32,
        mask: if masked { config.mask as f32 } else { 0.0 },
        eikonal: config.eikonal as f32,
        sparsity: config.sparsity as f32,
        sparsity_scale: config.sparsity_scale as f32,
        stereo: config.stereo as f32,
        knee: KNEE,
    }
}

/// Are rays seen over random colors?
pub fn random_background(config: &IfaceConfig) -> bool {
    config.background == Background::Random
}

/// Hash table, networks, variance.
pub type SdfGroups<O> = [ParameterGroup<<O as Ops>::Device>; 3];

/// The operations of a training step on one device. What a step leaves for its next operation stays on the device, in
/// the value that implements this.
pub trait SdfOps: Ops {
    /// Begins a training, or goes on with one: the cells to march through, the rays of the next step, and the stereo points.
    fn load(&mut self, occupancy: &Occupancy, rays: usize, points: &[SurfacePoint]);

    /// Sets the points that the surface should pass through.
    fn set_points(&mut self, points: &[SurfacePoint]);

    /// Waits for the device; the cells to march through, and the rays of the next step.
    fn read(&self, occupancy: &mut Occupancy) -> Result<usize>;

    /// Waits for the device: was a gradient not finite since the state was loaded?
    fn is_broken(&self) -> Result<bool>;

    /// Computes network weights and sharpness from parameters; keeps the variance within [`VARIANCE`].
    fn weights(&mut self, groups: &mut SdfGroups<Self>);

    /// Evaluates the field again to find the cells that may hold surface, with so many levels of the hash grid.
    fn update_occupancy(&mut self, groups: &SdfGroups<Self>, levels: usize, at: StepAt);

    /// Finds march step and number of rays by the sharpness and the samples of the last step.
    fn advance(&mut self);

    /// Draws rays; of large photographs each stands for a square of pixels as wide as `detail`.
    fn draw(&mut self, at: StepAt, detail: f32);

    /// Marches them. Rays beyond [`MOST_BUDGETS`] of samples are dropped.
    fn march(&mut self);

    /// Draws some of the stereo points, which are evaluated with the samples.
    fn append_points(&mut self, at: StepAt);

    /// Evaluates the field, so many levels of its hash grid, at samples and points.
    fn sdf_field(&mut self, groups: &SdfGroups<Self>, levels: usize);

    /// Composites the samples of each ray; `anneal` is the share of the hard cosine.
    fn neus(&mut self, anneal: f32);

    /// Losses of rays, samples and points, and their gradients by the field's output and the sharpness.
    fn losses(&mut self, anneal: f32);

    /// Gradients of the parameters; closes the [gate](Ops::gate) where one is not finite.
    fn backward(&mut self, groups: &mut SdfGroups<Self>);

    /// Waits for the device and returns what the last step came to.
    fn figures(&mut self, groups: &SdfGroups<Self>) -> Result<Figures>;
}
