//! Stage: blends several views of one camera into one.
//!
//! `I(p) = Σ_k w_k · clamp(I_k(p), 0, 1)`, the paper's §5 with `w` = 0.1 baseline, 0.6 T-Face, 0.3
//! I-Face. Which member is the better one differs from capture to capture, and fixed weights that
//! suit one make the blend of another worse than its best member. So weights are fitted
//! ([`fit_weights`]): those of least squared error, `w ≥ 0`, `Σ w = 1`, on squares of the training
//! photographs that nothing learned from ([`tiles()`]), never on test views.
//!
//! A fit gathers sums view by view, so a capture never has to be in memory. Everything is
//! sRGB-coded color over black (premultiplied), and nothing is rounded to 8 bits here. Sums are
//! taken in bands of fixed size and fixed order: any number of threads gives the same bits.

mod fit;
mod least_squares;
mod tiles;

pub use fit::{Fit, fit_weights};
pub use tiles::{Tile, tiles};

use rayon::prelude::*;
use std::ops::Range;
use tiface_base::image::{Gray, Image, Photo};
use tiface_base::{Error, Result};

/// Maximum number of members in a fit.
pub const MAX_MEMBERS: usize = 8;

/// The paper's §5: baseline, T-Face, I-Face.
pub const PAPER_WEIGHTS: [f32; 3] = [0.1, 0.6, 0.3];

/// Blends the members with one weight each, in float; the result is rounded once, when it is
/// written.
///
/// Weights are shares: finite, from 0 up, with sum 1. A sum beside 1 by at most 0.001 is taken as
/// rounding and divided out; beyond that it is an error, since the blend would be darker or
/// brighter than its members.
///
/// # Errors
/// Fails if the number of weights differs from that of the members, if a weight is negative or not
/// finite, or if their sum is not 1.
///
/// # Examples
///
/// ```
/// use tiface::ensemble::{Member, Members, blend};
/// use tiface::image::Image;
///
/// let flat = |v: f32| Image { data: vec![v; 2 * 2 * 4], ..Image::new(2, 2, 4) };
/// let (tface, iface) = (flat(0.2), flat(0.6));
/// let member = |name, image| Member { name, image, masked: true };
/// let members = Members::new(&[member("tface", &tface), member("iface", &iface)])?;
/// let blended = blend(&members, &[0.75, 0.25])?;
/// // 0.75 · 0.2 + 0.25 · 0.6
/// assert!((blended.pixel(1, 1)[0] - 0.3).abs() < 1e-6);
/// # Ok::<(), tiface::Error>(())
/// ```
pub fn blend(members: &Members, weights: &[f32]) -> Result<Image> {
    let weights = normalized(weights, members.count())?;
    let (width, height) = members.size();
    let mut out = Image::new(width, height, 4);
    let row = width.max(1) as usize;
    out.data.par_chunks_mut(4 * row).enumerate().for_each(|(y, line)| {
        let mut colors = vec![[0f32; 4]; members.count()];
        for (x, o) in line.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            members.read(y * row + x, &mut colors);
            for (c, w) in colors.iter().zip(&weights) {
                *o = std::array::from_fn(|j| o[j] + w * c[j]);
            }
            // the weights' last bit must not carry a white pixel past white
            *o = o.map(|v| v.min(1.0));
        }
    });
    Ok(out)
}

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
    /// Weight of each pixel, 255 = once, 0 = not at all: the mask, or the mask from half on, and 0
    /// where the photograph is not valid.
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
    /// A pixel that is not finite is an error, here and so in every fit: it comes from a member
    /// that has diverged, of which no other pixel should be trusted.
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
    /// They fill the frame, and a blend would show a ghost of the background at their weight. Color
    /// and alpha are multiplied by the mean opacity of the masked members, averaged with their
    /// `weights` (equally if those are all 0); where the head is opaque nothing changes. Without
    /// masked members nothing is cut.
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

    fn pixels(&self) -> usize {
        self.size().0 as usize * self.size().1 as usize
    }

    /// Reads all members at pixel `i`, clamped to 0..=1 and cut. `out`: `[members]`.
    #[inline]
    fn read(&self, i: usize, out: &mut [[f32; 4]]) {
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
    fn check(&self, target: &BlendTarget) -> Result<()> {
        let (photo, weight) = (target.photo, target.weight);
        same_size("the photograph", (photo.width, photo.height), self.size())?;
        same_size("the weight map", (weight.width, weight.height), self.size())
    }

    /// Calls `with(i, weight, member − photo)` for the pixels that count. The errors are
    /// `[members]`, RGB.
    fn errors(
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
fn in_bands<T: Send>(pixels: usize, band: impl Fn(Range<usize>) -> T + Sync) -> Vec<T> {
    (0..BANDS).into_par_iter().map(|b| band(b * pixels / BANDS..(b + 1) * pixels / BANDS)).collect()
}

/// Returns the error for an empty list of members.
fn no_members() -> Error {
    Error::cannot("there are no members to blend", "name at least one member whose views are rendered")
}

/// Normalizes weights to a sum of exactly 1. A sum that is off by more than 0.001 is an error.
fn normalized(weights: &[f32], members: usize) -> Result<Vec<f32>> {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(width: u32, height: u32, color: [f32; 4]) -> Image {
        let mut image = Image::new(width, height, 4);
        image.data.as_chunks_mut::<4>().0.fill(color);
        image
    }

    fn member<'a>(name: &'a str, image: &'a Image) -> Member<'a> {
        Member { name, image, masked: name != "baseline" }
    }

    fn near(found: &[f32], expected: [f32; 4]) {
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}, not {expected:?}");
    }

    #[test]
    fn the_papers_weights_give_the_papers_blend() {
        let views = [
            flat(3, 2, [0.2, 1.5, 0.0, 1.0]),
            flat(3, 2, [0.4, 1.0, -1.0, 0.5]),
            flat(3, 2, [0.6, 0.0, 0.5, 1.0]),
        ];
        let members = ["baseline", "tface", "iface"];
        let list: Vec<Member> = members.iter().zip(&views).map(|(n, v)| member(n, v)).collect();
        let out = blend(&Members::new(&list).unwrap(), &PAPER_WEIGHTS).unwrap();
        // red   0.1·0.2 + 0.6·0.4 + 0.3·0.6 = 0.44
        // green 0.1·1 (clamped) + 0.6·1 = 0.7
        // blue  0.6·0 (clamped) + 0.3·0.5 = 0.15
        // alpha 0.1 + 0.3 + 0.3 = 0.7
        for pixel in out.data.chunks(4) {
            near(pixel, [0.44, 0.7, 0.15, 0.7]);
        }
        assert_eq!((out.width, out.height, out.channels), (3, 2, 4));
    }

    #[test]
    fn one_member_is_itself_and_eleven_can_be_blended() {
        let view = flat(2, 2, [0.25, 0.5, 0.75, 1.0]);
        let alone = Members::new(&[member("iface", &view)]).unwrap();
        assert_eq!(blend(&alone, &[1.0]).unwrap(), view);
        let many = Members::new(&[member("iface", &view); 11]).unwrap();
        near(&blend(&many, &[1.0 / 11.0; 11]).unwrap().data[..4], [0.25, 0.5, 0.75, 1.0]);
    }

    #[test]
    fn a_member_without_masks_is_cut_to_the_head() {
        // pixel 0: the background; 1: hair, half opaque in T-Face, 0.8 in I-Face; 2: skin
        let baseline = flat(3, 1, [0.8, 0.8, 0.8, 1.0]);
        let (mut tface, mut iface) = (Image::new(3, 1, 4), Image::new(3, 1, 4));
        tface.data[4..8].copy_from_slice(&[0.2, 0.2, 0.2, 0.5]);
        iface.data[4..8].copy_from_slice(&[0.4, 0.4, 0.4, 0.8]);
        tface.data[8..12].copy_from_slice(&[0.6, 0.6, 0.6, 1.0]);
        iface.data[8..12].copy_from_slice(&[0.7, 0.7, 0.7, 1.0]);
        let list = [member("baseline", &baseline), member("tface", &tface), member("iface", &iface)];
        let members = Members::new(&list).unwrap();
        let ghost = blend(&members, &PAPER_WEIGHTS).unwrap();
        near(ghost.pixel(0, 0), [0.08, 0.08, 0.08, 0.1]);
        let out = blend(&members.cut(&PAPER_WEIGHTS).unwrap(), &PAPER_WEIGHTS).unwrap();
        near(out.pixel(0, 0), [0.0; 4]);
        // opacity (0.6·0.5 + 0.3·0.8)/0.9 = 0.6; color 0.1·0.8·0.6 + 0.6·0.2 + 0.3·0.4 = 0.288,
        // alpha 0.1·0.6 + 0.6·0.5 + 0.3·0.8 = 0.6
        near(out.pixel(1, 0), [0.288, 0.288, 0.288, 0.6]);
        near(out.pixel(2, 0), [0.65, 0.65, 0.65, 1.0]);
        near(ghost.pixel(2, 0), [0.65, 0.65, 0.65, 1.0]);
        // weights of 0 for the masked ones: they count alike, opacity (0.5 + 0.8)/2 = 0.65
        let alone = Members::new(&list).unwrap().cut(&[1.0, 0.0, 0.0]).unwrap();
        let out = blend(&alone, &[1.0, 0.0, 0.0]).unwrap();
        near(out.pixel(1, 0), [0.52, 0.52, 0.52, 0.65]);
        // without masked members nothing is cut
        let only = Members::new(&list[..1]).unwrap().cut(&[1.0]).unwrap();
        assert_eq!(blend(&only, &[1.0]).unwrap(), baseline);
    }

    #[test]
    fn what_cannot_be_blended_is_said() {
        let (view, other, rgb) = (flat(4, 3, [0.5; 4]), flat(4, 4, [0.5; 4]), Image::new(4, 3, 3));
        let error = |list: &[Member]| Members::new(list).unwrap_err().to_string();
        assert_eq!(error(&[]), "there are no members to blend");
        let e = error(&[member("tface", &view), member("iface", &other)]);
        assert_eq!(e, "the view of member `iface` is 4 × 4 pixels, expected 4 × 3");
        assert_eq!(error(&[member("tface", &rgb)]), "the view of member `tface` has 3 channels, expected 4");
        let mut broken = view.clone();
        broken.pixel_mut(2, 1)[3] = f32::NAN;
        broken.pixel_mut(0, 2)[0] = f32::INFINITY;
        let e = error(&[member("tface", &broken)]);
        assert_eq!(e, "member `tface`: 2 pixels are not finite, the first in column 2 of row 1");

        let members = Members::new(&[member("tface", &view), member("iface", &view)]).unwrap();
        let error = |weights: &[f32]| blend(&members, weights).unwrap_err();
        assert_eq!(error(&[1.0]).to_string(), "there are 1 weights for 2 members");
        assert_eq!(error(&[1.5, -0.5]).to_string(), "weight 2 is -0.5, expected a finite number from 0 up");
        assert!(error(&[f32::NAN, 0.5]).to_string().starts_with("weight 1 is NaN"));
        assert_eq!(error(&[1.0, 3.0]).to_string(), "the weights sum to 4, expected 1");
        assert_eq!(error(&[1.0, 3.0]).hint(), "the same shares with sum 1 are 0.2500, 0.7500");
        assert_eq!(error(&[0.0, 0.0]).hint(), "give at least one member a weight above 0");
        // a thousandth is rounding, and does not darken
        near(&blend(&members, &[0.5, 0.4999]).unwrap().data[..4], [0.5; 4]);
    }
}
