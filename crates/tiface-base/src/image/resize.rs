//! Pictures at other sizes.
//!
//! Smaller is the mean over the area of each new pixel: of coded values ([`reduce_photo`]), which
//! is what networks were trained on, and keeps the matting equation `I = α F + (1 − α) B` true in
//! the space it is solved in; or in linear light, for a cut, whose colors only distinguish two
//! sides, and for a photograph that stands for one of a coarser sensor. Larger is bilinear between
//! pixel centers: column `x` of `W` samples `(x + ½) w / W − ½` of `w`.

use super::{Gray, Photo, linear_from_srgb, quantize, srgb_from_linear};
use rayon::prelude::*;

/// Returns the size of a picture brought down to at most `side` pixels on its longest side; never
/// larger than it is.
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

/// Conversion of bytes to the values that are averaged, and back.
struct Coding {
    value: fn(u8) -> f32,
    byte: fn(f32) -> u8,
}

/// Themselves: coded colors, masks.
const CODED: Coding = Coding { value: |byte| byte as f32, byte: |value| (value + 0.5) as u8 };
/// Linear light, as a coarser sensor would have seen it.
const LIGHT: Coding = Coding {
    value: |byte| linear_from_srgb(byte as f32 / 255.0),
    byte: |value| quantize(srgb_from_linear(value)),
};

/// `channels` interleaved bytes a pixel, averaged. Rows are computed apart, each in a fixed order.
fn average(bytes: &[u8], channels: usize, from: (u32, u32), to: (u32, u32), coding: Coding) -> Vec<u8> {
    let values: Vec<f32> = (0..=255).map(coding.value).collect();
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
                column.iter_mut().zip(source).for_each(|(sum, &v)| *sum += weight * values[v as usize]);
            }
            for (pixel, share) in row.chunks_exact_mut(channels).zip(&across) {
                for (c, value) in pixel.iter_mut().enumerate() {
                    let part = share.weights.iter().enumerate();
                    let sum: f32 = part.map(|(k, w)| w * column[(share.first + k) * channels + c]).sum();
                    *value = (coding.byte)(sum);
                }
            }
        },
    );
    out
}

/// Returns a photograph averaged down to `size`, which is nowhere larger than its own.
pub fn reduce_photo(photo: &Photo, size: (u32, u32)) -> Photo {
    let from = (photo.width, photo.height);
    if size == from {
        return photo.clone();
    }
    let bytes = average(photo.rgb.as_flattened(), 3, from, size, CODED);
    let rgb = bytes.as_chunks::<3>().0.to_vec();
    let alpha = photo.alpha.as_ref().map(|a| average(a, 1, from, size, CODED));
    Photo { width: size.0, height: size.1, rgb, alpha }
}

/// Returns the size of a picture of `size` brought down to at most `rows` rows.
pub fn size_at_rows((width, height): (u32, u32), rows: u32) -> (u32, u32) {
    match height <= rows {
        true => (width, height),
        false => ((width as f64 * rows as f64 / height as f64).round().max(1.0) as u32, rows),
    }
}

/// Returns a photograph averaged down in linear light to at most `rows` rows, without its alpha;
/// the same photograph when it is small enough already.
pub fn reduce_to_rows(photo: &Photo, rows: u32) -> Photo {
    let from = (photo.width, photo.height);
    let size = size_at_rows(from, rows);
    if size == from {
        return Photo { alpha: None, ..photo.clone() };
    }
    let bytes = average(photo.rgb.as_flattened(), 3, from, size, LIGHT);
    Photo { width: size.0, height: size.1, rgb: bytes.as_chunks::<3>().0.to_vec(), alpha: None }
}

/// Returns a gray picture at another size: averaged where it is larger in both directions, else
/// interpolated.
pub fn resize_gray(gray: &Gray, size: (u32, u32)) -> Gray {
    let from = (gray.width, gray.height);
    if size == from {
        return gray.clone();
    }
    if from.0 >= size.0 && from.1 >= size.1 {
        return Gray { width: size.0, height: size.1, values: average(&gray.values, 1, from, size, CODED) };
    }
    let values: Vec<f32> = gray.values.iter().map(|&v| v as f32 / 255.0).collect();
    enlarge(&values, from, size, 0.0, 1.0)
}

/// Returns a mask (head where it is 128 or more) at another size, 255 or 0: resized and cut at one
/// half. Its outline is smooth where copied pixels would make stairs.
pub fn resize_hard(mask: &Gray, size: (u32, u32)) -> Gray {
    let mut resized = resize_gray(mask, size);
    resized.values.iter_mut().for_each(|v| *v = if *v >= 128 { 255 } else { 0 });
    resized
}

/// Clamps alpha to 0..=1, with values near 0 and 1 set to 0 and 1. First clamped, then hardened: a
/// learner takes every value but 0 for head, so a stray 1 of 255 costs a pixel.
#[inline]
pub fn harden(alpha: f32, lowest: f32, highest: f32) -> f32 {
    match alpha.clamp(0.0, 1.0) {
        a if a < lowest => 0.0,
        a if a > highest => 1.0,
        a => a,
    }
}

/// Alphas `[from.1 · from.0]` brought to `size` by bilinear interpolation, then hardened (`harden`)
/// and coded in 8 bit. Values that are no numbers become 0.
pub fn enlarge(alpha: &[f32], from: (u32, u32), size: (u32, u32), lowest: f32, highest: f32) -> Gray {
    assert_eq!(alpha.len(), from.0 as usize * from.1 as usize);
    let coded = |v: f32| quantize(harden(v, lowest, highest));
    Gray { width: size.0, height: size.1, values: bilinear(alpha, from.0, from, size, coded) }
}

/// Returns a field of `from` (width, height) at the pixel centers of `to`, each value given to
/// `with`; edges are repeated. Rows of `values` are `stride` apart, so the upper left `from` of a
/// larger field can be taken.
pub fn bilinear<T: Copy + Default + Send>(
    values: &[f32],
    stride: u32,
    from: (u32, u32),
    to: (u32, u32),
    with: impl Fn(f32) -> T + Sync,
) -> Vec<T> {
    let across: Vec<_> = (0..to.0).map(|x| between(x, from.0, to.0)).collect();
    let (width, stride) = (to.0 as usize, stride as usize);
    let mut out = vec![T::default(); width * to.1 as usize];
    out.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let (above, below, v) = between(y as u32, from.1, to.1);
        let (above, below) = (&values[above * stride..], &values[below * stride..]);
        for (value, &(left, right, u)) in row.iter_mut().zip(&across) {
            let top = above[left] + u * (above[right] - above[left]);
            let bottom = below[left] + u * (below[right] - below[left]);
            *value = with(top + v * (bottom - top));
        }
    });
    out
}

/// Returns the two neighbors of pixel `i` of `to` among `from`, and how far it is from the first to
/// the second.
fn between(i: u32, from: u32, to: u32) -> (usize, usize, f32) {
    let at = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64);
    let first = at as usize;
    (first, (first + 1).min(from as usize - 1), (at - first as f64) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_side_is_brought_down_and_the_other_rounded() {
        assert_eq!(working_size(3000, 4096, 1024), (750, 1024));
        assert_eq!(working_size(384, 512, 1024), (384, 512));
        // 2 · 1024 / 3000 = 0.68 → 1; 1 · 1024 / 5000 = 0.2 → 0, but a picture has at least one
        // pixel
        assert_eq!(working_size(3000, 2, 1024), (1024, 1));
        assert_eq!(working_size(5000, 1, 1024), (1024, 1));
    }

    #[test]
    fn colors_and_alpha_of_a_photograph_are_averaged_apart() {
        let photo =
            Photo { width: 2, height: 1, rgb: vec![[0, 10, 200], [100, 30, 100]], alpha: Some(vec![0, 50]) };
        let small = reduce_photo(&photo, (1, 1));
        assert_eq!((small.rgb[0], small.alpha), ([50, 20, 150], Some(vec![25])));
    }

    fn gray(width: u32, height: u32, values: &[u8]) -> Gray {
        Gray { width, height, values: values.to_vec() }
    }

    #[test]
    fn halving_averages_blocks_and_a_broken_factor_shares_pixels() {
        // (10 + 20 + 30 + 41) / 4 = 25.25 → 25; (0 + 255 + 255 + 0) / 4 = 127.5 → 128
        let four = gray(4, 2, &[10, 20, 0, 255, 30, 41, 255, 0]);
        assert_eq!(resize_gray(&four, (2, 1)).values, [25, 128]);
        // three to two: (1 · 0 + ½ · 90) / 1.5 = 30 and (½ · 90 + 1 · 30) / 1.5 = 50
        assert_eq!(resize_gray(&gray(3, 1, &[0, 90, 30]), (2, 1)).values, [30, 50]);
        assert_eq!(resize_gray(&gray(1, 3, &[0, 90, 30]), (1, 2)).values, [30, 50]);
    }

    #[test]
    fn an_even_picture_stays_even_at_any_factor() {
        let photo = gray(101, 67, &[77; 101 * 67]);
        for size in [(100, 66), (33, 20), (1, 1), (7, 67)] {
            assert!(resize_gray(&photo, size).values.iter().all(|&v| v == 77), "{size:?}");
        }
    }

    #[test]
    fn doubling_puts_new_centers_a_quarter_from_the_old() {
        // centers of the four at −¼, ¼, ¾, 5/4 of the two: 0, ¼, ¾, 1
        let large = enlarge(&[0.0, 1.0], (2, 1), (4, 1), 0.0, 1.0);
        assert_eq!(large.values, [0, 64, 191, 255]);
        let tall = enlarge(&[0.0, 1.0], (1, 2), (1, 4), 0.0, 1.0);
        assert_eq!(tall.values, [0, 64, 191, 255]);
        assert_eq!(bilinear(&[0.0, 1.0], 2, (2, 1), (4, 1), |v| v), [0.0, 0.25, 0.75, 1.0]);
    }

    #[test]
    fn a_field_is_cut_before_it_is_resized() {
        // of rows of three, only the first two columns count: the third, 9, must not bleed in
        assert_eq!(bilinear(&[0.0, 1.0, 9.0], 3, (2, 1), (4, 1), |v| v), [0.0, 0.25, 0.75, 1.0]);
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

    #[test]
    fn only_tall_photographs_are_reduced_to_rows() {
        let size = |width: u32, height: u32| {
            let rgb = vec![[0; 3]; (width * height) as usize];
            let small = reduce_to_rows(&Photo { width, height, rgb, alpha: None }, 512);
            (small.width, small.height)
        };
        assert_eq!(size(384, 512), (384, 512));
        assert_eq!(size(3000, 4096), (375, 512));
        assert_eq!(size(4096, 100), (4096, 100));
        assert_eq!(size(1, 4096), (1, 512));
    }

    #[test]
    fn averages_are_taken_in_linear_light_over_parts_of_pixels() {
        // three rows into two: rows 0 and half of 1, half of 1 and 2
        let rgb = vec![[255, 0, 0], [0, 0, 255], [0, 0, 255]];
        let small = reduce_to_rows(&Photo { width: 1, height: 3, rgb, alpha: None }, 2);
        let coded = |v: f32| quantize(srgb_from_linear(v));
        assert_eq!((small.width, small.height), (1, 2));
        assert_eq!(small.rgb, [[coded(2.0 / 3.0), 0, coded(1.0 / 3.0)], [0, 0, 255]]);
    }

    #[test]
    fn a_flat_photograph_stays_flat_at_every_size() {
        let photo = Photo { width: 61, height: 83, rgb: vec![[200, 100, 7]; 61 * 83], alpha: None };
        for rows in [82, 60, 41, 40, 13, 1] {
            assert!(reduce_to_rows(&photo, rows).rgb.iter().all(|c| *c == [200, 100, 7]), "{rows} rows");
        }
    }

    #[test]
    fn a_mask_goes_up_in_size_with_its_edge_in_place() {
        let mask = Gray { width: 4, height: 1, values: vec![255, 255, 0, 0] };
        let large = resize_hard(&mask, (12, 2));
        assert_eq!(large.values[..12], [255, 255, 255, 255, 255, 255, 0, 0, 0, 0, 0, 0]);
        assert_eq!(large.values[12..], large.values[..12]);
    }
}
