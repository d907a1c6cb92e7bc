//! Code that all learned fields share: the trainer, its device operations, parameters, photographs and checkpoints.
//!
//! A model ([`training::Model`]) defines what differs between fields. Its training step is written once, over
//! operations ([`ops::Ops`]) that each device implements with its own kernels.

#[cfg(any(test, feature = "wgpu"))]
pub(crate) mod ball;
pub mod checkpoint;
#[cfg(feature = "wgpu")]
pub mod devices;
#[cfg(feature = "wgpu")]
pub mod drawing;
#[cfg(all(test, feature = "wgpu"))]
pub(crate) mod gpu_tests;
pub mod ops;
pub mod parameters;
pub mod pixels;
#[cfg(feature = "wgpu")]
pub(crate) mod self_test;
pub mod training;

use crate::config::DeviceChoice;
use crate::{Error, Result};
use serde::Serialize;
use std::sync::{Mutex, OnceLock};

/// The reason for the processor on a machine without GPUs.
const NO_GPU: &str = "no GPU is here";

/// The device that a field is trained on.
// A process holds one or two of these, so boxing the larger variant would save nothing.
#[allow(clippy::large_enum_variant)]
pub enum ComputeDevice {
    /// The processor, with the reason if `auto` found no usable GPU.
    Cpu(String),
    /// A GPU.
    #[cfg(feature = "wgpu")]
    Gpu(devices::Gpu),
}

impl ComputeDevice {
    /// Returns the device's name and the reason for choosing it, for reports.
    pub fn description(&self) -> String {
        match self {
            ComputeDevice::Cpu(why) if why.is_empty() => "the processor".into(),
            ComputeDevice::Cpu(why) => format!("the processor: {why}"),
            #[cfg(feature = "wgpu")]
            ComputeDevice::Gpu(gpu) => format!("{}: {}", gpu.device.name(), gpu.why),
        }
    }

    /// Returns what to tell the user if `auto` found a GPU and does not use it.
    pub fn warning(&self) -> Option<String> {
        match self {
            ComputeDevice::Cpu(why) if !why.is_empty() && why != NO_GPU => {
                Some(format!("trained on the processor: {why}; `tiface doctor` tests the GPUs"))
            }
            _ => None,
        }
    }

    /// Falls back to the processor if `check` refuses a GPU that `auto` selected.
    ///
    /// # Errors
    ///
    /// The error of `check`, if the user named the device.
    pub fn fallback_to_cpu(self, check: impl FnOnce(&ComputeDevice) -> Result<()>) -> Result<ComputeDevice> {
        match check(&self) {
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
    /// Runs the step on an adapter and on the processor, and compares the results.
    #[cfg(feature = "wgpu")]
    pub run: fn(&crate::kernel::gpu::Adapter) -> Result<Vec<Check>>,
}

/// One quantity of a training step, and its deviation from the processor's value.
#[derive(Debug, Serialize)]
pub struct Check {
    /// Field and quantity.
    pub name: String,
    /// Relative error; NaN if the device did not compute the quantity.
    pub error: f32,
    /// Largest error that passes.
    pub allowed: f32,
    /// Whether the error is within the limit.
    pub passed: bool,
}

impl Check {
    /// Compares an error with its limit.
    pub fn new(name: String, error: f32, allowed: f32) -> Check {
        Check { name, error, allowed, passed: error <= allowed }
    }
}

/// The report of `tiface doctor` on a device.
#[derive(Debug, Serialize)]
pub struct Found {
    /// Name for `--device`.
    pub name: String,
    /// Name that the driver reports.
    pub adapter: String,
    /// `discrete`, `integrated`, `virtual`, `other` or `software`.
    pub kind: &'static str,
    /// The driver and its version.
    pub driver: String,
    /// PCI address, if the device is a card.
    pub card: Option<String>,
    /// Atomic addition of floats: `native` or `exchange`; `None` if the device cannot be opened.
    pub atomics: Option<&'static str>,
    /// Bytes of memory; `None` if the driver does not report it.
    pub memory: Option<u64>,
    /// Bytes of the largest buffer; `None` if the device cannot be opened.
    pub largest_buffer: Option<u64>,
    /// Bytes of shared memory of a workgroup; `None` if the device cannot be opened.
    pub shared: Option<usize>,
    /// Whether another training uses the device.
    pub in_use: bool,
    /// Comparisons of training steps with the processor's.
    pub checks: Vec<Check>,
    /// The error that prevented the comparison, if any.
    pub error: Option<String>,
    /// Seconds that opening and the self-test took, including the driver's compilation of kernels.
    pub seconds: f64,
}

/// Returns the report on every GPU of this machine, software renderers included, and the device that `--device auto`
/// selects for all fields. The self-tests run again, regardless of earlier verdicts.
pub fn examine_devices(tests: &[SelfTest]) -> Result<(Vec<Found>, ComputeDevice)> {
    #[cfg(feature = "wgpu")]
    let found = devices::examine_adapters(tests);
    #[cfg(not(feature = "wgpu"))]
    let found = Vec::new();
    Ok((found, select(&parse_choice("auto")?, tests)))
}

/// Returns the GPU that `auto` selects, or else the processor, with the reason.
fn select(choice: &DeviceChoice, tests: &[SelfTest]) -> ComputeDevice {
    #[cfg(feature = "wgpu")]
    return devices::best(choice, tests).map_or_else(ComputeDevice::Cpu, ComputeDevice::Gpu);
    #[cfg(not(feature = "wgpu"))]
    {
        let _ = (choice, tests);
        ComputeDevice::Cpu(String::new())
    }
}

/// Opens the device named `name`; see [`DeviceChoice`] for the syntax. `auto` selects a GPU only if it passes `test`, the
/// self-test of the field to be computed.
///
/// # Errors
///
/// If this build or this machine has no such device.
pub fn compute_device(name: &str, test: &SelfTest) -> Result<ComputeDevice> {
    let choice = parse_choice(name)?;
    if choice.name == "auto" { Ok(select(&choice, &[*test])) } else { open_named(&choice) }
}

/// Refuses a device that [`compute_device`] would refuse. Returns it if it is named; for `auto`, no
/// GPU is opened.
///
/// # Errors
///
/// If this build or this machine has no such device.
pub fn require_device(name: &str) -> Result<Option<ComputeDevice>> {
    let choice = parse_choice(name)?;
    if choice.name == "auto" { Ok(None) } else { open_named(&choice).map(Some) }
}

fn parse_choice(name: &str) -> Result<DeviceChoice> {
    let choice = DeviceChoice::parse(name).ok_or_else(|| {
        Error::usage(format!("unknown device `{name}`"), "`tiface config --explain device` says which")
    })?;
    let no_gpu = if cfg!(feature = "wgpu") { "the processor is none" } else { "this build supports none" };
    if choice.memory_gib.is_some() && (choice.name == "cpu" || cfg!(not(feature = "wgpu"))) {
        return Err(Error::usage(
            format!("device `{name}`: `--memory` limits what a training takes of a GPU, and {no_gpu}"),
            "leave `--memory` out, or use a GPU: `--device wgpu`, in a build with `--features wgpu`",
        ));
    }
    Ok(choice)
}

fn open_named(choice: &DeviceChoice) -> Result<ComputeDevice> {
    match choice.name.as_str() {
        "cpu" => Ok(ComputeDevice::Cpu(String::new())),
        #[cfg(feature = "wgpu")]
        _ => Ok(ComputeDevice::Gpu(devices::open(choice)?)),
        #[cfg(not(feature = "wgpu"))]
        other => {
            let problem = format!("device `{other}`: this build learns on the processor alone");
            Err(Error::usage(problem, "build with `--features wgpu`, or leave `--device` out"))
        }
    }
}

/// What to do about a GPU that failed.
const GPU_HINT: &str = "`tiface doctor` tests the GPU, `--device cpu` leaves it out";

/// A field on a GPU, which is evaluated in place of the processor's until the GPU fails.
pub struct GpuField<T> {
    field: Mutex<Option<T>>,
    failure: OnceLock<String>,
}

impl<T> GpuField<T> {
    /// Wraps a field; with `None`, [`ask`](GpuField::ask) always returns `None`.
    pub fn new(field: Option<T>) -> GpuField<T> {
        GpuField { field: Mutex::new(field), failure: OnceLock::new() }
    }

    /// Returns why the GPU is no longer used, once it has failed.
    pub fn failure(&self) -> Option<&str> {
        self.failure.get().map(String::as_str)
    }

    /// Evaluates the field on the GPU. Returns `None` without a field or if the GPU failed, so that the caller
    /// evaluates it on the processor.
    pub fn ask<A>(&self, evaluate: impl FnOnce(&mut T) -> Result<A>) -> Option<A> {
        let mut field = self.field.lock().ok()?;
        let result = evaluate(field.as_mut()?);
        if let Err(e) = &result {
            let text = self.failure.get_or_init(|| format!("{e}; the processor goes on. {GPU_HINT}"));
            tracing::warn!("{text}");
            *field = None;
        }
        result.ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gpu_that_failed_is_asked_no_more_and_says_why() {
        let field = GpuField::new(Some(1));
        assert_eq!((field.ask(|f| Ok(*f)), field.failure()), (Some(1), None));
        assert_eq!(field.ask(|_| Err::<i32, _>(Error::cannot("it is lost", ""))), None);
        assert_eq!(field.ask(|_| -> Result<i32> { panic!("asked again") }), None);
        let said = field.failure().unwrap();
        assert!(said.starts_with("it is lost; the processor goes on. `tiface doctor`"), "{said}");
    }

    #[test]
    fn a_gpu_that_auto_refused_is_a_warning_and_a_machine_without_one_is_not() {
        let warning = |why: &str| ComputeDevice::Cpu(why.into()).warning();
        let said = warning("Big GPU failed the self-test").unwrap();
        assert!(said.contains("Big GPU failed") && said.contains("`tiface doctor`"), "{said}");
        assert_eq!((warning(""), warning(NO_GPU)), (None, None));
    }
}
