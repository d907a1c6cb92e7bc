//! Pictures made smaller before the mask is cut, and alphas made large again afterwards.
//!
//! Smaller is the area average of coded values ([`crate::image::reduce_photo`]: what the networks were trained on, and
//! what keeps the matting equation `I = α F + (1 − α) B` true in the space it is solved in); for a cut, whose colors
//! only tell two sides apart, it is taken in linear light. Larger is bilinear between
//! pixel centers: column `x` of `W` looks at `(x + ½) w / W − ½` of `w`.

use crate::image::{CODED, Gray, LIGHT, Photo, average, quantize};
use rayon::prelude::*;

/// A photograph averaged down in linear light to at most `rows` rows, without its alpha; the same photograph when it is
/// small enough already.
pub fn reduce_to_rows(photo: &Photo, rows: u32) -> Photo {
    let from = (photo.width, photo.height);
    if photo.height <= rows {
        return Photo { alpha: None, ..photo.clone() };
    }
    let width = (photo.width as f64 * rows as f64 / photo.height as f64).round() as u32;
    let size = (width.max(1), rows);
    let bytes = average(photo.rgb.as_flattened(), 3, from, size, LIGHT);
    Photo { width: size.0, height: size.1, rgb: bytes.as_chunks::<3>().0.to_vec(), alpha: None }
}

/// A gray picture at another size: averaged where it is larger in both directions, else interpolated.
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

/// A mask (head where it is 128 or more) at another size, 255 or 0: resized and cut at one half. Its outline is smooth
/// where copied pixels would make stairs.
pub fn resize_hard(mask: &Gray, size: (u32, u32)) -> Gray {
    let mut resized = resize_gray(mask, size);
    resized.values.iter_mut().for_each(|v| *v = if *v >= 128 { 255 } else { 0 });
    resized
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
    let coded = |v: f32| quantize(harden(v, lowest, highest));
    Gray { width: size.0, height: size.1, values: bilinear(alpha, from.0, from, size, coded) }
}

/// A field of `from` (width, height) at the pixel centers of `to`, each value given to `with`; edges are repeated. Rows
/// of `values` are `stride` apart, so the upper left `from` of a larger field can be taken.
pub(super) fn bilinear<T: Copy + Default + Send>(
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

/// The two neighbors of pixel `i` of `to` among `from`, and how far it is from the first to the second.
fn between(i: u32, from: u32, to: u32) -> (usize, usize, f32) {
    let at = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64);
    let first = at as usize;
    (first, (first + 1).min(from as usize - 1), (at - first as f64) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::srgb_from_linear;

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
    fn doubling_puts_new_centres_a_quarter_from_the_old() {
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
