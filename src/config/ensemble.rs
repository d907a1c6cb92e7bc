//! `[ensemble]`: how several views of one camera become one.

use super::{Key, Method, Preset};
use serde::{Deserialize, Serialize};

/// Weights fitted on views that were set aside, next to the given ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fit {
    /// None: only the given weights.
    None,
    /// One weight for each member.
    Global,
    /// Weights that change smoothly over the head.
    Regions,
}

/// A correction of the members' colours, fitted on views that were set aside.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Correct {
    /// None.
    None,
    /// One factor for each channel.
    Gain,
    /// Any mix of the channels, and an offset.
    Affine,
}

/// Which views are blended, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnsembleConfig {
    /// Whose views; none of them for no blend.
    pub members: Vec<Method>,
    /// The share of each member, in their order.
    pub weights: Vec<f64>,
    /// Are members that were trained without masks cut to the head?
    pub cut: bool,
    /// Weights fitted on views that were set aside.
    pub fit: Fit,
    /// Colours corrected on views that were set aside.
    pub correct: Correct,
    /// Nodes of the grid of regions along each axis.
    pub regions: usize,
}

pub(super) const KEYS: &[Key] = &[
    Key::word(
        "members",
        "A list of baseline, tface, volume (I-Face), raycast (its mesh) and textured \
         (head.glb); an empty list for no blend.",
    ),
    Key::number("weights", "The share of each member, in their order; together 1.", 0.0, 1.0),
    Key::word("cut", "Cut members trained without masks to the head, true or false; else the stage shows."),
    Key::word(
        "fit",
        "A second blend, with weights fitted on views set aside: none, global, or regions (smooth over the head).",
    ),
    Key::word(
        "correct",
        "Members' colours corrected on views set aside: none, gain (per channel) or affine.",
    ),
    Key::number("regions", "Nodes of the grid of regions along each axis.", 2.0, 16.0),
];

impl EnsembleConfig {
    /// The values a preset starts with: the paper's §5 in all of them.
    pub fn preset(_: Preset) -> EnsembleConfig {
        EnsembleConfig {
            members: vec![Method::Baseline, Method::Tface, Method::Volume],
            weights: vec![0.1, 0.6, 0.3],
            cut: true,
            fit: Fit::None,
            correct: Correct::None,
            regions: 5,
        }
    }

    /// Is anything fitted on views that were set aside?
    pub fn fits(&self) -> bool {
        !self.members.is_empty() && (self.fit != Fit::None || self.correct != Correct::None)
    }
}

#[cfg(test)]
mod tests {
    use crate::config::{Config, Method, Sources};

    fn set(set: &[&str]) -> Config {
        let set = set.iter().map(|s| s.to_string()).collect();
        Config::resolve(&Sources { set, ..Sources::default() }).unwrap()
    }

    #[test]
    fn the_default_is_the_papers_blend_and_iface_is_a_word_for_volume() {
        let c = set(&[]).ensemble;
        assert_eq!(c.members, [Method::Baseline, Method::Tface, Method::Volume]);
        assert_eq!((c.weights.iter().sum::<f64>(), c.fits()), (1.0, false));
        let c =
            set(&["ensemble.members=tface,iface", "ensemble.weights=1,0", "ensemble.fit=regions"]).ensemble;
        assert_eq!(
            (c.members.as_slice(), c.weights.as_slice()),
            (&[Method::Tface, Method::Volume][..], &[1.0, 0.0][..])
        );
        assert!(c.fits());
        let c = set(&["ensemble.members=", "ensemble.fit=global"]).ensemble;
        assert!(c.members.is_empty() && !c.fits());
    }
}
