//! The operations of a training step of the signed-distance field, in the order of the step.

use super::occupancy::Occupancy;
use super::stereo::SurfacePoint;
use crate::config::iface::{Background, IfaceConfig};
use crate::field::ops::Ops;
use crate::field::parameters::ParameterGroup;
use crate::field::training::StepAt;
use tiface_base::Result;
use tiface_kernels::cpu::losses::LossWeights;
use tiface_kernels::cpu::neus::ColorRule;
use tiface_kernels::cpu::schedule::Figures;

/// Distance from a stereo point, in pixels, at which the loss changes from quadratic to linear:
/// about the error of such points.
const KNEE: f32 = 0.15;

/// Number of stereo points in a step, a few percent of its samples.
pub const STEREO_POINTS: u64 = 1024;

/// Largest number of samples in a step, as a multiple of the sample budget. A step can exceed the
/// budget because the ray count adapts one step late when cells become occupied again.
pub const MAX_BUDGETS: usize = 4;

/// Random stream of a step's background colors.
pub const BACKGROUND_STREAM: u64 = 3;

/// Range of the variance `v`, which keeps `inv_s = exp(10 v)` within the kernels' range of
/// 1e-6..=1e6. Beyond it, the gradient would be zero or infinite, and the sharpness could never
/// recover.
pub const VARIANCE: [f32; 2] = [-1.38, 1.38];

/// Returns the loss weights for photographs with or without masks.
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

/// Returns which samples of a ray have colors in training.
pub fn color_rule(config: &IfaceConfig) -> ColorRule {
    ColorRule { min_weight: config.min_weight, group_weight: config.group_weight }
}

/// Returns whether rays are composited over random colors.
pub fn random_background(config: &IfaceConfig) -> bool {
    config.background == Background::Random
}

/// Hash table, networks, variance.
pub type SdfGroups<O> = [ParameterGroup<<O as Ops>::Device>; 3];

/// The operations of a training step on one device. Intermediate results of a step stay on the
/// device, in the value that implements this trait.
pub trait SdfOps: Ops {
    /// Starts or resumes a training with the given cells to march through, number of rays of the
    /// next step, and stereo points.
    fn load(&mut self, occupancy: &Occupancy, rays: usize, points: &[SurfacePoint]);

    /// Sets the points that the surface should pass through.
    fn set_points(&mut self, points: &[SurfacePoint]);

    /// Waits for the device, reads the cells to march through, and returns the number of rays of
    /// the next step.
    fn read(&self, occupancy: &mut Occupancy) -> Result<usize>;

    /// Waits for the device and returns whether any gradient was not finite since the state was
    /// loaded.
    fn is_non_finite(&self) -> Result<bool>;

    /// Computes network weights and sharpness from parameters; keeps the variance within
    /// [`VARIANCE`].
    fn weights(&mut self, groups: &mut SdfGroups<Self>);

    /// Evaluates the field with the first `levels` of its hash grid to update the cells that may
    /// contain surface.
    fn update_occupancy(&mut self, groups: &SdfGroups<Self>, levels: usize, at: StepAt);

    /// Computes march step and number of rays from the sharpness and the samples of the last step.
    fn advance(&mut self);

    /// Draws rays. A ray of a large photograph stands for a square of pixels at most `detail` wide.
    fn draw(&mut self, at: StepAt, detail: f32);

    /// Marches the rays, and drops those whose samples exceed [`MAX_BUDGETS`] times the budget.
    fn march(&mut self);

    /// Draws random stereo points, which are evaluated together with the samples.
    fn append_points(&mut self, at: StepAt);

    /// Evaluates the field with the first `levels` of its hash grid at samples and points. Colors
    /// may wait until [`neus`](SdfOps::neus) knows which samples show.
    fn sdf_field(&mut self, groups: &SdfGroups<Self>, levels: usize);

    /// Composites the samples of each ray; `anneal` is the share of the hard cosine.
    fn neus(&mut self, anneal: f32);

    /// Computes the losses of rays, samples and points, and their gradients with respect to the
    /// field's output and the sharpness.
    fn losses(&mut self, anneal: f32);

    /// Computes the gradients of the parameters, and closes the [gate](Ops::gate) if one is not
    /// finite.
    fn backward(&mut self, groups: &mut SdfGroups<Self>);

    /// Waits for the device and returns the figures of the last step.
    fn figures(&mut self, groups: &SdfGroups<Self>) -> Result<Figures>;
}
