//! From a hard mask to a soft alpha: smaller, unknown band, opacity of the band, large again,
//! hardened.
//!
//! ```text
//! photograph → reduce ─────────┐
//! hard mask → reduce → trimap ─┴→ opacity of the band → enlarge → harden → alpha
//! ```
//!
//! The opacity is found at a working size, since the band of a photograph of 3000 × 4096 would hold
//! millions of pixels and its outline is no sharper than the lens: by closed-form matting, or by a
//! network of the caller's.
//!
//! The trimap has the unknown region around a mask's outline:
//!
//! ```text
//! 255  still head after the mask was shrunk
//! 128  between
//!   0  still outside after it was grown
//! ```
//!
//! Two ways to shrink and grow: squares as the published pipeline does (OpenCV's `erode` and
//! `dilate` with `k × k` ones, `i` times, anchor `k / 2`, nothing known beyond the picture), which
//! are pixels whatever the picture's size; and discs whose radius is a share of the height.

pub mod closed_form;

use self::closed_form::{ClosedFormOptions, closed_form};
use tiface_base::image::{
    Gray, INSIDE, Photo, dilated, enlarge, grow, reduce_photo, resize_hard, shrink, working_size,
};
use tiface_base::{Error, Result};

/// Alphas below become 0.
const MIN_ALPHA: f32 = 0.02;
/// Alphas above become 1.
const MAX_ALPHA: f32 = 0.98;
/// A band that is a larger share of the picture is worth a warning.
const MAX_UNKNOWN: f64 = 0.3;

/// Options of softening a hard mask.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoftenOptions {
    /// Longest side of the working picture at most, pixels.
    pub side: u32,
    /// Width of the unknown band.
    pub band: UnknownBand,
}

impl Default for SoftenOptions {
    fn default() -> SoftenOptions {
        SoftenOptions { side: 1024, band: UnknownBand::default() }
    }
}

impl SoftenOptions {
    /// Returns the bytes needed at most beside the photograph and the mask themselves, for one
    /// photograph of this size: the alpha, the working pictures, and the equations if the whole
    /// working picture were unknown.
    pub fn memory_bytes(&self, width: u32, height: u32) -> u64 {
        let pixels = |(w, h): (u32, u32)| w as u64 * h as u64;
        // per working pixel: photograph 3, mask, trimap 2, alpha and rows 8, distances and marks
        // 12, equations 310
        pixels((width, height)) + 335 * pixels(working_size(width, height, self.side))
    }
}

/// A soft alpha and its trimap.
#[derive(Clone, Debug, PartialEq)]
pub struct SoftMask {
    /// At the photograph's size.
    pub alpha: Gray,
    /// At the working size: 0, 128, 255.
    pub trimap: Gray,
    /// Warnings, one sentence each.
    pub warnings: Vec<String>,
}

/// Returns the soft alpha of a photograph from its hard mask (head where it is 128 or more), which
/// may be smaller but has the photograph's proportions. Where closed-form matting finds no solution
/// the band stays hard, with a warning.
///
/// # Errors
/// When the mask has other proportions than the photograph.
pub fn soften(photo: &Photo, mask: &Gray, options: &SoftenOptions) -> Result<SoftMask> {
    soften_with(photo, mask, options, |_, _| Ok(None))
}

/// [`soften`] with another way to find the opacity: `network` takes the working photograph and its
/// trimap, and returns an alpha of each pixel or `None` to leave it to closed-form matting. What is
/// definite in the trimap stays.
pub fn soften_with(
    photo: &Photo,
    mask: &Gray,
    options: &SoftenOptions,
    network: impl FnOnce(&Photo, &Gray) -> Result<Option<Vec<f32>>>,
) -> Result<SoftMask> {
    let size = (photo.width, photo.height);
    let working = working_size(photo.width, photo.height, options.side);
    // sides of w s and h s, each rounded by up to half a pixel
    let across = |a: u32, b: u32| a as u64 * b as u64;
    let apart = across(mask.width, size.1).abs_diff(across(mask.height, size.0));
    if mask.width == 0 || mask.height == 0 || apart > size.0.max(size.1) as u64 {
        let (w, h) = (mask.width, mask.height);
        return Err(Error::cannot(
            format!("the mask is {w} × {h} pixels, but its photograph is {} × {}", size.0, size.1),
            "make the mask from this very photograph; it may be smaller, but of the same proportions",
        ));
    }
    let (photo, mask) = (reduce_photo(photo, working), resize_hard(mask, working));
    let trimap = trimap(&mask, options.band);
    let mut warnings = band_warnings(&trimap);
    let alpha = match network(&photo, &trimap)? {
        Some(mut alpha) => {
            // the network takes the trimap for a hint
            for (a, &t) in alpha.iter_mut().zip(&trimap.values).filter(|(_, t)| **t != UNKNOWN) {
                *a = if t == HEAD { 1.0 } else { 0.0 };
            }
            alpha
        }
        None => solved(&photo, &mask, &trimap, &ClosedFormOptions::default(), &mut warnings),
    };
    let alpha = enlarge(&alpha, working, size, MIN_ALPHA, MAX_ALPHA);
    Ok(SoftMask { alpha, trimap, warnings })
}

/// Returns the alpha by closed-form matting, else the hard mask.
fn solved(
    photo: &Photo,
    mask: &Gray,
    trimap: &Gray,
    options: &ClosedFormOptions,
    warnings: &mut Vec<String>,
) -> Vec<f32> {
    let has = |value: u8| trimap.values.contains(&value);
    // constrained to one side only, everything would become that side
    if !has(UNKNOWN) || (has(HEAD) && has(OUTSIDE)) {
        match closed_form(photo, mask, trimap, options) {
            Ok(matte) => return matte.alpha,
            Err(why) => {
                warnings.push(format!("closed-form matting found no alpha, so the mask stays hard: {why}"));
            }
        }
    }
    mask.values.iter().map(|&v| if v >= INSIDE { 1.0 } else { 0.0 }).collect()
}

/// Warnings about the band, by whichever method its opacity is found.
fn band_warnings(trimap: &Gray) -> Vec<String> {
    let mut warnings = Vec::new();
    let band = unknown_share(trimap);
    if band > MAX_UNKNOWN {
        warnings.push(format!(
            "{:.0} % of the picture are unknown: the mask is ragged or full of holes; a click on what it missed helps",
            100.0 * band
        ));
    }
    if band > 0.0 && !trimap.values.contains(&HEAD) {
        warnings.push("no pixel is definitely head: the mask is thinner than the unknown band".into());
    }
    if band > 0.0 && !trimap.values.contains(&OUTSIDE) {
        warnings.push("no pixel is definitely outside: the mask leaves less than the unknown band".into());
    }
    warnings
}

/// Head, in a trimap.
pub const HEAD: u8 = 255;
/// Unknown, in a trimap.
pub const UNKNOWN: u8 = 128;
/// Outside, in a trimap.
pub const OUTSIDE: u8 = 0;

/// Width of the unknown band.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum UnknownBand {
    /// `kernel × kernel` ones applied `iterations` times each way.
    Squares {
        /// Side of the square, pixels; with an even one the band lies half a pixel to the lower
        /// right.
        kernel: u32,
        /// Number of applications.
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

/// Returns the trimap of a mask, which is head where it is 128 or more.
pub fn trimap(mask: &Gray, band: UnknownBand) -> Gray {
    let (width, height) = (mask.width as usize, mask.height as usize);
    let head = mask.inside();
    let (definite, maybe) = match band {
        UnknownBand::Squares { kernel, iterations } => (
            erode(&head, width, height, kernel, iterations),
            dilate(&head, width, height, kernel, iterations),
        ),
        UnknownBand::Discs { share } => {
            let radius = share * height as f32;
            (shrink(&head, width, height, radius), grow(&head, width, height, radius))
        }
    };
    let value = |(s, m)| match (s, m) {
        (true, _) => HEAD,
        (_, true) => UNKNOWN,
        _ => OUTSIDE,
    };
    Gray { values: definite.into_iter().zip(maybe).map(value).collect(), ..*mask }
}

/// Returns the share of a trimap's pixels that are unknown.
pub fn unknown_share(trimap: &Gray) -> f64 {
    let unknown = trimap.values.iter().filter(|&&v| v == UNKNOWN).count();
    unknown as f64 / trimap.values.len().max(1) as f64
}

/// Marks pixels whose square is entirely marked, as far as it lies inside the picture.
pub fn erode(marked: &[bool], width: usize, height: usize, kernel: u32, iterations: u32) -> Vec<bool> {
    let outside: Vec<bool> = marked.iter().map(|m| !m).collect();
    dilate(&outside, width, height, kernel, iterations).into_iter().map(|m| !m).collect()
}

/// Marks pixels with a marked pixel under their square.
pub fn dilate(marked: &[bool], width: usize, height: usize, kernel: u32, iterations: u32) -> Vec<bool> {
    assert_eq!(marked.len(), width * height);
    let (kernel, iterations) = (kernel.max(1) as usize, iterations as usize);
    // squares applied in turn are one larger square; OpenCV does not mirror the kernel when it
    // dilates, so both reach as far before as behind
    let before = (kernel / 2).saturating_mul(iterations);
    let behind = (kernel - 1 - kernel / 2).saturating_mul(iterations);
    dilated(marked.to_vec(), width, height, before, behind)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::image::resize_gray;
    use tiface_base::io::{Limits, read_gray, read_photo};

    /// Returns a bright disc on a dark background whose rim is soft over 6 pixels.
    fn disc(width: u32, height: u32) -> (Photo, Vec<f32>) {
        let (cx, cy, r) = (0.5 * width as f32, 0.5 * height as f32, 0.3 * height as f32);
        let pixels = 0..width * height;
        let truth: Vec<f32> = pixels
            .map(|i| {
                let (x, y) = ((i % width) as f32 + 0.5 - cx, (i / width) as f32 + 0.5 - cy);
                ((r + 3.0 - x.hypot(y)) / 6.0).clamp(0.0, 1.0)
            })
            .collect();
        let rgb =
            truth.iter().map(|a| [20.0 + 180.0 * a, 25.0 + 120.0 * a, 30.0 + 90.0 * a].map(|v| v as u8));
        (Photo { width, height, rgb: rgb.collect(), alpha: None }, truth)
    }

    fn hard(truth: &[f32], width: u32, height: u32) -> Gray {
        Gray { width, height, values: truth.iter().map(|&a| if a >= 0.5 { 255 } else { 0 }).collect() }
    }

    /// Returns the mean squared error of an 8-bit alpha against 0..=1.
    fn error(alpha: &[u8], truth: &[f32]) -> f64 {
        let squares = alpha.iter().zip(truth).map(|(&a, &t)| (a as f64 / 255.0 - t as f64).powi(2));
        squares.sum::<f64>() / truth.len() as f64
    }

    #[test]
    fn a_soft_rim_is_found_from_a_hard_mask() {
        let (photo, truth) = disc(160, 200);
        let mask = hard(&truth, 160, 200);
        let soft = soften(&photo, &mask, &SoftenOptions::default()).unwrap();
        assert!(soft.warnings.is_empty(), "{:?}", soft.warnings);
        let (before, after) = (error(&mask.values, &truth), error(&soft.alpha.values, &truth));
        assert!(after < 0.02 * before, "{after:.2e} of {before:.2e}");
        // discs of 4.6 pixels each way around a circle of 2π · 60: about 3470 of 32000 pixels
        assert!((0.09..0.13).contains(&unknown_share(&soft.trimap)), "{}", unknown_share(&soft.trimap));
    }

    #[test]
    fn a_large_photograph_is_worked_on_small_and_its_alpha_made_large() {
        let (photo, truth) = disc(320, 400);
        let options = SoftenOptions { side: 200, ..SoftenOptions::default() };
        let full = soften(&photo, &hard(&truth, 320, 400), &options).unwrap();
        assert_eq!((full.alpha.width, full.alpha.height), (320, 400));
        assert_eq!((full.trimap.width, full.trimap.height), (160, 200));
        let (before, after) =
            (error(&hard(&truth, 320, 400).values, &truth), error(&full.alpha.values, &truth));
        assert!(after < 0.1 * before, "{after:.2e} of {before:.2e}");
        // a mask that has the working size already is taken as it is; a smaller one is brought to
        // it
        let small = soften(&photo, &resize_gray(&hard(&truth, 320, 400), (160, 200)), &options).unwrap();
        assert_eq!(full.alpha, small.alpha);
        let tiny = soften(&photo, &resize_gray(&hard(&truth, 320, 400), (53, 67)), &options).unwrap();
        assert!(error(&tiny.alpha.values, &truth) < 0.1 * before);
    }

    #[test]
    fn without_rounds_the_mask_stays_hard_and_says_so() {
        let (photo, truth) = disc(80, 100);
        let mask = hard(&truth, 80, 100);
        let options = ClosedFormOptions { rounds: 0, ..ClosedFormOptions::default() };
        let mut warnings = Vec::new();
        let alpha = solved(&photo, &mask, &trimap(&mask, UnknownBand::default()), &options, &mut warnings);
        assert!(alpha.iter().zip(&mask.values).all(|(a, &m)| *a == m as f32 / 255.0));
        assert!(warnings[0].contains("stays hard") && warnings.len() == 1, "{warnings:?}");
    }

    #[test]
    fn empty_full_and_thin_masks_stay_what_they_are() {
        let (photo, _) = disc(64, 80);
        let gray = |values: Vec<u8>| Gray { width: 64, height: 80, values };
        let options = SoftenOptions::default();
        for value in [0, 255] {
            let soft = soften(&photo, &gray(vec![value; 64 * 80]), &options).unwrap();
            assert!(soft.alpha.values.iter().all(|&a| a == value) && unknown_share(&soft.trimap) == 0.0);
        }
        // a line one pixel wide is all band: it stays as it is, where a tie to one side would lose
        // it
        let line = gray((0..64 * 80).map(|i| if i % 64 == 30 { 255 } else { 0 }).collect());
        let soft = soften(&photo, &line, &options).unwrap();
        assert!(soft.warnings.iter().any(|w| w.contains("definitely head")), "{:?}", soft.warnings);
        assert_eq!(soft.alpha, line);
    }

    #[test]
    fn a_mask_of_another_size_and_senseless_options_are_named() {
        let (photo, _) = disc(64, 80);
        let other = Gray { width: 80, height: 64, values: vec![0; 80 * 64] };
        let error = soften(&photo, &other, &SoftenOptions::default()).unwrap_err();
        assert_eq!(error.to_string(), "the mask is 80 × 64 pixels, but its photograph is 64 × 80");
    }

    #[test]
    fn twelve_megapixels_need_less_than_two_gigabytes() {
        // 3000 × 4096 alphas, and 335 bytes for each of 750 × 1024 pixels: 270 MB
        let bytes = SoftenOptions::default().memory_bytes(3000, 4096);
        assert_eq!(bytes, 3000 * 4096 + 335 * 750 * 1024);
        assert!(bytes < 2 << 30);
    }

    /// Softens masks of a captured head cut as they are at half, too wide and too narrow by 2
    /// pixels, as far as a share of the error is given that must at least be gone.
    fn alphas_are_better(capture: &str, views: &[&str], gains: [Option<f64>; 3]) {
        let shared = std::env::var("TIFACE_SHARED")
            .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into());
        let limits = Limits::default();
        let folder = std::path::Path::new(&shared).join("data/captures").join(capture);
        if !folder.is_dir() {
            eprintln!("skipped: the capture `{capture}` is not at {}", folder.display());
            return;
        }
        let (mut hard_error, mut soft_error) = ([0.0; 3], [0.0; 3]);
        for view in views {
            let picture = |kind: &str| folder.join(kind).join(format!("{view}.png"));
            let photo = read_photo(&picture("images"), None, &limits).unwrap();
            let truth = read_gray(&picture("masks"), None, &limits).unwrap();
            let (w, h) = (truth.width as usize, truth.height as usize);
            let soft_truth: Vec<f32> = truth.values.iter().map(|&v| v as f32 / 255.0).collect();
            let cut = truth.inside();
            let masks = [cut.clone(), grow(&cut, w, h, 2.0), shrink(&cut, w, h, 2.0)];
            for (k, mask) in masks.iter().enumerate().filter(|(k, _)| gains[*k].is_some()) {
                let values = mask.iter().map(|&m| if m { 255 } else { 0 }).collect();
                let mask = Gray { values, ..truth };
                let soft = soften(&photo, &mask, &SoftenOptions::default()).unwrap();
                assert!(soft.warnings.is_empty(), "{:?}", soft.warnings);
                hard_error[k] += error(&mask.values, &soft_truth) / views.len() as f64;
                soft_error[k] += error(&soft.alpha.values, &soft_truth) / views.len() as f64;
            }
        }
        for (k, gain) in gains.into_iter().enumerate().filter_map(|(k, gain)| Some((k, gain?))) {
            let (hard, soft) = (hard_error[k], soft_error[k]);
            eprintln!("{capture}: {:.2} of 1000 became {:.2}", 1e3 * hard, 1e3 * soft);
            assert!(soft <= (1.0 - gain) * hard, "{capture} {k}: {soft:.2e} of {hard:.2e}");
        }
    }

    #[test]
    fn alphas_of_clicked_heads_take_most_of_the_error_of_masks_too_wide_or_too_narrow() {
        alphas_are_better("lps", &["010"], [None, Some(0.7), Some(0.7)]);
        alphas_are_better("nefertiti", &["010"], [None, Some(0.8), Some(0.8)]);
    }

    #[test]
    #[ignore = "long: run by `tools/test.sh all`; softens 18 masks of whole photographs"]
    fn alphas_of_all_clicked_heads_are_better_than_hard_masks() {
        alphas_are_better("lps", &["002", "006", "010"], [0.2, 0.7, 0.7].map(Some));
        // at half, a mask of a sharp outline is better than any cut can be
        alphas_are_better("nefertiti", &["010", "013", "015"], [-2.0, 0.8, 0.8].map(Some));
    }

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
        // anchor 2 of 4: a pixel sees two before itself and one behind, so one mark is seen from 4
        // places
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
