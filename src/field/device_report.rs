//! The report of `tiface doctor` on a device: its properties, and a training step compared with the
//! CPU's.

use serde::Serialize;

/// The reason for the CPU on a machine without GPUs.
pub(super) const NO_GPU: &str = "no GPU is here";

/// A comparison of a GPU with the CPU: one training step of a field.
#[derive(Clone, Copy)]
pub struct SelfTest {
    /// The name of the field.
    pub field: &'static str,
    /// Runs the step on an adapter and on the CPU, and compares the results.
    #[cfg(feature = "wgpu")]
    pub run: fn(&tiface_kernels::gpu::Adapter) -> tiface_base::Result<Vec<Check>>,
}

/// One quantity of a training step, and its deviation from the CPU's value.
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
pub struct DeviceReport {
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
    /// Comparisons of training steps with the CPU's.
    pub checks: Vec<Check>,
    /// The error that prevented the comparison, if any.
    pub error: Option<String>,
    /// Seconds that opening and the self-test took, including the driver's compilation of kernels.
    pub seconds: f64,
}
