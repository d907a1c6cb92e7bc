//! Skin and hair, told apart by the colors that the capture itself shows of them.

use super::Masks;
use rayon::prelude::*;
use tiface_base::Result;
use tiface_base::image::{Gray, INSIDE, Photo, grow};
use tiface_base::io::Limits;
use tiface_base::math::rank::median_of_counts;
use tiface_capture::View;

/// Around a soft rim this many pixels of opaque head are the hair's, and along a hard rim the
/// skin's.
const RIM_BAND_PX: f32 = 6.0;

/// An outline nearer than this to a soft rim does not count as skin's.
const RIM_CLEARANCE_PX: f32 = 10.0;

/// Minimum share of each kind among the samples for a classification.
const MIN_SHARE: f64 = 0.05;

/// Classifier of skin and hair by color, learned from the capture itself.
///
/// Where a mask is soft over more than the one pixel of an antialiased outline (a pixel whose eight
/// neighbors are all soft, too), hair is in front of the background: opaque pixels of the region
/// beside it are samples of hair, those along the other outlines samples of skin. Every opaque
/// pixel of the region is then assigned to the kind whose median is nearer, in units of that kind's
/// own median deviation. Brows and lips are classified as hair if they are as dark. Without soft
/// rims (a shaven head, a bust, hard masks), without hard ones, or with hair of the skin's color no
/// classification is made.
#[derive(Clone, Debug, PartialEq)]
pub struct Tones {
    skin: Tone,
    hair: Tone,
}

/// Median and median deviation of each channel, in 1/255.
#[derive(Clone, Debug, PartialEq)]
struct Tone {
    median: [f64; 3],
    deviation: [f64; 3],
}

/// Histograms of each channel over the samples of skin, and of hair.
#[derive(Clone)]
struct ToneSamples([[[u64; 256]; 3]; 2]);

impl ToneSamples {
    /// Collects the samples of one photograph (not cut out); `None` without a region of interest.
    fn collect(photo: &Photo, masks: Masks) -> Option<ToneSamples> {
        let (region, (width, height)) = (masks.region?, masks.size());
        let head = masks.mask.inside();
        let rest: Vec<bool> = head.iter().map(|h| !h).collect();
        let soft = soft_rim(masks.mask);
        let [beside, far] = [RIM_BAND_PX, RIM_CLEARANCE_PX].map(|px| grow(&soft, width, height, px));
        let rim = grow(&rest, width, height, 1.0);
        let hard: Vec<bool> =
            (0..rim.len()).map(|i| rim[i] && head[i] && !far[i] && region.values[i] >= INSIDE).collect();
        let along = grow(&hard, width, height, RIM_BAND_PX);
        let opaque = masks.all(|i, m| m == u8::MAX && region.values[i] >= INSIDE);
        let mut counts = [[[0; 256]; 3]; 2];
        for (i, rgb) in photo.rgb.iter().enumerate().filter(|(i, _)| opaque[*i]) {
            let kinds = [along[i] && !far[i], beside[i]];
            for (kind, _) in counts.iter_mut().zip(kinds).filter(|(_, is)| *is) {
                kind.iter_mut().zip(rgb).for_each(|(channel, &v)| channel[v as usize] += 1);
            }
        }
        Some(ToneSamples(counts))
    }

    /// Adds the samples of two photographs.
    fn and(mut self, other: &ToneSamples) -> ToneSamples {
        let counts = self.0.as_flattened_mut().as_flattened_mut();
        counts.iter_mut().zip(other.0.as_flattened().as_flattened()).for_each(|(a, b)| *a += b);
        self
    }

    /// Returns the classifier, if these samples separate the kinds.
    fn tones(&self) -> Option<Tones> {
        let [skin, hair] = [0, 1].map(|kind| self.0[kind][0].iter().sum::<u64>());
        if (skin.min(hair) as f64) <= MIN_SHARE * (skin + hair) as f64 {
            return None;
        }
        let [skin, hair] = [0, 1].map(|kind| Tone::from_histograms(&self.0[kind]));
        let apart = (0..3)
            .any(|c| (skin.median[c] - hair.median[c]).abs() > 2.0 * (skin.deviation[c] + hair.deviation[c]));
        apart.then_some(Tones { skin, hair })
    }
}

impl Tone {
    fn from_histograms(counts: &[[u64; 256]; 3]) -> Tone {
        let median = counts.each_ref().map(|counts| median_of_counts(counts));
        let deviation = std::array::from_fn(|c| {
            let mut away = [0; 256];
            let distance = |v: usize| v.abs_diff(median[c]);
            counts[c].iter().enumerate().for_each(|(v, n)| away[distance(v)] += n);
            median_of_counts(&away).max(1) as f64
        });
        Tone { median: median.map(|m| m as f64), deviation }
    }

    fn distance(&self, rgb: [u8; 3]) -> f64 {
        (0..3).map(|c| (rgb[c] as f64 - self.median[c]).abs() / self.deviation[c]).sum()
    }
}

impl Tones {
    /// Learns the classifier from photographs; `None` if they do not separate skin and hair.
    pub fn learn(views: &[&View]) -> Result<Option<Tones>> {
        let samples = |view: &&View| -> Result<Option<ToneSamples>> {
            let loaded = view.load(&Limits::default())?;
            Ok(Masks::of(&loaded).and_then(|masks| ToneSamples::collect(&loaded.photo, masks)))
        };
        let found = views.par_iter().map(samples).collect::<Result<Vec<_>>>()?;
        let sum = found.into_iter().flatten().reduce(|a, b| a.and(&b));
        Ok(sum.and_then(|s| s.tones()))
    }

    /// Returns skin and hair of one photograph, in whole or cut out; `None` without a region.
    pub fn split(&self, photo: &Photo, masks: Masks) -> Option<(Vec<bool>, Vec<bool>)> {
        let region = masks.region?;
        let (width, height) = masks.size();
        let fringe = grow(&soft_rim(masks.mask), width, height, 1.0);
        let dark = |i: usize| self.hair.distance(photo.rgb[i]) < self.skin.distance(photo.rgb[i]);
        let of = |i: usize, m: u8| region.values[i] >= INSIDE && m == u8::MAX;
        let skin = masks.all(|i, m| of(i, m) && !dark(i));
        let rim = |i: usize, m: u8| region.values[i] >= INSIDE && m < u8::MAX && fringe[i];
        Some((skin, masks.all(|i, m| of(i, m) && dark(i) || rim(i, m))))
    }
}

/// Returns the pixels where the mask and all eight neighbors (those within the frame) are neither 0
/// nor 1.
fn soft_rim(mask: &Gray) -> Vec<bool> {
    let (w, h) = (mask.width as usize, mask.height as usize);
    let soft = |x: usize, y: usize| !matches!(mask.values[y * w + x], 0 | u8::MAX);
    let all = |x: usize, y: usize| {
        let columns = x.saturating_sub(1)..(x + 2).min(w);
        (y.saturating_sub(1)..(y + 2).min(h)).all(|v| columns.clone().all(|u| soft(u, v)))
    };
    (0..w * h).map(|i| all(i % w, i / w)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::parts::parts;
    use crate::metrics::parts::tests::{close, gray, only};
    use tiface_base::image::Image;

    /// Returns a capture of one photograph, 40 × 20: background above, below it a soft rim of hair
    /// on the left half and a hard outline of skin on the right; the lowest rows are neck.
    fn head(hair: [u8; 3], skin: [u8; 3]) -> (Photo, Gray, Gray) {
        let (w, h) = (40, 20);
        let mask = |x: usize, y: usize| match (x < w / 2, y) {
            (true, 0..3) | (false, 0..6) => 0,
            (true, 3..6) => 60 * (y - 2) as u8,
            _ => 255,
        };
        let all = || (0..w * h).map(|i| (i % w, i / w));
        let color = |(x, _): (usize, usize)| if x < w / 2 { hair } else { skin };
        let region = all().map(|(_, y)| if y < 16 { 255 } else { 0 }).collect();
        let photo = Photo { width: 40, height: 20, rgb: all().map(color).collect(), alpha: None };
        (photo, gray(40, all().map(|(x, y)| mask(x, y)).collect()), gray(40, region))
    }

    #[test]
    fn a_soft_rim_shows_the_color_of_hair_and_a_hard_one_that_of_skin() {
        let (photo, mask, region) = head([60, 40, 30], [200, 150, 140]);
        let masks = Masks { region: Some(&region), ..only(&mask) };
        let samples = ToneSamples::collect(&photo, masks).unwrap();
        let tones = samples.clone().and(&samples).tones().unwrap();
        assert_eq!((tones.hair.median, tones.skin.median), ([60.0, 40.0, 30.0], [200.0, 150.0, 140.0]));
        let (skin, hair) = tones.split(&photo, masks).unwrap();
        let count = |set: &[bool]| set.iter().filter(|s| **s).count();
        // opaque rows 6 to 15 of 20 columns each; hair has its rim, too: row 4 up to column 18 has
        // soft neighbors only, and what touches it is in rows 3 to 5 up to there, and column 19 of
        // row 4
        assert_eq!((count(&skin), count(&hair)), (200, 200 + 3 * 19 + 1));
        assert!(skin[10 * 40 + 30] && hair[10 * 40 + 10] && hair[4 * 40 + 5] && !skin[17 * 40 + 30]);
        let render = Image::new(40, 20, 4);
        let found = parts(&render, &photo, masks, None, [0.0; 3], Some(&tones));
        // black for skin: (200² + 150² + 140²) / (3 · 255²) = 0.42086 → 3.7586 dB
        close(found.psnr_skin, 3.7586);
        // for hair: (60² + 40² + 30²) / (3 · 255²) = 0.031270 → 15.0487 dB
        close(found.psnr_hair, 15.0487);
    }

    #[test]
    fn without_a_soft_rim_or_a_difference_nothing_is_told_apart() {
        let (photo, mut mask, region) = head([60, 40, 30], [200, 150, 140]);
        let same = Photo { rgb: vec![[90; 3]; 800], ..photo.clone() };
        let masks = Masks { region: Some(&region), ..only(&mask) };
        assert_eq!(ToneSamples::collect(&same, masks).unwrap().tones(), None);
        assert!(ToneSamples::collect(&photo, only(&mask)).is_none());
        mask.values.iter_mut().for_each(|m| *m = if *m >= 128 { 255 } else { 0 });
        let masks = Masks { region: Some(&region), ..only(&mask) };
        assert_eq!(ToneSamples::collect(&photo, masks).unwrap().tones(), None);
    }
}
