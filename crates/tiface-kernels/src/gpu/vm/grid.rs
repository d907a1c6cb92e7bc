//! Planes and lines on a device: interpolation, the scatter of gradients, and the total variation.

use super::super::device::{Atomics, Buffer, Device, Words, groups, launch};
use super::super::sum::{Exchange, FIXED_POINT_RANGE, Fixed, Native, Sum};
use crate::cpu::vm::{Factor, Grid, LINE_AXIS, PLANE_AXES, tv_factors};
use burn::cubecl::{self, prelude::*};

type F4 = Vector<f32, Const<4>>;

const UNITS: u32 = 256;

/// Maximum number of groups of a launch whose threads loop over items.
const GROUPS: usize = 4096;

/// Number of groups that compute the bound on fixed-point sums.
const BOUNDING: usize = 64;

/// Offsets in the words of a grid: number of vertices (3), first vector of each plane (3) and of
/// each line (3).
const PLANES: usize = 3;
const LINES: usize = 6;

/// Marks a channel on the device that is padding, with no channel on the CPU.
pub(super) const NONE: u32 = u32::MAX;

/// Position of a sample in a term's plane and line; offsets count vectors of four channels.
#[derive(CubeType)]
pub(super) struct Term {
    plane: usize,
    pitch: usize,
    line: usize,
    x: f32,
    y: f32,
    z: f32,
}

/// Position of a coordinate between two vertices.
#[derive(CubeType)]
struct Interval {
    below: usize,
    frac: f32,
}

/// Returns the position of sample `s` between the vertices of an axis.
#[cube]
fn interval(words: &[u32], place: &[f32], plane: usize, s: usize, #[comptime] axis: usize) -> Interval {
    let v = place[axis * plane + s];
    let below = min(u32::cast_from(v), words[axis] - 2);
    Interval { below: below as usize, frac: v - f32::cast_from(below) }
}

/// Returns the position of sample `s` in term `i`.
#[cube]
pub(super) fn term(
    words: &[u32],
    place: &[f32],
    s: usize,
    #[comptime] i: usize,
    #[comptime] quads: usize,
) -> Term {
    let plane = place.len() / 3;
    let x = interval(words, place, plane, s, comptime!(PLANE_AXES[i].0));
    let y = interval(words, place, plane, s, comptime!(PLANE_AXES[i].1));
    let z = interval(words, place, plane, s, comptime!(LINE_AXIS[i]));
    let width = words[comptime!(PLANE_AXES[i].0)] as usize;
    Term {
        plane: words[comptime!(PLANES + i)] as usize + (y.below * width + x.below) * quads,
        pitch: width * quads,
        line: words[comptime!(LINES + i)] as usize + z.below * quads,
        x: x.frac,
        y: y.frac,
        z: z.frac,
    }
}

/// Interpolates the product of plane and line for four channels.
#[cube]
pub(super) fn looked_up(values: &[F4], t: &Term, q: usize, #[comptime] quads: usize) -> F4 {
    let p = t.plane + q;
    let (x, y) = (t.x, t.y);
    let (u, v) = (1.0f32 - x, 1.0f32 - y);
    let below = values[p] * F4::new(u * v) + values[p + quads] * F4::new(x * v);
    let above = values[p + t.pitch] * F4::new(u * y) + values[p + t.pitch + quads] * F4::new(x * y);
    let low = values[t.line + q];
    (below + above) * (low + (values[t.line + quads + q] - low) * F4::new(t.z))
}

/// Writes the feature of each sample: the sum of products over terms and channels.
#[cube(launch)]
fn gather(
    values: &[F4],
    words: &[u32],
    place: &[f32],
    count: &[u32],
    feature: &mut [f32],
    #[comptime] quads: [usize; 3],
) {
    for s in range_stepped(ABSOLUTE_POS, count[0] as usize, CUBE_COUNT * UNITS as usize) {
        let mut sum = 0.0f32;
        #[unroll]
        for i in 0..3usize {
            if comptime!(quads[i] > 0) {
                let t = term(words, place, s, i, comptime!(quads[i]));
                for q in 0..comptime!(quads[i]) {
                    let v = looked_up(values, &t, q, comptime!(quads[i]));
                    sum += v.extract(0usize) + v.extract(1usize) + (v.extract(2usize) + v.extract(3usize));
                }
            }
        }
        feature[s] = sum;
    }
}

/// Returns the number of samples from `from` on, at most `limit`.
#[cube]
fn remaining(count: &[u32], from: u32, limit: u32) -> usize {
    min(max(count[0], from) - from, limit) as usize
}

/// Adds gradients of samples to planes and lines. Each thread handles one channel of a sample at a
/// time.
#[cube(launch)]
fn scatter<S: Sum>(
    gradient: &[Atomic<S::Word>],
    values: &[f32],
    words: &[u32],
    place: &[f32],
    index: &[u32],
    count: &[u32],
    g: &[f32],
    units: &[f32],
    from: u32,
    limit: u32,
    #[comptime] quads: [usize; 3],
    #[comptime] by_channel: bool,
) {
    let channels = comptime!(4 * (quads[0] + quads[1] + quads[2]));
    let items = remaining(count, from, limit) * channels;
    for item in range_stepped(ABSOLUTE_POS, items, CUBE_COUNT * UNITS as usize) {
        let (n, c) = (item / channels, item % channels);
        let s = if by_channel { index[from as usize + n] as usize } else { n };
        let g_sample = if by_channel { g[item] } else { g[n] };
        // a gradient of exactly zero needs no scatter
        if g_sample != 0.0f32 {
            #[unroll]
            for i in 0..3usize {
                let first = comptime!(4 * quads[..i].iter().sum::<usize>());
                let next = comptime!(4 * quads[i]);
                if c >= first && c < comptime!(first + next) {
                    let t = term(words, place, s, i, comptime!(quads[i]));
                    let p = 4 * t.plane + c - first;
                    let q = p + 4 * t.pitch;
                    let l = 4 * t.line + c - first;
                    let (u, v) = (1.0f32 - t.x, 1.0f32 - t.y);
                    let (w0, w1, w2, w3) = (u * v, t.x * v, u * t.y, t.x * t.y);
                    let plane =
                        values[p] * w0 + values[p + next] * w1 + values[q] * w2 + values[q + next] * w3;
                    let low = values[l];
                    let line = (low + (values[l + next] - low) * t.z) * g_sample;
                    let plane = plane * g_sample;
                    S::add(&gradient[p], line * w0, units[0]);
                    S::add(&gradient[p + next], line * w1, units[0]);
                    S::add(&gradient[q], line * w2, units[0]);
                    S::add(&gradient[q + next], line * w3, units[0]);
                    S::add(&gradient[l], plane * (1.0f32 - t.z), units[1]);
                    S::add(&gradient[l + next], plane * t.z, units[1]);
                }
            }
        }
    }
}

/// Returns the maximum of 256 values if `largest` is set, else their sum, to thread 0.
#[cube]
fn reduced(shared: &mut [f32], value: f32, #[comptime] largest: bool) -> f32 {
    sync_cube();
    shared[UNIT_POS as usize] = value;
    sync_cube();
    let mut result = 0.0f32;
    if UNIT_POS == 0 {
        for i in 0..UNITS as usize {
            result = if largest { max(result, shared[i]) } else { result + shared[i] };
        }
    }
    result
}

/// Writes for each group the sum of its samples' largest gradients, and the largest value of its
/// part of planes and of lines.
#[cube(launch)]
fn bound(
    values: &[f32],
    words: &[u32],
    count: &[u32],
    g: &[f32],
    partial: &mut [f32],
    from: u32,
    limit: u32,
    #[comptime] width: usize,
) {
    let mut sum = 0.0f32;
    let samples = remaining(count, from, limit);
    for n in range_stepped(ABSOLUTE_POS, samples, CUBE_COUNT * UNITS as usize) {
        let mut largest = 0.0f32;
        for c in 0..width {
            largest = max(largest, g[n * width + c].abs());
        }
        sum += largest;
    }
    let mut plane = 0.0f32;
    let mut line = 0.0f32;
    let lines = 4 * words[LINES] as usize;
    // most chunks of a list with capacity for all samples are empty, and need no bound
    let end = select(samples > 0, values.len(), 0usize);
    for i in range_stepped(ABSOLUTE_POS, end, CUBE_COUNT * UNITS as usize) {
        let v = values[i].abs();
        plane = max(plane, select(i < lines, v, 0.0f32));
        line = max(line, select(i < lines, 0.0f32, v));
    }
    let mut shared = Shared::<[f32]>::new_slice(UNITS as usize);
    let sum = reduced(&mut shared, sum, false);
    let plane = reduced(&mut shared, plane, true);
    let line = reduced(&mut shared, line, true);
    if UNIT_POS == 0 {
        partial[CUBE_POS] = sum;
        partial[BOUNDING + CUBE_POS] = plane;
        partial[2 * BOUNDING + CUBE_POS] = line;
    }
}

/// Writes the scale of the fixed-point sums, the number of integer steps per 1: of planes, whose
/// gradients are multiplied by lines, and of lines.
#[cube(launch)]
fn fixed_point_scales(partial: &[f32], units: &mut [f32]) {
    if ABSOLUTE_POS == 0 {
        let mut sum = 0.0f32;
        let mut plane = 0.0f32;
        let mut line = 0.0f32;
        for i in 0..BOUNDING {
            sum += partial[i];
            plane = max(plane, partial[BOUNDING + i]);
            line = max(line, partial[2 * BOUNDING + i]);
        }
        // the lower bound keeps the scale finite if nothing is added
        units[0] = FIXED_POINT_RANGE / max(sum * line, 1e-28f32);
        units[1] = FIXED_POINT_RANGE / max(sum * plane, 1e-28f32);
    }
}

/// Adds the fixed-point sums as floats to the gradient and resets them to zero, if the step had
/// samples from `from` on.
#[cube(launch)]
fn flush_fixed_point(
    fixed_sums: &mut [i32],
    words: &[u32],
    units: &[f32],
    count: &[u32],
    gradient: &mut [f32],
    from: u32,
) {
    let i = ABSOLUTE_POS;
    if i < fixed_sums.len() && count[0] > from {
        let unit = select(i < 4 * words[LINES] as usize, units[0], units[1]);
        gradient[i] += f32::cast_from(fixed_sums[i]) / unit;
        fixed_sums[i] = 0;
    }
}

/// Adds the gradient of the planes' total variation; `factors` are those of the rows (3) and
/// columns (3) of each plane.
#[cube(launch)]
fn penalize(
    values: &[f32],
    words: &[u32],
    factors: &[f32],
    gradient: &mut [f32],
    weight: f32,
    #[comptime] quads: [usize; 3],
) {
    let at = ABSOLUTE_POS;
    if at < values.len() {
        let x = values[at];
        let mut g = 0.0f32;
        #[unroll]
        for i in 0..3usize {
            let n = comptime!(4 * quads[i]);
            let width = words[comptime!(PLANE_AXES[i].0)] as usize;
            let height = words[comptime!(PLANE_AXES[i].1)] as usize;
            let first = 4 * words[comptime!(PLANES + i)] as usize;
            let pitch = width * n;
            if comptime!(n > 0) && at >= first && at < first + height * pitch {
                let (row, column) = ((at - first) / pitch, (at - first) % pitch);
                let mut rows = 0.0f32;
                let mut columns = 0.0f32;
                if row > 0 {
                    rows += x - values[at - pitch];
                }
                if row + 1 < height {
                    rows += x - values[at + pitch];
                }
                if column >= n {
                    columns += x - values[at - n];
                }
                if column + n < pitch {
                    columns += x - values[at + n];
                }
                g = (factors[i] * rows + factors[3 + i] * columns) * weight;
            }
        }
        gradient[at] += g;
    }
}

/// Layout of a grid's planes and lines on a device. The channels of each term are padded to vectors
/// of four; padding stays zero.
pub struct DeviceGrid {
    grid: Grid,
    padded: Grid,
    words: Buffer,
    factors: Buffer,
    units: Buffer,
    partial: Buffer,
    /// Fixed-point sums of the gradient.
    fixed_sums: Option<Buffer>,
}

impl DeviceGrid {
    /// Creates the layout of a grid.
    pub fn new(device: &Device, grid: Grid) -> DeviceGrid {
        let padded = DeviceGrid::padded(grid);
        let vectors = |f: Factor| (f.start / 4) as u32;
        let mut words: Vec<u32> = grid.size.map(|n| n as u32).to_vec();
        words.extend((0..3).map(|i| vectors(padded.plane(i))));
        words.extend((0..3).map(|i| vectors(padded.line(i))));
        let tv = [0, 1, 2].map(|i| tv_factors(&grid.plane(i)).map(|k| (2.0 * k) as f32));
        let factors = [tv.map(|k| k[0]), tv.map(|k| k[1])].concat();
        let fixed = device.atomics() == Atomics::Fixed;
        DeviceGrid {
            grid,
            padded,
            words: device.upload(&words),
            factors: device.upload(&factors),
            units: device.zeros::<f32>(2),
            partial: device.scratch::<f32>(3 * BOUNDING),
            fixed_sums: fixed.then(|| device.zeros::<i32>(padded.len())),
        }
    }

    /// Returns the grid with the rank of every term padded to a multiple of four.
    pub fn padded(grid: Grid) -> Grid {
        Grid { rank: grid.rank.map(|r| r.next_multiple_of(4)), ..grid }
    }

    /// Returns the number of floats on the device.
    pub fn len(&self) -> usize {
        self.padded.len()
    }

    /// Returns the number of vectors of each term.
    pub(super) fn quads(&self) -> [usize; 3] {
        DeviceGrid::quads_of(self.grid)
    }

    /// Returns the number of vectors of each term of a grid.
    pub(super) fn quads_of(grid: Grid) -> [usize; 3] {
        grid.rank.map(|r| r.div_ceil(4))
    }

    /// Returns the sizes and offsets that kernels need for interpolation.
    pub(super) fn sizes(&self) -> &Buffer {
        &self.words
    }

    /// Returns the channel on the CPU of each channel on the device, [`NONE`] for padding.
    pub(super) fn channels(&self) -> Vec<u32> {
        let mut before = 0;
        let mut out = Vec::new();
        for (rank, padded_rank) in self.grid.rank.into_iter().zip(self.padded.rank) {
            out.extend((0..padded_rank).map(|c| if c < rank { (before + c) as u32 } else { NONE }));
            before += rank;
        }
        out
    }

    /// Iterates over planes and lines as pairs: on the CPU, on the device.
    fn pairs(&self) -> impl Iterator<Item = (Factor, Factor)> {
        let (a, b) = (self.grid, self.padded);
        let planes = (0..3).map(move |i| (a.plane(i), b.plane(i)));
        planes.chain((0..3).map(move |i| (a.line(i), b.line(i))))
    }

    /// Converts planes and lines from the layout of the CPU to that of the device, with zeros as
    /// padding.
    pub fn pad(&self, values: Vec<f32>) -> Vec<f32> {
        assert_eq!(values.len(), self.grid.len());
        if self.grid == self.padded {
            return values;
        }
        let mut out = vec![0f32; self.padded.len()];
        for (a, b) in self.pairs().filter(|(a, _)| !a.is_empty()) {
            let rows = values[a.range()].chunks(a.channels).zip(out[b.range()].chunks_mut(b.channels));
            rows.for_each(|(from, to)| to[..a.channels].copy_from_slice(from));
        }
        out
    }

    /// Converts planes and lines from the layout of the device to that of the CPU: the inverse of
    /// [`pad`](DeviceGrid::pad).
    pub fn cut(&self, values: Vec<f32>) -> Vec<f32> {
        if self.grid == self.padded {
            return values;
        }
        let mut out = Vec::with_capacity(self.grid.len());
        for (a, b) in self.pairs().filter(|(a, _)| !a.is_empty()) {
            values[b.range()].chunks(b.channels).for_each(|row| out.extend_from_slice(&row[..a.channels]));
        }
        out
    }

    /// Copies planes and lines from the layout of the CPU to the device.
    pub fn upload(&self, device: &Device, values: &[f32]) -> Buffer {
        device.upload(&self.pad(values.to_vec()))
    }

    /// Writes the features of samples, `[capacity]`: the sum over terms and channels. place: planes
    /// `[3, capacity]`, in units of vertices.
    pub fn gather(&self, device: &Device, values: &Buffer, place: &Buffer, count: &Buffer, feature: &Buffer) {
        assert!(values.word_count() == self.len() && place.word_count() == 3 * feature.word_count());
        let groups = groups(feature.word_count().div_ceil(UNITS as usize).min(GROUPS));
        launch!(device, gather::launch, groups, UNITS;
            values, self.words, place, count, feature; self.quads()
        );
    }

    /// Adds the gradients of samples to `gradient`. Without `index`, `g` is `[capacity]`, with
    /// respect to the features of [`DeviceGrid::gather`]. With it, `g` is `[limit, channels]`, with
    /// respect to the products of plane and line of samples `index[from..from + limit]`.
    pub fn scatter(
        &self,
        device: &Device,
        gradient: &Buffer,
        values: &Buffer,
        place: &Buffer,
        index: Option<(&Buffer, usize, usize)>,
        count: &Buffer,
        g: &Buffer,
    ) {
        assert!(gradient.word_count() == self.len() && values.word_count() == self.len());
        let channels = self.padded.channels();
        let (list, from, limit) = index.unwrap_or((count, 0, g.word_count()));
        if self.fixed_sums.is_some() {
            launch!(device, bound::launch, groups(BOUNDING), UNITS;
                values, self.words, count, g, self.partial;
                from as u32, limit as u32, if index.is_some() { channels } else { 1 }
            );
            let one = CubeCount::new_single();
            launch!(device, fixed_point_scales::launch, one, 1; self.partial, self.units);
        }
        let scatter = match device.atomics() {
            Atomics::Native => scatter::launch::<Native>,
            Atomics::Exchange => scatter::launch::<Exchange>,
            Atomics::Fixed => scatter::launch::<Fixed>,
        };
        launch!(device, scatter, groups((limit * channels).div_ceil(UNITS as usize).min(GROUPS)), UNITS;
            self.fixed_sums.as_ref().unwrap_or(gradient), values, self.words, place, list, count, g, self.units;
            from as u32, limit as u32, self.quads(), index.is_some()
        );
        if let Some(fixed_sums) = &self.fixed_sums {
            launch!(device, flush_fixed_point::launch, groups(self.len().div_ceil(UNITS as usize)), UNITS;
                fixed_sums, self.words, self.units, count, gradient; from as u32
            );
        }
    }

    /// Adds the gradient of the planes' total variation, times `weight`.
    pub fn penalize(&self, device: &Device, values: &Buffer, weight: f32, gradient: &Buffer) {
        if weight == 0.0 {
            return;
        }
        launch!(device, penalize::launch, groups(self.len().div_ceil(UNITS as usize)), UNITS;
            values, self.words, self.factors, gradient; weight, self.quads()
        );
    }
}
