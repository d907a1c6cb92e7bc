//! Times of work beside those of a fixed piece of arithmetic.

use crate::io::{cpu_seconds, forget_peak_memory, peak_memory};
use crate::report::bench::{Round, Row, Seconds};
use rayon::prelude::*;
use std::hint::black_box;
use std::time::Instant;

/// Rounds of short work: odd, so that the median is one of them.
const ROUNDS: usize = 5;

/// Work that takes longer is not repeated.
const LONG_S: f64 = 4.0;

/// Returns what `work` returns, and its seconds.
fn timed<T>(work: impl FnOnce() -> T) -> (T, Seconds) {
    let (start, cpu) = (Instant::now(), cpu_seconds());
    let result = work();
    (result, Seconds { wall: start.elapsed().as_secs_f64(), cpu: cpu_seconds() - cpu })
}

/// Work of the machine alone, some 30 ms on each thread: multiplications and additions as networks have them, and reads
/// at random from 16 MiB as tables of features have them. It must never change: results are compared by it.
fn reference() {
    const ENTRIES: usize = 1 << 22;
    static TABLE: std::sync::LazyLock<Vec<f32>> =
        std::sync::LazyLock::new(|| (0..ENTRIES).map(|i| (i % 251) as f32).collect());
    let part = |thread: u32| {
        let mut sums = [0.0f32; 16];
        for i in 0..4_000_000u32 {
            let scale = 1.0 / (1 + i % 7) as f32;
            sums.iter_mut().enumerate().for_each(|(k, s)| *s = *s * 0.999 + scale * k as f32);
        }
        let (mut at, mut sum) = (thread.wrapping_mul(0x9e37_79b9) | 1, 0.0);
        for _ in 0..600_000 {
            at = at.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            sum += TABLE[at as usize % ENTRIES];
        }
        sum + sums.iter().sum::<f32>()
    };
    let threads = rayon::current_num_threads() as u32;
    black_box((0..threads).into_par_iter().map(part).sum::<f32>());
}

/// Returns what `work` returns, and its time beside the reference's.
pub(super) fn round<T>(work: impl FnOnce() -> T) -> (T, Round) {
    let before = timed(reference).1;
    let (result, work) = timed(work);
    let after = timed(reference).1;
    let mean = |a: f64, b: f64| 0.5 * (a + b);
    let reference = Seconds { wall: mean(before.wall, after.wall), cpu: mean(before.cpu, after.cpu) };
    (result, Round { work, reference })
}

/// What was measured of one piece of work.
pub(super) struct Measured<T> {
    /// Of the first time.
    pub result: T,
    /// Every time.
    pub rounds: Vec<Round>,
    /// MiB.
    pub memory: Option<f64>,
}

impl<T> Measured<T> {
    /// The row of a choice that was measured as a whole, or of one of `pieces` equal pieces of it.
    pub fn row(
        &self,
        series: &str,
        choice: impl Into<String>,
        pieces: usize,
        figures: Vec<Option<f64>>,
    ) -> Row {
        let each = 1.0 / pieces.max(1) as f64;
        let part = |s: Seconds| Seconds { wall: each * s.wall, cpu: each * s.cpu };
        Row {
            series: series.into(),
            choice: choice.into(),
            rounds: self.rounds.iter().map(|r| Round { work: part(r.work), ..*r }).collect(),
            parts: false,
            memory_mib: self.memory,
            figures,
        }
    }
}

impl<T, E> Measured<Result<T, E>> {
    /// What went well, or the error.
    pub fn whole(self) -> Result<Measured<T>, E> {
        let Measured { result, rounds, memory } = self;
        Ok(Measured { result: result?, rounds, memory })
    }
}

/// Returns what `work` returns, its time and its memory, once.
pub(super) fn once<T>(work: impl FnOnce() -> T) -> Measured<T> {
    forget_peak_memory();
    let (result, round) = round(work);
    Measured { result, rounds: vec![round], memory: peak_mib() }
}

/// Measures pieces of work in turn, round after round, so that a busy minute of the machine meets all of them; what
/// takes long only once.
pub(super) fn in_turn<T, E>(
    pieces: usize,
    mut work: impl FnMut(usize) -> Result<T, E>,
) -> Result<Vec<Measured<T>>, E> {
    let mut all: Vec<Measured<T>> = Vec::with_capacity(pieces);
    for i in 0..pieces {
        all.push(once(|| work(i)).whole()?);
    }
    for _ in 1..ROUNDS {
        for (i, measured) in all.iter_mut().enumerate() {
            if measured.rounds[0].work.wall < LONG_S {
                let (result, round) = round(|| work(i));
                result?;
                measured.rounds.push(round);
            }
        }
    }
    Ok(all)
}

/// The most memory of late, MiB.
pub(super) fn peak_mib() -> Option<f64> {
    peak_memory().map(|bytes| bytes as f64 / f64::from(1 << 20))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_work_is_repeated_in_turn_and_every_round_has_its_reference() {
        let mut order = Vec::new();
        let measured = in_turn(2, |i| {
            order.push(i);
            std::thread::sleep(std::time::Duration::from_millis(5));
            Ok::<usize, ()>(i)
        });
        let measured = measured.unwrap();
        assert_eq!(order, [0, 1, 0, 1, 0, 1, 0, 1, 0, 1]);
        for (i, m) in measured.iter().enumerate() {
            assert_eq!((m.result, m.rounds.len()), (i, ROUNDS));
            for Round { work, reference } in &m.rounds {
                assert!(work.wall >= 0.005 && reference.cpu > 0.0 && reference.wall > 0.0);
            }
        }
        assert!(in_turn(1, |_| Err::<(), _>("no")).is_err());
    }
}
