//! Pictures made smaller before the mask is cut, and alphas made large again afterwards.
//!
//! Smaller is the area average of coded values (what the networks were trained on, and what keeps the
//! matting equation `I = α F + (1 − α) B` true in the space it is solved in); larger is bilinear between
//! pixel centres: column `x` of `W` looks at `(x + ½) w / W − ½` of `w`.

use crate::image::{Gray, Photo, quantise};
use rayon::prelude::*;

/// The size of a picture brought down to at most `side` pixels on its longest side; never larger than it is.
pub fn working_size(width: u32, height: u32, side: u32) -> (u32, u32) {
    let longest = width.max(height);
    if longest <= side {
        return (width, height);
    }
    let scaled = |x: u32| ((x as f64 * side as f64 / longest as f64 + 0.5) as u32).max(1);
    (scaled(width), scaled(height))
}

/// Which source pixels make one pixel of the smaller picture: the first, and how much of each.
struct Share {
    first: usize,
    weights: Vec<f32>,
}

/// One share per pixel of the smaller side; their weights sum to one.
fn shares(from: u32, to: u32) -> Vec<Share> {
    let step = from as f64 / to as f64;
    (0..to)
        .map(|i| {
            let (begin, end) = (i as f64 * step, ((i + 1) as f64 * step).min(from as f64));
            let first = (begin as usize).min(from as usize - 1);
            let last = (end.ceil() as usize).clamp(first + 1, from as usize);
            let overlap = |k: usize| (end.min((k + 1) as f64) - begin.max(k as f64)).max(0.0);
            let total: f64 = (first..last).map(overlap).sum();
            Share { first, weights: (first..last).map(|k| (overlap(k) / total) as f32).collect() }
        })
        .collect()
}

/// `channels` interleaved bytes a pixel, averaged. Rows are computed apart, each in a fixed order.
fn average(bytes: &[u8], channels: usize, from: (u32, u32), to: (u32, u32)) -> Vec<u8> {
    assert!(to.0 >= 1 && to.1 >= 1 && to.0 <= from.0 && to.1 <= from.1, "only smaller pictures are made");
    let (across, down) = (shares(from.0, to.0), shares(from.1, to.1));
    let stride = from.0 as usize * channels;
    let mut out = vec![0; to.0 as usize * to.1 as usize * channels];
    out.par_chunks_mut(to.0 as usize * channels).zip(down).for_each_init(
        || vec![0f32; stride],
        |column, (row, share)| {
            column.fill(0.0);
            for (k, &weight) in share.weights.iter().enumerate() {
                let source = &bytes[(share.first + k) * stride..][..stride];
                column.iter_mut().zip(source).for_each(|(sum, &v)| *sum += weight * v as f32);
            }
            for (pixel, share) in row.chunks_exact_mut(channels).zip(&across) {
                for (c, value) in pixel.iter_mut().enumerate() {
                    let part = share.weights.iter().enumerate();
                    let sum: f32 = part.map(|(k, w)| w * column[(share.first + k) * channels + c]).sum();
                    *value = (sum + 0.5) as u8;
                }
            }
        },
    );
    out
}

/// A photograph averaged down to `size`, which is nowhere larger than its own.
pub fn reduce_photo(photo: &Photo, size: (u32, u32)) -> Photo {
    let from = (photo.width, photo.height);
    if size == from {
        return photo.clone();
    }
    let bytes = average(photo.rgb.as_flattened(), 3, from, size);
    let rgb = bytes.as_chunks::<3>().0.to_vec();
    let alpha = photo.alpha.as_ref().map(|a| average(a, 1, from, size));
    Photo { width: size.0, height: size.1, rgb, alpha }
}

/// A mask averaged down to `size`, which is nowhere larger than its own.
pub fn reduce_gray(gray: &Gray, size: (u32, u32)) -> Gray {
    let from = (gray.width, gray.height);
    if size == from {
        return gray.clone();
    }
    Gray { width: size.0, height: size.1, values: average(&gray.values, 1, from, size) }
}

/// Alpha within 0..=1, with what is nearly nothing made nothing and what is nearly full made full. First
/// clamped, then hardened: a learner takes every value but 0 for head, so a stray 1 of 255 costs a pixel.
pub fn harden(alpha: f32, lowest: f32, highest: f32) -> f32 {
    match alpha.clamp(0.0, 1.0) {
        a if a < lowest => 0.0,
        a if a > highest => 1.0,
        a => a,
    }
}

/// Alphas `[from.1 · from.0]` brought to `size` by bilinear interpolation, then [`harden`]ed and coded in 8
/// bit. Values that are no numbers become 0.
pub fn enlarge(alpha: &[f32], from: (u32, u32), size: (u32, u32), lowest: f32, highest: f32) -> Gray {
    assert_eq!(alpha.len(), from.0 as usize * from.1 as usize);
    let across: Vec<_> = (0..size.0).map(|x| between(x, from.0, size.0)).collect();
    let width = from.0 as usize;
    let mut values = vec![0; size.0 as usize * size.1 as usize];
    values.par_chunks_mut(size.0 as usize).enumerate().for_each(|(y, row)| {
        let (above, below, v) = between(y as u32, from.1, size.1);
        let (above, below) = (&alpha[above * width..][..width], &alpha[below * width..][..width]);
        for (value, &(left, right, u)) in row.iter_mut().zip(&across) {
            let top = above[left] + u * (above[right] - above[left]);
            let bottom = below[left] + u * (below[right] - below[left]);
            *value = quantise(harden(top + v * (bottom - top), lowest, highest));
        }
    });
    Gray { width: size.0, height: size.1, values }
}

/// The two neighbours of pixel `i` of `to` among `from`, and how far it is from the first to the second.
fn between(i: u32, from: u32, to: u32) -> (usize, usize, f32) {
    let at = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64);
    let first = at as usize;
    (first, (first + 1).min(from as usize - 1), (at - first as f64) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gray(width: u32, height: u32, values: &[u8]) -> Gray {
        Gray { width, height, values: values.to_vec() }
    }

    #[test]
    fn the_longest_side_is_brought_down_and_the_other_rounded() {
        assert_eq!(working_size(3000, 4096, 1024), (750, 1024));
        assert_eq!(working_size(384, 512, 1024), (384, 512));
        // 2 · 1024 / 3000 = 0.68 → 1; 1 · 1024 / 5000 = 0.2 → 0, but a picture has at least one pixel
        assert_eq!(working_size(3000, 2, 1024), (1024, 1));
        assert_eq!(working_size(5000, 1, 1024), (1024, 1));
    }

    #[test]
    fn halving_averages_blocks_and_a_broken_factor_shares_pixels() {
        // (10 + 20 + 30 + 41) / 4 = 25.25 → 25; (0 + 255 + 255 + 0) / 4 = 127.5 → 128
        let four = gray(4, 2, &[10, 20, 0, 255, 30, 41, 255, 0]);
        assert_eq!(reduce_gray(&four, (2, 1)).values, [25, 128]);
        // three to two: (1 · 0 + ½ · 90) / 1.5 = 30 and (½ · 90 + 1 · 30) / 1.5 = 50
        assert_eq!(reduce_gray(&gray(3, 1, &[0, 90, 30]), (2, 1)).values, [30, 50]);
        assert_eq!(reduce_gray(&gray(1, 3, &[0, 90, 30]), (1, 2)).values, [30, 50]);
    }

    #[test]
    fn colours_and_alpha_of_a_photograph_are_averaged_apart() {
        let photo =
            Photo { width: 2, height: 1, rgb: vec![[0, 10, 200], [100, 30, 100]], alpha: Some(vec![0, 50]) };
        let small = reduce_photo(&photo, (1, 1));
        assert_eq!((small.rgb[0], small.alpha), ([50, 20, 150], Some(vec![25])));
    }

    #[test]
    fn an_even_picture_stays_even_at_any_factor() {
        let photo = gray(101, 67, &[77; 101 * 67]);
        for size in [(100, 66), (33, 20), (1, 1), (7, 67)] {
            assert!(reduce_gray(&photo, size).values.iter().all(|&v| v == 77), "{size:?}");
        }
    }

    #[test]
    fn doubling_puts_new_centres_a_quarter_from_the_old() {
        // centres of the four at −¼, ¼, ¾, 5/4 of the two: 0, ¼, ¾, 1
        let large = enlarge(&[0.0, 1.0], (2, 1), (4, 1), 0.0, 1.0);
        assert_eq!(large.values, [0, 64, 191, 255]);
        let tall = enlarge(&[0.0, 1.0], (1, 2), (1, 4), 0.0, 1.0);
        assert_eq!(tall.values, [0, 64, 191, 255]);
    }

    #[test]
    fn alphas_are_clamped_before_they_are_hardened() {
        let given = [-3.0, 0.019, 0.021, 0.5, 0.979, 0.981, 7.0];
        let hard: Vec<f32> = given.iter().map(|&a| harden(a, 0.02, 0.98)).collect();
        assert_eq!(hard, [0.0, 0.0, 0.021, 0.5, 0.979, 1.0, 1.0]);
        // 0.021 · 255 = 5.4 → 5: the smallest value that is left
        assert_eq!(enlarge(&given, (7, 1), (7, 1), 0.02, 0.98).values, [0, 0, 5, 128, 250, 255, 255]);
        assert_eq!(enlarge(&[f32::NAN], (1, 1), (2, 1), 0.02, 0.98).values, [0, 0]);
    }
}
