//! Stage · several views of one camera become one.
//!
//! `I(p) = Σ_k w_k · clamp(I_k(p), 0, 1)`, the paper's §5 with `w` = 0.1 baseline, 0.6 T-Face,
//! 0.3 I-Face. Three things are better than fixed weights, each fitted on views that were held out
//! of training, never on test views:
//!
//! - [`Fit`]: the weights of least squared error, `w ≥ 0`, `Σ w = 1`;
//! - [`RegionFit`]: weights that change smoothly over the head, [`RegionWeights`];
//! - [`ColorFit`]: a correction of one member's colours, [`ColorMap`], before it is blended.
//!
//! All of them gather sums view by view, so a capture never has to be in memory. Everything is
//! sRGB-coded colour over black (premultiplied), and nothing is rounded to 8 bits here. Sums are
//! taken in bands of fixed size and fixed order: any number of threads gives the same bits.

mod blend;
mod color;
mod error;
mod fit;
mod members;
mod region_fit;
mod regions;
mod simplex;

pub use blend::{blend, blend_regions};
pub use color::{ColorFit, ColorGain, ColorMap, Correction};
pub use error::EnsembleError;
pub use fit::{Fit, MAX_MEMBERS};
pub use members::{Member, Members, Target};
pub use region_fit::{RegionFit, Stiffness};
pub use regions::{MAX_NODES, NODES, RegionWeights};

/// The paper's §5: baseline, T-Face, I-Face.
pub const PAPER_WEIGHTS: [f32; 3] = [0.1, 0.6, 0.3];

#[cfg(test)]
mod fit_tests;
