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
#[cfg(feature = "wgpu")]
pub mod drawing;
pub mod ops;
pub mod parameters;
pub mod pixels;
pub mod training;

use crate::config::DeviceChoice;
use crate::{Error, Result};
use burn::tensor::{Device, Tensor, TensorData};

/// Where a field is learned.
pub enum Place {
    /// The processor, see [`processor`]; with the reason where `auto` found nothing else.
    Cpu(String),
    /// A GPU.
    #[cfg(feature = "wgpu")]
    Gpu(devices::Gpu),
}

impl Place {
    /// Returns what it is and why it was chosen, for reports.
    pub fn told(&self) -> String {
        match self {
            Place::Cpu(why) if why.is_empty() => "the processor".into(),
            Place::Cpu(why) => format!("the processor: {why}"),
            #[cfg(feature = "wgpu")]
            Place::Gpu(gpu) => format!("{}: {}", gpu.device.name(), gpu.why),
        }
    }

    /// Takes the processor where a GPU that nobody named cannot do what is asked; where it was named, that is an error.
    pub fn or_processor(self, asked: impl FnOnce(&Place) -> Result<()>) -> Result<Place> {
        match asked(&self) {
            Ok(()) => Ok(self),
            #[cfg(feature = "wgpu")]
            Err(why) if matches!(&self, Place::Gpu(gpu) if gpu.by_itself) => Ok(Place::Cpu(why.to_string())),
            Err(why) => Err(why),
        }
    }
}

/// Returns the processor as burn's device.
pub fn processor() -> Device {
    Device::flex()
}

/// Returns the place that a word names: see [`DeviceChoice`].
///
/// # Errors
///
/// Where this build or this machine does not have it.
pub fn place(name: &str) -> Result<Place> {
    let choice = DeviceChoice::parse(name).ok_or_else(|| {
        Error::usage(format!("there is no device `{name}`"), "`tiface config --explain device` says which")
    })?;
    match choice.name.as_str() {
        "cpu" => Ok(Place::Cpu(String::new())),
        #[cfg(feature = "wgpu")]
        "auto" => Ok(devices::best(&choice).map_or_else(Place::Cpu, Place::Gpu)),
        #[cfg(not(feature = "wgpu"))]
        "auto" => Ok(Place::Cpu(String::new())),
        #[cfg(feature = "wgpu")]
        _ => Ok(Place::Gpu(devices::open(&choice)?)),
        #[cfg(not(feature = "wgpu"))]
        other => {
            let problem = format!("device `{other}`: this build learns on the processor alone");
            let feature = if other == "cuda" { "cuda" } else { "wgpu" };
            Err(Error::usage(problem, format!("build with `--features {feature}`, or leave `--device` out")))
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
