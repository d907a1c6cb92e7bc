//! The random numbers of [`tiface_base::math::rng`], with the same bits. 64-bit words are pairs of
//! 32-bit words, because not every adapter has 64-bit integers.

use burn::cubecl::{self, prelude::*};
use tiface_base::math::rng;

/// A word of 64 bits.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub(super) struct Wide {
    pub high: u32,
    pub low: u32,
}

/// Returns the lower 64 bits of a product.
#[cube]
fn times(a: Wide, #[comptime] high: u32, #[comptime] low: u32) -> Wide {
    Wide { high: u32::mul_hi(a.low, low) + a.low * high + a.high * low, low: a.low * low }
}

/// Returns `a ^ (a >> bits)`, for `bits` below 32.
#[cube]
fn xor_shifted(a: Wide, #[comptime] bits: u32) -> Wide {
    Wide {
        high: a.high ^ (a.high >> bits),
        low: a.low ^ ((a.low >> bits) | (a.high << comptime!(32 - bits))),
    }
}

/// Returns 64 random bits for number `index` of a stream, whose key [`stream`] returns.
#[cube]
pub(super) fn bits(stream: &Wide, index: u32) -> Wide {
    let step = times(Wide { high: 0u32, low: index }, 0x9e37_79b9u32, 0x7f4a_7c15u32);
    let sum = stream.low + step.low;
    let carry = select(sum < stream.low, 1u32, 0u32);
    mix(Wide { high: stream.high + step.high + carry, low: sum })
}

/// Returns SplitMix64's finalizer of a word.
#[cube]
fn mix(z: Wide) -> Wide {
    let z = xor_shifted(z, 30u32);
    let z = xor_shifted(times(z, 0xbf58_476du32, 0x1ce4_e5b9u32), 27u32);
    xor_shifted(times(z, 0x94d0_49bbu32, 0x1331_11ebu32), 31u32)
}

/// Returns number `i` of the permutation of `0..n`, n > 0, of [`rng::Permutation`].
#[cube]
pub(super) fn permuted(key: &Wide, half_bits: u32, i: u32, n: u32) -> u32 {
    let lower = (1u32 << half_bits) - 1;
    let mut x = i;
    let mut inside = false;
    while !inside {
        let mut left = x >> half_bits;
        let mut right = x & lower;
        #[unroll]
        for round in 0..4u32 {
            let stream = mix(Wide { high: key.high, low: key.low ^ round });
            let mixed = bits(&stream, right).low & lower;
            let next = left ^ mixed;
            left = right;
            right = next;
        }
        x = (left << half_bits) | right;
        inside = x < n;
    }
    x
}

/// Returns a uniform number in [0, 1).
#[cube]
pub(super) fn uniform(stream: &Wide, index: u32) -> f32 {
    f32::cast_from(bits(stream, index).high >> 8) / 16_777_216.0f32
}

/// Returns a uniform integer in `0..n`, n > 0.
#[cube]
pub(super) fn below(stream: &Wide, index: u32, n: u32) -> u32 {
    let drawn = bits(stream, index);
    let middle = drawn.high * n;
    let sum = middle + u32::mul_hi(drawn.low, n);
    u32::mul_hi(drawn.high, n) + select(sum < middle, 1u32, 0u32)
}

/// Returns the key of a stream, which all of its numbers share.
pub(super) fn stream(seed: u64, stream: u64) -> WideLaunch {
    word(rng::stream_key(seed, stream))
}

/// Returns a word as an argument of a launch.
pub(super) fn word(bits: u64) -> WideLaunch {
    WideLaunch::new((bits >> 32) as u32, bits as u32)
}

#[cfg(test)]
mod tests {
    use super::super::device::{Words, groups, launch};
    use super::super::testing::device;
    use super::*;

    #[cube(launch)]
    fn draws(out: &mut [u32], stream: Wide, n: u32) {
        let i = ABSOLUTE_POS;
        let count = out.len() / 4;
        if i < count {
            let index = u32::cast_from(i) * 7_919;
            let random = bits(&stream, index);
            out[i] = random.high;
            out[count + i] = random.low;
            out[2 * count + i] = below(&stream, index, n);
            out[3 * count + i] = u32::reinterpret(uniform(&stream, index));
        }
    }

    #[test]
    fn every_bit_is_that_of_the_cpu() {
        let Some(device) = device() else { return };
        const COUNT: usize = 1 << 12;
        for (seed, of, n) in [(0, 0, 1), (42, 1 << 40 | 3, 289_123_456), (u64::MAX, u64::MAX, u32::MAX)] {
            let out = device.scratch::<u32>(4 * COUNT);
            launch!(device, draws::launch, groups(COUNT / 256), 256; out; stream(seed, of), n);
            let out = device.read::<u32>(&out);
            for i in 0..COUNT {
                let index = 7_919 * i as u64;
                let want = rng::bits(seed, of, index);
                assert_eq!([out[i], out[COUNT + i]], [(want >> 32) as u32, want as u32]);
                assert_eq!(out[2 * COUNT + i] as u64, rng::below(seed, of, index, n as u64));
                assert_eq!(out[3 * COUNT + i], rng::uniform(seed, of, index).to_bits());
            }
        }
    }
}
