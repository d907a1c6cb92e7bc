//! nerfacc's rule: a decaying maximum of the opacity of each cell, updated at randomly drawn cells.

use super::super::device::{Buffer, Device, Words, groups, launch};
use super::super::march::prefix_sum;
use super::super::rng::{self, Wide};
use super::super::running_counts::ranked;
use super::super::sum::group_sum;
use super::{Occupancy, UNITS};
use crate::cpu::occupancy::{DECAY, STREAMS, WARMUP_STEPS};
use burn::cubecl::{self, prelude::*};
use tiface_base::Result;

/// Counts the occupied cells of each word of a mask.
#[cube(launch)]
fn tally(mask: &[u32], counts: &mut [u32]) {
    let word = ABSOLUTE_POS;
    if word < mask.len() {
        counts[word] = mask[word].count_ones();
    }
}

/// Returns the cell of draw `k`, or `u32::MAX` if the draw does not exist: see
/// [`update_nerfacc`](crate::cpu::occupancy::update_nerfacc).
#[cube]
fn drawn_cell(
    mask: &[u32],
    before: &[u32],
    k: u32,
    cells: u32,
    any_stream: &Wide,
    occupied_stream: &Wide,
    #[comptime] warmup: bool,
) -> u32 {
    let mut cell = k;
    if !warmup {
        let quarter = cells / 4;
        let kept = before[mask.len()];
        if k < quarter {
            cell = rng::below(any_stream, k, cells);
        } else if kept > quarter {
            let rank = rng::below(occupied_stream, k - quarter, kept);
            cell = ranked(before, mask, 0usize, mask.len(), rank);
        } else if k - quarter < kept {
            cell = ranked(before, mask, 0usize, mask.len(), k - quarter);
        } else {
            cell = u32::MAX;
        }
    }
    cell
}

/// Writes the number of the last draw of each cell, counted from 1, so that only one draw updates a
/// cell.
#[cube(launch)]
fn find_last_draws(
    mask: &[u32],
    before: &[u32],
    last: &[Atomic<u32>],
    cells: u32,
    any_stream: Wide,
    occupied_stream: Wide,
) {
    let k = u32::cast_from(ABSOLUTE_POS);
    if k < cells / 4 * 2 {
        let cell = drawn_cell(mask, before, k, cells, &any_stream, &occupied_stream, false);
        if cell < cells {
            last[cell as usize].fetch_max(k + 1);
        }
    }
}

/// Writes a random point in the cell of each of `batch` draws, starting at draw `first`.
#[cube(launch)]
fn sample_points(
    mask: &[u32],
    before: &[u32],
    x: &mut [f32],
    drawn: &mut [u32],
    count: &mut [u32],
    first: u32,
    batch: u32,
    resolution: u32,
    radius: f32,
    any_stream: Wide,
    occupied_stream: Wide,
    jitter_stream: Wide,
    #[comptime] warmup: bool,
) {
    let s = ABSOLUTE_POS;
    let plane = x.len() / 3;
    if s < batch as usize {
        let k = first + u32::cast_from(s);
        let cells = resolution * resolution * resolution;
        let cell = drawn_cell(mask, before, k, cells, &any_stream, &occupied_stream, warmup);
        drawn[s] = cell;
        // the point of a missing draw is not used
        let i = select(cell < cells, cell, 0u32);
        let width = 2.0f32 * radius / f32::cast_from(resolution);
        let (a, b, c) = (i / (resolution * resolution), i / resolution % resolution, i % resolution);
        let u = rng::uniform(&jitter_stream, 3 * k);
        let v = rng::uniform(&jitter_stream, 3 * k + 1);
        let w = rng::uniform(&jitter_stream, 3 * k + 2);
        x[s] = (f32::cast_from(a) + u) * width - radius;
        x[plane + s] = (f32::cast_from(b) + v) * width - radius;
        x[2 * plane + s] = (f32::cast_from(c) + w) * width - radius;
    }
    if s == 0 {
        let mut draws = batch;
        if !warmup {
            let quarter = resolution * resolution * resolution / 4;
            let total_draws = quarter + min(before[mask.len()], quarter);
            draws = min(max(total_draws, first) - first, batch);
        }
        count[0] = draws;
    }
}

/// Decays the history of each drawn cell, and raises it to the cell's opacity if that is higher.
#[cube(launch)]
fn decay(
    opacity: &[f32],
    drawn: &[u32],
    last: &[u32],
    history: &mut [f32],
    first: u32,
    batch: u32,
    scale: f32,
    #[comptime] warmup: bool,
) {
    let s = ABSOLUTE_POS;
    if s < batch as usize {
        let cell = drawn[s] as usize;
        if cell < history.len() && (warmup || last[cell] == first + u32::cast_from(s) + 1) {
            history[cell] = max(DECAY * history[cell], scale * opacity[s]);
        }
    }
}

/// Sums 32 values per thread, and then over each group.
#[cube(launch)]
fn partial_sums(history: &[f32], sums: &mut [f32]) {
    let mut thread_sum = 0.0f32;
    for k in 0..32usize {
        let i = 32 * ABSOLUTE_POS + k;
        if i < history.len() {
            thread_sum += history[i];
        }
    }
    let sum = group_sum::<f32>(thread_sum, UNITS as usize);
    if UNIT_POS == 0 && CUBE_POS < sums.len() {
        sums[CUBE_POS] = sum;
    }
}

/// Writes the threshold: the mean of the history, but at most `max_threshold`.
#[cube(launch)]
fn update_threshold(sums: &[f32], threshold: &mut [f32], cells: u32, max_threshold: f32) {
    if ABSOLUTE_POS == 0 {
        let mut sum = 0.0f32;
        for k in 0..sums.len() {
            sum += sums[k];
        }
        threshold[0] = min(sum / f32::cast_from(cells), max_threshold);
    }
}

/// Writes the mask of cells whose history is above the threshold, `[1]`; each thread handles 32
/// cells.
#[cube(launch)]
fn update_mask(history: &[f32], threshold: &[f32], last: &mut [u32], mask: &mut [u32]) {
    let word = ABSOLUTE_POS;
    if word < mask.len() {
        let threshold = threshold[0];
        let mut kept = 0u32;
        for bit in 0..32usize {
            let i = 32 * word + bit;
            if i < history.len() {
                last[i] = 0;
                if history[i] > threshold {
                    kept |= 1u32 << u32::cast_from(bit);
                }
            }
        }
        mask[word] = kept;
    }
}

/// nerfacc's rule for any opacity of a cell: see [`crate::cpu::occupancy::update_nerfacc`].
pub struct Nerfacc {
    history: Buffer,
    /// Number of occupied cells of each word of the mask.
    counts: Buffer,
    /// Number of occupied cells before each word of the mask.
    before: Buffer,
    /// Number of occupied cells, an output of the prefix sum.
    kept: Buffer,
    /// Number of the last draw of each cell, counted from 1; 0 between updates.
    last: Buffer,
    /// Cells of the current batch of draws.
    drawn: Buffer,
    sums: Buffer,
    /// `[1]`: threshold of the last update.
    device_threshold: Buffer,
    count: Buffer,
    threshold: f32,
}

impl Nerfacc {
    /// Creates the rule from the history of the cells, `[cells]`. A cell is occupied if its history
    /// is above `threshold`, or above the mean if that is less. `capacity` is the number of cells
    /// that are evaluated in one batch.
    pub fn new(
        device: &Device,
        occupancy: &Occupancy,
        history: &[f32],
        threshold: f32,
        capacity: usize,
    ) -> Nerfacc {
        let (cells, words) = (history.len(), occupancy.mask.word_count());
        assert_eq!(cells, occupancy.resolution.pow(3));
        Nerfacc {
            history: device.upload(history),
            counts: device.zeros::<u32>(words),
            before: device.zeros::<u32>(words + 1),
            kept: device.zeros::<u32>(2),
            last: device.zeros::<u32>(cells),
            drawn: device.zeros::<u32>(capacity),
            sums: device.zeros::<f32>(cells.div_ceil(32 * UNITS as usize)),
            device_threshold: device.zeros::<f32>(1),
            count: device.zeros::<u32>(2),
            threshold,
        }
    }

    /// Waits for the device and returns the history of the cells.
    pub fn read(&self, device: &Device) -> Result<Vec<f32>> {
        device.fetch(&self.history)
    }

    /// Updates the mask before step `n`. Positions of cells are written to `x`, planes
    /// `[3, capacity]`; `opacity` gets the number of positions, `[1]` or more, and returns their
    /// opacities, `[capacity]`, and a factor for them.
    pub fn update<'a>(
        &self,
        device: &Device,
        (seed, n): (u64, u64),
        occupancy: &Occupancy,
        x: &Buffer,
        mut opacity: impl FnMut(&Buffer) -> (&'a Buffer, f32),
    ) {
        let cells = self.history.word_count();
        let warmup = n < WARMUP_STEPS;
        let [any_stream, occupied_stream, jitter_stream] = STREAMS;
        let groups_for = |count: usize| groups(count.div_ceil(UNITS as usize));
        let draws = |purpose: u64| rng::stream(seed, n << 4 | purpose);
        let draw_count = if warmup { cells } else { cells / 4 * 2 };
        if !warmup {
            let mask = &occupancy.mask;
            launch!(device, tally::launch, groups_for(mask.word_count()), UNITS; mask, self.counts);
            prefix_sum(device, &self.counts, &self.before, &self.kept, cells);
            launch!(device, find_last_draws::launch, groups_for(draw_count), UNITS;
                mask, self.before, self.last; cells as u32, draws(any_stream), draws(occupied_stream)
            );
        }
        let capacity = self.drawn.word_count();
        assert!(capacity <= x.word_count() / 3);
        for first in (0..draw_count).step_by(capacity) {
            let batch = capacity.min(draw_count - first);
            launch!(device, sample_points::launch, groups_for(batch), UNITS;
                occupancy.mask, self.before, x, self.drawn, self.count;
                first as u32, batch as u32, occupancy.resolution as u32, occupancy.radius, draws(any_stream),
                draws(occupied_stream), draws(jitter_stream), warmup
            );
            let (values, scale) = opacity(&self.count);
            launch!(device, decay::launch, groups_for(batch), UNITS;
                values, self.drawn, self.last, self.history; first as u32, batch as u32, scale, warmup
            );
        }
        let sums = &self.sums;
        launch!(device, partial_sums::launch, groups(sums.word_count()), UNITS; self.history, sums);
        launch!(device, update_threshold::launch, CubeCount::new_single(), 1;
            sums, self.device_threshold; cells as u32, self.threshold
        );
        launch!(device, update_mask::launch, groups_for(occupancy.mask.word_count()), UNITS;
            self.history, self.device_threshold, self.last, occupancy.mask
        );
    }
}
