//! Gaussian blur.

/// Returns one channel of a picture with `w` pixels a row, `[height · w]`, convolved with a
/// Gaussian of this deviation, pixels, above 0. Beyond the border, its pixels are repeated.
pub fn blurred(picture: &[f32], w: usize, deviation: f32) -> Vec<f32> {
    let reach = (3.0 * deviation).ceil() as usize;
    let weight = |k: usize| (-0.5 * (k as f32 / deviation).powi(2)).exp();
    let total = weight(0) + 2.0 * (1..=reach).map(weight).sum::<f32>();
    let weights: Vec<f32> = (0..=reach).map(|k| weight(k) / total).collect();
    if picture.is_empty() {
        return Vec::new();
    }
    // whole rows are added, which fills the lanes of the CPU
    let add = |out: &mut [f32], weight: f32, one: &[f32], other: &[f32]| {
        out.iter_mut().zip(one).zip(other).for_each(|((sum, a), b)| *sum += weight * (a + b));
    };
    let mut across = vec![0f32; picture.len()];
    let mut padded = vec![0f32; w + 2 * reach];
    for (row, out) in picture.chunks_exact(w).zip(across.chunks_exact_mut(w)) {
        padded[..reach].fill(row[0]);
        padded[reach..][..w].copy_from_slice(row);
        padded[reach + w..].fill(row[w - 1]);
        (1..=reach).for_each(|k| add(out, weights[k], &padded[reach - k..][..w], &padded[reach + k..][..w]));
        out.iter_mut().zip(row).for_each(|(sum, v)| *sum += weights[0] * v);
    }
    let rows: Vec<&[f32]> = across.chunks_exact(w).collect();
    let mut blurred = vec![0f32; picture.len()];
    for (y, out) in blurred.chunks_exact_mut(w).enumerate() {
        let below = |k: usize| rows[(y + k).min(rows.len() - 1)];
        (1..=reach).for_each(|k| add(out, weights[k], rows[y.saturating_sub(k)], below(k)));
        out.iter_mut().zip(rows[y]).for_each(|(sum, v)| *sum += weights[0] * v);
    }
    blurred
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_becomes_a_gaussian_and_a_plain_picture_stays() {
        let (w, h) = (9, 7);
        let mut point = vec![0.0; w * h];
        point[3 * w + 4] = 1.0;
        let found = blurred(&point, w, 0.8);
        let bell = |dx: f32, dy: f32| (-(dx * dx + dy * dy) / (2.0 * 0.8 * 0.8)).exp();
        let total: f32 = (-3..=3).flat_map(|y| (-3..=3).map(move |x| bell(x as f32, y as f32))).sum();
        for (i, v) in found.iter().enumerate() {
            let (dx, dy) = ((i % w) as f32 - 4.0, (i / w) as f32 - 3.0);
            let expected = if dx.abs() > 3.0 || dy.abs() > 3.0 { 0.0 } else { bell(dx, dy) / total };
            assert!((v - expected).abs() < 1e-6, "{dx} {dy} {v} {expected}");
        }
        // the border is repeated
        assert!(blurred(&vec![0.3; w * h], w, 2.0).iter().all(|v| (v - 0.3).abs() < 1e-6));
        assert!(blurred(&[], w, 1.0).is_empty());
    }
}
