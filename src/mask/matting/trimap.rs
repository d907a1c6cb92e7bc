//! The unknown region around a mask's outline.
//!
//! ```text
//! 255  still head after the mask was shrunk      0  still outside after it was grown      128  between
//! ```
//!
//! Two ways to shrink and grow: squares as the published pipeline does (OpenCV's `erode` and `dilate` with
//! `k × k` ones, `i` times, anchor `k / 2`, nothing known beyond the picture), which are pixels whatever the
//! picture's size; and discs whose radius is a share of the height.

use crate::image::Gray;
use crate::mask::distance;

/// Head, in a trimap.
pub const HEAD: u8 = 255;
/// Unknown, in a trimap.
pub const UNKNOWN: u8 = 128;
/// Outside, in a trimap.
pub const OUTSIDE: u8 = 0;

/// How wide the unknown band is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum UnknownBand {
    /// `kernel × kernel` ones applied `iterations` times each way.
    Squares {
        /// Side of the square, pixels; with an even one the band lies half a pixel to the lower right.
        kernel: u32,
        /// How many times.
        iterations: u32,
    },
    /// Discs each way, of this radius as a share of the picture's height.
    Discs {
        /// Radius over height.
        share: f32,
    },
}

impl Default for UnknownBand {
    /// 2.3 % of the height: 24 pixels of 1024, about what the published squares, 10 wide and
    /// five times, make of them.
    fn default() -> UnknownBand {
        UnknownBand::Discs { share: 0.023 }
    }
}

/// The trimap of a mask, which is head where it is 128 or more.
pub fn trimap(mask: &Gray, band: UnknownBand) -> Gray {
    let (width, height) = (mask.width as usize, mask.height as usize);
    let head: Vec<bool> = mask.values.iter().map(|&v| v >= 128).collect();
    let (definite, maybe) = match band {
        UnknownBand::Squares { kernel, iterations } => (
            erode(&head, width, height, kernel, iterations),
            dilate(&head, width, height, kernel, iterations),
        ),
        UnknownBand::Discs { share } => {
            let radius = share * height as f32;
            (distance::shrink(&head, width, height, radius), distance::grow(&head, width, height, radius))
        }
    };
    let value = |(s, m)| match (s, m) {
        (true, _) => HEAD,
        (_, true) => UNKNOWN,
        _ => OUTSIDE,
    };
    Gray { values: definite.into_iter().zip(maybe).map(value).collect(), ..*mask }
}

/// Share of a trimap's pixels that are unknown.
pub fn unknown_share(trimap: &Gray) -> f64 {
    let unknown = trimap.values.iter().filter(|&&v| v == UNKNOWN).count();
    unknown as f64 / trimap.values.len().max(1) as f64
}

/// Marked where the whole of the square is, as far as it lies inside the picture.
pub fn erode(marked: &[bool], width: usize, height: usize, kernel: u32, iterations: u32) -> Vec<bool> {
    let outside: Vec<bool> = marked.iter().map(|m| !m).collect();
    dilate(&outside, width, height, kernel, iterations).into_iter().map(|m| !m).collect()
}

/// Marked where anything under the square is.
pub fn dilate(marked: &[bool], width: usize, height: usize, kernel: u32, iterations: u32) -> Vec<bool> {
    assert_eq!(marked.len(), width * height);
    let (kernel, iterations) = (kernel.max(1) as usize, iterations as usize);
    // squares applied in turn are one larger square, and a square is a row of columns; OpenCV does not
    // mirror the kernel when it dilates, so both look as far before as behind
    let before = (kernel / 2).saturating_mul(iterations);
    let behind = (kernel - 1 - kernel / 2).saturating_mul(iterations);
    let mut rows = vec![false; marked.len()];
    dilate_lines(marked, &mut rows, (height, width), (width, 1), before, behind);
    let mut all = vec![false; marked.len()];
    dilate_lines(&rows, &mut all, (width, height), (1, width), before, behind);
    all
}

/// Along each of `lines` of `length` places: is anything marked from `before` places before to `behind` places behind?
/// Steps are those from line to line and from place to place.
fn dilate_lines(
    marked: &[bool],
    out: &mut [bool],
    (lines, length): (usize, usize),
    (line_step, step): (usize, usize),
    before: usize,
    behind: usize,
) {
    let mut seen = vec![0u32; length + 1];
    for line in 0..lines {
        let at = |i: usize| line * line_step + i * step;
        for i in 0..length {
            seen[i + 1] = seen[i] + marked[at(i)] as u32;
        }
        for i in 0..length {
            let (from, to) =
                (i.saturating_sub(before), i.saturating_add(behind).saturating_add(1).min(length));
            out[at(i)] = seen[to] > seen[from];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::{Limits, read_gray};

    /// As OpenCV's documentation says it, once per iteration.
    fn brute(marked: &[bool], w: i64, h: i64, k: i64, iterations: u32, any: bool) -> Vec<bool> {
        let mut now = marked.to_vec();
        for _ in 0..iterations {
            let at = |i: usize| {
                let (x, y) = (i as i64 % w, i as i64 / w);
                let mut under = (0..k * k)
                    .map(|j| (x + j % k - k / 2, y + j / k - k / 2))
                    .filter(|&(x, y)| (0..w).contains(&x) && (0..h).contains(&y))
                    .map(|(x, y)| now[(y * w + x) as usize]);
                if any { under.any(|m| m) } else { under.all(|m| m) }
            };
            now = (0..now.len()).map(at).collect();
        }
        now
    }

    #[test]
    fn squares_equal_the_definition_for_even_and_odd_kernels() {
        let (w, h) = (23, 17);
        let marked: Vec<bool> = (0..w * h).map(|i| (i * i + 7 * i) % 31 < 14 || i % w < 3).collect();
        for (kernel, iterations) in [(1, 3), (2, 1), (3, 2), (4, 1), (5, 0), (10, 1), (10, 5)] {
            let (grown, less) =
                (dilate(&marked, w, h, kernel, iterations), erode(&marked, w, h, kernel, iterations));
            let k = kernel as i64;
            assert_eq!(
                grown,
                brute(&marked, w as i64, h as i64, k, iterations, true),
                "{kernel} {iterations}"
            );
            assert_eq!(
                less,
                brute(&marked, w as i64, h as i64, k, iterations, false),
                "{kernel} {iterations}"
            );
        }
    }

    #[test]
    fn an_even_kernel_reaches_farther_right_than_left() {
        // anchor 2 of 4: a pixel sees two before itself and one behind, so one mark is seen from 4 places
        let mut one = [false; 9];
        one[4] = true;
        let grown = dilate(&one, 9, 1, 4, 1);
        assert_eq!(grown, [0, 0, 0, 1, 1, 1, 1, 0, 0].map(|v| v == 1));
    }

    #[test]
    fn discs_leave_a_band_of_their_radius_on_both_sides() {
        // the lower half of 8 × 20 is head: rows 10 and on; 10 % of 20 rows are 2 pixels each way
        let mask =
            Gray { width: 8, height: 20, values: (0..160).map(|i| if i < 80 { 0 } else { 255 }).collect() };
        let tri = trimap(&mask, UnknownBand::Discs { share: 0.1 });
        let rows: Vec<u8> = (0..20).map(|y| tri.values[y * 8 + 3]).collect();
        assert!(rows[..8].iter().all(|&v| v == 0) && rows[8..12].iter().all(|&v| v == 128), "{rows:?}");
        assert!(rows[12..].iter().all(|&v| v == 255), "{rows:?}");
        assert_eq!(unknown_share(&tri), 0.2);
    }

    #[test]
    fn trimaps_equal_those_of_opencv() {
        let shared = std::env::var("TIFACE_SHARED")
            .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into());
        let folder = std::path::Path::new(&shared).join("data/mask-models/classical");
        if !folder.is_dir() {
            eprintln!("skipped: the trimaps of OpenCV are not at {}", folder.display());
            return;
        }
        let read = |name: &str| read_gray(&folder.join(name), None, &Limits::default()).unwrap();
        let mask = read("mask.png");
        for (kernel, iterations) in [(10, 5), (3, 3), (4, 2), (5, 1)] {
            let ours = trimap(&mask, UnknownBand::Squares { kernel, iterations });
            assert!(ours == read(&format!("trimap_k{kernel}_i{iterations}.png")), "{kernel} {iterations}");
        }
    }
}
