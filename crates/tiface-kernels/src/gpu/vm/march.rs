//! The lattice points of rays inside a box and a mask: the same rule as
//! [`crate::cpu::vm::mask::Walk`].

use super::super::batch::DeviceBatch;
use super::super::device::{Buffer, Device, Words, groups, launch};
use super::super::march::{FAR, Span, bit, count_and_write, narrowed, room};
use super::super::occupancy::u32_words;
use super::super::vec3::Vec3;
use crate::cpu::vm::VmField;
use burn::cubecl::{self, prelude::*};

const UNITS: u32 = 256;

/// Number of cells along the edge of a block of cells that is skipped as a whole.
const BLOCK: usize = 8;

/// Offsets in the floats of a lattice: box (6), step, near, far; corner of the mask (3), its cells
/// per unit of length (3).
const STEP: usize = 6;
const MASK: usize = 9;
const SCALE: usize = 12;

/// Offsets in the integers of a lattice: samples of a ray; vertices (3); cells of the mask (3);
/// blocks (3).
const VERTICES: usize = 1;
const CELLS: usize = 4;
const BLOCKS: usize = 7;

/// Intersects the interval with the extent of the box along one axis. A zero component of the
/// direction is replaced by 1e-6, as in the published code.
#[cube]
fn crossed(span: Span, o: f32, d: f32, low: f32, high: f32) -> Span {
    let d = select(d == 0.0f32, 1e-6f32, d);
    narrowed(span, (low - o) / d, (high - o) / d)
}

/// Returns whether `v` lies outside `low..=high` by more than `slack`, which allows for rounding.
#[cube]
fn outside(v: f32, low: f32, high: f32, slack: f32) -> bool {
    !(v >= low - slack && v <= high + slack)
}

/// Returns whether a point lies outside a box by more than `slack` along any axis.
#[cube]
fn outside_box(p: Vec3, low: Vec3, high: Vec3, slack: Vec3) -> bool {
    outside(p.x, low.x, high.x, slack.x)
        || outside(p.y, low.y, high.y, slack.y)
        || outside(p.z, low.z, high.z, slack.z)
}

/// Returns the cell of a coordinate in units of cells, clamped to the mask.
#[cube]
fn cell(g: f32, cells: u32) -> u32 {
    min(u32::cast_from(max(g, 0.0f32)), cells - 1)
}

/// Returns the distance to the border of a cell, or of its block if that is empty, in units of `t`.
#[cube]
fn border(g: f32, cell: u32, cells: u32, d: f32, scale: f32, empty: bool) -> f32 {
    let ahead = select(d > 0.0f32, 1u32, 0u32);
    let block = cell / comptime!(BLOCK as u32);
    let wall = select(empty, min((block + ahead) * comptime!(BLOCK as u32), cells), cell + ahead);
    select(d == 0.0f32, FAR, (f32::cast_from(wall) - g) * (1.0f32 / (d * scale)))
}

/// Returns a coordinate in units of vertices of the grid, clamped to the outer ones.
#[cube]
fn grid_coordinate(p: f32, low: f32, high: f32, vertices: u32) -> f32 {
    let last = f32::cast_from(vertices - 1);
    clamp((p - low) / (high - low) * last, 0.0f32, last)
}

/// Counts the samples of rays or, if `writes` is set, writes them at the given offsets.
#[cube(launch)]
fn pass(
    lattice: &[f32],
    sizes: &[u32],
    bits: &[u32],
    blocks: &[u32],
    origin: &[f32],
    direction: &[f32],
    jitter: &[f32],
    alive: &mut [u32],
    offsets: &[u32],
    counts: &mut [u32],
    points: &mut [u32],
    t: &mut [f32],
    ray: &mut [u32],
    place: &mut [f32],
    #[comptime] masked: bool,
    #[comptime] writes: bool,
) {
    let rays = jitter.len();
    let plane = t.len();
    let r = ABSOLUTE_POS;
    if r < rays {
        let o = Vec3::read(origin, rays, r);
        let d = Vec3::read(direction, rays, r);
        let low = Vec3::read(lattice, 1usize, 0usize);
        let high = Vec3::read(lattice, 1usize, 3usize);
        let step = lattice[STEP];
        let span = crossed(Span { enter: -FAR, leave: FAR }, o.x, d.x, low.x, high.x);
        let span = crossed(span, o.y, d.y, low.y, high.y);
        let span = crossed(span, o.z, d.z, low.z, high.z);
        let entry = clamp(span.enter, lattice[STEP + 1], lattice[STEP + 2]);
        let start = entry + jitter[r] * step;
        let meets = span.enter <= span.leave && alive[r] == 1;
        let end = select(meets, sizes[0] - 1, 0u32);
        let slack = (high - low) * 1e-6f32;
        let mut first = 0usize;
        let mut max_count = end;
        if writes {
            first = offsets[r] as usize;
            max_count = room(offsets, &*counts, alive, r);
        } else {
            let inside = max((span.leave - entry) / step, 0.0f32);
            points[r] = select(meets, min(u32::cast_from(min(inside, 1e9f32)) + 1, sizes[0]), 0u32);
        }
        let mut found = 0u32;
        let mut k = 0u32;
        let mut marching = k < end && found < max_count;
        while marching {
            // t is computed for each k, never accumulated
            let at = start + step * f32::cast_from(k);
            let p = o + d * at;
            // the border itself belongs to the box, and rounding may put a sample just outside
            let inside_box = !outside_box(p, low, high, slack);
            let mut kept = inside_box;
            let mut skip = 1u32;
            if masked {
                let (nx, ny, nz) = (sizes[CELLS], sizes[CELLS + 1], sizes[CELLS + 2]);
                let u = Vec3::read(lattice, 1usize, SCALE);
                let from = p - Vec3::read(lattice, 1usize, MASK);
                let g = Vec3::new(from.x * u.x, from.y * u.y, from.z * u.z);
                let cells = Vec3::new(f32::cast_from(nx), f32::cast_from(ny), f32::cast_from(nz));
                let slack = Vec3::new(1e-3f32, 1e-3f32, 1e-3f32);
                kept = inside_box && !outside_box(g, Vec3::zero(), cells, slack);
                if kept {
                    let (cx, cy, cz) = (cell(g.x, nx), cell(g.y, ny), cell(g.z, nz));
                    if !bit(bits, (cx * ny + cy) * nz + cz) {
                        kept = false;
                        // skip to the border of the empty cell, or of its block if that is empty
                        // too, by a whole number of steps
                        let size = comptime!(BLOCK as u32);
                        let b = (cx / size * sizes[BLOCKS + 1] + cy / size) * sizes[BLOCKS + 2] + cz / size;
                        let empty = !bit(blocks, b);
                        let far = min(
                            border(g.x, cx, nx, d.x, u.x, empty),
                            min(border(g.y, cy, ny, d.y, u.y, empty), border(g.z, cz, nz, d.z, u.z, empty)),
                        );
                        // slightly less than that, so that rounding cannot skip a sample in the
                        // next cell
                        let whole = (max(far, 0.0f32) / step - 1e-3f32).ceil();
                        skip = u32::cast_from(clamp(whole, 1.0f32, 1e9f32));
                    }
                }
            }
            if at > span.leave + step {
                marching = false;
            } else {
                if kept {
                    if writes {
                        let s = first + found as usize;
                        t[s] = at;
                        ray[s] = r as u32;
                        let (nx, ny, nz) = (sizes[VERTICES], sizes[VERTICES + 1], sizes[VERTICES + 2]);
                        let x = grid_coordinate(p.x, low.x, high.x, nx);
                        let y = grid_coordinate(p.y, low.y, high.y, ny);
                        let z = grid_coordinate(p.z, low.z, high.z, nz);
                        Vec3::new(x, y, z).write(place, plane, s);
                    }
                    found += 1;
                }
                k += skip;
                marching = k < end && found < max_count;
            }
        }
        if !writes {
            counts[r] = found;
        }
    }
}

/// The lattice of a field on a device.
pub struct DeviceLattice {
    lattice: Buffer,
    sizes: Buffer,
    mask: Option<[Buffer; 2]>,
    /// Maximum number of samples of a ray.
    pub max_samples: usize,
}

impl DeviceLattice {
    /// Uploads the lattice of a field.
    pub fn new(device: &Device, field: &VmField) -> DeviceLattice {
        let l = &field.lattice;
        assert!(l.step.is_finite() && l.step > 0.0);
        let mut numbers = [l.min.as_slice(), &l.max, &[l.step, l.near, l.far]].concat();
        let mut sizes = vec![l.samples.max(1) as u32];
        sizes.extend(field.density.size.map(|n| n as u32));
        let mask = field.mask.as_ref().map(|mask| {
            let ((low, high), cells) = (mask.bounds(), mask.size());
            numbers.extend(low);
            numbers.extend((0..3).map(|a| cells[a] as f32 / (high[a] - low[a])));
            sizes.extend(cells.map(|n| n as u32));
            sizes.extend(cells.map(|n| n.div_ceil(BLOCK) as u32));
            [mask.bits(), &mask.blocks(BLOCK)].map(|bits| device.upload(&u32_words(bits)))
        });
        let max_samples = DeviceLattice::max_samples(field);
        DeviceLattice { lattice: device.upload(&numbers), sizes: device.upload(&sizes), mask, max_samples }
    }

    /// Returns the maximum number of samples of a ray: those of the box's diagonal, and a few more
    /// for rounding.
    pub fn max_samples(field: &VmField) -> usize {
        let l = &field.lattice;
        let diagonal = (0..3).map(|a| (l.max[a] - l.min[a]).powi(2)).sum::<f32>().sqrt();
        l.samples.saturating_sub(1).min((diagonal / l.step) as usize + 3).max(1)
    }
}

/// The samples of a batch of rays.
pub struct VmSamples {
    /// `[rays + 1]`: ray `r` owns samples `offsets[r]..offsets[r + 1]`.
    pub offsets: Buffer,
    /// `[2]`: number of samples, in both words.
    pub count: Buffer,
    /// `[capacity]`: `t` of each sample.
    pub t: Buffer,
    /// `[capacity]`: ray of each sample.
    pub ray: Buffer,
    /// Planes `[3, capacity]`: positions in units of vertices of the grid, clamped to the outer
    /// ones.
    pub place: Buffer,
    /// `[rays]`: number of lattice points inside the box, including those that the mask skips.
    pub points: Buffer,
    counts: Buffer,
}

impl VmSamples {
    /// Memory per sample, in words.
    pub const WORDS: usize = 5;

    /// Allocates buffers for `rays` rays and `capacity` samples.
    pub fn new(device: &Device, rays: usize, capacity: usize) -> VmSamples {
        VmSamples {
            offsets: device.zeros::<u32>(rays + 1),
            count: device.zeros::<u32>(2),
            t: device.scratch::<f32>(capacity),
            ray: device.scratch::<u32>(capacity),
            place: device.scratch::<f32>(3 * capacity),
            points: device.zeros::<u32>(rays),
            counts: device.zeros::<u32>(rays),
        }
    }

    /// Marches a batch of rays. Rays whose samples exceed the capacity are marked as not alive.
    pub fn march(&self, device: &Device, lattice: &DeviceLattice, rays: &DeviceBatch) {
        assert_eq!(rays.rays(), self.counts.word_count());
        let [bits, blocks] = match &lattice.mask {
            Some(masks) => masks.each_ref(),
            None => [&lattice.sizes; 2],
        };
        let run_pass = |writes: bool| {
            launch!(device, pass::launch, groups(rays.jitter.word_count().div_ceil(UNITS as usize)), UNITS;
                lattice.lattice, lattice.sizes, bits, blocks, rays.origin, rays.direction, rays.jitter,
                rays.alive, self.offsets, self.counts, self.points, self.t, self.ray, self.place;
                lattice.mask.is_some(), writes
            );
        };
        count_and_write(device, &self.counts, &self.offsets, &self.count, self.t.word_count(), run_pass);
    }
}
