//! Sets of cells of a cube: the visual hull, and the cells of a field that may contain surface.

use super::Aabb;
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// A set of the cells of a cubic grid, one bit per cell. Cell `(x, y, z)` of a grid of `R³` cells
/// has index `(x · R + y) · R + z`; bits of a word are counted from the lowest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BitGrid {
    /// Cells per axis.
    pub resolution: usize,
    /// `⌈R³ / 64⌉` words; bits after the last cell are zero.
    pub bits: Vec<u64>,
}

impl BitGrid {
    /// Returns a grid whose cells are all marked or all unmarked.
    pub fn filled(resolution: usize, marked: bool) -> BitGrid {
        let words = resolution.pow(3).div_ceil(64);
        BitGrid { resolution, bits: vec![if marked { u64::MAX } else { 0 }; words] }.with_padding_cleared()
    }

    /// Creates a grid from its words, one bit per cell. Returns `None` if their number does not fit
    /// the resolution.
    pub fn from_words(resolution: usize, bits: Vec<u64>) -> Option<BitGrid> {
        let fits = bits.len() == resolution.pow(3).div_ceil(64);
        fits.then(|| BitGrid { resolution, bits }.with_padding_cleared())
    }

    /// Creates a grid from one value per cell: `[R, R, R]`.
    pub fn from_cells(resolution: usize, cells: &[bool]) -> BitGrid {
        assert_eq!(cells.len(), resolution.pow(3));
        let mut grid = BitGrid::filled(resolution, false);
        (0..cells.len()).filter(|&i| cells[i]).for_each(|i| grid.set(i, true));
        grid
    }

    /// Clears the bits after the last cell.
    fn with_padding_cleared(mut self) -> BitGrid {
        let used_bits = self.resolution.pow(3) % 64;
        if let (Some(last), 1..) = (self.bits.last_mut(), used_bits) {
            *last &= (1 << used_bits) - 1;
        }
        self
    }

    /// Returns whether cell `i` is marked.
    #[inline(always)]
    pub fn get(&self, i: usize) -> bool {
        self.bits[i >> 6] >> (i & 63) & 1 == 1
    }

    /// Sets whether cell `i` is marked.
    #[inline]
    pub fn set(&mut self, i: usize, marked: bool) {
        let bit = 1 << (i & 63);
        if marked {
            self.bits[i >> 6] |= bit;
        } else {
            self.bits[i >> 6] &= !bit;
        }
    }

    /// Returns whether a point is in a marked cell of the grid over [-1, 1]³.
    #[inline]
    pub fn contains(&self, point: Vec3) -> bool {
        if !Aabb::SCENE.contains(point) {
            return false;
        }
        let r = self.resolution;
        let cell = (point + 1.0) * 0.5 * r as f32;
        let [x, y, z] = cell.to_array().map(|c| (c as usize).min(r - 1));
        self.get((x * r + y) * r + z)
    }

    /// Returns a grid in which every cell that touches a marked one, at a face, edge or corner, is
    /// marked too.
    pub fn grown(&self) -> BitGrid {
        let n = self.resolution;
        let cells: Vec<bool> = (0..n * n * n).map(|i| self.get(i)).collect();
        BitGrid::from_cells(n, &dilated_cells(&cells, [n; 3]))
    }

    /// Returns the number of marked cells.
    pub fn count(&self) -> usize {
        self.bits.iter().map(|word| word.count_ones() as usize).sum()
    }
}

/// Returns a copy in which every cell with a marked cell among its 26 neighbors is marked too. Cell
/// `(x, y, z)` has index `(x · ny + y) · nz + z`. The axes are dilated one after the other, which
/// is equivalent.
pub fn dilated_cells(cells: &[bool], size: [usize; 3]) -> Vec<bool> {
    let strides = [size[1] * size[2], size[2], 1];
    let mut marked = cells.to_vec();
    for a in 0..3 {
        let previous = marked.clone();
        marked.par_chunks_mut(strides[0]).enumerate().for_each(|(x, out)| {
            for (i, v) in out.iter_mut().enumerate() {
                let at = x * strides[0] + i;
                let k = [x, i / size[2], i % size[2]][a];
                *v = previous[at]
                    || k > 0 && previous[at - strides[a]]
                    || k + 1 < size[a] && previous[at + strides[a]];
            }
        });
    }
    marked
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grids_have_no_bits_after_the_last_cell() {
        // 27 cells in a word of 64
        let full = BitGrid::filled(3, true);
        assert_eq!((full.count(), full.bits[0]), (27, (1 << 27) - 1));
        assert_eq!(BitGrid::from_words(3, vec![u64::MAX]), Some(full));
        assert_eq!(BitGrid::from_words(4, vec![u64::MAX]).unwrap().count(), 64);
        assert!(BitGrid::from_words(3, vec![0; 2]).is_none() && BitGrid::from_words(5, vec![0]).is_none());
    }

    #[test]
    fn a_point_is_in_the_cell_around_it() {
        // cells of edge 0.5: (0.1, -0.9, 0.6) lies in cell (2, 0, 3), of index (2 · 4 + 0) · 4 + 3
        let mut cells = vec![false; 64];
        cells[35] = true;
        let grid = BitGrid::from_cells(4, &cells);
        assert!(grid.get(35) && grid.count() == 1);
        assert!(grid.contains(Vec3::new(0.1, -0.9, 0.6)) && !grid.contains(Vec3::new(-0.1, -0.9, 0.6)));
        // the upper faces belong to the last cells, and nothing lies beyond
        assert!(grid.contains(Vec3::new(0.1, -0.9, 1.0)) && !grid.contains(Vec3::new(0.1, -0.9, 1.1)));
    }
}
