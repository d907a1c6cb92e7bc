//! The marked cells of a box, stored for rays that skip empty ones.
//!
//! The bits of cells lie by bricks of 4³, so that one word holds those around a point, and each
//! brick knows how far away the nearest one is that is not empty.

/// Number of cells along the edge of a brick.
const BRICK: usize = 4;

/// Values of the three axes, and of a fourth lane that changes nothing: four lanes are one
/// instruction.
pub(crate) type Axes = [f32; 4];

/// Returns the values of three axes with 0 in the fourth lane.
#[inline(always)]
pub(crate) fn axes([x, y, z]: [f32; 3]) -> Axes {
    [x, y, z, 0.0]
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
        let bricks = size.map(|n| n.div_ceil(BRICK));
        let count = bricks.iter().product();
        let words = |bits: &[u64]| {
            let mut words = vec![0u64; count];
            for i in set_bits(bits) {
                let [x, y, z] = [i / (size[1] * size[2]), i / size[2] % size[1], i % size[2]];
                let brick = (x / BRICK * bricks[1] + y / BRICK) * bricks[2] + z / BRICK;
                words[brick] |= 1 << ((x % BRICK * BRICK + y % BRICK) * BRICK + z % BRICK);
            }
            words
        };
        let occupied = words(occupied);
        let ends = if ends.is_empty() { Vec::new() } else { words(ends) };
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
        let [x, y, z] = [i / (size[1] * size[2]), i / size[2] % size[1], i % size[2]];
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

/// What a ray finds at one of its points.
pub(crate) enum Found {
    /// An occupied cell.
    Occupied,
    /// A cell in which rays end.
    End,
    /// An empty cell: the number of steps to the next point that may lie in one that is not.
    Empty(i32),
}

/// What a ray needs at each of its points.
pub(crate) struct BrickWalk {
    /// Lower corner of the box.
    low: Axes,
    /// Cells per unit of length.
    scale: Axes,
    /// Number of cells.
    size: [i32; 4],
    /// Steps per cell; 0 along an axis that the ray does not move along.
    steps: Axes,
    /// Infinity along an axis that the ray does not move along, else 0.
    never: Axes,
    /// Whether the ray moves up.
    up: [bool; 4],
}

impl BrickWalk {
    /// Prepares a ray in `direction`, whose points are `step` apart, for the bricks of a box.
    #[inline(always)]
    pub fn new(bricks: &Bricks, [low, high]: [[f32; 3]; 2], direction: Axes, step: f32) -> BrickWalk {
        let (mut size, mut scale) = ([1; 4], [0f32; 4]);
        let (mut steps, mut never) = ([0f32; 4], [f32::INFINITY; 4]);
        for a in 0..3 {
            size[a] = bricks.size[a] as i32;
            scale[a] = bricks.size[a] as f32 / (high[a] - low[a]);
            if direction[a] != 0.0 {
                (steps[a], never[a]) = (1.0 / (direction[a] * scale[a] * step), 0.0);
            }
        }
        BrickWalk { low: axes(low), scale, size, steps, never, up: direction.map(|d| d > 0.0) }
    }

    /// Returns what the ray finds at `p`; outside of the box, an empty cell.
    #[inline(always)]
    pub fn find(&self, bricks: &Bricks, p: &Axes) -> Found {
        let (mut g, mut cell) = ([0f32; 4], [0i32; 4]);
        let mut outside = false;
        for a in 0..4 {
            g[a] = (p[a] - self.low[a]) * self.scale[a];
            let top = self.size[a] as f32;
            // written so that NaN is outside, too
            outside |= !(g[a] >= -1e-3 && g[a] <= top + 1e-3);
            // SAFETY: the bounds keep positions far outside the box, and NaN, in the range of i32.
            cell[a] = unsafe { g[a].max(0.0).min(top - 1.0).to_int_unchecked() };
        }
        if outside {
            return Found::Empty(1);
        }
        let mut brick = [0i32; 4];
        for a in 0..4 {
            brick[a] = cell[a] / BRICK as i32;
        }
        let [x, y, z, _] = brick.map(|b| b as usize);
        let at = (x * bricks.bricks[1] + y) * bricks.bricks[2] + z;
        let distance = i32::from(bricks.distance[at]);
        if distance == 0 {
            let [x, y, z, _] = cell.map(|c| c as usize % BRICK);
            let bit = (x * BRICK + y) * BRICK + z;
            if bricks.occupied[at] >> bit & 1 == 1 {
                return Found::Occupied;
            }
            if bricks.ends.get(at).is_some_and(|word| word >> bit & 1 == 1) {
                return Found::End;
            }
        }
        // to the border of the empty cell, or of the empty bricks around it
        let mut border = [0f32; 4];
        for a in 0..4 {
            let above = if distance == 0 { cell[a] + 1 } else { (brick[a] + distance) * BRICK as i32 };
            let below = if distance == 0 { cell[a] } else { (brick[a] + 1 - distance) * BRICK as i32 };
            let wall = if self.up[a] { above.min(self.size[a]) } else { below.max(0) };
            border[a] = (wall as f32 - g[a]) * self.steps[a] + self.never[a];
        }
        // slightly less than that, so that rounding cannot skip a point in the next cell
        let steps = border[0].min(border[1]).min(border[2]) - 1e-3;
        // SAFETY: the bounds keep the number, and NaN, in the range of i32.
        Found::Empty(unsafe { steps.ceil().max(1.0).min(1e9).to_int_unchecked() })
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
