//! The marked cells of a box, stored for rays that skip empty ones.
//!
//! The bits of cells lie by bricks of 4³, so that one word holds those around a point, and each
//! brick knows how far away the nearest one is that is not empty.

use tiface_base::geom::Ray;

/// Number of cells along the edge of a brick, a power of two.
const BRICK: usize = 4;

/// Returns x, y and z of a cell of a box.
pub(crate) fn coordinates(cell: usize, [_, ny, nz]: [usize; 3]) -> [usize; 3] {
    [cell / (ny * nz), cell / nz % ny, cell % nz]
}

/// Returns the indices of the set bits.
pub(crate) fn set_bits(bits: &[u64]) -> impl Iterator<Item = usize> {
    bits.iter().enumerate().flat_map(|(i, &word)| {
        let mut left = word;
        std::iter::from_fn(move || {
            let bit = (left != 0).then(|| 64 * i + left.trailing_zeros() as usize);
            left &= left.wrapping_sub(1);
            bit
        })
    })
}

/// Cells of a box in which rays take samples, and cells in which rays end.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Bricks {
    /// Number of cells along each axis.
    size: [usize; 3],
    /// Number of bricks along each axis.
    bricks: [usize; 3],
    /// Of each brick, a bit per cell that is occupied, in the order of cells.
    occupied: Vec<u64>,
    /// Of each brick, a bit per cell in which rays end; `[0]` if they end in none.
    ends: Vec<u64>,
    /// Of each brick, the number of bricks to the nearest one with a marked cell, along the axis in
    /// which the two are farthest apart: 0 if the brick itself has one, at most 255.
    distance: Vec<u8>,
}

impl Bricks {
    /// Creates bricks from the bits of cells, whose cell `(x, y, z)` has index `(x · ny + y) · nz +
    /// z`. `ends` are the cells in which rays end, `[0]` if they end in none.
    pub fn new(size: [usize; 3], occupied: &[u64], ends: &[u64]) -> Bricks {
        assert!(size.iter().all(|&n| n > 0 && n < 1 << 24), "cells of an axis are counted in f32");
        let bricks = size.map(|n| n.div_ceil(BRICK));
        let count = bricks.iter().product();
        let words = |bits: &[u64]| {
            let mut words = vec![0u64; count];
            for i in set_bits(bits) {
                let [x, y, z] = coordinates(i, size);
                let brick = (x / BRICK * bricks[1] + y / BRICK) * bricks[2] + z / BRICK;
                words[brick] |= 1 << ((x % BRICK * BRICK + y % BRICK) * BRICK + z % BRICK);
            }
            words
        };
        let occupied = words(occupied);
        let ends = if ends.iter().any(|word| *word != 0) { words(ends) } else { Vec::new() };
        let marked = |i: usize| occupied[i] != 0 || ends.get(i).is_some_and(|word| *word != 0);
        let distance = distances(bricks, (0..count).map(marked));
        Bricks { size, bricks, occupied, ends, distance }
    }
}

/// Returns, of each cell of a box, the number of cells to the nearest one that is `marked`, along
/// the axis in which the two are farthest apart, at most 255.
///
/// One pass from each end of the box finds them (Borgefors 1986, "Distance transformations in
/// digital images").
fn distances(size: [usize; 3], marked: impl Iterator<Item = bool>) -> Vec<u8> {
    let mut distance: Vec<u8> = marked.map(|marked| if marked { 0 } else { u8::MAX }).collect();
    let near = |at: usize, count: usize| at.saturating_sub(1)..(at + 2).min(count);
    let mut visit = |i: usize| {
        let [x, y, z] = coordinates(i, size);
        if distance[i] == 0 {
            return;
        }
        for u in near(x, size[0]) {
            for v in near(y, size[1]) {
                for w in near(z, size[2]) {
                    let beside = distance[(u * size[1] + v) * size[2] + w].saturating_add(1);
                    distance[i] = distance[i].min(beside);
                }
            }
        }
    };
    let count = size.iter().product();
    (0..count).for_each(&mut visit);
    (0..count).rev().for_each(visit);
    distance
}

/// Number of points of a ray that are looked at together.
pub(crate) const POINTS: usize = 8;

/// Positions of points along an axis.
type Positions = [f32; POINTS];

/// What a ray finds at [`POINTS`] successive points, a bit each.
pub(crate) struct Found {
    /// Points in occupied cells.
    pub occupied: u32,
    /// Points in cells in which rays end.
    pub ends: u32,
    /// Number of steps from the first point to the next one that may be marked, if none of these
    /// is.
    pub steps: i32,
}

/// Walks along a ray through bricks.
pub(crate) struct BrickWalk {
    origin: [f32; 3],
    direction: [f32; 3],
    /// Lower corner of the box.
    low: [f32; 3],
    /// Cells per unit of length.
    scale: [f32; 3],
    /// Number of cells.
    size: [i32; 3],
    /// Steps per cell; 0 along an axis that the ray does not move along.
    steps: [f32; 3],
    /// Infinity along an axis that the ray does not move along, else 0.
    never: [f32; 3],
}

impl BrickWalk {
    /// Prepares a ray whose points are `step` apart for the bricks of a box.
    #[inline(always)]
    pub fn new(bricks: &Bricks, [low, high]: [[f32; 3]; 2], ray: &Ray, step: f32) -> BrickWalk {
        let (origin, direction) = (ray.origin.to_array(), ray.direction.to_array());
        let (mut size, mut scale) = ([0; 3], [0f32; 3]);
        let (mut steps, mut never) = ([0f32; 3], [f32::INFINITY; 3]);
        for a in 0..3 {
            size[a] = bricks.size[a] as i32;
            scale[a] = bricks.size[a] as f32 / (high[a] - low[a]);
            if direction[a] != 0.0 {
                (steps[a], never[a]) = (1.0 / (direction[a] * scale[a] * step), 0.0);
            }
        }
        BrickWalk { origin, direction, low, scale, size, steps, never }
    }

    /// Returns what the ray finds at successive points `t`; outside of the box, empty cells.
    #[inline(always)]
    pub fn find(&self, bricks: &Bricks, t: &Positions) -> Found {
        // one type of number per loop, so that the compiler vectorizes it
        let mut g = [[0f32; POINTS]; 3];
        let mut outside = [0f32; POINTS];
        let (mut brick, mut bit) = ([0i32; POINTS], [0i32; POINTS]);
        for a in 0..3 {
            let top = self.size[a] as f32;
            let mut cell = [0i32; POINTS];
            for i in 0..POINTS {
                g[a][i] = (self.origin[a] + t[i] * self.direction[a] - self.low[a]) * self.scale[a];
            }
            for i in 0..POINTS {
                outside[i] = outside[i].max(-g[a][i]).max(g[a][i] - top);
            }
            for i in 0..POINTS {
                // SAFETY: the bounds keep positions far outside the box, and NaN, in the range of
                // i32, as the number of cells is.
                cell[i] = unsafe { g[a][i].max(0.0).min(top - 1.0).to_int_unchecked() };
            }
            for i in 0..POINTS {
                brick[i] = brick[i] * bricks.bricks[a] as i32 + (cell[i] >> BRICK.ilog2());
                bit[i] = bit[i] * BRICK as i32 + (cell[i] & (BRICK as i32 - 1));
            }
        }
        let mut inside = [0u32; POINTS];
        for i in 0..POINTS {
            inside[i] = u32::from(outside[i] <= 1e-3);
        }
        let (mut occupied, mut ends) = (0, 0);
        for i in 0..POINTS {
            let word = bricks.occupied[brick[i] as usize] >> bit[i];
            occupied |= (word as u32 & inside[i]) << i;
        }
        if !bricks.ends.is_empty() {
            for i in 0..POINTS {
                let word = bricks.ends[brick[i] as usize] >> bit[i];
                ends |= (word as u32 & inside[i]) << i;
            }
        }
        let mut steps = POINTS as i32;
        if occupied | ends == 0 {
            let distance = i32::from(bricks.distance[brick[POINTS - 1] as usize]);
            if distance > 0 && inside[POINTS - 1] == 1 {
                steps = POINTS as i32 - 1 + self.to_border([0, 1, 2].map(|a| g[a][POINTS - 1]), distance);
            }
        }
        Found { occupied, ends, steps }
    }

    /// Returns the number of steps from the position `g`, in cells, to the first point beyond the
    /// bricks around it that are nearer than `distance`.
    #[inline(always)]
    fn to_border(&self, g: [f32; 3], distance: i32) -> i32 {
        let mut border = f32::INFINITY;
        for a in 0..3 {
            let brick = (g[a].max(0.0) as i32).min(self.size[a] - 1) / BRICK as i32;
            let above = ((brick + distance) * BRICK as i32).min(self.size[a]);
            let below = ((brick + 1 - distance) * BRICK as i32).max(0);
            let wall = if self.direction[a] > 0.0 { above } else { below };
            border = border.min((wall as f32 - g[a]) * self.steps[a] + self.never[a]);
        }
        // slightly less than that, so that rounding cannot skip a point in the next cell
        let whole = (border - 1e-3).ceil().clamp(1.0, 1e9);
        whole as i32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn set_bits_are_counted_from_the_lowest_of_the_first_word() {
        assert_eq!(set_bits(&[0, 1 << 63 | 5, 2]).collect::<Vec<_>>(), [64, 66, 127, 129]);
    }

    #[test]
    fn distances_are_those_of_the_nearest_marked_cell() {
        let size = [5, 9, 7];
        let cells: Vec<[usize; 3]> = (0..315).map(|i| [i / 63, i / 7 % 9, i % 7]).collect();
        let marked = |i: &usize| i.wrapping_mul(2_654_435_761) % 97 == 3;
        let all: Vec<[usize; 3]> = (0..315).filter(marked).map(|i| cells[i]).collect();
        assert!((2..8).contains(&all.len()));
        let found = distances(size, (0..315).map(|i| marked(&i)));
        for (cell, found) in cells.iter().zip(found) {
            let apart = |to: &[usize; 3]| (0..3).map(|a| cell[a].abs_diff(to[a])).max();
            assert_eq!(Some(usize::from(found)), all.iter().filter_map(apart).min(), "{cell:?}");
        }
        assert!(distances(size, (0..315).map(|_| false)).iter().all(|d| *d == 255));
    }
}
