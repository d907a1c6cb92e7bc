//! What can be wrong with members, weights and fits.

use super::MAX_MEMBERS;

/// Why views cannot be blended, or a blend not be fitted.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EnsembleError {
    /// Nothing to blend.
    #[error("there are no members to blend")]
    NoMembers,
    /// More than a fit can weigh.
    #[error("{found} members cannot be fitted, at most {MAX_MEMBERS}")]
    TooManyMembers {
        /// How many were given.
        found: usize,
    },
    /// A fit was made for another number of members.
    #[error("there are {found} members, expected {expected}")]
    Members {
        /// How many were given.
        found: usize,
        /// How many the fit or the weights are for.
        expected: usize,
    },
    /// Pictures of one view differ in size.
    #[error("{what} is {} × {} pixels, expected {} × {}", found.0, found.1, expected.0, expected.1)]
    Size {
        /// Which picture: the member by name, the photograph or the weight map.
        what: String,
        /// Its width and height.
        found: (u32, u32),
        /// Those of the first member.
        expected: (u32, u32),
    },
    /// A picture of another kind.
    #[error("{what} has {found} channels, expected {expected}")]
    Channels {
        /// Which picture.
        what: String,
        /// How many there are.
        found: usize,
        /// How many there should be.
        expected: usize,
    },
    /// A render that went wrong.
    #[error(
        "member `{member}`: {pixels} pixels are not finite, the first in column {} of row {}", first.0, first.1
    )]
    NotFinite {
        /// Its name.
        member: String,
        /// How many pixels.
        pixels: usize,
        /// Column and row of the first, from 0.
        first: (u32, u32),
    },
    /// Not one weight for each member.
    #[error("there are {found} weights for {expected} members")]
    WeightCount {
        /// How many were given.
        found: usize,
        /// How many members there are.
        expected: usize,
    },
    /// A weight that is no share.
    #[error("weight {} is {value}, expected a finite number from 0 up", index + 1)]
    Weight {
        /// Which one, from 0.
        index: usize,
        /// Its value.
        value: f32,
    },
    /// Weights that would darken or brighten the blend.
    #[error("the weights sum to {sum}, expected 1")]
    WeightSum {
        /// As given.
        weights: Vec<f32>,
        /// Their sum.
        sum: f64,
    },
    /// No pixel to fit on.
    #[error("no pixel counts: the weight maps of all views are empty")]
    NoPixels,
}

crate::error::error_from!(EnsembleError, Cannot);

impl EnsembleError {
    /// The way out.
    pub fn hint(&self) -> String {
        match self {
            EnsembleError::NoMembers => "name at least one member whose views are rendered".into(),
            EnsembleError::TooManyMembers { .. } => {
                "blend them with weights of your own, or fit fewer".into()
            }
            EnsembleError::Members { .. } => "give every view the same members, in the same order".into(),
            EnsembleError::Size { .. } => {
                "render the members again, all at the size of the photograph".into()
            }
            EnsembleError::Channels { .. } => "members are RGBA renders: render the view again".into(),
            EnsembleError::NotFinite { .. } => {
                "its training has probably diverged: train that member again, or leave it out".into()
            }
            EnsembleError::WeightCount { .. } => "write one weight for each member, in their order".into(),
            EnsembleError::Weight { .. } => "a weight is the share of a member, from 0 to 1".into(),
            EnsembleError::WeightSum { weights, sum } if *sum > 0.0 => {
                let scaled: Vec<String> = weights.iter().map(|w| format!("{:.4}", *w as f64 / sum)).collect();
                format!("the same shares with sum 1 are {}", scaled.join(", "))
            }
            EnsembleError::WeightSum { .. } => "give at least one member a weight above 0".into(),
            EnsembleError::NoPixels => "hold out pixels in which the head is seen and masked".into(),
        }
    }
}
