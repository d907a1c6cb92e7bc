//! The formulas of the kernels once more, in f64, one sample after the other: what the fast ones are held against.

pub(crate) mod neus;
pub(crate) mod sdf;
pub(crate) mod vm;

/// The sixteen functions of [`sh16`](super::sphharm::sh16), their factors from the definition.
pub(crate) fn harmonics([x, y, z]: [f64; 3]) -> [f64; 16] {
    let root = |n: f64, d: f64| (n / (d * std::f64::consts::PI)).sqrt();
    let (r2, s2) = (x * x - y * y, 5.0 * z * z);
    [
        0.5 * root(1.0, 1.0),
        -root(3.0, 4.0) * y,
        root(3.0, 4.0) * z,
        -root(3.0, 4.0) * x,
        0.5 * root(15.0, 1.0) * x * y,
        -0.5 * root(15.0, 1.0) * y * z,
        0.25 * root(5.0, 1.0) * (3.0 * z * z - 1.0),
        -0.5 * root(15.0, 1.0) * x * z,
        0.25 * root(15.0, 1.0) * r2,
        0.25 * root(35.0, 2.0) * y * (y * y - 3.0 * x * x),
        0.5 * root(105.0, 1.0) * x * y * z,
        0.25 * root(21.0, 2.0) * y * (1.0 - s2),
        0.25 * root(7.0, 1.0) * z * (s2 - 3.0),
        0.25 * root(21.0, 2.0) * x * (1.0 - s2),
        0.25 * root(105.0, 1.0) * z * r2,
        0.25 * root(35.0, 2.0) * x * (3.0 * y * y - x * x),
    ]
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Values as f64.
pub(crate) fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| v as f64).collect()
}
