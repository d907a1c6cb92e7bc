//! Sampling of training rays for a device, from photographs in device or host memory.
//!
//! Photographs that fit are copied to the device, and kernels sample them. Otherwise the CPU
//! samples the same rays from host memory while the device computes the previous step, and uploads
//! rays and colors: about half a megabyte per step.

use super::pixels::{RaySampler, ray_backgrounds};
use super::training::StepAt;
use tiface_kernels::gpu::{Buffer, Device, DeviceBatch, Photographs, SamplingOptions, planes};

/// Source of the rays of a training on a device.
pub struct DeviceSampler {
    /// Photographs in device memory; `None` if the CPU samples the rays.
    resident: Option<Photographs>,
    drawing: SamplingOptions,
}

impl DeviceSampler {
    /// Creates the source, and copies the photographs to the device if they are to be `resident`.
    pub fn new(
        sampler: &RaySampler,
        device: &Device,
        drawing: SamplingOptions,
        resident: bool,
    ) -> DeviceSampler {
        let largest = device.limits().largest_buffer;
        DeviceSampler { resident: resident.then(|| sampler.on_device(device, drawing, largest)), drawing }
    }

    /// Draws the rays of a step into `batch`. They depend on seed and step alone; see
    /// [`RaySampler::draw`].
    ///
    /// # Shapes
    ///
    /// - wanted: `[1]`, number of rays to draw; the remaining rays of `batch` are marked inactive
    pub fn draw(
        &self,
        device: &Device,
        sampler: &RaySampler,
        (seed, step): (u64, u64),
        wanted: &Buffer,
        batch: &mut DeviceBatch,
        detail: f32,
    ) {
        if let Some(photographs) = &self.resident {
            return photographs.draw(device, (seed, step), wanted, batch, detail);
        }
        let rays = batch.rays();
        let drawn = sampler.draw(seed, step, rays, self.drawing.jitter, detail);
        let stream = self.drawing.background.then_some(self.drawing.background_stream);
        let background = ray_backgrounds(StepAt { seed, step }, stream, rays);
        // the values of drawn rays at their numbers, and zeros where a pixel has no ray
        let triples = |of: &dyn Fn(usize) -> [f32; 3]| -> Buffer {
            let mut rows = vec![[0.0; 3]; rays];
            drawn.number.iter().enumerate().for_each(|(k, &r)| rows[r as usize] = of(k));
            device.upload(&planes(&rows, rays))
        };
        let floats = |of: &dyn Fn(usize) -> f32| -> Buffer {
            let mut values = vec![0.0; rays];
            drawn.number.iter().enumerate().for_each(|(k, &r)| values[r as usize] = of(k));
            device.upload(&values)
        };
        let mut alive = vec![0u32; rays];
        drawn.number.iter().for_each(|&r| alive[r as usize] = 1);
        *batch = DeviceBatch {
            origin: triples(&|k| drawn.rays[k].origin.to_array()),
            direction: triples(&|k| drawn.rays[k].direction.to_array()),
            jitter: floats(&|k| drawn.jitter[k]),
            color: triples(&|k| drawn.color[k]),
            alpha: floats(&|k| drawn.alpha[k]),
            background: device.upload(&planes(&background, rays)),
            alive: device.upload(&alive),
        };
        batch.keep(device, wanted);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::iface::Foreground;
    use crate::field::ball;
    use crate::field::memory::resident;
    use tiface_capture::LoadedView;
    use tiface_kernels::gpu::testing::{agree, device};

    #[test]
    fn photographs_that_stay_in_host_memory_give_the_same_rays() {
        let Some(device) = device() else { return };
        let views = ball::textured_views();
        let sampler = RaySampler::new(&views, 0.25, 1.0, Foreground::Estimated, false).with_large(1.0);
        let drawing = SamplingOptions { jitter: true, background: true, background_stream: 8 };
        assert!(resident(&sampler, &device, 0).is_none() && resident(&sampler, &device, 1 << 30).is_some());
        let wanted = device.upload(&[900u32]);
        for detail in [0.0, 0.2] {
            let [resident, sent] = [true, false].map(|on_device| {
                let mut batch = DeviceBatch::new(&device, 1000);
                let rays = DeviceSampler::new(&sampler, &device, drawing, on_device);
                rays.draw(&device, &sampler, (5, 7), &wanted, &mut batch, detail);
                batch
            });
            assert_eq!(device.read::<u32>(&resident.alive), device.read::<u32>(&sent.alive));
            let planes =
                |b: &DeviceBatch| [&b.origin, &b.direction, &b.color, &b.background].map(|p| device.read(p));
            for (got, want) in planes(&sent).iter().zip(&planes(&resident)) {
                let alive = |all: &Vec<f32>| -> Vec<f32> { (0..900).map(|r| all[r]).collect() };
                agree("rays drawn by the host", &alive(got), &alive(want), 1e-5);
            }
            for (got, want) in [(&sent.alpha, &resident.alpha), (&sent.jitter, &resident.jitter)] {
                assert_eq!(device.read::<f32>(got)[..900], device.read::<f32>(want)[..900]);
            }
        }
    }

    /// Returns the resident memory of this process in kilobytes: the current amount, or the peak
    /// since the last call.
    fn resident_memory(peak: bool) -> u64 {
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        let name = if peak { "VmHWM:" } else { "VmRSS:" };
        let line = status.lines().find(|line| line.starts_with(name)).unwrap();
        let kilobytes = line.split_whitespace().nth(1).unwrap().parse().unwrap();
        std::fs::write("/proc/self/clear_refs", "5").unwrap();
        kilobytes
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn photographs_are_not_copied_whole_on_their_way() {
        if device().is_some() {
            tiface_kernels::gpu::testing::alone("field::drawing::tests::memory_of_photographs");
        }
    }

    /// With `TIFACE_PHOTOGRAPHS=28`, `--release`, `--ignored`, `--nocapture`: a whole capture.
    #[test]
    #[cfg(target_os = "linux")]
    #[ignore = "run by the test above, in a process of its own"]
    fn memory_of_photographs() {
        let device = device().unwrap();
        let count = std::env::var("TIFACE_PHOTOGRAPHS").map_or(5, |n| n.parse().unwrap());
        let one = ball::view(2000, 0.0, 0.0, |_| [90; 3]);
        let again = |_| LoadedView {
            camera: one.camera.clone(),
            photo: one.photo.clone(),
            mask: None,
            valid: None,
            region: None,
        };
        let views: Vec<LoadedView> = (0..count).map(again).collect();
        let sampler = RaySampler::new(&views, f32::INFINITY, 1.0, Foreground::Estimated, false);
        let drawing = SamplingOptions { jitter: true, background: true, background_stream: 8 };
        let bytes = resident(&sampler, &device, u64::MAX).unwrap();
        let before = resident_memory(false);
        let _rays = DeviceSampler::new(&sampler, &device, drawing, true);
        device.read::<f32>(&device.zeros::<f32>(1));
        let more = 1024 * (resident_memory(true) - before);
        let share = more as f64 / bytes as f64;
        println!("{bytes} bytes of photographs: {more} bytes at most, {share:.2} times as much");
        // A software device keeps its own copy in the same memory.
        assert!(bytes > 75 << 20 && share < 3.2, "{share}");
    }
}
