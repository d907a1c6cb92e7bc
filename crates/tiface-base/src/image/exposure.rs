//! Exposure of a photograph relative to others.

use super::{Photo, linear_from_srgb, quantize, srgb_from_linear};
use serde::{Deserialize, Serialize};

/// Factors of a photograph's linear light relative to the mean of all photographs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Exposure {
    /// Factor of each channel in linear light.
    pub gain: [f32; 3],
}

impl Exposure {
    /// Returns the factor of all channels together, their geometric mean.
    pub fn brightness(&self) -> f32 {
        self.gain.iter().product::<f32>().cbrt()
    }

    /// Returns the photograph as it would be with the mean exposure. Pixels brighter than white
    /// become white.
    pub fn divided_out(&self, mut photo: Photo) -> Photo {
        let coded = |b: u8, k: usize| {
            quantize(srgb_from_linear(linear_from_srgb(f32::from(b) / 255.0) / self.gain[k]))
        };
        let tables = [0, 1, 2].map(|k| (0..=255).map(|b| coded(b, k)).collect::<Vec<u8>>());
        for color in &mut photo.rgb {
            (0..3).for_each(|k| color[k] = tables[k][usize::from(color[k])]);
        }
        photo
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_is_divided_channel_by_channel_and_bright_pixels_become_white() {
        // 188 is half the light of white (0.5029); twice that is above white, half of it is 0.2515,
        // coded 137
        let photo = Photo { width: 1, height: 1, rgb: vec![[188; 3]], alpha: None };
        let exposure = Exposure { gain: [0.5, 1.0, 2.0] };
        assert_eq!(exposure.divided_out(photo).rgb, [[255, 188, 137]]);
        assert!((exposure.brightness() - 1.0).abs() < 1e-6);
    }
}
