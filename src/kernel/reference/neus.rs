//! NeuS compositing: see [`crate::kernel::neus`].

use super::sigmoid;
use crate::kernel::neus::{RAY_WIDTH, Rays};
use crate::kernel::sdf::WIDTH;
use std::array::from_fn;

/// `[rays, 8]` of a field `[samples, 8]`, of any sharpness.
pub(crate) fn composite(rays: Rays, field: &[f64], inv_s: f64, anneal: f64) -> Vec<f64> {
    let mut all = Vec::new();
    for r in 0..rays.offsets.len() - 1 {
        let mut out = [0f64; RAY_WIDTH];
        let mut transmittance = 1.0;
        for s in rays.offsets[r] as usize..rays.offsets[r + 1] as usize {
            let f = &field[s * WIDTH..][..WIDTH];
            let length = (f[1] * f[1] + f[2] * f[2] + f[3] * f[3]).sqrt().max(1e-12);
            let n: [f64; 3] = from_fn(|c| f[1 + c] / length);
            let cos: f64 = (0..3).map(|c| rays.direction[r][c] as f64 * n[c]).sum();
            let ic = -((0.5 - 0.5 * cos).max(0.0) * (1.0 - anneal) + (-cos).max(0.0) * anneal);
            let half = 0.5 * ic * rays.dt[s] as f64;
            let sharp = inv_s * f[7].exp();
            let (p, q) = (sigmoid((f[0] - half) * sharp), sigmoid((f[0] + half) * sharp));
            let alpha = ((p - q + 1e-5) / (p + 1e-5)).clamp(0.0, 1.0);
            let w = transmittance * alpha;
            for c in 0..3 {
                out[c] += w * f[4 + c];
                out[5 + c] += w * n[c];
            }
            out[3] += w;
            out[4] += w * rays.t[s] as f64;
            transmittance *= 1.0 - alpha;
        }
        all.extend(out);
    }
    all
}
