//! NeuS compositing of ragged rays, forward and backward.
//!
//! Wang et al. 2021, "NeuS", eq. 10-13, with the cosine annealing of its code: along a ray of unit
//! direction `d`, a sample of length `δ` with distance `f` and unit normal `n̂` has
//!
//! ```text
//! cos = d·n̂     ic = −[relu(½ − ½cos)(1 − a) + relu(−cos) a]     (a: anneal, 0 → 1)
//! P = σ(s (f − ½ ic δ))     N = σ(s (f + ½ ic δ))
//! α = clip((P − N + ε)/(P + ε), 0, 1)     ε = 1e-5
//! T_i = Π_{j<i} (1 − α_j)     w = T α     out = Σ w · (rgb, 1, t, n̂, ‖rgb‖²)
//! ```
//!
//! The last column of the field's output is `ln(s / inv_s)` of the sample; in NeuS it is 0
//! everywhere.

use super::sdf::WIDTH;
use rayon::prelude::*;

/// Number of values per ray: rgb (3), opacity, depth (Σ w t), normal (3, Σ w n̂), squared color (Σ
/// w ‖rgb‖²).
pub const RAY_WIDTH: usize = 9;

/// The segments of rays that samples stand for, sorted by ray and then by `t`.
#[derive(Clone, Copy)]
pub struct Segments<'a> {
    /// `[rays + 1]`: ray `r` owns samples `offsets[r]..offsets[r + 1]`.
    pub offsets: &'a [i32],
    /// `[rays, 3]` unit directions.
    pub direction: &'a [[f32; 3]],
    /// `[samples]` midpoints.
    pub t: &'a [f32],
    /// `[samples]` lengths.
    pub dt: &'a [f32],
}

const EPSILON: f32 = 1e-5;

fn sigmoid(x: f32) -> f32 {
    if x >= 0.0 {
        1.0 / (1.0 + (-x).exp())
    } else {
        let e = x.exp();
        e / (1.0 + e)
    }
}

/// Opacity of one sample, with the intermediate values that its derivative needs.
struct Alpha {
    alpha: f32,
    clipped: bool,
    previous: f32,
    next: f32,
    ic: f32,
    ic_by_cos: f32,
}

fn alpha_of(sdf: f32, cos: f32, dt: f32, inv_s: f32, anneal: f32) -> Alpha {
    let (soft, hard) = (0.5 - 0.5 * cos, -cos);
    let ic = -(soft.max(0.0) * (1.0 - anneal) + hard.max(0.0) * anneal);
    let ic_by_cos = 0.5 * (1.0 - anneal) * f32::from(soft > 0.0) + anneal * f32::from(hard > 0.0);
    let half = 0.5 * ic * dt;
    let (previous, next) = (sigmoid((sdf - half) * inv_s), sigmoid((sdf + half) * inv_s));
    let raw = (previous - next + EPSILON) / (previous + EPSILON);
    Alpha { alpha: raw.clamp(0.0, 1.0), clipped: !(0.0..=1.0).contains(&raw), previous, next, ic, ic_by_cos }
}

/// Returns the opacity of a cell of half size `half` for the occupancy grid: that of a ray that
/// meets the surface head-on.
pub fn occupancy(sdf: f32, half: f32, inv_s: f32) -> f32 {
    alpha_of(sdf, -1.0, 2.0 * half, inv_s.clamp(1e-6, 1e6), 1.0).alpha
}

/// A field gradient that is not longer than this has no meaningful direction, so nothing is
/// propagated back through its unit normal: that gradient would be scaled by the inverse length, up
/// to 1e12.
pub const MIN_GRADIENT_NORM: f32 = 1e-6;

fn normal_of(field: &[f32]) -> ([f32; 3], f32) {
    let n = [field[1], field[2], field[3]];
    let length = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt().max(1e-12);
    (n.map(|c| c / length), length)
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Returns the values of a sample that are composited, before they are multiplied by its weight.
#[inline]
fn values_of(field: &[f32], n: [f32; 3], t: f32) -> [f32; RAY_WIDTH] {
    let [r, g, b] = [field[4], field[5], field[6]];
    [r, g, b, 1.0, t, n[0], n[1], n[2], r * r + g * g + b * b]
}

/// Returns the sharpness at a sample, clamped to [1e-6, 1e6].
fn local_sharpness(inv_s: f32, field: &[f32]) -> f32 {
    (inv_s * field[7].exp()).clamp(1e-6, 1e6)
}

/// Composites the samples of each ray. The values of a ray without samples are zero.
///
/// # Shapes
///
/// - field: `[samples, 8]`, the output of the field
/// - output: `[rays, 9]` = rgb, opacity, Σ w t, Σ w n̂, Σ w ‖rgb‖²
pub fn forward(segments: Segments, field: &[f32], inv_s: f32, anneal: f32) -> Vec<f32> {
    let inv_s = inv_s.clamp(1e-6, 1e6);
    let count = segments.offsets.len() - 1;
    let mut out = vec![0f32; count * RAY_WIDTH];
    out.par_chunks_mut(RAY_WIDTH).with_min_len(64).enumerate().for_each(|(r, out)| {
        let mut transmittance = 1f32;
        for s in segments.offsets[r] as usize..segments.offsets[r + 1] as usize {
            let f = &field[s * WIDTH..][..WIDTH];
            let (n, _) = normal_of(f);
            let a = alpha_of(
                f[0],
                dot(segments.direction[r], n),
                segments.dt[s],
                local_sharpness(inv_s, f),
                anneal,
            )
            .alpha;
            let w = transmittance * a;
            out.iter_mut().zip(values_of(f, n, segments.t[s])).for_each(|(out, value)| *out += w * value);
            transmittance *= 1.0 - a;
        }
    });
    out
}

/// Returns the gradients with respect to the field's output, `[samples, 8]`, and with respect to
/// `inv_s`.
///
/// # Shapes
///
/// - g_out: `[rays, 9]`, the gradient of the loss with respect to the output of [`forward`]
pub fn backward(
    segments: Segments,
    field: &[f32],
    inv_s: f32,
    anneal: f32,
    g_out: &[f32],
) -> (Vec<f32>, f32) {
    let clamped = inv_s.clamp(1e-6, 1e6);
    let count = segments.offsets.len() - 1;
    let mut g_field = vec![0f32; field.len()];
    // each ray owns a contiguous piece of the samples
    let mut rest = &mut g_field[..];
    let split_ray = |r: usize| {
        let n = (segments.offsets[r + 1] - segments.offsets[r]) as usize;
        rest.split_off_mut(..n * WIDTH).expect("a row for each sample")
    };
    let tasks: Vec<&mut [f32]> = (0..count).map(split_ray).collect();
    let g_inv_s: Vec<f64> = tasks
        .into_par_iter()
        .enumerate()
        .with_min_len(64)
        .map(|(r, g_samples)| {
            let first = segments.offsets[r] as usize;
            let n = g_samples.len() / WIDTH;
            let g = &g_out[r * RAY_WIDTH..][..RAY_WIDTH];
            // recompute the forward pass: alphas, transmittances and the loss gradient g_w by each
            // weight
            let mut samples = Vec::with_capacity(n);
            let mut transmittance = 1f32;
            for s in first..first + n {
                let f = &field[s * WIDTH..][..WIDTH];
                let (normal, length) = normal_of(f);
                let cos = dot(segments.direction[r], normal);
                let sharp = local_sharpness(clamped, f);
                let a = alpha_of(f[0], cos, segments.dt[s], sharp, anneal);
                let g_w: f32 =
                    g.iter().zip(values_of(f, normal, segments.t[s])).map(|(g, value)| g * value).sum();
                let next = transmittance * (1.0 - a.alpha);
                samples.push((a, normal, length, transmittance, g_w, sharp));
                transmittance = next;
            }
            let mut farther = 0f32; // Σ_{j>k} w_j g_w_j
            let mut g_s = 0f64;
            for k in (0..n).rev() {
                let (a, normal, length, transmittance, g_w, sharp) = &samples[k];
                let s = first + k;
                let w = transmittance * a.alpha;
                let out = &mut g_samples[k * WIDTH..][..WIDTH];
                for c in 0..3 {
                    out[4 + c] = w * (g[c] + 2.0 * g[8] * field[s * WIDTH + 4 + c]);
                }
                let g_alpha = transmittance * g_w - farther / (1.0 - a.alpha).max(1e-10);
                farther += w * g_w;
                // the gradient by the unit normal has two parts: as composited, and through the
                // cosine
                let mut g_normal = [w * g[5], w * g[6], w * g[7]];
                if !a.clipped {
                    let (p, q) = (a.previous, a.next);
                    let d = p + EPSILON;
                    // α = (P − N + ε)/(P + ε): ∂P = N/(P+ε)², ∂N = −1/(P+ε)
                    let g_p = g_alpha * q / (d * d) * p * (1.0 - p);
                    let g_q = -g_alpha / d * q * (1.0 - q);
                    out[0] = (g_p + g_q) * sharp;
                    let half = 0.5 * a.ic * segments.dt[s];
                    let sdf = field[s * WIDTH];
                    // the gradient by ln s is that by the sample's offset and, divided by inv_s,
                    // that by inv_s
                    let g_ln = (g_p * (sdf - half) + g_q * (sdf + half)) * sharp;
                    out[7] = g_ln;
                    g_s += g_ln as f64;
                    let g_ic = (g_q - g_p) * sharp * 0.5 * segments.dt[s];
                    let g_cos = g_ic * a.ic_by_cos;
                    for c in 0..3 {
                        g_normal[c] += g_cos * segments.direction[r][c];
                    }
                }
                let radial = dot(*normal, g_normal);
                if *length > MIN_GRADIENT_NORM {
                    for c in 0..3 {
                        out[1 + c] = (g_normal[c] - normal[c] * radial) / length;
                    }
                }
            }
            g_s
        })
        .collect();
    let inside = (1e-6..=1e6).contains(&inv_s);
    (g_field, if inside { (g_inv_s.iter().sum::<f64>() / inv_s as f64) as f32 } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::reference;

    #[test]
    fn alphas_match_the_published_values() {
        let dt = 0.00101484375;
        let e3 = 3f32.exp();
        for (sdf, cos, s, a, want) in [
            (0.01, -0.8, 64.0, 0.25, 0.0194449),
            (0.0, -1.0, e3, 0.0, 0.0101598),
            (-0.05, -1.0, 1000.0, 1.0, 1.0),
            (0.02, 0.5, 200.0, 0.5, 4.66413e-4),
        ] {
            let got = alpha_of(sdf, cos, dt, s, a).alpha;
            assert!((got - want).abs() < 2e-6 * want.max(0.05), "{got} {want}");
        }
        for (sdf, s, want) in
            [(0.05, e3, 0.00546357), (0.2, e3, 3.70632e-4), (-0.1, e3, 0.0178938), (0.01, 1000.0, 5.80727e-5)]
        {
            let got = occupancy(sdf, 0.5 * dt, s);
            assert!((got - want).abs() < 5e-7, "{got} {want}");
        }
    }

    #[test]
    fn extreme_fields_have_finite_opacities_and_bounded_gradients() {
        let offsets = [0, 4];
        let (direction, t, dt) = ([[0.6, 0.0, -0.8]], [1.0, 1.1, 1.2, 1.3], [1e-9, 0.05, 3.0, 1e3]);
        let segments = Segments { offsets: &offsets, direction: &direction, t: &t, dt: &dt };
        let g = [1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0];
        for inv_s in [0.0, 1e-9, 1e-6, 1.0, 1e6, 1e9, f32::INFINITY] {
            for sdf in [0.0, 1e-30, -1e-6, 1.0, -1e3, 1e20] {
                for slope in [0.0, 1e-30, 1e-12, 2e-6, 1.0, 1e6] {
                    let sample = |k: usize| [sdf, slope, -0.5 * slope, 0.0, 0.5, 0.5, 0.5, -(k as f32)];
                    let field: Vec<f32> = (0..4).flat_map(sample).collect();
                    let composited = forward(segments, &field, inv_s, 1.0);
                    assert!(
                        composited.iter().all(|v| v.is_finite() && v.abs() < 2.0),
                        "{inv_s} {sdf} {slope} {composited:?}"
                    );
                    let (g_field, g_s) = backward(segments, &field, inv_s, 1.0, &g);
                    let gradients = || g_field.iter().chain([&g_s]);
                    assert!(gradients().all(|v| v.is_finite()), "{inv_s} {sdf} {slope} {g_field:?} {g_s}");
                    // 3 · 1e6, the unit normal's 1 / MIN_GRADIENT_NORM, and 1e3 · 1e6 by the length
                    // of an interval
                    assert!(gradients().all(|v| v.abs() < 1e10), "{inv_s} {sdf} {slope} {g_field:?} {g_s}");
                    if slope < MIN_GRADIENT_NORM {
                        assert!(g_field.as_chunks::<8>().0.iter().all(|g| g[1..4] == [0.0; 3]));
                    }
                }
            }
        }
    }

    /// Returns Σ g · out, by the formulas in f64.
    fn loss(segments: Segments, field: &[f64], inv_s: f64, anneal: f64, g: &[f32]) -> f64 {
        let out = reference::neus::composite(segments, field, inv_s, anneal);
        out.iter().zip(g).map(|(o, g)| o * *g as f64).sum()
    }

    #[test]
    fn the_backward_agrees_with_f64_finite_differences() {
        let offsets = [0, 5, 5, 12];
        let direction = [[0.6, 0.0, -0.8], [0.0, 0.0, 1.0], [0.36, -0.48, 0.8]];
        let t: Vec<f32> = (0..12).map(|i| 1.0 + 0.05 * i as f32).collect();
        let dt = vec![0.05f32; 12];
        let segments = Segments { offsets: &offsets, direction: &direction, t: &t, dt: &dt };
        let field: Vec<f32> = (0..96)
            .map(|i| match i % 8 {
                0 => 0.12 - 0.03 * (i / 8 % 6) as f32,
                7 => -0.1 * (i % 5) as f32,
                1..=3 => (i as f32 * 0.7).sin() * 0.8 + if i % 8 == 3 { 0.5 } else { 0.0 },
                _ => 0.5 + 0.4 * (i as f32 * 1.3).cos(),
            })
            .collect();
        let g: Vec<f32> = (0..27).map(|i| (i as f32 * 0.9).sin()).collect();
        let (inv_s, anneal) = (30f32, 0.4f32);
        let (g_field, g_s) = backward(segments, &field, inv_s, anneal, &g);
        let wide = reference::wide(&field);
        let at = |f: &[f64], s: f64| loss(segments, f, s, anneal as f64, &g);
        let scale = g_field.iter().fold(0f32, |a, &b| a.max(b.abs())) as f64;
        for i in 0..96 {
            let mut f = wide.clone();
            f[i] += 1e-6;
            let up = at(&f, inv_s as f64);
            f[i] -= 2e-6;
            let slope = (up - at(&f, inv_s as f64)) / 2e-6;
            let error = (slope - g_field[i] as f64).abs() / slope.abs().max(1e-3 * scale);
            assert!(error < 1e-3, "field {i}: {slope} {}", g_field[i]);
        }
        let slope = (at(&wide, inv_s as f64 + 1e-4) - at(&wide, inv_s as f64 - 1e-4)) / 2e-4;
        assert!((slope - g_s as f64).abs() < 1e-3 * slope.abs(), "inv_s {slope} {g_s}");
        assert_eq!(&forward(segments, &field, inv_s, anneal)[9..18], &[0.0; 9]);
    }
}
