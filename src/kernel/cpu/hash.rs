//! Multiresolution hash encoding: the value, its Jacobian, and the scatter, which is the
//! backward pass of both.
//!
//! Müller, Evans, Schied, Keller 2022, "Instant Neural Graphics Primitives"; cell indexing as in
//! tiny-cuda-nn (half-cell stagger, coherent-prime hash, dense levels while they fit).
//!
//! Features lie level-major, `[level][sample][2]`: one level's table is at most a few megabytes and
//! stays in the cache while all samples pass; a random read from the whole table costs seven times as
//! much. In the scatter one task owns the gradient of one level, so it needs no atomics and its result does not depend
//! on the number of threads.

use super::simd::fma;
use crate::dispatch;
use rayon::prelude::*;

/// One resolution of the grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// Cells per unit of the [0, 1] cube: `base · b^level − 1`.
    pub scale: f32,
    /// Vertices per axis: `⌈scale⌉ + 1`.
    pub resolution: u32,
    /// Number of entries in this level's table.
    pub entries: u32,
    /// Index of the first entry of this level's table.
    pub offset: usize,
}

impl Level {
    /// Returns whether vertices are hashed, rather than stored one by one.
    pub fn is_hashed(&self) -> bool {
        (self.resolution as u64).saturating_pow(3) > self.entries as u64
    }
}

/// Returns the levels of a grid: `scale_l = 2^(l · log₂ growth) · base − 1` in f32, tables of at most
/// `2^log2_entries` entries, dense ones rounded up to a multiple of 8.
pub fn levels(count: usize, base: u32, growth: f64, log2_entries: u32) -> Vec<Level> {
    let log2_growth = (growth as f32).log2();
    let mut offset = 0;
    (0..count)
        .map(|l| {
            let scale = (l as f32 * log2_growth).exp2() * base as f32 - 1.0;
            let resolution = (scale.ceil() as u32).saturating_add(1);
            let dense = (resolution as u64).saturating_pow(3).div_ceil(8).saturating_mul(8);
            let entries = dense.min(1 << log2_entries) as u32;
            let level = Level { scale, resolution, entries, offset };
            offset += entries as usize;
            level
        })
        .collect()
}

/// Returns the number of entries of all levels together.
pub fn entries(levels: &[Level]) -> usize {
    levels.last().map_or(0, |l| l.offset + l.entries as usize)
}

const PRIMES: [u32; 3] = [1, 2_654_435_761, 805_459_861];

/// Returns the eight table entries of the cell around `x01`, and the position inside it, with coordinates in 0..1.
///
/// Corner `k` lies at +1 along x when bit 0 of `k` is set, y with bit 1, z with bit 2.
#[inline(always)]
pub fn cell<const F: bool>(level: &Level, x01: [f32; 3]) -> ([u32; 8], [f32; 3]) {
    let mut low = [0u32; 3];
    let mut fraction = [0f32; 3];
    for a in 0..3 {
        let position = fma::<F>(level.scale, x01[a], 0.5);
        let floor = position.floor();
        fraction[a] = position - floor;
        // the cast saturates: positions far outside the box must not wrap into undefined cells
        low[a] = floor as i32 as u32;
    }
    let mut index = [0u32; 8];
    if level.is_hashed() {
        let h: [[u32; 2]; 3] = std::array::from_fn(|a| {
            [low[a].wrapping_mul(PRIMES[a]), low[a].wrapping_add(1).wrapping_mul(PRIMES[a])]
        });
        // hashed tables are powers of two, so `mod entries` is a mask
        let mask = level.entries - 1;
        for k in 0..8 {
            index[k] = (h[0][k & 1] ^ h[1][(k >> 1) & 1] ^ h[2][k >> 2]) & mask;
        }
    } else {
        let r = level.resolution;
        for k in 0..8 {
            let (cx, cy, cz) = (
                low[0].wrapping_add((k & 1) as u32),
                low[1].wrapping_add(((k >> 1) & 1) as u32),
                low[2].wrapping_add((k >> 2) as u32),
            );
            let i = cx.wrapping_add(r.wrapping_mul(cy.wrapping_add(r.wrapping_mul(cz))));
            // because of the half-cell stagger, cell + 1 can equal the resolution at the border, and wraps
            index[k] = if i >= level.entries { i % level.entries } else { i };
        }
    }
    (index, fraction)
}

const SX: [f32; 8] = [-1., 1., -1., 1., -1., 1., -1., 1.];
const SY: [f32; 8] = [-1., -1., 1., 1., -1., -1., 1., 1.];
const SZ: [f32; 8] = [-1., -1., -1., -1., 1., 1., 1., 1.];

/// Returns the corner weights of each axis: `w[axis][corner]` is the fraction or its complement.
#[inline(always)]
fn axis_weights<const F: bool>(f: [f32; 3]) -> [[f32; 8]; 3] {
    let mut w = [[0f32; 8]; 3];
    for k in 0..8 {
        w[0][k] = fma::<F>(SX[k], f[0] - 0.5, 0.5);
        w[1][k] = fma::<F>(SY[k], f[1] - 0.5, 0.5);
        w[2][k] = fma::<F>(SZ[k], f[2] - 0.5, 0.5);
    }
    w
}

/// Writes the features of samples and, if `J` is set, their derivatives.
#[inline(always)]
fn gather_samples<const F: bool, const J: bool>(
    level: &Level,
    table: &[[f32; 2]],
    x01: &[[f32; 3]],
    world: f32,
    value: &mut [[f32; 2]],
    jacobian: &mut [[f32; 6]],
) {
    let slope = level.scale * world;
    assert!(table.len() >= level.entries as usize);
    for (s, p) in x01.iter().enumerate() {
        let (index, f) = cell::<F>(level, *p);
        let w = axis_weights::<F>(f);
        let (mut e0, mut e1) = ([0f32; 8], [0f32; 8]);
        for k in 0..8 {
            // SAFETY: `cell` gives indices below `level.entries`, asserted above.
            let e = unsafe { table.get_unchecked(index[k] as usize) };
            (e0[k], e1[k]) = (e[0], e[1]);
        }
        let mut v = [0f32; 2];
        let mut j = [0f32; 6];
        for k in 0..8 {
            let (yz, xz, xy) = (w[1][k] * w[2][k], w[0][k] * w[2][k], w[0][k] * w[1][k]);
            let weight = xy * w[2][k];
            v[0] = fma::<F>(weight, e0[k], v[0]);
            v[1] = fma::<F>(weight, e1[k], v[1]);
            if J {
                let (dx, dy, dz) = (SX[k] * yz, SY[k] * xz, SZ[k] * xy);
                j[0] = fma::<F>(dx, e0[k], j[0]);
                j[1] = fma::<F>(dy, e0[k], j[1]);
                j[2] = fma::<F>(dz, e0[k], j[2]);
                j[3] = fma::<F>(dx, e1[k], j[3]);
                j[4] = fma::<F>(dy, e1[k], j[4]);
                j[5] = fma::<F>(dz, e1[k], j[5]);
            }
        }
        value[s] = v;
        if J {
            jacobian[s] = j.map(|d| d * slope);
        }
    }
}

#[inline(always)]
fn gather_body<const F: bool>(
    level: &Level,
    table: &[[f32; 2]],
    x01: &[[f32; 3]],
    world: f32,
    value: &mut [[f32; 2]],
    jacobian: Option<&mut [[f32; 6]]>,
) {
    match jacobian {
        None => gather_samples::<F, false>(level, table, x01, world, value, &mut []),
        Some(jacobian) => gather_samples::<F, true>(level, table, x01, world, value, jacobian),
    }
}

dispatch! {
    fn gather_level / gather_body(
        level: &Level, table: &[[f32; 2]], x01: &[[f32; 3]], world: f32,
        value: &mut [[f32; 2]], jacobian: Option<&mut [[f32; 6]]>,
    )
}

/// Number of samples per task of a gather.
const GATHER_CHUNK: usize = 8192;

/// Writes the features of samples and, if `jacobian` is given, their derivatives.
///
/// # Shapes
///
/// - table: `[entries, 2]`
/// - x01: `[samples, 3]` in the unit cube (outside it the grid repeats, hashed)
/// - world: d x01 / d position; the Jacobian is with respect to position
/// - value: `[levels, samples, 2]`
/// - jacobian: `[levels, samples, 2, 3]`
pub fn gather(
    levels: &[Level],
    table: &[[f32; 2]],
    x01: &[[f32; 3]],
    world: f32,
    value: &mut [[f32; 2]],
    mut jacobian: Option<&mut [[f32; 6]]>,
) {
    let n = x01.len();
    assert_eq!(value.len(), levels.len() * n);
    assert!(table.len() >= entries(levels));
    if n == 0 {
        return;
    }
    assert!(jacobian.as_ref().is_none_or(|jacobian| jacobian.len() == value.len()));
    let mut tasks = Vec::new();
    for (level, value) in levels.iter().zip(value.chunks_mut(n)) {
        let level_table = &table[level.offset..][..level.entries as usize];
        for (x, v) in x01.chunks(GATHER_CHUNK).zip(value.chunks_mut(GATHER_CHUNK)) {
            let j = jacobian.as_mut().and_then(|jacobian| jacobian.split_off_mut(..x.len()));
            tasks.push((level, level_table, x, v, j));
        }
    }
    tasks
        .into_par_iter()
        .for_each(|(level, level_table, x, v, j)| gather_level(level, level_table, x, world, v, j));
}

#[inline(always)]
fn scatter_body<const F: bool>(
    level: &Level,
    gradient: &mut [[f32; 2]],
    x01: &[[f32; 3]],
    world: f32,
    g_value: &[[f32; 2]],
    q: &[[f32; 2]],
    g_normal: &[[f32; 3]],
) {
    let slope = level.scale * world;
    assert!(gradient.len() >= level.entries as usize);
    assert!(g_value.len() == x01.len() && q.len() == x01.len() && g_normal.len() == x01.len());
    for s in 0..x01.len() {
        let (index, f) = cell::<F>(level, x01[s]);
        let w = axis_weights::<F>(f);
        let (gv, qv) = (g_value[s], q[s]);
        let n = g_normal[s].map(|v| v * slope);
        let (mut a, mut b) = ([0f32; 8], [0f32; 8]);
        for k in 0..8 {
            let (yz, xz, xy) = (w[1][k] * w[2][k], w[0][k] * w[2][k], w[0][k] * w[1][k]);
            let weight = xy * w[2][k];
            let d = fma::<F>(n[0] * SX[k], yz, fma::<F>(n[1] * SY[k], xz, n[2] * SZ[k] * xy));
            a[k] = fma::<F>(gv[0], weight, qv[0] * d);
            b[k] = fma::<F>(gv[1], weight, qv[1] * d);
        }
        for k in 0..8 {
            // SAFETY: `cell` gives indices below `level.entries`, asserted above.
            let e = unsafe { gradient.get_unchecked_mut(index[k] as usize) };
            e[0] += a[k];
            e[1] += b[k];
        }
    }
}

dispatch! {
    fn scatter_level / scatter_body(
        level: &Level, gradient: &mut [[f32; 2]], x01: &[[f32; 3]], world: f32,
        g_value: &[[f32; 2]], q: &[[f32; 2]], g_normal: &[[f32; 3]],
    )
}

/// Adds the gradient of a loss with respect to the table. The loss depends on the table through the features
/// (`g_value`) and through the spatial gradient (`g_normal`) of a scalar whose derivative with respect to the features is
/// `q`: the second-order path.
///
/// `table[corner k] += g_value · w_k + q · (g_normal · ∇w_k)`
///
/// # Shapes
///
/// - gradient: `[entries, 2]`, added to
/// - x01: `[samples, 3]`; world: d x01 / d position
/// - g_value, q: `[levels, samples, 2]`
/// - g_normal: `[samples, 3]`
pub fn scatter(
    levels: &[Level],
    gradient: &mut [[f32; 2]],
    x01: &[[f32; 3]],
    world: f32,
    g_value: &[[f32; 2]],
    q: &[[f32; 2]],
    g_normal: &[[f32; 3]],
) {
    let n = x01.len();
    assert!(g_value.len() == levels.len() * n && q.len() == levels.len() * n);
    let mut rest = gradient;
    let tables: Vec<&mut [[f32; 2]]> = levels
        .iter()
        .map(|level| {
            rest.split_off_mut(..level.entries as usize).expect("the gradient has the entries of all levels")
        })
        .collect();
    // the finest levels take longest because of cache misses, so they start first
    tables.into_par_iter().enumerate().rev().with_max_len(1).for_each(|(l, level_gradient)| {
        let span = l * n..(l + 1) * n;
        scatter_level(&levels[l], level_gradient, x01, world, &g_value[span.clone()], &q[span], g_normal);
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    const B32: f64 = 1.3195079107728942;
    const B16: f64 = 1.447269237440378;

    #[test]
    fn cells_match_the_published_grid() {
        // (base, growth, level, scale, low cell, entry of corner 000, of corner 111)
        let golden: [(u32, f64, usize, f32, u32, u32); 9] = [
            (32, B32, 0, 31.0, 29289, 30346),
            (32, B32, 3, 72.516693, 359218, 364769),
            (32, B32, 4, 96.005875, 65033, 182390),
            (32, B32, 8, 293.066833, 129088, 494085),
            (32, B32, 15, 2047.000732, 102768, 504181),
            (16, B16, 0, 15.0, 3733, 4006),
            (16, B16, 4, 69.196793, 315545, 320658),
            (16, B16, 5, 100.593658, 369813, 34494),
            (16, B16, 15, 4094.998535, 17612, 484073),
        ];
        for (base, growth, l, scale, first, last) in golden {
            let level = levels(16, base, growth, 19)[l];
            assert!((level.scale - scale).abs() < 2e-4 * scale.sqrt(), "{base} {l} {} {scale}", level.scale);
            let (index, _) = cell::<true>(&level, [0.3, 0.6, 0.9]);
            assert_eq!((index[0], index[7]), (first, last), "base {base} level {l}");
        }
        let all = levels(16, 32, B32, 19);
        assert_eq!(entries(&all), 6_984_576);
        assert_eq!([all[0].resolution, all[1].resolution, all[3].resolution], [32, 43, 74]);
        assert_eq!(entries(&levels(16, 16, B16, 19)), 6_299_960);
    }

    fn grid() -> (Vec<Level>, Vec<[f32; 2]>) {
        let levels = levels(4, 4, 1.9, 8);
        let table =
            (0..entries(&levels)).map(|i| [(i as f32 * 0.73).sin(), (i as f32 * 0.31).cos()]).collect();
        (levels, table)
    }

    #[test]
    fn the_jacobian_is_the_slope_of_the_value() {
        let (levels, table) = grid();
        // no cell border within the step at any of the four levels
        let x = [[0.31, 0.63, 0.19], [0.81, 0.07, 0.46]];
        let world = 0.5; // position = 2 · x01 − 1
        let mut v = vec![[0f32; 2]; 8];
        let mut j = vec![[0f32; 6]; 8];
        gather(&levels, &table, &x, world, &mut v, Some(&mut j));
        let h = 2e-4f32;
        for axis in 0..3 {
            let shifted = |sign: f32| {
                let mut y = x;
                y.iter_mut().for_each(|p| p[axis] += sign * h * world);
                let mut v = vec![[0f32; 2]; 8];
                gather(&levels, &table, &y, world, &mut v, None);
                v
            };
            let (up, down) = (shifted(1.0), shifted(-1.0));
            for i in 0..8 {
                for f in 0..2 {
                    let slope = (up[i][f] - down[i][f]) / (2.0 * h);
                    assert!(
                        (slope - j[i][3 * f + axis]).abs() < 2e-3 * slope.abs().max(5.0),
                        "{slope} {}",
                        j[i][3 * f + axis]
                    );
                }
            }
        }
    }

    #[test]
    fn the_scatter_is_the_adjoint_of_value_and_slope() {
        // L = Σ g·value + Σ q·(J n) is linear in the table, so <gradient, table> must equal L exactly
        let (levels, table) = grid();
        let x = [[0.31, 0.62, 0.17], [0.8, 0.05, 0.44], [0.999, 0.0, 1.0]];
        let n = [[0.3f32, -0.2, 0.9], [0.1, 0.5, -0.7], [1.0, 0.2, 0.1]];
        let g: Vec<[f32; 2]> = (0..12).map(|i| [(i as f32).sin(), 0.4 - 0.1 * i as f32]).collect();
        let q: Vec<[f32; 2]> = (0..12).map(|i| [(i as f32).cos(), 0.05 * i as f32]).collect();
        let (mut v, mut j) = (vec![[0f32; 2]; 12], vec![[0f32; 6]; 12]);
        gather(&levels, &table, &x, 0.5, &mut v, Some(&mut j));
        let mut want = 0f64;
        for i in 0..12 {
            let normal = n[i % 3];
            for f in 0..2 {
                let along: f32 = (0..3).map(|a| j[i][3 * f + a] * normal[a]).sum();
                want += (g[i][f] * v[i][f] + q[i][f] * along) as f64;
            }
        }
        let mut gradient = vec![[0f32; 2]; table.len()];
        scatter(&levels, &mut gradient, &x, 0.5, &g, &q, &n);
        let got: f64 = gradient.iter().zip(&table).map(|(a, b)| (a[0] * b[0] + a[1] * b[1]) as f64).sum();
        assert!((got - want).abs() < 1e-4 * want.abs(), "{got} {want}");
    }
}
