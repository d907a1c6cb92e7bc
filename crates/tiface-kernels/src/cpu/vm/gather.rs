//! Interpolation in planes and lines, and the scatter of gradients, which is its backward pass.

use super::{Factor, Grid, LINE_AXIS, PLANE_AXES};
use crate::cpu::simd::fma;
use rayon::prelude::*;
use tiface_base::dispatch;

/// Position of a point between the vertices of a grid.
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Cell {
    /// Index of the vertex below the point along each axis; the vertex above always exists.
    pub index: [u32; 3],
    /// Position between the two vertices along each axis, 0..=1.
    pub frac: [f32; 3],
}

impl Cell {
    /// Returns the cell of a point with coordinates 0..=1 along each axis of the box; outer
    /// vertices are at 0 and 1.
    #[inline(always)]
    pub fn new(size: [usize; 3], unit: [f32; 3]) -> Cell {
        let mut cell = Cell::default();
        for a in 0..3 {
            let top = (size[a] - 1) as f32;
            // unlike `clamp`, `max` and `min` also bound NaN
            let x = (unit[a] * top).max(0.0).min(top);
            // SAFETY: the bounds keep the number in the range of i32.
            let i = unsafe { x.min(1e9).to_int_unchecked::<i32>() }.min(size[a] as i32 - 2);
            cell.index[a] = i as u32;
            cell.frac[a] = x - i as f32;
        }
        cell
    }
}

/// The four corners of a cell in a plane: offsets of the two rows, and the weights of the corners.
#[derive(Clone, Copy)]
struct Corners {
    rows: [usize; 2],
    weight: [f32; 4],
}

/// Plane and line of a term as slices.
struct Term<'a> {
    plane: &'a [f32],
    line: &'a [f32],
    width: usize,
    channels: usize,
}

#[inline(always)]
fn corners(i: usize, cell: &Cell, width: usize, channels: usize) -> Corners {
    let (a, b) = PLANE_AXES[i];
    let row = cell.index[b] as usize * width + cell.index[a] as usize;
    let (x, y) = (cell.frac[a], cell.frac[b]);
    Corners {
        rows: [row * channels, (row + width) * channels],
        weight: [(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y],
    }
}

#[inline(always)]
fn lanes<const W: usize>(values: &[f32], start: usize) -> &[f32; W] {
    values[start..start + W].try_into().expect("a slice of W floats")
}

/// Interpolates plane and line values of `W` channels, starting at channel `c`.
#[inline(always)]
fn look_up<const F: bool, const W: usize>(
    term: &Term,
    at: &Corners,
    line: usize,
    z: f32,
    c: usize,
) -> ([f32; W], [f32; W]) {
    let n = term.channels;
    let (p, q) = (at.rows[0] + c, at.rows[1] + c);
    let (a, b) = (lanes::<W>(term.plane, p), lanes::<W>(term.plane, p + n));
    let (d, e) = (lanes::<W>(term.plane, q), lanes::<W>(term.plane, q + n));
    let (l, m) = (lanes::<W>(term.line, line + c), lanes::<W>(term.line, line + n + c));
    let w = at.weight;
    let mut plane = [0f32; W];
    for k in 0..W {
        plane[k] = fma::<F>(w[3], e[k], fma::<F>(w[2], d[k], fma::<F>(w[1], b[k], w[0] * a[k])));
    }
    (plane, lerp::<F, W>(l, m, z))
}

/// `a + t (b − a)` for each channel.
#[inline(always)]
fn lerp<const F: bool, const W: usize>(a: &[f32; W], b: &[f32; W], t: f32) -> [f32; W] {
    let mut out = [0f32; W];
    for k in 0..W {
        out[k] = fma::<F>(t, b[k] - a[k], a[k]);
    }
    out
}

/// Runs `body` over the channels of a term, in pieces of the largest width that fits.
macro_rules! in_pieces {
    ($channels:expr, $c:ident, $width:ident, $body:block) => {
        in_pieces!([16, 8, 4, 1] $channels, $c, $width, $body)
    };
    ([$($widest:literal),+] $channels:expr, $c:ident, $width:ident, $body:block) => {{
        let mut $c = 0;
        $(while $channels - $c >= $widest {
            const $width: usize = $widest;
            $body
            $c += $width;
        })+
    }};
}

/// A set of planes and lines, prepared for lookups.
pub(super) struct Lookup<'a> {
    terms: [Term<'a>; 3],
    size: [usize; 3],
}

impl<'a> Lookup<'a> {
    pub fn new(grid: &Grid, values: &'a [f32]) -> Lookup<'a> {
        assert_eq!(values.len(), grid.len(), "planes and lines do not fit their grid");
        let terms = std::array::from_fn(|i| {
            let (plane, line) = (grid.plane(i), grid.line(i));
            let (width, channels) = (plane.width, plane.channels);
            Term { plane: &values[plane.range()], line: &values[line.range()], width, channels }
        });
        Lookup { terms, size: grid.size }
    }

    pub fn size(&self) -> [usize; 3] {
        self.size
    }

    /// Returns the sum over terms and channels of plane times line. If `KEEP`, writes the plane
    /// values of all channels, term by term, to `planes`, `[channels]`.
    #[inline(always)]
    pub fn sum<const F: bool, const KEEP: bool>(&self, cell: &Cell, planes: &mut [f32]) -> f32 {
        // a number of channels that is known leaves nothing to ask at each sample
        match self.terms.each_ref().map(|term| term.channels) {
            [8, 8, 8] => self.sum_of::<F, KEEP, 8>(cell, planes),
            _ => self.sum_of::<F, KEEP, 0>(cell, planes),
        }
    }

    /// As [`Lookup::sum`], of `N` channels a term, or of any number if it is 0.
    #[inline(always)]
    fn sum_of<const F: bool, const KEEP: bool, const N: usize>(
        &self,
        cell: &Cell,
        planes: &mut [f32],
    ) -> f32 {
        // of whole lanes and of what is left of the channels, apart so that lanes stay whole
        let (mut sums, mut rest) = ([0f32; 8], 0f32);
        let mut first = 0;
        for i in 0..3 {
            let term = &self.terms[i];
            let channels = if N > 0 { N } else { term.channels };
            let at = corners(i, cell, term.width, channels);
            let axis = LINE_AXIS[i];
            let line = cell.index[axis] as usize * channels;
            in_pieces!(channels, c, W, {
                let (mut p, v) = look_up::<F, W>(term, &at, line, cell.frac[axis], c);
                if KEEP {
                    // without the black box the compiler splits the products into scalars
                    p = std::hint::black_box(p);
                    planes[first + c..first + c + W].copy_from_slice(&p);
                }
                for k in 0..W {
                    if W >= 8 {
                        sums[k % 8] = fma::<F>(p[k], v[k], sums[k % 8]);
                    } else {
                        rest = fma::<F>(p[k], v[k], rest);
                    }
                }
            });
            first += channels;
        }
        // By halves, since eight additions in a row would wait for each other. Without the black
        // box the compiler splits the products above into scalars.
        let mut sums = std::hint::black_box(sums);
        for half in [4, 2, 1] {
            for k in 0..half {
                sums[k] += sums[k + half];
            }
        }
        sums[0] + rest
    }

    /// Returns the line values of `N` channels of a term, which has no others.
    #[inline(always)]
    fn line_values<const F: bool, const N: usize>(&self, term: usize, cell: &Cell) -> [f32; N] {
        let (values, axis) = (self.terms[term].line, LINE_AXIS[term]);
        let at = cell.index[axis] as usize * N;
        lerp::<F, N>(lanes(values, at), lanes(values, at + N), cell.frac[axis])
    }

    /// Writes the line values of all channels of a term.
    #[inline(always)]
    fn write_line_values<const F: bool>(&self, term: usize, cell: &Cell, out: &mut [f32]) {
        let (values, axis, n) = (self.terms[term].line, LINE_AXIS[term], self.terms[term].channels);
        let at = cell.index[axis] as usize * n;
        in_pieces!(n, c, W, {
            let value: [f32; W] =
                lerp::<F, W>(lanes(values, at + c), lanes(values, at + n + c), cell.frac[axis]);
            out[c..c + W].copy_from_slice(&value);
        });
    }

    /// Writes plane and line values of all channels, term by term. Both slices are `[channels]` or
    /// longer.
    #[inline(always)]
    pub fn factors<const F: bool>(&self, cell: &Cell, planes: &mut [f32], lines: &mut [f32]) {
        let mut first = 0;
        for i in 0..3 {
            let term = &self.terms[i];
            let at = corners(i, cell, term.width, term.channels);
            let axis = LINE_AXIS[i];
            let line = cell.index[axis] as usize * term.channels;
            in_pieces!(term.channels, c, W, {
                let (p, v) = look_up::<F, W>(term, &at, line, cell.frac[axis], c);
                planes[first + c..first + c + W].copy_from_slice(&p);
                lines[first + c..first + c + W].copy_from_slice(&v);
            });
            first += term.channels;
        }
    }
}

/// Gradients of a loss with respect to the interpolated plane and line values of samples.
pub(super) struct FactorGradients<'a> {
    pub cells: &'a [Cell],
    pub planes: PlaneGradients<'a>,
    /// `[samples, stride]`, the first `channels` of a row are used.
    pub lines: &'a [f32],
    /// Number of floats per row.
    pub stride: usize,
}

/// Gradients with respect to the interpolated plane values of samples.
pub(super) enum PlaneGradients<'a> {
    /// Shaped like the gradients of lines.
    Given(&'a [f32]),
    /// Those of the sum of plane times line: the gradients `[samples]` with respect to the sum,
    /// times the line values, which are few enough to be looked up again faster than read.
    OfSum(&'a [f32], &'a Lookup<'a>),
}

/// The part of a plane or line that one task owns in the scatter.
struct ScatterBand<'a> {
    term: usize,
    line: bool,
    /// First row of the plane; 0 for a line.
    row: usize,
    channels: usize,
    /// First channel of this term in a sample's row.
    first: usize,
    width: usize,
    values: &'a mut [f32],
    /// Samples that contribute to this part of a plane, in increasing order; of a line, none are
    /// listed, since all do.
    samples: Vec<u32>,
}

/// Adds `weight · g` to `into`, for `n` channels.
#[inline(always)]
fn add<const F: bool>(into: &mut [f32], g: &[f32], weight: f32, n: usize) {
    let (into, g) = (&mut into[..n], &g[..n]);
    in_pieces!(n, c, W, {
        // the copy separates reads from writes, which is what allows vectorization
        let mut sum: [f32; W] = *lanes::<W>(into, c);
        let g: &[f32; W] = lanes::<W>(g, c);
        for k in 0..W {
            sum[k] = fma::<F>(weight, g[k], sum[k]);
        }
        into[c..c + W].copy_from_slice(&sum);
    });
}

/// Adds `a · g` and `b · g` to two neighbors along a row, which are adjacent in memory.
#[inline(always)]
fn add_pair<const F: bool>(into: &mut [f32], g: &[f32], a: f32, b: f32, n: usize) {
    add::<F>(into, g, a, n);
    add::<F>(&mut into[n..], g, b, n);
}

#[inline(always)]
fn band_body<const F: bool>(band: &mut ScatterBand, gradients: &FactorGradients) {
    // the ranks of the presets `draft` and `standard`
    match band.channels {
        8 => band_of::<F, 8>(band, gradients),
        24 => band_of::<F, 24>(band, gradients),
        _ => band_of::<F, 0>(band, gradients),
    }
}

/// Adds gradients to a part of `N` channels, or of any number if it is 0.
#[inline(always)]
fn band_of<const F: bool, const N: usize>(band: &mut ScatterBand, gradients: &FactorGradients) {
    let n = if N > 0 { N } else { band.channels };
    if band.line {
        let axis = LINE_AXIS[band.term];
        for (s, cell) in gradients.cells.iter().enumerate() {
            let g = &gradients.lines[s * gradients.stride + band.first..][..n];
            let z = cell.frac[axis];
            let at = cell.index[axis] as usize * n;
            add_pair::<F>(&mut band.values[at..at + 2 * n], g, 1.0 - z, z, n);
        }
        return;
    }
    let (a, b) = PLANE_AXES[band.term];
    let pitch = band.width * n;
    let rows = band.values.len() / pitch;
    let mut of_any_number = vec![0f32; if N > 0 { 0 } else { n }];
    for &s in &band.samples {
        let s = s as usize;
        let cell = &gradients.cells[s];
        // a sample contributes to this row and the next, either of which may belong to another band
        let row = (cell.index[b] as usize).wrapping_sub(band.row);
        let mut of_known_number;
        let g = match gradients.planes {
            PlaneGradients::Given(planes) => &planes[s * gradients.stride + band.first..][..n],
            PlaneGradients::OfSum(by_sum, lookup) if N > 0 => {
                of_known_number = lookup.line_values::<F, N>(band.term, cell);
                for g in &mut of_known_number {
                    *g *= by_sum[s];
                }
                &of_known_number[..]
            }
            PlaneGradients::OfSum(by_sum, lookup) => {
                lookup.write_line_values::<F>(band.term, cell, &mut of_any_number);
                for g in &mut of_any_number {
                    *g *= by_sum[s];
                }
                &of_any_number
            }
        };
        let (x, y) = (cell.frac[a], cell.frac[b]);
        let at = cell.index[a] as usize * n;
        if row < rows {
            let w = 1.0 - y;
            add_pair::<F>(&mut band.values[row * pitch + at..][..2 * n], g, (1.0 - x) * w, x * w, n);
        }
        let next = row.wrapping_add(1);
        if next < rows {
            add_pair::<F>(&mut band.values[next * pitch + at..][..2 * n], g, (1.0 - x) * y, x * y, n);
        }
    }
}

dispatch! { fn scatter_band / band_body(band: &mut ScatterBand, gradients: &FactorGradients) }

/// Number of bands of a plane. It is fixed, so that the order of sums does not depend on the number
/// of threads.
const BANDS: usize = 6;

/// Adds the gradients of all samples to `gradient`, which is laid out as `grid`. Every vertex is
/// summed in the order of the samples, for any number of threads.
pub(super) fn scatter(grid: &Grid, gradients: &FactorGradients, gradient: &mut [f32]) {
    assert_eq!(gradient.len(), grid.len());
    let mut bands = Vec::new();
    for (k, (factor, factor_gradient)) in grid.split_mut(gradient).into_iter().enumerate() {
        let (term, line) = (k % 3, k >= 3);
        let Factor { height, width, channels, .. } = factor;
        let first = grid.rank[..term].iter().sum();
        let rows = if line { 1 } else { height.div_ceil(BANDS) };
        for (i, values) in factor_gradient.chunks_mut((rows * width * channels).max(1)).enumerate() {
            bands.push(ScatterBand {
                term,
                line,
                row: i * rows,
                channels,
                first,
                width,
                values,
                samples: Vec::new(),
            });
        }
    }
    bands
        .par_chunk_by_mut(|a, b| (a.term, a.line) == (b.term, b.line))
        .filter(|bands| !bands[0].line)
        .for_each(|bands| {
            let axis = PLANE_AXES[bands[0].term].1;
            // a table, since a division takes longer than all else that is done for a sample
            let band_of: Vec<usize> = bands
                .iter()
                .enumerate()
                .flat_map(|(i, band)| {
                    std::iter::repeat_n(i, band.values.len() / (band.width * band.channels))
                })
                .collect();
            for (s, cell) in gradients.cells.iter().enumerate() {
                let row = cell.index[axis] as usize;
                let (band, next) = (band_of[row], band_of[row + 1]);
                bands[band].samples.push(s as u32);
                if next != band {
                    bands[next].samples.push(s as u32);
                }
            }
        });
    bands.par_iter_mut().with_max_len(1).for_each(|band| scatter_band(band, gradients));
}
