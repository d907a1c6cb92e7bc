//! What every field asks of the device that trains it.
//!
//! A model's training step is written once, over a trait of operations ([`Ops`] and one for each model); a device
//! implements it with kernels of its own. The processor computes on burn's Flex tensors, each step to its end; a GPU, on
//! burn's tensors of CubeCL, is given the launches of many steps and is read once in [`ArrayDevice::READ_EVERY`].

use crate::Result;
use crate::kernel::cpu::adam::{self, AdamStep};
#[cfg(feature = "wgpu")]
use crate::kernel::gpu;
#[cfg(feature = "wgpu")]
use burn::backend::Cube;
use burn::backend::Flex;
use burn::backend::tensor::FloatTensor;
use burn::tensor::TensorData;

/// A device with arrays of floats, and the optimizer.
pub trait ArrayDevice {
    /// A flat array of floats.
    type Array;

    /// Whether there is anything to step along: not where a training step met no sample, nor once a gradient was not
    /// finite.
    type Gate<'a>
    where
        Self: 'a;

    /// Steps between two reads of losses and flags: what goes wrong is known that much later.
    const READ_EVERY: u64;

    /// Copies values to the device.
    fn upload(&self, values: Vec<f32>) -> Self::Array;

    /// Waits for the device and copies values back.
    ///
    /// # Errors
    ///
    /// Where the device does not answer.
    fn download(&self, array: &Self::Array) -> Result<Vec<f32>>;

    /// Makes an AdamW step of values, first and second moments in place and leaves the gradient zero, where the gate is
    /// open.
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
    /// The device.
    type Device: ArrayDevice;

    /// The device.
    fn device(&self) -> &Self::Device;

    /// The gate of the last step's gradients.
    fn gate(&self) -> <Self::Device as ArrayDevice>::Gate<'_>;
}

/// The processor.
pub struct Cpu;

/// An array of the processor.
pub type CpuArray = FloatTensor<Flex>;

/// Returns the values of an array.
pub fn slice(array: &CpuArray) -> &[f32] {
    array.as_slice::<f32>().expect("arrays of this crate are contiguous f32")
}

/// Returns the values of an array that nothing else refers to, to be written.
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
