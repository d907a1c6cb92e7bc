//! nerfacc's rule: a decaying maximum of the opacity of each cell, looked at again at random.

use super::super::device::{Buffer, Device, Words, groups, launch};
use super::super::march::prefix_sum;
use super::super::rng;
use super::super::sum::group_sum;
use super::{Occupancy, UNITS};
use crate::Result;
use crate::kernel::cpu::occupancy::{DECAY, STREAMS, WARMUP_STEPS};
use burn::cubecl::{self, prelude::*};

/// Counts the cells of each word of a mask.
#[cube(launch)]
fn tally(mask: &[u32], counts: &mut [u32]) {
    let word = ABSOLUTE_POS;
    if word < mask.len() {
        counts[word] = mask[word].count_ones();
    }
}

/// The occupied cell of a rank, where `before` says how many lie before each word of the mask.
#[cube]
fn of_rank(mask: &[u32], before: &[u32], rank: u32) -> u32 {
    // the last word with no more than `rank` before it
    let mut low = 0u32;
    let mut high = u32::cast_from(mask.len());
    while high - low > 1 {
        let middle = (low + high) / 2;
        if before[middle as usize] <= rank {
            low = middle;
        } else {
            high = middle;
        }
    }
    let mut left = mask[low as usize];
    for _ in before[low as usize]..rank {
        // without its lowest bit
        left &= left - 1;
    }
    low * 32 + left.trailing_zeros()
}

/// The cell of a draw, none of the grid's where nothing is drawn: see [`update_nerfacc`](crate::kernel::cpu::occupancy::update_nerfacc).
#[cube]
fn drawn_cell(
    mask: &[u32],
    before: &[u32],
    k: u32,
    cells: u32,
    any: &Draws,
    some: &Draws,
    #[comptime] all: bool,
) -> u32 {
    let mut cell = k;
    if !all {
        let quarter = cells / 4;
        let kept = before[mask.len()];
        if k < quarter {
            cell = rng::below(any.high, any.low, k, cells);
        } else if kept > quarter {
            cell = of_rank(mask, before, rng::below(some.high, some.low, k - quarter, kept));
        } else if k - quarter < kept {
            cell = of_rank(mask, before, k - quarter);
        } else {
            cell = u32::MAX;
        }
    }
    cell
}

/// A stream of random numbers.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
struct Draws {
    high: u32,
    low: u32,
}

/// Says of every cell which draw of it is the last one, counted from 1.
#[cube(launch)]
fn claim(mask: &[u32], before: &[u32], last: &[Atomic<u32>], cells: u32, any: Draws, some: Draws) {
    let k = u32::cast_from(ABSOLUTE_POS);
    if k < cells / 4 * 2 {
        let cell = drawn_cell(mask, before, k, cells, &any, &some, false);
        if cell < cells {
            last[cell as usize].fetch_max(k + 1);
        }
    }
}

/// A random point in the cell of each draw from `first` on.
#[cube(launch)]
fn scatter(
    mask: &[u32],
    before: &[u32],
    x: &mut [f32],
    drawn: &mut [u32],
    count: &mut [u32],
    first: u32,
    here: u32,
    resolution: u32,
    radius: f32,
    any: Draws,
    some: Draws,
    jitter: Draws,
    #[comptime] all: bool,
) {
    let s = ABSOLUTE_POS;
    let plane = x.len() / 3;
    if s < here as usize {
        let k = first + u32::cast_from(s);
        let cells = resolution * resolution * resolution;
        let cell = drawn_cell(mask, before, k, cells, &any, &some, all);
        drawn[s] = cell;
        // where nothing is drawn any point will do
        let i = select(cell < cells, cell, 0u32);
        let width = 2.0f32 * radius / f32::cast_from(resolution);
        let (a, b, c) = (i / (resolution * resolution), i / resolution % resolution, i % resolution);
        let u = rng::uniform(jitter.high, jitter.low, 3 * k);
        let v = rng::uniform(jitter.high, jitter.low, 3 * k + 1);
        let w = rng::uniform(jitter.high, jitter.low, 3 * k + 2);
        x[s] = (f32::cast_from(a) + u) * width - radius;
        x[plane + s] = (f32::cast_from(b) + v) * width - radius;
        x[2 * plane + s] = (f32::cast_from(c) + w) * width - radius;
    }
    if s == 0 {
        let mut draws = here;
        if !all {
            let quarter = resolution * resolution * resolution / 4;
            let there = quarter + min(before[mask.len()], quarter);
            draws = min(max(there, first) - first, here);
        }
        count[0] = draws;
    }
}

/// Decays the history of each cell drawn, and takes its opacity where that is more.
#[cube(launch)]
fn decay(
    opacity: &[f32],
    drawn: &[u32],
    last: &[u32],
    history: &mut [f32],
    first: u32,
    here: u32,
    scale: f32,
    #[comptime] all: bool,
) {
    let s = ABSOLUTE_POS;
    if s < here as usize {
        let cell = drawn[s] as usize;
        if cell < history.len() && (all || last[cell] == first + u32::cast_from(s) + 1) {
            history[cell] = max(DECAY * history[cell], scale * opacity[s]);
        }
    }
}

/// Sums 32 values a thread, and those of a group.
#[cube(launch)]
fn partial_sums(history: &[f32], sums: &mut [f32]) {
    let mut own = 0.0f32;
    for k in 0..32usize {
        let i = 32 * ABSOLUTE_POS + k;
        if i < history.len() {
            own += history[i];
        }
    }
    let sum = group_sum::<f32>(own, UNITS as usize);
    if UNIT_POS == 0 && CUBE_POS < sums.len() {
        sums[CUBE_POS] = sum;
    }
}

/// The mean of the history, or `most` where that is less.
#[cube(launch)]
fn mean(sums: &[f32], least: &mut [f32], cells: u32, most: f32) {
    if ABSOLUTE_POS == 0 {
        let mut sum = 0.0f32;
        for k in 0..sums.len() {
            sum += sums[k];
        }
        least[0] = min(sum / f32::cast_from(cells), most);
    }
}

/// Decides about 32 cells a thread: those with a history above `least`, `[1]`, are kept.
#[cube(launch)]
fn decide_by_history(history: &[f32], least: &[f32], last: &mut [u32], mask: &mut [u32]) {
    let word = ABSOLUTE_POS;
    if word < mask.len() {
        let least = least[0];
        let mut kept = 0u32;
        for bit in 0..32usize {
            let i = 32 * word + bit;
            if i < history.len() {
                last[i] = 0;
                if history[i] > least {
                    kept |= 1u32 << u32::cast_from(bit);
                }
            }
        }
        mask[word] = kept;
    }
}

/// nerfacc's rule for any opacity of a cell: see [`crate::kernel::cpu::occupancy::update_nerfacc`].
pub struct Nerfacc {
    history: Buffer,
    /// Cells of each word of the mask, and how many lie before it.
    counts: Buffer,
    before: Buffer,
    /// How many are marched through, which only the prefix sum needs.
    kept: Buffer,
    /// The last draw of each cell, counted from 1; 0 between updates.
    last: Buffer,
    /// Cells of the draws that are evaluated together.
    drawn: Buffer,
    sums: Buffer,
    least: Buffer,
    count: Buffer,
    threshold: f32,
}

impl Nerfacc {
    /// With the history of the cells, `[cells]`; what is above `threshold`, or above the mean where that is less, is marched
    /// through, and `capacity` cells are evaluated together.
    pub fn new(
        device: &Device,
        occupancy: &Occupancy,
        history: &[f32],
        threshold: f32,
        capacity: usize,
    ) -> Nerfacc {
        let (cells, words) = (history.len(), occupancy.mask.words());
        assert_eq!(cells, occupancy.resolution.pow(3));
        Nerfacc {
            history: device.upload(history),
            counts: device.zeros::<u32>(words),
            before: device.zeros::<u32>(words + 1),
            kept: device.zeros::<u32>(2),
            last: device.zeros::<u32>(cells),
            drawn: device.zeros::<u32>(capacity),
            sums: device.zeros::<f32>(cells.div_ceil(32 * UNITS as usize)),
            least: device.zeros::<f32>(1),
            count: device.zeros::<u32>(2),
            threshold,
        }
    }

    /// Waits for the device and returns the history of the cells.
    pub fn read(&self, device: &Device) -> Result<Vec<f32>> {
        device.fetch(&self.history)
    }

    /// Evaluates cells again before step `n`: their positions are written to `x`, planes `[3, capacity]`; `opacity` returns
    /// those of as many as its argument counts, `[capacity]`, and what they are scaled by.
    pub fn update<'a>(
        &self,
        device: &Device,
        (seed, n): (u64, u64),
        occupancy: &Occupancy,
        x: &Buffer,
        mut opacity: impl FnMut(&Buffer) -> (&'a Buffer, f32),
    ) {
        let cells = self.history.words();
        let all = n < WARMUP_STEPS;
        let [any, some, jitter] = STREAMS;
        let over = |count: usize| groups(count.div_ceil(UNITS as usize));
        let draws = |purpose: u64| {
            let [high, low] = rng::stream(seed, n << 4 | purpose);
            DrawsLaunch::new(high, low)
        };
        let draw_count = if all { cells } else { cells / 4 * 2 };
        if !all {
            let mask = &occupancy.mask;
            launch!(device, tally::launch, over(mask.words()), UNITS; mask, self.counts);
            prefix_sum(device, &self.counts, &self.before, &self.kept, cells);
            launch!(device, claim::launch, over(draw_count), UNITS;
                mask, self.before, self.last; cells as u32, draws(any), draws(some)
            );
        }
        let capacity = self.drawn.words();
        assert!(capacity <= x.words() / 3);
        for first in (0..draw_count).step_by(capacity) {
            let here = capacity.min(draw_count - first);
            launch!(device, scatter::launch, over(here), UNITS;
                occupancy.mask, self.before, x, self.drawn, self.count;
                first as u32, here as u32, occupancy.resolution as u32, occupancy.radius, draws(any),
                draws(some), draws(jitter), all
            );
            let (values, scale) = opacity(&self.count);
            launch!(device, decay::launch, over(here), UNITS;
                values, self.drawn, self.last, self.history; first as u32, here as u32, scale, all
            );
        }
        let sums = &self.sums;
        launch!(device, partial_sums::launch, groups(sums.words()), UNITS; self.history, sums);
        launch!(device, mean::launch, CubeCount::new_single(), 1;
            sums, self.least; cells as u32, self.threshold
        );
        launch!(device, decide_by_history::launch, over(occupancy.mask.words()), UNITS;
            self.history, self.least, self.last, occupancy.mask
        );
    }
}
