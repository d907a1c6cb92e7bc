//! Cameras and pictures at a whole fraction of their size.
//!
//! Downscaling by `d` averages `d × d` blocks and drops the last columns and rows that fill no
//! block, so that every intrinsic is divided by exactly `d`. Color is averaged in linear light, as
//! a sensor with larger pixels would, weighted by alpha where there is one.

use tiface_base::geom::Camera;
use tiface_base::image::{Gray, Photo, linear_from_srgb, quantize, srgb_from_linear};

/// Returns the camera of a picture averaged down by `d`.
pub(super) fn downscaled(camera: &Camera, d: u32) -> Camera {
    let s = 1.0 / d as f64;
    Camera {
        width: camera.width / d,
        height: camera.height / d,
        fx: camera.fx * s,
        fy: camera.fy * s,
        cx: camera.cx * s,
        cy: camera.cy * s,
        ..camera.clone()
    }
}

/// How a block of a mask becomes one value.
#[derive(Clone, Copy)]
pub(super) enum Average {
    /// Coverage.
    Mean,
    /// A block with one unusable pixel is unusable.
    Least,
}

pub(super) fn average_gray(gray: &Gray, d: u32, average: Average) -> Gray {
    let (width, height) = (gray.width / d, gray.height / d);
    let mut values = Vec::with_capacity(width as usize * height as usize);
    let n = d * d;
    for y in 0..height {
        for x in 0..width {
            let block = block(x, y, d, gray.width).map(|i| gray.values[i]);
            values.push(match average {
                Average::Mean => ((block.map(u32::from).sum::<u32>() + n / 2) / n) as u8,
                Average::Least => block.min().unwrap_or(0),
            });
        }
    }
    Gray { width, height, values }
}

/// Returns the indices of the pixels of one block, row by row.
fn block(x: u32, y: u32, d: u32, row: u32) -> impl Iterator<Item = usize> {
    (y * d..(y + 1) * d)
        .flat_map(move |v| (x * d..(x + 1) * d).map(move |u| v as usize * row as usize + u as usize))
}

pub(super) fn average_photo(photo: &Photo, d: u32) -> Photo {
    let linear: Vec<f32> = (0..=255u8).map(|b| linear_from_srgb(b as f32 / 255.0)).collect();
    let (width, height) = (photo.width / d, photo.height / d);
    let mut rgb = Vec::with_capacity(width as usize * height as usize);
    let mut alpha = photo.alpha.as_ref().map(|_| Vec::with_capacity(rgb.capacity()));
    let n = (d * d) as f32;
    for y in 0..height {
        for x in 0..width {
            let (mut sum, mut plain, mut weight) = ([0f32; 3], [0f32; 3], 0u32);
            for i in block(x, y, d, photo.width) {
                let a = photo.alpha.as_ref().map_or(255, |a| a[i]) as u32;
                weight += a;
                for k in 0..3 {
                    let c = linear[photo.rgb[i][k] as usize];
                    sum[k] += a as f32 * c;
                    plain[k] += c;
                }
            }
            // where nothing is opaque the color cannot be seen; its plain mean keeps edges clean
            let mean = |k: usize| if weight > 0 { sum[k] / weight as f32 } else { plain[k] / n };
            rgb.push([0, 1, 2].map(|k| quantize(srgb_from_linear(mean(k)))));
            if let Some(alpha) = &mut alpha {
                alpha.push((weight as f32 / n + 0.5) as u8);
            }
        }
    }
    Photo { width, height, rgb, alpha }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_of_black_and_white_becomes_the_gray_of_half_the_light() {
        // linear mean of 0, 1, 0, 1 is 0.5; sRGB of 0.5 is 0.7354 → 188
        let rgb = vec![[0; 3], [255; 3], [0; 3], [255; 3]];
        let half = average_photo(&Photo { width: 2, height: 2, rgb, alpha: None }, 2);
        assert_eq!((half.width, half.height, half.rgb[0]), (1, 1, [188; 3]));
    }

    #[test]
    fn transparent_pixels_do_not_bleed_into_the_average() {
        let rgb = vec![[255, 0, 0], [0, 255, 0], [0, 255, 0], [0, 255, 0]];
        let alpha = Some(vec![255, 0, 0, 0]);
        let half = average_photo(&Photo { width: 2, height: 2, rgb, alpha }, 2);
        assert_eq!(half.rgb, [[255, 0, 0]]);
        assert_eq!(half.alpha, Some(vec![64])); // 255 / 4 = 63.75
    }

    #[test]
    fn columns_that_fill_no_block_are_dropped() {
        let values = (0..5).map(|v| v * 10).collect();
        let half = average_gray(&Gray { width: 5, height: 1, values }, 1, Average::Mean);
        assert_eq!(half.values.len(), 5);
        let values = vec![0, 10, 20, 30, 99, 0, 10, 20, 30, 99];
        let gray = Gray { width: 5, height: 2, values };
        assert_eq!(average_gray(&gray, 2, Average::Mean).values, [5, 25]);
        assert_eq!(average_gray(&gray, 2, Average::Least).values, [0, 20]);
    }

    #[test]
    fn a_downscaled_camera_sees_the_same_direction_through_the_same_place() {
        use glam::{DMat3, DVec3, Vec2};
        let c = Camera {
            width: 7,
            height: 5,
            fx: 9.0,
            fy: 8.0,
            cx: 3.2,
            cy: 2.6,
            distortion: Default::default(),
            rotation: DMat3::IDENTITY,
            position: DVec3::ZERO,
        };
        let half = downscaled(&c, 2);
        assert_eq!((half.width, half.height), (3, 2));
        // the center of the first block is (1, 1) before and (0.5, 0.5) after
        let (a, b) = (c.ray(Vec2::ONE).unwrap(), half.ray(Vec2::splat(0.5)).unwrap());
        assert!(a.direction.distance(b.direction) < 1e-6);
    }
}
