//! Does a training fit a device's memory?

use super::drawing::resident;
use super::pixels::Pixels;
use crate::kernel::gpu::Device;
use crate::{Error, Result};

/// What a training wants of a device's memory.
pub struct MemoryNeed {
    /// Bytes whatever the step's size, and what they are for.
    pub fixed: (u64, &'static str),
    /// What a step is counted in: `samples` or `rays`.
    pub unit: &'static str,
    /// Bytes of each, and those of the largest buffer alone.
    pub each: [u64; 2],
    /// The most that a step makes use of.
    pub wanted: u64,
    /// The fewest that it needs.
    pub least: u64,
}

impl MemoryNeed {
    /// Returns how many samples or rays the device has room for, up to those that are wanted, and whether the photographs
    /// lie there, too.
    ///
    /// # Errors
    ///
    /// Where there is room for fewer than the least; `remedy` says by their number what to lower.
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
        let most = self.wanted.min(by_buffer).min((left - resident.unwrap_or(0)) / bytes);
        if most < self.least {
            let problem = format!(
                "the device `{}` has room for {most} {} of a step beside {} MiB of {what}, {} are needed",
                device.name(),
                self.unit,
                fixed.div_ceil(1 << 20),
                self.least,
            );
            let hint = format!("lower {}, or give more with `--memory`", remedy(most));
            return Err(Error::cannot(problem, hint));
        }
        Ok((most as usize, resident.is_some()))
    }
}
