//! Marching through an occupancy bitmask, with the samples of [`crate::cpu::march`], without a
//! readback of the number of samples: a first pass counts the samples of each ray, a prefix sum
//! gives the offset of each ray, and a second pass writes the samples.

use super::batch::DeviceBatch;
use super::device::{Buffer, Device, Words, groups, launch};
use super::occupancy::Occupancy;
use super::vec3::Vec3;
use burn::cubecl::{self, prelude::*};

const UNITS: u32 = 256;

/// A distance beyond any sample.
pub(super) const FAR: f32 = 1e30;

/// Returns bit `i` of a mask.
#[cube]
pub(super) fn bit(mask: &[u32], i: u32) -> bool {
    (mask[(i >> 5) as usize] >> (i & 31)) & 1 == 1
}

/// Returns the cell of a coordinate in units of cells, clamped to the grid.
#[cube]
fn cell(g: f32, top: i32) -> i32 {
    clamp(i32::cast_from(g.floor()), 0i32, top)
}

/// Interval of `t` in which a ray lies inside the box.
#[derive(CubeType)]
pub(super) struct Span {
    pub enter: f32,
    pub leave: f32,
}

/// Intersects an interval with the one between `p` and `q`.
#[cube]
pub(super) fn narrowed(span: Span, p: f32, q: f32) -> Span {
    Span { enter: max(span.enter, min(p, q)), leave: min(span.leave, max(p, q)) }
}

/// Intersects the interval with the extent of the box along one axis.
#[cube]
fn clipped(span: Span, o: f32, d: f32, radius: f32) -> Span {
    // all of a line beside the axis lies inside, or nothing
    let beside = select(o.abs() > radius, -1.0f32, FAR);
    let low = select(d == 0.0f32, 0.0f32, (-radius - o) / d);
    let high = select(d == 0.0f32, beside, (radius - o) / d);
    narrowed(span, low, high)
}

/// Returns the distance along the ray to the border of a cell along one axis, in units of cells.
#[cube]
fn border(g: f32, cell: i32, d: f32) -> f32 {
    let wall = f32::cast_from(cell + select(d > 0.0f32, 1i32, 0i32));
    select(d == 0.0f32, FAR, (wall - g) * (1.0f32 / d))
}

/// Returns the number of samples of a ray that are written. A ray whose samples exceed the capacity
/// is marked as not alive.
#[cube]
pub(super) fn room(offsets: &[u32], counts: &[u32], alive: &mut [u32], r: usize) -> u32 {
    let room = offsets[r + 1] - offsets[r];
    if room < counts[r] {
        alive[r] = 0;
    }
    room
}

/// Counts the samples of rays or, if `writes` is set, writes them at the given offsets.
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
    step_length: &[f32],
    t: &mut [f32],
    dt: &mut [f32],
    x: &mut [f32],
    view_dir: &mut [f32],
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
        let o = Vec3::read(origin, rays, r);
        let d = Vec3::read(direction, rays, r);
        let span = clipped(Span { enter: 0.0f32, leave: FAR }, o.x, d.x, radius);
        let span = clipped(span, o.y, d.y, radius);
        let span = clipped(span, o.z, d.z, radius);
        let top = i32::cast_from(resolution) - 1;
        let scale = 0.5f32 * f32::cast_from(resolution) / radius;
        let step = step_length[0];
        let start = span.enter + jitter[r] * step;
        let mut first = 0usize;
        let mut max_count = limit;
        if writes {
            first = offsets[r] as usize;
            max_count = room(offsets, &*counts, alive, r);
        }
        let mut found = 0u32;
        let mut k = 0u32;
        let mut marching = span.enter < span.leave && found < max_count && alive[r] == 1;
        while marching {
            // t = start + (k + ½) · step for integer k: computed, never accumulated
            let at = start + (f32::cast_from(k) + 0.5f32) * step;
            if at >= span.leave {
                marching = false;
            } else {
                let p = o + d * at;
                let g = (p + Vec3::new(radius, radius, radius)) * scale;
                let (cx, cy, cz) = (cell(g.x, top), cell(g.y, top), cell(g.z, top));
                let i =
                    (u32::cast_from(cx) * resolution + u32::cast_from(cy)) * resolution + u32::cast_from(cz);
                if bit(mask, i) {
                    if writes {
                        let s = first + found as usize;
                        t[s] = at;
                        dt[s] = step;
                        p.write(x, plane, s);
                        d.write(view_dir, plane, s);
                    }
                    found += 1;
                    k += 1;
                    marching = found < max_count;
                } else {
                    let far = min(border(g.x, cx, d.x), min(border(g.y, cy, d.y), border(g.z, cz, d.z)));
                    // slightly less than that, so that rounding cannot skip a sample in the next
                    // cell
                    let skip = max((max(far, 0.0f32) / (scale * step) - 1e-3f32).ceil(), 1.0f32);
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

/// Computes [`prefix_sum`] with one group of threads.
#[cube(launch)]
fn scan(counts: &[u32], offsets: &mut [u32], total: &mut [u32], capacity: u32) {
    let unit = UNIT_POS as usize;
    let rays = counts.len();
    let share = rays.div_ceil(UNITS as usize);
    let begin = min(unit * share, rays);
    let end = min(begin + share, rays);
    let mut sum = 0u32;
    for r in begin..end {
        sum += counts[r];
    }
    let mut sums = Shared::<[u32]>::new_slice(UNITS as usize);
    let mut fit = Shared::<[u32]>::new_slice(UNITS as usize);
    sums[unit] = sum;
    sync_cube();
    let mut before = 0u32;
    for i in 0..unit {
        before += sums[i];
    }
    // the largest end of a ray that fits the capacity, over this thread's rays and then over all
    // rays
    let mut last = 0u32;
    let mut at = before;
    for r in begin..end {
        at += counts[r];
        last = select(at <= capacity, at, last);
    }
    fit[unit] = last;
    sync_cube();
    let mut fitting = 0u32;
    let mut wanted = 0u32;
    for i in 0..UNITS as usize {
        fitting = max(fitting, fit[i]);
        wanted += sums[i];
    }
    at = before;
    for r in begin..end {
        offsets[r] = min(at, fitting);
        at += counts[r];
    }
    if unit == 0 {
        offsets[rays] = fitting;
        total[0] = fitting;
        total[1] = wanted;
    }
}

/// Writes the offsets of each ray's samples, `[rays + 1]`, from their counts `[rays]`, and two
/// totals, `[2]`: the number of samples, and the number with unlimited capacity. The first ray
/// whose samples exceed the capacity, and all rays after it, get no samples.
pub(super) fn prefix_sum(
    device: &Device,
    counts: &Buffer,
    offsets: &Buffer,
    total: &Buffer,
    capacity: usize,
) {
    assert_eq!(offsets.word_count(), counts.word_count() + 1);
    launch!(device, scan::launch, CubeCount::new_single(), UNITS; counts, offsets, total; capacity as u32);
}

/// Marches rays without a readback: counts their samples with `pass(false)`, sums the counts as
/// [`prefix_sum`] does, and writes the samples with `pass(true)`.
pub(super) fn count_and_write(
    device: &Device,
    counts: &Buffer,
    offsets: &Buffer,
    total: &Buffer,
    capacity: usize,
    pass: impl Fn(bool),
) {
    pass(false);
    prefix_sum(device, counts, offsets, total, capacity);
    pass(true);
}

/// The samples of a batch of rays on a device.
pub struct Samples {
    /// `[rays + 1]`: ray `r` owns samples `offsets[r]..offsets[r + 1]`.
    pub offsets: Buffer,
    /// `[2]`: number of samples, and number of samples with unlimited capacity.
    pub count: Buffer,
    /// `[capacity]` midpoints.
    pub t: Buffer,
    /// `[capacity]` lengths.
    pub dt: Buffer,
    /// Planes `[3, capacity]`, positions; finite after the last sample.
    pub x: Buffer,
    /// Planes `[3, capacity]`, directions of the samples' rays; finite after the last sample.
    pub direction: Buffer,
    /// `[rays]`: number of samples of each ray.
    pub(super) counts: Buffer,
}

impl Samples {
    /// Allocates buffers for `rays` rays and `capacity` samples.
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

    /// Marches rays with steps of length `step_length`, `[1]`: see
    /// [`crate::cpu::march::MarchCells::march`].
    /// Each ray keeps at most `limit` samples. Rays whose samples exceed the capacity are marked as
    /// not alive. The last `reserved` places of the buffers stay free.
    pub fn march(
        &self,
        device: &Device,
        occupancy: &Occupancy,
        rays: &DeviceBatch,
        step_length: &Buffer,
        limit: usize,
        reserved: usize,
    ) {
        assert!(rays.rays() == self.counts.word_count() && reserved < self.t.word_count());
        let run_pass = |writes: bool| {
            launch!(device, pass::launch, groups(rays.rays().div_ceil(UNITS as usize)), UNITS;
                occupancy.mask, occupancy.solid.as_ref().unwrap_or(&occupancy.mask), rays.origin,
                rays.direction, rays.jitter, rays.alive, self.offsets, self.counts, step_length, self.t,
                self.dt, self.x, self.direction;
                occupancy.resolution as u32, occupancy.radius, limit.min(u32::MAX as usize) as u32, writes,
                occupancy.solid.is_some()
            );
        };
        let capacity = self.t.word_count() - reserved;
        count_and_write(device, &self.counts, &self.offsets, &self.count, capacity, run_pass);
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{agree, device, planes};
    use super::*;
    use crate::cpu::march::MarchCells;
    use tiface_base::geom::{BitGrid, Ray};
    use tiface_base::math::rng;

    const RADIUS: f32 = 1.1;
    const STEP: f32 = 0.02;

    /// Returns a mask with holes, solid cells, and rays from all around towards the center, one
    /// along an axis and one that misses, with their jitter.
    fn scene() -> (BitGrid, BitGrid, Vec<Ray>, Vec<f32>) {
        let resolution = 24;
        let mut mask = BitGrid::filled(resolution, false);
        let mut solid = mask.clone();
        for i in 0..resolution * resolution * resolution {
            let at = |stride: usize| (i / stride % resolution) as f32 / 12.0 - 0.95;
            let r = (at(1).powi(2) + at(resolution).powi(2) + at(resolution * resolution).powi(2)).sqrt();
            mask.set(i, (0.3..0.7).contains(&r) && i % 7 != 0);
            solid.set(i, r < 0.25);
        }
        let (mut rays, mut jitter): (Vec<Ray>, Vec<f32>) = (0..700)
            .map(|i| {
                let normal = |k: u64| rng::normal(1, 2, 7 * i + k);
                let unit = |v: [f32; 3]| v.map(|c| c / v.iter().map(|c| c * c).sum::<f32>().sqrt());
                let origin = unit([normal(0), normal(1), normal(2)]).map(|c| 2.0 * c);
                let aim = [normal(3), normal(4), normal(5)].map(|c| 0.4 * c);
                let direction = unit(std::array::from_fn(|a| aim[a] - origin[a]));
                (Ray::new(origin, direction), rng::uniform(1, 3, i))
            })
            .unzip();
        rays.push(Ray::new([0.03, 0.01, 2.0], [0.0, 0.0, -1.0]));
        rays.push(Ray::new([1.5, 0.0, 2.0], [0.0, 0.0, -1.0]));
        jitter.extend([0.0, 0.5]);
        (mask, solid, rays, jitter)
    }

    fn on_device(
        device: &Device,
        occupancy: &Occupancy,
        (rays, jitter): (&[Ray], &[f32]),
        capacity: usize,
        limit: usize,
    ) -> (Samples, Vec<u32>) {
        // the buffers have capacity for more rays and samples than are used
        let samples = Samples::new(device, rays.len() + 5, capacity + 3);
        let batch = DeviceBatch::upload(device, rays, jitter, rays.len() + 5);
        samples.march(device, occupancy, &batch, &device.upload(&[STEP]), limit, 3);
        (samples, device.read(&batch.alive))
    }

    #[test]
    fn samples_are_those_of_the_cpu() {
        let Some(device) = device() else { return };
        let (mask, solid, rays, jitter) = scene();
        for (solid, limit) in [(None, 1000), (Some(&solid), 1000), (Some(&solid), 7)] {
            let want = MarchCells::new(&mask, solid).march(RADIUS, STEP, &rays, &jitter, limit);
            let n = want.t.len();
            let occupancy = Occupancy::new(&device, &mask, solid, RADIUS);
            let (got, alive) = on_device(&device, &occupancy, (&rays, &jitter), (1 << 16) - 3, limit);
            assert_eq!(device.read::<u32>(&got.count), [n as u32; 2]);
            assert_eq!(device.read::<i32>(&got.offsets)[..=rays.len()], want.offsets);
            assert!((0..alive.len()).all(|r| (alive[r] == 1) == (r < rays.len())));
            agree("marched t", &device.read::<f32>(&got.t)[..n], &want.t, 1e-5);
            let (x, d) = want.points(&rays);
            agree("marched x", &device.read::<f32>(&got.x), &planes(&x, 1 << 16), 1e-5);
            agree("marched directions", &device.read::<f32>(&got.direction), &planes(&d, 1 << 16), 1e-5);
            println!("{n} samples");
        }
    }

    #[test]
    fn rays_beyond_the_capacity_get_no_samples() {
        let Some(device) = device() else { return };
        let (mask, _, rays, jitter) = scene();
        let whole = MarchCells::new(&mask, None).march(RADIUS, STEP, &rays, &jitter, 1000).offsets;
        let occupancy = Occupancy::new(&device, &mask, None, RADIUS);
        // rays from 300 on do not fit, except empty ones that directly follow
        let capacity = whole[300] + 1;
        let (got, alive) = on_device(&device, &occupancy, (&rays, &jitter), capacity as usize, 1000);
        let fits = *whole.iter().filter(|&&o| o <= capacity).max().unwrap();
        let want: Vec<i32> = whole.iter().map(|&o| o.min(fits)).collect();
        assert_eq!(device.read::<i32>(&got.offsets)[..=rays.len()], want);
        assert_eq!(device.read::<i32>(&got.count), [fits, whole[rays.len()]]);
        // rays that did not fit are not alive any more, but rays without samples are
        assert!(
            (0..rays.len()).all(|r| (alive[r] == 1) == (whole[r + 1] <= fits || whole[r + 1] == whole[r]))
        );
    }
}
