//! What is asked of planes and lines besides the photographs: smoothness and sparsity.
//!
//! ```text
//! TV(x[h, w, c]) = 2 (Σ (∂_h x)² / (c (h − 1) w) + Σ (∂_w x)² / (c h (w − 1)))    planes only
//! L1             = Σ over planes and lines of mean |x|
//! ```
//!
//! Chen et al. 2022, §4.4.

use super::{Factor, Grid};
use crate::dispatch;
use rayon::prelude::*;

/// Weights of the terms for one grid.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Penalty {
    /// Of the planes' total variation.
    pub tv: f32,
    /// Of the mean absolute value.
    pub l1: f32,
}

impl Penalty {
    /// Is there nothing to add?
    pub fn is_zero(&self) -> bool {
        *self == Penalty::default()
    }
}

struct Row<'a> {
    /// The whole plane, `[h, w, c]`.
    plane: &'a [f32],
    /// First row of this piece, and the gradient's rows.
    row: usize,
    gradient: &'a mut [f32],
    factor: Factor,
    /// Factors of the gradient: TV along h and w, L1.
    k: [f32; 3],
}

/// Adds d TV / dx: 2 k (x − neighbour) for every neighbour there is.
#[inline(always)]
fn rows_body<const F: bool>(task: &mut Row) {
    let (pitch, n) = (task.factor.width * task.factor.channels, task.factor.channels);
    let [kh, kw, l1] = task.k;
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
        if l1 != 0.0 {
            for i in 0..pitch {
                g[i] += l1 * sign(x[i]);
            }
        }
    }
}

dispatch! { fn penalize_rows / rows_body(task: &mut Row) }

/// −1, 0 or 1, zero for zero: the derivative torch gives |x|.
#[inline(always)]
fn sign(x: f32) -> f32 {
    f32::from(x > 0.0) - f32::from(x < 0.0)
}

/// 2 / count of differences along height and width, times two for the formula's leading factor.
pub(in crate::kernel) fn tv_factors(f: &Factor) -> [f64; 2] {
    let (h, w, c) = (f.height as f64, f.width as f64, f.channels.max(1) as f64);
    [2.0 / (c * (h - 1.0) * w), 2.0 / (c * h * (w - 1.0))]
}

/// Adds the gradient of the weighted terms to `gradient`. Both slices are laid out as `grid`.
pub fn penalize(grid: &Grid, penalty: &Penalty, values: &[f32], gradient: &mut [f32]) {
    const ROWS: usize = 16;
    assert!(values.len() == grid.len() && gradient.len() == grid.len());
    let mut tasks = Vec::new();
    for (k, (f, own)) in grid.split_mut(gradient).into_iter().enumerate() {
        let x = &values[f.range()];
        let l1 = penalty.l1 / f.len().max(1) as f32;
        if k >= 3 {
            own.iter_mut().zip(x).for_each(|(g, x)| *g += l1 * sign(*x));
            continue;
        }
        let [kh, kw] = tv_factors(&f).map(|k| (2.0 * k * penalty.tv as f64) as f32);
        let pitch = (f.width * f.channels).max(1);
        for (r, gradient) in own.chunks_mut(ROWS * pitch).enumerate() {
            tasks.push(Row { plane: x, row: r * ROWS, gradient, factor: f, k: [kh, kw, l1] });
        }
    }
    tasks.par_iter_mut().for_each(penalize_rows);
}
