//! The training loss of the signed-distance field and its gradients.
//!
//! With `C` and `O` a ray's color and opacity, `h` and `a` color (over black) and alpha of its
//! pixel, `b` a background, `e = C + (1 − O) b − h − (1 − a) b`. Means are taken over the rays with
//! samples (rgb_mse), over the rays whose pixel is entirely head (rgb_sample), over all rays
//! (mask), over the samples (eikonal, sparsity) and over the stereo points (stereo), whose signed
//! distance `f` is divided by the length `p` of a pixel:
//!
//! ```text
//! rgb_mse · ⟨e²⟩ + rgb_sample · ⟨Σ w (c − h)²⟩
//!   + mask · ⟨−a ln O − (1 − a) ln(1 − O)⟩
//!   + eikonal · ⟨(‖∇f‖ − 1)²⟩ + sparsity · ⟨exp(−β |f|)⟩
//!   + stereo · ⟨w (√((f / p)² + k²) − k)⟩
//! ```
//!
//! `Σ w (c − h)² = Σ w c² − 2 h Σ w c + h² Σ w`: compositing c² along with c is enough to compute
//! it.

use super::neus::RAY_WIDTH;
use super::sdf::WIDTH;
use rayon::prelude::*;

/// Weights of the loss terms, and the constants in them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossWeights {
    /// Weight of the squared error of the composited color.
    pub rgb_mse: f32,
    /// Weight of the squared error of each sample's color.
    pub rgb_sample: f32,
    /// Weight of the cross entropy of opacity and alpha.
    pub mask: f32,
    /// Weight of the eikonal loss, which keeps the sdf's gradient at length 1.
    pub eikonal: f32,
    /// Weight of the sparsity loss, which penalizes small absolute distances.
    pub sparsity: f32,
    /// β: decay rate of the sparsity loss, per unit of distance.
    pub sparsity_scale: f32,
    /// Weight of the distance from stereo points.
    pub stereo: f32,
    /// k: the distance from a stereo point, in pixels, up to which its loss is square and beyond
    /// which it is linear.
    pub knee: f32,
}

/// Random stream that draws the stereo points of a step.
pub const STEREO_STREAM: u64 = 12;

/// Number of loss terms of a ray: squared error, error of each sample's color, mask.
pub const RAY_TERMS: usize = 3;
/// Number of loss terms of a sample: eikonal, sparsity.
pub const SAMPLE_TERMS: usize = 2;
/// Number of all loss terms; they are stored in the order of the formula.
pub const TERMS: usize = RAY_TERMS + SAMPLE_TERMS + 1;

/// A pixel with an alpha above this is entirely head.
pub const HEAD_ALPHA: f32 = 0.999;

/// Photographed colors and masks of a batch of rays.
#[derive(Clone, Copy)]
pub struct Targets<'a> {
    /// `[rays + 1]`: ray `r` owns samples `offsets[r]..offsets[r + 1]`.
    pub offsets: &'a [i32],
    /// `[rays, 3]` colors of the pixels over black.
    pub color: &'a [[f32; 3]],
    /// `[rays]` alphas of the pixels, 0..=1.
    pub alpha: &'a [f32],
    /// `[rays, 3]` background colors of render and pixel.
    pub background: &'a [[f32; 3]],
}

/// Returns the unweighted loss terms of rays, and the gradient of the loss with respect to
/// `composed`, `[rays, 9]`.
///
/// # Shapes
///
/// - composed: `[rays, 9]`, the output of [`neus::composite`](super::neus::composite)
pub fn of_rays(composed: &[f32], targets: Targets, w: &LossWeights) -> ([f32; RAY_TERMS], Vec<f32>) {
    let Targets { offsets, color, alpha, background } = targets;
    let has_samples = |r: usize| offsets[r + 1] > offsets[r];
    let share = 1.0 / (3 * (0..alpha.len()).filter(|&r| has_samples(r)).count().max(1)) as f32;
    let head_share = 1.0 / (3 * alpha.iter().filter(|a| **a > HEAD_ALPHA).count().max(1)) as f32;
    let ray_share = 1.0 / alpha.len().max(1) as f32;
    let mut gradient = vec![0f32; composed.len()];
    let mut terms = [0f64; RAY_TERMS];
    for (r, (out, g)) in
        composed.chunks_exact(RAY_WIDTH).zip(gradient.chunks_exact_mut(RAY_WIDTH)).enumerate()
    {
        let (opacity, a) = (out[3], alpha[r]);
        let share = if has_samples(r) { share } else { 0.0 };
        let head = if a > HEAD_ALPHA { head_share } else { 0.0 };
        let (mut square, mut sample_error) = (0f32, out[8]);
        for c in 0..3 {
            let (h, b) = (color[r][c], background[r][c]);
            let e = out[c] + (1.0 - opacity) * b - (h + (1.0 - a) * b);
            square += e * e;
            sample_error += h * h * opacity - 2.0 * h * out[c];
            let by_error = 2.0 * e * w.rgb_mse * share;
            g[c] = by_error - 2.0 * h * w.rgb_sample * head;
            g[3] += h * h * w.rgb_sample * head - b * by_error;
        }
        g[8] = w.rgb_sample * head;
        let p = opacity.clamp(1e-3, 1.0 - 1e-3);
        if p == opacity {
            g[3] += ((1.0 - a) / (1.0 - p) - a / p) * ray_share * w.mask;
        }
        let cross = -(a * p.ln() + (1.0 - a) * (1.0 - p).ln());
        for (sum, term) in terms.iter_mut().zip([square * share, sample_error * head, cross * ray_share]) {
            *sum += f64::from(term);
        }
    }
    (terms.map(|t| t as f32), gradient)
}

/// Returns the unweighted loss terms of samples, and adds their gradients with respect to the
/// field's output to `g_field`.
///
/// # Shapes
///
/// - field, g_field: `[samples, 8]`
pub fn of_samples(field: &[f32], w: &LossWeights, g_field: &mut [f32]) -> [f32; SAMPLE_TERMS] {
    /// Floats per task. The number is fixed, so that sums do not depend on the number of threads.
    const CHUNK: usize = 4096 * WIDTH;
    let share = 1.0 / (field.len() / WIDTH).max(1) as f32;
    let of_chunk = |(field, g): (&[f32], &mut [f32])| {
        let mut terms = [0f64; SAMPLE_TERMS];
        for (out, g) in field.chunks_exact(WIDTH).zip(g.chunks_exact_mut(WIDTH)) {
            let length = (out[1] * out[1] + out[2] * out[2] + out[3] * out[3] + 1e-12).sqrt();
            let excess = length - 1.0;
            (1..4).for_each(|k| g[k] += 2.0 * excess / length * share * w.eikonal * out[k]);
            terms[0] += f64::from(excess * excess * share);
            if w.sparsity > 0.0 {
                let closeness = (-w.sparsity_scale * out[0].abs()).exp() * share;
                let sign = if out[0] == 0.0 { 0.0 } else { out[0].signum() };
                g[0] -= w.sparsity_scale * sign * closeness * w.sparsity;
                terms[1] += f64::from(closeness);
            }
        }
        terms
    };
    let terms: Vec<_> = field.par_chunks(CHUNK).zip(g_field.par_chunks_mut(CHUNK)).map(of_chunk).collect();
    std::array::from_fn(|k| terms.iter().map(|t| t[k]).sum::<f64>() as f32)
}

/// Returns the unweighted loss term of stereo points, and adds its gradient with respect to the
/// field's output to `g_field`.
///
/// # Shapes
///
/// - field, g_field: `[points, 8]`
/// - points: `[points, 2]`, the length of a pixel at each point in field units, and the point's
///   weight
pub fn of_points(field: &[f32], points: &[[f32; 2]], w: &LossWeights, g_field: &mut [f32]) -> f32 {
    let mut sum = 0f64;
    let rows = field.chunks_exact(WIDTH).zip(g_field.chunks_exact_mut(WIDTH));
    for ((out, g), [footprint, weight]) in rows.zip(points) {
        let even = weight / points.len() as f32;
        let off = out[0] / footprint;
        let root = (off * off + w.knee * w.knee).sqrt();
        g[0] += w.stereo * even * off / root / footprint;
        sum += f64::from(even * (root - w.knee));
    }
    sum as f32
}
