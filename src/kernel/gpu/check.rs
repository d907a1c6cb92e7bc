//! What a device computed beside what the processor did.

/// A kernel, or some that work together, and how far it was from the CPU.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Check {
    /// What was computed.
    pub name: &'static str,
    /// The largest error, of the larger of a value and the mean magnitude; NaN where a value was not a number.
    pub error: f32,
    /// What it may be.
    pub allowed: f32,
}

impl Check {
    /// Is it as near as it has to be?
    pub fn passed(&self) -> bool {
        self.error <= self.allowed
    }
}

/// The largest error of an array, of the larger of a value and the mean magnitude.
pub(super) fn worst(got: &[f32], want: &[f32]) -> f32 {
    let mean = want.iter().map(|v| v.abs()).sum::<f32>() / want.len().max(1) as f32;
    let error = |(g, w): (&f32, &f32)| (g - w).abs() / w.abs().max(mean).max(f32::MIN_POSITIVE);
    got.iter().zip(want).map(error).fold(0f32, |a, b| if b > a || b.is_nan() { b } else { a })
}

/// Rows `[n, W]` as planes `[W, capacity]`.
pub(crate) fn planes<const W: usize>(rows: &[[f32; W]], capacity: usize) -> Vec<f32> {
    let mut out = vec![0.0; W * capacity];
    for (i, row) in rows.iter().enumerate() {
        (0..W).for_each(|k| out[k * capacity + i] = row[k]);
    }
    out
}
