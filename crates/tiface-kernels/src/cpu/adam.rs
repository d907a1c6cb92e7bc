//! Fused AdamW (Kingma, Ba 2015; Loshchilov, Hutter 2019), one pass over memory.
//!
//! `m ← β₁ m + (1−β₁) g`,  `v ← β₂ v + (1−β₂) g²`,
//! `p ← p − lr · (λ p + m̂ / (√v̂ + ε))` with `m̂ = m / (1−β₁ᵗ)`, `v̂ = v / (1−β₂ᵗ)`

use super::simd::fma;
use rayon::prelude::*;
use tiface_base::dispatch;

/// Constants of one AdamW step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamStep {
    /// Learning rate of this step.
    pub lr: f32,
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
    /// Decoupled weight decay λ; each step takes `lr · λ` of the weight.
    pub weight_decay: f32,
    /// Step number, from 1, for the bias corrections.
    pub step: u64,
    /// Leave weights whose gradient is exactly zero alone, moments included: rows of a hash table
    /// that no sample touched must not drift on old momentum (Müller et al. 2022 do the same).
    pub skip_zero: bool,
}

impl AdamStep {
    /// Returns a step over all weights, without weight decay, whose moments decay as published for
    /// hash grids and TensoRF (β₁ = 0.9, β₂ = 0.99).
    pub fn new(lr: f64, epsilon: f32, step: u64) -> AdamStep {
        let (beta1, beta2) = (0.9, 0.99);
        AdamStep { lr: lr as f32, beta1, beta2, epsilon, weight_decay: 0.0, step, skip_zero: false }
    }
}

/// Number of weights that are skipped together: a line of the cache.
const BLOCK: usize = 16;

/// Number of weights that are fetched together, 32 blocks.
const GROUP: usize = 32 * BLOCK;

/// Returns the blocks of the group at `first` that a step changes, a bit each, and has the CPU
/// fetch their values and moments: its own prefetching cannot predict which ones are skipped.
#[inline(always)]
fn touched(p: &[f32], m: &[f32], v: &[f32], g: &[f32], first: usize, skip_zero: bool) -> u32 {
    let group = &g[first.min(g.len())..(first + GROUP).min(g.len())];
    let mut blocks = 0;
    for (i, block) in group.chunks(BLOCK).enumerate() {
        let mut any = !skip_zero;
        for &g in block {
            any |= g != 0.0;
        }
        blocks |= u32::from(any) << i;
        #[cfg(target_arch = "x86_64")]
        if any {
            use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
            for values in [p, m, v] {
                let at = values.as_ptr().wrapping_add(first + BLOCK * i);
                // SAFETY: any address may be fetched ahead; those that are not mapped are ignored.
                unsafe { _mm_prefetch::<_MM_HINT_T0>(at.cast()) };
            }
        }
    }
    blocks
}

#[inline(always)]
fn adam_body<const F: bool>(p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &mut [f32], s: &AdamStep) {
    let c1 = (1.0 / (1.0 - (s.beta1 as f64).powf(s.step as f64))) as f32;
    let c2 = (1.0 / (1.0 - (s.beta2 as f64).powf(s.step as f64))) as f32;
    let keep = 1.0 - s.lr * s.weight_decay;
    let n = p.len();
    assert!(m.len() == n && v.len() == n && g.len() == n);
    let mut next = touched(p, m, v, g, 0, s.skip_zero);
    for group in (0..n).step_by(GROUP) {
        let mut blocks = next;
        next = touched(p, m, v, g, group + GROUP, s.skip_zero);
        while blocks != 0 {
            let first = group + BLOCK * blocks.trailing_zeros() as usize;
            blocks &= blocks - 1;
            let span = first..(first + BLOCK).min(n);
            let (pi, mi) = (&mut p[span.clone()], &mut m[span.clone()]);
            let (vi, gi) = (&mut v[span.clone()], &mut g[span]);
            for k in 0..gi.len() {
                let g = gi[k];
                let m1 = fma::<F>(s.beta1, mi[k], (1.0 - s.beta1) * g);
                let v1 = fma::<F>(s.beta2, vi[k], (1.0 - s.beta2) * g * g);
                let p1 = fma::<F>(pi[k], keep, -s.lr * (m1 * c1) / ((v1 * c2).sqrt() + s.epsilon));
                let idle = s.skip_zero && g == 0.0;
                mi[k] = if idle { mi[k] } else { m1 };
                vi[k] = if idle { vi[k] } else { v1 };
                pi[k] = if idle { pi[k] } else { p1 };
                gi[k] = 0.0;
            }
        }
    }
}

dispatch! {
    fn adam_chunk / adam_body(p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &mut [f32], s: &AdamStep)
}

/// Takes one AdamW step in place. The gradient is **left zero**, so that the next one can be
/// accumulated in the same memory without a pass to clear it.
///
/// # Shapes
///
/// All four `[n]`.
pub fn adam(p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &mut [f32], step: &AdamStep) {
    const CHUNK: usize = 1 << 15;
    p.par_chunks_mut(CHUNK)
        .zip(m.par_chunks_mut(CHUNK))
        .zip(v.par_chunks_mut(CHUNK))
        .zip(g.par_chunks_mut(CHUNK))
        .for_each(|(((p, m), v), g)| adam_chunk(p, m, v, g, step));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step() -> AdamStep {
        AdamStep { skip_zero: true, ..AdamStep::new(0.1, 1e-15, 1) }
    }

    #[test]
    fn the_first_step_moves_by_the_learning_rate_against_the_sign() {
        // m̂ = g, v̂ = g², so m̂/√v̂ = sign(g): 1 − 0.1 and 1 + 0.1; zero gradient stays
        let (mut p, mut m, mut v) = ([1.0; 3], [0.0; 3], [0.0; 3]);
        let mut g = [0.3, -5.0, 0.0];
        adam(&mut p, &mut m, &mut v, &mut g, &step());
        assert!((p[0] - 0.9).abs() < 1e-6 && (p[1] - 1.1).abs() < 1e-6 && p[2] == 1.0);
        assert_eq!(g, [0.0; 3]);
    }

    #[test]
    fn untouched_rows_keep_their_momentum_and_do_not_move() {
        let (mut p, mut m, mut v) = ([1.0; 20], [0.5; 20], [0.5; 20]);
        let mut g = [0.0; 20];
        g[3] = 1.0;
        adam(&mut p, &mut m, &mut v, &mut g, &AdamStep { step: 7, ..step() });
        assert!(p[3] != 1.0);
        assert!((0..20).filter(|&i| i != 3).all(|i| p[i] == 1.0 && m[i] == 0.5 && v[i] == 0.5));
    }

    #[test]
    fn dense_steps_decay_weights_that_have_no_gradient() {
        // p = 1 · (1 − 0.1 · 0.01) = 0.999
        let (mut p, mut m, mut v, mut g) = ([1.0], [0.0], [0.0], [0.0]);
        let step = AdamStep { weight_decay: 0.01, ..AdamStep::new(0.1, 1e-8, 1) };
        adam(&mut p, &mut m, &mut v, &mut g, &step);
        assert!((p[0] - 0.999).abs() < 1e-7);
    }

    #[test]
    fn a_weight_gets_the_same_step_among_many_as_alone() {
        // more than two groups, with a part of one; every third block has no gradient
        const N: usize = 2 * GROUP + 5 * BLOCK + 3;
        let wave = |i: usize, k: f32| ((i as f32 + 0.5) * k).sin();
        for skip_zero in [false, true] {
            let step = AdamStep { skip_zero, weight_decay: 0.01, ..AdamStep::new(0.1, 1e-8, 3) };
            let gradient =
                |i: usize| if i / BLOCK % 3 == 1 || i.is_multiple_of(7) { 0.0 } else { wave(i, 2.3) };
            let start = |i: usize| [wave(i, 0.7), wave(i, 1.1), wave(i, 1.9).abs(), gradient(i)];
            let mut all: [Vec<f32>; 4] = std::array::from_fn(|k| (0..N).map(|i| start(i)[k]).collect());
            let [p, m, v, g] = &mut all;
            adam(p, m, v, g, &step);
            for i in 0..N {
                let [p, m, v, g] = &mut start(i).map(|x| [x]);
                adam(p, m, v, g, &step);
                assert_eq!(all.each_ref().map(|x| x[i]), [p[0], m[0], v[0], g[0]], "{i}");
            }
        }
    }
}
