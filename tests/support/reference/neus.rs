//! NeuS compositing: see [`tiface_kernels::cpu::neus`].

use super::{Real, sigmoid};
use std::array::from_fn;
use tiface_kernels::cpu::neus::{RAY_WIDTH, Segments};
use tiface_kernels::cpu::sdf::WIDTH;

/// `[rays, 9]` of a field `[samples, 8]`, of any sharpness.
pub(crate) fn composite<R: Real>(segments: Segments, field: &[R], inv_s: R, anneal: f64) -> Vec<R> {
    let of = R::of;
    let mut all = Vec::new();
    for r in 0..segments.offsets.len() - 1 {
        let mut out = [of(0.0); RAY_WIDTH];
        let mut transmittance = of(1.0);
        for s in segments.offsets[r] as usize..segments.offsets[r + 1] as usize {
            let f = &field[s * WIDTH..][..WIDTH];
            let length = (f[1] * f[1] + f[2] * f[2] + f[3] * f[3]).sqrt();
            let length = if length.value() > 1e-12 { length } else { of(1e-12) };
            let n: [R; 3] = from_fn(|c| f[1 + c] / length);
            let cos: R = (0..3).map(|c| of(segments.direction[r][c] as f64) * n[c]).sum();
            let ic = -((of(0.5) - of(0.5) * cos).relu() * of(1.0 - anneal) + (-cos).relu() * of(anneal));
            let half = of(0.5 * segments.dt[s] as f64) * ic;
            let sharp = inv_s * f[7].exp();
            let (p, q) = (sigmoid((f[0] - half) * sharp), sigmoid((f[0] + half) * sharp));
            let alpha = ((p - q + of(1e-5)) / (p + of(1e-5))).within(0.0, 1.0);
            let w = transmittance * alpha;
            if w.value() > segments.min_weight.into() {
                for c in 0..3 {
                    out[c] += w * f[4 + c];
                }
                out[8] += w * (f[4] * f[4] + f[5] * f[5] + f[6] * f[6]);
            }
            for c in 0..3 {
                out[5 + c] += w * n[c];
            }
            out[3] += w;
            out[4] += w * of(segments.t[s] as f64);
            transmittance = transmittance * (of(1.0) - alpha);
        }
        all.extend(out);
    }
    all
}
