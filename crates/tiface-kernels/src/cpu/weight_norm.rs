//! Weight normalization of the geometry network (Salimans, Kingma 2016): it converts trained
//! parameters to the weights of a [`Layout`], and gradients back.
//!
//! ```text
//! W = g v / ‖v‖ by rows     g_g = ĝ · v / ‖v‖     g_v = g / ‖v‖ (ĝ − (ĝ · v̂) v̂)
//! ĝ: the gradient by W
//! ```
//!
//! Parameters are stored in one vector: v1, g1, b1, v2, g2, b2, c1, c2, c3.

use super::mlp::Layout;

/// Offsets of a row of weights and of its parameters. A row without a length parameter is copied.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Index of the row's first parameter.
    pub from: usize,
    /// Index of the parameter that is the row's length, g.
    pub length: Option<usize>,
    /// Index of the row's first weight.
    pub to: usize,
    /// Number of weights of the row.
    pub count: usize,
}

/// Returns the rows of a network and its number of parameters.
pub fn rows(layout: Layout) -> (Vec<Row>, usize) {
    let mut rows = Vec::new();
    let (mut from, mut to) = (0, 0);
    for (part, (outputs, inputs)) in layout.shapes().into_iter().enumerate() {
        let normed = part == 0 || part == 2;
        let lengths = from + outputs * inputs;
        for o in 0..outputs {
            rows.push(Row {
                from: from + o * inputs,
                length: normed.then_some(lengths + o),
                to,
                count: inputs,
            });
            to += inputs;
        }
        from = lengths + if normed { outputs } else { 0 };
    }
    (rows, from)
}

/// Returns ‖v‖ of a row, clamped to at least 1e-12, so that it can be a divisor.
fn length(v: &[f32]) -> f32 {
    v.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-12)
}

/// Returns the flat weights of the parameters.
pub fn forward(layout: Layout, parameters: &[f32]) -> Vec<f32> {
    let mut flat = Vec::with_capacity(layout.len());
    for Row { from, length: g, count, .. } in rows(layout).0 {
        let v = &parameters[from..from + count];
        match g {
            Some(g) => {
                let share = parameters[g] / length(v);
                flat.extend(v.iter().map(|v| v * share));
            }
            None => flat.extend(v),
        }
    }
    flat
}

/// Writes the gradient with respect to the parameters, given that with respect to the flat weights.
pub fn backward(layout: Layout, parameters: &[f32], g_flat: &[f32], gradient: &mut [f32]) {
    for Row { from, length: g, to, count } in rows(layout).0 {
        let (v, by_weights) = (&parameters[from..from + count], &g_flat[to..to + count]);
        let Some(g) = g else {
            gradient[from..from + count].copy_from_slice(by_weights);
            continue;
        };
        let length = length(v);
        let radial = by_weights.iter().zip(v).map(|(g, v)| g * v).sum::<f32>() / length;
        gradient[g] = radial;
        let share = parameters[g] / length;
        for (k, (by_weight, v)) in by_weights.iter().zip(v).enumerate() {
            gradient[from + k] = share * (by_weight - radial * v / length);
        }
    }
}
