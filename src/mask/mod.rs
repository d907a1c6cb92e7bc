//! Stage `mask`: which pixels are the head, from a few clicks.
//!
//! A click says "this is head" or "this is not". From clicks a hard mask is cut, a band around its
//! outline is called unsure (the trimap), and the band's opacity is estimated from the photograph:
//!
//! ```text
//! photograph + clicks → hard mask → trimap → soft alpha
//! ```
//!
//! Masks, trimaps and alphas are [`Gray`](crate::image::Gray): 0 outside, 255 head, 128 unsure in a trimap.

pub mod agree;
pub mod alpha;
pub mod closed_form;
mod components;
pub mod cut;
mod cut_error;
pub mod distance;
mod font;
mod hull;
mod known;
pub mod maxflow;
pub mod mixture;
pub mod page;
pub mod points;
pub mod scale;
pub mod sheet;
pub mod spread;
pub mod trimap;

#[cfg(feature = "matting")]
pub mod networks;
#[cfg(all(test, feature = "matting"))]
mod networks_tests;
#[cfg(feature = "matting")]
mod onnx;
#[cfg(feature = "matting")]
mod processor;
#[cfg(feature = "matting")]
mod resample;
#[cfg(feature = "matting")]
mod sam;
#[cfg(feature = "matting")]
mod vitmatte;

#[cfg(feature = "matting")]
pub use self::{onnx::MaskNetworkError, vitmatte::VitMatteColours};
pub use cut_error::CutError;

/// One click of a person on a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Click {
    /// Column, as a pixel index: 0 is the centre of the leftmost pixels (`prompts.json`'s convention).
    pub x: f32,
    /// Row, as a pixel index: 0 is the centre of the top pixels.
    pub y: f32,
    /// Is the head there?
    pub head: bool,
}

impl Click {
    /// The same point of the photograph on a picture of it at another size; sizes are width and height.
    pub fn moved(&self, from: (u32, u32), to: (u32, u32)) -> Click {
        let moved = |v: f32, from: u32, to: u32| ((v as f64 + 0.5) * to as f64 / from as f64 - 0.5) as f32;
        Click { x: moved(self.x, from.0, to.0), y: moved(self.y, from.1, to.1), head: self.head }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clicks_keep_their_place() {
        // the first of four pixels has its centre at 1/8 of the width, which is a quarter into the first of two
        let moved = Click { x: 0.0, y: 3.0, head: true }.moved((4, 4), (2, 2));
        assert_eq!((moved.x, moved.y), (-0.25, 1.25));
    }
}
