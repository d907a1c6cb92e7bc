//! Marching through the occupancy bitmask of [`crate::kernel::cpu::march`], without the host knowing how many samples there
//! are: a pass counts them, a prefix sum says where each ray's lie, a second pass writes them.

use super::device::{Buffer, Device, Words, groups, launch};
use super::draw::Batch;
use super::occupancy::Occupancy;
use burn::cubecl::{self, prelude::*};

const UNITS: u32 = 256;

/// Further than anything.
const FAR: f32 = 1e30;

/// A bit of a mask.
#[cube]
pub(super) fn bit(mask: &[u32], i: u32) -> bool {
    (mask[(i >> 5) as usize] >> (i & 31)) & 1 == 1
}

/// The cell of a coordinate that counts cells.
#[cube]
fn cell(g: f32, top: i32) -> i32 {
    clamp(i32::cast_from(g.floor()), 0i32, top)
}

/// Where a ray enters and leaves the box along one axis.
#[derive(CubeType)]
struct Span {
    enter: f32,
    leave: f32,
}

#[cube]
fn clipped(span: Span, o: f32, d: f32, radius: f32) -> Span {
    let mut enter = span.enter;
    let mut leave = span.leave;
    if d == 0.0f32 {
        leave = select(o.abs() > radius, -1.0f32, leave);
    } else {
        let (p, q) = ((-radius - o) / d, (radius - o) / d);
        enter = max(enter, min(p, q));
        leave = min(leave, max(p, q));
    }
    Span { enter, leave }
}

/// How far it is to the border of a cell along one axis, in cells along the ray.
#[cube]
fn border(g: f32, cell: i32, d: f32) -> f32 {
    let wall = f32::cast_from(cell + select(d > 0.0f32, 1i32, 0i32));
    select(d == 0.0f32, FAR, (wall - g) * (1.0f32 / d))
}

/// Counts a ray's samples or, once it is known where they lie, writes them.
#[cube(launch)]
fn pass(
    mask: &[u32],
    solid: &[u32],
    origin: &[f32],
    direction: &[f32],
    jitter: &[f32],
    alive: &mut [u32],
    offsets: &[u32],
    counts: &mut [u32],
    pitch: &[f32],
    t: &mut [f32],
    dt: &mut [f32],
    x: &mut [f32],
    toward: &mut [f32],
    resolution: u32,
    radius: f32,
    limit: u32,
    #[comptime] writes: bool,
    #[comptime] has_solid: bool,
) {
    let rays = jitter.len();
    let plane = t.len();
    let r = ABSOLUTE_POS;
    if r < rays {
        let (ox, oy, oz) = (origin[r], origin[rays + r], origin[2 * rays + r]);
        let (dx, dy, dz) = (direction[r], direction[rays + r], direction[2 * rays + r]);
        let span = clipped(Span { enter: 0.0f32, leave: FAR }, ox, dx, radius);
        let span = clipped(span, oy, dy, radius);
        let span = clipped(span, oz, dz, radius);
        let top = i32::cast_from(resolution) - 1;
        let scale = 0.5f32 * f32::cast_from(resolution) / radius;
        let step = pitch[0];
        let start = span.enter + jitter[r] * step;
        let mut first = 0usize;
        let mut most = limit;
        if writes {
            first = offsets[r] as usize;
            most = offsets[r + 1] - offsets[r];
            if most < counts[r] {
                alive[r] = 0;
            }
        }
        let mut found = 0u32;
        let mut k = 0u32;
        let mut marching = span.enter < span.leave && found < most && alive[r] == 1;
        while marching {
            // t = start + (k + ½) · step for integer k: computed, never accumulated
            let at = start + (f32::cast_from(k) + 0.5f32) * step;
            if at >= span.leave {
                marching = false;
            } else {
                let (px, py, pz) = (ox + at * dx, oy + at * dy, oz + at * dz);
                let (gx, gy, gz) = ((px + radius) * scale, (py + radius) * scale, (pz + radius) * scale);
                let (cx, cy, cz) = (cell(gx, top), cell(gy, top), cell(gz, top));
                let i =
                    (u32::cast_from(cx) * resolution + u32::cast_from(cy)) * resolution + u32::cast_from(cz);
                if bit(mask, i) {
                    if writes {
                        let s = first + found as usize;
                        t[s] = at;
                        dt[s] = step;
                        x[s] = px;
                        x[plane + s] = py;
                        x[2 * plane + s] = pz;
                        toward[s] = dx;
                        toward[plane + s] = dy;
                        toward[2 * plane + s] = dz;
                    }
                    found += 1;
                    k += 1;
                    marching = found < most;
                } else {
                    let far = min(border(gx, cx, dx), min(border(gy, cy, dy), border(gz, cz, dz)));
                    let skip = max((max(far, 0.0f32) / (scale * step)).ceil(), 1.0f32);
                    k += u32::cast_from(min(skip, 1e9f32));
                    if has_solid && bit(solid, i) {
                        marching = false;
                    }
                }
            }
        }
        if !writes {
            counts[r] = found;
        }
    }
}

/// See [`prefix_sum`]. One group of threads.
#[cube(launch)]
fn scan(counts: &[u32], offsets: &mut [u32], total: &mut [u32], capacity: u32) {
    let unit = UNIT_POS as usize;
    let rays = counts.len();
    let share = rays.div_ceil(UNITS as usize);
    let begin = min(unit * share, rays);
    let end = min(begin + share, rays);
    let mut own = 0u32;
    for r in begin..end {
        own += counts[r];
    }
    let mut sums = Shared::<[u32]>::new_slice(UNITS as usize);
    let mut fit = Shared::<[u32]>::new_slice(UNITS as usize);
    sums[unit] = own;
    sync_cube();
    let mut before = 0u32;
    for i in 0..unit {
        before += sums[i];
    }
    // the last border that fits, of this thread's rays and then of all
    let mut last = 0u32;
    let mut at = before;
    for r in begin..end {
        at += counts[r];
        last = select(at <= capacity, at, last);
    }
    fit[unit] = last;
    sync_cube();
    let mut most = 0u32;
    let mut wanted = 0u32;
    for i in 0..UNITS as usize {
        most = max(most, fit[i]);
        wanted += sums[i];
    }
    at = before;
    for r in begin..end {
        offsets[r] = min(at, most);
        at += counts[r];
    }
    if unit == 0 {
        offsets[rays] = most;
        total[0] = most;
        total[1] = wanted;
    }
}

/// Where each ray's samples begin, `[rays + 1]`, of their counts `[rays]`; and how many there are and would be with more
/// room, `[2]`. A ray whose samples, with those before, are more than `capacity` gets none, and none behind it.
pub(super) fn prefix_sum(
    device: &Device,
    counts: &Buffer,
    offsets: &Buffer,
    total: &Buffer,
    capacity: usize,
) {
    assert_eq!(offsets.words(), counts.words() + 1);
    launch!(device, scan::launch, CubeCount::new_single(), UNITS; counts, offsets, total; capacity as u32);
}

/// The samples of a batch of rays on a device.
pub struct Samples {
    /// `[rays + 1]`: ray `r` owns samples `offsets[r]..offsets[r + 1]`.
    pub offsets: Buffer,
    /// `[2]`: how many there are, and how many there would be with more room.
    pub count: Buffer,
    /// `[capacity]` midpoints.
    pub t: Buffer,
    /// `[capacity]` lengths.
    pub dt: Buffer,
    /// Planes `[3, capacity]`, positions; finite behind the last.
    pub x: Buffer,
    /// Planes `[3, capacity]`, directions of their rays; finite behind the last.
    pub direction: Buffer,
    /// `[rays]`: how many samples each has.
    pub(super) counts: Buffer,
}

impl Samples {
    /// Room for so many rays and `capacity` samples.
    pub fn new(device: &Device, rays: usize, capacity: usize) -> Samples {
        Samples {
            offsets: device.zeros::<u32>(rays + 1),
            count: device.zeros::<u32>(2),
            t: device.zeros::<f32>(capacity),
            dt: device.zeros::<f32>(capacity),
            x: device.zeros::<f32>(3 * capacity),
            direction: device.zeros::<f32>(3 * capacity),
            counts: device.zeros::<u32>(rays),
        }
    }

    /// Marches rays with steps of `pitch`, `[1]`: see [`crate::kernel::cpu::march::march`]. Rays beyond the room there is are
    /// none from then on. The last `apart` places are left free.
    pub fn march(
        &self,
        device: &Device,
        occupancy: &Occupancy,
        rays: &Batch,
        pitch: &Buffer,
        limit: usize,
        apart: usize,
    ) {
        assert!(rays.rays() == self.counts.words() && apart < self.t.words());
        let both = |writes: bool| {
            launch!(device, pass::launch, groups(rays.rays().div_ceil(UNITS as usize)), UNITS;
                occupancy.mask, occupancy.solid.as_ref().unwrap_or(&occupancy.mask), rays.origin,
                rays.direction, rays.jitter, rays.alive, self.offsets, self.counts, pitch, self.t, self.dt,
                self.x, self.direction;
                occupancy.resolution as u32, occupancy.radius, limit.min(u32::MAX as usize) as u32, writes,
                occupancy.solid.is_some()
            );
        };
        both(false);
        prefix_sum(device, &self.counts, &self.offsets, &self.count, self.t.words() - apart);
        both(true);
    }
}

#[cfg(test)]
mod tests {
    use super::super::device::tests::{agree, device, planes};
    use super::*;
    use crate::kernel::cpu::march::{Bitmask, MarchRay, march};
    use crate::kernel::cpu::rng;

    const RADIUS: f32 = 1.1;
    const STEP: f32 = 0.02;

    /// Rays from all around towards the middle, one along an axis and one that misses; a mask with holes.
    fn scene() -> (Bitmask, Bitmask, Vec<MarchRay>) {
        let resolution = 24;
        let mut mask = Bitmask::filled(resolution, false);
        let mut solid = mask.clone();
        for i in 0..resolution * resolution * resolution {
            let at = |stride: usize| (i / stride % resolution) as f32 / 12.0 - 0.95;
            let r = (at(1).powi(2) + at(resolution).powi(2) + at(resolution * resolution).powi(2)).sqrt();
            mask.set(i, (0.3..0.7).contains(&r) && i % 7 != 0);
            solid.set(i, r < 0.25);
        }
        let mut rays: Vec<MarchRay> = (0..700)
            .map(|i| {
                let normal = |k: u64| rng::normal(1, 2, 7 * i + k);
                let unit = |v: [f32; 3]| v.map(|c| c / v.iter().map(|c| c * c).sum::<f32>().sqrt());
                let origin = unit([normal(0), normal(1), normal(2)]).map(|c| 2.0 * c);
                let aim = [normal(3), normal(4), normal(5)].map(|c| 0.4 * c);
                let direction = unit(std::array::from_fn(|a| aim[a] - origin[a]));
                MarchRay { origin, direction, jitter: rng::uniform(1, 3, i) }
            })
            .collect();
        rays.push(MarchRay { origin: [0.03, 0.01, 2.0], direction: [0.0, 0.0, -1.0], jitter: 0.0 });
        rays.push(MarchRay { origin: [1.5, 0.0, 2.0], direction: [0.0, 0.0, -1.0], jitter: 0.5 });
        (mask, solid, rays)
    }

    fn on_device(
        device: &Device,
        occupancy: &Occupancy,
        rays: &[MarchRay],
        capacity: usize,
        limit: usize,
    ) -> (Samples, Vec<u32>) {
        // room for some that are not there
        let samples = Samples::new(device, rays.len() + 5, capacity + 3);
        let batch = Batch::of_rays(device, rays, rays.len() + 5);
        samples.march(device, occupancy, &batch, &device.upload(&[STEP]), limit, 3);
        (samples, device.read(&batch.alive))
    }

    #[test]
    fn samples_are_those_of_the_cpu() {
        let Some(device) = device() else { return };
        let (mask, solid, rays) = scene();
        for (solid, limit) in [(None, 1000), (Some(&solid), 1000), (Some(&solid), 7)] {
            let want = march(&mask, solid, RADIUS, STEP, &rays, limit);
            let n = want.t.len();
            let occupancy = Occupancy::new(&device, &mask, solid, RADIUS);
            let (got, alive) = on_device(&device, &occupancy, &rays, (1 << 16) - 3, limit);
            assert_eq!(device.read::<u32>(&got.count), [n as u32; 2]);
            assert_eq!(device.read::<i32>(&got.offsets)[..=rays.len()], want.offsets);
            assert!((0..alive.len()).all(|r| (alive[r] == 1) == (r < rays.len())));
            agree("marched t", &device.read::<f32>(&got.t)[..n], &want.t, 1e-5);
            let (x, d) = want.points(&rays, 0);
            agree("marched x", &device.read::<f32>(&got.x), &planes(&x, 1 << 16), 1e-5);
            agree("marched directions", &device.read::<f32>(&got.direction), &planes(&d, 1 << 16), 1e-5);
            println!("{n} samples");
        }
    }

    #[test]
    fn rays_beyond_the_room_get_no_samples() {
        let Some(device) = device() else { return };
        let (mask, _, rays) = scene();
        let whole = march(&mask, None, RADIUS, STEP, &rays, 1000).offsets;
        let occupancy = Occupancy::new(&device, &mask, None, RADIUS);
        let room = whole[300] + 1; // the rays from 300 on, but for empty ones right there, do not fit
        let (got, alive) = on_device(&device, &occupancy, &rays, room as usize, 1000);
        let fits = *whole.iter().filter(|&&o| o <= room).max().unwrap();
        let want: Vec<i32> = whole.iter().map(|&o| o.min(fits)).collect();
        assert_eq!(device.read::<i32>(&got.offsets)[..=rays.len()], want);
        assert_eq!(device.read::<i32>(&got.count), [fits, whole[rays.len()]]);
        // those that did not fit are no rays any more, those that meet nothing are
        assert!(
            (0..rays.len()).all(|r| (alive[r] == 1) == (whole[r + 1] <= fits || whole[r + 1] == whole[r]))
        );
    }
}
