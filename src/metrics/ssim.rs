//! Structural similarity (Wang, Bovik, Sheikh, Simoncelli 2004) with the constants of the published
//! evaluations: Gaussian window of 11 × 11, σ = 1.5, k₁ = 0.01, k₂ = 0.03, range 1.
//!
//! `(2 μa μb + c₁)(2 σab + c₂) / ((μa² + μb² + c₁)(σa² + σb² + c₂))`, per channel, then the
//! mean.
//!
//! Two variants exist and are not equal. TensoRF's keeps only windows that fit (*valid*) and forces
//! variances to be possible. instant-nsr-pl's mirrors the border (*reflect*), which gives one value
//! per pixel: that one can be averaged over a mask.

use rayon::prelude::*;
use tiface_base::dispatch;
use tiface_base::image::Image;

const WINDOW: usize = 11;
const RADIUS: usize = WINDOW / 2;

/// Outputs of the window that are summed together.
const BLOCK: usize = 16;

const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Both variants of a pair of pictures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ssim {
    /// The figure of [`ssim_valid`].
    pub valid: Option<f64>,
    /// That of [`ssim_reflect_map`].
    pub reflect_map: Option<Vec<f64>>,
}

/// Returns the mean over the windows that fit; TensoRF's figure. `None` for pictures of different
/// shape or smaller than the window.
pub fn ssim_valid(a: &Image, b: &Image) -> Option<f64> {
    mean_of_fitting(&channels(a, b, 0, [true, false])?)
}

/// One value a pixel, `[height · width]`, mean over channels, with mirrored borders; their mean is
/// instant-nsr-pl's figure. `None` for pictures of different shape or below 6 pixels.
pub fn ssim_reflect_map(a: &Image, b: &Image) -> Option<Vec<f64>> {
    Some(mean_of_channels(&channels(a, b, RADIUS, [false, true])?))
}

/// Returns both variants for the time of one: windows that fit are those of the mirrored pictures
/// that reach over no border.
pub fn ssim(a: &Image, b: &Image) -> Ssim {
    let Some(channels) = channels(a, b, RADIUS, [true, true]) else { return Ssim::default() };
    Ssim { valid: mean_of_fitting(&channels), reflect_map: Some(mean_of_channels(&channels)) }
}

/// Similarities in the windows of one channel of two pictures.
struct Channel {
    /// In the windows that fit, with possible variances.
    fitting: Vec<f64>,
    /// In all windows.
    all: Vec<f64>,
}

/// Returns the similarities of each channel, after mirroring `border` pixels on every side;
/// `wanted`: in the windows that fit, in all of them.
fn channels(a: &Image, b: &Image, border: usize, wanted: [bool; 2]) -> Option<Vec<Channel>> {
    let (w, h) = (a.width as usize, a.height as usize);
    let same = (a.width, a.height, a.channels) == (b.width, b.height, b.channels) && a.channels > 0;
    let fits = w.min(h) > border && w.min(h) + 2 * border >= WINDOW;
    if !(same && fits) {
        return None;
    }
    let channel = |c: usize| {
        let (x, y) = (padded(a, c, border), padded(b, c, border));
        let width = w + 2 * border;
        let blurred = |f: &dyn Fn(f64, f64) -> f64| {
            blur(&x.iter().zip(&y).map(|(x, y)| f(*x, *y)).collect::<Vec<f64>>(), width)
        };
        let (ma, mb) = (blur(&x, width), blur(&y, width));
        let (aa, bb, ab) = (blurred(&|x, _| x * x), blurred(&|_, y| y * y), blurred(&|x, y| x * y));
        let similarity = |i: usize, possible: bool| {
            let mut va = aa[i] - ma[i] * ma[i];
            let mut vb = bb[i] - mb[i] * mb[i];
            let mut cov = ab[i] - ma[i] * mb[i];
            if possible {
                (va, vb) = (va.max(0.0), vb.max(0.0));
                cov = cov.signum() * cov.abs().min((va * vb).sqrt());
            }
            (2.0 * ma[i] * mb[i] + C1) * (2.0 * cov + C2)
                / ((ma[i] * ma[i] + mb[i] * mb[i] + C1) * (va + vb + C2))
        };
        // windows within the picture, of those of the mirrored one
        let [columns, rows] = [w, h].map(|n| if wanted[0] { n.saturating_sub(WINDOW - 1) } else { 0 });
        let within = (0..rows).flat_map(|y| (0..columns).map(move |x| (y, x)));
        let stride = width - (WINDOW - 1);
        let fitting = within.map(|(y, x)| similarity((y + border) * stride + x + border, true)).collect();
        let all = (0..if wanted[1] { ma.len() } else { 0 }).map(|i| similarity(i, false)).collect();
        Channel { fitting, all }
    };
    Some((0..a.channels).into_par_iter().map(channel).collect())
}

/// Returns the mean over the windows that fit; `None` if there are none.
fn mean_of_fitting(channels: &[Channel]) -> Option<f64> {
    let count: usize = channels.iter().map(|c| c.fitting.len()).sum();
    let sum: f64 = channels.iter().flat_map(|c| &c.fitting).sum();
    (count > 0).then(|| sum / count as f64)
}

/// Returns the mean over the channels in every window.
fn mean_of_channels(channels: &[Channel]) -> Vec<f64> {
    let count = channels.len() as f64;
    (0..channels[0].all.len()).map(|i| channels.iter().map(|c| c.all[i]).sum::<f64>() / count).collect()
}

/// One channel with mirrored borders; the edge pixel itself is not repeated.
fn padded(image: &Image, channel: usize, border: usize) -> Vec<f64> {
    let mirror = |i: usize, n: usize| {
        let i = i as i64 - border as i64;
        (if i < 0 { -i } else { i.min(2 * (n as i64 - 1) - i) }) as u32
    };
    let (w, h) = (image.width as usize, image.height as usize);
    let mut plane = Vec::with_capacity((w + 2 * border) * (h + 2 * border));
    for y in 0..h + 2 * border {
        for x in 0..w + 2 * border {
            plane.push(image.pixel(mirror(x, w), mirror(y, h))[channel] as f64);
        }
    }
    plane
}

/// Separable Gaussian, only where the window fits.
fn blur(plane: &[f64], width: usize) -> Vec<f64> {
    let mut kernel: [f64; WINDOW] =
        std::array::from_fn(|i| (-((i as f64 - RADIUS as f64) / 1.5).powi(2) / 2.0).exp());
    let sum: f64 = kernel.iter().sum();
    kernel.iter_mut().for_each(|k| *k /= sum);
    let (narrow, height) = (width - WINDOW + 1, plane.len() / width);
    let mut rows = vec![0.0; narrow * height];
    for (out, row) in rows.chunks_exact_mut(narrow).zip(plane.chunks_exact(width)) {
        weighted_sum(out, row, 1, &kernel);
    }
    let mut out = vec![0.0; narrow * (height - WINDOW + 1)];
    for (y, line) in out.chunks_exact_mut(narrow).enumerate() {
        weighted_sum(line, &rows[y * narrow..], narrow, &kernel);
    }
    out
}

dispatch! {
    /// Writes `out[i] = Σ_k kernel[k] · values[i + k · stride]`, summed in the order of k.
    fn weighted_sum / weighted_sum_body(
        out: &mut [f64],
        values: &[f64],
        stride: usize,
        kernel: &[f64; WINDOW],
    )
}

#[inline(always)]
fn weighted_sum_body<const HAS_FMA: bool>(
    out: &mut [f64],
    values: &[f64],
    stride: usize,
    kernel: &[f64; WINDOW],
) {
    // some outputs at a time stay in registers over all of the kernel
    for (block, out) in out.chunks_mut(BLOCK).enumerate() {
        let mut sums = [0f64; BLOCK];
        for (k, weight) in kernel.iter().enumerate() {
            let values = &values[block * BLOCK + k * stride..][..out.len()];
            match <&[f64; BLOCK]>::try_from(values) {
                Ok(values) => (0..BLOCK).for_each(|i| sums[i] += weight * values[i]),
                Err(_) => values.iter().zip(&mut sums).for_each(|(v, sum)| *sum += weight * v),
            }
        }
        // a copy of a length that is not known would be a call
        match out.first_chunk_mut() {
            Some(out) => *out = sums,
            None => out.copy_from_slice(&sums[..out.len()]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_golden_pair_has_both_golden_values() {
        let (a, b) = crate::metrics::golden();
        assert!((ssim_valid(&a, &b).unwrap() - 0.4777463).abs() < 1e-6, "{:?}", ssim_valid(&a, &b));
        let reflected = ssim_reflect_map(&a, &b).unwrap();
        let mean = reflected.iter().sum::<f64>() / reflected.len() as f64;
        assert!((mean - 0.5162364).abs() < 1e-6, "{mean}");
    }

    #[test]
    fn both_variants_together_are_what_each_is_alone() {
        let ramp = |w: u32, h: u32, by: f32| Image {
            data: (0..w * h * 3).map(|i| (i as f32 * by).sin().abs()).collect(),
            ..Image::new(w, h, 3)
        };
        // a window fits in all, in one way, not at all
        for (w, h) in [(40, 23), (11, 16), (11, 11), (10, 30), (6, 6), (5, 30)] {
            let (a, b) = (ramp(w, h, 0.13), ramp(w, h, 0.17));
            let alone = Ssim { valid: ssim_valid(&a, &b), reflect_map: ssim_reflect_map(&a, &b) };
            assert_eq!(ssim(&a, &b), alone, "{w} × {h}");
            assert_eq!(alone.valid.is_some(), w >= 11, "{w} × {h}");
        }
    }

    #[test]
    fn a_picture_is_like_itself() {
        let (a, _) = crate::metrics::golden();
        assert!((ssim_valid(&a, &a).unwrap() - 1.0).abs() < 1e-12);
        assert!(ssim_reflect_map(&a, &a).unwrap().iter().all(|s| (s - 1.0).abs() < 1e-9));
    }

    #[test]
    fn pictures_too_small_for_the_window_have_no_value() {
        let small = Image::new(10, 24, 3);
        assert_eq!(ssim_valid(&small, &small), None);
        assert!(ssim_reflect_map(&small, &small).is_some());
        let tiny = Image::new(5, 24, 3);
        assert_eq!(ssim_reflect_map(&tiny, &tiny), None);
        assert_eq!(ssim_valid(&Image::new(24, 24, 3), &Image::new(24, 24, 4)), None);
    }
}
