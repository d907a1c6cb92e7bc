//! The formulas of the kernels in f64, one sample after the other: what the fast ones are compared
//! with.
//!
//! Tests of the crate's own modules and the stability cases include this module by its path.
#![allow(dead_code)]

pub(crate) mod density;
pub(crate) mod neus;
pub(crate) mod sdf;
pub(crate) mod tape;
pub(crate) mod vm;

use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

/// What the formulas are written in: f64, or a number that remembers how it came about, for exact
/// gradients.
pub(crate) trait Real:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + Sum
{
    /// A constant.
    fn of(value: f64) -> Self;
    /// What it is.
    fn value(self) -> f64;
    /// A function of it, of this value and this slope there.
    fn map(self, value: f64, slope: f64) -> Self;

    fn exp(self) -> Self {
        let e = self.value().exp();
        self.map(e, e)
    }

    fn ln(self) -> Self {
        self.map(self.value().ln(), 1.0 / self.value())
    }

    fn ln_1p(self) -> Self {
        self.map(self.value().ln_1p(), 1.0 / (1.0 + self.value()))
    }

    fn sqrt(self) -> Self {
        let root = self.value().sqrt();
        self.map(root, 0.5 / root)
    }

    fn sin(self) -> Self {
        self.map(self.value().sin(), self.value().cos())
    }

    fn cos(self) -> Self {
        self.map(self.value().cos(), -self.value().sin())
    }

    fn abs(self) -> Self {
        self.map(self.value().abs(), if self.value() < 0.0 { -1.0 } else { 1.0 })
    }

    /// Within a range; flat beyond.
    fn within(self, low: f64, high: f64) -> Self {
        if (low..=high).contains(&self.value()) { self } else { Self::of(self.value().clamp(low, high)) }
    }

    fn relu(self) -> Self {
        if self.value() > 0.0 { self } else { Self::of(0.0) }
    }
}

impl Real for f64 {
    fn of(value: f64) -> f64 {
        value
    }

    fn value(self) -> f64 {
        self
    }

    fn map(self, value: f64, _: f64) -> f64 {
        value
    }
}

/// The sixteen functions of [`sh16`](tiface_base::geom::sphharm::sh16), their factors from the
/// definition.
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

fn sigmoid<R: Real>(x: R) -> R {
    let s = 1.0 / (1.0 + (-x.value()).exp());
    x.map(s, s * (1.0 - s))
}

/// Values as f64.
pub(crate) fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| v as f64).collect()
}
