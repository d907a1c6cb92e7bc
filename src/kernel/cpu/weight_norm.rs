//! Weight norm of the geometry network (Salimans, Kingma 2016): from trained parameters to the weights of a
//! [`Layout`], and back.
//!
//! ```text
//! W = g v / ‖v‖ by rows     g_g = ĝ · v / ‖v‖     g_v = g / ‖v‖ (ĝ − (ĝ · v̂) v̂),  ĝ the gradient by W
//! ```
//!
//! Parameters are one vector: v1, g1, b1, v2, g2, b2, c1, c2, c3.

use super::mlp::Layout;

/// A row of weights: where its parameters, the parameter that is its length, and its weights begin, and how many they
/// are. A row without a length parameter is copied.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// First of its parameters.
    pub from: usize,
    /// The parameter that is its length.
    pub length: Option<usize>,
    /// First of its weights.
    pub to: usize,
    /// Weights.
    pub count: usize,
}

/// Returns the rows of a network and how many parameters it has.
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

/// ‖v‖ of a row, which no division by it can break.
fn length(v: &[f32]) -> f32 {
    v.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-12)
}

/// Returns the flat weights of these parameters.
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

/// Writes the gradient by the parameters, from that by the flat weights.
pub fn backward(layout: Layout, parameters: &[f32], g_flat: &[f32], gradient: &mut [f32]) {
    for Row { from, length: g, to, count } in rows(layout).0 {
        let (v, by_weights) = (&parameters[from..from + count], &g_flat[to..to + count]);
        let Some(g) = g else {
            gradient[from..from + count].copy_from_slice(by_weights);
            continue;
        };
        let length = length(v);
        let along = by_weights.iter().zip(v).map(|(g, v)| g * v).sum::<f32>() / length;
        gradient[g] = along;
        let share = parameters[g] / length;
        for (k, (by_weight, v)) in by_weights.iter().zip(v).enumerate() {
            gradient[from + k] = share * (by_weight - along * v / length);
        }
    }
}
