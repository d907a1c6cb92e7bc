//! `[ensemble]`: how several views of one camera become one.

use super::Method;
use super::table::table;

table! {
    /// Which views are blended, and how.
    pub struct EnsembleConfig;
    keys {
        /// A list of baseline, tface, volume (I-Face), raycast (I-Face's mesh) and textured (head.glb); an empty list
        /// for no blend.
        members: Vec<Method>
            => vec![Method::Tface, Method::Volume, Method::Raycast],
            vec![Method::Tface, Method::Volume, Method::Raycast],
            vec![Method::Baseline, Method::Tface, Method::Volume];
        /// The share of each member, in their order, together 1; an empty list fits them on capture.tiles.
        weights: Vec<f64>, 0.0..=1.0 => Vec::new(), Vec::new(), vec![0.1, 0.6, 0.3];
        /// Cut members trained without masks to the head, true or false; else the background shows.
        cut: bool => true, true, false;
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
        assert_eq!(c.ensemble.members, [Method::Tface, Method::Volume, Method::Raycast]);
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
