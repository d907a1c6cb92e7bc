//! Numbers that remember how they came about: gradients of a formula by all of its inputs at once,
//! exactly.
//!
//! Reverse accumulation on a list of operations, one list per thread (Griewank and Walther 2008,
//! §3.2).

use super::Real;
use std::cell::RefCell;
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

/// An operation: its operands and its slopes by them.
struct Operation {
    of: [u32; 2],
    slope: [f64; 2],
}

/// A constant is no operation's result.
const CONSTANT: u32 = u32::MAX;

thread_local! {
    static TAPE: RefCell<Vec<Operation>> = const { RefCell::new(Vec::new()) };
}

/// A number on the tape, or a constant.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Var {
    value: f64,
    at: u32,
}

fn push(value: f64, of: [u32; 2], slope: [f64; 2]) -> Var {
    if of == [CONSTANT; 2] {
        return Var::of(value);
    }
    TAPE.with_borrow_mut(|tape| {
        tape.push(Operation { of, slope });
        Var { value, at: u32::try_from(tape.len() - 1).unwrap() }
    })
}

/// Gradient of `formula` by its inputs, at `inputs`; and its value.
pub(crate) fn gradient(inputs: &[f64], formula: impl FnOnce(&[Var]) -> Var) -> (f64, Vec<f64>) {
    TAPE.with_borrow_mut(Vec::clear);
    // an operation of nothing: only its place counts
    let leaf = |&value: &f64| {
        TAPE.with_borrow_mut(|tape| {
            tape.push(Operation { of: [CONSTANT; 2], slope: [0.0; 2] });
            Var { value, at: tape.len() as u32 - 1 }
        })
    };
    let inputs: Vec<Var> = inputs.iter().map(leaf).collect();
    let out = formula(&inputs);
    let tape = TAPE.take();
    let mut slopes = vec![0.0; tape.len()];
    if out.at != CONSTANT {
        slopes[out.at as usize] = 1.0;
    }
    for (i, operation) in tape.iter().enumerate().rev() {
        let g = slopes[i];
        for (of, slope) in operation.of.iter().zip(operation.slope) {
            if *of != CONSTANT {
                slopes[*of as usize] += g * slope;
            }
        }
    }
    slopes.truncate(inputs.len());
    (out.value, slopes)
}

impl Real for Var {
    fn of(value: f64) -> Var {
        Var { value, at: CONSTANT }
    }

    fn value(self) -> f64 {
        self.value
    }

    fn map(self, value: f64, slope: f64) -> Var {
        push(value, [self.at, CONSTANT], [slope, 0.0])
    }
}

impl Add for Var {
    type Output = Var;
    fn add(self, b: Var) -> Var {
        push(self.value + b.value, [self.at, b.at], [1.0, 1.0])
    }
}

impl Sub for Var {
    type Output = Var;
    fn sub(self, b: Var) -> Var {
        push(self.value - b.value, [self.at, b.at], [1.0, -1.0])
    }
}

impl Mul for Var {
    type Output = Var;
    fn mul(self, b: Var) -> Var {
        push(self.value * b.value, [self.at, b.at], [b.value, self.value])
    }
}

impl Div for Var {
    type Output = Var;
    fn div(self, b: Var) -> Var {
        let q = self.value / b.value;
        push(q, [self.at, b.at], [1.0 / b.value, -q / b.value])
    }
}

impl Neg for Var {
    type Output = Var;
    fn neg(self) -> Var {
        self.map(-self.value, -1.0)
    }
}

impl AddAssign for Var {
    fn add_assign(&mut self, b: Var) {
        *self = *self + b;
    }
}

impl Sum for Var {
    fn sum<I: Iterator<Item = Var>>(all: I) -> Var {
        all.fold(Var::of(0.0), |a, b| a + b)
    }
}

/// An array of parameters before and after a step, with the moments before it, as an optimizer
/// keeps them.
pub(crate) struct Stepped {
    /// Values before.
    pub value: Vec<f64>,
    /// First and second moment before.
    pub moments: [Vec<f64>; 2],
    /// Values after.
    pub after: Vec<f64>,
    /// First moment after.
    pub first_after: Vec<f64>,
}

/// Learning rate, epsilon, decoupled weight decay and the number of a step of AdamW, from 1.
#[derive(Clone, Copy)]
pub(crate) struct AdamW {
    pub lr: f64,
    pub epsilon: f64,
    pub decay: f64,
    pub step: i32,
}

impl AdamW {
    /// Errors of the updates that an optimizer made and of the first moments that it has then, each
    /// as a share of what this gradient asks for, or of a thousandth of the array's largest where
    /// that is more. β are the published 0.9 and 0.99.
    pub fn errors(&self, array: &Stepped, gradient: &[f64]) -> Vec<f64> {
        let moment = |beta: f64, before: f64, g: f64| beta * before + (1.0 - beta) * g;
        let unbiased = |beta: f64, m: f64| m / (1.0 - beta.powi(self.step));
        let update = |i: usize| {
            let (g, p) = (gradient[i], array.value[i]);
            let m = unbiased(0.9, moment(0.9, array.moments[0][i], g));
            let v = unbiased(0.99, moment(0.99, array.moments[1][i], g * g));
            -self.lr * (self.decay * p + m / (v.sqrt() + self.epsilon))
        };
        let wanted: Vec<f64> = (0..gradient.len()).map(update).collect();
        let floor = 1e-3 * wanted.iter().fold(0f64, |most, w| most.max(w.abs()));
        let error = |i: usize| {
            let made = array.after[i] - array.value[i];
            // weights are f32: what they round to is no error of the step
            let rounding = array.after[i].abs().max(array.value[i].abs()) * f64::from(f32::EPSILON);
            ((made - wanted[i]).abs() - rounding).max(0.0) / wanted[i].abs().max(floor)
        };
        let moments: Vec<f64> =
            (0..gradient.len()).map(|i| moment(0.9, array.moments[0][i], gradient[i])).collect();
        let floor = 1e-3 * moments.iter().fold(1e-30f64, |most, m| most.max(m.abs()));
        let of_moment = |i: usize| (array.first_after[i] - moments[i]).abs() / moments[i].abs().max(floor);
        (0..gradient.len()).map(|i| error(i).max(of_moment(i))).collect()
    }
}

#[test]
fn a_gradient_by_every_input_is_the_one_of_calculus() {
    // f = a b + exp(a) / b + √(b² + 1): f_a = b + exp(a)/b, f_b = a − exp(a)/b² + b/√(b² + 1)
    let (a, b) = (0.3f64, -1.7f64);
    let (value, g) =
        gradient(&[a, b, 5.0], |x| x[0] * x[1] + x[0].exp() / x[1] + (x[1] * x[1] + Var::of(1.0)).sqrt());
    let root = (b * b + 1.0).sqrt();
    assert!((value - (a * b + a.exp() / b + root)).abs() < 1e-15);
    assert!((g[0] - (b + a.exp() / b)).abs() < 1e-15 && g[2] == 0.0);
    assert!((g[1] - (a - a.exp() / (b * b) + b / root)).abs() < 1e-15, "{g:?}");
}
