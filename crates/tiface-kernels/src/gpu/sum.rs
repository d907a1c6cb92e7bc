//! Sums over threads: atomic addition to one word, by [`Atomics`](super::Atomics), and sums over a
//! group in a fixed order.

use burn::cubecl::{self, prelude::*};

/// Integer to which the bound on a fixed-point sum is scaled. The margin up to 2³¹ allows for the
/// rounding of 10⁸ terms.
pub const FIXED_POINT_RANGE: f32 = 2e9;

/// Returns the sum over the threads of a group, in their order, to the first thread; the others
/// get 0.
#[cube]
pub fn group_sum<N: Numeric>(value: N, #[comptime] units: usize) -> N {
    let mut values = Shared::<[N]>::new_slice(units);
    values[UNIT_POS as usize] = value;
    sync_cube();
    let mut sum = N::from_int(0);
    if UNIT_POS == 0 {
        for i in 0..units {
            sum += values[i];
        }
    }
    sum
}

/// A way to add floats to one word from many threads.
#[cube]
pub trait Sum: Send + Sync + 'static {
    /// Type of the word in memory.
    type Word: CubePrimitive;

    /// Adds `v`; fixed-point words count steps of `1 / unit`.
    fn add(word: &Atomic<Self::Word>, v: f32, unit: f32);
}

/// Addition by [`Atomics::Native`](super::Atomics::Native).
pub struct Native;
/// Addition by [`Atomics::Exchange`](super::Atomics::Exchange).
pub struct Exchange;
/// Fixed-point addition by [`Atomics::Fixed`](super::Atomics::Fixed).
pub struct Fixed;

#[cube]
impl Sum for Native {
    type Word = f32;

    fn add(word: &Atomic<f32>, v: f32, _unit: f32) {
        word.fetch_add(v);
    }
}

#[cube]
impl Sum for Exchange {
    type Word = u32;

    fn add(word: &Atomic<u32>, v: f32, _unit: f32) {
        // Each iteration takes the value of the word and leaves 0, writes back the sum, and
        // continues with whatever other threads wrote in between. A weak compare-exchange could
        // fail spuriously without reporting it.
        let mut pending = v;
        while pending != 0.0f32 {
            let found = f32::reinterpret(word.exchange(0u32));
            pending = f32::reinterpret(word.exchange(u32::reinterpret(found + pending)));
        }
    }
}

#[cube]
impl Sum for Fixed {
    type Word = i32;

    fn add(word: &Atomic<i32>, v: f32, unit: f32) {
        word.fetch_add(i32::cast_from((v * unit).round()));
    }
}
