//! Stage `mask`: which pixels are the head, from a few clicks or from what a network proposes.
//!
//! A click says "this is head" or "this is not". From clicks a hard mask is cut, a band around its
//! outline is unknown (the trimap), and the band's opacity is estimated from the photograph:
//!
//! ```text
//! photograph + clicks → hard mask → trimap → soft alpha
//! ```
//!
//! Masks, trimaps and alphas are [`Gray`](tiface_base::image::Gray): 0 outside, 255 head, 128
//! unknown in a trimap.

mod clicks;
pub mod distance;
mod hull;
mod morphology;

pub mod prompts;

pub mod pages;

pub mod grabcut;

pub mod propagate;

pub mod consistency;

pub mod matting;
#[cfg(feature = "matting")]
pub mod networks;

/// Networks in a build without them.
#[cfg(not(feature = "matting"))]
pub mod networks {
    pub use crate::onnx::Networks;
}

pub use clicks::Click;
