//! What a training step of I-Face minimizes: color, mask, eikonal and sparsity losses, as TI-Face names them.

use super::model::SdfModel;
use super::schedule;
use super::stereo::SurfacePoint;
use crate::config::iface::{Background, IfaceConfig};
use crate::field::pixels::Batch;
use crate::field::{self, ops};
use crate::kernel::sdf::FieldShape;
use crate::kernel::{march, rng};
use burn::tensor::{Device, Int, Tensor, TensorData};
use std::sync::Arc;

/// Distance from a stereo point, in pixels, up to which the loss is square and beyond which it is linear: about the
/// error of such points.
pub(super) const KNEE: f64 = 0.15;

/// Named losses of one step, `[1]` each, for the log and for naming the one that broke.
pub struct Losses {
    /// The weighted sum that is minimized.
    pub total: Tensor<1>,
    /// Mean squared error of the colors of rays that met a sample.
    pub rgb: Tensor<1>,
    /// Binary cross entropy of opacity and mask; none where there is no mask.
    pub mask: Option<Tensor<1>>,
    /// Mean of (‖∇f‖ − 1)² over the samples.
    pub eikonal: Tensor<1>,
    /// Mean of exp(−β |f|) over the samples.
    pub sparsity: Option<Tensor<1>>,
    /// Weighted mean distance from points that photographs agree on, in pixels, below [`KNEE`] squared.
    pub stereo: Option<Tensor<1>>,
}

/// A batch of pixels and the samples along their rays.
pub struct Marched<'a> {
    /// Rays with color and alpha of their pixels.
    pub batch: &'a Batch,
    /// Where along the rays the field is evaluated.
    pub samples: march::Samples,
    /// Points that the surface should pass through, some of all.
    pub stereo: Vec<SurfacePoint>,
    /// Length of a march step, in the field's units.
    pub dt: f32,
    /// Do the photographs have masks?
    pub masked: bool,
}

/// The losses of step `step`; random backgrounds come from `seed`.
///
/// # Shapes
///
/// `marched` holds `[rays]` pixels and `[n]` samples; the field is evaluated at `[n, 3]`, to `[n, 8]` (distance,
/// gradient, color, softness); composited, that is `[rays, 8]`.
pub fn losses(
    config: &IfaceConfig,
    model: &SdfModel,
    shape: &Arc<FieldShape>,
    marched: Marched,
    (seed, step): (u64, u64),
    device: &Device,
) -> Losses {
    let Marched { batch, samples, stereo, dt, masked } = marched;
    let (n, rays) = (samples.t.len(), batch.rays.len());
    // samples of rays first, then the points: one pass of the field for both
    let (mut x, mut d) = samples.points(&batch.rays, 0);
    let points = stereo.len();
    x.extend(stereo.iter().map(|p| p.position));
    d.resize(n + points, [0.0, 0.0, 1.0]); // their color is not looked at
    let rows = |v: Vec<[f32; 3]>| field::tensor(v.into_flattened(), [n + points, 3], device);
    let directions: Vec<f32> = batch.rays.iter().flat_map(|r| r.direction).collect();
    // target and render over the same background, whatever it is
    let background: Vec<[f32; 3]> = match config.background {
        Background::Black => vec![[0.0; 3]; rays],
        Background::Random => (0..rays as u64)
            .map(|r| std::array::from_fn(|c| rng::uniform(seed, step << 4 | 3, 3 * r + c as u64)))
            .collect(),
    };
    let mut target = Vec::with_capacity(3 * rays);
    for r in 0..rays {
        let a = batch.alpha[r];
        for c in 0..3 {
            target.push(batch.color[r][c] + (1.0 - a) * background[r][c]);
        }
    }
    let has_samples: Vec<f32> = samples.offsets.windows(2).map(|w| f32::from(w[1] > w[0])).collect();
    let alpha: Tensor<2> = field::tensor(batch.alpha.clone(), [rays, 1], device).autodiff();
    let background: Tensor<2> =
        field::tensor(background.into_iter().flatten().collect(), [rays, 3], device).autodiff();
    let target: Tensor<2> = field::tensor(target, [rays, 3], device).autodiff();
    // rays that are all head, and their color: background plays no part
    let full: Vec<f32> = batch.alpha.iter().map(|&a| f32::from(a > 0.999)).collect();
    let all_head = full.iter().sum::<f32>();
    let full: Tensor<2> = field::tensor(full, [rays, 1], device).autodiff();
    let head: Tensor<2> =
        field::tensor(batch.color.iter().flatten().copied().collect(), [rays, 3], device).autodiff();

    let all = model.field(shape, rows(x), rows(d)); // [n + points, 8]
    let out = if points > 0 { all.clone().narrow(0, 0, n) } else { all.clone() }; // [n, 8]
    let bundle = ops::RaySamples {
        direction: field::tensor(directions, [rays, 3], device).autodiff(),
        dt: field::tensor(vec![dt; n], [n], device).autodiff(),
        t: field::tensor(samples.t, [n], device).autodiff(),
        offsets: Tensor::<1, Int>::from_data(TensorData::new(samples.offsets, [rays + 1]), device).autodiff(),
    };
    let anneal = schedule::anneal(config, step);
    let inv_s = model.inv_s();
    let composed = ops::neus(out.clone(), inv_s.clone(), bundle.clone(), anneal); // [rays, 8]
    let opacity = composed.clone().narrow(1, 3, 1); // [rays, 1]
    // Σ w ‖c − h‖² = Σ w c² − 2 h Σ w c + h² Σ w, so compositing c² beside c gives it
    let single = (config.rgb_sample > 0.0 && all_head > 0.0).then(|| {
        let rgb = out.clone().narrow(1, 4, 3);
        let squared =
            Tensor::cat(vec![out.clone().narrow(1, 0, 4), rgb.square(), out.clone().narrow(1, 7, 1)], 1);
        let second = ops::neus(squared, inv_s, bundle, anneal).narrow(1, 0, 3); // [rays, 3]
        let first = composed.clone().narrow(1, 0, 3);
        let error = second - first * head.clone() * 2.0 + head.square() * opacity.clone();
        (error * full).sum() / (3.0 * all_head as f64)
    });
    let color = composed.narrow(1, 0, 3) + background * (opacity.clone().neg() + 1.0);

    // color over the rays that met something; the others are constant
    let counted: f32 = has_samples.iter().sum();
    let met: Tensor<2> = field::tensor(has_samples, [rays, 1], device).autodiff();
    let error = (color - target) * met;
    let denominator = 3.0 * counted.max(1.0) as f64;
    let rgb = error.clone().square().sum() / denominator;
    let mut total = rgb.clone() * config.rgb_mse;
    if let Some(single) = single {
        total = total + single * config.rgb_sample;
    }
    if config.rgb_l1 > 0.0 {
        total = total + error.abs().sum() / denominator * config.rgb_l1;
    }
    let mask = (masked && config.mask > 0.0).then(|| {
        let p = opacity.clamp(1e-3, 1.0 - 1e-3);
        let cross = alpha.clone() * p.clone().log() + (alpha.neg() + 1.0) * (p.neg() + 1.0).log();
        cross.mean().neg()
    });
    if let Some(mask) = &mask {
        total = total + mask.clone() * config.mask;
    }
    let gradient = out.clone().narrow(1, 1, 3); // [n, 3]
    let length = (gradient.square().sum_dim(1) + 1e-12).sqrt();
    let eikonal = (length - 1.0).square().mean();
    total = total + eikonal.clone() * config.eikonal;
    let sparsity =
        (config.sparsity > 0.0).then(|| (out.narrow(1, 0, 1).abs() * -config.sparsity_scale).exp().mean());
    if let Some(sparsity) = &sparsity {
        total = total + sparsity.clone() * config.sparsity;
    }
    let stereo = (points > 0).then(|| {
        let column = |value: fn(&SurfacePoint) -> f32| -> Tensor<2> {
            field::tensor(stereo.iter().map(value).collect(), [points, 1], device).autodiff()
        };
        let off = all.narrow(0, n, points).narrow(1, 0, 1) / column(|p| p.footprint);
        let loss = (off.square() + KNEE * KNEE).sqrt() - KNEE;
        (loss * column(|p| p.weight)).mean()
    });
    if let Some(stereo) = &stereo {
        total = total + stereo.clone() * config.stereo;
    }
    Losses { total, rgb, mask, eikonal, sparsity, stereo }
}
