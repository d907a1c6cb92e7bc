//! Operations that every field needs from the device it trains on.
//!
//! A model's training step is written once, over traits of operations ([`Ops`] and one for each
//! model); each device implements them with its own kernels. The CPU computes on burn's Flex
//! tensors and completes each step. A GPU computes on burn's CubeCL tensors; the host queues the
//! launches of many steps and reads results back once in [`ArrayDevice::READ_EVERY`] steps.

#[cfg(feature = "wgpu")]
use burn::backend::Cube;
use burn::backend::Flex;
use burn::backend::tensor::FloatTensor;
use burn::tensor::TensorData;
use tiface_base::Result;
use tiface_kernels::cpu::adam::{self, AdamStep};
#[cfg(feature = "wgpu")]
use tiface_kernels::gpu;

/// A device that stores arrays of floats and runs the optimizer on them.
pub trait ArrayDevice {
    /// A flat array of floats.
    type Array;

    /// Condition for an optimizer step: closed if the training step had no sample, or once a
    /// gradient was not finite.
    type Gate<'a>
    where
        Self: 'a;

    /// Steps between two readbacks of losses and flags, which is also the delay in detecting an
    /// error.
    const READ_EVERY: u64;

    /// Copies values to the device.
    fn upload(&self, values: Vec<f32>) -> Self::Array;

    /// Waits for the device and copies values back.
    ///
    /// # Errors
    ///
    /// If the device does not respond.
    fn download(&self, array: &Self::Array) -> Result<Vec<f32>>;

    /// Makes an AdamW step of values, first and second moments in place and zeroes the gradient, if
    /// the gate is open.
    fn adam(
        &self,
        state: [&mut Self::Array; 3],
        gradient: &mut Self::Array,
        step: &AdamStep,
        gate: Self::Gate<'_>,
    );
}

/// The operations of a model on a device.
pub trait Ops: Sized {
    /// The device that the operations run on.
    type Device: ArrayDevice;

    /// Returns the device.
    fn device(&self) -> &Self::Device;

    /// Returns the gate of the last step's gradients.
    fn gate(&self) -> <Self::Device as ArrayDevice>::Gate<'_>;
}

/// The CPU.
pub struct Cpu;

/// An array in host memory.
pub type CpuArray = FloatTensor<Flex>;

/// Returns the values of an array.
pub fn slice(array: &CpuArray) -> &[f32] {
    array.as_slice::<f32>().expect("arrays of this crate are contiguous f32")
}

/// Returns the values of an array for writing; no other handle may refer to the array.
pub fn slice_mut(array: &mut CpuArray) -> &mut [f32] {
    array.storage_mut::<f32>()
}

impl ArrayDevice for Cpu {
    type Array = CpuArray;
    type Gate<'a> = bool;
    const READ_EVERY: u64 = 1;

    fn upload(&self, values: Vec<f32>) -> CpuArray {
        let shape = [values.len()];
        CpuArray::from_data(TensorData::new(values, shape))
    }

    fn download(&self, array: &CpuArray) -> Result<Vec<f32>> {
        Ok(slice(array).to_vec())
    }

    fn adam(&self, state: [&mut CpuArray; 3], gradient: &mut CpuArray, step: &AdamStep, gate: bool) {
        if gate {
            let [p, m, v] = state.map(slice_mut);
            adam::adam(p, m, v, slice_mut(gradient), step);
        }
    }
}

#[cfg(feature = "wgpu")]
impl ArrayDevice for gpu::Device {
    type Array = FloatTensor<Cube>;
    type Gate<'a> = gpu::Gate<'a>;
    const READ_EVERY: u64 = 50;

    fn upload(&self, values: Vec<f32>) -> FloatTensor<Cube> {
        self.upload_vec(values)
    }

    fn download(&self, array: &FloatTensor<Cube>) -> Result<Vec<f32>> {
        self.fetch(array)
    }

    fn adam(
        &self,
        state: [&mut FloatTensor<Cube>; 3],
        gradient: &mut FloatTensor<Cube>,
        step: &AdamStep,
        gate: gpu::Gate,
    ) {
        gpu::adam(self, state.map(|array| &*array), gradient, step, gate);
    }
}
