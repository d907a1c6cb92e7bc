//! Rays of a step in device memory.

use super::device::{Buffer, Device, Words, groups, launch};
use crate::cpu::march::shift;
use burn::cubecl::server::Handle;
use burn::cubecl::{self, prelude::*};
use tiface_base::geom::Ray;

const UNITS: u32 = 256;

/// The rays that a kernel writes; [`DeviceBatch`] documents the arrays.
#[derive(CubeType, CubeLaunch)]
pub(super) struct RayArrays {
    pub origin: Box<[f32]>,
    pub direction: Box<[f32]>,
    pub jitter: Box<[f32]>,
    pub color: Box<[f32]>,
    pub alpha: Box<[f32]>,
    pub background: Box<[f32]>,
    pub alive: Box<[u32]>,
}

#[cube(launch)]
fn keep(wanted: &[u32], alive: &mut [u32]) {
    let r = ABSOLUTE_POS;
    if r < alive.len() && r >= wanted[0] as usize {
        alive[r] = 0;
    }
}

/// Rays of a step, and the colors of their pixels.
pub struct DeviceBatch {
    /// Planes `[3, rays]`, where they start, in the field's coordinates.
    pub origin: Buffer,
    /// Planes `[3, rays]`, directions.
    pub direction: Buffer,
    /// `[rays]`: the part of a step that samples are shifted by.
    pub jitter: Buffer,
    /// Planes `[3, rays]`: the head over black, sRGB-coded, 0 to 1.
    pub color: Buffer,
    /// `[rays]`: soft alpha, 1 without a mask.
    pub alpha: Buffer,
    /// Planes `[3, rays]`: background color of render and target.
    pub background: Buffer,
    /// `[rays]`: 1 for rays in use; the others have no samples and no part in any mean.
    pub alive: Buffer,
}

impl DeviceBatch {
    /// Allocates a batch with a capacity of `rays`, all inactive.
    pub fn new(device: &Device, rays: usize) -> DeviceBatch {
        DeviceBatch {
            origin: device.zeros::<f32>(3 * rays),
            direction: device.zeros::<f32>(3 * rays),
            jitter: device.zeros::<f32>(rays),
            color: device.zeros::<f32>(3 * rays),
            alpha: device.zeros::<f32>(rays),
            background: device.zeros::<f32>(3 * rays),
            alive: device.zeros::<u32>(rays),
        }
    }

    /// Uploads rays into a batch of the given capacity, with black colors. `jitter` is empty, or
    /// has one a ray.
    pub fn upload(device: &Device, rays: &[Ray], jitter: &[f32], capacity: usize) -> DeviceBatch {
        assert!(rays.len() <= capacity && (jitter.is_empty() || jitter.len() == rays.len()));
        let mut planes = [vec![0f32; 3 * capacity], vec![0f32; 3 * capacity]];
        let (mut shifts, mut alive) = (vec![0f32; capacity], vec![0u32; capacity]);
        for (r, ray) in rays.iter().enumerate() {
            for a in 0..3 {
                planes[0][a * capacity + r] = ray.origin[a];
                planes[1][a * capacity + r] = ray.direction[a];
            }
            (shifts[r], alive[r]) = (shift(jitter, r), 1);
        }
        DeviceBatch {
            origin: device.upload(&planes[0]),
            direction: device.upload(&planes[1]),
            jitter: device.upload(&shifts),
            alive: device.upload(&alive),
            ..DeviceBatch::new(device, capacity)
        }
    }

    /// Returns the capacity in rays.
    pub fn rays(&self) -> usize {
        self.jitter.word_count()
    }

    fn arrays(&self) -> [&Buffer; 7] {
        let DeviceBatch { origin, direction, jitter, color, alpha, background, alive } = self;
        [origin, direction, jitter, color, alpha, background, alive]
    }

    /// Returns the buffers as a kernel argument.
    pub(super) fn arg(&self) -> RayArraysLaunch {
        let [origin, direction, jitter, color, alpha, background, alive] = self.arrays().map(Words::arg);
        RayArraysLaunch::new(origin, direction, jitter, color, alpha, background, alive)
    }

    /// Returns the handles of the buffers' memory.
    pub(super) fn handles(&self) -> [&Handle; 7] {
        self.arrays().map(|buffer| &buffer.handle)
    }

    /// Deactivates all rays after the first `wanted`, `[1]`.
    pub fn keep(&self, device: &Device, wanted: &Buffer) {
        let count = groups(self.rays().div_ceil(UNITS as usize));
        launch!(device, keep::launch, count, UNITS; wanted, self.alive);
    }
}
