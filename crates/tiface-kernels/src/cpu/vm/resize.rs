//! Resampling and cropping of planes and lines.

use super::{Factor, Grid, LINE_AXIS, PLANE_AXES};
use rayon::prelude::*;

/// Returns planes and lines, resampled to another number of vertices over the same box:
/// interpolation is linear and corners keep their values (torch's `interpolate` with
/// `align_corners`).
pub fn resized(from: &Grid, values: &[f32], to: &Grid) -> Vec<f32> {
    assert!(values.len() == from.len() && from.rank == to.rank);
    let mut out = vec![0f32; to.len()];
    for (a, (b, factor)) in from.factors().iter().zip(to.split_mut(&mut out)) {
        resize(a, &values[a.range()], &b, factor);
    }
    out
}

/// Returns the position of vertex `i` of `to` vertices among `from` vertices: the index of the
/// vertex below, and the fraction of the way to the next.
fn interpolation(i: usize, from: usize, to: usize) -> (usize, f32) {
    if from < 2 || to < 2 {
        return (0, 0.0);
    }
    let x = i as f64 * (from - 1) as f64 / (to - 1) as f64;
    let below = (x as usize).min(from - 2);
    (below, (x - below as f64) as f32)
}

fn resize(a: &Factor, x: &[f32], b: &Factor, out: &mut [f32]) {
    let n = a.channels;
    if n == 0 {
        return;
    }
    out.par_chunks_mut(b.width * n).enumerate().for_each(|(y, row)| {
        let (y0, fy) = interpolation(y, a.height, b.height);
        let y1 = (y0 + 1).min(a.height - 1);
        for (k, out) in row.chunks_exact_mut(n).enumerate() {
            let (x0, fx) = interpolation(k, a.width, b.width);
            let x1 = (x0 + 1).min(a.width - 1);
            let at = |y: usize, k: usize| &x[(y * a.width + k) * n..][..n];
            let (p, q, r, s) = (at(y0, x0), at(y0, x1), at(y1, x0), at(y1, x1));
            for c in 0..n {
                let (top, bottom) = (p[c] + fx * (q[c] - p[c]), r[c] + fx * (s[c] - r[c]));
                out[c] = top + fy * (bottom - top);
            }
        }
    });
}

/// Returns the grid of the vertices `low..high` along each axis, and its planes and lines.
pub fn cropped(from: &Grid, values: &[f32], low: [usize; 3], high: [usize; 3]) -> (Grid, Vec<f32>) {
    let to = Grid { size: std::array::from_fn(|a| high[a] - low[a]), rank: from.rank };
    let mut out = Vec::with_capacity(to.len());
    for (k, f) in from.factors().iter().enumerate() {
        let (w, h) = if k < 3 { PLANE_AXES[k] } else { (LINE_AXIS[k - 3], usize::MAX) };
        let rows = if k < 3 { low[h]..high[h] } else { 0..1 };
        for y in rows {
            let row = &values[f.start + y * f.width * f.channels..][..f.width * f.channels];
            out.extend_from_slice(&row[low[w] * f.channels..high[w] * f.channels]);
        }
    }
    debug_assert_eq!(out.len(), to.len());
    (to, out)
}
