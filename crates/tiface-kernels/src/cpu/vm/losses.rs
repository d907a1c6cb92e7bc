//! The training loss of TensoRF's field and its gradients.
//!
//! With `C` and `O` a ray's color and opacity, `h` and `a` color (over black) and alpha of its
//! pixel, `b` the background of both, and means over the rays:
//!
//! ```text
//! ⟨(clamp(C + (1 − O) b) − h − (1 − a) b)²⟩
//!     + mask · ⟨O²⟩ over rays with a = 0, or mask · ⟨−m ln O − (1 − m) ln(1 − O)⟩
//! ```
//!
//! where m is 1 for every pixel with a > 0.

use super::RAY_WIDTH;

/// Number of loss terms of a ray: squared error, mask, squared opacity of the background.
pub const TERMS: usize = 3;

/// Loss term that compares opacity with the mask.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MaskTerm {
    /// No mask loss.
    None,
    /// Squared opacity of background rays, with a weight.
    L2(f32),
    /// Cross entropy of opacity and mask, with a weight; every pixel with an alpha above 0 counts
    /// as head.
    Ce(f32),
}

/// Background of renders and photographs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BackgroundMode {
    /// Gray level that is added to the batch's background for the render only, not for the pixel.
    pub lift: f32,
    /// Whether the pixel is composited over the batch's background, too.
    pub target: bool,
}

/// Photographed colors and masks of a batch of rays.
#[derive(Clone, Copy)]
pub struct Targets<'a> {
    /// `[rays, 3]` colors of the pixels over black.
    pub color: &'a [[f32; 3]],
    /// `[rays]` alphas of the pixels, 0..=1.
    pub alpha: &'a [f32],
    /// `[rays, 3]` background colors.
    pub background: &'a [[f32; 3]],
}

/// Returns the unweighted loss terms, and the gradient of the loss with respect to `composed`,
/// `[rays, 5]`. The squared opacity of the background is 0 in a batch without background rays,
/// where the published mean is NaN.
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
    let ray_share = 1.0 / alpha.len().max(1) as f32;
    let background_share = 1.0 / alpha.iter().filter(|a| **a == 0.0).count().max(1) as f32;
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
            let clamped = raw.clamp(0.0, 1.0);
            let e = clamped - (color[r][c] + if mode.target { (1.0 - a) * b } else { 0.0 });
            square += e * e;
            if raw == clamped {
                g[c] = 2.0 * e * ray_share / 3.0;
                g[3] -= g[c] * (b + mode.lift);
            }
        }
        let empty = if a == 0.0 { opacity * opacity * background_share } else { 0.0 };
        let term = match mask {
            MaskTerm::None => 0.0,
            MaskTerm::L2(weight) => {
                g[3] += if a == 0.0 { 2.0 * weight * opacity * background_share } else { 0.0 };
                empty
            }
            MaskTerm::Ce(weight) => {
                let p = opacity.clamp(1e-3, 1.0 - 1e-3);
                let m = f32::from(a != 0.0);
                if p == opacity {
                    g[3] += ((1.0 - m) / (1.0 - p) - m / p) * ray_share * weight;
                }
                -(m * p.ln() + (1.0 - m) * (1.0 - p).ln()) * ray_share
            }
        };
        for (sum, term) in terms.iter_mut().zip([square * ray_share / 3.0, term, empty]) {
            *sum += f64::from(term);
        }
    }
    (terms.map(|t| t as f32), gradient)
}

/// Results of training steps since the last report.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VmFigures {
    /// Sums over the steps of the unweighted squared error, mask term and squared opacity of the
    /// background.
    pub terms: [f32; TERMS],
    /// Number of lattice points inside the box, including those that the mask skips.
    pub lattice: u64,
    /// Number of samples whose density was evaluated.
    pub density: u64,
    /// Number of samples whose color was decoded.
    pub color: u64,
    /// Number of rays.
    pub rays: u64,
    /// Whether a gradient of the decoder was not finite.
    pub non_finite: bool,
}

impl VmFigures {
    /// Adds the counts of other steps.
    pub fn count(&mut self, other: &VmFigures) {
        self.rays += other.rays;
        self.lattice += other.lattice;
        self.density += other.density;
        self.color += other.color;
    }
}
