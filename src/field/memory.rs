//! Planning of a training's memory on a device.

use super::drawing::resident;
use super::pixels::Pixels;
use crate::kernel::gpu::Device;
use crate::{Error, Result};

/// Memory that a training needs on a device.
pub struct MemoryNeed {
    /// Bytes that do not depend on the step's size, and their purpose for messages.
    pub fixed: (u64, &'static str),
    /// Unit of a step's size: `samples` or `rays`.
    pub unit: &'static str,
    /// Bytes per unit in all buffers together, and in the largest buffer.
    pub each: [u64; 2],
    /// Largest number of units that a step uses.
    pub wanted: u64,
    /// Smallest number of units that a step can run with.
    pub least: u64,
}

impl MemoryNeed {
    /// Returns how many samples or rays fit on the device, up to the wanted number, and whether the photographs fit as
    /// well.
    ///
    /// # Errors
    ///
    /// If fewer than the minimum fit; `remedy` receives how many fit and returns the setting to lower.
    pub fn plan(
        &self,
        pixels: &Pixels,
        device: &Device,
        remedy: impl FnOnce(u64) -> String,
    ) -> Result<(usize, bool)> {
        let [bytes, widest] = self.each;
        let (fixed, what) = self.fixed;
        let left = device.available_memory().saturating_sub(fixed);
        let resident = resident(pixels, device, left.saturating_sub(self.wanted.saturating_mul(bytes)));
        let by_buffer = device.limits().largest_buffer / widest;
        let fits = self.wanted.min(by_buffer).min((left - resident.unwrap_or(0)) / bytes);
        if fits < self.least {
            let problem = format!(
                "the device `{}` has room for {fits} {} of a step beside {} MiB of {what}, {} are needed",
                device.name(),
                self.unit,
                fixed.div_ceil(1 << 20),
                self.least,
            );
            let hint = format!("lower {}, or give more with `--memory`", remedy(fits));
            return Err(Error::cannot(problem, hint));
        }
        Ok((fits as usize, resident.is_some()))
    }
}
