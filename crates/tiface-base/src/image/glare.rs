//! Glare: the light of lamps in a picture, spread around them by the lens.
//!
//! A lens spreads a share of the light of each point over the whole picture. Where lamps are in the
//! picture before a dark background, their light is what one sees of it: halos, which lie over the
//! head, too, and differently in each view. With `L` the light of lamps in linear light, the halo
//! is `Σₖ wₖ (Gₖ ∗ L)`, `Gₖ` being Gaussians of the deviations [`SPREADS`]. The weights are those
//! of least squared error on dark background, not negative. Their sum may exceed one, because a
//! photograph shows lamps less bright than they are.

use super::{
    Gray, OPAQUE_ALPHA, Photo, bilinear, blurred, grow, linear_from_srgb, quantize, srgb_from_linear,
};
use crate::math::cholesky::{factor, substitute};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Deviations of the Gaussians, as shares of the picture's longest side.
const SPREADS: [f32; 4] = [0.006, 0.018, 0.053, 0.16];

/// Linear light of a pixel's brightest channel from which on it shows a lamp, if it is background.
const LAMP: f32 = 0.4;

/// How far from open background a lamp is still seen through soft pixels, as a share of the
/// picture's longest side.
const BEHIND: f32 = 0.01;

/// Distances from lamps, and from the head, from which on background is compared, in pixels.
const AWAY_PX: (f32, f32) = (2.0, 3.0);

/// A picture is reduced until a Gaussian's deviation is between one and a half and three pixels.
const REDUCED_PX: f32 = 1.5;

/// Unknowns of the fit: the weights, and the light of the background itself.
const UNKNOWNS: usize = SPREADS.len() + 1;

/// Minimum share of the views that show a lamp.
const MIN_VIEWS_WITH_LAMPS: f64 = 0.5;

/// Largest median of the background's linear light: halos are told apart from what they lie on
/// before a dark background alone.
const MAX_BACKGROUND: f32 = 0.05;

/// Minimum share of the variance of one half of the views that the weights of the other explain.
/// Light-stage photographs with glare reach 0.97; lamps that light a wall beside them, 0.77.
const MIN_EXPLAINED: f64 = 0.9;

/// Minimum share of the glare on background that lies on the head, too: 1.3 where it comes from the
/// lens, −0.7 where lamps light a wall beside them.
const MIN_ON_HEAD: f64 = 0.4;

/// Distances from soft pixels between which pixels of the head are compared with each other, as
/// shares of the picture's longest side: light changes toward outlines without glare, too.
const RINGS: [f32; 4] = [0.004, 0.008, 0.016, 0.03];

/// What a lens spreads of the light of lamps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Glare {
    /// Weight of each of the Gaussians, 0 or more.
    pub weights: [f32; SPREADS.len()],
}

impl Glare {
    /// Fits the glare of photographs with masks of the head (0 is background) of the same sizes.
    /// Returns `None`
    /// where it cannot be told from other light: without lamps in half of the photographs, before a
    /// background that is not dark, where light does not fall off around lamps alike in all
    /// photographs, or where the head has nothing of it.
    pub fn measure(pictures: &[(Photo, Gray)]) -> Option<Glare> {
        let compared: Vec<Background> =
            pictures.par_iter().filter_map(|(photo, mask)| Background::compare(photo, mask)).collect();
        if compared.is_empty() || (compared.len() as f64) < MIN_VIEWS_WITH_LAMPS * pictures.len() as f64 {
            return None;
        }
        let mut medians: Vec<f32> = compared.iter().map(|view| view.median).collect();
        medians.sort_unstable_by(f32::total_cmp);
        if medians[medians.len() / 2] > MAX_BACKGROUND {
            return None;
        }
        let mut halves = [Sums::default(), Sums::default()];
        compared.iter().enumerate().for_each(|(i, view)| halves[i % 2].add(&view.sums));
        let agrees = |one: &Sums, other: &Sums| other.explained(&one.weights()) >= MIN_EXPLAINED;
        if !agrees(&halves[0], &halves[1]) || !agrees(&halves[1], &halves[0]) {
            return None;
        }
        let [mut all, other] = halves;
        all.add(&other);
        let weights = all.weights();
        let mut on_head = Sums::default();
        compared.iter().for_each(|view| on_head.add(&view.on_head));
        let slope = on_head.slope(&weights);
        if slope.is_nan() || slope < MIN_ON_HEAD {
            return None; // not a number: there is no head
        }
        Some(Glare { weights: std::array::from_fn(|k| weights[k] as f32) })
    }

    /// Returns the photograph without the glare of the lamps behind the head, whose mask has its
    /// size.
    pub fn taken_out(&self, mut photo: Photo, mask: &Gray) -> Photo {
        let Some(lamps) = Lamps::find(&photo, mask) else { return photo };
        let mut cleared = photo.rgb.clone();
        for c in 0..3 {
            let mut glare = vec![0f32; cleared.len()];
            for (k, weight) in self.weights.into_iter().enumerate().filter(|(_, weight)| *weight > 0.0) {
                lamps.add_halo(c, k, weight, &mut glare);
            }
            cleared.par_iter_mut().zip(&glare).for_each(|(color, glare)| {
                let light = lamps.linear[usize::from(color[c])] - glare;
                color[c] = quantize(srgb_from_linear(light.max(0.0)));
            });
        }
        photo.rgb = cleared;
        photo
    }
}

/// Returns which pixels are as bright as lamps.
fn bright(photo: &Photo, linear: &[f32; 256]) -> Vec<bool> {
    photo.rgb.iter().map(|color| color.iter().any(|&byte| linear[usize::from(byte)] > LAMP)).collect()
}

/// The lamps in a photograph.
struct Lamps<'a> {
    photo: &'a Photo,
    linear: [f32; 256],
    /// `[height, width]` share of each pixel that shows a lamp, in 255ths.
    share: Vec<u8>,
}

impl Lamps<'_> {
    /// Finds bright background, and bright soft pixels beside it, as much of them as is not covered
    /// by the head: bright skin has soft pixels, too. Returns `None` if there is none.
    fn find<'a>(photo: &'a Photo, mask: &Gray) -> Option<Lamps<'a>> {
        let linear = std::array::from_fn(|byte| linear_from_srgb(byte as f32 / 255.0));
        let (w, h) = (photo.width as usize, photo.height as usize);
        let bright = bright(photo, &linear);
        let open: Vec<bool> = bright.iter().zip(&mask.values).map(|(&b, &alpha)| b && alpha == 0).collect();
        if open.iter().all(|open| !open) {
            return None;
        }
        let near = grow(&open, w, h, BEHIND * w.max(h) as f32);
        let share = |i: usize| if bright[i] && near[i] { 255 - mask.values[i] } else { 0 };
        Some(Lamps { photo, linear, share: (0..w * h).map(share).collect() })
    }

    /// Adds `weight` times one channel of the lamps' light, convolved with a Gaussian. Beyond the
    /// border there is no light.
    fn add_halo(&self, channel: usize, spread: usize, weight: f32, sum: &mut [f32]) {
        let (w, h) = (self.photo.width as usize, self.photo.height as usize);
        let deviation = SPREADS[spread] * w.max(h) as f32;
        let factor = ((deviation / REDUCED_PX) as usize).max(1);
        // reducing by blocks and interpolating between them blurs by a quarter of a block's square
        let reduced = deviation / factor as f32;
        let reduced = if factor > 1 { (reduced * reduced - 0.25).sqrt() } else { reduced };
        // a dark margin, since the blur repeats what is at the border
        let margin = (3.0 * reduced).ceil() as usize;
        let (columns, rows) = (w.div_ceil(factor), h.div_ceil(factor));
        let stride = columns + 2 * margin;
        let mut small = vec![0f32; stride * (rows + 2 * margin)];
        let part = weight / (255 * factor * factor) as f32;
        for (i, &share) in self.share.iter().enumerate().filter(|(_, share)| **share > 0) {
            let (x, y) = (i % w / factor + margin, i / w / factor + margin);
            let light = self.linear[usize::from(self.photo.rgb[i][channel])];
            small[y * stride + x] += part * f32::from(share) * light;
        }
        let small = blurred(&small, stride, reduced);
        let size = [columns, rows, stride].map(|n| n as u32);
        let whole = ((columns * factor) as u32, (rows * factor) as u32);
        let first = margin * stride + margin;
        let large = bilinear(&small[first..], size[2], (size[0], size[1]), whole, |v| v);
        for (out, row) in sum.chunks_exact_mut(w).zip(large.chunks_exact(columns * factor)) {
            out.iter_mut().zip(row).for_each(|(sum, v)| *sum += v);
        }
    }
}

/// The dark background of a photograph, compared with the halos of its lamps.
struct Background {
    sums: Sums,
    /// The same of the head: what both differ by from the mean of pixels as far inside.
    on_head: Sums,
    /// Median of its light.
    median: f32,
}

impl Background {
    /// Returns `None` without lamps, and where there is no background beside them.
    fn compare(photo: &Photo, mask: &Gray) -> Option<Background> {
        let (w, h) = (photo.width as usize, photo.height as usize);
        let lamps = Lamps::find(photo, mask)?;
        let light = &lamps.linear;
        let head: Vec<bool> = mask.values.iter().map(|&alpha| alpha > 0).collect();
        let near = [grow(&bright(photo, light), w, h, AWAY_PX.0), grow(&head, w, h, AWAY_PX.1)];
        let compared: Vec<usize> = (0..w * h).filter(|&i| !near[0][i] && !near[1][i]).collect();
        let rings = rings(mask);
        let (mut sums, mut on_head) = (Sums::default(), Sums::default());
        let mut of_background = Vec::with_capacity(3 * compared.len());
        for c in 0..3 {
            let halos: [Vec<f32>; SPREADS.len()] = std::array::from_fn(|k| {
                let mut halo = vec![0f32; w * h];
                lamps.add_halo(c, k, 1.0, &mut halo);
                halo
            });
            let pixel = |i: usize| {
                let terms = std::array::from_fn(|k| halos.get(k).map_or(1.0, |halo| f64::from(halo[i])));
                (terms, light[usize::from(photo.rgb[i][c])])
            };
            for &i in &compared {
                let (terms, seen) = pixel(i);
                sums.add_pixel(terms, f64::from(seen));
                of_background.push(seen);
            }
            for ring in &rings {
                let mut mean = Sums::default();
                let pixels = || ring.iter().map(|&i| pixel(i));
                pixels().for_each(|(terms, seen)| mean.add_pixel(terms, f64::from(seen)));
                let [.., sums] = mean.terms;
                let count = sums[UNKNOWNS - 1];
                for (terms, seen) in pixels() {
                    let terms = std::array::from_fn(|k| terms[k] - sums[k] / count);
                    on_head.add_pixel(terms, f64::from(seen) - mean.light[UNKNOWNS - 1] / count);
                }
            }
        }
        let middle = of_background.len() / 2;
        let (_, median, _) =
            (middle > 0).then(|| of_background.select_nth_unstable_by(middle, f32::total_cmp))?;
        Some(Background { median: *median, sums, on_head })
    }
}

/// Returns the opaque pixels of the head by their distance from soft ones, without those beside
/// them.
fn rings(mask: &Gray) -> Vec<Vec<usize>> {
    let (w, h) = (mask.width as usize, mask.height as usize);
    let soft: Vec<bool> = mask.values.iter().map(|&alpha| alpha < OPAQUE_ALPHA).collect();
    let mut ring = vec![0; w * h];
    for (k, share) in RINGS.into_iter().enumerate() {
        let near = grow(&soft, w, h, share * w.max(h) as f32);
        ring.iter_mut().zip(near).filter(|(_, near)| !near).for_each(|(ring, _)| *ring = k + 1);
    }
    (1..=RINGS.len()).map(|k| (0..w * h).filter(|&i| ring[i] == k).collect()).collect()
}

/// Sums over pixels: what a fit by least squares needs of them.
#[derive(Clone, Copy, Default)]
struct Sums {
    /// Products of the terms.
    terms: [[f64; UNKNOWNS]; UNKNOWNS],
    /// Products of terms and light.
    light: [f64; UNKNOWNS],
    /// Squares of the light.
    square: f64,
}

impl Sums {
    fn add_pixel(&mut self, terms: [f64; UNKNOWNS], light: f64) {
        for i in 0..UNKNOWNS {
            (0..UNKNOWNS).for_each(|j| self.terms[i][j] += terms[i] * terms[j]);
            self.light[i] += terms[i] * light;
        }
        self.square += light * light;
    }

    fn add(&mut self, other: &Sums) {
        for i in 0..UNKNOWNS {
            (0..UNKNOWNS).for_each(|j| self.terms[i][j] += other.terms[i][j]);
            self.light[i] += other.light[i];
        }
        self.square += other.square;
    }

    /// Returns the sum of squared errors with these weights.
    fn error(&self, weights: &[f64; UNKNOWNS]) -> f64 {
        let product = |i: usize| (0..UNKNOWNS).map(|j| self.terms[i][j] * weights[j]).sum::<f64>();
        self.square + (0..UNKNOWNS).map(|i| weights[i] * (product(i) - 2.0 * self.light[i])).sum::<f64>()
    }

    /// Returns the share of the light's variance that these weights explain.
    fn explained(&self, weights: &[f64; UNKNOWNS]) -> f64 {
        let count = self.terms[UNKNOWNS - 1][UNKNOWNS - 1];
        let variance = self.square - self.light[UNKNOWNS - 1].powi(2) / count;
        1.0 - self.error(weights) / variance
    }

    /// Returns how much of the sum of terms with these weights is in the light.
    fn slope(&self, weights: &[f64; UNKNOWNS]) -> f64 {
        let product = |i: usize| (0..UNKNOWNS).map(|j| self.terms[i][j] * weights[j]).sum::<f64>();
        let of_terms: f64 = (0..UNKNOWNS).map(|i| weights[i] * product(i)).sum();
        (0..UNKNOWNS).map(|i| weights[i] * self.light[i]).sum::<f64>() / of_terms
    }

    /// Returns the weights of least error of which none is negative: the best of the minima over
    /// each subset of the terms that have none.
    fn weights(&self) -> [f64; UNKNOWNS] {
        let (mut best, mut least) = ([0.0; UNKNOWNS], self.square);
        for subset in 1u32..1 << UNKNOWNS {
            let on: Vec<usize> = (0..UNKNOWNS).filter(|k| subset >> k & 1 == 1).collect();
            let n = on.len();
            let mut matrix: Vec<f64> = on
                .iter()
                .flat_map(|&i| on.iter().map(move |&j| (i, j)))
                .map(|(i, j)| self.terms[i][j])
                .collect();
            let mut found: Vec<f64> = on.iter().map(|&i| self.light[i]).collect();
            if !factor(&mut matrix, n) {
                continue;
            }
            substitute(&matrix, &mut found);
            if found.iter().any(|v| v.is_nan() || *v < 0.0) {
                continue;
            }
            let mut weights = [0.0; UNKNOWNS];
            on.iter().zip(&found).for_each(|(&k, &v)| weights[k] = v);
            let error = self.error(&weights);
            if error < least {
                (best, least) = (weights, error);
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (60, 80);

    /// Returns a photograph of a gray head in the middle, before lamps on a dark background, and
    /// its mask. `glare` are the weights of the halos.
    fn photo(lamps: &[(f32, f32)], glare: [f32; 4], background: f32) -> (Photo, Gray) {
        photo_of(lamps, glare, background, true)
    }

    /// The same; halos lie on the head only if they come from the lens.
    fn photo_of(lamps: &[(f32, f32)], glare: [f32; 4], background: f32, of_lens: bool) -> (Photo, Gray) {
        let (w, h) = SIZE;
        let at = |i: usize| ((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
        let is_head = |i: usize| (at(i).0 - 30.0).hypot(at(i).1 - 40.0) < 15.0;
        let is_lamp =
            |i: usize| lamps.iter().any(|l| (at(i).0 - l.0).hypot(at(i).1 - l.1) < 5.0) && !is_head(i);
        // by the definition: a sum over all pixels of lamps
        let bell = |i: usize, j: usize, k: usize| {
            let deviation = SPREADS[k] * h as f32;
            let square = (at(i).0 - at(j).0).powi(2) + (at(i).1 - at(j).1).powi(2);
            (-0.5 * square / (deviation * deviation)).exp() / (std::f32::consts::TAU * deviation * deviation)
        };
        let sources: Vec<usize> = (0..w * h).filter(|&i| is_lamp(i)).collect();
        let pixel = |i: usize| {
            let own = if is_head(i) {
                0.1
            } else if is_lamp(i) {
                0.8
            } else {
                background
            };
            let halo = |k: usize| glare[k] * sources.iter().map(|&j| 0.8 * bell(i, j, k)).sum::<f32>();
            let halos = if of_lens || !is_head(i) { (0..4).map(halo).sum::<f32>() } else { 0.0 };
            [quantize(srgb_from_linear(own + halos)); 3]
        };
        let mask = (0..w * h).map(|i| if is_head(i) { 255 } else { 0 }).collect();
        let (width, height) = (w as u32, h as u32);
        let rgb = (0..w * h).into_par_iter().map(pixel).collect();
        (Photo { width, height, rgb, alpha: None }, Gray { width, height, values: mask })
    }

    const VIEWS: [&[(f32, f32)]; 4] =
        [&[(10.0, 20.0), (45.0, 60.0)], &[(15.0, 65.0)], &[(50.0, 30.0), (30.0, 10.0)], &[(43.0, 25.0)]];

    #[test]
    fn glare_is_found_on_the_background_and_taken_off_the_head() {
        let glare = [0.3, 0.3, 0.2, 0.4];
        let pictures = VIEWS.map(|lamps| photo(lamps, glare, 0.01));
        let found = Glare::measure(&pictures).unwrap();
        for ((photographed, mask), lamps) in pictures.into_iter().zip(VIEWS) {
            let (clean, _) = photo(lamps, [0.0; 4], 0.01);
            let error = |a: &Photo| {
                let head = (0..mask.values.len()).filter(|&i| mask.values[i] > 0);
                head.map(|i| (f64::from(a.rgb[i][0]) - f64::from(clean.rgb[i][0])).powi(2)).sum::<f64>()
            };
            let before = error(&photographed);
            let after = error(&found.taken_out(photographed, &mask));
            assert!(after < 0.05 * before, "{after} of {before}, {found:?}");
        }
    }

    #[test]
    fn without_halos_lamps_or_darkness_there_is_no_glare() {
        // no lamps, no halos, a bright room
        let measure = |lamps: [&[(f32, f32)]; 4], glare: [f32; 4], background: f32| {
            Glare::measure(&lamps.map(|lamps| photo(lamps, glare, background)))
        };
        let glare = [0.3, 0.3, 0.2, 0.4];
        assert_eq!(measure([&[]; 4], glare, 0.01), None);
        assert_eq!(measure(VIEWS, [0.0; 4], 0.01), None);
        assert_eq!(measure(VIEWS, glare, 0.2), None);
        assert_eq!(measure([VIEWS[0], &[], &[], &[]], glare, 0.01), None);
        assert_eq!(Glare::measure(&[]), None);
        // halos of one width in one half of the photographs, of another in the other
        let kinds = [[0.0, 0.0, 0.0, 4.0], [0.0, 0.0, 1.5, 0.0]];
        let mixed: Vec<_> = (0..4).map(|i| photo(VIEWS[i], kinds[i % 2], 0.01)).collect();
        assert_eq!(Glare::measure(&mixed), None);
        assert!(
            kinds.iter().all(|kind| Glare::measure(&VIEWS.map(|lamps| photo(lamps, *kind, 0.01))).is_some())
        );
        // lamps that light a wall behind the head
        let walls = VIEWS.map(|lamps| photo_of(lamps, glare, 0.01, false));
        assert_eq!(Glare::measure(&walls), None);
    }

    #[test]
    fn a_photograph_without_lamps_keeps_its_bytes() {
        let (plain, mask) = photo(&[], [0.0; 4], 0.01);
        let glare = Glare { weights: [0.5; 4] };
        assert!(glare.taken_out(plain.clone(), &mask).rgb == plain.rgb);
    }

    #[test]
    fn no_weight_is_negative() {
        let mut sums = Sums::default();
        // light that falls with the first term and grows with the third
        for i in 0..50 {
            let x = f64::from(i) / 50.0;
            let terms = [x, x * x, 1.0 - x * x * x, (7.0 * x).sin().abs(), 1.0];
            sums.add_pixel(terms, 2.0 - x);
        }
        let weights = sums.weights();
        assert!(weights.iter().all(|w| *w >= 0.0) && weights[2] > 0.0, "{weights:?}");
        // no step within bounds improves it
        for k in 0..UNKNOWNS {
            for step in [-1e-4, 1e-4] {
                let mut moved = weights;
                moved[k] = (moved[k] + step).max(0.0);
                assert!(sums.error(&moved) >= sums.error(&weights) - 1e-12);
            }
        }
    }
}
