//! The visual hull as a first signed distance.
//!
//! The hull is known before training and lies within millimetres of most of the head. Fitting the field
//! to its distance for a few hundred cheap steps replaces the thousands that carve a sphere, and gives
//! the occupancy grid a band from the first training step.

use crate::kernel::march::Bitmask;
use rayon::prelude::*;

/// Signed distance to a hull's boundary at cell centres, in units of the box's half edge; negative inside.
pub struct HullDistance {
    resolution: usize,
    values: Vec<f32>,
}

/// Squared distance transform of one line (Felzenszwalb, Huttenlocher 2012), in cells.
fn transform_line(f: &mut [f32], v: &mut [usize], z: &mut [f32], out: &mut [f32]) {
    let n = f.len();
    let mut k = 0;
    v[0] = 0;
    z[0] = f32::NEG_INFINITY;
    z[1] = f32::INFINITY;
    let meet = |f: &[f32], q: usize, p: usize| {
        ((f[q] + (q * q) as f32) - (f[p] + (p * p) as f32)) / (2.0 * (q as f32 - p as f32))
    };
    for q in 1..n {
        let mut s = meet(f, q, v[k]);
        while s <= z[k] {
            k -= 1;
            s = meet(f, q, v[k]);
        }
        k += 1;
        v[k] = q;
        z[k] = s;
        z[k + 1] = f32::INFINITY;
    }
    k = 0;
    for q in 0..n {
        while z[k + 1] < q as f32 {
            k += 1;
        }
        let d = q as f32 - v[k] as f32;
        out[q] = d * d + f[v[k]];
    }
    f.copy_from_slice(out);
}

/// Distance in cells from each cell's centre to the nearest centre of a cell in `seeds`.
fn distance(resolution: usize, seeds: impl Fn(usize) -> bool + Sync) -> Vec<f32> {
    let r = resolution;
    /// Larger than any squared distance on the grid, small enough to stay exact in f32.
    const FAR: f32 = 1e6;
    let mut d: Vec<f32> = (0..r * r * r).map(|i| if seeds(i) { 0.0 } else { FAR }).collect();
    let scratch = || (vec![0f32; r], vec![0usize; r], vec![0f32; r + 1], vec![0f32; r]);
    // z lines are contiguous; y and x lines within and across slabs of constant x
    d.par_chunks_mut(r * r).for_each(|slab| {
        let (mut line, mut v, mut z, mut out) = scratch();
        for row in slab.chunks_mut(r) {
            transform_line(row, &mut v, &mut z, &mut out);
        }
        for c in 0..r {
            (0..r).for_each(|y| line[y] = slab[y * r + c]);
            transform_line(&mut line, &mut v, &mut z, &mut out);
            (0..r).for_each(|y| slab[y * r + c] = line[y]);
        }
    });
    let columns: Vec<Vec<f32>> = (0..r * r)
        .into_par_iter()
        .map(|c| {
            let (mut line, mut v, mut z, mut out) = scratch();
            (0..r).for_each(|x| line[x] = d[x * r * r + c]);
            transform_line(&mut line, &mut v, &mut z, &mut out);
            line
        })
        .collect();
    for (c, column) in columns.iter().enumerate() {
        (0..r).for_each(|x| d[x * r * r + c] = column[x].sqrt());
    }
    d
}

impl HullDistance {
    /// From a hull; beyond the box counts as outside.
    pub fn new(hull: &Bitmask) -> HullDistance {
        let r = hull.resolution;
        let border = |i: usize| [i / (r * r), i / r % r, i % r].iter().any(|&c| c == 0 || c == r - 1);
        let inside = |i: usize| hull.get(i) && !border(i);
        let to_inside = distance(r, inside);
        let to_outside = distance(r, |i| !inside(i));
        let cell = 2.0 / r as f32;
        // the boundary runs half a cell before the nearest centre of the other kind
        let values = (0..r * r * r)
            .map(|i| {
                if inside(i) {
                    -(to_outside[i] - 0.5).max(0.0) * cell
                } else {
                    (to_inside[i] - 0.5).max(0.0) * cell
                }
            })
            .collect();
        HullDistance { resolution: r, values }
    }

    /// Trilinear value at a point of [-1, 1]³.
    pub fn at(&self, p: [f32; 3]) -> f32 {
        let r = self.resolution;
        let mut low = [0usize; 3];
        let mut f = [0f32; 3];
        for a in 0..3 {
            let g = ((p[a] + 1.0) * 0.5 * r as f32 - 0.5).clamp(0.0, (r - 1) as f32);
            low[a] = (g as usize).min(r - 2);
            f[a] = g - low[a] as f32;
        }
        let mut sum = 0.0;
        for k in 0..8 {
            let bit = |a: usize| k >> a & 1;
            let w: f32 = (0..3).map(|a| if bit(a) == 1 { f[a] } else { 1.0 - f[a] }).product();
            sum += w * self.values[((low[0] + bit(0)) * r + low[1] + bit(1)) * r + low[2] + bit(2)];
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distance_to_a_ball_of_cells_is_that_of_the_ball() {
        let r = 48;
        let mut hull = Bitmask::filled(r, false);
        let center =
            |i: usize| [i / (r * r), i / r % r, i % r].map(|c| (c as f32 + 0.5) / (0.5 * r as f32) - 1.0);
        let norm = |p: [f32; 3]| (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
        (0..r * r * r).for_each(|i| hull.set(i, norm(center(i)) < 0.6));
        let d = HullDistance::new(&hull);
        let cell = 2.0 / r as f32;
        // (not at the very centre, where the eight neighbours all lie nearer to the boundary)
        for p in [[0.2, 0.1, 0.0], [0.3, -0.2, 0.4], [0.0, 0.61, 0.0], [0.7, 0.7, 0.0], [-0.9, 0.1, 0.1]] {
            assert!((d.at(p) - (norm(p) - 0.6)).abs() < cell, "{p:?}: {} {}", d.at(p), norm(p) - 0.6);
        }
    }
}
