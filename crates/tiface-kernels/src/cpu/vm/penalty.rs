//! Total variation of the planes, a smoothness regularizer.
//!
//! ```text
//! TV(x[h, w, c]) = 2 (Σ (∂_h x)² / (c (h − 1) w) + Σ (∂_w x)² / (c h (w − 1)))
//! ```
//!
//! Chen et al. 2022, §4.4.

use super::{Factor, Grid};
use rayon::prelude::*;
use tiface_base::dispatch;

/// Some rows of a plane, for one task.
struct RowsTask<'a> {
    /// The whole plane, `[h, w, c]`.
    plane: &'a [f32],
    /// First row of the task.
    row: usize,
    /// Gradient of the rows of the task.
    gradient: &'a mut [f32],
    factor: Factor,
    /// Factors of the gradient along h and w.
    k: [f32; 2],
}

/// Adds the gradient of TV: k (x − neighbor) for every neighbor, where `k` includes the factor 2 of
/// the square's derivative.
#[inline(always)]
fn rows_body<const F: bool>(task: &mut RowsTask) {
    let (pitch, n) = (task.factor.width * task.factor.channels, task.factor.channels);
    let [kh, kw] = task.k;
    for (r, g) in task.gradient.chunks_exact_mut(pitch).enumerate() {
        let y = task.row + r;
        let x = &task.plane[y * pitch..][..pitch];
        if y > 0 {
            let up = &task.plane[(y - 1) * pitch..][..pitch];
            for i in 0..pitch {
                g[i] += kh * (x[i] - up[i]);
            }
        }
        if y + 1 < task.factor.height {
            let down = &task.plane[(y + 1) * pitch..][..pitch];
            for i in 0..pitch {
                g[i] += kh * (x[i] - down[i]);
            }
        }
        for i in n..pitch {
            g[i] += kw * (x[i] - x[i - n]);
        }
        for i in 0..pitch - n {
            g[i] += kw * (x[i] - x[i + n]);
        }
    }
}

dispatch! { fn penalize_rows / rows_body(task: &mut RowsTask) }

/// Returns the factors of the sums of squared differences along height and width in the formula: 2
/// / count.
pub(crate) fn tv_factors(f: &Factor) -> [f64; 2] {
    let (h, w, c) = (f.height as f64, f.width as f64, f.channels.max(1) as f64);
    [2.0 / (c * (h - 1.0) * w), 2.0 / (c * h * (w - 1.0))]
}

/// Adds the gradient of the planes' total variation, times `weight`, to `gradient`. Both slices are
/// laid out as `grid`.
pub fn penalize(grid: &Grid, weight: f32, values: &[f32], gradient: &mut [f32]) {
    const ROWS: usize = 16;
    assert!(values.len() == grid.len() && gradient.len() == grid.len());
    let mut tasks = Vec::new();
    for (f, plane_gradient) in grid.split_mut(gradient).into_iter().take(3) {
        let k = tv_factors(&f).map(|k| (2.0 * k * weight as f64) as f32);
        let pitch = (f.width * f.channels).max(1);
        for (r, gradient) in plane_gradient.chunks_mut(ROWS * pitch).enumerate() {
            tasks.push(RowsTask { plane: &values[f.range()], row: r * ROWS, gradient, factor: f, k });
        }
    }
    tasks.par_iter_mut().for_each(penalize_rows);
}
