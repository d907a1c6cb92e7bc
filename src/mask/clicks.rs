//! Clicks on a photograph, and the conditions that all of them must meet.

use tiface_base::{Error, Result};

/// One click of a person on a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Click {
    /// Column, as a pixel index: 0 is the center of the leftmost pixels (`prompts.json`'s
    /// convention).
    pub x: f32,
    /// Row, as a pixel index: 0 is the center of the top pixels.
    pub y: f32,
    /// Whether it is on the head.
    pub head: bool,
}

impl Click {
    /// Returns whether the click is on a photograph of this size. Index 0 is a pixel's center, so a
    /// picture reaches from −½ to just before `side` − ½, which rounds to the pixel behind the
    /// last.
    pub fn is_inside(&self, (width, height): (u32, u32)) -> bool {
        let inside = |v: f32, side: u32| v >= -0.5 && v < side as f32 - 0.5;
        inside(self.x, width) && inside(self.y, height)
    }

    /// Returns the same point of the photograph on a picture of it at another size; sizes are width
    /// and height.
    pub fn moved(&self, from: (u32, u32), to: (u32, u32)) -> Click {
        let moved = |v: f32, from: u32, to: u32| ((v as f64 + 0.5) * to as f64 / from as f64 - 0.5) as f32;
        Click { x: moved(self.x, from.0, to.0), y: moved(self.y, from.1, to.1), head: self.head }
    }
}

/// Checks the clicks on a photograph of `width` × `height` pixels, before anything is computed;
/// `subject` is what messages call it.
///
/// # Errors
/// As [`check_places`], or when two clicks call the same pixel head and background.
pub(super) fn check(subject: &str, clicks: &[Click], width: u32, height: u32) -> Result<()> {
    check_places(subject, clicks, width, height)?;
    let pixel = |c: &Click| (c.x.round().max(0.0) as u32, c.y.round().max(0.0) as u32);
    for (i, a) in clicks.iter().enumerate() {
        let contradicts = |b: &Click| a.head != b.head && pixel(a) == pixel(b);
        if let Some(j) = clicks.iter().skip(i + 1).position(contradicts) {
            let (first, second, (x, y)) = (i + 1, i + j + 2, pixel(a));
            return Err(Error::cannot(
                format!(
                    "{subject}: clicks {first} and {second} call the same pixel ({x}, {y}) head and background"
                ),
                "remove the wrong one of the two clicks",
            ));
        }
    }
    Ok(())
}

/// The part of [`check`] that also holds on a reduced photograph, where clicks may fall together.
///
/// # Errors
/// Without clicks, without one on the head, and for one outside the photograph.
pub(super) fn check_places(subject: &str, clicks: &[Click], width: u32, height: u32) -> Result<()> {
    if clicks.is_empty() {
        return Err(no_clicks(subject));
    }
    if let Some(i) = clicks.iter().position(|c| !c.is_inside((width, height))) {
        let (n, Click { x, y, .. }) = (i + 1, clicks[i]);
        return Err(Error::cannot(
            format!(
                "{subject}: click {n} at ({x}, {y}) is outside the photograph of {width} × {height} pixels"
            ),
            "coordinates are pixels of the photograph as stored, x right and y down from the top left; were the \
             clicks made on a photograph of another size?",
        ));
    }
    if clicks.iter().all(|c| !c.head) {
        let n = clicks.len();
        return Err(Error::cannot(
            format!("{subject}: all {n} clicks are on the background, none is on the head"),
            "add clicks on the face, the hair and the garment: label 1 is the head, 0 the background",
        ));
    }
    Ok(())
}

/// Returns the error for a photograph without clicks.
pub(super) fn no_clicks(subject: &str) -> Error {
    Error::cannot(
        format!("{subject} has no clicks"),
        "click the face, the hair and each part of the garment (label 1), and twice the background (label 0)",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn click(x: f32, y: f32, head: bool) -> Click {
        Click { x, y, head }
    }

    #[test]
    fn clicks_keep_their_place() {
        // the first of four pixels has its center at 1/8 of the width, which is a quarter into the
        // first of two
        let moved = Click { x: 0.0, y: 3.0, head: true }.moved((4, 4), (2, 2));
        assert_eq!((moved.x, moved.y), (-0.25, 1.25));
    }

    #[test]
    fn clicks_that_cannot_be_used_are_named() {
        let check = |clicks: &[Click]| check("view `007`", clicks, 40, 30);
        assert_eq!(check(&[click(39.4, 29.4, true), click(-0.4, 0.0, false)]), Ok(()));
        let refused = |clicks: &[Click], message: &str| {
            let e = check(clicks).unwrap_err();
            assert!(e.to_string().contains(message) && !e.hint().is_empty(), "{e}");
        };
        refused(&[], "view `007` has no clicks");
        refused(&[click(1.0, 1.0, false)], "view `007`: all 1 clicks are on the background");
        for (x, y) in
            [(39.5, 3.0), (40.0, 3.0), (3.0, 30.0), (-1.0, 3.0), (f32::NAN, 3.0), (f32::INFINITY, 3.0)]
        {
            refused(&[click(1.0, 1.0, true), click(x, y, false)], "click 2 at");
        }
        let clicks = [click(4.2, 5.0, true), click(9.0, 9.0, true), click(4.0, 5.3, false)];
        refused(&clicks, "clicks 1 and 3 call the same pixel (4, 5)");
        // on a reduced photograph that is no contradiction
        assert_eq!(check_places("view `007`", &clicks, 40, 30), Ok(()));
    }
}
