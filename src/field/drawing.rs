//! Rays of training steps on a device, wherever the photographs lie.
//!
//! Where these fit they lie on the device and kernels draw from them. Where they do not, the processor draws the same
//! rays from its own memory while the device is busy with the step before, and sends what their pixels show: some half
//! a megabyte a step.

use super::pixels::Pixels;
use crate::kernel::cpu::rng;
use crate::kernel::gpu::{Batch, Buffer, Device, Photographs, SamplingOptions};

/// Where rays of a training on a device come from.
pub struct DeviceRays {
    /// None where the processor draws.
    resident: Option<Photographs>,
    drawing: SamplingOptions,
}

/// Bytes of photographs that fit in `room` bytes of a device; none where they do not, or where the device knows no such
/// order of pixels.
pub fn resident(pixels: &Pixels, device: &Device, room: u64) -> Option<u64> {
    let bytes = pixels.bytes_on_device();
    let fits = bytes <= device.limits().largest_buffer && bytes * 33 / 32 <= room;
    (fits && pixels.count() <= u32::MAX as u64 && !pixels.is_ordered()).then_some(bytes * 33 / 32)
}

impl DeviceRays {
    /// From photographs that lie on the device where that is said.
    pub fn new(pixels: &Pixels, device: &Device, drawing: SamplingOptions, resident: bool) -> DeviceRays {
        DeviceRays { resident: resident.then(|| pixels.on_device(device, drawing)), drawing }
    }

    /// Draws the rays of a step into `batch`: a function of seed and step alone. See [`Pixels::draw`].
    ///
    /// # Shapes
    ///
    /// - wanted: `[1]`, how many rays; those of `batch` behind them are none
    pub fn draw(
        &self,
        device: &Device,
        pixels: &Pixels,
        (seed, step): (u64, u64),
        wanted: &Buffer,
        batch: &mut Batch,
        detail: f32,
    ) {
        if let Some(photographs) = &self.resident {
            return photographs.draw(device, (seed, step), wanted, batch, detail);
        }
        let rays = batch.rays();
        let drawn = pixels.draw_each(seed, step, rays, self.drawing.jitter, detail);
        let mut planes =
            [vec![0f32; 3 * rays], vec![0f32; 3 * rays], vec![0f32; 3 * rays], vec![0f32; 3 * rays]];
        let (mut jitter, mut alpha, mut alive) = (vec![0f32; rays], vec![0f32; rays], vec![0u32; rays]);
        for (r, ray) in drawn.into_iter().enumerate() {
            for c in 0..3 {
                let i = (3 * r + c) as u64;
                if self.drawing.background {
                    planes[3][c * rays + r] = rng::uniform(seed, step << 4 | self.drawing.behind, i);
                }
                if let Some((ray, color, _)) = &ray {
                    planes[0][c * rays + r] = ray.origin[c];
                    planes[1][c * rays + r] = ray.direction[c];
                    planes[2][c * rays + r] = color[c];
                }
            }
            if let Some((ray, _, a)) = ray {
                (jitter[r], alpha[r], alive[r]) = (ray.jitter, a, 1);
            }
        }
        let [origin, direction, color, background] = planes.map(|values| device.upload(&values));
        let [jitter, alpha] = [jitter, alpha].map(|values| device.upload(&values));
        *batch = Batch { origin, direction, jitter, color, alpha, background, alive: device.upload(&alive) };
        batch.keep(device, wanted);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::iface::Foreground;
    use crate::field::ball;
    use crate::kernel::gpu::tests::{agree, device};

    #[test]
    fn photographs_that_stay_in_host_memory_give_the_same_rays() {
        let Some(device) = device() else { return };
        let views = ball::textured_views();
        let pixels = Pixels::new(&views, 0.25, 1.0, Foreground::Estimated, false).with_large(1.0);
        let drawing = SamplingOptions { every: false, jitter: true, background: true, behind: 8 };
        assert!(resident(&pixels, &device, 0).is_none() && resident(&pixels, &device, 1 << 30).is_some());
        let wanted = device.upload(&[900u32]);
        for detail in [0.0, 0.2] {
            let [there, here] = [true, false].map(|resident| {
                let mut batch = Batch::new(&device, 1000);
                let rays = DeviceRays::new(&pixels, &device, drawing, resident);
                rays.draw(&device, &pixels, (5, 7), &wanted, &mut batch, detail);
                batch
            });
            assert_eq!(device.read::<u32>(&there.alive), device.read::<u32>(&here.alive));
            let planes =
                |b: &Batch| [&b.origin, &b.direction, &b.color, &b.background].map(|p| device.read(p));
            for (got, want) in planes(&here).iter().zip(&planes(&there)) {
                let alive = |all: &Vec<f32>| -> Vec<f32> { (0..900).map(|r| all[r]).collect() };
                agree("rays drawn by the host", &alive(got), &alive(want), 1e-5);
            }
            for (got, want) in [(&here.alpha, &there.alpha), (&here.jitter, &there.jitter)] {
                assert_eq!(device.read::<f32>(got)[..900], device.read::<f32>(want)[..900]);
            }
        }
    }
}
