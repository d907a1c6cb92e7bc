//! What the learned fields share: the trainer, what it asks of a device, parameters, photographs, checkpoints.
//!
//! A model ([`training::Model`]) says what differs between fields; its step is written once, over operations
//! ([`ops::Ops`]) that each device implements with its own kernels.

pub mod background;
#[cfg(any(test, feature = "wgpu"))]
pub(crate) mod ball;
pub mod checkpoint;
#[cfg(feature = "wgpu")]
pub mod devices;
#[cfg(feature = "wgpu")]
pub mod drawing;
#[cfg(feature = "wgpu")]
pub mod memory;
pub mod ops;
pub mod parameters;
pub mod pixels;
#[cfg(feature = "wgpu")]
pub(crate) mod self_test;
pub mod training;

use crate::config::DeviceChoice;
use crate::{Error, Result};
#[cfg(feature = "wgpu")]
use std::sync::{Mutex, OnceLock};

/// Where a field is learned.
// a process has one, or two
#[allow(clippy::large_enum_variant)]
pub enum ComputeDevice {
    /// The processor, with the reason where `auto` found nothing else.
    Cpu(String),
    /// A GPU.
    #[cfg(feature = "wgpu")]
    Gpu(devices::Gpu),
}

impl ComputeDevice {
    /// Returns what it is and why it was chosen, for reports.
    pub fn description(&self) -> String {
        match self {
            ComputeDevice::Cpu(why) if why.is_empty() => "the processor".into(),
            ComputeDevice::Cpu(why) => format!("the processor: {why}"),
            #[cfg(feature = "wgpu")]
            ComputeDevice::Gpu(gpu) => format!("{}: {}", gpu.device.name(), gpu.why),
        }
    }

    /// Takes the processor where a GPU that nobody named cannot do what is asked; where it was named, that is an error.
    pub fn fallback_to_cpu(self, asked: impl FnOnce(&ComputeDevice) -> Result<()>) -> Result<ComputeDevice> {
        match asked(&self) {
            Ok(()) => Ok(self),
            #[cfg(feature = "wgpu")]
            Err(why) if matches!(&self, ComputeDevice::Gpu(gpu) if gpu.auto_selected) => {
                Ok(ComputeDevice::Cpu(why.to_string()))
            }
            Err(why) => Err(why),
        }
    }
}

/// A comparison of a GPU with the processor: one training step of a field.
#[derive(Clone, Copy)]
pub struct SelfTest {
    /// The name of the field.
    pub field: &'static str,
    /// Makes the step on an adapter and on the processor.
    #[cfg(feature = "wgpu")]
    pub run: fn(&crate::kernel::gpu::Adapter) -> Result<Vec<devices::Check>>,
}

/// Returns the device that a word names: see [`DeviceChoice`]. `auto` takes a GPU only where it passes the test of the
/// field that is to be computed there.
///
/// # Errors
///
/// Where this build or this machine does not have it.
pub fn compute_device(name: &str, test: &SelfTest) -> Result<ComputeDevice> {
    let choice = parsed(name)?;
    if choice.name == "auto" {
        #[cfg(feature = "wgpu")]
        return Ok(devices::best(&choice, &[*test]).map_or_else(ComputeDevice::Cpu, ComputeDevice::Gpu));
    }
    let _ = test;
    named(&choice)
}

/// Refuses a device that [`compute_device`] would refuse. Nothing is asked of any GPU where none is named.
///
/// # Errors
///
/// Where this build or this machine does not have it.
pub fn require_device(name: &str) -> Result<()> {
    let choice = parsed(name)?;
    if choice.name == "auto" { Ok(()) } else { named(&choice).map(drop) }
}

fn parsed(name: &str) -> Result<DeviceChoice> {
    let choice = DeviceChoice::parse(name).ok_or_else(|| {
        Error::usage(format!("unknown device `{name}`"), "`tiface config --explain device` says which")
    })?;
    let no_gpu = if cfg!(feature = "wgpu") { "the processor is none" } else { "this build knows none" };
    if choice.memory_gib.is_some() && (choice.name == "cpu" || cfg!(not(feature = "wgpu"))) {
        return Err(Error::usage(
            format!("device `{name}`: `--memory` limits what a training takes of a GPU, and {no_gpu}"),
            "leave `--memory` out, or use a GPU: `--device wgpu`, in a build with `--features wgpu`",
        ));
    }
    Ok(choice)
}

fn named(choice: &DeviceChoice) -> Result<ComputeDevice> {
    match choice.name.as_str() {
        "cpu" => Ok(ComputeDevice::Cpu(String::new())),
        #[cfg(feature = "wgpu")]
        _ => Ok(ComputeDevice::Gpu(devices::open(choice)?)),
        #[cfg(not(feature = "wgpu"))]
        "auto" => Ok(ComputeDevice::Cpu(String::new())),
        #[cfg(not(feature = "wgpu"))]
        other => {
            let problem = format!("device `{other}`: this build learns on the processor alone");
            Err(Error::usage(problem, "build with `--features wgpu`, or leave `--device` out"))
        }
    }
}

/// A field on a GPU, which answers instead of the processor until it fails.
#[cfg(feature = "wgpu")]
pub struct GpuField<T> {
    field: Mutex<Option<T>>,
    failure: OnceLock<String>,
}

#[cfg(feature = "wgpu")]
impl<T> GpuField<T> {
    /// Takes the field; without one there is never an answer.
    pub fn new(field: Option<T>) -> GpuField<T> {
        GpuField { field: Mutex::new(field), failure: OnceLock::new() }
    }

    /// Returns why the processor answers in its place, once it failed.
    pub fn failure(&self) -> Option<&str> {
        self.failure.get().map(String::as_str)
    }

    /// Returns the answer; none where there is no field, or where it failed: then the processor answers.
    pub fn ask<A>(&self, question: impl FnOnce(&mut T) -> Result<A>) -> Option<A> {
        let mut field = self.field.lock().ok()?;
        let answer = question(field.as_mut()?);
        if let Err(e) = &answer {
            let text = self.failure.get_or_init(|| format!("{e}; the processor goes on"));
            tracing::warn!("{text}");
            *field = None;
        }
        answer.ok()
    }
}

#[cfg(all(test, feature = "wgpu"))]
mod tests {
    use super::*;

    #[test]
    fn a_gpu_that_failed_is_asked_no_more_and_says_why() {
        let field = GpuField::new(Some(1));
        assert_eq!((field.ask(|f| Ok(*f)), field.failure()), (Some(1), None));
        assert_eq!(field.ask(|_| Err::<i32, _>(Error::cannot("it is lost", ""))), None);
        assert_eq!(field.ask(|_| -> Result<i32> { panic!("asked again") }), None);
        assert_eq!(field.failure(), Some("it is lost; the processor goes on"));
    }
}
