//! Stage: blends several views of one camera into one.
//!
//! `I(p) = Σ_k w_k · clamp(I_k(p), 0, 1)`, the paper's §5 with `w` = 0.1 baseline, 0.6 T-Face,
//! 0.3 I-Face. Which member is the better one differs from capture to capture, and fixed weights that suit
//! one make the blend of another worse than its best member. So weights are fitted ([`fit_weights`]): those of
//! least squared error, `w ≥ 0`, `Σ w = 1`, on squares of the training photographs that nothing learned
//! from ([`tiles`]), never on test views.
//!
//! A fit gathers sums view by view, so a capture never has to be in memory. Everything is
//! sRGB-coded color over black (premultiplied), and nothing is rounded to 8 bits here. Sums are
//! taken in bands of fixed size and fixed order: any number of threads gives the same bits.

mod fit;
mod members;

pub use fit::{Fit, MAX_MEMBERS, Tile, fit_weights, tiles};
pub use members::{BlendTarget, Member, Members, shares_hint};

use crate::Result;
use crate::image::Image;
use members::normalized;
use rayon::prelude::*;

/// The paper's §5: baseline, T-Face, I-Face.
pub const PAPER_WEIGHTS: [f32; 3] = [0.1, 0.6, 0.3];

/// Blends the members with one weight each, in float; the result is rounded once, when it is written.
///
/// Weights are shares: finite, from 0 up, with sum 1. A sum beside 1 by at most 0.001 is taken as
/// rounding and divided out; beyond that it is an error, since the blend would be darker or brighter
/// than its members.
///
/// # Errors
/// Fails if the number of weights differs from that of the members, if a weight is negative or not finite, or if
/// their sum is not 1.
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

#[cfg(test)]
mod fit_tests;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ensemble::{Member, PAPER_WEIGHTS};

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
