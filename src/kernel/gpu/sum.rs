//! Sums of many threads: into one place by [`Atomics`](super::Atomics), and of a group in a fixed order.

use burn::cubecl::{self, prelude::*};

/// Steps that the bound on a sum is counted in: what is left up to 2³¹ takes the rounding of 10⁸ terms.
pub const MOST: f32 = 2e9;

/// Returns the sum over the threads of a group, in their order, to the first of them.
#[cube]
pub fn group_sum<N: Numeric>(own: N, #[comptime] units: usize) -> N {
    let mut all = Shared::<[N]>::new_slice(units);
    all[UNIT_POS as usize] = own;
    sync_cube();
    let mut sum = N::from_int(0);
    if UNIT_POS == 0 {
        for i in 0..units {
            sum += all[i];
        }
    }
    sum
}

/// A word that threads add floats to.
#[cube]
pub trait Sum: Send + Sync + 'static {
    /// What lies in memory.
    type Word: CubePrimitive;

    /// Adds `v`, where words count it in steps of `1 / unit`.
    fn add(word: &Atomic<Self::Word>, v: f32, unit: f32);
}

/// [`Atomics::Native`](super::Atomics::Native).
pub struct Native;
/// [`Atomics::Exchange`](super::Atomics::Exchange).
pub struct Exchange;
/// [`Atomics::Fixed`](super::Atomics::Fixed).
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
        // takes what lies there, puts it back with its own, and goes on with what came between: a weak comparison may
        // fail without telling so
        let mut own = v;
        while own != 0.0f32 {
            let found = f32::reinterpret(word.exchange(0u32));
            own = f32::reinterpret(word.exchange(u32::reinterpret(found + own)));
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
