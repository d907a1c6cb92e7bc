//! Peak signal-to-noise ratio: `−10 log10(Σ e² / (3 · pixels))`, data range 1.

use tiface_base::image::Image;

/// PSNR in dB of two three-channel pictures of one size, over the pixels where `inside` holds, or
/// all. `None` without pixels, with different sizes, or without any difference.
pub fn psnr(a: &Image, b: &Image, inside: Option<&[bool]>) -> Option<f64> {
    if (a.width, a.height, a.channels) != (b.width, b.height, b.channels) {
        return None;
    }
    let (mut sum, mut count) = (0.0f64, 0usize);
    let pixels = a.data.chunks_exact(a.channels).zip(b.data.chunks_exact(b.channels));
    for (i, (x, y)) in pixels.enumerate() {
        if inside.is_none_or(|m| m.get(i) == Some(&true)) {
            sum += x.iter().zip(y).map(|(x, y)| (*x as f64 - *y as f64).powi(2)).sum::<f64>();
            count += a.channels;
        }
    }
    let value = -10.0 * (sum / count as f64).log10();
    value.is_finite().then_some(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_golden_pair_has_its_golden_value() {
        let (a, b) = crate::metrics::golden();
        assert!((psnr(&a, &b, None).unwrap() - 10.5292616).abs() < 1e-6);
        assert_eq!(psnr(&a, &a, None), None);
        assert_eq!(psnr(&a, &b, Some(&[false; 576])), None);
    }
}
