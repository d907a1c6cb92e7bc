//! What is asked of planes and lines besides the photographs: smoothness, sparsity, orthogonality.
//!
//! ```text
//! TV(x[h, w, c]) = 2 (Σ (∂_h x)² / (c (h − 1) w) + Σ (∂_w x)² / (c h (w − 1)))    planes only
//! L1             = Σ over planes and lines of mean |x|
//! ortho          = Σ over lines of the mean |L Lᵀ| off the diagonal, L = [channels, n]
//! ```
//!
//! Chen et al. 2022, §4.4 (TV, L1); the orthogonality term is the published code's.

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
    /// Of the lines' orthogonality.
    pub ortho: f32,
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
    width: usize,
    height: usize,
    channels: usize,
    /// Factors of the gradient: TV along h and w, L1.
    k: [f32; 3],
}

/// Adds d TV / dx: 2 k (x − neighbour) for every neighbour there is.
#[inline(always)]
fn rows_body<const F: bool>(task: &mut Row) {
    let (pitch, n) = (task.width * task.channels, task.channels);
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
        if y + 1 < task.height {
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
    assert!(values.len() == grid.len() && gradient.len() == grid.len());
    let mut rest = gradient;
    if penalty.tv != 0.0 || penalty.l1 != 0.0 {
        const ROWS: usize = 16;
        let mut tasks = Vec::new();
        for i in 0..3 {
            let f = grid.plane(i);
            let (own, tail) = std::mem::take(&mut rest).split_at_mut(f.len());
            rest = tail;
            let [kh, kw] = tv_factors(&f).map(|k| (2.0 * k * penalty.tv as f64) as f32);
            let k = [kh, kw, penalty.l1 / f.len().max(1) as f32];
            let pitch = (f.width * f.channels).max(1);
            for (r, gradient) in own.chunks_mut(ROWS * pitch).enumerate() {
                tasks.push(Row {
                    plane: &values[f.range()],
                    row: r * ROWS,
                    gradient,
                    width: f.width,
                    height: f.height,
                    channels: f.channels,
                    k,
                });
            }
        }
        tasks.par_iter_mut().for_each(penalize_rows);
        for i in 0..3 {
            let f = grid.line(i);
            let (own, tail) = std::mem::take(&mut rest).split_at_mut(f.len());
            rest = tail;
            let l1 = penalty.l1 / f.len().max(1) as f32;
            for (g, x) in own.iter_mut().zip(&values[f.range()]) {
                *g += l1 * sign(*x);
            }
            if penalty.ortho != 0.0 {
                ortho_gradient(&f, &values[f.range()], penalty.ortho, own);
            }
        }
    } else if penalty.ortho != 0.0 {
        for i in 0..3 {
            let f = grid.line(i);
            ortho_gradient(&f, &values[f.range()], penalty.ortho, &mut rest[f.range()]);
        }
    }
}

/// Σ_n L[a, n] L[b, n] for all pairs of channels, `[c, c]`.
pub(super) fn gram(f: &Factor, line: &[f32]) -> Vec<f64> {
    let c = f.channels;
    let mut gram = vec![0f64; c * c];
    for v in line.chunks_exact(c.max(1)) {
        for a in 0..c {
            for b in 0..c {
                gram[a * c + b] += v[a] as f64 * v[b] as f64;
            }
        }
    }
    gram
}

fn ortho_gradient(f: &Factor, line: &[f32], weight: f32, gradient: &mut [f32]) {
    let c = f.channels;
    if c < 2 {
        return;
    }
    let gram = gram(f, line);
    let k = 2.0 * weight / (c * (c - 1)) as f32;
    for (g, v) in gradient.chunks_exact_mut(c).zip(line.chunks_exact(c)) {
        for a in 0..c {
            for b in (0..c).filter(|&b| b != a) {
                g[a] += k * sign(gram[a * c + b] as f32) * v[b];
            }
        }
    }
}
