//! Random numbers without state: a hash of (seed, stream, index).
//!
//! A step's draws depend on the step's number alone, so resuming needs no generator state and any
//! number of threads draws the same numbers. SplitMix64's finalizer (Steele, Lea, Flood 2014).

/// Returns 64 random bits for number `index` of a stream.
#[inline]
pub fn bits(seed: u64, stream: u64, index: u64) -> u64 {
    mix(stream_key(seed, stream).wrapping_add(index.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
}

/// Returns the key of a stream, which all of its numbers share.
#[inline]
pub fn stream_key(seed: u64, stream: u64) -> u64 {
    mix(mix(seed ^ 0x9e37_79b9_7f4a_7c15) ^ stream)
}

/// Returns SplitMix64's finalizer of a word, a bijective hash.
#[inline]
pub fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Returns a uniform number in [0, 1).
#[inline]
pub fn uniform(seed: u64, stream: u64, index: u64) -> f32 {
    (bits(seed, stream, index) >> 40) as f32 / (1u64 << 24) as f32
}

/// Returns a uniform integer in `0..n`, n > 0.
#[inline]
pub fn below(seed: u64, stream: u64, index: u64, n: u64) -> u64 {
    ((bits(seed, stream, index) as u128 * n as u128) >> 64) as u64
}

/// A random permutation of `0..n` that is computed, not stored: four rounds of a Feistel network
/// over the next power of four, repeated until the result is below n (cycle walking; Black and
/// Rogaway 2002, "Ciphers with arbitrary finite domains").
#[derive(Clone, Copy, Debug)]
pub struct Permutation {
    /// Key that the streams of all rounds are derived from.
    pub key: u64,
    /// Number of bits of each half of the Feistel network.
    pub half_bits: u32,
    /// Position of the first number of the current step.
    pub first: u64,
    n: u64,
}

impl Permutation {
    /// Returns the permutation of `0..n`, n > 0, for a key.
    pub fn new(key: u64, n: u64) -> Permutation {
        let half_bits = (64 - (n - 1).leading_zeros()).div_ceil(2).max(1);
        Permutation { key: mix(key ^ 0x9e37_79b9_7f4a_7c15), half_bits, first: 0, n }
    }

    /// Returns the permutation whose first `count` numbers a step uses. Successive steps use
    /// successive numbers, so no number repeats until fewer than `count` are left; then a new
    /// permutation begins.
    pub fn of_step((seed, step): (u64, u64), count: u64, n: u64) -> Permutation {
        let steps = (n / count).max(1);
        let first = step % steps * count;
        Permutation { first, ..Permutation::new(bits(seed, 13, step / steps), n) }
    }

    /// Returns number `i` of the step, or `None` past the end of the permutation.
    #[inline]
    pub fn get(&self, i: u64) -> Option<u64> {
        let mut x = Some(self.first + i).filter(|&x| x < self.n)?;
        let lower = (1u64 << self.half_bits) - 1;
        loop {
            let (mut left, mut right) = (x >> self.half_bits, x & lower);
            for round in 0..4 {
                let mixed =
                    mix(mix(self.key ^ round).wrapping_add(right.wrapping_mul(0x9e37_79b9_7f4a_7c15)));
                (left, right) = (right, left ^ (mixed & lower));
            }
            x = left << self.half_bits | right;
            if x < self.n {
                return Some(x);
            }
        }
    }
}

/// Returns a standard normal number (Box, Muller 1958).
#[inline]
pub fn normal(seed: u64, stream: u64, index: u64) -> f32 {
    let (u, v) = (uniform(seed, stream, 2 * index), uniform(seed, stream, 2 * index + 1));
    (-2.0 * (1.0 - u as f64).ln()).sqrt() as f32 * (std::f32::consts::TAU * v).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_the_distributions() {
        let n = 100_000;
        let mean: f64 = (0..n).map(|i| uniform(1, 2, i) as f64).sum::<f64>() / n as f64;
        assert!((mean - 0.5).abs() < 0.005);
        let (mut sum, mut square) = (0f64, 0f64);
        for i in 0..n {
            let x = normal(1, 3, i) as f64;
            sum += x;
            square += x * x;
        }
        assert!((sum / n as f64).abs() < 0.02 && (square / n as f64 - 1.0).abs() < 0.03);
        assert!((0..1000).all(|i| below(5, 6, i, 7) < 7));
        assert_ne!(bits(1, 2, 3), bits(1, 3, 2));
    }

    #[test]
    fn a_permutation_has_every_number_once_and_another_order_for_every_key() {
        for n in [1, 2, 3, 64, 65, 1000] {
            let permuted =
                |key: u64| (0..n).map(|i| Permutation::new(key, n).get(i).unwrap()).collect::<Vec<u64>>();
            let mut sorted = permuted(7);
            sorted.sort_unstable();
            assert_eq!(sorted, (0..n).collect::<Vec<u64>>());
            assert!(n < 64 || permuted(7) != permuted(8));
        }
        // consecutive numbers are uncorrelated: on average they are a third of 1000 apart
        let permuted: Vec<u64> = (0..1000).map(|i| Permutation::new(3, 1000).get(i).unwrap()).collect();
        let distance = permuted.windows(2).map(|w| w[0].abs_diff(w[1])).sum::<u64>() as f64 / 999.0;
        assert!((distance - 333.0).abs() < 30.0, "{distance}");
    }
}
