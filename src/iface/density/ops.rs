//! What a training step of the density is made of, in the order of the step.

use crate::Result;
use crate::field::ops::Ops;
use crate::field::parameters::ParameterGroup;
use crate::field::training::StepAt;
use crate::iface::occupancy::Occupancy;
use crate::kernel::cpu::schedule::Figures;

/// Cells above so much opacity of a march step are marched through.
pub const OCCUPIED: f32 = 0.01;

/// Hash table and networks.
pub type DensityGroups<O> = [ParameterGroup<<O as Ops>::Device>; 2];

/// The operations of a training step on one device. What a step leaves for its next operation stays on the device, in
/// the value that implements this.
pub trait DensityOps: Ops {
    /// Begins a training, or goes on with one: the cells to march through, and the rays of the next step.
    fn load(&mut self, occupancy: &Occupancy, rays: usize);

    /// Waits for the device; the cells to march through, and the rays of the next step.
    fn read(&self, occupancy: &mut Occupancy) -> Result<usize>;

    /// Waits for the device: was a gradient not finite since the state was loaded?
    fn is_broken(&self) -> Result<bool>;

    /// Evaluates the field again to find the cells that may hold something.
    fn update_occupancy(&mut self, groups: &DensityGroups<Self>, at: StepAt);

    /// Draws as many rays as the samples of the last step leave for this one.
    fn draw(&mut self, at: StepAt);

    /// Marches them up to where the light is gone.
    fn march(&mut self, groups: &DensityGroups<Self>);

    /// Evaluates the field at the samples.
    fn density_field(&mut self, groups: &DensityGroups<Self>);

    /// Composites the samples of each ray; losses, and their gradients by the field's output.
    fn losses(&mut self);

    /// Gradients of the parameters; closes the [gate](Ops::gate) where one is not finite.
    fn backward(&mut self, groups: &mut DensityGroups<Self>);

    /// Waits for the device and returns what the last step came to; its first losses are squared error, smooth-L1 and
    /// distortion.
    fn figures(&mut self) -> Result<Figures>;
}
