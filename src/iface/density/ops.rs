//! The operations of a training step of the density, in the order of the step.

use crate::Result;
use crate::field::ops::Ops;
use crate::field::parameters::ParameterGroup;
use crate::field::training::StepAt;
use crate::iface::occupancy::Occupancy;
use crate::kernel::cpu::schedule::Figures;

/// Opacity of a march step above which a cell is marched through.
pub const OCCUPIED: f32 = 0.01;

/// Hash table and networks.
pub type DensityGroups<O> = [ParameterGroup<<O as Ops>::Device>; 2];

/// The operations of a training step on one device. Intermediate results of a step stay on the device, in the value that
/// implements this trait.
pub trait DensityOps: Ops {
    /// Starts or resumes a training with the given cells to march through and number of rays of the next step.
    fn load(&mut self, occupancy: &Occupancy, rays: usize);

    /// Waits for the device, reads the cells to march through, and returns the number of rays of the next step.
    fn read(&self, occupancy: &mut Occupancy) -> Result<usize>;

    /// Waits for the device and returns whether any gradient was not finite since the state was loaded.
    fn is_broken(&self) -> Result<bool>;

    /// Evaluates the field to update the cells that are marched through.
    fn update_occupancy(&mut self, groups: &DensityGroups<Self>, at: StepAt);

    /// Draws rays; their number follows from the samples of the last step.
    fn draw(&mut self, at: StepAt);

    /// Marches the rays up to where the transmittance has vanished.
    fn march(&mut self, groups: &DensityGroups<Self>);

    /// Evaluates the field at the samples.
    fn density_field(&mut self, groups: &DensityGroups<Self>);

    /// Composites the samples of each ray, and computes losses and their gradients with respect to the field's output.
    fn losses(&mut self);

    /// Computes the gradients of the parameters, and closes the [gate](Ops::gate) if one is not finite.
    fn backward(&mut self, groups: &mut DensityGroups<Self>);

    /// Waits for the device and returns the figures of the last step, whose first losses are squared error, smooth-L1
    /// and distortion.
    fn figures(&mut self) -> Result<Figures>;
}
