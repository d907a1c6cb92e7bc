//! The guided filter (He, Sun, Tang 2010): a hard mask bent towards the edges of the photograph.
//!
//! Within every window the mask is fitted by an affine function of colour, `a · I + b` with
//! `a = (Σ + ε 1)⁻¹ cov(I, p)` and `b = p̄ − a · Ī` (their equations 19 and 20), and each pixel averages
//! the fits of all windows it lies in. No system is solved, so nothing can fail.

use super::closed_form::{inverted, product};
use super::trimap::{HEAD, UNSURE};
use crate::image::{Gray, Photo};

/// How the filter looks around.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GuidedOptions {
    /// Half side of the windows as a share of the picture's height; at least one pixel.
    pub radius: f32,
    /// Noise of colours, added to their covariance; squared colour differences of 0..=1.
    pub epsilon: f64,
}

impl Default for GuidedOptions {
    fn default() -> GuidedOptions {
        GuidedOptions { radius: 0.008, epsilon: 1e-4 }
    }
}

/// Sums over a window: colour, products of colours, mask, mask times colour. Whole numbers, so that sliding
/// loses nothing.
type Sums = [u64; 13];

/// Alpha of every pixel `[height · width]` in 0..=1: the filtered `mask` (head at 128 and more) where the
/// trimap is unsure, else what it says. All of one size.
pub fn guided(photo: &Photo, mask: &Gray, trimap: &Gray, options: &GuidedOptions) -> Vec<f32> {
    let (width, height) = (photo.width as usize, photo.height as usize);
    assert_eq!((photo.width, photo.height), (mask.width, mask.height));
    assert_eq!((photo.width, photo.height), (trimap.width, trimap.height));
    let radius = ((options.radius * height as f32).round() as usize).clamp(1, width.max(height).max(1));

    let measure = |i: usize| -> Sums {
        let [r, g, b] = photo.rgb[i].map(u64::from);
        let p = (mask.values[i] >= 128) as u64;
        [r, g, b, r * r, r * g, r * b, g * g, g * b, b * b, p, p * r, p * g, p * b]
    };
    let mut fits = vec![[0f64; 4]; width * height];
    slide(width, height, radius, measure, |i, sums: Sums, count| {
        fits[i] = fit(&sums, count, options.epsilon)
    });
    let mut alpha: Vec<f32> = trimap.values.iter().map(|&v| if v == HEAD { 1.0 } else { 0.0 }).collect();
    // sums of fits slide in f64; what that loses (1e-13) is far below a byte
    slide(
        width,
        height,
        radius,
        |i| fits[i],
        |i, sums: [f64; 4], count| {
            if trimap.values[i] == UNSURE {
                let [r, g, b] = photo.rgb[i].map(|v| v as f64 / 255.0);
                alpha[i] =
                    ((sums[0] * r + sums[1] * g + sums[2] * b + sums[3]) / count).clamp(0.0, 1.0) as f32;
            }
        },
    );
    alpha
}

/// `a` and `b` of one window.
fn fit(sums: &Sums, count: f64, epsilon: f64) -> [f64; 4] {
    let mean = |k: usize, scale: f64| sums[k] as f64 / (count * scale);
    let colour = [mean(0, 255.0), mean(1, 255.0), mean(2, 255.0)];
    let square = |k: usize, i: usize, j: usize| mean(k, 255.0 * 255.0) - colour[i] * colour[j];
    let covariance = [
        square(3, 0, 0) + epsilon,
        square(4, 0, 1),
        square(5, 0, 2),
        square(6, 1, 1) + epsilon,
        square(7, 1, 2),
        square(8, 2, 2) + epsilon,
    ];
    let p = mean(9, 1.0);
    let with = [0, 1, 2].map(|k| mean(10 + k, 255.0) - p * colour[k]);
    let a = product(&inverted(covariance), with);
    [a[0], a[1], a[2], p - a[0] * colour[0] - a[1] * colour[1] - a[2] * colour[2]]
}

/// A number that can be added to a sum and taken out again.
trait Sliding: Copy + Default + std::ops::AddAssign + std::ops::SubAssign {}
impl Sliding for u64 {}
impl Sliding for f64 {}

/// Gives `put` the sums of `measure` over the window of every pixel, clipped to the picture, and how many
/// pixels that are. One pass down the picture: sums of columns slide down, and the window slides along them.
fn slide<T: Sliding, const N: usize>(
    width: usize,
    height: usize,
    radius: usize,
    measure: impl Fn(usize) -> [T; N],
    mut put: impl FnMut(usize, [T; N], f64),
) {
    let mut columns = vec![[T::default(); N]; width];
    let add_row = |columns: &mut Vec<[T; N]>, y: usize, out: bool| {
        for (x, column) in columns.iter_mut().enumerate() {
            for (sum, value) in column.iter_mut().zip(measure(y * width + x)) {
                if out { *sum -= value } else { *sum += value }
            }
        }
    };
    (0..radius.min(height)).for_each(|y| add_row(&mut columns, y, false));
    for y in 0..height {
        if y + radius < height {
            add_row(&mut columns, y + radius, false);
        }
        if y > radius {
            add_row(&mut columns, y - radius - 1, true);
        }
        let rows = (y + radius).min(height - 1) - y.saturating_sub(radius) + 1;
        let mut sums = [T::default(); N];
        let slide_over = |sums: &mut [T; N], x: usize, out: bool| {
            for (sum, value) in sums.iter_mut().zip(columns[x]) {
                if out { *sum -= value } else { *sum += value }
            }
        };
        (0..radius.min(width)).for_each(|x| slide_over(&mut sums, x, false));
        for x in 0..width {
            if x + radius < width {
                slide_over(&mut sums, x + radius, false);
            }
            if x > radius {
                slide_over(&mut sums, x - radius - 1, true);
            }
            let across = (x + radius).min(width - 1) - x.saturating_sub(radius) + 1;
            put(y * width + x, sums, (rows * across) as f64);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sliding_sums_equal_sums_over_every_window() {
        for (w, h, r) in [(7usize, 5usize, 1usize), (7, 5, 3), (4, 9, 20), (1, 6, 2)] {
            let value = |i: usize| (i * i % 19) as u64;
            let mut seen = 0;
            slide(
                w,
                h,
                r,
                |i| [value(i)],
                |i, [sum], count| {
                    let (x, y) = (i % w, i / w);
                    let inside = (0..w * h).filter(|j| (j % w).abs_diff(x) <= r && (j / w).abs_diff(y) <= r);
                    assert_eq!(count, inside.clone().count() as f64);
                    assert_eq!(sum, inside.map(value).sum::<u64>(), "{w} {h} {r} {i}");
                    seen += 1;
                },
            );
            assert_eq!(seen, w * h);
        }
    }

    /// One colour left of a soft edge, another right of it.
    fn edge(width: u32, height: u32) -> (Photo, Vec<f32>) {
        let truth: Vec<f32> =
            (0..width * height).map(|i| (((i % width) as f32 - 8.0) / 4.0).clamp(0.0, 1.0)).collect();
        let rgb = truth.iter().map(|a| [40.0 + 160.0 * a, 30.0 + 90.0 * a, 20.0].map(|v| v as u8)).collect();
        (Photo { width, height, rgb, alpha: None }, truth)
    }

    #[test]
    fn a_hard_mask_takes_the_softness_of_the_photograph() {
        let (width, height) = (20u32, 12u32);
        let (photo, truth) = edge(width, height);
        let gray = |values: Vec<u8>| Gray { width, height, values };
        let mask = gray(truth.iter().map(|&a| if a >= 0.5 { 255 } else { 0 }).collect());
        let trimap = gray(
            (0..width * height).map(|i| [0, UNSURE, HEAD][((i % width + 2) / 8).min(2) as usize]).collect(),
        );
        let alpha = guided(&photo, &mask, &trimap, &GuidedOptions { radius: 0.34, epsilon: 1e-4 });
        let error = |a: &dyn Fn(usize) -> f32| -> f32 {
            (0..truth.len()).map(|i| (a(i) - truth[i]).powi(2)).sum::<f32>() / truth.len() as f32
        };
        let (soft, hard) = (error(&|i| alpha[i]), error(&|i| mask.values[i] as f32 / 255.0));
        assert!(soft < 0.4 * hard, "{soft} against {hard}");
        for i in (0..truth.len()).filter(|&i| trimap.values[i] != UNSURE) {
            assert_eq!(alpha[i], trimap.values[i] as f32 / 255.0);
        }
    }

    #[test]
    fn without_edges_in_the_photograph_the_mask_is_only_blurred() {
        let (width, height) = (9, 3);
        let photo = Photo { width, height, rgb: vec![[50; 3]; 27], alpha: None };
        let mask =
            Gray { width, height, values: (0..27).map(|i| if i % 9 >= 5 { 255 } else { 0 }).collect() };
        let trimap = Gray { width, height, values: vec![UNSURE; 27] };
        // windows of 3: means of p are 0 0 0 0 ⅓ ⅔ 1 1 1, and those averaged again by threes
        let alpha = guided(&photo, &mask, &trimap, &GuidedOptions { radius: 0.0, epsilon: 1e-4 });
        let expected = [0.0, 0.0, 0.0, 1.0 / 9.0, 1.0 / 3.0, 2.0 / 3.0, 8.0 / 9.0, 1.0, 1.0];
        for i in 0..27 {
            assert!((alpha[i] - expected[i % 9]).abs() < 1e-5, "{i}: {}", alpha[i]);
        }
    }
}
