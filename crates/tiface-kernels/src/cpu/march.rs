//! Ray marching through an occupancy bitmask, on a fixed lattice of steps.
//!
//! All samples of a ray lie on one lattice of pitch `step` (as in nerfacc 0.3.3): empty cells are
//! skipped by whole steps, so that positions do not depend on which cells happen to be empty.

use rayon::prelude::*;
use tiface_base::geom::{BitGrid, Ray};

/// Returns the part of a step, 0..1, by which the sample lattice of a ray is shifted: `jitter` has
/// one a ray, or none at all, which stands for 0.
#[inline(always)]
pub(crate) fn shift(jitter: &[f32], ray: usize) -> f32 {
    jitter.get(ray).copied().unwrap_or(0.0)
}

/// The samples of a batch of rays, sorted by ray and then by `t`.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// `[rays + 1]`: ray `r` owns samples `offsets[r]..offsets[r + 1]`.
    pub offsets: Vec<i32>,
    /// `[samples]` midpoints.
    pub t: Vec<f32>,
}

impl Samples {
    /// Returns positions and directions of the samples of the batch's rays.
    pub fn points(&self, rays: &[Ray]) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
        let (mut points, mut directions) = (Vec::new(), Vec::new());
        self.points_into(rays, &mut points, &mut directions);
        (points, directions)
    }

    /// Replaces what the lists hold by positions and directions of the samples of the batch's rays.
    pub fn points_into(&self, rays: &[Ray], points: &mut Vec<[f32; 3]>, directions: &mut Vec<[f32; 3]>) {
        for list in [&mut *points, directions] {
            list.clear();
            list.reserve(self.t.len());
        }
        for (ray, span) in rays.iter().zip(self.offsets.windows(2)) {
            let (o, d) = (ray.origin.to_array(), ray.direction.to_array());
            for t in &self.t[span[0] as usize..span[1] as usize] {
                points.push([o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]]);
                directions.push(d);
            }
        }
    }
}

/// Number of cells along the edge of a block of cells that is skipped as a whole.
pub(crate) const BLOCK: usize = 8;

/// The blocks of `BLOCK`³ cells in which a ray may find something, one bit each, in the order of
/// cells.
struct Blocks {
    /// Blocks per axis.
    size: usize,
    bits: Vec<u64>,
}

impl Blocks {
    /// Marks the blocks with an occupied or a solid cell.
    fn new(mask: &BitGrid, solid: Option<&BitGrid>) -> Blocks {
        let n = mask.resolution;
        let size = n.div_ceil(BLOCK);
        let mut bits = vec![0u64; size.pow(3).div_ceil(64)];
        for (at, &word) in mask.bits.iter().enumerate() {
            let mut word = word | solid.map_or(0, |s| s.bits[at]);
            while word != 0 {
                let first = word.trailing_zeros() as usize;
                let cell = at * 64 + first;
                let z = cell % n;
                let block = (cell / (n * n) / BLOCK * size + cell / n % n / BLOCK) * size + z / BLOCK;
                bits[block >> 6] |= 1 << (block & 63);
                // the rest of this row of the block is marked by the same bit
                let run = (BLOCK - z % BLOCK).min(n - z);
                word &= !(((1 << run) - 1) << first);
            }
        }
        Blocks { size, bits }
    }

    /// Returns whether a block has no occupied cell.
    #[inline(always)]
    fn is_empty(&self, block: [usize; 3]) -> bool {
        let i = (block[0] * self.size + block[1]) * self.size + block[2];
        self.bits[i >> 6] >> (i & 63) & 1 == 0
    }
}

/// Marches one ray, calling `emit` with the midpoint of every step whose cell is occupied, until
/// `emit` returns false or the ray reaches a cell of `solid`. Solid cells lie so deep inside that
/// nothing beyond them is visible.
#[inline]
fn march_one(
    mask: &BitGrid,
    solid: Option<&BitGrid>,
    blocks: &Blocks,
    radius: f32,
    step: f32,
    (ray, jitter): (&Ray, f32),
    mut emit: impl FnMut(f32) -> bool,
) {
    let (origin, direction) = (ray.origin.to_array(), ray.direction.to_array());
    let (mut enter, mut leave) = (0f32, f32::INFINITY);
    for a in 0..3 {
        let (o, d) = (origin[a], direction[a]);
        if d == 0.0 {
            if o.abs() > radius {
                return;
            }
            continue;
        }
        let (p, q) = ((-radius - o) / d, (radius - o) / d);
        enter = enter.max(p.min(q));
        leave = leave.min(p.max(q));
    }
    if enter.is_nan() || leave.is_nan() || enter >= leave || !step.is_finite() || step <= 0.0 {
        return;
    }
    let r = mask.resolution as f32;
    let top = mask.resolution as i32 - 1;
    let scale = 0.5 * r / radius; // cells per unit length
    let start = enter + jitter * step;
    let inverse: [f32; 3] = std::array::from_fn(|a| 1.0 / direction[a]);
    // t = start + (k + ½) · step for integer k: computed, never accumulated
    let mut k = 0i64;
    loop {
        let t = start + (k as f32 + 0.5) * step;
        if t >= leave {
            return;
        }
        let g: [f32; 3] = std::array::from_fn(|a| (origin[a] + t * direction[a] + radius) * scale);
        // casts truncate, which is `floor` here: what is negative belongs to the first cell
        let c: [i32; 3] = std::array::from_fn(|a| (g[a] as i32).clamp(0, top));
        let cell = (c[0] as usize * mask.resolution + c[1] as usize) * mask.resolution + c[2] as usize;
        if mask.get(cell) {
            if !emit(t) {
                return;
            }
            k += 1;
            continue;
        }
        if solid.is_some_and(|solid| solid.get(cell)) {
            return;
        }
        // skip to the border of this cell, or of its block if that is empty too, by a whole number
        // of steps
        let block = c.map(|c| c as usize / BLOCK);
        let empty = blocks.is_empty(block);
        let mut border = f32::INFINITY;
        for a in 0..3 {
            if direction[a] != 0.0 {
                let ahead = usize::from(direction[a] > 0.0);
                let wall = if empty {
                    ((block[a] + ahead) * BLOCK).min(mask.resolution)
                } else {
                    c[a] as usize + ahead
                };
                border = border.min((wall as f32 - g[a]) * inverse[a]);
            }
        }
        // slightly less than a block, so that rounding cannot skip a sample of the next one
        let skip = border.max(0.0) / (scale * step) - if empty { 1e-3 } else { 0.0 };
        let whole = skip as i64;
        k += (whole + i64::from(skip > whole as f32)).max(1);
    }
}

/// Marches a batch of whole rays, of unit directions and in field units, and keeps the nearest
/// `limit` samples of each. `solid` must have the resolution of `mask`; `radius` and `step` are in
/// field units.
///
/// # Shapes
///
/// - jitter: `[rays]`, the part of a step by which each ray's samples are shifted; `[0]` for none
pub fn march(
    mask: &BitGrid,
    solid: Option<&BitGrid>,
    radius: f32,
    step: f32,
    rays: &[Ray],
    jitter: &[f32],
    limit: usize,
) -> Samples {
    /// Rays per task.
    const RAYS: usize = 256;
    assert!(jitter.is_empty() || jitter.len() == rays.len());
    assert!(solid.is_none_or(|s| s.resolution == mask.resolution));
    let blocks = Blocks::new(mask, solid);
    let per_chunk: Vec<(Vec<i32>, Vec<f32>)> = rays
        .par_chunks(RAYS)
        .enumerate()
        .map(|(task, rays)| {
            let mut counts = Vec::with_capacity(rays.len());
            let mut t = Vec::with_capacity(rays.len() * 32);
            for (r, ray) in rays.iter().enumerate() {
                let before = t.len();
                let jitter = shift(jitter, task * RAYS + r);
                march_one(mask, solid, &blocks, radius, step, (ray, jitter), |t_mid| {
                    t.push(t_mid);
                    t.len() - before < limit
                });
                counts.push((t.len() - before) as i32);
            }
            (counts, t)
        })
        .collect();
    let mut samples = Samples { offsets: vec![0], t: Vec::new() };
    let mut sum = 0;
    for (counts, t) in per_chunk {
        for c in counts {
            sum += c;
            samples.offsets.push(sum);
        }
        samples.t.extend_from_slice(&t);
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a ray down along z, near the axis.
    fn ray() -> Ray {
        Ray::new([0.03, 0.01, 2.0], [0.0, 0.0, -1.0])
    }

    #[test]
    fn a_full_box_of_edge_two_holds_twenty_steps_of_a_tenth() {
        let mask = BitGrid::filled(8, true);
        let s = march(&mask, None, 1.0, 0.1, &[ray()], &[], 1000);
        assert_eq!(s.offsets, [0, 20]);
        assert!((s.t[0] - 1.05).abs() < 1e-5 && (s.t[19] - 2.95).abs() < 1e-5);
    }

    #[test]
    fn emptying_cells_removes_samples_and_moves_none() {
        let full = BitGrid::filled(8, true);
        let mut holes = full.clone();
        for i in 0..512 {
            if i % 3 == 0 || i % 8 == 5 {
                holes.set(i, false);
            }
        }
        let ray = Ray::new([2.0, 1.7, 1.9], [-0.6, -0.48, -0.64]);
        let all = march(&full, None, 1.0, 0.02, &[ray], &[0.3], 1000).t;
        let some = march(&holes, None, 1.0, 0.02, &[ray], &[0.3], 1000).t;
        assert!(some.len() < all.len() && !some.is_empty());
        for t in &some {
            assert!(all.iter().any(|u| u == t));
        }
        // and no sample of the full march in an occupied cell is missing
        let kept = all.iter().filter(|&&t| {
            let c = |a: usize| {
                (((ray.origin[a] + t * ray.direction[a] + 1.0) * 4.0).floor() as i32).clamp(0, 7) as usize
            };
            holes.get((c(0) * 8 + c(1)) * 8 + c(2))
        });
        assert_eq!(kept.count(), some.len());
    }

    #[test]
    fn blocks_are_empty_where_no_cell_is_occupied_or_solid() {
        // 20 cells, so 3 blocks an axis, the last of 4; words begin anywhere in a row
        let (mut mask, mut solid) = (BitGrid::filled(20, false), BitGrid::filled(20, false));
        mask.set((7 * 20 + 8) * 20 + 19, true);
        mask.set((7 * 20 + 9) * 20, true);
        solid.set((19 * 20 + 15) * 20 + 9, true);
        let blocks = Blocks::new(&mask, Some(&solid));
        for i in 0..27 {
            let block = [i / 9, i / 3 % 3, i % 3];
            assert_eq!(
                !blocks.is_empty(block),
                [[0, 1, 2], [0, 1, 0], [2, 1, 1]].contains(&block),
                "{block:?}"
            );
        }
    }

    #[test]
    fn skipping_empty_blocks_loses_no_sample() {
        // 3 % of 37³ cells, so that most blocks of 8³ have one, some have none; rays through all of
        // the box
        let mut mask = BitGrid::filled(37, false);
        let draw = |i: usize| (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
        (0..37usize.pow(3)).filter(|&i| draw(i) % 1000 < 30 && i % 37 > 12).for_each(|i| mask.set(i, true));
        let mut kept = 0;
        for i in 0..200 {
            let unit = |k: usize| draw(i * 8 + k) as f32 / (1 << 24) as f32;
            let to = [unit(0) - 0.5, unit(1) - 0.5, unit(2) - 0.5];
            let from = [3.0 * unit(3) - 1.5, 3.0 * unit(4) - 1.5, 2.5 * (unit(5) - 0.5).signum()];
            let way: [f32; 3] = std::array::from_fn(|a| to[a] - from[a]);
            let length = way.iter().map(|d| d * d).sum::<f32>().sqrt();
            let (ray, jitter) = (Ray::new(from, way.map(|d| d / length)), [unit(6)]);
            let all = march(&BitGrid::filled(37, true), None, 1.0, 0.01, &[ray], &jitter, 1000).t;
            let cell = |t: f32| {
                let c = |a: usize| ((ray.origin[a] + t * ray.direction[a] + 1.0) * 18.5) as i32;
                [0, 1, 2].iter().fold(0, |i, &a| i * 37 + c(a).clamp(0, 36) as usize)
            };
            let want: Vec<f32> = all.into_iter().filter(|&t| mask.get(cell(t))).collect();
            assert_eq!(march(&mask, None, 1.0, 0.01, &[ray], &jitter, 1000).t, want);
            kept += want.len();
        }
        assert!(kept > 100, "{kept}");
    }

    #[test]
    fn a_ray_ends_at_the_first_solid_cell() {
        // the ray comes down along z through cell column (4, 4): z cells 7, 6, 5 kept, 4 solid
        let mut mask = BitGrid::filled(8, true);
        let mut solid = BitGrid::filled(8, false);
        mask.set((4 * 8 + 4) * 8 + 4, false);
        solid.set((4 * 8 + 4) * 8 + 4, true);
        let s = march(&mask, Some(&solid), 1.0, 0.1, &[ray()], &[], 1000);
        // z from 1 down to 0.25 in steps of 0.1, midpoints 0.95 … 0.25: eight of them
        assert_eq!(s.offsets, [0, 8]);
    }

    #[test]
    fn rays_that_miss_own_nothing() {
        let mask = BitGrid::filled(8, true);
        let miss = Ray::new([0.0, 0.0, 2.0], [0.0, 0.0, 1.0]);
        let outside = Ray::new([1.5, 0.0, 2.0], [0.0, 0.0, -1.0]);
        assert_eq!(march(&mask, None, 1.0, 0.1, &[miss, ray(), outside], &[], 5).offsets, [0, 0, 5, 5]);
    }
}
