//! Selection of an item by its number: binary search in running counts.

use burn::cubecl::{self, prelude::*};

/// Returns the first of `values[first..end]` that exceeds `v`, of non-decreasing values; only every
/// `stride`-th counts, and indices count those.
#[cube]
pub(super) fn upper_bound(
    values: &[u32],
    first: usize,
    end: usize,
    v: u32,
    #[comptime] stride: usize,
) -> usize {
    let mut low = first;
    let mut high = end;
    while low < high {
        let middle = (low + high) / 2;
        if values[middle * stride] <= v {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    low
}

/// Returns the bit of the words `first..first + words` of a mask that has so many set bits before
/// it; `before` holds the count before each word.
#[cube]
pub(super) fn ranked(before: &[u32], mask: &[u32], first: usize, words: usize, rank: u32) -> u32 {
    let word = upper_bound(before, first, first + words, rank, 1usize) - 1;
    let mut bits = mask[word];
    for _ in before[word]..rank {
        // clears the lowest bit
        bits &= bits - 1;
    }
    32 * u32::cast_from(word - first) + bits.trailing_zeros()
}
