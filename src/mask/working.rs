//! The working size of a cut: photographs averaged down, clicks moved with them, hard masks brought back up.

use super::Click;
use crate::image::{Gray, Photo, linear_from_srgb, quantise, srgb_from_linear};

/// Width and height of a picture reduced to at most `rows` rows; never enlarged.
pub fn working_size(width: u32, height: u32, rows: u32) -> (u32, u32) {
    if height <= rows {
        return (width, height);
    }
    let reduced = (width as f64 * rows as f64 / height as f64).round() as u32;
    (reduced.max(1), rows)
}

/// Averages a photograph over the area of each smaller pixel, in linear light as a coarser sensor would see it.
/// The same photograph when it is small enough already; alpha is dropped.
pub fn working_photo(photo: &Photo, rows: u32) -> Photo {
    let (width, height) = working_size(photo.width, photo.height, rows);
    if (width, height) == (photo.width, photo.height) {
        return Photo { alpha: None, ..photo.clone() };
    }
    let linear: Vec<f32> = (0..=255u8).map(|v| linear_from_srgb(v as f32 / 255.0)).collect();
    let columns = shares(photo.width, width);
    let lines = shares(photo.height, height);
    let (w, from) = (width as usize, photo.width as usize);
    let mut sums = vec![0f32; w * height as usize * 3];
    let mut narrow = vec![0f32; w * 3];
    for (y, row) in photo.rgb.chunks_exact(from).enumerate() {
        narrow.fill(0.0);
        for (pixel, &(x, first, rest)) in row.iter().zip(&columns) {
            for c in 0..3 {
                let value = linear[pixel[c] as usize];
                narrow[3 * x + c] += first * value;
                if rest > 0.0 {
                    narrow[3 * x + 3 + c] += rest * value;
                }
            }
        }
        let (line, first, rest) = lines[y];
        for (weight, at) in [(first, line), (rest, line + 1)] {
            if weight > 0.0 {
                let out = &mut sums[3 * w * at..3 * w * (at + 1)];
                out.iter_mut().zip(&narrow).for_each(|(o, n)| *o += weight * n);
            }
        }
    }
    let rgb = sums.chunks_exact(3).map(|c| [0, 1, 2].map(|a| quantise(srgb_from_linear(c[a])))).collect();
    Photo { width, height, rgb, alpha: None }
}

/// For each of `from` cells: the first of `to` cells it falls into, and its weight in that one and the next.
fn shares(from: u32, to: u32) -> Vec<(usize, f32, f32)> {
    let scale = to as f64 / from as f64;
    (0..from)
        .map(|i| {
            let (begin, end) = (i as f64 * scale, (i + 1) as f64 * scale);
            let cell = (begin.floor() as usize).min(to as usize - 1);
            let next = (cell + 1) as f64;
            // a sliver from rounding belongs to the first cell
            if end > next + 1e-9 && cell + 1 < to as usize {
                (cell, (next - begin) as f32, (end - next) as f32)
            } else {
                (cell, (end - begin) as f32, 0.0)
            }
        })
        .collect()
}

/// A click on a picture at another size: the same point of the photograph.
pub fn working_click(click: &Click, from: (u32, u32), to: (u32, u32)) -> Click {
    let moved = |v: f32, from: u32, to: u32| ((v as f64 + 0.5) * to as f64 / from as f64 - 0.5) as f32;
    Click { x: moved(click.x, from.0, to.0), y: moved(click.y, from.1, to.1), head: click.head }
}

/// A hard mask at another size: bilinear between pixel centres, then 255 where at least half. Its outline is
/// smooth where copied pixels would make stairs.
pub fn resized_mask(mask: &Gray, width: u32, height: u32) -> Gray {
    if (width, height) == (mask.width, mask.height) {
        return mask.clone();
    }
    let columns = between(mask.width, width);
    let lines = between(mask.height, height);
    let w = mask.width as usize;
    let mut values = Vec::with_capacity(width as usize * height as usize);
    for &(y0, y1, v) in &lines {
        let (top, bottom) = (&mask.values[y0 * w..(y0 + 1) * w], &mask.values[y1 * w..(y1 + 1) * w]);
        for &(x0, x1, u) in &columns {
            let above = top[x0] as f32 * (1.0 - u) + top[x1] as f32 * u;
            let below = bottom[x0] as f32 * (1.0 - u) + bottom[x1] as f32 * u;
            values.push(if above * (1.0 - v) + below * v >= 127.5 { 255 } else { 0 });
        }
    }
    Gray { width, height, values }
}

/// For each of `to` centres: the two of `from` around it and how far it is towards the second.
fn between(from: u32, to: u32) -> Vec<(usize, usize, f32)> {
    let last = from as usize - 1;
    (0..to)
        .map(|i| {
            let at = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, last as f64);
            (at as usize, (at as usize + 1).min(last), (at - at.floor()) as f32)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_tall_photographs_are_reduced() {
        assert_eq!(working_size(384, 512, 512), (384, 512));
        assert_eq!(working_size(3000, 4096, 512), (375, 512));
        assert_eq!(working_size(4096, 100, 512), (4096, 100));
        assert_eq!(working_size(1, 4096, 512), (1, 512));
    }

    #[test]
    fn averages_are_taken_in_linear_light_over_parts_of_pixels() {
        // three rows into two: rows 0 and half of 1, half of 1 and 2
        let rgb = vec![[255, 0, 0], [0, 0, 255], [0, 0, 255]];
        let small = working_photo(&Photo { width: 1, height: 3, rgb, alpha: None }, 2);
        let coded = |v: f32| quantise(srgb_from_linear(v));
        assert_eq!((small.width, small.height), (1, 2));
        assert_eq!(small.rgb, [[coded(2.0 / 3.0), 0, coded(1.0 / 3.0)], [0, 0, 255]]);
    }

    #[test]
    fn a_flat_photograph_stays_flat_at_every_size() {
        let photo = Photo { width: 61, height: 83, rgb: vec![[200, 100, 7]; 61 * 83], alpha: None };
        for rows in [82, 60, 41, 40, 13, 1] {
            assert!(working_photo(&photo, rows).rgb.iter().all(|c| *c == [200, 100, 7]), "{rows} rows");
        }
    }

    #[test]
    fn clicks_keep_their_place() {
        // the first of four pixels has its centre at 1/8 of the width, which is a quarter into the first of two
        let moved = working_click(&Click { x: 0.0, y: 3.0, head: true }, (4, 4), (2, 2));
        assert_eq!((moved.x, moved.y), (-0.25, 1.25));
    }

    #[test]
    fn a_mask_goes_up_in_size_with_its_edge_in_place() {
        let mask = Gray { width: 4, height: 1, values: vec![255, 255, 0, 0] };
        let large = resized_mask(&mask, 12, 2);
        assert_eq!(large.values[..12], [255, 255, 255, 255, 255, 255, 0, 0, 0, 0, 0, 0]);
        assert_eq!(large.values[12..], large.values[..12]);
    }
}
