//! A cube of cells: their centers, their neighbors, and sets of them.

use crate::math::{Components, components};
use glam::DVec3;

/// A cube of `n³` cells around a center.
#[derive(Clone, Copy, Debug)]
pub struct CellCube {
    /// Its middle.
    pub center: DVec3,
    /// Half of its side.
    pub half: f64,
    /// Number of cells along each axis.
    pub n: usize,
}

impl CellCube {
    /// Returns the side of a cell.
    #[inline]
    pub fn cell(&self) -> f64 {
        2.0 * self.half / self.n as f64
    }

    /// Returns the center of a cell by its indices.
    #[inline]
    pub fn cell_center(&self, x: usize, y: usize, z: usize) -> DVec3 {
        let at = |i: usize| (i as f64 + 0.5) * self.cell() - self.half;
        self.center + DVec3::new(at(x), at(y), at(z))
    }

    /// Returns where the centers of cells lie along each axis.
    pub fn centers(&self) -> [Vec<f64>; 3] {
        let at = |i: usize| (i as f64 + 0.5) * self.cell() - self.half;
        self.center.to_array().map(|center| (0..self.n).map(|i| center + at(i)).collect())
    }

    /// Returns half the diagonal of a cell.
    pub fn radius(&self) -> f64 {
        0.5 * self.cell() * 3f64.sqrt()
    }
}

/// Returns the neighbors of a cell of `n³` over faces, or over corners too.
#[inline]
pub fn cells_around([x, y, z]: [usize; 3], n: usize, corners: bool) -> impl Iterator<Item = usize> {
    let span = move |v: usize| v.saturating_sub(1)..(v + 2).min(n);
    span(x).flat_map(move |u| span(y).flat_map(move |v| span(z).map(move |w| (u, v, w)))).filter_map(
        move |(u, v, w)| {
            let steps = u.abs_diff(x) + v.abs_diff(y) + w.abs_diff(z);
            (steps == 1 || (corners && steps > 1)).then_some((u * n + v) * n + w)
        },
    )
}

/// Removes every 26-connected component smaller than `share` of the largest one; returns how many
/// cells it removed.
pub fn drop_small_components(kept: &mut [bool], n: usize, share: f64) -> usize {
    let Components { label, size } =
        components(kept, |i| cells_around([i / (n * n), i / n % n, i % n], n, true));
    let least = share * size.iter().copied().max().unwrap_or(0) as f64;
    let mut dropped = 0;
    for (cell, &id) in kept.iter_mut().zip(&label) {
        if *cell && (size[id as usize] as f64) < least {
            *cell = false;
            dropped += 1;
        }
    }
    dropped
}

/// Lowest and highest index of the cells kept along each axis; `None` without any.
pub fn extent_of_cells(kept: &[bool], n: usize) -> Option<[(usize, usize); 3]> {
    let mut found = [(usize::MAX, 0); 3];
    for (i, _) in kept.iter().enumerate().filter(|(_, k)| **k) {
        for (axis, v) in [i / (n * n), i / n % n, i % n].into_iter().enumerate() {
            found[axis] = (found[axis].0.min(v), found[axis].1.max(v));
        }
    }
    (found[0].0 != usize::MAX).then_some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dust_is_dropped_and_the_large_piece_stays() {
        let n = 5;
        let mut kept = vec![false; n * n * n];
        for i in 0..50 {
            kept[i] = true; // two full slabs
        }
        kept[n * n * n - 1] = true;
        assert_eq!(drop_small_components(&mut kept, n, 0.05), 1);
        assert_eq!(kept.iter().filter(|k| **k).count(), 50);
        assert_eq!(extent_of_cells(&kept, n), Some([(0, 1), (0, 4), (0, 4)]));
        assert_eq!(extent_of_cells(&[false; 8], 2), None);
    }
}
