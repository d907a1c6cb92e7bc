//! Conversion of trained parameters to the weights and the sharpness of the field, and of gradients
//! back: weight normalization of the geometry network (Salimans, Kingma 2016) and the sharpness of
//! NeuS.
//!
//! ```text
//! W = g v / ‖v‖ by rows     g_g = ĝ · v / ‖v‖     g_v = g / ‖v‖ (ĝ − (ĝ · v̂) v̂)
//! ĝ: the gradient by W
//! inv_s = exp(10 s)         g_s = 10 inv_s g_inv_s
//! ```

use super::device::{Buffer, Device, Words, groups, launch};
use crate::cpu::mlp::Layout;
use crate::cpu::weight_norm::{self, Row};
use burn::cubecl::{self, prelude::*};

const UNITS: u32 = 64;

/// Number of words that describe a row of weights, a piece: offsets of its parameters, of its
/// length parameter and of its weights, and their number. A piece without a length parameter is
/// copied.
const PIECE: usize = 4;

/// Offset of a piece without a length parameter.
const NONE: u32 = u32::MAX;

/// Returns ‖v‖ of a piece, or 1 if it has no length parameter.
#[cube]
fn length(raw: &[f32], pieces: &[u32], i: usize) -> f32 {
    let from = pieces[i * PIECE] as usize;
    let mut sum = 0.0f32;
    for k in 0..pieces[i * PIECE + 3] as usize {
        sum += raw[from + k] * raw[from + k];
    }
    select(pieces[i * PIECE + 1] == NONE, 1.0f32, max(sum.sqrt(), 1e-12f32))
}

/// Returns whether a float is finite. Its bits are tested, because compilers may assume that floats
/// are finite.
#[cube]
pub(super) fn finite(v: f32) -> bool {
    (u32::reinterpret(v) & 0x7f80_0000u32) != 0x7f80_0000u32
}

/// Returns the length parameter g of a piece, or 1 if it has none.
#[cube]
fn scale(raw: &[f32], pieces: &[u32], i: usize) -> f32 {
    let at = pieces[i * PIECE + 1];
    let mut g = 1.0f32;
    if at != NONE {
        g = raw[at as usize];
    }
    g
}

#[cube(launch)]
fn forward(
    raw: &[f32],
    pieces: &[u32],
    variance: &mut [f32],
    flat: &mut [f32],
    inv_s: &mut [f32],
    min_variance: f32,
    max_variance: f32,
) {
    let i = ABSOLUTE_POS;
    if i < pieces.len() / PIECE {
        let (from, to) = (pieces[i * PIECE] as usize, pieces[i * PIECE + 2] as usize);
        let share = scale(raw, pieces, i) / length(raw, pieces, i);
        for k in 0..pieces[i * PIECE + 3] as usize {
            flat[to + k] = raw[from + k] * share;
        }
    }
    if i == 0 {
        let v = clamp(variance[0], min_variance, max_variance);
        variance[0] = v;
        inv_s[0] = (10.0f32 * v).exp();
    }
}

#[cube(launch)]
fn backward(
    raw: &[f32],
    pieces: &[u32],
    inv_s: &[f32],
    g_flat: &[f32],
    g_inv_s: &[f32],
    g_raw: &mut [f32],
    g_variance: &mut [f32],
    non_finite: &mut [u32],
) {
    let i = ABSOLUTE_POS;
    if i < pieces.len() / PIECE {
        let (from, to) = (pieces[i * PIECE] as usize, pieces[i * PIECE + 2] as usize);
        let count = pieces[i * PIECE + 3] as usize;
        let at = pieces[i * PIECE + 1];
        let length = length(raw, pieces, i);
        let share = scale(raw, pieces, i) / length;
        let mut radial = 0.0f32;
        if at != NONE {
            for k in 0..count {
                radial += g_flat[to + k] * raw[from + k];
            }
            radial /= length;
            g_raw[at as usize] = radial;
            if !finite(radial) {
                non_finite[0] = 1;
            }
        }
        for k in 0..count {
            let gradient = share * (g_flat[to + k] - radial * raw[from + k] / length);
            g_raw[from + k] = gradient;
            // all threads that write, write the same value
            if !finite(gradient) {
                non_finite[0] = 1;
            }
        }
    }
    if i == 0 {
        let gradient = 10.0f32 * inv_s[0] * g_inv_s[0];
        g_variance[0] = gradient;
        if !finite(gradient) {
            non_finite[0] = 1;
        }
    }
}

/// Weight normalization of a network on a device.
///
/// Parameters are stored in one vector: v1, g1, b1, v2, g2, b2, c1, c2, c3; weights are as
/// [`Layout`] describes them.
pub struct WeightNorm {
    pieces: Buffer,
    count: usize,
    parameters: usize,
}

impl WeightNorm {
    /// Creates the weight normalization of a network.
    pub fn new(device: &Device, layout: Layout) -> WeightNorm {
        let (rows, parameters) = weight_norm::rows(layout);
        let piece = |row: &Row| {
            let length = row.length.map_or(NONE, |g| g as u32);
            [row.from as u32, length, row.to as u32, row.count as u32]
        };
        let pieces: Vec<u32> = rows.iter().flat_map(piece).collect();
        let count = pieces.len() / PIECE;
        WeightNorm { pieces: device.upload(&pieces), count, parameters }
    }

    /// Computes the weights `flat` and the sharpness `inv_s`, `[1]`, from the parameters `raw` and
    /// the variance, `[1]`, which is first clamped to `range`.
    pub fn forward(
        &self,
        device: &Device,
        raw: &Buffer,
        variance: &Buffer,
        range: [f32; 2],
        flat: &Buffer,
        inv_s: &Buffer,
    ) {
        assert_eq!(raw.word_count(), self.parameters);
        launch!(device, forward::launch, groups(self.count.div_ceil(UNITS as usize)), UNITS;
            raw, self.pieces, variance, flat, inv_s; range[0], range[1]
        );
    }

    /// Writes the gradients with respect to parameters and variance, given those with respect to
    /// weights and sharpness. Sets `non_finite`, `[1]`, to 1 if one of them is not finite. The
    /// table needs no check of its own: a value that is not finite reaches it through the layers
    /// checked here.
    pub fn backward(
        &self,
        device: &Device,
        raw: &Buffer,
        inv_s: &Buffer,
        [g_flat, g_inv_s]: [&Buffer; 2],
        [g_raw, g_variance]: [&Buffer; 2],
        non_finite: &Buffer,
    ) {
        launch!(device, backward::launch, groups(self.count.div_ceil(UNITS as usize)), UNITS;
            raw, self.pieces, inv_s, g_flat, g_inv_s, g_raw, g_variance, non_finite
        );
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{agree, device};
    use super::*;
    use crate::cpu::mlp::{HIDDEN, OUTPUTS};
    use tiface_base::math::rng;

    /// Returns the weights of parameters in f64, derived from the shapes alone.
    fn weights(layout: Layout, raw: &[f64]) -> Vec<f64> {
        let mut rest = raw;
        let mut flat = Vec::new();
        let take = |rest: &mut &[f64], n: usize| -> Vec<f64> {
            let (head, tail) = rest.split_at(n);
            *rest = tail;
            head.to_vec()
        };
        for (part, (outputs, inputs)) in layout.shapes().into_iter().enumerate() {
            let v = take(&mut rest, outputs * inputs);
            if part == 0 || part == 2 {
                let g = take(&mut rest, outputs);
                for (row, g) in v.chunks(inputs).zip(g) {
                    let length = row.iter().map(|x| x * x).sum::<f64>().sqrt();
                    flat.extend(row.iter().map(|x| g * x / length));
                }
            } else {
                flat.extend(v);
            }
        }
        flat
    }

    #[test]
    fn weights_and_gradients_agree_with_f64() {
        let Some(device) = device() else { return };
        let layout = Layout::new(5, true);
        let norm = WeightNorm::new(&device, layout);
        assert_eq!(norm.parameters, layout.len() + HIDDEN + OUTPUTS);
        let normal = |stream: u64, n: usize| -> Vec<f32> {
            (0..n as u64).map(|i| rng::normal(3, stream, i)).collect()
        };
        let (raw, g) = (normal(1, norm.parameters), normal(2, layout.len()));
        let [device_raw, g_flat] = [&raw, &g].map(|v| device.upload(v));
        let (variance, g_inv_s) = (device.upload(&[0.3f32]), device.upload(&[0.7f32]));
        let (flat, inv_s) = (device.scratch::<f32>(layout.len()), device.scratch::<f32>(1));
        norm.forward(&device, &device_raw, &variance, [-1.0, 0.25], &flat, &inv_s);
        let wide: Vec<f64> = raw.iter().map(|&v| v as f64).collect();
        let want: Vec<f32> = weights(layout, &wide).iter().map(|&v| v as f32).collect();
        agree("weights", &device.read::<f32>(&flat), &want, 1e-5);
        // 0.3 is clamped to 0.25: inv_s = exp(2.5), and its gradient 0.7 becomes 7 exp(2.5)
        assert_eq!(device.read::<f32>(&variance), [0.25]);
        agree("sharpness", &device.read::<f32>(&inv_s), &[2.5f32.exp()], 1e-5);
        let (g_raw, g_variance) = (device.scratch::<f32>(raw.len()), device.scratch::<f32>(1));
        let non_finite = device.zeros::<u32>(1);
        let outputs = [&g_raw, &g_variance];
        norm.backward(&device, &device_raw, &inv_s, [&g_flat, &g_inv_s], outputs, &non_finite);
        assert_eq!(device.read::<u32>(&non_finite), [0]);
        agree("gradient by the variance", &device.read::<f32>(&g_variance), &[7.0 * 2.5f32.exp()], 1e-5);
        let loss =
            |raw: &[f64]| -> f64 { weights(layout, raw).iter().zip(&g).map(|(w, &g)| w * g as f64).sum() };
        let got = device.read::<f32>(&g_raw);
        let some: Vec<usize> = (0..raw.len()).step_by(7).collect();
        let slopes: Vec<f32> = some
            .iter()
            .map(|&i| {
                let at = |h: f64| {
                    let mut p = wide.clone();
                    p[i] += h;
                    loss(&p)
                };
                ((at(1e-5) - at(-1e-5)) / 2e-5) as f32
            })
            .collect();
        agree("gradient by the parameters", &some.iter().map(|&i| got[i]).collect::<Vec<_>>(), &slopes, 1e-5);
        for (value, at) in [(f32::NAN, 0), (f32::INFINITY, layout.len() - 1)] {
            let mut g = g.clone();
            g[at] = value;
            let non_finite = device.zeros::<u32>(1);
            norm.backward(&device, &device_raw, &inv_s, [&device.upload(&g), &g_inv_s], outputs, &non_finite);
            assert_eq!(device.read::<u32>(&non_finite), [1]);
        }
    }
}
