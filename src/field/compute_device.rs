//! The device that a field is trained on: a named one, or the one that `auto` selects.

use super::device_report::{DeviceReport, NO_GPU, SelfTest};
#[cfg(feature = "wgpu")]
use super::devices;
use crate::config::DeviceChoice;
use tiface_base::{Error, Result};

/// The device that a field is trained on.
// A process holds one or two of these, so boxing the larger variant would save nothing.
#[allow(clippy::large_enum_variant)]
pub enum ComputeDevice {
    /// The CPU, with the reason if `auto` found no usable GPU.
    Cpu(String),
    /// A GPU.
    #[cfg(feature = "wgpu")]
    Gpu(devices::Gpu),
}

impl ComputeDevice {
    /// Returns the device's name and the reason for choosing it, for reports.
    pub fn description(&self) -> String {
        match self {
            ComputeDevice::Cpu(why) if why.is_empty() => "the CPU".into(),
            ComputeDevice::Cpu(why) => format!("the CPU: {why}"),
            #[cfg(feature = "wgpu")]
            ComputeDevice::Gpu(gpu) => format!("{}: {}", gpu.device.name(), gpu.why),
        }
    }

    /// Returns what to tell the user if `auto` found a GPU and does not use it.
    pub fn warning(&self) -> Option<String> {
        match self {
            ComputeDevice::Cpu(why) if !why.is_empty() && why != NO_GPU => {
                Some(format!("trained on the CPU: {why}; `tiface doctor` tests the GPUs"))
            }
            _ => None,
        }
    }

    /// Falls back to the CPU if `check` refuses a GPU that `auto` selected.
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

/// Returns the report on every GPU of this machine, software renderers included, and the device
/// that `--device auto` selects for all fields. The self-tests run again, regardless of earlier
/// verdicts.
pub fn examine_devices(tests: &[SelfTest]) -> Result<(Vec<DeviceReport>, ComputeDevice)> {
    #[cfg(feature = "wgpu")]
    let found = devices::examine_adapters(tests);
    #[cfg(not(feature = "wgpu"))]
    let found = Vec::new();
    Ok((found, select(&parse_choice("auto")?, tests)))
}

/// Returns the GPU that `auto` selects, or else the CPU, with the reason.
fn select(choice: &DeviceChoice, tests: &[SelfTest]) -> ComputeDevice {
    #[cfg(feature = "wgpu")]
    return devices::best(choice, tests).map_or_else(ComputeDevice::Cpu, ComputeDevice::Gpu);
    #[cfg(not(feature = "wgpu"))]
    {
        let _ = (choice, tests);
        ComputeDevice::Cpu(String::new())
    }
}

/// Opens the device named `name`; see [`DeviceChoice`] for the syntax. `auto` selects a GPU only if
/// it passes `test`, the self-test of the field to be computed.
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
    let no_gpu = if cfg!(feature = "wgpu") { "the CPU is none" } else { "this build supports none" };
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
            let problem = format!("device `{other}`: this build learns on the CPU alone");
            Err(Error::usage(problem, "build with `--features wgpu`, or leave `--device` out"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gpu_that_auto_refused_is_a_warning_and_a_machine_without_one_is_not() {
        let warning = |why: &str| ComputeDevice::Cpu(why.into()).warning();
        let said = warning("Big GPU failed the self-test").unwrap();
        assert!(said.contains("Big GPU failed") && said.contains("`tiface doctor`"), "{said}");
        assert_eq!((warning(""), warning(NO_GPU)), (None, None));
    }
}
