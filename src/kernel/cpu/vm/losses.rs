//! What a training step of TensoRF's field minimizes, and its gradients.
//!
//! With `C` and `O` a ray's color and opacity, `h` and `a` color (over black) and alpha of its pixel, `b` what both are
//! seen over, and means over the rays:
//!
//! ```text
//! ⟨(clamp(C + (1 − O) b) − h − (1 − a) b)²⟩ + mask · ⟨O²⟩ over rays with a = 0, or mask · ⟨−m ln O − (1 − m) ln(1 − O)⟩
//! ```
//!
//! where m is 1 for all that is a little head.

use super::RAY_WIDTH;

/// Terms of a ray: squared error, mask, squared opacity of the background.
pub const TERMS: usize = 3;

/// How opacity is held to the mask.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MaskTerm {
    /// Not at all.
    None,
    /// Squared opacity of background rays, with this weight.
    L2(f32),
    /// Cross entropy of opacity and mask, where all that is a little head is head, with this weight.
    Ce(f32),
}

/// What rays are seen over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BackgroundMode {
    /// A gray added to the batch's background behind the render, not behind the pixel.
    pub lift: f32,
    /// Is the batch's background behind the pixel, too?
    pub target: bool,
}

/// What the pixels of a batch of rays show.
#[derive(Clone, Copy)]
pub struct Targets<'a> {
    /// `[rays, 3]` over black.
    pub color: &'a [[f32; 3]],
    /// `[rays]`.
    pub alpha: &'a [f32],
    /// `[rays, 3]`.
    pub background: &'a [[f32; 3]],
}

/// Returns the terms, unweighted, and the gradient of the loss by what was composited, `[rays, 5]`. A batch without a
/// background ray has no squared opacity of it (the published mean is NaN then).
///
/// # Shapes
///
/// - composed: `[rays, 5]`, see [`RAY_WIDTH`]
pub fn of_rays(
    composed: &[f32],
    targets: Targets,
    mode: BackgroundMode,
    mask: MaskTerm,
) -> ([f32; TERMS], Vec<f32>) {
    let Targets { color, alpha, background } = targets;
    let even = 1.0 / alpha.len().max(1) as f32;
    let outside = 1.0 / alpha.iter().filter(|a| **a == 0.0).count().max(1) as f32;
    let mut gradient = vec![0f32; composed.len()];
    let mut terms = [0f64; TERMS];
    for (r, (out, g)) in
        composed.chunks_exact(RAY_WIDTH).zip(gradient.chunks_exact_mut(RAY_WIDTH)).enumerate()
    {
        let (opacity, a) = (out[3], alpha[r]);
        let mut square = 0f32;
        for c in 0..3 {
            let b = background[r][c];
            let raw = out[c] + (1.0 - opacity) * (b + mode.lift);
            let shown = raw.clamp(0.0, 1.0);
            let e = shown - (color[r][c] + if mode.target { (1.0 - a) * b } else { 0.0 });
            square += e * e;
            if raw == shown {
                g[c] = 2.0 * e * even / 3.0;
                g[3] -= g[c] * (b + mode.lift);
            }
        }
        let empty = if a == 0.0 { opacity * opacity * outside } else { 0.0 };
        let term = match mask {
            MaskTerm::None => 0.0,
            MaskTerm::L2(weight) => {
                g[3] += if a == 0.0 { 2.0 * weight * opacity * outside } else { 0.0 };
                empty
            }
            MaskTerm::Ce(weight) => {
                let p = opacity.clamp(1e-3, 1.0 - 1e-3);
                let m = f32::from(a != 0.0);
                if p == opacity {
                    g[3] += ((1.0 - m) / (1.0 - p) - m / p) * even * weight;
                }
                -(m * p.ln() + (1.0 - m) * (1.0 - p).ln()) * even
            }
        };
        for (sum, term) in terms.iter_mut().zip([square * even / 3.0, term, empty]) {
            *sum += f64::from(term);
        }
    }
    (terms.map(|t| t as f32), gradient)
}

/// What steps came to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VmFigures {
    /// Sums over the steps of the squared error, the mask's term and the background's squared opacity, unweighted.
    pub terms: [f32; TERMS],
    /// Lattice points inside the box, were nothing skipped.
    pub lattice: u64,
    /// Samples whose density was looked up.
    pub density: u64,
    /// Samples whose color was decoded.
    pub color: u64,
    /// Rays.
    pub rays: u64,
    /// Was a gradient of the decoder not finite?
    pub broken: bool,
}
