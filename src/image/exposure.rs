//! Exposure, white balance and vignetting of a photograph.

use super::{Photo, linear_from_srgb, quantize, srgb_from_linear};
use serde::{Deserialize, Serialize};

/// What the light of a photograph is multiplied with, relative to the mean of all photographs: `gain · exp(−vignetting · r²)`,
/// where `r` is the distance from the middle of the picture and 1 in its corners.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Exposure {
    /// Factor of each channel in linear light.
    pub gain: [f32; 3],
    /// Logarithm of the light that the corners lose.
    #[serde(default)]
    pub vignetting: f32,
}

/// Returns the squared distance of a position from the middle of a picture, 1 in its corners.
pub fn corner_share((x, y): (f32, f32), (width, height): (u32, u32)) -> f32 {
    let (w, h) = (width as f32, height as f32);
    ((2.0 * x - w).powi(2) + (2.0 * y - h).powi(2)) / (w * w + h * h)
}

impl Exposure {
    /// Returns the factor of all channels together, their geometric mean.
    pub fn brightness(&self) -> f32 {
        self.gain.iter().product::<f32>().cbrt()
    }

    /// Returns the photograph as it would be with the mean exposure and without vignetting. Pixels brighter than white become
    /// white.
    pub fn divided_out(&self, mut photo: Photo) -> Photo {
        let factor = |k: usize, r2: f32| (self.vignetting * r2).exp() / self.gain[k];
        let linear: Vec<f32> = (0..=255u8).map(|b| linear_from_srgb(f32::from(b) / 255.0)).collect();
        let coded = |light: f32| quantize(srgb_from_linear(light));
        if self.vignetting == 0.0 {
            let tables: [Vec<u8>; 3] =
                std::array::from_fn(|k| linear.iter().map(|l| coded(factor(k, 0.0) * l)).collect());
            for color in &mut photo.rgb {
                (0..3).for_each(|k| color[k] = tables[k][usize::from(color[k])]);
            }
            return photo;
        }
        let size = (photo.width, photo.height);
        for (i, color) in photo.rgb.iter_mut().enumerate() {
            let (x, y) = (i as u32 % photo.width, i as u32 / photo.width);
            let r2 = corner_share((x as f32 + 0.5, y as f32 + 0.5), size);
            (0..3).for_each(|k| color[k] = coded(factor(k, r2) * linear[usize::from(color[k])]));
        }
        photo
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gray(width: u32, height: u32, value: u8) -> Photo {
        Photo { width, height, rgb: vec![[value; 3]; (width * height) as usize], alpha: None }
    }

    #[test]
    fn light_is_divided_channel_by_channel_and_bright_pixels_become_white() {
        // 188 is half the light of white (0.5029); twice that is above white, half of it is 0.2515, coded 137
        let exposure = Exposure { gain: [0.5, 1.0, 2.0], vignetting: 0.0 };
        assert_eq!(exposure.divided_out(gray(1, 1, 188)).rgb, [[255, 188, 137]]);
        assert!((exposure.brightness() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn vignetting_is_none_in_the_middle_and_whole_in_the_corners() {
        assert_eq!(corner_share((5.0, 5.0), (10, 10)), 0.0);
        assert_eq!(corner_share((0.0, 10.0), (10, 10)), 1.0);
        // a corner that lost half its light gets it back: 137 becomes 188 again
        let lit = Exposure { gain: [1.0; 3], vignetting: std::f32::consts::LN_2 }.divided_out(gray(201, 201, 137));
        assert_eq!((lit.rgb[0], lit.rgb[100 * 201 + 100]), ([188; 3], [137; 3]));
    }
}
