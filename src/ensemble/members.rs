//! The renders of one view, checked once, and how their pixels are read.

use super::EnsembleError;
use crate::image::{Gray, Image, Photo};
use rayon::prelude::*;
use std::ops::Range;

/// Sums are gathered in this many bands of a picture, whatever the number of threads, and added in
/// the order of the bands.
const BANDS: usize = 32;

/// One render of the view.
#[derive(Clone, Copy, Debug)]
pub struct Member<'a> {
    /// What errors call it: `baseline`, `tface`, `iface`.
    pub name: &'a str,
    /// RGBA, sRGB-coded over black (premultiplied); alpha = opacity.
    pub image: &'a Image,
    /// Was it trained with masks? One that was not shows the stage behind the head too.
    pub masked: bool,
}

/// What the members should have shown.
#[derive(Clone, Copy, Debug)]
pub struct Target<'a> {
    /// The photograph over black: its colours multiplied by the mask.
    pub photo: &'a Photo,
    /// How much a pixel counts, 255 = once, 0 = not at all: the mask, or the mask from half on, and
    /// 0 where the photograph is not valid.
    pub weight: &'a Gray,
}

/// The renders of one view: one size, RGBA, all finite.
#[derive(Clone, Debug)]
pub struct Members<'a> {
    list: Vec<Member<'a>>,
    /// Shares of the masked members in the opacity that cuts the others; 0 for the others.
    cut: Option<Vec<f32>>,
}

impl<'a> Members<'a> {
    /// Checks them. The order is that of the weights.
    ///
    /// A pixel that is not finite is an error, here and so in every fit: it comes from a member that
    /// has diverged, of which no other pixel should be trusted.
    pub fn new(list: &[Member<'a>]) -> Result<Members<'a>, EnsembleError> {
        let Some(first) = list.first() else { return Err(EnsembleError::NoMembers) };
        let expected = (first.image.width, first.image.height);
        for member in list {
            let what = || format!("the view of member `{}`", member.name);
            same_size(what, (member.image.width, member.image.height), expected)?;
            channels(what, member.image, 4)?;
            all_finite(member.name, member.image)?;
        }
        Ok(Members { list: list.to_vec(), cut: None })
    }

    /// Cuts the members that were trained without masks to the head.
    ///
    /// They fill the frame, and a blend would show a ghost of the stage at their weight. Colour and
    /// alpha are multiplied by the mean opacity of the masked members, averaged with their
    /// `weights` (alike if those are all 0); where the head is opaque nothing changes. Without
    /// masked members there is nothing to cut by, and nothing is cut.
    pub fn cut(mut self, weights: &[f32]) -> Result<Members<'a>, EnsembleError> {
        let weights = normalised(weights, self.list.len())?;
        let shares = |of: &dyn Fn(usize) -> f32| -> Option<Vec<f32>> {
            let of = |k: usize| if self.list[k].masked { of(k) } else { 0.0 };
            let sum: f32 = (0..self.list.len()).map(of).sum();
            (sum > 0.0).then(|| (0..self.list.len()).map(|k| of(k) / sum).collect())
        };
        self.cut = shares(&|k| weights[k]).or_else(|| shares(&|_| 1.0));
        Ok(self)
    }

    /// How many.
    pub fn count(&self) -> usize {
        self.list.len()
    }

    /// Width and height.
    pub fn size(&self) -> (u32, u32) {
        (self.list[0].image.width, self.list[0].image.height)
    }

    pub(super) fn pixels(&self) -> usize {
        self.size().0 as usize * self.size().1 as usize
    }

    /// All members at pixel `i`, clamped to 0..=1 and cut. `out`: `[members]`.
    #[inline]
    pub(super) fn read(&self, i: usize, out: &mut [[f32; 4]]) {
        for (o, member) in out.iter_mut().zip(&self.list) {
            let p = &member.image.data[4 * i..4 * i + 4];
            *o = [p[0], p[1], p[2], p[3]].map(|v| v.clamp(0.0, 1.0));
        }
        if let Some(shares) = &self.cut {
            let opacity: f32 = out.iter().zip(shares).map(|(c, s)| c[3] * s).sum();
            for (o, _) in out.iter_mut().zip(&self.list).filter(|(_, m)| !m.masked) {
                *o = o.map(|v| v * opacity);
            }
        }
    }

    /// Is the target one of this view?
    pub(super) fn check(&self, target: &Target) -> Result<(), EnsembleError> {
        let (photo, weight) = (target.photo, target.weight);
        same_size(|| "the photograph".into(), (photo.width, photo.height), self.size())?;
        same_size(|| "the weight map".into(), (weight.width, weight.height), self.size())
    }

    /// Calls `with(i, weight, member − photo)` for the pixels that count. Errors: `[members]`, RGB.
    pub(super) fn errors(
        &self,
        target: &Target,
        pixels: Range<usize>,
        mut with: impl FnMut(usize, f64, &[[f64; 3]]),
    ) {
        let mut colors = vec![[0f32; 4]; self.count()];
        let mut errors = vec![[0f64; 3]; self.count()];
        for i in pixels.filter(|&i| target.weight.values[i] > 0) {
            self.read(i, &mut colors);
            let photo = target.photo.rgb[i].map(|v| v as f64 / 255.0);
            for (e, c) in errors.iter_mut().zip(&colors) {
                *e = std::array::from_fn(|j| c[j] as f64 - photo[j]);
            }
            with(i, target.weight.values[i] as f64 / 255.0, &errors);
        }
    }
}

/// One result for each band of a picture, in order.
pub(super) fn in_bands<T: Send>(pixels: usize, band: impl Fn(Range<usize>) -> T + Sync) -> Vec<T> {
    (0..BANDS).into_par_iter().map(|b| band(b * pixels / BANDS..(b + 1) * pixels / BANDS)).collect()
}

/// Weights that have a sum of 1 exactly. More than 0.001 beside it is no rounding but a mistake.
pub(super) fn normalised(weights: &[f32], members: usize) -> Result<Vec<f32>, EnsembleError> {
    if weights.len() != members {
        return Err(EnsembleError::WeightCount { found: weights.len(), expected: members });
    }
    if let Some(index) = weights.iter().position(|w| !(w.is_finite() && *w >= 0.0)) {
        return Err(EnsembleError::Weight { index, value: weights[index] });
    }
    let sum: f64 = weights.iter().map(|w| *w as f64).sum();
    if (sum - 1.0).abs() > 1e-3 {
        return Err(EnsembleError::WeightSum { weights: weights.to_vec(), sum });
    }
    Ok(weights.iter().map(|w| (*w as f64 / sum) as f32).collect())
}

pub(super) fn same_size(
    what: impl Fn() -> String,
    found: (u32, u32),
    expected: (u32, u32),
) -> Result<(), EnsembleError> {
    if found == expected { Ok(()) } else { Err(EnsembleError::Size { what: what(), found, expected }) }
}

pub(super) fn channels(
    what: impl Fn() -> String,
    image: &Image,
    expected: usize,
) -> Result<(), EnsembleError> {
    let found = image.channels;
    if found == expected { Ok(()) } else { Err(EnsembleError::Channels { what: what(), found, expected }) }
}

pub(super) fn all_finite(member: &str, image: &Image) -> Result<(), EnsembleError> {
    let bad = |i: &usize| image.data[4 * i..4 * i + 4].iter().any(|v| !v.is_finite());
    let found = in_bands(image.data.len() / 4, |band| {
        let mut wrong = band.filter(bad);
        let first = wrong.next();
        (first, wrong.count() + first.is_some() as usize)
    });
    let Some(first) = found.iter().find_map(|f| f.0) else { return Ok(()) };
    let width = image.width as usize;
    let first = ((first % width) as u32, (first / width) as u32);
    let pixels = found.iter().map(|f| f.1).sum();
    Err(EnsembleError::NotFinite { member: member.into(), pixels, first })
}
