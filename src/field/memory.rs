//! Memory that a training needs on a device.

use super::pixels::RaySampler;
use tiface_base::{Error, Result};
use tiface_kernels::gpu::{BUFFERS, Device};

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
    pub minimum: u64,
}

impl MemoryNeed {
    /// Returns how many samples or rays fit on the device, up to the wanted number, and whether the
    /// photographs fit as well.
    ///
    /// # Errors
    ///
    /// If fewer than the minimum fit; `remedy` receives how many fit and returns the setting to
    /// lower.
    pub fn plan(
        &self,
        sampler: &RaySampler,
        device: &Device,
        remedy: impl FnOnce(u64) -> String,
    ) -> Result<(usize, bool)> {
        let [bytes, widest] = self.each;
        let (fixed, what) = self.fixed;
        let left = device.available_memory().saturating_sub(fixed);
        let resident = resident(sampler, device, left.saturating_sub(self.wanted.saturating_mul(bytes)));
        let by_buffer = device.limits().largest_buffer / widest;
        let fits = self.wanted.min(by_buffer).min((left - resident.unwrap_or(0)) / bytes);
        if fits < self.minimum {
            let problem = format!(
                "the device `{}` has memory for {fits} {} of a step beside {} MiB of {what}, {} are needed",
                device.name(),
                self.unit,
                fixed.div_ceil(1 << 20),
                self.minimum,
            );
            let hint = format!("lower {}, or give more with `--memory`", remedy(fits));
            return Err(Error::cannot(problem, hint));
        }
        Ok((fits as usize, resident.is_some()))
    }
}

/// Returns the bytes that the photographs take on a device, or `None` if they do not fit in
/// `available` bytes.
pub fn resident(sampler: &RaySampler, device: &Device, available: u64) -> Option<u64> {
    let buffers = sampler.buffers_on_device(device.limits().largest_buffer);
    // A pixel takes four bytes for its color, one bit for whether it is drawable, and its share of
    // the bits' counts.
    let bytes = buffers.iter().sum::<u64>() * 17 / 4;
    let fits = buffers.len() <= BUFFERS && bytes <= available;
    (fits && sampler.count() <= u32::MAX as u64).then_some(bytes)
}
