//! Pictures made smaller: the mean over the area of each new pixel.

use super::{Photo, linear_from_srgb, quantize, srgb_from_linear};
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

/// What bytes stand for while they are averaged, and back.
pub(crate) struct Coding {
    value: fn(u8) -> f32,
    byte: fn(f32) -> u8,
}

/// Themselves: coded colors, masks.
pub(crate) const CODED: Coding = Coding { value: |byte| byte as f32, byte: |value| (value + 0.5) as u8 };
/// Linear light, as a coarser sensor would have seen it.
pub(crate) const LIGHT: Coding = Coding {
    value: |byte| linear_from_srgb(byte as f32 / 255.0),
    byte: |value| quantize(srgb_from_linear(value)),
};

/// `channels` interleaved bytes a pixel, averaged. Rows are computed apart, each in a fixed order.
pub(crate) fn average(
    bytes: &[u8],
    channels: usize,
    from: (u32, u32),
    to: (u32, u32),
    coding: Coding,
) -> Vec<u8> {
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

/// A photograph averaged down to `size`, which is nowhere larger than its own.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_side_is_brought_down_and_the_other_rounded() {
        assert_eq!(working_size(3000, 4096, 1024), (750, 1024));
        assert_eq!(working_size(384, 512, 1024), (384, 512));
        // 2 · 1024 / 3000 = 0.68 → 1; 1 · 1024 / 5000 = 0.2 → 0, but a picture has at least one pixel
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
}
