//! What the learned fields share: kernels as burn operations, the device they run on, the training loop, the
//! checkpoint.
//!
//! A model calls the free functions of [`ops`]; `backend_extension` routes them to the kernels of the
//! tensor's device, and [`autodiff`] gives each one backward for every device. A new device
//! implements [`ops::FieldKernels`] and nothing else changes.

pub mod autodiff;
mod background;
pub mod checkpoint;
pub mod ops;
pub mod parameters;
pub mod pixels;
pub mod training;

use crate::{Error, Result};
use burn::tensor::{Device, Tensor, TensorData};

/// Returns the device of a name: `auto` or `cpu`.
pub fn device(name: &str) -> Result<Device> {
    match name {
        "auto" | "cpu" => Ok(Device::flex()),
        other if other.starts_with("wgpu") || other.starts_with("cuda") => {
            Err(unusable(other, "has no training kernels yet"))
        }
        other => Err(unusable(other, "is not known here")),
    }
}

fn unusable(name: &str, why: &str) -> Error {
    let problem = format!("device `{name}` {why}; this build trains on: cpu");
    Error::usage(problem, "choose another with `--device`")
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
