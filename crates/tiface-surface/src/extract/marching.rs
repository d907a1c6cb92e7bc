//! Marching cubes over a dense volume: closed, manifold, finite, with the trilinear topology.
//!
//! Passes over rows as in flying edges (Schroeder, Maynard, Geveci 2015): inside bits, 64 nodes to
//! a word; crossings counted per row by comparing words; prefix sums; vertices and triangles
//! written at fixed offsets. Cells without a crossing cost a sixty-fourth of a few word operations.
//! A vertex's index is arithmetic: running counters per row, never a hash. What happens inside a
//! cell is in `marching_cell`. The bytes are the same for any number of threads.
//!
//! An exact zero is outside, `-0.0` too.

use super::marching_cell::{CASES, CellOutput, CellSurface, crossing, resolve};
use crate::check_count;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::borrow::Cow;
use tiface_base::geom::Mesh;
use tiface_base::{Error, Result};

/// A dense grid of field values, negative inside.
#[derive(Clone, Copy, Debug)]
pub struct Volume<'a> {
    /// Nodes along x, y, z; at least 2 each.
    pub dims: [usize; 3],
    /// `[z, y, x]`: x runs fastest.
    pub values: &'a [f32],
    /// Position of node (0, 0, 0).
    pub origin: Vec3,
    /// Distance between nodes along each axis, > 0.
    pub spacing: Vec3,
}

/// A level set as triangles, counter-clockwise seen from outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LevelSet {
    /// The surface: first a vertex for each crossed grid edge, then those inside cells.
    pub mesh: Mesh,
    /// Number of values that were not finite (`+inf`, `NaN` count as outside, `-inf` as inside).
    pub non_finite: usize,
    /// Inside nodes on the outer faces that were taken as outside to close the surface.
    pub capped: usize,
}

/// Sizes of the part of a level set in one part of a grid.
#[derive(Clone, Copy, Default)]
pub(super) struct PartCounts {
    /// Vertices on edges.
    pub vertices: u64,
    /// Vertices inside cells.
    pub inner: u64,
    pub triangles: u64,
}

/// Output slices of one part of a grid.
pub(super) struct PartOutput<'a> {
    /// Index of the first of `vertices`.
    pub first: u32,
    pub vertices: &'a mut [Vec3],
    pub cells: CellOutput<'a>,
}

impl LevelSet {
    /// Allocates the arrays of all parts, and divides them.
    pub(super) fn share_out(&mut self, counts: &[PartCounts]) -> Result<Vec<PartOutput<'_>>> {
        let sum = |of: fn(&PartCounts) -> u64| counts.iter().map(of).sum::<u64>();
        let (edges, inside, triangles) = (sum(|c| c.vertices), sum(|c| c.inner), sum(|c| c.triangles));
        check_count(edges + inside, triangles)?;
        self.mesh.positions = vec![Vec3::ZERO; (edges + inside) as usize];
        self.mesh.triangles = vec![[0; 3]; triangles as usize];
        let (mut vertices, mut inner) = self.mesh.positions.split_at_mut(edges as usize);
        let mut triangles = &mut self.mesh.triangles[..];
        let (mut first, mut first_inner) = (0, edges as u32);
        let part = |count: &PartCounts| {
            let own = PartOutput {
                first,
                vertices: vertices.split_off_mut(..count.vertices as usize).unwrap_or_default(),
                cells: CellOutput {
                    triangles: triangles.split_off_mut(..count.triangles as usize).unwrap_or_default(),
                    inner: inner.split_off_mut(..count.inner as usize).unwrap_or_default(),
                    first_inner,
                },
            };
            (first, first_inner) = (first + count.vertices as u32, first_inner + count.inner as u32);
            own
        };
        Ok(counts.iter().map(part).collect())
    }
}

/// Returns the zero level set of a volume.
///
/// With `closed`, nodes on the outer faces count as outside, so that a surface that leaves the box
/// is capped within a thousandth of a cell of its faces; without, the surface is open at the faces.
///
/// # Errors
///
/// Disagreeing `dims` and `values`, an axis with fewer than two nodes, more vertices or triangles
/// than 32-bit indices can name.
pub fn marching(volume: &Volume, closed: bool) -> Result<LevelSet> {
    let nodes = volume.dims.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
    if volume.dims.iter().any(|&d| d < 2) || nodes != Some(volume.values.len()) {
        let ([x, y, z], values) = (volume.dims, volume.values.len());
        let needed = x.saturating_mul(y).saturating_mul(z);
        let message = format!(
            "a volume of {x} × {y} × {z} nodes needs {needed} values (and two nodes along each axis), but has {values}"
        );
        return Err(Error::cannot(message, "values are stored x fastest, then y, then z"));
    }
    let (mut bits, all_finite) = Bits::scan(volume.values, volume.dims);
    let mut out = LevelSet::default();
    let mut values = Cow::Borrowed(volume.values);
    if !all_finite {
        values = Cow::Owned(repair(volume, &mut out));
        (bits, _) = Bits::scan(&values, volume.dims);
    }
    if closed {
        out.capped = bits.clear_border();
    }
    Passes { dims: volume.dims, values: &values, origin: volume.origin, spacing: volume.spacing, bits }
        .run(&mut out)?;
    Ok(out)
}

/// Returns where the vertex of a crossed edge lies: on the edge that leaves `node` along `axis`, at
/// `t` cells.
pub(super) fn edge_point(origin: Vec3, spacing: Vec3, node: [usize; 3], axis: usize, t: f64) -> Vec3 {
    let mut at = [0.0; 3];
    at[axis] = t;
    cell_point(origin, spacing, node, at)
}

/// Returns where an inner vertex of a cell lies.
pub(super) fn cell_point(origin: Vec3, spacing: Vec3, cell: [usize; 3], at: [f64; 3]) -> Vec3 {
    let p = DVec3::new(cell[0] as f64, cell[1] as f64, cell[2] as f64) + DVec3::from_array(at);
    (origin.as_dvec3() + p * spacing.as_dvec3()).as_vec3()
}

/// Returns a value as the interpolation may see it: a node counted as outside is never below zero.
pub(super) fn sided(value: f32, inside: bool) -> f32 {
    if inside { value } else { value.max(0.0) }
}

/// Finite stand-ins: the sign as documented, the size that of the largest finite neighbor. One
/// value per node, not per cell, so that cells agree on their common edges.
fn repair(volume: &Volume, out: &mut LevelSet) -> Vec<f32> {
    let [nx, ny, _] = volume.dims;
    let mut values = volume.values.to_vec();
    for (i, &v) in volume.values.iter().enumerate().filter(|(_, v)| !v.is_finite()) {
        let node = [i % nx, i / nx % ny, i / nx / ny];
        out.non_finite += 1;
        let size = largest_neighbor(node, volume.dims, |[x, y, z]| volume.values[(z * ny + y) * nx + x]);
        values[i] = if v == f32::NEG_INFINITY { -size } else { size };
    }
    values
}

/// Returns the size of the largest finite value among a node and its 26 neighbors; 1 without any.
pub(super) fn largest_neighbor(node: [usize; 3], dims: [usize; 3], value: impl Fn([usize; 3]) -> f32) -> f32 {
    let around = |axis: usize| node[axis].saturating_sub(1)..(node[axis] + 2).min(dims[axis]);
    let mut size = 0.0f32;
    for z in around(2) {
        for y in around(1) {
            for x in around(0) {
                let near = value([x, y, z]).abs();
                size = if near.is_finite() { size.max(near) } else { size };
            }
        }
    }
    if size > 0.0 { size } else { 1.0 }
}

struct Passes<'a> {
    dims: [usize; 3],
    values: &'a [f32],
    origin: Vec3,
    spacing: Vec3,
    bits: Bits,
}

impl Passes<'_> {
    fn run(&self, out: &mut LevelSet) -> Result<()> {
        let [_, ny, nz] = self.dims;
        // Vertices before each row's x, y and z edges, counted from the start of its plane.
        let mut rows = vec![[0u32; 3]; ny * nz];
        let planes: Vec<PartCounts> =
            rows.par_chunks_mut(ny).enumerate().map(|(k, rows)| self.count(k, rows)).collect();
        let parts = out.share_out(&planes)?;
        rows.par_chunks_mut(ny).zip(&parts).for_each(|(rows, part)| {
            rows.iter_mut().flatten().for_each(|r| *r += part.first);
        });
        parts.into_par_iter().enumerate().for_each(|(k, part)| {
            self.write_vertices(k, part.vertices);
            self.connect(k, &rows, part.cells);
        });
        Ok(())
    }

    /// Counts vertices and triangles of one plane of nodes and the layer of cells above it.
    fn count(&self, k: usize, rows: &mut [[u32; 3]]) -> PartCounts {
        let mut vertices = 0u32;
        for (j, row) in rows.iter_mut().enumerate() {
            for axis in 0..3 {
                row[axis] = vertices;
                crossings(&self.bits, j, k, axis, |_, word| vertices += word.count_ones());
            }
        }
        let mut plane = PartCounts { vertices: u64::from(vertices), ..PartCounts::default() };
        let cases = &*CASES;
        if k + 1 < self.dims[2] {
            for j in 0..self.dims[1] - 1 {
                for_each_active(&self.bits, j, k, |i, index| {
                    let case = &cases[index as usize];
                    if case.ambiguous {
                        let cell = self.cell(index, i, j, k);
                        plane.inner += cell.inner.len() as u64;
                        plane.triangles += cell.triangles.len() as u64;
                    } else {
                        plane.triangles += u64::from(case.count);
                    }
                });
            }
        }
        plane
    }

    fn cell(&self, case: u8, i: usize, j: usize, k: usize) -> CellSurface {
        let [nx, ny, _] = self.dims;
        let values = std::array::from_fn(|c| {
            let node = ((k + (c >> 2)) * ny + j + (c >> 1 & 1)) * nx + i + (c & 1);
            sided(self.values[node], case >> c & 1 == 1)
        });
        resolve(case, &values)
    }

    /// Writes the vertices of one plane's rows, in the order in which `count` counted them.
    fn write_vertices(&self, k: usize, mut vertices: &mut [Vec3]) {
        let [nx, ny, _] = self.dims;
        let step = [1, nx, nx * ny];
        for j in 0..ny {
            for axis in 0..3 {
                crossings(&self.bits, j, k, axis, |base, mut word| {
                    let (now, later) = std::mem::take(&mut vertices).split_at_mut(word.count_ones() as usize);
                    vertices = later;
                    for vertex in now {
                        let i = base + word.trailing_zeros() as usize;
                        word &= word - 1;
                        let node = (k * ny + j) * nx + i;
                        let (a, b) = (self.values[node], self.values[node + step[axis]]);
                        // Exactly one end is inside; in a closed domain the other may be a node
                        // below zero on the border, which counts as zero.
                        let inside = self.bits.get(i, j, k);
                        let t = crossing(sided(a, inside), sided(b, !inside));
                        *vertex = edge_point(self.origin, self.spacing, [i, j, k], axis, t);
                    }
                });
            }
        }
    }

    /// Writes the triangles of one layer of cells, and their inner vertices.
    fn connect(&self, k: usize, rows: &[[u32; 3]], mut out: CellOutput) {
        let [_, ny, nz] = self.dims;
        if k + 1 == nz {
            return;
        }
        let cases = &*CASES;
        for j in 0..ny - 1 {
            let (r00, r10) = (rows[k * ny + j], rows[k * ny + j + 1]);
            let (r01, r11) = (rows[(k + 1) * ny + j], rows[(k + 1) * ny + j + 1]);
            // Running indices: x edges of four rows, y edges of two, z edges of two.
            let mut next = [r00[0], r10[0], r01[0], r11[0], r00[1], r01[1], r00[2], r10[2]];
            for_each_active(&self.bits, j, k, |i, index| {
                let case = &cases[index as usize];
                let step = &case.advance;
                // A crossed y or z edge at the near side of the cell comes before the one at its
                // far side; the x edges have one each.
                let ids = [
                    next[0],
                    next[1],
                    next[2],
                    next[3],
                    next[4],
                    next[4] + step[4],
                    next[5],
                    next[5] + step[5],
                    next[6],
                    next[6] + step[6],
                    next[7],
                    next[7] + step[7],
                ];
                let resolved = case.ambiguous.then(|| self.cell(index, i, j, k));
                let point = |at| cell_point(self.origin, self.spacing, [i, j, k], at);
                out.write(case, resolved, &ids, point);
                next.iter_mut().zip(step).for_each(|(n, s)| *n += s);
            });
        }
    }
}

/// One bit a node, set where the value is below zero; rows along x start at a fresh word.
pub(super) struct Bits {
    words: Vec<u64>,
    per_row: usize,
    dims: [usize; 3],
}

impl Bits {
    /// Reads all values once; also says whether all of them are finite.
    fn scan(values: &[f32], dims: [usize; 3]) -> (Bits, bool) {
        let [nx, ny, nz] = dims;
        let per_row = nx.div_ceil(64);
        let mut words = vec![0u64; per_row * ny * nz];
        let all_finite = words
            .par_chunks_mut(per_row * ny)
            .zip(values.par_chunks(nx * ny))
            .map(|(words, values)| {
                let mut finite = true;
                for (words, row) in words.chunks_mut(per_row).zip(values.chunks(nx)) {
                    let (whole, rest) = row.as_chunks::<64>();
                    for (word, chunk) in words.iter_mut().zip(whole) {
                        let (bits, good) = below_zero(chunk);
                        *word = bits;
                        finite &= good;
                    }
                    if !rest.is_empty() {
                        let (bits, good) = below_zero_short(rest);
                        words[whole.len()] = bits;
                        finite &= good;
                    }
                }
                finite
            })
            .reduce(|| true, |a, b| a & b);
        (Bits { words, per_row, dims }, all_finite)
    }

    fn row(&self, j: usize, k: usize) -> &[u64] {
        let start = (k * self.dims[1] + j) * self.per_row;
        &self.words[start..start + self.per_row]
    }

    /// Returns whether this node is inside.
    pub(super) fn get(&self, i: usize, j: usize, k: usize) -> bool {
        self.row(j, k)[i / 64] >> (i % 64) & 1 == 1
    }

    /// Takes the nodes on the six outer faces as outside; how many were inside.
    fn clear_border(&mut self) -> usize {
        let [nx, ny, nz] = self.dims;
        let mut cleared = 0;
        for k in 0..nz {
            for j in 0..ny {
                let start = (k * ny + j) * self.per_row;
                let row = &mut self.words[start..start + self.per_row];
                if k == 0 || k == nz - 1 || j == 0 || j == ny - 1 {
                    cleared += row.iter().map(|w| w.count_ones() as usize).sum::<usize>();
                    row.fill(0);
                } else {
                    for i in [0, nx - 1] {
                        let word = &mut row[i / 64];
                        cleared += (*word >> (i % 64) & 1) as usize;
                        *word &= !(1 << (i % 64));
                    }
                }
            }
        }
        cleared
    }
}

/// Calls `found(first node, word)` for every non-zero word of crossed edges that leave the nodes of
/// row (j, k) along `axis`.
#[inline]
pub(super) fn crossings(bits: &Bits, j: usize, k: usize, axis: usize, mut found: impl FnMut(usize, u64)) {
    let [nx, ny, nz] = bits.dims;
    let here = bits.row(j, k);
    let next_layer = match axis {
        0 => {
            for w in 0..here.len() {
                let next = here.get(w + 1).copied().unwrap_or(0);
                let word = (here[w] ^ (here[w] >> 1 | next << 63)) & below(nx - 1, w);
                if word != 0 {
                    found(64 * w, word);
                }
            }
            return;
        }
        1 if j + 1 < ny => bits.row(j + 1, k),
        2 if k + 1 < nz => bits.row(j, k + 1),
        _ => return,
    };
    for (w, (a, b)) in here.iter().zip(next_layer).enumerate() {
        if a != b {
            found(64 * w, a ^ b);
        }
    }
}

/// Returns the bits of word `w` that stand for positions before `end`.
#[inline]
fn below(end: usize, w: usize) -> u64 {
    match end.saturating_sub(64 * w) {
        n @ 0..64 => (1 << n) - 1,
        _ => u64::MAX,
    }
}

/// Calls `visit(i, case)` for every cell (i, j, k) of a row that the surface crosses.
#[inline]
fn for_each_active(bits: &Bits, j: usize, k: usize, mut visit: impl FnMut(usize, u8)) {
    let rows = [bits.row(j, k), bits.row(j + 1, k), bits.row(j, k + 1), bits.row(j + 1, k + 1)];
    let words = bits.per_row;
    let [r0, r1, r2, r3] = rows.map(|r| &r[..words]);
    for w in 0..words {
        let now = [r0[w], r1[w], r2[w], r3[w]];
        let next = if w + 1 < words { [r0[w + 1], r1[w + 1], r2[w + 1], r3[w + 1]] } else { [0; 4] };
        let all = now[0] & now[1] & now[2] & now[3];
        let any = now[0] | now[1] | now[2] | now[3];
        let all_next = next[0] & next[1] & next[2] & next[3];
        let any_next = next[0] | next[1] | next[2] | next[3];
        let mut active = (any | any >> 1 | any_next << 63)
            & !(all & (all >> 1 | all_next << 63))
            & below(bits.dims[0] - 1, w);
        while active != 0 {
            let i = active.trailing_zeros();
            active &= active - 1;
            // Two neighboring bits of each row; the second may be the next word's first.
            let pair = |r: usize| ((now[r] >> i | next[r] << 1 << (63 - i)) & 3) as u8;
            visit(64 * w + i as usize, pair(0) | pair(1) << 2 | pair(2) << 4 | pair(3) << 6);
        }
    }
}

fn below_zero_short(values: &[f32]) -> (u64, bool) {
    values
        .iter()
        .enumerate()
        .fold((0, true), |(word, finite), (i, v)| (word | u64::from(*v < 0.0) << i, finite & v.is_finite()))
}

/// SSE2, which every x86-64 has: sixteen comparisons to a mask at a time. `v − v` is NaN exactly
/// when v is not finite, and a sum keeps it.
#[cfg(target_arch = "x86_64")]
#[inline]
fn below_zero(values: &[f32; 64]) -> (u64, bool) {
    use std::arch::x86_64::*;
    // SAFETY: the intrinsics need SSE2, part of the x86-64 baseline; each load reads four floats at
    // 16 q + 4 s <= 60 of the 64, and unaligned loads need no alignment.
    unsafe {
        let zero = _mm_setzero_ps();
        let mut sum = [zero; 4];
        let mut word = 0;
        for q in 0..4 {
            let mut less = [zero; 4];
            for s in 0..4 {
                let v = _mm_loadu_ps(values.as_ptr().add(16 * q + 4 * s));
                less[s] = _mm_cmplt_ps(v, zero);
                sum[s] = _mm_add_ps(sum[s], _mm_sub_ps(v, v));
            }
            let low = _mm_packs_epi32(_mm_castps_si128(less[0]), _mm_castps_si128(less[1]));
            let high = _mm_packs_epi32(_mm_castps_si128(less[2]), _mm_castps_si128(less[3]));
            word |= (_mm_movemask_epi8(_mm_packs_epi16(low, high)) as u32 as u64) << (16 * q);
        }
        let sum = _mm_add_ps(_mm_add_ps(sum[0], sum[1]), _mm_add_ps(sum[2], sum[3]));
        (word, _mm_movemask_ps(_mm_cmpunord_ps(sum, sum)) == 0)
    }
}

#[cfg(not(target_arch = "x86_64"))]
#[inline]
fn below_zero(values: &[f32; 64]) -> (u64, bool) {
    below_zero_short(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube<'a>(n: usize, values: &'a [f32]) -> Volume<'a> {
        Volume { dims: [n; 3], values, origin: Vec3::ZERO, spacing: Vec3::ONE }
    }

    #[test]
    fn a_lone_inside_node_is_an_octahedron() {
        // Node (1, 1, 1) at -1 among +1: six crossings half way along its edges. The octahedron
        // with half axes ½ has volume 4/3 · (1/2)³ = 1/6, eight faces.
        let mut v = vec![1.0; 27];
        v[13] = -1.0;
        let s = marching(&cube(3, &v), false).unwrap();
        let mesh = s.mesh;
        assert_eq!((mesh.positions.len(), mesh.triangles.len()), (6, 8));
        assert!(mesh.is_closed());
        assert!((mesh.signed_volume() - 1.0 / 6.0).abs() < 1e-6);
    }

    #[test]
    fn a_volume_without_a_surface_is_empty_and_a_full_one_is_capped() {
        assert!(marching(&cube(4, &[1.0; 64]), true).unwrap().mesh.triangles.is_empty());
        assert!(marching(&cube(4, &[-1.0; 64]), false).unwrap().mesh.triangles.is_empty());
        let full = marching(&cube(4, &[-1.0; 64]), true).unwrap();
        // 64 nodes, 8 of them inside the outer faces.
        assert_eq!(full.capped, 56);
        assert!(!full.mesh.triangles.is_empty());
    }

    #[test]
    fn sizes_that_disagree_are_an_error_that_says_both() {
        let e = marching(&cube(4, &[1.0; 63]), true).unwrap_err().to_string();
        assert!(e.contains("64") && e.contains("63"), "{e}");
        assert!(marching(&cube(1, &[1.0]), true).is_err());
    }

    #[test]
    fn what_is_not_finite_is_counted_and_takes_the_size_of_its_neighbors() {
        let mut v = vec![2.0; 27];
        v[13] = f32::NEG_INFINITY;
        v[4] = f32::NAN;
        let s = marching(&cube(3, &v), false).unwrap();
        assert_eq!(s.non_finite, 2);
        // -2 against +2: half way.
        assert!(s.mesh.positions.iter().all(|p| p.is_finite() && (*p - Vec3::ONE).length() == 0.5));
    }

    #[test]
    fn the_wide_scan_agrees_with_the_plain_one() {
        let mut v: [f32; 64] = std::array::from_fn(|i| ((i * 37) % 11) as f32 - 5.0);
        (v[3], v[4]) = (-0.0, -1e-45);
        assert_eq!(below_zero(&v), below_zero_short(&v));
        assert_eq!(below_zero(&v).0 >> 3 & 3, 0b10, "-0.0 is outside, the smallest negative inside");
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for at in [0, 17, 63] {
                let mut w = v;
                w[at] = bad;
                assert_eq!(below_zero(&w), below_zero_short(&w));
                assert!(!below_zero(&w).1);
            }
        }
    }

    #[test]
    fn a_cell_across_two_words_gets_bits_of_both() {
        // 66 × 2 × 2 nodes, only node 64 of the first row inside: cells 63 and 64 are crossed.
        let mut v = vec![1.0; 66 * 4];
        v[64] = -1.0;
        let (bits, _) = Bits::scan(&v, [66, 2, 2]);
        let mut seen = Vec::new();
        for_each_active(&bits, 0, 0, |i, case| seen.push((i, case)));
        assert_eq!(seen, [(63, 2), (64, 1)]);
        let mut edges = Vec::new();
        crossings(&bits, 0, 0, 0, |base, word| edges.push((base, word)));
        assert_eq!(edges, [(0, 1 << 63), (64, 1)]);
    }
}
