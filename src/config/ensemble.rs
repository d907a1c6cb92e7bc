//! `[ensemble]`: how several views of one camera become one.

use super::{Key, Method, Preset};
use serde::{Deserialize, Serialize};

/// Which views are blended, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnsembleConfig {
    /// Whose views; none of them for no blend.
    pub members: Vec<Method>,
    /// The share of each member, in their order; empty to fit them on `capture.tiles`.
    pub weights: Vec<f64>,
    /// Are members that were trained without masks cut to the head?
    pub cut: bool,
}

pub(super) const KEYS: &[Key] = &[
    Key::word(
        "members",
        "A list of baseline, tface, volume (I-Face), raycast (I-Face's mesh) and textured (head.glb); an empty list for \
         no blend.",
    ),
    Key::number(
        "weights",
        "The share of each member, in their order, together 1; an empty list fits them on capture.tiles.",
        0.0,
        1.0,
    ),
    Key::word("cut", "Cut members trained without masks to the head, true or false; else the stage shows."),
];

impl EnsembleConfig {
    /// The values a preset starts with: the paper's §5, or the two fields that know masks, which a baseline without
    /// them makes no better.
    pub fn preset(preset: Preset) -> EnsembleConfig {
        let (members, weights) = match preset {
            Preset::Paper => (vec![Method::Baseline, Method::Tface, Method::Volume], vec![0.1, 0.6, 0.3]),
            _ => (vec![Method::Tface, Method::Volume], Vec::new()),
        };
        EnsembleConfig { members, weights, cut: true }
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
    fn weights_are_fitted_unless_they_are_given_and_iface_is_a_word_for_volume() {
        let c = set(&[]);
        assert_eq!(c.ensemble.members, [Method::Tface, Method::Volume]);
        assert!(c.ensemble.weights.is_empty() && c.capture.tiles > 0.0);
        assert!(!c.render.method.contains(&Method::Baseline));
        let c = set(&["preset=paper"]);
        assert_eq!(c.ensemble.members, [Method::Baseline, Method::Tface, Method::Volume]);
        assert_eq!((c.ensemble.weights.iter().sum::<f64>(), c.capture.tiles), (1.0, 0.0));
        assert!(c.render.method.contains(&Method::Baseline));
        let c = set(&["ensemble.members=tface,iface", "ensemble.weights=1,0"]).ensemble;
        assert_eq!((c.members[1], c.weights.as_slice()), (Method::Volume, &[1.0, 0.0][..]));
        assert!(set(&["preset=paper", "ensemble.weights="]).ensemble.weights.is_empty());
    }
}
