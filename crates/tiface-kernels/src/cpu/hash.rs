//! Multiresolution hash encoding: the value, its Jacobian, and the scatter, which is the
//! backward pass of both.
//!
//! Müller, Evans, Schied, Keller 2022, "Instant Neural Graphics Primitives"; cell indexing as in
//! tiny-cuda-nn (half-cell stagger, coherent-prime hash, dense levels while they fit).
//!
//! Features lie level-major, `[level][sample][2]`: one level's table is at most a few megabytes and
//! stays in the cache while all samples pass; a random read from the whole table costs seven times
//! as much. In the scatter one task owns the gradient of one level, so it needs no atomics and its
//! result does not depend on the number of threads.

use super::simd::fma;
use rayon::prelude::*;
use tiface_base::dispatch;

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

/// Returns the levels of a grid: `scale_l = 2^(l · log₂ growth) · base − 1` in f32, tables of at
/// most `2^log2_entries` entries, dense ones rounded up to a multiple of 8.
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

/// Number of samples that the kernels evaluate together.
pub const LANES: usize = 8;

/// A number of each of [`LANES`] samples.
pub type Lanes = [f32; LANES];

/// The derivatives of both features along the three axes, `[2 · 3]`, at [`LANES`] samples.
pub type JacobianBlock = [Lanes; 6];

/// The eight table entries `[corner][sample]` of the cells around [`LANES`] samples, and the
/// samples' positions in their cells, 0..1, `[axis][sample]`.
///
/// Corner `k` lies at +1 along x when bit 0 of `k` is set, y with bit 1, z with bit 2.
pub type Cells = ([[u32; LANES]; 8], [Lanes; 3]);

/// Writes the cells around `x01`. Returned by value, this much would be copied by a call.
#[inline(always)]
pub fn cells<const F: bool>(level: &Level, x01: &[[f32; 3]; LANES], (index, fraction): &mut Cells) {
    let mut low = [[0u32; LANES]; 3];
    for a in 0..3 {
        for i in 0..LANES {
            let position = fma::<F>(level.scale, x01[i][a], 0.5);
            let floor = position.floor();
            fraction[a][i] = position - floor;
            // unlike `clamp`, `max` and `min` also bound NaN
            let above = floor.max(-1e9);
            // SAFETY: the bounds keep positions far outside the box, and NaN, in the range of i32.
            low[a][i] = unsafe { above.min(1e9).to_int_unchecked::<i32>() } as u32;
        }
    }
    let r = level.resolution;
    // each axis's term in an entry's index, for the lower and the upper corner
    let factors = if level.is_hashed() { PRIMES } else { [1, r, r.wrapping_mul(r)] };
    let mut term = [[[0u32; LANES]; 2]; 3];
    for a in 0..3 {
        for i in 0..LANES {
            term[a][0][i] = low[a][i].wrapping_mul(factors[a]);
            term[a][1][i] = term[a][0][i].wrapping_add(factors[a]);
        }
    }
    let corner = |k: usize| [&term[0][k & 1], &term[1][k >> 1 & 1], &term[2][k >> 2]];
    if level.is_hashed() {
        // hashed tables are powers of two, so `mod entries` is a mask
        let mask = level.entries - 1;
        for k in 0..8 {
            let [x, y, z] = corner(k);
            for i in 0..LANES {
                index[k][i] = (x[i] ^ y[i] ^ z[i]) & mask;
            }
        }
    } else {
        let mut last = [0; LANES];
        for k in 0..8 {
            let [x, y, z] = corner(k);
            for i in 0..LANES {
                let entry = x[i].wrapping_add(y[i]).wrapping_add(z[i]);
                // because of the half-cell stagger, cell + 1 can equal the resolution at the
                // border, and wraps
                index[k][i] = entry.min(entry.wrapping_sub(level.entries));
                last[i] = last[i].max(index[k][i]);
            }
        }
        // farther outside of the box it wraps more than once
        if last.iter().any(|last| *last >= level.entries) {
            index.as_flattened_mut().iter_mut().for_each(|i| *i %= level.entries);
        }
    }
}

/// Returns the first block of `x`, padded with zeros.
#[inline(always)]
fn block<const N: usize>(x: &[[f32; N]]) -> [[f32; N]; LANES] {
    let padded = || std::array::from_fn(|i| x.get(i).copied().unwrap_or([0.0; N]));
    x.first_chunk().copied().unwrap_or_else(padded)
}

/// Writes the [`cells`] of the first block of samples, and has the CPU fetch their entries of
/// `table`: the finer tables are larger than its second-level cache.
#[inline(always)]
fn fetch_cells<const F: bool>(level: &Level, table: &[[f32; 2]], x01: &[[f32; 3]], found: &mut Cells) {
    cells::<F>(level, &block(x01), found);
    #[cfg(target_arch = "x86_64")]
    for &i in found.0.as_flattened() {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: `cells` gives indices below `level.entries`, which is at most the length of the
        // callers' tables.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(table.as_ptr().add(i as usize).cast()) };
    }
}

/// Returns a component of each sample.
#[inline(always)]
fn component<const N: usize>(x: &[[f32; N]; LANES], c: usize) -> Lanes {
    let mut out = [0f32; LANES];
    for i in 0..LANES {
        out[i] = x[i][c];
    }
    out
}

/// `a + t (b − a)` for each sample.
#[inline(always)]
fn mix<const F: bool>(a: &Lanes, b: &Lanes, t: &Lanes) -> Lanes {
    let mut out = [0f32; LANES];
    for i in 0..LANES {
        out[i] = fma::<F>(t[i], b[i] - a[i], a[i]);
    }
    out
}

/// `b − a` for each sample.
#[inline(always)]
fn minus(b: &Lanes, a: &Lanes) -> Lanes {
    let mut out = [0f32; LANES];
    for i in 0..LANES {
        out[i] = b[i] - a[i];
    }
    out
}

#[inline(always)]
fn gather_body<const F: bool>(
    level: &Level,
    table: &[[f32; 2]],
    x01: &[[f32; 3]],
    world: f32,
    value: &mut [[f32; 2]],
    mut jacobian: Option<&mut [JacobianBlock]>,
) {
    let slope = level.scale * world;
    assert!(table.len() >= level.entries as usize);
    // derivatives are computed in any case, which takes no longer than the reads of the table
    let mut unused = [[0f32; LANES]; 6];
    // of a block and of the next one, in turn
    let mut found = [Cells::default(); 2];
    fetch_cells::<F>(level, table, x01, &mut found[0]);
    let count = value.len();
    let (blocks, rest) = value.as_chunks_mut::<LANES>();
    let mut last = [[0f32; 2]; LANES];
    for b in 0..count.div_ceil(LANES) {
        let next = x01.get((b + 1) * LANES..).unwrap_or_default();
        fetch_cells::<F>(level, table, next, &mut found[(b + 1) % 2]);
        let (index, fraction) = &found[b % 2];
        let jacobian = jacobian.as_mut().map_or(&mut unused, |jacobian| &mut jacobian[b]);
        // [feature][corner][sample]
        let mut e = [[[0f32; LANES]; 8]; 2];
        for k in 0..8 {
            for i in 0..LANES {
                // SAFETY: `cells` gives indices below `level.entries`, asserted above.
                let entry = unsafe { *table.get_unchecked(index[k][i] as usize) };
                (e[0][k][i], e[1][k][i]) = (entry[0], entry[1]);
            }
        }
        let (first, [x0, y0, z0]) = interpolated::<F>(&e[0], fraction, slope);
        let (second, [x1, y1, z1]) = interpolated::<F>(&e[1], fraction, slope);
        *jacobian = [x0, y0, z0, x1, y1, z1];
        let value = blocks.get_mut(b).unwrap_or(&mut last);
        for i in 0..LANES {
            value[i] = [first[i], second[i]];
        }
    }
    rest.copy_from_slice(&last[..rest.len()]);
}

/// Returns a feature interpolated between the corners `e` of cells, and its derivatives times
/// `slope`.
#[inline(always)]
fn interpolated<const F: bool>(e: &[Lanes; 8], [fx, fy, fz]: &[Lanes; 3], slope: f32) -> (Lanes, [Lanes; 3]) {
    // along x at the four edges, along y at the two faces, then along z
    let edge: [Lanes; 4] = std::array::from_fn(|k| mix::<F>(&e[2 * k], &e[2 * k + 1], fx));
    let face: [Lanes; 2] = std::array::from_fn(|k| mix::<F>(&edge[2 * k], &edge[2 * k + 1], fy));
    let dx: [Lanes; 4] = std::array::from_fn(|k| minus(&e[2 * k + 1], &e[2 * k]));
    let dx: [Lanes; 2] = std::array::from_fn(|k| mix::<F>(&dx[2 * k], &dx[2 * k + 1], fy));
    let dy: [Lanes; 2] = std::array::from_fn(|k| minus(&edge[2 * k + 1], &edge[2 * k]));
    let mut d = [mix::<F>(&dx[0], &dx[1], fz), mix::<F>(&dy[0], &dy[1], fz), minus(&face[1], &face[0])];
    for a in 0..3 {
        for i in 0..LANES {
            d[a][i] *= slope;
        }
    }
    (mix::<F>(&face[0], &face[1], fz), d)
}

dispatch! {
    fn gather_level / gather_body(
        level: &Level, table: &[[f32; 2]], x01: &[[f32; 3]], world: f32,
        value: &mut [[f32; 2]], jacobian: Option<&mut [JacobianBlock]>,
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
/// - jacobian: `[levels, blocks, 2, 3, 8]`, for blocks of 8 samples
pub fn gather(
    levels: &[Level],
    table: &[[f32; 2]],
    x01: &[[f32; 3]],
    world: f32,
    value: &mut [[f32; 2]],
    mut jacobian: Option<&mut [JacobianBlock]>,
) {
    let n = x01.len();
    assert_eq!(value.len(), levels.len() * n);
    assert!(table.len() >= entries(levels));
    if n == 0 {
        return;
    }
    let blocks = levels.len() * n.div_ceil(LANES);
    assert!(jacobian.as_ref().is_none_or(|jacobian| jacobian.len() == blocks));
    let mut tasks = Vec::new();
    for (level, value) in levels.iter().zip(value.chunks_mut(n)) {
        let level_table = &table[level.offset..][..level.entries as usize];
        for (x, v) in x01.chunks(GATHER_CHUNK).zip(value.chunks_mut(GATHER_CHUNK)) {
            let j = jacobian.as_mut().and_then(|jacobian| jacobian.split_off_mut(..x.len().div_ceil(LANES)));
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
    let mut found = [Cells::default(); 2];
    fetch_cells::<F>(level, gradient, x01, &mut found[0]);
    for first in (0..x01.len()).step_by(LANES) {
        let span = first..(first + LANES).min(x01.len());
        let (count, b) = (span.len(), first / LANES);
        fetch_cells::<F>(level, gradient, &x01[span.end..], &mut found[(b + 1) % 2]);
        let (index, f) = &found[b % 2];
        let (normal, gv) = (block(&g_normal[span.clone()]), block(&g_value[span.clone()]));
        let qv = block(&q[span]);
        let (gv, qv) = ([component(&gv, 0), component(&gv, 1)], [component(&qv, 0), component(&qv, 1)]);
        // the share of the lower and of the upper corner along each axis, and its derivative along
        // `g_normal`
        let mut share = [[[0f32; LANES]; 2]; 3];
        let mut slope_along = [[[0f32; LANES]; 2]; 3];
        for a in 0..3 {
            let normal = component(&normal, a);
            for i in 0..LANES {
                share[a][0][i] = 1.0 - f[a][i];
                share[a][1][i] = f[a][i];
                slope_along[a][0][i] = normal[i] * -slope;
                slope_along[a][1][i] = normal[i] * slope;
            }
        }
        let mut add = [[[0f32; 2]; LANES]; 8];
        for k in 0..8 {
            let up = |a: usize| k >> a & 1;
            let w: [&Lanes; 3] = std::array::from_fn(|a| &share[a][up(a)]);
            let n: [&Lanes; 3] = std::array::from_fn(|a| &slope_along[a][up(a)]);
            let mut addend = [[0f32; LANES]; 2];
            for i in 0..LANES {
                let weight = w[0][i] * w[1][i] * w[2][i];
                let d = fma::<F>(
                    n[0][i] * w[1][i],
                    w[2][i],
                    w[0][i] * fma::<F>(n[1][i], w[2][i], n[2][i] * w[1][i]),
                );
                addend[0][i] = fma::<F>(gv[0][i], weight, qv[0][i] * d);
                addend[1][i] = fma::<F>(gv[1][i], weight, qv[1][i] * d);
            }
            for i in 0..LANES {
                add[k][i] = [addend[0][i], addend[1][i]];
            }
        }
        for i in 0..count {
            for k in 0..8 {
                // SAFETY: `cells` gives indices below `level.entries`, asserted above.
                let e = unsafe { gradient.get_unchecked_mut(index[k][i] as usize) };
                e[0] += add[k][i][0];
                e[1] += add[k][i][1];
            }
        }
    }
}

dispatch! {
    fn scatter_level / scatter_body(
        level: &Level, gradient: &mut [[f32; 2]], x01: &[[f32; 3]], world: f32,
        g_value: &[[f32; 2]], q: &[[f32; 2]], g_normal: &[[f32; 3]],
    )
}

/// Adds the gradient of a loss with respect to the table. The loss depends on the table through the
/// features (`g_value`) and through the spatial gradient (`g_normal`) of a scalar whose derivative
/// with respect to the features is `q`: the second-order path.
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
            let mut found = Cells::default();
            cells::<true>(&level, &[[0.3, 0.6, 0.9]; LANES], &mut found);
            assert_eq!((found.0[0][0], found.0[7][0]), (first, last), "base {base} level {l}");
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
        let mut j = [[[0f32; LANES]; 6]; 4];
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
                    let got = j[i / 2][3 * f + axis][i % 2];
                    assert!((slope - got).abs() < 2e-3 * slope.abs().max(5.0), "{slope} {got}");
                }
            }
        }
    }

    #[test]
    fn the_scatter_is_the_adjoint_of_value_and_slope() {
        // L = Σ g·value + Σ q·(J n) is linear in the table, so <gradient, table> must equal L
        // exactly
        let (levels, table) = grid();
        let x = [[0.31, 0.62, 0.17], [0.8, 0.05, 0.44], [0.999, 0.0, 1.0]];
        let n = [[0.3f32, -0.2, 0.9], [0.1, 0.5, -0.7], [1.0, 0.2, 0.1]];
        let g: Vec<[f32; 2]> = (0..12).map(|i| [(i as f32).sin(), 0.4 - 0.1 * i as f32]).collect();
        let q: Vec<[f32; 2]> = (0..12).map(|i| [(i as f32).cos(), 0.05 * i as f32]).collect();
        let (mut v, mut j) = (vec![[0f32; 2]; 12], [[[0f32; LANES]; 6]; 4]);
        gather(&levels, &table, &x, 0.5, &mut v, Some(&mut j));
        let mut want = 0f64;
        for i in 0..12 {
            let normal = n[i % 3];
            for f in 0..2 {
                let along: f32 = (0..3).map(|a| j[i / 3][3 * f + a][i % 3] * normal[a]).sum();
                want += (g[i][f] * v[i][f] + q[i][f] * along) as f64;
            }
        }
        let mut gradient = vec![[0f32; 2]; table.len()];
        scatter(&levels, &mut gradient, &x, 0.5, &g, &q, &n);
        let got: f64 = gradient.iter().zip(&table).map(|(a, b)| (a[0] * b[0] + a[1] * b[1]) as f64).sum();
        assert!((got - want).abs() < 1e-4 * want.abs(), "{got} {want}");
    }
}
