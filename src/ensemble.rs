//! Stage · several views of one camera become one.
//!
//! `I(p) = Σ_k w_k · clamp(I_k(p), 0, 1)`, the paper's §5 with `w` = 0.1 baseline, 0.6 T-Face,
//! 0.3 I-Face. Which member is the better one differs from capture to capture, and fixed weights that suit
//! one make the blend of another worse than its best member. So weights are fitted ([`weigh`]): those of
//! least squared error, `w ≥ 0`, `Σ w = 1`, on squares of the training photographs that nothing learned
//! from ([`tiles`]), never on test views.
//!
//! A fit gathers sums view by view, so a capture never has to be in memory. Everything is
//! sRGB-coded color over black (premultiplied), and nothing is rounded to 8 bits here. Sums are
//! taken in bands of fixed size and fixed order: any number of threads gives the same bits.

mod blend;
mod fit;
mod members;
mod simplex;
mod tiles;

pub use blend::blend;
pub use fit::{Fit, weigh};
pub use members::{BlendTarget, Member, Members, shares_hint};
pub use simplex::MAX_MEMBERS;
pub use tiles::{Tile, tiles};

/// The paper's §5: baseline, T-Face, I-Face.
pub const PAPER_WEIGHTS: [f32; 3] = [0.1, 0.6, 0.3];

#[cfg(test)]
mod fit_tests;
