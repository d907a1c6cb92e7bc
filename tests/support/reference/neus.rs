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
        // weights and colors of the samples whose color counts
        let mut counting = Vec::new();
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
            if w.value() > segments.colors.min_weight.into() {
                counting.push((w, [f[4], f[5], f[6]]));
            }
            for c in 0..3 {
                out[5 + c] += w * n[c];
            }
            out[3] += w;
            out[4] += w * of(segments.t[s] as f64);
            transmittance = transmittance * (of(1.0) - alpha);
        }
        // groups that are full, and what is left at the end
        let full = |group: &[(R, [R; 3])]| {
            group.iter().map(|(w, _)| w.value()).sum::<f64>() >= f64::from(segments.colors.group_weight)
        };
        let mut groups: Vec<Vec<(R, [R; 3])>> = vec![Vec::new()];
        for sample in counting {
            if groups.last().is_some_and(|group| full(group)) {
                groups.push(Vec::new());
            }
            groups.last_mut().unwrap().push(sample);
        }
        let mut before = None;
        for group in groups.iter().filter(|group| !group.is_empty()) {
            let mut heaviest = group[0];
            group.iter().for_each(|other| {
                if other.0.value() > heaviest.0.value() {
                    heaviest = *other;
                }
            });
            let color = before.filter(|_| !full(group)).unwrap_or(heaviest.1);
            for (w, _) in group {
                for c in 0..3 {
                    out[c] += *w * color[c];
                }
                out[8] += *w * (color[0] * color[0] + color[1] * color[1] + color[2] * color[2]);
            }
            before = Some(color);
        }
        all.extend(out);
    }
    all
}
