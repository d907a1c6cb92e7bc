//! What the learned fields share: kernels as burn operations, and the device they run on.
//!
//! A model calls the free functions of [`ops`]; `backend_extension` routes them to the kernels of the
//! tensor's device, and [`autodiff`] gives each one backward for every device. A new device
//! implements [`ops::FieldKernels`] and nothing else changes.

pub mod autodiff;
#[cfg(test)]
pub(crate) mod ball;
pub mod checkpoint;
mod dark_stage;
pub mod ops;
pub mod optimizer;
pub mod pixels;

use burn::tensor::{Device, Tensor, TensorData};

/// Why a device cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DeviceError {
    /// Not a name this build knows.
    #[error("device `{0}` is not known here; this build trains on: cpu")]
    Unknown(String),
    /// Known, but without training kernels.
    #[error("device `{0}` has no training kernels yet; this build trains on: cpu")]
    NoKernels(String),
}

/// The device of a name: `auto` or `cpu`.
pub fn device(name: &str) -> Result<Device, DeviceError> {
    match name {
        "auto" | "cpu" => Ok(Device::flex()),
        other if other.starts_with("wgpu") || other.starts_with("cuda") => {
            Err(DeviceError::NoKernels(other.to_owned()))
        }
        other => Err(DeviceError::Unknown(other.to_owned())),
    }
}

/// A tensor of these values; takes the vector without copying.
pub fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// The values of a tensor, on the host.
pub fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_into_vec::<f32>().expect("float tensors of this crate are f32")
}
