//! Inside bits of a volume, 64 nodes of a row to a word, and the scans over them.

use rayon::prelude::*;

/// One bit a node, set where the value is below zero; rows along x start at a fresh word.
pub(super) struct Bits {
    words: Vec<u64>,
    per_row: usize,
    dims: [usize; 3],
}

impl Bits {
    /// Reads all values once; also says whether all of them are finite.
    pub(super) fn scan(values: &[f32], dims: [usize; 3]) -> (Bits, bool) {
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

    /// Is this node inside?
    pub(super) fn get(&self, i: usize, j: usize, k: usize) -> bool {
        self.row(j, k)[i / 64] >> (i % 64) & 1 == 1
    }

    /// Takes the nodes on the six outer faces as outside; how many were inside.
    pub(super) fn clear_border(&mut self) -> usize {
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

/// Calls `found(first node, word)` for every non-zero word of crossed edges that leave the nodes of row
/// (j, k) along `axis`.
#[inline]
pub(super) fn crossings(bits: &Bits, j: usize, k: usize, axis: usize, mut found: impl FnMut(usize, u64)) {
    let [nx, ny, nz] = bits.dims;
    let here = bits.row(j, k);
    let there = match axis {
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
    for (w, (a, b)) in here.iter().zip(there).enumerate() {
        if a != b {
            found(64 * w, a ^ b);
        }
    }
}

/// The bits of word `w` that stand for positions before `end`.
#[inline]
fn below(end: usize, w: usize) -> u64 {
    match end.saturating_sub(64 * w) {
        n @ 0..64 => (1 << n) - 1,
        _ => u64::MAX,
    }
}

/// Calls `visit(i, case)` for every cell (i, j, k) of a row that the surface crosses.
#[inline]
pub(super) fn for_each_active(bits: &Bits, j: usize, k: usize, mut visit: impl FnMut(usize, u8)) {
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
            // Two neighbouring bits of each row; the second may be the next word's first.
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

/// SSE2, which every x86-64 has: sixteen comparisons to a mask at a time. `v − v` is NaN exactly when v
/// is not finite, and a sum keeps it.
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
