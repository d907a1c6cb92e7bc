//! What this machine can do at most, measured when a bench starts: the share of it that a kernel
//! reaches says what is left to gain.

use super::cpu_s;
use std::hint::black_box;
use tiface_base::dispatch;

/// Peak rates of all threads together, per CPU second.
pub struct Roof {
    /// f32 operations, of which a fused multiply-add is two.
    pub operations: f64,
    /// Bytes read or written.
    pub bytes: f64,
}

/// Independent sums, of two vectors each: enough to hide the latency of an addition, and few enough
/// to stay in registers.
const CHAINS: usize = 4;
/// Multiply-adds of each number of a call.
const ROUNDS: usize = 1 << 16;
/// Floats of each of the three arrays that a thread streams through: beyond any cache.
const STREAM: usize = 1 << 24;

#[inline(always)]
fn chains<const F: bool, const W: usize>(out: &mut f32) {
    let (factor, term) = (black_box(0.999f32), black_box(1e-3f32));
    let mut sums = [[0f32; W]; CHAINS];
    for _ in 0..ROUNDS {
        for i in 0..CHAINS {
            for l in 0..W {
                let v = sums[i][l];
                sums[i][l] = if F { v.mul_add(factor, term) } else { v * factor + term };
            }
        }
    }
    *out = sums.as_flattened().iter().sum();
}

#[inline(always)]
fn narrow<const F: bool>(out: &mut f32, operations: &mut f64) {
    *operations = (2 * 16 * CHAINS * ROUNDS) as f64;
    chains::<F, 16>(out);
}

#[inline(always)]
fn wide<const F: bool>(out: &mut f32, operations: &mut f64) {
    *operations = (2 * 32 * CHAINS * ROUNDS) as f64;
    chains::<F, 32>(out);
}

dispatch! { fn multiply / narrow / wide (out: &mut f32, operations: &mut f64) }

#[inline(always)]
fn stream_body<const F: bool>(a: &mut [f32], b: &[f32], c: &[f32]) {
    for ((a, b), c) in a.iter_mut().zip(b).zip(c) {
        *a = 0.5 * *a + *b * *c;
    }
}

dispatch! { fn stream / stream_body(a: &mut [f32], b: &[f32], c: &[f32]) }

impl Roof {
    /// Measures this machine, in about a second a thread.
    pub fn measure() -> Roof {
        /// Every figure is the best of three, of this many CPU seconds a thread.
        const SECONDS: f64 = 0.2;
        let best = |work: &(dyn Fn() -> f64 + Sync)| {
            let once = || {
                let began = cpu_s();
                let mut done = 0.0;
                while cpu_s() - began < SECONDS * rayon::current_num_threads() as f64 {
                    done += rayon::broadcast(|_| work()).iter().sum::<f64>();
                }
                done / (cpu_s() - began)
            };
            (0..3).map(|_| once()).fold(0.0, f64::max)
        };
        let multiplied = || {
            let (mut out, mut operations) = (0f32, 0.0);
            (0..16).for_each(|_| multiply(black_box(&mut out), &mut operations));
            16.0 * operations
        };
        thread_local! {
            static ARRAYS: std::cell::RefCell<[Vec<f32>; 3]> =
                std::cell::RefCell::new([(); 3].map(|()| vec![1.0; STREAM]));
        }
        let streamed = || {
            ARRAYS.with_borrow_mut(|[a, b, c]| stream(black_box(a), b, c));
            (16 * STREAM) as f64
        };
        rayon::broadcast(|_| streamed()); // pages the arrays in
        let roof = Roof { operations: best(&multiplied), bytes: best(&streamed) };
        rayon::broadcast(|_| ARRAYS.take());
        println!(
            "roof of a core: {:.0} GFLOP/s in f32, {:.1} GB/s of memory",
            1e-9 * roof.operations,
            1e-9 * roof.bytes
        );
        roof
    }

    /// Formats a time of a kernel that computes, with the share of the roof it reaches.
    pub fn computed(&self, ms: f64, operations: f64) -> String {
        format!("{ms:.1} ({:.0} % of f32)", 1e5 * operations / (ms * self.operations))
    }

    /// Formats a time of a kernel that moves memory, with the share of the roof it reaches.
    pub fn moved(&self, ms: f64, bytes: f64) -> String {
        format!("{ms:.1} ({:.0} % of memory)", 1e5 * bytes / (ms * self.bytes))
    }
}
