//! What the learned fields share: kernels as burn operations, the device they run on, the training loop, the
//! checkpoint.
//!
//! A model calls the free functions of [`ops`]; `backend_extension` routes them to the kernels of the
//! tensor's device, and [`autodiff`] gives each one backward for every device. A new device
//! implements [`ops::FieldKernels`] and nothing else changes.

pub mod autodiff;
mod background;
pub mod checkpoint;
#[cfg(feature = "wgpu")]
pub mod devices;
pub mod ops;
pub mod parameters;
pub mod pixels;
pub mod training;

#[cfg(not(feature = "wgpu"))]
use crate::Error;
use crate::Result;
use burn::tensor::{Device, Tensor, TensorData};

/// Where a field is learned.
pub enum Place {
    /// The processor: see [`processor`].
    Cpu,
    /// A GPU.
    #[cfg(feature = "wgpu")]
    Gpu(devices::Gpu),
}

/// Returns the processor as burn's device.
pub fn processor() -> Device {
    Device::flex()
}

/// Returns the place of a device's name: `auto`, `cpu`, `wgpu`, `vulkan`, `metal` or `dx12`, the GPUs with a number
/// after a colon where there are several.
///
/// # Errors
///
/// Where this build or this machine does not have it.
pub fn place(name: &str) -> Result<Place> {
    match name {
        "cpu" => Ok(Place::Cpu),
        #[cfg(feature = "wgpu")]
        "auto" => Ok(devices::best().map_or(Place::Cpu, Place::Gpu)),
        #[cfg(not(feature = "wgpu"))]
        "auto" => Ok(Place::Cpu),
        #[cfg(feature = "wgpu")]
        other => Ok(Place::Gpu(devices::open(other)?)),
        #[cfg(not(feature = "wgpu"))]
        other => {
            let problem = format!("device `{other}`: this build learns on the processor alone");
            Err(Error::usage(problem, "build with `--features wgpu`, or leave `--device` out"))
        }
    }
}

/// Returns a tensor of these values; takes the vector without copying.
pub fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// Returns the values of a tensor, on the host.
pub fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_into_vec::<f32>().expect("float tensors of this crate are f32")
}

#[cfg(test)]
#[path = "ball_tests.rs"]
pub(crate) mod ball;
