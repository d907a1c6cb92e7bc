//! Comparison of results from a device with those from the CPU.

/// Result of comparing a kernel, or a group of kernels, with the CPU.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Check {
    /// Name of what was computed.
    pub name: &'static str,
    /// Largest error, relative to the larger of a value and the mean magnitude; NaN if a value was not a number.
    pub error: f32,
    /// Largest error that is accepted.
    pub allowed: f32,
}

impl Check {
    /// Returns whether the error is small enough.
    pub fn passed(&self) -> bool {
        self.error <= self.allowed
    }
}

/// Returns the largest error of an array, relative to the larger of a value and the mean magnitude.
pub(super) fn worst(got: &[f32], want: &[f32]) -> f32 {
    let mean = want.iter().map(|v| v.abs()).sum::<f32>() / want.len().max(1) as f32;
    let error = |(g, w): (&f32, &f32)| (g - w).abs() / w.abs().max(mean).max(f32::MIN_POSITIVE);
    got.iter().zip(want).map(error).fold(0f32, |a, b| if b > a || b.is_nan() { b } else { a })
}

/// Converts rows `[n, W]` to planes `[W, capacity]`, padded with zeros.
pub(crate) fn planes<const W: usize>(rows: &[[f32; W]], capacity: usize) -> Vec<f32> {
    let mut out = vec![0.0; W * capacity];
    for (i, row) in rows.iter().enumerate() {
        (0..W).for_each(|k| out[k * capacity + i] = row[k]);
    }
    out
}
