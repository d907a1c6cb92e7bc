//! The renders of one view: their validation and access to their pixels.

use crate::image::{Gray, Image, Photo};
use crate::{Error, Result};
use rayon::prelude::*;
use std::ops::Range;

/// Sums are gathered in this many bands of a picture, whatever the number of threads, and added in
/// the order of the bands.
const BANDS: usize = 32;

/// One render of the view.
#[derive(Clone, Copy, Debug)]
pub struct Member<'a> {
    /// The name in error messages: `baseline`, `tface`, `iface`.
    pub name: &'a str,
    /// RGBA, sRGB-coded over black (premultiplied); alpha = opacity.
    pub image: &'a Image,
    /// Whether the member was trained with masks. One that was not shows the background too.
    pub masked: bool,
}

/// The photograph that the members are compared with.
#[derive(Clone, Copy, Debug)]
pub struct BlendTarget<'a> {
    /// The photograph over black: its colors multiplied by the mask.
    pub photo: &'a Photo,
    /// Weight of each pixel, 255 = once, 0 = not at all: the mask, or the mask from half on, and 0 where the
    /// photograph is not valid.
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
    /// Checks the renders. Their order is that of the weights.
    ///
    /// A pixel that is not finite is an error, here and so in every fit: it comes from a member that
    /// has diverged, of which no other pixel should be trusted.
    pub fn new(list: &[Member<'a>]) -> Result<Members<'a>> {
        let first = list.first().ok_or_else(no_members)?;
        let expected = (first.image.width, first.image.height);
        for member in list {
            let Member { name, image, .. } = member;
            same_size(&format!("the view of member `{name}`"), (image.width, image.height), expected)?;
            if image.channels != 4 {
                return Err(Error::cannot(
                    format!("the view of member `{name}` has {} channels, expected 4", image.channels),
                    "members are RGBA renders: render the view again",
                ));
            }
            all_finite(name, image)?;
        }
        Ok(Members { list: list.to_vec(), cut: None })
    }

    /// Cuts the members that were trained without masks to the head.
    ///
    /// They fill the frame, and a blend would show a ghost of the background at their weight. Color and alpha are
    /// multiplied by the mean opacity of the masked members, averaged with their `weights` (equally if those are all
    /// 0); where the head is opaque nothing changes. Without masked members nothing is cut.
    pub fn cut(mut self, weights: &[f32]) -> Result<Members<'a>> {
        let weights = normalized(weights, self.list.len())?;
        let shares = |of: &dyn Fn(usize) -> f32| -> Option<Vec<f32>> {
            let of = |k: usize| if self.list[k].masked { of(k) } else { 0.0 };
            let sum: f32 = (0..self.list.len()).map(of).sum();
            (sum > 0.0).then(|| (0..self.list.len()).map(|k| of(k) / sum).collect())
        };
        self.cut = shares(&|k| weights[k]).or_else(|| shares(&|_| 1.0));
        Ok(self)
    }

    /// Returns the number of members.
    pub fn count(&self) -> usize {
        self.list.len()
    }

    /// Returns width and height.
    pub fn size(&self) -> (u32, u32) {
        (self.list[0].image.width, self.list[0].image.height)
    }

    pub(super) fn pixels(&self) -> usize {
        self.size().0 as usize * self.size().1 as usize
    }

    /// Reads all members at pixel `i`, clamped to 0..=1 and cut. `out`: `[members]`.
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

    /// Checks that the target belongs to this view.
    pub(super) fn check(&self, target: &BlendTarget) -> Result<()> {
        let (photo, weight) = (target.photo, target.weight);
        same_size("the photograph", (photo.width, photo.height), self.size())?;
        same_size("the weight map", (weight.width, weight.height), self.size())
    }

    /// Calls `with(i, weight, member − photo)` for the pixels that count. The errors are `[members]`, RGB.
    pub(super) fn errors(
        &self,
        target: &BlendTarget,
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

/// Returns one result for each band of a picture, in order.
pub(super) fn in_bands<T: Send>(pixels: usize, band: impl Fn(Range<usize>) -> T + Sync) -> Vec<T> {
    (0..BANDS).into_par_iter().map(|b| band(b * pixels / BANDS..(b + 1) * pixels / BANDS)).collect()
}

/// Returns the error for an empty list of members.
pub(super) fn no_members() -> Error {
    Error::cannot("there are no members to blend", "name at least one member whose views are rendered")
}

/// Normalizes weights to a sum of exactly 1. A sum that is off by more than 0.001 is an error.
pub(super) fn normalized(weights: &[f32], members: usize) -> Result<Vec<f32>> {
    let found = weights.len();
    if found != members {
        return Err(Error::cannot(
            format!("there are {found} weights for {members} members"),
            "write one weight for each member, in their order",
        ));
    }
    if let Some(index) = weights.iter().position(|w| !(w.is_finite() && *w >= 0.0)) {
        return Err(Error::cannot(
            format!("weight {} is {}, expected a finite number from 0 up", index + 1, weights[index]),
            "a weight is the share of a member, from 0 to 1",
        ));
    }
    let sum: f64 = weights.iter().map(|w| *w as f64).sum();
    if (sum - 1.0).abs() > 1e-3 {
        return Err(Error::cannot(format!("the weights sum to {sum}, expected 1"), shares_hint(weights)));
    }
    Ok(weights.iter().map(|w| (*w as f64 / sum) as f32).collect())
}

/// Returns the hint for weights whose sum is not 1.
pub fn shares_hint(weights: &[f32]) -> String {
    let sum: f64 = weights.iter().map(|w| *w as f64).sum();
    if sum <= 0.0 {
        return "give at least one member a weight above 0".into();
    }
    let shares: Vec<String> = weights.iter().map(|w| format!("{:.4}", *w as f64 / sum)).collect();
    format!("the same shares with sum 1 are {}", shares.join(", "))
}

fn same_size(what: &str, found: (u32, u32), expected: (u32, u32)) -> Result<()> {
    if found == expected {
        return Ok(());
    }
    Err(Error::cannot(
        format!("{what} is {} × {} pixels, expected {} × {}", found.0, found.1, expected.0, expected.1),
        "render the members again, all at the size of the photograph",
    ))
}

fn all_finite(member: &str, image: &Image) -> Result<()> {
    let finite = |pixel: &[f32]| pixel.iter().all(|v| v.is_finite());
    let pixels = image.data.par_chunks_exact(4);
    let Some(first) = pixels.clone().position_first(|pixel| !finite(pixel)) else { return Ok(()) };
    let wrong = pixels.filter(|pixel| !finite(pixel)).count();
    let (column, row) = (first % image.width as usize, first / image.width as usize);
    Err(Error::cannot(
        format!(
            "member `{member}`: {wrong} pixels are not finite, the first in column {column} of row {row}"
        ),
        "its training has probably diverged: train that member again, or leave it out",
    ))
}
