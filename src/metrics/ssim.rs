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

/// Returns the mean over the windows that fit; TensoRF's figure. `None` for pictures of different
/// shape or smaller than the window.
pub fn ssim_valid(a: &Image, b: &Image) -> Option<f64> {
    let maps = maps(a, b, 0, true)?;
    let count: usize = maps.iter().map(Vec::len).sum();
    Some(maps.iter().flatten().sum::<f64>() / count as f64)
}

/// One value a pixel, `[height · width]`, mean over channels, with mirrored borders; their mean is
/// instant-nsr-pl's figure. `None` for pictures of different shape or below 6 pixels.
pub fn ssim_reflect_map(a: &Image, b: &Image) -> Option<Vec<f64>> {
    let maps = maps(a, b, RADIUS, false)?;
    let count = maps.len() as f64;
    Some((0..maps[0].len()).map(|i| maps.iter().map(|m| m[i]).sum::<f64>() / count).collect())
}

/// Returns a map per channel, after mirroring `border` pixels on every side.
fn maps(a: &Image, b: &Image, border: usize, possible: bool) -> Option<Vec<Vec<f64>>> {
    let (w, h) = (a.width as usize, a.height as usize);
    let same = (a.width, a.height, a.channels) == (b.width, b.height, b.channels) && a.channels > 0;
    let fits = w.min(h) > border && w.min(h) + 2 * border >= WINDOW;
    if !(same && fits) {
        return None;
    }
    let channel = |c: usize| {
        let x = padded(a, c, border);
        let y = padded(b, c, border);
        let width = w + 2 * border;
        let blurred = |f: &dyn Fn(f64, f64) -> f64| {
            blur(&x.iter().zip(&y).map(|(x, y)| f(*x, *y)).collect::<Vec<f64>>(), width)
        };
        let (ma, mb) = (blurred(&|x, _| x), blurred(&|_, y| y));
        let (aa, bb, ab) = (blurred(&|x, _| x * x), blurred(&|_, y| y * y), blurred(&|x, y| x * y));
        (0..ma.len())
            .map(|i| {
                let mut va = aa[i] - ma[i] * ma[i];
                let mut vb = bb[i] - mb[i] * mb[i];
                let mut cov = ab[i] - ma[i] * mb[i];
                if possible {
                    (va, vb) = (va.max(0.0), vb.max(0.0));
                    cov = cov.signum() * cov.abs().min((va * vb).sqrt());
                }
                (2.0 * ma[i] * mb[i] + C1) * (2.0 * cov + C2)
                    / ((ma[i] * ma[i] + mb[i] * mb[i] + C1) * (va + vb + C2))
            })
            .collect()
    };
    Some((0..a.channels).into_par_iter().map(channel).collect())
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
