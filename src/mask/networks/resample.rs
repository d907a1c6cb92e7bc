//! Pictures at another size, as the networks were trained to see them.
//!
//! Photographs: a triangle as wide as the coarser of the two grids, first along rows, then along columns,
//! weights of 22 bits and 8-bit values between the two passes, which is what Pillow's `BILINEAR` does and
//! what SAM's processors use. Logits: the plain bilinear of PyTorch (`align_corners = false`, no antialias).

use crate::image::Photo;
use rayon::prelude::*;

/// Bits of a weight; 8 more for the value and 2 to spare make 32.
const WEIGHT_BITS: u32 = 22;

/// What one new pixel is made of: the first old one, and a weight for each from there on.
struct Taps {
    first: usize,
    weights: Vec<i32>,
}

/// The triangle's weights for each of `new` pixels over `old` ones, summing to 1.
fn taps(old: usize, new: usize) -> Vec<Taps> {
    let scale = old as f64 / new as f64;
    // never narrower than the old grid: enlarging interpolates, shrinking averages
    let reach = scale.max(1.0);
    (0..new)
        .map(|i| {
            let centre = (i as f64 + 0.5) * scale;
            let first = (centre - reach + 0.5).max(0.0) as usize;
            let end = ((centre + reach + 0.5) as usize).min(old);
            let weight = |j: usize| (1.0 - ((j as f64 + 0.5 - centre) / reach).abs()).max(0.0);
            let total: f64 = (first..end).map(weight).sum();
            let one = f64::from(1u32 << WEIGHT_BITS);
            let weights = (first..end).map(|j| (weight(j) / total * one + 0.5) as i32).collect();
            Taps { first, weights }
        })
        .collect()
}

fn blend(taps: &Taps, at: impl Fn(usize) -> [u8; 3]) -> [u8; 3] {
    let mut sum = [1i32 << (WEIGHT_BITS - 1); 3];
    for (k, &w) in taps.weights.iter().enumerate() {
        let c = at(taps.first + k);
        for i in 0..3 {
            sum[i] += i32::from(c[i]) * w;
        }
    }
    sum.map(|s| (s >> WEIGHT_BITS).clamp(0, 255) as u8)
}

/// The photograph's colours at `width` × `height`, antialiased bilinear; `[height · width]`.
pub(super) fn photo(photo: &Photo, width: usize, height: usize) -> Vec<[u8; 3]> {
    let (w, h) = (photo.width as usize, photo.height as usize);
    let across = if w == width { None } else { Some(taps(w, width)) };
    let rows: Vec<[u8; 3]> = match across {
        None => photo.rgb.clone(),
        Some(taps) => {
            let row = |old: &[[u8; 3]]| taps.iter().map(|t| blend(t, |x| old[x])).collect::<Vec<_>>();
            photo.rgb.par_chunks(w).flat_map_iter(row).collect()
        }
    };
    if h == height {
        return rows;
    }
    let down = taps(h, height);
    let row = |t: &Taps| (0..width).map(|x| blend(t, |y| rows[y * width + x])).collect::<Vec<_>>();
    down.par_iter().flat_map_iter(row).collect()
}

/// A field of `from` (width, height) at the pixel centres of `to`: bilinear, half-pixel centres, edges
/// repeated. Rows of `values` are `stride` apart, so the upper left `from` of a larger field can be taken.
pub(super) fn field(values: &[f32], stride: usize, from: (usize, usize), to: (usize, usize)) -> Vec<f32> {
    let along = |old: usize, new: usize| -> Vec<(usize, usize, f32)> {
        let scale = old as f64 / new as f64;
        (0..new)
            .map(|i| {
                let at = ((i as f64 + 0.5) * scale - 0.5).max(0.0);
                let a = (at as usize).min(old - 1);
                (a, (a + 1).min(old - 1), (at - a as f64) as f32)
            })
            .collect()
    };
    let (xs, ys) = (along(from.0, to.0), along(from.1, to.1));
    ys.par_iter()
        .flat_map_iter(|&(a, b, v)| {
            xs.iter().map(move |&(l, r, u)| {
                let top = values[a * stride + l] * (1.0 - u) + values[a * stride + r] * u;
                let low = values[b * stride + l] * (1.0 - u) + values[b * stride + r] * u;
                top * (1.0 - v) + low * v
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(values: &[u8]) -> Photo {
        let rgb = values.iter().map(|&v| [v; 3]).collect();
        Photo { width: values.len() as u32, height: 1, rgb, alpha: None }
    }

    fn firsts(colours: &[[u8; 3]]) -> Vec<u8> {
        colours.iter().map(|c| c[0]).collect()
    }

    #[test]
    fn halving_averages_over_a_triangle_four_pixels_wide() {
        // new pixel 0 lies at 1, reach 2: old 0.5, 1.5, 2.5 weigh 0.75, 0.75, 0.25 of 1.75
        // 0 · 0.43 + 70 · 0.43 + 140 · 0.14 = 50; new pixel 1 mirrors it: 0.25, 0.75, 0.75 → 160
        assert_eq!(firsts(&photo(&line(&[0, 70, 140, 210]), 2, 1)), [50, 160]);
    }

    #[test]
    fn doubling_interpolates_at_quarter_pixels_and_repeats_the_edge() {
        assert_eq!(firsts(&photo(&line(&[0, 100]), 4, 1)), [0, 25, 75, 100]);
        let grown = field(&[0.0, 1.0], 2, (2, 1), (4, 1));
        assert_eq!(grown, [0.0, 0.25, 0.75, 1.0]);
    }

    #[test]
    fn a_field_is_cut_before_it_is_resized() {
        // of rows of three, only the first two columns count: the third, 9, must not bleed in
        assert_eq!(field(&[0.0, 1.0, 9.0], 3, (2, 1), (4, 1)), [0.0, 0.25, 0.75, 1.0]);
    }
}
